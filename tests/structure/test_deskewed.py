"""Clouds that were deskewed before they were recorded: found where a sweep meets itself."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.model import Config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.structure.deskewed import MotionLeft, motion_left
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.read import read_patches
from caliv_graph.trajectory.deskew import deskew
from caliv_graph.trajectory.select import GivenTrajectory
from tests.drives_with_chair import Memory
from tests.samples import pose
from tests.structure.worlds import Spinner, World, driven, ground, recorded, world_of, yard
from tests.trajectory.motions import eight_drive

TRUTH = pose((1.0, 0.3, 1.8), (2.0, 3.0, 20.0))
OFF = gtsam.Pose3(gtsam.Rot3.Expmap(np.radians([1.5, -1.0, 3.0])), np.array([0.1, -0.1, 0.05]))
GUESS = TRUTH * OFF
EIGHT = driven(eight_drive())
CONFIG = Config(
    lidars={
        "roof": LidarConfig(
            topic="roof",
            initial=PoseConfig(
                xyz=tuple(GUESS.translation()), rpy_deg=tuple(np.degrees(GUESS.rotation().rpy()))
            ),
        )
    }
)


def spinner(degrees: float = 360.0, sweep_s: float = 0.1) -> Spinner:
    return Spinner(
        TRUTH,
        np.arange(-20.0, 12.0, 2.0),
        np.linspace(-0.5 * degrees, 0.5 * degrees, round(2 * degrees), endpoint=False),
        sweep_s=sweep_s,
    )


def read(world: World, trajectory: GivenTrajectory, lidar: Spinner, moved: bool) -> DrivePatches:
    begin, end = trajectory.span_ns
    stamps = np.arange(begin + 100_000_000, end - 100_000_000, 1_500_000_000, dtype=np.int64)
    recording = recorded(world, trajectory, {"roof": lidar}, {"roof": stamps})
    if moved:
        clouds = tuple(
            replace(deskew(scan, TRUTH, trajectory), point_times_s=scan.point_times_s)
            for scan in recording.clouds["roof"]
        )
        recording = Memory({"roof": clouds}, recording.poses)
    (patches,) = read_patches([recording], [trajectory], CONFIG, SilentProgress(), keep_level=True)
    return patches


@cache
def found(moved: bool) -> MotionLeft:
    return motion_left([read(yard(), EIGHT, spinner(), moved)])["roof"]


def test_measured_points_have_all_of_the_motion() -> None:
    left = found(moved=False)

    assert left.share == pytest.approx(1.0, abs=0.1)
    assert left.measured
    assert not left.deskewed


def test_deskewed_points_have_none() -> None:
    left = found(moved=True)

    assert left.share == pytest.approx(0.0, abs=0.1)
    assert left.deskewed
    assert not left.measured


@pytest.mark.parametrize(
    ("world", "lidar"),
    [
        (world_of(ground()), spinner()),
        (yard(), spinner(sweep_s=0.0)),
        (yard(), spinner(degrees=120.0)),
    ],
    ids=["ground alone", "at an instant", "no end that meets the beginning"],
)
def test_what_is_not_seen_at_two_times_tells_nothing(world: World, lidar: Spinner) -> None:
    assert motion_left([read(world, EIGHT, lidar, moved=False)]) == {}


def test_the_vehicle_itself_does_not_look_deskewed() -> None:
    # A cab of 3 m that the LiDAR sees where its sweep ends and begins, upright across the motion.
    cab = world_of(
        [np.array([-2.0, -2.5, 0.5]), np.array([0.0, 3.0, 0.0]), np.array([0.0, 0.0, 3.0])]
    )
    seen = read(yard(), EIGHT, replace(spinner(), body=cab), moved=False)
    assert np.count_nonzero(np.linalg.norm(seen.centres_lidar, axis=1) < 5.0) > 300

    left = motion_left([seen])

    assert "roof" not in left or left["roof"].measured


def test_a_share_in_between_is_neither() -> None:
    for share in (-0.6, 0.4, 0.5, 0.6, 1.6):
        left = MotionLeft(share, 0.1, 50)
        assert not left.deskewed
        assert not left.measured
    assert not MotionLeft(0.0, 0.3, 50).deskewed
    assert not MotionLeft(1.0, 0.3, 50).measured
