"""ROS parameter files with a LiDAR's pose as lists of three and nine numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam

from caliv_graph.errors import ExportError
from caliv_graph.export.edit import YamlFile, with_comment
from caliv_graph.export.request import Base, Export, Request, Transform
from caliv_graph.export.text import notice, numbers, with_hash

_ROS2 = "ros__parameters"
"""Key of every parameter file of ROS 2."""


@dataclass(frozen=True)
class Parameters:
    """The parameters of a consumer.

    Attributes:
        consumer: name of the consumer.
        lidar: name of the LiDAR.
        parent: parent frame of the transform.
        child: child frame of the transform.
        T_parent_child: the transform.
        meaning: direction of the transform, as an equation of the parameters.
        ros1: per parameter its numbers, for ROS 1.
        ros2: per parameter its numbers, for ROS 2.
        above_ros1: keys above the parameters in a new file for ROS 1.
        above_ros2: keys above the parameters in a new file for ROS 2.
        optional: parameters that `--base` need not have.
        extra_ros1: further lines of the comment for ROS 1.
        extra_ros2: further lines of the comment for ROS 2.
    """

    consumer: str
    lidar: str
    parent: str
    child: str
    T_parent_child: gtsam.Pose3
    meaning: str
    ros1: Mapping[str, Sequence[float]]
    ros2: Mapping[str, Sequence[float]]
    above_ros1: tuple[str, ...]
    above_ros2: tuple[str, ...]
    optional: tuple[str, ...] = ()
    extra_ros1: tuple[str, ...] = ()
    extra_ros2: tuple[str, ...] = ()


def parameter_export(request: Request, parameters: Parameters, warnings: tuple[str, ...]) -> Export:
    """A new parameter file, or `--base` with new values of the parameters.

    Raises:
        ExportError: `--base` lacks the parameters.
    """
    assert request.imu is not None
    remark = f"{parameters.meaning} T_vehicle_imu is from {request.imu.origin}."
    transform = Transform(
        parameters.lidar,
        parameters.parent,
        parameters.child,
        parameters.T_parent_child,
        remark,
    )
    is_ros1 = _is_ros1(request)
    values = parameters.ros1 if is_ros1 else parameters.ros2
    extra = parameters.extra_ros1 if is_ros1 else parameters.extra_ros2
    comment = with_hash(notice(request, [transform], extra))
    if request.base is None:
        text = _new(parameters.above_ros1 if is_ros1 else parameters.above_ros2, values)
    else:
        text = _changed(request.base, parameters, values)
    return Export(with_comment(comment, text).encode(), (transform,), warnings)


def _is_ros1(request: Request) -> bool:
    if request.form not in ("", "ros1", "ros2"):
        raise ExportError(f"--form {request.form}: is neither ros1 nor ros2")
    if request.form or request.base is None:
        return request.form == "ros1"
    return _ROS2 not in request.base.text


def _new(above: tuple[str, ...], values: Mapping[str, Sequence[float]]) -> str:
    lines = [f"{'  ' * depth}{key}:" for depth, key in enumerate(above)]
    indent = "  " * len(above)
    for key, items in values.items():
        start = f"{indent}{key}: ["
        rows = [numbers(items[i : i + 3], ", ") for i in range(0, len(items), 3)]
        lines.append(start + f",\n{' ' * len(start)}".join(rows) + "]")
    return "\n".join(lines) + "\n"


def _changed(base: Base, parameters: Parameters, values: Mapping[str, Sequence[float]]) -> str:
    file = YamlFile(base)
    for key, items in values.items():
        entry = file.entry(key)
        if entry is not None:
            file.set_numbers(entry, items)
        elif key not in parameters.optional:
            raise ExportError(
                f"{base.path}: has no '{key}'. Give the parameters of {parameters.consumer} as "
                "--base"
            )
    return file.edited()
