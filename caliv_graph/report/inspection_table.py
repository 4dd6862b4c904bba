"""The content of a recording as tables for a terminal."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from rich.console import Group, RenderableType
from rich.text import Text

from caliv_graph.report.inspection import DriveSummary, Inspection, Run, Sighting, TargetSummary
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


def inspection_table(inspection: Inspection | BagInspection) -> RenderableType:
    """The content of a recording, and per target which LiDAR sees it when."""
    if not isinstance(inspection, Inspection):
        return _bag_inspection(inspection)
    table = new_table(
        "LiDAR",
        "clouds",
        "frames",
        "step",
        "rate\nHz",
        "points per cloud\nmin / median / max",
    )
    for name, lidar in inspection.lidars.items():
        points = lidar.points
        table.add_row(
            Text(name),
            str(lidar.clouds),
            f"{lidar.frames[0]} to {lidar.frames[1]}",
            str(lidar.step),
            UNKNOWN if lidar.rate_hz is None else f"{lidar.rate_hz:.3g}",
            f"{points.min} / {points.median} / {points.max}",
        )
    parts: list[RenderableType] = [Text(inspection.data, style="bold")]
    parts += titled("Clouds by frame number (rates are nominal: 10 frames per second)", table)
    parts += [
        Text(f"{name}: clouds are missing between the frames {_runs(lidar.gaps, ' and ')}")
        for name, lidar in inspection.lidars.items()
        if lidar.gaps
    ]
    parts += ["", _drive_text(inspection.drive, " (nominal)")]
    return Group(*parts, *_target_parts(inspection.targets))


def _drive_text(drive: DriveSummary, note: str) -> Text:
    return Text(
        f"Drive: {drive.poses} poses, {drive.path_length_m:.1f} m in {drive.duration_s:.1f} s"
        f"{note}, {drive.climb_m:.2f} m up and down; heading changes by "
        f"{drive.heading_change_deg:+.1f} degrees (positive: left), sum of all "
        f"turns {drive.turned_deg:.1f} degrees."
    )


def _target_parts(targets: Iterable[TargetSummary] | None) -> list[RenderableType]:
    parts: list[RenderableType] = []
    for target in targets or ():
        x, y, z = target.centre_map_m
        in_time = any(sighting.times_s is not None for sighting in target.lidars.values())
        seen = new_table(
            "LiDAR",
            "scans",
            "range\nm",
            "points per scan\nmin / median / max",
            "seconds" if in_time else "frames",
        )
        for name, sighting in target.lidars.items():
            seen.add_row(Text(name), *_sighting_cells(sighting))
        parts += titled(f"{target.name} near ({x:.1f}, {y:.1f}, {z:.1f}) m in the map", seen)
    return parts


def _bag_inspection(inspection: BagInspection) -> RenderableType:
    parts: list[RenderableType] = [
        Text(f"{inspection.data}: {inspection.duration_s:.1f} s", style="bold")
    ]
    topics = new_table(
        "topic",
        "messages",
        "rate\nHz",
        "gaps\nlongest",
        "header - record\nmedian (min to max) s",
        "type",
    )
    for name, topic in inspection.topics.items():
        topics.add_row(Text(name), *_topic_cells(topic))
    parts += titled("Topics", topics)
    lidars = new_table(
        "LiDAR", "frame", "clouds", "points per cloud\nmin / median / max", "times of points"
    )
    for name, lidar in inspection.lidars.items():
        lidars.add_row(Text(name), *_bag_lidar_cells(lidar))
    sampled = max((lidar.sampled for lidar in inspection.lidars.values()), default=0)
    parts += titled(f"LiDARs (points and times of up to {sampled} clouds of each)", lidars)
    parts += [
        Text(f"{name}: the times of its points are not used: {lidar.times_problem}", style="yellow")
        for name, lidar in inspection.lidars.items()
        if lidar.times_problem
    ]
    lines = [
        Text(
            f"IMU {topic}: median specific force {imu.specific_force_m_s2:.2f} m/s^2, 95 % of the "
            f"angular rates below {imu.angular_rate_rad_s:.2f} rad/s: "
            f"{'; '.join(imu.problems) or 'as expected'}",
            style="yellow" if imu.problems else "",
        )
        for topic, imu in inspection.imus.items()
    ]
    lines += [
        Text(f"GNSS {topic}: {fixes} of {inspection.topics[topic].messages} messages have a fix")
        for topic, fixes in inspection.gnss_fixes.items()
    ]
    if inspection.drive is not None:
        lines.append(_drive_text(inspection.drive, ""))
    if lines:
        parts += ["", *lines]
    return Group(*parts, *_target_parts(inspection.targets))


def _topic_cells(topic: TopicSummary) -> list[Text | str]:
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
    return [str(topic.messages), rate, gaps, offset, Text(topic.type)]


def _bag_lidar_cells(lidar: BagLidarSummary) -> list[Text | str]:
    points, times = lidar.points, lidar.times
    shown = "none"
    if times is not None:
        shown = (
            f"{times.field} ({times.type}): {times.unit}, {times.first_s:+.4f} to "
            f"{times.last_s:+.4f} s"
        )
    if lidar.stamp_told_by:
        shown += f"; stamp: {lidar.stamp_marks} ({_TOLD_BY[lidar.stamp_told_by]})"
    return [
        Text(lidar.frame_id or UNKNOWN),
        str(lidar.clouds),
        UNKNOWN if points is None else f"{points.min} / {points.median} / {points.max}",
        Text(shown),
    ]


def _sighting_cells(sighting: Sighting) -> list[str]:
    if sighting.points is None or sighting.range_m is None:
        return ["0", UNKNOWN, UNKNOWN, "never"]
    points, (near, far) = sighting.points, sighting.range_m
    return [
        str(sighting.scans),
        f"{near:.1f} to {far:.1f}",
        f"{points.min} / {points.median} / {points.max}",
        _runs(sighting.frames, " to ")
        if sighting.times_s is None
        else ", ".join(f"{first:.1f} to {last:.1f}" for first, last in sighting.times_s),
    ]


def _runs(runs: Iterable[Run], between: str) -> str:
    return ", ".join(
        str(first) if first == last else f"{first}{between}{last}" for first, last in runs
    )
