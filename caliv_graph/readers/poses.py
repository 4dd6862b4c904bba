"""From messages to the vehicle's poses in the map (`products.GivenPoses`)."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from caliv_graph.geometry.interpolation import PoseCurve
from caliv_graph.products import Array, GivenPoses, IntArray, PoseFrame
from caliv_graph.readers.collectors import (
    MOST_M,
    NORM_TOLERANCE,
    Losses,
    RowCollector,
    Rows,
    below,
    covariances,
    or_none,
)
from caliv_graph.readers.frames import (
    VEHICLE_FRAMES,
    FrameTransform,
    FrameTree,
    clean_frame,
    message_transforms,
)

_SIDEWAYS_M = 1.0
"""Of a vehicle that always looks along x: poses that move farther along y hold no orientation."""


class PoseCollector(RowCollector):
    """`Odometry`, `PoseStamped` or `PoseWithCovarianceStamped`: the vehicle in the map.

    The header's frame is taken for the map, the child frame of an odometry for the vehicle
    (`pose_frame.py`).
    """

    _WIDTH = 43

    def __init__(self) -> None:
        super().__init__()
        self._children: set[str] = set()
        self._static: dict[str, FrameTransform] = {}

    def add_static(self, message: Any) -> None:
        """Takes one message of `/tf_static`."""
        for _, link in message_transforms(message):
            self._static[link.child] = link

    def add(self, stamp_ns: int, message: Any) -> None:
        """Takes one message."""
        self._children.add(clean_frame(getattr(message, "child_frame_id", "")))
        pose = message.pose
        cov = np.zeros(36)
        if hasattr(pose, "covariance"):
            cov, pose = pose.covariance, pose.pose
        t, q = pose.position, pose.orientation
        self._rows.add(stamp_ns, (t.x, t.y, t.z, q.x, q.y, q.z, q.w, *cov.tolist()))

    def finish(self) -> GivenPoses | None:
        """The poses; None if there are none."""
        stamps, rows, _ = self._usable(
            ("with NaN or infinity", lambda r: np.isfinite(r[:, :7]).all(1)),
            (f"beyond {MOST_M:g} m from the origin", lambda r: below(r[:, :3], MOST_M)),
            (
                "whose orientation is not a unit quaternion",
                lambda r: np.abs(np.linalg.norm(r[:, 3:7], axis=1) - 1.0) <= NORM_TOLERANCE,
            ),
        )
        if not len(stamps):
            return None
        if (rows[:, 3:6] == 0.0).all() and np.ptp(rows[:, 1]) > _SIDEWAYS_M:
            self._losses.say(
                "the orientation is the identity in all messages, but the position moves sideways: "
                "if these are positions, as of a total station, set topics.gnss to the topic "
                "instead and gnss.lever_arm to the place of the prism"
            )
        poses = poses_of(rows[:, :3], rows[:, 3:7])
        cov = or_none(covariances(rows[:, 7:]))
        if cov is not None:
            cov = right_perturbations(Rotation.from_quat(rows[:, 3:7]).as_matrix(), cov)
        return GivenPoses(stamps, poses, cov, self._frame())

    def _frame(self) -> PoseFrame | None:
        """The frame of the poses, if all messages name one that is not the vehicle's."""
        if len(self._children) != 1:
            return None
        (name,) = self._children
        if not name or name in VEHICLE_FRAMES:
            return None
        tree = FrameTree(self._static.values())
        vehicle = tree.vehicle_frame() or ""
        return PoseFrame(name, vehicle, tree.transform(vehicle, name) if vehicle else None)


class TfCollector:
    """`/tf` and `/tf_static`: the vehicle in the frame at the root of its chain.

    With map -> odom -> base_link this is base_link in map, at the stamps of the link of the chain
    that comes most often; the others are interpolated between their stamps.
    """

    def __init__(self) -> None:
        self._moving: dict[tuple[str, str], Rows] = {}
        self._static: dict[str, FrameTransform] = {}
        self._losses = Losses()
        self._messages = 0

    def add(self, stamp_ns: int, message: Any) -> None:
        """Takes one message of `/tf`."""
        self._messages += 1
        for own_stamp_ns, link in message_transforms(message):
            rows = self._moving.setdefault((link.parent, link.child), Rows(7))
            q: Any = link.T_parent_child.rotation().toQuaternion()
            rows.add(
                own_stamp_ns or stamp_ns,
                (*link.T_parent_child.translation(), q.x(), q.y(), q.z(), q.w()),
            )

    def add_static(self, message: Any) -> None:
        """Takes one message of `/tf_static`."""
        for _, link in message_transforms(message):
            self._static[link.child] = link

    def finish(self) -> GivenPoses | None:
        """The poses; None if no vehicle frame moves in another."""
        self._losses = Losses()
        rows = {child: value for (_, child), value in self._moving.items()}
        still = [link for link in self._static.values() if link.child not in rows]
        moving = [FrameTransform(*names, gtsam.Pose3()) for names in self._moving]
        tree = FrameTree([*still, *moving])
        for vehicle in VEHICLE_FRAMES:
            chain = tree.links_to(vehicle)
            if any(link.child in rows for link in chain):
                break
        else:
            self._losses.say(
                f"none of the frames {', '.join(VEHICLE_FRAMES)} moves in another; frames: "
                f"{', '.join(tree.frames[:12])}"
            )
            return None
        self._losses.say(
            "poses are those of the chain "
            + " -> ".join([chain[0].parent, *(link.child for link in chain)])
        )
        sampled = {c: rows[c].ordered()[:2] for c in (link.child for link in chain) if c in rows}
        stamps = max((stamps for stamps, _ in sampled.values()), key=len)
        # A frame that was sent once, as a latched map -> odom is, holds throughout.
        several = [s for s, _ in sampled.values() if len(s) > 1]
        if several:
            inside = (stamps >= max(s[0] for s in several)) & (
                stamps <= min(s[-1] for s in several)
            )
            stamps = stamps[inside]
        if not len(stamps):
            self._losses.say("its links have no time in common")
            return None
        R, t = Rotation.identity(len(stamps)), np.zeros((len(stamps), 3))
        for link in chain:
            if link.child in sampled:
                R_link, t_link = _interpolated(*sampled[link.child], stamps)
            else:
                # Copies: scipy refuses the views of GTSAM's memory, which are read-only.
                R_link = Rotation.from_matrix(np.array(link.T_parent_child.rotation().matrix()))
                t_link = np.array(link.T_parent_child.translation())
            R, t = R * R_link, t + R.apply(t_link)
        return GivenPoses(stamps, poses_of(t, R.as_quat()))

    def notes(self) -> list[str]:
        """What was left out, and the frames that were used."""
        return self._losses.notes(self._messages)


def right_perturbations(R_map_vehicle: Array, cov_ros: Array) -> Array:
    """Covariances (n, 6, 6) of poses from ROS's convention into ours, rad and m.

    ROS: x, y, z, then rotation about the fixed axes, all in the parent's axes. Ours: right
    perturbation, rotation then translation. `cov_ros = B cov B^T`, `B = [[0, R], [R, 0]]`.
    """
    B = np.zeros((len(R_map_vehicle), 6, 6))
    B[:, :3, 3:] = R_map_vehicle
    B[:, 3:, :3] = R_map_vehicle
    return np.asarray(B.transpose(0, 2, 1) @ cov_ros @ B)


def poses_of(t: Array, q_xyzw: Array) -> tuple[gtsam.Pose3, ...]:
    """Poses from places (n, 3), metres, and quaternions (n, 4) of about unit norm."""
    q = q_xyzw / np.linalg.norm(q_xyzw, axis=1, keepdims=True)
    return tuple(
        gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), ti)
        for ti, (x, y, z, w) in zip(t, q, strict=True)
    )


def _interpolated(stamps: IntArray, rows: Array, at_ns: IntArray) -> tuple[Rotation, Array]:
    """Rotation and translation (n, 3) of a link at other stamps, none outside its own.

    On a curve: a vehicle moves by it. A link that corrects a map jumps, and the curve with it.
    """
    if len(stamps) == 1:
        return Rotation.from_quat(rows[0, 3:]), rows[0, :3]
    # Seconds from the first: a float cannot resolve nanoseconds in numbers this large.
    own_s, at_s = (stamps - stamps[0]) * 1e-9, (at_ns - stamps[0]) * 1e-9
    R, t = PoseCurve(own_s, Rotation.from_quat(rows[:, 3:]).as_matrix(), rows[:, :3]).at(at_s)
    return Rotation.from_matrix(R), t
