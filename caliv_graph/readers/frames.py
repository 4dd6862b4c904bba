"""Extrinsics between named frames: from `/tf_static` or the fixed joints of a URDF."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from caliv_graph.common.inputs import read_input, unreadable
from caliv_graph.errors import ConfigError

VEHICLE_FRAMES = ("base_link", "base_footprint", "ego_vehicle", "vehicle")
"""Names of the vehicle frame, the usual one first (REP-105)."""

TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

_MOST_BYTES = 100_000_000
"""Of a URDF, which names meshes but holds none."""

_MOST_M = 1e8
"""No frame is farther from another: the earth is 12,742 km wide."""

_NORM_TOLERANCE = 1e-2
"""Of a quaternion: single precision and a few digits of text are off by less."""


@dataclass(frozen=True)
class FrameTransform:
    """One link of a tree of frames."""

    parent: str
    child: str
    T_parent_child: gtsam.Pose3


class FrameTree:
    """Frames that are fixed to each other."""

    def __init__(self, transforms: Iterable[FrameTransform]) -> None:
        """Of two transforms with the same child the later one counts, as in tf."""
        self._up = {link.child: link for link in transforms if link.child != link.parent}
        self._frames = dict.fromkeys(
            frame for link in self._up.values() for frame in (link.parent, link.child)
        )

    @property
    def frames(self) -> tuple[str, ...]:
        """All frames in the order of the transforms, each parent before its child."""
        return tuple(self._frames)

    def vehicle_frame(self) -> str | None:
        """The frame of the vehicle: one of `VEHICLE_FRAMES`, or None if there is none."""
        return next((frame for frame in VEHICLE_FRAMES if frame in self._frames), None)

    def root(self, frame: str) -> str:
        """The frame at the top of the chain of a frame."""
        return (self._chain(frame) or [frame])[-1]

    def transform(self, parent: str, child: str) -> gtsam.Pose3 | None:
        """`T_parent_child`, composed over any number of links up and down; None: no connection."""
        to_parent, to_child = self._chain(parent), self._chain(child)
        common = next((frame for frame in to_child if frame in to_parent), None)
        if common is None:
            return None
        T_common_child = self._compose(to_child[: to_child.index(common)])
        T_common_parent = self._compose(to_parent[: to_parent.index(common)])
        return T_common_parent.between(T_common_child)

    def links_to(self, frame: str) -> list[FrameTransform]:
        """The links from the root down to a frame; empty if the frame is not known."""
        return [self._up[child] for child in reversed(self._chain(frame)[:-1])]

    def _chain(self, frame: str) -> list[str]:
        """The frame, its parent, that one's parent, ...; empty if the frame is not known."""
        if frame not in self._frames:
            return []
        chain = [frame]
        while (link := self._up.get(chain[-1])) and link.parent not in chain:
            chain.append(link.parent)
        return chain

    def _compose(self, chain: list[str]) -> gtsam.Pose3:
        T = gtsam.Pose3()
        for frame in chain:
            T = self._up[frame].T_parent_child.compose(T)
        return T


def clean_frame(frame_id: str) -> str:
    """A frame's name without the slash that ROS 1 allowed in front."""
    return frame_id.lstrip("/")


def message_transforms(message: Any) -> Iterator[tuple[int, FrameTransform]]:
    """Stamps and links of a `tf2_msgs/TFMessage`; invalid poses are left out."""
    for transform in message.transforms:
        T = pose_from_ros(transform.transform.translation, transform.transform.rotation)
        if T is None:
            continue
        stamp = transform.header.stamp
        parent = clean_frame(transform.header.frame_id)
        child = clean_frame(transform.child_frame_id)
        yield stamp.sec * 1_000_000_000 + stamp.nanosec, FrameTransform(parent, child, T)


def pose_from_ros(translation: Any, rotation: Any) -> gtsam.Pose3 | None:
    """A pose from a message with x, y, z and one with x, y, z, w; None if it is invalid."""
    q = np.array([rotation.w, rotation.x, rotation.y, rotation.z], dtype=np.float64)
    t = np.array([translation.x, translation.y, translation.z], dtype=np.float64)
    norm = float(np.linalg.norm(q))
    if not (np.abs(t) <= _MOST_M).all() or not abs(norm - 1.0) <= _NORM_TOLERANCE:
        return None
    return gtsam.Pose3(gtsam.Rot3.Quaternion(*(q / norm)), t)


def pose_text(T: gtsam.Pose3) -> str:
    """A pose as a config has it, to the centimetre and the tenth of a degree."""
    xyz = ", ".join(f"{round(value, 2) + 0.0:.2f}" for value in T.translation())
    angles = np.degrees(T.rotation().rpy())
    rpy_deg = ", ".join(f"{round(value, 1) + 0.0:.1f}" for value in angles)
    return f"xyz [{xyz}], rpy_deg [{rpy_deg}]"


def read_urdf(path: Path) -> tuple[FrameTransform, ...]:
    """The fixed joints of a URDF. A link on a joint that moves has no fixed pose.

    Raises:
        ConfigError: the file is missing, not a URDF, or a xacro that was not expanded.
    """
    try:
        text = read_input(path, _MOST_BYTES).decode("utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file. Give --urdf the vehicle's URDF") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is not text in UTF-8. Give a URDF") from None
    except OSError as e:
        raise ConfigError(f"{path}: {unreadable(e)}") from None
    # Entities can unfold to gigabytes, and no URDF has them.
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ConfigError(f"{path}: has a DOCTYPE, which no URDF needs. Remove it")
    try:
        root = ET.fromstring(text)
    except (ET.ParseError, ValueError, RecursionError) as e:
        raise ConfigError(f"{path}: is not valid XML: {e}. Correct it there") from None
    if root.tag != "robot":
        raise ConfigError(f"{path}: its root is <{root.tag}>, expected <robot>: give a URDF")
    if "${" in text or "$(" in text or "<xacro:" in text:
        raise ConfigError(
            f"{path}: is a xacro. Expand it first: 'xacro {path.name} > vehicle.urdf'"
        )
    # Transmissions name joints too, without their type and poses.
    fixed = [joint for joint in root.iter("joint") if joint.get("type") == "fixed"]
    return tuple(_joint(joint, path) for joint in fixed)


def _joint(joint: ET.Element, path: Path) -> FrameTransform:
    where = f"{path}: joint '{joint.get('name', '')}'"
    names = [(found.get("link") or "") for tag in ("parent", "child") for found in joint.iter(tag)]
    if len(names) != 2 or not all(names):
        raise ConfigError(f"{where}: needs one <parent link=...> and one <child link=...>")
    origin = joint.find("origin")
    xyz = _triple(origin, "xyz", where)
    roll, pitch, yaw = _triple(origin, "rpy", where)
    T = gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, yaw), np.array(xyz))
    return FrameTransform(clean_frame(names[0]), clean_frame(names[1]), T)


def _triple(origin: ET.Element | None, name: str, where: str) -> tuple[float, float, float]:
    text = "0 0 0" if origin is None else origin.get(name, "0 0 0")
    try:
        x, y, z = (float(value) for value in text.split())
    except ValueError:
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        raise ConfigError(f"{where}: {name}='{text[:60]}', expected three finite numbers")
    return x, y, z
