"""Robust weights: what stands in for the paper's percentile filter.

`CustomFactor` cannot be cloned by GTSAM's `GncOptimizer`, and a hard trim is no M-estimator of
GTSAM's. So all kernels are one scheme here, iteratively reweighted least squares: solve, weigh
every cloud by its whitened residual, solve again.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtri

from caliv_graph.config.model import RobustConfig
from caliv_graph.products import Array, BoolArray, IntArray

DOF = 6
"""Degrees of freedom of a cloud's residual."""

GNC_FACTOR = 1.4
"""Growth of the convexity parameter of graduated non-convexity (Yang et al. 2020)."""

MIN_WEIGHT = 1e-6
"""A dropped cloud keeps this weight, so that its information stays invertible."""

FAR_OFF = 54.0
"""Squared whitened residual beyond which a cloud is lost by any kernel but `none`: three sigma on
each of six axes, which chance gives once in a thousand million. Such a cloud was registered to the
wrong place (cut off by the field of view, it slid along the shape), and half a say, as Huber's
kernel leaves it, would still bend all. Where a kernel weighs nothing down, this tells."""

CONTROLLED = 1e-4
"""Least part of what a cloud says that the rest of the data must control for its error to be
noticed; of what controls less, nothing can be said."""

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

    def snoop(self, W: Array, v: Array, own: Array, explained: Array | float = 1.0) -> BoolArray:
        """New weights by what each cloud is off from all the others together.

        Data snooping (Baarda 1968): a cloud that is far off bends the solution, and its neighbours
        seem to be off as well. So the worst is dropped alone, and the others are judged without it,
        until none is far off, or half are gone: then it is not they that are wrong. Kernel `none`
        drops nothing.

        Args:
            W: (6 J, 6 J) and
            v: (6 J,) of `graph.adjusted_residuals`, no cloud weighed down by its residual.
            own: (J, 6, 6) what each cloud says, the others held.
            explained: (J,) factors for what the residuals do not show (`explained_part`).

        Returns:
            (J,) the clouds that are not lost. The kernel may have taken more out.
        """
        squared = np.zeros(len(own))
        kept = np.ones(len(own), dtype=bool)
        while True:
            squared[kept] = deletion_squares(W, v, own)[0][kept]
            worst = int(np.where(kept, squared, -1.0).argmax())
            lost = squared[worst] > FAR_OFF and self._config.kernel != "none"
            if not lost or 2 * kept.sum() <= len(kept):
                self.update(squared, explained)
                # `trimmed` drops its percentage, which may be fewer.
                self.values[~kept] = MIN_WEIGHT
                return kept
            kept[worst] = False
            squared[worst] = np.inf
            W, v = _without(W, v, own, worst)

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
            # Lost clouds are infinitely far off, and are no measure.
            worst = float(np.where(np.isfinite(squared), squared, 0.0).max())
            if 2.0 * worst <= c2:
                self._annealed = True
                return np.ones_like(squared)
            self._mu = c2 / (2.0 * worst - c2)
        mu = self._mu
        middle = np.sqrt(c2 * mu * (mu + 1.0) / np.maximum(squared, 1e-12)) - mu
        self._mu = mu * GNC_FACTOR
        self._annealed = self._mu > 1e3
        return np.clip(middle, 0.0, 1.0)


def own_blocks(H: Array) -> Array:
    """(J, 6, 6) what each cloud of a (6 J, 6 J) information says, the others held."""
    each = np.arange(len(H) // 6)
    return np.asarray(H.reshape(len(each), 6, len(each), 6)[each, :, each, :])


def deletion_squares(W: Array, v: Array, own: Array) -> tuple[Array, IntArray]:
    """Squares of what each cloud is off from all others together, in its own sigmas.

    By as much the sum of squares falls if the cloud is left out: the test of an outlier by Baarda
    (1968), for six coordinates at once.

    Args:
        W: (6 J, 6 J) and
        v: (6 J,) of `graph.adjusted_residuals`.
        own: (J, 6, 6) what each cloud says, the others held.

    Returns:
        (J,) the squares, of a chi-squared distribution if only noise is in them; and (J,) its
        degrees of freedom: six, or fewer where the rest of the data does not control all of a
        cloud.
    """
    inverses, freedom = _deletion_covariances(W, own)
    parts = v.reshape(-1, 6)
    return np.einsum("ja,jab,jb->j", parts, inverses, parts), freedom


def _deletion_covariances(W: Array, own: Array) -> tuple[Array, IntArray]:
    """(J, 6, 6) inverses of W's blocks along what is controlled, else zero; (J,) its dimension.

    Rotations and translations have units of their own: a block is compared with what the cloud
    itself says.
    """
    values, axes = np.linalg.eigh(own)
    # What a cloud of a drum says of turns about it is eliminated to rounding.
    some = values > 1e-9 * values[:, -1:]
    white = axes * np.where(some, 1.0 / np.sqrt(np.where(some, values, 1.0)), 0.0)[:, None, :]
    part, along = np.linalg.eigh(np.einsum("jax,jab,jby->jxy", white, own_blocks(W), white))
    controlled = part > CONTROLLED
    roots = white @ along * np.where(controlled, part, np.inf)[:, None, :] ** -0.5
    return roots @ np.swapaxes(roots, 1, 2), controlled.sum(axis=1)


def _without(W: Array, v: Array, own: Array, cloud: int) -> tuple[Array, Array]:
    """W and v of `graph.adjusted_residuals` with the pose of one cloud left free."""
    mine = slice(6 * cloud, 6 * cloud + 6)
    inverse = _deletion_covariances(W[mine, mine], own[cloud : cloud + 1])[0][0]
    pull = W[:, mine] @ inverse
    return W - pull @ W[mine], v - pull @ v[mine]


def weighted_joint(H: Array, weights: Array) -> Array:
    """Joint information of clouds whose say is weighted.

    A cloud of weight w is one whose pose is known with an error more, of information
    `w / (1 - w)` times what the others let it say: it then says w times as much, at MIN_WEIGHT it
    is as good as free, and a common motion of all clouds, of which H says nothing, stays unsaid.
    Scaled by the roots of the weights, H would tie clouds of different weights to where the shape
    happens to lie.

    Args:
        H: (6 J, 6 J) of all clouds, the shape eliminated.
        weights: (J,) from 0, which counts as MIN_WEIGHT, to 1.
    """
    less = np.flatnonzero(weights < 1.0)
    if len(less) == 0:
        return H
    # At least, so that a cloud that nothing else ties down has an inverse.
    w = np.clip(weights[less], MIN_WEIGHT, 1.0 - 1e-12)
    rows = (6 * less[:, None] + np.arange(6)).ravel()
    more = block_diag(*(own_blocks(H)[less] * (w / (1.0 - w))[:, None, None]))
    ridge = (1e-12 * float(np.trace(H)) / len(H) + 1e-300) * np.eye(len(rows))
    out = H - H[:, rows] @ np.linalg.solve(H[np.ix_(rows, rows)] + more + ridge, H[rows])
    return np.asarray(0.5 * (out + out.T))
