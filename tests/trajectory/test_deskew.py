"""Sweeps taken in motion become the clouds that a LiDAR at rest would have taken."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest

from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array, LidarScan, Trajectory
from caliv_graph.trajectory.deskew import deskew, deskewed_with_origins
from caliv_graph.trajectory.select import GivenTrajectory
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from tests.trajectory.motions import (
    START_NS,
    Course,
    arc_drive,
    config_for,
    mounted_askew,
    record,
    seconds,
    stamps,
)

MOUNTING = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, 0.17, 3.1), np.array([-0.4, 0.1, 2.0]))


def sweep(course: Course, stamp_ns: int, times_s: Array, seed: int = 0) -> tuple[LidarScan, Array]:
    """Points on a static world, each seen at its own time, and the same seen at the stamp."""
    rng = np.random.default_rng(seed)
    world = np.array([10.0, -5.0, 1.0]) + 8.0 * rng.standard_normal((len(times_s), 3))
    at = stamp_ns + np.round(1e9 * times_s).astype(np.int64)
    R, t = MOUNTING.rotation().matrix(), MOUNTING.translation()

    def seen(when: Array) -> Array:
        truth = course.at(when)
        in_vehicle = np.einsum("nji,nj->ni", truth.R_map_vehicle, world - truth.p_map_vehicle)
        return np.asarray((in_vehicle - t) @ R)

    still = seen(np.full(len(times_s), float(seconds(np.array([stamp_ns]))[0])))
    return LidarScan("rear", stamp_ns, seen(seconds(at)), "rear at 8 s", times_s), still


def even_turn(rate_rad_s: float, speed_m_s: float) -> GivenTrajectory:
    """Given poses of a turn on the spot, or of a straight drive."""
    at = START_NS + np.arange(11, dtype=np.int64) * 100_000_000
    poses = tuple(
        gtsam.Pose3(gtsam.Rot3.Yaw(rate_rad_s * k * 0.1), np.array([speed_m_s * k * 0.1, 0, 0]))
        for k in range(11)
    )
    return GivenTrajectory(Trajectory(at, poses))


def test_a_straight_drive_by_hand() -> None:
    scan = LidarScan(
        "front",
        START_NS + 500_000_000,
        np.array([[10.0, 0.0, 0.0], [10.0, 0.0, 0.0]]),
        "scan",
        np.array([0.0, 0.1]),
    )
    moved = deskew(scan, gtsam.Pose3(), even_turn(0.0, 3.0))
    # Seen 0.1 s later, the vehicle was 0.3 m farther on.
    np.testing.assert_allclose(moved.points_lidar, [[10.0, 0.0, 0.0], [10.3, 0.0, 0.0]], atol=1e-9)
    assert moved.point_times_s is None


def test_beams_begin_where_the_lidar_was() -> None:
    """At 3 m/s it is 0.3 m farther on after 0.1 s; ranges are those that it measured."""
    T = gtsam.Pose3(gtsam.Rot3.Yaw(0.5 * np.pi), np.array([2.0, 0.0, 1.0]))
    measured = np.array([[10.0, 0.0, 0.0], [4.0, 3.0, -1.0]])
    scan = LidarScan("left", START_NS + 500_000_000, measured, "scan", np.array([0.0, 0.1]))
    points, origins = deskewed_with_origins(scan, T, even_turn(0.0, 3.0))
    # Ahead is to the right of a LiDAR that looks to the left.
    np.testing.assert_allclose(origins, [[0.0, 0.0, 0.0], [0.0, -0.3, 0.0]], atol=1e-9)
    np.testing.assert_allclose(points - origins, measured, atol=1e-9)
    np.testing.assert_array_equal(points, deskew(scan, T, even_turn(0.0, 3.0)).points_lidar)
    at_once = replace(scan, point_times_s=None)
    points, origins = deskewed_with_origins(at_once, T, even_turn(0.0, 3.0))
    assert (points == measured).all()
    assert not origins.any()


def test_a_turn_by_hand() -> None:
    scan = LidarScan(
        "front", START_NS + 500_000_000, np.array([[10.0, 0.0, 0.0]]), "s", np.array([-0.05])
    )
    moved = deskew(scan, gtsam.Pose3(), even_turn(0.4, 0.0))
    angle = -0.4 * 0.05
    np.testing.assert_allclose(
        moved.points_lidar, [[10.0 * np.cos(angle), 10.0 * np.sin(angle), 0.0]], atol=1e-6
    )


@cache
def rough_road(noise: float) -> tuple[Course, SmoothedTrajectory]:
    """One smoothed drive for all places of a stamp within its sweep."""
    course, sensors = Course(arc_drive(), rough=1.0), replace(mounted_askew(), noise=noise)
    motion = record(course, sensors, 0)
    return course, smooth_trajectory(motion, config_for(sensors), stamps(17.0, 10.0))


@pytest.mark.parametrize("begin_s", [0.0, -0.05, -0.1], ids=["begin", "middle", "end"])
@pytest.mark.parametrize(("noise", "rms_m"), [(0.0, 2e-4), (1.0, 4e-3)], ids=["exact", "noisy"])
def test_a_sweep_on_a_rough_road(begin_s: float, noise: float, rms_m: float) -> None:
    course, smoothed = rough_road(noise)
    stamp = START_NS + 8_000_000_000
    scan, still = sweep(course, stamp, begin_s + np.linspace(0.0, 0.1, 4000))
    skewed = np.linalg.norm(scan.points_lidar - still, axis=1).max()
    moved = deskew(scan, MOUNTING, smoothed)
    left = np.linalg.norm(moved.points_lidar - still, axis=1)
    assert skewed > 0.2
    # The gyroscope's 0.16 mrad per axis in 0.1 s, at up to 30 m, and no more.
    assert np.sqrt(np.mean(left**2)) < rms_m


def test_points_before_the_first_pose_move_as_if_the_vehicle_stood() -> None:
    trajectory = even_turn(0.0, 3.0)
    points = np.array([[10.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    scan = LidarScan("front", START_NS, points, "scan", np.array([-0.1, 0.05]))
    moved = deskew(scan, gtsam.Pose3(), trajectory)
    # Linear between knots a millisecond apart, the start among them but for rounding.
    np.testing.assert_allclose(moved.points_lidar[:, 0], [10.0, 10.15], atol=2e-3)


def test_a_scan_without_times_is_left_alone() -> None:
    scan = LidarScan("front", 7, np.ones((3, 3)), "scan")
    assert deskew(scan, gtsam.Pose3(), even_turn(0.1, 1.0)) is not scan
    np.testing.assert_array_equal(
        deskew(scan, gtsam.Pose3(), even_turn(0.1, 1.0)).points_lidar, scan.points_lidar
    )


@pytest.mark.parametrize(
    ("stamp_ns", "times", "message"),
    [
        (START_NS - 1, [0.0, 0.01], "outside the trajectory's span"),
        (START_NS, [0.0, 1.7e9], "no sweep takes a second"),
        (START_NS, [0.0, np.nan], "no sweep takes a second"),
    ],
    ids=["outside", "absolute-times", "nan"],
)
def test_bad_times_are_told(stamp_ns: int, times: list[float], message: str) -> None:
    scan = LidarScan("front", stamp_ns, np.ones((2, 3)), "front at 0", np.array(times))
    with pytest.raises(TrajectoryError, match=message):
        deskew(scan, gtsam.Pose3(), even_turn(0.0, 1.0))
