"""The joint covariance in the orders of GTSAM and of ROS."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from caliv_graph.export.request import Request
from caliv_graph.products import Array

ROS_AXES = ("x", "y", "z", "rot_x", "rot_y", "rot_z")
"""Order of `geometry_msgs/PoseWithCovariance`."""

GTSAM_AXES = ("rot_x", "rot_y", "rot_z", "x", "y", "z")
"""Order of GTSAM's Pose3."""

GTSAM_SIDE = (
    "right: T_vehicle_lidar Exp(d) (Pose3.retract); rotation and translation along the axes of the "
    "LiDAR; rad, m"
)
ROS_SIDE = (
    "left: t + dt and Exp(w) R; translation along, rotation about the fixed axes of the vehicle, "
    "at the LiDAR's origin; m, rad"
)


def ros_jacobian(T_parent_child: gtsam.Pose3) -> Array:
    """(6, 6) from a right perturbation in GTSAM's order to ROS's, B = [[0, R], [R, 0]].

    `T Exp([w, v])` moves the position by R v + O(d^2), and its rotation `R Exp(w)` is
    `Exp(R w) R`: ROS wants position, then rotation about fixed axes, both in the parent's axes
    (geometry_msgs/PoseWithCovariance).
    """
    R = T_parent_child.rotation().matrix()
    out = np.zeros((6, 6))
    out[:3, 3:] = R
    out[3:, :3] = R
    return out


def ros_covariance(T_parent_child: Sequence[gtsam.Pose3], cov: Array) -> Array:
    """A joint covariance (6n, 6n) of n poses in one parent, in ROS's order, parent's axes; m, rad.

    `cov` has right perturbations, rotation then translation. The result has per pose x, y, z and
    rotations about fixed x, y, z.
    """
    B = np.zeros(cov.shape)
    for i, T in enumerate(T_parent_child):
        B[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = ros_jacobian(T)
    out = B @ cov @ B.T
    return np.asarray((out + out.T) / 2.0)


def joint_covariance(request: Request) -> Array:
    """(6n, 6n) of the exported LiDARs, marginalised over the others; GTSAM's order."""
    names = list(request.calibration.lidars)
    rows = [6 * names.index(name) + axis for name in request.lidars for axis in range(6)]
    return np.asarray(request.calibration.cov_joint[np.ix_(rows, rows)])


def covariances(request: Request) -> dict[str, tuple[list[str], str, Array]]:
    """Per convention, `gtsam` and `ros`, names of the rows, side, and the joint covariance."""
    cov = joint_covariance(request)
    poses = [request.T_vehicle_lidar(name) for name in request.lidars]
    return {
        "gtsam": (_rows(request, GTSAM_AXES), GTSAM_SIDE, cov),
        "ros": (_rows(request, ROS_AXES), ROS_SIDE, ros_covariance(poses, cov)),
    }


def _rows(request: Request, axes: Sequence[str]) -> list[str]:
    return [f"{name}.{axis}" for name in request.lidars for axis in axes]
