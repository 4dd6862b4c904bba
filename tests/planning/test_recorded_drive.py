"""Recorded drives as a prediction takes them: route, target and pose noise against the truth."""

from __future__ import annotations

import math
from pathlib import Path

import gtsam
import numpy as np
import pytest

from caliv_graph.config.model import Config
from caliv_graph.geometry.se3 import unstack
from caliv_graph.planning.assumptions import Assumptions
from caliv_graph.planning.predict import Prediction, predict_drives
from caliv_graph.planning.recorded_motion import lifted, pose_noise_model
from caliv_graph.planning.recorded_route import RecordedRoute
from caliv_graph.planning.recorded_target import CANDIDATES, Silhouettes, nearest_object
from caliv_graph.products import Array, Trajectory
from caliv_graph.scenario.drive_models import ArcDrive
from caliv_graph.scenario.drives import make_drive
from caliv_graph.scenario.model import load_scenario
from caliv_graph.scenario.shapes import object_mesh
from caliv_graph.trajectory.select import GivenTrajectory

SCENARIOS = Path(__file__).resolve().parents[2] / "configs" / "scenarios"
DRIVE = make_drive(ArcDrive(duration_s=17.0, radius_m=6.0, speed_m_s=1.5))
FIRST_NS = 1_750_000_000_000_000_000
UP_M = 0.4


def given(period_s: float, position_m: float = 0.0, rotation_rad: float = 0.0) -> GivenTrajectory:
    """Poses of a frame `UP_M` above ground along `DRIVE`, with white errors."""
    stamps = np.arange(0.0, DRIVE.duration_s, period_s)
    stamps_ns = np.rint(1e9 * stamps).astype(np.int64)
    states = DRIVE.states(stamps_ns, UP_M)
    rng = np.random.default_rng(5)
    errors = rng.normal(size=(len(stamps), 6)) * ([rotation_rad] * 3 + [position_m] * 3)
    poses = unstack(states.R_map_vehicle, states.position_map)
    noisy = [
        gtsam.Pose3(T.rotation().compose(gtsam.Rot3.Expmap(e[:3])), T.translation() + e[3:])
        for T, e in zip(poses, errors, strict=True)
    ]
    return GivenTrajectory(Trajectory(FIRST_NS + stamps_ns, tuple(noisy)))


def test_a_route_is_the_drive_with_its_frame_on_the_ground() -> None:
    begin_ns = 2_000_000_000
    end_ns = 16_000_000_000
    route = RecordedRoute(given(0.02), FIRST_NS + begin_ns, FIRST_NS + end_ns, UP_M)
    at = np.array([0, 3_000_000_000, 7_770_000_000], np.int64)

    found, true = route.states(at), DRIVE.states(begin_ns + at)

    assert route.duration_s == 14.0
    assert found.position_map == pytest.approx(true.position_map, abs=1e-3)
    assert found.R_map_vehicle == pytest.approx(true.R_map_vehicle, abs=1e-3)
    assert found.velocity_map == pytest.approx(true.velocity_map, abs=5e-3)
    assert found.angular_velocity == pytest.approx(true.angular_velocity, abs=2e-3)
    assert found.acceleration_map == pytest.approx(true.acceleration_map, abs=0.1)
    speed, curvature = route.habits()
    assert (speed, 1.0 / curvature) == pytest.approx((1.5, 6.0), rel=0.01)


def test_outside_its_span_a_route_stands_still_at_its_end() -> None:
    trajectory = given(0.1)
    route = RecordedRoute(trajectory, FIRST_NS, FIRST_NS + 17_000_000_000, UP_M)

    late = route.states(np.array([17_000_000_000, 30_000_000_000], np.int64))

    assert late.position_map[0] == pytest.approx(late.position_map[1], abs=1e-6)


def on_slope(slope_deg: float, ramp: bool = False) -> Prediction:
    """The arc past a chair as a recorded drive on a slope; `ramp`: 3 degrees more at the end."""
    scenario = load_scenario(SCENARIOS / "demo_arc.yaml")
    drive = make_drive(scenario.drive, None)
    stamps_ns = np.arange(0, round(1e9 * drive.duration_s), 50_000_000, dtype=np.int64)
    states = drive.states(stamps_ns)
    slope, more = (
        gtsam.Pose3(gtsam.Rot3.Pitch(-math.radians(deg)), np.zeros(3)) for deg in (slope_deg, 3.0)
    )
    poses = [slope.compose(T) for T in unstack(states.R_map_vehicle, states.position_map)]
    if ramp:
        begin = 4 * len(poses) // 5
        poses[begin:] = [T.compose(more) for T in poses[begin:]]
    route = RecordedRoute(
        GivenTrajectory(Trajectory(stamps_ns, tuple(poses))), 0, int(stamps_ns[-1]), 0.0
    )
    return predict_drives([(scenario, route)], Assumptions(structure=False))


def test_ground_with_a_slope_counts_and_a_ramp_does_not() -> None:
    """What the arc past a chair leaves open does not depend on the slope of the yard."""
    level, sloped, ramp = on_slope(0.0), on_slope(3.0), on_slope(3.0, ramp=True)
    assert len(sloped.undetermined) == len(level.undetermined)
    for name, sigma in level.sigma_s2v.items():
        np.testing.assert_allclose(sloped.sigma_s2v[name], sigma, rtol=0.1)
        # Fewer planes tell roll and pitch.
        assert (ramp.sigma_s2v[name][:2] > 1.03 * sigma[:2]).all()


def test_the_white_error_of_given_poses_is_seen_in_them() -> None:
    config = Config.model_validate({"lidars": {"a": {"topic": "a"}}})

    noisy = pose_noise_model(given(0.2, 0.005, 0.001), config)
    exact = pose_noise_model(given(0.2), config)

    assert noisy.position_sigma_m == pytest.approx(0.005, rel=0.2)
    assert noisy.rotation_sigma_rad == pytest.approx(0.001, rel=0.2)
    # The vehicle's own motion is not taken for an error.
    assert exact.position_sigma_m < 3e-4
    stated = config.model_copy(
        update={"noise": config.noise.model_copy(update={"pose_position_m": 0.02})}
    )
    assert pose_noise_model(given(0.2), stated).position_sigma_m == 0.02


def seen_from(model: object, towards: Array) -> Silhouettes:
    """Silhouettes of an object's mesh, from azimuths (n,), with a centimetre of noise."""
    vertices = object_mesh(model).vertices  # type: ignore[arg-type]
    yaw = math.radians(model.yaw_deg)  # type: ignore[attr-defined]
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    across = np.column_stack([-np.sin(towards), np.cos(towards)])
    rng = np.random.default_rng(1)
    width = np.ptp(vertices[:, :2] @ turn.T @ across.T, axis=0)
    height = np.full(len(towards), np.ptp(vertices[:, 2])) - 0.05
    noise = rng.normal(0.0, 0.01, (2, len(towards)))
    return Silhouettes(across, width + noise[0], height + noise[1])


@pytest.mark.parametrize("shape", CANDIDATES, ids=lambda shape: shape.__name__)
def test_the_nearest_object_is_the_one_that_was_seen(shape: type) -> None:
    true = shape(xy_m=(4.0, -2.0), yaw_deg=30.0)
    seen = seen_from(true, np.linspace(0.0, 2.5, 30))
    vertices = object_mesh(true).vertices
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    yaw = math.radians(30.0)
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    centre = np.array([*(np.array([4.0, -2.0]) + turn @ middle[:2]), middle[2]])

    found = nearest_object(seen, centre, 0.05)

    assert found.shape == true.shape
    # A silhouette is the same from behind, and mirrored objects look alike.
    assert found.xy_m == pytest.approx(true.xy_m, abs=0.25)


def test_a_mounting_in_a_frame_on_the_ground() -> None:
    T = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 3.0), np.array([1.0, 2.0, 3.0]))

    found = lifted(T, 0.4)

    assert found.xyz == (1.0, 2.0, 3.4)
    assert found.pose().rotation().equals(T.rotation(), 1e-5)
