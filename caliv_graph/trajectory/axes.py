"""Horizontal specific force against the acceleration of the path (`README.md`, section 13)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from caliv_graph.config.model import Config
from caliv_graph.products import Array, MotionData
from caliv_graph.trajectory.alignment import level
from caliv_graph.trajectory.imu import Inertial
from caliv_graph.trajectory.kinematics import MIN_WINDOWS, OVERLAP, Windows, means_over

MIN_ACCELERATION_M_S2 = 0.15
"""Root mean square of the horizontal acceleration from which axes can be compared: that of a slope
of 1 degree."""

MAX_DELAY_S = 3.0
DELAY_STEP_S, COARSE_STEPS = 0.05, 4
"""Clock offsets that are tried: every fourth, then those about the best. Accelerations are means
over 2 s, so that their agreement changes slowly with the offset."""

MIN_DELAY_S = 0.05
"""Smaller clock offsets are left to the smoother: parabolas over 2 s err by some hundredths of a
second on sound drives, and their sigma may be less."""

SLOPE_PRIOR_M_S2 = 0.35
"""1 sigma of gravity's part along a slope of 2 degrees, and of the accelerometer's bias: what the
acceleration of a drive is regressed with."""

SIGMAS = 5.0
"""Of a comparison that is taken as certain."""

LEVER_PRIOR_M = 2.0
"""1 sigma of an error of the lever arm, which looks like a clock offset in curves: no vehicle is
larger."""


Complex = npt.NDArray[np.complex128]


@dataclass(frozen=True)
class Axes:
    """Horizontal specific force in vehicle axes against the acceleration along the path.

    Attributes:
        yaw_rad: by which the vehicle's axes, by `T_vehicle_imu`, are turned against the path.
        sigma_rad: of it.
        ratio: of the measured to the true acceleration, with its sigma.
        mirrored: whether left and right are exchanged: axes that are left-handed.
        delay_s: of the GNSS stamps against those of the IMU, with its sigma; None: not determined.
            Where it is certain, all else is at stamps that are free of it.
    """

    yaw_rad: float
    sigma_rad: float
    ratio: tuple[float, float]
    mirrored: bool
    delay_s: tuple[float, float] | None

    @property
    def certain_delay_s(self) -> tuple[float, float] | None:
        """The same where it is beyond doubt, and large enough to bend a trajectory."""
        return self.delay_s if _is_certain(self.delay_s) else None


def _is_certain(delay_s: tuple[float, float] | None) -> bool:
    return delay_s is not None and abs(delay_s[0]) > max(MIN_DELAY_S, SIGMAS * delay_s[1])


def _directions(motion: MotionData, moving: Windows) -> Array:
    """(n,) +1 forward, -1 backward, by the velocities; without them all are forward."""
    if motion.twist is None:
        return np.ones(len(moving.stamps_ns))
    finite = np.isfinite(motion.twist.velocity).all(axis=1)
    stamps = np.asarray(motion.twist.stamps_ns, np.int64)[finite]
    along = means_over(stamps, motion.twist.velocity[finite, :1], moving.stamps_ns)[:, 0]
    return np.where(along < 0.0, -1.0, 1.0)


def accelerometer_axes(
    moving: Windows, inertial: Inertial, motion: MotionData, R_vehicle_imu: Array, config: Config
) -> Axes | None:
    """The accelerometer's horizontal axes against the path; None if it hardly accelerates."""
    v = moving.velocity_map[:, 0] + 1j * moving.velocity_map[:, 1]
    a = moving.acceleration_map[:, 0] + 1j * moving.acceleration_map[:, 1]
    if len(v) < MIN_WINDOWS or float(np.sqrt((np.abs(a) ** 2).mean())) < MIN_ACCELERATION_M_S2:
        return None
    along: Complex = np.asarray(_directions(motion, moving) * v / np.abs(v))
    up = R_vehicle_imu @ inertial.force.mean(axis=0)
    leveled = np.column_stack([inertial.force, inertial.gyro]) @ np.kron(
        np.eye(2), (level(up) @ R_vehicle_imu).T
    )
    x, y, _ = config.gnss.lever_arm or (0.0, 0.0, 0.0)
    arm = complex(x, y)

    def fit(delay_s: float, mirrored: bool = False) -> _Fit | None:
        means = means_over(inertial.stamps_ns, leveled, moving.stamps_ns, -delay_s)
        usable = np.isfinite(means).all(axis=1)
        if usable.sum() < MIN_WINDOWS:
            return None
        # Windows without fixes are left out: the steps between windows differ.
        turn_rate = np.gradient(means[usable, 5], moving.stamps_ns[usable] * 1e-9)
        # Of the antenna relative to the vehicle's origin, per metre of the lever arm.
        swing: Complex = np.asarray(1j * turn_rate - means[usable, 5] ** 2)
        force = means[usable, 0] + 1j * means[usable, 1]
        acceleration = a[usable] * along[usable].conj() - swing * arm
        return _regression(
            force, acceleration.conj() if mirrored else acceleration, along[usable], swing
        )

    plain, mirror = fit(0.0), fit(0.0, mirrored=True)
    if plain is None or mirror is None:
        return None

    def scatter(step: int) -> float:
        found = fit(step * DELAY_STEP_S)
        return math.inf if found is None else found.squares / found.dof

    most = round(MAX_DELAY_S / DELAY_STEP_S)
    steps = np.arange(-most, most + 1, COARSE_STEPS)
    coarse = np.array([scatter(step) for step in steps.tolist()])
    near = int(steps[np.argmin(coarse)])
    fine = np.arange(near - COARSE_STEPS - 1, near + COARSE_STEPS + 2)
    by_step = np.array([scatter(step) for step in fine.tolist()])
    least = float(by_step.min())
    variance = min(least, mirror.squares / mirror.dof)
    delay = None
    if abs(near) < most and is_alone(coarse * plain.dof / variance):
        at = np.asarray(fine * DELAY_STEP_S, np.float64)
        delay = _minimum(at, by_step * plain.dof / variance)
    better = (plain.squares - mirror.squares) / variance
    mirrored = better > SIGMAS**2 and mirror.squares < plain.dof * least
    chosen = mirror if mirrored else plain
    if not mirrored and delay is not None and _is_certain(delay):
        chosen = fit(delay[0]) or plain
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
        squares: of the residuals and of the priors, (m/s^2)^2, independent samples.
        dof: number of independent samples.
        variance: of a sample, (m/s^2)^2.
        normal: (8, 8) information of all coefficients, the prior's too, times the variance.
    """

    factor: Array
    squares: float
    dof: float
    variance: float
    normal: Array

    @cached_property
    def cov(self) -> Array:
        """(2, 2) of the factor; most fits are asked for their squares alone."""
        return np.asarray((self.variance * np.linalg.pinv(self.normal))[:2, :2])


def _regression(force: Complex, acceleration: Complex, along: Complex, swing: Complex) -> _Fit:
    """Forces on accelerations, with slope, bias and an error of the lever arm under priors.

    All (n,) and complex: force and acceleration in levelled vehicle and path axes, the direction of
    travel in map axes, and the acceleration of the antenna per metre of its lever arm.
    """
    one = np.ones(len(force), complex)
    columns = [acceleration, one, along.conj(), swing]
    both = np.stack([c * unit for c in columns for unit in (1.0, 1j)], axis=1)
    A = np.concatenate([both.real, both.imag])
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
    return _Fit(found[:2], squares, dof, variance, normal + prior)


def is_alone(chi2: Array) -> bool:
    """Whether no other local minimum of chi-squares is within `SIGMAS` of the lowest.

    A drive that does the same again after seconds tells its clock up to these.
    """
    padded = np.concatenate([[math.inf], chi2, [math.inf]])
    local = (chi2 <= padded[:-2]) & (chi2 <= padded[2:])
    local[np.argmin(chi2)] = False
    return not bool((chi2[local] < chi2.min() + SIGMAS**2).any())


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
