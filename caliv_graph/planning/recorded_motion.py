"""The motion sensors of a recorded drive as a scenario describes them, with the noise in use."""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam
import numpy as np

from caliv_graph.calibration.noise import first_pose_noise
from caliv_graph.config.model import Config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, IntArray
from caliv_graph.scenario.sensor_models import (
    GnssModel,
    ImuModel,
    OrientationModel,
    OutageModel,
    PoseNoiseModel,
    VelocityModel,
)
from caliv_graph.targets.ground.planes import MEDIAN_OF_NORMAL
from caliv_graph.trajectory.correlated import CorrelatedError
from caliv_graph.trajectory.imu import log_so3
from caliv_graph.trajectory.inputs import STANDARD_GRAVITY_M_S2, SmootherInput
from caliv_graph.trajectory.measurements import usable_orientations
from caliv_graph.trajectory.noise import (
    MIN_POSE_POSITION_M,
    MIN_POSE_ROTATION_RAD,
    TYPICAL_CORRELATION_S,
    given_pose_covariances,
    orientation_covariances,
    stated,
    velocity_covariances,
)
from caliv_graph.trajectory.select import GivenTrajectory, VehicleTrajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.wording.recorded import INSTEAD, heading_sentence, slow_error_sentence

OUTAGE_PERIODS = 3.5
"""Periods of the GNSS without a fix that count as an outage."""

ORDER = 5
"""Of the differences in which the white error of given poses is looked at. With (turn rate times
period)^ORDER of the motion left, it is 10 micrometres at 2 m/s, 0.2 rad/s and 2 Hz; of third
differences 3 mm."""

DIFFERENCE = math.sqrt(math.comb(2 * ORDER, ORDER))
"""1 sigma of a difference of this order over that of the values, if they are white."""

LEAST_POSES = 20
"""Given poses from which their white error is estimated."""


@dataclass(frozen=True)
class RecordedMotion:
    """How the motion of a vehicle was measured.

    Attributes:
        imu: the IMU.
        gnss: the GNSS, with its outages in this drive.
        velocity: the source of velocities.
        poses: errors of given poses, used where the other three are absent.
        gravity_m_s2: magnitude of gravity.
        notes: what of it is not in any predicted sigma, a sentence each.
    """

    imu: ImuModel
    gnss: GnssModel
    velocity: VelocityModel
    poses: PoseNoiseModel
    gravity_m_s2: float
    notes: tuple[str, ...] = ()


def recorded_motion(
    trajectory: VehicleTrajectory, config: Config, begin_ns: int, height_m: float
) -> RecordedMotion:
    """The motion sensors of a drive, in a vehicle frame on the ground.

    Args:
        trajectory: smoothed or given.
        config: noise of given poses.
        begin_ns: stamp that is the start of the drive.
        height_m: of the vehicle frame above ground.

    Raises:
        TrajectoryError: a prediction has no model for such sensors; the message says what to do.
    """
    if isinstance(trajectory, SmoothedTrajectory):
        return _of_sensors(trajectory, begin_ns, height_m)
    if isinstance(trajectory, GivenTrajectory) and trajectory.odometry is None:
        none = {"enabled": False}
        return RecordedMotion(
            ImuModel.model_validate(none),
            GnssModel.model_validate(none),
            VelocityModel.model_validate(none),
            pose_noise_model(trajectory, config),
            STANDARD_GRAVITY_M_S2,
        )
    raise TrajectoryError(
        "the drive has no motion data (IMU, GNSS, velocities, poses), and what a next one would "
        f"determine depends on theirs. {INSTEAD}"
    )


def _of_sensors(trajectory: SmoothedTrajectory, begin_ns: int, height_m: float) -> RecordedMotion:
    data = trajectory.data
    if data.wheels is not None or data.motion.imu is None:
        raise TrajectoryError(
            f"{data.name}: wheels without an IMU, for which a prediction has no model. {INSTEAD}"
        )
    slow = {error.kind: error for error in trajectory.correlated}
    notes = [slow_error_sentence(e.kind, _size(e), e.time_s) for e in slow.values()]
    if data.headings is not None or data.baselines is not None:
        notes.append(heading_sentence())
    return RecordedMotion(
        imu=_imu(trajectory, slow.get("orientation"), begin_ns, height_m),
        gnss=_gnss(trajectory, slow.get("gnss"), begin_ns, height_m),
        velocity=_velocity(data, begin_ns),
        poses=PoseNoiseModel(),
        gravity_m_s2=round(trajectory.gravity_m_s2, 5),
        notes=tuple(notes),
    )


def _size(error: CorrelatedError) -> float:
    """1 sigma of an error in scenarios and sentences: horizontal; tilt or yaw, the larger."""
    return error.sigmas[0] if error.kind == "gnss" else max(error.sigmas)


def _imu(
    trajectory: SmoothedTrajectory, slow: CorrelatedError | None, begin_ns: int, height_m: float
) -> ImuModel:
    data = trajectory.data
    imu = data.motion.imu
    assert imu is not None
    rate_hz, phase_s = _rate_and_phase(imu.stamps_ns, begin_ns)
    noise = data.noise
    orientation = OrientationModel(enabled=False)
    if data.orientation:
        cov, _ = orientation_covariances(imu, data.config)
        orientation = OrientationModel(
            sigma_rad=_sigma(cov[usable_orientations(imu)]),
            correlated_sigma_rad=0.0 if slow is None else _rounded(_size(slow)),
            correlation_s=TYPICAL_CORRELATION_S if slow is None else _rounded(slow.time_s),
        )
    return ImuModel(
        mounting=lifted(trajectory.T_vehicle_imu, height_m),
        rate_hz=rate_hz,
        phase_s=phase_s,
        gyroscope_sigma_rad_s=_sigma(noise.gyro_density[None] * rate_hz),
        accelerometer_sigma_m_s2=_sigma(noise.force_density[None] * rate_hz),
        gyroscope_bias_walk_rad_s2_sqrthz=_rounded(float(noise.gyro_walk.mean())),
        accelerometer_bias_walk_m_s3_sqrthz=_rounded(float(noise.force_walk.mean())),
        orientation=orientation,
    )


def _gnss(
    trajectory: SmoothedTrajectory, slow: CorrelatedError | None, begin_ns: int, height_m: float
) -> GnssModel:
    data = trajectory.data
    positions = data.positions
    if positions is None or len(positions.stamps_ns) < 2:
        return GnssModel(enabled=False)
    stamps = positions.stamps_ns
    cov_of_one = positions.cov_map / positions.shared[:, None, None]
    rate_hz, phase_s = _rate_and_phase(stamps, begin_ns)
    latitude, longitude, altitude = positions.origin_deg_m
    x, y, z = (round(float(v), 4) for v in data.lever_arm)
    return GnssModel(
        lever_arm=(x, y, z + height_m),
        rate_hz=rate_hz,
        phase_s=phase_s,
        horizontal_sigma_m=_sigma(cov_of_one[:, :2, :2]),
        vertical_sigma_m=_sigma(cov_of_one[:, 2:, 2:]),
        correlated_horizontal_sigma_m=0.0 if slow is None else _rounded(slow.sigmas[0]),
        correlated_vertical_sigma_m=0.0 if slow is None else _rounded(slow.sigmas[2]),
        correlation_s=TYPICAL_CORRELATION_S if slow is None else _rounded(slow.time_s),
        outlier_probability=round(len(trajectory.gnss_dropped) / len(stamps), 4),
        outages=_outages(stamps, rate_hz, begin_ns),
        latitude_deg=float(np.clip(latitude, -89.0, 89.0)),
        longitude_deg=float((longitude + 180.0) % 360.0 - 180.0),
        altitude_m=altitude,
    )


def _outages(stamps_ns: IntArray, rate_hz: float, begin_ns: int) -> tuple[OutageModel, ...]:
    """Times without a fix, from half a period after the last one to half a period before the next.

    What lies before the start of the drive is left out.
    """
    seconds = (stamps_ns - begin_ns) / NANOSECONDS_PER_SECOND
    out = []
    for gap in np.flatnonzero(np.diff(seconds) * rate_hz > OUTAGE_PERIODS).tolist():
        start_s = max(round(float(seconds[gap]) + 0.5 / rate_hz, 3), 0.0)
        end_s = round(float(seconds[gap + 1]) - 0.5 / rate_hz, 3)
        if end_s > start_s:
            out.append(OutageModel(start_s=start_s, duration_s=end_s - start_s))
    return tuple(out)


def _velocity(data: SmootherInput, begin_ns: int) -> VelocityModel:
    twist = data.motion.twist
    if twist is None:
        return VelocityModel(enabled=False)
    usable = np.isfinite(twist.velocity).all(axis=1)
    if usable.sum() < 2:
        return VelocityModel(enabled=False)
    cov, _ = velocity_covariances(twist, data.config)
    rate_hz, phase_s = _rate_and_phase(twist.stamps_ns[usable], begin_ns)
    return VelocityModel(rate_hz=rate_hz, phase_s=phase_s, sigma_m_s=_sigma(cov[usable]))


def pose_noise_model(trajectory: GivenTrajectory, config: Config) -> PoseNoiseModel:
    """Errors of given poses: those of the config, else of their messages, else of the poses.

    The white error is seen in differences of the poses of a high order, in which a vehicle's motion
    is next to nothing. The slow one is not: without a figure in the config it has the values that a
    calibration begins with, as a random walk that grows as fast.
    """
    given = first_pose_noise(config.noise)
    white_rotation, white_position = given.white_rotation_rad, given.white_position_m
    T = trajectory.trajectory
    cov = given_pose_covariances(T.cov, config)
    if cov is not None:
        known = stated(cov)
        white_rotation = _sigma(cov[known][:, :3, :3])
        white_position = _sigma(cov[known][:, 3:, 3:])
    elif len(T.T_map_vehicle) >= LEAST_POSES:
        R, t = stack(T.T_map_vehicle)
        turns = log_so3(np.swapaxes(R[:-1], 1, 2) @ R[1:])
        if config.noise.pose_rotation_deg is None:
            white_rotation = max(MIN_POSE_ROTATION_RAD, _white(np.diff(turns, ORDER - 1, axis=0)))
        if config.noise.pose_position_m is None:
            white_position = max(MIN_POSE_POSITION_M, _white(np.diff(t, ORDER, axis=0)))
    # A Gauss-Markov error of sigma s and time T begins as a walk of s sqrt(2 / T).
    grows = math.sqrt(2.0 / given.drift_time_s)
    return PoseNoiseModel(
        position_sigma_m=_rounded(white_position),
        rotation_sigma_rad=_rounded(white_rotation),
        position_walk_m_sqrts=_rounded(grows * given.drift_position_m),
        rotation_walk_rad_sqrts=_rounded(grows * given.drift_rotation_rad),
    )


def _white(differences: Array) -> float:
    """1 sigma of a white error, from differences (n, 3) of order `ORDER`."""
    return float(np.median(np.abs(differences))) / (MEDIAN_OF_NORMAL * DIFFERENCE)


def _sigma(cov: Array) -> float:
    """Root of the median over (n, d, d) covariances of the mean variance of the axes."""
    variances = np.einsum("nii->n", cov) / cov.shape[1]
    return _rounded(math.sqrt(float(np.median(variances))))


def _rounded(value: float) -> float:
    """To four digits: for people who read the scenario."""
    return float(f"{value:.4g}")


def _rate_and_phase(stamps_ns: IntArray, begin_ns: int) -> tuple[float, float]:
    """Samples per second, and seconds from the start of the drive to the first one within it."""
    rate_hz = NANOSECONDS_PER_SECOND / float(np.median(np.diff(stamps_ns)))
    first = stamps_ns[min(int(np.searchsorted(stamps_ns, begin_ns)), len(stamps_ns) - 1)]
    return float(f"{rate_hz:.5g}"), max(0.0, float(first - begin_ns) / NANOSECONDS_PER_SECOND)


def lifted(T: gtsam.Pose3, height_m: float) -> PoseConfig:
    """`T_vehicle_sensor` in a vehicle frame that lies lower by `height_m`, on the ground."""
    x, y, z = (round(float(v), 5) for v in T.translation() + np.array([0.0, 0.0, height_m]))
    roll, pitch, yaw = (round(float(v), 4) for v in np.degrees(T.rotation().rpy()))
    return PoseConfig(xyz=(x, y, z), rpy_deg=(roll, pitch, yaw))
