"""Autoware: `sensors_calibration.yaml` and `sensor_kit_calibration.yaml`.

A file has parent frames, below each its child frames, and below each x, y, z, roll, pitch, yaw in
metres and radians: the pose of the child in the parent, like the `<origin>` of a fixed joint. The
child of a LiDAR is its housing `<sensor>_base_link`. The xacro of the sensor has the pose of the
cloud's frame in the housing. Therefore
`T_parent_housing = T_vehicle_parent^-1 T_vehicle_lidar T_housing_lidar^-1`.
"""

from __future__ import annotations

from collections.abc import Mapping

import gtsam
import numpy as np
import yaml

from caliv_graph.errors import ExportError
from caliv_graph.export.edit import Entry, YamlFile, read_base, with_comment
from caliv_graph.export.frames import match_frame
from caliv_graph.export.request import FRAME_OPTIONS, Base, Consumer, Export, Request, Transform
from caliv_graph.export.text import notice, number, rpy, with_hash
from caliv_graph.readers.frames import VEHICLE_FRAMES, FrameTransform, FrameTree

_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")

_SENSORS = "sensors_calibration.yaml"
"""File beside `sensor_kit_calibration.yaml` with the pose of the sensor kit."""


def export(request: Request) -> Export:
    """A calibration file of Autoware: a new `sensors_calibration.yaml`, or `--base` changed.

    Raises:
        ExportError: `--base` is not such a file or has none of the LiDARs, or the pose of a parent
            frame is unknown.
    """
    if request.base is None:
        return _new(request)
    return _changed(request, request.base)


def _new(request: Request) -> Export:
    transforms = tuple(
        _transform(request, name, request.parent, request.frame(name) or f"{name}_base_link")
        for name in request.lidars
    )
    lines = [f"{_quoted(request.parent)}:"]
    for transform in transforms:
        lines.append(f"  {_quoted(transform.child)}:")
        values = _values(transform.T_parent_child)
        lines += [f"    {key}: {number(value)}" for key, value in values.items()]
    text = with_hash(notice(request, transforms)) + "\n".join(lines) + "\n"
    return Export(text.encode(), transforms, _without_housing(request, request.lidars))


def _changed(request: Request, base: Base) -> Export:
    file = YamlFile(base)
    children = _children(file)
    if not children:
        raise ExportError(
            f"{base.path}: is not a calibration file of Autoware: it has no frame with x, y, z, "
            "roll, pitch, yaw below a parent frame. Give another --base"
        )
    tree = FrameTree([*_tree(file), *_tree_beside(base)])
    transforms: list[Transform] = []
    missing = []
    for name in request.lidars:
        frame = request.frame_among(name, children) or _find(name, list(children))
        if frame not in children:
            if frame is not None:
                raise ExportError(
                    f"{base.path}: has no frame '{frame}'. Give --frame one of "
                    f"{', '.join(children)}"
                )
            missing.append(name)
            continue
        entry = children[frame]
        parent = entry.path[-2]
        T_vehicle_parent = _parent_pose(request, base, tree, parent)
        transform = _transform(request, name, parent, frame, T_vehicle_parent)
        clash = [other.lidar for other in transforms if other.child == frame]
        if clash:
            raise ExportError(
                f"{base.path}: '{frame}' is the frame of LiDARs {clash[0]} and {name}. Give "
                "--frame NAME=FRAME for each"
            )
        transforms.append(transform)
        file.set_scalars(entry, _values(transform.T_parent_child))
    if not transforms:
        raise ExportError(
            f"{base.path}: has none of the LiDARs {', '.join(missing)}, but {', '.join(children)}. "
            "Give --frame NAME=FRAME"
        )
    text = with_comment(with_hash(notice(request, transforms)), file.edited())
    warnings = [
        *(f"{base.path}: has no frame of LiDAR '{name}', which is not written" for name in missing),
        *_without_housing(request, [transform.lidar for transform in transforms]),
    ]
    return Export(text.encode(), tuple(transforms), tuple(warnings))


def _find(lidar: str, frames: list[str]) -> str | None:
    return match_frame(lidar, frames, housing=True) or match_frame(lidar, frames, housing=False)


def _transform(
    request: Request,
    lidar: str,
    parent: str,
    child: str,
    T_vehicle_parent: gtsam.Pose3 | None = None,
) -> Transform:
    T = request.T_vehicle_child(lidar)
    if T_vehicle_parent is not None:
        T = T_vehicle_parent.between(T)
    remark = (
        f"The child is the housing; the LiDAR's frame in it is {_text(request.housings[lidar])}."
        if lidar in request.housings
        else "The LiDAR's frame is assumed to be the frame of its housing."
    )
    return Transform(lidar, parent, child, T, remark)


def _without_housing(request: Request, lidars: list[str] | tuple[str, ...]) -> tuple[str, ...]:
    return tuple(
        f"LiDAR '{name}': Autoware places the housing, and the pose of the cloud's frame in it is "
        f"unknown: assumed the same. Give --housing {name}=x,y,z,roll,pitch,yaw or --bag"
        for name in lidars
        if name not in request.housings
    )


def _values(pose: gtsam.Pose3) -> dict[str, float]:
    values = [*(float(value) for value in pose.translation()), *rpy(pose)]
    return dict(zip(_KEYS, values, strict=True))


def _text(pose: gtsam.Pose3) -> str:
    return ", ".join(f"{key} {number(value)}" for key, value in _values(pose).items())


def _quoted(name: str) -> str:
    """A name as a key of YAML."""
    return yaml.safe_dump(name, width=10_000).removesuffix("...\n").strip()


def _children(file: YamlFile) -> dict[str, Entry]:
    """The frames of a file with their entries: mappings of the six keys below a parent frame."""
    found = {}
    for entry in file.entries:
        below = file.below(entry)
        if len(entry.path) >= 2 and all(key in below for key in _KEYS):
            found[entry.path[-1]] = entry
    return found


def _tree(file: YamlFile) -> list[FrameTransform]:
    links = []
    for child, entry in _children(file).items():
        below = file.below(entry)
        values = [file.scalar(below[key]) for key in _KEYS]
        if None in values:
            continue
        x, y, z, roll, pitch, yaw = (float(value) for value in values if value is not None)
        T = gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, yaw), np.array([x, y, z]))
        links.append(FrameTransform(entry.path[-2], child, T))
    return links


def _tree_beside(base: Base) -> list[FrameTransform]:
    """The links of `sensors_calibration.yaml` in the folder of `sensor_kit_calibration.yaml`."""
    beside = base.path.parent / _SENSORS
    if base.path.name == _SENSORS or not beside.is_file():
        return []
    return _tree(YamlFile(read_base(beside)))


def _parent_pose(request: Request, base: Base, tree: FrameTree, parent: str) -> gtsam.Pose3:
    """`T_vehicle_parent`."""
    poses: Mapping[str, gtsam.Pose3] = request.parents
    if parent in poses:
        return poses[parent]
    names = [request.vehicle_frame] if request.vehicle_frame else list(VEHICLE_FRAMES)
    if parent in names:
        return gtsam.Pose3()
    for known in (tree, request.tree):
        for vehicle in names:
            T = known.transform(vehicle, parent) if known else None
            if T is not None:
                return T
    raise ExportError(
        f"{base.path}: the pose of '{parent}' in '{names[0]}' is unknown. Give --parent "
        f"{parent}=x,y,z,roll,pitch,yaw, or put {_SENSORS} in the folder of --base"
    )


CONSUMER = Consumer(export, FRAME_OPTIONS | {"--base", "--parent"}, places_housings=True)
