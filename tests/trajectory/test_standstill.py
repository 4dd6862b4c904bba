"""A vehicle that stands does not turn: the gyroscope's bias, where nothing else tells it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.products import MotionData
from caliv_graph.trajectory.inputs import SmootherInput, check_input
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.solve import without_heading
from caliv_graph.trajectory.standstill import TURN_RAD, standstills
from tests.trajectory.motions import record, seconds
from tests.trajectory.test_about_poses import (
    BIAS_RAD_S,
    COURSE,
    SENSORS,
    WANTED,
    smoothed_by_speeds,
    speeds_alone,
)

STANDS_S = COURSE.drive.speed.standstill_s


def with_zeros(motion: MotionData) -> MotionData:
    """Encoders that read zero while the wheels stand, as odometry has it."""
    assert motion.twist is not None
    velocity = motion.twist.velocity.copy()
    velocity[seconds(motion.twist.stamps_ns) <= STANDS_S] = 0.0
    return replace(motion, twist=replace(motion.twist, velocity=velocity))


def input_of(motion: MotionData) -> SmootherInput:
    _, config = speeds_alone()
    return check_input(motion, config)[0]


def test_the_bias_is_what_the_gyroscope_reads_while_the_vehicle_stands() -> None:
    motion, config = speeds_alone()

    found = standstills(input_of(with_zeros(motion)))

    assert len(found) == 1
    (first,) = found
    assert seconds(np.array([first.middle_ns]))[0] == pytest.approx(0.5 * STANDS_S, abs=0.1)
    assert np.abs(first.rate - [0.0, 0.0, BIAS_RAD_S]).max() < 4.0 * first.sigmas.max()
    # A turn of the body over what is left of a second, without its edges.
    assert first.sigmas.min() > TURN_RAD
    wide = smoothed_by_speeds()
    known = smooth_trajectory(with_zeros(motion), config, WANTED)
    assert known.pose_sigmas[2] < 0.25 * wide.pose_sigmas[2]
    bias = np.median(known.states.gyro_bias[:, 2])
    assert bias == pytest.approx(BIAS_RAD_S, abs=4.0 * first.sigmas[2])
    assert "standstill" in known.factor_kinds


def test_a_vehicle_that_may_turn_does_not_stand() -> None:
    motion = with_zeros(speeds_alone()[0])
    assert motion.twist is not None
    assert motion.imu is not None
    n = len(motion.twist.stamps_ns)

    on_the_spot = replace(motion.twist, yaw_rate=np.full(n, 0.3))
    assert not standstills(input_of(replace(motion, twist=on_the_spot)))
    still = replace(motion.twist, yaw_rate=np.where(np.arange(n) % 2, np.nan, 0.0))
    assert len(standstills(input_of(replace(motion, twist=still)))) == 1

    # No yaw rate: it begins to turn halfway.
    rates = motion.imu.angular_velocity.copy()
    rates[seconds(motion.imu.stamps_ns) > 0.5 * STANDS_S, 2] += 0.1
    turning = replace(motion, imu=replace(motion.imu, angular_velocity=rates))
    assert not standstills(input_of(turning))


def test_speeds_that_are_noise_or_short_are_no_standstill() -> None:
    motion = speeds_alone()[0]
    assert not standstills(input_of(motion))

    assert motion.twist is not None
    velocity = motion.twist.velocity.copy()
    velocity[seconds(motion.twist.stamps_ns) <= 0.35] = 0.0
    short = replace(motion, twist=replace(motion.twist, velocity=velocity))
    assert not standstills(input_of(short))


def test_where_fixes_or_orientations_measure_the_heading_it_is_not_used() -> None:
    measured = with_zeros(record(COURSE, SENSORS, 3))
    assert not standstills(input_of(measured))
    assert not standstills(input_of(replace(measured, gnss=None)))


def test_who_has_speeds_but_no_heading_is_told_to_stand_still() -> None:
    data = input_of(speeds_alone()[0])

    said = str(without_heading(data, 0.3))
    assert "its sigma is 17.2 degrees. Record orientation in the IMU's messages, or GNSS" in said
    assert "stand still for two seconds" in said
    assert "walls" not in said

    with_fixes = input_of(record(COURSE, SENSORS, 3))
    assert str(without_heading(with_fixes, 0.3)).endswith("Record GNSS along the whole drive")
