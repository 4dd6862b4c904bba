"""Tables and JSON of the structure that a validation holds out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from caliv_graph.conventions import AXES
from caliv_graph.report.layout import UNKNOWN, millimetres
from caliv_graph.report.surfaces import kind_of, place_text
from caliv_graph.validation.findings import (
    AFTER,
    BEFORE,
    WITHOUT,
    HeldOutStructure,
    HeldStrip,
    PairTest,
)

HELD_OUT_HEADS = (
    "",
    "what",
    "at x y z\nm",
    "LiDARs\n(scans)",
    "apart\nbefore mm",
    "apart\nafter mm",
    "apart with-\nout it mm",
    "expected\nmm",
    "thick\nbefore mm",
    "thick\nafter mm",
    "expected\nmm",
)


def held_out_rows(found: HeldOutStructure) -> list[list[str]]:
    """Cells of each held-out strip, in the order of the result: `HELD_OUT_HEADS`."""
    return [_held_row(strip) for strip in found.strips]


def _held_row(strip: HeldStrip) -> list[str]:
    what = kind_of(strip.normal_map)
    apart = [_lines(strip.distance_m[stage]) for stage in (BEFORE, AFTER, WITHOUT)]
    return [
        strip.name,
        what if strip.tested or not strip.distance_m[AFTER] else f"{what}, irregular",
        place_text(strip.centre_map),
        "\n".join(f"{name} ({count})" for name, count in strip.scans.items()),
        *apart,
        _lines(strip.sigma_m[AFTER]),
        *(_known(strip.thickness_m[stage]) for stage in (BEFORE, AFTER)),
        _known(strip.expected_thickness_m[AFTER]),
    ]


def _lines(values: Mapping[tuple[str, str], float]) -> str:
    return "\n".join(f"{1e3 * value:.1f}" for value in values.values()) or "-"


def held_out_tables(
    held: HeldOutStructure, before: str
) -> list[tuple[str, list[str], list[list[str]]]]:
    """The table of the held-out structure, all strips together; `before`: what that is."""
    rows = []
    for what, stage in (
        (before, BEFORE),
        ("calibration", AFTER),
        ("calibration without these strips", WITHOUT),
    ):
        test = held.tests.get(stage)
        tested = test is not None and test.dof > 0
        rows.append(
            [
                what,
                millimetres(held.distance_m[stage] if held.tested else None),
                millimetres(test.expected_m if test is not None and tested else None),
                f"{test.chi2:.0f} / {test.dof}" if test is not None and tested else UNKNOWN,
                f"{test.p_value:.2g}" if test is not None and tested else UNKNOWN,
                millimetres(held.thickness_m(stage) if held.tested else None),
                millimetres(held.expected_thickness_m(stage) if tested else None),
            ]
        )
    title = (
        f"Held-out structure: {len(held.tested)} strips that two LiDARs see, of {len(held.strips)} "
        f"in {len(held.tiles_map_m)} of {held.tiles_of} tiles of {held.tile_m:.0f} m"
    )
    heads = ["", "apart\nmm", "expected\nmm", "chi2 /\ndof", "p", "thick\nmm", "expected\nmm"]
    return [(title, heads, rows)]


def held_out_document(held: HeldOutStructure) -> dict[str, Any]:
    """The held-out structure as plain values: metres, map."""
    return {
        "tile_m": held.tile_m,
        "tiles": len(held.tiles_map_m),
        "of_tiles": held.tiles_of,
        "tiles_map_m": held.tiles_map_m.tolist(),
        "distance_m": dict(held.distance_m) if held.tested else None,
        "tests": {
            stage: {
                "chi2": test.chi2 if test.dof else None,
                "dof": test.dof,
                "p_value": test.p_value,
                "expected_distance_m": test.expected_m if test.dof else None,
            }
            for stage, test in held.tests.items()
        },
        "s2s": [_pair_document(test) for test in held.pairs],
        "strips": [_held_document(strip) for strip in held.strips],
    }


def _pair_document(test: PairTest) -> dict[str, Any]:
    """S2S of the calibration less that by structure; rad and m, null where it tells nothing."""
    known = dict(zip(AXES, test.determined, strict=True))
    return {
        "from": test.lidars[0],
        "to": test.lidars[1],
        "chi2": test.chi2 if test.dof else None,
        "dof": test.dof,
        "p_value": test.p_value,
        **{
            what: {
                axis: float(v) if known[axis] else None for axis, v in zip(AXES, of, strict=True)
            }
            for what, of in (("off", test.off), ("sigma", test.sigma))
        },
    }


def _held_document(strip: HeldStrip) -> dict[str, Any]:
    return {
        "name": strip.name,
        "surface": strip.surface,
        "xyz_map_m": strip.centre_map.tolist(),
        "normal_map": strip.normal_map.tolist(),
        "scans": dict(strip.scans),
        "tested": strip.tested,
        "thickness_m": dict(strip.thickness_m),
        "expected_thickness_m": dict(strip.expected_thickness_m),
        "pairs": [
            {
                "from": a,
                "to": b,
                "distance_m": {s: of[a, b] for s, of in strip.distance_m.items()},
                "sigma_m": {s: of[a, b] for s, of in strip.sigma_m.items()},
            }
            for a, b in strip.distance_m[AFTER]
        ],
    }


def _known(value_m: float) -> str:
    return millimetres(value_m if math.isfinite(value_m) else None)
