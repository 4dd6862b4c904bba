"""Wheel odometry as the source of the motion between fixes, where there is no IMU.

The axle's frame stands in for that of an IMU: x where the vehicle goes, z normal to the road. Its
yaw rate is that of the odometry, or unknown; its roll and pitch change as smoothly as springs let
them, about the road's level; its acceleration in its own axes changes slowly (`README.md`, section
15). So an arc at constant speed is what no noise explains: constant twist.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from caliv_graph.config.model import Config
from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array, BoolArray, IntArray, TwistSamples
from caliv_graph.trajectory.imu import (
    NO_GAPS,
    DeadReckoning,
    Inertial,
    interpolate,
    longest_piece,
)
from caliv_graph.trajectory.noise import (
    PAPER_GYRO_RAD_S,
    ImuNoise,
    velocity_covariances,
)

STEP_NS = 10_000_000
"""Largest integration step. The covariance of ten of them between two nodes is 0.86 of that of the
continuous walk of rate and acceleration."""

YAW_RATE_WALK_RAD_S2 = 1e-3
"""rad/s^2/sqrt(Hz), random walk of the bias of a yaw rate: where wheel speeds make it, its error is
a percent of the turn, and changes with it within seconds."""

STEERING_RAD_S2 = 0.5
"""rad/s^2/sqrt(Hz), random walk of a yaw rate that nothing measures: steering from lock to lock,
0.4 rad/s, in a second."""

TURNING_RAD_S = 1.0
"""1 sigma of such a rate at the start."""

JERK_M_S3 = (2.0, 2.0, 0.5)
"""m/s^3/sqrt(Hz), random walk of the acceleration along the axle frame's x, y, z: braking by
2 m/s^2 within a second."""

ACCELERATION_M_S2 = 3.0
"""1 sigma of the acceleration at the start."""

VIBRATION_M_S2 = 0.02
"""m/s^2/sqrt(Hz), white acceleration: what shakes faster than the nodes."""

STEADY_RAD_S = 1e-4
"""rad/s/sqrt(Hz), white rates about x and y. They make the step of a rate that changes regular: far
below what changes it."""

LEAN_NS = 250_000_000
"""Half the time over which accelerations are averaged: a body on springs takes as long to lean."""

LEAST_SLIP_M_S = 0.003
"""1 sigma of the lateral and vertical velocity of a standing vehicle."""


ROUNDING = 1e-6
"""Lateral and vertical velocities up to this part of the largest forward one were not measured: a
filter in the plane leaves rounding where an odometry has zeros."""

STANDING_M_S = 0.01
"""Velocity up to which a vehicle stands: forward, so that it does not move sideways either, and
along every axis, so that it does not turn (`standstill.py`). Wheels that stand read zero."""

UNMEASURED_M_S = 100.0
"""1 sigma of a velocity that nobody measured."""


def is_planar(twist: TwistSamples) -> bool:
    """Whether velocities are forward only: the zeros beside them are set, not measured."""
    velocity = np.abs(twist.velocity[np.isfinite(twist.velocity).all(axis=1)])
    if not len(velocity):
        return False
    return bool(velocity[:, 1:].max() <= ROUNDING * velocity[:, 0].max())


def forward_alone(twist: TwistSamples) -> BoolArray:
    """(n,) planar velocities beside an IMU that are forward only: of a vehicle that moves.

    What moves sideways is the axle, not the vehicle's origin: 1.4 m before it, in a curve of 10 m,
    the origin goes 140 mrad beside the vehicle's x. Forward velocities are alike all along x.
    """
    return ~(np.abs(twist.velocity[:, 0]) <= STANDING_M_S)


SWING_NS = 200_000_000
"""Over which speeds and yaw rates are averaged before and after an instant, for their change."""


@dataclass(frozen=True)
class WheelModel:
    """What is known of the axle's motion beside its speed.

    Attributes:
        planar: whether velocities are forward only, so that lateral and vertical ones are zero but
            for slip; else they are measured, in vehicle axes at the vehicle's origin.
        yaw_rate: whether the odometry has one.
        slip_rad: 1 sigma of the direction of travel about the axle's z.
        tilt_rad: 1 sigma of roll and pitch against the mean ground.
        correlation_s: of both.
    """

    planar: bool
    yaw_rate: bool
    slip_rad: float
    tilt_rad: float
    correlation_s: float


def wheel_model(twist: TwistSamples, config: Config) -> WheelModel:
    """The model of a drive's odometry."""
    return WheelModel(
        planar=is_planar(twist),
        yaw_rate=twist.yaw_rate is not None,
        slip_rad=math.radians(config.wheels.slip_sigma_deg),
        tilt_rad=math.radians(config.wheels.tilt_sigma_deg),
        correlation_s=config.wheels.correlation_s,
    )


def wheel_samples(twist: TwistSamples, name: str) -> tuple[Inertial, tuple[str, ...]]:
    """Rates and accelerations of the axle as far as they are measured, every `STEP_NS` or denser.

    The rate about z is the odometry's yaw rate; all else reads zero. Also lines about what was left
    out.

    Raises:
        TrajectoryError: too few velocities are left.
    """
    stamps = np.asarray(twist.stamps_ns, np.int64)[np.isfinite(twist.velocity).all(axis=1)]
    if len(stamps) < 2:
        raise TrajectoryError(
            f"{name}: {len(stamps)} usable velocities, needs at least 2. Choose another "
            "topics.twist, or remove it"
        )
    nothing = np.zeros((len(stamps), 3))
    piece, lines = longest_piece(Inertial(stamps, nothing, nothing, NO_GAPS), name, "velocities")
    begin, end = piece.begin_ns, piece.end_ns
    at = np.unique(np.concatenate([np.arange(begin, end, STEP_NS), piece.stamps_ns]))
    rates = np.zeros((len(at), 3))
    if twist.yaw_rate is not None:
        known = np.isfinite(twist.yaw_rate)
        rates[:, 2:] = interpolate(at, twist.stamps_ns[known], twist.yaw_rate[known, None])
    return Inertial(at, rates, np.zeros((len(at), 3)), piece.gaps_ns), lines


def swing_rates(twist: TwistSamples, at_ns: IntArray) -> Array:
    """(m,) change of the lateral acceleration, forward positive in reverse too, m/s^3, at stamps.

    Of speeds and yaw rates that are means over `SWING_NS`: steps of their numbers are no change.
    """
    assert twist.yaw_rate is not None
    usable = np.isfinite(twist.velocity[:, 0]) & np.isfinite(twist.yaw_rate)
    swing = np.abs(twist.velocity[usable, 0]) * twist.yaw_rate[usable]
    stamps = np.asarray(twist.stamps_ns, np.int64)[usable]
    seconds = (stamps - stamps[0]) * 1e-9
    total = np.append(0.0, np.cumsum(0.5 * (swing[1:] + swing[:-1]) * np.diff(seconds)))
    at = (at_ns - stamps[0]) * 1e-9
    half = SWING_NS * 1e-9
    ahead, here, behind = (np.interp(at + shift, seconds, total) for shift in (half, 0.0, -half))
    return np.asarray((ahead - 2.0 * here + behind) / half**2)


def wheel_noise(twist: TwistSamples, config: Config) -> ImuNoise:
    """The noise of `wheel_samples`, and the walks of what they do not measure."""
    model, noise = wheel_model(twist, config), config.noise
    T = model.correlation_s
    rolling, rolling_walk = math.sqrt(2.0) * model.tilt_rad / T, tilt_walk(model)
    sources = {"roll and pitch": "wheels.tilt_sigma_deg", "braking": "a usual drive"}
    yaw, bias, walk = STEADY_RAD_S**2, TURNING_RAD_S, STEERING_RAD_S2
    if not model.yaw_rate:
        sources["steering"] = "a usual drive"
    else:
        sigma, sources["yaw rate"] = _yaw_rate_sigma(twist, config)
        dt = float(np.median(np.diff(twist.stamps_ns))) * 1e-9
        yaw, bias = sigma**2 * dt, noise.gyroscope_bias_rad_s
        walk = noise.gyroscope_bias_walk_rad_s2_sqrthz or YAW_RATE_WALK_RAD_S2
    return ImuNoise(
        gyro_density=np.diag([STEADY_RAD_S**2, STEADY_RAD_S**2, yaw]),
        force_density=VIBRATION_M_S2**2 * np.eye(3),
        gyro_walk=np.array([rolling_walk, rolling_walk, walk]),
        force_walk=np.array(JERK_M_S3),
        gyro_bias=np.array([rolling, rolling, bias]),
        force_bias=np.full(3, ACCELERATION_M_S2),
        sources=sources,
    )


def scaled_wheel_noise(noise: ImuNoise, scales: Mapping[str, float]) -> ImuNoise:
    """The noise with the levels that the data contradict multiplied (`variances.COMPONENTS`)."""
    yaw = np.array([1.0, 1.0, scales.get("yaw_rate", 1.0)])
    braking = scales.get("braking", 1.0)
    return replace(
        noise,
        gyro_density=noise.gyro_density * np.outer(yaw, yaw),
        gyro_walk=noise.gyro_walk * np.array([1.0, 1.0, scales.get("steering", 1.0)]),
        force_density=noise.force_density * braking**2,
        force_walk=noise.force_walk * braking,
    )


def _yaw_rate_sigma(twist: TwistSamples, config: Config) -> tuple[float, str]:
    """1 sigma of a yaw rate, rad/s, and its source."""
    if config.noise.yaw_rate_rad_s is not None:
        return config.noise.yaw_rate_rad_s, "config"
    variance = twist.yaw_rate_var
    if variance is not None and np.isfinite(variance).any():
        return math.sqrt(float(np.nanmedian(variance))), "messages"
    return PAPER_GYRO_RAD_S, "that of a gyroscope in the paper's table"


def wheel_covariances(twist: TwistSamples, model: WheelModel, config: Config) -> tuple[Array, str]:
    """(n, 3, 3) (m/s)^2 of the velocities, and the source of the forward ones' figures.

    Of planar velocities, in the axle's frame, lateral and vertical ones are those of slip and tilt:
    correlated over time, so that neighbours count as one.
    """
    cov, source = velocity_covariances(twist, config)
    if not model.planar:
        return cov, source
    dt = float(np.median(np.diff(twist.stamps_ns))) * 1e-9
    alike = max(2.0 * model.correlation_s / dt, 1.0)
    speed2 = twist.velocity[:, 0] ** 2
    out: Array = np.zeros((len(speed2), 3, 3))
    out[:, 0, 0] = cov[:, 0, 0]
    for axis, sigma in ((1, model.slip_rad), (2, math.hypot(model.slip_rad, model.tilt_rad))):
        out[:, axis, axis] = (sigma**2 * speed2 + LEAST_SLIP_M_S**2) * alike
    return out, source


def node_spans_s(nodes_ns: IntArray) -> Array:
    """(n,) time that each node stands for: half of that to its neighbours."""
    steps = np.diff(nodes_ns) * 1e-9
    return np.asarray(0.5 * (np.append(steps, 0.0) + np.append(0.0, steps)), np.float64)


def tilt_walk(model: WheelModel) -> float:
    """rad/s^2/sqrt(Hz), random walk of the rates about x and y of a body on its springs.

    Of variance s^2 and integral time T of roll and pitch, with `level_sigmas`.
    """
    return math.sqrt(8.0 / model.correlation_s**3) * model.tilt_rad


def level_sigmas(nodes_ns: IntArray, model: WheelModel) -> Array:
    """(n,) 1 sigma of `level_factor` at the nodes, radians.

    With rates that walk (`tilt_walk`) the pull to level makes roll and pitch a process of variance
    s^2 and integral time T that has a rate: its information is a chain.
    """
    density = 2.0 * model.tilt_rad**2 * model.correlation_s
    return np.asarray(np.sqrt(density / node_spans_s(nodes_ns)))


def accelerations(
    twist: TwistSamples,
    nodes_ns: IntArray,
    dead: DeadReckoning,
    R_wheels_twist: Array,
    late_ns: int = 0,
) -> Array:
    """(n, 2) m/s^2 of the axle ahead and to the left at the nodes, over half a second.

    Args:
        twist: velocities in axes of their own.
        nodes_ns: (n,) stamps.
        dead: the axle's rates.
        R_wheels_twist: (3, 3) from those axes.
        late_ns: the stamps of the velocities less the true times.
    """
    usable = np.isfinite(twist.velocity).all(axis=1)
    stamps = np.asarray(twist.stamps_ns, np.int64)[usable] - late_ns
    speeds = twist.velocity[usable] @ R_wheels_twist[:1].T
    begin, end = (np.clip(nodes_ns + shift, stamps[0], stamps[-1]) for shift in (-LEAN_NS, LEAN_NS))
    before, after = (interpolate(at, stamps, speeds)[:, 0] for at in (begin, end))
    # Beyond the velocities, where a late clock leaves nodes without any, they are held.
    ahead = (after - before) / (np.maximum(end - begin, 1) * 1e-9)
    rates = dead.rates(nodes_ns, LEAN_NS)[:, 2]
    return np.column_stack([ahead, 0.5 * (before + after) * rates])


def normal_of(slope: Array) -> Array:
    """(3,) unit normal of ground that rises by `slope` (2,) along the map's x and y."""
    normal = np.array([-slope[0], -slope[1], 1.0])
    return np.asarray(normal / np.linalg.norm(normal))
