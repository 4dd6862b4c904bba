"""The calibration of drives without a target: structure and ground, by `auto` or `joint`.

There are no clouds, and so no shape, no registration and no robust weights of clouds: the graph is
reduced to the extrinsics and solved by Gauss-Newton steps.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from caliv_graph.calibration.clock_prior import has_clock, under_clock_prior
from caliv_graph.calibration.graph import initial_values, motion_graph
from caliv_graph.calibration.ground import drives_with_planes, ground_values
from caliv_graph.calibration.ground_floors import with_floors
from caliv_graph.calibration.ground_scatter import (
    FURTHER_SOLVES,
    GroundLevels,
    asked_levels,
    failed_sentence,
    scattering_more,
    unsettled_sentence,
)
from caliv_graph.calibration.ground_weights import ground_weights
from caliv_graph.calibration.linear import CloudLinearisation
from caliv_graph.calibration.noise import first_pose_noise
from caliv_graph.calibration.pack import packed_solution
from caliv_graph.calibration.problem import Problem, pose_problem
from caliv_graph.calibration.reduced import Reduced, reduce_to_extrinsics
from caliv_graph.calibration.robust import RobustWeights
from caliv_graph.calibration.sensor_noise import SensorNoise, usual_noise
from caliv_graph.calibration.solve import (
    COUPLED_SIGMAS,
    COUPLED_STEPS,
    OFFSET_DETERMINED_S,
    WEIGHT_TOLERANCE,
    SolveState,
    base_graph,
    covariance_of_mode,
    reduced_offset_sigmas,
    step_of_mode,
)
from caliv_graph.calibration.structure import (
    lidars_with_structure,
    nearest_extrinsics,
    structure_graph,
)
from caliv_graph.calibration.structure_evidence import (
    NOTHING_TOLD,
    StructureEvidence,
    ToldErrors,
    kept_stamps,
    other_grounds,
)
from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config
from caliv_graph.errors import SolveError, TargetError
from caliv_graph.products import (
    Array,
    GroundObservation,
    Iteration,
    PoseNoise,
    Solution,
    StructureTerm,
)
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.wording.offsets import undetermined_offset_sentences

DECIDED_AFTER = 4
"""Step from which the number of undetermined directions is fixed, so that a direction at the
threshold does not make the estimate jump for ever: the terms are quadratic, and three steps are
usual."""


@dataclass
class StructureSolve:
    """A graph of structure and ground, solved.

    Attributes:
        state: the solved graph.
        reduced: linearised there.
        offsets_s: LiDAR -> 1 sigma in seconds of each time offset that was asked for.
        course: the steps.
        undetermined: number of undetermined directions, mode `auto`, once it was fixed.
        converged: whether the last step was small.
        noise: heave and waves of the ground.
        times_s: seconds per stage.
        left: a warning, if this one asked for another solve that failed or was one too many.
    """

    state: SolveState
    reduced: Reduced
    offsets_s: dict[str, float]
    course: tuple[Iteration, ...]
    undetermined: int | None
    converged: bool
    noise: SensorNoise
    times_s: dict[str, float]
    left: tuple[str, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Of time offsets that stay undetermined, of the structure, and of the ground."""
        offsets = undetermined_offset_sentences(self.offsets_s, OFFSET_DETERMINED_S)
        of_terms = (line for term in self.state.structure for line in term.warnings)
        levels = GroundLevels.of(self.state.problem)
        return (*offsets, *of_terms, *self.left, *levels.beyond_ground)


def solve_structure_and_ground(
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    progress: Progress,
    grounds: tuple[GroundObservation, ...],
    structure: StructureEvidence,
    noise: SensorNoise | None = None,
    told: ToldErrors = NOTHING_TOLD,
    pose_noise: PoseNoise | None = None,
) -> StructureSolve:
    """Solves for the extrinsics by structure and ground.

    Args:
        trajectories: one per drive, with nodes at the scans of the structure.
        config: guesses, mode, noise, ground.
        progress: reports every stage.
        grounds: the ground at the poses of `kept_stamps`.
        structure: the patches.
        noise: of the drives; None: the usual figures.
        told: what a rough solve of the structure said of the sensors' errors.
        pose_noise: of given poses; None: the usual figures.

    Raises:
        TargetError: structure says nothing, or the mode is the paper's, which needs a target.
        SolveError: it could not be solved.
    """
    if config.solve.mode == "staged":
        raise TargetError("solve.mode staged needs a target", "Set it to auto or joint")
    noise = noise or usual_noise(config.noise)
    pose_noise = pose_noise or first_pose_noise(config.noise)
    guesses = {name: lidar.guess() for name, lidar in config.lidars.items()}
    start = told.T_vehicle_lidar or guesses

    def terms_at(heave_m: float) -> tuple[StructureTerm, ...]:
        begun = time.perf_counter()
        with progress.stage("solving walls and other surfaces", None):
            found = structure.terms(
                trajectories,
                kept_stamps(structure.patches),
                start,
                {},
                heave_m,
                pose_noise,
                config,
                aligned=told.aligned,
            )
        times["structure"] = times.get("structure", 0.0) + time.perf_counter() - begun
        return found

    times: dict[str, float] = {}
    terms = terms_at(noise.heave_m)
    solved = _solved(trajectories, config, progress, grounds, terms, noise, pose_noise, times)
    for number in range(FURTHER_SOLVES + 1):
        levels, asked = GroundLevels.of(solved.state.problem), asked_levels(solved.state)
        if asked == levels:
            break
        if number == FURTHER_SOLVES:
            return replace(solved, left=(unsettled_sentence(scattering_more(levels, asked)),))
        before, noise = noise, noise.with_ground_levels(asked)
        # About the guesses: planes that scatter may have led far from them.
        grounds = with_floors(grounds, trajectories, start, before.floors, noise.floors)
        try:
            if noise.heave_m != before.heave_m:
                terms = terms_at(noise.heave_m)
            solved = _solved(
                trajectories, config, progress, grounds, terms, noise, pose_noise, times
            )
        except (SolveError, TargetError) as error:
            return replace(solved, left=(failed_sentence(error.what),))
    return solved


def _solved(
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    progress: Progress,
    grounds: tuple[GroundObservation, ...],
    terms: tuple[StructureTerm, ...],
    noise: SensorNoise,
    pose_noise: PoseNoise,
    times: dict[str, float],
) -> StructureSolve:
    """Solves the graph of some terms of structure and the ground; `times` are added to.

    Raises:
        TargetError: there is no term.
        SolveError: it could not be solved.
    """
    others = lidars_with_structure(terms)
    if not others:
        raise TargetError(
            "the LiDARs see neither a target nor structure that stands still, such as walls",
            "Drive past walls or a chair within 20 m, and check topics and guesses with "
            "'caliv-graph inspect --html'",
        )
    begun = time.perf_counter()
    stamps = {term.drive: term.stamps_ns for term in terms}
    problem = pose_problem([], trajectories, config, noise, others, stamps)
    with progress.stage("solving the graph", COUPLED_STEPS) as advance:
        loop = _Loop(problem, terms, other_grounds(grounds, terms), config, pose_noise)
        loop.solve(advance)
        if has_clock(problem):
            loop.again(under_clock_prior(loop.state, loop.reduced, loop.undetermined), advance)
            problem = loop.state.problem
        offsets_s = reduced_offset_sigmas(problem, loop.reduced)
    times["graph"] = times.get("graph", 0.0) + time.perf_counter() - begun
    return StructureSolve(
        loop.state,
        loop.reduced,
        offsets_s,
        tuple(loop.course),
        loop.undetermined,
        loop.converged,
        noise,
        times,
    )


def solution_without_target(solved: StructureSolve) -> Solution:
    """Packs the estimate of a solve, its covariance by the mode."""
    state, reduced = solved.state, solved.reduced
    cov = covariance_of_mode(state, reduced, solved.undetermined)
    packed = packed_solution(
        state,
        (),
        reduced,
        np.zeros((0, 6, 6)),
        reduced.D,
        cov,
        held=(),
        iterations=len(solved.course),
        converged=solved.converged,
        time_offsets=reduced.time_offsets(state.problem, cov),
    )
    return replace(
        packed,
        course=solved.course,
        stage_times_s=solved.times_s,
        warnings=solved.warnings,
        sensor_noise=solved.noise.levels,
    )


class _Loop:
    """Gauss-Newton steps of the reduced graph."""

    def __init__(
        self,
        problem: Problem,
        terms: tuple[StructureTerm, ...],
        grounds: tuple[GroundObservation, ...],
        config: Config,
        pose_noise: PoseNoise,
    ) -> None:
        """At the extrinsics of the terms."""
        start = nearest_extrinsics({}, terms)
        self.state = SolveState(
            problem=problem,
            config=config,
            values=initial_values(problem, [], start),
            noise=pose_noise,
            scale=1.0,
            weights=RobustWeights(config.robust, 0),
            motion=motion_graph(problem),
            sound=np.ones(0, dtype=bool),
            grounds=grounds,
            structure=terms,
            structure_factors=structure_graph(
                problem, terms, start, drives_with_planes(problem, grounds, config.ground)
            ),
        )
        state = self.state
        state.values.insert(ground_values(problem, grounds, state.values, config.ground))
        self.course: list[Iteration] = []
        self.undetermined: int | None = None
        self.converged = False
        self.reduced = self._linearised()

    def solve(self, advance: Callable[..., None]) -> None:
        """Steps until one is small, `COUPLED_STEPS` at most."""
        state = self.state
        prior = state.problem.guess_information()
        while len(self.course) < COUPLED_STEPS and not self.converged:
            step, lost = step_of_mode(state, self.reduced, self.undetermined)
            if len(self.course) + 1 >= DECIDED_AFTER:
                self.undetermined = lost
            sigmas = float(np.sqrt(step @ (self.reduced.D + prior) @ step))
            state.values = self.reduced.move(step)
            change = self._weigh()
            self.reduced = self._linearised()
            size = np.abs(step.reshape(-1, 6))
            self.course.append(
                Iteration(float(size[:, :3].max()), float(size[:, 3:].max()), sigmas, change, lost)
            )
            self.converged = sigmas < COUPLED_SIGMAS and change < WEIGHT_TOLERANCE
            advance()

    def again(self, state: SolveState, advance: Callable[..., None]) -> None:
        """The same of another state at the same values."""
        self.state, self.converged = state, False
        self.reduced = self._linearised()
        self.solve(advance)

    def _weigh(self) -> float:
        """New weights of the ground; their largest change."""
        state = self.state
        if not state.grounds:
            return 0.0
        before = state.ground_weights
        state.ground_weights = ground_weights(state.problem, state.grounds, state.values)
        if before is None:
            return 1.0
        return float(np.abs(state.ground_weights.planes - before.planes).max())

    def _linearised(self) -> Reduced:
        nothing: tuple[Array, Array] = np.zeros((0, 0)), np.zeros(0)
        lines = CloudLinearisation((), (), ())
        state = self.state
        return reduce_to_extrinsics(state.problem, state.values, base_graph(state), nothing, lines)
