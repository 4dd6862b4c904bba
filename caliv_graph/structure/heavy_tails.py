"""Sizes of errors of strips, each of its own size about a common one."""

from __future__ import annotations

import math

import numpy as np

from caliv_graph.products import Array

FREEDOM = 4.0
"""Degrees of freedom of the distribution of errors of strips: heavy tails."""

LEAST_TOLD = 0.02
"""What counts beside the errors that tell a size: where none does, sigmas are ten times the usual
ones. The side of a car, in other patches of each of two LiDARs, had one tilted by 12 mrad."""


def heavy_tailed(
    known: Array, square: Array, before: Array, usual: float, limits: tuple[float, float]
) -> Array:
    """(K,) sigmas of errors of K strips, each of its own size about a common one.

    Args:
        known: (K,) how many errors of each the data know.
        square: (K,) sum of their squares.
        before: (K,) the sigmas before.
        usual: what counts as one more error of one more strip.
        limits: smallest and largest sigma.
    """
    least, most = np.square(limits).tolist()
    middle = float(np.median(before))
    own_weight = (FREEDOM + known) / (FREEDOM + square / middle**2)
    common = (usual**2 + float(own_weight @ square)) / (1.0 + float(known.sum()))
    common = float(np.clip(common, least, most))
    common *= told_by_few(float(known.sum()))
    out = (FREEDOM * common + square) / (FREEDOM + known)
    return np.asarray(np.sqrt(np.clip(out, least, most)))


def told_by_few(number: float) -> float:
    """By how much a variance grows that so many errors tell: that of a t distribution.

    It has as many degrees of freedom, and two.
    """
    return 1.0 + 2.0 / (LEAST_TOLD + number)


def sigma_of_few(sigma: float, number: float, usual: float) -> float:
    """A sigma that so many errors tell; the usual one counts as one more."""
    variance = (usual**2 + number * sigma**2) / (1.0 + number)
    return math.sqrt(variance * told_by_few(number))
