"""Given poses become a trajectory, unchanged."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import pytest

from caliv_graph.errors import RecordingError, TrajectoryError
from caliv_graph.products import GivenPoses, LidarScan, MotionData
from caliv_graph.trajectory.given import given_trajectories


@dataclass(frozen=True)
class PosesOnly:
    """A recording of which nothing but the poses is read."""

    name: str
    stamps_ns: tuple[int, ...]
    readable: bool = True

    @property
    def lidars(self) -> tuple[str, ...]:
        return ()

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        raise AssertionError(f"clouds of {lidar} are not needed")

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        raise AssertionError(f"clouds of {lidar} are not needed")

    def motion(self) -> MotionData:
        if not self.readable:
            raise RecordingError(f"{self.name}: damaged")
        poses = GivenPoses(
            np.array(self.stamps_ns, dtype=np.int64),
            tuple(pose_of(self.name, stamp) for stamp in self.stamps_ns),
        )
        return MotionData(self.name, poses=poses)

    def warnings(self) -> Sequence[str]:
        return ()


def pose_of(name: str, stamp: int) -> gtsam.Pose3:
    """A pose that tells drive and stamp apart."""
    return gtsam.Pose3(gtsam.Rot3.Yaw(0.01 * stamp), np.array([1.0 * stamp, 0.1 * len(name), 2.0]))


def test_every_drive_keeps_its_own_poses() -> None:
    first, second = given_trajectories([PosesOnly("a", (1, 5, 9)), PosesOnly("longer", (5, 6))])

    assert first.stamps_ns.tolist() == [1, 5, 9]
    assert second.stamps_ns.tolist() == [5, 6]
    assert first.pose_at(5).equals(pose_of("a", 5), 0.0)
    assert second.pose_at(5).equals(pose_of("longer", 5), 0.0)
    assert first.pose_at(9).translation() == pytest.approx([9.0, 0.1, 2.0])


@pytest.mark.parametrize("stamp", [0, 4, 10])
def test_there_is_no_pose_between_the_stamps(stamp: int) -> None:
    (trajectory,) = given_trajectories([PosesOnly("a", (1, 5, 9))])

    with pytest.raises(KeyError, match=str(stamp)):
        trajectory.pose_at(stamp)


@pytest.mark.parametrize("stamps", [(), (3,)])
def test_one_pose_is_no_drive(stamps: tuple[int, ...]) -> None:
    with pytest.raises(TrajectoryError) as caught:
        given_trajectories([PosesOnly("good", (1, 2)), PosesOnly("drive/", stamps)])

    assert str(caught.value) == f"drive/: {len(stamps)} vehicle pose(s), needs at least 2"


def test_an_unreadable_recording_says_so_itself() -> None:
    with pytest.raises(RecordingError, match="drive/: damaged"):
        given_trajectories([PosesOnly("drive/", (1, 2), readable=False)])
