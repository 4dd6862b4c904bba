"""Figures as dictionaries: the same that plotly's own figures write."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import plotly.graph_objects as go
import pytest
from plotly.io import templates
from plotly.subplots import make_subplots

from caliv_graph.report.figures.plot import Plot

VALUES = np.linspace(-1.0, 2.0, 4, dtype=np.float32)


def document(plot: Plot) -> dict[str, Any]:
    """What plotly.js is given, without the template."""
    found: dict[str, Any] = json.loads(plot.json())
    del found["layout"]["template"]
    return found


def plotlys(figure: go.Figure) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(figure.to_json())
    found["layout"].pop("template", None)
    for annotation in found["layout"].get("annotations", ()):
        annotation["font"]["size"] = 12
    return found


@pytest.mark.parametrize("stacked", [False, True])
def test_panels_side_by_side_and_one_above_another(stacked: bool) -> None:
    ours = Plot(("a", "b", "c"), stacked=stacked, spacing=0.1)
    shape = (3, 1) if stacked else (1, 3)
    theirs = make_subplots(
        *shape,
        subplot_titles=("a", "b", "c"),
        shared_xaxes=stacked,
        horizontal_spacing=None if stacked else 0.1,
        vertical_spacing=0.1 if stacked else None,
    )
    for panel in (1, 3):
        ours.add("scatter", panel=panel, x=np.arange(4), y=VALUES, name="n")
        row, col = (panel, 1) if stacked else (1, panel)
        theirs.add_scatter(row=row, col=col, x=np.arange(4), y=VALUES, name="n")
    ours.x_axes(title="s", panel=3)
    ours.y_axes(type="log")
    theirs.update_xaxes(title="s", row=shape[0], col=shape[1])
    theirs.update_yaxes(type="log")

    assert document(ours) == plotlys(theirs)


def test_panels_of_three_dimensions() -> None:
    ours = Plot(("before", "after"), solid=True)
    theirs = make_subplots(
        1, 2, specs=[[{"type": "scene"}] * 2], subplot_titles=("before", "after")
    )
    ours.add("scatter3d", panel=2, x=VALUES, y=VALUES, z=VALUES)
    theirs.add_scatter3d(row=1, col=2, x=VALUES, y=VALUES, z=VALUES)
    ours.scenes(aspectmode="cube")
    theirs.update_scenes(aspectmode="cube")

    assert document(ours) == plotlys(theirs)


@pytest.mark.parametrize(
    "values",
    [
        np.array([-128, 127]),
        np.array([0, 128]),
        np.array([-32769, 0]),
        np.array([0, 2**40]),
        np.array([[1.0, np.nan], [np.inf, 4.0]]),
        np.array([], dtype=np.float32),
        np.array(["a", "b"]),
        np.arange(12.0).reshape(3, 4)[:, ::2],
    ],
)
def test_arrays_are_written_as_plotly_writes_them(values: np.ndarray[Any, Any]) -> None:
    ours = Plot()
    ours.add("heatmap", z=values)
    theirs = go.Figure(go.Heatmap(z=values, xaxis="x", yaxis="y"))

    assert document(ours) == plotlys(theirs)


def test_numbers_that_are_none_are_null_and_the_look_is_plotlys() -> None:
    plot = Plot()
    plot.add("scatter", y=[1.0, float("nan"), float("inf")])

    found = json.loads(plot.json())

    assert found["data"][0]["y"] == [1.0, None, None]
    assert found["layout"]["template"] == json.loads(
        json.dumps(templates["plotly_white"].to_plotly_json())
    )
