"""A first picture of a flat figure, as SVG: a browser shows it while plotly.js is still being read.

Points and lines in their panels, without axes. plotly.js draws the whole figure in its place.
"""

from __future__ import annotations

from itertools import repeat
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from caliv_graph.products import Array
from caliv_graph.report.figures.drawing import GREY, WIDTH, Figure, evenly
from caliv_graph.report.figures.plot import Plot

MOST_POINTS = 500
"""Of one trace."""

_GREY_RULE = "#C8C8C8"


def still(figure: Figure) -> Markup:
    """The picture; empty for 3-D views and for figures with anything but points and lines."""
    plot = figure.figure
    traces = [trace for trace in plot.data if trace.get("visible") is not False]
    if figure.solid or not traces or any(trace["type"] != "scatter" for trace in traces):
        return Markup("")
    height = int(plot.layout["height"])
    panels = [
        _panel(plot, traces, name, height) for name in dict.fromkeys(t["xaxis"] for t in traces)
    ]
    inside = "".join(panel for panel in panels if panel)
    if not inside:
        return Markup("")
    label = escape(figure.caption)
    return Markup(
        f'<svg class="first" viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{label}">'
        f"{inside}</svg>"
    )


def _panel(plot: Plot, traces: list[dict[str, Any]], x_name: str, height: int) -> str:
    """One panel: its frame, and which of the traces lie in it."""
    number = x_name.removeprefix("x")
    axes = plot.layout.get(f"xaxis{number}", {}), plot.layout.get(f"yaxis{number}", {})
    margin = plot.layout["margin"]
    box = []
    for axis, low, high in (
        (axes[0], margin["l"], WIDTH - margin["r"]),
        (axes[1], height - margin["b"], margin["t"]),
    ):
        begin, end = axis.get("domain", (0.0, 1.0))
        box.append((low + (high - low) * begin, low + (high - low) * end))
    shown = [t for t in traces if t["xaxis"] == x_name and len(t.get("x", ())) > 0]
    if not shown or any(not _numbers(t["x"]) or not _numbers(t["y"]) for t in shown):
        return ""
    places = [
        [_along(axis, trace[key]) for axis, key in zip(axes, "xy", strict=True)] for trace in shown
    ]
    spans = [
        axis.get("range") or _span([place[i] for place in places]) for i, axis in enumerate(axes)
    ]
    if axes[1].get("scaleanchor"):
        _equal(spans, box)
    (x0, x1), (y1, y0) = box
    parts = [
        f'<rect x="{x0:.0f}" y="{y0:.0f}" width="{x1 - x0:.0f}" height="{y1 - y0:.0f}" '
        f'fill="none" stroke="{_GREY_RULE}"/>'
    ]
    return "".join([*parts, *map(_trace, shown, places, repeat(spans), repeat(box))])


def _along(axis: dict[str, Any], values: Any) -> Array:
    """Values (n,) in the unit of the range of their axis: on a log axis, the logarithm to 10."""
    numbers = np.asarray(values, np.float64)
    if axis.get("type") != "log":
        return numbers
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.log10(numbers))


def _trace(
    trace: dict[str, Any], place: list[Array], spans: list[Any], box: list[tuple[float, float]]
) -> str:
    """The points or the line of one trace; `place` are its x and y."""
    pixels = []
    for values, span, (low, high) in zip(place, spans, box, strict=True):
        pixels.append(low + (high - low) * (values - span[0]) / (span[1] - span[0]))
    x, y = (values[evenly(len(values), MOST_POINTS)] for values in pixels)
    with np.errstate(invalid="ignore"):
        inside = (x >= min(box[0])) & (x <= max(box[0])) & (y >= min(box[1])) & (y <= max(box[1]))
    # A line is broken where it leaves the panel or has no value.
    follows = inside & np.concatenate([[False], inside[:-1]])
    x, y, follows = x[inside], y[inside], follows[inside]
    is_line = "lines" in trace.get("mode", "lines")
    look = trace.get("line" if is_line else "marker", {})
    colour = look.get("color", GREY)
    colour = escape(colour if isinstance(colour, str) else GREY)
    dot = "" if is_line else "h0"
    path = "".join(
        f"{'L' if is_line and on else 'M'}{a:.1f} {b:.1f}{dot}"
        for a, b, on in zip(x.tolist(), y.tolist(), follows.tolist(), strict=True)
    )
    return (
        f'<path d="{path}" fill="none" stroke="{colour}" stroke-linecap="round" '
        f'stroke-width="{1.5 if is_line else 3}"/>'
    )


def _numbers(values: Any) -> bool:
    return np.asarray(values).dtype.kind in "fiu"


def _span(parts: list[Array]) -> tuple[float, float]:
    """Least and greatest of some values, with a margin."""
    values = np.concatenate(parts)
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    margin = 0.05 * (high - low) or 0.5
    return low - margin, high + margin


def _equal(spans: list[Any], box: list[tuple[float, float]]) -> None:
    """Widens one span, so that a metre is as long in both directions."""
    size = [abs(high - low) for low, high in box]
    metre = max((span[1] - span[0]) / pixels for span, pixels in zip(spans, size, strict=True))
    for i, (low, high) in enumerate(spans):
        middle, half = 0.5 * (low + high), 0.5 * metre * size[i]
        spans[i] = (middle - half, middle + half)
