"""One smoothed trajectory with covariance from IMU, GNSS, velocity and orientation, in GTSAM.

Variables, per node i:
    I_i  `T_map_imu`, right perturbation, rotation then translation
    V_i  velocity of the IMU's origin in the map, m/s
    B_i  `imuBias.ConstantBias` of accelerometer and gyroscope, imu frame
and, if asked for, one yaw bias of the orientation source for the whole drive. The IMU's own pose
is the variable, not the vehicle's: with a lever arm, what an accelerometer feels off the vehicle's
origin depends on the angular acceleration, which GTSAM's `body_P_sensor` leaves out (a steering
transition seen 1 m off is a velocity error of 0.2 m/s). T_vehicle_imu is constant, so all results
carry over to the vehicle by its adjoint, exactly.

Nodes are at every stamp that is asked for, at the ends of gaps in the IMU, and between them so
that none are farther apart than `NODE_SPACING_S`. Measurements at other times are carried to the
nearest node by the IMU (`measurements`).

Frames and gauge: the map is ENU, its origin the first GNSS fix, gravity along -z. Without GNSS the
velocities alone determine the motion relative to the start, which is then the map's origin (and,
without an orientation source, its x axis).

Noise: `noise` module. GNSS is robust: Huber, and fixes that no plausible noise explains are
dropped, worst first (`robust.kernel`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.special import chdtri

from caliv_graph.config.model import Config
from caliv_graph.conventions import key_bias, key_imu, key_velocity, key_yaw_bias
from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, ImuSamples, IntArray, MotionData, Trajectory
from caliv_graph.trajectory.chain import POSE, Chain
from caliv_graph.trajectory.factors import (
    biased_orientation_factor,
    orientation_factor,
    position_factor,
    velocity_factor,
)
from caliv_graph.trajectory.gnss import Positions, normal_gravity, positions_in_map
from caliv_graph.trajectory.imu import DeadReckoning, Inertial, clean_inertial, preintegrate
from caliv_graph.trajectory.initial import (
    align,
    heading_window,
    positions_and_velocities,
    rotations_by_orientation,
    standing_gyro,
)
from caliv_graph.trajectory.measurements import (
    NodeOrientations,
    NodePositions,
    NodeVelocities,
    nearest_node,
    orientations_at_nodes,
    positions_at_nodes,
    rotations_of,
    usable_orientations,
    velocities_at_nodes,
)
from caliv_graph.trajectory.noise import (
    ImuNoise,
    imu_noise,
    orientation_covariances,
    velocity_covariances,
)
from caliv_graph.trajectory.smoothed import MERGE_NS, SmoothedTrajectory, States, without_bias

NODE_SPACING_S = 0.1
"""Nodes are no farther apart, on drives of up to `FINE_NODES` of them."""

FINE_NODES = 1200
COARSE_SPACING_S = 0.5
"""On long drives nodes away from the wanted stamps are this far apart at most."""

STANDARD_GRAVITY_M_S2 = 9.80665

JUMP_P_VALUE = 1e-6
"""A fix whose residual white noise exceeds this rarely is no noise."""

REJECTED_PART = 0.4
"""If more of the fixes would be dropped, it is not they that are wrong."""

MOST_ROUNDS = 12
"""Of dropping fixes; a jump by a kilometre takes nine."""

GROWTH_S = 20.0
"""Without orientations the drive is solved from its start, over this time, then twice as much."""

PASSES = 4
"""Preintegration and carrying are done anew with the biases found, at most this often."""

# Biases found may differ from those integrated with by this before all is done anew.
GYRO_BIAS_CHANGE = 2e-4
FORCE_BIAS_CHANGE = 5e-3

MOST_STEPS = 60
ERROR_TOLERANCE = 1e-7
"""Of the sum of squares: a step that gains less moves nothing by a hundredth of its sigma."""

ROUGH_TOLERANCE = 1e-3
"""While outliers are still in: Huber's weights take many steps to settle about them."""

LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e8

GAUGE_M = 1e-4
GAUGE_RAD = 1e-4

WORST_DISAGREEMENT_RAD = math.radians(20.0)
"""Between accelerometer and orientation, on average: more is a mistake in axes."""

BIAS_SIGMAS = 5.0
"""Of its prior, beyond which a bias is told."""

# A trajectory of which half is less certain than this is no help to anyone.
WORST_TILT_RAD = 0.1
WORST_YAW_RAD = 0.2
WORST_POSITION_M = 10.0


@dataclass(frozen=True)
class _Data:
    """What there is to smooth, checked."""

    name: str
    config: Config
    motion: MotionData
    inertial: Inertial
    noise: ImuNoise
    positions: Positions | None
    orientation: bool
    T_vehicle_imu: gtsam.Pose3
    gravity_m_s2: float

    @property
    def arm_imu(self) -> Array:
        """The GNSS antenna in the imu frame."""
        arm = np.array(self.config.gnss.lever_arm)
        return np.asarray(self.T_vehicle_imu.transformTo(arm))


@dataclass(frozen=True)
class _Carried:
    """All measurements at the nodes."""

    positions: NodePositions | None
    orientations: NodeOrientations | None
    velocities: NodeVelocities | None


def smooth_trajectory(
    motion: MotionData, config: Config, stamps_ns: Sequence[int] | IntArray
) -> SmoothedTrajectory:
    """Smooths one drive.

    Args:
        motion: IMU, and GNSS, velocities or both; orientations within the IMU's messages.
        config: extrinsics, noise, robust kernel.
        stamps_ns: stamps at which poses are wanted (of LiDAR scans), in any order.

    Returns:
        The trajectory. Stamps outside the span of the IMU are in `lost_ns`.

    Raises:
        TrajectoryError: what was recorded does not determine the motion; says what is missing.
    """
    data, warnings = _checked(motion, config)
    inertial = data.inertial
    wanted = np.unique(np.asarray(stamps_ns, dtype=np.int64))
    inside = (wanted >= inertial.begin_ns) & (wanted <= inertial.end_ns)
    lost = wanted[~inside]
    if len(wanted) and not inside.any():
        raise TrajectoryError(
            f"{data.name}: all {len(wanted)} scans are outside the trajectory's span: IMU from "
            f"{inertial.begin_ns * 1e-9:.3f} s to {inertial.end_ns * 1e-9:.3f} s, scans from "
            f"{wanted[0] * 1e-9:.3f} s to {wanted[-1] * 1e-9:.3f} s. Do their clocks agree?"
        )
    if len(lost):
        warnings.append(
            f"{data.name}: {len(lost)} of {len(wanted)} scans are outside the trajectory's span, "
            "lost"
        )
    wanted = wanted[inside]
    nodes = _place_nodes(inertial, wanted)
    states = _initial(data, nodes)
    states, graph, values, dropped, data = _solve(data, nodes, states, warnings)
    chain = _chain(graph, values, len(nodes), config.imu.yaw_bias and data.orientation)
    cov_imu = _determined(chain, data, states)
    rejected = np.zeros(0, dtype=np.int64)
    if data.positions is not None and len(dropped):
        rejected = data.positions.stamps_ns[dropped]
        warnings.append(
            f"{data.name}: {len(rejected)} of {len(data.positions.stamps_ns)} GNSS fixes disagree "
            "with the motion, dropped"
        )
    warnings += _biases(data, states)
    yaw_bias = None
    if config.imu.yaw_bias and data.orientation:
        sigma = float(np.sqrt(chain.common_covariance()[0, 0]))
        yaw_bias = (states.yaw_bias_rad, sigma)
    smoothed = SmoothedTrajectory(
        trajectory=Trajectory(wanted, ()),
        lost_ns=tuple(lost.tolist()),
        warnings=tuple(warnings),
        noise_sources=_sources(data),
        nodes_ns=nodes,
        states=states,
        T_vehicle_imu=data.T_vehicle_imu,
        gravity_m_s2=data.gravity_m_s2,
        yaw_bias=yaw_bias,
        gnss_rejected=rejected,
        origin_deg_m=None if data.positions is None else data.positions.origin_deg_m,
        graph=graph,
        values=values,
        chain=chain,
        inertial=inertial,
        factor_kinds=_factor_kinds(data, nodes, states, dropped, graph.size()),
    )
    return replace(smoothed, trajectory=_at_wanted(smoothed, wanted, cov_imu))


def _at_wanted(smoothed: SmoothedTrajectory, wanted: IntArray, cov_imu: Array) -> Trajectory:
    """The product: poses, covariances and velocities at the wanted stamps."""
    i = nearest_node(smoothed.nodes_ns, wanted)
    Ad = np.asarray(smoothed.T_vehicle_imu.AdjointMap())
    velocity, rates = smoothed.velocities_at(wanted)
    return Trajectory(
        stamps_ns=wanted,
        T_map_vehicle=smoothed.node_poses(i),
        cov=np.asarray(Ad @ cov_imu[i] @ Ad.T),
        velocity_vehicle=velocity,
        angular_velocity_vehicle=rates,
    )


def _checked(motion: MotionData, config: Config) -> tuple[_Data, list[str]]:
    """What is there, or what is missing."""
    name = motion.name
    if motion.imu is None:
        raise TrajectoryError(
            f"{name}: no IMU: set topics.imu to a topic of sensor_msgs/Imu, or topics.pose to one "
            "with the vehicle's poses"
        )
    no_twist = motion.twist is None or not np.isfinite(motion.twist.velocity).all(axis=1).any()
    no_gnss = motion.gnss is None or not len(motion.gnss.stamps_ns)
    if no_twist and no_gnss:
        raise TrajectoryError(
            f"{name}: neither GNSS fixes nor velocities: an IMU alone drifts away within seconds. "
            "Set topics.gnss (sensor_msgs/NavSatFix), topics.twist "
            "(geometry_msgs/TwistStamped or nav_msgs/Odometry), or topics.pose"
        )
    inertial, lines = clean_inertial(motion.imu, name)
    warnings = list(lines)
    positions = None
    gravity = config.imu.gravity_m_s2
    if motion.gnss is not None and not no_gnss:
        positions, lines = positions_in_map(motion.gnss, config, name)
        warnings += lines
        within = (positions.stamps_ns >= inertial.begin_ns) & (
            positions.stamps_ns <= inertial.end_ns
        )
        if not within.any() and no_twist:
            raise TrajectoryError(
                f"{name}: no GNSS fix lies within the IMU's {_span(inertial)}; fixes from "
                f"{positions.stamps_ns[0] * 1e-9:.3f} s to {positions.stamps_ns[-1] * 1e-9:.3f} s. "
                "Do their clocks agree?"
            )
        gravity = gravity or normal_gravity(positions.origin_deg_m[0], positions.origin_deg_m[2])
        if not within.any():
            positions = None
            warnings.append(f"{name}: no GNSS fix lies within the IMU's span: GNSS is not used")
    if positions is None and not no_twist:
        warnings.append(
            f"{name}: no GNSS: the map's origin is the vehicle's start, and positions drift with "
            "the velocities"
        )
    data = _Data(
        name=name,
        config=config,
        motion=motion,
        inertial=inertial,
        noise=imu_noise(motion.imu, config),
        positions=positions,
        orientation=_usable_orientation(motion.imu, inertial, name),
        T_vehicle_imu=config.imu.T_vehicle_imu.pose(),
        gravity_m_s2=gravity or STANDARD_GRAVITY_M_S2,
    )
    return data, warnings


def _span(inertial: Inertial) -> str:
    return f"span, {inertial.begin_ns * 1e-9:.3f} s to {inertial.end_ns * 1e-9:.3f} s"


def _biases(data: _Data, states: States) -> list[str]:
    """Biases that the config does not expect, a line each."""
    out = []
    for what, bias, sigma, key, unit in (
        (
            "accelerometer",
            states.force_bias,
            data.noise.force_bias,
            "noise.accelerometer_bias_m_s2",
            "m/s^2",
        ),
        (
            "gyroscope",
            states.gyro_bias,
            data.noise.gyro_bias,
            "noise.gyroscope_bias_rad_s",
            "rad/s",
        ),
    ):
        largest = float(np.abs(np.median(bias, axis=0)).max())
        if largest > BIAS_SIGMAS * sigma:
            out.append(
                f"{data.name}: the {what}'s bias comes out as {largest:.3g} {unit}, {key} is "
                f"{sigma:.3g}: a wrong unit, or axes that are not those of the orientation"
            )
    return out


def _usable_orientation(imu: ImuSamples, inertial: Inertial, name: str) -> bool:
    """Whether there are orientations. They have to agree on where up is with the accelerometer."""
    usable = usable_orientations(imu) & np.isfinite(imu.specific_force).all(axis=1)
    stamps = imu.stamps_ns
    usable &= (stamps >= inertial.begin_ns) & (stamps <= inertial.end_ns)
    if imu.orientation_xyzw is None or not usable.any():
        return False
    R = rotations_of(imu.orientation_xyzw[usable])
    up = np.einsum("nij,nj->ni", R, imu.specific_force[usable]).mean(axis=0)
    tilt = math.acos(float(np.clip(up[2] / np.linalg.norm(up), -1.0, 1.0)))
    if tilt > WORST_DISAGREEMENT_RAD:
        raise TrajectoryError(
            f"{name}: the IMU's orientation and its accelerometer disagree by "
            f"{math.degrees(tilt):.0f} degrees on where up is: the orientation has to be that of "
            "the IMU's own frame in ENU axes, z up. Choose another topics.imu, or set its "
            "orientation_covariance[0] to -1"
        )
    return True


def _sources(data: _Data) -> dict[str, str]:
    """Where the figures of each sensor in use are from."""
    out = dict(data.noise.sources)
    if data.orientation:
        assert data.motion.imu is not None
        out["orientation"] = orientation_covariances(data.motion.imu, data.config)[1]
    if data.positions is not None:
        out["gnss"] = data.positions.source
    if data.motion.twist is not None:
        out["velocity"] = velocity_covariances(data.motion.twist, data.config)[1]
    return out


def _place_nodes(inertial: Inertial, wanted: IntArray) -> IntArray:
    """Stamps of the nodes: every wanted one, ends, ends of gaps, and as many between as needed."""
    begin, end = inertial.begin_ns, inertial.end_ns
    fixed = np.unique(np.concatenate([wanted, [begin, end], inertial.gaps_ns.ravel()]))
    fixed = fixed[np.concatenate([[True], np.diff(fixed) > MERGE_NS])]
    if end - fixed[-1] <= MERGE_NS:
        fixed[-1] = end  # the span is not to end short of a stamp that is within it
    duration_s = (end - begin) * 1e-9
    spacing_s = min(max(NODE_SPACING_S, duration_s / FINE_NODES), COARSE_SPACING_S)
    parts = np.maximum(np.ceil(np.diff(fixed) * 1e-9 / spacing_s - 1e-3), 1).astype(np.int64)
    pieces = [
        a + (np.arange(n) * (b - a)) // n
        for a, b, n in zip(fixed[:-1].tolist(), fixed[1:].tolist(), parts.tolist(), strict=True)
    ]
    return np.concatenate([*pieces, fixed[-1:]]).astype(np.int64)


def _carry(data: _Data, nodes: IntArray, dead: DeadReckoning) -> _Carried:
    """All measurements to the nodes that are there."""
    assert data.motion.imu is not None
    cov, _ = orientation_covariances(data.motion.imu, data.config)
    velocities = None
    if data.motion.twist is not None:
        cov_v, _ = velocity_covariances(data.motion.twist, data.config)
        velocities = velocities_at_nodes(
            data.motion.twist, cov_v, nodes, dead, data.noise, data.T_vehicle_imu
        )
    return _Carried(
        None
        if data.positions is None
        else positions_at_nodes(data.positions, nodes, dead, data.arm_imu),
        orientations_at_nodes(data.motion.imu, cov, nodes, dead, data.noise)
        if data.orientation
        else None,
        velocities,
    )


def _initial(data: _Data, nodes: IntArray) -> States:
    """Where the optimisation starts. Without orientation, of the drive's first part only."""
    inertial = data.inertial
    twist = data.motion.twist
    speeds = None
    if twist is not None:
        finite = np.isfinite(twist.velocity).all(axis=1)
        speeds = twist.stamps_ns[finite], np.linalg.norm(twist.velocity[finite], axis=1)
    gyro_bias = standing_gyro(inertial, data.positions, speeds)
    # A turning Earth is not asked about: a bias beyond ten of its sigmas is no standstill.
    if gyro_bias is None or np.linalg.norm(gyro_bias) > 10.0 * data.noise.gyro_bias:
        gyro_bias = np.zeros(3)
    dead = DeadReckoning(inertial.stamps_ns, inertial.gyro - gyro_bias, inertial.force)
    carried = _carry(data, nodes, dead)
    if carried.orientations is not None:
        R = rotations_by_orientation(carried.orientations, nodes, dead)
    else:
        until = heading_window(data.positions, inertial.begin_ns, inertial.end_ns, GROWTH_S)
        velocities = None
        if carried.velocities is not None:
            velocities = nodes[carried.velocities.nodes], carried.velocities.velocity_imu
        forward = data.T_vehicle_imu.rotation().matrix()[0]
        R_start = align(
            dead, until, data.positions, velocities, forward, data.gravity_m_s2, data.name
        )
        keep = max(int(np.searchsorted(nodes, until, "right")), 2)
        nodes = nodes[:keep]
        carried = _carry(data, nodes, dead)
        R = R_start @ dead.between(np.full(keep, nodes[0]), nodes)[0]
    p, v = positions_and_velocities(R, nodes, data.positions, carried.velocities, data.arm_imu)
    if data.positions is None:
        p = p + R[0] @ data.T_vehicle_imu.inverse().translation() * -1.0
    return States(R, p, v, np.zeros_like(p), np.broadcast_to(gyro_bias, p.shape).copy())


def _extended(data: _Data, nodes: IntArray, states: States) -> States:
    """The estimate of the first nodes, carried on to all of them by the IMU."""
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
    carried = _carry(data, nodes, dead)
    p, v = positions_and_velocities(R, nodes, data.positions, carried.velocities, data.arm_imu)
    if data.positions is None:
        p += states.p_map_imu[-1] - p[done - 1]
    return replace(
        grown,
        R_map_imu=R,
        p_map_imu=np.concatenate([states.p_map_imu, p[done:]]),
        velocity_map=np.concatenate([states.velocity_map, v[done:]]),
    )


def _solve(
    data: _Data, nodes: IntArray, states: States, warnings: list[str]
) -> tuple[States, gtsam.NonlinearFactorGraph, gtsam.Values, IntArray, _Data]:
    """Solves for all nodes, piece by piece where the start is not known well enough at once.

    Returns:
        The estimate, its graph and values, the indices of dropped fixes, and the data with the
        noise that was used.
    """
    none = np.zeros(0, dtype=np.int64)
    while len(states.p_map_imu) < len(nodes):
        done = len(states.p_map_imu)
        states, _, _ = _settle(data, nodes[:done], states, none, "huber", ROUGH_TOLERANCE)
        until = nodes[0] + 2 * (nodes[done - 1] - nodes[0])
        more = min(max(int(np.searchsorted(nodes, until)), done + 1), len(nodes))
        states = _extended(data, nodes[:more], states)
    kernel = data.config.robust.kernel
    if data.positions is None or kernel == "none":
        return *_settle(data, nodes, states, none, kernel), none, data
    states, graph, values = _settle(data, nodes, states, none, "huber", ROUGH_TOLERANCE)
    data, states = _honest_noise(data, nodes, states, warnings)
    dropped, solved_with = none, "roughly"
    limit: float | None = None
    for _ in range(MOST_ROUNDS):
        found, limit = _outliers(_position_residuals(data, nodes, states), data.config, limit)
        if np.array_equal(found, dropped) and solved_with == kernel:
            if limit == _final_limit(data.config):
                break
            continue
        dropped = found
        rough = limit > _final_limit(data.config)
        solved_with = "roughly" if rough else kernel
        tolerance = ROUGH_TOLERANCE if rough else ERROR_TOLERANCE
        states, graph, values = _settle(data, nodes, states, dropped, kernel, tolerance)
    if solved_with != kernel:
        states, graph, values = _settle(data, nodes, states, dropped, kernel)
    return states, graph, values, dropped, data


def _honest_noise(
    data: _Data, nodes: IntArray, states: States, warnings: list[str]
) -> tuple[_Data, States]:
    """Widens the fixes' covariance where most of them disagree with the motion by more.

    A receiver that states nothing gets the paper's 17 mm, and may be good to a metre: then not
    the fixes are wrong but the figure.
    """
    assert data.positions is not None
    none, stated_by = np.zeros(0, dtype=np.int64), data.positions.source
    total = 1.0
    for _ in range(3):
        squares = _position_residuals(data, nodes, states)
        if (squares > _final_limit(data.config)).mean() <= REJECTED_PART:
            break
        factor = float(np.median(squares) / chdtri(3, 0.5))
        total *= factor
        assert data.positions is not None
        positions = replace(data.positions, cov_map=data.positions.cov_map * factor)
        data = replace(data, positions=positions)
        states, _, _ = _settle(data, nodes, states, none, "huber", ROUGH_TOLERANCE)
    if total > 1.0:
        warnings.append(
            f"{data.name}: most GNSS fixes disagree with the motion by more than their noise "
            f"({stated_by}): taken as {math.sqrt(total):.1f} times as much. Set "
            "noise.gnss_horizontal_m and noise.gnss_vertical_m"
        )
    return data, states


def _final_limit(config: Config) -> float:
    """Squared whitened residual of a fix beyond which it is dropped."""
    p = config.robust.tls_p_value if config.robust.kernel == "tls" else JUMP_P_VALUE
    return float(chdtri(3, p))


def _outliers(squares: Array, config: Config, limit: float | None) -> tuple[IntArray, float]:
    """Fixes to drop now, and the limit they exceed.

    The limit comes down step by step: a jump pulls the first solution towards itself, and with it
    sound fixes look wrong that no longer do once the worst ones are gone.
    """
    final = _final_limit(config)
    if config.robust.kernel == "trimmed":
        count = int(len(squares) * config.robust.trim_percent / 100.0)
        return np.sort(np.argsort(squares)[len(squares) - count :]), final
    worst = float(squares.max(initial=0.0)) if limit is None else limit
    limit = max(final, worst / 9.0)
    return np.flatnonzero(squares > limit), limit


def _position_residuals(data: _Data, nodes: IntArray, states: States) -> Array:
    """(k,) squared whitened residual of each fix at an estimate; 0 where it lies outside."""
    assert data.positions is not None
    dead = without_bias(data.inertial, nodes, states)
    carried = positions_at_nodes(data.positions, nodes, dead, data.arm_imu)
    out = np.zeros(len(data.positions.stamps_ns))
    if carried is None:
        return out
    i, dt = carried.nodes, carried.delay_s[:, None]
    g = np.array([0.0, 0.0, -data.gravity_m_s2])
    predicted = states.p_map_imu[i] + states.velocity_map[i] * dt + 0.5 * g * dt**2
    predicted += np.einsum("nij,nj->ni", states.R_map_imu[i], carried.offset_imu)
    r = predicted - carried.position_map
    out[carried.fixes] = np.einsum("ni,nij,nj->n", r, np.linalg.inv(carried.cov_map), r)
    return out


def _settle(
    data: _Data,
    nodes: IntArray,
    states: States,
    dropped: IntArray,
    kernel: str,
    tolerance: float = ERROR_TOLERANCE,
) -> tuple[States, gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Optimises until the biases are those that the measurements were integrated with."""
    for _ in range(PASSES):
        graph = _graph(data, nodes, states, dropped, kernel)
        values = _optimised(graph, _values(states, data), len(nodes), tolerance)
        found = _states(values, len(nodes), data)
        settled = (
            np.abs(found.gyro_bias - states.gyro_bias).max() < GYRO_BIAS_CHANGE
            and np.abs(found.force_bias - states.force_bias).max() < FORCE_BIAS_CHANGE
        )
        states = found
        if settled:
            break
    return states, graph, values


def _graph(
    data: _Data, nodes: IntArray, states: States, dropped: IntArray, kernel: str
) -> gtsam.NonlinearFactorGraph:
    """All factors, linearised in the biases about an estimate."""
    noise = data.noise
    dead = without_bias(data.inertial, nodes, states)
    carried = _carry(data, nodes, dead)
    graph = gtsam.NonlinearFactorGraph()
    biases = [
        gtsam.imuBias.ConstantBias(f, w)
        for f, w in zip(states.force_bias, states.gyro_bias, strict=True)
    ]
    gravity = data.gravity_m_s2
    for i, measured in enumerate(preintegrate(data.inertial, nodes, biases, noise, gravity)):
        graph.add(
            gtsam.CombinedImuFactor(
                key_imu(i),
                key_velocity(i),
                key_imu(i + 1),
                key_velocity(i + 1),
                key_bias(i),
                key_bias(i + 1),
                measured,
            )
        )
    bias_sigmas = np.array([noise.force_bias] * 3 + [noise.gyro_bias] * 3)
    graph.add(
        gtsam.PriorFactorConstantBias(
            key_bias(0),
            gtsam.imuBias.ConstantBias(),
            gtsam.noiseModel.Diagonal.Sigmas(bias_sigmas),
        )
    )
    _add_positions(graph, data, carried.positions, dropped, kernel)
    if carried.orientations is not None:
        _add_orientations(graph, data, carried.orientations)
    if carried.velocities is not None:
        _add_velocities(graph, data, carried.velocities)
    if data.positions is None:
        _add_gauge(graph, data, states)
    return graph


def _factor_kinds(
    data: _Data, nodes: IntArray, states: States, dropped: IntArray, size: int
) -> tuple[str, ...]:
    """What each factor of `_graph` is about, in its order. GTSAM's own have no names."""
    carried = _carry(data, nodes, without_bias(data.inertial, nodes, states))
    kinds = ["imu"] * (len(nodes) - 1) + ["prior"]
    if carried.positions is not None:
        kinds += ["gnss"] * int((~np.isin(carried.positions.fixes, dropped)).sum())
    if carried.orientations is not None:
        kinds += ["orientation"] * len(carried.orientations.nodes)
        kinds += ["prior"] * data.config.imu.yaw_bias
    if carried.velocities is not None:
        kinds += ["velocity"] * len(carried.velocities.nodes)
    return (*kinds, *["prior"] * (size - len(kinds)))


def _add_positions(
    graph: gtsam.NonlinearFactorGraph,
    data: _Data,
    positions: NodePositions | None,
    dropped: IntArray,
    kernel: str,
) -> None:
    if positions is None:
        return
    keep = ~np.isin(positions.fixes, dropped)
    bend = data.config.robust.huber_k * math.sqrt(3.0)
    for k in np.flatnonzero(keep).tolist():
        noise: gtsam.noiseModel.Base = gtsam.noiseModel.Gaussian.Covariance(positions.cov_map[k])
        if kernel == "huber":
            estimator = gtsam.noiseModel.mEstimator.Huber.Create(bend)
            noise = gtsam.noiseModel.Robust.Create(estimator, noise)
        i = int(positions.nodes[k])
        graph.add(
            position_factor(
                key_imu(i),
                key_velocity(i),
                positions.position_map[k],
                positions.offset_imu[k],
                float(positions.delay_s[k]),
                data.gravity_m_s2,
                noise,
            )
        )


def _add_orientations(
    graph: gtsam.NonlinearFactorGraph, data: _Data, orientations: NodeOrientations
) -> None:
    estimated = data.config.imu.yaw_bias
    for k, i in enumerate(orientations.nodes.tolist()):
        noise = gtsam.noiseModel.Gaussian.Covariance(orientations.cov[k])
        R = gtsam.Rot3(orientations.R_map_imu[k])
        if estimated:
            graph.add(biased_orientation_factor(key_imu(i), key_yaw_bias(), R, noise))
        else:
            graph.add(orientation_factor(key_imu(i), R, noise))
    if estimated:
        sigma = math.radians(data.config.imu.yaw_bias_sigma_deg)
        graph.add(
            gtsam.PriorFactorVector(
                key_yaw_bias(), np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, sigma)
            )
        )


def _add_velocities(
    graph: gtsam.NonlinearFactorGraph, data: _Data, velocities: NodeVelocities
) -> None:
    for k, i in enumerate(velocities.nodes.tolist()):
        gained = np.array([0.0, 0.0, -data.gravity_m_s2 * velocities.delay_s[k]])
        noise = gtsam.noiseModel.Gaussian.Covariance(velocities.cov[k])
        graph.add(
            velocity_factor(key_imu(i), key_velocity(i), velocities.velocity_imu[k], gained, noise)
        )


def _add_gauge(graph: gtsam.NonlinearFactorGraph, data: _Data, states: States) -> None:
    """Without GNSS: the vehicle starts at the map's origin, without orientation along its x."""
    start = gtsam.Pose3(gtsam.Rot3(states.R_map_imu[0]), states.p_map_imu[0])
    graph.add(
        gtsam.PoseTranslationPrior3D(
            key_imu(0), start, gtsam.noiseModel.Isotropic.Sigma(3, GAUGE_M)
        )
    )
    if not data.orientation:
        R = states.R_map_imu[0]
        # Loose in tilt, which gravity tells; in the imu's axes, as the factor's residual is.
        cov = R.T @ np.diag([1.0, 1.0, GAUGE_RAD**2]) @ R
        graph.add(
            orientation_factor(key_imu(0), gtsam.Rot3(R), gtsam.noiseModel.Gaussian.Covariance(cov))
        )


def _values(states: States, data: _Data) -> gtsam.Values:
    out = gtsam.Values()
    for i in range(len(states.p_map_imu)):
        out.insert(key_imu(i), gtsam.Pose3(gtsam.Rot3(states.R_map_imu[i]), states.p_map_imu[i]))
        out.insert(key_velocity(i), states.velocity_map[i])
        out.insert(
            key_bias(i), gtsam.imuBias.ConstantBias(states.force_bias[i], states.gyro_bias[i])
        )
    if data.orientation and data.config.imu.yaw_bias:
        out.insert(key_yaw_bias(), np.array([states.yaw_bias_rad]))
    return out


def _states(values: gtsam.Values, n: int, data: _Data) -> States:
    R, p = stack([values.atPose3(key_imu(i)) for i in range(n)])
    biases = [values.atConstantBias(key_bias(i)) for i in range(n)]
    yaw_bias = 0.0
    if data.orientation and data.config.imu.yaw_bias:
        yaw_bias = float(values.atVector(key_yaw_bias())[0])
    return States(
        R,
        p,
        np.array([values.atVector(key_velocity(i)) for i in range(n)]),
        np.array([b.accelerometer() for b in biases]),
        np.array([b.gyroscope() for b in biases]),
        yaw_bias,
    )


def _optimised(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, n: int, tolerance: float
) -> gtsam.Values:
    """Gauss-Newton, damped where a full step does not descend (Levenberg-Marquardt).

    The start is close and the problem nearly linear: four steps do. They are taken here because
    GTSAM's optimizers need ten times as long for a step over factors written in Python.
    """
    ordering = gtsam.Ordering()
    for i in range(n):
        for key in (key_bias(i), key_velocity(i), key_imu(i)):
            ordering.push_back(key)
    if values.exists(key_yaw_bias()):
        ordering.push_back(key_yaw_bias())
    error = graph.error(values)
    damping = 0.0
    for _ in range(MOST_STEPS):
        linear = graph.linearize(values)
        moved, error_moved = values, math.inf
        while not error_moved <= error and damping < MOST_DAMPING:
            moved = _step(linear, values, ordering, n, damping)
            error_moved = graph.error(moved)
            if error_moved <= error:
                damping = damping / 10.0 if damping > LEAST_DAMPING else 0.0
            elif error_moved - error < tolerance * (1.0 + error):
                return values  # rounding: there is nothing left to gain
            else:
                damping = max(10.0 * damping, LEAST_DAMPING)
        if not error_moved <= error:
            return values
        gained = error - error_moved
        values, error = moved, error_moved
        if gained <= tolerance * (1.0 + error) and damping == 0.0:
            break
    return values


def _step(
    linear: gtsam.GaussianFactorGraph,
    values: gtsam.Values,
    ordering: gtsam.Ordering,
    n: int,
    damping: float,
) -> gtsam.Values:
    """One step; with damping, short of the sizes that a step may have."""
    if damping == 0.0:
        try:
            return values.retract(linear.optimize(ordering))
        except RuntimeError:  # GTSAM's word for a singular system
            damping = LEAST_DAMPING
    damped = linear.clone()
    root = math.sqrt(damping)
    pose = np.diag([root / 0.1] * 3 + [root] * 3)
    bias = np.diag([root / 0.1] * 3 + [root / 0.01] * 3)
    unit3, unit6 = gtsam.noiseModel.Unit.Create(3), gtsam.noiseModel.Unit.Create(6)
    for i in range(n):
        damped.add(gtsam.JacobianFactor(key_imu(i), pose, np.zeros(6), unit6))
        damped.add(gtsam.JacobianFactor(key_velocity(i), root * np.eye(3), np.zeros(3), unit3))
        damped.add(gtsam.JacobianFactor(key_bias(i), bias, np.zeros(6), unit6))
    try:
        return values.retract(damped.optimize(ordering))
    except RuntimeError:
        return values


def _chain(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, n: int, yaw_bias: bool
) -> Chain:
    return Chain.from_graph(
        graph.linearize(values),
        [(key_imu(i), key_velocity(i), key_bias(i)) for i in range(n)],
        (6, 3, 6),
        [key_yaw_bias()] if yaw_bias else [],
    )


def _determined(chain: Chain, data: _Data, states: States) -> Array:
    """(n, 6, 6) covariances of the IMU's poses, or what it is that leaves them undetermined."""
    wanting = f"{data.name}: the motion data do not determine "
    advice = (
        "orientation in the IMU's messages, GNSS, or velocities, or a drive with curves"
        if not data.orientation
        else "GNSS or velocities along the whole drive"
    )
    try:
        cov = chain.covariances()[:, :POSE, :POSE]
    except TrajectoryError:
        raise TrajectoryError(f"{wanting}the trajectory: record {advice}") from None
    R = states.R_map_imu
    turn = R @ cov[:, :3, :3] @ np.swapaxes(R, 1, 2)
    sigma = np.median(np.sqrt(np.diagonal(turn, axis1=1, axis2=2)), axis=0)
    if sigma[2] > WORST_YAW_RAD:
        raise TrajectoryError(
            f"{wanting}heading: its sigma is {math.degrees(sigma[2]):.1f} degrees. Record {advice}"
        )
    if max(sigma[:2]) > WORST_TILT_RAD:
        raise TrajectoryError(
            f"{wanting}roll and pitch: sigma {math.degrees(max(sigma[:2])):.1f} degrees. Record "
            f"{advice}"
        )
    position = float(np.sqrt(np.median(np.trace(cov[:, 3:, 3:], axis1=1, axis2=2))))
    if position > WORST_POSITION_M:
        raise TrajectoryError(f"{wanting}position: its sigma is {position:.1f} m. Record {advice}")
    return cov
