"""What all figures share: colours, names, layout, thinning of data, and JSON for plotly.js.

The colours are those of Okabe and Ito (2008), which colour-blind readers can tell apart. What
matters differs in its marker or dash as well, for print.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from html import escape
from typing import Any

import numpy as np
import numpy.typing as npt
import plotly.graph_objects as go
from plotly.io import templates
from plotly.io.json import to_json_plotly

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import IntArray
from caliv_graph.trajectory.select import VehicleTrajectory

BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BLACK, GREY = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#000000",
    "#767676",
)

LIDAR_COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BLACK)

SYMBOLS = ("circle", "square", "diamond", "cross", "x", "triangle-up", "star")

WIDTH = 980
"""Pixels. A printed page is scaled to its paper."""

LONGEST_NAME = 20
"""Letters of a name in a figure; tables show the whole name."""


@dataclass(frozen=True)
class Figure:
    """A figure and its caption.

    Attributes:
        name: unique on the page; names the element.
        solid: whether it is a 3-D view.
    """

    name: str
    caption: str
    figure: go.Figure
    solid: bool = False


@contextmanager
def without_template() -> Iterator[None]:
    """Creates figures without a template, which plotly would validate again at every step."""
    before = templates.default
    templates.default = None
    try:
        yield
    finally:
        templates.default = before


def figure_json(figure: Figure) -> str:
    """JSON for plotly.js: data, layout and template."""
    document = figure.figure.to_plotly_json()
    document["layout"]["template"] = _template()
    return str(to_json_plotly(document))


@cache
def _template() -> Mapping[str, Any]:
    found: Mapping[str, Any] = templates["plotly_white"].to_plotly_json()
    return found


def label(text: str) -> str:
    """A user's name as text for plotly, which would interpret tags such as `<b>` and `<a>`."""
    return escape(text, quote=False)


def labels(lidars: Iterable[str]) -> dict[str, str]:
    """A label per LiDAR. Long names are shortened if the short names stay distinct."""
    names = list(lidars)
    half = LONGEST_NAME // 2
    short = {
        name: name if len(name) <= LONGEST_NAME else f"{name[:half]}…{name[1 - half :]}"
        for name in names
    }
    distinct = len(set(short.values())) == len(names)
    return {name: label(short[name] if distinct else name) for name in names}


def colours(lidars: Sequence[str]) -> dict[str, str]:
    """A colour per LiDAR, by its position in the config."""
    return {name: LIDAR_COLOURS[i % len(LIDAR_COLOURS)] for i, name in enumerate(lidars)}


def finish(figure: go.Figure, height: int) -> None:
    """Sets size (the height in pixels), margins, font and legend of a figure in place."""
    figure.update_layout(
        width=WIDTH,
        height=height,
        margin={"l": 60, "r": 20, "t": 40, "b": 50},
        font={"family": "system-ui, sans-serif", "size": 12, "color": "#1A1A1A"},
        legend={"orientation": "h", "yanchor": "bottom", "y": 1.08, "x": 0.0},
    )
    if figure.layout.showlegend is not False:
        figure.update_layout(margin={"t": 90})
    figure.update_annotations(font={"size": 12})


def evenly(count: int, most: int) -> IntArray:
    """Indices of at most `most` out of `count` elements, evenly spaced."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).astype(np.int64))


def first_stamp(stamps_ns: Any) -> int:
    """The earliest stamp in nanoseconds; 0 if there is none."""
    return min((int(stamp) for stamp in stamps_ns), default=0)


def to_seconds(ns: Any) -> Any:
    """Nanoseconds to seconds, rounded to milliseconds."""
    return np.round(np.asarray(ns, np.float64) / NANOSECONDS_PER_SECOND, 3)


def small(values: Any) -> npt.NDArray[np.float32]:
    """Single precision, which halves the size of the page."""
    return np.asarray(values, np.float32)


def stamps_along(trajectory: VehicleTrajectory, count: int) -> IntArray:
    """(count,) stamps in nanoseconds, evenly spaced from the first pose to the last."""
    begin, end = trajectory.span_ns
    return np.asarray(begin + (end - begin) * np.arange(count) // (count - 1), dtype=np.int64)
