"""The initial guess without an IMU: heading by the course of the fixes, level ground."""

from __future__ import annotations

import numpy as np

from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.gnss import Positions
from caliv_graph.trajectory.imu import DeadReckoning, exp_so3, interpolate
from caliv_graph.trajectory.initial import positions_and_velocities, turned_to_antennas
from caliv_graph.trajectory.inputs import SmootherInput
from caliv_graph.trajectory.kinematics import Windows, antenna_windows
from caliv_graph.trajectory.measurements import nearest_node
from caliv_graph.trajectory.nodes import carry_to_nodes
from caliv_graph.trajectory.states import States

MIN_SPEED_M_S = 0.5
"""Slower, the course of an antenna is noise."""

MIN_FAST = 2
"""Windows with a course that a heading is made of."""

MIN_CHORD_M = 1.0
CHORD_SIGMAS = 5.0
MOST_CHORD_NS = 3_000_000_000
"""Two fixes tell a course if they are so far apart, and this many of their sigmas, within so long:
in a curve the way between them is the course halfway."""


def first_wheel_states(data: SmootherInput, nodes: IntArray) -> States:
    """The initial guess of all nodes (n,).

    Raises:
        TrajectoryError: neither fixes nor a yaw rate tell where the vehicle goes.
    """
    assert data.wheels is not None
    dead = DeadReckoning(data.inertial.stamps_ns, data.inertial.gyro, data.inertial.force)
    turned = _integrated(dead, nodes)
    rate = np.zeros(len(nodes))
    told = data.headings is not None or data.baselines is not None
    if data.positions is None or (data.wheels.yaw_rate and told):
        yaw = turned
    else:
        at, course = _courses(data)
        if data.wheels.yaw_rate:
            # From the nearest course: integrated over minutes a yaw rate is off by any angle.
            near = nearest_node(at, nodes) if len(at) > 1 else np.zeros(len(nodes), np.int64)
            yaw = (course - _integrated(dead, at, nodes[0]))[near] + turned
        else:
            yaw = interpolate(nodes, at, np.unwrap(course)[:, None])[:, 0]
            rate = np.gradient(yaw, (nodes - nodes[0]) * 1e-9)
    R = turned_to_antennas(data, exp_so3(np.outer(yaw, [0.0, 0.0, 1.0])), nodes, dead)
    bias = np.outer(-rate, [0.0, 0.0, 1.0])
    velocities = carry_to_nodes(data, nodes, dead, frozenset({"velocity"})).velocities
    p, v = positions_and_velocities(R, nodes, data.positions, velocities, data.arm_imu)
    return States(R, p, v, np.zeros_like(p), bias)


def _integrated(dead: DeadReckoning, at_ns: IntArray, from_ns: int | None = None) -> Array:
    """(m,) angles about z from the first instant, or another, by the rates: not modulo a turn."""
    stamps, rates = dead.stamps_ns, dead.gyro[:, 2]
    steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(stamps) * 1e-9
    angle = np.concatenate([[0.0], np.cumsum(steps)])[:, None]
    begin = at_ns[:1] if from_ns is None else np.array([from_ns])
    return np.asarray((interpolate(at_ns, stamps, angle) - interpolate(begin, stamps, angle))[:, 0])


def _courses(data: SmootherInput) -> tuple[IntArray, Array]:
    """Instants (m,) at which the vehicle moves, and the direction of its x axis there, radians."""
    assert data.positions is not None
    assert data.motion.twist is not None
    begin, end = data.inertial.begin_ns, data.inertial.end_ns
    windows: Windows = antenna_windows(data.positions, begin, end)
    moving = windows.where(windows.speed_m_s > MIN_SPEED_M_S)
    stamps, v = moving.stamps_ns, moving.velocity_map
    if len(stamps) < MIN_FAST:
        stamps, v = _chords(data.positions, begin, end)
    if len(stamps) < MIN_FAST:
        raise TrajectoryError(
            f"{data.name}: there is no IMU, and the vehicle hardly moves faster than "
            f"{MIN_SPEED_M_S:g} m/s while there are fixes: heading is unknown. Record GNSS along "
            "the whole drive, or set topics.imu or topics.heading"
        )
    course = np.arctan2(v[:, 1], v[:, 0])
    twist = data.motion.twist
    usable = np.isfinite(twist.velocity).all(axis=1)
    forward = interpolate(stamps, twist.stamps_ns[usable], twist.velocity[usable, :1])
    return stamps, course + np.where(forward[:, 0] < 0.0, np.pi, 0.0)


def _chords(positions: Positions, begin_ns: int, end_ns: int) -> tuple[IntArray, Array]:
    """Instants (m,) between fixes that are well apart, and the way (m, 3) from one to the other.

    For receivers of 1 or 2 Hz, whose fixes are too few for a window.
    """
    inside = (positions.stamps_ns >= begin_ns) & (positions.stamps_ns <= end_ns)
    at, place = positions.stamps_ns[inside], positions.position_map[inside]
    sigma_m = np.sqrt(np.trace(positions.cov_map[inside, :2, :2], axis1=1, axis2=2))
    stamps, ways, first = [], [], 0
    for i in range(1, len(at)):
        while first < i - 1 and at[i] - at[first] > MOST_CHORD_NS:
            first += 1
        way = place[i] - place[first]
        apart_m = float(np.hypot(way[0], way[1]))
        far = apart_m > max(MIN_CHORD_M, CHORD_SIGMAS * float(sigma_m[[first, i]].max()))
        if far and at[i] - at[first] <= MOST_CHORD_NS:
            stamps.append((int(at[first]) + int(at[i])) // 2)
            ways.append(way)
            first = i
    return np.array(stamps, dtype=np.int64), np.array(ways).reshape(-1, 3)
