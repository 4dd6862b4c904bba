"""Finding the target: the compact static object on the ground that all LiDARs pass.

Some scans of each LiDAR are segmented into objects (`objects`). One error per LiDAR, small by the
sigma of its guess, must explain the motion of all static ones in the map: yaw and shift are found
first (`align`). What still moves then, or is missing where it should be in view, is not static. The
static ones are judged by size and height (`tracks`), and matched across LiDARs (`find`).

Words: an *object* is a cluster of points of one scan; a *track* is what one LiDAR saw at one place
in several scans; a *proposal* is a track, or matching tracks of several LiDARs, that may be the
target.
"""

from caliv_graph.targets.search.find import FoundTarget, find_target

__all__ = ["FoundTarget", "find_target"]
