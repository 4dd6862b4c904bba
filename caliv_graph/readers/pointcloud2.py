"""Decoding clouds: `sensor_msgs/PointCloud2` and Livox `CustomMsg`, all points at once.

Times of points come in several conventions, distinguished by name, type and range. Times far from
the cloud's stamp are not used, whatever their name.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import Array
from caliv_graph.readers.bag import DamagedMessageError
from caliv_graph.readers.packet_times import PACKET_PART, continued_times
from caliv_graph.readers.returns import is_return

POINTCLOUD2 = "sensor_msgs/msg/PointCloud2"

LIVOX_TYPES = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")

VELODYNE = "velodyne_msgs/msg/VelodyneScan"

CLOUD_TYPES = (POINTCLOUD2, *LIVOX_TYPES, VELODYNE)

_DECODED_BY = (
    (
        r"(?i)hesai|pandar",
        "'hesai_ros_driver_node' (source_type: packets of a bag), 'hesai_lidar_node' (data_type: "
        "rosbag) or Nebula's 'hesai_ros_wrapper_node' (launch_hw: false)",
    ),
    (
        r"(?i)robosense|rslidar",
        "'rslidar_sdk_node' (msg_source: 2) or Nebula's 'robosense_ros_wrapper_node' (launch_hw: "
        "false)",
    ),
    (r"(?i)ouster.*PacketMsg", "'os_cloud' of ouster_ros"),
    (r"NebulaPackets?$", "Nebula's wrapper node of the LiDAR (launch_hw: false)"),
    (r"(?i)blickfeld|velodyne|livox", "the driver's own node"),
)
"""Packets that only their driver decodes: pattern of the type, and the node."""


def packets_hint(type_name: str) -> str:
    """What decodes packets of a type, as a sentence; empty: they are no known packets."""
    packets = re.search(r"Scan$|Packets?$|PacketMsg$|UdpFrame$|rslidarScan$", type_name)
    node = next((node for pattern, node in _DECODED_BY if re.search(pattern, type_name)), None)
    if packets is None or node is None or type_name in CLOUD_TYPES:
        return ""
    return (
        f"{type_name} holds packets, not points. Play the bag through {node}, record the "
        "PointCloud2 topic with the others, and give that bag"
    )


_TYPES = {
    **{1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"},
    **{-1: "i8", -2: "u8"},
}
"""numpy's names of the types of `sensor_msgs/PointField`. It has none for 64-bit integers, which
stand in files: no message has these numbers."""

DATATYPES = {kind: number for number, kind in _TYPES.items()}
"""The numbers of the types."""

TIME_FIELDS = (
    "t",
    "time",
    "timestamp",
    "time_stamp",
    "offset_time",
    "time_offset",
    "time_offset_ns",
)
"""Names of per-point times: of Ouster, Velodyne, Hesai and Robosense, Autoware, Livox, others."""

_PARTS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
"""Units of times after the stamp that are taken for seconds, the largest first."""

_LEAST_SWEEP_S = 0.01
"""A sweep takes more: no LiDAR turns 100 times a second."""

_MOST_S = 1.0
"""Seconds between a cloud's stamp and its points, at most: a sweep takes less. Other times follow a
convention that is not known."""

_WHOLE = {"ns": 1, "us": 1_000, "ms": 1_000_000}
"""Nanoseconds of the units of whole numbers. Whole seconds are no times of points."""

_ABSOLUTE = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


class UnusableCloudsError(Exception):
    """The clouds of a topic have no x, y, z that could be read."""


@dataclass(frozen=True)
class TimeField:
    """The field with the times of a cloud's points; `unit` is such as `ns after the stamp`."""

    name: str
    type: str
    unit: str


@dataclass(frozen=True)
class DecodedCloud:
    """The returns of one cloud.

    Attributes:
        points_lidar: (N, 3) metres, all finite, none of them zero.
        times_s: (N,) seconds after the stamp, or None.
        time_field: the source of `times_s`; None: the cloud has no times.
        time_problem: why the times of the cloud are not used; empty: they are, or it has none.
        packets: packets with which the times start anew, and over which they were continued; 0:
            they ran through the cloud.
    """

    points_lidar: Array
    times_s: Array | None
    time_field: TimeField | None = None
    time_problem: str = ""
    packets: int = 0


def decode_pointcloud2(
    message: Any,
    stamp_ns: int,
    min_range: float,
    max_range: float,
    period_s: float | None = None,
) -> DecodedCloud:
    """Decodes a `sensor_msgs/PointCloud2`: any order of fields, padding and endianness.

    Times are related to `stamp_ns`; returns outside the ranges (metres) are dropped. With the usual
    time between two clouds, `period_s`, times that start anew with every packet are continued.

    Raises:
        DamagedMessageError: the data do not fit the fields.
        UnusableCloudsError: x, y or z is missing or no floating-point number.
    """
    fields = {field.name: field for field in reversed(message.fields)}
    shown = ", ".join(f"{f.name} {_type_name(f)}" for f in message.fields) or "none"
    if any(axis not in fields or fields[axis].datatype not in (7, 8) for axis in "xyz"):
        raise UnusableCloudsError(
            f"x, y, z as float32 or float64 are needed, its fields are {shown}"
        )
    columns = [_column(message, fields[axis]) for axis in "xyz"]
    points = np.stack(columns, axis=1).astype(np.float64, order="C")
    kept = is_return(points, min_range, max_range)
    times = [(field, column[kept]) for field, column in _time_columns(message)]
    cloud = _with_times(points.compress(kept, axis=0), times, stamp_ns)
    return cloud if period_s is None else _with_continued_times(cloud, period_s)


def sweep_times(message: Any, stamp_ns: int, period_s: float | None) -> DecodedCloud:
    """The times of a `sensor_msgs/PointCloud2`, of beams without a return as well.

    A sweep begins and ends where it does also where its beams hit nothing. Raises as
    `decode_pointcloud2`.
    """
    times = [(field, column[np.isfinite(column)]) for field, column in _time_columns(message)]
    count = len(times[0][1]) if times else 0
    whole = _with_times(np.empty((count, 3)), times, stamp_ns)
    known_s = np.empty(0) if whole.times_s is None else whole.times_s
    if period_s is not None and len(known_s) and np.ptp(known_s) > PACKET_PART * period_s:
        return whole  # of a whole sweep: no need to look at the points
    # Drivers may leave zeros as the absolute times of beams without a return.
    cloud = decode_pointcloud2(message, stamp_ns, 0.0, np.inf, period_s)
    return cloud if cloud.packets or whole.times_s is None else whole


def _time_columns(message: Any) -> list[tuple[TimeField, npt.NDArray[Any]]]:
    """Fields that may hold the times of the points, and their values (N,)."""
    fields = {field.name: field for field in reversed(message.fields)}
    return [
        (TimeField(name, _type_name(fields[name]), ""), _column(message, fields[name]))
        for name in TIME_FIELDS
        if name in fields and fields[name].datatype in _TYPES
    ]


def _with_continued_times(cloud: DecodedCloud, period_s: float) -> DecodedCloud:
    """Times that start anew with every packet, continued; or the reason why they cannot be."""
    if cloud.times_s is None or cloud.time_field is None:
        return cloud
    continued = continued_times(cloud.points_lidar, cloud.times_s, period_s)
    if continued is None:
        return cloud
    if continued.times_s is None:
        problem = f"field '{cloud.time_field.name}': {continued.problem}"
        return DecodedCloud(cloud.points_lidar, None, time_problem=problem)
    return replace(cloud, times_s=continued.times_s, packets=continued.packets)


def decode_livox(
    raw: bytes, is_ros1: bool, stamp_ns: int, min_range: float, max_range: float
) -> DecodedCloud:
    """Decodes a Livox `CustomMsg` from its bytes: as objects, 30,000 points would take 0.3 s.

    `std_msgs/Header header; uint64 timebase; uint32 point_num; uint8 lidar_id; uint8[3] rsvd;
    CustomPoint[] points`, of `uint32 offset_time; float32 x, y, z; uint8 reflectivity, tag, line`,
    as in ROS 1 or as CDR, which aligns each value to its size. Further arguments as in
    `decode_pointcloud2`.

    Raises:
        DamagedMessageError: its size does not fit the number of its points.
    """
    order = "<" if is_ros1 or raw[1:2] == b"\x01" else ">"
    try:
        if is_ros1:
            (frame_size,) = struct.unpack_from("<I", raw, 12)
            start, stride = 16 + frame_size, 19
        else:
            (frame_size,) = struct.unpack_from(f"{order}I", raw, 12)
            # Aligned to 8, counted from the end of the four bytes that every CDR message has.
            start, stride = 4 + -(-(12 + frame_size) // 8) * 8, 20
        announced, count = struct.unpack_from(f"{order}8xI4xI", raw, start)
    except struct.error:
        raise DamagedMessageError("is cut off in its header") from None
    start += 20
    # CDR pads between the points, but not after the last.
    size = start + (stride * count - (stride - 19) if count else 0)
    if count != announced or not size <= len(raw) <= size + 3:
        raise DamagedMessageError(
            f"has {len(raw)} bytes, expected {size} of a CustomMsg with {announced} points"
        )

    def column(offset: int, kind: str) -> npt.NDArray[Any]:
        return np.ndarray((count,), order + kind, raw, start + offset, (stride,))

    if not count:
        return DecodedCloud(np.empty((0, 3)), None)
    points = np.stack([column(offset, "f4") for offset in (4, 8, 12)], axis=1).astype(np.float64)
    kept = is_return(points, min_range, max_range)
    field = TimeField("offset_time", "uint32", "")
    return _with_times(points.compress(kept, axis=0), [(field, column(0, "u4")[kept])], stamp_ns)


def _type_name(field: Any) -> str:
    known = _TYPES.get(field.datatype)
    return np.dtype(known).name if known else f"type {field.datatype}"


def _column(message: Any, field: Any) -> npt.NDArray[Any]:
    """The values of a field, (N,), in the order of the points."""
    order = ">" if message.is_bigendian else "<"
    width, height, step = message.width, message.height, message.point_step
    # Senders of unorganised clouds set row_step to any number, also 0; there is only one row.
    row = message.row_step if height > 1 else width * step
    itemsize = np.dtype(_TYPES[field.datatype]).itemsize
    if field.offset + itemsize > step or (height > 1 and row < width * step):
        raise DamagedMessageError(
            f"has point_step {step} and row_step {row} bytes, too few for its fields"
        )
    if height and width and (height - 1) * row + width * step > len(message.data):
        raise DamagedMessageError(
            f"has {len(message.data)} bytes of data, expected {(height - 1) * row + width * step}"
        )
    if not height * width:
        return np.empty(0, order + _TYPES[field.datatype])
    values: npt.NDArray[Any] = np.ndarray(
        (height, width), order + _TYPES[field.datatype], message.data, field.offset, (row, step)
    )
    return values.ravel()


def _with_times(
    points_lidar: Array, candidates: Sequence[tuple[TimeField, npt.NDArray[Any]]], stamp_ns: int
) -> DecodedCloud:
    """Adds the first times that are plausible."""
    if not len(points_lidar):
        return DecodedCloud(points_lidar, np.empty(0) if candidates else None)
    problem = ""
    for field, values in candidates:
        readings = list(_readings(field, values, stamp_ns))
        for unit, times_s in readings:
            if np.isfinite(times_s).all() and np.abs(times_s).max() <= _MOST_S:
                found = TimeField(field.name, field.type, unit)
                return DecodedCloud(points_lidar, times_s, found)
        problem = problem or _problem(field, values, readings)
    return DecodedCloud(points_lidar, None, time_problem=problem)


def _readings(
    field: TimeField, values: npt.NDArray[Any], stamp_ns: int
) -> Iterable[tuple[str, Array]]:
    """Meanings of the values, the most common first: unit, and seconds after the stamp, (N,)."""
    if field.type in ("uint32", "int32"):
        yield "ns after the stamp", values * 1e-9
    elif field.type in ("uint64", "int64"):
        yield from _whole_readings(field, values, stamp_ns)
    elif field.type == "float32":
        yield "s after the stamp", values.astype(np.float64)
    elif field.type == "float64":
        values = values.astype(np.float64)
        after = ("s after the stamp", values)
        if field.name not in ("timestamp", "time_stamp"):
            yield after
        seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS_PER_SECOND)
        for unit, scale in _ABSOLUTE.items():
            # The stamp's whole seconds first: both numbers are too large for a difference in ns.
            yield f"{unit}, absolute", (values - seconds / scale) * scale - nanoseconds * 1e-9
        if field.name in ("timestamp", "time_stamp"):
            yield after


def _whole_readings(
    field: TimeField, values: npt.NDArray[Any], stamp_ns: int
) -> Iterable[tuple[str, Array]]:
    """`_readings` of 64-bit integers."""
    values = values.astype(np.int64)
    after = ("ns after the stamp", values * 1e-9)
    if field.name not in ("timestamp", "time_stamp"):
        yield after
    for unit, scale_ns in _WHOLE.items():
        # Whole numbers are subtracted: a float of both would be off by 256 ns.
        whole, rest_ns = divmod(stamp_ns, scale_ns)
        times_s = (values - whole) * (scale_ns * 1e-9) - rest_ns * 1e-9
        yield f"{unit}, absolute", times_s
    if field.name in ("timestamp", "time_stamp"):
        yield after


def _problem(
    field: TimeField, values: npt.NDArray[Any], readings: Sequence[tuple[str, Array]]
) -> str:
    """Why none of the readings is plausible, in the words of the most common."""
    where = f"field '{field.name}' ({field.type})"
    if not readings:
        return f"{where} is of a type that no known convention has"
    unit, times_s = readings[0]
    finite = times_s[np.isfinite(times_s)]
    if len(finite) < len(times_s):
        return f"{where} holds values that are not finite"
    first, last = float(finite.min()), float(finite.max())
    return (
        f"{where}, read as {unit}, spans {first:.4g} to {last:.4g} s from the stamp, more than "
        f"{_MOST_S:g} s{_other_unit(field, values)}"
    )


def _other_unit(field: TimeField, values: npt.NDArray[Any]) -> str:
    """The unit in which times that count from the stamp, of a field of seconds, would be a sweep's.

    Of a clock of its own, the times of a cloud differ by little of what they are.
    """
    if field.type not in ("float32", "float64"):
        return ""
    values = values.astype(np.float64)
    for unit, scale in _PARTS.items():
        first_s, last_s = float(values.min()) * scale, float(values.max()) * scale
        if max(abs(first_s), abs(last_s)) <= _MOST_S and last_s - first_s >= _LEAST_SWEEP_S:
            return (
                f". In {unit} it would span {first_s:.4g} to {last_s:.4g} s: convert the field to "
                "seconds, and give that recording"
            )
    return ""
