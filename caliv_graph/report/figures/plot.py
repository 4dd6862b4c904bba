"""Figures as plotly.js takes them: plain dictionaries of traces and layout.

plotly's own figures check and copy every value at every step, which takes 0.3 s of CPU per report.
The keys are those of https://plotly.com/javascript/reference.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
import numpy.typing as npt
from plotly.io.json import to_json_plotly

_TYPED_ARRAYS = {
    "int8": "i1",
    "int16": "i2",
    "int32": "i4",
    "float32": "f4",
    "float64": "f8",
}
"""Types of arrays that plotly.js reads as bytes; it has none for 64-bit integers."""


class Plot:
    """Traces and layout of one panel or several.

    Attributes:
        data: traces, in the order in which they are drawn.
        layout: by key.
        across: panels side by side; a narrow screen shows them one below another.
    """

    def __init__(
        self,
        titles: Sequence[str] = (),
        *,
        stacked: bool = False,
        solid: bool = False,
        spacing: float | None = None,
    ) -> None:
        """An empty figure.

        Args:
            titles: one per panel; none: one panel without a title.
            stacked: panels one above another, which share the x axis; else side by side.
            solid: 3-D panels.
            spacing: between panels, as a share of the figure; None: 0.3 of it between all that are
                stacked, 0.2 between all others.
        """
        self.data: list[dict[str, Any]] = []
        self.layout: dict[str, Any] = {}
        self._panels = max(len(titles), 1)
        self.across = 1 if stacked else self._panels
        self._solid = solid
        if titles:
            self._divide(titles, stacked, spacing)

    def _divide(self, titles: Sequence[str], stacked: bool, spacing: float | None) -> None:
        count = len(titles)
        parts = _spans(count, (0.3 if stacked else 0.2) / count if spacing is None else spacing)
        whole = [0.0, 1.0]
        headings = self.layout["annotations"] = []
        for panel, title in enumerate(titles):
            x, y = (whole, parts[count - 1 - panel]) if stacked else (parts[panel], whole)
            number = _number(panel)
            headings.append(_heading(title, x, y))
            if self._solid:
                self.layout[f"scene{number}"] = {"domain": {"x": x, "y": y}}
                continue
            self.layout[f"xaxis{number}"] = {"anchor": f"y{number}", "domain": x}
            self.layout[f"yaxis{number}"] = {"anchor": f"x{number}", "domain": y}
            if stacked and panel < count - 1:
                shared = {"matches": f"x{_number(count - 1)}", "showticklabels": False}
                self.layout[f"xaxis{number}"] |= shared

    def add(self, kind: str, *, panel: int = 1, **trace: Any) -> None:
        """Adds a trace, such as `scatter`, to a panel; panels count from 1."""
        number = _number(panel - 1)
        axes = {"xaxis": f"x{number}", "yaxis": f"y{number}"}
        where = {"scene": f"scene{number}"} if self._solid else axes
        self.data.append({"type": kind, **trace, **where})

    def x_axes(self, *, panel: int | None = None, title: str | None = None, **keys: Any) -> None:
        """Sets keys of the x axes of all panels, or of one."""
        self._update("xaxis", panel, title, keys)

    def y_axes(self, *, panel: int | None = None, title: str | None = None, **keys: Any) -> None:
        """Sets keys of the y axes of all panels, or of one."""
        self._update("yaxis", panel, title, keys)

    def scenes(self, **keys: Any) -> None:
        """Sets keys of all 3-D panels."""
        self._update("scene", None, None, keys)

    def _update(
        self, what: str, panel: int | None, title: str | None, keys: Mapping[str, Any]
    ) -> None:
        heading = {} if title is None else {"title": {"text": title}}
        for at in range(self._panels) if panel is None else (panel - 1,):
            self.layout.setdefault(f"{what}{_number(at)}", {}).update({**keys, **heading})

    def json(self) -> str:
        """Data, layout and template for plotly.js."""
        layout = {**self.layout, "template": _template()}
        return str(to_json_plotly({"data": _encoded(self.data), "layout": layout}))


def _number(panel: int) -> str:
    """What tells the axes of a panel from those of the first one."""
    return "" if panel == 0 else str(panel + 1)


def _spans(count: int, spacing: float) -> list[list[float]]:
    """Where the panels of a row or column lie, in shares of the figure."""
    size = (1.0 - spacing * (count - 1)) / count
    return [[i * (size + spacing), i * (size + spacing) + size] for i in range(count)]


def _heading(title: str, x: Sequence[float], y: Sequence[float]) -> dict[str, Any]:
    """The title of a panel, above it."""
    return {
        "text": title,
        "font": {"size": 12},
        "showarrow": False,
        "x": 0.5 * (x[0] + x[1]),
        "xanchor": "center",
        "xref": "paper",
        "y": y[1],
        "yanchor": "bottom",
        "yref": "paper",
    }


def _encoded(value: Any) -> Any:
    """The same with arrays as base64 of their bytes, a third of their size as text."""
    if isinstance(value, dict):
        return {key: _encoded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_encoded(item) for item in value]
    return _typed_array(value) if isinstance(value, np.ndarray) else value


def _typed_array(values: npt.NDArray[Any]) -> dict[str, str] | list[Any]:
    """An array for plotly.js; a list if it is empty or of a type that plotly.js does not know."""
    if values.dtype == np.int64 and values.size:
        values = values.astype(_smallest(int(values.min()), int(values.max())))
    kind = _TYPED_ARRAYS.get(str(values.dtype))
    if kind is None or not values.size:
        return list(values.tolist())
    out = {"dtype": kind, "bdata": base64.b64encode(values.tobytes()).decode()}
    if values.ndim > 1:
        out["shape"] = ", ".join(map(str, values.shape))
    return out


def _smallest(least: int, most: int) -> type[np.signedinteger[Any]]:
    """The smallest signed type for all integers of a range."""
    for kind in (np.int8, np.int16, np.int32):
        if np.iinfo(kind).min <= least and most <= np.iinfo(kind).max:
            return kind
    return np.int64


@cache
def _template() -> Mapping[str, Any]:
    """The look of plotly's figures on white, as plotly stores it."""
    text = files("plotly").joinpath("package_data/templates/plotly_white.json").read_text("utf-8")
    found: Mapping[str, Any] = json.loads(text)
    return found
