from __future__ import annotations

import json
import math
from collections.abc import Container, Iterator, Sequence

import gtsam
import numpy as np
import pytest

from caliv_graph.common.progress import SilentProgress
from caliv_graph.products import GivenPoses, LidarScan, MotionData, TargetCloud, TargetObservation
from caliv_graph.readers.caliv_folder import FRAME_PERIOD_NS
from caliv_graph.report.inspection import Points, add_targets, inspect_recording


class Drive:
    """A recording in memory: frame n of a LiDAR has n points."""

    name = "drive"

    def __init__(self, frames: dict[str, list[int]], poses: Sequence[gtsam.Pose3]) -> None:
        self._frames = frames
        self._poses = tuple(poses)

    @property
    def lidars(self) -> tuple[str, ...]:
        return tuple(self._frames)

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        return [frame * FRAME_PERIOD_NS for frame in self._frames[lidar]]

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        for frame in self._frames[lidar]:
            yield LidarScan(lidar, frame * FRAME_PERIOD_NS, np.ones((frame, 3)), f"{frame}.pcd")

    def motion(self) -> MotionData:
        stamps_ns = np.arange(len(self._poses), dtype=np.int64) * FRAME_PERIOD_NS
        return MotionData(self.name, poses=GivenPoses(stamps_ns, self._poses))

    def warnings(self) -> Sequence[str]:
        return ()


STANDING = [gtsam.Pose3()] * 2


def test_clouds_rates_and_gaps() -> None:
    progress = SilentProgress()
    drive = Drive({"front": [3, 5, 7, 9, 15, 17, 19, 40], "rear": [4]}, STANDING)

    inspection = inspect_recording(drive, progress)

    front, rear = inspection.lidars["front"], inspection.lidars["rear"]
    assert (front.clouds, front.frames, front.step) == (8, (3, 40), 2)
    assert front.gaps == ((9, 15), (19, 40))
    # Frames come at 10 Hz; every other one is 5 Hz.
    assert front.rate_hz == pytest.approx(5.0)
    assert front.points == Points(min=3, median=12, max=40)
    assert (rear.clouds, rear.frames, rear.gaps, rear.rate_hz) == (1, (4, 4), (), None)
    assert [(stage.done, stage.total) for stage in progress.stages] == [(9, 9)]


def test_a_drive_on_a_circle() -> None:
    # A quarter of a circle to the right with radius 10 m in 90 steps, then one step back left.
    headings = [-math.radians(degrees) for degrees in (*range(91), 89)]
    poses = [
        gtsam.Pose3(
            gtsam.Rot3.Rz(heading), 10.0 * np.array([-math.sin(heading), math.cos(heading), 0.0])
        )
        for heading in headings
    ]
    poses[-1] = gtsam.Pose3(
        poses[-1].rotation(), poses[-2].translation() + np.array([0.0, 0.0, 0.5])
    )

    drive = inspect_recording(Drive({"front": [1]}, poses), SilentProgress()).drive

    assert drive.poses == 92
    assert drive.duration_s == pytest.approx(9.1)
    chord_m = 2 * 10.0 * math.sin(math.radians(0.5))
    assert drive.path_length_m == pytest.approx(90 * chord_m + 0.5)
    assert drive.climb_m == pytest.approx(0.5)
    assert drive.heading_change_deg == pytest.approx(-89.0)
    assert drive.turned_deg == pytest.approx(91.0)


def test_who_sees_the_target_when() -> None:
    drive = Drive({"front": [3, 5, 7, 9, 11, 13], "rear": [4, 6]}, STANDING)
    clouds = tuple(
        TargetCloud(
            "front", 0, frame * FRAME_PERIOD_NS, np.array([[x, 1.0, 0.0], [x, -1.0, 0.0]]), "f"
        )
        for frame, x in ((3, 9.0), (5, 8.0), (11, 4.0))
    )
    observation = TargetObservation(0, "chair", np.array([15.0, -9.0, 0.4]), clouds)

    inspection = add_targets(inspect_recording(drive, SilentProgress()), [observation])

    (target,) = inspection.targets or ()
    front = target.lidars["front"]
    assert (front.scans, front.frames) == (3, ((3, 5), (11, 11)))
    assert front.points == Points(2, 2, 2)
    assert front.range_m == pytest.approx((4.0, 9.0))
    assert target.lidars["rear"].scans == 0
    document = json.loads(json.dumps(inspection.document(), allow_nan=False))
    assert document["targets"][0]["lidars"]["front"]["frames"] == [[3, 5], [11, 11]]
