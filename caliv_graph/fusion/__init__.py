"""Uses of calibrations: factors for localisers, comparison and merging. README.md explains them.

`priors`, `factors` and `archive` pass a calibration to a GTSAM localiser. `terms`, `compare` and
`merge` work on the information of each drive's data alone, so a shared guess never counts twice.
"""
