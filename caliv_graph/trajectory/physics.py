"""The raw sensors of a drive against each other and against `imu.T_vehicle_imu`, in closed form.

Nothing is smoothed here, so it finds why smoothing fails. `README.md`, section 13; the sentences
are in `wording.physics`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from caliv_graph.common.statistics import MAD
from caliv_graph.config.heading import HeadingAxes
from caliv_graph.config.model import Config
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import (
    Array,
    BoolArray,
    HeadingSamples,
    IntArray,
    MotionData,
    TwistSamples,
)
from caliv_graph.trajectory.alignment import level
from caliv_graph.trajectory.antennas import azimuth_of
from caliv_graph.trajectory.axes import SIGMAS, Axes, accelerometer_axes
from caliv_graph.trajectory.gnss import Positions, positions_in_map
from caliv_graph.trajectory.imu import Inertial, clean_inertial, interpolate, log_so3
from caliv_graph.trajectory.inputs import has_orientation
from caliv_graph.trajectory.kinematics import (
    MIN_WINDOWS,
    OVERLAP,
    Windows,
    antenna_windows,
    means_over,
)
from caliv_graph.trajectory.measurements import (
    nearest_node,
    rotations_of,
    usable_orientations,
)
from caliv_graph.trajectory.wheels import wheel_samples

MIN_SPEED_M_S = 0.5
"""Below, the course of a GNSS antenna is noise: 15 mm/s of it are 2 degrees."""

MIN_TURN_RAD_S = 0.03
"""Root mean square of the turning rate from which a gyroscope can be compared: 2 degrees per
second, three times the prior of its bias."""


@dataclass(frozen=True)
class Gravity:
    """Direction of the mean specific force, which is up.

    Attributes:
        up_imu: (3,) unit vector, imu frame.
        up_vehicle: (3,) the same in vehicle axes, by the configured `T_vehicle_imu`.
    """

    up_imu: Array
    up_vehicle: Array

    @property
    def tilt_rad(self) -> float:
        """Angle between up and the vehicle's +z."""
        return math.acos(float(np.clip(self.up_vehicle[2], -1.0, 1.0)))

    @property
    def roll_pitch_deg(self) -> tuple[float, float]:
        """Roll and pitch of `T_vehicle_imu` that would make gravity vertical, whatever the yaw."""
        x, y, z = self.up_imu
        return math.degrees(math.atan2(y, z)), math.degrees(math.atan2(-x, math.hypot(y, z)))


@dataclass(frozen=True)
class Ratio:
    """A measured rate over the true one, by least squares.

    Attributes:
        against: `course` (GNSS), `orientation` (of the IMU's messages), or `gnss` (speeds).
        value: 1 if all is well.
        sigma: of it.
    """

    against: str
    value: float
    sigma: float


@dataclass(frozen=True)
class Misheading:
    """Angles of two antennas against the course of one of them.

    Attributes:
        off_rad: median of measured less true by the config's direction, to the left.
        spread_rad: median deviation from it.
        other_off_rad: the median if the angles counted the other way (`heading.axes`).
        other_spread_rad: the deviation then.
    """

    off_rad: float
    spread_rad: float
    other_off_rad: float
    other_spread_rad: float


@dataclass(frozen=True)
class MotionPhysics:
    """What the raw sensors say about each other; None: the drive does not say it.

    Attributes:
        name: of the recording.
        gravity: its direction; None without an IMU.
        gyroscope: its rate about the vertical over the true one, by each source.
        yaw_rate: that of the odometry over that of the course, without an IMU.
        speed: of the velocities over that of the GNSS.
        axes: of the accelerometer.
        heading: of two antennas against the course.
        oriented: whether the IMU's messages carry orientations.
    """

    name: str
    gravity: Gravity | None
    gyroscope: tuple[Ratio, ...] = ()
    speed: Ratio | None = None
    axes: Axes | None = None
    yaw_rate: Ratio | None = None
    heading: Misheading | None = None
    oriented: bool = False


def known_rotation(config: Config) -> Array | None:
    """(3, 3) R_vehicle_imu as the user gave it; None: it is left to the data."""
    mounting = config.imu.T_vehicle_imu
    return None if mounting.rpy_deg is None else mounting.pose().rotation().matrix()


def motion_physics(motion: MotionData, config: Config) -> MotionPhysics | None:
    """Compares the raw sensors of a drive; None with neither an IMU nor velocities.

    Raises:
        TrajectoryError: the IMU's samples or the fixes are unusable, or its orientation and its
            accelerometer disagree on where up is.
    """
    if motion.imu is None:
        return None if motion.twist is None else _wheel_physics(motion, motion.twist, config)
    inertial, _ = clean_inertial(motion.imu, motion.name)
    oriented = has_orientation(motion.imu, inertial, motion.name)
    mean = inertial.force.mean(axis=0)
    up_imu = mean / np.linalg.norm(mean)
    R_vehicle_imu = known_rotation(config)
    if R_vehicle_imu is None:
        R_vehicle_imu = level(up_imu)
    gravity = Gravity(up_imu, R_vehicle_imu @ up_imu)
    turn = (inertial.gyro @ up_imu)[:, None]
    ratios = []
    by_orientation = _gyro_by_orientation(motion, inertial, turn, config)
    if by_orientation is not None:
        ratios.append(by_orientation)
    windows = _windows(motion, config, inertial)
    if windows is None:
        return MotionPhysics(motion.name, gravity, tuple(ratios))
    moving = windows.where(windows.speed_m_s > MIN_SPEED_M_S)
    axes = accelerometer_axes(moving, inertial, motion, R_vehicle_imu, config)
    moving = _at_true_times(moving, axes)
    by_course = _gyro_by_course(moving, inertial, turn, config)
    if by_course is not None:
        ratios.insert(0, by_course)
    speed = _speed(motion, moving)
    heading = _heading_by_course(motion, moving, config)
    return MotionPhysics(
        motion.name, gravity, tuple(ratios), speed, axes, heading=heading, oriented=oriented
    )


def _at_true_times(moving: Windows, axes: Axes | None) -> Windows:
    """Windows of fixes whose clock is certainly off, in the clock of the IMU."""
    delay = None if axes is None else axes.certain_delay_s
    if delay is None:
        return moving
    by_ns = round(delay[0] * NANOSECONDS_PER_SECOND)
    return replace(moving, stamps_ns=moving.stamps_ns - by_ns)


def _wheel_physics(motion: MotionData, twist: TwistSamples, config: Config) -> MotionPhysics | None:
    """Speed and yaw rate of wheels against the fixes; None without enough of them."""
    samples, _ = wheel_samples(twist, motion.name)
    windows = _windows(motion, config, samples)
    if windows is None:
        return None
    moving = windows.where(windows.speed_m_s > MIN_SPEED_M_S)
    turn = None
    if twist.yaw_rate is not None:
        turn = _gyro_by_course(moving, samples, samples.gyro[:, 2:], config)
    heading = _heading_by_course(motion, moving, config)
    speed = _speed(motion, moving)
    return MotionPhysics(motion.name, None, speed=speed, yaw_rate=turn, heading=heading)


def _heading_by_course(motion: MotionData, moving: Windows, config: Config) -> Misheading | None:
    """The angles of two antennas against the course; None without enough of either."""
    samples = motion.heading
    if not isinstance(samples, HeadingSamples) or len(moving.stamps_ns) < MIN_WINDOWS:
        return None
    begin, end = samples.stamps_ns[[0, -1]]
    moving = moving.where((moving.stamps_ns >= begin) & (moving.stamps_ns <= end))
    if len(moving.stamps_ns) < MIN_WINDOWS:
        return None
    v = moving.velocity_map
    ahead = np.where(_backwards(motion, moving.stamps_ns), -1.0, 1.0)
    course = np.arctan2(ahead * v[:, 1], ahead * v[:, 0]) + config.heading.yaw_rad
    near = nearest_node(samples.stamps_ns, moving.stamps_ns)
    out: list[float] = []
    axes = config.heading.axes
    other: HeadingAxes = "ned" if axes == "enu" else "enu"
    for counted in (axes, other):
        off = azimuth_of(samples.yaw_rad[near], counted) - course
        mean = float(np.angle(np.exp(1j * off).sum()))
        around = np.angle(np.exp(1j * (off - mean)))
        middle = float(np.median(around))
        out += [math.remainder(mean + middle, math.tau), float(np.median(np.abs(around - middle)))]
    return Misheading(*out)


def _backwards(motion: MotionData, stamps_ns: IntArray) -> BoolArray:
    """(n,) whether velocities say that the vehicle reverses."""
    twist = motion.twist
    if twist is None or len(twist.stamps_ns) < MIN_WINDOWS:
        return np.zeros(len(stamps_ns), dtype=bool)
    return np.asarray(interpolate(stamps_ns, twist.stamps_ns, twist.velocity[:, :1])[:, 0] < 0.0)


def _windows(motion: MotionData, config: Config, inertial: Inertial) -> Windows | None:
    """Windows with fixes in the IMU's span; None without enough of them."""
    if motion.gnss is None or not len(motion.gnss.stamps_ns):
        return None
    positions: Positions = positions_in_map(motion.gnss, config, motion.name)[0]
    windows = antenna_windows(positions, inertial.begin_ns, inertial.end_ns)
    return windows if len(windows.stamps_ns) >= MIN_WINDOWS else None


def _ratio(measured: Array, true: Array, offset_sigma: float, against: str) -> Ratio | None:
    """`measured = ratio true + offset` by robust least squares; (n,) each, overlapping windows.

    None if `true` says too little.
    """
    usable = np.isfinite(measured) & np.isfinite(true)
    measured, true = measured[usable], true[usable]
    if len(true) < MIN_WINDOWS or float(np.sqrt((true**2).mean())) < MIN_TURN_RAD_S:
        return None
    A = np.stack([true, np.ones(len(true))], axis=1)
    found, cov = _robust(A, measured, np.array([np.inf, offset_sigma]))
    return Ratio(against, float(found[0]), float(np.sqrt(cov[0, 0])))


def _robust(A: Array, y: Array, prior_sigma: Array) -> tuple[Array, Array]:
    """Least squares of (n, k) unknowns by Tukey's biweight, with priors about zero, and (k, k) cov.

    Windows overlap: `OVERLAP` of them count as one.
    """
    n, k = A.shape
    weight: Array = np.ones(n)
    found: Array = np.zeros(k)
    scale = 1.0
    prior = np.zeros((k, k))
    for _ in range(10):
        root = np.sqrt(weight)[:, None]
        normal = (A * root).T @ (A * root) / OVERLAP
        found = np.asarray(
            np.linalg.lstsq(normal + prior, (A * weight[:, None]).T @ y / OVERLAP)[0], np.float64
        )
        left = y - A @ found
        scale = max(MAD * float(np.median(np.abs(left))), 1e-9)
        weight = np.clip(1.0 - (left / (4.685 * scale)) ** 2, 0.0, None) ** 2
        # The prior in units of the scatter, which is known after the first round.
        prior = scale**2 * np.diag(1.0 / prior_sigma**2)
    root = np.sqrt(weight)[:, None]
    normal = (A * root).T @ (A * root) / OVERLAP + prior
    return found, np.asarray(scale**2 * np.linalg.pinv(normal))


def _gyro_by_course(
    moving: Windows, inertial: Inertial, turn: Array, config: Config
) -> Ratio | None:
    """The gyroscope against the rate of the course over ground."""
    measured = means_over(inertial.stamps_ns, turn, moving.stamps_ns)[:, 0]
    # The course is the noisier of the two: regressed on the gyroscope, and inverted.
    inverse = _ratio(
        moving.course_rate_rad_s, measured, config.noise.gyroscope_bias_rad_s, "course"
    )
    return _inverted(inverse)


def _inverted(ratio: Ratio | None) -> Ratio | None:
    """The inverse of a ratio, as far as it is one: without correlation it says nothing."""
    if ratio is None or abs(ratio.value) < SIGMAS * ratio.sigma:
        return None
    return Ratio(ratio.against, 1.0 / ratio.value, ratio.sigma / ratio.value**2)


def _gyro_by_orientation(
    motion: MotionData, inertial: Inertial, turn: Array, config: Config
) -> Ratio | None:
    """The gyroscope against the rate of the orientations about the vertical."""
    assert motion.imu is not None
    imu = motion.imu
    usable = usable_orientations(imu)
    usable &= (imu.stamps_ns >= inertial.begin_ns) & (imu.stamps_ns <= inertial.end_ns)
    if imu.orientation_xyzw is None or usable.sum() < MIN_WINDOWS:
        return None
    stamps = np.asarray(imu.stamps_ns, np.int64)[usable]
    # Steps of half a second: ten degrees of turn, far below the ambiguity of half a turn.
    at = np.arange(stamps[0], stamps[-1], 500_000_000, dtype=np.int64)
    chosen = np.unique(np.searchsorted(stamps, at))
    R = rotations_of(imu.orientation_xyzw[usable][chosen])
    begin, end = stamps[chosen[:-1]], stamps[chosen[1:]]
    true = log_so3(R[1:] @ np.swapaxes(R[:-1], 1, 2))[:, 2] / ((end - begin) * 1e-9)
    measured = _mean_between(inertial.stamps_ns, turn[:, 0], begin, end)
    inverse = _ratio(true, measured, config.noise.gyroscope_bias_rad_s, "orientation")
    return _inverted(inverse)


def _mean_between(stamps_ns: IntArray, values: Array, begin: IntArray, end: IntArray) -> Array:
    """(m,) means of samples (n,) from (m,) instants to others, by the trapezoidal rule."""
    seconds = (stamps_ns - stamps_ns[0]) * 1e-9
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(seconds)
    integral = np.concatenate([[0.0], np.cumsum(steps)])
    ends = [np.interp((at - stamps_ns[0]) * 1e-9, seconds, integral) for at in (begin, end)]
    return np.asarray((ends[1] - ends[0]) / ((end - begin) * 1e-9))


def _speed(motion: MotionData, moving: Windows) -> Ratio | None:
    """Speed of the velocities over that of the GNSS."""
    if motion.twist is None:
        return None
    finite = np.isfinite(motion.twist.velocity).all(axis=1)
    speed = np.linalg.norm(motion.twist.velocity[finite, :2], axis=1)[:, None]
    stamps = np.asarray(motion.twist.stamps_ns, np.int64)[finite]
    measured = means_over(stamps, speed, moving.stamps_ns)[:, 0]
    return _ratio(measured, moving.speed_m_s, 0.1, "gnss")
