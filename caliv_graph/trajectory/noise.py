"""The noise of each sensor: the config's figures, else the messages', else the paper's.

A covariance of a message counts as stated if it is finite and positive definite: drivers write
zeros or NaN where they do not know it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from caliv_graph.config.model import Config
from caliv_graph.products import Array, BoolArray, GnssFixes, ImuSamples, TwistSamples
from caliv_graph.trajectory.correlated import CorrelatedError

# Table I of the CaLiV paper, 1 sigma per sample.
PAPER_FORCE_M_S2 = 0.05
PAPER_GYRO_RAD_S = 0.005
PAPER_GNSS_HORIZONTAL_M = 0.0167
"""1.5e-7 degrees of latitude."""
PAPER_GNSS_VERTICAL_M = 0.02
PAPER_ORIENTATION_RAD = 0.005
PAPER_VELOCITY_M_S = 0.1

# Not in the paper: typical of automotive MEMS.
DEFAULT_FORCE_WALK_M_S3 = 5e-4
DEFAULT_GYRO_WALK_RAD_S2 = 1e-5

MIN_POSE_ROTATION_RAD = 2e-5
MIN_POSE_POSITION_M = 2e-4
"""Smallest sigmas taken from a message of a given pose: below what any cloud of a target resolves.
Some drivers state 1e-9 instead of an unknown covariance."""

TYPICAL_CORRELATION_S = 30.0
"""Correlation time of the errors of a receiver with corrections (the troposphere and multipath of a
moving antenna) and of an AHRS, where neither config nor data give one."""

MIN_CORRELATED_M, MIN_CORRELATED_RAD = 1e-4, 1e-6
"""1 sigma that stands for no error: below what any sensor resolves."""


@dataclass(frozen=True)
class ImuNoise:
    """Noise of the IMU, imu frame.

    Attributes:
        gyro_density: (3, 3) (rad/s)^2/Hz, white noise of the gyroscope.
        force_density: (3, 3) (m/s^2)^2/Hz, white noise of the accelerometer.
        gyro_walk: (3,) rad/s^2/sqrt(Hz), random walk of the gyroscope's bias.
        force_walk: (3,) m/s^3/sqrt(Hz), random walk of the accelerometer's bias.
        gyro_bias: (3,) rad/s, 1 sigma of the gyroscope's bias at the start.
        force_bias: (3,) m/s^2, 1 sigma of the accelerometer's bias at the start.
        sources: quantity -> where its figure is from.
    """

    gyro_density: Array
    force_density: Array
    gyro_walk: Array
    force_walk: Array
    gyro_bias: Array
    force_bias: Array
    sources: dict[str, str]


def stated(cov: Array) -> BoolArray:
    """Which of (n, d, d) covariances are stated: finite and positive definite; (n,) bool."""
    finite = np.all(np.isfinite(cov), axis=(1, 2))
    with np.errstate(invalid="ignore"):
        positive = np.all(np.diagonal(cov, axis1=1, axis2=2) > 0.0, axis=1)
    out: BoolArray = np.asarray(finite & positive)
    if out.any():
        out[out] = np.linalg.eigvalsh(cov[out])[:, 0] > 0.0
    return out


def _per_message(
    count: int, configured: Array | None, messages: Array | None, table: Array
) -> tuple[Array, str]:
    """(n, d, d) covariances and their source: the first of the three that is stated.

    One that holds for all is a read-only view: a drive of hours has a million messages.
    """
    d = len(table)
    if configured is not None:
        return np.broadcast_to(configured, (count, d, d)), "config"
    out = np.broadcast_to(table, (count, d, d))
    if messages is None:
        return out, "the paper's table"
    if count and messages.strides[0] == 0:
        # A view from the reader: the same covariance in all messages.
        if stated(messages[:1])[0]:
            return messages, "messages"
        return out, "the paper's table"
    known = stated(messages)
    out = out.copy()
    out[known] = messages[known]
    if known.all():
        return out, "messages"
    if not known.any():
        return out, "the paper's table"
    # A message without one is taken to be as good as the others.
    out[~known] = np.median(messages[known], axis=0)
    return out, "messages, their median where one states none"


def imu_noise(imu: ImuSamples, config: Config) -> ImuNoise:
    """Densities and bias figures of an IMU; per-sample figures are over sqrt(rate)."""
    noise = config.noise
    dt = float(np.median(np.diff(imu.stamps_ns))) * 1e-9
    sources = {}

    def density(name: str, configured: float | None, message: Array | None, table: float) -> Array:
        if configured is not None:
            sources[name] = "config"
            return configured**2 * np.eye(3)
        if message is not None and stated(message[None])[0]:
            sources[name] = "messages"
            return np.asarray(message * dt)
        sources[name] = "the paper's table"
        return table**2 * dt * np.eye(3)

    gyro = density(
        "gyroscope",
        noise.gyroscope_density_rad_s_sqrthz,
        imu.angular_velocity_cov,
        PAPER_GYRO_RAD_S,
    )
    force = density(
        "accelerometer",
        noise.accelerometer_density_m_s2_sqrthz,
        imu.specific_force_cov,
        PAPER_FORCE_M_S2,
    )
    return ImuNoise(
        gyro_density=gyro,
        force_density=force,
        gyro_walk=np.full(3, noise.gyroscope_bias_walk_rad_s2_sqrthz or DEFAULT_GYRO_WALK_RAD_S2),
        force_walk=np.full(3, noise.accelerometer_bias_walk_m_s3_sqrthz or DEFAULT_FORCE_WALK_M_S3),
        gyro_bias=np.full(3, noise.gyroscope_bias_rad_s),
        force_bias=np.full(3, noise.accelerometer_bias_m_s2),
        sources=sources,
    )


def orientation_covariances(imu: ImuSamples, config: Config) -> tuple[Array, str]:
    """(n, 3, 3) rad^2 of the IMU's orientations, about the imu's axes, and the figures' source."""
    sigma_deg = config.noise.orientation_deg
    configured = None if sigma_deg is None else math.radians(sigma_deg) ** 2 * np.eye(3)
    return _per_message(
        len(imu.stamps_ns), configured, imu.orientation_cov, PAPER_ORIENTATION_RAD**2 * np.eye(3)
    )


def _set_sigma(cov: Array, axes: slice, sigma: float) -> None:
    """Makes some axes of (n, d, d) covariances independent, with this sigma."""
    cov[:, axes, :] = 0.0
    cov[:, :, axes] = 0.0
    cov[:, axes, axes] = sigma**2 * np.eye(axes.stop - axes.start)


def given_pose_covariances(cov: Array | None, config: Config) -> Array | None:
    """Covariances of the white errors of given poses; the config's figures before the messages'.

    `cov` and the result are (m, 6, 6), rotation then position, NaN where unknown, or None: all
    unknown, or the config gives both figures. No sigma of the result is below
    `MIN_POSE_ROTATION_RAD` and `MIN_POSE_POSITION_M`.
    """
    rotation_deg, position_m = config.noise.pose_rotation_deg, config.noise.pose_position_m
    if cov is None or (rotation_deg is not None and position_m is not None):
        return None
    out, known = cov.copy(), stated(cov)
    if not known.any():
        return None
    if rotation_deg is not None:
        _set_sigma(out, slice(0, 3), math.radians(rotation_deg))
    if position_m is not None:
        _set_sigma(out, slice(3, 6), position_m)
    least = np.array([MIN_POSE_ROTATION_RAD] * 3 + [MIN_POSE_POSITION_M] * 3) ** 2
    at = np.arange(6)
    out[:, at, at] = np.maximum(out[:, at, at], least)
    out[~known] = np.nan
    return out


def gnss_covariances(gnss: GnssFixes, config: Config) -> tuple[Array, str]:
    """(n, 3, 3) m^2 ENU of the fixes, and the figures' source."""
    table = np.array([PAPER_GNSS_HORIZONTAL_M] * 2 + [PAPER_GNSS_VERTICAL_M])
    horizontal, vertical = config.noise.gnss_horizontal_m, config.noise.gnss_vertical_m
    cov, source = _per_message(len(gnss.stamps_ns), None, gnss.cov_enu, np.diag(table**2))
    cov = cov.copy()
    if horizontal is not None:
        _set_sigma(cov, slice(0, 2), horizontal)
    if vertical is not None:
        _set_sigma(cov, slice(2, 3), vertical)
    if horizontal is not None and vertical is not None:
        source = "config"
    elif horizontal is not None or vertical is not None:
        source = f"config, and {source}"
    return cov, source


def velocity_covariances(twist: TwistSamples, config: Config) -> tuple[Array, str]:
    """(n, 3, 3) (m/s)^2 of the velocities, vehicle axes, and the figures' source."""
    sigma = config.noise.velocity_m_s
    configured = None if sigma is None else sigma**2 * np.eye(3)
    return _per_message(
        len(twist.stamps_ns), configured, twist.velocity_cov, PAPER_VELOCITY_M_S**2 * np.eye(3)
    )


def configured_errors(config: Config) -> tuple[CorrelatedError, ...]:
    """The correlated errors that the config gives, with a typical correlation time if it has none.

    An error of zero is none.
    """
    noise, out = config.noise, []
    horizontal, vertical = noise.gnss_correlated_horizontal_m, noise.gnss_correlated_vertical_m
    if horizontal or vertical:
        sigmas = [v if v else MIN_CORRELATED_M for v in (horizontal or 0.0, vertical or 0.0)]
        time_s = noise.gnss_correlation_s or TYPICAL_CORRELATION_S
        out.append(CorrelatedError("gnss", (sigmas[0], sigmas[0], sigmas[1]), time_s))
    level, yaw = noise.orientation_correlated_deg, noise.orientation_correlated_yaw_deg
    yaw = level if yaw is None else yaw
    if level or yaw:
        tilt, turn = (math.radians(v) if v else MIN_CORRELATED_RAD for v in (level, yaw))
        time_s = noise.orientation_correlation_s or TYPICAL_CORRELATION_S
        out.append(CorrelatedError("orientation", (tilt, tilt, turn), time_s))
    return tuple(out)
