"""Figures of validation.html: walls, poles and objects, before and after calibration."""

from __future__ import annotations

from typing import Any

import numpy as np

from caliv_graph.products import Array, IntArray
from caliv_graph.report.figures.drawing import SYMBOLS, Figure, colours, finish, label, small
from caliv_graph.report.figures.plot import Plot
from caliv_graph.validation.findings import AFTER, BEFORE, Validation

MOST_POINTS = 2500
"""Points of one LiDAR in one picture."""

WALLS, POLES, THINGS = 2, 2, 2
"""Numbers of figures: the largest walls, poles and objects are shown."""


def validation_figures(found: Validation) -> list[Figure]:
    """Figures from above, along walls, of poles and of objects; empty without structure."""
    if not len(found.clouds.lidar):
        return []
    out = [_top_view(found)]
    walls = [s for s in found.surfaces if s.name.startswith(("wall", "ground"))][:WALLS]
    poles = [s for s in found.surfaces if s.name.startswith("pole")][:POLES]
    points = {stage: found.points_map(stage) for stage in (BEFORE, AFTER)}
    for number, surface in enumerate(walls, start=1):
        wall: Any = surface.surface
        views = {
            stage: np.column_stack(
                [
                    (p[wall.members] - wall.centre) @ wall.axes[0],
                    1e3 * (p[wall.members] - wall.centre) @ wall.normal,
                ]
            )
            for stage, p in points.items()
        }
        figure = _two(
            found, wall.members, views, ("along (m)", "across (mm)"), equal=False, height=330
        )
        out.append(
            Figure(
                f"wall-{number}",
                f"{surface.name}: its points from above, with the direction across it enlarged a "
                "hundred times or more. Where colours separate, the LiDARs disagree. Where one "
                "colour is thick, the extrinsic of that LiDAR is wrong.",
                figure,
            )
        )
    for number, surface in enumerate(poles, start=1):
        pole: Any = surface.surface
        views = {stage: p[pole.members, :2] - pole.foot for stage, p in points.items()}
        figure = _two(found, pole.members, views, ("x (m)", "y (m)"), equal=True, height=480)
        out.append(
            Figure(
                f"pole-{number}",
                f"{surface.name} from above, {2e3 * pole.radius_m:.0f} mm thick. All colours lie "
                "on one outline, round or square as the post is, if the extrinsics are right.",
                figure,
            )
        )
    for number, result in enumerate(found.things[:THINGS], start=1):
        thing = result.thing
        for kind, axes, heads in (
            ("above", [0, 1], ("x (m)", "y (m)")),
            ("the side", [0, 2], ("x (m)", "z (m)")),
        ):
            views = {s: (p[thing.members] - thing.centre)[:, axes] for s, p in points.items()}
            out.append(
                Figure(
                    f"object-{number}-{'top' if kind == 'above' else 'side'}",
                    f"{result.name} from {kind}.",
                    _two(found, thing.members, views, heads, equal=True, height=480),
                )
            )
    return out


def _top_view(found: Validation) -> Figure:
    members = np.arange(len(found.clouds.lidar), dtype=np.int64)
    views = {stage: found.points_map(stage)[:, :2] for stage in (BEFORE, AFTER)}
    figure = _two(found, members, views, ("x (m)", "y (m)"), equal=True, height=560, closer=False)
    return Figure(
        "top",
        "Structure around the drive from above, in the map, without ground and target. Zoom in: "
        "both pictures move together.",
        figure,
    )


def _two(
    found: Validation,
    members: IntArray,
    views: dict[str, Array],
    heads: tuple[str, str],
    *,
    equal: bool,
    height: int,
    closer: bool = True,
) -> Plot:
    """Before and after side by side at one scale; closer: after at its own scale, too."""
    stages = {"before": BEFORE, "after": AFTER, **({"after, closer": AFTER} if closer else {})}
    figure = Plot(tuple(stages))
    lidar = found.clouds.lidar[members]
    colour = colours(found.lidars)
    for i, name in enumerate(found.lidars):
        own = np.flatnonzero(lidar == i)
        if not len(own):
            continue
        if len(own) > MOST_POINTS:
            rng = np.random.default_rng(0)
            own = own[np.sort(rng.choice(len(own), MOST_POINTS, replace=False))]
        for panel, stage in enumerate(stages.values(), start=1):
            figure.add(
                "scatter",
                x=small(views[stage][own, 0]),
                y=small(views[stage][own, 1]),
                mode="markers",
                marker={
                    "color": colour[name],
                    "symbol": f"{SYMBOLS[i % len(SYMBOLS)]}-open",
                    "size": 4,
                    "line": {"width": 0.7},
                },
                name=label(name),
                legendgroup=name,
                showlegend=panel == 1,
                hovertemplate="%{x:.3f}, %{y:.3f}",
                panel=panel,
            )
    figure.x_axes(title=heads[0])
    figure.y_axes(title=heads[1], panel=1)
    figure.x_axes(matches="x", panel=2)
    figure.y_axes(matches="y", panel=2)
    if equal:
        # The second pair of axes follows the first.
        figure.y_axes(scaleanchor="x", panel=1)
        if closer:
            figure.y_axes(scaleanchor="x3", panel=3)
        figure.x_axes(constrain="domain")
        figure.y_axes(constrain="domain")
        # Stated: of linked axes plotly.js 3 makes a range of their own with nothing in it.
        both = np.concatenate([views[stage] for stage in (BEFORE, AFTER)])
        for panel, shown in enumerate((both, both, views[AFTER])[: len(stages)], start=1):
            x, y = _ranges(shown)
            figure.x_axes(range=x, panel=panel)
            figure.y_axes(range=y, panel=panel)
    finish(figure, height)
    return figure


def _ranges(points: Array) -> tuple[list[float], list[float]]:
    """Ranges of x and y that show all points (n, 2), with a rim of 5 percent."""
    if not len(points):
        return [-1.0, 1.0], [-1.0, 1.0]
    low, high = points.min(axis=0), points.max(axis=0)
    rim = 0.05 * max(float((high - low).max()), 1e-3)
    x, y = zip((low - rim).tolist(), (high + rim).tolist(), strict=True)
    return list(x), list(y)
