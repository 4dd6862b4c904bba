"""Up and ahead for a tracked LiDAR, by tracks with known truth."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest

from caliv_graph.odometry.statement import course_of
from caliv_graph.odometry.track import Track
from caliv_graph.trajectory.odometry import VehicleStatement

YAW = 0.7
MOUNTED = gtsam.Pose3(gtsam.Rot3.Yaw(YAW), np.array([2.3, -0.4, 1.5]))


def driven(rate: list[float], speed: list[float], slip_rad: float = 0.0) -> Track:
    """The track of a LiDAR on a vehicle with some yaw rates (rad/s) and speeds (m/s), 5 s each."""
    dt = 0.1
    rates, speeds = np.repeat(rate, 50), np.repeat(speed, 50)
    yaw = np.concatenate([[0.0], np.cumsum(rates * dt)])
    place, poses = np.zeros(3), []
    for k, a in enumerate(yaw.tolist()):
        poses.append(gtsam.Pose3(gtsam.Rot3.Yaw(a), place).compose(MOUNTED))
        if k < len(rates):
            middle = a + 0.5 * float(rates[k]) * dt + slip_rad
            place = place + speeds[k] * dt * np.array([math.cos(middle), math.sin(middle), 0.0])
    back = poses[0].inverse()
    stamps = 1_750_000_000_000_000_007 + 100_000_000 * np.arange(len(poses), dtype=np.int64)
    return Track(stamps, tuple(back.compose(T) for T in poses), ())


def test_the_course_of_a_curved_drive_is_that_of_its_straight_parts() -> None:
    found = course_of(driven([0.3, -0.3, 0.0, -0.2, 0.25], [3.0] * 5), np.eye(3), None)
    assert found.angle_rad == pytest.approx(-YAW, abs=2e-3)
    assert found.ahead_m == pytest.approx(2.3, abs=0.05)
    assert found.sigma_rad < 5e-3


def test_a_slip_of_the_vehicle_turns_the_course() -> None:
    found = course_of(driven([0.0, 0.0], [3.0, 3.0], slip_rad=0.02), np.eye(3), None)
    assert found.angle_rad == pytest.approx(0.02 - YAW, abs=1e-3)


def test_backing_up_is_told_by_the_longer_way_or_the_guess() -> None:
    way = driven([0.2, -0.3, 0.1], [3.0, -2.0, 3.0])
    assert course_of(way, np.eye(3), None).angle_rad == pytest.approx(-YAW, abs=3e-3)
    only = driven([0.2, -0.3], [-2.0, -2.0])
    blind = course_of(only, np.eye(3), None).angle_rad
    assert math.cos(blind + YAW) == pytest.approx(-1.0, abs=1e-4)
    assert course_of(only, np.eye(3), -YAW + 0.1).angle_rad == pytest.approx(-YAW, abs=3e-3)


def test_an_arc_tells_no_yaw_and_a_standstill_none_at_all() -> None:
    arc = course_of(driven([0.3, 0.3], [3.0, 3.0]), np.eye(3), None)
    assert arc.sigma_rad > 0.3  # 10 m of a lever at 0.1 rad/m
    still = course_of(driven([0.0], [0.0]), np.eye(3), None)
    assert math.isinf(still.sigma_rad)


def statement(course_rad: float = 3e-3) -> VehicleStatement:
    R = gtsam.Rot3.RzRyRx(0.1, -0.2, 2.0).matrix()
    return VehicleStatement(R.T[:, 2], R.T[:, 0], 1.7, 5e-3, course_rad, 7e-3)


def test_a_mounting_that_agrees_has_no_residual() -> None:
    said = statement()
    T = gtsam.Pose3(gtsam.Rot3(said.level()), np.array([2.0, 0.5, 1.4]))
    r, _, _ = said.residuals(T, 0.3)
    np.testing.assert_allclose(r, 0.0, atol=1e-12)
    H, b = said.gaussian(T, 0.3)
    np.testing.assert_allclose(b, 0.0, atol=1e-9)
    assert np.linalg.matrix_rank(H, tol=1.0) == 4
    R = T.rotation().matrix()
    for axis in (0, 1):  # x and y of the vehicle
        shift = np.concatenate([np.zeros(3), R.T[:, axis]])
        assert shift @ H @ shift == pytest.approx(0.0, abs=1e-6)


def test_derivatives_of_the_statement() -> None:
    said = statement()
    T = gtsam.Pose3(gtsam.Rot3(said.level()), np.array([2.0, 0.5, 1.4])).retract(
        np.array([0.1, -0.2, 0.15, 0.3, 0.1, -0.2])
    )
    _, J, _ = said.residuals(T, 0.3)
    h = 1e-6
    for k, step in enumerate(h * np.eye(6)):
        ahead, behind = said.residuals(T.retract(step), 0.3), said.residuals(T.retract(-step), 0.3)
        np.testing.assert_allclose(J[:, k], (ahead[0] - behind[0]) / (2.0 * h), atol=1e-8)


def test_without_a_course_or_a_height_yaw_and_z_are_open() -> None:
    said = statement(course_rad=math.inf)
    T = gtsam.Pose3(gtsam.Rot3(said.level()), np.array([2.0, 0.5, 1.4]))
    H, _ = said.gaussian(T, None)
    assert np.isfinite(H).all()
    assert np.linalg.matrix_rank(H, tol=1.0) == 2
