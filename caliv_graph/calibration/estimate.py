"""The estimator: registration, graph solve, and the loop around both.

`estimate` is the one place that goes round. The paper's pipeline is its first half: register all
clouds to the latent target, then solve the graph with one pose factor per cloud, robustly. `staged`
stops there, in the paper's two stages. `joint` and `auto` go on: expectation-maximisation whose
M-step is the graph solve, the clouds' quadratic (places and orientations of the components
eliminated, all clouds coupled) in the place of the pose factors.

Gauge: the target frames stay where they are, for the shapes are free; the map is held by the given
poses, the extrinsics by the data or the guesses (SPEC 3, `auto`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np
from scipy.linalg import block_diag
from threadpoolctl import threadpool_limits

from caliv_graph.calibration.graph import (
    CloudLinearisation,
    DenseSystem,
    add_shape,
    cloud_graph,
    dense_system,
    initial_values,
    linearise_clouds,
    merged,
    motion_graph,
    offset_graph,
    optimise,
    pose_graph,
    prior_graph,
    retract,
    with_given_poses,
)
from caliv_graph.calibration.ground import (
    GroundWeights,
    ground_graph,
    ground_values,
    ground_weights,
)
from caliv_graph.calibration.noise import (
    TYPICAL_SCALE,
    first_pose_noise,
    fit_pose_noise,
    sound_clouds,
    squares_without_own_pose,
)
from caliv_graph.calibration.problem import Problem, moved_map, pose_problem, usable
from caliv_graph.calibration.robust import MIN_WEIGHT, RobustWeights, explained_part, weighted_joint
from caliv_graph.config import Config, RobustConfig
from caliv_graph.conventions import key_mounting, key_offset, key_target, key_vehicle
from caliv_graph.errors import SolveError
from caliv_graph.geometry.se3 import stack, unstack, vehicle_axes_difference
from caliv_graph.products import (
    Array,
    GroundObservation,
    Iteration,
    PoseNoise,
    Registration,
    Solution,
    TargetObservation,
)
from caliv_graph.progress import Progress
from caliv_graph.registration.mixture import ShapeQuadratic
from caliv_graph.registration.register import (
    FINE_SIGMA_M,
    JointRegistration,
    annealing_steps,
    left_step,
    register_jointly,
)
from caliv_graph.registration.symmetry import (
    Symmetry,
    alarming,
    forget_turns,
    refit,
    symmetries,
    symmetry_sentence,
    views_of,
)
from caliv_graph.trajectory.deskew import deskew
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.uncertainty.observability import (
    respectful_covariance,
    respectful_step,
    spectrum,
)
from caliv_graph.uncertainty.outlook import untold_offsets

REWEIGHTINGS = 12
"""Rounds of reweighting at most; graduated non-convexity needs more and may take twice this."""

WEIGHT_TOLERANCE = 0.02
"""Largest change of a weight at which reweighting stops."""

SHAPES_BEGUN_AGAIN = 8
"""Iteration of the joint loop after which normals and mixture begin anew, now that annealing has
come to its end, or near it."""

REFINEMENTS = 20
"""Iterations of the joint loop at most; more where the noise is so small that annealing to it takes
more."""

LAST_REFINEMENTS = 4
"""Iterations that are left at the noise level, at least."""

DECIDED_AFTER = 9
"""Iterations after which the number of undetermined directions is no longer changed, so that one
at the threshold does not make the estimate jump for ever."""

STEP_TOLERANCE = (5e-5, 3e-4)
STEP_SIGMAS = 0.1
"""Largest step of the extrinsics, rad and m, at which the joint loop has converged: a fraction of
what 100 clouds of a chair can tell. Or else in joint standard deviations of the extrinsics."""

OFFSET_TOLD_S = 0.005
"""A time offset with a larger sigma, a centimetre at 2 m/s, is not told by the drive."""

COUPLED_STEPS = 20
"""Gauss-Newton steps with the joint information at most: the problem is nearly linear there, and
three or four are usual."""

FAR_OFF = 0.5
"""Robust weight below which the joint information takes a cloud for lost. Huber's is that at 7
sigma, where no noise comes to: such a cloud was registered to the wrong place (cut off by the field
of view, it slid along the shape). Judged are clouds by what the graph of single pose factors leaves
of them; what they share with others has a longer lever, and half a say would still bend all."""

COUPLED_SIGMAS = 0.01
"""Step in joint standard deviations of the extrinsics at which they have converged."""


@dataclass
class SolveState:
    """What the solve carries along."""

    problem: Problem
    config: Config
    values: gtsam.Values
    noise: PoseNoise
    scale: float
    weights: RobustWeights
    motion: gtsam.NonlinearFactorGraph
    grounds: tuple[GroundObservation, ...] = ()
    turns: tuple[Symmetry | None, ...] = ()
    ground_weights: GroundWeights | None = None
    graph_seconds: float = 0.0


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
        JointRegistration(o, config, rough=True, shares=problem.cloud_shares(m))
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
        warnings = tuple(untold_offsets(offsets_s, OFFSET_TOLD_S))
        if warnings:
            solve = solve_registered(problem, registrations, grounds, config)
            times["graph"] += solve.graph_seconds

    # Once more, from where the graph puts the clouds: EM ends near where it starts, and the result
    # shall depend on the data, not on the initial guess. And aligned clouds show normals that
    # single ones do not.
    begun = time.perf_counter()
    lines = linearise_clouds(problem, solve.values)
    mountings = {name: problem.mounting(solve.values, name) for name in problem.lidars}
    observations = [_deskewed(o, mountings, trajectories) for o in observations]
    states = [
        JointRegistration(o, config, normals=False, shares=problem.cloud_shares(m))
        for m, o in enumerate(observations)
    ]
    again = []
    with progress.stage("registering again, from the solved graph", len(states)) as advance:
        for state, (R, t) in zip(states, _per_placement(states, lines), strict=True):
            state.refine_normals(R, t)
            again.append(register_jointly(state, unstack(R, t), limit, coarse=False))
            advance()
    turns, alike = turns_of_targets(again, config)
    warnings += alike
    times["registration"] += time.perf_counter() - begun
    begun = time.perf_counter()
    solve = solve_registered(problem, again, grounds, config, turns)
    if config.solve.mode == "staged":
        with progress.stage("solving the graph in two stages", None):
            solution = _staged(solve, again)
    else:
        most = _refinements(config.noise.lidar_range_m)
        with progress.stage("refining shape and graph together", most) as advance:
            solution = _refine(solve, states, most, advance)
    times["refinement"] = time.perf_counter() - begun - solve.graph_seconds
    times["graph"] += solve.graph_seconds
    return replace(solution, stage_times_s=times, warnings=warnings)


def _deskewed(
    observation: TargetObservation,
    mountings: Mapping[str, gtsam.Pose3],
    trajectories: Sequence[VehicleTrajectory],
) -> TargetObservation:
    """The clouds again, their sweeps put together with the mountings that have been found.

    A guess that is off by 3 degrees puts what the vehicle moves by during a sweep, 0.1 to 0.2 m,
    off by some millimetres, in all clouds alike.
    """
    clouds = []
    for cloud in observation.clouds:
        if cloud.swept is not None:
            scan = deskew(cloud.swept, mountings[cloud.lidar], trajectories[cloud.drive])
            cloud = replace(cloud, points_lidar=scan.points_lidar)
        clouds.append(cloud)
    return replace(observation, clouds=tuple(clouds))


def with_determined_offsets(
    state: SolveState, registrations: Sequence[Registration]
) -> tuple[Problem, dict[str, float]]:
    """The problem without the time offsets that the drive does not determine.

    At constant speed on an arc an offset of a LiDAR is the same as its own x and yaw: to free it
    would lose what the drive does tell of them (SPEC 4).

    Args:
        state: of `solve_registered`, offsets free.
        registrations: what it was given.

    Returns:
        The problem; and LiDAR -> 1 sigma in seconds of each offset that was free.
    """
    problem = state.problem
    if not problem.offsets:
        return problem, {}
    reduced = reduced_registered(state, registrations)
    cov = np.asarray(np.linalg.inv(reduced.D + problem.guess_information()), np.float64)
    sigmas = {name: sigma for name, (_, sigma) in reduced.time_offsets(problem, cov).items()}
    kept = frozenset(name for name, sigma in sigmas.items() if sigma < OFFSET_TOLD_S)
    return replace(problem, offsets=kept, twists=problem.twists if kept else None), sigmas


def prealigned(problem: Problem, placement: int) -> list[gtsam.Pose3]:
    """T_map_vehicle T_vehicle_lidar of the clouds of a placement, at the guesses."""
    out = []
    for j in np.flatnonzero(problem.cloud_placement == placement):
        guess = problem.guesses[problem.lidars[problem.cloud_lidar[j]]]
        out.append(problem.T_map_vehicle[problem.cloud_pose[j]].compose(guess))
    return out


def turns_of_targets(
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


def _measured(
    registrations: Sequence[Registration], turns: Sequence[Symmetry | None] = ()
) -> tuple[list[gtsam.Pose3], Array]:
    """Registered poses and informations of all placements, in order."""
    poses = [T for r in registrations for T in r.T_target_lidar]
    information = []
    for r, turn in zip(registrations, turns or [None] * len(registrations), strict=True):
        blocks = r.information
        if turn is not None:
            blocks = np.array([forget_turns(b, np.zeros(6), turn)[0] for b in blocks])
            # Pose factors want an information that can be inverted.
            ridge = 1e-9 * np.trace(blocks, axis1=1, axis2=2)
            blocks = blocks + ridge[:, None, None] * np.eye(6)
        information.append(blocks)
    return poses, np.concatenate(information)


def _residuals(lines: CloudLinearisation, measured: Sequence[gtsam.Pose3]) -> Array:
    """Residuals (J, 6) of the pose factors, `Log(predicted measured^-1)`."""
    return np.array(
        [
            gtsam.Pose3.Logmap(Z.compose(measured[j].inverse()))
            for j, Z in enumerate(lines.predicted)
        ]
    )


def _whitened(residuals: Array, information: Array) -> Array:
    """Residuals (J, 6), whitened by the root of their (J, 6, 6) information."""
    return np.asarray(np.einsum("jba,jb->ja", np.linalg.cholesky(information), residuals))


def solve_registered(
    problem: Problem,
    registrations: Sequence[Registration],
    grounds: tuple[GroundObservation, ...],
    config: Config,
    turns: tuple[Symmetry | None, ...] = (),
) -> SolveState:
    """The paper's minimisation on the graph: pose factors, robust, noise levels from the data.

    Args:
        problem: what takes part.
        registrations: of its placements, in order.
        grounds: the ground as the LiDARs saw it.
        config: kernels, noise, ground.
        turns: per placement the turn that its target looks the same after; empty: none known.

    Raises:
        SolveError: the graph is singular.
    """
    begun = time.perf_counter()
    measured, information = _measured(registrations, turns)
    state = SolveState(
        problem=problem,
        config=config,
        values=initial_values(problem, measured),
        noise=first_pose_noise(config.noise),
        scale=TYPICAL_SCALE,
        weights=RobustWeights(config.robust, problem.clouds),
        motion=motion_graph(problem),
        grounds=grounds,
        turns=turns,
    )
    state.values.insert(ground_values(problem, grounds, state.values, config.ground))
    # Before the noise is known, weights would take the slow error of the poses for outliers, and
    # the variances would then find none of it: solve plainly, and leave out what is far off.
    plain = RobustWeights(RobustConfig(kernel="none"), problem.clouds)
    state.weights, kernel = plain, state.weights
    explained = np.concatenate([explained_part(r.inlier_ratio) for r in registrations])
    _reweight(state, measured, information, explained, 1)
    given = with_given_poses(problem, state.values)
    # How far a cloud by itself may be off: what it shares with others from its place included.
    single = information / problem.cloud_shares()[:, None, None]
    sound = sound_clouds(problem, measured, single, given, state.noise) & (explained > 0.5)
    state.noise, state.scale = fit_pose_noise(problem, measured, single, sound, given, config.noise)
    state.weights = kernel
    rounds = REWEIGHTINGS if config.robust.kernel != "tls" else 4 * REWEIGHTINGS
    _reweight(state, measured, information, explained, rounds)
    state.graph_seconds += time.perf_counter() - begun
    return state


def _reweight(
    state: SolveState,
    measured: Sequence[gtsam.Pose3],
    information: Array,
    explained: Array,
    rounds: int,
) -> None:
    """Alternates graph solves and robust weights until the weights stay."""
    problem = state.problem
    scaled = information / state.scale**2
    single = scaled / problem.cloud_shares()[:, None, None]
    for _ in range(rounds):
        steady = merged(
            pose_graph(problem, state.noise, state.motion),
            offset_graph(problem),
            _ground_graph(state),
            prior_graph(problem, problem.lidars),
        )
        clouds = cloud_graph(problem, measured, scaled * state.weights.values[:, None, None])
        state.values = optimise(merged(steady, clouds), state.values, 10)
        if state.grounds:
            # Not before: by a guess that is degrees off, the vehicle would stand on no plane.
            state.ground_weights = ground_weights(problem, state.grounds, state.values)
        lines = linearise_clouds(problem, state.values)
        r = _residuals(lines, measured)
        change = state.weights.update(
            squares_without_own_pose(problem, lines, r, single, state.values, state.noise),
            explained,
        )
        if change < WEIGHT_TOLERANCE and state.weights.settled:
            break


def _joint_information(state: SolveState, registrations: Sequence[Registration]) -> Array:
    """(6J, 6J) information of all registered poses, with what they share and their weights."""
    turns = state.turns or [None] * len(registrations)
    out, start = [], 0
    for r, turn in zip(registrations, turns, strict=True):
        part = slice(start, start + len(r.information))
        start = part.stop
        H = r.information_joint
        if turn is not None:
            H = forget_turns(H, np.zeros(len(H)), turn)[0]
        out.append(weighted_joint(H, state.weights.values[part]))
    return np.asarray(block_diag(*out) / state.scale**2)


def reduced_registered(state: SolveState, registrations: Sequence[Registration]) -> Reduced:
    """What registered clouds, motion and ground say of the extrinsics where the solve is.

    Args:
        state: of `solve_registered`.
        registrations: what it was given.
    """
    problem = state.problem
    H = _joint_information(state, registrations)
    lines = linearise_clouds(problem, state.values)
    r = _residuals(lines, _measured(registrations)[0]).ravel()
    return _reduce(problem, state.values, _steady_graph(state), (H, H @ r), lines)


# ---------------------------------------------------------------- staged


def _staged(state: SolveState, registrations: Sequence[Registration]) -> Solution:
    """The paper's two stages on the registered clouds.

    Stage 1 estimates all S_a with E free under its prior. Stage 2 fixes S_a, holds the reference
    LiDAR's translation at its guess and solves its rotation.

    The translation is reported as the guess has it, but the guess may be wrong by its sigma, and a
    fit that denies this bends the rotation to make up for it: on an arc 50 mm of y become 10 mrad
    of roll. So its error is *considered* (Schmidt 1966): it takes part with the guess's sigma
    while the rotation is solved for, and is not reported.

    Both stages take the registration's joint information. Its blocks, one pose factor per cloud,
    say twice what the clouds share, since the shape was estimated from them: where two LiDARs saw
    different skins of the target, blocks tie them together and the joint information does not.
    """
    begun = time.perf_counter()
    problem = state.problem
    measured, information = _measured(registrations, state.turns)
    state.weights.values[state.weights.values < FAR_OFF] = MIN_WEIGHT
    H = _joint_information(state, registrations)
    steady = _steady_graph(state)
    prior = problem.guess_information()

    def reduce() -> Reduced:
        lines = linearise_clouds(problem, state.values)
        r = _residuals(lines, measured).ravel()
        return _reduce(problem, state.values, steady, (H, H @ r), lines)

    def settled(step: Callable[[Reduced], Array]) -> tuple[Reduced, Array, bool]:
        """Repeats a step until it is small; the last linearisation, the step, and whether it is."""
        for _ in range(COUPLED_STEPS):
            reduced = reduce()
            d = step(reduced)
            state.values = reduced.move(d)
            if d @ (reduced.D + prior) @ d < COUPLED_SIGMAS**2:
                return reduced, d, True
        return reduced, d, False

    reduced, last, converged = settled(lambda reduced: reduced.step_with(prior, _offset(state)))
    first, information_data = state.values, reduced.D

    guess = problem.guesses[problem.reference]
    certainty = problem.prior_sigmas[problem.reference][3:] ** -2.0

    def turn(reduced: Reduced) -> Array:
        E = state.values.atPose3(key_mounting())
        R = E.rotation().matrix()
        Q = problem.to_vehicle_axes(state.values)[:, :6]
        A, b = Q.T @ reduced.D @ Q, Q.T @ reduced.c
        # The guess has a say in the translation alone: the paper's second stage minimises the
        # data's error over the rotation.
        A[3:, 3:] += R.T @ np.diag(certainty) @ R
        b[3:] -= R.T @ (certainty * (E.translation() - guess.translation()))
        return np.asarray(Q @ np.linalg.solve(A, b))

    reduced, second, turned = settled(turn)
    if not (converged and turned):
        moved = np.abs((second if converged else last).reshape(-1, 6))
        step = float(moved[:, :3].max()), float(moved[:, 3:].max())
        registrations = [
            replace(r, converged=False, last_step=step, iterations=COUPLED_STEPS)
            for r in registrations
        ]
    solved = state.values.atPose3(key_mounting())
    state.values = gtsam.Values(state.values)
    state.values.update(key_mounting(), gtsam.Pose3(solved.rotation(), guess.translation()))
    cov = _staged_covariance(state, information_data, prior, first)
    offsets = reduced.time_offsets(problem, cov)
    gradient_data = reduce().c
    state.graph_seconds += time.perf_counter() - begun
    return _solution(
        state,
        registrations,
        steady,
        measured,
        information / state.scale**2,
        information_data,
        cov,
        held=("x", "y", "z"),
        iterations=1,
        converged=converged and turned,
        time_offsets=offsets,
        gradient_data=gradient_data,
    )


def _staged_covariance(
    state: SolveState, information_data: Array, prior: Array, first: gtsam.Values
) -> Array:
    """Covariance of the staged result, vehicle axes.

    S_a has the covariance of stage 1, the held translation that of the guess. The rotation is
    solved with the translation considered: its error is the data's, and what a translation that
    is off by its sigma pulls along (0.1 m turn the yaw by 0.1 m over the turning radius, SPEC 4).
    """
    problem = state.problem
    n = len(problem.lidars)
    Q = problem.to_vehicle_axes(first)
    D = Q.T @ information_data @ Q  # tangents of E (rotation, translation), S_a
    stage_one = np.linalg.inv(D + Q.T @ prior @ Q)
    R = first.atPose3(key_mounting()).rotation().matrix()
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


# ---------------------------------------------------------------- joint and auto


@dataclass
class _Shapes:
    """The clouds' quadratic over all placements at one set of poses."""

    poses: list[tuple[Array, Array]]
    quadratics: list[ShapeQuadratic]
    turns: list[Symmetry | None]

    def joint(self, scale: float) -> tuple[Array, Array]:
        """(6 J, 6 J) and (6 J,) of all placements."""
        H = block_diag(*[H for H, _ in self.joints])
        return H / scale**2, np.concatenate([gradient for _, gradient in self.joints]) / scale**2

    @cached_property
    def joints(self) -> list[tuple[Array, Array]]:
        """The same of each placement, before the scale of the registration."""
        out = []
        for quadratic, turn in zip(self.quadratics, self.turns, strict=True):
            H, gradient = quadratic.joint(), quadratic.gradient.ravel()
            out.append((H, gradient) if turn is None else forget_turns(H, gradient, turn))
        return out

    @cached_property
    def single(self) -> tuple[Array, Array]:
        """(J, 6, 6) and (J, 6): each cloud by itself, given the shape."""
        blocks, gradients = [], []
        for quadratic, turn in zip(self.quadratics, self.turns, strict=True):
            for H, gradient in zip(quadratic.blocks, quadratic.gradient, strict=True):
                if turn is not None:
                    H, gradient = forget_turns(H, gradient, turn)
                blocks.append(H)
                gradients.append(gradient)
        return np.array(blocks), np.array(gradients)


def _expect(
    states: Sequence[JointRegistration],
    lines: CloudLinearisation,
    turns: Sequence[Symmetry | None],
) -> _Shapes:
    """E-step of every placement at the poses that the graph predicts."""
    poses = _per_placement(states, lines)
    quadratics = [state.expect(R, t) for state, (R, t) in zip(states, poses, strict=True)]
    fitted = [
        None if turn is None else refit(turn, state.mixture)
        for turn, state in zip(turns, states, strict=True)
    ]
    return _Shapes(poses, quadratics, fitted)


def _per_placement(
    states: Sequence[JointRegistration], lines: CloudLinearisation
) -> list[tuple[Array, Array]]:
    """The predicted poses of the clouds, (R, t) per placement."""
    out, start = [], 0
    for state in states:
        out.append(stack(lines.predicted[start : start + state.clouds.count]))
        start += state.clouds.count
    return out


def _hand_weights(state: SolveState, states: Sequence[JointRegistration]) -> None:
    """Gives every placement the robust weights of its clouds."""
    start = 0
    for shape in states:
        shape.weights = state.weights.values[start : start + shape.clouds.count]
        start += shape.clouds.count


@dataclass
class _ShapeMeasurements:
    """What each cloud by itself, given the shape at its best, would have its pose be.

    Attributes:
        pull: (J, 6) left perturbations that lead there from the predicted poses.
        information: (J, 6, 6) without robust weights.
    """

    pull: Array
    information: Array


def _shape_measurements(state: SolveState, shapes: _Shapes) -> _ShapeMeasurements:
    """The pose factors that the quadratic stands for, one per cloud."""
    weights = state.weights.values
    blocks, gradient = shapes.single
    information = blocks / weights[:, None, None] / state.scale**2
    # A sliver of a ridge: a cloud that sees one plane of the target has a singular block.
    ridge = 1e-9 * np.trace(information, axis1=1, axis2=2) + 1e-9
    information = information + ridge[:, None, None] * np.eye(6)
    force = gradient / weights[:, None] / state.scale**2
    pull = -np.linalg.solve(information, force[..., None])[..., 0]
    return _ShapeMeasurements(pull, information)


def _refinements(sigma_range_m: float) -> int:
    """How many iterations the joint loop may take, at this noise along the beam."""
    annealed = SHAPES_BEGUN_AGAIN + annealing_steps(FINE_SIGMA_M, sigma_range_m)
    return max(REFINEMENTS, annealed + LAST_REFINEMENTS)


def _refine(
    state: SolveState,
    states: Sequence[JointRegistration],
    most: int,
    advance: Callable[..., None],
) -> Solution:
    """Expectation-maximisation whose M-step is the graph solve; no more than `most` of them."""
    problem, config = state.problem, state.config
    prior = problem.guess_information()
    steady = _steady_graph(state)
    _begin_shapes(state, states, normals=False)
    undetermined: int | None = None
    course: list[Iteration] = []
    converged, iteration = False, 0
    while iteration < most and not converged:
        iteration += 1
        lines = linearise_clouds(problem, state.values)
        shapes = _expect(states, lines, state.turns)
        clouds = shapes.joint(state.scale)
        begun = time.perf_counter()
        reduced = _reduce(problem, state.values, steady, clouds, lines)
        lost: int | None = None
        if config.solve.mode == "auto":
            split = spectrum(reduced.D, prior, undetermined)
            lost = int(split.undetermined.sum())
            if iteration >= DECIDED_AFTER:
                undetermined = int(split.undetermined.sum())
            step = respectful_step(reduced.D, reduced.c, prior, _offset(state), split)
        else:
            step = reduced.step_with(prior, _offset(state))
        wanted = _shape_measurements(state, shapes)
        single = wanted.information / problem.cloud_shares()[:, None, None]
        squared = squares_without_own_pose(
            problem, lines, -wanted.pull, single, state.values, state.noise
        )
        state.values = reduced.move(step)
        state.graph_seconds += time.perf_counter() - begun
        new = linearise_clouds(problem, state.values)
        for shape, (R, t) in zip(states, _per_placement(states, new), strict=True):
            shape.maximise(R, t)
        change = 0.0
        if config.robust.kernel != "tls":
            # Truncated weights stay as the annealed solve of the pose factors left them: a cloud
            # that is dropped has no say in the shape that it would then be judged by.
            explained = np.concatenate([explained_part(shape.inlier_ratio) for shape in states])
            change = state.weights.update(squared, explained)
        _hand_weights(state, states)
        if iteration == SHAPES_BEGUN_AGAIN:
            _begin_shapes(state, states, normals=True)
        size = np.abs(step.reshape(-1, 6))
        sigmas = float(np.sqrt(step @ (reduced.D + prior) @ step))
        small = size[:, :3].max() < STEP_TOLERANCE[0] and size[:, 3:].max() < STEP_TOLERANCE[1]
        converged = bool(
            iteration > SHAPES_BEGUN_AGAIN
            and all(s.finest for s in states)
            and (small or sigmas < STEP_SIGMAS)
            and change < 10.0 * WEIGHT_TOLERANCE
        )
        last_step = (float(size[:, :3].max()), float(size[:, 3:].max()))
        course.append(Iteration(*last_step, sigmas, change, lost))
        advance()
    solution = _refined_solution(
        state, states, steady, prior, undetermined, iteration, converged, last_step
    )
    return replace(solution, course=tuple(course))


def _begin_shapes(state: SolveState, states: Sequence[JointRegistration], normals: bool) -> None:
    """A new mixture, and if asked for new normals, where the graph puts the clouds.

    EM ends near where it starts: what it starts from shall not depend on the way that the
    registration took from the initial guess.
    """
    lines = linearise_clouds(state.problem, state.values)
    for shape, (R, t) in zip(states, _per_placement(states, lines), strict=True):
        if normals:
            shape.refine_normals(R, t)
        shape.seed(R, t, FINE_SIGMA_M)
    _hand_weights(state, states)


def _steady_graph(state: SolveState) -> gtsam.NonlinearFactorGraph:
    """What stays the same while clouds are weighed anew: poses, ground and trusted mountings."""
    problem = state.problem
    return merged(
        pose_graph(problem, state.noise, state.motion),
        offset_graph(problem),
        _ground_graph(state),
        prior_graph(problem, sorted(problem.fixed)),
    )


def _ground_graph(state: SolveState) -> gtsam.NonlinearFactorGraph:
    """What the ground says, as far as it is believed."""
    return ground_graph(state.problem, state.grounds, state.config.ground, state.ground_weights)


def _refined_solution(
    state: SolveState,
    states: Sequence[JointRegistration],
    steady: gtsam.NonlinearFactorGraph,
    prior: Array,
    undetermined: int | None,
    iterations: int,
    converged: bool,
    last_step: tuple[float, float],
) -> Solution:
    """Reads covariance, residuals and registrations off the last estimate."""
    problem = state.problem
    lines = linearise_clouds(problem, state.values)
    shapes = _expect(states, lines, state.turns)
    clouds = shapes.joint(state.scale)
    begun = time.perf_counter()
    reduced = _reduce(problem, state.values, steady, clouds, lines)
    if state.config.solve.mode == "auto":
        split = spectrum(reduced.D, prior, undetermined)
        cov = respectful_covariance(prior, split)
    else:
        cov = np.asarray(np.linalg.inv(reduced.D + prior), np.float64)
    pulls = _shape_measurements(state, shapes)
    # The robust weights of the clouds are kept apart from what they say.
    weighted = shapes.single[0]
    registrations, measured, start = [], [], 0
    for shape, (R, t), (H, _) in zip(states, shapes.poses, shapes.joints, strict=True):
        part = slice(start, start + shape.clouds.count)
        start = part.stop
        R, t = left_step(R, t, pulls.pull[part])
        blocks = pulls.information[part] * state.scale**2
        joint = H + block_diag(*(blocks - weighted[part]))
        result = shape.result(R, t, blocks, joint, iterations, converged, last_step)
        registrations.append(result)
        measured += list(result.T_target_lidar)
    state.graph_seconds += time.perf_counter() - begun
    return _solution(
        state,
        registrations,
        steady,
        measured,
        pulls.information,
        reduced.D,
        cov,
        held=(),
        iterations=iterations,
        converged=converged,
        time_offsets=reduced.time_offsets(problem, cov),
        gradient_data=reduced.c,
    )


# ---------------------------------------------------------------- shared


@dataclass
class Reduced:
    """The linearised problem with everything but the extrinsics eliminated, in vehicle axes.

    `D` and `c`: the quadratic `e^T D e / 2 - c^T e` of the data in a step e of the extrinsics.
    """

    D: Array
    c: Array
    _to_axes: Array
    _keys: tuple[int, ...]
    _G: Array
    _g: Array
    _values: gtsam.Values
    _system: DenseSystem

    def time_offsets(self, problem: Problem, cov: Array) -> dict[str, tuple[float, float]]:
        """Time offset and its sigma, in seconds, of the LiDARs that have a free one.

        Args:
            problem: which they are.
            cov: (6n, 6n) of the extrinsics, vehicle axes.
        """
        inverse = np.linalg.inv(self._to_axes)
        tangent = inverse @ cov @ inverse.T
        out = {}
        for i, name in enumerate(problem.lidars):
            if name in problem.offsets:
                variance = self._system.covariance_of(key_offset(i), tangent)[0, 0]
                value = float(self._values.atVector(key_offset(i))[0])
                out[name] = (value, float(np.sqrt(variance)))
        return out

    def step_with(self, prior: Array, offset: Array) -> Array:
        """The step (6n,) that data and guesses together call for.

        Args:
            prior: (6n, 6n) information of the guesses.
            offset: (6n,) where the estimate is from them.
        """
        return np.asarray(np.linalg.solve(self.D + prior, self.c - prior @ offset), np.float64)

    def move(self, step: Array) -> gtsam.Values:
        """All values after a step (6n,) of the extrinsics, the rest following."""
        tangent = np.linalg.solve(self._to_axes, step)
        rest = self._g - self._G @ tangent
        return retract(self._values, self._keys, np.concatenate([rest, tangent]))


def _reduce(
    problem: Problem,
    values: gtsam.Values,
    graph: gtsam.NonlinearFactorGraph,
    clouds: tuple[Array, Array],
    lines: CloudLinearisation,
) -> Reduced:
    """Linearises a graph and the clouds' quadratic (H, gradient), and eliminates the rest."""
    system = add_shape(dense_system(problem, graph, values), lines, *clouds)
    D, c, G, g = system.schur()
    Q = problem.to_vehicle_axes(values)
    inverse = np.linalg.inv(Q)
    D = inverse.T @ D @ inverse
    return Reduced(0.5 * (D + D.T), inverse.T @ c, Q, system.keys, G, g, values, system)


def _offset(state: SolveState) -> Array:
    """(6n,) where the estimate is from the guesses, vehicle axes."""
    problem = state.problem
    return np.concatenate(
        [
            vehicle_axes_difference(problem.mounting(state.values, n), problem.guesses[n])
            for n in problem.lidars
        ]
    )


def _target_in_its_map(state: SolveState, placement: int) -> gtsam.Pose3:
    """T_target_map of a placement in the map of its drive."""
    problem = state.problem
    cloud = int(np.flatnonzero(problem.cloud_placement == placement)[0])
    drive = problem.poses[problem.cloud_pose[cloud]][0]
    T_target_map = state.values.atPose3(key_target(placement))
    return T_target_map.compose(gtsam.Pose3(gtsam.Rot3(), -problem.origins_map[drive]))


def _solution(
    state: SolveState,
    registrations: Sequence[Registration],
    steady: gtsam.NonlinearFactorGraph,
    measured: Sequence[gtsam.Pose3],
    information: Array,
    information_data: Array,
    cov: Array,
    held: tuple[str, ...],
    iterations: int,
    converged: bool,
    time_offsets: Mapping[str, tuple[float, float]],
    gradient_data: Array,
) -> Solution:
    """Packs the result, and the whole graph: what is steady, the guesses, the weighted clouds."""
    problem = state.problem
    graph = merged(
        steady,
        prior_graph(problem, [n for n in problem.lidars if n not in problem.fixed]),
        cloud_graph(problem, measured, information * state.weights.values[:, None, None]),
    )
    if not (np.isfinite(cov).all() and np.isfinite(information_data).all()):
        raise SolveError("the covariance of the extrinsics is not finite")
    white = _whitened(_residuals(linearise_clouds(problem, state.values), measured), information)
    cuts = np.cumsum([len(r.T_target_lidar) for r in registrations])[:-1]
    return Solution(
        mode=state.config.solve.mode,
        lidars=problem.lidars,
        reference=problem.reference,
        T_vehicle_lidar={n: problem.mounting(state.values, n) for n in problem.lidars},
        T_map_vehicle={
            pose: moved_map(state.values.atPose3(key_vehicle(i)), problem.origins_map[pose[0]])
            for i, pose in enumerate(problem.poses)
        },
        T_target_map=tuple(_target_in_its_map(state, m) for m in range(problem.placements)),
        registrations=tuple(registrations),
        cloud_weights=tuple(np.split(state.weights.values, cuts)),
        residuals=tuple(np.split(white, cuts)),
        pose_noise=state.noise if problem.given().any() else None,
        registration_scale=state.scale,
        information_data=information_data,
        information_prior=problem.guess_information(),
        cov=cov,
        held=held,
        iterations=iterations,
        converged=converged,
        time_offsets=time_offsets,
        graph=graph,
        values=state.values,
        gradient_data=gradient_data,
    )
