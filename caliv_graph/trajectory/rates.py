"""Errors of the rates of a trajectory: what errors of its poses do to the motion within sweeps.

Points are moved over the time between their own and that of their pose with the rates of the
trajectory. These are the differences of its poses, so that they err as the poses do (`README.md`,
section 9).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import gtsam
import numpy as np

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.geometry.se3 import skew, twist_by_turn
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.select import GivenTrajectory, VehicleTrajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory

RATES = 9
"""Errors of the angular velocity (rad/s) and velocity (m/s) in the map, both along the vehicle's
axes; and how far the vehicle's origin is from the point of the body whose velocity that is (m)."""

MOST_TURN_RAD = 1.0
"""Largest rotation between two poses whose difference counts: the motion between them is taken as
one of constant velocities. A step of a radian is long, a chord 4 percent short of its arc."""

RATE_SIGMAS = np.repeat([1e-5, 1e-4, 1e-3], 3)
"""1 sigma of what ties them to the poses, rad/s, m/s and m. None is meant: over 0.1 s it moves a
point 20 m away by 0.02 mm, and at 0.5 rad/s a shift by 0.05 mm."""

LEAST_TURNING_RAD_S = 0.01
"""Root mean square of the angular velocity about its mean below which a shift of the origin is not
told apart from a mean velocity. What it would move is then a thousandth of it per sweep."""


def by_rates(angular_velocity: Array) -> Array:
    """(..., 6, RATES) what the errors make of a twist, at angular velocities (..., 3), rad/s.

    A point of the body that is s further on has the velocity `v + omega x s`.
    """
    out = np.zeros((*angular_velocity.shape[:-1], 6, RATES))
    out[..., range(6), range(6)] = 1.0
    out[..., 3:, 6:] = skew(angular_velocity)
    return out


def rate_rows(
    stamps_ns: Sequence[int] | IntArray,
    T_map_vehicle: Sequence[gtsam.Pose3],
    pivot_vehicle: Array | None = None,
) -> Array | None:
    """(RATES, 6 m) derivatives of the errors of the rates by right perturbations of m poses.

    The rates between two poses are `Log(X_i^-1 X_j) / (t_j - t_i)`. The errors are those that fit
    their change best over time: a constant twist, and a shift of the vehicle's origin. An antenna
    whose place is known to a centimetre shifts the origin along the body, and with it the velocity
    by `omega x s`, to the other side in the other curve: it is no mean velocity. What a
    turn of the pose changes of the velocities in vehicle axes, which those in the map are not, is
    taken out: it is another at every speed and in every curve, and follows from each pose by
    itself.

    Args:
        stamps_ns: (m,) of the poses, strictly increasing.
        T_map_vehicle: m poses.
        pivot_vehicle: (3,) metres, about which a turn of a pose is taken out: a turn of the vehicle
            frame about it is no error of the rates. None: its origin.

    Returns:
        None, if no two poses follow each other within `MOST_TURN_RAD`.
    """
    m = len(stamps_ns)
    pull, known = np.zeros((RATES, 6 * m)), np.zeros((RATES, RATES))
    total_s = 0.0
    for i in range(m - 1):
        step = T_map_vehicle[i].between(T_map_vehicle[i + 1])
        if np.linalg.norm(gtsam.Rot3.Logmap(step.rotation())) > MOST_TURN_RAD:
            continue
        # Log(Exp(-d_i) step Exp(d_j)); the time by which each difference is divided is its weight.
        by_later = np.asarray(gtsam.Pose3.LogmapDerivative(step))
        by_poses = np.hstack([-by_later @ step.inverse().AdjointMap(), by_later])
        motion = np.asarray(gtsam.Pose3.Logmap(step))
        half = 0.5 * twist_by_turn(motion, pivot_vehicle)
        by_poses[:, :3] -= half
        by_poses[:, 6:9] -= half
        seconds = int(stamps_ns[i + 1] - stamps_ns[i]) / NANOSECONDS_PER_SECOND
        by_errors = by_rates(motion[:3] / seconds)
        pull[:, 6 * i : 6 * i + 12] += by_errors.T @ by_poses
        known += seconds * by_errors.T @ by_errors
        total_s += seconds
    if math.isclose(total_s, 0.0):
        return None
    shift = np.arange(6, RATES)
    known[shift, shift] += LEAST_TURNING_RAD_S**2 * total_s
    return np.asarray(np.linalg.solve(known, pull))


def rate_rows_of_drives(
    trajectories: Sequence[VehicleTrajectory], T_map_vehicle: Mapping[tuple[int, int], gtsam.Pose3]
) -> dict[int, Array]:
    """`rate_rows` of each drive that has them, of its poses by (drive, stamp), ascending.

    None where an odometry of a LiDAR gave the poses: its rates have no error apart from the scans.
    """
    out = {}
    for drive in sorted({drive for drive, _ in T_map_vehicle}):
        trajectory = trajectories[drive]
        if isinstance(trajectory, GivenTrajectory) and trajectory.odometry is not None:
            continue
        own = {stamp: T for (d, stamp), T in T_map_vehicle.items() if d == drive}
        rows = rate_rows(list(own), list(own.values()))
        if rows is not None:
            out[drive] = rows
    return out


def with_rates(information: Array, gradient: Array, rows: Array) -> tuple[Array, Array]:
    """A Gaussian on poses and what follows them, with the errors of the mean rates at its end.

    Args:
        information: (n, n), right perturbations of m poses first.
        gradient: (n,).
        rows: (RATES, 6 m) of `rate_rows`.

    Returns:
        (n + RATES, n + RATES) and (n + RATES,); with the rates eliminated, what was given.
    """
    n, m = len(gradient), rows.shape[1]
    tie = np.zeros((RATES, n + RATES))
    tie[:, :m], tie[:, n:] = -rows, np.eye(RATES)
    tie /= RATE_SIGMAS[:, None]
    out = tie.T @ tie
    out[:n, :n] += information
    return out, np.concatenate([gradient, np.zeros(RATES)])


def turn_variances(trajectory: SmoothedTrajectory) -> tuple[Array, Array]:
    """How the angular velocity errs within a sweep, along the vehicle's axes.

    (3,) rad^2/s, variance per second of an angle that walks at random, and (3,) rad^2/s^2, variance
    of a constant error: without an IMU nothing measures how fast the body rolls and pitches.
    """
    R = trajectory.T_vehicle_imu.rotation().matrix()
    noise = trajectory.data.noise
    steady = np.zeros(3)
    if trajectory.data.wheels is not None:
        steady[:2] = noise.gyro_bias[:2] ** 2
    white, constant = (R @ of @ R.T for of in (noise.gyro_density, np.diag(steady)))
    return np.asarray(np.diag(white)), np.asarray(np.diag(constant))
