"""report.html: one self-contained page that says what a calibration is worth, and shows why.

Nothing is loaded from anywhere: style, plotly.js and data are inside. Names come from users and
are escaped wherever they go.
"""

from __future__ import annotations

import importlib.metadata
import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from markupsafe import Markup

import caliv_graph
from caliv_graph.common.progress import StageRecord, count_text
from caliv_graph.config.load import dump_config
from caliv_graph.config.model import Config
from caliv_graph.conventions import AXES, NANOSECONDS_PER_SECOND
from caliv_graph.geometry.covariance import parent_axes_covariance
from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.products import Array, Calibration, Direction, LidarResult, Solution
from caliv_graph.report.layout import SHOWN_AXES, decimals_of, fixed
from caliv_graph.report.page import environment, script_data
from caliv_graph.report.residuals import (
    CloudVerdict,
    all_residuals,
    down_weighted,
    figures_of,
)
from caliv_graph.results.run import RunRecord
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.uncertainty.pairs import pair_covariance, pair_determined, sensor_pairs

MOST_LISTED = 40
"""Down-weighted clouds in the table; the figure has all."""

FAR_SIGMAS = 3.0
"""From which a mounting counts as far from its guess."""

_HEADLINES = {
    "ok": "Calibrated: the drive determined every axis of every LiDAR.",
    "partial": "Calibrated in part: some axes were not determined by the drive.",
    "inconsistent": "Do not use this result: what went into it contradicts itself.",
}

_VERSIONS_OF = ("gtsam", "numpy", "scipy", "open3d", "rosbags", "plotly")


@dataclass(frozen=True)
class Cell:
    """A number of a table.

    Attributes:
        value: with its unit's decimals; in brackets if it was not determined.
        below: its sigma, or what stands in for it.
        determined: whether the drive told it.
    """

    value: str
    below: str
    determined: bool


def render_report(
    calibration: Calibration,
    solution: Solution,
    config: Config,
    stages: Sequence[StageRecord],
    warnings: Sequence[str],
    evidence: RunRecord,
) -> str:
    """The page.

    Args:
        calibration: the result.
        solution: the solved graph.
        config: the effective one.
        stages: what was done, and how long it took.
        warnings: what a person should know, a line each.
        evidence: what the result was made from.

    Returns:
        A whole HTML document of a few megabytes, most of them plotly.js.
    """
    # Here, for a run that writes no report has no use for them.
    from plotly.offline import get_plotlyjs

    pages = environment()
    pages.globals["figures_of"] = figures_of
    pages.globals["median"] = lambda values: float(np.median(np.abs(values)))
    from caliv_graph.report.figures.sections import report_figures

    sections = report_figures(calibration, solution, evidence)
    figures = {f.name: f for figures in sections.values() for f in figures}
    clouds = down_weighted(solution, config.robust)
    template = pages.get_template("report.html.j2")
    return template.render(
        calibration=calibration,
        headline=_HEADLINES.get(calibration.status, calibration.status),
        verdicts=verdicts(calibration),
        conflicts=_conflicts(calibration, warnings),
        directions=_direction_rows(calibration),
        axes=SHOWN_AXES,
        extrinsics={n: mounting_row(r) for n, r in calibration.lidars.items()},
        pairs=_pair_rows(calibration),
        moves=_move_rows(calibration),
        residuals=all_residuals(solution, evidence),
        clouds=[_cloud_row(c, evidence) for c in clouds[:MOST_LISTED]],
        more_clouds=max(len(clouds) - MOST_LISTED, 0),
        weights=_weight_rows(solution),
        registrations=solution.registrations,
        solution=solution,
        noise=_noise_rows(solution, evidence),
        sections=sections,
        data={name: script_data(f) for name, f in figures.items()},
        warnings=list(dict.fromkeys(warnings)),
        stages=[(s.depth, s.name, s.seconds, count_text(s)) for s in stages],
        config=dump_config(config),
        inputs=_inputs(calibration),
        versions=_versions(),
        version=caliv_graph.__version__,
        plotlyjs=Markup(get_plotlyjs()),
    )


def verdicts(calibration: Calibration) -> list[tuple[str, str, str]]:
    """Per LiDAR and pair: its name, what was determined, what was not; in words."""
    out = []
    for name, lidar in calibration.lidars.items():
        if lidar.guess is not None and lidar.guess.fixed:
            out.append((name, "", "not estimated: the config says to trust its mounting (fixed)"))
        elif not lidar.saw_target:
            out.append((name, "", "everything: it never saw a target, its mounting is the guess"))
        else:
            out.append((f"{name} to the vehicle", *_told(lidar.determined)))
    for source, to in sensor_pairs(calibration.lidars, calibration.reference):
        if all(calibration.lidars[n].saw_target for n in (source, to)):
            told = _told(pair_determined(calibration, source, to))
            out.append((f"{source} to {to}", *told))
    return out


def _told(determined: Mapping[str, bool]) -> tuple[str, str]:
    told = [axis for axis in SHOWN_AXES if determined[axis]]
    lost = [axis for axis in SHOWN_AXES if not determined[axis]]
    return ("all six axes" if not lost else ", ".join(told)), (
        "all six axes" if not told else ", ".join(lost)
    )


def _conflicts(calibration: Calibration, warnings: Sequence[str]) -> list[str]:
    """What contradicts what; of a result that does not say so itself, all that was noticed."""
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
    """A sigma along a direction, as that of the axis it moves most."""
    if not math.isfinite(sigma):
        return "nothing known"
    best, size = ("", 0), 0.0
    for name, vector in direction.vector.items():
        # 1 mrad counts as 10 mm.
        scaled = np.abs(vector) * np.array([1e3] * 3 + [1e2] * 3)
        if scaled.max() > size:
            best, size = (name, int(scaled.argmax())), float(scaled.max())
    name, axis = best
    value = 1e3 * sigma * abs(float(direction.vector[name][axis]))
    if value >= 1e4:
        return "next to nothing"
    return f"{figures_of(value)} {'mrad' if axis < 3 else 'mm'} in {AXES[axis]} of {name}"


def mounting_row(result: LidarResult) -> dict[str, Any]:
    """One LiDAR's line in a table of extrinsics: per axis the value and its sigma."""
    estimated = not (result.guess is not None and result.guess.fixed)
    return {
        "cells": _cells(result.T_vehicle_lidar, result.cov, result.determined),
        "scans": str(result.scans_used) if result.saw_target else "no target",
        "offset": None
        if result.time_offset is None
        else f"{1e3 * result.time_offset[0]:+.2f} ± {1e3 * result.time_offset[1]:.2f} ms",
        "estimated": estimated,
    }


def _pair_rows(calibration: Calibration) -> list[dict[str, Any]]:
    rows = []
    for source, to in sensor_pairs(calibration.lidars, calibration.reference):
        T_vehicle_from = calibration.lidars[source].T_vehicle_lidar
        T_to_from = calibration.lidars[to].T_vehicle_lidar.between(T_vehicle_from)
        cov = pair_covariance(calibration, source, to)
        cells = _cells(T_to_from, cov, pair_determined(calibration, source, to))
        rows.append({"from": source, "to": to, "cells": cells})
    return rows


def _cells(T_parent_child: gtsam.Pose3, cov: Array, determined: Mapping[str, bool]) -> list[Cell]:
    """A cell per shown axis: metres and degrees, sigma in the parent's axes."""
    sigma = np.sqrt(np.diag(parent_axes_covariance(T_parent_child, cov)))
    values = np.concatenate([T_parent_child.rotation().rpy(), T_parent_child.translation()])
    values[:3], sigma[:3] = np.degrees(values[:3]), np.degrees(sigma[:3])
    out = []
    for axis in SHOWN_AXES:
        i = AXES.index(axis)
        if determined[axis]:
            decimals = decimals_of(float(sigma[i]), 2)
            value = fixed(float(values[i]), decimals)
            out.append(Cell(value, f"± {sigma[i]:.{decimals}f}", True))
        else:
            decimals = decimals_of(float(sigma[i]), 1)
            out.append(Cell(f"({fixed(float(values[i]), decimals)})", "not determined", False))
    return out


def _move_rows(calibration: Calibration) -> list[dict[str, Any]]:
    """From the guess to the result, mm and mrad in vehicle axes."""
    rows = []
    for name, lidar in calibration.lidars.items():
        if lidar.guess is None or lidar.guess.fixed or not lidar.saw_target:
            continue
        moved = vehicle_axes_difference(lidar.T_vehicle_lidar, lidar.guess.T_vehicle_lidar)
        after = np.sqrt(np.diag(parent_axes_covariance(lidar.T_vehicle_lidar, lidar.cov)))
        cells = []
        for axis in SHOWN_AXES:
            i = AXES.index(axis)
            told, prior = lidar.determined[axis], lidar.guess.sigmas[i]
            cells.append(
                {
                    "moved": f"{1e3 * moved[i]:.3g}" if told else "not determined",
                    "prior": f"{1e3 * prior:.3g}",
                    "after": figures_of(1e3 * after[i]) if told else "the guess's",
                    "sigmas": fixed(float(moved[i] / prior), 1) if told else "",
                    "far": bool(told and abs(moved[i]) > FAR_SIGMAS * prior),
                    "determined": told,
                }
            )
        rows.append({"name": name, "cells": cells})
    return rows


def _cloud_row(cloud: CloudVerdict, evidence: RunRecord) -> dict[str, str]:
    begin, _ = evidence.trajectories[cloud.drive].span_ns
    return {
        "lidar": cloud.lidar,
        "target": cloud.target,
        "drive": evidence.drives[cloud.drive],
        "at": f"{(cloud.stamp_ns - begin) / NANOSECONDS_PER_SECOND:.2f}",
        "source": _short_source(cloud.source),
        "weight": f"{cloud.weight:.2f}",
        "turn": f"{1e3 * cloud.turn_rad:.3g}",
        "shift": f"{1e3 * cloud.shift_m:.3g}",
        "reason": cloud.reason,
    }


def _short_source(source: str) -> str:
    """A file by its last folder and name, a scan of a topic as it is."""
    return "/".join(source.split("/")[-2:]) if source.endswith(".pcd") else source


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
                        "cut": sum(c.cut for c in clouds if c.lidar == name),
                        "down": int((w < 0.5).sum()),
                        "dropped": int((w < 0.01).sum()),
                        "inliers": f"{np.median(registration.inlier_ratio[mine]):.0%}",
                    }
                )
    return rows


def _noise_rows(solution: Solution, evidence: RunRecord) -> list[tuple[str, str]]:
    """Noise levels, and where they are from."""
    rows = []
    noise = solution.pose_noise
    if noise is not None:
        rows += [
            (
                "given poses, white part (from the data where the config states none)",
                f"{1e3 * noise.white_rotation_rad:.2g} mrad, "
                f"{1e3 * noise.white_position_m:.2g} mm per axis",
            ),
            (
                "given poses, slow part",
                f"{1e3 * noise.drift_rotation_rad:.2g} mrad, "
                f"{1e3 * noise.drift_position_m:.2g} mm per axis, "
                f"over {noise.drift_time_s:g} s",
            ),
        ]
    rows.append(
        ("registration of the target, factor on its sigmas", f"{solution.registration_scale:.2f}")
    )
    for name, trajectory in zip(evidence.drives, evidence.trajectories, strict=True):
        if isinstance(trajectory, SmoothedTrajectory):
            rows += [(f"{name}: {what}", by) for what, by in trajectory.noise_sources.items()]
    return rows


def _inputs(calibration: Calibration) -> list[tuple[str, str]]:
    """The provenance as lines: digests whole, for they are to be compared."""
    rows = []
    for key, value in calibration.provenance.items():
        shown = value if isinstance(value, list) else [value]
        rows += [(key, str(item)) for item in shown]
    return rows


def _versions() -> list[tuple[str, str]]:
    rows = [("caliv-graph", caliv_graph.__version__), ("Python", platform.python_version())]
    for name in _VERSIONS_OF:
        try:
            rows.append((name, importlib.metadata.version(name)))
        except importlib.metadata.PackageNotFoundError:
            continue
    return rows
