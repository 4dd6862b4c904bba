"""Figures of strips of structure: where they are, and how thick they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from caliv_graph.geometry.se3 import tangent_axes
from caliv_graph.products import Array, Solution, Strip, StructureTerm
from caliv_graph.report.figures.drawing import (
    BLUE,
    VERMILLION,
    Figure,
    finish,
    label,
    small,
)
from caliv_graph.report.figures.plot import Plot
from caliv_graph.validation.findings import AFTER, BEFORE, WITHOUT, HeldOutStructure

HALF_M = 0.8
"""Half the edge of the square that is drawn for a strip: of the cells of 2 m, gaps are left."""

PART = 0.95
"""Part of the strips within the range of the colours: a few outliers would make all others pale."""

LEAST_MM = 0.1
"""Smallest value on a logarithmic axis."""

THICK = [[0.0, "#E8F1F8"], [0.5, "#56B4E9"], [1.0, "#08306B"]]
SIGNED = [[0.0, "#0072B2"], [0.5, "#F2F2F2"], [1.0, "#D55E00"]]


@dataclass(frozen=True)
class Shade:
    """What colours strips.

    Attributes:
        name: on its button.
        values_mm: (K,) NaN: not drawn, nothing is known.
        signed: whether zero is the middle of the colours.
    """

    name: str
    values_mm: Array
    signed: bool


def strip_figure(term: StructureTerm, name: str) -> Figure | None:
    """The strips of a drive in 3-D; None if none has weight."""
    strips = [strip for strip in term.strips if strip.weight > 0.0]
    if not strips:
        return None
    nothing = float("nan")
    shades = [Shade("thickness", 1e3 * np.array([s.scatter_m for s in strips]), signed=False)]
    shades += [
        Shade(lidar, 1e3 * np.array([s.residuals_m.get(lidar, nothing) for s in strips]), True)
        for lidar in term.T_vehicle_lidar
    ]
    return Figure(
        f"strips_{term.drive}",
        f"Recording '{name}': the strips of walls and ground that were used, in the map. Colour: "
        "thickness, which is how far single scans see a strip from one plane (root mean square); "
        "or the mean distance of a LiDAR from the strip, positive towards the side that is seen.",
        _squares(
            np.array([s.centre_map for s in strips]),
            np.array([s.normal_map for s in strips]),
            shades,
        ),
        solid=True,
    )


def thickness_figure(solution: Solution, before: str) -> Figure | None:
    """Thickness of all strips before and after, as shares; None without strips.

    `before` says what that is.
    """
    strips = used_strips(solution)
    if not strips:
        return None
    figure = _shares(
        {
            "before": ([s.before_m for s in strips], VERMILLION),
            "after": ([s.scatter_m for s in strips], BLUE),
        }
    )
    return Figure(
        "thickness",
        f"Share of the strips that are thinner than a value: with {before} on the "
        "trajectory of the motion data, and after the calibration.",
        figure,
    )


def used_strips(solution: Solution) -> list[Strip]:
    """The strips with weight, of all drives."""
    return [s for term in solution.structure for s in term.strips if s.weight > 0.0]


def held_out_figures(found: HeldOutStructure) -> list[Figure]:
    """The held-out strips in 3-D, and their thickness."""
    strips = found.strips
    if not strips:
        return []
    shades = [
        Shade(
            f"apart, {what}",
            1e3 * np.array([_largest(s.distance_m[stage]) for s in strips]),
            signed=True,
        )
        for stage, what in ((AFTER, "after"), (WITHOUT, "without them"), (BEFORE, "before"))
    ]
    thick = 1e3 * np.array([s.thickness_m[AFTER] for s in strips])
    shades.append(Shade("thickness, after", thick, signed=False))
    where = _squares(
        np.array([s.centre_map for s in strips]), np.array([s.normal_map for s in strips]), shades
    )
    shares = _shares(
        {
            "before": ([s.thickness_m[BEFORE] for s in strips], VERMILLION),
            "after": ([s.thickness_m[AFTER] for s in strips], BLUE),
        }
    )
    return [
        Figure(
            "held-out",
            "The held-out strips in the map. Colour: distance between two LiDARs (of more, the "
            "largest), or thickness.",
            where,
            solid=True,
        ),
        Figure("held-out-thickness", "Share of the held-out strips thinner than a value.", shares),
    ]


def _largest(distances: Mapping[Any, float]) -> float:
    """The value that is farthest from zero; NaN of none."""
    return max(distances.values(), key=abs, default=float("nan"))


def _squares(centres: Array, normals: Array, shades: Sequence[Shade]) -> Plot:
    """Squares in 3-D, a mesh per shade; buttons choose the one that is shown."""
    axes = HALF_M * tangent_axes(normals)
    corners = np.stack(
        [
            centres + a * axes[:, 0] + b * axes[:, 1]
            for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))
        ],
        axis=1,
    )
    corners -= centres.mean(axis=0)
    buttons = [
        {
            "label": label(shade.name),
            "method": "restyle",
            "args": [{"visible": [i == k for k in range(len(shades))]}],
        }
        for i, shade in enumerate(shades)
    ]
    low, high = corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)
    spans = {
        f"{axis}axis": {"title": {"text": ""}, "range": [float(a) - 1.0, float(b) + 1.0]}
        for axis, a, b in zip("xyz", low, high, strict=True)
    }
    figure = Plot(solid=True)
    for i, shade in enumerate(shades):
        figure.add("mesh3d", **_mesh(corners, shade, shown=i == 0))
    figure.scenes(aspectmode="data", camera={"eye": {"x": -0.9, "y": -0.9, "z": 0.9}}, **spans)
    finish(figure, 520, legend=False)
    figure.layout["updatemenus"] = [
        {
            "buttons": buttons,
            "type": "buttons",
            "direction": "right",
            "x": 0.0,
            "xanchor": "left",
            "y": 1.12,
        }
    ]
    figure.layout["margin"] = {**figure.layout["margin"], "t": 90}
    return figure


def _mesh(corners: Array, shade: Shade, shown: bool) -> dict[str, Any]:
    """The squares of which the value is known; corners (K, 4, 3) metres."""
    known = np.flatnonzero(np.isfinite(shade.values_mm))
    x, y, z = small(corners[known].reshape(-1, 3)).T
    first = 4 * np.arange(len(known), dtype=np.int32)
    values = shade.values_mm[known]
    size = float(np.quantile(np.abs(values), PART)) if len(known) else 0.0
    size = max(size, 1e-3)
    return {
        "x": x,
        "y": y,
        "z": z,
        "i": np.repeat(first, 2),
        "j": np.stack([first + 1, first + 2], axis=1).ravel(),
        "k": np.stack([first + 2, first + 3], axis=1).ravel(),
        "intensity": small(np.repeat(values, 2)),
        "intensitymode": "cell",
        "colorscale": SIGNED if shade.signed else THICK,
        "cmin": -size if shade.signed else 0.0,
        "cmax": size,
        "colorbar": {"title": {"text": "mm"}, "len": 0.8},
        "flatshading": True,
        "lighting": {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0},
        "hoverinfo": "skip",
        "visible": shown,
    }


def _shares(curves: Mapping[str, tuple[Sequence[float], str]]) -> Plot:
    """The share of values (metres) below each, over millimetres."""
    figure = Plot()
    for name, (values_m, colour) in curves.items():
        values = np.sort(1e3 * np.array([v for v in values_m if np.isfinite(v)]))
        figure.add(
            "scatter",
            x=small(np.maximum(values, LEAST_MM)),
            y=small(100.0 * np.arange(1, len(values) + 1) / max(len(values), 1)),
            mode="lines",
            line={"color": colour, "dash": "dot" if name.startswith("before") else "solid"},
            name=name,
        )
    figure.x_axes(title="thickness (mm)", type="log")
    figure.y_axes(title="share of the strips (%)", range=[0, 100])
    finish(figure, 320)
    return figure
