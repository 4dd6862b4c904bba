"""Shape and graph together, for `joint` and `auto`.

Expectation-maximisation whose M-step is the graph solve, the clouds' quadratic (places and
orientations of the components eliminated, all clouds coupled) in the place of the pose factors.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import gtsam
import numpy as np
from scipy.linalg import block_diag

from caliv_graph.calibration.channel_errors import ChannelSizes, OwnChannels, channel_sizes
from caliv_graph.calibration.graph import CalibrationGraph
from caliv_graph.calibration.jackknife import jackknife_scale
from caliv_graph.calibration.linear import CloudLinearisation, linearise_clouds
from caliv_graph.calibration.noise import fit_scale, squares_without_own_pose
from caliv_graph.calibration.pack import packed_solution
from caliv_graph.calibration.problem import Problem
from caliv_graph.calibration.range_bias import (
    UNKNOWN,
    BiasSizes,
    OwnRanges,
    RangeBiases,
    fit_bias_sizes,
    most_likely_biases,
    moved_back,
    range_biases,
    without_bias,
)
from caliv_graph.calibration.rates import turned_clouds
from caliv_graph.calibration.reduced import Reduced, reduce_to_extrinsics
from caliv_graph.calibration.robust import explained_part
from caliv_graph.calibration.solve import (
    WEIGHT_TOLERANCE,
    SolveState,
    base_graph,
    covariance_of_mode,
    step_of_mode,
)
from caliv_graph.config.range_errors import range_errors
from caliv_graph.geometry.se3 import stack, unstack, vehicle_axes_difference
from caliv_graph.products import Array, Iteration, Registration, Solution
from caliv_graph.registration.quadratic import ShapeQuadratic
from caliv_graph.registration.register import (
    FINE_SIGMA_M,
    TILES_SETTLE,
    JointRegistration,
    annealing_steps,
    left_step,
)
from caliv_graph.registration.symmetry import Symmetry, marginalise_symmetry, refit
from caliv_graph.uncertainty.consistency import RANGE_BIAS_LIMIT_M

REFINEMENTS = 30
"""Iterations of a round of the joint loop at most; more where the noise is so small that annealing
to it takes more."""

HELD_PART = 1e-6
"""Ridge, relative to each cloud's own information, on the poses that minimise the clouds'
quadratic without the graph: numerical."""

LAST_REFINEMENTS = 4
"""Iterations that are left at the noise level, at least."""

DECIDED_AFTER = 9
"""Iteration from which the number of undetermined directions is fixed, so that a direction at the
threshold does not make the estimate jump for ever."""

SCALED_EVERY = 3
"""Iterations at the noise level from one estimate of the registration's scale to the next."""

BIAS_AFTER = 4
"""Iterations at the noise level after which the sigmas of the biases are estimated, once: with the
biases free the shapes fit each other, and contradict nothing any more."""

STEP_TOLERANCE = (5e-5, 3e-4)
STEP_SIGMAS = 0.1
"""Largest step of the extrinsics, rad and m, at which the joint loop has converged: a fraction of
the accuracy of 100 clouds of a chair. Or else in joint standard deviations of the extrinsics."""


CREEPING_SIGMAS, LAST_STEPS = 0.5, 5
"""Where most of so many last steps are above as many joint standard deviations, the loop is far
from its end, although its iterations are up. Two copies of an edge, a hand's breadth apart, one of
each LiDAR, draw each other together by a millimetre in each at the noise level."""

WAY, LONG_WAY_SIGMAS = 10, 2.5
"""Likewise where the extrinsics have come so far in as many iterations. Steps of 0.4 that lead
nowhere come 1.3, those of one direction 4: of `random` 272, which fall by a fortieth each time,
eighteen were still to come."""

LOOSE_WAY_SIGMAS, MOSTLY_HELD = 0.7, 0.7
"""How far the extrinsics have come in the last `WAY` iterations, in joint standard deviations, from
which what the clouds hold along this way is measured; and the part of what all data claim there
that passes for all of it. Steps that lead nowhere come as far, and are held by 0.97."""

FOLLOWING = 3
"""Iterations in which shapes follow a motion of the clouds: eight find the same."""

LOOSE_SIGMAS, HALVINGS = (0.05, 20.0), 10
"""Size of such a motion in its claimed standard deviations, and halvings of the interval in which
it is looked for."""

MOST_ROUNDS = 8
"""Rounds of iterations of such a loop at most: shapes that begin anew are coarse at first, and move
by centimetres. `random` 194 of the second simulator, 0.35 m off at first, takes three."""

FEW_SURFELS, OTHER_STARTS = 100, 2
"""Where a target has fewer surfels, for want of points, the shapes begin so many times more, on
other points, and the mean of all ends is taken. Where the surface is cut into them moves the
extrinsics: by one to two standard deviations with 50 surfels, by 0.1 to 0.3 with 300."""


def refinements(sigma_range_m: float) -> int:
    """How many iterations there may be, at this noise along the beam (metres)."""
    return max(REFINEMENTS, annealing_steps(FINE_SIGMA_M, sigma_range_m) + LAST_REFINEMENTS)


def further_refinements(sigma_range_m: float) -> int:
    """How many iterations each other start may take, at this noise along the beam (metres)."""
    annealed = annealing_steps(FINE_SIGMA_M, sigma_range_m)
    return annealed + TILES_SETTLE + LAST_REFINEMENTS


def creeps(course: Sequence[Iteration]) -> bool:
    """Whether iterations that did not converge ended far from where they lead."""
    far = bool(course) and course[-1].way_sigmas > LONG_WAY_SIGMAS
    if far and course[-1].sigmas >= STEP_SIGMAS and not _is_small(course[-1]):
        return True
    long = [last.sigmas > CREEPING_SIGMAS and not _is_small(last) for last in course[-LAST_STEPS:]]
    return 2 * sum(long) > len(long)


def _is_small(step: Iteration) -> bool:
    """Whether a step is next to nothing, whatever is known of the extrinsics."""
    return step.turn_rad < STEP_TOLERANCE[0] and step.shift_m < STEP_TOLERANCE[1]


def refined(
    state: SolveState,
    states: Sequence[JointRegistration],
    most: int,
    advance: Callable[..., None],
) -> Solution:
    """Expectation-maximisation whose M-step is the graph solve, `most` iterations in a round.

    `state` (of `solve_registered`) and `states`, the registration of each placement, are taken
    along; `advance` is called after each iteration.

    Raises:
        SolveError: a pose or a target has no measurement.
    """
    loop, course, converged = _settled(state, states, most, advance)
    return replace(
        _refined_solution(loop, course[-1], len(course), converged), course=tuple(course)
    )


def registered_with_motion(
    state: SolveState,
    states: Sequence[JointRegistration],
    most: int,
    advance: Callable[..., None],
) -> tuple[list[Registration], tuple[Iteration, ...]]:
    """`refined`, but of each placement what the clouds alone say of their poses; and the course.

    Poses that are all free wander where clouds are sparse and noisy: shape and poses together move
    by ten times their sigmas in hundreds of iterations, and none of them is the end. So the graph
    is the M-step here, too.

    Args:
        state: of `solve_registered`; gets values, weights, the scale of the registration, what
            biases of the ranges do to the poses, and whether the loop creeps.
        states: the registration of each placement, taken along.
        most: iterations of a round.
        advance: is called after each.

    Raises:
        SolveError: a pose or a target has no measurement.
    """
    loop, course, converged = _settled(state, states, most, advance)
    shapes, reduced = loop.at_the_end()
    begun = time.perf_counter()
    state.bias_directions = loop.directions(shapes, reduced.lines)
    last_step = course[-1].turn_rad, course[-1].shift_m
    out = []
    for own, shape, quadratic, fitting in zip(
        state.problem.clouds_of_placements(), states, shapes.quadratics, shapes.poses, strict=True
    ):
        R, t, blocks, H = poses_by_clouds_alone(quadratic, state.weights.values[own], *fitting)
        out.append(shape.result(R, t, blocks, H, len(course), converged, last_step))
    state.graph_seconds += time.perf_counter() - begun
    return out, tuple(course)


def poses_by_clouds_alone(
    quadratic: ShapeQuadratic, weights: Array, R: Array, t: Array
) -> tuple[Array, Array, Array, Array]:
    """Poses that minimise the clouds' quadratic without a graph, and their information.

    As pose factors with the joint information they have the gradient that the quadratic has. What
    clouds do not tell stays where it is: the gauge, and clouds that have no surface in common.

    Args:
        quadratic: of the clouds at `T_target_lidar` (R, t).
        weights: (J,) robust weights that it was made with. They are taken out: it is for pose
            factors to have them.
        R: (J, 3, 3).
        t: (J, 3) metres.

    Returns:
        The poses (J, 3, 3) and (J, 3), information (J, 6, 6) of each given the shape, and
        (6 J, 6 J) of all, in rad and m.
    """
    blocks = quadratic.blocks / weights[:, None, None]
    H = quadratic.joint() + block_diag(*(blocks - quadratic.blocks))
    more = (1.0 / weights - 1.0)[:, None]
    gradient = quadratic.gradient + more * quadratic.gradient_given_shape
    held = H + block_diag(*(HELD_PART * blocks))
    d = -np.asarray(np.linalg.solve(held, gradient.ravel()), np.float64).reshape(-1, 6)
    return *left_step(R, t, d), blocks, H


def _settled(
    state: SolveState,
    states: Sequence[JointRegistration],
    most: int,
    advance: Callable[..., None],
) -> tuple[_Loop, list[Iteration], bool]:
    """The loop at its end, its iterations, and whether it has converged; see `refined`."""
    none_m = np.zeros(sum(of.clouds.lidars for of in states))
    channels = OwnChannels.of(states)
    found = [term.channels for term in state.structure]
    sizes = channel_sizes(channels.lidars, found, range_errors(state.config.noise))
    base, prior = base_graph(state), state.problem.guess_information()
    loop = _Loop(state, states, base, prior, none_m, channels, sizes)
    course: list[Iteration] = []
    converged = _in_rounds(loop, course, most, advance)
    state.creeps = not converged and creeps(course)
    few = min(FEW_SURFELS, state.config.registration.components)
    if not state.creeps and any(len(shape.mixture.weights) < few for shape in states):
        ends = [loop.extrinsics()]
        further = further_refinements(state.config.noise.lidar_range_m)
        for draw in range(1, OTHER_STARTS + 1):
            loop.begin_shapes(draw)
            _iterated(loop, course, further, advance)
            ends.append(loop.extrinsics())
        loop.move_to_mean(ends)
    return loop, course, converged


def _in_rounds(
    loop: _Loop, course: list[Iteration], most: int, advance: Callable[..., None]
) -> bool:
    """Whether the loop has converged in rounds of `most` iterations, one unless it creeps."""
    for number in range(1, MOST_ROUNDS + 1):
        loop.begin_round()
        # Further rounds are not among the iterations that were expected.
        further = partial(advance, 0, f"round {number}")
        if _iterated(loop, course, most, further if number > 1 else advance):
            return True
        if not creeps(course):
            break
    return False


def _iterated(
    loop: _Loop, course: list[Iteration], most: int, advance: Callable[..., None]
) -> bool:
    """Whether the loop has converged within `most` more iterations, which `course` gets."""
    for number in range(1, most + 1):
        course.append(loop.iterate(number))
        advance()
        if loop.has_converged(course[-1]):
            return True
    return False


@dataclass
class _Loop:
    """What the iterations carry along; `base` is the graph without clouds and guesses.

    `prior` (6n, 6n) of the guesses; `offsets_m` (B,): biases of the ranges with which
    the clouds are moved back before they meet the shape; `undetermined`: number of such directions
    once it is fixed; `fine`: iterations at the noise level; `ranges` of each placement since the
    shapes began; `channels` that see the targets, and sizes of their errors; `ends`: the extrinsics
    after each iteration since then; `fine_since`: as `fine`, of these shapes; `loose` (6 J, 1):
    motion of the clouds that they do not tell, at the end, and how they pull along it.
    """

    state: SolveState
    states: Sequence[JointRegistration]
    base: CalibrationGraph
    prior: Array
    offsets_m: Array
    channels: OwnChannels
    channel_sizes: ChannelSizes
    undetermined: int | None = None
    fine: int = 0
    ranges: tuple[OwnRanges, ...] = ()
    ends: list[list[gtsam.Pose3]] = field(default_factory=list)
    fine_since: int = 0
    loose: Array | None = None
    loose_pull: float = 0.0

    def expected(self) -> tuple[_Shapes, CloudLinearisation]:
        """E-step at the poses that the graph predicts, and the derivatives of these."""
        lines = linearise_clouds(self.state.problem, self.state.values)
        poses, turns = self.poses_of_clouds(lines), self.state.turns
        return _expect(self.states, poses, turns, self.ranges), lines

    def at_the_end(self) -> tuple[_Shapes, Reduced]:
        """E-step and linearised graph, the registration's scale by a jackknife, too."""
        shapes, lines = self.expected()
        begun = time.perf_counter()
        self.state.least_scale = self.left_out(lines)
        self.estimate_scale(shapes, lines)
        reduced = self.linearised(shapes, lines)
        if self._find_loose(shapes, lines, reduced):
            reduced = self.linearised(shapes, lines)
        self.state.graph_seconds += time.perf_counter() - begun
        return shapes, reduced

    def poses_of_clouds(self, lines: CloudLinearisation) -> list[tuple[Array, Array]]:
        """Poses at which the clouds fit, per placement: the predicted ones, with biased ranges."""
        return moved_back(self.states, per_placement(self.state.problem, lines), self.offsets_m)

    def extrinsics(self) -> list[gtsam.Pose3]:
        """T_vehicle_lidar of every LiDAR."""
        return list(self.state.problem.extrinsics(self.state.values).values())

    def move_to_mean(self, ends: Sequence[Sequence[gtsam.Pose3]]) -> None:
        """Takes the extrinsics to the mean of these, the last of which they are; all else follows.

        The ends are a fraction of a sigma apart: the mean of their tangents is the mean.
        """
        now = self.extrinsics()
        steps = [
            np.concatenate([vehicle_axes_difference(T, T0) for T, T0 in zip(end, now, strict=True)])
            for end in ends
        ]
        self.state.values = self.linearised(*self.expected()).move(np.mean(steps, axis=0))

    def begin_round(self) -> None:
        """Shapes begin, and all that was found out from those before is forgotten."""
        self.undetermined, self.fine = None, 0
        self.offsets_m = np.zeros_like(self.offsets_m)
        self.state.bias_sizes = UNKNOWN
        self.begin_shapes()

    def begin_shapes(self, draw: int = 0) -> None:
        """New normals and a new mixture, at the poses of the solved graph: EM ends near its start.

        The surfels are those of beams from now on. Another `draw` begins on other points.
        """
        self.ends, self.fine_since = [], 0
        _hand_weights(self.state, self.states)
        lines = linearise_clouds(self.state.problem, self.state.values)
        for shape, (R, t) in zip(self.states, self.poses_of_clouds(lines), strict=True):
            shape.refine_normals(R, t)
            shape.by_beams, shape.held_along = True, 0.0
            shape.seed(R, t, FINE_SIGMA_M, draw)
        self.ranges = tuple(OwnRanges.of(shape.clouds) for shape in self.states)

    def left_out(self, lines: CloudLinearisation) -> float:
        """Scale of the registration by a jackknife, at a linearisation."""
        fitting = [T for R, t in self.poses_of_clouds(lines) for T in unstack(R, t)]
        moved = replace(lines, predicted=tuple(fitting))
        return jackknife_scale(self.state.problem, self.extrinsics(), self.states, moved)

    def estimate_scale(self, shapes: _Shapes, lines: CloudLinearisation) -> None:
        """Estimates the scale of the registration at a linearisation."""
        state, clouds = self.state, shapes.joint(1.0)
        contradicted = fit_scale(state.problem, lines, clouds, state.values, state.noise)
        state.scale = max(1.0, contradicted, state.least_scale)

    def estimate_bias(self, shapes: _Shapes, lines: CloudLinearisation) -> None:
        """Estimates the sigmas of the biases at a linearisation."""
        reduced = self._reduced(shapes.joint(self.state.scale), lines)
        self.state.bias_sizes = fit_bias_sizes(
            reduced,
            shapes.biases,
            reduced.in_tangents(self.prior),
            self.state.config.noise.lidar_range_bias_m,
        )

    def _reduced(self, clouds: tuple[Array, Array], lines: CloudLinearisation) -> Reduced:
        return reduce_to_extrinsics(self.state.problem, self.state.values, self.base, clouds, lines)

    def linearised(
        self, shapes: _Shapes, lines: CloudLinearisation, directions: Array | None = None
    ) -> Reduced:
        """The graph with the clouds' quadratic; what moves them along `directions` eliminated.

        None: these are worked out.
        """
        joint = shapes.joint(self.state.scale)
        directions = self.directions(shapes, lines) if directions is None else directions
        return self._reduced(without_bias(*joint, directions, self._applied(directions)), lines)

    def _sizes(self) -> BiasSizes:
        """Sizes of the biases, at most those of LiDARs: larger ones would hide a wrong clock."""
        sizes, stated_m = self.state.bias_sizes, self.state.config.noise.lidar_range_bias_m
        most_m = max(RANGE_BIAS_LIMIT_M, stated_m or 0.0)
        return replace(sizes, offset_m=min(sizes.offset_m, most_m))

    def directions(self, shapes: _Shapes, lines: CloudLinearisation) -> Array:
        """(6 J, B) by biases of ranges, by channels, and by turns of the gyroscope since stamps.

        And the motion that the clouds do not tell, once it is known.
        """
        biases = shapes.biases.directions(self._sizes())
        channels = self.channels.directions(self.states, shapes.poses, self.channel_sizes)
        turned = turned_clouds(self.state.problem, lines)
        loose = [] if self.loose is None else [self.loose]
        return np.hstack([biases, channels, turned, *loose])

    def _applied(self, directions: Array) -> Array:
        """(B,) the offsets in sigmas, of all biases along `directions`."""
        out = np.zeros(directions.shape[1])
        out[: len(self.offsets_m)] = self.offsets_m / self._sizes().offset_m
        if self.loose is not None:
            out[-1] = self.loose_pull
        return out

    def _follow(self, shapes: _Shapes, reduced: Reduced, step: Array, directions: Array) -> None:
        """Moves the offsets to their most likely values after a step."""
        joint, applied = shapes.joint(self.state.scale), self._applied(directions)
        found = most_likely_biases(*joint, directions, applied, reduced.moved_clouds(step))
        self.offsets_m = self._sizes().offset_m * found[: len(self.offsets_m)]

    def iterate(self, number: int) -> Iteration:
        """One iteration: E-step, graph solve, new shape, new weights; the number in its round."""
        state = self.state
        shapes, lines = self.expected()
        begun = time.perf_counter()
        if all(shape.finest for shape in self.states):
            if self.fine % SCALED_EVERY == 0:
                self.estimate_scale(shapes, lines)
            self.fine += 1
            self.fine_since += 1
            if self.fine == BIAS_AFTER:
                self.estimate_bias(shapes, lines)
        directions = self.directions(shapes, lines)
        reduced = self.linearised(shapes, lines, directions)
        step, lost = self._step(reduced, number)
        squared = self._squares(shapes, lines, directions)
        if self.fine >= BIAS_AFTER:
            self._follow(shapes, reduced, step, directions)
        state.values = reduced.move(step)
        state.graph_seconds += time.perf_counter() - begun
        new = linearise_clouds(state.problem, state.values)
        for shape, (R, t) in zip(self.states, self.poses_of_clouds(new), strict=True):
            shape.maximise(R, t)
        change = self._weigh(squared)
        size = np.abs(step.reshape(-1, 6))
        information = reduced.D + self.prior
        sigmas = float(np.sqrt(step @ information @ step))
        turn_rad, shift_m = float(size[:, :3].max()), float(size[:, 3:].max())
        return Iteration(turn_rad, shift_m, sigmas, change, lost, self._way_sigmas(information))

    def _way_sigmas(self, information: Array) -> float:
        """`Iteration.way_sigmas`, by an information (6n, 6n) on the extrinsics."""
        self.ends.append(self.extrinsics())
        way = _way_of(self.ends)
        return 0.0 if way is None else float(np.sqrt(way @ information @ way))

    def _find_loose(self, shapes: _Shapes, lines: CloudLinearisation, reduced: Reduced) -> bool:
        """Whether there is a motion that the clouds do not tell, which is `loose` from then on.

        What the clouds hold along the way that the loop has come is measured: by the force that is
        left once the shapes have followed a motion by 1 sigma.
        """
        way, information = _way_of(self.ends), reduced.D + self.prior
        # While shapes are coarse, all goes a long way.
        if way is None or self.fine_since <= WAY:
            return False
        if way @ information @ way < LOOSE_WAY_SIGMAS**2:
            return False
        step = way / np.sqrt(way @ information @ way)
        still = np.zeros_like(step)
        here, there = (self._pull_of_shapes(reduced.move(to)) for to in (still, step))
        held = float(step @ (here - there) + step @ self.prior @ step)
        if held > MOSTLY_HELD:
            return False
        motion = reduced.moved_clouds(step) - reduced.moved_clouds(still)
        others = self.directions(shapes, lines)
        low, high = np.log(LOOSE_SIGMAS)
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            self.loose = np.exp(middle) * motion[:, None]
            # The clouds pull as they did: at the end of EM their gradient is the right one.
            self.loose_pull = float(self.loose[:, 0] @ reduced.clouds[1])
            found = self.linearised(shapes, lines, np.hstack([others, self.loose]))
            left = step @ (found.D + self.prior) @ step
            low, high = (middle, high) if left > max(held, 0.0) else (low, middle)
        return True

    def _pull_of_shapes(self, values: gtsam.Values) -> Array:
        """(6n,) right-hand side `Reduced.c` at values that the shapes have followed."""
        state, now = self.state, self.state.values
        shapes = [copy(shape) for shape in self.states]
        lines = linearise_clouds(state.problem, values)
        poses = self.poses_of_clouds(lines)
        for _ in range(FOLLOWING):
            for shape, (R, t) in zip(shapes, poses, strict=True):
                shape.expect(R, t)
                shape.maximise(R, t)
        state.values = values
        try:
            return self.linearised(_expect(shapes, poses, state.turns, self.ranges), lines).c
        finally:
            state.values = now

    def _step(self, reduced: Reduced, number: int) -> tuple[Array, int | None]:
        """The step (6n,) of the extrinsics; and in mode `auto` the undetermined directions."""
        step, lost = step_of_mode(self.state, reduced, self.undetermined)
        if number >= DECIDED_AFTER:
            self.undetermined = lost
        return step, lost

    def _squares(self, shapes: _Shapes, lines: CloudLinearisation, directions: Array) -> Array:
        """(J,) squared residuals of the clouds, to weigh them by.

        Errors along `directions` are errors of each, too: what the graph leaves to them is no sign
        of a cloud that lies wrong. Not the offsets of the ranges: clouds are moved back with these.
        """
        state = self.state
        pull, information = _single_clouds(state, shapes)
        views = np.concatenate([shape.view_weights for shape in self.states])
        by = directions[:, len(self.offsets_m) :].reshape(len(views), 6, -1)
        cov = np.linalg.inv(information / views[:, None, None]) + by @ np.swapaxes(by, 1, 2)
        single = np.asarray(np.linalg.inv(cov), np.float64)
        return squares_without_own_pose(
            state.problem, lines, -pull, single, state.values, state.noise
        )

    def _weigh(self, squared: Array) -> float:
        """Updates the robust weights; their largest change."""
        state, change = self.state, 0.0
        if state.weights.kernel.in_joint_loop:
            explained = np.concatenate(
                [explained_part(shape.inlier_ratio) for shape in self.states]
            )
            change = state.weights.update(squared, explained)
        _hand_weights(state, self.states)
        return change

    def has_converged(self, last: Iteration) -> bool:
        """Whether the loop may end after an iteration."""
        return bool(
            self.fine > BIAS_AFTER
            and all(s.settled for s in self.states)
            and (_is_small(last) or last.sigmas < STEP_SIGMAS)
            and last.weight_change < 10.0 * WEIGHT_TOLERANCE
        )


def _way_of(ends: Sequence[Sequence[gtsam.Pose3]]) -> Array | None:
    """(6n,) how far extrinsics have come in their last `WAY` iterations; None: too few."""
    if len(ends) <= WAY:
        return None
    both = zip(ends[-1], ends[-1 - WAY], strict=True)
    return np.concatenate([vehicle_axes_difference(T, T0) for T, T0 in both])


def _expect(
    states: Sequence[JointRegistration],
    poses: list[tuple[Array, Array]],
    turns: Sequence[Symmetry | None],
    ranges: Sequence[OwnRanges],
) -> _Shapes:
    """E-step of every placement at the poses that the graph predicts, those of `per_placement`."""
    quadratics = [state.expect(R, t) for state, (R, t) in zip(states, poses, strict=True)]
    fitted = [
        None if turn is None else refit(turn, state.mixture)
        for turn, state in zip(turns, states, strict=True)
    ]
    biases = range_biases(states, poses, quadratics, ranges)
    return _Shapes(poses, quadratics, fitted, biases)


def per_placement(problem: Problem, lines: CloudLinearisation) -> list[tuple[Array, Array]]:
    """The predicted poses of the clouds, per placement (J, 3, 3) and (J, 3), target frame."""
    return [stack(lines.predicted[own]) for own in problem.clouds_of_placements()]


def _hand_weights(state: SolveState, states: Sequence[JointRegistration]) -> None:
    """Gives every placement the robust weights of its clouds."""
    for own, shape in zip(state.problem.clouds_of_placements(), states, strict=True):
        shape.weights = state.weights.values[own]


@dataclass
class _Shapes:
    """The clouds' quadratic over all placements at one set of poses, and the biases there."""

    poses: list[tuple[Array, Array]]
    quadratics: list[ShapeQuadratic]
    turns: list[Symmetry | None]
    biases: RangeBiases

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
            out.append((H, gradient) if turn is None else marginalise_symmetry(H, gradient, turn))
        return out

    @cached_property
    def single(self) -> tuple[Array, Array]:
        """(J, 6, 6) and (J, 6): each cloud by itself, given the shape."""
        blocks, gradients = [], []
        for quadratic, turn in zip(self.quadratics, self.turns, strict=True):
            for H, gradient in zip(quadratic.blocks, quadratic.gradient, strict=True):
                if turn is not None:
                    H, gradient = marginalise_symmetry(H, gradient, turn)
                blocks.append(H)
                gradients.append(gradient)
        return np.array(blocks), np.array(gradients)


def _single_clouds(state: SolveState, shapes: _Shapes) -> tuple[Array, Array]:
    """The pose of each cloud by itself, given the shape: the quadratic as pose factors.

    (J, 6) left perturbations from the predicted poses; (J, 6, 6) information, no robust weights.
    """
    weights = state.weights.values
    blocks, gradient = shapes.single
    information = blocks / weights[:, None, None] / state.scale**2
    # A small ridge: a cloud that sees one plane of the target has a singular block.
    ridge = 1e-9 * np.trace(information, axis1=1, axis2=2) + 1e-9
    information = information + ridge[:, None, None] * np.eye(6)
    force = gradient / weights[:, None] / state.scale**2
    return -np.linalg.solve(information, force[..., None])[..., 0], information


def _refined_solution(loop: _Loop, last: Iteration, iterations: int, converged: bool) -> Solution:
    """Reads covariance, residuals and registrations off the last estimate."""
    state, problem = loop.state, loop.state.problem
    shapes, reduced = loop.at_the_end()
    begun = time.perf_counter()
    cov = covariance_of_mode(state, reduced, loop.undetermined)
    pull, information = _single_clouds(state, shapes)
    # The robust weights of the clouds are kept apart from their information.
    weighted = shapes.single[0]
    last_step = (last.turn_rad, last.shift_m)
    registrations = []
    placements = problem.clouds_of_placements()
    # Where the LiDARs are, not where their clouds fit.
    predicted = per_placement(problem, reduced.lines)
    for part, shape, (R, t), (H, _) in zip(
        placements, loop.states, predicted, shapes.joints, strict=True
    ):
        R, t = left_step(R, t, pull[part])
        blocks = information[part] * state.scale**2
        joint = H + block_diag(*(blocks - weighted[part]))
        registrations.append(shape.result(R, t, blocks, joint, iterations, converged, last_step))
    state.graph_seconds += time.perf_counter() - begun
    return packed_solution(
        state,
        registrations,
        reduced,
        information,
        reduced.D,
        cov,
        held=(),
        iterations=iterations,
        converged=converged,
        time_offsets=reduced.time_offsets(problem, cov),
    )
