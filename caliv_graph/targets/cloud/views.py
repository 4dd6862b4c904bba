"""Weights of clouds of a target when several have the same view, and even choices among them."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from caliv_graph.products import Array, IntArray

SAME_VIEW_M = 0.05
"""Width of a view: where the target has the same place in the LiDAR's frame to this distance, the
beams hit the same spots of it. Beams of common LiDARs are 2 to 10 cm apart at 10 m."""

CELL_M = 0.2 * SAME_VIEW_M
"""Scans within so small a cell count as from its middle: the number is right to a few percent."""

TYPICAL_SHARED = 0.25
"""Part of the variance of a height that scans of one view share, where it has not been estimated:
3 to 4.5 mm of what the shape does not show beside 5.5 to 10 mm of noise, on two OS1-128."""

TOTAL_PER_LIDARS = 2.5
"""Clouds of one target that are used at most, as a multiple of `extraction.max_scans`: with more
LiDARs fewer of each, since S2S depends on all of them and the cost grows with the square."""


def views(centres_lidar: Array) -> Array:
    """(n,) how many clouds of a LiDAR have the view of each, itself included, at least 1.

    A view is the place of the target in the frame of the LiDAR, `centres_lidar` (n, 3), metres.
    """
    if not len(centres_lidar):
        return np.zeros(0)
    # Pairs of cells, not of scans: those of a vehicle that stands for minutes are millions.
    cells = np.floor(centres_lidar / CELL_M)
    _, cell, scans = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    cell = cell.ravel()
    places = np.column_stack(
        [np.bincount(cell, coordinate) / scans for coordinate in centres_lidar.T]
    )
    pairs = cKDTree(places).query_pairs(4.0 * SAME_VIEW_M, output_type="ndarray")
    apart = np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1)
    alike = np.exp(-0.5 * (apart / SAME_VIEW_M) ** 2)
    count = scans.astype(np.float64)
    for end, other in ((0, 1), (1, 0)):
        count += np.bincount(pairs[:, end], alike * scans[pairs[:, other]], len(scans))
    return np.asarray(count[cell])


def weights_of_views(count: Array, shared: Array | float = TYPICAL_SHARED) -> Array:
    """(n,) weight, 0 to 1, of clouds whose view `count` (n,) have: errors are shared in part.

    The variance of a mean of c errors with the correlation `shared` is that of
    c / (1 + (c - 1) shared) independent ones (Kish's design effect).
    """
    return np.asarray(1.0 / (1.0 + (count - 1.0) * shared))


def view_weights(centres_lidar: Array) -> Array:
    """(n,) weight, 0 to 1, of each cloud of a LiDAR, before its noise is known; see `views`."""
    return weights_of_views(views(centres_lidar))


def evenly_spread(weights: Array, most: int) -> IntArray:
    """Indices of at most `most` clouds, ascending, evenly spread over the sum of weights (n,)."""
    if len(weights) <= most:
        return np.arange(len(weights), dtype=np.int64)
    middle = np.cumsum(weights) - 0.5 * weights
    wanted = np.linspace(middle[0], middle[-1], most)
    after = np.clip(np.searchsorted(middle, wanted), 1, len(weights) - 1)
    nearer = wanted - middle[after - 1] < middle[after] - wanted
    return np.unique(np.where(nearer, after - 1, after)).astype(np.int64)


def preference(numbers: IntArray, count: int) -> Array:
    """(n,) from 0 to 1, the order in which scans with these `numbers` of `count` are preferred.

    That of van der Corput: the first m are spread evenly over all, for every m.
    """
    out, left = np.zeros(len(numbers)), np.asarray(numbers, dtype=np.int64)
    for bit in range(1, max(int(count) - 1, 1).bit_length() + 1):
        out += (left & 1) * 0.5**bit
        left = left >> 1
    # Not zero: the first scan of all is not to be taken whatever its weight.
    return np.asarray(out + 0.5 ** (bit + 1))


def chosen(preferences: Array, weights: Array, most: int) -> IntArray:
    """Indices of `most` clouds at most, ascending: as many at each place as the weights (n,) ask.

    One cloud more or less, or another weight, changes a single choice: which clouds are used shall
    not depend on the initial guess, by which a cloud at the rim of a region is found or not.
    """
    first = np.argsort(preferences / weights, kind="stable")[:most]
    return np.asarray(np.sort(first), dtype=np.int64)


def clouds_per_lidar(max_scans: int, seeing: int) -> int:
    """Clouds of one LiDAR that are used at most if so many LiDARs see the target often enough."""
    return min(max_scans, max(round(TOTAL_PER_LIDARS * max_scans / max(seeing, 1)), 10))
