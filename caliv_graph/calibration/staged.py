"""The paper's two stages on the registered clouds: sensor to sensor, then rotation to vehicle."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from caliv_graph.calibration.pack import packed_solution
from caliv_graph.calibration.reduced import Reduced
from caliv_graph.calibration.snooping import snoop_clouds
from caliv_graph.calibration.solve import (
    COUPLED_STEPS,
    SolveState,
    measured_poses,
    reduced_registered,
    settle,
    step_of_all,
)
from caliv_graph.conventions import key_extrinsic
from caliv_graph.products import Array, Registration, Solution


def staged_solution(state: SolveState, registrations: Sequence[Registration]) -> Solution:
    """The paper's two stages on the registered clouds.

    Stage 1 estimates all S_a with E free under its prior. Stage 2 fixes S_a, holds the reference
    LiDAR's translation at its guess and solves its rotation. The error of the guess is *considered*
    (Schmidt 1966): free under its sigma while the rotation is solved for, and not reported; else 50
    mm of y become 10 mrad of roll on an arc. Both stages use the registration's joint information
    (`caliv_graph/calibration/README.md`, "Modes").

    Args:
        state: of `solve_registered`; weights and noise are measured anew.
        registrations: what it was given.

    Raises:
        SolveError: the graph is singular.
    """
    begun = time.perf_counter()
    problem = state.problem
    snoop_clouds(state, registrations)
    prior = problem.guess_information()
    reduced, last, converged = settle(state, registrations, step_of_all(state))
    first, information_data = state.values, reduced.D

    reduced, second, turned = settle(state, registrations, _second_stage(state))
    if not (converged and turned):
        moved = np.abs((second if converged else last).reshape(-1, 6))
        step = float(moved[:, :3].max()), float(moved[:, 3:].max())
        registrations = [
            replace(r, converged=False, last_step=step, iterations=COUPLED_STEPS)
            for r in registrations
        ]
    solved, guess = state.values.atPose3(key_extrinsic()), problem.guesses[problem.reference]
    state.values = gtsam.Values(state.values)
    state.values.update(key_extrinsic(), gtsam.Pose3(solved.rotation(), guess.translation()))
    cov = _staged_covariance(state, information_data, prior, first)
    offsets = reduced.time_offsets(problem, cov)
    reduced = reduced_registered(state, registrations)
    state.graph_seconds += time.perf_counter() - begun
    return packed_solution(
        state,
        registrations,
        reduced,
        measured_poses(registrations, state.turns)[1] / state.scale**2,
        information_data,
        cov,
        # A trusted translation is as good as estimated.
        held=() if problem.reference in problem.fixed else ("x", "y", "z"),
        iterations=1,
        converged=converged and turned,
        time_offsets=offsets,
    )


def _second_stage(state: SolveState) -> Callable[[Reduced], Array]:
    """For `settle`: the step of E with all S_a fixed and the error of the held translation free."""
    problem = state.problem
    guess = problem.guesses[problem.reference]
    certainty = problem.prior_sigmas[problem.reference][3:] ** -2.0

    def step(reduced: Reduced) -> Array:
        E = state.values.atPose3(key_extrinsic())
        R = E.rotation().matrix()
        Q = problem.to_vehicle_axes(state.values)[:, :6]
        A, b = Q.T @ reduced.D @ Q, Q.T @ reduced.c
        # The guess weighs on the translation alone: the paper's second stage minimises the data's
        # error over the rotation.
        A[3:, 3:] += R.T @ np.diag(certainty) @ R
        b[3:] -= R.T @ (certainty * (E.translation() - guess.translation()))
        return np.asarray(Q @ np.linalg.solve(A, b))

    return step


def _staged_covariance(
    state: SolveState, information_data: Array, prior: Array, first: gtsam.Values
) -> Array:
    """Covariance of the staged result, vehicle axes: S_a of stage 1, the translation of the guess.

    The rotation's error is that of the data and that of a translation that is off by its sigma.
    """
    problem = state.problem
    n = len(problem.lidars)
    Q = problem.to_vehicle_axes(first)
    D = Q.T @ information_data @ Q  # tangents of E (rotation, translation), S_a
    stage_one = np.linalg.inv(D + Q.T @ prior @ Q)
    R = first.atPose3(key_extrinsic()).rotation().matrix()
    sigma = problem.prior_sigmas[problem.reference][3:]
    held = R.T @ np.diag(sigma**2) @ R  # of the translation, in E's tangent
    considered = D[:6, :6].copy()
    considered[3:, 3:] += np.linalg.inv(held)
    solved = np.linalg.inv(considered)
    # The rotation's error follows that of S_a, which stage 2 takes for known, and that of the
    # translation: the solve estimated (d_t - guess error), so the error of the guess remains.
    pull = -solved @ D[:6, 6:]
    cov = np.zeros((6 * n, 6 * n))
    cov[6:, 6:] = stage_one[6:, 6:]
    cov[:3, :3] = solved[:3, :3] + pull[:3] @ stage_one[6:, 6:] @ pull[:3].T
    cov[:3, 6:] = pull[:3] @ stage_one[6:, 6:]
    cov[6:, :3] = cov[:3, 6:].T
    cov[3:6, 3:6] = held
    # Rotation error against the guess's own error d0: the solve weighs the guess by its sigma.
    cov[:3, 3:6] = solved[:3, 3:]
    cov[3:6, :3] = cov[:3, 3:6].T
    Q = problem.to_vehicle_axes(state.values)
    cov = Q @ cov @ Q.T
    return np.asarray(0.5 * (cov + cov.T))
