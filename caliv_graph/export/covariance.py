"""The joint covariance as npz and JSON, in GTSAM's and in ROS's order."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np

from caliv_graph.conventions import AXES
from caliv_graph.export.request import DEFAULT_VEHICLE_FRAME, Export, Request, Transform
from caliv_graph.export.wording import notice, quaternion_xyzw, undetermined_axes
from caliv_graph.products import Array

ROS_AXES = ("x", "y", "z", "rot_x", "rot_y", "rot_z")
"""Order of `geometry_msgs/PoseWithCovariance`."""

GTSAM_AXES = ("rot_x", "rot_y", "rot_z", "x", "y", "z")
"""Order of GTSAM's Pose3."""

_GTSAM_SIDE = (
    "right: T_vehicle_lidar Exp(d) (Pose3.retract); rotation and translation along the axes of the "
    "LiDAR; rad, m"
)
_ROS_SIDE = (
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
    """A joint covariance of poses in ROS's order.

    Args:
        T_parent_child: n poses in one parent.
        cov: (6n, 6n) right perturbations, rotation then translation, rad and m.

    Returns:
        (6n, 6n) per pose x, y, z, rotation about fixed x, y, z; the parent's axes; m and rad.
    """
    B = np.zeros(cov.shape)
    for i, T in enumerate(T_parent_child):
        B[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = ros_jacobian(T)
    out = B @ cov @ B.T
    return np.asarray((out + out.T) / 2.0)


def joint_covariance(request: Request) -> Array:
    """(6n, 6n) of the LiDARs asked for, the others integrated out; GTSAM's order."""
    return _rows(request, request.calibration.cov_joint)


def export_npz(request: Request) -> Export:
    """Arrays for NumPy; texts are arrays of strings, so that nothing needs pickle."""
    transforms = _transforms(request)
    poses = [request.T_vehicle_lidar(name) for name in request.lidars]
    cov = joint_covariance(request)
    arrays: dict[str, Any] = {
        "comment": np.array(notice(request, transforms)),
        "status": np.array(request.calibration.status),
        "lidars": np.array(request.lidars),
        "T_vehicle_lidar": np.array([pose.matrix() for pose in poses]),
        "determined": np.array(
            [
                [request.calibration.lidars[name].determined[axis] for axis in AXES]
                for name in request.lidars
            ]
        ),
        "determined_axes": np.array(AXES),
        "covariance_gtsam": cov,
        "order_gtsam": np.array(_order(request.lidars, GTSAM_AXES)),
        "side_gtsam": np.array(_GTSAM_SIDE),
        "covariance_ros": ros_covariance(poses, cov),
        "order_ros": np.array(_order(request.lidars, ROS_AXES)),
        "side_ros": np.array(_ROS_SIDE),
    }
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return Export(buffer.getvalue(), transforms)


def export_json(request: Request) -> Export:
    """The same as one JSON document."""
    transforms = _transforms(request)
    cov = joint_covariance(request)
    poses = [request.T_vehicle_lidar(name) for name in request.lidars]
    document = {
        "comment": notice(request, transforms).splitlines(),
        "status": request.calibration.status,
        "lidars": {
            name: {
                "T_vehicle_lidar": {
                    "matrix": pose.matrix().tolist(),
                    "translation": pose.translation().tolist(),
                    "quaternion_xyzw": list(quaternion_xyzw(pose)),
                },
                "determined": {
                    axis: bool(request.calibration.lidars[name].determined[axis]) for axis in AXES
                },
                "undetermined": undetermined_axes(request.calibration.lidars[name]),
            }
            for name, pose in zip(request.lidars, poses, strict=True)
        },
        "covariance_gtsam": {
            "order": _order(request.lidars, GTSAM_AXES),
            "side": _GTSAM_SIDE,
            "matrix": cov.tolist(),
        },
        "covariance_ros": {
            "order": _order(request.lidars, ROS_AXES),
            "side": _ROS_SIDE,
            "matrix": ros_covariance(poses, cov).tolist(),
        },
    }
    return Export((json.dumps(document, indent=1, allow_nan=False) + "\n").encode(), transforms)


def _transforms(request: Request) -> tuple[Transform, ...]:
    parent = request.vehicle_frame or DEFAULT_VEHICLE_FRAME
    return tuple(
        Transform(name, parent, name, request.T_vehicle_lidar(name)) for name in request.lidars
    )


def _rows(request: Request, matrix: Array) -> Array:
    names = list(request.calibration.lidars)
    rows = [6 * names.index(name) + axis for name in request.lidars for axis in range(6)]
    return np.asarray(matrix[np.ix_(rows, rows)])


def _order(lidars: Sequence[str], axes: Sequence[str]) -> list[str]:
    return [f"{name}.{axis}" for name in lidars for axis in axes]
