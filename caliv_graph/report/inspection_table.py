"""The content of a recording as tables for a terminal."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from rich.console import Group, RenderableType
from rich.text import Text

from caliv_graph.report.inspection import (
    DriveSummary,
    Inspection,
    Points,
    Run,
    Sighting,
    TargetSummary,
)
from caliv_graph.report.layout import UNKNOWN, new_table, titled

if TYPE_CHECKING:
    from caliv_graph.report.bag_inspection import BagInspection, BagLidarSummary, TopicSummary


_TOLD_BY = {
    "config": "by the config",
    "times": "by the times",
    "records": "by the record times",
    "nothing": "assumed",
}
"""What tells which end of the sweep the stamps mark."""

_POINTS_HEADING = "points per cloud\nmin / median / max"


@dataclass(frozen=True)
class TableText:
    """A table: its title, headings and rows of text."""

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Remark:
    """A line below a table.

    Attributes:
        alarming: whether something is wrong.
        begins: whether it is the first of lines that stand apart from the table.
    """

    text: str
    alarming: bool = False
    begins: bool = False


def inspection_table(inspection: Inspection | BagInspection) -> RenderableType:
    """The content of a recording, and per target which LiDAR sees it when."""
    parts: list[RenderableType] = [Text(title_of(inspection), style="bold")]
    for part in content(inspection):
        if isinstance(part, TableText):
            table = new_table(*part.headings)
            for row in part.rows:
                table.add_row(*map(Text, row))
            parts += titled(part.title, table)
            continue
        parts += [""] if part.begins else []
        parts.append(Text(part.text, style="yellow" if part.alarming else ""))
    return Group(*parts)


def title_of(inspection: Inspection | BagInspection) -> str:
    """The recording's name, and its duration if it has stamps."""
    if isinstance(inspection, Inspection):
        return inspection.data
    return f"{inspection.data}: {inspection.duration_s:.1f} s"


def content(inspection: Inspection | BagInspection) -> list[TableText | Remark]:
    """Tables and lines in the order in which they are shown."""
    if isinstance(inspection, Inspection):
        parts = _folder_content(inspection)
    else:
        parts = _bag_content(inspection)
    return [*parts, *map(_target_table, inspection.targets or ())]


def _folder_content(inspection: Inspection) -> list[TableText | Remark]:
    headings = ("LiDAR", "clouds", "frames", "step", "rate\nHz")
    rows = tuple(
        (
            name,
            str(lidar.clouds),
            f"{lidar.frames[0]} to {lidar.frames[1]}",
            str(lidar.step),
            UNKNOWN if lidar.rate_hz is None else f"{lidar.rate_hz:.3g}",
            _points_text(lidar.points),
        )
        for name, lidar in inspection.lidars.items()
    )
    title = "Clouds by frame number (rates are nominal: 10 frames per second)"
    gaps = [
        Remark(f"{name}: clouds are missing between the frames {_runs(lidar.gaps, ' and ')}")
        for name, lidar in inspection.lidars.items()
        if lidar.gaps
    ]
    drive = Remark(_drive_text(inspection.drive, " (nominal)"), begins=True)
    return [TableText(title, (*headings, _POINTS_HEADING), rows), *gaps, drive]


def _drive_text(drive: DriveSummary, note: str) -> str:
    return (
        f"Drive: {drive.poses} poses, {drive.path_length_m:.1f} m in {drive.duration_s:.1f} s"
        f"{note}, {drive.climb_m:.2f} m up and down; heading changes by "
        f"{drive.heading_change_deg:+.1f} degrees (positive: left), sum of all "
        f"turns {drive.turned_deg:.1f} degrees."
    )


def _target_table(target: TargetSummary) -> TableText:
    x, y, z = target.centre_map_m
    in_time = any(sighting.times_s is not None for sighting in target.lidars.values())
    headings = ("LiDAR", "scans", "range\nm", "points per scan\nmin / median / max")
    return TableText(
        f"{target.name} near ({x:.1f}, {y:.1f}, {z:.1f}) m in the map",
        (*headings, "seconds" if in_time else "frames"),
        tuple((name, *_sighting_cells(s)) for name, s in target.lidars.items()),
    )


def _bag_content(inspection: BagInspection) -> list[TableText | Remark]:
    offset = "header - record\nmedian (min to max) s"
    topics = TableText(
        "Topics",
        ("topic", "messages", "rate\nHz", "gaps\nlongest", offset, "type"),
        tuple((name, *_topic_cells(topic)) for name, topic in inspection.topics.items()),
    )
    sampled = max((lidar.sampled for lidar in inspection.lidars.values()), default=0)
    lidars = TableText(
        f"LiDARs (points and times of up to {sampled} clouds of each)",
        ("LiDAR", "frame", "clouds", _POINTS_HEADING, "times of points"),
        tuple((name, *_bag_lidar_cells(lidar)) for name, lidar in inspection.lidars.items()),
    )
    unused = [
        Remark(f"{name}: the times of its points are not used: {lidar.times_problem}", True)
        for name, lidar in inspection.lidars.items()
        if lidar.times_problem
    ]
    lines = [
        Remark(
            f"IMU {topic}: median specific force {imu.specific_force_m_s2:.2f} m/s^2, 95 % of the "
            f"angular rates below {imu.angular_rate_rad_s:.2f} rad/s: "
            f"{'; '.join(imu.problems) or 'as expected'}",
            bool(imu.problems),
        )
        for topic, imu in inspection.imus.items()
    ]
    lines += [
        Remark(f"GNSS {topic}: {fixes} of {inspection.topics[topic].messages} messages have a fix")
        for topic, fixes in inspection.gnss_fixes.items()
    ]
    if inspection.drive is not None:
        lines.append(Remark(_drive_text(inspection.drive, "")))
    lines[:1] = [replace(line, begins=True) for line in lines[:1]]
    return [topics, lidars, *unused, *lines]


def _topic_cells(topic: TopicSummary) -> list[str]:
    rate = UNKNOWN if topic.rate_hz is None else f"{topic.rate_hz:.4g}"
    gaps = UNKNOWN if topic.read else ""
    if topic.longest_gaps_s:
        longest_s = max(last - first for first, last in topic.longest_gaps_s)
        gaps = f"{topic.gaps}\n{longest_s:.3g} s"
    offset = ""
    if topic.header_minus_record_s is not None:
        # Rounded first, so that no minus sign stands before zeros.
        low, median, high = (round(v, 3) + 0.0 for v in topic.header_minus_record_s)
        offset = f"{median:+.3f} ({low:+.3f} to {high:+.3f})"
    return [str(topic.messages), rate, gaps, offset, topic.type]


def _bag_lidar_cells(lidar: BagLidarSummary) -> list[str]:
    times = lidar.times
    shown = "none"
    if times is not None:
        shown = (
            f"{times.field} ({times.type}): {times.unit}, {times.first_s:+.4f} to "
            f"{times.last_s:+.4f} s"
        )
    if lidar.stamp_told_by:
        shown += f"; stamp: {lidar.stamp_marks} ({_TOLD_BY[lidar.stamp_told_by]})"
    return [
        lidar.frame_id or UNKNOWN,
        str(lidar.clouds),
        _points_text(lidar.points),
        shown,
    ]


def _points_text(points: Points | None) -> str:
    return UNKNOWN if points is None else f"{points.min} / {points.median} / {points.max}"


def _sighting_cells(sighting: Sighting) -> list[str]:
    if sighting.points is None or sighting.range_m is None:
        return ["0", UNKNOWN, UNKNOWN, "never"]
    near, far = sighting.range_m
    return [
        str(sighting.scans),
        f"{near:.1f} to {far:.1f}",
        _points_text(sighting.points),
        _runs(sighting.frames, " to ")
        if sighting.times_s is None
        else ", ".join(f"{first:.1f} to {last:.1f}" for first, last in sighting.times_s),
    ]


def _runs(runs: Iterable[Run], between: str) -> str:
    return ", ".join(
        str(first) if first == last else f"{first}{between}{last}" for first, last in runs
    )
