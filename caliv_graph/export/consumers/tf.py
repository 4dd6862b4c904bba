"""tf2: lines of static_transform_publisher, a ROS 2 launch file, or an MCAP with /tf_static."""

from __future__ import annotations

import re
import shlex
import tempfile
from pathlib import Path

from caliv_graph.errors import ExportError
from caliv_graph.export.request import (
    FRAME_OPTIONS,
    Consumer,
    Export,
    Request,
    Transform,
    check_names,
)
from caliv_graph.export.text import notice, numbers, quaternion_xyzw, with_hash

FORMS = {".mcap": "mcap", ".py": "launch", ".sh": "lines", ".txt": "lines", "": "lines"}
"""Form by the suffix of the output."""

_TOPIC = "/tf_static"


def export(request: Request) -> Export:
    """The extrinsics as static transforms from the vehicle frame to the frames of the clouds.

    Raises:
        ExportError: neither `form` nor the name of the output gives the form.
    """
    suffix = request.out.suffix
    form = request.form or FORMS.get(suffix)
    if form not in FORMS.values():
        raise ExportError(
            f"tf: no form for '{request.form or suffix}': the suffix of --out must be .sh, .py or "
            ".mcap. Give --form lines, launch or mcap"
        )
    transforms = request.vehicle_transforms("tf2.")
    check_names("tf", transforms)
    if form == "mcap":
        content = _mcap(request, transforms)
    elif form == "launch":
        content = _launch(request, transforms).encode()
    else:
        content = _lines(request, transforms).encode()
    return Export(content, transforms)


def _arguments(transform: Transform) -> list[str]:
    """Arguments of static_transform_publisher since ROS 2 Humble: pose of child in parent."""
    names = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    pose = transform.T_parent_child
    values = numbers((*pose.translation(), *quaternion_xyzw(pose))).split()
    arguments = [item for pair in zip(names, values, strict=True) for item in pair]
    frames = ["--frame-id", transform.parent, "--child-frame-id", transform.child]
    return [*arguments, *frames]


def _lines(request: Request, transforms: tuple[Transform, ...]) -> str:
    extra = ["Each line starts a process that does not end."]
    lines = [
        shlex.join(["ros2", "run", "tf2_ros", "static_transform_publisher", *_arguments(transform)])
        for transform in transforms
    ]
    return with_hash(notice(request, transforms, extra)) + "\n".join(lines) + "\n"


def _launch(request: Request, transforms: tuple[Transform, ...]) -> str:
    nodes = []
    for index, transform in enumerate(transforms):
        name = re.sub(r"[^A-Za-z0-9_]+", "_", transform.child).strip("_")
        arguments = _arguments(transform)
        pairs = zip(arguments[::2], arguments[1::2], strict=True)
        nodes.append(
            "            Node(\n"
            '                package="tf2_ros",\n'
            '                executable="static_transform_publisher",\n'
            f'                name="static_tf_{index}_{name}",\n'
            "                arguments=[\n"
            + "".join(f"                    {key!r}, {value!r},\n" for key, value in pairs)
            + "                ],\n"
            "            ),\n"
        )
    return (
        with_hash(notice(request, transforms))
        + "from launch import LaunchDescription\n"
        + "from launch_ros.actions import Node\n\n\n"
        + "def generate_launch_description():\n"
        + "    return LaunchDescription(\n        [\n"
        + "".join(nodes)
        + "        ]\n    )\n"
    )


def _mcap(request: Request, transforms: tuple[Transform, ...]) -> bytes:
    """A single MCAP file with one latched message; the comment is in its rosbag2 metadata."""
    from rosbags import interfaces as ros
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    never = ros.QosTime(sec=9_223_372_036, nsec=854_775_807)
    qos = ros.Qos(
        history=ros.QosHistory.KEEP_LAST,
        depth=1,
        reliability=ros.QosReliability.RELIABLE,
        durability=ros.QosDurability.TRANSIENT_LOCAL,
        deadline=never,
        lifespan=never,
        liveliness=ros.QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=never,
        avoid_ros_namespace_conventions=False,
    )
    seconds, nanoseconds = divmod(request.recorded_ns, 1_000_000_000)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    messages = []
    for transform in transforms:
        pose = transform.T_parent_child
        x, y, z, w = quaternion_xyzw(pose)
        tx, ty, tz = (float(value) for value in pose.translation())
        messages.append(
            types["geometry_msgs/msg/TransformStamped"](
                header=types["std_msgs/msg/Header"](stamp=stamp, frame_id=transform.parent),
                child_frame_id=transform.child,
                transform=types["geometry_msgs/msg/Transform"](
                    translation=types["geometry_msgs/msg/Vector3"](x=tx, y=ty, z=tz),
                    rotation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
                ),
            )
        )
    message = types["tf2_msgs/msg/TFMessage"](transforms=messages)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "tf"
        writer = Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP)
        writer.set_custom_data("caliv_graph", notice(request, transforms))
        with writer:
            connection = writer.add_connection(
                _TOPIC, "tf2_msgs/msg/TFMessage", typestore=store, offered_qos_profiles=[qos]
            )
            data = store.serialize_cdr(message, connection.msgtype)
            writer.write(connection, request.recorded_ns, data)
        (file,) = folder.glob("*.mcap")
        return file.read_bytes()


CONSUMER = Consumer(export, FRAME_OPTIONS | {"--form"})
