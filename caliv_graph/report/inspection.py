"""The content of a recording: clouds, frames, gaps, the drive, and when each LiDAR sees the target.

This file serves CaLiV folders and what bags have in common with them; `bag_inspection` serves bags.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import gtsam
import numpy as np

from caliv_graph.common.progress import Advance, Progress
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import RecordingError, TrajectoryError
from caliv_graph.products import Finding, GivenPoses, Recording, TargetObservation
from caliv_graph.readers.caliv_folder import FRAME_PERIOD_NS
from caliv_graph.wording.inspection import unreadable_sentence

Run = tuple[int, int]
"""First and last frame number of a run, or the frames before and after a gap."""


@dataclass(frozen=True)
class Points:
    """Points per cloud, without NaN, zero returns and points outside the ranges of the config."""

    min: int
    median: int
    max: int


@dataclass(frozen=True)
class LidarSummary:
    """The clouds of one LiDAR.

    Attributes:
        frames: first and last frame number.
        step: usual difference of frame numbers between clouds.
        gaps: frames before and after each larger difference.
        rate_hz: nominal, since the files have no stamps; None with one cloud.
        points: None if no cloud could be read.
    """

    clouds: int
    frames: Run
    step: int
    gaps: tuple[Run, ...]
    rate_hz: float | None
    points: Points | None


@dataclass(frozen=True)
class DriveSummary:
    """The vehicle's motion according to the given poses.

    Attributes:
        duration_s: nominal, from the first pose to the last.
        path_length_m: sum of the distances between poses.
        climb_m: height of the highest pose above the lowest.
        heading_change_deg: sum of all heading changes, positive to the left.
        turned_deg: sum of their absolute values.
    """

    poses: int
    duration_s: float
    path_length_m: float
    climb_m: float
    heading_change_deg: float
    turned_deg: float


@dataclass(frozen=True)
class Sighting:
    """The scans of one LiDAR that see one target.

    Attributes:
        scans: number of scans with enough points on the target.
        frames: first and last frame of each run without a gap; empty for a bag.
        points: points on the target per scan, of the clouds that a calibration would use; None if
            no scan sees the target.
        range_m: minimum and maximum distance of the target from the LiDAR, of the same clouds; None
            if no scan sees the target.
        times_s: for a bag, the runs in seconds from its first record time.
    """

    scans: int
    frames: tuple[Run, ...]
    points: Points | None = None
    range_m: tuple[float, float] | None = None
    times_s: tuple[tuple[float, float], ...] | None = None


@dataclass(frozen=True)
class TargetSummary:
    """One target placement: its approximate centre in the map, and the sightings of every LiDAR."""

    name: str
    centre_map_m: tuple[float, float, float]
    lidars: dict[str, Sighting]


@dataclass(frozen=True)
class Inspection:
    """The content of a recording; `targets` is None if no target was searched.

    Attributes:
        findings: values of the config that the data contradict (`physics`).
        problems: clouds that cannot be read, and why the search for the target stopped, a sentence
            each.
    """

    data: str
    lidars: dict[str, LidarSummary]
    drive: DriveSummary
    targets: tuple[TargetSummary, ...] | None = None
    findings: tuple[Finding, ...] = ()
    problems: tuple[str, ...] = ()

    def document(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)


def inspect_recording(recording: Recording, progress: Progress) -> Inspection:
    """Reads a whole recording once, one cloud at a time.

    Raises:
        TrajectoryError: the recording has no vehicle poses.
    """
    lidars = {}
    problems: list[str] = []
    total = sum(len(recording.scan_stamps_ns(lidar)) for lidar in recording.lidars)
    with progress.stage("reading the clouds", total) as advance:
        for lidar in recording.lidars:
            stamps_ns = recording.scan_stamps_ns(lidar)
            counts, unread = count_points(recording, lidar, stamps_ns, advance)
            problems += unread
            frames = [stamp_ns // FRAME_PERIOD_NS for stamp_ns in stamps_ns]
            lidars[lidar] = _summarise_lidar(frames, counts)
    given = recording.motion().poses
    if given is None:
        raise TrajectoryError(
            f"{recording.name}: has no vehicle poses. Add them to input/ego_poses.yaml"
        )
    return Inspection(
        data=recording.name,
        lidars=lidars,
        drive=summarise_drive(given),
        problems=tuple(problems),
    )


def count_points(
    recording: Recording, lidar: str, stamps_ns: Iterable[int], advance: Advance
) -> tuple[list[int], tuple[str, ...]]:
    """Points of the clouds at some stamps, and a sentence if any cannot be read.

    What cannot be read does not hide the rest of a recording.
    """
    counts: list[int] = []
    errors: list[str] = []
    left = sorted(stamps_ns)
    while left:
        begin_ns = left[0]
        try:
            for scan in recording.scans(lidar, frozenset(left)):
                counts.append(len(scan.points_lidar))
                begin_ns = scan.stamp_ns + 1
                advance()
            break
        except RecordingError as error:
            errors.append(str(error))
            advance()
            # The next cloud is the one that cannot be read.
            left = [stamp_ns for stamp_ns in left if stamp_ns >= begin_ns][1:]
    if not errors:
        return counts, ()
    return counts, (unreadable_sentence(lidar, errors[0], len(errors)),)


def add_targets(inspection: Inspection, observations: Iterable[TargetObservation]) -> Inspection:
    """Adds when each LiDAR sees each target."""

    def frames(lidar: str, stamps_ns: Sequence[int]) -> tuple[Run, ...]:
        numbers = [stamp_ns // FRAME_PERIOD_NS for stamp_ns in stamps_ns]
        return runs_of(numbers, inspection.lidars[lidar].step)

    targets = summarise_targets(
        observations,
        lambda lidar, stamps_ns: Sighting(len(stamps_ns), frames(lidar, stamps_ns)),
        inspection.lidars,
    )
    return replace(inspection, targets=targets)


def summarise_targets(
    observations: Iterable[TargetObservation],
    sighting: Callable[[str, Sequence[int]], Sighting],
    lidars: Iterable[str],
) -> tuple[TargetSummary, ...]:
    """Sightings of every target by every LiDAR.

    `sighting` gives the number and the runs of the scans of a LiDAR at these stamps.
    """
    names = list(lidars)
    out = []
    for observation in observations:
        x, y, z = (float(v) for v in observation.centre_map)
        seen = {}
        for lidar in names:
            clouds = [cloud for cloud in observation.clouds if cloud.lidar == lidar]
            if not clouds:
                seen[lidar] = sighting(lidar, ())
                continue
            # Including the scans that a calibration would not use.
            stamps = {cloud.stamp_ns for cloud in clouds}.union(observation.seen_ns.get(lidar, ()))
            ranges_m = [float(np.linalg.norm(c.points_lidar.mean(axis=0))) for c in clouds]
            seen[lidar] = replace(
                sighting(lidar, sorted(stamps)),
                points=summarise_points([len(cloud.points_lidar) for cloud in clouds]),
                range_m=(min(ranges_m), max(ranges_m)),
            )
        out.append(TargetSummary(observation.name, (x, y, z), seen))
    return tuple(out)


def _summarise_lidar(frames: Sequence[int], counts: Sequence[int]) -> LidarSummary:
    steps = np.diff(frames)
    # The lower median: it is one of the steps, which the mean of two need not be.
    step = int(np.sort(steps)[(len(steps) - 1) // 2]) if len(steps) else 1
    gaps = [
        (before, after) for before, after in itertools.pairwise(frames) if after - before > step
    ]
    rate_hz = NANOSECONDS_PER_SECOND / (step * FRAME_PERIOD_NS) if len(steps) else None
    return LidarSummary(
        clouds=len(frames),
        frames=(frames[0], frames[-1]),
        step=step,
        gaps=tuple(gaps),
        rate_hz=rate_hz,
        points=summarise_points(counts) if counts else None,
    )


def summarise_drive(given: GivenPoses) -> DriveSummary:
    """The vehicle's motion according to at least one given pose."""
    poses = given.T_map_vehicle
    positions_map = np.array([pose.translation() for pose in poses])
    turns = [
        gtsam.Rot3.rpy(before.rotation().between(after.rotation()))[2]
        for before, after in itertools.pairwise(poses)
    ]
    steps_m = np.linalg.norm(np.diff(positions_map, axis=0), axis=1)
    return DriveSummary(
        poses=len(poses),
        duration_s=float(given.stamps_ns[-1] - given.stamps_ns[0]) / NANOSECONDS_PER_SECOND,
        path_length_m=float(steps_m.sum()),
        climb_m=float(np.ptp(positions_map[:, 2])),
        heading_change_deg=math.degrees(float(np.sum(turns))),
        turned_deg=math.degrees(float(np.sum(np.abs(turns)))),
    )


def runs_of(values: Sequence[int], step: int) -> tuple[Run, ...]:
    """First and last value of each run of ascending values with steps of at most `step`."""
    runs: list[Run] = []
    for value in values:
        if runs and value - runs[-1][1] <= step:
            runs[-1] = (runs[-1][0], value)
        else:
            runs.append((value, value))
    return tuple(runs)


def summarise_points(counts: Sequence[int]) -> Points:
    """Minimum, median and maximum number of points."""
    return Points(min=min(counts), median=int(np.median(counts)), max=max(counts))
