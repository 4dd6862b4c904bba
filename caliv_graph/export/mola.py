"""MOLA: `fixed_sensor_pose` of a sensor, "x y z yaw pitch roll", metres and degrees.

The pose of the sensor in the vehicle's frame (MOLAorg/mola, Rosbag2Dataset and BridgeROS2; yaw,
pitch, roll as in MRPT's CPose3D: R = Rz(yaw) Ry(pitch) Rx(roll)).
"""

from __future__ import annotations

import json
import math
from dataclasses import replace

import gtsam
import yaml

from caliv_graph.errors import ExportError
from caliv_graph.export.edit import YamlFile, with_comment
from caliv_graph.export.request import DEFAULT_VEHICLE_FRAME, Base, Export, Request, Transform
from caliv_graph.export.wording import notice, numbers, rpy, with_hash, without_notice

_KEY = "fixed_sensor_pose"


def export(request: Request) -> Export:
    """The `sensors` of a MOLA data source, or `--base` with the poses of its sensors changed.

    Raises:
        ExportError: no topic is known to tell the sensors by, or `--base` has none of them.
    """
    parent = request.vehicle_frame or DEFAULT_VEHICLE_FRAME
    transforms = tuple(
        Transform(
            name,
            parent,
            request.frame(name) or name,
            request.T_vehicle_lidar(name),
            f"{_KEY}: x y z in metres, yaw pitch roll in degrees.",
        )
        for name in request.lidars
    )
    unknown = [name for name in request.lidars if name not in request.topics]
    if unknown:
        raise ExportError(
            f"mola: tells sensors by their topics, and that of LiDAR '{unknown[0]}' is not known: "
            f"there is no config.yaml beside {request.source}. Give --config CONFIG.yaml"
        )
    comment = with_hash(notice(request, transforms))
    if request.base is None:
        text = _new(request, transforms)
    else:
        base = replace(request.base, text=without_notice(request.base.text))
        text = _changed(base, request, transforms)
    return Export(with_comment(comment, text).encode(), transforms)


def _pose(T: gtsam.Pose3) -> str:
    roll, pitch, yaw = rpy(T)
    return numbers([*T.translation(), *(math.degrees(angle) for angle in (yaw, pitch, roll))])


def _new(request: Request, transforms: tuple[Transform, ...]) -> str:
    lines = ["sensors:"]
    for transform in transforms:
        lines += [
            # What JSON quotes is quoted for YAML too.
            f"  - topic: {json.dumps(request.topics[transform.lidar])}",
            "    type: CObservationPointCloud",
            f'    {_KEY}: "{_pose(transform.T_parent_child)}"',
        ]
    return "\n".join(lines) + "\n"


def _changed(base: Base, request: Request, transforms: tuple[Transform, ...]) -> str:
    file = YamlFile(base)
    sensors = []
    for entry in file.entries:
        if entry.path[-1] != "topic" or not isinstance(entry.value, yaml.ScalarNode):
            continue
        beside = [e for e in file.entries if e.path[:-1] == entry.path[:-1] and e.path[-1] == _KEY]
        sensors += [(entry.value.value, pose.value) for pose in beside]
    for transform in transforms:
        topic = request.topics[transform.lidar]
        # A topic may be the default of a variable of the environment: ${TOPIC|'/points'}.
        found = [pose for text, pose in sensors if topic in (text, _default(text))]
        if len(found) != 1:
            listed = ", ".join(text for text, _ in sensors) or "none"
            raise ExportError(
                f"{base.path}: {len(found)} sensors with {_KEY} have topic {topic} of LiDAR "
                f"'{transform.lidar}', expected one; topics: {listed}. Mend --base, or give "
                "--lidar to leave the LiDAR out"
            )
        file.set_text(found[0], _pose(transform.T_parent_child))
    return file.edited()


def _default(text: str) -> str:
    inner = text.strip().removeprefix("${").removesuffix("}")
    return inner.partition("|")[2].strip("'\"") if text.strip().startswith("${") else text
