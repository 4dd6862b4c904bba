"""The pictures of walls, poles and objects, as plotly.js lays them out in a real browser."""

from __future__ import annotations

import json
import re
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from caliv_graph.products import Array
from caliv_graph.report.figures.structure import _two
from caliv_graph.report.surfaces import _median_mm
from caliv_graph.validation.findings import AFTER, BEFORE, Validation
from tests.report.test_html import chromium, shown

RNG = np.random.default_rng(0)
WIDE = RNG.uniform([-25.0, -30.0], [27.0, 29.0], (400, 2))
TALL = RNG.uniform([-0.5, -2.0], [0.5, 3.0], (400, 2))


def laid_out(points: Array, closer: bool, folder: Path) -> dict[str, dict[str, Any]]:
    """Range and domain of every axis of a picture of points whose guess was 0.3 m off."""
    found = SimpleNamespace(
        clouds=SimpleNamespace(lidar=np.arange(2 * len(points)) % 2), lidars=("front", "rear")
    )
    views = {BEFORE: points + 0.3, AFTER: points}
    heads = ("x (m)", "y (m)")
    plot = _two(
        cast(Validation, found),
        np.arange(len(points), 2 * len(points)),
        views,
        heads,
        equal=True,
        height=560,
        closer=closer,
    )
    plotly = files("plotly").joinpath("package_data/plotly.min.js").read_text("utf-8")
    html = f"""<meta charset="utf-8"><div id="plot"></div><pre id="told"></pre>
<script>{plotly}</script><script type="application/json" id="figure">{plot.json()}</script>
<script>
const figure = JSON.parse(document.getElementById("figure").textContent);
Plotly.newPlot("plot", figure.data, figure.layout).then(function (plot) {{
  const full = plot._fullLayout, told = {{}};
  for (const name of Object.keys(full).filter(n => /^[xy]axis\\d*$/.test(n))) {{
    told[name] = {{ range: full[name].range, domain: full[name].domain }};
  }}
  document.getElementById("told").textContent = JSON.stringify(told);
}});
</script>"""
    dom = shown(html, folder).dom
    text = re.search(r'<pre id="told">(.*?)</pre>', dom)
    assert text
    out: dict[str, dict[str, Any]] = json.loads(text.group(1))
    return out


@pytest.mark.parametrize(("points", "closer"), [(WIDE, False), (TALL, True)], ids=["wide", "tall"])
def test_all_points_of_a_picture_are_in_its_axes(
    points: Array, closer: bool, tmp_path: Path
) -> None:
    chromium()
    axes = laid_out(points, closer, tmp_path)

    shifts = (0.3, 0.0, 0.0) if closer else (0.3, 0.0)
    scales = []
    for number, shift in zip(("", "2", "3"), shifts, strict=False):
        for column, key in enumerate("xy"):
            axis = axes[f"{key}axis{number}"]
            low, high = axis["range"]
            assert low < points[:, column].min() + shift
            assert high > points[:, column].max() + shift
            begin, end = axis["domain"]
            assert end - begin > 0.05
            pixels = (980 - 80, 560 - 140)[column] * (end - begin)
            scales.append(pixels / (high - low))
    # One metre is as long in both axes, and before as after.
    np.testing.assert_allclose(scales[:4], scales[0], rtol=0.02)


def test_thickness_of_strips_that_one_scan_saw_is_left_out() -> None:
    assert _median_mm([np.nan, 0.002, 0.004]) == "3.0"
    assert _median_mm([np.nan]) == "-"


def test_buttons_of_a_picture_become_a_list_where_they_would_not_fit(tmp_path: Path) -> None:
    chromium()
    script = files("caliv_graph.report").joinpath("templates/draw.js").read_text("utf-8")
    layout = {
        "width": 980,
        "margin": {"t": 90, "b": 20},
        "updatemenus": [{"type": "buttons", "direction": "right"}],
    }
    figure = json.dumps({"data": [], "layout": layout})
    pictures = "".join(
        f'<figure data-across="1" style="width: {width}px; margin: 0">'
        f'<div class="plot" data-figure="{name}" style="height: 400px"></div></figure>'
        f'<script type="application/json" id="data-{name}">{figure}</script>'
        for name, width in (("narrow", 390), ("wide", 980))
    )
    told = """<script>window.Plotly = { newPlot: function (plot, data, layout) {
  plot.textContent = layout.updatemenus.map(m => m.type + " " + m.direction).join();
  return Promise.resolve();
} };</script>"""

    dom = shown(f'<meta charset="utf-8">{pictures}{told}<script>{script}</script>', tmp_path).dom

    drawn = dict(re.findall(r'data-figure="(\w+)"[^>]*>([^<]*)<', dom))
    assert drawn == {"narrow": "dropdown down", "wide": "buttons right"}
