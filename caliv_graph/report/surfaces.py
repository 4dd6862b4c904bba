"""The table of the surfaces that a calibration used."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caliv_graph.products import Array, Solution, Strip
from caliv_graph.report.layout import millimetres
from caliv_graph.structure.strips import LEVEL

MOST_ROWS = 40
"""Rows of a table; figures show all strips, and the JSON document lists all."""

_HEADINGS = (
    "east",
    "north-east",
    "north",
    "north-west",
    "west",
    "south-west",
    "south",
    "south-east",
)


def surface_rows(solution: Solution, drives: Sequence[str]) -> list[list[str]]:
    """Cells of each surface, those that most scans see first: `SURFACE_HEADS`."""
    surfaces: dict[tuple[int, int], list[Strip]] = {}
    for term in solution.structure:
        for strip in term.strips:
            if strip.weight > 0.0:
                surfaces.setdefault((term.drive, strip.surface), []).append(strip)
    order = sorted(surfaces, key=lambda key: -sum(sum(s.scans.values()) for s in surfaces[key]))
    return [_surface_row(drives[drive], surfaces[drive, i]) for drive, i in order]


SURFACE_HEADS = (
    "surface",
    "drive",
    "at x y z, m",
    "strips",
    "LiDARs (strips that each sees)",
    "thickness before, mm",
    "thickness after, mm",
)


def _surface_row(drive: str, strips: Sequence[Strip]) -> list[str]:
    seen: dict[str, int] = {}
    for strip in strips:
        for name in strip.scans:
            seen[name] = seen.get(name, 0) + 1
    normal = np.mean([strip.normal_map for strip in strips], axis=0)
    return [
        kind_of(normal),
        drive,
        place_text(np.mean([strip.centre_map for strip in strips], axis=0)),
        str(len(strips)),
        ", ".join(f"{name} ({count})" for name, count in seen.items()),
        _median_mm([strip.before_m for strip in strips]),
        _median_mm([strip.scatter_m for strip in strips]),
    ]


def _median_mm(values_m: Sequence[float]) -> str:
    """Of the strips of which it is known: one scan alone has no thickness."""
    known = [value for value in values_m if np.isfinite(value)]
    return millimetres(float(np.median(known)) if known else None)


def kind_of(normal: Array) -> str:
    """Ground, or where in the map a wall faces."""
    if abs(normal[2]) > LEVEL * np.linalg.norm(normal):
        return "ground"
    eighth = round(float(np.arctan2(normal[1], normal[0])) / (np.pi / 4.0)) % 8
    return f"wall that faces {_HEADINGS[eighth]}"


def place_text(centre: Array) -> str:
    """x, y and z of a place (3,) in metres."""
    return " ".join(f"{value:.1f}" for value in centre)
