"""The graph solve that every mode starts from, and what all modes share of it.

The paper's minimisation: one pose factor per registered cloud, robust weights, noise levels from
the data. Then the problem reduced to the extrinsics, which the stages step on and read covariances
off, and the result as it is passed on.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.linalg import block_diag

from caliv_graph.calibration.graph import (
    CalibrationGraph,
    CloudLinearisation,
    DenseSystem,
    add_shape,
    cloud_graph,
    cloud_rows,
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
from caliv_graph.calibration.problem import Problem, moved_map
from caliv_graph.calibration.robust import RobustWeights, explained_part, weighted_joint
from caliv_graph.config.model import Config, RobustConfig
from caliv_graph.conventions import key_offset, key_target, key_vehicle
from caliv_graph.errors import SolveError
from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.products import (
    Array,
    BoolArray,
    GroundObservation,
    LinearisedGraph,
    PoseNoise,
    Registration,
    Solution,
)
from caliv_graph.registration.symmetry import Symmetry, marginalise_symmetry

REWEIGHTINGS = 12
"""Rounds of reweighting at most; graduated non-convexity needs more and may take four times
this."""

COUPLED_STEPS = 20
"""Gauss-Newton steps with the joint information at most: the problem is nearly linear there, and
three or four are usual."""

COUPLED_SIGMAS = 0.01
"""Step in joint standard deviations of the extrinsics at which they have converged."""

WEIGHT_TOLERANCE = 0.02
"""Largest change of a weight at which reweighting stops."""

OFFSET_DETERMINED_S = 0.005
"""A time offset with a larger sigma, a centimetre at 2 m/s, is not told by the drive."""


@dataclass
class SolveState:
    """What the solve carries along."""

    problem: Problem
    config: Config
    values: gtsam.Values
    noise: PoseNoise
    scale: float
    weights: RobustWeights
    motion: CalibrationGraph
    sound: BoolArray
    """(J,) the clouds that the noise was measured by."""
    grounds: tuple[GroundObservation, ...] = ()
    turns: tuple[Symmetry | None, ...] = ()
    ground_weights: GroundWeights | None = None
    graph_seconds: float = 0.0


@dataclass
class Reduced:
    """The linearised problem with everything but the extrinsics eliminated, in vehicle axes.

    Attributes:
        D: (6n, 6n) and
        c: (6n,) of the data's quadratic `e^T D e / 2 - c^T e` in a step e of the extrinsics.
        system: the linearised graph with the clouds' quadratic in it.
        clouds: (6 J, 6 J) and (6 J,) that quadratic, in left perturbations of the clouds' poses.
        lines: derivatives of these poses with respect to the variables.
    """

    D: Array
    c: Array
    system: DenseSystem
    clouds: tuple[Array, Array]
    lines: CloudLinearisation
    _to_axes: Array
    _G: Array
    _g: Array
    _values: gtsam.Values

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
                variance = self.system.covariance_of(key_offset(i), tangent)[0, 0]
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
        return retract(self._values, self.system.keys, np.concatenate([rest, tangent]))

    def linearised(self, problem: Problem) -> LinearisedGraph:
        """The same as numbers, with the guesses' information, for score tests."""
        H, gradient = self.clouds
        guesses = np.zeros_like(self.system.H)
        of_extrinsics = slice(len(guesses) - len(self._to_axes), None)
        prior = self._to_axes.T @ problem.guess_information() @ self._to_axes
        guesses[of_extrinsics, of_extrinsics] = prior
        return LinearisedGraph(
            information=self.system.H,
            gradient=self.system.b,
            information_guesses=guesses,
            cloud_jacobian=cloud_rows(self.system, self.lines),
            cloud_information=H,
            cloud_gradient=gradient,
            by_vehicle=np.array([moves[1] for moves in self.lines.jacobians]),
            by_extrinsic=np.array([moves[-1] for moves in self.lines.jacobians]),
        )


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
    measured, information = measured_poses(registrations, turns)
    state = SolveState(
        problem=problem,
        config=config,
        values=initial_values(problem, measured),
        noise=first_pose_noise(config.noise),
        scale=TYPICAL_SCALE,
        weights=RobustWeights(config.robust, problem.clouds),
        motion=motion_graph(problem),
        sound=np.ones(problem.clouds, dtype=bool),
        grounds=grounds,
        turns=turns,
    )
    state.values.insert(ground_values(problem, grounds, state.values, config.ground))
    # Before the noise is known, weights would take the slow error of the poses for outliers, and
    # the variances would then find none of it: solve plainly, and leave out what is far off.
    plain = RobustWeights(RobustConfig(kernel="none"), problem.clouds)
    state.weights, robust = plain, state.weights
    explained = explained_parts(registrations)
    _reweight(state, measured, information, explained, 1)
    given = with_given_poses(problem, state.values)
    # How far a cloud by itself may be off: what it shares with others from its place included.
    single = information / problem.view_weights()[:, None, None]
    state.sound = sound_clouds(problem, measured, single, given, state.noise) & (explained > 0.5)
    state.noise, state.scale = fit_pose_noise(
        problem, measured, single, state.sound, given, config.noise
    )
    state.weights = robust
    rounds = REWEIGHTINGS * state.weights.kernel.patience
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
    single = scaled / problem.view_weights()[:, None, None]
    for _ in range(rounds):
        clouds = cloud_graph(problem, measured, scaled * state.weights.values[:, None, None])
        state.values = optimise(merged(guessed_graph(state), clouds), state.values, 10)
        if state.grounds:
            # Not before: by a guess that is degrees off, the vehicle would stand on no plane.
            state.ground_weights = ground_weights(problem, state.grounds, state.values)
        lines = linearise_clouds(problem, state.values)
        r = cloud_residuals(lines, measured)
        change = state.weights.update(
            squares_without_own_pose(problem, lines, r, single, state.values, state.noise),
            explained,
        )
        if change < WEIGHT_TOLERANCE and state.weights.kernel.settled:
            break


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
    kept = frozenset(name for name, sigma in sigmas.items() if sigma < OFFSET_DETERMINED_S)
    return replace(problem, offsets=kept, twists=problem.twists if kept else None), sigmas


def reduced_registered(state: SolveState, registrations: Sequence[Registration]) -> Reduced:
    """What registered clouds, motion and ground say of the extrinsics where the solve is.

    Args:
        state: of `solve_registered`.
        registrations: what it was given.
    """
    return _reduction(state, registrations)()


def _reduction(state: SolveState, registrations: Sequence[Registration]) -> Callable[[], Reduced]:
    """`reduced_registered` to be asked again as the values move, weights and noise as they are."""
    problem, steady = state.problem, base_graph(state)
    H, measured = joint_information(state, registrations), measured_poses(registrations)[0]

    def reduced() -> Reduced:
        lines = linearise_clouds(problem, state.values)
        r = cloud_residuals(lines, measured).ravel()
        return reduce_to_extrinsics(problem, state.values, steady, (H, H @ r), lines)

    return reduced


def settle(
    state: SolveState,
    registrations: Sequence[Registration],
    step: Callable[[Reduced], Array],
) -> tuple[Reduced, Array, bool]:
    """Repeats a Gauss-Newton step on the joint information until it is small.

    Args:
        state: of `solve_registered`; its values are moved.
        registrations: what it was given.
        step: (6 n,) of the extrinsics, vehicle axes, from what is said of them where they are.

    Returns:
        The last linearisation, the last step, and whether that was small.

    Raises:
        SolveError: a pose or a target is tied to nothing.
    """
    prior = state.problem.guess_information()
    reduction = _reduction(state, registrations)
    for _ in range(COUPLED_STEPS):
        reduced = reduction()
        d = step(reduced)
        state.values = reduced.move(d)
        if d @ (reduced.D + prior) @ d < COUPLED_SIGMAS**2:
            return reduced, d, True
    return reduced, d, False


def step_of_all(state: SolveState) -> Callable[[Reduced], Array]:
    """For `settle`: the step that data and guesses of all LiDARs together call for."""
    prior = state.problem.guess_information()
    return lambda reduced: reduced.step_with(prior, offset_from_guesses(state))


def joint_information(state: SolveState, registrations: Sequence[Registration]) -> Array:
    """(6 J, 6 J) information of all registered poses, with what they share and their weights.

    Args:
        state: weights, scale of the registration's sigmas, turns that are forgotten.
        registrations: of the placements, in order.
    """
    turns = state.turns or [None] * len(registrations)
    out, start = [], 0
    for r, turn in zip(registrations, turns, strict=True):
        part = slice(start, start + len(r.information))
        start = part.stop
        H = r.information_joint
        if turn is not None:
            H = marginalise_symmetry(H, np.zeros(len(H)), turn)[0]
        out.append(weighted_joint(H, state.weights.values[part]))
    return np.asarray(block_diag(*out) / state.scale**2)


def measured_poses(
    registrations: Sequence[Registration], turns: Sequence[Symmetry | None] = ()
) -> tuple[list[gtsam.Pose3], Array]:
    """Registered poses (J,) and informations (J, 6, 6) of all placements, in order.

    Args:
        registrations: of the placements, in order.
        turns: per placement the turn that its target looks the same after, and that the
            information is to forget; empty: none.
    """
    poses = [T for r in registrations for T in r.T_target_lidar]
    information = []
    for r, turn in zip(registrations, turns or [None] * len(registrations), strict=True):
        blocks = r.information
        if turn is not None:
            blocks = np.array([marginalise_symmetry(b, np.zeros(6), turn)[0] for b in blocks])
            # Pose factors want an information that can be inverted.
            ridge = 1e-9 * np.trace(blocks, axis1=1, axis2=2)
            blocks = blocks + ridge[:, None, None] * np.eye(6)
        information.append(blocks)
    return poses, np.concatenate(information)


def cloud_residuals(lines: CloudLinearisation, measured: Sequence[gtsam.Pose3]) -> Array:
    """Residuals (J, 6) of the pose factors, `Log(predicted measured^-1)`, rad and m.

    Args:
        lines: with the predicted poses T_target_lidar.
        measured: those that the registration found.
    """
    return np.array(
        [
            gtsam.Pose3.Logmap(Z.compose(measured[j].inverse()))
            for j, Z in enumerate(lines.predicted)
        ]
    )


def _whitened(residuals: Array, information: Array) -> Array:
    """Residuals (J, 6), whitened by the root of their (J, 6, 6) information."""
    return np.asarray(np.einsum("jba,jb->ja", np.linalg.cholesky(information), residuals))


def explained_parts(registrations: Sequence[Registration]) -> Array:
    """Factors (J,) on the weights of all clouds by how much of each is target at all."""
    return np.concatenate([explained_part(r.inlier_ratio) for r in registrations])


def base_graph(state: SolveState) -> CalibrationGraph:
    """What stays the same while clouds are weighed anew: poses, ground and trusted extrinsics."""
    problem = state.problem
    return merged(
        pose_graph(problem, state.noise, state.motion),
        offset_graph(problem),
        _ground_graph(state),
        prior_graph(problem, sorted(problem.fixed)),
    )


def guessed_graph(state: SolveState) -> CalibrationGraph:
    """What stays the same, and the guesses of the extrinsics that are not trusted."""
    return merged(base_graph(state), _guess_graph(state.problem))


def _guess_graph(problem: Problem) -> CalibrationGraph:
    """The guesses of the extrinsics that are not trusted."""
    return prior_graph(problem, [n for n in problem.lidars if n not in problem.fixed])


def _ground_graph(state: SolveState) -> CalibrationGraph:
    """What the ground says, as far as it is believed."""
    return ground_graph(state.problem, state.grounds, state.config.ground, state.ground_weights)


def reduce_to_extrinsics(
    problem: Problem,
    values: gtsam.Values,
    graph: CalibrationGraph,
    clouds: tuple[Array, Array],
    lines: CloudLinearisation,
) -> Reduced:
    """Linearises a graph and the clouds' quadratic, and eliminates all but the extrinsics.

    Args:
        problem: what takes part.
        values: where to linearise.
        graph: everything but the clouds and the guesses.
        clouds: (6 J, 6 J) and (6 J,) their quadratic in left perturbations of their poses.
        lines: how these move with the variables.

    Raises:
        SolveError: a pose or a target is tied to nothing.
    """
    system = add_shape(dense_system(problem, graph, values), lines, *clouds)
    D, c, G, g = system.schur()
    Q = problem.to_vehicle_axes(values)
    inverse = np.linalg.inv(Q)
    D = inverse.T @ D @ inverse
    return Reduced(
        D=0.5 * (D + D.T),
        c=inverse.T @ c,
        system=system,
        clouds=clouds,
        lines=lines,
        _to_axes=Q,
        _G=G,
        _g=g,
        _values=values,
    )


def offset_from_guesses(state: SolveState) -> Array:
    """(6 n,) where the extrinsics are from their guesses, vehicle axes, rad and m."""
    problem = state.problem
    return np.concatenate(
        [
            vehicle_axes_difference(problem.extrinsic(state.values, n), problem.guesses[n])
            for n in problem.lidars
        ]
    )


def packed_solution(
    state: SolveState,
    registrations: Sequence[Registration],
    reduced: Reduced,
    information: Array,
    information_data: Array,
    cov: Array,
    held: tuple[str, ...],
    iterations: int,
    converged: bool,
    time_offsets: Mapping[str, tuple[float, float]],
) -> Solution:
    """Packs the result, the whole graph and its linearisation.

    Args:
        state: after its last step.
        registrations: the registered clouds.
        reduced: linearisation at the result.
        information: (J, 6, 6) of the graph's pose factors, without robust weights.
        information_data: (6 n, 6 n) of the extrinsics by the data alone, vehicle axes.
        cov: (6 n, 6 n) of the result, vehicle axes.
        held: axes of the reference LiDAR that were held at the guess.
        iterations: of the loop.
        converged: whether its last step was below its tolerance.
        time_offsets: LiDAR -> offset and sigma, seconds.

    Raises:
        SolveError: the covariance is not finite.
    """
    if not (np.isfinite(cov).all() and np.isfinite(information_data).all()):
        raise SolveError("the covariance of the extrinsics is not finite")
    problem, measured = state.problem, measured_poses(registrations)[0]
    weighted = information * state.weights.values[:, None, None]
    graph = merged(guessed_graph(state), cloud_graph(problem, measured, weighted))
    residuals = cloud_residuals(linearise_clouds(problem, state.values), measured)
    cuts = np.cumsum([len(r.T_target_lidar) for r in registrations])[:-1]
    return Solution(
        mode=state.config.solve.mode,
        lidars=problem.lidars,
        reference=problem.reference,
        T_vehicle_lidar={n: problem.extrinsic(state.values, n) for n in problem.lidars},
        T_map_vehicle={
            pose: moved_map(state.values.atPose3(key_vehicle(i)), problem.origins_map[pose[0]])
            for i, pose in enumerate(problem.poses)
        },
        T_target_map=tuple(_target_in_its_map(state, m) for m in range(problem.placements)),
        registrations=tuple(registrations),
        cloud_weights=tuple(np.split(state.weights.values, cuts)),
        residuals=tuple(np.split(_whitened(residuals, information), cuts)),
        pose_noise=state.noise if problem.given().any() else None,
        registration_scale=state.scale,
        information_data=information_data,
        information_prior=problem.guess_information(),
        cov=cov,
        held=held,
        iterations=iterations,
        converged=converged,
        graph=graph,
        factor_kinds=tuple(graph.kinds),
        values=state.values,
        linearised=reduced.linearised(problem),
        time_offsets=time_offsets,
        gradient_data=reduced.c,
    )


def _target_in_its_map(state: SolveState, placement: int) -> gtsam.Pose3:
    """T_target_map of a placement in the map of its drive."""
    problem = state.problem
    cloud = int(np.flatnonzero(problem.cloud_placement == placement)[0])
    drive = problem.poses[problem.cloud_pose[cloud]][0]
    T_target_map = state.values.atPose3(key_target(placement))
    return T_target_map.compose(gtsam.Pose3(gtsam.Rot3(), -problem.origins_map[drive]))
