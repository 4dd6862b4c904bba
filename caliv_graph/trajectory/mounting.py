"""The rotation of an IMU that nobody measured: a guess from gravity and the drive.

A vehicle stands upright on average, and its origin goes where its x axis points (`README.md`,
section 13). What the drive says more precisely is left to the smoother.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np

from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.alignment import level
from caliv_graph.trajectory.imu import interpolate
from caliv_graph.trajectory.inputs import SmootherInput
from caliv_graph.trajectory.states import States, without_bias

MIN_SPEED_M_S = 0.5
"""Slower, the direction of the velocity is noise."""

LEVEL_SIGMA_RAD = math.radians(3.0)
"""Mean slope and camber of the ground under a whole drive, and the lean of a loaded body: steeper
than any road's camber of 2.5 percent."""

COURSE_SIGMA_RAD = math.radians(3.0)
"""Mean slip angle of the vehicle's origin: it is a rear axle, or a metre from one on circles of
20 m."""

UNKNOWN_YAW_RAD = math.pi / math.sqrt(3.0)
"""Of any angle: the vehicle did not move."""

LEAST_ARM_SIGMA_M = 0.05
"""Least addition to the noise of the fixes, by an antenna that turns about the IMU."""

Smoother = Callable[[SmootherInput], States]


def needs_guess(data: SmootherInput) -> bool:
    """Whether the rotation of the IMU is unknown."""
    return data.config.imu.T_vehicle_imu.rpy_deg is None


def with_guessed_rotation(
    data: SmootherInput, nodes: IntArray, smoothed: Smoother
) -> SmootherInput:
    """The input with a rotation of the IMU, and its sigmas about the vehicle's axes.

    The IMU's own motion is smoothed first, by GNSS without a lever arm: the length of the arm is
    added to the noise of the fixes. Velocities and headings do not take part, their axes are the
    vehicle's.

    Args:
        data: the input; the rotation of its T_vehicle_imu is not used.
        nodes: (n,) stamps.
        smoothed: solves the smoother's graph of an input at the nodes.

    Raises:
        TrajectoryError: without GNSS nothing tells where the vehicle goes.
    """
    if data.positions is None:
        raise TrajectoryError(
            f"{data.name}: imu.T_vehicle_imu.rpy_deg is null, and without GNSS nothing tells where "
            "the vehicle goes: measure the rotation of the IMU, or set topics.gnss"
        )
    known = np.linalg.norm(data.lever_arm - data.T_vehicle_imu.translation())
    sigma = max(float(known), data.config.gnss.arm_sigma() or 0.0, LEAST_ARM_SIGMA_M)
    wide = replace(data.positions, cov_map=data.positions.cov_map + sigma**2 * np.eye(3))
    origin = gtsam.Pose3()
    alone = replace(
        data,
        motion=replace(data.motion, twist=None),
        positions=wide,
        T_vehicle_imu=origin,
        lever_arm=np.zeros(3),
        rotation_sigmas=None,
        headings=None,
        baselines=None,
    )
    states = smoothed(alone)
    R_vehicle_imu, yaw_sigma = _upright_and_ahead(data, nodes, states)
    T = gtsam.Pose3(gtsam.Rot3(R_vehicle_imu), data.T_vehicle_imu.translation())
    sigmas = np.array([LEVEL_SIGMA_RAD, LEVEL_SIGMA_RAD, yaw_sigma])
    return replace(data, T_vehicle_imu=T, rotation_sigmas=sigmas)


def _upright_and_ahead(data: SmootherInput, nodes: IntArray, states: States) -> tuple[Array, float]:
    """R_vehicle_imu and the sigma of its yaw, from the IMU's motion (n nodes) in the map."""
    R_level_imu = level(states.R_map_imu[:, 2].mean(axis=0))
    velocity = np.einsum("nji,nj->ni", states.R_map_imu, states.velocity_map) @ R_level_imu.T
    dead = without_bias(data.inertial, nodes, states)
    turn = interpolate(nodes, dead.stamps_ns, dead.gyro) @ R_level_imu[2]
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    fast = speed > MIN_SPEED_M_S
    if not fast.any():
        return R_level_imu, UNKNOWN_YAW_RAD
    # Where the IMU should go in the vehicle's axes: ahead, and around the vehicle's origin.
    x, y, _ = data.T_vehicle_imu.translation()
    ahead = _signed(data, nodes, speed)
    expected = np.stack([ahead - turn * y, turn * x], axis=1)[fast]
    seen = velocity[fast, :2]
    sine = float((seen[:, 0] * expected[:, 1] - seen[:, 1] * expected[:, 0]).sum())
    yaw = math.atan2(sine, float((seen * expected).sum()))
    return gtsam.Rot3.Rz(yaw).matrix() @ R_level_imu, COURSE_SIGMA_RAD


def _signed(data: SmootherInput, nodes: IntArray, speed: Array) -> Array:
    """(n,) speeds, negative where measured velocities say that the vehicle reverses."""
    twist = data.motion.twist
    if twist is None:
        return speed
    usable = np.isfinite(twist.velocity).all(axis=1)
    stamps = np.asarray(twist.stamps_ns, dtype=np.int64)[usable]
    if not len(stamps):
        return speed
    forward = interpolate(nodes, stamps, twist.velocity[usable, :1])[:, 0]
    return np.where(forward < 0.0, -speed, speed)
