"""What became of a batch: as JSON for programs, as CSV for spreadsheets; `page` makes it a page.

Metres, radians, seconds; CSV has degrees in columns that say so. What a drive did not determine is
null, or an empty cell.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

import caliv_graph
from caliv_graph.batch.folder import SUMMARY_SCHEMA
from caliv_graph.common.exits import DONE, INCONSISTENT, UNMET
from caliv_graph.conventions import AXES
from caliv_graph.errors import CalivError
from caliv_graph.fusion.compare import Comparison, Movement
from caliv_graph.fusion.merge import merge
from caliv_graph.geometry.covariance import parent_axes_covariance
from caliv_graph.products import Array, Calibration, LidarResult
from caliv_graph.report.layout import SHOWN_AXES
from caliv_graph.results.names import REPORT_FILE

_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""What makes a spreadsheet take text for a formula."""


@dataclass(frozen=True)
class Row:
    """One job.

    Attributes:
        job: its name, and its folder's.
        vehicle: what the jobs of one vehicle have in common; None: not said.
        state: `waiting`, `done` (there is a result) or `failed`.
        exit: exit code that `calibrate` would have ended with; None: not known, or not yet.
        message: why it failed, one line.
        seconds: how long it took, when it was done.
        digest: what its result was made from.
        warnings: what a person should know, a line each.
        calibration: the result.
        reused: whether the result was there already.
        trace: lines of the traceback of a defect.
    """

    job: str
    vehicle: str | None = None
    state: Literal["waiting", "done", "failed"] = "waiting"
    exit: int | None = None
    message: str = ""
    seconds: float | None = None
    digest: str = ""
    warnings: tuple[str, ...] = ()
    calibration: Calibration | None = None
    reused: bool = False
    trace: tuple[str, ...] = ()

    @property
    def status(self) -> str:
        """That of the result; of a job without one, its state."""
        return self.state if self.calibration is None else self.calibration.status

    @property
    def note(self) -> str:
        """What is wrong, in short: one line, or nothing."""
        if self.message or self.calibration is None:
            return self.message
        found = (*self.calibration.contradictions, *self.calibration.unmet)
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        return " ".join(f"{found[0]}{more}".split()) if found else ""


@dataclass(frozen=True)
class Deviation:
    """How far, at most, a drive is from the vehicle's other drives.

    Attributes:
        sigmas: of the difference.
        job: which one.
    """

    sigmas: float
    job: str


@dataclass(frozen=True)
class Spread:
    """The extrinsics of one vehicle, from drive to drive.

    Attributes:
        vehicle: which.
        jobs: whose results were compared, each with the others together (`fusion.merge`).
        left_out: jobs that were not, and why.
        deviations: per LiDAR (one name) and pair (two: the first against the second), and per axis
            of `conventions.AXES`, in vehicle axes; None where the drives do not tell.
        moved: jobs that disagree with the others, after the correction for the number of tests.
        reason: why nothing was compared; empty: something was.
    """

    vehicle: str
    jobs: tuple[str, ...]
    left_out: Mapping[str, str] = field(default_factory=dict)
    deviations: Mapping[tuple[str, ...], Mapping[str, Deviation | None]] = field(
        default_factory=dict
    )
    moved: tuple[str, ...] = ()
    reason: str = ""


@dataclass(frozen=True)
class Summary:
    """A batch.

    Attributes:
        rows: per job of the manifest, in its order.
        manifest: the file.
        written: when, UTC, ISO 8601.
    """

    rows: tuple[Row, ...]
    manifest: str
    written: str

    @property
    def exit(self) -> int:
        """The worst of the jobs; UNMET also if one failed, or is not done."""
        if any(row.exit == INCONSISTENT for row in self.rows):
            return INCONSISTENT
        good = all(row.state == "done" and row.exit == DONE for row in self.rows)
        return DONE if good else UNMET

    @property
    def counts(self) -> dict[str, int]:
        """Jobs by state, and how many of the results fell short or contradict themselves."""
        states = [row.state for row in self.rows]
        exits = [row.exit for row in self.rows if row.state == "done"]
        return {
            "jobs": len(self.rows),
            "done": states.count("done"),
            "failed": states.count("failed"),
            "waiting": states.count("waiting"),
            "not_good_enough": exits.count(UNMET),
            "inconsistent": exits.count(INCONSISTENT),
        }

    def spreads(self) -> list[Spread]:
        """Per vehicle that the manifest names, in its order."""
        names = dict.fromkeys(row.vehicle for row in self.rows if row.vehicle is not None)
        return [_spread(name, [r for r in self.rows if r.vehicle == name]) for name in names]


def summary_document(summary: Summary) -> dict[str, Any]:
    """The content of summary.json, plain values only."""
    return {
        "schema": SUMMARY_SCHEMA,
        "caliv_graph": caliv_graph.__version__,
        "manifest": summary.manifest,
        "written": summary.written,
        "exit": summary.exit,
        "counts": summary.counts,
        "jobs": [_row_document(row) for row in summary.rows],
        "vehicles": [_spread_document(spread) for spread in summary.spreads()],
    }


def summary_json(summary: Summary) -> str:
    """summary.json."""
    return json.dumps(summary_document(summary), indent=2, allow_nan=False) + "\n"


def summary_csv(summary: Summary) -> str:
    """summary.csv: a line per job and LiDAR, or one per job without a result."""
    units = {axis: "m" if axis in "xyz" else "deg" for axis in SHOWN_AXES}
    values = [f"{axis}_{unit}" for axis, unit in units.items()]
    columns = [
        *("job", "vehicle", "status", "exit", "seconds", "lidar", "scans_used"),
        *(name for value in values for name in (value, f"sigma_{value}")),
        *("folder", "message"),
    ]
    file = io.StringIO()
    writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
    writer.writeheader()
    for row in summary.rows:
        line: dict[str, Any] = {
            "job": row.job,
            "vehicle": row.vehicle or "",
            "status": row.status,
            "exit": "" if row.exit is None else row.exit,
            "seconds": "" if row.seconds is None else f"{row.seconds:.1f}",
            "folder": row.job if row.calibration is not None else "",
            "message": row.note,
        }
        lines = [line]
        if row.calibration is not None:
            lines = [
                {**line, "lidar": name, "scans_used": lidar.scans_used, **_csv_cells(lidar, units)}
                for name, lidar in row.calibration.lidars.items()
            ]
        for cells in lines:
            writer.writerow({key: _no_formula(value) for key, value in cells.items()})
    return file.getvalue()


def _csv_cells(lidar: LidarResult, units: Mapping[str, str]) -> dict[str, str]:
    values, sigmas = _mounting(lidar)
    cells = {}
    for axis, unit in units.items():
        i = AXES.index(axis)
        if lidar.determined[axis]:
            scale = np.degrees(1.0) if unit == "deg" else 1.0
            cells[f"{axis}_{unit}"] = f"{scale * values[i]:.6f}"
            cells[f"sigma_{axis}_{unit}"] = f"{scale * sigmas[i]:.6f}"
    return cells


def _no_formula(value: Any) -> Any:
    """Text that a spreadsheet takes for text. Names and messages come from elsewhere."""
    if not isinstance(value, str) or not value.startswith(_FORMULA) or _number(value):
        return value
    return f"'{value}"


def _number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _mounting(lidar: LidarResult) -> tuple[Array, Array]:
    """(6,) roll, pitch, yaw, x, y, z and (6,) sigmas in vehicle axes; rad, m."""
    T = lidar.T_vehicle_lidar
    sigmas = np.sqrt(np.diag(parent_axes_covariance(T, lidar.cov)))
    return np.concatenate([T.rotation().rpy(), T.translation()]), sigmas


def _row_document(row: Row) -> dict[str, Any]:
    document: dict[str, Any] = {
        "job": row.job,
        "vehicle": row.vehicle,
        "state": row.state,
        "status": row.status,
        "exit": row.exit,
        "message": row.message or None,
        "seconds": row.seconds,
        "reused": row.reused,
        "digest": row.digest or None,
        "folder": None,
        "warnings": list(row.warnings),
    }
    if row.trace:
        document["traceback"] = list(row.trace)
    if row.calibration is not None:
        document |= {
            "folder": row.job,
            "report": f"{row.job}/{REPORT_FILE}",
            "unmet": list(row.calibration.unmet),
            "contradictions": list(row.calibration.contradictions),
            "undetermined": [direction.text for direction in row.calibration.undetermined],
            "lidars": {n: _lidar_document(lidar) for n, lidar in row.calibration.lidars.items()},
        }
    return document


def _lidar_document(lidar: LidarResult) -> dict[str, Any]:
    values, sigmas = _mounting(lidar)

    def told(numbers: Array, axes: Sequence[str]) -> list[float | None]:
        return [
            float(f"{numbers[AXES.index(axis)]:.9g}") if lidar.determined[axis] else None
            for axis in axes
        ]

    rotation, translation = AXES[:3], AXES[3:]
    return {
        "saw_target": lidar.saw_target,
        "scans_used": lidar.scans_used,
        "translation_m": told(values, translation),
        "rpy_rad": told(values, rotation),
        "sigma_translation_m": told(sigmas, translation),
        "sigma_rotation_rad": told(sigmas, rotation),
        "determined": {axis: bool(lidar.determined[axis]) for axis in AXES},
    }


def _spread_document(spread: Spread) -> dict[str, Any]:
    def axes(deviations: Mapping[str, Deviation | None]) -> dict[str, Any]:
        return {
            axis: None if d is None else {"sigmas": round(d.sigmas, 3), "job": d.job}
            for axis, d in deviations.items()
        }

    return {
        "vehicle": spread.vehicle,
        "jobs": list(spread.jobs),
        "left_out": dict(spread.left_out),
        "not_compared": spread.reason or None,
        "moved": list(spread.moved),
        "lidars": {n[0]: axes(d) for n, d in spread.deviations.items() if len(n) == 1},
        "pairs": [
            {"from": n[0], "to": n[1], "axes": axes(d)}
            for n, d in spread.deviations.items()
            if len(n) == 2
        ],
    }


def _spread(vehicle: str, rows: Sequence[Row]) -> Spread:
    results: dict[str, Calibration] = {}
    left_out: dict[str, str] = {}
    for row in rows:
        if row.calibration is None:
            left_out[row.job] = row.state
        elif row.calibration.status == "inconsistent":
            left_out[row.job] = "contradicts itself"
        else:
            results[row.job] = row.calibration
    jobs = tuple(results)
    if len(results) < 2:
        reason = "takes two drives with a result"
        return Spread(vehicle, jobs, left_out, reason=reason)
    try:
        agreement = merge(results).agreement
    except (CalivError, np.linalg.LinAlgError) as e:
        return Spread(vehicle, jobs, left_out, reason=" ".join(str(e).split()))
    return Spread(
        vehicle,
        jobs,
        left_out,
        deviations=_deviations(agreement),
        moved=tuple(job for job, comparison in agreement.items() if comparison.moved),
        reason="" if agreement else "the drives have no LiDAR in common",
    )


def _deviations(
    agreement: Mapping[str, Comparison],
) -> dict[tuple[str, ...], dict[str, Deviation | None]]:
    out: dict[tuple[str, ...], dict[str, Deviation | None]] = {}
    for job, comparison in agreement.items():
        for movement in comparison.movements:
            axes = out.setdefault(movement.lidars, dict.fromkeys(SHOWN_AXES))
            for axis in SHOWN_AXES:
                sigmas = _sigmas(movement, AXES.index(axis))
                before = axes[axis]
                if sigmas is not None and (before is None or sigmas > before.sigmas):
                    axes[axis] = Deviation(sigmas, job)
    return out


def _sigmas(movement: Movement, axis: int) -> float | None:
    if not movement.determined[axis]:
        return None
    return float(abs(movement.movement[axis]) / movement.sigma[axis])
