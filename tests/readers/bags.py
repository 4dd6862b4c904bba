"""Small bags of all kinds, for the tests of what reads them."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from caliv_graph.readers.definitions import DEFINITIONS

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND

KINDS = ("mcap", "mcap-zstd", "mcap-message", "mcap-file", "sqlite3", "ros1", "ros1-lz4")

_LIVOX_DEFINITION = """
std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
{package}/CustomPoint[] points
"""

_LIVOX_POINT_DEFINITION = """
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""

_STORES = {
    False: get_typestore(Stores.ROS2_HUMBLE),
    True: get_typestore(Stores.ROS1_NOETIC),
}
for _store in _STORES.values():
    for _package in ("livox_ros_driver", "livox_ros_driver2"):
        _definition = _LIVOX_DEFINITION.format(package=_package)
        _store.register(get_types_from_msg(_definition, f"{_package}/msg/CustomMsg"))
        _store.register(get_types_from_msg(_LIVOX_POINT_DEFINITION, f"{_package}/msg/CustomPoint"))

_STORES[True].register(
    get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
)

for _store in _STORES.values():
    for _name, _text in DEFINITIONS.items():
        _store.register(get_types_from_msg(_text, _name))

Message = dict[str, Any]
"""A message as nested dictionaries; `_type` names the type at the top."""


def write_bag(
    path: Path,
    messages: Iterable[tuple[str, int, Message]],
    kind: str = "mcap",
    topics: Sequence[tuple[str, str]] = (),
) -> Path:
    """Writes a bag.

    Args:
        path: folder of a ROS 2 bag, or a `.bag` file to be.
        messages: topic, record time in nanoseconds, message; written in this order.
        kind: one of `KINDS`.
        topics: name and type of topics that have no messages.

    Returns:
        The path of what was written.
    """
    ros1 = kind.startswith("ros1")
    store = _STORES[ros1]
    writer: Any
    if ros1:
        path = path.with_suffix(".bag")
        writer = Writer1(path)
        writer.chunk_threshold = 20_000  # several chunks in small bags
        if kind == "ros1-lz4":
            writer.set_compression(Writer1.CompressionFormat.LZ4)
    else:
        plugin = StoragePlugin.SQLITE3 if kind == "sqlite3" else StoragePlugin.MCAP
        writer = Writer2(path, version=9, storage_plugin=plugin)
        mode = {
            "mcap-zstd": CompressionMode.STORAGE,
            "mcap-message": CompressionMode.MESSAGE,
            "mcap-file": CompressionMode.FILE,
        }.get(kind)
        if mode:
            writer.set_compression(mode, CompressionFormat.ZSTD)
    connections: dict[str, Any] = {}
    with writer:
        for topic, type_name in topics:
            connections[topic] = writer.add_connection(topic, type_name, typestore=store)
        for topic, record_ns, message in messages:
            type_name = message["_type"]
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=store)
            raw = serialise(message, ros1)
            writer.write(connections[topic], record_ns, raw)
    return path


def serialise(message: Message, ros1: bool = False, little_endian: bool = True) -> bytes:
    """The bytes of a message."""
    store = _STORES[ros1]
    type_name = message["_type"]
    built = _build(store, type_name, {k: v for k, v in message.items() if k != "_type"})
    if ros1:
        return bytes(store.serialize_ros1(built, type_name))
    return bytes(store.serialize_cdr(built, type_name, little_endian=little_endian))


def as_object(message: Message) -> Any:
    """The message as `rosbags` decodes it."""
    store = _STORES[False]
    return store.deserialize_cdr(serialise(message), message["_type"])


def _build(store: Any, type_name: str, values: Message) -> Any:
    """An object of a type; what is not given is zero or empty."""
    fields = {}
    for name, (node, detail) in store.fielddefs[type_name][1]:
        given = values.get(name)
        fields[name] = _value(store, int(node), detail, given)
    return store.types[type_name](**fields)


def _value(store: Any, node: int, detail: Any, given: Any) -> Any:
    if node == 1:  # a base type
        return given if given is not None else ("" if detail[0] == "string" else 0)
    if node == 2:  # a message
        return _build(store, detail, given or {})
    (inner_node, inner), size = detail
    if int(inner_node) == 2:
        return [_build(store, inner, item) for item in given or ()]
    count = size if node == 3 else 0
    return np.array(given if given is not None else np.zeros(count), dtype=inner[0])


def header(stamp_ns: int, frame_id: str = "") -> Message:
    return {
        "stamp": {"sec": stamp_ns // SECOND, "nanosec": stamp_ns % SECOND},
        "frame_id": frame_id,
    }


def xyz(values: Iterable[float]) -> Message:
    return dict(zip("xyz", map(float, values), strict=True))


def xyzw(values: Iterable[float]) -> Message:
    return dict(zip("xyzw", map(float, values), strict=True))


_DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def cloud(
    stamp_ns: int,
    points: Any,
    times: Any = None,
    time_field: tuple[str, str] = ("t", "u4"),
    frame_id: str = "lidar",
    **changes: Any,
) -> Message:
    """A `sensor_msgs/PointCloud2` of x, y, z float32 and, if given, times."""
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    columns: dict[str, Any] = {axis: (points[:, i], "f4") for i, axis in enumerate("xyz")}
    if times is not None:
        columns[time_field[0]] = (np.asarray(times), time_field[1])
    return packed_cloud(stamp_ns, columns, frame_id=frame_id, **changes)


def packed_cloud(
    stamp_ns: int,
    columns: dict[str, tuple[Any, str]],
    height: int = 1,
    big_endian: bool = False,
    padding: tuple[int, int, int] = (0, 0, 0),
    frame_id: str = "lidar",
    **changes: Any,
) -> Message:
    """A `sensor_msgs/PointCloud2` with fields in the order given.

    Args:
        stamp_ns: of the header.
        columns: values (N,) and numpy's name of the type, by field.
        height: rows of the cloud.
        big_endian: order of the bytes.
        padding: bytes before the first field, after each field, after each row.
        frame_id: of the header.
        changes: fields of the message to be set otherwise.
    """
    before, after, row_end = padding
    order = ">" if big_endian else "<"
    offsets, step = [], before
    for _, kind in columns.values():
        offsets.append(step)
        step += np.dtype(kind).itemsize + after
    dtype = np.dtype(
        {
            "names": list(columns),
            "formats": [order + kind for _, kind in columns.values()],
            "offsets": offsets,
            "itemsize": step,
        }
    )
    count = len(next(iter(columns.values()))[0])
    table = np.zeros(count, dtype)
    for name, (values, _) in columns.items():
        table[name] = values
    width = count // height
    rows = table.reshape(height, width).view(np.uint8).reshape(height, width * step)
    data = np.hstack([rows, np.full((height, row_end), 255, np.uint8)]).ravel()
    return {
        "_type": "sensor_msgs/msg/PointCloud2",
        "header": header(stamp_ns, frame_id),
        "height": height,
        "width": width,
        "fields": [
            {"name": name, "offset": offset, "datatype": _DATATYPES[kind], "count": 1}
            for (name, (_, kind)), offset in zip(columns.items(), offsets, strict=True)
        ],
        "is_bigendian": big_endian,
        "point_step": step,
        "row_step": width * step + row_end,
        "data": data,
        "is_dense": False,
        **changes,
    }


def livox(
    stamp_ns: int,
    points: Any,
    offsets_ns: Sequence[int],
    frame_id: str = "lid",
    package: str = "livox_ros_driver2",
) -> Message:
    return {
        "_type": f"{package}/msg/CustomMsg",
        "header": header(stamp_ns, frame_id),
        "timebase": stamp_ns,
        "point_num": len(offsets_ns),
        "points": [
            {"offset_time": int(t), **xyz(p), "tag": 16, "line": i % 4}
            for i, (p, t) in enumerate(zip(points, offsets_ns, strict=True))
        ],
    }


def imu(
    stamp_ns: int,
    force: Sequence[float] = (0.0, 0.0, 9.81),
    rate: Sequence[float] = (0.0, 0.0, 0.1),
    quaternion: Sequence[float] = (0.0, 0.0, 0.6, 0.8),
    frame_id: str = "imu_link",
    **covariances: Any,
) -> Message:
    return {
        "_type": "sensor_msgs/msg/Imu",
        "header": header(stamp_ns, frame_id),
        "orientation": xyzw(quaternion),
        "angular_velocity": xyz(rate),
        "linear_acceleration": xyz(force),
        **covariances,
    }


def fix(
    stamp_ns: int, latitude: float = 48.0, longitude: float = 11.0, status: int = 0, **more: Any
) -> Message:
    return {
        "_type": "sensor_msgs/msg/NavSatFix",
        "header": header(stamp_ns, "gnss"),
        "status": {"status": status, "service": 1},
        "latitude": latitude,
        "longitude": longitude,
        "altitude": 500.0,
        **more,
    }


def twist(stamp_ns: int, velocity: Sequence[float], frame_id: str = "base_link") -> Message:
    return {
        "_type": "geometry_msgs/msg/TwistStamped",
        "header": header(stamp_ns, frame_id),
        "twist": {"linear": xyz(velocity)},
    }


def odometry(
    stamp_ns: int,
    position: Iterable[float],
    quaternion: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
    velocity: Sequence[float] = (0.0, 0.0, 0.0),
    pose_cov: Any = None,
    twist_cov: Any = None,
    child: str = "base_link",
) -> Message:
    return {
        "_type": "nav_msgs/msg/Odometry",
        "header": header(stamp_ns, "map"),
        "child_frame_id": child,
        "pose": {
            "pose": {"position": xyz(position), "orientation": xyzw(quaternion)},
            "covariance": pose_cov,
        },
        "twist": {"twist": {"linear": xyz(velocity)}, "covariance": twist_cov},
    }


def tf(*links: tuple[str, str, Sequence[float], Sequence[float]], stamp_ns: int = START) -> Message:
    """A TFMessage of (parent, child, x y z, quaternion) links."""
    return {
        "_type": "tf2_msgs/msg/TFMessage",
        "transforms": [
            {
                "header": header(stamp_ns, parent),
                "child_frame_id": child,
                "transform": {"translation": xyz(t), "rotation": xyzw(q)},
            }
            for parent, child, t, q in links
        ],
    }


def set_header_stamp(raw: bytes, stamp_ns: int) -> bytes:
    """A CDR message with another stamp."""
    return raw[:4] + struct.pack("<iI", *divmod(stamp_ns, SECOND)) + raw[12:]
