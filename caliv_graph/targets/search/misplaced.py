"""Guesses that the search had to replace: the config with others, and a sentence about each."""

from __future__ import annotations

import math
from collections.abc import Sequence

import gtsam
import numpy as np

from caliv_graph.config.guesses import with_guess
from caliv_graph.config.lidars import FoundLidarConfig
from caliv_graph.config.model import Config
from caliv_graph.conventions import AXES
from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.targets.search.find import FoundTarget

SMALLEST_RAD = math.radians(0.5)
"""Smaller angles are not named."""


def realigned(config: Config, searched: Sequence[FoundTarget]) -> tuple[Config, tuple[str, ...]]:
    """The config with the guesses that the search of the drives found; and a sentence for each.

    A guess that was itself found in the drive has no sentence: nobody gave it. Of several drives
    the first that has something to say of a LiDAR decides.
    """
    moved, sentences = config, []
    for found in searched:
        for name in found.misplaced:
            if moved.lidars[name] is not config.lidars[name]:
                continue
            T = found.aligned[name]
            moved = with_guess(moved, name, T)
            if not isinstance(config.lidars[name], FoundLidarConfig):
                sentences.append(_sentence(name, config.lidars[name].guess(), T))
    return moved, tuple(sentences)


def _sentence(name: str, guess: gtsam.Pose3, found: gtsam.Pose3) -> str:
    off = vehicle_axes_difference(found, guess)
    angles = ", ".join(
        f"{axis} by {math.degrees(angle):+.0f}"
        for axis, angle in zip(AXES[:3], off[:3].tolist(), strict=True)
        if abs(angle) >= SMALLEST_RAD
    )
    shift = float(np.linalg.norm(off[3:]))
    return (
        f"lidar '{name}': the objects that it sees stand still on level ground only if its initial "
        f"guess is off: {angles or 'no angle'} degrees, and {shift:.1f} m ({off[3]:+.1f} forward, "
        f"{off[4]:+.1f} left, {off[5]:+.1f} up). The target was searched, and the graph solved, "
        f"from there. Check lidars.{name}.initial: signs, degrees, T_vehicle_lidar and not its "
        "inverse, the topic"
    )
