from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
import pytest

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config
from caliv_graph.errors import RecordingError
from caliv_graph.pipeline import Look
from caliv_graph.products import (
    Array,
    GivenPoses,
    LidarScan,
    MotionData,
    TargetCloud,
    TargetObservation,
)
from caliv_graph.trajectory.select import smooth_trajectories
from caliv_graph.workflows.scene import ALONG_SCANS, STANDS_M_S, Piece, Scene, scene_of

FRONT = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 2.5), np.array([2.0, 0.3, 1.5]))
REAR = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.3, -2.9), np.array([-0.4, 0.0, 1.8]))
MOUNTS = {"front": FRONT, "rear": REAR}
BEGIN_NS = 10**9
SPEED, RATE = 5.0, 0.4
"""m/s and rad/s."""

WALL = np.stack(
    [
        np.full(400, 12.0),
        np.tile(np.linspace(-9, 9, 40), 10),
        np.repeat(np.linspace(0.5, 4, 10), 40),
    ],
    axis=1,
)


def at(time_s: float) -> gtsam.Pose3:
    """T_map_vehicle: one second of standstill, then an arc."""
    s = max(time_s - 1.0, 0.0)
    twist = np.array([0.0, 0.0, RATE, SPEED, 0.0, 0.0])
    return gtsam.Pose3.Expmap(twist * s)


@dataclass
class Drive:
    """A drive past a wall; every sweep takes 0.1 s."""

    broken: str = ""
    posed: bool = True
    name: str = "drive"
    lidars: tuple[str, ...] = tuple(MOUNTS)

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        return [BEGIN_NS + k * 100_000_000 for k in range(50)]

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        if lidar == self.broken:
            raise RecordingError("its clouds are damaged")
        for stamp in self.scan_stamps_ns(lidar):
            if wanted is None or stamp in wanted:
                late = np.linspace(0.0, 0.099, len(WALL))
                seen = [
                    at(1e-9 * (stamp - BEGIN_NS) + s).compose(MOUNTS[lidar]).transformTo(p)
                    for s, p in zip(late, WALL, strict=True)
                ]
                yield LidarScan(lidar, stamp, np.array(seen), f"{lidar} at {stamp}", late)

    def motion(self) -> MotionData:
        if not self.posed:
            return MotionData(self.name)
        stamps = BEGIN_NS + 10_000_000 * np.arange(520)
        poses = tuple(at(1e-9 * float(stamp - BEGIN_NS)) for stamp in stamps)
        return MotionData(self.name, GivenPoses(stamps, poses))

    def warnings(self) -> Sequence[str]:
        return ()


def config(**keys: object) -> Config:
    lidars: dict[str, object] = {
        name: {
            "topic": name,
            "initial": {
                "xyz": T.translation().tolist(),
                "rpy_deg": np.degrees(T.rotation().rpy()).tolist(),
            },
        }
        for name, T in MOUNTS.items()
    }
    raw = {"topics": {"pose": "/pose"}, "lidars": lidars, **keys}
    return parse_config(raw, "config", Path())


def placed(pieces: Sequence[Piece], T_vehicle_lidar: gtsam.Pose3) -> Array:
    parts = [
        piece.T_view_vehicle.compose(T_vehicle_lidar).transformFrom(piece.points_lidar.T).T
        for piece in pieces
    ]
    return np.concatenate(parts)


def scene(drive: Drive | None = None, seen: Look | None = None, **keys: object) -> Scene:
    return scene_of(drive or Drive(), config(**keys), seen, SilentProgress())


def off_the_wall(points: Array) -> float:
    """Metres to the nearest point of the wall's plane, at most."""
    return float(np.abs(points[:, 0] - 12.0).max())


def test_with_the_right_mounting_the_wall_of_all_scans_is_one() -> None:
    found = scene()

    for lidar in found.lidars:
        assert len(lidar.along) >= ALONG_SCANS
        # Half a piece of 5 ms at 5 m/s, and 0.4 rad/s at 20 m: 33 mm.
        assert off_the_wall(placed(lidar.along, MOUNTS[lidar.name])) < 0.034
    assert np.allclose(found.path_map[-1], at(5.19).translation(), atol=1e-3)
    assert found.problems == ()


def test_another_mounting_moves_the_wall_of_every_scan_by_itself() -> None:
    """The motion compensation does not depend on the mounting with which clouds were read."""
    wrong = {name: T.compose(gtsam.Pose3.Expmap(np.full(6, 0.2))) for name, T in MOUNTS.items()}
    lidars = {
        name: {
            "topic": name,
            "initial": {
                "xyz": T.translation().tolist(),
                "rpy_deg": np.degrees(T.rotation().rpy()).tolist(),
            },
        }
        for name, T in wrong.items()
    }

    found = scene(lidars=lidars)

    for lidar in found.lidars:
        assert off_the_wall(placed(lidar.along, MOUNTS[lidar.name])) < 0.034
        assert off_the_wall(placed(lidar.along, wrong[lidar.name])) > 1.0


def test_the_single_scan_is_of_a_time_at_which_the_vehicle_stands() -> None:
    found = scene()

    assert found.T_map_view is not None
    assert found.T_map_view.equals(gtsam.Pose3(), STANDS_M_S)
    for lidar in found.lidars:
        assert len(lidar.once) > 1  # in pieces, by the times of its points
        assert off_the_wall(placed(lidar.once, MOUNTS[lidar.name])) < 1e-6


def test_without_poses_one_scan_in_the_vehicle_frame() -> None:
    found = scene(Drive(posed=False))

    assert found.T_map_view is None
    assert len(found.path_map) == 0
    assert "no trajectory" in found.problems[0]
    for lidar in found.lidars:
        (piece,) = lidar.once
        assert piece.T_view_vehicle.equals(gtsam.Pose3(), 0.0)
        assert lidar.along == ()


def test_a_lidar_with_damaged_clouds_is_named_and_the_others_shown() -> None:
    found = scene(Drive(broken="rear"))

    front, rear = found.lidars
    assert rear.once == rear.along == ()
    assert front.along
    assert found.problems == ("The clouds of lidar 'rear' are not shown: its clouds are damaged",)


def test_boxes_are_those_of_the_config_or_about_what_was_found() -> None:
    box = {"min": [10, -5, 0], "max": [14, 5, 3], "frame": "start"}
    drive = Drive()
    (trajectory,) = smooth_trajectories([drive], config(), [[]])
    chair = np.array([6.0, 2.0, 0.5]) + np.random.default_rng(0).uniform(-0.3, 0.3, (500, 3))
    stamp = BEGIN_NS + 3 * 10**9
    seen = at(3.0).compose(FRONT).transformTo(chair.T).T
    observation = TargetObservation(
        0, "chair", chair.mean(axis=0), (TargetCloud("front", 0, stamp, seen, "a scan"),)
    )
    look = Look((observation,), (), (), (), trajectory, None)

    (given,) = scene(seen=look, target=box).boxes
    (found,) = scene(seen=look).boxes

    assert (given.found, given.region.frame, given.region.max) == (False, "start", (14.0, 5.0, 3.0))
    assert (found.name, found.found, found.region.frame) == ("target", True, "map")
    # The chair and 0.3 m on every side.
    assert found.region.min == pytest.approx([5.4, 1.4, -0.1], abs=0.03)
    assert found.region.max == pytest.approx([6.6, 2.6, 1.1], abs=0.03)
    # Where the vehicle starts is not known.
    assert scene(Drive(posed=False), target=box).boxes == ()


def test_an_unknown_mounting_is_said() -> None:
    lidars = {"front": {"topic": "a"}, "rear": {"topic": "b", "initial": {"xyz": [0, 0, 1]}}}

    front, rear = scene(lidars=lidars).lidars

    assert (front.initial, front.origin) == (None, "mounting unknown")
    assert rear.origin == "initial guess"
