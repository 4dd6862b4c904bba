"""A calibration and its evaluation as tables for a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from caliv_graph.calibration.assemble import SLOW_ERRORS
from caliv_graph.common.progress import StageRecord, count_text
from caliv_graph.conventions import AXES
from caliv_graph.products import Calibration, Direction
from caliv_graph.report.layout import UNKNOWN, axis_headings, new_table, sentences, titled
from caliv_graph.report.numbers import (
    NO_VALUE,
    SHOWN_AXES,
    Cell,
    fixed,
    pair_cells,
    pose_cells,
    scans_text,
)
from caliv_graph.wording.guesses import unseen_sentence
from caliv_graph.wording.suspects import suspect_row
from caliv_graph.wording.vehicle import vehicle_text

_HELD = "held"

MOST_SUSPECTS = 5
"""Lines of the table of suspects; the report has all."""

STATUS_STYLES = {"ok": "bold green", "partial": "bold yellow", "inconsistent": "bold red"}


def calibration_table(
    calibration: Calibration, stages: Sequence[StageRecord] = (), seconds: float | None = None
) -> RenderableType:
    """The result of `calibrate` as tables; without `seconds`, no table of the times of its stages.

    An axis that the drive does not determine is marked `held`. Its value is in brackets, with the
    precision of the initial guess; without a guess it has none.
    """
    status = Text(calibration.status, style=STATUS_STYLES.get(calibration.status, "bold"))
    names = ", ".join(calibration.lidars)
    parts: list[RenderableType] = [
        Text.assemble("Status: ", status, f". LiDARs: {names}; reference {calibration.reference}.")
    ]
    parts += sentences("Contradictions:", calibration.contradictions)
    if calibration.contradictions and calibration.suspects:
        parts += titled("What freeing an input would explain", _suspects(calibration))
    parts += titled(
        "Sensor to vehicle: T_vehicle_lidar and 1 sigma in vehicle axes", _extrinsics(calibration)
    )
    slow = slow_errors_text(calibration.provenance)
    if slow:
        parts.append(Text(slow))
    if len(calibration.lidars) > 1:
        parts += titled(
            "Sensor to sensor: T_to_from and 1 sigma in the axes of 'to'",
            _sensor_to_sensor(calibration),
        )
    open_ = [r for r in calibration.lidars.values() if not all(r.determined.values())]
    if not all(result.without_guess for result in open_):
        parts.append(
            Text(
                f"{_HELD}: this drive does not determine the axis; the value in brackets comes "
                "from the initial guess.",
                style="yellow",
            )
        )
    if any(result.without_guess for result in open_):
        parts.append(
            Text(
                f"{NO_VALUE}: this drive does not determine the axis, and no initial guess was "
                "given.",
                style="yellow",
            )
        )
    parts += sentences("Clocks (header stamp minus true acquisition):", _offset_texts(calibration))
    measured = [vehicle_text(name, found) for name, found in calibration.vehicle.items()]
    parts += sentences("Measured by hand, as the drive sees it:", measured)
    unseen = [
        unseen_sentence(name, result.without_guess)
        for name, result in calibration.lidars.items()
        if not result.has_data
    ]
    undetermined = direction_texts(calibration.undetermined)
    parts += sentences("Not determined by this drive:", [*undetermined, *unseen])
    parts += sentences("Weakly determined:", direction_texts(calibration.weak))
    parts += sentences("Required by the config, but not reached:", calibration.unmet)
    if seconds is not None:
        parts += titled("Time", _times(stages, seconds))
    return Group(*parts)


def slow_errors_text(provenance: Mapping[str, Any]) -> str:
    """Which slow errors of the motion data the sigmas allow for, and whence they are; or nothing.

    With few fixes they are assumed, and may be smaller than what more fixes would show.
    """
    said = []
    for level in provenance.get(SLOW_ERRORS, ()):
        what = (
            str(level["name"]).replace("_correlated", "").replace("_", " ").replace("gnss", "GNSS")
        )
        unit = "mm" if level["unit"] == "m" else "mrad"
        source = str(level["from"])
        from_ = "estimated from the drive" if source.startswith("residuals") else source
        said.append(f"{what} {1e3 * float(level['sigma']):.2g} {unit} ({from_})")
    if not said:
        return ""
    return f"The S2V sigmas allow for slow errors of the motion data: {', '.join(said)}."


def evaluation_table(evaluation: Mapping[str, Any], calibration: Calibration) -> RenderableType:
    """Errors of a calibration as a table: the result of `uncertainty.evaluation.evaluate`."""
    table = new_table("", *axis_headings("mm", "mrad"))
    table.add_column("NEES\n6 dof", justify="right")
    guessed = unguessed = False
    for name, errors in evaluation["lidars"].items():
        determined = calibration.lidars[name].determined
        guessed |= not all(determined.values()) and not calibration.lidars[name].without_guess
        unguessed |= not all(determined.values()) and calibration.lidars[name].without_guess
        table.add_row(Text(f"S2V {name}"), *_error_cells(errors["s2v"], determined))
    for errors in evaluation["pairs"]:
        # A pair's axes are marked as determined in the axes of `to`; these errors are in vehicle
        # axes.
        placed = all(calibration.lidars[errors[end]].placed for end in ("from", "to"))
        name = f"S2S {errors['from']} to {errors['to']}"
        table.add_row(Text(name), *_error_cells(errors, dict.fromkeys(AXES, placed)))
    parts = titled("Errors in vehicle axes (estimate minus truth)", table)
    if guessed or unguessed:
        of = "the error of the initial guess" if guessed else "no initial guess was given"
        parts.append(Text(f"In brackets: not determined by the drive; {of}.", style="yellow"))
    return Group(*parts[1:])


def direction_texts(directions: Iterable[Direction]) -> list[str]:
    """Sentences for directions, without repetitions, grouped by their remedy."""
    by_remedy: dict[str, list[str]] = {}
    for direction in directions:
        by_remedy.setdefault(direction.remedy, []).append(direction.text)
    return [
        "\n  - ".join(dict.fromkeys(texts)) + (f"\n    Remedy: {remedy}" if remedy else "")
        for remedy, texts in by_remedy.items()
    ]


def _extrinsics(calibration: Calibration) -> Table:
    table = new_table("LiDAR", *axis_headings("m", "deg"), "scans\nused")
    for name, result in calibration.lidars.items():
        cells = pose_cells(
            result.T_vehicle_lidar, result.cov, result.determined, not result.without_guess
        )
        known = result.has_data
        scans = Text(scans_text(result), style="" if known else "bold yellow")
        table.add_row(Text(name), *map(_text, cells), scans)
    return table


def _suspects(calibration: Calibration) -> Table:
    table = new_table("input", "by (1 sigma)", "sigma", "with the first\nfreed")
    table.columns[1].no_wrap = False  # of six numbers: names would be cut off for it
    for suspect in calibration.suspects[:MOST_SUSPECTS]:
        name, by, _, sigmas, left = suspect_row(suspect)
        table.add_row(Text(name), Text(by), Text(sigmas), Text(left))
    return table


def _sensor_to_sensor(calibration: Calibration) -> Table:
    table = new_table("from\nto", *axis_headings("m", "deg"))
    for pair in pair_cells(calibration):
        table.add_row(Text(f"{pair.source}\n{pair.to}"), *map(_text, pair.cells))
    return table


def _text(cell: Cell) -> Text:
    if cell.determined:
        return Text(f"{cell.value}\n±{cell.sigma}")
    return Text(f"{cell.value}\n{'' if cell.value == NO_VALUE else _HELD}", style="yellow")


def _offset_texts(calibration: Calibration) -> list[str]:
    return [
        f"LiDAR '{name}': {1e3 * result.time_offset[0]:+.2f} ms, sigma "
        f"{1e3 * result.time_offset[1]:.2f} ms"
        for name, result in calibration.lidars.items()
        if result.time_offset is not None
    ]


def _times(stages: Sequence[StageRecord], seconds: float) -> Table:
    table = new_table("stage", "seconds", "done")
    for stage in stages:
        taken = UNKNOWN if stage.seconds is None else f"{stage.seconds:.2f}"
        table.add_row(Text(f"{'  ' * stage.depth}{stage.name}"), taken, count_text(stage))
    known = sum(round(s.seconds, 2) for s in stages if s.seconds is not None and s.depth == 0)
    table.add_row("reading the config, writing the result", f"{seconds - known:.2f}", "")
    table.add_row("all", f"{seconds:.2f}", "", style="bold")
    return table


def _error_cells(errors: Mapping[str, Any], determined: Mapping[str, bool]) -> list[Text]:
    values = dict(zip(AXES, [*errors["rotation_rad"], *errors["translation_m"]], strict=True))
    cells = []
    for axis in SHOWN_AXES:
        text = fixed(1e3 * values[axis], 2)
        cells.append(Text(text) if determined[axis] else Text(f"({text})", style="yellow"))
    nees = errors["nees"]
    return [*cells, Text(UNKNOWN if nees is None else f"{nees:.2f}")]
