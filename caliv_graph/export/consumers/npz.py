"""NumPy: poses and joint covariance as arrays."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from caliv_graph.conventions import AXES
from caliv_graph.export.covariance import (
    GTSAM_AXES,
    GTSAM_SIDE,
    ROS_AXES,
    ROS_SIDE,
    axes_order,
    joint_covariance,
    ros_covariance,
)
from caliv_graph.export.request import Consumer, Export, Request
from caliv_graph.export.text import notice


def export(request: Request) -> Export:
    """Arrays; texts are arrays of strings, so that loading needs no pickle."""
    transforms = request.vehicle_transforms()
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
        "order_gtsam": np.array(axes_order(request.lidars, GTSAM_AXES)),
        "side_gtsam": np.array(GTSAM_SIDE),
        "covariance_ros": ros_covariance(poses, cov),
        "order_ros": np.array(axes_order(request.lidars, ROS_AXES)),
        "side_ros": np.array(ROS_SIDE),
    }
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return Export(buffer.getvalue(), transforms)


CONSUMER = Consumer(export)
