"""Usual mistakes of a config, where a LiDAR sees no target or its guess is contradicted."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config
from caliv_graph.mounting.doubts import Doubt, doubts
from caliv_graph.physics import heading_findings
from caliv_graph.products import Finding, MotionData, Recording, TargetObservation
from caliv_graph.trajectory.select import VehicleTrajectory


def mistakes(
    recordings: Sequence[Recording],
    trajectories: Sequence[VehicleTrajectory],
    motions: Mapping[int, MotionData],
    config: Config,
    progress: Progress,
    raw: Sequence[Finding],
    observations: Sequence[TargetObservation] = (),
    blamed: Collection[str] = (),
) -> tuple[Doubt, ...]:
    """Mistakes that explain why LiDARs do not see the target, or why guesses are contradicted.

    None if all LiDARs see the target. `blamed` are those whose guess a solve contradicts.

    None either if the raw sensors (`raw`) or the course contradict the attitude of an IMU: a
    trajectory that was smoothed from these is no evidence. `observations` are of the target.

    Raises:
        RecordingError: a cloud could not be read.
        TrajectoryError: times of points are invalid.
    """
    seeing = {cloud.lidar for o in observations for cloud in o.clouds}
    recorded = {n for r in recordings for n in config.lidars if len(r.scan_stamps_ns(n))}
    if not trajectories or recorded <= seeing:
        return ()
    if any(found.input.startswith("imu.") for found in raw):
        return ()
    if heading_findings(trajectories, motions, config, raw):
        return ()
    return doubts(recordings, trajectories, config, progress, blamed)


def without_remedies(
    observations: Sequence[TargetObservation], found: Sequence[Doubt]
) -> tuple[TargetObservation, ...]:
    """The observations, whose warnings about the LiDARs of a mistake give no advice.

    The mistake has its own, and that of a target is to change its region.
    """
    names = [f"lidar '{name}'" for doubt in found for name in doubt.lidars]

    def shortened(warning: str) -> str:
        what, _, _ = warning.rpartition(". ")
        return what if what and any(name in warning for name in names) else warning

    return tuple(replace(o, warnings=tuple(map(shortened, o.warnings))) for o in observations)
