"""Waves of the ground, as far as its planes scatter at a solution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.special import chdtrc

from caliv_graph.calibration.evidence import SEEN
from caliv_graph.calibration.ground import (
    GroundWeights,
    ground_centre,
    plane_factor_of,
    taken_poses,
)
from caliv_graph.calibration.problem import Problem
from caliv_graph.products import Array, GroundObservation

FEWEST_PLANES = 8
"""Planes, and tilts beyond those that are fitted, at least: a variance to a half."""

LARGEST_RATIO, CHANCE = 1.5, 1e-3
"""Mean square of tilts in their variance from which they do, unless by chance."""

ROUNDS = 40
"""Halvings of the interval in which the variance is looked for."""


def larger_normal_rad(
    problem: Problem,
    observations: Sequence[GroundObservation],
    weights: GroundWeights,
    values: gtsam.Values,
    normal_rad: float,
) -> float | None:
    """1 sigma of the tilt of ground planes by waves that a solution asks for; None: no larger one.

    Before it, few planes tell: of seven, known to 2 mrad with the tilt that all share, waves of 0.1
    mrad were as likely as of 0.4, and S2S roll was off by ten sigmas. Here all LiDARs agree on one
    ground. Planes that scatter more than their sigmas say, `normal_rad` included, do so by waves.
    `values` is the solution, `weights` are the robust ones of the observations there.
    """
    planes = _Planes.of(problem, observations, weights, values)
    tilts, variances = planes.tilts, planes.variances
    free = tilts.size - planes.fitted
    if len(tilts) < FEWEST_PLANES or free < FEWEST_PLANES:
        return None

    def squares(more: float) -> float:
        # Outliers count as three sigmas.
        return float(np.minimum(tilts**2 / (variances + more), 9.0).sum())

    ratio = squares(0.0) / free
    # Waves that scans share are as many as there are places; noise of the points is of each scan.
    apart = free / float(np.mean(1.0 + planes.repeated * normal_rad**2 / variances**2))
    if ratio < LARGEST_RATIO or chdtrc(apart, ratio * apart) > CHANCE:
        return None
    low, high = 0.0, float(np.max(tilts**2))
    for _ in range(ROUNDS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if squares(middle) > free else (low, middle)
    return float(np.sqrt(normal_rad**2 + high))


@dataclass(frozen=True)
class _Planes:
    """Planes in use at a solution.

    Attributes:
        tilts: (n, 2) to the ground, rad, without what biases of the ranges do to them.
        variances: (n, 2) of these.
        repeated: (n, 2) `GroundObservation.repeated`: that of waves, by the other scans of a place.
        fitted: number of tilts that the solution is fitted to.
    """

    tilts: Array
    variances: Array
    repeated: Array
    fitted: int

    @classmethod
    def of(
        cls,
        problem: Problem,
        observations: Sequence[GroundObservation],
        weights: GroundWeights,
        values: gtsam.Values,
    ) -> _Planes:
        """Of those among the observations whose pose the problem has."""
        taken = taken_poses(problem, observations)
        seen = [n for n in range(len(observations)) if taken[n] >= 0 and weights.planes[n] >= SEEN]
        out = np.zeros((3, len(seen), 2))
        for row, n in enumerate(seen):
            o = observations[n]
            centre = ground_centre(problem, o.drive)
            factor = plane_factor_of(problem, o, int(taken[n]), centre)
            tilt = factor.unwhitenedError(values)[:2]
            repeated = np.zeros(2) if o.repeated is None else o.repeated[:2]
            out[:, row] = tilt, np.diag(o.cov)[:2], repeated
        lidars = {observations[n].lidar for n in seen}
        drives = {observations[n].drive for n in seen}
        tilts, variances, repeated = out
        return cls(tilts, variances, repeated, 2 * (len(lidars) + len(drives)))
