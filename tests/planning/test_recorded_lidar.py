"""The beams of a LiDAR, read off its clouds: of several kinds, in a room without a ceiling."""

from __future__ import annotations

import math

import numpy as np
import pytest

from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.errors import RecordingError
from caliv_graph.planning.recorded_lidar import SeenBeams, lidar_model
from caliv_graph.products import Array
from caliv_graph.scenario.beams import unit_vectors

HEIGHT_M = 1.8
WALL_M = 12.0
"""Half the side of a square room, with walls of 6 m."""


def cloud(elevation: Array, azimuth: Array, seed: int) -> Array:
    """Returns of beams (angles in radians that broadcast), with noise, as a bag has them."""
    beams = unit_vectors(elevation, azimuth).reshape(-1, 3)
    ground_m = np.full(len(beams), np.inf)
    down = beams[:, 2] < 0.0
    ground_m[down] = -HEIGHT_M / beams[down, 2]
    wall_m = WALL_M / np.abs(beams[:, :2]).max(axis=1)
    wall_m[wall_m * beams[:, 2] + HEIGHT_M > 6.0] = np.inf
    range_m = np.minimum(ground_m, wall_m)
    hit = np.isfinite(range_m)
    noisy = range_m[hit] + np.random.default_rng(seed).normal(0.0, 0.02, hit.sum())
    return np.asarray((noisy[:, None] * beams[hit]).astype(np.float32), np.float64)


def turning(
    elevations_deg: Array, azimuth_deg: tuple[float, float], column_deg: float
) -> SeenBeams:
    azimuth = np.radians(np.arange(*azimuth_deg, column_deg))
    clouds = [cloud(np.radians(elevations_deg)[:, None], azimuth, seed) for seed in range(4)]
    return SeenBeams.of(clouds, "drive")


def test_even_channels_all_around() -> None:
    channels = np.arange(-15.0, 16.0, 2.0)

    found = turning(channels, (-180.0, 180.0), 0.2)

    assert found.even
    assert found.elevations_deg == pytest.approx(channels, abs=0.01)
    assert found.column_deg == pytest.approx(0.2, rel=0.01)
    assert found.horizontal_fov_deg == (-180.0, 180.0)
    # The farthest return is in a corner, 15 degrees up or down at most.
    assert found.reach_m == pytest.approx(WALL_M * math.sqrt(2.0), abs=0.8)


def test_uneven_channels_to_one_side() -> None:
    channels = np.array([-25.0, -15.6, -11.3, -8.8, -4.0, -3.67, -3.33, -3.0, 0.0, 4.7, 15.0])

    found = turning(channels, (-50.0, 20.0), 0.4)

    assert not found.even
    assert found.elevations_deg == pytest.approx(channels, abs=0.01)
    assert found.horizontal_fov_deg == pytest.approx((-50.0, 20.0), abs=0.5)
    assert found.column_deg == pytest.approx(0.4, rel=0.01)


def test_the_field_of_view_of_a_lidar_that_looks_back() -> None:
    found = turning(np.arange(-15.0, 0.0, 2.0), (130.0, 250.0), 0.4)

    low, high = found.horizontal_fov_deg
    assert (low % 360.0, high % 360.0) == pytest.approx((130.0, 250.0), abs=0.5)
    # About a middle between -180 and 180.
    assert abs(low + high) <= 360.0


def test_two_returns_of_a_beam_are_no_columns() -> None:
    azimuth = np.radians(np.arange(-60.0, 60.0, 0.2))
    once = cloud(np.radians(np.arange(-15.0, 0.0, 1.0))[:, None], azimuth, 1)

    found = SeenBeams.of([np.vstack([once, 0.9 * once])], "drive")

    assert found.column_deg == pytest.approx(0.2, rel=0.01)


def test_channels_that_never_return_are_not_known() -> None:
    # Into the sky, over walls of 6 m at 12 to 17 m.
    found = turning(np.arange(-20.0, 41.0, 2.0), (-180.0, 180.0), 0.5)

    assert found.elevations_deg[-1] == pytest.approx(18.0, abs=0.01)


def test_a_lidar_without_channels_has_the_density_of_its_points() -> None:
    rng = np.random.default_rng(3)
    # Evenly over 60 x 30 degrees: 100 points per square degree.
    azimuth = np.radians(rng.uniform(-30.0, 30.0, 180_000))
    elevation = np.radians(rng.uniform(-20.0, 10.0, 180_000))

    found = SeenBeams.of([cloud(elevation, azimuth, 3)], "drive")

    steps = np.diff(found.elevations_deg)
    assert found.column_deg * float(steps.mean()) == pytest.approx(1.0 / 100.0, rel=0.1)
    assert found.elevations_deg[[0, -1]] == pytest.approx([-20.0, 10.0], abs=0.2)


@pytest.mark.parametrize("upright", [False, True])
def test_a_lidar_of_one_plane_is_one(upright: bool) -> None:
    angle = np.radians(np.arange(-40.0, 0.0, 0.2))
    still = np.zeros(1)
    clouds = [cloud(angle, still, s) if upright else cloud(still, angle, s) for s in range(4)]

    found = SeenBeams.of(clouds, "drive")
    stamps = 100_000_000 * np.arange(5, dtype=np.int64)
    model = lidar_model(found, LidarConfig(topic="a"), PoseConfig(xyz=(0, 0, 2)), 0.02, stamps)

    level, steep = (np.ptp(fov) for fov in (model.horizontal_fov_deg, model.vertical_fov_deg))
    assert (level < 2.0, steep < 2.0) == (upright, not upright)


def test_a_topic_of_next_to_no_points_is_refused() -> None:
    with pytest.raises(RecordingError, match="drive: LiDAR 'a': 2 clouds have 6 points beyond 2 m"):
        SeenBeams.of([np.full((3, 3), 4.0), np.full((3, 3), 5.0)], "drive: LiDAR 'a'")


def test_as_a_scenario_has_it() -> None:
    beams = turning(np.arange(-15.0, 16.0, 2.0), (-180.0, 180.0), 0.2)
    stamps = 30_000_000 + 100_000_000 * np.arange(20, dtype=np.int64)
    # One cloud is lost.
    stamps = np.delete(stamps, 7)

    model = lidar_model(
        beams, LidarConfig(topic="a", max_range=15.0), PoseConfig(xyz=(1, 0, 2)), 0.02, stamps
    )

    assert (model.rate_hz, model.phase_s, model.channels) == (10.0, 0.03, 16)
    assert (model.elevations_deg, model.max_range_m, model.range_sigma_m) == (None, 15.0, 0.02)
