"""The raw sensors of a drive against each other and against `imu.T_vehicle_imu`, in closed form.

Nothing is smoothed here, so it finds why smoothing fails. `README.md`, section 13; the sentences
are in `wording.physics`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from caliv_graph.config.model import Config
from caliv_graph.products import Array, IntArray, MotionData
from caliv_graph.trajectory.alignment import level
from caliv_graph.trajectory.gnss import Positions, positions_in_map
from caliv_graph.trajectory.imu import Inertial, clean_inertial, log_so3
from caliv_graph.trajectory.inputs import has_orientation
from caliv_graph.trajectory.kinematics import OVERLAP, STEP_NS, Windows, antenna_windows, means_over
from caliv_graph.trajectory.measurements import rotations_of, usable_orientations

MIN_SPEED_M_S = 0.5
"""Below, the course of a GNSS antenna is noise: 15 mm/s of it are 2 degrees."""

MIN_WINDOWS = 12
"""Windows that a comparison is made of: three independent samples."""

MIN_TURN_RAD_S = 0.03
"""Root mean square of the turning rate from which a gyroscope can be compared: 2 degrees per
second, three times the prior of its bias."""

MIN_ACCELERATION_M_S2 = 0.15
"""Root mean square of the horizontal acceleration from which axes can be compared: that of a slope
of 1 degree."""

MAX_DELAY_S = 1.0
DELAY_STEP_S = 0.05
"""Clock offsets that are tried. A larger one is a different clock, which the readers report."""

SLOPE_PRIOR_M_S2 = 0.35
"""1 sigma of gravity's part along a slope of 2 degrees, and of the accelerometer's bias: what the
acceleration of a drive is regressed with."""

SIGMAS = 5.0
"""Of a comparison that is taken as certain."""

LEVER_PRIOR_M = 2.0
"""1 sigma of an error of the lever arm, which looks like a clock offset in curves: no vehicle is
larger."""


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
class Axes:
    """Horizontal specific force in vehicle axes against the acceleration along the path.

    Attributes:
        yaw_rad: by which the vehicle's axes, by `T_vehicle_imu`, are turned against the path.
        sigma_rad: of it.
        ratio: of the measured to the true acceleration, with its sigma.
        mirrored: whether left and right are exchanged: axes that are left-handed.
        delay_s: of the GNSS stamps against those of the IMU, with its sigma; None: not determined.
    """

    yaw_rad: float
    sigma_rad: float
    ratio: tuple[float, float]
    mirrored: bool
    delay_s: tuple[float, float] | None


@dataclass(frozen=True)
class MotionPhysics:
    """What the raw sensors say about each other; None: the drive does not say it.

    Attributes:
        name: of the recording.
        gravity: its direction.
        gyroscope: its rate about the vertical over the true one, by each source.
        speed: of the velocities over that of the GNSS.
        axes: of the accelerometer.
    """

    name: str
    gravity: Gravity
    gyroscope: tuple[Ratio, ...] = ()
    speed: Ratio | None = None
    axes: Axes | None = None


def motion_physics(motion: MotionData, config: Config) -> MotionPhysics | None:
    """Compares the raw sensors of a drive; None without an IMU.

    Raises:
        TrajectoryError: the IMU's samples or the fixes are unusable, or its orientation and its
            accelerometer disagree on where up is.
    """
    if motion.imu is None:
        return None
    inertial, _ = clean_inertial(motion.imu, motion.name)
    has_orientation(motion.imu, inertial, motion.name)
    R_vehicle_imu = config.imu.T_vehicle_imu.pose().rotation().matrix()
    mean = inertial.force.mean(axis=0)
    up_imu = mean / np.linalg.norm(mean)
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
    by_course = _gyro_by_course(moving, inertial, turn, config)
    if by_course is not None:
        ratios.insert(0, by_course)
    speed = _speed(motion, moving)
    axes = _axes(moving, inertial, motion, config)
    return MotionPhysics(motion.name, gravity, tuple(ratios), speed, axes)


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
        scale = max(1.4826 * float(np.median(np.abs(left))), 1e-9)
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
    if ratio is None or abs(ratio.value) < 5.0 * ratio.sigma:
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


def _directions(motion: MotionData, moving: Windows) -> Array:
    """(n,) +1 forward, -1 backward, by the velocities; without them all are forward."""
    if motion.twist is None:
        return np.ones(len(moving.stamps_ns))
    finite = np.isfinite(motion.twist.velocity).all(axis=1)
    stamps = np.asarray(motion.twist.stamps_ns, np.int64)[finite]
    along = means_over(stamps, motion.twist.velocity[finite, :1], moving.stamps_ns)[:, 0]
    return np.where(along < 0.0, -1.0, 1.0)


def _axes(moving: Windows, inertial: Inertial, motion: MotionData, config: Config) -> Axes | None:
    """The accelerometer's horizontal axes against the path; None if it hardly accelerates."""
    v = moving.velocity_map[:, 0] + 1j * moving.velocity_map[:, 1]
    a = moving.acceleration_map[:, 0] + 1j * moving.acceleration_map[:, 1]
    if len(v) < MIN_WINDOWS or float(np.sqrt((np.abs(a) ** 2).mean())) < MIN_ACCELERATION_M_S2:
        return None
    along = _directions(motion, moving) * v / np.abs(v)
    R_vehicle_imu = config.imu.T_vehicle_imu.pose().rotation().matrix()
    up = R_vehicle_imu @ inertial.force.mean(axis=0)
    leveled = np.column_stack([inertial.force, inertial.gyro]) @ np.kron(
        np.eye(2), (level(up) @ R_vehicle_imu).T
    )
    x, y, _ = config.gnss.lever_arm or (0.0, 0.0, 0.0)
    arm = complex(x, y)

    def fit(delay_s: float, mirrored: bool = False) -> _Fit | None:
        means = means_over(inertial.stamps_ns, leveled, moving.stamps_ns, -delay_s)
        return _fit_axes(means, along, a, arm, mirrored)

    plain, mirror = fit(0.0), fit(0.0, mirrored=True)
    if plain is None or mirror is None:
        return None
    delays = np.arange(-MAX_DELAY_S, MAX_DELAY_S + 1e-9, DELAY_STEP_S)
    fits = [fit(delay_s) for delay_s in delays.tolist()]
    scatter = np.array([math.inf if f is None else f.squares / f.dof for f in fits])
    variance = min(float(scatter.min()), mirror.squares / mirror.dof)
    delay = _minimum(delays, scatter * plain.dof / variance)
    better = (plain.squares - mirror.squares) / variance
    mirrored = better > SIGMAS**2 and mirror.squares < plain.dof * float(scatter.min())
    chosen = mirror if mirrored else plain
    size = math.hypot(*chosen.factor)
    if size < SIGMAS * math.sqrt(float(np.linalg.eigvalsh(chosen.cov)[-1])):
        return None
    direction = chosen.factor / size
    across = np.array([-direction[1], direction[0]])
    return Axes(
        # f = size e^(i angle) a: the axes are turned by the opposite angle.
        yaw_rad=-math.atan2(chosen.factor[1], chosen.factor[0]),
        sigma_rad=float(np.sqrt(across @ chosen.cov @ across)) / size,
        ratio=(size, float(np.sqrt(direction @ chosen.cov @ direction))),
        mirrored=mirrored,
        delay_s=None if mirrored else delay,
    )


@dataclass(frozen=True)
class _Fit:
    """Specific force regressed on the acceleration of the path.

    Attributes:
        factor: (2,) real and imaginary part of force over acceleration.
        cov: (2, 2) of it.
        squares: of the residuals and of the priors, (m/s^2)^2, independent samples.
        dof: number of independent samples.
    """

    factor: Array
    cov: Array
    squares: float
    dof: float


def _fit_axes(
    means: Array, along: Array, a_antenna: Array, arm: complex, mirrored: bool
) -> _Fit | None:
    """Regression of forces on accelerations, slope, bias and an error of the lever arm.

    `means` (n, 6) are forces and rates, levelled vehicle axes; `along` and `a_antenna` (n,) the
    direction of travel and the acceleration of the antenna, complex, map axes.
    """
    usable = np.isfinite(means).all(axis=1)
    if usable.sum() < MIN_WINDOWS:
        return None
    means, along, a_antenna = means[usable], along[usable], a_antenna[usable]
    force = means[:, 0] + 1j * means[:, 1]
    turn = means[:, 5]
    # Of the antenna relative to the vehicle's origin, per metre of the lever arm.
    swing = 1j * np.gradient(turn, STEP_NS * 1e-9) - turn**2
    acceleration = a_antenna * along.conj() - swing * arm
    if mirrored:
        acceleration = acceleration.conj()
    one = np.ones(len(force), complex)
    columns = [acceleration, one, along.conj(), swing]
    A = np.stack([c * unit for c in columns for unit in (1.0, 1j)], axis=1)
    A = np.concatenate([A.real, A.imag])
    y = np.concatenate([force.real, force.imag])
    sigma = np.array([np.inf] * 2 + [SLOPE_PRIOR_M_S2] * 4 + [LEVER_PRIOR_M] * 2)
    normal, right = A.T @ A / OVERLAP, A.T @ y / OVERLAP
    dof = len(y) / OVERLAP
    variance = SLOPE_PRIOR_M_S2**2
    found = np.zeros(len(sigma))
    for _ in range(5):
        # The prior in units of the scatter, which is known after the first round.
        prior = variance * np.diag(sigma**-2.0)
        found = np.linalg.lstsq(normal + prior, right)[0]
        left = y - A @ found
        variance = max(float(left @ left) / OVERLAP / dof, 1e-8)
    squares = float(left @ left) / OVERLAP + float(found @ prior @ found)
    cov = variance * np.linalg.pinv(normal + prior)
    return _Fit(found[:2], np.asarray(cov[:2, :2]), squares, dof)


def _minimum(at: Array, chi2: Array) -> tuple[float, float] | None:
    """Where a parabola through the lowest of chi-squares is least, and 1 sigma; None at an end."""
    i = int(np.argmin(chi2))
    if i in (0, len(at) - 1):
        return None
    low, middle, high = chi2[i - 1 : i + 2]
    bend = low - 2.0 * middle + high
    step = float(at[1] - at[0])
    if not math.isfinite(bend) or bend <= 0.0:
        return None
    return float(at[i] + 0.5 * step * (low - high) / bend), step * math.sqrt(2.0 / bend)
