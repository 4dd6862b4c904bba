"""A validation as tables in millimetres, as plain values in metres, and as a page."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from markupsafe import Markup
from rich.console import Group, RenderableType
from rich.text import Text

import caliv_graph
from caliv_graph.fusion.compare import Comparison
from caliv_graph.report.comparison import comparison_document
from caliv_graph.report.held_out import (
    HELD_OUT_HEADS,
    held_out_document,
    held_out_rows,
    held_out_tables,
)
from caliv_graph.report.layout import UNKNOWN, millimetres, new_table, sentences, titled
from caliv_graph.report.tables import STATUS_STYLES
from caliv_graph.validation.findings import (
    AFTER,
    BEFORE,
    STAGES,
    SurfaceResult,
    ThingResult,
    Validation,
)
from caliv_graph.validation.surfaces import Pole, Thing, Wall
from caliv_graph.workflows.repeatability import Repeatability

MOST_SHOWN = 12
"""Surfaces in the table; the JSON document lists all."""


def validation_table(found: Validation, repeated: Repeatability | None, p_value: float) -> Group:
    """The verdict in a word, distances between LiDARs, thicknesses, objects, and sentences.

    `p_value` is the limit of the tests of repeatability; `repeated` None: not tested.
    """
    parts: list[RenderableType] = [Text(first_line(found), style="bold")]
    for title, headings, rows in tables(found):
        table = new_table(*headings)
        for row in rows:
            table.add_row(*map(Text, row))
        parts += titled(title, table)
    if repeated is not None:
        parts += sentences("Split-half repeatability:", repeatability_sentences(repeated, p_value))
    parts.append("")
    style = STATUS_STYLES[validation_status(found)]
    parts += [Text(sentence, style=style) for sentence in found.verdict.sentences]
    return Group(*parts)


def first_line(found: Validation) -> str:
    """The verdict in a word, and what it does not cover."""
    return f"Verdict: {found.verdict.word}. {found.unseen}."


def validation_status(found: Validation) -> str:
    """The status of a validation, in the words of a calibration's status.

    `partial` without structure, `inconsistent` if the calibration contradicts the structure or fits
    it worse than the initial guesses, else `ok`.
    """
    if not found.has_structure:
        return "partial"
    bad = found.verdict.contradicts or (found.verdict.better or 1.0) < 1.0
    return "inconsistent" if bad else "ok"


def tables(found: Validation) -> list[tuple[str, list[str], list[list[str]]]]:
    """Per table its title, headings and rows of text."""
    out: list[tuple[str, list[str], list[list[str]]]] = []
    if found.pairs:
        rows = []
        for pair in found.pairs:
            a, b = pair.lidars
            values = [millimetres(pair.distance_m.get(stage)) for stage in STAGES]
            expected = millimetres(pair.expected_m if pair.surfaces else None)
            clouds = [millimetres(pair.cloud_m[stage]) for stage in (BEFORE, AFTER)]
            overlap = " / ".join(f"{100.0 * pair.overlap[s]:.0f}" for s in (BEFORE, AFTER))
            rows.append([f"{a} to {b}", str(pair.surfaces), *values, expected, *clouds, overlap])
        headings = ["", "walls,\npoles", "before\nmm", "after\nmm", "best\nmm", "expected\nmm"]
        headings += ["cloud\nbefore mm", "cloud\nafter mm", "overlap\n%"]
        out.append(
            ("Distance between LiDARs: on walls and poles, and from cloud to cloud", headings, rows)
        )
    if found.surfaces:
        rows = [
            [
                "merged",
                *(millimetres(found.thickness_m[stage]) for stage in STAGES),
                millimetres(found.expected_thickness_m),
            ]
        ]
        rows += [
            [
                f"{name} alone",
                *(millimetres(found.alone_m[stage].get(name)) for stage in STAGES),
                millimetres(found.expected_alone_m.get(name)),
            ]
            for name in found.lidars
        ]
        headings = ["", "before\nmm", "after\nmm", "best\nmm", "expected\nmm"]
        out.append(("Thickness of walls and poles, RMS", headings, rows))
        headings = ["", "at x y\nm", "size\nm", "points", "thick\nbefore mm", "thick\nafter mm"]
        headings += ["apart\nbefore mm", "apart\nafter mm", "expected\nmm"]
        shown = found.surfaces[:MOST_SHOWN]
        title = f"The {len(shown)} largest of {len(found.surfaces)} walls and poles"
        out.append((title, headings, [_surface_row(s) for s in shown]))
    if found.things:
        headings = ["", "at x y\nm", "size\nm", "points", "apart\nbefore mm", "apart\nafter mm"]
        rows = [_thing_row(t) for t in found.things[:MOST_SHOWN]]
        out.append(
            (
                "Objects: mean distance from the other LiDAR's nearest point",
                [*headings, "best\nmm"],
                rows,
            )
        )
    if found.held_out is not None:
        out += held_out_tables(found.held_out, found.before)
    return out


def repeatability_sentences(repeated: Repeatability, p_value: float) -> list[str]:
    """The comparison of the two halves of the drive, in sentences."""
    comparison = repeated.comparison
    if comparison is None:
        return [f"not tested: {repeated.reason}"]
    first, second = repeated.halves
    out = [f"{first} against {second}, largest differences along determined axes:"]
    for movement in comparison.movements:
        name = " to ".join(movement.lidars)
        if not movement.dof:
            out.append(f"{name}: no direction is determined by both halves")
            continue
        kinds = []
        for axes, unit in ((slice(3, 6), "mm"), (slice(0, 3), "mrad")):
            known = [
                (abs(d), s)
                for d, s, t in zip(
                    movement.movement[axes],
                    movement.sigma[axes],
                    movement.determined[axes],
                    strict=True,
                )
                if t
            ]
            if known:
                d, s = max(known)
                kinds.append(f"{1e3 * d:.2f} {unit} (sigma {1e3 * s:.2f})")
        kind = "S2S" if len(movement.lidars) == 2 else "S2V"
        out.append(
            f"{kind} {name}: {', '.join(kinds) or 'no single axis is determined'}; chi2 "
            f"{movement.chi2:.1f} with {movement.dof} dof, p {movement.p_value:.2g}"
        )
    out.append(_repeats(comparison, p_value))
    if not repeated.by_passes:
        out.append(
            "these halves share the errors of the trajectory, so two drives would differ more; for "
            "a better test, drive past the target twice"
        )
    return out


def _repeats(comparison: Comparison, p_value: float) -> str:
    if not any(m.dof for m in comparison.movements):
        return "no direction is determined by both halves"
    verdict = (
        "differ by more than their sigmas explain"
        if comparison.moved
        else "agree within their sigmas"
    )
    return (
        f"the halves {verdict} (joint test: chi2 {comparison.chi2:.1f} with {comparison.dof} dof; "
        f"limit p {p_value:g} over all tests)"
    )


def validation_document(
    found: Validation, repeated: Repeatability | None, p_value: float
) -> dict[str, Any]:
    """A validation as plain values: metres; null where a value cannot be computed."""
    verdict = found.verdict
    document: dict[str, Any] = {
        "drive": found.drive,
        "structure": found.has_structure,
        "verdict": verdict.word,
        "unseen": found.unseen,
        "test": {
            "text": " ".join(verdict.sentences),
            "better": verdict.better,
            "measure": verdict.measure if found.surfaces else None,
            "of_expected": verdict.of_expected,
            "chi2": verdict.chi2 if verdict.dof else None,
            "dof": verdict.dof,
            "p_value": verdict.p_value,
            "contradicts": verdict.contradicts,
        },
        "scans": dict(found.scans),
        "pairs": [
            {
                "from": pair.lidars[0],
                "to": pair.lidars[1],
                "surfaces": pair.surfaces,
                "distance_m": {s: pair.distance_m.get(s) for s in STAGES},
                "expected_distance_m": pair.expected_m if pair.surfaces else None,
                "cloud_to_cloud_m": dict(pair.cloud_m),
                "overlap": dict(pair.overlap),
            }
            for pair in found.pairs
        ],
        "thickness_m": {
            "merged": {s: v if found.surfaces else None for s, v in found.thickness_m.items()},
            "expected_merged": found.expected_thickness_m if found.surfaces else None,
            "lidars": {
                name: {
                    **{stage: found.alone_m[stage].get(name) for stage in STAGES},
                    "expected": found.expected_alone_m.get(name),
                }
                for name in found.lidars
            },
        },
        "surfaces": [_surface_document(surface) for surface in found.surfaces],
        "objects": [_thing_document(thing) for thing in found.things],
        "held_out": None if found.held_out is None else held_out_document(found.held_out),
        "repeatability": None,
    }
    if repeated is not None:
        comparison = repeated.comparison
        document["repeatability"] = {
            "halves": list(repeated.halves),
            "by_passes": repeated.by_passes,
            "not_done": repeated.reason or None,
            "agree": None if comparison is None else not comparison.moved,
            "comparison": None
            if comparison is None
            else comparison_document(comparison, repeated.halves, p_value),
        }
    return document


def _surface_document(found: SurfaceResult) -> dict[str, Any]:
    return {
        **_place_document(found, found.surface),
        "thickness_m": {s: t.merged for s, t in found.thickness.items()},
        "expected_thickness_m": found.expected.merged,
        "alone_m": {s: dict(t.alone) for s, t in found.thickness.items()},
        "pairs": [
            {
                "from": a,
                "to": b,
                "distance_m": {
                    s: apart[a, b].distance_m if (a, b) in apart else None
                    for s, apart in found.apart.items()
                },
                "expected_distance_m": found.expected.distance_m.get((a, b)),
            }
            for a, b in found.apart[AFTER]
        ],
    }


def _thing_document(found: ThingResult) -> dict[str, Any]:
    return {
        **_place_document(found, found.thing),
        "pairs": [
            {
                "from": a,
                "to": b,
                "distance_m": {s: d.get((a, b)) for s, d in found.distance_m.items()},
            }
            for a, b in found.distance_m[AFTER]
        ],
    }


def _place_document(
    found: SurfaceResult | ThingResult, where: Wall | Pole | Thing
) -> dict[str, Any]:
    x, y, size = place_of(where)
    return {
        "name": found.name,
        "xy_map_m": [x, y],
        "size_m": list(size),
        "points": dict(found.points),
    }


def place_of(surface: Wall | Pole | Thing) -> tuple[float, float, tuple[float, ...]]:
    """Position in the map, x and y in metres, and sizes in metres.

    The sizes are the two lengths of a wall, diameter and height of a pole, width of an object.
    """
    if isinstance(surface, Wall):
        return float(surface.centre[0]), float(surface.centre[1]), surface.extent_m
    if isinstance(surface, Pole):
        x, y = (float(v) for v in surface.foot)
        return x, y, (2.0 * surface.radius_m, surface.height_m)
    return float(surface.centre[0]), float(surface.centre[1]), (surface.extent_m,)


def _place_cells(found: SurfaceResult | ThingResult, where: Wall | Pole | Thing) -> list[str]:
    x, y, size = place_of(where)
    return [
        found.name,
        f"{x:.1f} {y:.1f}",
        " x ".join(f"{v:.2f}" for v in size),
        _lines(str(n) for n in found.points.values()),
    ]


def _surface_row(found: SurfaceResult) -> list[str]:
    pairs = list(found.apart[AFTER])
    apart = [
        _lines(
            millimetres(found.apart[s][p].distance_m if p in found.apart[s] else None)
            for p in pairs
        )
        for s in (BEFORE, AFTER)
    ]
    return [
        *_place_cells(found, found.surface),
        millimetres(found.thickness[BEFORE].merged),
        millimetres(found.thickness[AFTER].merged),
        *apart,
        _lines(millimetres(found.expected.distance_m.get(p)) for p in pairs),
    ]


def _thing_row(found: ThingResult) -> list[str]:
    pairs = list(found.distance_m[AFTER])
    apart = (_lines(millimetres(found.distance_m[s].get(p)) for p in pairs) for s in STAGES)
    return [*_place_cells(found, found.thing), *apart]


def _lines(texts: Iterable[str]) -> str:
    return "\n".join(texts) or UNKNOWN


def render_validation(found: Validation, repeated: Repeatability | None, p_value: float) -> str:
    """validation.html: one self-contained page with figures before and after, coloured by LiDAR.

    `p_value` is the limit of the tests of repeatability; `repeated` None: not tested.
    """
    # Imported here: the tables need no plotly.
    from plotly.offline import get_plotlyjs

    from caliv_graph.report.figures.strips import held_out_figures
    from caliv_graph.report.figures.structure import validation_figures
    from caliv_graph.report.page import environment, script_data

    figures = validation_figures(found)
    if found.held_out is not None:
        figures += held_out_figures(found.held_out)
    template = environment().get_template("validation.html.j2")
    return template.render(
        found=found,
        status=validation_status(found),
        unseen=found.unseen,
        tables=tables(found),
        repeated=[] if repeated is None else repeatability_sentences(repeated, p_value),
        held_out_heads=HELD_OUT_HEADS,
        held_out_rows=held_out_rows(found.held_out) if found.held_out is not None else [],
        figures=figures,
        data={figure.name: script_data(figure) for figure in figures},
        plotlyjs=Markup(get_plotlyjs()),
        version=caliv_graph.__version__,
    )
