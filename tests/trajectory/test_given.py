"""Given poses become a trajectory, unchanged."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from caliv_graph.errors import TrajectoryError
from caliv_graph.products import GivenPoses, MotionData
from caliv_graph.trajectory.given import given_trajectory


def recorded(*stamps_ns: int) -> MotionData:
    """A drive of which nothing but the poses was recorded."""
    poses = tuple(
        gtsam.Pose3(gtsam.Rot3.Yaw(0.01 * stamp), np.array([1.0 * stamp, 0.1, 2.0]))
        for stamp in stamps_ns
    )
    return MotionData("drive/", poses=GivenPoses(np.array(stamps_ns, dtype=np.int64), poses))


def test_the_poses_are_those_of_the_recording() -> None:
    trajectory = given_trajectory(recorded(1, 5, 9))

    assert trajectory.stamps_ns.tolist() == [1, 5, 9]
    assert trajectory.T_map_vehicle[2].rotation().yaw() == pytest.approx(0.09)
    assert trajectory.T_map_vehicle[2].translation() == pytest.approx([9.0, 0.1, 2.0])


@pytest.mark.parametrize("stamps", [(), (3,)])
def test_one_pose_is_no_drive(stamps: tuple[int, ...]) -> None:
    with pytest.raises(TrajectoryError) as caught:
        given_trajectory(recorded(*stamps))

    assert str(caught.value) == f"drive/: {len(stamps)} vehicle pose(s), needs at least 2"


def test_a_drive_without_poses_is_an_error() -> None:
    with pytest.raises(TrajectoryError, match="drive/: has no vehicle poses"):
        given_trajectory(MotionData("drive/"))
