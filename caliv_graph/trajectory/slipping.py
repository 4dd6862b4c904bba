"""Speeds of wheels that slip for a moment: they are left out (`README.md`, section 7)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from caliv_graph.common.statistics import MAD
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.build import Estimate, velocity_roots
from caliv_graph.trajectory.factors import velocity_residuals
from caliv_graph.trajectory.inputs import TWIST_CLOCK, SmootherInput
from caliv_graph.trajectory.measurements import NO_VELOCITIES, nearest_node
from caliv_graph.trajectory.nodes import carry_to_nodes
from caliv_graph.trajectory.outliers import (
    OUTLIER_P_VALUE,
    Robust,
    next_limit,
    solve_without_outliers,
)
from caliv_graph.trajectory.solve import ROUGH_TOLERANCE, solve
from caliv_graph.trajectory.states import States, without_bias
from caliv_graph.trajectory.uncertain import Settled, settle

MOST_SLIPPED = 0.2
"""Part of the nodes in motion. If the speeds of more lie apart, they have no common noise, and none
of them is an outlier."""

FEWEST_SPEEDS = 20
"""Nodes in motion from which the scatter of their speeds is known."""

STANDING_M_S = 0.1
"""Slower vehicles stand: their wheels do not slip, and their speeds scatter less."""

LEAST_SCATTER_M_S = 0.005
"""Speeds without noise scatter by less than what a node neglects (`README.md`, section 3). With 20
mm/s, speeds that a ramp puts 90 mm/s off pass for noise of all."""

STEP_PART = 0.25
"""The same in steps of the speeds' numbers: they are off by half a step, and may stay so."""

SLIP_ROUNDS = 8
"""Of leaving out, worst first: a slip by 10 m/s takes six."""

ABOUT_NS = 5_000_000
"""How far a delay may be from that by which velocities belong to nodes: a tenth of the way to the
next one."""


def without_slips(settled: Settled, nodes: IntArray) -> Settled:
    """A rough estimate of states and parameters without speeds that all others do not explain.

    Fixes are all in it: those beside a slip seem wrong until it is left out. And velocities belong
    to nodes by the delay that is found.
    """
    if not _may_slip(settled.data):
        return settled
    none = np.zeros(0, dtype=np.int64)
    limit: float | None = None
    for _ in range(SLIP_ROUNDS):
        data = settled.data
        late_ns = data.late_ns.get(TWIST_CLOCK, 0)
        if abs(late_ns - data.about_late_ns) > ABOUT_NS:
            data = replace(data, about_late_ns=late_ns)
        found, limit = _slipped(data, nodes, settled.estimate.states, limit)
        if data is settled.data and np.array_equal(found, data.slipped):
            if limit == _final_limit(data):
                break
            continue
        data = replace(data, slipped=found)
        estimate = solve(data, nodes, settled.estimate.states, none, "huber", ROUGH_TOLERANCE)
        of = settled.parameters
        settled = settle(data, nodes, estimate, none, "huber", of, ROUGH_TOLERANCE)
    return settled


def solve_without_slips(
    data: SmootherInput, nodes: IntArray, states: States
) -> tuple[Robust, Estimate]:
    """`solve_without_outliers`, and without speeds that all others do not explain.

    What a speed is off by is compared with the scatter of all, whatever noise is stated.
    """
    robust, estimate = solve_without_outliers(data, nodes, states)
    if not _may_slip(data):
        return robust, estimate
    limit: float | None = None
    for _ in range(SLIP_ROUNDS):
        found, limit = _slipped(robust.data, nodes, estimate.states, limit)
        if np.array_equal(found, robust.data.slipped):
            if limit == _final_limit(data):
                break
            continue
        states = estimate.states
        del estimate  # its graph: 4 MB per minute of drive
        # From the fixes as they were: beside a slip they may have seemed noisier.
        data = replace(data, slipped=found)
        robust, estimate = solve_without_outliers(data, nodes, states)
    return robust, estimate


def slip_warnings(data: SmootherInput) -> list[str]:
    """A line if speeds were left out."""
    twist, count = data.motion.twist, len(data.slipped)
    if twist is None or not count:
        return []
    begins_s = (twist.stamps_ns[data.slipped[0]] - twist.stamps_ns[0]) * 1e-9
    why = ", as of wheels that slip" if data.speed_alone else ""
    return [
        f"{data.name}: {count} of {len(twist.stamps_ns)} speeds disagree with the motion, left "
        f"out: the first {begins_s:.1f} s after the first speed{why}"
    ]


def _may_slip(data: SmootherInput) -> bool:
    """Without an IMU, speeds are what all others are compared with."""
    robust = data.config.robust.kernel != "none"
    return robust and data.wheels is None and data.motion.twist is not None


def _final_limit(data: SmootherInput) -> float:
    return float(chdtri(1 if data.speed_alone else 3, OUTLIER_P_VALUE))


def _slipped(
    data: SmootherInput, nodes: IntArray, states: States, limit: float | None
) -> tuple[IntArray, float]:
    """Indices of the messages to leave out now, and the limit of squares that they exceed.

    It comes down from round to round, as that of the fixes does (`outliers.py`).
    """
    final = _final_limit(data)
    twist = data.motion.twist
    assert twist is not None
    dead = without_bias(data.inertial, nodes, states)
    all_of_them = replace(data, slipped=NO_VELOCITIES)
    carried = carry_to_nodes(all_of_them, nodes, dead, frozenset({"velocity"})).velocities
    if carried is None:
        return NO_VELOCITIES, final
    measured, of = carried.velocity_imu, (carried.delay_s, data.gravity_m_s2, data.speed_scale)
    residuals = velocity_residuals(states, carried.nodes, measured, *of)
    roots = velocity_roots(data, carried)
    off = np.einsum("nij,nj->ni", roots, residuals)
    per_m_s = np.median(np.linalg.norm(roots, axis=2), axis=0)
    if data.speed_alone:
        off, per_m_s = off[:, :1], per_m_s[:1]
    speeds = [np.linalg.norm(v, axis=1) for v in (measured + residuals, measured)]
    moving = np.maximum(*speeds) > STANDING_M_S  # wheels that lock read zero
    if moving.sum() < FEWEST_SPEEDS:
        return NO_VELOCITIES, final
    middle = np.median(off[moving], axis=0)
    scatter = MAD * np.median(np.abs(off[moving] - middle), axis=0)
    least_m_s = max(LEAST_SCATTER_M_S, STEP_PART * _step_m_s(twist.velocity[:, 0]))
    squares = np.sum(((off - middle) / np.maximum(scatter, least_m_s * per_m_s)) ** 2, axis=1)
    squares = np.where(moving, squares, 0.0)
    limit = next_limit(squares, limit, final)
    # A large slip bends all that is near: of these the worst first.
    most = float(np.quantile(squares[moving], 1.0 - MOST_SLIPPED))
    if limit == final and most > final:
        return NO_VELOCITIES, final
    wrong = squares > max(limit, most)
    stamps = np.asarray(twist.stamps_ns) - data.about_late_ns
    inside = (stamps >= nodes[0]) & (stamps <= nodes[-1])
    of_wrong = np.isin(nearest_node(nodes, stamps), carried.nodes[wrong])
    return np.flatnonzero(inside & of_wrong & np.isfinite(twist.velocity).all(axis=1)), limit


def _step_m_s(speeds: Array) -> float:
    """Smallest step between speeds (n,); 0 for less than three of them."""
    distinct = np.unique(np.round(speeds[np.isfinite(speeds)], 4))
    return float(np.diff(distinct).min()) if len(distinct) > 2 else 0.0
