"""NumPy: poses and joint covariance as arrays."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from caliv_graph.conventions import AXES
from caliv_graph.export.covariance import covariances
from caliv_graph.export.request import Consumer, Export, Request
from caliv_graph.export.text import notice


def export(request: Request) -> Export:
    """Arrays; texts are arrays of strings, so that loading needs no pickle."""
    transforms = request.vehicle_transforms()
    poses = [request.T_vehicle_lidar(name) for name in request.lidars]
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
    }
    for name, (order, side, cov) in covariances(request).items():
        arrays[f"covariance_{name}"] = cov
        arrays[f"order_{name}"] = np.array(order)
        arrays[f"side_{name}"] = np.array(side)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return Export(buffer.getvalue(), transforms)


CONSUMER = Consumer(export)
