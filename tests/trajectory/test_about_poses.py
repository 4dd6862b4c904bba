"""A smoothed trajectory linearised at other poses: the same data, another point."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest

from caliv_graph.config.model import Config
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, MotionData
from caliv_graph.trajectory.about_poses import about_poses
from caliv_graph.trajectory.correlated import CorrelatedError
from caliv_graph.trajectory.imu import log_so3
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from tests.trajectory.motions import (
    Course,
    Sensors,
    arc_drive,
    config_for,
    mounted_askew,
    record,
    seconds,
    stamps,
)

BIAS_RAD_S = 0.01
COURSE = Course(arc_drive(20.0))
SENSORS = replace(mounted_askew(), gyro_bias=(0.0, 0.0, BIAS_RAD_S), noise=0.3)
WANTED = stamps(20.0, 2.0, 0.1)


def speeds_alone(sensors: Sensors = SENSORS) -> tuple[MotionData, Config]:
    """A drive without fixes and orientations: a gyroscope's bias turns it."""
    motion = record(COURSE, sensors, 3)
    assert motion.imu is not None
    imu = replace(motion.imu, orientation_xyzw=None)
    return replace(motion, imu=imu, gnss=None), config_for(sensors)


@cache
def smoothed_by_speeds() -> SmoothedTrajectory:
    motion, config = speeds_alone()
    return smooth_trajectory(motion, config, WANTED)


@pytest.fixture
def smoothed() -> SmoothedTrajectory:
    return smoothed_by_speeds()


def truth() -> tuple[Array, Array]:
    true = COURSE.at(seconds(WANTED))
    return true.R_map_vehicle, true.p_map_vehicle


def turns(trajectory: SmoothedTrajectory, R: Array) -> Array:
    own, _ = stack(trajectory.trajectory.T_map_vehicle)
    return log_so3(np.swapaxes(own, 1, 2) @ R)


def test_at_its_own_poses_a_trajectory_stays(smoothed: SmoothedTrajectory) -> None:
    R, t = stack(smoothed.trajectory.T_map_vehicle)

    again = about_poses(smoothed, WANTED, R, t)

    before, after = smoothed.joint(WANTED), again.joint(WANTED)
    scale = np.sqrt(np.diag(before.information))
    assert np.abs(after.gradient / scale).max() < 0.05
    change = (after.information - before.information) / np.outer(scale, scale)
    assert np.abs(change).max() < 1e-3
    assert again.elsewhere
    assert not smoothed.elsewhere


def test_true_poses_give_the_bias_that_turned_the_heading(smoothed: SmoothedTrajectory) -> None:
    R, t = truth()
    assert np.abs(turns(smoothed, R)[:, 2]).max() > 0.03

    there = about_poses(smoothed, WANTED, R, t)

    assert np.abs(turns(there, R)).max() < 0.003
    assert np.median(there.states.gyro_bias[:, 2]) == pytest.approx(BIAS_RAD_S, abs=5e-4)
    assert there.trajectory.stamps_ns is smoothed.trajectory.stamps_ns


def test_the_gradient_pulls_back_to_where_the_data_want_the_poses(
    smoothed: SmoothedTrajectory,
) -> None:
    """The hold is no evidence: one step from elsewhere ends at the data's own estimate."""
    R, t = stack(smoothed.trajectory.T_map_vehicle)
    ramp = np.linspace(0.0, 0.004, len(WANTED))
    aside = [
        gtsam.Pose3(gtsam.Rot3(own), at).compose(gtsam.Pose3(gtsam.Rot3.Rz(by), np.zeros(3)))
        for own, at, by in zip(R, t, ramp.tolist(), strict=True)
    ]

    there = about_poses(smoothed, WANTED, *stack(aside))

    joint = there.joint(WANTED)
    moved = np.linalg.norm(turns(there, R), axis=1).max()
    step = np.linalg.solve(joint.information, joint.gradient).reshape(-1, 6)
    back = [T.retract(d) for T, d in zip(joint.T_map_vehicle, step, strict=True)]
    left = [own.between(T) for own, T in zip(smoothed.trajectory.T_map_vehicle, back, strict=True)]
    cov = smoothed.trajectory.cov
    assert cov is not None
    sigmas = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    off = np.array([gtsam.Pose3.Logmap(T) for T in left])
    assert moved > 0.003
    assert np.abs(off[1:] / sigmas[1:]).max() < 0.05
    # By all sigmas together: a ramp is within those of single poses, which grow over the drive.
    assert math.sqrt(off.ravel() @ joint.information @ off.ravel()) < 0.2
    assert math.sqrt(step.ravel() @ joint.information @ step.ravel()) > 1.0


def test_a_pose_needs_a_node_and_errors_over_time_stay(smoothed: SmoothedTrajectory) -> None:
    R, t = stack(smoothed.trajectory.T_map_vehicle)
    with pytest.raises(KeyError):
        about_poses(smoothed, WANTED + 12_345_678, R, t)
    slow = CorrelatedError("gnss", (0.01, 0.01, 0.01), 10.0)
    with pytest.raises(ValueError, match="correlated"):
        about_poses(replace(smoothed, correlated=(slow,)), WANTED, R, t)
