"""Guesses that the search had to replace: the config with others, and a sentence about each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import gtsam
import numpy as np

from caliv_graph.config.guesses import with_guess
from caliv_graph.config.lidars import FoundLidarConfig
from caliv_graph.config.model import Config
from caliv_graph.conventions import AXES
from caliv_graph.geometry.se3 import common_motion, vehicle_axes_difference
from caliv_graph.products import Array
from caliv_graph.readers.pose_frame import different_frames, poses_source
from caliv_graph.targets.search.find import FoundTarget

AT_M = 3.0
"""Distance at which angles and shifts of guesses are compared: the search leaves 2 degrees and 0.2
m open, which are alike there."""

TOGETHER = 0.25
"""Part of how far guesses are off that one motion of them all may leave, so that it is named. Poses
of a frame 1.6 m ahead left 0.1, of one turned by 90 degrees 0.05."""

SMALLEST_RAD = math.radians(0.5)
"""Smaller angles are not named."""


def realigned(
    config: Config, searched: Sequence[FoundTarget], given: bool = False
) -> tuple[Config, tuple[str, ...]]:
    """The config with the guesses that the search of the drives found; and a sentence for each.

    One for all, if all are off by about one motion. A guess that was itself found in the drive has
    no sentence: nobody gave it. Of several drives the first that has something to say of a LiDAR
    decides. `given`: the poses were.
    """
    moved = config
    off: dict[str, tuple[gtsam.Pose3, gtsam.Pose3]] = {}
    for found in searched:
        for name in found.misplaced:
            if moved.lidars[name] is not config.lidars[name]:
                continue
            T = found.aligned[name]
            moved = with_guess(moved, name, T)
            if not isinstance(config.lidars[name], FoundLidarConfig):
                off[name] = config.lidars[name].guess(), T
    if set(off) == set(config.lidars) and len(off) > 1:
        T_vehicle_guessed = _together(off)
        if T_vehicle_guessed is not None:
            source = poses_source(config) if given else ""
            return moved, (_sentence_of_all(tuple(off), T_vehicle_guessed, source),)
    return moved, tuple(_sentence(name, *poses) for name, poses in off.items())


def _together(off: Mapping[str, tuple[gtsam.Pose3, gtsam.Pose3]]) -> gtsam.Pose3 | None:
    """T_vehicle_guessed, if guesses and what was found differ by one motion; None: they do not."""
    guesses, found = zip(*off.values(), strict=True)
    T_vehicle_guessed = common_motion(found, guesses)
    for guess, T in off.values():
        left = vehicle_axes_difference(T, T_vehicle_guessed.compose(guess))
        if _size_m(left) > TOGETHER * _size_m(vehicle_axes_difference(T, guess)):
            return None
    return T_vehicle_guessed


def _size_m(difference: Array) -> float:
    """How far a difference of extrinsics moves what is seen at `AT_M`."""
    return float(np.hypot(np.linalg.norm(difference[3:]), AT_M * np.linalg.norm(difference[:3])))


def _sentence_of_all(names: Sequence[str], T_vehicle_guessed: gtsam.Pose3, source: str) -> str:
    listed = " and ".join(f"'{name}'" for name in names)
    x, y, z = np.round(T_vehicle_guessed.translation(), 1) + 0.0
    roll, pitch, yaw = np.round(np.degrees(T_vehicle_guessed.rotation().rpy())) + 0.0
    return (
        f"lidars {listed}: the objects that they see stand still on level ground only if the "
        "initial guesses of all are off by about the same: their vehicle frame moved by "
        f"({x:+.1f}, {y:+.1f}, {z:+.1f}) m and turned by ({roll:+.0f}, {pitch:+.0f}, {yaw:+.0f}) "
        "degrees (roll, pitch, yaw). The target was searched, and the graph solved, from there. "
        f"{different_frames(T_vehicle_guessed, source)}"
    )


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
