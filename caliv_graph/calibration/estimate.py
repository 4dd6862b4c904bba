"""The estimator: registration, graph solve, and what `solve.mode` asks for after them.

The paper's pipeline is its first half: register all clouds to the latent target, then solve the
graph with one pose factor per cloud, robustly (`solve`). `staged` stops there, in the paper's two
stages. `joint` and `auto` go on (`refine`): expectation-maximisation whose M-step is the graph
solve.

Gauge: the target frames stay where they are, for the shapes are free; the map is held by the given
poses, the extrinsics by the data or the guesses (SPEC 3, `auto`).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np
from threadpoolctl import threadpool_limits

from caliv_graph.calibration.graph import linearise_clouds
from caliv_graph.calibration.problem import Problem, pose_problem, usable
from caliv_graph.calibration.refine import per_placement, refined, refinements
from caliv_graph.calibration.solve import (
    OFFSET_DETERMINED_S,
    solve_registered,
    with_determined_offsets,
)
from caliv_graph.calibration.staged import staged_solution
from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config
from caliv_graph.geometry.se3 import unstack
from caliv_graph.products import GroundObservation, Registration, Solution, TargetObservation
from caliv_graph.registration.register import JointRegistration, register_jointly
from caliv_graph.registration.self_comparison import views_of
from caliv_graph.registration.symmetry import Symmetry, alarming, symmetries, symmetry_sentence
from caliv_graph.trajectory.deskew import deskew
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.uncertainty.predicted import undetermined_offsets


def estimate(
    observations: Sequence[TargetObservation],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    progress: Progress,
    grounds: Sequence[GroundObservation] = (),
) -> Solution:
    """Registers, solves and refines, as `solve.mode` says.

    Args:
        observations: clouds of each target placement.
        trajectories: one per drive.
        config: modes, kernels, priors.
        progress: told of every stage.
        grounds: the ground under the vehicle, as the LiDARs saw it. The paper's procedure,
            `staged`, does without.

    Raises:
        RegistrationError, SolveError: it could not be done.
    """
    used = usable(observations)
    problem = pose_problem(used, trajectories, config)
    if config.solve.mode == "staged":
        grounds = ()
    # The matrices are small: threads of a linear algebra library would mostly wait for each other,
    # for seconds where the machine has other work.
    with threadpool_limits(limits=1):
        return _estimate(problem, used, trajectories, tuple(grounds), config, progress)


def _estimate(
    problem: Problem,
    observations: Sequence[TargetObservation],
    trajectories: Sequence[VehicleTrajectory],
    grounds: tuple[GroundObservation, ...],
    config: Config,
    progress: Progress,
) -> Solution:
    """The stages of `estimate`, timed."""
    limit = config.registration.max_iterations
    begun = time.perf_counter()
    states = [
        JointRegistration(o, config, rough=True, view_weights=problem.view_weights(m))
        for m, o in enumerate(observations)
    ]
    registrations = []
    with progress.stage("registering the clouds", len(states)) as advance:
        for m, state in enumerate(states):
            registrations.append(register_jointly(state, prealigned(problem, m), limit))
            advance()
    times = {"registration": time.perf_counter() - begun}
    with progress.stage("solving the graph", None):
        solve = solve_registered(problem, registrations, grounds, config)
        times["graph"] = solve.graph_seconds
        problem, offsets_s = with_determined_offsets(solve, registrations)
        warnings = tuple(undetermined_offsets(offsets_s, OFFSET_DETERMINED_S))
        if warnings:
            solve = solve_registered(problem, registrations, grounds, config)
            times["graph"] += solve.graph_seconds

    # Once more, from where the graph puts the clouds: EM ends near where it starts, and the result
    # shall depend on the data, not on the initial guess. And aligned clouds show normals that
    # single ones do not.
    begun = time.perf_counter()
    lines = linearise_clouds(problem, solve.values)
    extrinsics = {name: problem.extrinsic(solve.values, name) for name in problem.lidars}
    observations = [_deskewed(o, extrinsics, trajectories) for o in observations]
    states = [
        JointRegistration(o, config, normals=False, view_weights=problem.view_weights(m))
        for m, o in enumerate(observations)
    ]
    again = []
    with progress.stage("registering again, from the solved graph", len(states)) as advance:
        for state, (R, t) in zip(states, per_placement(states, lines), strict=True):
            state.refine_normals(R, t)
            again.append(register_jointly(state, unstack(R, t), limit, coarse=False))
            advance()
    turns, alike = symmetries_of_targets(again, config)
    warnings += alike
    times["registration"] += time.perf_counter() - begun
    begun = time.perf_counter()
    solve = solve_registered(problem, again, grounds, config, turns)
    if config.solve.mode == "staged":
        with progress.stage("solving the graph in two stages", None):
            solution = staged_solution(solve, again)
    else:
        most = refinements(config.noise.lidar_range_m)
        with progress.stage("refining shape and graph together", most) as advance:
            solution = refined(solve, states, most, advance)
    times["refinement"] = time.perf_counter() - begun - solve.graph_seconds
    times["graph"] += solve.graph_seconds
    return replace(
        solution, stage_times_s=times, warnings=(*warnings, *_unconverged(solution.registrations))
    )


def _deskewed(
    observation: TargetObservation,
    extrinsics: Mapping[str, gtsam.Pose3],
    trajectories: Sequence[VehicleTrajectory],
) -> TargetObservation:
    """The clouds again, their sweeps put together with the extrinsics that have been found.

    A guess that is off by 3 degrees puts what the vehicle moves by during a sweep, 0.1 to 0.2 m,
    off by some millimetres, in all clouds alike.
    """
    clouds = []
    for cloud in observation.clouds:
        if cloud.swept is not None:
            scan = deskew(cloud.swept, extrinsics[cloud.lidar], trajectories[cloud.drive])
            cloud = replace(cloud, points_lidar=scan.points_lidar)
        clouds.append(cloud)
    return replace(observation, clouds=tuple(clouds))


def prealigned(problem: Problem, placement: int) -> list[gtsam.Pose3]:
    """T_map_vehicle T_vehicle_lidar of the clouds of a placement, at the guesses."""
    out = []
    for j in np.flatnonzero(problem.cloud_placement == placement):
        guess = problem.guesses[problem.lidars[problem.cloud_lidar[j]]]
        out.append(problem.T_map_vehicle[problem.cloud_pose[j]].compose(guess))
    return out


def symmetries_of_targets(
    registrations: Sequence[Registration], config: Config
) -> tuple[tuple[Symmetry | None, ...], tuple[str, ...]]:
    """Per placement the turn that its target looks the same after, any turn; and what to tell.

    How far a cloud of a drum is turned about it is not in the cloud: it comes from noise and from
    how the beams fell, and is forgotten wherever clouds speak.
    """
    turns: list[Symmetry | None] = []
    told = []
    sigma = max(max(lidar.sigma.rpy_rad()) for lidar in config.lidars.values())
    for registration in registrations:
        found = symmetries(registration.mixture, views_of(registration), config.noise.lidar_range_m)
        turns.append(next((s for s in found if s.continuous and s.upright), None))
        told += [
            symmetry_sentence(s, registration.observation.name, sigma)
            for s in found
            if alarming(s, sigma)
        ]
    return tuple(turns), tuple(told)


def _unconverged(registrations: Sequence[Registration]) -> list[str]:
    """A warning for each registration that stopped before its tolerance."""
    out = []
    for registration in registrations:
        if not registration.converged:
            turn, shift = registration.last_step
            out.append(
                f"{registration.observation.name}: shape and poses still moved by "
                f"{1e3 * turn:.2f} mrad and {1e3 * shift:.2f} mm in the last of "
                f"{registration.iterations} iterations: trust the result no further than its sigmas"
            )
    return out
