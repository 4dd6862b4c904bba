"""Speeds of wheels that slip for a moment: they are left out (`README.md`, section 7)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from caliv_graph.common.statistics import MAD
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.build import Estimate, velocity_roots
from caliv_graph.trajectory.inputs import SmootherInput
from caliv_graph.trajectory.measurements import NO_VELOCITIES, nearest_node
from caliv_graph.trajectory.nodes import carry_to_nodes
from caliv_graph.trajectory.outliers import OUTLIER_P_VALUE, Robust, solve_without_outliers
from caliv_graph.trajectory.states import States, without_bias
from caliv_graph.trajectory.variances import SCALE_BOUNDS

MOST_SLIPPED = 0.2
"""Part of the nodes in motion. If the speeds of more lie apart, they have no common noise, and none
of them is an outlier."""

FEWEST_SPEEDS = 20
"""Nodes in motion from which the scatter of their speeds is known."""

STANDING_M_S = 0.1
"""Slower wheels stand: they do not slip, and their speeds scatter less."""

SLIP_ROUNDS = 4
"""Of leaving out: beside a slip, sound speeds seem off until it is gone, and slighter ones show."""


def solve_without_slips(
    data: SmootherInput, nodes: IntArray, states: States
) -> tuple[Robust, Estimate]:
    """`solve_without_outliers`, and without speeds that all others do not explain.

    What a speed is off by is compared with the scatter of all, whatever noise is stated.
    """
    robust, estimate = solve_without_outliers(data, nodes, states)
    if data.wheels is not None or data.config.robust.kernel == "none":
        return robust, estimate  # without an IMU, speeds are what all others are compared with
    for _ in range(SLIP_ROUNDS):
        found = _slipped(robust.data, nodes, estimate.states)
        if np.array_equal(found, robust.data.slipped):
            break
        states, warnings = estimate.states, robust.warnings
        del estimate  # its graph: 4 MB per minute of drive
        data = replace(robust.data, slipped=found)
        robust, estimate = solve_without_outliers(data, nodes, states)
        robust = replace(robust, warnings=(*warnings, *robust.warnings))
    return robust, estimate


def slip_warnings(data: SmootherInput) -> list[str]:
    """A line if speeds were left out."""
    twist, count = data.motion.twist, len(data.slipped)
    if twist is None or not count:
        return []
    at = np.asarray(twist.stamps_ns)[data.slipped] * 1e-9
    return [
        f"{data.name}: {count} of {len(twist.stamps_ns)} speeds disagree with the motion, left "
        f"out: the first {at[0] - twist.stamps_ns[0] * 1e-9:.1f} s after the first speed, as of "
        "wheels that slip"
    ]


def _slipped(data: SmootherInput, nodes: IntArray, states: States) -> IntArray:
    """Indices of the messages whose speeds an estimate does not explain."""
    none = NO_VELOCITIES
    if data.motion.twist is None:
        return none
    all_of_them = replace(data, slipped=none)
    dead = without_bias(data.inertial, nodes, states)
    carried = carry_to_nodes(all_of_them, nodes, dead, frozenset({"velocity"})).velocities
    if carried is None:
        return none
    R = states.R_map_imu[carried.nodes]
    V = states.velocity_map[carried.nodes]
    falling = -data.gravity_m_s2 * np.einsum("nij,nj->ni", carried.delay_s, R[:, 2, :])
    expected = data.speed_scale * (np.einsum("nji,nj->ni", R, V) + falling)
    off = np.einsum("nij,nj->ni", velocity_roots(data, carried), expected - carried.velocity_imu)
    if data.speed_alone:
        off = off[:, :1]
    moving = np.linalg.norm(carried.velocity_imu, axis=1) > STANDING_M_S
    wrong = moving & (_squares(off, moving) > float(chdtri(off.shape[1], OUTLIER_P_VALUE)))
    if moving.sum() < FEWEST_SPEEDS or wrong.sum() > MOST_SLIPPED * moving.sum():
        return none
    stamps = np.asarray(data.motion.twist.stamps_ns) - data.about_late_ns
    inside = (stamps >= nodes[0]) & (stamps <= nodes[-1])
    of_wrong = np.isin(nearest_node(nodes, stamps), carried.nodes[wrong])
    return np.flatnonzero(inside & of_wrong)


def _squares(off: Array, moving: Array) -> Array:
    """(m,) squares of residuals (m, k) in units of what those of `moving` (m,) scatter by."""
    if not moving.any():
        return np.zeros(len(off))
    middle = np.median(off[moving], axis=0)
    scatter = MAD * np.median(np.abs(off[moving] - middle), axis=0)
    return np.asarray(np.sum(((off - middle) / np.maximum(scatter, SCALE_BOUNDS[0])) ** 2, axis=1))
