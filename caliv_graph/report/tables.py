"""Results as tables for a terminal. Degrees and millimetres exist here only."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from caliv_graph.common.progress import StageRecord, count_text
from caliv_graph.conventions import AXES
from caliv_graph.geometry.covariance import parent_axes_covariance
from caliv_graph.products import Array, Calibration, Direction, LidarResult
from caliv_graph.report.inspection import DriveSummary, Inspection, Run, Sighting, TargetSummary
from caliv_graph.report.layout import (
    SHOWN_AXES,
    axis_headings,
    decimals_of,
    fixed,
    new_table,
    sentences,
    titled,
    value_and_sigma,
)
from caliv_graph.uncertainty.pairs import pair_covariance, pair_determined, sensor_pairs

if TYPE_CHECKING:
    from caliv_graph.report.bag_inspection import BagInspection, BagLidarSummary, TopicSummary

_HELD = "held"

STATUS_STYLES = {"ok": "bold green", "partial": "bold yellow", "inconsistent": "bold red"}


def calibration_table(
    calibration: Calibration, stages: Sequence[StageRecord] = (), seconds: float | None = None
) -> RenderableType:
    """The closing words of `calibrate`.

    An axis that the drive does not determine is marked as held, and its value, in brackets, is
    only as precise as what decided it.

    Args:
        calibration: the result.
        stages: what was done.
        seconds: how long all of it took; None: nothing is said of time.
    """
    parts: list[RenderableType] = [_status_line(calibration)]
    parts += sentences("What contradicts what:", calibration.contradictions)
    parts += titled(
        "Sensor to vehicle: T_vehicle_lidar and 1 sigma in vehicle axes", _extrinsics(calibration)
    )
    if len(calibration.lidars) > 1:
        parts += titled(
            "Sensor to sensor: T_to_from and 1 sigma in the axes of 'to'",
            _sensor_to_sensor(calibration),
        )
    if not _all_determined(calibration):
        parts.append(
            Text(
                f"{_HELD}: the drive does not determine this axis; the value in brackets is "
                "decided by the initial guess.",
                style="yellow",
            )
        )
    parts += sentences("Clocks (header stamp minus true acquisition):", _offset_texts(calibration))
    parts += sentences("What the drive could not tell:", _undetermined_texts(calibration))
    weak = direction_texts(calibration.weak)
    parts += sentences("What it told only weakly:", weak)
    parts += sentences("Asked for in the config, but not reached:", calibration.unmet)
    if seconds is not None:
        parts += titled("Time", _times(stages, seconds))
    return Group(*parts)


def evaluation_table(evaluation: Mapping[str, Any], calibration: Calibration) -> RenderableType:
    """Errors against the truth.

    Args:
        evaluation: what `uncertainty.evaluation.evaluate` returned.
        calibration: what was evaluated; tells which axes were held.
    """
    table = new_table("", *axis_headings("mm", "mrad"))
    table.add_column("NEES\n6 dof", justify="right")
    any_held = False
    for name, errors in evaluation["lidars"].items():
        determined = calibration.lidars[name].determined
        any_held |= not all(determined.values())
        table.add_row(Text(f"S2V {name}"), *_error_cells(errors["s2v"], determined))
    for errors in evaluation["pairs"]:
        # The verdict on a pair's axes is about those of `to`, and these errors are not.
        seen = all(calibration.lidars[errors[end]].saw_target for end in ("from", "to"))
        name = f"S2S {errors['from']} to {errors['to']}"
        table.add_row(Text(name), *_error_cells(errors, dict.fromkeys(AXES, seen)))
    parts = titled("Errors in vehicle axes (estimate against truth)", table)
    if any_held:
        note = "In brackets: the drive did not determine this axis; its error is that of the guess."
        parts.append(Text(note, style="yellow"))
    return Group(*parts[1:])


def inspection_table(inspection: Inspection | BagInspection) -> RenderableType:
    """What a recording holds."""
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
            "-" if lidar.rate_hz is None else f"{lidar.rate_hz:.3g}",
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
        f"{drive.heading_change_deg:+.1f} degrees (positive: left), turns add up to "
        f"{drive.turned_deg:.1f} degrees."
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
        Text(f"{name}: times of points are not used: {lidar.times_problem}", style="yellow")
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
    rate = "-" if topic.rate_hz is None else f"{topic.rate_hz:.4g}"
    gaps = "-" if topic.read else ""
    if topic.longest_gaps_s:
        longest_s = max(last - first for first, last in topic.longest_gaps_s)
        gaps = f"{topic.gaps}\n{longest_s:.3g} s"
    offset = ""
    if topic.header_minus_record_s is not None:
        # Rounded first: a minus before zeros says nothing.
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
    return [
        Text(lidar.frame_id or "-"),
        str(lidar.clouds),
        "-" if points is None else f"{points.min} / {points.median} / {points.max}",
        Text(shown),
    ]


def _status_line(calibration: Calibration) -> Text:
    names = ", ".join(calibration.lidars)
    status = Text(calibration.status, style=STATUS_STYLES.get(calibration.status, "bold"))
    return Text.assemble(
        "Status: ", status, f". LiDARs: {names}; reference {calibration.reference}."
    )


def _extrinsics(calibration: Calibration) -> Table:
    table = new_table(
        "LiDAR",
        *axis_headings("m", "deg"),
        "scans\nused",
    )
    for name, result in calibration.lidars.items():
        cells = _pose_cells(result.T_vehicle_lidar, result.cov, result.determined)
        table.add_row(Text(name), *cells, _scans_cell(result))
    return table


def _scans_cell(result: LidarResult) -> Text:
    if result.saw_target:
        return Text(str(result.scans_used))
    return Text("no\ntarget", style="bold yellow")


def _sensor_to_sensor(calibration: Calibration) -> Table:
    table = new_table(
        "from\nto",
        *axis_headings("m", "deg"),
    )
    for source, to in sensor_pairs(calibration.lidars, calibration.reference):
        T_vehicle_from = calibration.lidars[source].T_vehicle_lidar
        T_to_from = calibration.lidars[to].T_vehicle_lidar.between(T_vehicle_from)
        cov = pair_covariance(calibration, source, to)
        determined = pair_determined(calibration, source, to)
        table.add_row(Text(f"{source}\n{to}"), *_pose_cells(T_to_from, cov, determined))
    return table


def _all_determined(calibration: Calibration) -> bool:
    return all(all(result.determined.values()) for result in calibration.lidars.values())


def _offset_texts(calibration: Calibration) -> list[str]:
    return [
        f"LiDAR '{name}': {1e3 * result.time_offset[0]:+.2f} ms, sigma "
        f"{1e3 * result.time_offset[1]:.2f} ms"
        for name, result in calibration.lidars.items()
        if result.time_offset is not None
    ]


def _undetermined_texts(calibration: Calibration) -> list[str]:
    texts = direction_texts(calibration.undetermined)
    return texts + [
        f"LiDAR '{name}' never saw a target: its mounting is the initial guess"
        for name, result in calibration.lidars.items()
        if not result.saw_target
    ]


def direction_texts(directions: Iterable[Direction]) -> list[str]:
    """Directions in words, each once; those with the same remedy together, and it below them."""
    by_remedy: dict[str, list[str]] = {}
    for direction in directions:
        by_remedy.setdefault(direction.remedy, []).append(direction.text)
    return [
        "\n  - ".join(dict.fromkeys(texts)) + (f"\n    Remedy: {remedy}" if remedy else "")
        for remedy, texts in by_remedy.items()
    ]


def _times(stages: Sequence[StageRecord], seconds: float) -> Table:
    table = new_table("stage", "seconds", "done")
    for stage in stages:
        taken = "-" if stage.seconds is None else f"{stage.seconds:.2f}"
        table.add_row(Text(f"{'  ' * stage.depth}{stage.name}"), taken, count_text(stage))
    table.add_row("all", f"{seconds:.2f}", "", style="bold")
    return table


def _pose_cells(T_parent_child: Any, cov: Array, determined: Mapping[str, bool]) -> list[Text]:
    """A cell per axis of `SHOWN_AXES`: the value and, below it, its sigma in the parent's axes."""
    sigma = np.sqrt(np.diag(parent_axes_covariance(T_parent_child, cov)))
    values = np.concatenate([T_parent_child.rotation().rpy(), T_parent_child.translation()])
    values[:3], sigma[:3] = np.degrees(values[:3]), np.degrees(sigma[:3])
    cells = dict(zip(AXES, zip(values, sigma, strict=True), strict=True))
    return [_value_cell(*cells[axis], determined[axis]) for axis in SHOWN_AXES]


def _value_cell(value: float, sigma: float, determined: bool) -> Text:
    """A value to two digits of its sigma; or, held, to one and in brackets."""
    if not determined:
        return Text(f"({fixed(value, decimals_of(sigma, 1))})\n{_HELD}", style="yellow")
    return Text(value_and_sigma(value, sigma))


def _error_cells(errors: Mapping[str, Any], determined: Mapping[str, bool]) -> list[Text]:
    values = dict(zip(AXES, [*errors["rotation_rad"], *errors["translation_m"]], strict=True))
    cells = []
    for axis in SHOWN_AXES:
        text = fixed(1e3 * values[axis], 2)
        cells.append(Text(text) if determined[axis] else Text(f"({text})", style="yellow"))
    nees = errors["nees"]
    return [*cells, Text("-" if nees is None else f"{nees:.2f}")]


def _sighting_cells(sighting: Sighting) -> list[str]:
    if sighting.points is None or sighting.range_m is None:
        return ["0", "-", "-", "never"]
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
