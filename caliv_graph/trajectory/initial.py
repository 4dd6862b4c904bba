"""Where the optimisation starts: close enough that it ends in the right place.

With an orientation source there is little to do. Without one, gravity levels the IMU, the
gyroscope turns it along, and heading follows from laying the path that IMU or velocities give over
that of the GNSS.
"""

from __future__ import annotations

import numpy as np

from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.gnss import Positions
from caliv_graph.trajectory.imu import DeadReckoning, Inertial, interpolate
from caliv_graph.trajectory.measurements import NodeOrientations, NodeVelocities

STANDSTILL_S = 1.0
"""Length of the windows in which the vehicle is looked for standing."""

STANDING_M = 0.1
"""The antenna of a standing vehicle stays within this, noise aside."""

MOVED_M = 8.0
"""A path of this extent tells heading."""


def standing_gyro(
    inertial: Inertial, positions: Positions | None, speeds: tuple[IntArray, Array] | None
) -> Array | None:
    """(3,) mean angular rate in the first windows at standstill: the gyroscope's bias.

    A gyroscope alone cannot tell standstill from a steady turn, so either GNSS or velocities must
    confirm. None if the vehicle does not stand, or nothing can tell.

    Args:
        inertial: samples.
        positions: of the antenna, if known.
        speeds: stamps (n,) and speeds (n,) m/s, if known.
    """
    if positions is None and speeds is None:
        return None
    window = int(1e9 * STANDSTILL_S)
    rates: list[Array] = []
    for begin in range(inertial.begin_ns, inertial.end_ns - window, window):
        still = True
        confirmed = False
        if positions is not None:
            inside = (positions.stamps_ns >= begin) & (positions.stamps_ns < begin + window)
            if inside.sum() >= 3:
                sigma = float(np.sqrt(positions.cov_map[inside].diagonal(axis1=1, axis2=2).max()))
                # A drift from one half to the other: noise averages out, motion does not.
                path = positions.position_map[inside, :2]
                half = len(path) // 2
                moved = float(np.linalg.norm(path[half:].mean(axis=0) - path[:half].mean(axis=0)))
                confirmed = True
                still &= moved < STANDING_M + 2.0 * sigma / np.sqrt(half)
        if speeds is not None:
            inside = (speeds[0] >= begin) & (speeds[0] < begin + window)
            if inside.any():
                confirmed = True
                still &= float(np.median(speeds[1][inside])) < 0.3
        if not (still and confirmed):
            if rates:
                break
            continue
        samples = (inertial.stamps_ns >= begin) & (inertial.stamps_ns < begin + window)
        rates.append(inertial.gyro[samples].mean(axis=0))
    return np.mean(rates, axis=0) if rates else None


def level(force_up: Array) -> Array:
    """(3, 3) rotation that turns a vector (3,) upward, by the shortest way."""
    up = force_up / np.linalg.norm(force_up)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine, cosine = float(np.linalg.norm(axis)), float(up[2])
    if sine < 1e-12:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    x, y, z = axis / sine
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + sine * K + (1.0 - cosine) * (K @ K))


def _yaw_matrix(yaw: float) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def heading_window(positions: Positions | None, begin_ns: int, end_ns: int, least_s: float) -> int:
    """Stamp until which the recording has to be seen for its heading to show."""
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
    """(3, 3) R_map_imu at the first sample, without an orientation source.

    Args:
        dead: the IMU, its gyroscope's bias removed.
        until_ns: what comes later is not looked at.
        positions: of the antenna; None: the heading at the start is the map's x axis.
        velocities: stamps (n,) and velocities (n, 3) of the IMU's origin in its own axes, if known.
        forward_imu: (3,) the vehicle's x axis in the imu frame.
        gravity_m_s2: its magnitude.
        name: of the recording, for messages.

    Raises:
        TrajectoryError: the fixes do not show which way it went.
    """
    begin = int(dead.stamps_ns[0])
    ends = np.array([begin]), np.array([until_ns])
    _, gained, _ = dead.between(*ends)
    R_level = level(gained[0])
    if positions is None:
        x, y, _ = R_level @ forward_imu
        return _yaw_matrix(-float(np.arctan2(y, x))) @ R_level
    inside = (positions.stamps_ns >= begin) & (positions.stamps_ns <= until_ns)
    if inside.sum() < 4:
        raise TrajectoryError(
            f"{name}: {int(inside.sum())} GNSS fixes and no orientation: heading is unknown. "
            "Record orientation in the IMU's messages, or GNSS along the whole drive"
        )
    stamps = positions.stamps_ns[inside]
    path_map = positions.position_map[inside]
    start = np.full(len(stamps), begin)
    if (
        velocities is not None
        and ((velocities[0] >= begin) & (velocities[0] <= until_ns)).sum() > 3
    ):
        yaw = _yaw_by_velocities(dead, R_level, velocities, stamps, path_map)
    else:
        _, _, dp = dead.between(start, stamps)
        yaw = _yaw_by_accelerations(dead, R_level, stamps, dp, path_map, gravity_m_s2)
    return _yaw_matrix(yaw) @ R_level


def _yaw_by_velocities(
    dead: DeadReckoning,
    R_level: Array,
    velocities: tuple[IntArray, Array],
    stamps: IntArray,
    path_map: Array,
) -> float:
    """The turn that lays the path by velocities over that of the fixes."""
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
    """Heading by least squares: linear in its cosine and sine, start, velocity and bias.

    In the levelled frame at the start, `Rz(-yaw) z = p0 + v0 t + g t^2 / 2 + dp - A b`, where the
    bias b also takes up what the levelling is off by.
    """
    begin = int(dead.stamps_ns[0])
    t = (stamps - begin) * 1e-9
    x, y, _ = (path_map - path_map[0]).T
    known = displacement @ R_level.T
    known[:, 2] -= 0.5 * gravity_m_s2 * t**2
    # A(t): a constant bias in the turning frame, integrated twice.
    step_s = 0.1
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
    weak[:, 6:9] = np.eye(3)  # 0.2 m/s^2 of bias weighs like 0.2 m of position
    solution, *_ = np.linalg.lstsq(
        np.vstack([*rows, weak]), np.concatenate([*right, np.zeros(3)]), rcond=None
    )
    return float(np.arctan2(solution[1], solution[0]))


def rotations_by_orientation(
    orientations: NodeOrientations, nodes_ns: IntArray, dead: DeadReckoning
) -> Array:
    """(n, 3, 3) R_map_imu: measured where it is, carried on by the gyroscope elsewhere."""
    known = orientations.nodes
    after = np.clip(np.searchsorted(known, np.arange(len(nodes_ns))), 0, len(known) - 1)
    before = np.clip(after - 1, 0, None)
    at = np.arange(len(nodes_ns))
    nearer = np.abs(known[before] - at) < np.abs(known[after] - at)
    source = np.where(nearer, before, after)
    dR, _, _ = dead.between(nodes_ns[known[source]], nodes_ns)
    return np.asarray(orientations.R_map_imu[source] @ dR)


def positions_and_velocities(
    R_map_imu: Array,
    nodes_ns: IntArray,
    positions: Positions | None,
    velocities: NodeVelocities | None,
    arm_imu: Array,
) -> tuple[Array, Array]:
    """(n, 3) positions and (n, 3) velocities of the IMU's origin in the map, given rotations."""
    v = None
    if velocities is not None:
        v = np.einsum("nij,nj->ni", R_map_imu[velocities.nodes], velocities.velocity_imu)
        v = interpolate(nodes_ns, nodes_ns[velocities.nodes], v)
    if positions is None:
        assert v is not None  # the caller has checked that one of them is there
        dt = np.diff(nodes_ns)[:, None] * 1e-9
        return np.vstack([np.zeros(3), np.cumsum(0.5 * (v[1:] + v[:-1]) * dt, axis=0)]), v
    p = interpolate(nodes_ns, positions.stamps_ns, positions.position_map) - R_map_imu @ arm_imu
    if v is None:
        half = 500_000_000
        ahead = interpolate(nodes_ns + half, nodes_ns, p)
        behind = interpolate(nodes_ns - half, nodes_ns, p)
        span = np.minimum(nodes_ns + half, nodes_ns[-1]) - np.maximum(nodes_ns - half, nodes_ns[0])
        v = (ahead - behind) / (span[:, None] * 1e-9)
    return p, v
