"""ROS parameter files with a LiDAR's pose as lists of three and nine numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from caliv_graph.errors import ExportError
from caliv_graph.export.edit import YamlFile, with_comment
from caliv_graph.export.request import Base, Export, Request, Transform
from caliv_graph.export.text import notice, numbers, with_hash

_ROS2 = "ros__parameters"
"""Key of every parameter file of ROS 2."""


@dataclass(frozen=True)
class Parameters:
    """The parameters of a consumer in one version of ROS.

    Attributes:
        above: keys above the parameters in a new file.
        values: per parameter its numbers.
        extra: further lines of the comment.
    """

    above: tuple[str, ...]
    values: Mapping[str, Sequence[float]]
    extra: tuple[str, ...] = ()


def parameter_export(
    request: Request,
    consumer: str,
    transform: Transform,
    ros1: Parameters,
    ros2: Parameters,
    warnings: tuple[str, ...],
    optional: tuple[str, ...] = (),
) -> Export:
    """A new parameter file, or `--base` with new values of the parameters.

    The transform's remark states its direction as an equation of the parameters; `optional` are
    parameters that `--base` need not have.

    Raises:
        ExportError: `--base` lacks the parameters.
    """
    assert request.imu is not None
    remark = f"{transform.remark} T_vehicle_imu is from {request.imu.origin}."
    transform = replace(transform, remark=remark)
    parameters = ros1 if _is_ros1(request) else ros2
    comment = with_hash(notice(request, [transform], parameters.extra))
    if request.base is None:
        text = _new(parameters)
    else:
        text = _changed(request.base, consumer, parameters.values, optional)
    return Export(with_comment(comment, text).encode(), (transform,), warnings)


def _is_ros1(request: Request) -> bool:
    if request.form not in ("", "ros1", "ros2"):
        raise ExportError(f"--form {request.form}: is neither ros1 nor ros2")
    if request.form or request.base is None:
        return request.form == "ros1"
    return _ROS2 not in request.base.text


def _new(parameters: Parameters) -> str:
    lines = [f"{'  ' * depth}{key}:" for depth, key in enumerate(parameters.above)]
    indent = "  " * len(parameters.above)
    for key, items in parameters.values.items():
        start = f"{indent}{key}: ["
        rows = [numbers(items[i : i + 3], ", ") for i in range(0, len(items), 3)]
        lines.append(start + f",\n{' ' * len(start)}".join(rows) + "]")
    return "\n".join(lines) + "\n"


def _changed(
    base: Base, consumer: str, values: Mapping[str, Sequence[float]], optional: tuple[str, ...]
) -> str:
    file = YamlFile(base)
    for key, items in values.items():
        entry = file.entry(key)
        if entry is not None:
            file.set_numbers(entry, items)
        elif key not in optional:
            raise ExportError(
                f"{base.path}: has no '{key}'. Give the parameters of {consumer} as --base"
            )
    return file.edited()
