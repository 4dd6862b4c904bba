"""ROS parameter files that hold a LiDAR's pose as a list of three and one of nine numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam

from caliv_graph.errors import ExportError
from caliv_graph.export.edit import YamlFile, with_comment
from caliv_graph.export.request import Base, Export, Request, Transform
from caliv_graph.export.wording import notice, numbers, with_hash, without_notice

_ROS2 = "ros__parameters"
"""Key that every parameter file of ROS 2 has."""


@dataclass(frozen=True)
class Parameters:
    """What a consumer wants to have in its file.

    Attributes:
        consumer: its name.
        lidar: the LiDAR it is made from.
        parent: frame of the transform.
        child: frame of the transform.
        T_parent_child: the transform.
        meaning: which way it goes, in the words of the parameters.
        ros1: per parameter its numbers, in the version for ROS 1.
        ros2: likewise for ROS 2.
        above_ros1: keys above the parameters in a new file for ROS 1.
        above_ros2: likewise for ROS 2.
        optional: parameters that a `--base` need not have.
        extra_ros1: what else the comment is to say for ROS 1.
        extra_ros2: likewise for ROS 2.
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
    """A new parameter file, or `--base` with the parameters changed.

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
        base = replace(request.base, text=without_notice(request.base.text))
        text = _changed(base, parameters, values)
    return Export(with_comment(comment, text).encode(), (transform,), warnings)


def _is_ros1(request: Request) -> bool:
    if request.form not in ("", "ros1", "ros2"):
        raise ExportError(f"--form {request.form}: is none of ros1, ros2")
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
