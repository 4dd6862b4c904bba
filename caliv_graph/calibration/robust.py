"""Robust weights: what stands in for the paper's percentile filter.

`CustomFactor` cannot be cloned by GTSAM's `GncOptimizer`, and a hard trim is no M-estimator of
GTSAM's. So all kernels are one scheme here, iteratively reweighted least squares: solve, weigh
every cloud by its whitened residual, solve again.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtri

from caliv_graph.config import RobustConfig
from caliv_graph.products import Array

DOF = 6
"""Degrees of freedom of a cloud's residual."""

GNC_FACTOR = 1.4
"""Growth of the convexity parameter of graduated non-convexity (Yang et al. 2020)."""

MIN_WEIGHT = 1e-6
"""A dropped cloud keeps this weight, so that its information stays invertible."""


EXPLAINED = (0.4, 0.8)
"""A cloud of which the target explains less than the first part of what it explains of the median
cloud has no say, and from the second on its full say."""


def explained_part(inlier_ratio: Array) -> Array:
    """Factors (J,) on the weights of clouds by how much of each is target at all.

    A cloud that lies where the target is not has no residual: all its points are outliers.

    Args:
        inlier_ratio: (J,) part of each cloud's points that the mixture explains.
    """
    typical = max(float(np.median(inlier_ratio)), 1e-6)
    none, full = EXPLAINED
    return np.clip((inlier_ratio / typical - none) / (full - none), 0.0, 1.0)


class RobustWeights:
    """Weights of the clouds under one kernel, round by round."""

    def __init__(self, config: RobustConfig, clouds: int) -> None:
        """Starts with full weights for `clouds` clouds."""
        self._config = config
        self._mu: float | None = None
        self._annealed = False
        self.values: Array = np.ones(clouds)

    @property
    def settled(self) -> bool:
        """Whether the kernel has reached its final shape (only `tls` is graduated)."""
        return self._config.kernel != "tls" or self._annealed

    def update(self, squared: Array, explained: Array | float = 1.0) -> float:
        """New weights; returns the largest change.

        Args:
            squared: (J,) squared whitened residuals.
            explained: (J,) factors for what the residuals do not show (`explained_part`).
        """
        before = self.values
        if self._config.kernel == "none":
            explained = 1.0
        self.values = np.maximum(self._weights(squared) * explained, MIN_WEIGHT)
        return float(np.abs(self.values - before).max())

    def _weights(self, squared: Array) -> Array:
        kernel = self._config.kernel
        if kernel == "none":
            return np.ones_like(squared)
        if kernel == "huber":
            bend = self._config.huber_k * np.sqrt(DOF)
            return np.asarray(np.minimum(1.0, bend / np.sqrt(np.maximum(squared, 1e-12))))
        if kernel == "trimmed":
            dropped = int(len(squared) * self._config.trim_percent / 100.0)
            weights = np.ones_like(squared)
            if dropped:
                weights[np.argsort(squared, kind="stable")[-dropped:]] = 0.0
            return weights
        return self._graduated(squared)

    def _graduated(self, squared: Array) -> Array:
        """Truncated least squares by graduated non-convexity (Yang et al. 2020, eq. 14)."""
        c2 = float(chdtri(DOF, self._config.tls_p_value))
        if self._annealed:
            return np.where(squared < c2, 1.0, 0.0)
        if self._mu is None:
            worst = float(squared.max())
            if 2.0 * worst <= c2:
                self._annealed = True
                return np.ones_like(squared)
            self._mu = c2 / (2.0 * worst - c2)
        mu = self._mu
        middle = np.sqrt(c2 * mu * (mu + 1.0) / np.maximum(squared, 1e-12)) - mu
        self._mu = mu * GNC_FACTOR
        self._annealed = self._mu > 1e3
        return np.clip(middle, 0.0, 1.0)


def weighted_joint(H: Array, weights: Array) -> Array:
    """Joint information of clouds whose say is weighted.

    A cloud of weight w is one whose pose is known with an error more, of information
    `w / (1 - w)` times what the others let it say: it then says w times as much, at 0 it is free,
    and a common motion of all clouds, of which H says nothing, stays unsaid. Scaled by the roots of
    the weights, H would tie clouds of different weights to where the shape happens to lie.

    Args:
        H: (6 J, 6 J) of all clouds, the shape eliminated.
        weights: (J,) from 0 to 1.
    """
    less = np.flatnonzero(weights < 1.0)
    if len(less) == 0:
        return H
    # As good as none, so that a cloud that nothing else ties down has an inverse.
    w = np.clip(weights[less], 1e-9, 1.0 - 1e-12)
    rows = (6 * less[:, None] + np.arange(6)).ravel()
    own = H.reshape(len(weights), 6, len(weights), 6)[less, :, less, :]
    more = block_diag(*(own * (w / (1.0 - w))[:, None, None]))
    ridge = (1e-12 * float(np.trace(H)) / len(H) + 1e-300) * np.eye(len(rows))
    out = H - H[:, rows] @ np.linalg.solve(H[np.ix_(rows, rows)] + more + ridge, H[rows])
    return np.asarray(0.5 * (out + out.T))
