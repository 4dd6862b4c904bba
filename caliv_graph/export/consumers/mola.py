"""MOLA: `fixed_sensor_pose` of a sensor, "x y z yaw pitch roll", metres and degrees.

The pose of the sensor in the vehicle's frame (MOLAorg/mola, Rosbag2Dataset and BridgeROS2; yaw,
pitch, roll as in MRPT's CPose3D: R = Rz(yaw) Ry(pitch) Rx(roll)).
"""

from __future__ import annotations

import json
import math

import gtsam
import yaml

from caliv_graph.errors import ExportError
from caliv_graph.export.edit import YamlFile, with_comment
from caliv_graph.export.request import Base, Consumer, Export, Request, Transform
from caliv_graph.export.text import notice, numbers, rpy, with_hash

_KEY = "fixed_sensor_pose"


def export(request: Request) -> Export:
    """The `sensors` of a MOLA data source, or `--base` with new poses of its sensors.

    Raises:
        ExportError: the topic of a LiDAR is unknown or not in `--base`.
    """
    transforms = request.vehicle_transforms(f"{_KEY}: x y z in metres, yaw pitch roll in degrees.")
    unknown = [name for name in request.lidars if name not in request.topics]
    if unknown:
        raise ExportError(
            f"mola: needs the topic of LiDAR '{unknown[0]}', and there is no config.yaml beside "
            f"{request.source}. Give --config CONFIG.yaml"
        )
    comment = with_hash(notice(request, transforms))
    if request.base is None:
        text = _new(request, transforms)
    else:
        text = _changed(request.base, request, transforms)
    return Export(with_comment(comment, text).encode(), transforms)


def _pose(T: gtsam.Pose3) -> str:
    roll, pitch, yaw = rpy(T)
    return numbers([*T.translation(), *(math.degrees(angle) for angle in (yaw, pitch, roll))])


def _new(request: Request, transforms: tuple[Transform, ...]) -> str:
    lines = ["sensors:"]
    for transform in transforms:
        lines += [
            # A JSON string is a valid YAML string.
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
        # A topic may be the default of an environment variable: ${TOPIC|'/points'}.
        found = [pose for text, pose in sensors if topic in (text, _default(text))]
        if len(found) != 1:
            listed = ", ".join(text for text, _ in sensors) or "none"
            raise ExportError(
                f"{base.path}: {len(found)} sensors with {_KEY} have topic {topic} of LiDAR "
                f"'{transform.lidar}', expected one; topics: {listed}. Correct --base, or leave "
                "the LiDAR out by --lidar"
            )
        file.set_text(found[0], _pose(transform.T_parent_child))
    return file.edited()


def _default(text: str) -> str:
    inner = text.strip().removeprefix("${").removesuffix("}")
    return inner.partition("|")[2].strip("'\"") if text.strip().startswith("${") else text


CONSUMER = Consumer(export, frozenset(("--base", "--frame", "--vehicle-frame")), needs_topics=True)
