"""Marginal covariances of single variables of a linear graph, by GTSAM's Bayes tree.

QR, not Cholesky: on drives without GNSS, where positions are known to 0.1 mm at the start and to
0.2 m at the end, GTSAM's Cholesky reports a singular system (`IndeterminantLinearSystem`).
`gtsam.Marginals` offers no choice from Python, and linearises once more.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from caliv_graph.conventions import key_bias, key_imu, key_velocity, key_yaw_bias
from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array
from caliv_graph.trajectory.chain import UNDETERMINED, inverse_of


def node_ordering(n: int, yaw_bias: bool) -> gtsam.Ordering:
    """Elimination order: node after node, then the yaw bias. The fill-in stays in the chain."""
    ordering = gtsam.Ordering()
    for i in range(n):
        for key in (key_bias(i), key_velocity(i), key_imu(i)):
            ordering.push_back(key)
    if yaw_bias:
        ordering.push_back(key_yaw_bias())
    return ordering


class Marginals:
    """Marginals of a linear graph."""

    def __init__(self, linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> None:
        """Eliminates a whitened graph in this order of its variables, nodes in order of time.

        Raises:
            TrajectoryError: the graph is singular.
        """
        try:
            self._tree = linear.eliminateMultifrontal(ordering, gtsam.EliminateQR)
        except RuntimeError:  # GTSAM's report of a singular system
            raise TrajectoryError(UNDETERMINED) from None

    def covariances(self, keys: Sequence[int]) -> Array:
        """(m, d, d) covariances of m variables of one dimension d, in order of elimination.

        Raises:
            TrajectoryError: a variable is undetermined.
        """
        # From the last one back: each needs one clique beyond those in GTSAM's cache. Forward, the
        # first would recurse through the whole drive.
        try:
            factors = [self._tree.marginalFactor(key, gtsam.EliminateQR) for key in reversed(keys)]
        except RuntimeError:
            raise TrajectoryError(UNDETERMINED) from None
        return np.array([inverse_of(factor.information()) for factor in reversed(factors)])
