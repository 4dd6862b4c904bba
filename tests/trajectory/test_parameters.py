"""Parameters of the smoother's input: what a moved one does is known by smoothing again."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any, TypeVar

import gtsam
import numpy as np
import pytest

from caliv_graph.config.model import Config
from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array, GnssFixes, ImuSamples, MotionData
from caliv_graph.trajectory.columns import whitening
from caliv_graph.trajectory.inputs import check_input
from caliv_graph.trajectory.parameters import (
    GNSS_TIME_OFFSET,
    GYROSCOPE,
    IMU_PLACE,
    IMU_ROTATION,
    IMU_TIME_OFFSET,
    LEVER_ARM,
    InputParameter,
)
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.with_parameters import with_parameters
from tests.trajectory.motions import Course, config_for, eight_drive, mounted_askew, record, stamps

Samples = TypeVar("Samples", ImuSamples, GnssFixes)

COURSE = Course(eight_drive(12.0), rough=1.0)
SENSORS = replace(mounted_askew(), gnss_delay_s=0.033, twist_hz=50.0, twist_delay_s=0.017)
MOTION = record(COURSE, SENSORS, 1)
WANTED = stamps(12.0, 2.0, 0.0512)
CONFIG = config_for(SENSORS, robust={"kernel": "none"})


@cache
def unmoved() -> SmoothedTrajectory:
    return smooth_trajectory(MOTION, CONFIG, WANTED)


def smoothed_with(parameter: InputParameter, d: Array) -> SmoothedTrajectory:
    """The drive again, with a parameter of the config moved by d, or stamps that are earlier by d.

    A sensor whose stamps are taken as late by d is one whose stamps are earlier by d.
    """
    if parameter is GNSS_TIME_OFFSET:
        assert MOTION.gnss is not None
        return smooth_trajectory(replace(MOTION, gnss=earlier(MOTION.gnss, d)), CONFIG, WANTED)
    if parameter is IMU_TIME_OFFSET:
        assert MOTION.imu is not None
        return smooth_trajectory(replace(MOTION, imu=earlier(MOTION.imu, d)), CONFIG, WANTED)
    if parameter is GYROSCOPE:
        return smooth_trajectory(with_response(MOTION, -d), CONFIG, WANTED)
    if parameter is LEVER_ARM:
        arm = np.array(CONFIG.gnss.lever_arm) + d
        return smooth_trajectory(MOTION, config_of({"gnss": {"lever_arm": tuple(arm)}}), WANTED)
    T = CONFIG.imu.T_vehicle_imu.pose()
    turn, shift = (d, np.zeros(3)) if parameter is IMU_ROTATION else (np.zeros(3), d)
    rpy = gtsam.Rot3.Expmap(turn).compose(T.rotation()).rpy()
    mounting = {"xyz": tuple(T.translation() + shift), "rpy_deg": tuple(np.degrees(rpy))}
    return smooth_trajectory(MOTION, config_of({"imu": {"T_vehicle_imu": mounting}}), WANTED)


def with_response(motion: MotionData, d: Array) -> MotionData:
    """The drive by a gyroscope that reads d more per turn about the vehicle's vertical."""
    assert motion.imu is not None
    gyro = motion.imu.angular_velocity
    up = SENSORS.T_vehicle_imu.rotation().matrix()[2]
    return replace(motion, imu=replace(motion.imu, angular_velocity=gyro + np.outer(gyro @ up, d)))


def earlier(samples: Samples, d: Array) -> Samples:
    return replace(samples, stamps_ns=samples.stamps_ns - round(1e9 * d[0]))


def config_of(changes: dict[str, dict[str, object]]) -> Config:
    raw = CONFIG.model_dump()
    for section, keys in changes.items():
        raw[section] |= keys
    return Config.model_validate(raw)


def test_derivatives_are_whitened_as_the_residuals_are() -> None:
    huber = smooth_trajectory(
        MOTION, config_of({"robust": {"kernel": "huber", "huber_k": 0.7}}), WANTED
    )
    estimate = huber.estimate()
    graph, values = estimate.graph.factors, estimate.values
    linear = graph.linearize(values)
    weights = []
    for number in range(graph.size()):
        factor: Any = graph.at(number)
        white = whitening(factor, values) @ factor.unwhitenedError(values)
        right: Any = linear.at(number)
        np.testing.assert_allclose(white, -right.getb(), atol=1e-9)
        weights.append(factor.noiseModel().weight(white))
    assert min(weights) < 0.8  # some fixes are beyond the bend of the kernel


@pytest.mark.parametrize(
    ("parameter", "d"),
    [
        (LEVER_ARM, np.array([0.02, -0.03, 0.01])),
        (IMU_ROTATION, np.array([1.0, -2.0, 1.5]) * 1e-3),
        (IMU_PLACE, np.array([0.02, -0.01, 0.03])),
        (GNSS_TIME_OFFSET, np.array([3e-3])),
        (IMU_TIME_OFFSET, np.array([-2e-4])),
        (GYROSCOPE, np.array([3e-3, -2e-3, 4e-3])),
    ],
    ids=["lever arm", "imu rotation", "imu place", "gnss clock", "imu clock", "gyroscope"],
)
def test_the_joint_gaussian_predicts_what_a_moved_parameter_does(
    parameter: InputParameter, d: Array
) -> None:
    smoothed = with_parameters(unmoved(), [parameter])

    joint = smoothed.joint(WANTED, [parameter.name])

    moved = smoothed_with(parameter, d)
    seen = np.concatenate(
        [
            gtsam.Pose3.Logmap(before.between(after))
            for before, after in zip(
                joint.T_map_vehicle, moved.trajectory.T_map_vehicle, strict=True
            )
        ]
    )
    size = 6 * len(WANTED)
    poses, cross = joint.information[:size, :size], joint.information[:size, size:]
    expected = np.linalg.solve(poses, joint.gradient[:size] - cross @ d)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(seen, expected, atol=0.02 * scale)
    # The sum of squares: minus its half is the log-likelihood whose gradient is stated.
    reduced = joint.information[size:, size:] - cross.T @ np.linalg.solve(poses, cross)
    slope = joint.gradient[size:] - cross.T @ np.linalg.solve(poses, joint.gradient[:size])
    after, before = (t.estimate() for t in (moved, smoothed))
    gained = after.graph.factors.error(after.values) - before.graph.factors.error(before.values)
    assert gained == pytest.approx(0.5 * d @ reduced @ d - slope @ d, rel=0.05, abs=0.05)


@pytest.mark.parametrize("late_s", [4e9, -12.0, math.nan])
def test_a_clock_that_no_motion_explains_ends_the_estimate(late_s: float) -> None:
    """Garbage in the fixes moved it beyond what nanoseconds hold."""
    data, _ = check_input(MOTION, CONFIG)
    with pytest.raises(TrajectoryError, match="Stamps of the gnss seem"):
        GNSS_TIME_OFFSET.moved(data, np.array([late_s]))
    moved = GNSS_TIME_OFFSET.moved(GNSS_TIME_OFFSET.moved(data, np.array([6.0])), np.array([-1.0]))
    assert moved.late_ns == {"gnss": 5_000_000_000}
    with pytest.raises(TrajectoryError, match="12 s late"):
        GNSS_TIME_OFFSET.moved(moved, np.array([7.0]))
