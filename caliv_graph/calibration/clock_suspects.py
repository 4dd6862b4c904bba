"""The value of a LiDAR's clock that leads the ranking, by short solves at moved stamps.

A score is the effect of the first milliseconds. Stamps that are 0.1 s late blur the shape, which
follows them, and the linear change is half of the truth. Here some of the clouds are registered and
solved again with their stamps moved by what is known so far (`README.md`, section 19).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from caliv_graph.calibration.choose import late_stamps
from caliv_graph.calibration.estimate import estimate
from caliv_graph.calibration.score_tests import MIN_CLOUDS
from caliv_graph.calibration.suspects import suspect_scores
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.guesses import configured_guess
from caliv_graph.config.model import Config
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import CalivError
from caliv_graph.products import MotionData, Solution, TargetCloud, TargetObservation
from caliv_graph.targets.cloud.scans import thinned
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.uncertainty.consistency import CONTRADICTION_SIGMAS
from caliv_graph.uncertainty.suspects import Freed, Ranked, Scores

ALL_LIDARS = "lidars.*.time_offset"
"""The candidate whose parameter is one clock for all LiDARs."""

CLOUDS = 24
POINTS = 100
COMPONENTS = 200
"""Clouds of a LiDAR, points of a cloud, and size of the shape. What a sound clock may be off by is
most of the value's sigma, and its share from the noise grows by a few percent."""

SOLVES = 4
"""At most. From the places of the clouds one is usual, from the linear change three."""

SETTLED = 0.5
"""Change over sigma at which the value has converged."""


def is_lidar_clock(name: str) -> bool:
    """Whether a candidate is the clock of one LiDAR or of all."""
    return name.startswith("lidars.") and name.endswith(".time_offset")


def clock_solved_again(
    ranked: Sequence[Ranked],
    solution: Solution,
    trajectories: Sequence[VehicleTrajectory],
    motions: Mapping[int, MotionData],
    config: Config,
    displaced: bool,
) -> tuple[Ranked, ...] | None:
    """The ranking led by a LiDAR's clock, with its value and what is left once it is freed.

    The clock that the ranking begins with; or, of `displaced` targets (`choose.displaced`), the one
    that brings the clouds to one place: half of them may have lost their weight, and contradict
    nothing any more. `trajectories` are one per drive, `motions` by the index of the drive.

    None: no clock is suspect, its solve fails, or it leaves what led before.
    """
    name, late_s = ranked[0].candidate.name, float(ranked[0].freed.change[0])
    whole = [r.observation for r in solution.registrations]
    most = max(whole, key=lambda o: len(o.clouds))
    try:
        if displaced:
            late = late_stamps(most, trajectories[most.clouds[0].drive], config)
            if late:
                name = ALL_LIDARS if len(late) > 1 else f"lidars.{next(iter(late))}.time_offset"
                late_s = float(np.mean(list(late.values())))
        led = next((r for r in ranked if r.candidate.name == name), None)
        if led is None or not is_lidar_clock(name):
            return None
        observations = [_some_clouds(o, solution.lidars) for o in whole]
        solved = _solved(name, late_s, observations, solution, trajectories, motions, config)
    except CalivError:
        return None
    if solved is None:
        return None
    scores, freed = solved
    # The score at stamps that are right says nothing of the clock: its distance from zero does.
    squares = max(led.freed.squares, float(freed.change[0] ** 2 / freed.cov[0, 0]))
    found = replace(led.freed, change=freed.change, cov=freed.cov, squares=squares)
    rest = tuple(_with_first_freed(r, scores, name) for r in ranked if r is not led)
    if led is not ranked[0] and rest[0].sigmas_left > CONTRADICTION_SIGMAS:
        return None
    part = sum(len(o.clouds) for o in observations) / sum(len(o.clouds) for o in whole)
    explains = max(led.explains, 1.0 - _excess_left(scores, name) / part / max(squares, 1.0))
    led = replace(led, freed=found, explains=explains, sigmas_left=found.sigmas)
    return (led, *rest)


def _solved(
    name: str,
    late_s: float,
    observations: Sequence[TargetObservation],
    solution: Solution,
    trajectories: Sequence[VehicleTrajectory],
    motions: Mapping[int, MotionData],
    config: Config,
) -> tuple[Scores, Freed] | None:
    """Gauss-Newton on the lateness from `late_s`, a solve of the graph within each step.

    The scores at the last stamps, and the clock's value with its covariance; None: no convergence.
    """
    lidar = name.removeprefix("lidars.").removesuffix(".time_offset")
    whose = solution.lidars if name == ALL_LIDARS else (lidar,)
    for _ in range(SOLVES):
        moved = _moved(observations, trajectories, whose, late_s)
        scores = _scores_of(moved, trajectories, motions, config)
        if name not in scores.names:
            return None
        freed = scores.freed([scores.index(name)])
        step_s = float(freed.change[0])
        late_s += step_s
        if abs(step_s) < SETTLED * math.sqrt(freed.cov[0, 0]):
            return scores, replace(freed, change=np.array([late_s]))
    return None


def _excess_left(scores: Scores, first: str) -> float:
    """Squares beyond those of noise that all others explain once the first is freed."""
    others = [i for i, name in enumerate(scores.names) if name != first]
    left = scores.freed(others, [scores.index(first)])
    return max(left.squares - left.dof, 0.0)


def _with_first_freed(ranked: Ranked, scores: Scores, first: str) -> Ranked:
    """A candidate with the sigmas that it has where the clock is right."""
    if ranked.candidate.name not in scores.names:
        return ranked
    left = scores.freed([scores.index(ranked.candidate.name)], [scores.index(first)])
    return replace(ranked, sigmas_left=left.sigmas)


def _some_clouds(observation: TargetObservation, lidars: Sequence[str]) -> TargetObservation:
    """Evenly chosen clouds, those that the field of view cuts off only where there are few."""
    kept: list[TargetCloud] = []
    for name in lidars:
        clouds = [c for c in observation.clouds if c.lidar == name]
        whole = [c for c in clouds if not c.cut]
        kept += thinned(whole if len(whole) >= 2 * MIN_CLOUDS else clouds, CLOUDS)
    return replace(observation, clouds=tuple(kept))


def _moved(
    observations: Sequence[TargetObservation],
    trajectories: Sequence[VehicleTrajectory],
    whose: Sequence[str],
    late_s: float,
) -> list[TargetObservation]:
    """The clouds at the times at which they were taken, without those outside a trajectory.

    Their motion compensation is the old one: the velocity changes little in a fraction of a second.
    """
    late_ns = round(late_s * NANOSECONDS_PER_SECOND)
    out = []
    for observation in observations:
        clouds = []
        for cloud in observation.clouds:
            if cloud.lidar in whose:
                cloud = replace(cloud, stamp_ns=cloud.stamp_ns - late_ns, swept=None)
            begin, end = trajectories[cloud.drive].span_ns
            if begin <= cloud.stamp_ns <= end:
                clouds.append(cloud)
        out.append(replace(observation, clouds=tuple(clouds)))
    return out


def _scores_of(
    observations: Sequence[TargetObservation],
    trajectories: Sequence[VehicleTrajectory],
    motions: Mapping[int, MotionData],
    config: Config,
) -> Scores:
    """The suspects after a solve of its own: a small registration, no ground, no slow errors.

    Errors of the sensors that are correlated over time would take up a part of the lateness.
    """
    size = {"components": COMPONENTS, "max_points": POINTS}
    size = {key: min(most, getattr(config.registration, key)) for key, most in size.items()}
    small = config.registration.model_copy(update=size)
    none = {"gnss_correlated_horizontal_m": 0.0, "orientation_correlated_deg": 0.0}
    absent = {key: value for key, value in none.items() if getattr(config.noise, key) is None}
    quick = config.model_copy(
        update={
            "registration": small,
            "noise": config.noise.model_copy(update=absent),
            "solve": config.solve.model_copy(update={"mode": "auto"}),
        }
    )
    stamps = [(c.drive, c.stamp_ns) for o in observations for c in o.clouds]
    again = [
        smooth_trajectory(motions[d], config, [stamp for drive, stamp in stamps if drive == d])
        if isinstance(t, SmoothedTrajectory)
        else t
        for d, t in enumerate(trajectories)
    ]
    solution = estimate(observations, again, quick, SilentProgress())
    guesses = {name: configured_guess(config, name) for name in solution.lidars}
    return suspect_scores(solution, again, guesses)
