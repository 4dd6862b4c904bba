"""The results of a batch: JSON for programs, CSV for spreadsheets (the HTML page is in `page`).

Metres, radians, seconds; the angles in the CSV are in degrees, as its columns say. An undetermined
value is null or an empty cell.
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
from caliv_graph.fusion.compare import Comparison
from caliv_graph.fusion.merge import merge
from caliv_graph.products import Array, Calibration, LidarResult
from caliv_graph.report.numbers import SHOWN_AXES, pose_and_sigmas, rounded
from caliv_graph.results.names import REPORT_FILE

_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""First characters of a text that a spreadsheet interprets as a formula."""


@dataclass(frozen=True)
class Row:
    """One job.

    Attributes:
        vehicle: name shared by the jobs of one vehicle; None: not given.
        state: `waiting`, `done` (the result is written) or `failed`.
        exit: exit code of `calibrate` for this job; None: not known, or not yet.
        seconds: duration of the calibration.
        digest: of the inputs of the result (`digests.job_digest`).
        reused: whether an earlier batch made the result.
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
        """The status of the result, or the state of a job without a result."""
        return self.state if self.calibration is None else self.calibration.status

    @property
    def note(self) -> str:
        """The first problem in one line; empty without problems."""
        if self.message or self.calibration is None:
            return self.message
        found = (*self.calibration.contradictions, *self.calibration.unmet)
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        return " ".join(f"{found[0]}{more}".split()) if found else ""


@dataclass(frozen=True)
class Deviation:
    """The largest difference of one drive from the others of the vehicle, in sigmas."""

    sigmas: float
    job: str


@dataclass(frozen=True)
class Spread:
    """The extrinsics of one vehicle, from drive to drive.

    Attributes:
        vehicle: name of the vehicle.
        jobs: the jobs compared, each with all others together (`fusion.merge`).
        left_out: per job that is not compared, the reason.
        deviations: per LiDAR (one name) and pair (two names, from and to) and per axis of
            `conventions.AXES`, in vehicle axes; None where no drive determines the axis.
        moved: jobs that disagree with the others, corrected for the number of tests.
        reason: why no job was compared; empty if jobs were compared.
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
    """A batch: a row per job in the order of the manifest, its path, and the time (UTC)."""

    rows: tuple[Row, ...]
    manifest: str
    written: str

    @property
    def exit(self) -> int:
        """The exit code of the worst job; UNMET also if a job failed or is not done."""
        if any(row.exit == INCONSISTENT for row in self.rows):
            return INCONSISTENT
        good = all(row.state == "done" and row.exit == DONE for row in self.rows)
        return DONE if good else UNMET

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of jobs by state, and of results with unmet requirements or contradictions."""
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
        """One per vehicle of the manifest, in its order."""
        names = dict.fromkeys(row.vehicle for row in self.rows if row.vehicle is not None)
        return [_spread(name, [r for r in self.rows if r.vehicle == name]) for name in names]


def summary_document(summary: Summary) -> dict[str, Any]:
    """The content of summary.json as plain values."""
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
    """The text of summary.json."""
    return json.dumps(summary_document(summary), indent=2, allow_nan=False) + "\n"


def summary_csv(summary: Summary) -> str:
    """The text of summary.csv: one line per job and LiDAR, or one per job without a result."""
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
    values, sigmas = pose_and_sigmas(lidar.T_vehicle_lidar, lidar.cov)
    cells = {}
    for axis, unit in units.items():
        i = AXES.index(axis)
        if lidar.determined[axis]:
            scale = np.degrees(1.0) if unit == "deg" else 1.0
            cells[f"{axis}_{unit}"] = f"{scale * values[i]:.6f}"
            cells[f"sigma_{axis}_{unit}"] = f"{scale * sigmas[i]:.6f}"
    return cells


def _no_formula(value: Any) -> Any:
    """A value that a spreadsheet does not interpret as a formula; names are user input."""
    if not isinstance(value, str) or not value.startswith(_FORMULA) or _number(value):
        return value
    return f"'{value}"


def _number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


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
    values, sigmas = pose_and_sigmas(lidar.T_vehicle_lidar, lidar.cov)

    def where_determined(numbers: Array, axes: Sequence[str]) -> list[float | None]:
        return [
            rounded(numbers[AXES.index(axis)], 9) if lidar.determined[axis] else None
            for axis in axes
        ]

    rotation, translation = AXES[:3], AXES[3:]
    return {
        "saw_target": lidar.saw_target,
        "scans_used": lidar.scans_used,
        "translation_m": where_determined(values, translation),
        "rpy_rad": where_determined(values, rotation),
        "sigma_translation_m": where_determined(sigmas, translation),
        "sigma_rotation_rad": where_determined(sigmas, rotation),
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
            left_out[row.job] = "inconsistent"
        else:
            results[row.job] = row.calibration
    jobs = tuple(results)
    if len(results) < 2:
        reason = "two drives with a result are needed"
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
                i, before = AXES.index(axis), axes[axis]
                if not movement.determined[i]:
                    continue
                sigmas = float(abs(movement.movement[i]) / movement.sigma[i])
                if before is None or sigmas > before.sigmas:
                    axes[axis] = Deviation(sigmas, job)
    return out
