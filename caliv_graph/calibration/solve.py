"""The graph solve of registered clouds, and what all modes use of it.

The paper's minimisation: one pose factor per registered cloud, robust weights, noise levels from
the data. Then the problem reduced to the extrinsics, for steps and covariances.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from scipy.linalg import block_diag

from caliv_graph.calibration.graph import (
    CalibrationGraph,
    cloud_graph,
    initial_values,
    merged,
    motion_graph,
    offset_graph,
    optimise,
    pose_graph,
    prior_graph,
    with_given_poses,
)
from caliv_graph.calibration.ground import (
    GroundWeights,
    drives_with_planes,
    ground_graph,
    ground_values,
)
from caliv_graph.calibration.ground_weights import ground_weights
from caliv_graph.calibration.linear import CloudLinearisation, linearise_clouds
from caliv_graph.calibration.noise import (
    TYPICAL_SCALE,
    PoseResiduals,
    first_pose_noise,
    fit_pose_noise,
    sound_clouds,
    squares_without_own_pose,
)
from caliv_graph.calibration.problem import Problem
from caliv_graph.calibration.range_bias import UNKNOWN, BiasSizes, without_bias
from caliv_graph.calibration.rates import rates_graph
from caliv_graph.calibration.reduced import Reduced, reduce_to_extrinsics
from caliv_graph.calibration.robust import RobustWeights, explained_part, weighted_joint
from caliv_graph.calibration.structure import structure_graph
from caliv_graph.config.model import Config, RobustConfig
from caliv_graph.config.range_errors import range_errors
from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.products import (
    Array,
    BoolArray,
    GroundObservation,
    PoseNoise,
    Registration,
    StructureTerm,
)
from caliv_graph.registration.symmetry import Symmetry, marginalise_symmetry
from caliv_graph.uncertainty.observability import (
    covariance_with_prior_in_null_space,
    spectrum,
    step_with_prior_in_null_space,
)

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
"""A time offset with a larger sigma, a centimetre at 2 m/s, is not determined by the drive."""


@dataclass
class SolveState:
    """State of the solve."""

    problem: Problem
    config: Config
    values: gtsam.Values
    noise: PoseNoise
    scale: float
    weights: RobustWeights
    motion: CalibrationGraph
    sound: BoolArray
    """(J,) the clouds that the noise was estimated from."""
    grounds: tuple[GroundObservation, ...] = ()
    turns: tuple[Symmetry | None, ...] = ()
    ground_weights: GroundWeights | None = None
    graph_seconds: float = 0.0
    bias_sizes: BiasSizes = UNKNOWN
    """1 sigma of the biases of the ranges; before the joint loop none are looked for."""
    bias_directions: Array | None = None
    """(6 J, B) how the poses of registered clouds seem to move by biases of sigma 1; None: none."""
    least_scale: float = 0.0
    """What `scale` is at least after the joint loop: 1, or what a jackknife said."""
    creeps: bool = False
    """Whether the joint loop ended far from where it leads."""
    structure: tuple[StructureTerm, ...] = ()
    structure_factors: CalibrationGraph = field(default_factory=CalibrationGraph)
    """Of `structure`; like those of `motion` they take time to build."""
    of_poses: PoseResiduals | None = None
    """What structure says of the noise of given poses."""


def solve_registered(
    problem: Problem,
    registrations: Sequence[Registration],
    grounds: tuple[GroundObservation, ...],
    config: Config,
    turns: tuple[Symmetry | None, ...] = (),
    structure: tuple[StructureTerm, ...] = (),
    start: Mapping[str, gtsam.Pose3] | None = None,
    of_poses: PoseResiduals | None = None,
) -> SolveState:
    """The paper's minimisation on the graph: pose factors, robust, noise levels from the data.

    `registrations` are of the problem's placements, in order; `turns` the continuous symmetry of
    each placement's target, empty for none; `start` extrinsics that are nearer than the guesses;
    `of_poses` what structure says of the noise of given poses.

    Raises:
        SolveError: the graph is singular.
    """
    begun = time.perf_counter()
    measured, information = measured_poses(registrations, turns)
    state = SolveState(
        problem=problem,
        config=config,
        values=initial_values(problem, measured, start),
        noise=first_pose_noise(config.noise),
        scale=TYPICAL_SCALE,
        weights=RobustWeights(config.robust, problem.clouds),
        motion=motion_graph(problem),
        sound=np.ones(problem.clouds, dtype=bool),
        grounds=grounds,
        turns=turns,
        structure=structure,
        structure_factors=structure_graph(
            problem, structure, start, drives_with_planes(problem, grounds, config.ground)
        ),
        of_poses=of_poses,
    )
    state.values.insert(ground_values(problem, grounds, state.values, config.ground))
    # Before the noise is known, weights would treat the Gauss-Markov pose error as outliers, and
    # the noise fit would find none of it: solve without weights, and leave out what is far off.
    robust = state.weights
    state.weights = RobustWeights(RobustConfig(kernel="none"), problem.clouds)
    explained = explained_parts(registrations)
    _reweight(state, registrations, measured, information, explained, 1)
    given = with_given_poses(problem, state.values)
    single = of_single_clouds(information, registrations)
    state.sound = sound_clouds(problem, measured, single, given, state.noise) & (explained > 0.5)
    fit_noise(state, registrations)
    state.weights = robust
    rounds = REWEIGHTINGS * state.weights.kernel.patience
    _reweight(state, registrations, measured, information, explained, rounds)
    state.graph_seconds += time.perf_counter() - begun
    return state


def fit_noise(state: SolveState, registrations: Sequence[Registration]) -> None:
    """Estimates the noise levels of a solved graph, which is not solved again, by its sound clouds.

    And by what structure says of given poses (`of_poses`).
    """
    measured, information = measured_poses(registrations, state.turns)
    single = of_single_clouds(information, registrations)
    given = with_given_poses(state.problem, state.values)
    state.noise, state.scale = fit_pose_noise(
        state.problem, measured, single, state.sound, given, state.config.noise, state.of_poses
    )


def _reweight(
    state: SolveState,
    registrations: Sequence[Registration],
    measured: Sequence[gtsam.Pose3],
    information: Array,
    explained: Array,
    rounds: int,
) -> None:
    """Alternates graph solves and robust weights until the weights stay."""
    problem = state.problem
    scaled = information / state.scale**2
    single = of_single_clouds(scaled, registrations)
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


def offset_sigmas(state: SolveState, registrations: Sequence[Registration]) -> dict[str, float]:
    """LiDAR -> 1 sigma in seconds of each time offset that is free, guesses included.

    `state` and `registrations` are those of `solve_registered`.
    """
    if not state.problem.offsets:
        return {}
    return reduced_offset_sigmas(state.problem, reduced_registered(state, registrations))


def reduced_offset_sigmas(problem: Problem, reduced: Reduced) -> dict[str, float]:
    """`offset_sigmas` of a problem that is reduced to the extrinsics."""
    cov = np.asarray(np.linalg.inv(reduced.D + problem.guess_information()), np.float64)
    return {name: sigma for name, (_, sigma) in reduced.time_offsets(problem, cov).items()}


def reduced_registered(state: SolveState, registrations: Sequence[Registration]) -> Reduced:
    """The problem of registered clouds, motion and ground, reduced to the extrinsics."""
    return _reduction(state, registrations)()


def _reduction(state: SolveState, registrations: Sequence[Registration]) -> Callable[[], Reduced]:
    """`reduced_registered` for values that move, weights and noise fixed."""
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
    """Repeats a Gauss-Newton step on the joint information until it is small; moves `state`.

    `step` gives (6 n,) of the extrinsics, vehicle axes, from the problem reduced to them. Returns
    the last linearisation, the last step, and whether that was small.

    Raises:
        SolveError: a pose or a target has no measurement.
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
    """(6 J, 6 J) joint information of all registered poses, with robust weights.

    Biases of the ranges and errors of channels are eliminated, where they are known.
    """
    turns = state.turns or [None] * len(registrations)
    out = []
    placements = state.problem.clouds_of_placements()
    for part, r, turn in zip(placements, registrations, turns, strict=True):
        H = r.information_joint
        if turn is not None:
            H = marginalise_symmetry(H, np.zeros(len(H)), turn)[0]
        out.append(weighted_joint(H, state.weights.values[part]))
    H = np.asarray(block_diag(*out) / state.scale**2)
    if state.bias_directions is None:
        return H
    return without_bias(H, np.zeros(len(H)), state.bias_directions)[0]


def measured_poses(
    registrations: Sequence[Registration], turns: Sequence[Symmetry | None] = ()
) -> tuple[list[gtsam.Pose3], Array]:
    """Registered poses (J,) and informations (J, 6, 6) of all placements, in order.

    The continuous symmetries `turns` of the placements' targets are marginalised; empty: none.
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
    return poses, np.concatenate([np.zeros((0, 6, 6)), *information])


def of_single_clouds(information: Array, registrations: Sequence[Registration]) -> Array:
    """(J, 6, 6) of clouds by themselves, without the weights for what scans of a view share."""
    weights = np.concatenate([r.view_weights for r in registrations])
    return np.asarray(information / weights[:, None, None])


def cloud_residuals(lines: CloudLinearisation, measured: Sequence[gtsam.Pose3]) -> Array:
    """Residuals (J, 6) of the pose factors, `Log(predicted measured^-1)`, rad and m."""
    return np.array(
        [
            gtsam.Pose3.Logmap(Z.compose(measured[j].inverse()))
            for j, Z in enumerate(lines.predicted)
        ]
    ).reshape(-1, 6)


def explained_parts(registrations: Sequence[Registration]) -> Array:
    """Factors (J,) on the weights of all clouds by how much of each is target at all."""
    return np.concatenate([explained_part(r.inlier_ratio) for r in registrations])


def base_graph(state: SolveState) -> CalibrationGraph:
    """The graph without clouds and guesses: poses, ground, structure, trusted extrinsics."""
    problem = state.problem
    return merged(
        pose_graph(problem, state.noise, state.motion),
        offset_graph(problem),
        rates_graph(problem, state.grounds),
        ground_graph(
            problem,
            state.grounds,
            state.config.ground,
            state.ground_weights,
            math.radians(state.config.noise.sway_deg),
            range_errors(state.config.noise),
        ),
        state.structure_factors,
        prior_graph(problem, sorted(problem.fixed)),
    )


def guessed_graph(state: SolveState) -> CalibrationGraph:
    """`base_graph`, and the guesses of the extrinsics that are estimated."""
    estimated = [n for n in state.problem.lidars if n not in state.problem.fixed]
    return merged(base_graph(state), prior_graph(state.problem, estimated))


def step_of_mode(
    state: SolveState, reduced: Reduced, undetermined: int | None
) -> tuple[Array, int | None]:
    """The step (6 n,) of the extrinsics by `joint` or `auto`; and for `auto` the directions lost.

    `undetermined` is the number of undetermined directions once it is fixed.
    """
    prior, offset = state.problem.guess_information(), offset_from_guesses(state)
    if state.config.solve.mode != "auto":
        return reduced.step_with(prior, offset), None
    split = spectrum(reduced.D, prior, undetermined)
    step = step_with_prior_in_null_space(reduced.D, reduced.c, prior, offset, split)
    return step, int(split.undetermined.sum())


def covariance_of_mode(state: SolveState, reduced: Reduced, undetermined: int | None) -> Array:
    """(6 n, 6 n) covariance of the extrinsics, vehicle axes, by `joint` or `auto`."""
    prior = state.problem.guess_information()
    if state.config.solve.mode != "auto":
        return np.asarray(np.linalg.inv(reduced.D + prior), np.float64)
    split = spectrum(reduced.D, prior, undetermined)
    return covariance_with_prior_in_null_space(prior, split)


def offset_from_guesses(state: SolveState) -> Array:
    """(6 n,) where the extrinsics are from their guesses, vehicle axes, rad and m."""
    problem = state.problem
    return np.concatenate(
        [
            vehicle_axes_difference(problem.extrinsic(state.values, n), problem.guesses[n])
            for n in problem.lidars
        ]
    )
