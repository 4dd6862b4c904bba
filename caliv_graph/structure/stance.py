"""How the vehicle stands on the ground that structure has found: for tests of what is assumed.

The height of the vehicle above the ground is in the solve as the config has it, its tilt only where
the config states one. Here both are measured, given the poses and extrinsics of a term
(`README.md`, section 8).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from caliv_graph.products import Array, Stance, StandingErrors
from caliv_graph.structure.elimination import marginal
from caliv_graph.structure.solve import Solved
from caliv_graph.structure.standing import Standing, above_ground_m, tilt_rows

STANDING = 3
"""Coordinates of the errors of height and tilt in a system."""


@dataclass(frozen=True)
class MeanTilt:
    """Mean tilt of the ground in the vehicle frame over a drive, `value + rows d`.

    Attributes:
        value: (2,) x and y of the ground's mean normal, at the estimate.
        rows: (2, D) by the coordinates of a system, its surfaces following.
        cov: (2, 2) of it, these coordinates being known.
    """

    value: Array
    rows: Array
    cov: Array


def mean_tilt(found: Solved) -> MeanTilt | None:
    """Of a solved drive; None: there is no ground below its poses."""
    stands = found.stands()
    if not len(stands.pose):
        return None
    state, layout = found.state, found.layout
    value, rows, sigma = tilt_rows(
        found.problem.standing,
        stands,
        state.R_map_vehicle,
        state.normals_map,
        layout.plane,
        layout.size,
    )
    on_rest, cov, _ = found.system.surfaces.reduced(scipy.sparse.csr_array(rows))
    return MeanTilt(value, on_rest, cov + sigma**2 * np.eye(2))


def strips_above_ground_m(found: Solved) -> float:
    """`standing.above_ground_m` of a solved drive."""
    state = found.state
    return above_ground_m(
        found.problem.standing,
        found.stands(),
        state.t_map_vehicle,
        state.centres_map,
        state.normals_map,
    )


def stance_of(
    standing: Standing, now_m: float, information: Array, gradient: Array, tilt: MeanTilt | None
) -> Stance | None:
    """Height and tilt, given the first n coordinates of a quadratic; None: there is no ground.

    Args:
        standing: what is assumed.
        now_m: error of the height at the estimate.
        information: (n + 3, n + 3), the errors of height and tilt last, their priors in it.
        gradient: (n + 3,).
        tilt: its rows are on these coordinates.
    """
    n = len(gradient) - STANDING
    if tilt is None:
        return None
    stated = standing.tilt_sigma_rad is not None
    prior = standing.height_sigma_m**-2.0
    own, cross, pull = _without_tilt(information, gradient, n)
    own, pull = own - prior, pull + prior * now_m
    known = standing.height_m is not None and own > 0.0
    if not known:
        if stated:
            return None
        return Stance(tilt.value, tilt.rows[:, :n], tilt.cov, None, tilt_in_term=False)
    # Of the error of the height alone, then the tilt that follows it.
    by_height = np.concatenate([[1.0], tilt.rows[:, n]])
    start = np.concatenate([[now_m], tilt.value])
    rows = np.vstack([np.zeros(n), tilt.rows[:, :n]]) - np.outer(by_height, cross / own)
    cov = np.outer(by_height, by_height) / own
    cov[1:, 1:] += tilt.cov
    keep = slice(0, 1) if stated else slice(0, 3)
    return Stance(
        value=(start + by_height * pull / own)[keep],
        rows=rows[keep],
        cov=cov[keep, keep],
        height_sigma_m=standing.height_sigma_m,
        tilt_in_term=stated,
    )


def standing_errors(
    standing: Standing, now: Array, information: Array, gradient: Array
) -> StandingErrors | None:
    """The errors of height and tilt that the config states; None: it states neither.

    Args:
        standing: what is assumed.
        now: (3,) the errors at the estimate.
        information: (n + 3, n + 3), the errors last, their priors in it.
        gradient: (n + 3,).
    """
    n = len(gradient) - STANDING
    height, tilt = standing.height_m is not None, standing.tilt_sigma_rad is not None
    stated = np.array([height, tilt, tilt])
    if not stated.any():
        return None
    own, rest = n + np.flatnonzero(stated), n + np.flatnonzero(~stated)
    kept = np.concatenate([np.arange(n), own])
    both, pull = information, gradient
    if len(rest):
        both, pull = marginal(information, gradient, kept, rest)
    sigmas = np.array([standing.height_sigma_m, *[standing.tilt_sigma_rad or np.inf] * 2])
    prior, value = sigmas[stated] ** -2.0, now[stated]
    return StandingErrors(
        height=height,
        tilt=tilt,
        value=value,
        coupling=both[:n, n:],
        information=both[n:, n:] - np.diag(prior),
        gradient=pull[n:] + prior * value,
        prior=prior,
    )


def _without_tilt(information: Array, gradient: Array, n: int) -> tuple[float, Array, float]:
    """Of the error of the height: information, its coupling (n,), gradient; the tilt eliminated."""
    tilts = slice(n + 1, n + STANDING)
    follow = np.linalg.solve(information[tilts, tilts], information[tilts, : n + 1])
    row = information[n, : n + 1] - information[n, tilts] @ follow
    step = np.linalg.solve(information[tilts, tilts], gradient[tilts])
    return float(row[n]), row[:n], float(gradient[n] - information[n, tilts] @ step)
