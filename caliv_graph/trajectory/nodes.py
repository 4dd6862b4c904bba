"""The nodes of the graph, and all measurements carried to them."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass, replace

import numpy as np

from caliv_graph.products import Array, IntArray
from caliv_graph.readers.common_stamps import MERGE_NS, without_neighbours
from caliv_graph.trajectory.antennas import NodeDirections, directions_at_nodes
from caliv_graph.trajectory.imu import DeadReckoning, Inertial
from caliv_graph.trajectory.inputs import GNSS_CLOCK, IMU_CLOCK, TWIST_CLOCK, SmootherInput
from caliv_graph.trajectory.measurements import (
    NodeOrientations,
    NodePositions,
    NodeVelocities,
    orientations_at_nodes,
    positions_at_nodes,
    velocities_at_nodes,
)
from caliv_graph.trajectory.noise import orientation_covariances, velocity_covariances
from caliv_graph.trajectory.wheels import forward_alone, wheel_covariances

NODE_SPACING_S = 0.1
"""Largest distance of two nodes on drives of up to `FINE_NODES` of them. A GNSS fix is then carried
by at most 0.05 s: the noise of the IMU over it, 0.03 mm at the paper's figures, is far below that
of the fix."""

FINE_NODES = 1200
"""Two minutes. On longer drives the spacing grows with the length, up to `COARSE_SPACING_S`, so
that time and memory stay bounded."""

COARSE_SPACING_S = 0.5
"""Largest distance of two nodes on any drive."""


@dataclass(frozen=True)
class NodeMeasurements:
    """All measurements at the nodes; None: the drive has none of the kind."""

    positions: NodePositions | None
    orientations: NodeOrientations | None
    velocities: NodeVelocities | None
    headings: NodeDirections | None = None
    baselines: NodeDirections | None = None


def place_nodes(inertial: Inertial, wanted: IntArray) -> IntArray:
    """Stamps (n,) of the nodes.

    A node is at every `wanted` stamp (m,) (ascending, more than `MERGE_NS` apart, within the
    samples) or within `MERGE_NS` of it, at both ends, and at the ends of gaps; further nodes lie
    evenly between them.
    """
    begin, end = inertial.begin_ns, inertial.end_ns
    fixed = np.unique(np.concatenate([wanted, [begin, end], inertial.gaps_ns.ravel()]))
    fixed = without_neighbours(fixed, MERGE_NS)
    if end - fixed[-1] <= MERGE_NS:
        fixed[-1] = end  # the span must not end before a stamp that lies within it
    duration_s = (end - begin) * 1e-9
    spacing_s = min(max(NODE_SPACING_S, duration_s / FINE_NODES), COARSE_SPACING_S)
    parts = np.maximum(np.ceil(np.diff(fixed) * 1e-9 / spacing_s - 1e-3), 1).astype(np.int64)
    pieces = [
        a + (np.arange(n) * (b - a)) // n
        for a, b, n in zip(fixed[:-1].tolist(), fixed[1:].tolist(), parts.tolist(), strict=True)
    ]
    return np.concatenate([*pieces, fixed[-1:]]).astype(np.int64)


CARRIED = frozenset({"gnss", "orientation", "velocity", "heading", "baseline"})
"""Kinds of measurements that are carried to nodes."""


def carry_to_nodes(
    data: SmootherInput, nodes: IntArray, dead: DeadReckoning, kinds: Set[str] = CARRIED
) -> NodeMeasurements:
    """Carries the measurements of some kinds to their nearest nodes; `dead`: IMU without bias."""
    positions = orientations = velocities = None
    gnss_late, imu_late = (data.late_ns.get(clock, 0) for clock in (GNSS_CLOCK, IMU_CLOCK))
    if data.positions is not None and "gnss" in kinds:
        positions = positions_at_nodes(data.positions, nodes, dead, data.arm_imu, gnss_late)
    if data.orientation and "orientation" in kinds:
        assert data.motion.imu is not None
        cov, _ = orientation_covariances(data.motion.imu, data.config)
        cov = cov * data.scales.get("orientation", 1.0) ** 2
        orientations = orientations_at_nodes(
            data.motion.imu, cov, nodes, dead, data.noise, imu_late
        )
        if orientations is not None and data.slow_orientation_rad:
            slow = data.slow_orientation_rad**2 * np.eye(3)
            orientations = replace(orientations, cov=orientations.cov + slow)
    if data.motion.twist is not None and "velocity" in kinds:
        velocities = velocities_at_nodes(
            data.motion.twist,
            _velocity_covariances(data),
            nodes,
            dead,
            data.noise,
            data.T_vehicle_twist.between(data.T_vehicle_imu),
            data.speed_scale,
            data.late_ns.get(TWIST_CLOCK, 0) if data.wheels is None else imu_late,
            data.axle_slip,
            forward_alone(data.motion.twist) if data.speed_alone else None,
            data.slipped,
            data.about_late_ns,
        )
    headings = baselines = None
    if data.headings is not None and "heading" in kinds:
        headings = directions_at_nodes(
            data.headings.stamps_ns, data.heading_imu, nodes, dead, gnss_late
        )
    if data.baselines is not None and "baseline" in kinds:
        baselines = directions_at_nodes(
            data.baselines.stamps_ns, data.baseline_imu, nodes, dead, gnss_late
        )
    return NodeMeasurements(positions, orientations, velocities, headings, baselines)


def _velocity_covariances(data: SmootherInput) -> Array:
    """(n, 3, 3) (m/s)^2 of the velocities, in their axes, scaled as the data ask for."""
    twist = data.motion.twist
    assert twist is not None
    axes = np.array([data.scales.get("speed", 1.0), 1.0, 1.0])
    if data.wheels is not None:
        cov, _ = wheel_covariances(twist, data.wheels, data.config)
    else:
        cov, _ = velocity_covariances(twist, data.config)
        if data.speed_alone:
            cov = cov * np.eye(3)  # zeros beside the forward velocity are correlated with nothing
    # Of planar velocities `speed` is estimated in the place of `velocity`.
    axes = data.scales.get("velocity", 1.0) * axes
    return np.asarray(cov * np.outer(axes, axes))
