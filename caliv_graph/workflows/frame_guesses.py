"""Initial guesses of a bag's sensors, from its `/tf_static` or a URDF."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import gtsam

from caliv_graph.geometry.se3 import rpy
from caliv_graph.readers.bag import Bag, DamagedMessageError
from caliv_graph.readers.frame_names import frames_like
from caliv_graph.readers.frames import (
    TF_TYPES,
    VEHICLE_FRAMES,
    FrameTransform,
    FrameTree,
    message_transforms,
    read_urdf,
)

_STILL_MESSAGES = 200
"""Messages of /tf in which old senders repeat what does not move: a few seconds of them."""

_GROUND_FRAMES = ("base_footprint", "footprint", "ground", "ground_link", "ground_plane")
"""Frames on the ground under the vehicle (REP-120)."""

_MOST_HEIGHT_M = 5.0
_MOST_TILT_RAD = 0.1
"""Of a vehicle frame over the ground: more is another frame of that name."""

NO_GUESS = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@dataclass(frozen=True)
class FrameGuess:
    """`T_vehicle_sensor`, None if it is not known, and where it is from or why it is not known."""

    T_vehicle_sensor: gtsam.Pose3 | None
    origin: str

    def numbers(self) -> tuple[Sequence[float], Sequence[float]]:
        """Metres, and roll, pitch, yaw in degrees; zeros if it is not known."""
        if self.T_vehicle_sensor is None:
            return NO_GUESS
        angles = rpy(self.T_vehicle_sensor.rotation().matrix())
        # To the micrometre and microdegree: the zeros of a quaternion become 1e-15.
        xyz = [round(float(v), 6) + 0.0 for v in self.T_vehicle_sensor.translation()]
        return xyz, [round(math.degrees(v), 6) + 0.0 for v in angles]


@dataclass(frozen=True)
class Frames:
    """Frames that are fixed to each other, the vehicle's frame (None: unknown) and their source."""

    tree: FrameTree
    vehicle: str | None
    source: str

    def extrinsic(self, frame: str, name: str = "") -> FrameGuess:
        """`T_vehicle_sensor` of a sensor by the frame of its messages, or by its own name.

        Where the messages' frame is not known, a frame with a similar name is taken, as `export`
        does: `lidar_front_link` for `front`.
        """
        if frame and frame == (self.vehicle or next((f for f in VEHICLE_FRAMES if f == frame), "")):
            return FrameGuess(gtsam.Pose3(), f"its frame {frame} is that of the vehicle")
        if self.vehicle is None:
            return FrameGuess(None, f"{self.source} has no frame base_link")
        T = self.tree.transform(self.vehicle, frame) if frame else None
        if T is not None:
            return FrameGuess(T, f"{self.vehicle} to {frame}, taken from {self.source}")
        for wanted in filter(None, (frame, name)):
            alike = frames_like(wanted, self.tree.frames, housing=False)
            T = self.tree.transform(self.vehicle, alike[0]) if len(alike) == 1 else None
            if T is not None:
                how = f"by its name that of {wanted}"
                return FrameGuess(T, f"{self.vehicle} to {alike[0]} ({how}), from {self.source}")
        if not frame:
            return FrameGuess(None, "its messages name no frame")
        return FrameGuess(None, f"{self.source} does not lead from {self.vehicle} to {frame}")

    def height(self) -> tuple[float, str] | None:
        """Height of the vehicle frame above the ground, metres, and its source; None: unknown."""
        if self.vehicle is None:
            return None
        if self.vehicle in _GROUND_FRAMES:
            return 0.0, f"{self.vehicle} is on the ground"
        for ground in _GROUND_FRAMES:
            T = self.tree.transform(ground, self.vehicle) if ground in self.tree.frames else None
            if T is None:
                continue
            height, up = float(T.translation()[2]), float(T.rotation().matrix()[2, 2])
            if abs(height) <= _MOST_HEIGHT_M and up >= math.cos(_MOST_TILT_RAD):
                return round(height, 6), f"{ground} to {self.vehicle}, taken from {self.source}"
        return None


def read_frames(bag: Bag, urdf: Path | None) -> Frames:
    """The frames of a bag, those of a URDF over them.

    Raises:
        ConfigError: the URDF is missing or damaged.
    """
    links: list[FrameTransform] = []
    for topic in bag.topics.values():
        if topic.type in TF_TYPES and topic.name.rpartition("/")[2] != "tf_static":
            links += _still_links(bag, topic.name)
    static = [name for name in bag.topics if name.rpartition("/")[2] == "tf_static"]
    for _, _, raw in bag.messages(static):
        links += _links(bag, static[0], raw)
    source = "/tf_static"
    vehicle = FrameTree(links).vehicle_frame()
    if urdf is not None:
        fixed = read_urdf(urdf)
        tree = FrameTree(fixed)
        # The root of a URDF may have any name; a known name of a vehicle frame comes first.
        root = tree.root(fixed[0].child) if fixed else None
        vehicle = tree.vehicle_frame() or vehicle or root
        source = f"{urdf.name} and /tf_static" if static else urdf.name
        links += fixed
    elif not links:
        source = "the bag, which has no /tf_static,"
    return Frames(FrameTree(links), vehicle, source)


def _links(bag: Bag, topic: str, raw: bytes) -> list[FrameTransform]:
    try:
        return [link for _, link in message_transforms(bag.decode(topic, raw))]
    except DamagedMessageError:
        return []


def _still_links(bag: Bag, topic: str) -> Iterable[FrameTransform]:
    """Links that repeat without change: before /tf_static, senders repeated static links."""
    first: dict[tuple[str, str], FrameTransform] = {}
    repeated: dict[tuple[str, str], bool] = {}
    for count, (_, _, raw) in enumerate(bag.messages([topic])):
        for link in _links(bag, topic, raw):
            key = (link.parent, link.child)
            before = first.setdefault(key, link)
            if before is not link:
                same = before.T_parent_child.equals(link.T_parent_child, 1e-9)
                repeated[key] = repeated.get(key, True) and same
        if count >= _STILL_MESSAGES:
            break
    return [first[key] for key, same in repeated.items() if same]
