"""Data snooping: clouds that were registered to the wrong place, found by the joint information."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from caliv_graph.calibration.kernels import DOF
from caliv_graph.calibration.linear import adjusted_residuals, dense_system, linearise_clouds
from caliv_graph.calibration.problem import Problem
from caliv_graph.calibration.robust import MIN_WEIGHT, deletion_squares, own_blocks
from caliv_graph.calibration.solve import (
    SolveState,
    cloud_residuals,
    explained_parts,
    fit_noise,
    guessed_graph,
    joint_information,
    measured_poses,
    settle,
    step_of_all,
)
from caliv_graph.products import Array, BoolArray, Registration

AGREEING = 0.75
"""Part of the clouds, those that agree best, that the first noise estimate uses."""

MOST_LOST = 0.25
"""Part of a LiDAR's clouds that may be lost one by one. From a tenth on they are reported as a
contradiction (`uncertainty.consistency.OUTLIERS`)."""

MIN_SNOOPED_WEIGHT = 0.5
"""Weight below which a cloud is dropped where it is not clear which clouds are wrong: even
down-weighted, it would bias the solution by the joint information."""

SNOOPINGS = 6
"""Rounds of dropping clouds and estimating the noise without them, at most."""


def snoop_clouds(state: SolveState, registrations: Sequence[Registration]) -> None:
    """Weighs the clouds by their joint information, and estimates the noise without the lost ones.

    Single pose factors ignore the correlation between clouds, and miss some that were registered to
    the wrong place. These also widen the fitted noise and hide in it: clouds are judged by the
    noise of those that agree best. If a LiDAR would lose more than MOST_LOST of its clouds, its
    clock, its mount or the target is wrong rather than the clouds: noise and values stay, and
    weights below MIN_SNOOPED_WEIGHT become zero. Kernel `none` changes nothing.

    Args:
        state: of `solve_registered`, or of the joint loop; gets new weights and values, and where
            clouds are lost new noise levels, the scale not below what a jackknife has said.
        registrations: what it was given.

    Raises:
        SolveError: the graph is singular.
    """
    _snoop(state, registrations)
    state.scale = max(state.scale, state.least_scale)


def _snoop(state: SolveState, registrations: Sequence[Registration]) -> None:
    """`snoop_clouds`; the noise levels are those that the residuals of what is left show."""
    if not state.weights.kernel.drops or not state.sound.any():
        return
    problem, fitted = state.problem, (state.noise, state.scale)
    sound, weights, values = state.sound, state.weights.values, state.values
    measured, _ = measured_poses(registrations, state.turns)
    explained = explained_parts(registrations)
    whole = np.maximum(explained, MIN_WEIGHT)
    state.weights.values = whole
    squares, freedom = deletion_squares(*_adjusted(state, registrations, measured))
    # Fewer controlled directions give smaller squares.
    squares = (squares * DOF / np.maximum(freedom, 1))[sound]
    by = np.zeros(problem.clouds, dtype=bool)
    by[np.flatnonzero(sound)[squares <= np.quantile(squares, AGREEING)]] = True
    for _ in range(SNOOPINGS):
        state.sound = by
        if (by == sound).all():
            state.noise, state.scale = fitted
        else:
            fit_noise(state, registrations)
        # Clouds that are a metre off bend the values so much that all others seem to be off.
        state.weights.values = np.where(by, whole, MIN_WEIGHT)
        settle(state, registrations, step_of_all(state))
        state.weights.values = whole
        kept = state.weights.snoop(*_adjusted(state, registrations, measured), explained)
        if _too_many(problem, ~kept & (explained > 0.5)):
            state.noise, state.scale = fitted
            state.sound, state.values = sound, values
            state.weights.values = np.where(weights < MIN_SNOOPED_WEIGHT, MIN_WEIGHT, weights)
            return
        if (by == (sound & kept)).all():
            return
        by = sound & kept


def _too_many(problem: Problem, lost: BoolArray) -> bool:
    """Whether a LiDAR loses more than MOST_LOST of its clouds."""
    clouds = np.bincount(problem.cloud_lidar, minlength=len(problem.lidars))
    gone = np.bincount(problem.cloud_lidar, lost, minlength=len(problem.lidars))
    return bool((gone > MOST_LOST * clouds).any())


def _adjusted(
    state: SolveState, registrations: Sequence[Registration], measured: Sequence[gtsam.Pose3]
) -> tuple[Array, Array, Array]:
    """W and v of `adjusted_residuals`, and (J, 6, 6) information of each cloud, the others held."""
    problem = state.problem
    H = joint_information(state, registrations)
    lines = linearise_clouds(problem, state.values)
    system = dense_system(problem, guessed_graph(state), state.values)
    W, v = adjusted_residuals(system, lines, H, cloud_residuals(lines, measured))
    return W, v, own_blocks(H)
