"""Raw sensors are smoothed, given poses taken; either answers the same questions."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest

from caliv_graph.errors import TrajectoryError
from caliv_graph.products import GivenPoses, LidarScan, MotionData
from caliv_graph.trajectory.select import GivenTrajectory, sharing_poses, smooth_trajectories
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from tests.trajectory.motions import (
    START_NS,
    Course,
    Sensors,
    arc_drive,
    config_for,
    record,
    stamps,
)


@dataclass(frozen=True)
class Drive:
    """A recording of two LiDARs, of which no cloud is read."""

    data: MotionData
    front: tuple[int, ...]
    rear: tuple[int, ...] = ()

    @property
    def name(self) -> str:
        return self.data.name

    @property
    def lidars(self) -> tuple[str, ...]:
        return ("front", "rear")

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        return self.front if lidar == "front" else self.rear

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        raise AssertionError(f"clouds of {lidar} are not needed")

    def motion(self) -> MotionData:
        return self.data

    def warnings(self) -> Sequence[str]:
        return ()


def given(count: int = 5) -> MotionData:
    """Poses every 0.1 s: 2 m/s along x, turning by 0.1 rad a second."""
    at = START_NS + np.arange(count, dtype=np.int64) * 100_000_000
    poses = tuple(
        gtsam.Pose3(gtsam.Rot3.Yaw(0.01 * k), np.array([0.2 * k, 0.0, 0.0])) for k in range(count)
    )
    return MotionData("drive/", poses=GivenPoses(at, poses))


def test_raw_sensors_are_smoothed_at_the_stamps_of_all_lidars() -> None:
    motion = record(Course(arc_drive(5.0)), Sensors(), 0)
    front, rear = stamps(5.0, 2.0, 0.1), stamps(5.0, 2.0, 0.15)
    drive = Drive(motion, tuple(front.tolist()), tuple(rear.tolist()))

    (smoothed,) = smooth_trajectories([drive], config_for(Sensors()))

    assert isinstance(smoothed, SmoothedTrajectory)
    expected = sorted([*front.tolist(), *rear.tolist()])
    assert smoothed.trajectory.stamps_ns.tolist() == expected


def test_only_the_stamps_that_are_asked_for() -> None:
    drive = Drive(record(Course(arc_drive(5.0)), Sensors(), 0), (START_NS,))
    (smoothed,) = smooth_trajectories([drive], config_for(Sensors()), [[START_NS + 10**9]])
    assert smoothed.trajectory.stamps_ns.tolist() == [START_NS + 10**9]


def test_given_poses_are_taken_where_there_is_nothing_else() -> None:
    (taken,) = smooth_trajectories([Drive(given(), (START_NS,))], config_for(Sensors()))
    assert isinstance(taken, GivenTrajectory)
    assert taken.lost_ns == ()
    assert taken.warnings == ()


def test_given_poses_beside_raw_sensors_are_taken_if_asked_for() -> None:
    motion = replace(record(Course(arc_drive(5.0)), Sensors(), 0), poses=given(51).poses)
    drive = Drive(motion, (START_NS,))
    (smoothed,) = smooth_trajectories([drive], config_for(Sensors()))
    assert isinstance(smoothed, SmoothedTrajectory)
    for asked in (
        {"topics": {"pose": "/pose"}},
        {"topics": {"imu": "/imu", "pose": "/pose"}},
        {"topics": {"imu": "/imu", "gnss": "/gnss"}, "data": {"poses": "poses.tum"}},
    ):
        (taken,) = smooth_trajectories([drive], config_for(Sensors(), **asked))
        assert isinstance(taken, GivenTrajectory)
        assert taken.poses_at([START_NS + 10**9])[1] == pytest.approx(np.array([[2.0, 0.0, 0.0]]))


def test_clouds_share_a_pose_where_motion_data_tell_what_is_between() -> None:
    later = START_NS + 3_000_000
    smoothed = Drive(record(Course(arc_drive(5.0)), Sensors(), 0), (START_NS,), (later,))
    taken = Drive(given(), (START_NS,), (later,))

    for drive, stamp in ((smoothed, START_NS), (taken, later)):
        shared = sharing_poses(drive, drive.motion(), config_for(Sensors()))
        assert list(shared.scan_stamps_ns("rear")) == [stamp]


def test_between_given_poses_the_vehicle_moves_evenly() -> None:
    (taken,) = smooth_trajectories([Drive(given(), (START_NS,))], config_for(Sensors()))
    R, t = taken.poses_at([START_NS + 150_000_000, START_NS])
    np.testing.assert_allclose(t, [[0.3, 0.0, 0.0], [0.0, 0.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(R[0], gtsam.Rot3.Yaw(0.015).matrix(), atol=1e-12)
    with pytest.raises(TrajectoryError, match="outside the given poses"):
        taken.poses_at([START_NS - 1])


def test_scans_outside_the_given_poses_are_lost_and_told() -> None:
    drive = Drive(given(), (START_NS, START_NS + 10**9))
    (taken,) = smooth_trajectories([drive], config_for(Sensors()))
    assert taken.lost_ns == (START_NS + 10**9,)
    assert taken.warnings == ("drive/: 1 of 2 scans are outside the given poses' span, lost",)
    with pytest.raises(TrajectoryError, match=r"all 1 scans .* Check their clocks"):
        smooth_trajectories([Drive(given(), (START_NS + 10**9,))], config_for(Sensors()))


def test_a_recording_without_any_motion_says_what_is_missing() -> None:
    with pytest.raises(TrajectoryError, match=r"^empty: no IMU and no velocities: set topics\.imu"):
        smooth_trajectories([Drive(MotionData("empty"), (START_NS,))], config_for(Sensors()))
