"""Robust weights of the clouds, and data snooping on their joint information.

A robust kernel (`kernels`) weighs a cloud by its residual. Data snooping (Baarda 1968) finds the
clouds that were registered to the wrong place. Derivations: `caliv_graph/calibration/README.md`.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from caliv_graph.calibration.kernels import KERNELS
from caliv_graph.config.model import RobustConfig
from caliv_graph.products import Array, BoolArray, IntArray

MIN_WEIGHT = 1e-6
"""A dropped cloud keeps this weight, so that its information stays invertible."""

FAR_OFF = 54.0
"""Squared whitened residual beyond which a cloud is lost by any kernel but `none`: three sigma on
each of six axes, probability 1e-9. Such a cloud was registered to the wrong place (cut off by the
field of view, it slid along the shape). Even down-weighted by half, as by Huber's kernel, it would
bias the solution."""

MIN_REDUNDANCY = 1e-4
"""Minimum redundancy for a testable residual: along a direction in which the rest of the data
controls a smaller part of a cloud's information, its error cannot be found."""

EXPLAINED = (0.4, 0.8)
"""Inlier ratio of a cloud, relative to the median cloud, below which its weight is zero, and from
which on it is full."""


def explained_part(inlier_ratio: Array) -> Array:
    """Factors (J,) on the weights of clouds by how much of each is target at all.

    A cloud that lies where the target is not has no residual: all its points are outliers.
    `inlier_ratio` (J,) is the part of each cloud's points that the mixture explains.
    """
    typical = max(float(np.median(inlier_ratio)), 1e-6)
    none, full = EXPLAINED
    return np.clip((inlier_ratio / typical - none) / (full - none), 0.0, 1.0)


class RobustWeights:
    """Weights of the clouds under one kernel, round by round."""

    def __init__(self, config: RobustConfig, clouds: int) -> None:
        """Starts with full weights for `clouds` clouds."""
        self.kernel = KERNELS[config.kernel](config)
        self.values: Array = np.ones(clouds)

    def update(self, squared: Array, explained: Array | float = 1.0) -> float:
        """New weights from squared whitened residuals (J,); returns the largest change.

        `explained` (J,) are factors for what the residuals do not show (`explained_part`).
        """
        before = self.values
        if not self.kernel.drops:
            explained = 1.0
        self.values = np.maximum(self.kernel.weights(squared) * explained, MIN_WEIGHT)
        return float(np.abs(self.values - before).max())

    def snoop(self, W: Array, v: Array, own: Array, explained: Array | float = 1.0) -> BoolArray:
        """New weights by how far each cloud is off from all the others together (Baarda 1968).

        The worst cloud is dropped alone, and the others are judged without it, until none is far
        off, or half are gone: then the clouds are not what is wrong. Kernel `none` drops nothing.

        Args:
            W: (6 J, 6 J) and
            v: (6 J,) of `adjusted_residuals`, no cloud down-weighted by its residual.
            own: (J, 6, 6) information of each cloud, the others held.
            explained: (J,) factors for what the residuals do not show (`explained_part`).

        Returns:
            (J,) the clouds that are not lost. The kernel may have taken more out.
        """
        squared = np.zeros(len(own))
        kept = np.ones(len(own), dtype=bool)
        while True:
            squared[kept] = deletion_squares(W, v, own)[0][kept]
            worst = int(np.where(kept, squared, -1.0).argmax())
            lost = squared[worst] > FAR_OFF and self.kernel.drops
            if not lost or 2 * kept.sum() <= len(kept):
                self.update(squared, explained)
                # `trimmed` drops its percentage, which may be fewer.
                self.values[~kept] = MIN_WEIGHT
                return kept
            kept[worst] = False
            squared[worst] = np.inf
            W, v = _without(W, v, own, worst)


def own_blocks(H: Array) -> Array:
    """(J, 6, 6) information of each cloud in a (6 J, 6 J) joint one, the others held."""
    each = np.arange(len(H) // 6)
    return np.asarray(H.reshape(len(each), 6, len(each), 6)[each, :, each, :])


def deletion_squares(W: Array, v: Array, own: Array) -> tuple[Array, IntArray]:
    """How far each cloud is off from all others together, squared and in its own sigmas.

    The sum of squares falls by as much if the cloud is left out: Baarda's (1968) outlier test for
    six coordinates at once.

    Args:
        W: (6 J, 6 J) and
        v: (6 J,) of `adjusted_residuals`.
        own: (J, 6, 6) information of each cloud, the others held.

    Returns:
        (J,) the squares, chi-squared if there is only noise; and (J,) the degrees of freedom: six,
        or fewer where the rest of the data does not control all of a cloud.
    """
    inverses, freedom = _deletion_covariances(W, own)
    parts = v.reshape(-1, 6)
    return np.einsum("ja,jab,jb->j", parts, inverses, parts), freedom


def _deletion_covariances(W: Array, own: Array) -> tuple[Array, IntArray]:
    """(J, 6, 6) inverses of W's blocks along what is controlled, else zero; (J,) its dimension.

    A block is compared with the cloud's own information, for rad and m do not compare.
    """
    values, axes = np.linalg.eigh(own)
    # The rotation of a cloud about a drum is marginalised to rounding.
    some = values > 1e-9 * values[:, -1:]
    white = axes * np.where(some, 1.0 / np.sqrt(np.where(some, values, 1.0)), 0.0)[:, None, :]
    part, along = np.linalg.eigh(np.einsum("jax,jab,jby->jxy", white, own_blocks(W), white))
    controlled = part > MIN_REDUNDANCY
    roots = white @ along * np.where(controlled, part, np.inf)[:, None, :] ** -0.5
    return roots @ np.swapaxes(roots, 1, 2), controlled.sum(axis=1)


def _without(W: Array, v: Array, own: Array, cloud: int) -> tuple[Array, Array]:
    """W and v of `graph.adjusted_residuals` with the pose of one cloud left free."""
    mine = slice(6 * cloud, 6 * cloud + 6)
    inverse = _deletion_covariances(W[mine, mine], own[cloud : cloud + 1])[0][0]
    pull = W[:, mine] @ inverse
    return W - pull @ W[mine], v - pull @ v[mine]


def weighted_joint(H: Array, weights: Array) -> Array:
    """Joint information (6 J, 6 J) of weighted clouds, the shape eliminated; weights (J,) 0 to 1.

    A cloud of weight w gets one more pose error, of information `w / (1 - w)` times the cloud's
    own. A common motion of all clouds stays unobservable; H scaled by the roots of the weights
    would tie clouds of different weights to the present place of the shape.
    """
    less = np.flatnonzero(weights < 1.0)
    if len(less) == 0:
        return H
    # The clip gives a cloud that nothing else ties down an inverse.
    w = np.clip(weights[less], MIN_WEIGHT, 1.0 - 1e-12)
    rows = (6 * less[:, None] + np.arange(6)).ravel()
    more = block_diag(*(own_blocks(H)[less] * (w / (1.0 - w))[:, None, None]))
    ridge = (1e-12 * float(np.trace(H)) / len(H) + 1e-300) * np.eye(len(rows))
    out = H - H[:, rows] @ np.linalg.solve(H[np.ix_(rows, rows)] + more + ridge, H[rows])
    return np.asarray(0.5 * (out + out.T))
