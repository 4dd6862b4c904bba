"""What a recorded drive shows with a config, as far as it can be seen."""

from __future__ import annotations

import math
from dataclasses import dataclass

from threadpoolctl import threadpool_limits

from caliv_graph.calibration.choose import displaced_or_misguessed
from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config
from caliv_graph.errors import CalivError, TargetError
from caliv_graph.mounting.place import place_lidars
from caliv_graph.physics import (
    check_clouds,
    heading_findings,
    raw_findings,
    smoothed_findings,
)
from caliv_graph.pipeline.preparation import completed_motions, targets_of
from caliv_graph.products import (
    Finding,
    Recording,
    TargetObservation,
)
from caliv_graph.trajectory.select import VehicleTrajectory, smooth_trajectories
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.wording.inspection import heading_left_sentence
from caliv_graph.wording.mounting import placement_sentence


@dataclass(frozen=True)
class Look:
    """What a recorded drive shows with a config, as far as it can be seen.

    Attributes:
        observations: the targets' clouds; None if the search stopped.
        findings: values of the config that the raw data contradict, the heading included.
        problems: what stopped the search, a sentence each.
        notes: where LiDARs without an initial guess were found, and what motion data leave to
            walls, a sentence each.
        trajectory: of the vehicle; None if it could not be smoothed.
        config: with the mountings that were found; None if none was looked for.
    """

    observations: tuple[TargetObservation, ...] | None
    findings: tuple[Finding, ...]
    problems: tuple[str, ...]
    notes: tuple[str, ...] = ()
    trajectory: VehicleTrajectory | None = None
    config: Config | None = None


def look(recording: Recording, config: Config, progress: Progress) -> Look:
    """The checks of `prepare`, and the search for the target, of one drive; raises no CalivError.

    Clouds that are read for the first time here may be damaged: that is a problem like the others.
    """
    # As in `pipeline.run.calibrate`: threads for small matrices cost ten times the time.
    with threadpool_limits(limits=1):
        return _look(recording, config, progress)


def _look(recording: Recording, config: Config, progress: Progress) -> Look:
    """See `look`."""
    findings: tuple[Finding, ...] = ()
    problems: list[str] = []
    notes: tuple[str, ...] = ()
    trajectory: VehicleTrajectory | None = None
    observations: tuple[TargetObservation, ...] | None = None
    try:
        check_clouds([recording], config)
    except CalivError as error:
        problems.append(str(error))
    try:
        motions, config, notes = completed_motions(
            [recording], config, {0: recording.motion()}, progress
        )
        findings = raw = raw_findings(motions, config)
        if any(found.severity == "fatal" for found in findings):
            return Look(None, findings, tuple(problems), notes)
        trajectories = smooth_trajectories([recording], config, [[]], motions, by_walls=True)
        (trajectory,) = trajectories
        notes += _on_heading(recording.name, trajectory)
        config, placements = place_lidars([recording], trajectories, config, progress)
        notes += tuple(map(placement_sentence, placements))
        findings += smoothed_findings([recording], trajectories, motions, config, progress)
        findings += heading_findings(trajectories, motions, config, raw)
        near, misplaced, observations = targets_of([recording], trajectories, config, progress)
        kept = [name for name in near.lidars if near.lidars[name] is config.lidars[name]]
        said = displaced_or_misguessed(observations, trajectories, near, kept)
        problems += (*misplaced, *said)
    except CalivError as error:
        problems.append(error.what if findings and isinstance(error, TargetError) else str(error))
        observations = None
    return Look(observations, findings, tuple(problems), notes, trajectory, config)


def _on_heading(name: str, trajectory: VehicleTrajectory) -> tuple[str, ...]:
    """A sentence on a heading that is refused where no walls tell it."""
    if not isinstance(trajectory, SmoothedTrajectory) or not trajectory.heading_is_wide:
        return ()
    return (heading_left_sentence(name, math.degrees(trajectory.heading_sigma_rad)),)
