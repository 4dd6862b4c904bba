"""Ground planes of known height and tilt, among things that are none."""

from __future__ import annotations

import math

import numpy as np
import pytest

from caliv_graph.products import Array
from caliv_graph.targets.ground.fit import MAX_TILT_RAD, MIN_POINTS, fit_ground, height_above

DISTANCE_M = 0.05


def plane_points(
    rng: np.random.Generator,
    count: int,
    *,
    tilt_deg: float = 0.0,
    azimuth_deg: float = 0.0,
    height_m: float = 0.0,
    half_size_m: float = 5.0,
    sigma_m: float = 0.0,
) -> Array:
    """Points of a square that rises by `tilt_deg` towards `azimuth_deg`."""
    xy = rng.uniform(-half_size_m, half_size_m, (count, 2))
    azimuth = math.radians(azimuth_deg)
    uphill = xy @ np.array([math.cos(azimuth), math.sin(azimuth)])
    z = height_m + math.tan(math.radians(tilt_deg)) * uphill + sigma_m * rng.normal(size=count)
    return np.column_stack([xy, z])


def wall_points(rng: np.random.Generator, count: int) -> Array:
    """Points of an upright wall at x = 3, 10 m long and 4 m high."""
    return np.column_stack(
        [np.full(count, 3.0), rng.uniform(-5.0, 5.0, count), rng.uniform(0.0, 4.0, count)]
    )


def found(points: Array) -> Array:
    plane = fit_ground(points, DISTANCE_M)
    assert plane is not None
    return plane


def test_level_ground_by_hand() -> None:
    plane = found(plane_points(np.random.default_rng(0), 200, height_m=-1.5))

    assert plane == pytest.approx([0.0, 0.0, 1.0, 1.5], abs=1e-9)
    heights = height_above(plane, np.array([[1.0, 2.0, -1.5], [0.0, 0.0, 0.5], [7.0, 7.0, -2.0]]))
    assert heights == pytest.approx([0.0, 2.0, -0.5], abs=1e-9)


def test_height_is_at_right_angles_to_a_slope() -> None:
    # A plane of 45 degrees through the origin: what is 1 m above it upwards is 0.71 m off.
    root = math.sqrt(0.5)
    plane = np.array([-root, 0.0, root, 0.0])
    heights = height_above(plane, np.array([[0.0, 0.0, 1.0], [1.0, 5.0, 1.0], [1.0, 0.0, 0.0]]))
    assert heights == pytest.approx([root, 0.0, -root])


@pytest.mark.parametrize("azimuth_deg", [0.0, 90.0, 200.0])
@pytest.mark.parametrize("tilt_deg", [3.0, 10.0, 14.0])
def test_tilted_ground_with_noise_and_a_chair_on_it(tilt_deg: float, azimuth_deg: float) -> None:
    rng = np.random.default_rng(1)
    ground = plane_points(
        rng, 2000, tilt_deg=tilt_deg, azimuth_deg=azimuth_deg, height_m=0.3, sigma_m=0.01
    )
    chair = rng.uniform([-0.4, -0.4, 0.4], [0.4, 0.4, 1.6], (600, 3))

    plane = found(np.vstack([chair, ground]))

    tilt, azimuth = math.radians(tilt_deg), math.radians(azimuth_deg)
    normal = [
        -math.sin(tilt) * math.cos(azimuth),
        -math.sin(tilt) * math.sin(azimuth),
        math.cos(tilt),
    ]
    # 2000 points of 10 mm over +-5 m: 0.1 mrad and 0.2 mm; the feet of the chair add a little.
    assert plane[:3] == pytest.approx(normal, abs=1e-3)
    assert height_above(plane, np.array([[0.0, 0.0, 0.3]])) == pytest.approx([0.0], abs=2e-3)
    assert np.linalg.norm(plane[:3]) == pytest.approx(1.0)


def test_a_wall_larger_than_the_ground_is_not_the_ground() -> None:
    rng = np.random.default_rng(2)
    ground = plane_points(rng, 800, tilt_deg=2.0, height_m=-0.2, sigma_m=0.01)

    plane = found(np.vstack([wall_points(rng, 2500), ground]))

    assert plane[2] == pytest.approx(math.cos(math.radians(2.0)), abs=1e-3)
    assert np.abs(height_above(plane, ground)).max() < DISTANCE_M


def test_a_wall_alone_is_no_ground() -> None:
    assert fit_ground(wall_points(np.random.default_rng(3), 2000), DISTANCE_M) is None


def test_a_slope_beyond_the_limit_is_no_ground() -> None:
    rng = np.random.default_rng(4)
    limit = math.degrees(MAX_TILT_RAD)
    assert fit_ground(plane_points(rng, 500, tilt_deg=limit - 1.0), DISTANCE_M) is not None
    assert fit_ground(plane_points(rng, 500, tilt_deg=limit + 1.0), DISTANCE_M) is None


def test_too_few_points_make_no_plane() -> None:
    rng = np.random.default_rng(5)
    assert fit_ground(plane_points(rng, MIN_POINTS - 1), DISTANCE_M) is None
    assert fit_ground(plane_points(rng, MIN_POINTS), DISTANCE_M) is not None
    assert fit_ground(np.empty((0, 3)), DISTANCE_M) is None


def test_a_plane_of_less_than_a_tenth_is_none() -> None:
    # A bush, 5 percent of whose points happen to lie in a thin layer.
    rng = np.random.default_rng(6)
    bush = rng.uniform([-2.0, -2.0, 0.0], [2.0, 2.0, 4.0], (1900, 3))
    layer = plane_points(rng, 100, half_size_m=2.0)
    assert fit_ground(np.vstack([bush, layer]), DISTANCE_M) is None


def test_points_that_are_all_one_make_no_plane() -> None:
    assert fit_ground(np.tile([1.0, 2.0, 3.0], (100, 1)), DISTANCE_M) is None


def test_more_points_than_are_fitted_and_far_from_the_origin() -> None:
    # Coordinates of a national grid.
    rng = np.random.default_rng(7)
    offset = np.array([691_000.0, 5_334_000.0, 520.0])
    points = plane_points(rng, 20_000, tilt_deg=5.0, sigma_m=0.01) + offset

    plane = found(points)

    # 5000 of them, 10 mm over +-5 m: 0.05 mrad.
    assert plane[:3] == pytest.approx(
        [-math.sin(math.radians(5.0)), 0.0, math.cos(math.radians(5.0))], abs=5e-4
    )
    assert height_above(plane, offset[None]) == pytest.approx([0.0], abs=1e-3)


def test_same_points_give_the_same_plane() -> None:
    points = plane_points(np.random.default_rng(8), 3000, tilt_deg=4.0, sigma_m=0.02)
    np.testing.assert_array_equal(found(points), found(points.copy()))
