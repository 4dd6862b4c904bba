"""Walls, kerbs, cars and foliage against geometry worked out by hand."""

from collections import Counter
from typing import Any

import numpy as np
import pytest

from caliv_graph.errors import ConfigError
from caliv_graph.products import Array
from caliv_graph.scenario.model import parse_scenario
from caliv_graph.scenario.shapes import ground, object_mesh
from caliv_graph.scenario.solids import Mesh
from caliv_graph.scenario.surroundings import CAR_HALF_M, LEAN_M, car, kerb, wall
from caliv_graph.scenario.world import make_world
from caliv_graph.scenario.world_models import (
    BushModel,
    GroundModel,
    HedgeModel,
    RevealsModel,
    WalkerModel,
    WallModel,
    WorldModel,
)
from caliv_graph.simulation.rays import RayCaster

HERE = (0.0, 0.0)

WINDOWS = RevealsModel(size_m=(1.0, 1.5), spacing_m=2.5, sill_m=0.8, depth_m=(0.1, 0.1))


def front(**changes: Any) -> WallModel:
    values: dict[str, Any] = {"xy_m": HERE, "length_m": 10.0, "thickness_m": 0.5}
    return WallModel(**{**values, **changes})


def assert_closed(mesh: Mesh) -> None:
    """Every edge belongs to two faces that run through it in opposite directions."""
    edges = Counter(
        (int(t[i]), int(t[(i + 1) % 3])) for t in mesh.triangles.tolist() for i in range(3)
    )
    assert all(count == 1 for count in edges.values())
    assert all((b, a) in edges for a, b in edges)


def ranges_at_front(mesh_of: WallModel, x: Array, z: Array) -> Array:
    """Ranges of beams along -y from y = 5 m at the places x, z of the wall's face."""
    world = make_world(WorldModel(objects={"wall": mesh_of}))
    origins = np.column_stack([x, np.full(len(x), 5.0), z])
    return RayCaster(world).cast(origins, np.tile([0.0, -1.0, 0.0], (len(x), 1)))[0]


# ------------------------------------------------------------------ walls


def test_a_flat_wall_is_a_box_without_its_windows() -> None:
    mesh = wall(front(bumps_sigma_m=0.0, reveals=WINDOWS))
    assert_closed(mesh)
    # (10 - 1 - 2 x 0.1) / 2.5 leaves room for four windows on each side.
    assert mesh.signed_volume() == pytest.approx(10.0 * 3.0 * 0.5 - 8 * 1.0 * 1.5 * 0.1)


def test_windows_are_set_back_and_nothing_else() -> None:
    # The windows' middles are at -3.75, -1.25, 1.25, 3.75 m.
    x = np.array([-1.25, -0.76, -0.74, 0.0, 1.7, 1.25, 1.25])
    z = np.array([1.5, 1.5, 1.5, 1.5, 0.81, 0.79, 2.31])
    behind = ranges_at_front(front(bumps_sigma_m=0.0, reveals=WINDOWS), x, z) - 4.75
    np.testing.assert_allclose(behind, [0.1, 0.1, 0.0, 0.0, 0.1, 0.0, 0.0], atol=1e-6)


def test_depths_of_windows_are_within_their_range_and_differ() -> None:
    reveals = WINDOWS.model_copy(update={"depth_m": (0.05, 0.2)})
    middles = np.array([-3.75, -1.25, 1.25, 3.75])
    model = front(bumps_sigma_m=0.0, reveals=reveals)
    depth = ranges_at_front(model, middles, np.full(4, 1.5)) - 4.75
    assert (depth > 0.05).all()
    assert (depth < 0.2).all()
    assert np.ptp(depth) > 0.01


def test_bumps_have_their_sigma_their_size_and_their_seed() -> None:
    long = {"length_m": 300.0, "bumps_sigma_m": 0.005, "bumps_cell_m": (1.5, 1.5)}
    x = np.linspace(-149.0, 149.0, 1491)
    z = np.full(len(x), 1.5)  # a border of cells
    offset = ranges_at_front(front(**long, seed=1), x, z) - 4.75
    at_corners = offset[np.isclose(x % 1.5, 0.0, atol=0.051)]
    assert at_corners.std() == pytest.approx(0.005, rel=0.15)
    assert abs(at_corners.mean()) < 0.0015
    # No step: over 0.2 m a face moves by at most 0.2 / 1.5 of the difference of two corners.
    assert np.abs(np.diff(offset)).max() < 0.2 / 1.5 * 6.0 * 0.005
    np.testing.assert_array_equal(ranges_at_front(front(**long, seed=1), x, z) - 4.75, offset)
    other = ranges_at_front(front(**long, seed=2), x, z) - 4.75
    assert abs(np.corrcoef(offset, other)[0, 1]) < 0.3


def test_the_two_faces_of_a_wall_have_bumps_of_their_own() -> None:
    mesh = wall(front(length_m=100.0, bumps_sigma_m=0.01))
    half = len(mesh.vertices) // 2
    one, other = np.abs(mesh.vertices[:half, 1]), np.abs(mesh.vertices[half:, 1])
    assert abs(np.corrcoef(one, other)[0, 1]) < 0.3
    assert one.mean() == pytest.approx(0.25, abs=0.003)
    assert_closed(mesh)


# ------------------------------------------------------------------ kerbs, cars, ground


def test_a_kerb_is_a_leaning_bar() -> None:
    mesh = kerb(10.0, 0.12, 0.15)
    assert_closed(mesh)
    assert mesh.signed_volume() == pytest.approx(10.0 * 0.12 * (0.15 + LEAN_M))


def test_a_car_stands_on_its_wheels_within_its_size() -> None:
    mesh = car()
    assert_closed(mesh)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    np.testing.assert_allclose(high, [*CAR_HALF_M, 1.45], atol=1e-3)
    np.testing.assert_allclose(low[:2], np.negative(CAR_HALF_M), atol=1e-3)
    assert low[2] == pytest.approx(0.0, abs=0.003)  # a wheel's lowest corner


def test_a_car_drives_to_and_fro() -> None:
    path = WalkerModel(body="car", from_xy_m=(10.0, -4.0), to_xy_m=(10.0, 4.0), speed_m_s=2.0)
    caster = RayCaster(make_world(WorldModel(walkers={"car": path})))
    # At 2 s and at 6 s it is at y = 0, its side towards the beam; in between it is elsewhere.
    times = np.array([2.0, 3.9, 6.0])
    beams = np.tile([1.0, 0.0, 0.0], (3, 1))
    range_m, _ = caster.cast(np.array([0.0, 0.0, 0.5]), beams, times)
    assert range_m[0] == pytest.approx(10.0 - CAR_HALF_M[1], abs=0.02)
    assert range_m[2] == pytest.approx(range_m[0], abs=1e-5)
    assert np.isinf(range_m[1])


def test_bumps_of_the_ground_have_their_sigma() -> None:
    model = GroundModel(half_size_m=60.0, bumps_sigma_m=0.01, bumps_cell_m=2.0)
    z = ground(model).vertices[:, 2]
    assert len(z) == 61**2
    assert z.std() == pytest.approx(0.01, rel=0.05)
    assert not np.array_equal(z, ground(model.model_copy(update={"bumps_seed": 1})).vertices[:, 2])


# ------------------------------------------------------------------ foliage


def test_beams_enter_a_hedge_as_deep_as_it_says() -> None:
    hedge = HedgeModel(xy_m=HERE, size_m=(8.0, 4.0, 3.0), penetration_m=0.3, leaf_m=0.06)
    world = make_world(WorldModel(objects={"hedge": hedge}))
    rng = np.random.default_rng(1)
    origins = rng.uniform([-3.5, 6.0, 0.3], [3.5, 6.0, 2.7], (4000, 3))
    range_m, _ = RayCaster(world).cast(origins, np.tile([0.0, -1.0, 0.0], (4000, 1)))
    depth = range_m - 4.0
    # Exponential: the mean is the spread. A leaf may stand out by half of its size.
    assert depth.mean() == pytest.approx(0.3, rel=0.15)
    assert depth.std() == pytest.approx(0.3, rel=0.15)
    assert depth.min() > -0.06


def test_a_bush_is_within_its_ellipsoid() -> None:
    bush = BushModel(xy_m=HERE, size_m=(2.0, 1.6, 1.2), leaf_m=0.1)
    middles = object_mesh(bush).vertices.reshape(-1, 3, 3).mean(axis=1)
    inside = (((middles - [0.0, 0.0, 0.6]) / [1.0, 0.8, 0.6]) ** 2).sum(axis=1)
    assert inside.max() <= 1.0 + 1e-9
    # Evenly filled: an eighth of the leaves is within half of the radii.
    assert (inside < 0.25).mean() == pytest.approx(0.125, abs=0.02)


# ------------------------------------------------------------------ what is wrong


@pytest.mark.parametrize(
    ("world", "message"),
    [
        ({"shape": "wall", "length_m": 9.0, "thickness_m": 0.05}, "thickness_m (0.05 m) must"),
        (
            {"shape": "wall", "length_m": 9.0, "thickness_m": 0.4, "reveals": {}},
            "twice the depth of a window",
        ),
        (
            {"shape": "wall", "length_m": 9.0, "height_m": 2.0, "thickness_m": 0.5, "reveals": {}},
            "too small for windows of 1.2 m up to a height of 2.3 m",
        ),
        (
            {"shape": "wall", "length_m": 9.0, "reveals": {"spacing_m": 1.0}},
            "must exceed the width",
        ),
        ({"shape": "wall", "length_m": 9.0, "bumps_cell_m": [2.0, 1.0]}, "2.0 m must not exceed"),
        ({"shape": "hedge", "leaf_m": 0.0}, "greater than 0"),
    ],
)
def test_impossible_walls_are_refused(world: dict[str, Any], message: str) -> None:
    raw = {
        "name": "wrong",
        "drive": {"kind": "arc", "duration_s": 17.0},
        "lidars": {"front": {"mounting": {"xyz": [2, 0, 2]}}},
        "world": {"objects": {"thing": {"xy_m": [15, -9], **world}}},
    }
    with pytest.raises(ConfigError) as caught:
        parse_scenario(raw, "scenario.yaml")
    assert message in str(caught.value)


def test_ground_has_bumps_or_ramps() -> None:
    ramp = {"xy_m": [9.0, 0.0], "height_m": 0.2, "flank_m": 2.0}
    with pytest.raises(ValueError, match="not both"):
        GroundModel.model_validate({"ramps": [ramp], "bumps_sigma_m": 0.01})
