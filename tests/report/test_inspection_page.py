"""The page of `inspect --html` in a real browser: its geometry, its sliders, its boxes."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
import yaml

from caliv_graph.config.load import parse_config
from caliv_graph.config.model import TargetRegion
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.report.inspection import (
    DriveSummary,
    Inspection,
    LidarSummary,
    Points,
    Sighting,
    TargetSummary,
)
from caliv_graph.report.inspection_page import QUANTUM_M, render_inspection
from caliv_graph.workflows.scene import Box, Piece, Scene, SceneLidar
from tests.report.test_html import EVIL, Page, chromium, shown

RNG = np.random.default_rng(2)
POSES = [
    PoseConfig(xyz=xyz, rpy_deg=rpy)
    for xyz, rpy in zip(
        RNG.uniform(-5.0, 5.0, (20, 3)).tolist(),
        (RNG.uniform(-1.0, 1.0, (20, 3)) * [180.0, 89.0, 180.0]).tolist(),
        strict=True,
    )
]

FRONT = PoseConfig(xyz=(2.0, 0.0, 1.875), rpy_deg=(0.0, 10.0, -1.5))

CLOUD = np.array([[3.0, 1.0, 0.5], [-59.9, 20.002, -1.0], [0.0, 0.0, 0.0]])


def scene(**changes: object) -> Scene:
    T = gtsam.Pose3(gtsam.Rot3.Yaw(0.5), np.array([4.0, 1.0, 0.2]))
    pieces = (Piece(CLOUD[:2], gtsam.Pose3()), Piece(CLOUD[2:], T))
    path = np.stack([np.linspace(0.0, 20.0, 50), np.zeros(50), np.zeros(50)], axis=1)
    made = Scene(
        lidars=(
            SceneLidar("front", "/front", FRONT, "initial guess", pieces, pieces),
            SceneLidar(EVIL, "/evil", None, "mounting unknown", pieces, ()),
        ),
        T_map_view=gtsam.Pose3(),
        T_map_start=T,
        path_map=path,
        fixes_map=path[::10],
        boxes=(
            Box("chair", TargetRegion(min=(9.0, -1.0, 0.0), max=(11.0, 2.0, 1.5)), True),
            Box("turned", TargetRegion(min=(3, 3, 0), max=(5, 5, 2), frame="start"), False),
        ),
        height_m=0.0,
        problems=("a problem",),
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def page(**changes: object) -> str:
    drive = DriveSummary(50, 5.0, 20.0, 0.0, 0.0, 0.0)
    lidar = LidarSummary(8, (0, 60), 1, ((20, 30),), 10.0, Points(1, 2, 3))
    target = TargetSummary("chair", (10.0, 0.5, 0.7), {"front": Sighting(3, ((12, 14),))})
    names = {"front": lidar, EVIL: lidar}
    return render_inspection(
        Inspection("drive", names, drive, (target,)), scene(**changes), ["a warning", "a warning"]
    )


SCRIPT = Path(__file__).with_name("use_inspection_page.js").read_text(encoding="utf-8")

BLANK = """
let looked = 0;
function blank() {
  return looked++ < 60 && ["space", "map"].some(function (id) {
    const c = document.getElementById(id);
    return !c.getContext("2d").getImageData(0, 0, c.width, c.height).data.some(Boolean);
  });
}
"""
"""Whether a view has not been drawn yet, up to half a minute."""


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What scripts of the page computed, and what happened when a person used it."""
    chromium()
    poses = json.dumps([[p.xyz, p.rpy_deg] for p in POSES])
    _, turned = scene().boxes
    T = scene().T_map_start
    assert T is not None
    ends = [T.transformFrom(np.array(corner)) for corner in (turned.region.min, turned.region.max)]
    extent = json.dumps(np.array([np.min(ends, axis=0), np.max(ends, axis=0)]).tolist())
    script = SCRIPT.replace("POSES", poses).replace("BOX", extent)
    # After the first pictures: at a time of the browser's own that a busy machine stretches.
    wait = (
        "setTimeout(function go() { if (blank()) { setTimeout(go, 500); return; } "
        f"{script} }}, 500);"
    )
    html = page().replace("</body>", f"<script>{BLANK}{wait}</script></body>")
    result = shown(html, tmp_path_factory.mktemp("page"))
    found = re.search(r'<pre id="told">(.*?)</pre>', result.dom, re.DOTALL)
    assert found is not None, result.console
    return {**json.loads(unescape(found.group(1))), "shown": result}


def test_a_mounting_is_that_of_the_config(told: dict[str, Any]) -> None:
    """Roll, pitch and yaw are those of `PoseConfig`; poses compose as those of gtsam do."""
    for pose, rows in zip(POSES, told["poses"], strict=True):
        np.testing.assert_allclose(rows, pose.pose().matrix()[:3].ravel(), atol=1e-12)
    a, b, c, d = (pose.pose() for pose in POSES[:4])
    np.testing.assert_allclose(told["composed"], a.compose(b).matrix()[:3].ravel(), atol=1e-12)
    np.testing.assert_allclose(told["inverse"], c.inverse().matrix()[:3].ravel(), atol=1e-12)
    np.testing.assert_allclose(told["applied"], d.transformFrom(np.array([1.0, 2.0, 3.0])))


def test_points_arrive_to_the_millimetre(told: dict[str, Any]) -> None:
    points = QUANTUM_M * np.array(told["points"]).reshape(-1, 3)

    np.testing.assert_allclose(points, CLOUD, atol=0.5 * QUANTUM_M + 1e-12)


def lidars(text: str) -> dict[str, Any]:
    """The mountings of a text for a config, as a config reads it."""
    raw = yaml.safe_load(text)
    for topic, lidar in enumerate(raw["lidars"].values()):
        lidar["topic"] = f"/{topic}"
    return dict(parse_config(raw, "page", Path()).lidars)


def test_the_text_for_the_config_is_what_the_sliders_say(told: dict[str, Any]) -> None:
    before, after = lidars(told["before"]), lidars(told["after"])

    assert list(before) == ["front", EVIL]
    assert before["front"].initial == FRONT
    # One mounting is unknown: the sliders reach any angle.
    assert told["range"] == [-180.0, 180.0]
    assert after["front"].initial.xyz == (2.0, 0.0, 7.25)
    assert after["front"].initial.rpy_deg == (0.0, 10.0, -31.5)
    assert after[EVIL].initial == PoseConfig(xyz=(0.0, 0.0, 0.0))
    # The slider follows what was typed beyond its end.
    assert told["slider"] == pytest.approx(7.25, abs=0.02)


def targets(text: str) -> list[TargetRegion]:
    raw = {**yaml.safe_load(text), "lidars": {"front": {"topic": "/front"}}}
    regions = parse_config(raw, "page", Path()).target
    assert regions
    return list(regions)


def test_a_box_is_dragged_and_sized(told: dict[str, Any]) -> None:
    before, moved = targets(told["boxesBefore"]), targets(told["moved"])
    sized, added = targets(told["sized"]), targets(told["added"])

    assert before == [box.region for box in scene().boxes]
    assert moved[0].min == pytest.approx((10.0, -3.0, 0.0), abs=1e-3)
    assert moved[0].max == pytest.approx((12.0, 0.0, 1.5), abs=1e-3)
    assert sized[0].min == moved[0].min
    assert sized[0].max == pytest.approx((13.5, 0.0, 1.5), abs=1e-3)
    assert moved[1] == sized[1] == before[1]
    assert len(added) == 3


def test_a_point_is_drawn_where_it_is(told: dict[str, Any]) -> None:
    # 2 m above the middle of a view of 198 x 98, without its border, at 20 per metre.
    assert told["projected"] == pytest.approx([99.0, 9.0])
    assert told["blue"] == [[99, 9]]
    # Paper, points in shades, path, boxes, letters.
    assert min(told["painted"]) > 10


def test_it_draws_without_network_or_complaint(told: dict[str, Any]) -> None:
    assert told["ready"] == "yes"
    assert told["shown"].console == []
    assert told["shown"].requests == []


# ------------------------------------------------------------------ without a browser


def test_names_do_not_run_and_nothing_is_loaded() -> None:
    html = page()

    assert '<script>alert("x")' not in html
    assert set(Page(html).loads) <= {"data:,"}
    assert "default-src 'none'" in html
    text = Page(html).text
    assert f"{EVIL} " in text
    assert text.count("a warning") == 1
    assert "a problem" in text


def test_the_largest_scene_stays_below_ten_megabytes() -> None:
    from caliv_graph.workflows.scene import ALONG_SCANS, MOST_POINTS, PIECE_NS

    count = 24
    points = MOST_POINTS // (2 * count)
    pieces_of_scan = 100_000_000 // PIECE_NS
    T = POSES[0].pose()

    def pieces(scans: int) -> tuple[Piece, ...]:
        n = points // (scans * pieces_of_scan)
        cloud = RNG.uniform(-60.0, 60.0, (n, 3))
        return tuple(Piece(cloud, T) for _ in range(scans * pieces_of_scan))

    once, along = pieces(1), pieces(ALONG_SCANS)
    many = tuple(SceneLidar(f"lidar_{k}", "/t", FRONT, "", once, along) for k in range(count))

    assert len(page(lidars=many).encode()) < 10_000_000


def test_without_clouds_or_path_the_tables_remain() -> None:
    html = page(lidars=(), path_map=np.zeros((0, 3)), fixes_map=np.zeros((0, 3)), T_map_start=None)

    assert "<canvas" not in html
    assert "<script" not in html
    assert "Clouds by frame number" in Page(html).text
