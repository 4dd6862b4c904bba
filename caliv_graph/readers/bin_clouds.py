"""Clouds as plain numbers, point after point (`.bin`), as KITTI, nuScenes and others store them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from caliv_graph.common.inputs import read_input, unreadable
from caliv_graph.errors import RecordingError
from caliv_graph.readers.bag import DamagedMessageError
from caliv_graph.readers.plain_points import as_message
from caliv_graph.readers.pointcloud2 import (
    DecodedCloud,
    UnusableCloudsError,
    decode_pointcloud2,
    sweep_times,
)

KITTI = ("x f4", "y f4", "z f4", "intensity f4")
NUSCENES = (*KITTI, "ring f4")

_FARTHEST_M = 1e4
"""Beyond the range of any LiDAR: such a coordinate is another field, read as one."""


def point_size(fields: Sequence[str]) -> int:
    """Bytes of a point with these fields (`name type`)."""
    return sum(np.dtype(field.partition(" ")[2]).itemsize for field in fields)


def plain_fields(paths: Sequence[Path], sizes: Sequence[int]) -> tuple[str, ...] | None:
    """Fields of clouds of 4 or 5 floats per point, by the sizes of all files; None: neither."""
    filled = [size for size in sizes if size]
    fitting = [
        fields
        for fields in (KITTI, NUSCENES)
        if filled and all(size % point_size(fields) == 0 for size in filled)
    ]
    if len(fitting) == 2:  # sizes of both kinds: nuScenes names its clouds so
        return NUSCENES if all(path.name.endswith(".pcd.bin") for path in paths) else KITTI
    return fitting[0] if fitting else None


def read_bin(
    path: Path,
    fields: Sequence[str],
    stamp_ns: int,
    ranges: tuple[float, float],
    period_s: float | None,
) -> DecodedCloud:
    """The returns of a cloud within the ranges (least, most; metres), with their times if any.

    Raises:
        RecordingError: the file is missing, cut off, or has other fields.
    """
    message = _as_message(path, fields)
    try:
        cloud = decode_pointcloud2(message, stamp_ns, ranges[0], np.inf, period_s)
    except (DamagedMessageError, UnusableCloudsError) as e:
        raise RecordingError(f"{path}: {e}") from None
    if len(cloud.points_lidar) and np.abs(cloud.points_lidar).max() > _FARTHEST_M:
        raise RecordingError(
            f"{path}: read as {', '.join(fields)}, a point is "
            f"{np.abs(cloud.points_lidar).max():.3g} m away. Set bin_fields of the LiDAR to the "
            "fields of a point"
        )
    near = np.linalg.norm(cloud.points_lidar, axis=1) <= ranges[1]
    times_s = None if cloud.times_s is None else cloud.times_s[near]
    return DecodedCloud(
        cloud.points_lidar[near], times_s, cloud.time_field, cloud.time_problem, cloud.packets
    )


def bin_sweep_times(
    path: Path, fields: Sequence[str], stamp_ns: int, period_s: float | None
) -> DecodedCloud:
    """The times of a cloud, of beams without a return as well. Raises as `read_bin`."""
    return sweep_times(_as_message(path, fields), stamp_ns, period_s)


def _as_message(path: Path, fields: Sequence[str]) -> Any:
    """The file with the attributes of a `sensor_msgs/PointCloud2`, whose decoding it shares."""
    try:
        data = read_input(path)
    except OSError as e:
        raise RecordingError(f"{path}: {unreadable(e)}") from None
    step = point_size(fields)
    if len(data) % step:
        raise RecordingError(
            f"{path}: {len(data)} bytes are no whole number of points of {step} bytes "
            f"({', '.join(fields)}). Set bin_fields of the LiDAR, or copy the cloud again"
        )
    described, offset = [], 0
    for field in fields:
        name, _, kind = field.partition(" ")
        described.append((name, kind, offset))
        offset += np.dtype(kind).itemsize
    return as_message(np.frombuffer(data, np.uint8), described, step)
