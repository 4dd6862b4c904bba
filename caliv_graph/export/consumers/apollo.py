"""Apollo: the extrinsics file of a LiDAR, such as `velodyne128_novatel_extrinsics.yaml`.

Apollo's static transform component publishes `header.frame_id`, `child_frame_id` and `transform` of
the file (ApolloAuto/apollo, modules/transform/static_transform_component.cc) like tf: the pose of
the child in the frame, a translation in metres and a quaternion x y z w. In Apollo's own vehicles
the frame is `novatel`, that of the GNSS/IMU unit, with axes right, forward, up.
"""

from __future__ import annotations

import json

import gtsam
import yaml

from caliv_graph.errors import ExportError
from caliv_graph.export.edit import YamlFile, with_comment
from caliv_graph.export.frames import match_frame
from caliv_graph.export.request import (
    FRAME_OPTIONS,
    Base,
    Consumer,
    Export,
    Request,
    Transform,
    check_names,
)
from caliv_graph.export.text import notice, number, quaternion_xyzw, with_hash

_GIVE_BASE = "Give an extrinsics file of Apollo as --base"


def export(request: Request) -> Export:
    """The extrinsics file of one LiDAR, or `--base` with new numbers.

    The parent frame is that of `--base`, else the one of `--parent`, else the vehicle frame.

    Raises:
        ExportError: the pose of the parent frame is unknown, or `--base` is not the extrinsics file
            of one of the LiDARs.
    """
    if request.base is None:
        lidar, warnings = request.one_lidar("apollo")
        transform = _transform(request, lidar, _parent(request), request.frame(lidar) or lidar)
        text = _new(transform)
    else:
        file, warnings = YamlFile(request.base), ()
        names = {key: _name(file, request.base, key) for key in ("frame_id", "child_frame_id")}
        lidar = _lidar_of(request, request.base, names["child_frame_id"])
        transform = _transform(request, lidar, names["frame_id"], names["child_frame_id"])
        text = _changed(file, request.base, transform)
    comment = with_hash(notice(request, [transform]))
    return Export(with_comment(comment, text).encode(), (transform,), warnings)


def _parent(request: Request) -> str:
    if len(request.parents) > 1:
        names = ", ".join(request.parents)
        raise ExportError(f"apollo: a file has one parent frame. Give one --parent, not {names}")
    return next(iter(request.parents), request.parent)


def _lidar_of(request: Request, base: Base, child: str) -> str:
    """The LiDAR whose frame is the child of a file."""
    fits = [
        name
        for name in request.lidars
        if (request.frames.get(name) or match_frame(name, [child], housing=False)) == child
    ]
    if not fits:
        # A frame such as velodyne128 does not name the LiDAR: it fits if there is one LiDAR only.
        fits = [name for name in request.lidars if name not in request.frames]
    if len(fits) != 1:
        raise ExportError(
            f"{base.path}: the LiDAR of frame '{child}' is unknown. Give --frame NAME={child}"
        )
    return fits[0]


def _transform(request: Request, lidar: str, parent: str, child: str) -> Transform:
    T_parent_child = _T_vehicle_parent(request, parent).between(request.T_vehicle_child(lidar))
    transform = Transform(lidar, parent, child, T_parent_child, "Rotation: quaternion x y z w.")
    check_names("apollo", (transform,))
    return transform


def _T_vehicle_parent(request: Request, parent: str) -> gtsam.Pose3:
    if parent in request.parents:
        return request.parents[parent]
    if parent == request.parent:
        return gtsam.Pose3()
    T = None if request.tree is None else request.tree.transform(request.parent, parent)
    if T is None:
        raise ExportError(
            f"apollo: the pose of '{parent}' in '{request.parent}' is unknown. Give --parent "
            f"{parent}=x,y,z,roll,pitch,yaw (axes right, forward, up: yaw -1.570796)"
        )
    return T


def _values(pose: gtsam.Pose3) -> dict[str, dict[str, float]]:
    translation = (float(value) for value in pose.translation())
    return {
        "translation": dict(zip("xyz", translation, strict=True)),
        "rotation": dict(zip("xyzw", quaternion_xyzw(pose), strict=True)),
    }


def _new(transform: Transform) -> str:
    lines = [
        "header:",
        # A JSON string is a valid YAML string.
        f"  frame_id: {json.dumps(transform.parent)}",
        f"child_frame_id: {json.dumps(transform.child)}",
        "transform:",
    ]
    for key, numbers in _values(transform.T_parent_child).items():
        lines.append(f"  {key}:")
        lines += [f"    {axis}: {number(value)}" for axis, value in numbers.items()]
    return "\n".join(lines) + "\n"


def _changed(file: YamlFile, base: Base, transform: Transform) -> str:
    for key, numbers in _values(transform.T_parent_child).items():
        entry = file.entry(key)
        if entry is None:
            raise ExportError(f"{base.path}: has no '{key}'. {_GIVE_BASE}")
        file.set_scalars(entry, numbers)
    return file.edited()


def _name(file: YamlFile, base: Base, key: str) -> str:
    entry = file.entry(key)
    if entry is None or not isinstance(entry.value, yaml.ScalarNode):
        raise ExportError(f"{base.path}: has no '{key}'. {_GIVE_BASE}")
    return str(entry.value.value)


CONSUMER = Consumer(export, FRAME_OPTIONS | {"--base", "--parent"})
