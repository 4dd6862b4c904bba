"""The target's points in each scan.

`extract` is the whole of it. `scans`: which scans are decoded and which clouds are used. `region`:
candidates in one scan. `beams`: which points of a scan are of one object. `track`: the static
objects among them. `constellation`: several objects in one region, matched between LiDARs. `moved`:
a target that somebody carries from place to place. `views`: weights of clouds with the same view.
`field_of_view`: of a LiDAR, from its scans, and what it cuts off.

Words: a *scan* is all that a LiDAR returns at a stamp; a *candidate* is an object of a scan that
may be the target; a *cloud* is the candidate that is taken.
"""
