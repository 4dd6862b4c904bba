"""How a vehicle moves, and what its IMU, GNSS, wheels and odometry report.

Nothing here is imported from caliv_graph: see `_foreign_drives.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.signal import bilinear, lfilter
from scipy.spatial.transform import Rotation

from scripts._foreign_draws import Draws
from scripts._foreign_world import Array, Ground

Segment = tuple[float, float, float]
"""Duration (s), speed (m/s), curvature (1/m)."""

STEP_S = 0.002
"""Step of the integration of the path."""

KEPT_STEPS = 5
"""Every so many steps are a knot of the motion."""

EARTH_RAD_S = 7.292115e-5
SEMI_MAJOR_M = 6378137.0
ECCENTRICITY_SQUARED = 0.00669437999014
"""Of WGS84."""

STATED_M = (0.01, 0.01, 0.018)
STATED_WORSE_M = (0.18, 0.18, 0.3)
"""Sigmas that fixes state."""


def gauss_markov(
    rng: np.random.Generator, t_s: Array, time_s: float, sigma: float, count: int
) -> Array:
    """(n, count) first-order Gauss-Markov noise at ascending times."""
    out = np.empty((len(t_s), count))
    out[0] = rng.normal(size=count)
    step = rng.normal(size=(len(t_s), count))
    for k in range(1, len(t_s)):
        decay = np.exp(-(t_s[k] - t_s[k - 1]) / time_s)
        out[k] = decay * out[k - 1] + np.sqrt(1 - decay * decay) * step[k]
    return sigma * out


@dataclass(frozen=True)
class Body:
    """Size and springs of a vehicle; the axle frame is on the ground below the rear axle.

    Attributes:
        wheelbase_m: between the axles.
        track_m: between the wheels of an axle.
        frequency_hz: of the body on its springs.
        damping: ratio.
        roll_gain_rad: roll per m/s2 of lateral acceleration.
        pitch_gain_rad: pitch per m/s2 of longitudinal acceleration.
        slip_gain_rad: side slip of the rear axle per m/s2 of lateral acceleration.
    """

    wheelbase_m: float = 2.7
    track_m: float = 1.55
    frequency_hz: float = 1.5
    damping: float = 0.35
    roll_gain_rad: float = 0.0055
    pitch_gain_rad: float = 0.0030
    slip_gain_rad: float = 0.004


@dataclass(frozen=True)
class Course:
    """The path of the rear axle before side slip, (n, ...) at equal steps."""

    t_s: Array
    speed_m_s: Array
    curvature: Array

    @property
    def yaw_rad(self) -> Array:
        return np.asarray(
            cumulative_trapezoid(self.speed_m_s * self.curvature, self.t_s, initial=0)
        )

    @property
    def xy_m(self) -> Array:
        yaw = self.yaw_rad
        east = cumulative_trapezoid(self.speed_m_s * np.cos(yaw), self.t_s, initial=0)
        north = cumulative_trapezoid(self.speed_m_s * np.sin(yaw), self.t_s, initial=0)
        return np.column_stack([east, north])


@dataclass(frozen=True)
class Motion:
    """The axle frame over time.

    Attributes:
        t: (n,) times of the knots, s.
        values: spline of x, y, z, roll, pitch, yaw (m, rad).
        speed_m_s: (n,) along the course, in plan.
        yaw_rate_rad_s: (n,) of the course.
    """

    t: Array
    values: CubicSpline
    speed_m_s: Array
    yaw_rate_rad_s: Array

    def pose(self, t_s: Array) -> tuple[Array, Array]:
        """Rotations (n, 3, 3) and positions (n, 3) in the world."""
        values = self.values(np.clip(t_s, self.t[0], self.t[-1]))
        return Rotation.from_euler("ZYX", values[:, 5:2:-1]).as_matrix(), values[:, :3]

    def rates(self, t_s: Array) -> Array:
        """(n, 3) angular velocities in axes of the body."""
        _, _, _, roll, pitch, _ = self.values(t_s).T
        _, _, _, d_roll, d_pitch, d_yaw = self.values(t_s, 1).T
        return np.column_stack(
            [
                d_roll - d_yaw * np.sin(pitch),
                d_pitch * np.cos(roll) + d_yaw * np.cos(pitch) * np.sin(roll),
                -d_pitch * np.sin(roll) + d_yaw * np.cos(pitch) * np.cos(roll),
            ]
        )


def plan(draws: Draws, segments: Sequence[Segment]) -> Course:
    """The course of a driver who follows segments smoothly and not quite steadily."""
    rng = draws.stream("driver")
    counts = [round(segment[0] / STEP_S) for segment in segments]
    speed: Array = np.repeat([float(segment[1]) for segment in segments], counts)
    curvature: Array = np.repeat([float(segment[2]) for segment in segments], counts)
    speed = gaussian_filter1d(speed, 0.9 / STEP_S, mode="nearest")
    speed = np.where(np.abs(speed) < 0.02, 0.0, speed)
    curvature = gaussian_filter1d(curvature, 0.6 / STEP_S, mode="nearest")
    t_s = STEP_S * np.arange(len(speed), dtype=float)
    shake = gaussian_filter1d(rng.normal(size=(2, len(t_s))), 0.5 / STEP_S, axis=1)
    shake /= shake.std(axis=1, keepdims=True)
    if draws.on("driver"):
        speed = speed * (1 + 0.04 * shake[0])
        curvature = curvature + 0.006 * shake[1] * np.clip(np.abs(speed), 0, 1)
    speed = gaussian_filter1d(speed, 0.15 / STEP_S)
    curvature = gaussian_filter1d(curvature, 0.1 / STEP_S)
    return Course(t_s, np.asarray(speed, float), np.asarray(curvature, float))


def drive(draws: Draws, course: Course, ground: Ground, body: Body) -> Motion:
    """The motion of a body that rolls over the ground on its springs."""
    speed = course.speed_m_s
    forward, lateral = np.gradient(speed, STEP_S), speed**2 * course.curvature
    xy, yaw = course.xy_m, course.yaw_rad
    if draws.on("slip"):
        yaw = yaw + body.slip_gain_rad * gaussian_filter1d(np.sign(speed) * lateral, 0.1 / STEP_S)
    ahead = np.column_stack([np.cos(yaw), np.sin(yaw)])
    left = np.column_stack([-np.sin(yaw), np.cos(yaw)])

    def wheel(axle: int, side: int) -> Array:
        """Heights of a wheel, which is not a point."""
        place = xy + axle * body.wheelbase_m * ahead + side * body.track_m / 2 * left
        return np.asarray(gaussian_filter1d(ground.z(place), 0.06 / STEP_S))

    left_rear, right_rear, left_front, right_front = (
        wheel(axle, side) for axle in (0, 1) for side in (1, -1)
    )
    rear, front = (left_rear + right_rear) / 2, (left_front + right_front) / 2
    across = (left_rear - right_rear + left_front - right_front) / 2 / body.track_m
    road = np.column_stack([rear, across, -(front - rear) / body.wheelbase_m])
    w, d = 2 * np.pi * body.frequency_hz, body.damping
    numerator, denominator = bilinear([2 * d * w, w * w], [1, 2 * d * w, w * w], 1 / STEP_S)
    sprung = lfilter(numerator, denominator, road - road[0], axis=0) + road[0]
    numerator, denominator = bilinear([w * w], [1, 2 * d * w, w * w], 1 / STEP_S)
    lean = draws.on("springs") * np.column_stack(
        [
            body.roll_gain_rad * lfilter(numerator, denominator, lateral),
            -body.pitch_gain_rad * lfilter(numerator, denominator, forward),
        ]
    )
    tilt = np.arctan(sprung[:, 1:]) + lean
    kept = slice(None, None, KEPT_STEPS)
    t = course.t_s[kept]
    values = np.column_stack([xy, sprung[:, 0], tilt, yaw])[kept]
    return Motion(t, CubicSpline(t, values), speed[kept], (speed * course.curvature)[kept])


@dataclass(frozen=True)
class Imu:
    """An IMU: its data sheet and its mounting in the axle frame, in SI units.

    Attributes:
        rate_hz: samples per second.
        xyz_m: position.
        rpy_rad: rotation to the axle frame.
        accel_density: white noise, m/s2/sqrt(Hz); 0.0012 are about 120 ug.
        gyro_density: white noise, rad/s/sqrt(Hz); 1.2e-4 are about 0.4 deg/sqrt(h).
        accel_bias: sigma at the start.
        gyro_bias: sigma at the start.
        accel_walk: random walk of the bias per sqrt(s).
        gyro_walk: random walk of the bias per sqrt(s).
        vibration_m_s2: while rolling.
        orientation: whether it is an INS, with slow errors of 0.03 and 0.1 degrees.
    """

    rate_hz: float = 200.0
    xyz_m: tuple[float, float, float] = (0.2, 0.1, 0.5)
    rpy_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    accel_density: float = 0.0012
    gyro_density: float = 1.2e-4
    accel_bias: float = 0.03
    gyro_bias: float = 0.003
    accel_walk: float = 2e-4
    gyro_walk: float = 1e-5
    vibration_m_s2: float = 0.08
    orientation: bool = False


@dataclass(frozen=True)
class ImuSamples:
    """(n, ...) times, specific forces, angular rates and orientations (x, y, z, w)."""

    t_s: Array
    force_m_s2: Array
    rate_rad_s: Array
    xyzw: Array


def gravity_m_s2(latitude_deg: float, altitude_m: float) -> float:
    """Normal gravity of WGS84 (Somigliana), with the free-air gradient."""
    s = np.sin(np.radians(latitude_deg)) ** 2
    level = 9.7803253359 * (1 + 0.00193185265241 * s) / np.sqrt(1 - ECCENTRICITY_SQUARED * s)
    return float(level - 3.086e-6 * altitude_m)


def measure_imu(
    draws: Draws, motion: Motion, imu: Imu, latitude_deg: float, altitude_m: float
) -> ImuSamples:
    """What the IMU reports on the turning Earth."""
    rng = draws.stream("imu")
    t = np.arange(motion.t[0] + 0.004, motion.t[-1] - 0.02, 1 / imu.rate_hz)
    n, root_hz = len(t), np.sqrt(imu.rate_hz)
    rotation, _ = motion.pose(t)
    rate = motion.rates(t)
    force = _force_at(motion, t, np.array(imu.xyz_m), gravity_m_s2(latitude_deg, altitude_m))
    latitude = np.radians(latitude_deg)
    earth = EARTH_RAD_S * np.array([0, np.cos(latitude), np.sin(latitude)])
    rate = rate + np.einsum("nji,j->ni", rotation, earth)

    off = draws.on("imu_misalign")
    mount = Rotation.from_euler("xyz", imu.rpy_rad).as_matrix()
    mount = mount @ Rotation.from_rotvec(off * 1e-3 * rng.normal(size=3)).as_matrix()
    gyro_to_accel = Rotation.from_rotvec(off * 5e-4 * rng.normal(size=3)).as_matrix()
    force, rate = force @ mount, rate @ mount @ gyro_to_accel
    for values in (force, rate):
        values *= 1 + draws.on("imu_scale") * 1e-3 * rng.normal(size=3)

    noise, walk = rng.normal(size=(2, n, 3)), rng.normal(size=(2, n, 3))
    bias = rng.normal(size=(2, 3))
    if draws.on("imu_noise"):
        force += imu.accel_density * root_hz * noise[0]
        rate += imu.gyro_density * root_hz * noise[1]
    if draws.on("imu_bias"):
        force += imu.accel_bias * bias[0] + imu.accel_walk / root_hz * np.cumsum(walk[0], 0)
        rate += imu.gyro_bias * bias[1] + imu.gyro_walk / root_hz * np.cumsum(walk[1], 0)
    rolling = np.clip(np.abs(np.interp(t, motion.t, motion.speed_m_s)) / 2, 0.05, 1)[:, None]
    engine = np.sin(2 * np.pi * 27.3 * t[:, None] + rng.uniform(0, 6.28, 3))
    vibration = draws.on("vibration") * imu.vibration_m_s2 * rolling
    force += vibration * (rng.normal(size=(n, 3)) + 1.2 * engine)
    rate += 0.02 * vibration * rng.normal(size=(n, 3))
    if draws.on("imu_quantisation"):
        force, rate = np.round(force / 6e-4) * 6e-4, np.round(rate / 1.3e-4) * 1.3e-4

    level, yaw = gauss_markov(rng, t, 60, 5e-4, 2), gauss_markov(rng, t, 80, 1.7e-3, 1)
    error = np.column_stack([level, yaw]) + 1.5e-4 * rng.normal(size=(n, 3))
    turned = Rotation.from_rotvec(draws.on("ins") * error) * Rotation.from_matrix(rotation @ mount)
    return ImuSamples(t, force, rate, turned.as_quat())


def _force_at(motion: Motion, t: Array, arm_m: Array, gravity: float) -> Array:
    """(n, 3) specific forces at a place of the body, in its axes."""
    rotation, _ = motion.pose(t)
    rate = motion.rates(t)
    turning = (motion.rates(t + 0.001) - motion.rates(t - 0.001)) / 0.002
    # Second differences of positions over 5 ms, as samples are averages.
    h = 0.0025
    before, now, after = (motion.values(t + step)[:, :3] for step in (-h, 0.0, h))
    acceleration = (after - 2 * now + before) / h**2
    acceleration[:, 2] += gravity
    of_axle = np.einsum("nji,nj->ni", rotation, acceleration)
    return np.asarray(
        of_axle + np.cross(turning, arm_m) + np.cross(rate, np.cross(rate, arm_m)), float
    )


@dataclass(frozen=True)
class Gnss:
    """An RTK receiver.

    Attributes:
        rate_hz: fixes per second.
        antenna_m: position of the antenna in the axle frame.
        white_m: white errors east and north; 1.6 times that up.
        slow_m: slow errors, likewise.
        time_s: correlation time of the slow errors.
        worse_s: begin and end of a stretch of worse fixes, which their messages state.
    """

    rate_hz: float = 5.0
    antenna_m: tuple[float, float, float] = (0.8, 0.1, 1.6)
    white_m: float = 0.004
    slow_m: float = 0.012
    time_s: float = 50.0
    worse_s: tuple[float, float] | None = None


@dataclass(frozen=True)
class Fixes:
    """(n, ...) times, times of arrival, positions of the antenna in the world, stated sigmas."""

    t_s: Array
    arrival_s: Array
    position_m: Array
    sigma_m: Array


def measure_gnss(draws: Draws, motion: Motion, gnss: Gnss) -> Fixes:
    """What the receiver reports."""
    rng = draws.stream("gnss")
    worse = draws.stream("gnss worse")  # others draw the same without
    t = np.arange(motion.t[0] + 0.03, motion.t[-1] - 0.05, 1 / gnss.rate_hz)
    rotation, position = motion.pose(t)
    up = np.array([1, 1, 1.6])
    fix = position + rotation @ np.array(gnss.antenna_m)
    fix += draws.on("gnss_white") * gnss.white_m * up * rng.normal(size=fix.shape)
    slow = 0.8 * gauss_markov(rng, t, gnss.time_s, 1, 3)
    slow += 0.6 * gauss_markov(rng, t, gnss.time_s / 5, 1, 3)
    fix += draws.on("gnss_slow") * gnss.slow_m * up * slow
    stated = np.tile(np.array(STATED_M), (len(t), 1))
    if gnss.worse_s is not None and draws.on("gnss_worse"):
        bad = (t > gnss.worse_s[0]) & (t < gnss.worse_s[1])
        fix[bad] += gauss_markov(worse, t[bad], 4, 0.12, 3)
        fix[bad] += 0.05 * worse.normal(size=(int(bad.sum()), 3))
        stated[bad] = STATED_WORSE_M
    return Fixes(t, t + 0.03 + 0.02 * rng.random(len(t)), fix, stated)


def geodetic(enu_m: Array, latitude_deg: float, longitude_deg: float, altitude_m: float) -> Array:
    """(n, 3) latitude, longitude (deg) and altitude (m) of points around an origin."""
    a, e2 = SEMI_MAJOR_M, ECCENTRICITY_SQUARED
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    sp, cp = np.sin(latitude), np.cos(latitude)
    sq, cq = np.sin(longitude), np.cos(longitude)
    n = a / np.sqrt(1 - e2 * sp * sp)
    origin = np.array(
        [
            (n + altitude_m) * cp * cq,
            (n + altitude_m) * cp * sq,
            (n * (1 - e2) + altitude_m) * sp,
        ]
    )
    axes = np.array([[-sq, -sp * cq, cp * cq], [cq, -sp * sq, cp * sq], [0, cp, sp]])
    x, y, z = (origin + enu_m @ axes.T).T
    from_axis = np.hypot(x, y)
    phi = np.full(len(x), latitude)
    for _ in range(8):
        n = a / np.sqrt(1 - e2 * np.sin(phi) ** 2)
        phi = np.arctan2(z + e2 * n * np.sin(phi), from_axis)
    n = a / np.sqrt(1 - e2 * np.sin(phi) ** 2)
    height = from_axis * np.cos(phi) + z * np.sin(phi) - a * a / n
    return np.column_stack([np.degrees(phi), np.degrees(np.arctan2(y, x)), height])


@dataclass(frozen=True)
class WheelSamples:
    """(n,) times, speeds of the rear axle and yaw rates."""

    t_s: Array
    speed_m_s: Array
    yaw_rate_rad_s: Array


def measure_wheels(draws: Draws, motion: Motion, rate_hz: float = 50.0) -> WheelSamples:
    """What the wheels report."""
    rng = draws.stream("wheels")
    t = np.arange(motion.t[0] + 0.01, motion.t[-1] - 0.02, 1 / rate_hz)
    noise = draws.on("wheel_noise")
    level = np.interp(t, motion.t, motion.speed_m_s)
    # Wheels roll along the road, the course is its plan.
    speed = np.sign(level) * np.hypot(level, motion.values(t, 1)[:, 2])
    speed *= 1 + 0.007 * rng.normal() * draws.on("wheel_scale")
    speed += noise * 0.01 * rng.normal(size=len(t)) * (np.abs(speed) > 0.01)
    if draws.on("wheel_quantisation"):
        speed = np.round(speed / 0.02) * 0.02
    yaw_rate = np.interp(t, motion.t, motion.yaw_rate_rad_s)
    return WheelSamples(t, speed, yaw_rate + noise * 0.004 * rng.normal(size=len(t)))


@dataclass(frozen=True)
class PoseSamples:
    """(n, ...) times, positions and orientations (x, y, z, w) of the axle frame."""

    t_s: Array
    position_m: Array
    xyzw: Array


def measure_poses(
    draws: Draws, motion: Motion, rate_hz: float = 20.0, time_s: float = 8.0
) -> PoseSamples:
    """What an odometry reports that errs slowly and drifts."""
    rng = draws.stream("odometry")
    t = np.arange(motion.t[0] + 0.01, motion.t[-1] - 0.02, 1 / rate_hz)
    rotation, position = motion.pose(t)
    n, white, slow = len(t), draws.on("pose_white"), draws.on("pose_slow")
    position = position + white * 0.002 * rng.normal(size=(n, 3))
    position += gauss_markov(rng, t, time_s, 0.008 * slow, 3)
    error = white * 2e-4 * rng.normal(size=(n, 3)) + gauss_markov(rng, t, time_s, 5e-4 * slow, 3)
    drift = 0.002 / np.sqrt(rate_hz) * np.cumsum(rng.normal(size=(n, 3)), 0)
    position += draws.on("pose_drift") * drift
    turned = Rotation.from_rotvec(error) * Rotation.from_matrix(rotation)
    return PoseSamples(t, position, turned.as_quat())
