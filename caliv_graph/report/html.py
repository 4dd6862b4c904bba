"""report.html: one self-contained page about the quality of a calibration.

The page loads nothing: style, plotly.js and data are inside. Names come from users and are escaped
wherever they appear.
"""

from __future__ import annotations

import importlib.metadata
import math
import platform
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

import caliv_graph
from caliv_graph.calibration.assemble import MARKS
from caliv_graph.common.progress import StageRecord, count_text
from caliv_graph.config.load import dump_config
from caliv_graph.config.model import Config
from caliv_graph.conventions import AXES, NANOSECONDS_PER_SECOND
from caliv_graph.geometry.covariance import parent_axes_covariance
from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.products import Calibration, Direction, LidarResult, NoiseLevel, Solution
from caliv_graph.report.numbers import (
    SHOWN_AXES,
    fixed,
    pair_cells,
    pose_cells,
    scans_text,
    two_digits,
)
from caliv_graph.report.page import environment, script_data
from caliv_graph.report.residuals import CloudVerdict, all_residuals, down_weighted
from caliv_graph.report.surfaces import MOST_ROWS, SURFACE_HEADS, surface_rows
from caliv_graph.results.run import RunRecord
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.uncertainty.pairs import pair_determined, sensor_pairs
from caliv_graph.wording.suspects import suspect_row
from caliv_graph.wording.vehicle import vehicle_text

MOST_LISTED = 40
"""Down-weighted clouds in the table; the figure shows all."""

FAR_SIGMAS = 3.0
"""An extrinsic that moved by more than this many sigmas of its guess is highlighted."""

_HEADLINES = {
    "ok": "Calibrated: this drive determined every axis of every LiDAR.",
    "partial": "Calibrated in part: this drive did not determine some axes.",
    "inconsistent": "Do not use this result: its inputs contradict each other.",
}

_VERSIONS_OF = ("gtsam", "numpy", "scipy", "open3d", "rosbags", "plotly")


def render_report(
    calibration: Calibration,
    solution: Solution,
    config: Config,
    stages: Sequence[StageRecord],
    warnings: Sequence[str],
    record: RunRecord,
) -> str:
    """The page, an HTML document of a few megabytes, most of them plotly.js."""
    # Imported here: a run that writes no report does not need plotly.
    from plotly.offline import get_plotlyjs

    from caliv_graph.report.figures.sections import report_figures

    sections = report_figures(calibration, solution, record)
    clouds = down_weighted(solution, config.robust)
    pages = environment()
    pages.globals["two_digits"] = two_digits
    pages.globals["median"] = lambda values: float(np.median(np.abs(values)))
    return pages.get_template("report.html.j2").render(
        calibration=calibration,
        headline=_HEADLINES.get(calibration.status, calibration.status),
        verdicts=verdicts(calibration),
        contradictions=_contradictions(calibration, warnings),
        suspects=[(*suspect_row(s), f"{s.explains:.0%}") for s in calibration.suspects],
        directions=_direction_rows(calibration),
        axes=SHOWN_AXES,
        extrinsics={n: extrinsic_row(r) for n, r in calibration.lidars.items()},
        pairs=pair_cells(calibration),
        measured=[vehicle_text(name, found) for name, found in calibration.vehicle.items()],
        moves=move_rows(calibration),
        residuals=all_residuals(solution, record),
        clouds=[_cloud_row(c, record) for c in clouds[:MOST_LISTED]],
        more_clouds=max(len(clouds) - MOST_LISTED, 0),
        weights=_weight_rows(solution),
        surface_heads=SURFACE_HEADS,
        surfaces=(surfaces := surface_rows(solution, record.drives))[:MOST_ROWS],
        more_surfaces=max(len(surfaces) - MOST_ROWS, 0),
        registrations=solution.registrations,
        solution=solution,
        noise=_noise_rows(solution, record),
        sections=sections,
        data={f.name: script_data(f) for figures in sections.values() for f in figures},
        warnings=list(dict.fromkeys(warnings)),
        stages=[(s.depth, s.name, s.seconds, count_text(s)) for s in stages],
        config=dump_config(config),
        inputs=_inputs(calibration),
        versions=_versions(),
        version=caliv_graph.__version__,
        plotlyjs=Markup(get_plotlyjs()),
    )


def verdicts(calibration: Calibration) -> list[tuple[str, str, str]]:
    """Per LiDAR and pair: its name, the determined axes, the undetermined axes, as text."""
    out = []
    for name, lidar in calibration.lidars.items():
        if lidar.guess is not None and lidar.guess.fixed:
            out.append((name, "", "not estimated: 'fixed' in the config"))
        elif not lidar.has_data:
            kept = "no guess given" if lidar.without_guess else "the extrinsic is the guess"
            out.append((name, "", f"all six axes: nothing seen, {kept}"))
        else:
            out.append((f"{name} to the vehicle", *_axes_texts(lidar.determined)))
    for source, to in sensor_pairs(calibration.lidars, calibration.reference):
        if all(calibration.lidars[n].placed for n in (source, to)):
            axes = _axes_texts(pair_determined(calibration, source, to))
            out.append((f"{source} to {to}", *axes))
    return out


def _axes_texts(determined: Mapping[str, bool]) -> tuple[str, str]:
    """The determined and the undetermined axes."""
    known = [axis for axis in SHOWN_AXES if determined[axis]]
    unknown = [axis for axis in SHOWN_AXES if not determined[axis]]
    return (
        "all six axes" if not unknown else ", ".join(known),
        "all six axes" if not known else ", ".join(unknown),
    )


def _contradictions(calibration: Calibration, warnings: Sequence[str]) -> list[str]:
    """The contradictions; of an inconsistent result that names none, all warnings."""
    if calibration.contradictions or calibration.status != "inconsistent":
        return list(calibration.contradictions)
    return list(dict.fromkeys([*calibration.unmet, *warnings]))


def _direction_rows(calibration: Calibration) -> list[dict[str, str]]:
    return [
        {
            "verdict": verdict,
            "text": direction.text,
            "remedy": direction.remedy,
            "data": _sigma_text(direction, direction.sigma_data),
            "prior": _sigma_text(direction, direction.sigma_prior),
        }
        for verdict, directions in (
            ("undetermined", calibration.undetermined),
            ("weak", calibration.weak),
        )
        for direction in directions
    ]


def _sigma_text(direction: Direction, sigma: float) -> str:
    """A sigma along a direction, stated for the axis that changes most along it."""
    if not math.isfinite(sigma):
        return "no information"
    best, size = ("", 0), 0.0
    for name, vector in direction.vector.items():
        # 1 mrad counts as 10 mm.
        scaled = np.abs(vector) * np.array([1e3] * 3 + [1e2] * 3)
        if scaled.max() > size:
            best, size = (name, int(scaled.argmax())), float(scaled.max())
    name, axis = best
    value = 1e3 * sigma * abs(float(direction.vector[name][axis]))
    if value >= 1e4:
        return "almost no information"
    return f"{two_digits(value)} {'mrad' if axis < 3 else 'mm'} in {AXES[axis]} of {name}"


def extrinsic_row(result: LidarResult) -> dict[str, Any]:
    """The row of one LiDAR in a table of extrinsics: a cell per axis, scans, time offset."""
    offset = result.time_offset
    return {
        "cells": pose_cells(
            result.T_vehicle_lidar, result.cov, result.determined, not result.without_guess
        ),
        "scans": scans_text(result),
        "offset": None if offset is None else f"{1e3 * offset[0]:+.2f} ± {1e3 * offset[1]:.2f} ms",
        "estimated": not (result.guess is not None and result.guess.fixed),
    }


def move_rows(calibration: Calibration) -> list[dict[str, Any]]:
    """Differences between guess and result; mm and mrad in vehicle axes.

    A guess that was found in the drive is no measure of anything.
    """
    rows = []
    for name, lidar in calibration.lidars.items():
        if lidar.guess is None or lidar.guess.fixed or lidar.without_guess or not lidar.has_data:
            continue
        moved = vehicle_axes_difference(lidar.T_vehicle_lidar, lidar.guess.T_vehicle_lidar)
        after = np.sqrt(np.diag(parent_axes_covariance(lidar.T_vehicle_lidar, lidar.cov)))
        cells = []
        for axis in SHOWN_AXES:
            i = AXES.index(axis)
            determined, prior = lidar.determined[axis], lidar.guess.sigmas[i]
            cells.append(
                {
                    "moved": f"{1e3 * moved[i]:.3g}" if determined else "not determined",
                    "prior": f"{1e3 * prior:.3g}",
                    "after": two_digits(1e3 * after[i]),
                    "sigmas": fixed(float(moved[i] / prior), 1) if determined else "",
                    "far": bool(determined and abs(moved[i]) > FAR_SIGMAS * prior),
                    "determined": determined,
                }
            )
        rows.append({"name": name, "cells": cells})
    return rows


def _cloud_row(cloud: CloudVerdict, record: RunRecord) -> dict[str, str]:
    begin, _ = record.trajectories[cloud.drive].span_ns
    source = cloud.source
    return {
        "lidar": cloud.lidar,
        "target": cloud.target,
        "drive": record.drives[cloud.drive],
        "at": f"{(cloud.stamp_ns - begin) / NANOSECONDS_PER_SECOND:.2f}",
        # Of a file, its folder and name; the name of a scan from a topic as it is.
        "source": "/".join(source.split("/")[-2:]) if source.endswith(".pcd") else source,
        "weight": f"{cloud.weight:.2f}",
        "rotation": f"{1e3 * cloud.rotation_rad:.3g}",
        "position": f"{1e3 * cloud.position_m:.3g}",
        "reason": cloud.reason,
    }


def _weight_rows(solution: Solution) -> list[dict[str, Any]]:
    rows = []
    for registration, weights in zip(solution.registrations, solution.cloud_weights, strict=True):
        clouds = registration.observation.clouds
        for name in solution.lidars:
            mine = np.array([c.lidar == name for c in clouds], dtype=bool)
            if mine.any():
                w = weights[mine]
                points = [len(c.points_lidar) for c in clouds if c.lidar == name]
                rows.append(
                    {
                        "target": registration.observation.name,
                        "lidar": name,
                        "scans": int(mine.sum()),
                        "points": f"{min(points)} / {int(np.median(points))} / {max(points)}",
                        "cut": sum(bool(c.cut) for c in clouds if c.lidar == name),
                        "down": int((w < 0.5).sum()),
                        "dropped": int((w < 0.01).sum()),
                        "inliers": f"{np.median(registration.inlier_ratio[mine]):.0%}",
                    }
                )
    return rows


def _noise_rows(solution: Solution, record: RunRecord) -> list[tuple[str, str]]:
    """Noise levels and their sources."""
    rows = []
    noise = solution.pose_noise
    if noise is not None:
        rows += [
            (
                "given poses, white error (estimated from the data unless the config states it)",
                f"{1e3 * noise.white_rotation_rad:.2g} mrad, "
                f"{1e3 * noise.white_position_m:.2g} mm per axis",
            ),
            (
                "given poses, Gauss-Markov error",
                f"{1e3 * noise.drift_rotation_rad:.2g} mrad, "
                f"{1e3 * noise.drift_position_m:.2g} mm per axis, "
                f"correlation time {noise.drift_time_s:.2g} s",
            ),
        ]
    if solution.registrations:
        scale = f"{solution.registration_scale:.2f}"
        rows.append(("registration of the target, factor on its sigmas", scale))
    rows += [_noise_row(level) for level in solution.sensor_noise]
    for name, trajectory in zip(record.drives, record.trajectories, strict=True):
        if isinstance(trajectory, SmoothedTrajectory):
            rows += [(f"{name}: {what}", by) for what, by in trajectory.noise_sources.items()]
    return rows


def _noise_row(level: NoiseLevel) -> tuple[str, str]:
    """A noise level that no message states, and where it is from."""
    unit = "mm" if level.unit == "m" else "mrad"
    time = "" if level.time_s is None else f", correlation time {level.time_s:.3g} s"
    name = level.name.replace("_", " ")
    return f"{name} (from: {level.source})", f"{1e3 * level.sigma:.2g} {unit}{time}"


def _inputs(calibration: Calibration) -> list[tuple[str, str]]:
    """The provenance, one row per value; digests in full, so that they can be compared."""
    return [
        (key, str(item))
        for key, value in calibration.provenance.items()
        if key != MARKS
        for item in (value if isinstance(value, list) else [value])
    ]


def _versions() -> list[tuple[str, str]]:
    rows = [("caliv-graph", caliv_graph.__version__), ("Python", platform.python_version())]
    for name in _VERSIONS_OF:
        try:
            rows.append((name, importlib.metadata.version(name)))
        except importlib.metadata.PackageNotFoundError:
            continue
    return rows
