"""Systematic errors of ranges: a constant of the LiDAR, and one that grows with the incidence."""

import math
from typing import Any

import gtsam
import numpy as np
import pytest

from caliv_graph.config.mounting import PoseConfig
from caliv_graph.products import Array
from caliv_graph.scenario.drive_models import StandstillDrive
from caliv_graph.scenario.model import Scenario
from caliv_graph.scenario.sensor_models import LidarModel
from caliv_graph.scenario.world import make_world
from caliv_graph.scenario.world_models import BodyBoxModel, GroundModel, WallModel, WorldModel
from caliv_graph.simulation.lidar import ChannelErrors, SimulatedLidar
from caliv_graph.simulation.rays import RayCaster
from caliv_graph.simulation.recording import simulate_drive

HEIGHT_M = 2.0

LIDAR = LidarModel(
    mounting=PoseConfig(xyz=(0.0, 0.0, HEIGHT_M)),
    # Below the horizontal: incidences of 30, 45, 60, 78, 84 degrees on level ground.
    elevations_deg=(-60.0, -45.0, -30.0, -12.0, -6.0),
    horizontal_fov_deg=(-10.0, 10.0),
    horizontal_resolution_deg=10.0,
    range_sigma_m=0.0,
)


def ranges(model: LidarModel, range_bias_m: float = 0.0, body: tuple[Any, ...] = ()) -> Array:
    """(channels, columns) metres to level ground."""
    world = make_world(WorldModel(), body)
    lidar = SimulatedLidar(
        model, world, RayCaster(world), None, np.random.default_rng(1), range_bias_m
    )
    points = lidar.scan(gtsam.Pose3()).points_lidar
    return np.asarray(np.linalg.norm(points, axis=1).reshape(5, 2))


def test_a_constant_error_lengthens_every_range() -> None:
    noisy = LIDAR.model_copy(update={"range_sigma_m": 0.02})
    difference_m = ranges(noisy, 0.007) - ranges(noisy)
    np.testing.assert_allclose(difference_m, 0.007, atol=1e-12)


def test_the_error_of_incidence_is_b_at_60_degrees_and_constant_beyond_80() -> None:
    model = LIDAR.model_copy(update={"incidence_bias_m": 0.002})
    difference_m = (ranges(model) - ranges(LIDAR))[:, 0]
    secants = [1.0 / math.cos(math.radians(angle)) for angle in (30.0, 45.0, 60.0, 78.0, 80.0)]
    np.testing.assert_allclose(difference_m, 0.002 * (np.array(secants) - 1.0), atol=2e-6)
    assert difference_m[2] == pytest.approx(0.002, abs=1e-6)


def test_the_vehicle_itself_is_hit_squarely() -> None:
    # A plate below the LiDAR that all beams hit at a slant.
    body = (BodyBoxModel(centre_m=(20.0, 0.0, 0.5), size_m=(60.0, 60.0, 0.1)),)
    model = LIDAR.model_copy(update={"incidence_bias_m": 0.002})
    np.testing.assert_array_equal(ranges(model, body=body), ranges(LIDAR, body=body))


def test_each_channel_has_its_own_error_of_range_and_direction() -> None:
    world = make_world(WorldModel(), ())
    errors = ChannelErrors(
        range_m=np.array([0.01, 0.0, 0.0, 0.0, 0.0]),
        elevation_rad=np.array([0.0, 1e-3, 0.0, 0.0, 0.0]),
        azimuth_rad=np.array([0.0, 0.0, 2e-3, 0.0, 0.0]),
    )
    rng = np.random.default_rng(1)
    lidar = SimulatedLidar(LIDAR, world, RayCaster(world), None, rng, 0.0, errors)
    points = lidar.scan(gtsam.Pose3()).points_lidar.reshape(5, 2, 3)
    measured_m = np.linalg.norm(points, axis=2)
    difference_m = measured_m - ranges(LIDAR)
    np.testing.assert_allclose(difference_m[0], 0.01, atol=1e-6)
    # A beam that is higher than reported goes farther: 2 m over the sine of 45 degrees.
    farther_m = 2.0 / math.sin(math.radians(45.0) - 1e-3) - 2.0 / math.sin(math.radians(45.0))
    np.testing.assert_allclose(difference_m[1], farther_m, atol=1e-6)
    # On level ground the azimuth changes no range; reported directions are those of the model.
    np.testing.assert_allclose(difference_m[2:], 0.0, atol=1e-6)
    elevations = np.degrees(np.arcsin(points[:, 0, 2] / measured_m[:, 0]))
    assert elevations.tolist() == pytest.approx(LIDAR.elevations_deg)


def biased_scenario(**changes: float) -> Scenario:
    model = LIDAR.model_copy(update=changes)
    return Scenario(
        name="biased",
        drive=StandstillDrive(duration_s=0.3),
        lidars={"one": model, "other": model},
        world=WorldModel(ground=GroundModel(half_size_m=50.0)),
    )


def test_drawn_errors_are_each_lidar_s_own_and_in_the_truth() -> None:
    scenario = biased_scenario(range_bias_m=0.1, range_bias_sigma_m=0.01)
    drawn = [list(simulate_drive(scenario, seed).truth.range_bias_m.values()) for seed in range(50)]
    values = np.array(drawn)
    assert values.mean() == pytest.approx(0.1, abs=0.004)
    assert values.std() == pytest.approx(0.01, rel=0.3)
    assert abs(np.corrcoef(values.T)[0, 1]) < 0.4
    recording, exact = simulate_drive(scenario, 3), simulate_drive(biased_scenario(), 3)
    for name, bias_m in recording.truth.range_bias_m.items():
        (biased, *_), (plain, *_) = recording.scans(name), exact.scans(name)
        longer_m = np.linalg.norm(biased.points_lidar, axis=1) - np.linalg.norm(
            plain.points_lidar, axis=1
        )
        np.testing.assert_allclose(longer_m, bias_m, atol=1e-9)


def test_errors_of_channels_are_drawn_once_per_lidar_and_drive() -> None:
    scenario = biased_scenario(channel_bias_sigma_m=0.02, channel_direction_sigma_mrad=2.0)
    right, wrong = (simulate_drive(each, seed=3) for each in (biased_scenario(), scenario))
    assert not right.channel_errors
    assert set(wrong.channel_errors) == {"one", "other"}
    for name, errors in wrong.channel_errors.items():
        for scan, without in zip(wrong.scans(name), right.scans(name), strict=True):
            seen = scan.points_lidar.reshape(5, 2, 3)
            nominal = without.points_lidar.reshape(5, 2, 3)
            # Nominal directions, true ranges of the turned beams, and the channel's own error.
            direction = nominal / np.linalg.norm(nominal, axis=2, keepdims=True)
            ranges_m = np.linalg.norm(seen, axis=2)
            np.testing.assert_allclose(seen, ranges_m[..., None] * direction, atol=1e-9)
            # The vehicle stands as high as it drew it.
            height_m = -nominal[:, 0, 2]
            down = np.arcsin(-direction[:, 0, 2]) - errors.elevation_rad
            expected_m = height_m / np.sin(down) + errors.range_m
            np.testing.assert_allclose(ranges_m[:, 0], expected_m, atol=1e-5)
    first, second = wrong.channel_errors.values()
    assert (first.range_m != second.range_m).all()
    assert np.abs(first.elevation_rad).max() < 8e-3


def test_a_channel_that_is_turned_to_the_left_sees_the_wall_there() -> None:
    """A wall that goes off to the left: a beam further left meets it later."""
    wall = WallModel(xy_m=(10.0, 0.0), yaw_deg=45.0, length_m=40.0, height_m=8.0, bumps_sigma_m=0.0)
    world = make_world(WorldModel(objects={"wall": wall}), ())
    level = LIDAR.model_copy(update={"elevations_deg": (-1.0, 1.0)})
    ranges_m = []
    for azimuth_rad in (0.0, 0.01):
        errors = ChannelErrors(np.zeros(2), np.zeros(2), np.full(2, azimuth_rad))
        rng = np.random.default_rng(1)
        lidar = SimulatedLidar(level, world, RayCaster(world), None, rng, 0.0, errors)
        ranges_m.append(np.linalg.norm(lidar.scan(gtsam.Pose3()).points_lidar, axis=1))
    change_m = ranges_m[1] - ranges_m[0]
    # 10 m away, at 45 degrees: 0.1 m, and 30 percent more or less 10 degrees to either side.
    assert change_m == pytest.approx(0.1, rel=0.5)
