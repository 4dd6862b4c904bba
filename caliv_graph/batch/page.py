"""The summary of a batch: index.html, one self-contained page, and a table for a terminal."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Any
from urllib.parse import quote

from rich.console import Group, RenderableType
from rich.text import Text

import caliv_graph
from caliv_graph.batch.summary import Deviation, Row, Spread, Summary
from caliv_graph.products import LidarResult
from caliv_graph.report.html import extrinsic_row
from caliv_graph.report.layout import UNKNOWN, new_table, sentences, titled
from caliv_graph.report.numbers import SHOWN_AXES
from caliv_graph.report.page import environment
from caliv_graph.report.tables import STATUS_STYLES
from caliv_graph.results.names import REPORT_FILE

FAR_SIGMAS = 3.0
"""A larger difference between drives is highlighted; the verdict comes from a test."""


def render_index(summary: Summary) -> str:
    """The page: every job with its extrinsics, and per vehicle the differences between its drives.

    Its links are relative, so that the folder can be moved.
    """
    template = environment().get_template("batch.html.j2")
    return template.render(
        headline=_headline(summary),
        style=_style(summary),
        counts=summary.counts,
        rows=[_row(row) for row in summary.rows],
        spreads=[_spread(spread) for spread in summary.spreads()],
        axes=SHOWN_AXES,
        manifest=summary.manifest,
        written=summary.written,
        exit=summary.exit,
        far=FAR_SIGMAS,
        version=caliv_graph.__version__,
    )


def summary_table(summary: Summary) -> RenderableType:
    """The result of `batch` as a table."""
    table = new_table("job", "exit", "time\ns", "status", "determined", "vehicle")
    for row in summary.rows:
        table.add_row(
            Text(row.job),
            "-" if row.exit is None else str(row.exit),
            "-" if row.seconds is None else f"{row.seconds:.1f}",
            Text(row.status, style=STATUS_STYLES.get(row.status, "bold red")),
            Text(_determined(row)),
            Text(row.vehicle or ""),
        )
    parts: list[RenderableType] = [Text(_headline(summary), style="bold")]
    parts += titled("Jobs", table)
    parts += sentences("Problems:", (f"{row.job}: {row.note}" for row in summary.rows if row.note))
    parts += sentences("Vehicles:", (_spread_line(s) for s in summary.spreads()))
    return Group(*parts)


def _headline(summary: Summary) -> str:
    counts = summary.counts
    text = f"{counts['done']} of {counts['jobs']} jobs have a result"
    for key, words in (
        ("failed", "failed"),
        ("waiting", "not done yet"),
        ("not_good_enough", "of the results without something required"),
        ("inconsistent", "of them inconsistent"),
    ):
        if counts[key]:
            text += f", {counts[key]} {words}"
    return f"{text}."


def _style(summary: Summary) -> str:
    """A class of the page's style."""
    counts = summary.counts
    if counts["inconsistent"] or counts["failed"]:
        return "inconsistent"
    return "partial" if summary.exit or counts["waiting"] else "ok"


def _determined(row: Row) -> str:
    """The number of determined axes of all LiDARs."""
    if row.calibration is None:
        return UNKNOWN
    axes = [d for lidar in row.calibration.lidars.values() for d in lidar.determined.values()]
    return f"{sum(axes)} of {len(axes)}"


def _row(row: Row) -> dict[str, Any]:
    lidars = {} if row.calibration is None else row.calibration.lidars
    folder = quote(row.job)
    return {
        "job": row.job,
        "vehicle": row.vehicle or "",
        "status": row.status,
        "exit": UNKNOWN if row.exit is None else row.exit,
        "seconds": UNKNOWN if row.seconds is None else f"{row.seconds:.1f}",
        "reused": row.reused,
        "note": row.note,
        "report": str(PurePosixPath(folder) / REPORT_FILE),
        "folder": f"{folder}/",
        "warnings": len(row.warnings),
        "lidars": [{"name": n, **_extrinsic_cells(lidar)} for n, lidar in lidars.items()],
        "undetermined": []
        if row.calibration is None
        else [direction.text for direction in row.calibration.undetermined],
    }


def _extrinsic_cells(lidar: LidarResult) -> dict[str, Any]:
    cells = extrinsic_row(lidar)
    fixed = not cells["estimated"]
    # Undetermined values are initial guesses, which only the report of the job shows.
    shown = [
        {
            "determined": cell.determined and not fixed,
            "value": "fixed" if fixed else cell.value if cell.determined else "not determined",
            "below": f"± {cell.sigma}" if cell.determined and not fixed else "",
        }
        for cell in cells["cells"]
    ]
    return {"cells": shown, "scans": cells["scans"]}


def _spread(spread: Spread) -> dict[str, Any]:
    return {
        "vehicle": spread.vehicle,
        "jobs": spread.jobs,
        "left_out": spread.left_out,
        "reason": spread.reason,
        "moved": spread.moved,
        "rows": [
            {
                "name": names[0] if len(names) == 1 else f"{names[0]} to {names[1]}",
                "cells": [_deviation(axes[axis]) for axis in SHOWN_AXES],
            }
            for names, axes in spread.deviations.items()
        ],
    }


def _deviation(deviation: Deviation | None) -> dict[str, Any]:
    if deviation is None:
        return {"value": "not determined", "job": "", "far": False, "determined": False}
    return {
        "value": f"{deviation.sigmas:.1f}",
        "job": deviation.job,
        "far": deviation.sigmas > FAR_SIGMAS,
        "determined": True,
    }


def _spread_line(spread: Spread) -> str:
    """The differences between the drives of a vehicle, in a sentence."""
    if spread.reason:
        return f"{spread.vehicle}: not compared: {spread.reason}"
    found = [
        (deviation.sigmas, " to ".join(names), axis, deviation.job)
        for names, axes in spread.deviations.items()
        for axis, deviation in axes.items()
        if deviation is not None
    ]
    drives = f"{spread.vehicle}: {len(spread.jobs)} drives"
    if not found:
        return f"{drives}: no axis is determined by two of them"
    sigmas, name, axis, job = max(found)
    most = f"largest difference {sigmas:.1f} sigma ({axis} of {name}, {job})"
    if spread.moved:
        return f"{drives} disagree: {', '.join(spread.moved)}; {most}"
    return f"{drives} agree; {most}"
