"""Frames of LiDARs among the user's frames, and poses from the command line."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from caliv_graph.errors import ExportError

_KINDS = """
    lidar laser velodyne vlp hdl vls ouster os hesai pandar at livox mid hap robosense rslidar
    helios bpearl seyond innoviz
"""
"""Words in the name of a frame that mark it as that of some LiDAR; with digits, too: `vlp16`."""

_FILLING = frozenset(("link", "frame", "sensor", "scan", "mount", "joint", "points", "optical"))
"""Words without information about the sensor."""

_HOUSING = "base"
"""Word in the name of a housing, as in Autoware's `<sensor>_base_link`."""


def parse_pose(text: str, what: str) -> gtsam.Pose3:
    """A pose of `x,y,z` or `x,y,z,roll,pitch,yaw`, metres and radians as in URDF.

    The numbers are between commas or blanks; `what` is the option, for the message.

    Raises:
        ExportError: the text is not three or six finite numbers.
    """
    try:
        values = [float(part) for part in re.split(r"[,\s]+", text.strip())]
    except ValueError:
        values = []
    if len(values) not in (3, 6) or not all(map(math.isfinite, values)):
        raise ExportError(
            f"{what}: '{text}' is not x,y,z,roll,pitch,yaw: six numbers, metres and radians, or "
            "three for no rotation"
        )
    roll, pitch, yaw = values[3:] or (0.0, 0.0, 0.0)
    return gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, yaw), np.array(values[:3]))


def parse_named(texts: Sequence[str], what: str) -> dict[str, str]:
    """Options of the form NAME=VALUE.

    Raises:
        ExportError: an option has another form, or a name is given twice.
    """
    named: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals and value):
            raise ExportError(f"{what}: '{text}' is not NAME=VALUE")
        if name in named:
            raise ExportError(f"{what}: '{name}' is given twice")
        named[name] = value
    return named


def match_frame(lidar: str, candidates: Iterable[str], housing: bool) -> str | None:
    """The frame of a LiDAR among the frames of a file, by its name; None if none fits.

    A frame fits if its name equals that of the LiDAR apart from words for a LiDAR in general:
    `lidar_front` and `velodyne_front_link` fit `front`. With `housing`, frames of housings
    (`<sensor>_base_link`) are searched.

    Raises:
        ExportError: several fit equally well.
    """
    names = list(dict.fromkeys(candidates))
    core, _ = _words(lidar)
    if lidar in names and (not housing or _HOUSING in core):
        return lidar
    wanted = [word for word in core if word != _HOUSING]
    fits = [name for name in names if _fits(name, wanted, housing)]
    if len(fits) > 1:
        fits = [name for name in fits if _words(name)[1]] or fits
    if len(fits) > 1:
        listed = ", ".join(f"'{name}'" for name in fits)
        raise ExportError(
            f"LiDAR '{lidar}': {listed} could all be its frame. Give --frame {lidar}=FRAME"
        )
    return fits[0] if fits else None


def _fits(name: str, wanted: list[str], housing: bool) -> bool:
    core, is_lidar = _words(name)
    is_housing = _HOUSING in core
    core = [word for word in core if word != _HOUSING]
    if is_housing != housing:
        return False
    # A LiDAR named just 'lidar' fits only frames with such a word.
    return core == wanted and (bool(wanted) or is_lidar)


def _words(name: str) -> tuple[list[str], bool]:
    """The words of a name that identify the LiDAR, and whether it names a LiDAR at all."""
    # lidar1 is number 1, but vlp16 is a model.
    text = re.sub(r"(lidar|laser|sensor)(?=[0-9])", r"\1_", name.lower())
    words = [word for word in re.split(r"[^a-z0-9]+", text) if word]
    kinds = [word for word in words if word.rstrip("0123456789") in _KINDS.split()]
    core = [word for word in words if word not in kinds and word not in _FILLING]
    return core, bool(kinds)
