"""Things that are carried about, drums and tables: geometry worked out by hand."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest

from caliv_graph.errors import ConfigError
from caliv_graph.scenario.model import parse_scenario
from caliv_graph.scenario.shapes import table
from caliv_graph.scenario.world import World, make_world
from caliv_graph.scenario.world_models import (
    BoxModel,
    CylinderModel,
    MoveModel,
    TableModel,
    WorldModel,
)
from caliv_graph.simulation.rays import NO_OBJECT, RayCaster

MOVES = (
    MoveModel(begin_s=10.0, end_s=14.0, xy_m=(5.0, 4.0), yaw_deg=90.0),
    MoveModel(begin_s=20.0, end_s=21.0, xy_m=(9.0, 4.0), yaw_deg=90.0),
)


def carried_box() -> World:
    box = BoxModel(xy_m=(5.0, 0.0), size_m=(1.0, 0.4, 1.0), moves=MOVES)
    return make_world(WorldModel(objects={"box": box}, targets=("box",)))


def hit(world: World, origin: tuple[float, float, float], time_s: float) -> tuple[float, str]:
    """Range and name of what a ray along +x meets."""
    ahead = np.array([[1.0, 0.0, 0.0]])
    distance, objects = RayCaster(world).cast(np.array(origin), ahead, time_s)
    return float(distance[0]), "" if objects[0] == NO_OBJECT else world.names[int(objects[0])]


def assert_hit(
    world: World,
    origin: tuple[float, float, float],
    time_s: float,
    range_m: float,
    name: str,
) -> None:
    distance, met = hit(world, origin, time_s)
    assert met == name
    assert distance == pytest.approx(range_m, abs=1e-5)


def test_it_stands_turned_where_it_was_put() -> None:
    world = carried_box()
    # Half of 1.0 m along x at first; turned by 90 degrees half of 0.4 m.
    assert_hit(world, (0.0, 0.0, 0.5), 9.9, 4.5, "box")
    assert_hit(world, (0.0, 4.0, 0.5), 14.1, 4.8, "box")
    assert hit(world, (0.0, 0.0, 0.5), 14.1)[1] == ""
    assert_hit(world, (0.0, 4.0, 0.5), 30.0, 8.8, "box")


def test_on_the_way_somebody_carries_it() -> None:
    world = carried_box()
    # Half the way: at (5, 2), with the person 0.45 m behind, at (5, 1.55).
    assert hit(world, (0.0, 2.0, 0.5), 12.0)[1] == "box"
    assert hit(world, (0.0, 1.5, 1.2), 12.0)[1] == "who carries box"
    for time_s in (5.0, 17.0, 25.0):
        for y in np.arange(-1.0, 5.0, 0.1):
            assert hit(world, (0.0, float(y), 1.2), time_s)[1] == ""


def test_its_bounds_hold_all_its_places() -> None:
    low, high = carried_box().bounds("box")
    np.testing.assert_allclose(low, [4.5, -0.2, 0.0], atol=1e-9)
    np.testing.assert_allclose(high, [9.2, 4.5, 1.0], atol=1e-9)
    centre, radius = carried_box().bounding_sphere("box")
    np.testing.assert_allclose(centre, 0.5 * (low + high), atol=1e-9)
    assert radius <= 0.5 * np.linalg.norm(high - low) + 1e-9


def test_a_drum_is_round() -> None:
    drum = CylinderModel(xy_m=(4.0, 0.0), radius_m=0.5, height_m=1.0)
    world = make_world(WorldModel(objects={"drum": drum}))
    for y in np.linspace(-0.45, 0.45, 19):
        expected = 4.0 - math.sqrt(0.25 - y**2)
        assert hit(world, (0.0, float(y), 0.5), 0.0)[0] == pytest.approx(expected, abs=2e-4)


def test_a_table_has_a_top_and_four_legs() -> None:
    mesh = table((1.2, 0.8, 0.7), 0.04, 0.06)
    np.testing.assert_allclose(mesh.vertices.min(axis=0), [-0.6, -0.4, 0.0])
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [0.6, 0.4, 0.7])
    world = make_world(WorldModel(objects={"table": TableModel(xy_m=(4.0, 0.0))}))
    assert hit(world, (0.0, 0.0, 0.3), 0.0)[1] == ""
    assert_hit(world, (0.0, 0.33, 0.3), 0.0, 4.0 - 0.55, "table")
    assert_hit(world, (0.0, 0.0, 0.7), 0.0, 4.0 - 0.55, "table")


@pytest.mark.parametrize(
    ("chair", "said"),
    [
        ({"moves": [{"begin_s": 3.0, "end_s": 2.0, "xy_m": [1, 1]}]}, "must be before end_s"),
        (
            {
                "moves": [
                    {"begin_s": 1.0, "end_s": 4.0, "xy_m": [1, 1]},
                    {"begin_s": 3.0, "end_s": 5.0, "xy_m": [2, 1]},
                ]
            },
            "before the one at 1.0 s has ended",
        ),
        ({"moves": [{"begin": 1.0, "end_s": 4.0, "xy_m": [1, 1]}]}, "did you mean 'begin_s'?"),
    ],
    ids=["backwards", "overlapping", "misspelt"],
)
def test_moves_that_cannot_be_are_refused(chair: dict[str, Any], said: str) -> None:
    raw = {
        "name": "x",
        "drive": {"kind": "standstill", "duration_s": 10.0},
        "lidars": {"front": {"mounting": {"xyz": [0.0, 0.0, 2.0]}}},
        "world": {"objects": {"chair": {"shape": "chair", "xy_m": [5.0, 0.0], **chair}}},
    }
    with pytest.raises(ConfigError, match=re.escape(said)) as raised:
        parse_scenario(raw, "s.yaml")
    assert "\n" not in str(raised.value)
