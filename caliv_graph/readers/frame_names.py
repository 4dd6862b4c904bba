"""Frames of LiDARs among the user's frames, by their names."""

from __future__ import annotations

import re
from collections.abc import Iterable

_KINDS = """
    lidar laser velodyne vlp hdl vls ouster os hesai pandar at livox mid hap robosense rslidar
    helios bpearl seyond innoviz
"""
"""Words in the name of a frame that mark it as that of some LiDAR; with digits, too: `vlp16`."""

_FILLING = frozenset(("link", "frame", "sensor", "scan", "mount", "joint", "points", "optical"))
"""Words without information about the sensor."""

_HOUSING = "base"
"""Word in the name of a housing, as in Autoware's `<sensor>_base_link`."""


def frames_like(lidar: str, candidates: Iterable[str], housing: bool) -> list[str]:
    """The frames among some that may be that of a LiDAR, by its name; the best ones only.

    A frame fits if its name equals that of the LiDAR apart from words for a LiDAR in general:
    `lidar_front` and `velodyne_front_link` fit `front`. With `housing`, frames of housings
    (`<sensor>_base_link`) are searched.
    """
    names = list(dict.fromkeys(candidates))
    core, _ = _words(lidar)
    if lidar in names and (not housing or _HOUSING in core):
        return [lidar]
    wanted = [word for word in core if word != _HOUSING]
    fits = [name for name in names if _fits(name, wanted, housing)]
    if len(fits) > 1:
        fits = [name for name in fits if _words(name)[1]] or fits
    return fits


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
