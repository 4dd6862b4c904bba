"""Given poses against what a vehicle does: it stays upright, and goes where it points.

Poses that do neither are often right in another convention: each common one is tried.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, MotionData, PoseFrame
from caliv_graph.trajectory.odometry import OdometryPoses

MAX_TILT_RAD = math.radians(20.0)
"""Median angle between the vehicle's z and the map's: slopes are below."""

MIN_SPREAD_RAD = math.radians(5.0)
"""Median deviation of the course from where the vehicle points, from which another convention is
looked for: poses are noisy, and wheels slip."""

MENDED = 0.25
"""Part of that deviation that another convention may leave. A frame ahead of the rear axle deviates
in curves, in any convention that is right."""

MAX_OFF_RAD = math.radians(20.0)
"""Mean angle between course and heading, from which another convention is looked for."""

SAME_RAD = 1e-6
"""Difference of two deviations that rounding explains: a turn about z changes none."""

STEP_M = 1.0
"""Way over which the course is taken."""

MIN_STEPS = 8
"""Pieces of the way that tell a course."""

MAX_SPEED_M_S = 70.0
"""250 km/h: no vehicle is calibrated that fast. Centimetres or millimetres that are read as metres
make a walking pace faster."""

SPEED_WINDOW_NS = 1_000_000_000
"""Time over which the speed is taken: noise of decimetres is none."""


@dataclass(frozen=True)
class Stance:
    """How a vehicle stands and goes by its poses.

    Attributes:
        tilt_rad: median angle between its z and that of the map.
        spread_rad: median deviation of its course from where it points, less `off_rad`; NaN if it
            hardly moves.
        off_rad: mean angle of its course to the left of where it points.
    """

    tilt_rad: float
    spread_rad: float = math.nan
    off_rad: float = math.nan

    @property
    def upright(self) -> bool:
        """Whether it stays on its wheels."""
        return self.tilt_rad < MAX_TILT_RAD

    @property
    def strays(self) -> bool:
        """Whether it goes elsewhere than it points; what hardly moves does not."""
        return self.spread_rad > MIN_SPREAD_RAD

    @property
    def aside_rad(self) -> float:
        """Mean angle of the course to the axis that the vehicle points along, ahead or back."""
        return abs(math.remainder(self.off_rad, math.pi)) if math.isfinite(self.off_rad) else 0.0

    @property
    def sound(self) -> bool:
        """Whether a vehicle stands and goes so."""
        return self.upright and not self.strays and self.aside_rad < MAX_OFF_RAD

    def mends(self, other: Stance) -> bool:
        """Whether a vehicle stands and goes so, and did not by the other stance.

        A frame ahead of the rear axle deviates in curves in every convention. That is no reason
        against one that puts a vehicle on its wheels, or only turns it.
        """
        if not self.upright or not abs(self.off_rad) < MAX_OFF_RAD:
            return False
        turns = abs(self.spread_rad - other.spread_rad) < SAME_RAD
        if not other.upright or turns:
            return self.spread_rad < MAX_OFF_RAD
        return self.spread_rad <= max(MENDED * other.spread_rad, MIN_SPREAD_RAD * MENDED)


@dataclass(frozen=True)
class PosesPhysics:
    """Given poses that are not those of a vehicle, unless they are read in another convention.

    Attributes:
        name: of the recording.
        now: as they are read.
        readings: the conventions in which they are (`READINGS`).
        then: in the first of them.
        frame: that they are of, where messages name it.
    """

    name: str
    now: Stance
    readings: tuple[str, ...]
    then: Stance
    frame: PoseFrame | None = None


def _file_order(R: Array, t: Array) -> tuple[Array, Array]:
    """Quaternions in the order w x y z, read as x y z w."""
    w, x, y, z = Rotation.from_matrix(R).as_quat().T
    return Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix(), t


_DOWN = np.diag([1.0, -1.0, -1.0])
_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_RIGHT_AHEAD = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_NORTH_EAST = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])

READINGS: dict[str, Callable[[Array, Array], tuple[Array, Array]]] = {
    "wxyz": _file_order,
    "frd": lambda R, t: (R @ _DOWN, t),
    "ned": lambda R, t: (_DOWN @ R, t @ _DOWN),
    "inverse": lambda R, t: (np.swapaxes(R, 1, 2), -np.einsum("nji,nj->ni", R, t)),
    "compass": lambda R, t: (_NORTH_EAST @ R @ _DOWN, t),
    "y": lambda R, t: (R, t * [1.0, -1.0, 1.0]),
    "x": lambda R, t: (R, t * [-1.0, 1.0, 1.0]),
    "xy": lambda R, t: (R, t[:, [1, 0, 2]]),
    "camera": lambda R, t: (R @ _CAMERA.T, t),
    "camera_map": lambda R, t: (_CAMERA @ R @ _CAMERA.T, t @ _CAMERA.T),
    "rfu": lambda R, t: (R @ _RIGHT_AHEAD.T, t),
}
"""What may have been meant, and rotations (n, 3, 3) and positions (n, 3) read so: quaternions as w
x y z; vehicles with z down; maps with z down; the map in the vehicle; rotations of north, east,
down with positions of east, north, up; y or x the other way; x and y exchanged; a camera with x to
the right, y down, z ahead, in a map with z up or in one with the same axes; vehicles with x to the
right and y ahead."""


def poses_physics(motion: MotionData) -> PosesPhysics | None:
    """What given poses say against themselves; None: nothing, or no common convention mends it."""
    poses = motion.poses
    if poses is None or isinstance(poses, OdometryPoses) or len(poses.stamps_ns) < MIN_STEPS:
        return None
    R, t = stack(poses.T_map_vehicle)
    now = stance(R, t)
    if now.sound:
        return None
    tried = {name: stance(*read(R, t)) for name, read in READINGS.items()}
    sound = {name: then for name, then in tried.items() if then.mends(now)}
    if not sound:
        return None
    # Of a vehicle that points where it goes the drive cannot tell z up from z down.
    best = min(then.spread_rad for then in sound.values())
    alike = {n: s for n, s in sound.items() if s.spread_rad <= best + MIN_SPREAD_RAD * MENDED}
    return PosesPhysics(motion.name, now, tuple(alike), next(iter(alike.values())), poses.frame)


def impossible_speed(motion: MotionData) -> float | None:
    """Median speed of a vehicle by given poses, m/s, if no vehicle goes as fast; None: it may."""
    poses = motion.poses
    if poses is None or isinstance(poses, OdometryPoses) or len(poses.stamps_ns) < MIN_STEPS:
        return None
    _, t = stack(poses.T_map_vehicle)
    after = np.searchsorted(poses.stamps_ns, poses.stamps_ns + SPEED_WINDOW_NS)
    before = np.flatnonzero(after < len(t))
    if len(before) < MIN_STEPS:
        return None
    after = after[before]
    seconds = (poses.stamps_ns[after] - poses.stamps_ns[before]) / NANOSECONDS_PER_SECOND
    speed = float(np.median(np.linalg.norm(t[after] - t[before], axis=1) / seconds))
    return speed if speed > MAX_SPEED_M_S else None


def stance(R_map_vehicle: Array, t_map_vehicle: Array) -> Stance:
    """How a vehicle with poses (n, 3, 3), (n, 3) stands and goes."""
    cosine = np.clip(R_map_vehicle[:, 2, 2], -1.0, 1.0)
    tilt = float(np.median(np.arccos(cosine)))
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(t_map_vehicle, axis=0), axis=1))])
    at = np.searchsorted(way, np.arange(0.0, way[-1], STEP_M))
    if len(at) <= MIN_STEPS:
        return Stance(tilt)
    moved = np.diff(t_map_vehicle[at], axis=0)
    ahead = R_map_vehicle[at, :, 0][:-1] + R_map_vehicle[at, :, 0][1:]
    off = (moved[:, 0] + 1j * moved[:, 1]) * (ahead[:, 0] - 1j * ahead[:, 1])
    unit = off / np.maximum(np.abs(off), 1e-12)
    # Doubled angles: a vehicle that reverses for a while follows its heading backwards. Of one that
    # goes back as far as it went ahead the mean of the angles themselves is left to chance.
    mean = (unit**2).mean()
    around = 0.5 * np.abs(np.angle(unit**2 * np.conj(mean)))
    axis = np.exp(0.5j * np.angle(mean))
    along = 1.0 if (unit * np.conj(axis)).real.sum() >= 0.0 else -1.0
    return Stance(tilt, float(np.median(around)), float(np.angle(along * axis)))
