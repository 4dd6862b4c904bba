"""Mistakes of guesses and poses that a drive past posts shows, without a target."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import cast

import gtsam
import numpy as np
import pytest

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.model import Config
from caliv_graph.mounting.doubts import Doubt, Kind, _explains, doubts
from caliv_graph.mounting.place import place_lidars
from caliv_graph.products import LidarScan, Trajectory
from caliv_graph.trajectory.select import GivenTrajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.wording.mounting import mistake_sentence
from tests.mounting.posts import Drive, config_of, views_kept

FRONT = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.17, 0.0), np.array([2.0, 0.0, 2.0]))
REAR = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.17, math.pi), np.array([-0.4, 0.0, 2.0]))
ERROR = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, -0.03, 0.04), np.array([0.06, -0.07, 0.04]))
"""As far off as a guess may be."""
DRIVE = Drive({"front": FRONT, "rear": REAR})
GUESSES = config_of(front=FRONT.compose(ERROR), rear=REAR.compose(ERROR))
DOWN = gtsam.Pose3(gtsam.Rot3(np.diag([1.0, -1.0, -1.0])), np.zeros(3))


@pytest.fixture(scope="module", autouse=True)
def keep_views() -> Iterator[None]:
    with views_kept():
        yield


def turned(degrees: float, T: gtsam.Pose3) -> gtsam.Pose3:
    """A mounting of which the rotation is turned about the vertical."""
    R = gtsam.Rot3.Yaw(math.radians(degrees)).compose(T.rotation())
    return gtsam.Pose3(R, T.translation())


def along(*poses: gtsam.Pose3) -> GivenTrajectory:
    return GivenTrajectory(Trajectory(DRIVE.way.trajectory.stamps_ns, poses))


def found(config: Config, way: GivenTrajectory = DRIVE.way) -> tuple[Doubt, ...]:
    return doubts([DRIVE], [way], config, SilentProgress())


def test_sound_guesses_have_no_mistake() -> None:
    assert found(GUESSES) == ()


def test_topics_that_are_swapped() -> None:
    config = config_of(front=REAR.compose(ERROR), rear=FRONT.compose(ERROR))
    (doubt,) = found(config)
    assert (doubt.kind, doubt.lidars) == ("exchanged", ("front", "rear"))
    text = mistake_sentence(doubt, config)
    assert "the topics of lidars 'front' and 'rear' are swapped" in text
    assert "Exchange lidars.front.topic and lidars.rear.topic" in text
    assert "y of both guesses" not in text  # front and rear do not mirror each other


@pytest.mark.parametrize(
    ("gains", "kind", "explained"),
    [
        ((1.26, 2.03), "exchanged", True),  # a pair counts together
        ((1.3, 1.3), "exchanged", False),
        ((0.9, 4.0), "exchanged", False),  # only one of them is wrong
        ((1.59,), "turned", False),
        ((1.61,), "turned", True),
    ],
)
def test_by_how_much_maps_must_be_sharper(
    gains: tuple[float, ...], kind: Kind, explained: bool
) -> None:
    assert _explains(np.array(gains), kind) is explained


def test_swapped_topics_of_a_symmetric_rig_may_be_guesses_with_y_to_the_right() -> None:
    """Of a vehicle with x forward, y right, z down: y, pitch and yaw have the other sign."""
    guesses = {
        name: gtsam.Pose3(
            gtsam.Rot3.RzRyRx(0.0, -0.17, math.radians(side * 40.0 + 5.0)),
            np.array([1.2, side * 0.6, 1.8]),
        )
        for name, side in (("left", -1.0), ("right", 1.0))
    }
    config = config_of(**guesses)
    sharing = {"left": (1.0, 4.0), "right": (1.1, 4.2)}
    text = mistake_sentence(
        Doubt(0, "drive", "exchanged", ("left", "right"), 0, sharing, False), config
    )
    assert "the topics of lidars 'left' and 'right' are swapped, or y of both guesses" in text
    assert "change the sign of y and yaw of all guesses, and of roll or pitch if" in text


@pytest.mark.parametrize("degrees", [180.0, -90.0])
def test_a_guess_whose_yaw_is_a_quarter_turn_off(degrees: float) -> None:
    config = config_of(front=FRONT.compose(ERROR), rear=turned(degrees, REAR.compose(ERROR)))
    (doubt,) = found(config)
    assert (doubt.kind, doubt.lidars, doubt.turn_deg) == ("turned", ("rear",), degrees)
    now, then = doubt.sharing["rear"]
    assert then > 1.6 * now
    text = mistake_sentence(doubt, config)
    assert f"'rear' is turned by {abs(degrees):.0f} degrees of yaw" in text
    right = math.degrees(REAR.compose(ERROR).rotation().yaw())
    assert f"{math.remainder(right, 360.0):.1f}]" in text


@pytest.mark.parametrize(("axis", "word"), [("x", "roll"), ("y", "pitch")])
def test_a_lidar_that_is_the_other_way_up(axis: str, word: str) -> None:
    over = gtsam.Rot3.Rx(math.pi) if axis == "x" else gtsam.Rot3.Ry(math.pi)
    guess = REAR.compose(ERROR).compose(gtsam.Pose3(over, np.zeros(3)))
    config = config_of(front=FRONT.compose(ERROR), rear=guess)
    (doubt,) = doubts([DRIVE], [DRIVE.way], config, SilentProgress(), ("rear",))
    assert (doubt.kind, doubt.lidars) == ("upside_down", ("rear",))
    text = mistake_sentence(doubt, config)
    assert "the initial guess has lidar 'rear' upside down" in text
    assert f"({word} about 180 degrees off)" in text
    right = np.degrees(REAR.compose(ERROR).rotation().rpy())
    assert f"about [{', '.join(f'{angle:.1f}' for angle in right)}]" in text


def test_a_ceiling_is_no_ground_of_a_lidar_whose_guess_nothing_contradicts() -> None:
    over = gtsam.Pose3(gtsam.Rot3.Rx(math.pi), np.zeros(3))
    hanging = config_of(front=FRONT.compose(ERROR), rear=REAR.compose(over))
    assert all(doubt.kind != "upside_down" for doubt in found(hanging))
    low = gtsam.Pose3(REAR.rotation(), REAR.translation() - [0.0, 0.0, 1.2])
    elsewhere = config_of(front=FRONT.compose(ERROR), rear=low.compose(over))
    for doubt in doubts([DRIVE], [DRIVE.way], elsewhere, SilentProgress(), ("rear",)):
        assert doubt.kind != "upside_down"


def test_a_heading_that_points_backwards() -> None:
    back = gtsam.Pose3(gtsam.Rot3.Yaw(math.pi), np.zeros(3))
    way = along(*(T.compose(back) for T in DRIVE.way.trajectory.T_map_vehicle))
    (doubt,) = found(GUESSES, way)
    assert (doubt.kind, doubt.turn_deg, doubt.given) == ("heading", 180, True)
    text = mistake_sentence(doubt, GUESSES)
    assert "the heading of the vehicle is turned by 180 degrees" in text
    assert "a vehicle that reverses points against its course" in text


def test_poses_of_north_east_down() -> None:
    way = along(*(DOWN.compose(T).compose(DOWN) for T in DRIVE.way.trajectory.T_map_vehicle))
    (doubt,) = found(GUESSES, way)
    assert (doubt.kind, doubt.lidars) == ("mirrored", ("front", "rear"))
    text = mistake_sentence(doubt, GUESSES)
    assert "a map with z down" in text
    assert "Set data.pose_axes: ned" in text


def left_handed(*names: str) -> Drive:
    """The drive, y of the clouds of some LiDARs to the right."""

    class Mirrored(Drive):
        def scan(self, lidar: str, stamp: int) -> LidarScan:
            scan = DRIVE.scan(lidar, stamp)
            if lidar not in names:
                return scan
            return replace(scan, points_lidar=scan.points_lidar * [1.0, -1.0, 1.0])

    return Mirrored(DRIVE.mountings)


def test_left_handed_clouds_of_one_lidar() -> None:
    (doubt,) = doubts([left_handed("rear")], [DRIVE.way], GUESSES, SilentProgress())
    assert (doubt.kind, doubt.lidars) == ("left_handed", ("rear",))
    assert "the clouds of lidar 'rear' are left-handed" in mistake_sentence(doubt, GUESSES)


def test_left_handed_clouds_of_all_lidars_on_a_path_of_the_sensors_of_motion() -> None:
    class Estimated:
        """A path that nobody gave."""

        span_ns, lost_ns = DRIVE.way.span_ns, DRIVE.way.lost_ns
        poses_at = staticmethod(DRIVE.way.poses_at)

    drive = left_handed("front", "rear")
    way = cast("SmoothedTrajectory", Estimated())
    (doubt,) = doubts([drive], [way], GUESSES, SilentProgress())
    assert (doubt.kind, doubt.lidars) == ("left_handed", ("front", "rear"))
    assert "most likely, the clouds are left-handed" in mistake_sentence(doubt, GUESSES)


def test_left_handed_clouds_of_all_lidars_look_like_poses_of_north_east_down() -> None:
    drive = left_handed("front", "rear")
    (doubt,) = doubts([drive], [DRIVE.way], GUESSES, SilentProgress())
    assert (doubt.kind, doubt.lidars) == ("mirrored", ("front", "rear"))
    assert "or all clouds are left-handed" in mistake_sentence(doubt, GUESSES)
    assert "write the points with y to the left" in mistake_sentence(doubt, GUESSES)
    assert "Set data.pose_axes: ned" in mistake_sentence(doubt, GUESSES)
    # Set already: then the poses were of a map with z up.
    data = GUESSES.data.model_copy(update={"pose_axes": "ned"})
    text = mistake_sentence(doubt, GUESSES.model_copy(update={"data": data}))
    assert "a map with z up, other than data.pose_axes: ned says" in text
    assert "Set data.pose_axes: flu" in text


def test_a_mistake_of_the_config_is_said_once_of_several_drives() -> None:
    config = config_of(front=REAR, rear=FRONT)
    (doubt,) = doubts([DRIVE, DRIVE], [DRIVE.way, DRIVE.way], config, SilentProgress())
    assert doubt.drive == 0


def test_a_heading_is_of_one_drive() -> None:
    back = gtsam.Pose3(gtsam.Rot3.Yaw(math.pi), np.zeros(3))
    wrong = along(*(T.compose(back) for T in DRIVE.way.trajectory.T_map_vehicle))
    second = replace(DRIVE, name="second")
    (doubt,) = doubts([DRIVE, second], [DRIVE.way, wrong], GUESSES, SilentProgress())
    assert (doubt.drive, doubt.name, doubt.kind) == (1, "second", "heading")


def test_a_drive_without_anything_upright_tells_nothing() -> None:
    bare = replace(DRIVE, posts=False)
    assert doubts([bare], [bare.way], config_of(front=REAR, rear=FRONT), SilentProgress()) == ()


def test_a_mounting_that_was_found_is_no_guess_to_doubt() -> None:
    config, _ = place_lidars([DRIVE], [DRIVE.way], config_of("front", rear=REAR), SilentProgress())
    assert found(config) == ()
    assert found(config_of(front=FRONT)) == ()
