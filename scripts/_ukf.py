"""An unscented Kalman filter with the paper's inputs: the baseline of benchmark_trajectory.py.

The IMU is the control input; GNSS, velocity and orientation are measurements. The state is
orientation, position and velocity of the IMU in the map and both biases, on the manifold: sigma
points are perturbations of the mean (right perturbations of the rotation). It knows the true
noise, starts from the first measurement of each kind, and has the smoother's prior on the biases.
It sees the past only; that is what the comparison is about.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

from caliv_graph.config.model import Config
from caliv_graph.geometry.se3 import skew
from caliv_graph.products import Array, IntArray, MotionData
from caliv_graph.trajectory.gnss import normal_gravity, positions_in_map
from caliv_graph.trajectory.imu import interpolate
from caliv_graph.trajectory.noise import (
    imu_noise,
    orientation_covariances,
    velocity_covariances,
)

STATE = 15
"""Rotation, position, velocity, gyro bias, accelerometer bias."""

Measure = Callable[[Array, Array, Array, Array], Array]


def exp(v: Array) -> Array:
    """(m, 3, 3) rotations of (m, 3) rotation vectors; Rodrigues."""
    angle = np.sqrt(np.einsum("ni,ni->n", v, v))[:, None, None]
    small = angle < 1e-8
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0, np.sin(safe) / safe)
    b = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    K = skew(v)
    return np.asarray(np.eye(3) + a * K + b * (K @ K))


def log(R: Array) -> Array:
    """(m, 3) rotation vectors of (m, 3, 3) rotations by less than a right angle."""
    v = 0.5 * np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1
    )
    sine = np.sqrt(np.einsum("ni,ni->n", v, v))
    scale = np.where(sine < 1e-8, 1.0, np.arcsin(np.minimum(sine, 1.0)) / np.maximum(sine, 1e-12))
    return np.asarray(v * scale[:, None])


@dataclass
class Filter:
    """The mean and covariance, and what time and measurements do to them.

    Attributes:
        R: (3, 3) R_map_imu.
        rest: (12,) position, velocity, gyro bias, accelerometer bias.
        cov: (15, 15).
        gravity: (3,) in the map.
        process: (15,) variances per second.
    """

    R: Array
    rest: Array
    cov: Array
    gravity: Array
    process: Array

    def _sigma_points(self) -> Array:
        """(30, 15) perturbations of equal weight: the cubature rule, kappa = 0."""
        root = np.linalg.cholesky(self.cov) * np.sqrt(STATE)
        return np.concatenate([root.T, -root.T])

    def predict(self, gyro: Array, force: Array, dt: float) -> None:
        """Integrates the IMU's readings at the middle of a step."""
        points = np.concatenate([np.zeros((1, STATE)), self._sigma_points()])
        R = self.R @ exp(points[:, :3])
        rest = self.rest + points[:, 3:]
        turn = (gyro - rest[:, 6:9]) * dt
        half = R @ exp(0.5 * turn)
        acceleration = np.einsum("nij,nj->ni", half, force - rest[:, 9:12]) + self.gravity
        rest[:, :3] += rest[:, 3:6] * dt + 0.5 * acceleration * dt**2
        rest[:, 3:6] += acceleration * dt
        R = R @ exp(turn)
        errors = np.concatenate([log(R[0].T @ R[1:]), rest[1:] - rest[0]], axis=1)
        mean = errors.mean(axis=0)
        self.R = R[0] @ exp(mean[None, :3])[0]
        self.rest = rest[0] + mean[3:]
        errors -= mean
        self.cov = errors.T @ errors / len(errors) + np.diag(self.process * dt)

    def update(self, residual_of: Measure, noise: Array) -> None:
        """Takes in a measurement.

        Args:
            residual_of: (m, d) of measurement minus prediction for m states, given as R (m, 3, 3),
                position, velocity and gyro bias (m, 3).
            noise: (d, d).
        """
        points = self._sigma_points()
        R = self.R @ exp(points[:, :3])
        rest = self.rest + points[:, 3:]
        residuals = residual_of(R, rest[:, :3], rest[:, 3:6], rest[:, 6:9])
        mean = residuals.mean(axis=0)
        spread = residuals - mean
        S = spread.T @ spread / len(points) + noise
        cross = -points.T @ spread / len(points)
        gain = np.linalg.solve(S, cross.T).T
        step = gain @ mean
        self.R = self.R @ exp(step[None, :3])[0]
        self.rest = self.rest + step[3:]
        cov = self.cov - gain @ S @ gain.T
        self.cov = 0.5 * (cov + cov.T)


def filter_trajectory(
    motion: MotionData, config: Config, stamps_ns: IntArray
) -> tuple[Array, Array, Array]:
    """Filters a drive.

    Args:
        motion: with IMU, orientations, GNSS and velocities.
        config: extrinsics, noise.
        stamps_ns: (m,) increasing, at which poses are wanted.

    Returns:
        R_map_vehicle (m, 3, 3) and t_map_vehicle (m, 3), by what came until then, and their
        covariance (m, 6, 6), right perturbations, rotation then translation.
    """
    imu, gnss, twist = motion.imu, motion.gnss, motion.twist
    if imu is None or gnss is None or twist is None or imu.orientation_xyzw is None:
        raise ValueError("the filter needs IMU, orientation, GNSS and velocity")
    noise = imu_noise(imu, config)
    positions, _ = positions_in_map(gnss, config, motion.name)
    orientation_cov, _ = orientation_covariances(imu, config)
    velocity_cov, _ = velocity_covariances(twist, config)
    g = config.imu.gravity_m_s2 or normal_gravity(
        positions.origin_deg_m[0], positions.origin_deg_m[2]
    )
    T_vehicle_imu = config.imu.T_vehicle_imu.pose()
    T_imu_vehicle = T_vehicle_imu.inverse()
    R_iv, t_iv = T_imu_vehicle.rotation().matrix(), T_imu_vehicle.translation()
    antenna = T_vehicle_imu.transformTo(np.array(config.gnss.lever_arm))
    Z = np.array(
        [gtsam.Rot3.Quaternion(w, x, y, z).matrix() for x, y, z, w in imu.orientation_xyzw]
    )
    process = np.concatenate(
        [
            np.diagonal(noise.gyro_density),
            np.full(3, 1e-10),
            np.diagonal(noise.force_density),
            noise.gyro_walk**2,
            noise.force_walk**2,
        ]
    )
    start_velocity = twist.velocity[0] @ R_iv.T - np.cross(imu.angular_velocity[0], t_iv)
    state = Filter(
        R=Z[0],
        rest=np.concatenate(
            [positions.position_map[0] - Z[0] @ antenna, Z[0] @ start_velocity, np.zeros(6)]
        ),
        cov=np.zeros((STATE, STATE)),
        gravity=np.array([0.0, 0.0, -g]),
        process=process,
    )
    state.cov[:3, :3] = orientation_cov[0]
    state.cov[3:6, 3:6] = positions.cov_map[0]
    state.cov[6:9, 6:9] = Z[0] @ R_iv @ velocity_cov[0] @ R_iv.T @ Z[0].T
    state.cov[9:15, 9:15] = np.diag(np.concatenate([noise.gyro_bias, noise.force_bias]) ** 2)

    begin = max(int(imu.stamps_ns[0]), int(positions.stamps_ns[0]), int(twist.stamps_ns[0]))
    events = np.unique(
        np.concatenate([imu.stamps_ns, positions.stamps_ns, twist.stamps_ns, stamps_ns])
    )
    events = events[(events >= begin) & (events <= imu.stamps_ns[-1])]
    gyro = interpolate(events, imu.stamps_ns, imu.angular_velocity)
    force = interpolate(events, imu.stamps_ns, imu.specific_force)
    orientation_at = {s: k for k, s in enumerate(imu.stamps_ns.tolist())}
    fix_at = {s: k for k, s in enumerate(positions.stamps_ns.tolist())}
    twist_at = {s: k for k, s in enumerate(twist.stamps_ns.tolist())}
    wanted = set(stamps_ns.tolist())
    Ad = T_vehicle_imu.AdjointMap()
    R_out, t_out, cov_out = [], [], []
    for e, stamp in enumerate(events.tolist()):
        if e:
            dt = (stamp - int(events[e - 1])) * 1e-9
            state.predict(0.5 * (gyro[e] + gyro[e - 1]), 0.5 * (force[e] + force[e - 1]), dt)
            k = orientation_at.get(stamp)
            if k is not None:
                state.update(_orientation(Z[k]), orientation_cov[k])
            k = fix_at.get(stamp)
            if k is not None:
                state.update(_position(positions.position_map[k], antenna), positions.cov_map[k])
            k = twist_at.get(stamp)
            if k is not None:
                at_imu = twist.velocity[k] @ R_iv.T
                state.update(_velocity(at_imu, gyro[e], t_iv), R_iv @ velocity_cov[k] @ R_iv.T)
        if stamp in wanted:
            R_out.append(state.R @ R_iv)
            t_out.append(state.rest[:3] + state.R @ t_iv)
            to_right = np.eye(6)
            to_right[3:, 3:] = state.R.T
            to_right = Ad @ to_right
            cov_out.append(to_right @ state.cov[:6, :6] @ to_right.T)
    return np.array(R_out), np.array(t_out), np.array(cov_out)


def _orientation(Z: Array) -> Measure:
    def residual_of(R: Array, p: Array, v: Array, b: Array) -> Array:
        return log(np.swapaxes(R, 1, 2) @ Z)

    return residual_of


def _position(z: Array, antenna: Array) -> Measure:
    def residual_of(R: Array, p: Array, v: Array, b: Array) -> Array:
        return np.asarray(z - p - R @ antenna)

    return residual_of


def _velocity(z: Array, gyro: Array, origin: Array) -> Measure:
    def residual_of(R: Array, p: Array, v: Array, b: Array) -> Array:
        return np.asarray(z - np.einsum("nji,nj->ni", R, v) - np.cross(gyro - b, origin))

    return residual_of
