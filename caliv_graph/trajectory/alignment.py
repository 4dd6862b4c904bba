"""Attitude at the start without an orientation source.

Gravity gives roll and pitch. The heading is that which lays the path of the IMU, or of the
velocities, over the path of the GNSS.
"""

from __future__ import annotations

import numpy as np

from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.se3 import skew
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.gnss import Positions
from caliv_graph.trajectory.imu import DeadReckoning, interpolate

MOVED_M = 8.0
"""Extent of a path that determines the heading: two fixes of 17 mm, 8 m apart, give 3 mrad."""

MIN_FIXES = 4
"""Fixes, and likewise velocities, that a path is made of."""

BIAS_STEP_S = 0.1
"""Step of the double integral of the accelerometer's bias; an initial guess needs no better."""


def level(force_up: Array) -> Array:
    """(3, 3) smallest rotation that turns a vector (3,) upward."""
    up = force_up / np.linalg.norm(force_up)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine, cosine = float(np.linalg.norm(axis)), float(up[2])
    if sine < 1e-12:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    K = skew(axis / sine)
    return np.asarray(np.eye(3) + sine * K + (1.0 - cosine) * (K @ K))


def _yaw_matrix(yaw: float) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def heading_window(positions: Positions | None, begin_ns: int, end_ns: int, least_s: float) -> int:
    """Stamp at which the path is long enough to determine the heading; at least `least_s` in."""
    until = begin_ns + int(1e9 * least_s)
    if positions is not None and len(positions.stamps_ns):
        start = positions.position_map[0, :2]
        far = np.linalg.norm(positions.position_map[:, :2] - start, axis=1) > MOVED_M
        if far.any():
            until = max(until, int(positions.stamps_ns[np.argmax(far)]) + int(1e9 * 0.5 * least_s))
    return min(until, end_ns)


def align(
    dead: DeadReckoning,
    until_ns: int,
    positions: Positions | None,
    velocities: tuple[IntArray, Array] | None,
    forward_imu: Array,
    gravity_m_s2: float,
    name: str,
) -> Array:
    """(3, 3) R_map_imu at the first sample, of the samples and fixes up to `until_ns`.

    Args:
        dead: the IMU, its gyroscope's bias removed.
        until_ns: stamp, nanoseconds.
        positions: of the antenna; None: the heading at the start is the map's x axis.
        velocities: stamps (n,) and velocities (n, 3) of the IMU's origin in its own axes, if known.
        forward_imu: (3,) the vehicle's x axis in the imu frame.
        gravity_m_s2: its magnitude.
        name: of the recording, for messages.

    Raises:
        TrajectoryError: too few fixes to determine the heading.
    """
    begin = int(dead.stamps_ns[0])
    _, gained, _ = dead.between(np.array([begin]), np.array([until_ns]))
    R_level = level(gained[0])
    if positions is None:
        x, y, _ = R_level @ forward_imu
        return _yaw_matrix(-float(np.arctan2(y, x))) @ R_level
    inside = (positions.stamps_ns >= begin) & (positions.stamps_ns <= until_ns)
    if inside.sum() < MIN_FIXES:
        raise TrajectoryError(
            f"{name}: {int(inside.sum())} GNSS fixes and no orientation: heading is unknown. "
            "Record orientation in the IMU's messages, or GNSS along the whole drive"
        )
    stamps = positions.stamps_ns[inside]
    path_map = positions.position_map[inside]
    if velocities is not None and (
        ((velocities[0] >= begin) & (velocities[0] <= until_ns)).sum() >= MIN_FIXES
    ):
        yaw = _yaw_by_velocities(dead, R_level, velocities, stamps, path_map)
    else:
        _, _, dp = dead.between(np.full(len(stamps), begin), stamps)
        yaw = _yaw_by_accelerations(dead, R_level, stamps, dp, path_map, gravity_m_s2)
    return _yaw_matrix(yaw) @ R_level


def _yaw_by_velocities(
    dead: DeadReckoning,
    R_level: Array,
    velocities: tuple[IntArray, Array],
    stamps: IntArray,
    path_map: Array,
) -> float:
    """Yaw of the least-squares rotation of the path by velocities onto that of the fixes."""
    times, values = velocities
    dR, _, _ = dead.between(np.full(len(times), dead.stamps_ns[0]), times)
    level_velocity = np.einsum("nij,nj->ni", R_level @ dR, values)
    dt = np.diff(times)[:, None] * 1e-9
    steps = 0.5 * (level_velocity[1:] + level_velocity[:-1]) * dt
    path = interpolate(stamps, times, np.vstack([np.zeros(3), np.cumsum(steps, axis=0)]))
    a = (path - path.mean(axis=0))[:, :2]
    b = (path_map - path_map.mean(axis=0))[:, :2]
    cross = float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    return float(np.arctan2(cross, float((a * b).sum())))


def _yaw_by_accelerations(
    dead: DeadReckoning,
    R_level: Array,
    stamps: IntArray,
    displacement: Array,
    path_map: Array,
    gravity_m_s2: float,
) -> float:
    """Yaw by least squares, linear in its cosine and sine (`README.md`, section 6)."""
    begin = int(dead.stamps_ns[0])
    t = (stamps - begin) * 1e-9
    x, y, _ = (path_map - path_map[0]).T
    known = displacement @ R_level.T
    known[:, 2] -= 0.5 * gravity_m_s2 * t**2
    # A(t): double integral of the rotation, so that A b is the displacement by a constant bias.
    step_s = BIAS_STEP_S
    fine = np.arange(0.0, t[-1] + step_s, step_s)
    R, _, _ = dead.between(np.full(len(fine), begin), begin + np.round(1e9 * fine).astype(np.int64))
    R = R_level @ R
    once = np.cumsum(R, axis=0) * step_s
    twice = np.cumsum(once, axis=0) * step_s
    A = twice[np.clip(np.round(t / step_s).astype(np.int64), 0, len(fine) - 1)]
    n = len(t)
    rows = []
    right = []
    for axis, (cosine, sine) in enumerate(((x, y), (y, -x))):
        M = np.zeros((n, 9))
        M[:, 0], M[:, 1] = cosine, sine
        M[:, 2 + axis] = -1.0
        M[:, 4 + axis] = -t
        M[:, 6:9] = A[:, axis, :]
        rows.append(M)
        right.append(known[:, axis])
    weak = np.zeros((3, 9))
    weak[:, 6:9] = np.eye(3)  # prior on the bias: 1 m/s^2 weighs like 1 m of position
    solution, *_ = np.linalg.lstsq(
        np.vstack([*rows, weak]), np.concatenate([*right, np.zeros(3)]), rcond=None
    )
    return float(np.arctan2(solution[1], solution[0]))
