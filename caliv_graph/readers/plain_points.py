"""Points of files with the attributes of a `sensor_msgs/PointCloud2`, whose decoding they share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt

from caliv_graph.readers.pointcloud2 import DATATYPES


def as_message(
    data: npt.NDArray[np.uint8], fields: Iterable[tuple[str, str, int]], point_size: int
) -> Any:
    """Points of `point_size` bytes, one after another, little-endian.

    `fields` are name, type as numpy names it (such as f4), and offset in a point, bytes.
    """
    return SimpleNamespace(
        fields=[
            SimpleNamespace(name=name, offset=offset, datatype=DATATYPES[kind])
            for name, kind, offset in fields
        ],
        is_bigendian=False,
        width=len(data) // point_size,
        height=1,
        point_step=point_size,
        row_step=len(data),
        data=data,
    )


def table_as_message(table: npt.NDArray[np.void]) -> Any:
    """Points (N,) with named fields, little-endian."""
    described: Mapping[str, Any] = table.dtype.fields or {}
    fields = [(name, kind.str[1:], offset) for name, (kind, offset, *_) in described.items()]
    data = np.ascontiguousarray(table).view(np.uint8)
    return as_message(data, fields, table.dtype.itemsize)
