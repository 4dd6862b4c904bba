"""What each of many scans of a target is worth when some of them were taken from one place."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from caliv_graph.products import Array, IntArray

SAME_VIEW_M = 0.05
"""Where the target is in the LiDAR's frame, to this distance, the beams fall on the same spots of
it: beams of common LiDARs are 2 to 10 cm apart at 10 m."""

SCANS_OF_A_VIEW = 3.0
"""What all scans from one place are worth together, in scans. They average the noise of the range,
but not what no beam hits. In simulations of a standing vehicle (10 mm noise) 80 scans are worth
2 to 6."""


def view_weights(centres_lidar: Array) -> Array:
    """(n,) what each scan of one LiDAR counts, 0 to 1: less where many saw the same.

    Args:
        centres_lidar: (n, 3) metres, where the target was in the frame of the LiDAR, per scan.
    """
    if not len(centres_lidar):
        return np.zeros(0)
    pairs = cKDTree(centres_lidar).query_pairs(4.0 * SAME_VIEW_M, output_type="ndarray")
    apart = np.linalg.norm(centres_lidar[pairs[:, 0]] - centres_lidar[pairs[:, 1]], axis=1)
    alike = np.exp(-0.5 * (apart / SAME_VIEW_M) ** 2)
    count = np.ones(len(centres_lidar))
    for end in (0, 1):
        count += np.bincount(pairs[:, end], alike, len(count))
    return np.asarray(np.minimum(1.0, SCANS_OF_A_VIEW / count))


def evenly_spread(shares: Array, most: int) -> IntArray:
    """Indices of at most so many scans, ascending, evenly spread over what there is to be seen.

    Args:
        shares: (n,) of `view_weights`, in order of time.
        most: how many at most; all if there are no more.
    """
    if len(shares) <= most:
        return np.arange(len(shares), dtype=np.int64)
    middle = np.cumsum(shares) - 0.5 * shares
    wanted = np.linspace(middle[0], middle[-1], most)
    after = np.clip(np.searchsorted(middle, wanted), 1, len(shares) - 1)
    nearer = wanted - middle[after - 1] < middle[after] - wanted
    return np.unique(np.where(nearer, after - 1, after)).astype(np.int64)
