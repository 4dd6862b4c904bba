"""Scale of the registration's sigmas by a jackknife over views.

The joint information of the clouds holds responsibilities and surfels' widths, and takes the errors
of different clouds for independent. What that makes of the sigmas the clouds themselves tell: parts
of them are left out in turn, shape and extrinsics estimated again, and the scatter of the estimates
compared with what the information claims (Tukey 1958; `caliv_graph/calibration/README.md`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy

import gtsam
import numpy as np

from caliv_graph.calibration.linear import CloudLinearisation
from caliv_graph.calibration.problem import Problem
from caliv_graph.geometry.se3 import retract_vehicle_axes, right_to_vehicle_axes, stack
from caliv_graph.products import Array, IntArray
from caliv_graph.registration.register import JointRegistration

GROUPS = 4
"""Parts of the clouds that are left out in turn: three degrees of freedom for each of twelve
coordinates of two LiDARs give the scale to a tenth."""

TOGETHER = 2
"""Clouds of a LiDAR in a row that are left out together: neighbours have beams on nearly the same
spots."""

ROUNDS = 5
"""Rounds of expectation-maximisation without a part: what is missing of the way to its end is a
tenth on sparse clouds."""

LEFT_OUT = 1e-9
"""Weight of the clouds that are left out."""

LEAST_LIDAR_CLOUDS = 3 * GROUPS * TOGETHER
"""Clouds of every LiDAR for a jackknife: with fewer the parts are too large."""


def jackknife_scale(
    problem: Problem,
    extrinsics: Sequence[gtsam.Pose3],
    states: Sequence[JointRegistration],
    lines: CloudLinearisation,
) -> float:
    """Factor on the registration's sigmas, at least 1, by leaving out parts of the clouds.

    The poses of the vehicle stay: their noise is not the registration's. 1 if there are few clouds,
    or few different views: scans of one view share their errors, and leaving out some of them does
    not show these.

    Args:
        problem: LiDARs and clouds.
        extrinsics: T_vehicle_lidar of its LiDARs, the solution.
        states: the registration of each placement at the solution; they stay as they are.
        lines: predicted poses of the clouds there.
    """
    distinct = np.array(
        [
            np.sum(1.0 / _views(problem)[problem.cloud_lidar == a])
            for a in range(len(problem.lidars))
        ]
    )
    if (distinct[distinct > 0.0] < LEAST_LIDAR_CLOUDS).any():
        return 1.0
    # T_target_vehicle of every cloud.
    before = [
        Z.compose(extrinsics[a].inverse())
        for Z, a in zip(lines.predicted, problem.cloud_lidar.tolist(), strict=True)
    ]
    group = _groups(problem)
    ends = [_without(problem, extrinsics, before, states, group == g) for g in range(GROUPS)]
    ends_mean = np.mean(ends, axis=0)
    scatter = np.array(ends) - ends_mean
    H, _ = _system(problem, extrinsics, before, [copy(state) for state in states])
    known = np.linalg.solve(H + problem.guess_information(), H)
    claimed = float(np.trace(known @ known))
    found = (GROUPS - 1) / GROUPS * float(np.einsum("ga,ab,gb->", scatter, H, scatter))
    return max(math.sqrt(found / max(claimed, 1e-12)), 1.0) if claimed > 1.0 else 1.0


def _views(problem: Problem) -> Array:
    return np.ones(problem.clouds) if problem.views is None else problem.views


def _groups(problem: Problem) -> IntArray:
    """(J,) part that each cloud belongs to: runs of `TOGETHER` clouds of a LiDAR, in turn."""
    out = np.zeros(problem.clouds, dtype=np.int64)
    for m in range(problem.placements):
        for a in range(len(problem.lidars)):
            own = np.flatnonzero((problem.cloud_lidar == a) & (problem.cloud_placement == m))
            own = own[np.argsort(problem.cloud_pose[own], kind="stable")]
            out[own] = np.arange(len(own)) // TOGETHER % GROUPS
    return out


def _without(
    problem: Problem,
    extrinsics: Sequence[gtsam.Pose3],
    before: Sequence[gtsam.Pose3],
    states: Sequence[JointRegistration],
    left_out: Array,
) -> Array:
    """(6 n,) where the extrinsics go without some of the clouds (J,), vehicle axes."""
    trial = [copy(state) for state in states]
    start = 0
    for state in trial:
        own = left_out[start : start + state.clouds.count]
        start += state.clouds.count
        state.weights = np.where(own, LEFT_OUT, state.weights)
    moved, total = list(extrinsics), np.zeros(6 * len(extrinsics))
    prior = problem.guess_information()
    for _ in range(ROUNDS):
        H, gradient = _system(problem, moved, before, trial)
        step = -np.asarray(np.linalg.solve(H + prior, gradient), np.float64)
        moved = [
            retract_vehicle_axes(T, d) for T, d in zip(moved, step.reshape(-1, 6), strict=True)
        ]
        total += step
        for state, (R, t, _) in zip(trial, _poses(problem, moved, before, trial), strict=True):
            state.maximise(R, t)
    return np.asarray(total)


def _system(
    problem: Problem,
    extrinsics: Sequence[gtsam.Pose3],
    before: Sequence[gtsam.Pose3],
    states: Sequence[JointRegistration],
) -> tuple[Array, Array]:
    """E-step: (6 n, 6 n) information and (6 n,) gradient over the extrinsics, vehicle axes."""
    H = np.zeros((6 * len(extrinsics), 6 * len(extrinsics)))
    gradient = np.zeros(len(H))
    for state, (R, t, J) in zip(states, _poses(problem, extrinsics, before, states), strict=True):
        quadratic = state.expect(R, t)
        H += quadratic.along(J)
        gradient += np.einsum("jab,ja->b", J, quadratic.gradient)
    return H, gradient


def _poses(
    problem: Problem,
    extrinsics: Sequence[gtsam.Pose3],
    before: Sequence[gtsam.Pose3],
    states: Sequence[JointRegistration],
) -> list[tuple[Array, Array, Array]]:
    """Per placement the poses of its clouds (J, 3, 3), (J, 3), and (J, 6, 6 n) their derivatives.

    Left perturbations by those of the extrinsics in vehicle axes.
    """
    axes = [right_to_vehicle_axes(T).T for T in extrinsics]
    out, start = [], 0
    for state in states:
        count = state.clouds.count
        J = np.zeros((count, 6, 6 * len(extrinsics)))
        predicted = []
        for j in range(count):
            a = int(problem.cloud_lidar[start + j])
            Z = before[start + j].compose(extrinsics[a])
            predicted.append(Z)
            J[j, :, 6 * a : 6 * a + 6] = Z.AdjointMap() @ axes[a]
        start += count
        out.append((*stack(predicted), J))
    return out
