"""Measurements of IMU, GNSS and odometry: derivatives of the true drive at each sensor.

Specific force and angular rate are analytic derivatives of the drive. Nothing is integrated here,
so their integral reproduces the drive.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pymap3d
from scipy.spatial.transform import Rotation

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import Array, GnssFixes, ImuSamples, IntArray, TwistSamples
from caliv_graph.scenario.drives import Drive, VehicleStates, sample_stamps
from caliv_graph.scenario.model import Scenario
from caliv_graph.scenario.sensor_models import GnssModel, ImuModel
from caliv_graph.simulation.noise import Stream, gauss_markov, random_stream

ANGULAR_ACCELERATION_STEP_NS = 50_000
"""Half step of the difference for the angular acceleration, exact to 1e-7 rad/s^2."""


@dataclass(frozen=True)
class SimulatedImu:
    """Measurements of an IMU, and its true biases (n, 3) in m/s^2 and rad/s, imu frame."""

    samples: ImuSamples
    accelerometer_bias: Array
    gyroscope_bias: Array


@dataclass(frozen=True)
class SimulatedGnss:
    """Fixes of a GNSS receiver, and (m,) stamps without a fix."""

    fixes: GnssFixes
    lost_ns: IntArray


def angular_acceleration(drive: Drive, stamps_ns: IntArray) -> Array:
    """(n, 3) rate of the vehicle's angular velocity in rad/s^2, vehicle axes."""
    step_ns = ANGULAR_ACCELERATION_STEP_NS
    before, after = (
        drive.states(stamps_ns + shift_ns).angular_velocity for shift_ns in (-step_ns, step_ns)
    )
    rate: Array = (after - before) * (0.5 * NANOSECONDS_PER_SECOND / step_ns)
    return rate


def true_imu(
    drive: Drive, model: ImuModel, gravity_m_s2: float, stamps_ns: IntArray
) -> tuple[Array, Array, Rotation]:
    """Measurements of a perfect IMU at (n,) stamps since the start of the drive.

    Returns:
        (n, 3) angular velocity in rad/s and (n, 3) specific force in m/s^2, both in the imu frame,
        and n rotations R_map_imu.
    """
    states = drive.states(stamps_ns)
    T_vehicle_imu = model.mounting.pose()
    R_vehicle_imu = T_vehicle_imu.rotation().matrix()
    lever = T_vehicle_imu.translation()
    rate = states.angular_velocity
    turning = np.cross(angular_acceleration(drive, stamps_ns), lever) + np.cross(
        rate, np.cross(rate, lever)
    )
    felt_map = states.acceleration_map + np.array([0.0, 0.0, gravity_m_s2])
    # Row vectors: R^T v is v R.
    felt_vehicle = np.einsum("nji,nj->ni", states.R_map_vehicle, felt_map) + turning
    rotations = Rotation.from_matrix(states.R_map_vehicle @ R_vehicle_imu)
    return rate @ R_vehicle_imu, felt_vehicle @ R_vehicle_imu, rotations


def _bias(
    sigma: float | tuple[float, float, float], walk: float, dt_s: Array, draws: Array
) -> Array:
    """(n, 3) a constant drawn with `sigma` plus a random walk; `draws` (n, 3) are normal."""
    steps = walk * np.sqrt(dt_s)[:, None] * draws
    steps[0] = np.broadcast_to(np.asarray(sigma), (3,)) * draws[0]
    bias: Array = np.cumsum(steps, axis=0)
    return bias


def simulate_imu(drive: Drive, scenario: Scenario, seed: int) -> SimulatedImu:
    """Measurements of the scenario's IMU during the drive.

    Raises:
        ConfigError: the seed is negative, or the drive is shorter than the phase.
    """
    model = scenario.imu
    stamps_ns = sample_stamps("imu", model.rate_hz, model.phase_s, drive.duration_s)
    n = len(stamps_ns)
    rate, force, rotations = true_imu(drive, model, scenario.gravity_m_s2, stamps_ns)
    noise = random_stream(seed, Stream.IMU).standard_normal((n, 6))
    draws = random_stream(seed, Stream.IMU_BIAS).standard_normal((n, 6))
    dt_s = np.diff(stamps_ns, prepend=stamps_ns[:1]) / NANOSECONDS_PER_SECOND
    gyroscope_bias = _bias(
        model.gyroscope_bias_sigma_rad_s,
        model.gyroscope_bias_walk_rad_s2_sqrthz,
        dt_s,
        draws[:, :3],
    )
    accelerometer_bias = _bias(
        model.accelerometer_bias_sigma_m_s2,
        model.accelerometer_bias_walk_m_s3_sqrthz,
        dt_s,
        draws[:, 3:],
    )
    off = random_stream(seed, Stream.GYROSCOPE_SCALE).standard_normal((3, 3))
    turned_by = rate + model.gyroscope_scale_sigma * rate @ off
    orientation = model.orientation
    xyzw = None
    if orientation.enabled:
        errors = orientation.sigma_rad * random_stream(seed, Stream.ORIENTATION).standard_normal(
            (n, 3)
        )
        rng = random_stream(seed, Stream.ORIENTATION_CORRELATED)
        slow = orientation.correlated_sigma_rad * gauss_markov(
            stamps_ns, orientation.correlation_s, rng
        )
        yaw_bias = Rotation.from_euler("z", math.radians(orientation.yaw_bias_deg))
        turned = Rotation.from_rotvec(slow) * yaw_bias * rotations
        xyzw = (turned * Rotation.from_rotvec(errors)).as_quat()
    known = scenario.bag.covariances == "stated"
    samples = ImuSamples(
        stamps_ns=_absolute(stamps_ns, scenario),
        angular_velocity=turned_by + gyroscope_bias + model.gyroscope_sigma_rad_s * noise[:, :3],
        specific_force=force + accelerometer_bias + model.accelerometer_sigma_m_s2 * noise[:, 3:],
        orientation_xyzw=xyzw,
        orientation_cov=(
            np.tile(_diagonal(orientation.sigma_rad), (n, 1, 1))
            if known and orientation.enabled
            else None
        ),
        angular_velocity_cov=(
            _diagonal(model.stated_over_true * model.gyroscope_sigma_rad_s) if known else None
        ),
        specific_force_cov=(
            _diagonal(model.stated_over_true * model.accelerometer_sigma_m_s2) if known else None
        ),
    )
    return SimulatedImu(samples, accelerometer_bias, gyroscope_bias)


def simulate_gnss(drive: Drive, scenario: Scenario, z_map: float, seed: int) -> SimulatedGnss:
    """Fixes of the scenario's GNSS receiver during the drive.

    `z_map` is the height of the vehicle frame in the map where the ground is level, in metres.

    Raises:
        ConfigError: the seed is negative, or the drive is shorter than the phase.
    """
    model = scenario.gnss
    stamps_ns = sample_stamps("gnss", model.rate_hz, model.phase_s, drive.duration_s)
    n = len(stamps_ns)
    sigma = np.array([model.horizontal_sigma_m, model.horizontal_sigma_m, model.vertical_sigma_m])
    antenna_map = antenna_positions(drive.states(stamps_ns, z_map), model)
    measured = antenna_map + sigma * random_stream(seed, Stream.GNSS).standard_normal((n, 3))
    slow = np.array([model.correlated_horizontal_sigma_m] * 2 + [model.correlated_vertical_sigma_m])
    rng = random_stream(seed, Stream.GNSS_CORRELATED)
    measured += slow * gauss_markov(stamps_ns, model.correlation_s, rng)
    rng = random_stream(seed, Stream.GNSS_OUTLIERS)
    is_outlier = rng.random(n) < model.outlier_probability
    wrong = model.outlier_sigma_m * rng.standard_normal((n, 3))
    measured += np.where(is_outlier[:, None], wrong, 0.0)
    time_s = stamps_ns / NANOSECONDS_PER_SECOND
    for jump in model.jumps:
        during = (time_s >= jump.start_s) & (time_s < jump.start_s + jump.duration_s)
        measured[during] += jump.offset_enu_m
    fixed = np.ones(n, dtype=np.bool_)
    for outage in model.outages:
        fixed &= (time_s < outage.start_s) | (time_s >= outage.start_s + outage.duration_s)
    east, north, up = measured[fixed].T
    latitude, longitude, altitude = pymap3d.enu2geodetic(
        east, north, up, model.latitude_deg, model.longitude_deg, model.altitude_m
    )
    stamps_ns = _absolute(stamps_ns, scenario)
    fixes = GnssFixes(
        stamps_ns=stamps_ns[fixed],
        latitude_deg=np.asarray(latitude, dtype=np.float64),
        longitude_deg=np.asarray(longitude, dtype=np.float64),
        altitude_m=np.asarray(altitude, dtype=np.float64),
        cov_enu=(
            np.tile(np.diag((model.stated_over_true * sigma) ** 2), (int(fixed.sum()), 1, 1))
            if scenario.bag.covariances == "stated"
            else None
        ),
    )
    return SimulatedGnss(fixes, stamps_ns[~fixed])


def antenna_positions(states: VehicleStates, model: GnssModel) -> Array:
    """(n, 3) true positions of the GNSS antenna in the map in metres."""
    positions: Array = states.position_map + states.R_map_vehicle @ np.array(model.lever_arm)
    return positions


def simulate_velocity(drive: Drive, scenario: Scenario, seed: int) -> TwistSamples:
    """Velocities that the scenario's odometry measures during the drive.

    Raises:
        ConfigError: the seed is negative, or the drive is shorter than the phase.
    """
    model = scenario.velocity
    stamps_ns = sample_stamps("velocity", model.rate_hz, model.phase_s, drive.duration_s)
    n = len(stamps_ns)
    states = drive.states(stamps_ns)
    true = np.einsum("nji,nj->ni", states.R_map_vehicle, states.velocity_map)
    noise = random_stream(seed, Stream.VELOCITY).standard_normal((n, 3))
    known = scenario.bag.covariances == "stated"
    return TwistSamples(
        stamps_ns=_absolute(stamps_ns, scenario),
        velocity=true + model.sigma_m_s * noise,
        velocity_cov=np.tile(_diagonal(model.sigma_m_s), (n, 1, 1)) if known else None,
    )


def start_ns(scenario: Scenario) -> int:
    """Stamp of the start of the drive in nanoseconds."""
    return scenario.bag.start_time_s * NANOSECONDS_PER_SECOND


def _absolute(stamps_ns: IntArray, scenario: Scenario) -> IntArray:
    return stamps_ns + start_ns(scenario)


def _diagonal(sigma: float) -> Array:
    return np.eye(3) * sigma**2
