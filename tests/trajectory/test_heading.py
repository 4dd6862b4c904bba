"""A vehicle frame that does not point where the vehicle goes is told; a true one is not."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caliv_graph.common.progress import SilentProgress
from caliv_graph.physics import smoothed_findings
from caliv_graph.products import MotionData, Recording
from caliv_graph.trajectory.heading import (
    HeadingDisagreement,
    heading_disagreement,
    turn_of_orientations,
)
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.tilt import vehicle_tilt
from tests.trajectory.motions import (
    Course,
    Sensors,
    arc_drive,
    config_for,
    eight_drive,
    mounted_askew,
    record,
    stamps,
)

EIGHT, ARC = Course(eight_drive(16.0)), Course(arc_drive())
LONG_EIGHT = Course(eight_drive(24.0))
TWO_DEGREES = math.radians(2.0)


def compared(
    course: Course, sensors: Sensors, seed: int, twist: bool, wanted_hz: float = 10.0
) -> HeadingDisagreement | None:
    motion: MotionData = record(course, sensors, seed)
    if not twist:
        motion = replace(motion, twist=None)
    wanted = stamps(course.duration_s, wanted_hz)
    return heading_disagreement(smooth_trajectory(motion, config_for(sensors), wanted), motion)


@pytest.mark.parametrize("twist", [True, False], ids=["measured-lateral", "no-slip"])
def test_an_orientation_source_that_is_turned_is_told(twist: bool) -> None:
    found = compared(EIGHT, replace(mounted_askew(), yaw_bias_rad=TWO_DEGREES), 1, twist)
    assert found is not None
    assert found.measured == twist
    assert abs(found.yaw_rad - TWO_DEGREES) < 4.0 * found.sigma_rad
    assert "heading is turned by +" in found.warning
    assert "imu.yaw_bias" in found.warning
    if not twist:
        assert found.axle_m == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize(
    ("course", "twist", "seed"),
    [(EIGHT, True, 0), (EIGHT, False, 1), (ARC, True, 2), (ARC, False, 3)],
    ids=["eight-measured-lateral", "eight-no-slip", "arc-measured-lateral", "arc-no-slip"],
)
def test_a_true_heading_is_not(course: Course, twist: bool, seed: int) -> None:
    found = compared(course, mounted_askew(), seed, twist)
    assert found is not None
    assert not found.warning
    assert abs(found.yaw_rad) < 4.0 * found.sigma_rad


def test_on_an_arc_a_frame_off_the_axle_looks_like_a_turned_one() -> None:
    found = compared(ARC, replace(mounted_askew(), yaw_bias_rad=TWO_DEGREES), 1, False)
    assert found is not None
    assert math.isnan(found.axle_m)
    # 2 degrees on a radius of 9.16 m, to the right: 0.32 m.
    assert "0.3" in found.warning.split("vehicle frame is ")[1][:4]


def test_a_vehicle_that_stands_shows_nothing() -> None:
    assert compared(Course(arc_drive(4.0)), Sensors(), 0, True) is None


def test_a_compass_that_is_off_by_more_than_a_right_angle_is_told_with_its_sign() -> None:
    """Odometry, whose lateral velocity is none, says that the vehicle goes forward."""
    sensors = replace(mounted_askew(), yaw_bias_rad=math.radians(120.0), imu_hz=50.0)
    motion = record(LONG_EIGHT, sensors, 1)
    assert motion.twist is not None
    ahead = motion.twist.velocity * [1.0, 0.0, 0.0]
    motion = replace(motion, twist=replace(motion.twist, velocity=ahead))
    wanted = stamps(LONG_EIGHT.duration_s, 5.0)
    found = heading_disagreement(smooth_trajectory(motion, config_for(sensors), wanted), motion)
    assert found is not None
    assert math.degrees(found.yaw_rad) == pytest.approx(120.0, abs=3.0)
    assert "heading is turned by +1" in found.warning


@pytest.mark.parametrize(
    ("twist", "imu_hz", "wanted_hz", "against_fixes", "most_dropped"),
    # With twice the samples and poses the solve of the first takes five times as long.
    [
        (True, 50.0, 5.0, True, False),
        (False, 100.0, 10.0, False, False),
        (False, 50.0, 5.0, True, True),
    ],
    ids=["measured-lateral", "no-slip", "half-of-the-fixes-dropped"],
)
def test_a_compass_that_counts_from_north_is_told(
    twist: bool, imu_hz: float, wanted_hz: float, against_fixes: bool, most_dropped: bool
) -> None:
    sensors = replace(Sensors(), yaw_bias_rad=math.radians(80.0), imu_hz=imu_hz)
    motion = record(LONG_EIGHT, sensors, 1)
    motion = motion if twist else replace(motion, twist=None)
    config = config_for(sensors, ground={"use": False})
    smoothed = smooth_trajectory(motion, config, stamps(LONG_EIGHT.duration_s, wanted_hz))
    found = heading_disagreement(smoothed, motion)
    assert found is not None
    # Where the rest outvotes the fixes, these tell with the orientations as they are: within them
    # alone the smoothed path is turned by 172 degrees in the last.
    assert found.yaw_rad == pytest.approx(math.radians(80.0), abs=math.radians(2.0))
    assert found.sigma_rad < math.radians(2.0)
    assert found.warning
    assert ("against the path of the GNSS fixes" in found.warning) == against_fixes
    recording = cast("Recording", SimpleNamespace(name="drive"))
    said = smoothed_findings([recording], [smoothed], {0: motion}, config, SilentProgress())
    lost = [each for each in said if each.input.startswith("topics.gnss")]
    assert [each.severity for each in lost] == ["contradiction"] * most_dropped
    assert all("GNSS fixes disagree with the motion" in each.sentence for each in lost)


def test_driving_backwards_is_no_disagreement() -> None:
    forward = eight_drive(24.0)
    backward = replace(forward, speed=replace(forward.speed, speed_m_s=-2.0))
    found = compared(Course(backward), Sensors(), 1, False)
    assert found is not None
    assert not found.warning
    assert abs(found.yaw_rad) < 4.0 * found.sigma_rad


def test_a_heading_from_north_is_told_before_any_scan_has_a_pose() -> None:
    sensors = replace(Sensors(), yaw_bias_rad=math.radians(80.0))
    motion = record(EIGHT, sensors, 1)
    found = heading_disagreement(smooth_trajectory(motion, config_for(sensors), ()), motion)
    assert found is not None
    assert found.sigma_rad > 0.0
    assert "against the path of the GNSS fixes" in found.warning


@cache
def without_twist() -> MotionData:
    return replace(record(EIGHT, mounted_askew(), 1), twist=None)


@cache
def at_every_stamp() -> SmoothedTrajectory:
    wanted = stamps(EIGHT.duration_s, 10.0)
    return smooth_trajectory(without_twist(), config_for(mounted_askew()), wanted)


@pytest.mark.parametrize("wanted_hz", [0.0, 1.0], ids=["no-stamps", "some-stamps"])
def test_heading_and_tilt_have_the_sigma_of_the_poses_whichever_are_wanted(
    wanted_hz: float,
) -> None:
    """Before any scan is looked at no stamps are wanted: poses are as uncertain as later."""
    config = config_for(mounted_askew())
    motion = without_twist()
    every = at_every_stamp()
    some = stamps(EIGHT.duration_s, wanted_hz) if wanted_hz else ()
    few = smooth_trajectory(motion, config, some)

    assert every.trajectory.cov is not None
    sigmas = np.sqrt(np.median(np.diagonal(every.trajectory.cov, axis1=1, axis2=2), axis=0))
    assert few.pose_sigmas == pytest.approx(sigmas, rel=0.1)
    expected, found = heading_disagreement(every, motion), heading_disagreement(few, motion)
    assert expected is not None
    assert found is not None
    assert found.sigma_rad == pytest.approx(expected.sigma_rad, rel=0.1)
    tilts = [vehicle_tilt(each, "drive", config).sigma_rad for each in (every, few)]
    assert tilts[1] == pytest.approx(tilts[0], rel=0.1)


@pytest.mark.parametrize("turn_deg", [30.0, 120.0, -80.0])
@pytest.mark.parametrize(
    ("speed_m_s", "measured"),
    [(1.0, False), (1.0, True), (-1.0, True)],
    ids=["forward", "speeds", "backwards"],
)
def test_orientations_that_are_turned_are_told_whatever_the_antenna_does(
    turn_deg: float, speed_m_s: float, measured: bool
) -> None:
    """On a circle of one side, where an arm of 1.6 m that is left out is 7 degrees."""
    arm, rate = np.array([1.5, 0.4, 0.8]), 0.3
    times = np.arange(0, 60_000_000_000, 20_000_000, dtype=np.int64)
    yaw = rate * 1e-9 * times
    around = Rotation.from_rotvec(np.outer(yaw, [0.0, 0.0, 1.0]))
    place = speed_m_s / rate * np.stack([np.sin(yaw), -np.cos(yaw), 0.0 * yaw], axis=1)
    antenna = place + around.apply(arm)
    said = Rotation.from_rotvec([0.0, 0.0, math.radians(turn_deg)]) * around
    first = np.arange(0, len(times) - 100, 10)
    pieces = np.stack([first, first + 100], axis=1)
    velocity = np.tile([speed_m_s, 0.0], (len(times), 1)) if measured else None

    # Messages begin after a third of the drive: pieces before have nothing to say.
    late = slice(1000, None)
    turn, sigma = turn_of_orientations(
        times[late],
        said.as_matrix()[late],
        None if velocity is None else velocity[late],
        times[pieces],
        antenna[pieces],
        arm,
    )

    assert math.degrees(turn) == pytest.approx(turn_deg, abs=0.1)
    assert sigma < 1e-3
    nothing = turn_of_orientations(
        times[:2], said.as_matrix()[:2], None, times[pieces[:0]], antenna[pieces[:0]], arm
    )
    assert nothing == (0.0, 0.0)
