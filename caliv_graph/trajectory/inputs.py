"""The input of the smoother: the drive's sensor data, checked, with the noise of each sensor."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from caliv_graph.config.model import Config
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array, ImuSamples, IntArray, MotionData
from caliv_graph.trajectory.antennas import Baselines, Headings, directions_of
from caliv_graph.trajectory.gnss import (
    Positions,
    normal_gravity,
    positions_in_map,
    shared_by_rough,
)
from caliv_graph.trajectory.imu import Inertial, clean_inertial
from caliv_graph.trajectory.measurements import NO_VELOCITIES, rotations_of, usable_orientations
from caliv_graph.trajectory.noise import (
    ImuNoise,
    imu_noise,
    orientation_covariances,
    velocity_covariances,
)
from caliv_graph.trajectory.wheels import (
    WheelModel,
    is_planar,
    scaled_wheel_noise,
    wheel_model,
    wheel_noise,
    wheel_samples,
)

STANDARD_GRAVITY_M_S2 = 9.80665
"""Conventional value, used without GNSS. It differs from gravity on Earth by at most 0.03 m/s^2,
which the accelerometer's bias absorbs."""

MAX_TILT_DISAGREEMENT_RAD = math.radians(20.0)
"""Mean angle between the vertical of the accelerometer and that of the orientation. A vehicle's
accelerations average to a few degrees; a wrong axis convention is 90 or 180."""


IMU_CLOCK, GNSS_CLOCK, TWIST_CLOCK = "imu", "gnss", "twist"
"""Clocks of the sensors of the motion. Without an IMU the first is that of the wheels, which stand
in for it; directions by antennas have the second."""


@dataclass(frozen=True)
class SmootherInput:
    """The sensor data of one drive, checked.

    Attributes:
        name: of the recording, for messages.
        config: extrinsics, noise, robust kernel.
        motion: the data as read.
        inertial: cleaned IMU samples.
        noise: of the IMU.
        positions: of the GNSS antenna in the map; None: GNSS is not used.
        orientation: whether the IMU's messages carry orientations.
        T_vehicle_imu: the IMU's extrinsic.
        lever_arm: (3,) the GNSS antenna in the vehicle frame, metres.
        gravity_m_s2: along -z of the map.
        rotation_sigmas: (3,) of the rotation of `T_vehicle_imu` about the vehicle's axes, radians;
            None: it is exact, or still to be guessed (`mounting.py`).
        scales: name of `variances.COMPONENTS` -> factor on the stated sigmas that is in use, of
            those that the data contradict.
        wheels: what is known of the axle where there is no IMU; `T_vehicle_imu` is then that of its
            frame, `inertial` and `noise` are of `wheels.wheel_samples`, and gravity is zero.
        slope: (2,) of the mean ground along the map's x and y, where there is no IMU.
        axle_slip: side slip of the axle there, radians per m/s^2 of lateral acceleration.
        lean: (2,) how the body leans on its springs there: nose up per m/s^2 ahead, left side up
            per m/s^2 to the left, radians.
        speed_scale: measured over true velocities.
        speed_point: (2,) y and z in the vehicle frame, metres, of where wheels beside an IMU
            measure the speed.
        headings: directions of a baseline as angles; None: there are none.
        baselines: the same as vectors between two antennas.
        heading_yaw: direction of that baseline in the vehicle frame, to the left of x, radians.
        second_arm: (3,) the second antenna in the vehicle frame, metres.
        late_ns: sensor (`IMU_CLOCK`, `GNSS_CLOCK`, `TWIST_CLOCK`) -> stamps less true times in the
            clock of the LiDARs; absent: 0. Stamps of `inertial` are free of it, all others as they
            were read. Velocities without an IMU have `IMU_CLOCK`.
        found_late_s: how late the fixes are and its sigma, found before smoothing
            (`late_fixes.py`). Stamps of positions, headings and baselines are free of it, and
            `late_ns` is beyond it. None: nothing says that they are late.
        slow_orientation_rad: 1 sigma of errors of the orientations at a node beside their noise,
            which hardly change from node to node.
        slipped: (k,) indices of velocities that are left out (`slipping.py`).
        about_late_ns: how late velocities beside an IMU are, about: each belongs to the node that
            is nearest to its stamp less this, also while `late_ns` is estimated.
    """

    name: str
    config: Config
    motion: MotionData
    inertial: Inertial
    noise: ImuNoise
    positions: Positions | None
    orientation: bool
    T_vehicle_imu: gtsam.Pose3
    lever_arm: Array
    gravity_m_s2: float
    rotation_sigmas: Array | None = None
    scales: Mapping[str, float] = field(default_factory=dict)
    wheels: WheelModel | None = None
    slope: Array = field(default_factory=lambda: np.zeros(2))
    axle_slip: float = 0.0
    lean: Array = field(default_factory=lambda: np.zeros(2))
    speed_scale: float = 1.0
    speed_point: Array = field(default_factory=lambda: np.zeros(2))
    headings: Headings | None = None
    baselines: Baselines | None = None
    heading_yaw: float = 0.0
    second_arm: Array = field(default_factory=lambda: np.zeros(3))
    late_ns: Mapping[str, int] = field(default_factory=dict)
    found_late_s: tuple[float, float] | None = None
    slow_orientation_rad: float = 0.0
    slipped: IntArray = field(default_factory=lambda: NO_VELOCITIES)
    about_late_ns: int = 0

    def late_s(self, clock: str) -> float:
        """Stamps of a sensor as they were read less true times, seconds."""
        found_s = self.found_late_s[0] if clock == GNSS_CLOCK and self.found_late_s else 0.0
        return found_s + self.late_ns.get(clock, 0) / NANOSECONDS_PER_SECOND

    @property
    def heading_imu(self) -> Array:
        """(3,) unit vector along the baseline of `headings`, imu frame."""
        ahead = np.array([math.cos(self.heading_yaw), math.sin(self.heading_yaw), 0.0])
        return np.asarray(self.T_vehicle_imu.rotation().unrotate(ahead))

    @property
    def baseline_imu(self) -> Array:
        """(3,) from the first to the second antenna, imu frame, metres."""
        baseline = self.second_arm - self.lever_arm
        return np.asarray(self.T_vehicle_imu.rotation().unrotate(baseline))

    @property
    def T_vehicle_twist(self) -> gtsam.Pose3:
        """The frame in which velocities are measured."""
        planar = self.wheels is not None and self.wheels.planar
        if planar:
            return self.T_vehicle_imu
        return gtsam.Pose3(gtsam.Rot3(), np.append(0.0, self.speed_point))

    @property
    def speed_alone(self) -> bool:
        """Whether wheels beside an IMU measure the forward velocity alone."""
        twist = self.motion.twist
        return self.wheels is None and twist is not None and is_planar(twist)

    @property
    def speed_scale_sigma(self) -> float | None:
        """Of the scale of the velocities; None: it is exact."""
        return self.config.wheels.scale_sigma(self.speed_alone or self.wheels is not None)

    @property
    def speeds_delay_sigma_s(self) -> float:
        """Of the stamps of velocities beside an IMU; 0: they are exact, or there are none."""
        if self.wheels is not None or self.motion.twist is None:
            return 0.0
        return self.config.wheels.delay_sigma_s(self.speed_alone, beside_imu=True)

    @property
    def gyroscope_scale_sigma(self) -> float | None:
        """Of the gyroscope's scale and axes; None: they are exact, or there is none."""
        return (self.config.imu.gyroscope_scale_sigma or None) if self.wheels is None else None

    @property
    def arm_imu(self) -> Array:
        """(3,) the GNSS antenna in the imu frame, metres."""
        return np.asarray(self.T_vehicle_imu.transformTo(self.lever_arm))

    @property
    def yaw_bias(self) -> bool:
        """Whether a yaw bias of the orientation source is estimated."""
        return self.config.imu.yaw_bias and self.orientation


def check_input(motion: MotionData, config: Config) -> tuple[SmootherInput, list[str]]:
    """Checks that the data suffice, cleans them, and finds the noise of each sensor; warnings.

    Raises:
        TrajectoryError: a sensor that is needed is missing, or its data contradict themselves.
    """
    name = motion.name
    no_twist = motion.twist is None or not np.isfinite(motion.twist.velocity).all(axis=1).any()
    no_gnss = motion.gnss is None or not len(motion.gnss.stamps_ns)
    if motion.imu is None:
        if config.topics.imu is not None:
            raise TrajectoryError(
                f"{name}: no IMU: topics.imu '{config.topics.imu}' holds nothing that can be used. "
                "Choose another one, or leave it out: GNSS and the speeds of the wheels suffice"
            )
        if no_twist:
            raise TrajectoryError(
                f"{name}: no IMU and no velocities: set topics.imu (sensor_msgs/Imu), topics.twist "
                "(nav_msgs/Odometry or a twist: speed and yaw rate of the wheels), or topics.pose "
                "(the vehicle's poses)"
            )
        return _wheel_input(motion, config, no_gnss)
    if no_twist and no_gnss:
        raise TrajectoryError(
            f"{name}: neither GNSS fixes nor velocities: an IMU alone drifts away within seconds. "
            "Set topics.gnss (sensor_msgs/NavSatFix), topics.twist "
            "(geometry_msgs/TwistStamped or nav_msgs/Odometry), or topics.pose"
        )
    inertial, lines = clean_inertial(motion.imu, name)
    warnings = list(lines)
    positions, gravity = None, config.imu.gravity_m_s2
    if not no_gnss:
        positions, normal, notes = _positions(motion, config, inertial, no_twist)
        gravity = gravity or normal
        warnings += notes
    if positions is None and not no_twist:
        warnings.append(
            f"{name}: no GNSS: the map's origin is the vehicle's start, and positions drift with "
            "the velocities"
        )
    rotation_sigma = config.imu.rotation_sigma_rad()
    mounting, arm = config.imu.T_vehicle_imu, config.gnss.lever_arm
    known = mounting.rpy_deg is not None
    data = SmootherInput(
        name=name,
        config=config,
        motion=motion,
        inertial=inertial,
        noise=imu_noise(motion.imu, config),
        positions=positions,
        orientation=has_orientation(motion.imu, inertial, name),
        T_vehicle_imu=(
            mounting.pose() if known else gtsam.Pose3(gtsam.Rot3(), np.array(mounting.xyz))
        ),
        lever_arm=np.zeros(3) if arm is None else np.array(arm),
        gravity_m_s2=gravity or STANDARD_GRAVITY_M_S2,
        rotation_sigmas=None if rotation_sigma is None else np.full(3, rotation_sigma),
    )
    return _with_heading(data), warnings


def _wheel_input(
    motion: MotionData, config: Config, no_gnss: bool
) -> tuple[SmootherInput, list[str]]:
    """As `check_input`, of velocities without an IMU."""
    assert motion.twist is not None
    inertial, lines = wheel_samples(motion.twist, motion.name)
    model, warnings, positions = wheel_model(motion.twist, config), list(lines), None
    if not no_gnss:
        positions, _, notes = _positions(motion, config, inertial, not model.yaw_rate)
        warnings += notes
    if positions is None and not model.yaw_rate:
        raise TrajectoryError(
            f"{motion.name}: speeds alone do not tell where the vehicle goes: set topics.gnss "
            "(sensor_msgs/NavSatFix), topics.imu, or topics.twist to odometry with a yaw rate"
        )
    arm = config.gnss.lever_arm
    data = SmootherInput(
        name=motion.name,
        config=config,
        motion=motion,
        inertial=inertial,
        noise=wheel_noise(motion.twist, config),
        positions=positions,
        orientation=False,
        T_vehicle_imu=config.wheels.T_vehicle_wheels.pose(),
        lever_arm=np.zeros(3) if arm is None else np.array(arm),
        gravity_m_s2=0.0,
        rotation_sigmas=np.array(config.wheels.rotation_sigmas_rad()),
        wheels=model,
    )
    return _with_heading(data), warnings


def _with_heading(data: SmootherInput) -> SmootherInput:
    """The input with what `topics.heading` says."""
    config = data.config.heading
    headings, baselines = directions_of(data.motion, data.positions, data.config)
    arm = np.zeros(3) if config.lever_arm is None else np.array(config.lever_arm)
    return replace(
        data,
        headings=headings,
        baselines=baselines,
        heading_yaw=config.yaw_rad,
        second_arm=arm,
    )


def _positions(
    motion: MotionData, config: Config, inertial: Inertial, needed: bool
) -> tuple[Positions | None, float, list[str]]:
    """The fixes in the map that lie within the IMU's span, None: none; normal gravity; warnings."""
    assert motion.gnss is not None
    positions, lines = positions_in_map(motion.gnss, config, motion.name)
    gravity = normal_gravity(positions.origin_deg_m[0], positions.origin_deg_m[2])
    stamps = positions.stamps_ns
    begin, end = inertial.begin_ns, inertial.end_ns
    within = (stamps >= begin) & (stamps <= end)
    if within.any():
        # The others have no residuals: among those that judge the noise they would be perfect.
        # What is rough is so beside those that remain.
        cov = (positions.cov_map / positions.shared[:, None, None])[within]
        shared = shared_by_rough(stamps[within], cov)
        positions = replace(
            positions,
            stamps_ns=stamps[within],
            position_map=positions.position_map[within],
            cov_map=cov * shared[:, None, None],
            shared=shared,
        )
        return positions, gravity, list(lines)
    span = "the IMU's span" if motion.imu is not None else "the span of the velocities"
    if needed:
        raise TrajectoryError(
            f"{motion.name}: no GNSS fix lies within {span}, {begin * 1e-9:.3f} s to "
            f"{end * 1e-9:.3f} s; fixes from {stamps[0] * 1e-9:.3f} s to {stamps[-1] * 1e-9:.3f} "
            "s. Check their clocks with 'caliv-graph inspect', or remove topics.gnss"
        )
    unused = f"{motion.name}: no GNSS fix lies within {span}: GNSS is not used"
    return None, gravity, [*lines, unused]


def has_orientation(imu: ImuSamples, inertial: Inertial, name: str) -> bool:
    """Whether messages carry an orientation; its vertical must agree with the accelerometer's."""
    usable = usable_orientations(imu) & np.isfinite(imu.specific_force).all(axis=1)
    stamps = imu.stamps_ns
    usable &= (stamps >= inertial.begin_ns) & (stamps <= inertial.end_ns)
    if imu.orientation_xyzw is None or not usable.any():
        return False
    R = rotations_of(imu.orientation_xyzw[usable])
    up = np.einsum("nij,nj->ni", R, imu.specific_force[usable]).mean(axis=0)
    tilt = math.acos(float(np.clip(up[2] / np.linalg.norm(up), -1.0, 1.0)))
    if tilt > MAX_TILT_DISAGREEMENT_RAD:
        raise TrajectoryError(
            f"{name}: the IMU's orientation and its accelerometer disagree by "
            f"{math.degrees(tilt):.0f} degrees on where up is: the orientation has to be that of "
            "the IMU's own frame in ENU axes, z up. Choose another topics.imu, or set its "
            "orientation_covariance[0] to -1"
        )
    return True


def scaled(data: SmootherInput, scales: Mapping[str, float]) -> SmootherInput:
    """The input with some stated sigmas multiplied (`variances.COMPONENTS`)."""
    noise, positions = data.noise, data.positions
    if positions is not None:
        horizontal, vertical = (scales.get(f"gnss_{s}", 1.0) for s in ("horizontal", "vertical"))
        axes = np.array([horizontal, horizontal, vertical])
        positions = replace(positions, cov_map=positions.cov_map * np.outer(axes, axes))
    headings, baselines = data.headings, data.baselines
    if headings is not None:
        headings = replace(headings, var=headings.var * scales.get("heading", 1.0) ** 2)
    if baselines is not None:
        cov = baselines.cov_map * scales.get("baseline", 1.0) ** 2
        baselines = replace(baselines, cov_map=cov)
    noise = replace(
        noise,
        gyro_density=noise.gyro_density * scales.get("gyroscope", 1.0) ** 2,
        force_density=noise.force_density * scales.get("accelerometer", 1.0) ** 2,
    )
    if data.wheels is not None:
        noise = scaled_wheel_noise(noise, scales)
    every = {name: data.scales.get(name, 1.0) * scale for name, scale in scales.items()}
    return replace(
        data,
        noise=noise,
        positions=positions,
        headings=headings,
        baselines=baselines,
        scales={**data.scales, **every},
    )


PARTS = {"speed": "velocity_forward", "yaw_rate": "yaw rate"}
"""Noise levels that are not called by their sensor -> sensor and part."""


def noise_sources(data: SmootherInput) -> dict[str, str]:
    """Sensor in use -> where its noise figures are from."""
    out = dict(data.noise.sources)
    if data.orientation:
        assert data.motion.imu is not None
        out["orientation"] = orientation_covariances(data.motion.imu, data.config)[1]
    if data.positions is not None:
        out["gnss"] = data.positions.source
    if data.motion.twist is not None:
        out["velocity"] = velocity_covariances(data.motion.twist, data.config)[1]
    if data.headings is not None:
        out["heading"] = data.headings.source
    if data.baselines is not None:
        out["baseline"] = data.baselines.source
    for name, scale in data.scales.items():
        sensor, _, part = PARTS.get(name, name).partition("_")
        what = f", {part}" if part else ""
        out[sensor] = f"{out[sensor]}{what} times {scale:.2f} by the residuals"
    return out
