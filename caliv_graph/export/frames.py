"""Frames of LiDARs among the user's frames, and poses from the command line."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from caliv_graph.errors import ExportError
from caliv_graph.readers.frame_names import frames_like


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
            f"{what}: '{text}', expected x,y,z,roll,pitch,yaw: six numbers, metres and radians, or "
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
            raise ExportError(f"{what}: '{text}', expected NAME=VALUE")
        if name in named:
            raise ExportError(f"{what}: '{name}' is given twice. Remove one")
        named[name] = value
    return named


def match_frame(lidar: str, candidates: Iterable[str], housing: bool) -> str | None:
    """The frame of a LiDAR among the frames of a file, by its name; None if none fits.

    See `readers.frame_names.frames_like`.

    Raises:
        ExportError: several fit equally well.
    """
    fits = frames_like(lidar, candidates, housing)
    if len(fits) > 1:
        listed = ", ".join(f"'{name}'" for name in fits)
        raise ExportError(
            f"LiDAR '{lidar}': {listed} could all be its frame. Give --frame {lidar}=FRAME"
        )
    return fits[0] if fits else None
