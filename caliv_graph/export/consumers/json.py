"""JSON: poses and joint covariance as one document."""

from __future__ import annotations

import json

from caliv_graph.conventions import AXES
from caliv_graph.export.covariance import covariances
from caliv_graph.export.request import Consumer, Export, Request
from caliv_graph.export.text import notice, quaternion_xyzw, undetermined_axes


def export(request: Request) -> Export:
    """Poses, determined axes and covariances as one JSON document."""
    transforms = request.vehicle_transforms()
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
        **{
            f"covariance_{name}": {"order": order, "side": side, "matrix": cov.tolist()}
            for name, (order, side, cov) in covariances(request).items()
        },
    }
    return Export((json.dumps(document, indent=1, allow_nan=False) + "\n").encode(), transforms)


CONSUMER = Consumer(export)
