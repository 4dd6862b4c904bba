"""Which points of a cloud are returns."""

from __future__ import annotations

import numpy as np

from caliv_graph.products import Array, BoolArray


def is_return(points_lidar: Array, min_range: float, max_range: float) -> BoolArray:
    """Which points (N, 3), metres in the lidar frame, are returns within the ranges; (N,).

    NaN compares false, infinity exceeds any `max_range`, and (0, 0, 0) is a beam without a return
    even where `min_range` is 0.
    """
    squared_range = np.einsum("ij,ij->i", points_lidar, points_lidar)
    within = (squared_range >= min_range**2) & (squared_range <= max_range**2)
    return np.asarray(within & (squared_range > 0.0))
