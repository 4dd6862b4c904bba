"""Waves of the ground, as far as its planes scatter at a solution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
from scipy.stats import chi2

from caliv_graph.calibration.ground import GroundWeights, ground_centre, taken_poses
from caliv_graph.calibration.ground_factors import ground_plane_factor
from caliv_graph.calibration.problem import Problem
from caliv_graph.conventions import key_ground, key_ground_bias, key_vehicle
from caliv_graph.products import Array, GroundObservation

FEWEST_PLANES = 8
"""Planes whose tilts say that they scatter more than was estimated, at least."""

LARGEST_RATIO, CHANCE = 1.5, 1e-3
"""Mean square of tilts in their variance from which they do, unless by chance."""

FULL = 0.5
"""Weight of a plane from which it is one of them."""

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
    tilts, variances, fitted = _tilts(problem, observations, weights, values)
    if len(tilts) < FEWEST_PLANES:
        return None
    free = tilts.size - fitted

    def squares(more: float) -> float:
        # Outliers count as three sigmas.
        return float(np.minimum(tilts**2 / (variances + more), 9.0).sum())

    if squares(0.0) < LARGEST_RATIO * free or chi2.sf(squares(0.0), free) > CHANCE:
        return None
    low, high = 0.0, float(np.max(tilts**2))
    for _ in range(ROUNDS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if squares(middle) > free else (low, middle)
    return float(np.sqrt(normal_rad**2 + high))


def _tilts(
    problem: Problem,
    observations: Sequence[GroundObservation],
    weights: GroundWeights,
    values: gtsam.Values,
) -> tuple[Array, Array, int]:
    """Tilts (n, 2) of planes to the ground at a solution, rad, their variances, and what is fitted.

    Without what biases of the ranges do to them.
    """
    taken = taken_poses(problem, observations)
    lidars = set()
    rows = []
    for n, o in enumerate(observations):
        if taken[n] < 0 or weights.planes[n] < FULL:
            continue
        bias = key_ground_bias(problem.lidars.index(o.lidar))
        factor: Any = ground_plane_factor(
            (key_vehicle(int(taken[n])), *problem.extrinsic_keys_of(o.lidar)),
            key_ground(o.drive),
            ground_centre(problem, o.drive),
            replace(o, cov=np.eye(3)),
            key_bias=bias if values.exists(bias) else None,
        )
        lidars.add((o.drive, o.lidar))
        rows.append((np.array(factor.linearize(values).getb())[:2], np.diag(o.cov)[:2]))
    tilts, variances = (np.array([row[k] for row in rows]).reshape(-1, 2) for k in range(2))
    return tilts, variances, 2 * (len(lidars) + len({drive for drive, _ in lidars}))
