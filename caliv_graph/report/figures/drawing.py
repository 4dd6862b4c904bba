"""What all figures share: colours, names, layout and thinning of data.

The colours are those of Okabe and Ito (2008), which colour-blind readers can tell apart. What
matters differs in its marker or dash as well, for print.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import numpy.typing as npt

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import IntArray
from caliv_graph.report.figures.plot import Plot
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
    figure: Plot
    solid: bool = False


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


def finish(figure: Plot, height: int, *, legend: bool = True) -> None:
    """Sets size (the height in pixels), margins, font and legend of a figure in place."""
    figure.layout |= {
        "width": WIDTH,
        "height": height,
        "margin": {"l": 60, "r": 20, "t": 90 if legend else 40, "b": 50},
        "font": {"family": "system-ui, sans-serif", "size": 12, "color": "#1A1A1A"},
        "legend": {"orientation": "h", "yanchor": "bottom", "y": 1.08, "x": 0.0},
    }
    if not legend:
        figure.layout["showlegend"] = False


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
