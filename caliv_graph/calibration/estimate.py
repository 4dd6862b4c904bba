"""The estimator: registration, graph solve, and what `solve.mode` asks for after them.

The paper's pipeline is its first half: register all clouds to the latent target, then solve the
graph with one pose factor per cloud (`solve`). `staged` stops there; `joint` and `auto` refine
shape and graph together (`refine`). The gauge is in `caliv_graph/calibration/README.md`.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
from threadpoolctl import threadpool_limits

from caliv_graph.calibration.clock_prior import has_clock, under_clock_prior
from caliv_graph.calibration.drift import about_walls
from caliv_graph.calibration.given_noise import noise_by_structure, residuals_of_structure
from caliv_graph.calibration.ground_factors import held
from caliv_graph.calibration.ground_floors import with_floors
from caliv_graph.calibration.ground_scatter import (
    FURTHER_SOLVES,
    GroundLevels,
    asked_levels,
    failed_sentence,
    scattering_more,
    unsettled_sentence,
)
from caliv_graph.calibration.linear import linearise_clouds
from caliv_graph.calibration.no_target import (
    solution_without_target,
    solve_structure_and_ground,
)
from caliv_graph.calibration.noise import PoseResiduals, all_stated
from caliv_graph.calibration.problem import Problem, pose_problem, usable
from caliv_graph.calibration.rates import with_rates_of
from caliv_graph.calibration.refine import (
    OTHER_STARTS,
    further_refinements,
    per_placement,
    refined,
    refinements,
    registered_with_motion,
)
from caliv_graph.calibration.rough import rough_solve, symmetries_of_targets
from caliv_graph.calibration.sensor_noise import (
    SensorNoise,
    estimated_noise,
    noise_of_motion,
    with_noise,
)
from caliv_graph.calibration.solve import (
    SolveState,
    fit_noise,
    reduced_registered,
    settle,
    solve_registered,
    step_of_all,
)
from caliv_graph.calibration.staged import staged_solution
from caliv_graph.calibration.structure import far_from, lidars_with_structure
from caliv_graph.calibration.structure_evidence import (
    NO_STRUCTURE,
    NOTHING_TOLD,
    StructureEvidence,
    ToldErrors,
    kept_stamps,
    other_grounds,
    rough_extrinsics,
    solved_with_structure,
)
from caliv_graph.common.memory import keeping_larger_arrays
from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config
from caliv_graph.errors import RegistrationError, SolveError
from caliv_graph.geometry.se3 import unstack
from caliv_graph.products import (
    GroundObservation,
    IntArray,
    Registration,
    Solution,
    StructureTerm,
    TargetObservation,
)
from caliv_graph.registration.register import JointRegistration, register_jointly
from caliv_graph.targets.ground.planes import ground_floors
from caliv_graph.trajectory.deskew import deskewed_with_origins
from caliv_graph.trajectory.select import VehicleTrajectory


def estimate(
    observations: Sequence[TargetObservation],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    progress: Progress,
    grounds: Sequence[GroundObservation] = (),
    structure: StructureEvidence = NO_STRUCTURE,
) -> Solution:
    """Registers, solves and refines, by `solve.mode`.

    Args:
        observations: clouds of each target placement.
        trajectories: one per drive.
        config: modes, kernels, priors.
        progress: reports every stage.
        grounds: the ground as the LiDARs saw it.
        structure: what else they saw. The paper's procedure, `staged`, does without both.

    Raises:
        TargetError: there is neither a target nor structure.
        RegistrationError, SolveError: it could not be done.
    """
    return estimate_with_noise(observations, trajectories, config, progress, grounds, structure)[0]


def estimate_with_noise(
    observations: Sequence[TargetObservation],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    progress: Progress,
    grounds: Sequence[GroundObservation] = (),
    structure: StructureEvidence = NO_STRUCTURE,
) -> tuple[Solution, tuple[VehicleTrajectory, ...]]:
    """`estimate`, and the trajectories with the noise of the sensors that it was solved with."""
    used = usable(observations)
    if not used and structure.patches:
        with threadpool_limits(limits=1):
            with progress.stage("estimating the noise of the sensors", None):
                guesses = {name: lidar.guess() for name, lidar in config.lidars.items()}
                drives = trajectories, grounds, structure
                trajectories, grounds, walls = _about_walls(drives, guesses, {}, config)
                start = walls.T_vehicle_lidar or guesses
                told = structure.slow_errors(trajectories, start, {}, config)
                noise = noise_of_motion(trajectories, config.noise, told.of_drives)
                start = told.T_vehicle_lidar or start
                poses, stamps_ns = structure.pose_errors(trajectories, start, config)
                pose_noise = noise_by_structure(poses, stamps_ns, trajectories, config)
                start = poses.T_vehicle_lidar or start
                told = next((of for of in (told, poses) if of.T_vehicle_lidar), walls)
                trajectories, grounds = _with_noise(noise, trajectories, grounds, start, config)
            solved = solve_structure_and_ground(
                trajectories, config, progress, grounds, structure, noise, told, pose_noise
            )
            return solution_without_target(solved), trajectories
    if config.solve.mode == "staged":
        grounds, structure = (), NO_STRUCTURE
    # The matrices are small: threads of a linear algebra library would mostly wait for each other,
    # for seconds where the machine has other work.
    with threadpool_limits(limits=1):
        return _estimate(used, trajectories, (tuple(grounds), structure), config, progress)


def _estimate(
    observations: Sequence[TargetObservation],
    trajectories: Sequence[VehicleTrajectory],
    surroundings: tuple[tuple[GroundObservation, ...], StructureEvidence],
    config: Config,
    progress: Progress,
) -> tuple[Solution, tuple[VehicleTrajectory, ...]]:
    """The stages of `estimate_with_noise`, timed."""
    grounds, structure = surroundings
    limit = config.registration.max_iterations
    kept = kept_stamps(structure.patches, observations)
    problem = pose_problem(observations, trajectories, config, kept_ns=kept)
    guesses = {name: problem.guesses[name] for name in problem.lidars}
    guessed = _held_grounds(grounds, guesses, problem)
    with keeping_larger_arrays():
        rough = rough_solve(problem, observations, guessed, config, progress, limit)
    with progress.stage("estimating the noise of the sensors", None):
        extrinsics = problem.extrinsics(rough.state.values)
        before, placed = trajectories, rough_extrinsics(rough.state)
        drives = trajectories, grounds, structure
        trajectories, grounds, walls = _about_walls(drives, placed, extrinsics, config)
        start = walls.T_vehicle_lidar or placed
        slow = structure.slow_errors(trajectories, start, extrinsics, config)
        poses, stamps_ns = NOTHING_TOLD, dict[int, IntArray]()
        if not all_stated(config.noise):
            poses, stamps_ns = structure.pose_errors(trajectories, start, config)
        of_poses = residuals_of_structure(poses, stamps_ns, trajectories, config)
        if of_poses is not None:
            rough.state.of_poses = of_poses
            fit_noise(rough.state, rough.registrations)
        told = next((of for of in (slow, poses) if of.T_vehicle_lidar), walls)
        noise = estimated_noise(rough.state, rough.registrations, before, slow.of_drives)
        trajectories, grounds = _with_noise(noise, trajectories, grounds, start, config)
        problem = pose_problem(observations, trajectories, config, noise, kept_ns=kept)
    times = {"registration": rough.registration_s, "graph": rough.graph_s}
    whole = _Whole(problem, trajectories, grounds, structure, noise, of_poses, kept, config)
    solved = _solved(whole, observations, rough.state, told, times, progress)
    left: tuple[str, ...] = ()
    for _ in range(FURTHER_SOLVES):
        larger = _for_another_solve(whole, observations, solved.state)
        if larger is None:
            break
        try:
            solved = _solved(larger, observations, solved.state, NOTHING_TOLD, times, progress)
        except (RegistrationError, SolveError) as error:
            left = (failed_sentence(error.what),)
            break
        whole = larger
    else:
        left = _unsettled(whole, _for_another_solve(whole, observations, solved.state))
    left = (*left, *GroundLevels.of(whole.problem).beyond_ground)
    if solved.offsets_s is not None:
        rough = replace(rough, offsets_s=solved.offsets_s)
    said = (line for term in solved.state.structure for line in term.warnings)
    solution = solved.solution
    # A loop that creeps is a contradiction, with a sentence of its own.
    unconverged = [] if solution.creeps else _unconverged(solution.registrations)
    warnings = (*rough.warnings, *solved.alike, *said, *unconverged, *left)
    levels = whole.noise.levels
    solution = replace(solution, stage_times_s=times, warnings=warnings, sensor_noise=levels)
    return solution, tuple(trajectories)


@dataclass(frozen=True)
class _Whole:
    """What all stages after the noise of the sensors are given."""

    problem: Problem
    trajectories: Sequence[VehicleTrajectory]
    grounds: Sequence[GroundObservation]
    structure: StructureEvidence
    noise: SensorNoise
    of_poses: PoseResiduals | None
    kept: Mapping[int, Sequence[int]]
    config: Config


def _for_another_solve(
    whole: _Whole, observations: Sequence[TargetObservation], at: SolveState
) -> _Whole | None:
    """What a solve that begins at a solved graph is given; None: nothing asks for one.

    What the target alone told may have been far off: structure is linearised where all leads. And
    ground planes and stands that scatter more at the result than was estimated have larger sigmas.
    """
    grounds, noise, config = whole.grounds, whole.noise, whole.config
    asked = asked_levels(at)
    if asked != GroundLevels.of(at.problem):
        noise = noise.with_ground_levels(asked)
        floors = whole.noise.floors, noise.floors
        grounds = with_floors(grounds, whole.trajectories, rough_extrinsics(at), *floors)
    elif not far_from(at.structure, at.problem.extrinsics(at.values)):
        return None
    # With the LiDARs of the solved graph: its keys are numbered by them.
    others = lidars_with_structure(at.structure)
    problem = pose_problem(observations, whole.trajectories, config, noise, others, whole.kept)
    return replace(whole, problem=problem, grounds=grounds, noise=noise)


def _unsettled(before: _Whole, after: _Whole | None) -> tuple[str, ...]:
    """A warning: a result asks for one more solve, `after`; none if that is None."""
    if after is None:
        return ()
    was, asked = GroundLevels.of(before.problem), GroundLevels.of(after.problem)
    why = "a LiDAR is still far from where the walls were linearised"
    if asked != was:
        why = scattering_more(was, asked)
    return (unsettled_sentence(why),)


@dataclass(frozen=True)
class _Solved:
    """Their outcome.

    Attributes:
        solution: the calibration.
        state: the solved graph, terms of structure in it.
        offsets_s: LiDAR -> 1 sigma in seconds of each time offset; None: structure was not asked.
        alike: a warning for each symmetric target.
    """

    solution: Solution
    state: SolveState
    offsets_s: dict[str, float] | None
    alike: tuple[str, ...]


def _solved(
    whole: _Whole,
    observations: Sequence[TargetObservation],
    begun_at: SolveState,
    told: ToldErrors,
    times: dict[str, float],
    progress: Progress,
) -> _Solved:
    """Registers again from a solved graph, solves structure near it, and refines.

    `told` is what structure said of slow errors, and from where; `times` are added to.
    """
    problem, trajectories, config = whole.problem, whole.trajectories, whole.config
    structure, noise = whole.structure, whole.noise
    limit = config.registration.max_iterations
    extrinsics = problem.extrinsics(begun_at.values)
    # Register again, from the solved graph: EM ends near where it starts, and the result shall
    # depend on the data, not on the initial guess. Aligned clouds also give better normals.
    begun = time.perf_counter()
    # All clouds from here on: those that the field of view cuts off have predicted poses now.
    moved_with = begun_at.problem.moved_with
    lines = linearise_clouds(replace(problem, moved_with=moved_with), begun_at.values)
    problem = replace(problem, moved_with=extrinsics)
    grounds = _held_grounds(whole.grounds, extrinsics, problem)
    states = [
        JointRegistration(
            _deskewed(o, extrinsics, trajectories),
            config,
            normals=False,
            views=problem.views_of(m),
        )
        for m, o in enumerate(observations)
    ]
    registrations = []
    with (
        progress.stage("registering again, from the solved graph", len(states)) as advance,
        keeping_larger_arrays(),
    ):
        for state, (R, t) in zip(states, per_placement(problem, lines), strict=True):
            state.refine_normals(R, t)
            registrations.append(register_jointly(state, unstack(R, t), limit, coarse=False))
            advance()
    found, alike = symmetries_of_targets(registrations, config)
    times["registration"] += time.perf_counter() - begun

    begun = time.perf_counter()
    terms: tuple[StructureTerm, ...] = ()
    if structure.patches:
        with progress.stage("solving walls and other surfaces", None):
            terms = structure.terms_beside(begun_at, problem, trajectories, noise.heave_m, told)
        times["structure"] = times.get("structure", 0.0) + time.perf_counter() - begun

    begun = time.perf_counter()
    offsets_s = None
    if terms:
        others = lidars_with_structure(terms)
        grounds = other_grounds(grounds, terms)
        problem = pose_problem(observations, trajectories, config, noise, others, whole.kept)
        problem = replace(problem, moved_with=extrinsics)
        solve, offsets_s = solved_with_structure(
            problem, registrations, grounds, config, found, terms, extrinsics, whole.of_poses
        )
    else:
        solve = solve_registered(
            problem, registrations, grounds, config, found, of_poses=whole.of_poses
        )
    if has_clock(problem):
        reduced = reduced_registered(solve, registrations)
        solve = under_clock_prior(solve, reduced, None)
        settle(solve, registrations, step_of_all(solve))
    most = refinements(config.noise.lidar_range_m)
    total = most + OTHER_STARTS * further_refinements(config.noise.lidar_range_m)
    with (
        progress.stage("refining shape and graph together", total) as advance,
        keeping_larger_arrays(),
    ):
        if config.solve.mode == "staged":
            registrations, course = registered_with_motion(solve, states, most, advance)
        else:
            solution = refined(solve, states, most, advance)
    if config.solve.mode == "staged":
        with progress.stage("solving the graph in two stages", None):
            solution = replace(staged_solution(solve, registrations), course=course)
    solution = replace(solution, creeps=solve.creeps)
    spent = time.perf_counter() - begun - solve.graph_seconds
    times["refinement"] = times.get("refinement", 0.0) + spent
    times["graph"] += solve.graph_seconds
    return _Solved(solution, solve, offsets_s, tuple(alike))


def _about_walls(
    drives: tuple[Sequence[VehicleTrajectory], Sequence[GroundObservation], StructureEvidence],
    start: Mapping[str, gtsam.Pose3],
    held: Mapping[str, gtsam.Pose3],
    config: Config,
) -> tuple[tuple[VehicleTrajectory, ...], tuple[GroundObservation, ...], ToldErrors]:
    """`about_walls` of trajectories, and the ground by their rates; where the strips lie."""
    trajectories, grounds, structure = drives
    after, walls = about_walls(trajectories, structure, start, held, config)
    return after, with_rates_of(grounds, trajectories, after), walls


def _with_noise(
    noise: SensorNoise,
    trajectories: Sequence[VehicleTrajectory],
    grounds: Sequence[GroundObservation],
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
    config: Config,
) -> tuple[tuple[VehicleTrajectory, ...], tuple[GroundObservation, ...]]:
    """Trajectories with estimated noise, and the ground: its waves, and the rates of the former."""
    after = tuple(with_noise(noise, trajectories))
    usual = ground_floors(config.noise)
    changed = with_floors(grounds, after, T_vehicle_lidar, usual, noise.floors)
    return after, with_rates_of(changed, trajectories, after)


def _held_grounds(
    grounds: Sequence[GroundObservation],
    extrinsics: Mapping[str, gtsam.Pose3],
    problem: Problem,
) -> tuple[GroundObservation, ...]:
    """The ground, its motion compensated with the extrinsics of the clouds.

    It stays so where the rates of a drive are taken as exact. Left free, it would say roll and
    pitch of the LiDARs to milliradians: what turns a LiDAR on the vehicle changes its clouds as
    rates do that are off.
    """
    return tuple(
        held(o, extrinsics[o.lidar].rotation().matrix())
        if o.lidar in extrinsics and o.drive not in problem.rate_rows
        else o
        for o in grounds
    )


def _deskewed(
    observation: TargetObservation,
    extrinsics: Mapping[str, gtsam.Pose3],
    trajectories: Sequence[VehicleTrajectory],
) -> TargetObservation:
    """The clouds again, their sweeps put together with the extrinsics that have been found.

    A guess that is 3 degrees off moves all clouds alike by some millimetres.
    """
    clouds = []
    for cloud in observation.clouds:
        if cloud.swept is not None:
            points, origins = deskewed_with_origins(
                cloud.swept, extrinsics[cloud.lidar], trajectories[cloud.drive]
            )
            cloud = replace(cloud, points_lidar=points, origins_lidar=origins)
        clouds.append(cloud)
    return replace(observation, clouds=tuple(clouds))


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
