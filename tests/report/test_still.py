"""The first pictures of a page, and the page on a narrow and on a dark screen."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from importlib.resources import files
from typing import Any

import numpy as np
import pytest

from caliv_graph.report.figures.drawing import Figure, finish
from caliv_graph.report.figures.plot import Plot
from caliv_graph.report.figures.still import still

TEMPLATES = files("caliv_graph.report").joinpath("templates")
STYLE = TEMPLATES.joinpath("style.css").read_text("utf-8")
DRAW = TEMPLATES.joinpath("draw.js").read_text("utf-8")


def scatter(x: Any, y: Any, **layout: Any) -> Plot:
    plot = Plot(("before", "after"))
    for panel in (1, 2):
        plot.add(
            "scatter", x=x, y=y, mode="markers", marker={"color": "#0072B2"}, panel=panel, name="a"
        )
        plot.x_axes(range=[0.0, 10.0], panel=panel)
        plot.y_axes(range=[0.0, 5.0], panel=panel, **layout)
    finish(plot, 340)
    return plot


def paths(plot: Plot) -> list[list[tuple[float, float]]]:
    """Points of each path of the picture, pixels."""
    root = ET.fromstring(str(still(Figure("f", 'a "caption" & <more>', plot))))
    return [
        [(float(x), float(y)) for x, y in re.findall(r"[ML]([\d.-]+) ([\d.-]+)", path.get("d", ""))]
        for path in root.iter("path")
    ]


def test_points_are_where_plotly_puts_them() -> None:
    """980 x 340 px; margins 60 left, 20 right, 90 above, 50 below; panels at 0 to .45, .55 to 1."""
    left, right = paths(scatter(np.array([0.0, 10.0, 5.0]), np.array([0.0, 5.0, 2.5])))

    assert left == [(60.0, 290.0), (465.0, 90.0), (262.5, 190.0)]
    assert right == [(555.0, 290.0), (960.0, 90.0), (757.5, 190.0)]


def test_both_panels_have_one_scale_and_what_is_outside_is_left_out() -> None:
    left, right = paths(scatter(np.array([1.0, 11.0]), np.array([1.0, 1.0])))

    assert len(left) == len(right) == 1


def test_a_metre_is_as_long_upwards() -> None:
    plot = scatter(np.array([0.0, 5.0, 5.0]), np.array([0.0, 0.0, 2.0]), scaleanchor="x")

    (a, b, c), _ = paths(plot)

    # 40 px/m upwards is less than 40.5 px/m to the right: both become 40.
    assert (b[0] - a[0]) / 5.0 == pytest.approx((b[1] - c[1]) / 2.0, rel=1e-2)


def test_a_decade_is_as_long_everywhere_on_a_log_axis() -> None:
    plot = Plot()
    values = np.array([1.0, 10.0, 100.0])
    plot.add("scatter", x=values, y=values, mode="markers", name="a")
    plot.x_axes(type="log", range=[0.0, 2.0])
    plot.y_axes(type="log")
    finish(plot, 340)

    ((a, b, c),) = paths(plot)

    assert b[0] - a[0] == pytest.approx(c[0] - b[0], abs=0.2)
    assert b[1] - a[1] == pytest.approx(c[1] - b[1], abs=0.2)


def test_a_line_is_broken_where_it_has_no_value() -> None:
    plot = Plot()
    plot.add("scatter", x=np.arange(5.0), y=np.array([1.0, 2.0, np.nan, 2.0, 1.0]), mode="lines")
    finish(plot, 340)

    path = re.search(r'<path d="([^"]*)"', str(still(Figure("f", "", plot))))

    assert path is not None
    assert re.sub(r"[\d. -]", "", path[1]) == "MLML"


def test_there_is_none_of_what_it_cannot_show() -> None:
    solid, named = Plot(("a",), solid=True), scatter(["front x", "rear x"], np.array([1.0, 2.0]))
    solid.add("scatter3d", x=np.zeros(1), y=np.zeros(1), z=np.zeros(1))
    finish(solid, 300)
    bars = Plot()
    bars.add("bar", x=np.zeros(1), y=np.zeros(1))
    finish(bars, 300)

    for figure in (
        Figure("a", "", solid, solid=True),
        Figure("b", "", named),
        Figure("c", "", bars),
    ):
        assert still(figure) == ""


def test_panels_side_by_side_are_told_from_stacked_ones() -> None:
    assert (Plot().across, Plot(("a", "b")).across, Plot(("a", "b"), stacked=True).across) == (
        *(1, 2),
        1,
    )


def test_nothing_is_wider_than_a_narrow_screen() -> None:
    assert re.findall(r"[^-]width: *(\d+)px", STYLE.split("@media print")[0]) == []
    narrow = STYLE.split("@media (max-width: 700px)")[1]
    assert "overflow-x: auto" in narrow


def test_every_colour_of_the_page_has_one_for_dark_screens() -> None:
    light, dark = STYLE.split("@media (prefers-color-scheme: dark)")[:2]
    named = set(re.findall(r"(--[a-z]+):", light))

    assert named == set(re.findall(r"(--[a-z]+):", dark.split("}")[0]))
    # Borders of a verdict are the same on both; all other colours are variables.
    rules = STYLE.split("* { box-sizing")[1].split("@media print")[0]
    assert set(re.findall(r"#[0-9A-Fa-f]{3,6}\b", rules)) <= {"#009E73", "#E69F00", "#D55E00"}
    for made_for_white in ("#000000", "#1A1A1A", "white", "#F7F7F7"):
        assert f'"{made_for_white}": "#' in DRAW


def contrast(one: str, other: str) -> float:
    """WCAG 2: 4.5 is legible."""

    def luminance(colour: str) -> float:
        full = colour if len(colour) == 7 else "#" + "".join(2 * c for c in colour[1:])
        rgb = np.array([int(full[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("scheme", [0, 1], ids=["light", "dark"])
def test_text_is_legible_on_both(scheme: int) -> None:
    block = STYLE.split(":root {")[1 + scheme].split("}")[0]
    colour = dict(re.findall(r"--([a-z]+): (#[0-9a-fA-F]+)", block))

    for text in ("ink", "faint", "held", "weak", "good"):
        assert contrast(colour[text], colour["paper"]) > 4.5, text
    assert contrast(colour["ink"], colour["alarm"]) > 4.5
