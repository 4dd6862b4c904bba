"""Measurements carried to the nearest node of the trajectory by the IMU (`README.md`, section 3).

Orientations and velocities around a node are averaged with their weights. GNSS fixes are not, since
each may be an outlier.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import gtsam
import numpy as np

from caliv_graph.geometry.se3 import cross
from caliv_graph.products import Array, BoolArray, ImuSamples, IntArray, TwistSamples
from caliv_graph.trajectory.gnss import Positions
from caliv_graph.trajectory.imu import DeadReckoning, exp_so3, interpolate, log_so3
from caliv_graph.trajectory.noise import ImuNoise
from caliv_graph.trajectory.wheels import UNMEASURED_M_S

NO_VELOCITIES: IntArray = np.zeros(0, np.int64)

SAMPLES_AT_A_TIME = 16_384
"""Of the IMU, whose orientations are carried to their nodes at once: 16 MB."""


@dataclass(frozen=True)
class NodeOrientations:
    """One orientation per node that has any.

    Attributes:
        nodes: (m,) indices.
        R_map_imu: (m, 3, 3).
        cov: (m, 3, 3) rad^2, right perturbation (imu axes).
    """

    nodes: IntArray
    R_map_imu: Array
    cov: Array


@dataclass(frozen=True)
class NodeVelocities:
    """One velocity of the IMU's origin per node that has any; see `velocity_factor`.

    Attributes:
        nodes: (m,) indices.
        velocity_imu: (m, 3) m/s in the IMU's axes at the node.
        delay_s: (m, 3, 3) mean time of the measurements after the node, weighted as they are: where
            each measures the forward velocity, along axes that turn, not the same in all axes.
        cov: (m, 3, 3) (m/s)^2, the same axes.
    """

    nodes: IntArray
    velocity_imu: Array
    delay_s: Array
    cov: Array


@dataclass(frozen=True)
class NodePositions:
    """Fixes, and the IMU's motion between each and its node; see `position_factor`.

    Attributes:
        nodes: (m,) indices, one per fix.
        fixes: (m,) index of each into the positions it was made from.
        position_map: (m, 3) metres, of the antenna.
        offset_imu: (m, 3) metres in the IMU's axes at the node.
        delay_s: (m,) of the fix after the node.
        cov_map: (m, 3, 3) m^2.
    """

    nodes: IntArray
    fixes: IntArray
    position_map: Array
    offset_imu: Array
    delay_s: Array
    cov_map: Array


def nearest_node(nodes_ns: IntArray, stamps_ns: IntArray) -> IntArray:
    """(m,) index of the nearest of (n,) ascending nodes, the later of two equally near ones."""
    middles = nodes_ns[:-1] + (np.diff(nodes_ns) + 1) // 2
    return np.asarray(np.searchsorted(middles, stamps_ns, "right"), dtype=np.int64)


def rotated(R: Array, cov: Array) -> Array:
    """`R cov R^T` of (m, 3, 3) each."""
    return np.asarray(R @ cov @ np.swapaxes(R, 1, 2))


def _weighted_mean(group: IntArray, values: Array, cov: Array) -> tuple[IntArray, Array, Array]:
    """Groups (g,); means (g, 3, c) of (m, 3, c) vectors, weighted by `cov` (m, 3, 3); their cov."""
    if (np.diff(group) < 0).any():
        order = np.argsort(group, kind="stable")
        group, values, cov = group[order], values[order], cov[order]
    starts = np.flatnonzero(np.diff(group, prepend=group[0] - 1))
    groups = group[starts]
    weight = np.linalg.inv(cov)
    information = np.add.reduceat(weight, starts)
    moment = np.add.reduceat(weight @ values, starts)
    mean_cov = np.linalg.inv(information)
    return np.asarray(groups), np.asarray(mean_cov @ moment), np.asarray(mean_cov)


def orientations_at_nodes(
    imu: ImuSamples,
    cov: Array,
    nodes_ns: IntArray,
    dead: DeadReckoning,
    noise: ImuNoise,
    late_ns: int = 0,
) -> NodeOrientations | None:
    """Averages the IMU's orientations around each node; None if there are none.

    `cov` (n, 3, 3) rad^2 is that of each message, `dead` the IMU without bias, `late_ns` the stamps
    less the true times.
    """
    if imu.orientation_xyzw is None:
        return None
    usable = usable_orientations(imu)
    usable &= (imu.stamps_ns >= nodes_ns[0]) & (imu.stamps_ns <= nodes_ns[-1])
    samples = np.flatnonzero(usable)
    if not len(samples):
        return None
    node = nearest_node(nodes_ns, np.asarray(imu.stamps_ns, dtype=np.int64)[samples])
    # In parts of whole nodes: a sample takes a kilobyte here, too much on a long drive.
    starts = np.flatnonzero(np.diff(node, prepend=-1))
    some = np.unique(starts // SAMPLES_AT_A_TIME, return_index=True)[1]
    cuts = [*starts[some].tolist(), len(samples)]
    parts = [
        _oriented(imu, cov, nodes_ns, dead, noise, samples[a:b], node[a:b], late_ns)
        for a, b in itertools.pairwise(cuts)
    ]
    return NodeOrientations(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _oriented(
    imu: ImuSamples,
    cov: Array,
    nodes_ns: IntArray,
    dead: DeadReckoning,
    noise: ImuNoise,
    samples: IntArray,
    node: IntArray,
    late_ns: int,
) -> tuple[IntArray, Array, Array]:
    """`NodeOrientations` of some samples (m,) that carry one; `node` (m,) is theirs."""
    assert imu.orientation_xyzw is not None
    stamps = np.asarray(imu.stamps_ns, dtype=np.int64)[samples] - late_ns
    R = rotations_of(imu.orientation_xyzw[samples])
    at_node = nodes_ns[node]
    dR, _, _ = dead.between(stamps, at_node)
    R_node = R @ dR
    late_s = np.abs(stamps - at_node) * 1e-9
    cov_node = rotated(np.swapaxes(dR, 1, 2), cov[samples])
    cov_node = cov_node + late_s[:, None, None] * noise.gyro_density
    # Averaged in the tangent space at the sample nearest to the node.
    order = np.lexsort((late_s, node))
    _, first = np.unique(node[order], return_index=True)
    reference = np.zeros(len(nodes_ns), dtype=np.int64)
    reference[node[order][first]] = order[first]
    R_reference = R_node[reference[node]]
    differences = log_so3(np.swapaxes(R_reference, 1, 2) @ R_node)
    nodes, mean, mean_cov = _weighted_mean(node, differences[:, :, None], cov_node)
    return nodes, R_node[reference[nodes]] @ exp_so3(mean[:, :, 0]), mean_cov


def usable_orientations(imu: ImuSamples) -> BoolArray:
    """(n,) bool: which messages carry an orientation."""
    if imu.orientation_xyzw is None:
        return np.zeros(len(imu.stamps_ns), dtype=bool)
    norms = np.linalg.norm(imu.orientation_xyzw, axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(norms - 1.0) < 0.1)


def rotations_of(xyzw: Array) -> Array:
    """(n, 3, 3) of (n, 4) quaternions x y z w."""
    x, y, z, w = (xyzw / np.linalg.norm(xyzw, axis=1, keepdims=True)).T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], axis=1),
            np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], axis=1),
            np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=1),
        ],
        axis=1,
    )


def velocities_at_nodes(
    twist: TwistSamples,
    cov: Array,
    nodes_ns: IntArray,
    dead: DeadReckoning,
    noise: ImuNoise,
    T_twist_imu: gtsam.Pose3,
    scale: float = 1.0,
    late_ns: int = 0,
    slip_s2_m: float = 0.0,
    alone: BoolArray | None = None,
    left_out: IntArray = NO_VELOCITIES,
    about_late_ns: int = 0,
) -> NodeVelocities | None:
    """Averages the velocities around each node; None if there are none.

    They are those of the origin of the twist's frame, mostly the vehicle's; `scale` is measured
    over true ones, `late_ns` the stamps less the true times. The lever to the IMU enters with the
    gyroscope's rate and its noise. `slip_s2_m` is the side slip of an axle, radians per m/s^2 of
    lateral acceleration, to the outside of a curve. `alone` (n,) are the messages of which only the
    forward velocity is measured; None: none. `left_out` (k,) are indices of messages. A message
    belongs to the node nearest to its stamp less `about_late_ns`.
    """
    usable = np.asarray(np.isfinite(twist.velocity).all(axis=1))
    usable[left_out] = False
    about = np.asarray(twist.stamps_ns, dtype=np.int64) - about_late_ns
    usable &= (about >= nodes_ns[0]) & (about <= nodes_ns[-1])
    if not usable.any():
        return None
    node = nearest_node(nodes_ns, about[usable])
    stamps = about[usable] + (about_late_ns - late_ns)
    T_imu_twist = T_twist_imu.inverse()
    R_imu_twist = T_imu_twist.rotation().matrix()
    arm = T_imu_twist.translation()
    rates = interpolate(stamps, dead.stamps_ns, dead.gyro)
    measured = twist.velocity[usable]
    if slip_s2_m:
        measured = measured.copy()
        ahead = measured[:, 0]
        measured[:, 1] -= slip_s2_m * np.abs(ahead) * ahead * (rates @ R_imu_twist)[:, 2]
    at_imu = measured @ R_imu_twist.T - scale * cross(rates, arm)
    sample_s = float(np.median(np.diff(dead.stamps_ns))) * 1e-9
    arm_cross = np.cross(np.eye(3), arm)
    arm_cov = arm_cross.T @ (noise.gyro_density / sample_s) @ arm_cross
    cov_imu = R_imu_twist @ cov[usable] @ R_imu_twist.T + arm_cov
    at_node = nodes_ns[node]
    dR, dv, _ = dead.between(at_node, stamps)
    delay_s = (stamps - at_node) * 1e-9
    carried = np.einsum("nij,nj->ni", dR, at_imu) - scale * dv
    cov_node = rotated(dR, cov_imu) + np.abs(delay_s)[:, None, None] * noise.force_density
    late = delay_s[:, None, None] * np.eye(3)
    values = np.dstack([carried[:, :, None], late])
    if alone is not None and alone[usable].any():
        own = alone[usable]
        ahead_node = (dR @ R_imu_twist)[own, :, 0]
        one = _forward_mean(node[own], ahead_node, values[own], cov_node[own])
        both = (node[~own], one[0]), (values[~own], one[1]), (cov_node[~own], one[2])
        node, values, cov_node = map(np.concatenate, both)
    nodes, mean, mean_cov = _weighted_mean(node, values, cov_node)
    return NodeVelocities(nodes, mean[:, :, 0], mean[:, :, 1:], mean_cov)


def _forward_mean(
    group: IntArray, ahead: Array, values: Array, cov: Array
) -> tuple[IntArray, Array, Array]:
    """Groups (g,) of forward velocities; what they measure (g, 3, c); its covariance (g, 3, 3).

    Each measures `ahead . v`. Of a group this is one number along the mean of the axes, and nothing
    beside it. The axes differ by what the vehicle turns meanwhile: solved for a whole velocity,
    they give it a lateral part of tens of metres per second, all noise, and what turns with it
    seems to be measured.

    Args:
        group: (m,) ascending.
        ahead: (m, 3) unit vectors along which the velocities are measured.
        values: (m, 3, c) vectors of which the parts along `ahead` are; the first is the velocity.
        cov: (m, 3, 3) (m/s)^2 of the first.
    """
    starts = np.flatnonzero(np.diff(group, prepend=group[0] - 1))
    weight = 1.0 / np.einsum("mi,mij,mj->m", ahead, cov, ahead)
    along = np.einsum("mi,mic->mc", ahead, values)
    total = np.add.reduceat(weight, starts)
    share = weight / np.repeat(total, np.diff(starts, append=len(group)))

    def mean(of: Array) -> Array:
        return np.asarray(np.add.reduceat(np.einsum("m,m...->m...", share, of), starts))

    axis = mean(ahead)
    length = np.linalg.norm(axis, axis=1)
    axis /= length[:, None]
    on_axis = axis[:, :, None] * axis[:, None, :]
    beside = np.eye(3) - on_axis
    forward = mean(along) / length[:, None]
    measured = axis[:, :, None] * forward[:, None, :] + beside @ mean(values)
    variance = 1.0 / (total * length**2)
    mean_cov = variance[:, None, None] * on_axis + UNMEASURED_M_S**2 * beside
    return group[starts], measured, mean_cov


def positions_at_nodes(
    positions: Positions,
    nodes_ns: IntArray,
    dead: DeadReckoning,
    arm_imu: Array,
    late_ns: int = 0,
) -> NodePositions | None:
    """Fixes within the trajectory and their nodes; None if there are none.

    `dead` is the IMU without bias, `arm_imu` (3,) the antenna in the imu frame, metres, `late_ns`
    the stamps less the true times.
    """
    stamps = positions.stamps_ns
    fixes = np.flatnonzero((stamps >= nodes_ns[0]) & (stamps <= nodes_ns[-1]))
    if not len(fixes):
        return None
    node = nearest_node(nodes_ns, stamps[fixes])
    at_node = nodes_ns[node]
    taken = stamps[fixes] - late_ns
    dR, _, dp = dead.between(at_node, taken)
    delay_s = np.asarray((taken - at_node) * 1e-9)
    position, cov = positions.position_map[fixes], positions.cov_map[fixes]
    return NodePositions(node, fixes, position, dp + dR @ arm_imu, delay_s, cov)
