"""Comparisons and merged calibrations, as tables and as plain values."""

from __future__ import annotations

from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from caliv_graph.conventions import AXES
from caliv_graph.fusion.compare import Comparison, Movement
from caliv_graph.fusion.merge import Merger
from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.products import Calibration
from caliv_graph.report.layout import (
    UNKNOWN,
    axis_headings,
    new_table,
    sentences,
    titled,
)
from caliv_graph.report.numbers import SHOWN_AXES, fixed, value_and_sigma
from caliv_graph.report.tables import STATUS_STYLES, calibration_table


def comparison_table(comparison: Comparison, labels: tuple[str, str], p_value: float) -> Group:
    """Movements with their sigmas, and the verdict.

    The labels name the earlier and the later calibration; `p_value` is the limit applied.
    """
    table = new_table("", *axis_headings("mm", "mrad"), "chi2\ndof", "p\ncorrected", "moved")
    for movement in comparison.movements:
        table.add_row(Text(_name(movement)), *_cells(movement), *_verdict(movement))
    parts = titled(
        f"Movement from {labels[0]} to {labels[1]}, and 1 sigma, in vehicle axes", table
    )[1:]
    if not all(all(m.determined) for m in comparison.movements):
        parts.append(
            Text(
                f"{UNKNOWN}: not determined by both calibrations, so not compared.", style="yellow"
            )
        )
    for label, texts in zip(labels, comparison.undetermined, strict=True):
        parts += sentences(f"Not determined by {label}:", texts)
    parts += sentences(
        "Not compared:", (f"LiDAR '{n}': {why}" for n, why in comparison.not_compared.items())
    )
    tested = any(movement.dof for movement in comparison.movements)
    style = "bold red" if comparison.moved else "bold green" if tested else "bold yellow"
    together = (
        f" (joint test: chi2 {comparison.chi2:.1f} with {comparison.dof} dof, p "
        f"{comparison.p_value:.3g}; limit {p_value:g} after correction for {_tests(comparison)} "
        "tests)"
        if comparison.dof
        else ""
    )
    parts += ["", Text.assemble((comparison.conclusion, style), together)]
    return Group(*parts)


def merger_table(merger: Merger, p_value: float) -> RenderableType:
    """The merged calibration, and whether its inputs agree."""
    table = new_table("", "tests", "smallest p\ncorrected", "verdict")
    for label, comparison in merger.agreement.items():
        tested = [m.p_corrected for m in comparison.movements if m.dof]
        table.add_row(
            Text(label),
            str(_tests(comparison)),
            f"{min(tested):.3g}" if tested else UNKNOWN,
            Text("disagrees", style="bold red")
            if comparison.moved
            else Text("agrees" if tested else "nothing to compare"),
        )
    parts: list[RenderableType] = [calibration_table(merger.calibration)]
    parts += titled(
        f"Each calibration against all others together (limit {p_value:g} over all tests)", table
    )
    return Group(*parts)


def comparison_document(
    comparison: Comparison, labels: tuple[str, str], p_value: float
) -> dict[str, Any]:
    """A comparison as plain values: metres, radians; null where not determined."""
    return {
        "first": labels[0],
        "second": labels[1],
        "moved": comparison.moved,
        "conclusion": comparison.conclusion,
        "p_value_limit": p_value,
        "tests": _tests(comparison),
        "lidars": {name: {"s2v": _movement_document(m)} for name, m in comparison.lidars.items()},
        "pairs": [
            {"from": m.lidars[0], "to": m.lidars[1], **_movement_document(m)}
            for m in comparison.pairs
        ],
        "joint": {
            "chi2": comparison.chi2 if comparison.dof else None,
            "dof": comparison.dof,
            "p_value": comparison.p_value if comparison.dof else None,
        },
        "undetermined": {
            label: list(texts)
            for label, texts in zip(("first", "second"), comparison.undetermined, strict=True)
        },
        "not_compared": dict(comparison.not_compared),
        "shared_data": list(comparison.shared),
    }


def agreement_document(merger: Merger, p_value: float) -> dict[str, Any]:
    """Per calibration, its comparison with all others together."""
    others = ("the others", "this")
    return {
        label: comparison_document(comparison, others, p_value)
        for label, comparison in merger.agreement.items()
    }


def _movement_document(movement: Movement) -> dict[str, Any]:
    def where_determined(values: Any, axes: slice) -> list[float | None]:
        pairs = zip(values[axes], movement.determined[axes], strict=True)
        return [float(value) if known else None for value, known in pairs]

    rotation, translation = slice(0, 3), slice(3, 6)
    tested = movement.dof > 0
    return {
        "rotation_rad": where_determined(movement.movement, rotation),
        "translation_m": where_determined(movement.movement, translation),
        "sigma_rotation_rad": where_determined(movement.sigma, rotation),
        "sigma_translation_m": where_determined(movement.sigma, translation),
        "determined": dict(zip(AXES, movement.determined, strict=True)),
        "chi2": movement.chi2 if tested else None,
        "dof": movement.dof,
        "p_value": movement.p_value if tested else None,
        "p_rotation": where_determined(movement.p_axes, rotation),
        "p_translation": where_determined(movement.p_axes, translation),
        "p_corrected": movement.p_corrected if tested else None,
        "moved": movement.moved if tested else None,
    }


def _name(movement: Movement) -> str:
    if len(movement.lidars) == 1:
        return f"S2V {movement.lidars[0]}"
    return "S2S {} to {}".format(*movement.lidars)


def _cells(movement: Movement) -> list[Text]:
    cells = []
    for axis in SHOWN_AXES:
        i = AXES.index(axis)
        if not movement.determined[i]:
            cells.append(Text(UNKNOWN, style="yellow"))
            continue
        value, sigma = 1e3 * movement.movement[i], 1e3 * movement.sigma[i]
        cells.append(Text(value_and_sigma(value, sigma)))
    return cells


def _verdict(movement: Movement) -> list[Text]:
    if not movement.dof:
        return [Text(UNKNOWN), Text(UNKNOWN), Text("not\ntested", style="yellow")]
    moved = Text("yes", style="bold red") if movement.moved else Text("no")
    return [
        Text(f"{movement.chi2:.1f}\n{movement.dof}"),
        Text(f"{movement.p_value:.2g}\n{movement.p_corrected:.2g}"),
        moved,
    ]


def _tests(comparison: Comparison) -> int:
    return sum(len(m.tests) for m in comparison.movements)


def trial_table(first: Calibration, second: Calibration, change: str) -> RenderableType:
    """The run with the first suspect freed beside the first run; `change` of the config."""
    table = new_table("", *axis_headings("mm", "mrad"))
    for name, lidar in second.lidars.items():
        moved = vehicle_axes_difference(lidar.T_vehicle_lidar, first.lidars[name].T_vehicle_lidar)
        cells = [Text(fixed(1e3 * float(moved[AXES.index(axis)]), 2)) for axis in SHOWN_AXES]
        table.add_row(Text(f"S2V {name}"), *cells)
    style = STATUS_STYLES.get(second.status, "bold")
    parts: list[RenderableType] = [
        "",
        Text.assemble(
            f"Tried: {change}. Status: {first.status} before, ", (second.status, style), " now."
        ),
    ]
    parts += sentences("Contradictions that are left:", second.contradictions)
    parts += titled("What the extrinsics change by, vehicle axes", table)
    return Group(*parts)
