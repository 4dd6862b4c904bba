"""The value of a LiDAR's clock that leads the ranking, by short solves at moved stamps.

A score is the effect of the first milliseconds. Stamps that are 0.1 s late blur the shape, which
follows them, and the linear change is half of the truth. Here some of the clouds are registered and
solved again with their stamps moved by what is known so far (`README.md`, section 18).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from caliv_graph.calibration.choose import late_by_centres
from caliv_graph.calibration.estimate import estimate
from caliv_graph.calibration.guesses import configured_guess
from caliv_graph.calibration.score_tests import MIN_CLOUDS
from caliv_graph.calibration.suspects import suspect_scores
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.model import Config
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import CalivError
from caliv_graph.products import MotionData, Solution, TargetCloud, TargetObservation
from caliv_graph.targets.cloud.scans import thinned
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.uncertainty.suspects import Ranked, Scores

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
) -> tuple[Ranked, ...]:
    """The ranking with the value of its first, a LiDAR's clock, and what is left once it is freed.

    Gauss-Newton on the lateness, a solve of the graph within each step. `trajectories` are one per
    drive, `motions` by the index of the drive. The ranking as it is where no solve succeeds.
    """
    first, *rest = ranked
    name = first.candidate.name
    whose = solution.lidars if name == ALL_LIDARS else (name.split(".")[1],)
    whole = [r.observation for r in solution.registrations]
    observations = [_some_clouds(o, solution.lidars) for o in whole]
    most = max(whole, key=lambda o: len(o.clouds))
    try:
        begun = late_by_centres(most, trajectories[most.clouds[0].drive], config, whose)
        late_s = float(first.freed.change[0]) if begun is None else begun
        for _ in range(SOLVES):
            moved = _moved(observations, trajectories, whose, late_s)
            scores = _scores_of(moved, trajectories, motions, config)
            freed = scores.freed([scores.index(name)])
            late_s += float(freed.change[0])
            if abs(freed.change[0]) < SETTLED * math.sqrt(freed.cov[0, 0]):
                break
        else:
            return tuple(ranked)
    except CalivError:
        return tuple(ranked)
    found = replace(first.freed, change=np.array([late_s]), cov=freed.cov)
    part = sum(len(o.clouds) for o in observations) / sum(len(o.clouds) for o in whole)
    explains = max(first.explains, 1.0 - _excess_left(scores, name) / part / _excess(first))
    led = replace(first, freed=found, explains=explains)
    return (led, *(_with_first_freed(r, scores, name) for r in rest))


def _excess(first: Ranked) -> float:
    """Squares beyond those of noise that freeing all candidates takes off, by the first's part."""
    return (first.freed.squares - first.freed.dof) / first.explains


def _excess_left(scores: Scores, first: str) -> float:
    """The same of all others once the first is freed, at stamps that are right."""
    others = [i for i, c in enumerate(scores.candidates) if c.name != first]
    left = scores.freed(others, [scores.index(first)])
    return max(left.squares - left.dof, 0.0)


def _with_first_freed(ranked: Ranked, scores: Scores, first: str) -> Ranked:
    """A candidate with the sigmas that it has where the clock is right."""
    names = [c.name for c in scores.candidates]
    if ranked.candidate.name not in names:
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
