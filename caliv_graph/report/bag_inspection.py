"""The content of a bag: topics, rates, gaps, clocks, time fields, units, views of the target."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import RecordingError
from caliv_graph.products import Finding, Recording, TargetObservation
from caliv_graph.readers.clock import Clock
from caliv_graph.readers.cloud_folder import CloudFolder
from caliv_graph.readers.imu import ImuCheck
from caliv_graph.readers.rosbag import RosbagRecording
from caliv_graph.report.inspection import (
    DriveSummary,
    Inspection,
    Points,
    Sighting,
    TargetSummary,
    add_targets,
    count_points,
    inspect_recording,
    runs_of,
    summarise_drive,
    summarise_points,
    summarise_targets,
)
from caliv_graph.trajectory.physics import known_rotation
from caliv_graph.wording.physics import gravity_problem

_SAMPLED_CLOUDS = 20
"""Clouds per LiDAR that are decoded, spread over the drive: a bag can hold many thousands."""

_GAPS_SHOWN = 20
"""Gaps listed per topic, the longest ones."""

_RUN_FACTOR = 1.75
"""Largest number of scan intervals between two scans of one run."""


Bagged = RosbagRecording | CloudFolder
"""Recordings with topics and stamps."""


@dataclass(frozen=True)
class TopicSummary:
    """One topic.

    Attributes:
        rate_hz: from the median interval between stamps; of a topic that was not read, the mean
            over the bag; None with fewer than two messages.
        read: whether the topic was read; if not, the attributes below are unknown.
        frame_id: frame in the header of the first message.
        span_s: first and last stamp in seconds from the bag's first record time; None: no message.
        gaps: number of intervals that are too long for the rate.
        longest_gaps_s: (from, to) of the longest gaps in time order, in seconds from the bag's
            first record time.
        header_minus_record_s: (min, median, max); None if no message has a stamp.
        unset: messages without a stamp.
        backwards: messages with a stamp before that of the previous message.
        duplicates: messages with the same stamp as another.
    """

    type: str
    messages: int
    rate_hz: float | None
    read: bool = False
    frame_id: str = ""
    span_s: tuple[float, float] | None = None
    gaps: int = 0
    longest_gaps_s: tuple[tuple[float, float], ...] = ()
    header_minus_record_s: tuple[float, float, float] | None = None
    unset: int = 0
    backwards: int = 0
    duplicates: int = 0


@dataclass(frozen=True)
class PointTimes:
    """The times of a LiDAR's points after the stamp; the unit is that found from the values."""

    field: str
    type: str
    unit: str
    first_s: float
    last_s: float


@dataclass(frozen=True)
class BagLidarSummary:
    """The clouds of one LiDAR.

    Attributes:
        rate_hz: from the median interval; None with fewer than two clouds.
        sampled: number of clouds decoded for the attributes below.
        points: points per cloud, without NaN, zero returns and points outside the ranges; None if
            no cloud could be read.
        times: times of the points; None if there are no valid times.
        times_problem: why the times are not valid; empty: no problem.
        stamp_marks: start or end of the sweep, which the stamps mark.
        stamp_told_by: what tells it: config, times (by their sign), records (the record times),
            nothing (it is assumed); empty: the clouds are of one instant.
        stamp_shift_s: seconds by which the times were shifted for it.
    """

    topic: str
    frame_id: str
    clouds: int
    rate_hz: float | None
    sampled: int
    points: Points | None
    times: PointTimes | None
    times_problem: str
    stamp_marks: str
    stamp_told_by: str
    stamp_shift_s: float


@dataclass(frozen=True)
class ImuSummary:
    """Magnitudes of one IMU, which reveal wrong units.

    Attributes:
        specific_force_m_s2: median of its norm.
        angular_rate_rad_s: 95th percentile of its norm.
        up_imu: unit vector along the mean specific force, imu frame: upwards.
        problems: one sentence per problem.
    """

    specific_force_m_s2: float
    angular_rate_rad_s: float
    up_imu: tuple[float, float, float]
    problems: tuple[str, ...]


@dataclass(frozen=True)
class BagInspection:
    """The content of a bag.

    Attributes:
        gnss_fixes: number of messages with a fix, per GNSS topic that was read.
        drive: the motion according to given poses; None without poses.
        findings: values of the config that the data contradict (`physics`).
        problems: clouds that cannot be read, and why the search for the target stopped, a sentence
            each.
    """

    data: str
    start_ns: int
    duration_s: float
    topics: dict[str, TopicSummary]
    lidars: dict[str, BagLidarSummary]
    imus: dict[str, ImuSummary]
    gnss_fixes: dict[str, int]
    drive: DriveSummary | None
    targets: tuple[TargetSummary, ...] | None = None
    findings: tuple[Finding, ...] = ()
    problems: tuple[str, ...] = ()

    def document(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)


def inspect_any(
    recording: Recording, progress: Progress, config: Config | None = None
) -> Inspection | BagInspection:
    """The content of a recording of any format; `config` says how its IMU is mounted.

    Raises:
        RecordingError: the recording is damaged.
        TrajectoryError: a CaLiV folder has no vehicle poses.
    """
    if isinstance(recording, Bagged):
        return inspect_bag(recording, progress, config)
    return inspect_recording(recording, progress)


def add_any_targets(
    inspection: Inspection | BagInspection, observations: Iterable[TargetObservation]
) -> Inspection | BagInspection:
    """Adds when each LiDAR sees each target."""
    if isinstance(inspection, Inspection):
        return add_targets(inspection, observations)
    lidars, start_ns = inspection.lidars, inspection.start_ns

    def sighting(lidar: str, stamps_ns: Sequence[int]) -> Sighting:
        rate_hz = lidars[lidar].rate_hz
        period_ns = NANOSECONDS_PER_SECOND / rate_hz if rate_hz else 0.0
        if len(stamps_ns) > 2:
            # Not every scan of a long drive is searched for the target.
            period_ns = max(period_ns, float(np.median(np.diff(stamps_ns))))
        runs = runs_of(stamps_ns, round(_RUN_FACTOR * period_ns))
        times_s = tuple(_span_s(run, start_ns) for run in runs)
        return Sighting(len(stamps_ns), frames=(), times_s=times_s)

    targets = summarise_targets(observations, sighting, lidars)
    return replace(inspection, targets=targets)


def inspect_bag(
    recording: Bagged, progress: Progress, config: Config | None = None
) -> BagInspection:
    """Reads a bag once, and some clouds of each LiDAR.

    Raises:
        RecordingError: the bag is damaged.
    """
    start_ns, stop_ns = recording.span_ns
    with progress.stage("reading the stamps", 1) as advance:
        clocks = recording.clocks()
        advance()
    duration_s = (stop_ns - start_ns) / NANOSECONDS_PER_SECOND
    topics = {
        name: _summarise_topic(recording, name, clocks.get(name), start_ns, duration_s)
        for name in recording.topics
    }
    samples = {lidar: _sample(recording, lidar) for lidar in recording.lidars}
    lidars = {}
    problems: list[str] = []
    with progress.stage("reading the clouds", sum(map(len, samples.values()))) as advance:
        for lidar, wanted in samples.items():
            counts, unread = count_points(recording, lidar, wanted, advance)
            problems += unread
            lidars[lidar] = _summarise_lidar(recording, lidar, counts, topics)
    return BagInspection(
        data=recording.name,
        start_ns=start_ns,
        duration_s=duration_s,
        topics=topics,
        lidars=lidars,
        imus={
            topic: _summarise_imu(check, config if _is_used(config, topic) else None)
            for topic, check in recording.imu_checks().items()
        },
        gnss_fixes=dict(recording.gnss_fixes()),
        drive=_drive(recording),
        problems=tuple(problems),
    )


def _is_used(config: Config | None, topic: str) -> bool:
    """Whether the config takes this IMU; without `topics.imu` it takes the only one there is."""
    return config is not None and config.topics.imu in (None, topic)


def _summarise_imu(check: ImuCheck, config: Config | None) -> ImuSummary:
    """An IMU, its axes by the config that uses it; without one as if it stood upright."""
    R = np.eye(3) if config is None else known_rotation(config)
    axes = ""
    # Without gravity in it, a force has no direction.
    if R is not None and not check.gravity_problem:
        axes = gravity_problem(np.array(check.up_imu), R)
    return ImuSummary(
        specific_force_m_s2=check.specific_force_m_s2,
        angular_rate_rad_s=check.angular_rate_rad_s,
        up_imu=check.up_imu,
        problems=tuple(p for p in (check.gravity_problem, axes, check.rate_problem) if p),
    )


def _drive(recording: Bagged) -> DriveSummary | None:
    try:
        poses = recording.motion().poses
    except RecordingError:
        if isinstance(recording, CloudFolder):
            raise
        return None  # wrong IMU units, which the inspection reports
    return None if poses is None else summarise_drive(poses)


def _sample(recording: Bagged, lidar: str) -> frozenset[int]:
    stamps = recording.scan_stamps_ns(lidar)
    count = min(_SAMPLED_CLOUDS, len(stamps))
    steps = max(count - 1, 1)
    return frozenset(stamps[i * (len(stamps) - 1) // steps] for i in range(count))


def _summarise_topic(
    recording: Bagged, name: str, clock: Clock | None, start_ns: int, duration_s: float
) -> TopicSummary:
    topic = recording.topics[name]
    if clock is None:
        rate_hz = (topic.messages - 1) / duration_s if topic.messages > 1 and duration_s else None
        return TopicSummary(topic.type, topic.messages, rate_hz)
    longest = sorted(clock.gaps, key=lambda gap: gap[0] - gap[1])[:_GAPS_SHOWN]
    return TopicSummary(
        type=topic.type,
        messages=clock.messages,
        rate_hz=clock.rate_hz,
        read=True,
        frame_id=recording.frame_ids().get(name, ""),
        span_s=_span_s((clock.first_ns, clock.last_ns), start_ns) if clock.messages else None,
        gaps=len(clock.gaps),
        longest_gaps_s=tuple(_span_s(gap, start_ns) for gap in sorted(longest)),
        header_minus_record_s=clock.offset_s,
        unset=clock.unset,
        backwards=clock.backwards,
        duplicates=clock.duplicates,
    )


def _summarise_lidar(
    recording: Bagged, lidar: str, counts: list[int], topics: dict[str, TopicSummary]
) -> BagLidarSummary:
    name = recording.lidar_topic(lidar)
    seen, mark = recording.times_seen(lidar), recording.stamp_mark(lidar)
    times = None
    if seen.field is not None:
        field = seen.field
        times = PointTimes(field.name, field.type, field.unit, seen.first_s, seen.last_s)
    return BagLidarSummary(
        topic=name,
        frame_id=topics[name].frame_id,
        clouds=len(recording.scan_stamps_ns(lidar)),
        rate_hz=topics[name].rate_hz,
        sampled=len(counts),
        points=summarise_points(counts) if counts else None,
        times=times,
        times_problem=seen.problem,
        stamp_marks=mark.marks,
        stamp_told_by=mark.told_by,
        stamp_shift_s=mark.shift_s,
    )


def _span_s(span_ns: tuple[int, int], start_ns: int) -> tuple[float, float]:
    first, last = ((stamp_ns - start_ns) / NANOSECONDS_PER_SECOND for stamp_ns in span_ns)
    return first, last
