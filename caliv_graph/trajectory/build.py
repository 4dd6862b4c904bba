"""The smoother's factor graph, and the conversion of estimates to GTSAM's values and back.

`README.md` of this folder defines the variables of a node and derives every factor.
"""

from __future__ import annotations

import math
from collections.abc import Set
from dataclasses import dataclass, field
from functools import lru_cache

import gtsam
import numpy as np

from caliv_graph.conventions import key_bias, key_imu, key_velocity, key_yaw_bias
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.antennas import NodeDirections
from caliv_graph.trajectory.factors import (
    baseline_factor,
    biased_orientation_factor,
    heading_factor,
    level_factor,
    orientation_factor,
    position_factor,
    velocity_factor,
)
from caliv_graph.trajectory.imu import DeadReckoning, preintegrate
from caliv_graph.trajectory.inputs import IMU_CLOCK, SmootherInput
from caliv_graph.trajectory.measurements import (
    NodeOrientations,
    NodePositions,
    NodeVelocities,
    nearest_node,
)
from caliv_graph.trajectory.nodes import carry_to_nodes
from caliv_graph.trajectory.standstill import standstills
from caliv_graph.trajectory.states import States, without_bias
from caliv_graph.trajectory.wheels import accelerations, level_sigmas, normal_of

GAUGE_M = 1e-4
GAUGE_RAD = 1e-4
"""1 sigma of the gauge prior on the first pose, without GNSS: far below what any sensor resolves,
and large enough that the graph stays well conditioned."""


UNMEASURED_M_S2 = 1e3
"""1 sigma of a bias that nothing measures: no information."""


@dataclass
class TrajectoryGraph:
    """The factors, the kind of each, of `KINDS`, and which fix each one of GNSS is."""

    factors: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    kinds: list[str] = field(default_factory=list)
    fixes: list[int] = field(default_factory=list)

    def add(self, kind: str, factor: gtsam.NonlinearFactor) -> None:
        """Appends a factor."""
        self.factors.add(factor)
        self.kinds.append(kind)

    def only(self, kinds: Set[str]) -> TrajectoryGraph:
        """The factors of some kinds, in order."""
        out = TrajectoryGraph()
        for number, kind in enumerate(self.kinds):
            if kind in kinds:
                out.add(kind, self.factors.at(number))
        out.fixes += self.fixes if "gnss" in kinds else []
        return out


KINDS = frozenset(
    {
        "imu",
        "gnss",
        "orientation",
        "velocity",
        "level",
        "heading",
        "baseline",
        "standstill",
        "prior",
    }
)
"""Kinds of the factors of a trajectory."""


def build_graph(
    data: SmootherInput,
    nodes: IntArray,
    states: States,
    dropped: IntArray,
    kernel: str,
    kinds: Set[str] = KINDS,
) -> TrajectoryGraph:
    """All factors; the measurements are integrated and carried with the biases of `states`.

    The GNSS fixes of indices `dropped` (k,) are left out. `kernel` is the robust kernel of the
    others; only `huber` changes the noise model. Factors of other kinds than `kinds` are left out.
    """
    graph = TrajectoryGraph()
    dead = without_bias(data.inertial, nodes, states)
    carried = carry_to_nodes(data, nodes, dead, kinds)
    if kinds & {"imu", "prior"}:
        _add_imu(graph, data, nodes, states)
    if "standstill" in kinds:
        _add_standstills(graph, data, nodes)
    if carried.positions is not None:
        _add_positions(graph, data, carried.positions, dropped, kernel)
    if carried.orientations is not None:
        _add_orientations(graph, data, carried.orientations)
    if carried.velocities is not None:
        _add_velocities(graph, data, carried.velocities)
    if carried.headings is not None:
        _add_headings(graph, data, carried.headings, kernel)
    if carried.baselines is not None:
        _add_baselines(graph, data, carried.baselines, kernel)
    if data.wheels is not None and "level" in kinds:
        _add_level(graph, data, nodes, dead)
    if data.positions is None:
        _add_gauge_prior(graph, data, states)
    return graph if kinds == KINDS else graph.only(kinds)


@dataclass(frozen=True)
class Estimate:
    """A solved graph, and the estimate.

    Attributes:
        states: the estimate.
        graph: the factors.
        values: the estimate, as values of the graph.
        built_with: whose biases integrated and carried the measurements of the graph.
    """

    states: States
    graph: TrajectoryGraph
    values: gtsam.Values
    built_with: States


def _add_imu(graph: TrajectoryGraph, data: SmootherInput, nodes: IntArray, states: States) -> None:
    """Preintegrated factors between neighbours, and the prior on the first bias."""
    noise = data.noise
    biases = [
        gtsam.imuBias.ConstantBias(f, w)
        for f, w in zip(states.force_bias, states.gyro_bias, strict=True)
    ]
    measurements = preintegrate(data.inertial, nodes, biases, noise, data.gravity_m_s2)
    for i, measured in enumerate(measurements):
        poses = key_imu(i), key_velocity(i), key_imu(i + 1), key_velocity(i + 1)
        factor = gtsam.CombinedImuFactor(*poses, key_bias(i), key_bias(i + 1), measured)
        graph.add("imu", factor)
    bias_sigmas = np.concatenate([noise.force_bias, noise.gyro_bias])
    model = gtsam.noiseModel.Diagonal.Sigmas(bias_sigmas)
    no_bias = gtsam.imuBias.ConstantBias()
    graph.add("prior", gtsam.PriorFactorConstantBias(key_bias(0), no_bias, model))


def _add_standstills(graph: TrajectoryGraph, data: SmootherInput, nodes: IntArray) -> None:
    """The bias of the gyroscope where the vehicle stands; that of the accelerometer stays free."""
    for found in standstills(data):
        if not nodes[0] <= found.middle_ns <= nodes[-1]:
            continue
        node = int(nearest_node(nodes, np.array([found.middle_ns]))[0])
        bias = gtsam.imuBias.ConstantBias(np.zeros(3), found.rate)
        sigmas = np.concatenate([np.full(3, UNMEASURED_M_S2), found.sigmas])
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        graph.add("standstill", gtsam.PriorFactorConstantBias(key_bias(node), bias, noise))


def _add_positions(
    graph: TrajectoryGraph,
    data: SmootherInput,
    positions: NodePositions,
    dropped: IntArray,
    kernel: str,
) -> None:
    keep = ~np.isin(positions.fixes, dropped)
    for k in np.flatnonzero(keep).tolist():
        noise = _robust(gtsam.noiseModel.Gaussian.Covariance(positions.cov_map[k]), data, kernel)
        i = int(positions.nodes[k])
        measured, offset = positions.position_map[k], positions.offset_imu[k]
        delay_s, gravity = float(positions.delay_s[k]), data.gravity_m_s2
        factor = position_factor(
            key_imu(i), key_velocity(i), measured, offset, delay_s, gravity, noise
        )
        graph.add("gnss", factor)
        graph.fixes.append(int(positions.fixes[k]))


def _add_orientations(
    graph: TrajectoryGraph, data: SmootherInput, orientations: NodeOrientations
) -> None:
    estimated = data.config.imu.yaw_bias
    for k, i in enumerate(orientations.nodes.tolist()):
        noise = gtsam.noiseModel.Gaussian.Covariance(orientations.cov[k])
        R = gtsam.Rot3(orientations.R_map_imu[k])
        if estimated:
            graph.add(
                "orientation", biased_orientation_factor(key_imu(i), key_yaw_bias(), R, noise)
            )
        else:
            graph.add("orientation", orientation_factor(key_imu(i), R, noise))
    if estimated:
        sigma = math.radians(data.config.imu.yaw_bias_sigma_deg)
        noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
        graph.add("prior", gtsam.PriorFactorVector(key_yaw_bias(), np.zeros(1), noise))


def velocity_roots(data: SmootherInput, velocities: NodeVelocities) -> Array:
    """(m, 3, 3) what whitens residuals of velocities at nodes, imu axes.

    The first row is what the forward velocity says, along the axis that it was measured along: with
    the root of a covariance it would be as uncertain as what odometry does not measure.
    """
    R_twist_imu = data.T_vehicle_twist.between(data.T_vehicle_imu).rotation().matrix()
    information = np.linalg.inv(R_twist_imu @ velocities.cov @ R_twist_imu.T)
    return np.asarray(np.swapaxes(np.linalg.cholesky(information), 1, 2) @ R_twist_imu)


def _add_velocities(
    graph: TrajectoryGraph, data: SmootherInput, velocities: NodeVelocities
) -> None:
    roots = velocity_roots(data, velocities)
    for k, i in enumerate(velocities.nodes.tolist()):
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(roots[k], False)
        factor = velocity_factor(
            key_imu(i),
            key_velocity(i),
            velocities.velocity_imu[k],
            velocities.delay_s[k],
            data.gravity_m_s2,
            noise,
            data.speed_scale,
        )
        graph.add("velocity", factor)


def _add_headings(
    graph: TrajectoryGraph, data: SmootherInput, found: NodeDirections, kernel: str
) -> None:
    assert data.headings is not None
    for i, k, u in zip(found.nodes.tolist(), found.measurements, found.direction_imu, strict=True):
        variance = data.headings.var[k : k + 1, None]
        noise = _robust(gtsam.noiseModel.Gaussian.Covariance(variance), data, kernel)
        azimuth = float(data.headings.azimuth_rad[k])
        graph.add("heading", heading_factor(key_imu(i), u, azimuth, noise))


def _add_baselines(
    graph: TrajectoryGraph, data: SmootherInput, found: NodeDirections, kernel: str
) -> None:
    assert data.baselines is not None
    for i, k, b in zip(found.nodes.tolist(), found.measurements, found.direction_imu, strict=True):
        noise = gtsam.noiseModel.Gaussian.Covariance(data.baselines.cov_map[k])
        robust = _robust(noise, data, kernel)
        graph.add("baseline", baseline_factor(key_imu(i), b, data.baselines.vector_map[k], robust))


def _robust(
    noise: gtsam.noiseModel.Base, data: SmootherInput, kernel: str
) -> gtsam.noiseModel.Base:
    """A noise model under Huber's loss where that is the kernel."""
    if kernel != "huber":
        return noise
    threshold = data.config.robust.huber_k * math.sqrt(noise.dim())
    return gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(threshold), noise
    )


def _add_level(
    graph: TrajectoryGraph, data: SmootherInput, nodes: IntArray, dead: DeadReckoning
) -> None:
    """The road under an axle is level, but for its slope and bumps; the body leans in curves."""
    assert data.wheels is not None
    assert data.motion.twist is not None
    up_map = normal_of(data.slope)
    R_wheels_twist = data.T_vehicle_imu.between(data.T_vehicle_twist).rotation().matrix()
    late_ns = data.late_ns.get(IMU_CLOCK, 0)
    leaning = data.lean * accelerations(data.motion.twist, nodes, dead, R_wheels_twist, late_ns)
    for i, sigma in enumerate(level_sigmas(nodes, data.wheels).tolist()):
        noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
        graph.add("level", level_factor(key_imu(i), up_map, leaning[i], noise))


def _add_gauge_prior(graph: TrajectoryGraph, data: SmootherInput, states: States) -> None:
    """Without GNSS the start is the map's origin; if nothing tells the yaw, that is fixed, too."""
    start = gtsam.Pose3(gtsam.Rot3(states.R_map_imu[0]), states.p_map_imu[0])
    position_noise = gtsam.noiseModel.Isotropic.Sigma(3, GAUGE_M)
    graph.add("prior", gtsam.PoseTranslationPrior3D(key_imu(0), start, position_noise))
    if not data.orientation and data.headings is None:
        R = states.R_map_imu[0]
        # 1 rad in roll and pitch, which gravity determines; rotated into the imu's axes, in which
        # the residual is.
        cov = R.T @ np.diag([1.0, 1.0, GAUGE_RAD**2]) @ R
        noise = gtsam.noiseModel.Gaussian.Covariance(cov)
        graph.add("prior", orientation_factor(key_imu(0), gtsam.Rot3(R), noise))


def to_values(states: States, data: SmootherInput) -> gtsam.Values:
    """An estimate as GTSAM's values."""
    biases = gtsam.VectorValues()
    for i, bias in enumerate(np.hstack([states.force_bias, states.gyro_bias])):
        biases.insert(key_bias(i), bias)
    out = _no_biases(len(states.p_map_imu)).retract(biases)
    for i in range(len(states.p_map_imu)):
        out.insert(key_imu(i), gtsam.Pose3(gtsam.Rot3(states.R_map_imu[i]), states.p_map_imu[i]))
        out.insert(key_velocity(i), states.velocity_map[i])
    if data.yaw_bias:
        out.insert(key_yaw_bias(), np.array([states.yaw_bias_rad]))
    return out


@lru_cache(maxsize=8)
def _no_biases(n: int) -> gtsam.Values:
    """Biases of n nodes, all zero. To insert one takes as long as all else of a node together."""
    out = gtsam.Values()
    for i in range(n):
        out.insert(key_bias(i), gtsam.imuBias.ConstantBias())
    return out


def from_values(values: gtsam.Values, n: int, data: SmootherInput) -> States:
    """The estimate of n nodes in GTSAM's values."""
    R, p = stack([values.atPose3(key_imu(i)) for i in range(n)])
    biases = [values.atConstantBias(key_bias(i)) for i in range(n)]
    return States(
        R,
        p,
        np.array([values.atVector(key_velocity(i)) for i in range(n)]),
        np.array([b.accelerometer() for b in biases]),
        np.array([b.gyroscope() for b in biases]),
        float(values.atVector(key_yaw_bias())[0]) if data.yaw_bias else 0.0,
    )
