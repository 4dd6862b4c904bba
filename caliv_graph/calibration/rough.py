"""The rough solve: registration from the initial guesses, and the graph of registered clouds.

It brings the extrinsics near enough to read the information off (`workflows.survey`) and to
register again from (`calibration.estimate`). Clouds that the edge of the field of view cuts off
take part from there on.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress

import gtsam
import numpy as np

from caliv_graph.calibration.problem import Problem
from caliv_graph.calibration.solve import (
    OFFSET_DETERMINED_S,
    SolveState,
    offset_sigmas,
    solve_registered,
)
from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config
from caliv_graph.products import GroundObservation, Registration, TargetObservation
from caliv_graph.registration.register import JointRegistration, register_jointly
from caliv_graph.registration.self_comparison import views_of
from caliv_graph.registration.symmetry import Symmetry, alarming, alarming_orders, symmetries
from caliv_graph.wording.offsets import undetermined_offset_sentences
from caliv_graph.wording.symmetries import symmetry_sentence


@dataclass(frozen=True)
class RoughSolve:
    """The outcome of the rough solve.

    Attributes:
        state: the solved graph; its problem has
            the clouds that took part.
        registrations: of those clouds, a placement each.
        offsets_s: LiDAR -> 1 sigma in seconds of each time offset that was asked for.
        symmetric: a warning for each symmetric target.
        registration_s: seconds that the registration took.
        graph_s: seconds that the graph took.
    """

    state: SolveState
    registrations: tuple[Registration, ...]
    offsets_s: dict[str, float]
    symmetric: tuple[str, ...]
    registration_s: float
    graph_s: float

    @property
    def warnings(self) -> tuple[str, ...]:
        """Time offsets that the drive does not determine, and symmetric targets."""
        offsets = undetermined_offset_sentences(self.offsets_s, OFFSET_DETERMINED_S)
        return (*offsets, *self.symmetric)


def rough_solve(
    problem: Problem,
    observations: Sequence[TargetObservation],
    grounds: tuple[GroundObservation, ...],
    config: Config,
    progress: Progress,
    iterations: int,
    look_for_symmetries: bool = False,
) -> RoughSolve:
    """Registers the clouds from the initial guesses and solves the graph.

    Args:
        problem: what takes part.
        observations: clouds of its placements, in order.
        grounds: the ground as the LiDARs saw it.
        config: kernels, noise, ground.
        progress: reports every stage.
        iterations: of each registration at most.
        look_for_symmetries: marginalise what a target that looks the same after a rotation cannot
            determine.

    Raises:
        RegistrationError, SolveError: it could not be done.
    """
    begun = time.perf_counter()
    problem, observations = roughly_used(problem, observations, config.extraction.min_scans)
    registrations = []
    with progress.stage("registering the clouds", len(observations)) as advance:
        for m, observation in enumerate(observations):
            state = JointRegistration(observation, config, rough=True, views=problem.views_of(m))
            registrations.append(register_jointly(state, prealigned(problem, m), iterations))
            advance()
    registration_s = time.perf_counter() - begun
    with progress.stage("solving the graph", None):
        found, alike = (
            symmetries_of_targets(registrations, config) if look_for_symmetries else ((), ())
        )
        solve = solve_registered(problem, registrations, grounds, config, found)
        graph_s = solve.graph_seconds
        offsets_s = offset_sigmas(solve, registrations)
    return RoughSolve(solve, tuple(registrations), offsets_s, alike, registration_s, graph_s)


def roughly_used(
    problem: Problem, observations: Sequence[TargetObservation], fewest: int
) -> tuple[Problem, list[TargetObservation]]:
    """Problem and observations with whole clouds only, of LiDARs that have at least `fewest`.

    A cloud that the edge of the field of view cuts off may be registered to a wrong place while the
    guesses are all that is known. All poses stay: once the graph is solved, it predicts where those
    clouds are.
    """
    kept: list[bool] = []
    out = []
    for observation in observations:
        whole = Counter(cloud.lidar for cloud in observation.clouds if not cloud.cut)
        used = [not cloud.cut or whole[cloud.lidar] < fewest for cloud in observation.clouds]
        out.append(replace(observation, clouds=tuple(compress(observation.clouds, used))))
        kept += used
    if all(kept):
        return problem, out
    return problem.with_clouds(np.array(kept)), out


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
    """Per placement the continuous symmetry of its target; and a warning for each.

    The rotation of a cloud about a drum comes from noise and from where the beams fell.
    """
    turns: list[Symmetry | None] = []
    warnings = []
    sigma = max(max(lidar.sigma.rpy_rad()) for lidar in config.lidars.values())
    noise_m, orders = config.noise.lidar_range_m, alarming_orders(sigma)
    for registration in registrations:
        found = symmetries(registration.mixture, views_of(registration), noise_m, orders)
        turns.append(next((s for s in found if s.continuous and s.upright), None))
        warnings += [
            symmetry_sentence(s, registration.observation.name, sigma)
            for s in found
            if alarming(s, sigma)
        ]
    return tuple(turns), tuple(warnings)
