"""Predicts the joint covariance of the vehicle's poses along a planned drive.

The chain of states is that of `trajectory` (pose and velocity of the IMU, its biases) with the same
factors, linearised along the planned drive. No measurement is drawn and nothing is optimised, so
this takes milliseconds. Errors of poses that are near in time are correlated. The chain gives this
correlation, and the extrinsics depend on relative errors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from caliv_graph.config.noise import NoiseConfig
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.geometry.se3 import skew
from caliv_graph.planning.assumptions import Source
from caliv_graph.products import Array, IntArray
from caliv_graph.scenario.drives import Route, sample_stamps
from caliv_graph.scenario.model import Scenario
from caliv_graph.trajectory.chain import POSE, STATE
from caliv_graph.trajectory.measurements import nearest_node
from caliv_graph.trajectory.noise import DEFAULT_FORCE_WALK_M_S3, DEFAULT_GYRO_WALK_RAD_S2

NODE_NS = NANOSECONDS_PER_SECOND // 10
"""Largest distance of two nodes, as in `trajectory.nodes`."""

MERGE_NS = 1_000_000
"""Stamps that are nearer to each other share a node."""

SUBSTEPS = 10
"""Steps of the IMU's error propagation from node to node: one per sample at 100 Hz."""

LOOSE_RAD = 1.0
"""Prior sigma of the first orientation. It keeps the matrices regular."""

LEAST_SIGMA = 1e-6
"""Sigma that replaces zero, in the unit of the measurement."""


@dataclass(frozen=True)
class PlannedMotion:
    """The vehicle along a planned drive, and the information of its sensors on its states.

    The states are those of `trajectory.chain`: right perturbation of T_map_imu (rotation, then
    translation), velocity in the map, biases. With given poses the last nine are unused.

    Attributes:
        nodes_ns: (n,) stamps since the start of the drive.
        R_map_vehicle: (n, 3, 3).
        position_map: (n, 3) metres.
        twist: (n, 6) velocity of the vehicle, a right perturbation of T_map_vehicle per second.
        to_vehicle: (6, 6) from a right perturbation of T_map_imu to one of T_map_vehicle.
        diagonal: (n, 15, 15) information on each state.
        coupling: (n - 1, 15, 15) between a state (rows) and the next (columns).
    """

    nodes_ns: IntArray
    R_map_vehicle: Array
    position_map: Array
    twist: Array
    to_vehicle: Array
    diagonal: Array
    coupling: Array

    def nodes_of(self, stamps_ns: IntArray) -> IntArray:
        """(m,) index of the node nearest to each stamp."""
        return nearest_node(self.nodes_ns, stamps_ns)


def plan_motion(
    drive: Route,
    scenario: Scenario,
    stamps_ns: IntArray,
    source: Source,
    spacing_ns: int = NODE_NS,
) -> PlannedMotion:
    """The chain of states along a drive, with the information of the motion data.

    Args:
        drive: the drive.
        scenario: sensors and their noise.
        stamps_ns: (m,) stamps of LiDAR scans since the start; each gets a node.
        source: raw sensors, or given poses.
        spacing_ns: largest distance of two nodes.
    """
    nodes = _nodes(drive, stamps_ns, source, spacing_ns)
    states = drive.states(nodes, scenario.world.ground.height_m)
    R = states.R_map_vehicle
    twist = np.hstack([states.angular_velocity, np.einsum("nji,nj->ni", R, states.velocity_map)])
    T_vehicle_imu = scenario.imu.mounting.pose()
    if source == "poses":
        diagonal, coupling = _given_poses(nodes, R, scenario)
        to_vehicle = np.eye(POSE)
    else:
        R_vi, t_vi = T_vehicle_imu.rotation().matrix(), T_vehicle_imu.translation()
        diagonal, coupling = _inertial(drive, nodes, scenario, R_vi, t_vi)
        _add_aiding(diagonal, drive, nodes, scenario)
        to_vehicle = np.asarray(T_vehicle_imu.AdjointMap(), dtype=np.float64)
    return PlannedMotion(nodes, R, states.position_map, twist, to_vehicle, diagonal, coupling)


def _nodes(drive: Route, stamps_ns: IntArray, source: Source, spacing_ns: int) -> IntArray:
    end = round(drive.duration_s * NANOSECONDS_PER_SECOND)
    grid = np.arange(0, end + 1, spacing_ns, dtype=np.int64)
    # Given poses exist only at the stamps; more nodes would add information.
    fixed = np.unique(stamps_ns) if source == "poses" else np.unique(np.append(stamps_ns, [0, end]))
    if source == "poses":
        return fixed if len(fixed) > 1 else np.unique(np.append(fixed, [0, end]))
    fixed = fixed[np.concatenate([[True], np.diff(fixed) > MERGE_NS])]
    extra = grid[np.abs(grid - fixed[nearest_node(fixed, grid)]) > spacing_ns // 2]
    return np.unique(np.append(fixed, extra))


def _given_poses(nodes: IntArray, R: Array, scenario: Scenario) -> tuple[Array, Array]:
    """White errors on each pose, and a random walk in the coordinates 6 to 11 of the states."""
    model, n = scenario.poses, len(nodes)
    white = np.maximum([model.rotation_sigma_rad] * 3 + [model.position_sigma_m] * 3, LEAST_SIGMA)
    walk = np.array([model.rotation_walk_rad_sqrts] * 3 + [model.position_walk_m_sqrts] * 3)
    # The walk is in map axes; the perturbation of the pose is in vehicle axes.
    J = np.zeros((n, 6, STATE))
    J[:, :, :6] = np.eye(6)
    J[:, :3, 6:9] = J[:, 3:, 9:12] = -np.swapaxes(R, 1, 2)
    diagonal = np.swapaxes(J, 1, 2) @ ((white**-2.0)[:, None] * J)
    unused = np.arange(12, STATE)
    diagonal[:, unused, unused] = 1.0
    steps = np.maximum(
        walk * np.sqrt(np.diff(nodes) / NANOSECONDS_PER_SECOND)[:, None], LEAST_SIGMA
    )
    walks = np.arange(6, 12)
    coupling = np.zeros((n - 1, STATE, STATE))
    coupling[:, walks, walks] = -(steps**-2.0)
    diagonal[0, walks, walks] += LEAST_SIGMA**-2.0
    diagonal[1:, walks, walks] += steps**-2.0
    diagonal[:-1, walks, walks] += steps**-2.0
    return diagonal, coupling


def _inertial(
    drive: Route, nodes: IntArray, scenario: Scenario, R_vehicle_imu: Array, arm: Array
) -> tuple[Array, Array]:
    """Diagonal and coupling of the IMU's information between neighbouring nodes."""
    n = len(nodes)
    carried, cov = _propagated(drive, nodes, scenario, R_vehicle_imu, arm)
    # From map axes to the axes of the right perturbation.
    turn = np.broadcast_to(np.eye(STATE), (n, STATE, STATE)).copy()
    R_all = drive.states(nodes).R_map_vehicle @ R_vehicle_imu
    turn[:, 3:6, 3:6] = np.swapaxes(R_all, 1, 2)
    carried = turn[1:] @ carried @ np.swapaxes(turn[:-1], 1, 2)
    cov = turn[1:] @ cov @ np.swapaxes(turn[1:], 1, 2)
    scale = np.sqrt(np.einsum("nii->ni", cov))
    even = scale[:, :, None] * scale[:, None, :]
    info = np.linalg.inv(cov / even) / even
    back = np.swapaxes(carried, 1, 2) @ info
    diagonal = np.zeros((n, STATE, STATE))
    diagonal[:-1] += back @ carried
    diagonal[1:] += info
    noise_defaults = NoiseConfig()
    bias = np.repeat(
        [noise_defaults.accelerometer_bias_m_s2, noise_defaults.gyroscope_bias_rad_s], 3
    )
    at_bias = np.arange(9, STATE)
    diagonal[0, at_bias, at_bias] += bias**-2.0
    return diagonal, -back


def _propagated(
    drive: Route, nodes: IntArray, scenario: Scenario, R_vehicle_imu: Array, arm: Array
) -> tuple[Array, Array]:
    """Error-state propagation of the IMU between neighbouring nodes, with white noise.

    With b the biases, f the specific force and w the rate, both of the IMU:
    `dR/dt = -w x dR - b_g`, `dp/dt = dv`, `dv/dt = -R (f x dR) - R b_a`.

    Returns:
        (n - 1, 15, 15) transition matrices and (n - 1, 15, 15) covariances, map axes.
    """
    n = len(nodes)
    imu = scenario.imu
    step = np.diff(nodes) / (SUBSTEPS * NANOSECONDS_PER_SECOND)
    per_root_s = 1.0 / math.sqrt(imu.rate_hz)
    # The defaults that apply to the config of `simulate` apply here too.
    force_walk = imu.accelerometer_bias_walk_m_s3_sqrthz or DEFAULT_FORCE_WALK_M_S3
    gyro_walk = imu.gyroscope_bias_walk_rad_s2_sqrthz or DEFAULT_GYRO_WALK_RAD_S2
    density = np.zeros(STATE)
    density[0:3] = max(imu.gyroscope_sigma_rad_s * per_root_s, LEAST_SIGMA) ** 2
    density[6:9] = max(imu.accelerometer_sigma_m_s2 * per_root_s, LEAST_SIGMA) ** 2
    density[9:12], density[12:15] = force_walk**2, gyro_walk**2
    at_step = np.rint((np.arange(SUBSTEPS)[:, None] + 0.5) * step * NANOSECONDS_PER_SECOND)
    at = drive.states((nodes[:-1] + at_step.astype(np.int64)).ravel())
    R = at.R_map_vehicle @ R_vehicle_imu
    rate = at.angular_velocity
    felt = at.acceleration_map + np.array([0.0, 0.0, scenario.gravity_m_s2])
    force = np.einsum("nji,nj->ni", at.R_map_vehicle, felt)
    force += np.cross(rate, np.cross(rate, arm))
    turned, pushed = -skew(rate @ R_vehicle_imu), -R @ skew(force @ R_vehicle_imu)
    carried = np.broadcast_to(np.eye(STATE), (n - 1, STATE, STATE))
    cov = np.zeros((n - 1, STATE, STATE))
    for k in range(SUBSTEPS):
        own = slice(k * (n - 1), (k + 1) * (n - 1))
        whole, half = _transitions(turned[own], pushed[own], R[own], step)
        noise = (half * (density * step[:, None])[:, None]) @ np.swapaxes(half, 1, 2)
        carried = whole @ carried
        cov = whole @ cov @ np.swapaxes(whole, 1, 2) + noise
    return carried, cov


def _transitions(turned: Array, pushed: Array, R: Array, step_s: Array) -> tuple[Array, Array]:
    """(n, 15, 15) `I + F h + (F h)^2 / 2` over steps h (n,) seconds, and `I + F h / 2`.

    F is the derivative of the rates of the errors of rotation, position, velocity, specific force
    and angular rate. `turned` and `pushed` (n, 3, 3) are its blocks of rotation and of velocity by
    rotation, `R` is R_map_imu; the other blocks are 0, 1 or -1. Most blocks of F and of its square
    are zero.
    """
    n, h = len(step_s), step_s[:, None, None]
    A, B, C = turned * h, pushed * h, -R * h
    eye = np.eye(3)
    whole = np.broadcast_to(np.eye(STATE), (n, STATE, STATE)).copy()
    half = whole.copy()
    for out, part in ((whole, 1.0), (half, 0.5)):
        out[:, 0:3, 0:3] += part * A
        out[:, 0:3, 12:15] = -part * h * eye
        out[:, 3:6, 6:9] = part * h * eye
        out[:, 6:9, 0:3] = part * B
        out[:, 6:9, 9:12] = part * C
    whole[:, 0:3, 0:3] += 0.5 * A @ A
    whole[:, 0:3, 12:15] -= 0.5 * h * A
    whole[:, 3:6, 0:3] = 0.5 * h * B
    whole[:, 3:6, 9:12] = 0.5 * h * C
    whole[:, 6:9, 0:3] += 0.5 * B @ A
    whole[:, 6:9, 12:15] = -0.5 * h * B
    return whole, half


def _add_aiding(diagonal: Array, drive: Route, nodes: IntArray, scenario: Scenario) -> None:
    """Adds GNSS, orientation and velocity, each sample at its nearest node."""
    states = drive.states(nodes)
    T_vehicle_imu = scenario.imu.mounting.pose()
    R_vi = T_vehicle_imu.rotation().matrix()
    R = states.R_map_vehicle @ R_vi
    R_back = np.swapaxes(R, 1, 2)
    n = len(nodes)
    gnss, imu, velocity = scenario.gnss, scenario.imu, scenario.velocity
    if gnss.enabled:
        sigma = np.maximum(
            [gnss.horizontal_sigma_m, gnss.horizontal_sigma_m, gnss.vertical_sigma_m], LEAST_SIGMA
        )
        arm = np.asarray(T_vehicle_imu.transformTo(np.array(gnss.lever_arm)))
        J = np.zeros((n, 3, POSE))
        J[:, :, :3] = -R @ skew(arm)
        J[:, :, 3:] = R
        fixes = np.bincount(nearest_node(nodes, _good_fixes(drive, scenario)), minlength=n)
        # The smoother drops outliers; the remaining fixes count.
        weight = fixes * (1.0 - gnss.outlier_probability)
        info = np.swapaxes(J, 1, 2) @ ((sigma**-2.0)[:, None] * J)
        diagonal[:, :POSE, :POSE] += weight[:, None, None] * info
    else:
        # The origin of the map is the vehicle's start.
        position = np.arange(3, POSE)
        diagonal[0, position, position] += LEAST_SIGMA**-2.0
    rotation = np.arange(3)
    diagonal[0, rotation, rotation] += LOOSE_RAD**-2.0
    if not gnss.enabled and not imu.orientation.enabled:
        up = R_back[0, :, 2]
        diagonal[0, :3, :3] += LEAST_SIGMA**-2.0 * np.outer(up, up)
    if imu.orientation.enabled:
        count = _count(nodes, drive, "imu", imu.rate_hz, imu.phase_s)
        info = max(imu.orientation.sigma_rad, LEAST_SIGMA) ** -2.0
        diagonal[:, rotation, rotation] += (count * info)[:, None]
    if velocity.enabled:
        count = _count(nodes, drive, "velocity", velocity.rate_hz, velocity.phase_s)
        at_imu = states.velocity_map + np.einsum(
            "nij,nj->ni",
            states.R_map_vehicle,
            np.cross(states.angular_velocity, T_vehicle_imu.translation()),
        )
        J = np.zeros((n, 3, STATE))
        J[:, :, :3] = skew(np.einsum("nij,nj->ni", R_back, at_imu))
        J[:, :, 6:9] = R_back
        weight = count * max(velocity.sigma_m_s, LEAST_SIGMA) ** -2.0
        diagonal += weight[:, None, None] * (np.swapaxes(J, 1, 2) @ J)


def _count(
    nodes: IntArray, drive: Route, what: str, rate_hz: float, phase_s: float
) -> npt.NDArray[np.int64]:
    """(n,) number of samples nearest to each node."""
    stamps = sample_stamps(what, rate_hz, phase_s, drive.duration_s)
    return np.asarray(np.bincount(nearest_node(nodes, stamps), minlength=len(nodes)))


def _good_fixes(drive: Route, scenario: Scenario) -> IntArray:
    """Stamps of the fixes without those in a jump, which the smoother drops."""
    gnss = scenario.gnss
    stamps = sample_stamps("gnss", gnss.rate_hz, gnss.phase_s, drive.duration_s)
    time_s = stamps / NANOSECONDS_PER_SECOND
    good = np.ones(len(stamps), dtype=np.bool_)
    bad = [(o.start_s, o.duration_s) for o in gnss.outages]
    bad += [(j.start_s, j.duration_s) for j in gnss.jumps]
    for start_s, duration_s in bad:
        good &= (time_s < start_s) | (time_s >= start_s + duration_s)
    return np.asarray(stamps[good])
