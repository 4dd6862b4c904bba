"""Joint covariances of the extrinsics and of the vehicle's poses, for the expected alignment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from caliv_graph.calibration.noise import first_pose_noise
from caliv_graph.config.model import Config
from caliv_graph.geometry.se3 import joint_right_to_vehicle_axes
from caliv_graph.products import Array, Calibration, IntArray, PoseNoise
from caliv_graph.trajectory.measurements import nearest_node
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory


def extrinsic_covariance(names: Sequence[str], calibration: Calibration) -> Array:
    """(6 L, 6 L) joint covariance of the extrinsics, vehicle axes, in the order of `names`."""
    order = list(calibration.lidars)
    rows = [6 * order.index(name) + axis for name in names for axis in range(6)]
    poses = [calibration.lidars[name].T_vehicle_lidar for name in names]
    axes = joint_right_to_vehicle_axes(poses)
    return np.asarray(axes @ calibration.cov_joint[np.ix_(rows, rows)] @ axes.T)


def pose_covariance(
    taken_ns: IntArray,
    nodes_ns: IntArray,
    trajectory: VehicleTrajectory,
    calibration: Calibration,
    config: Config,
) -> Array:
    """Joint covariance of the vehicle's poses at the scans.

    Args:
        taken_ns: (S,) times of the scans.
        nodes_ns: nodes of the trajectory, ascending.
        trajectory: the trajectory with these nodes.
        calibration: has the error model of given poses, if they were calibrated with it.
        config: has it otherwise.

    Returns:
        (6 S, 6 S) right perturbations.
    """
    at = nearest_node(nodes_ns, taken_ns)
    if isinstance(trajectory, SmoothedTrajectory):
        information, _ = trajectory.joint_information(nodes_ns)
        cov = np.asarray(np.linalg.inv(information), dtype=np.float64)
    else:
        cov = given_pose_covariance(nodes_ns, pose_noise(calibration, config))
    rows = (6 * at[:, None] + np.arange(6)).ravel()
    return np.asarray(0.5 * (cov + cov.T)[np.ix_(rows, rows)], dtype=np.float64)


def pose_noise(calibration: Calibration, config: Config) -> PoseNoise:
    """Error model of given poses: estimated by `calibrate`, or else from the config."""
    found = calibration.provenance.get("pose_noise")
    if isinstance(found, Mapping):
        try:
            return PoseNoise(**{str(key): float(value) for key, value in found.items()})
        except (TypeError, ValueError):
            pass  # the file of another program
    return first_pose_noise(config.noise)


def given_pose_covariance(stamps_ns: IntArray, noise: PoseNoise) -> Array:
    """Joint covariance of given poses at stamps (n,): white and Gauss-Markov errors.

    Returns:
        (6 n, 6 n), rotation then translation. It is the same in map and vehicle axes, because the
        three axes have equal sigmas.
    """
    apart_s = 1e-9 * np.abs(stamps_ns[:, None] - stamps_ns[None, :])
    correlation = np.exp(-apart_s / noise.drift_time_s)
    white = np.array([noise.white_rotation_rad] * 3 + [noise.white_position_m] * 3) ** 2
    drift = np.array([noise.drift_rotation_rad] * 3 + [noise.drift_position_m] * 3) ** 2
    eye = np.eye(len(stamps_ns))
    out = np.kron(eye, np.diag(white)) + np.kron(correlation, np.diag(drift))
    return np.asarray(out, dtype=np.float64)
