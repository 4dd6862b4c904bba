"""The initial guess of the smoother, within its basin of convergence.

With an orientation source the rotations are measured. Without one they start from `alignment` and
follow the gyroscope, over the first part of the drive only.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.alignment import align, heading_window
from caliv_graph.trajectory.antennas import yaw_by_antennas
from caliv_graph.trajectory.gnss import Positions
from caliv_graph.trajectory.imu import DeadReckoning, Inertial, exp_so3, interpolate
from caliv_graph.trajectory.inputs import SmootherInput
from caliv_graph.trajectory.measurements import NodeOrientations, NodeVelocities
from caliv_graph.trajectory.nodes import carry_to_nodes
from caliv_graph.trajectory.states import States, without_bias

STANDSTILL_S = 1.0
"""Length of the windows that are tested for standstill."""

STANDING_M = 0.1
"""The antenna of a standing vehicle moves by less from the first to the second half of a window,
noise aside: 0.2 m/s, less than any vehicle drives steadily."""

STANDING_M_S = 0.3
"""Median speed of a standing vehicle, noise of the velocities included."""

MIN_FIXES = 3
"""In a window that is tested for standstill."""

FIRST_PART_S = 20.0
"""Without orientations the drive is solved from its start over this time, then over twice as much,
and so on. Over 20 s a gyroscope bias of 0.002 rad/s turns the guess by 2 degrees."""

MAX_STANDING_BIAS_SIGMAS = 10.0
"""A mean rate at standstill beyond so many sigmas of the bias is not a bias: the vehicle turns on
the spot, or the confirmation is wrong."""

SPEED_WINDOW_NS = 1_000_000_000
"""Without velocities the initial speed is the difference of the fixes over this time."""


def first_states(data: SmootherInput, nodes: IntArray) -> States:
    """The initial guess of all nodes (n,); without orientation, of those of the drive's first part.

    Raises:
        TrajectoryError: there is no orientation, and the fixes do not determine the heading.
    """
    gyro_bias = _gyro_bias(data)
    inertial = data.inertial
    dead = DeadReckoning(inertial.stamps_ns, inertial.gyro - gyro_bias, inertial.force)
    carried = carry_to_nodes(data, nodes, dead)
    if carried.orientations is not None:
        R = rotations_by_orientation(carried.orientations, nodes, dead)
    else:
        until = heading_window(data.positions, inertial.begin_ns, inertial.end_ns, FIRST_PART_S)
        velocities = None
        if carried.velocities is not None:
            velocities = nodes[carried.velocities.nodes], carried.velocities.velocity_imu
        forward = data.T_vehicle_imu.rotation().matrix()[0]
        R_start = align(
            dead, until, data.positions, velocities, forward, data.gravity_m_s2, data.name
        )
        keep = max(int(np.searchsorted(nodes, until, "right")), 2)
        nodes = nodes[:keep]
        carried = carry_to_nodes(data, nodes, dead)
        R = R_start @ dead.between(np.full(keep, nodes[0]), nodes)[0]
        R = turned_to_antennas(data, R, nodes, dead)
    p, v = positions_and_velocities(R, nodes, data.positions, carried.velocities, data.arm_imu)
    if data.positions is None:
        p = p + R[0] @ data.T_vehicle_imu.inverse().translation() * -1.0
    return States(R, p, v, np.zeros_like(p), np.broadcast_to(gyro_bias, p.shape).copy())


def turned_to_antennas(
    data: SmootherInput, R_map_imu: Array, nodes: IntArray, dead: DeadReckoning
) -> Array:
    """Rotations (n, 3, 3) turned about the vertical as two antennas say, if there are any."""
    measured = []
    if data.headings is not None:
        measured.append((data.headings.stamps_ns, data.headings.azimuth_rad, data.heading_imu))
    if data.baselines is not None:
        x, y, _ = data.baselines.vector_map.T
        measured.append((data.baselines.stamps_ns, np.arctan2(y, x), data.baseline_imu))
    yaw = yaw_by_antennas(R_map_imu, nodes, dead, measured)
    if yaw is None:
        return R_map_imu
    return np.asarray(exp_so3(np.array([[0.0, 0.0, yaw]]))[0] @ R_map_imu)


def extended_states(data: SmootherInput, nodes: IntArray, states: States) -> States:
    """The estimate of the first nodes, extended to all nodes (n,) by dead reckoning."""
    done = len(states.p_map_imu)
    fill = len(nodes) - done

    def held(values: Array) -> Array:
        return np.concatenate([values, np.repeat(values[-1:], fill, axis=0)])

    force_bias, gyro_bias = held(states.force_bias), held(states.gyro_bias)
    grown = replace(states, force_bias=force_bias, gyro_bias=gyro_bias)
    dead = without_bias(data.inertial, nodes, grown)
    later = nodes[done:]
    dR, _, _ = dead.between(np.full(fill, nodes[done - 1]), later)
    R = np.concatenate([states.R_map_imu, states.R_map_imu[-1] @ dR])
    carried = carry_to_nodes(data, nodes, dead)
    p, v = positions_and_velocities(R, nodes, data.positions, carried.velocities, data.arm_imu)
    if data.positions is None:
        p += states.p_map_imu[-1] - p[done - 1]
    return replace(
        grown,
        R_map_imu=R,
        p_map_imu=np.concatenate([states.p_map_imu, p[done:]]),
        velocity_map=np.concatenate([states.velocity_map, v[done:]]),
    )


def _gyro_bias(data: SmootherInput) -> Array:
    """(3,) rad/s, from standstill; zero if the vehicle does not stand.

    The rate of the Earth, 7e-5 rad/s, is not removed: it is below the prior of the bias.
    """
    twist, speeds = data.motion.twist, None
    if twist is not None:
        finite = np.isfinite(twist.velocity).all(axis=1)
        speeds = twist.stamps_ns[finite], np.linalg.norm(twist.velocity[finite], axis=1)
    bias = standing_gyro(data.inertial, data.positions, speeds)
    most = MAX_STANDING_BIAS_SIGMAS * float(data.noise.gyro_bias.max())
    if bias is None or np.linalg.norm(bias) > most:
        return np.zeros(3)
    return bias


def standing_gyro(
    inertial: Inertial, positions: Positions | None, speeds: tuple[IntArray, Array] | None
) -> Array | None:
    """(3,) mean angular rate in the first windows at standstill: the gyroscope's bias.

    A gyroscope does not distinguish standstill from a steady turn, so GNSS or velocities (stamps
    (n,) and speeds (n,) m/s) must confirm it. None if the vehicle does not stand, or nothing
    confirms it.
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
            if inside.sum() >= MIN_FIXES:
                of_one = positions.cov_map[inside].diagonal(axis1=1, axis2=2)
                sigma = float(np.sqrt((of_one.T / positions.shared[inside]).max()))
                # Means of the two halves: noise averages out, motion does not.
                path = positions.position_map[inside, :2]
                half = len(path) // 2
                moved = float(np.linalg.norm(path[half:].mean(axis=0) - path[:half].mean(axis=0)))
                confirmed = True
                still &= moved < STANDING_M + 2.0 * sigma / np.sqrt(half)
        if speeds is not None:
            inside = (speeds[0] >= begin) & (speeds[0] < begin + window)
            if inside.any():
                confirmed = True
                still &= float(np.median(speeds[1][inside])) < STANDING_M_S
        if not (still and confirmed):
            if rates:
                break
            continue
        samples = (inertial.stamps_ns >= begin) & (inertial.stamps_ns < begin + window)
        rates.append(inertial.gyro[samples].mean(axis=0))
    return np.mean(rates, axis=0) if rates else None


def rotations_by_orientation(
    orientations: NodeOrientations, nodes_ns: IntArray, dead: DeadReckoning
) -> Array:
    """(n, 3, 3) R_map_imu: the measured ones, and between them the gyroscope from the nearest."""
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
        half = SPEED_WINDOW_NS // 2
        ahead = interpolate(nodes_ns + half, nodes_ns, p)
        behind = interpolate(nodes_ns - half, nodes_ns, p)
        span = np.minimum(nodes_ns + half, nodes_ns[-1]) - np.maximum(nodes_ns - half, nodes_ns[0])
        v = (ahead - behind) / (span[:, None] * 1e-9)
    return p, v
