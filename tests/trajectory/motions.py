"""Drives with known truth, and what IMU, GNSS, velocity and orientation sensors say of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TypeVar

import gtsam
import numpy as np
import pymap3d
from scipy.spatial.transform import Rotation

from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config
from caliv_graph.products import (
    Array,
    BoolArray,
    GnssFixes,
    ImuSamples,
    IntArray,
    MotionData,
    TwistSamples,
)
from caliv_graph.scenario.drives import CurvatureProfile, Drive, SpeedProfile, smoothstep
from caliv_graph.trajectory.gnss import normal_gravity

ORIGIN = (48.2627, 11.6673, 480.0)
GRAVITY = normal_gravity(ORIGIN[0], ORIGIN[2])
START_NS = 1_700_000_000_000_000_000

Samples = TypeVar("Samples", ImuSamples, GnssFixes)
"""Stamps of a bag are absolute: too large for a float."""


def arc_drive(duration_s: float = 17.0) -> Drive:
    """The paper's arc."""
    return Drive(SpeedProfile(2.0, 1.0, 1.5, duration_s), CurvatureProfile(-1.0 / 9.16), 2.8)


def eight_drive(duration_s: float = 61.0) -> Drive:
    """A full circle, then one to the other side."""
    first = -1.0 / 9.16
    middle = 2.0 * (duration_s - 2.5) / 2.0
    change = (middle, 3.0, -2.0 * first)
    return Drive(SpeedProfile(2.0, 1.0, 1.5, duration_s), CurvatureProfile(first, (change,)), 2.8)


@dataclass(frozen=True)
class Truth:
    """True motion at n instants; everything of the vehicle's origin.

    Attributes:
        R_map_vehicle: (n, 3, 3).
        p_map_vehicle: (n, 3).
        velocity_map: (n, 3).
        acceleration_map: (n, 3).
        rates: (n, 3) angular velocity, vehicle axes.
        rates_rate: (n, 3) its derivative.
    """

    R_map_vehicle: Array
    p_map_vehicle: Array
    velocity_map: Array
    acceleration_map: Array
    rates: Array
    rates_rate: Array


@dataclass(frozen=True)
class Course:
    """A drive on flat ground, or one that also heaves, rolls and pitches (`rough`: how much)."""

    drive: Drive
    rough: float = 0.0

    @property
    def duration_s(self) -> float:
        return self.drive.duration_s

    def _rpy_z(self, t: Array) -> tuple[Array, Array]:
        motion = self.drive.motion(np.round(1e9 * t).astype(np.int64))
        swing = self.rough * smoothstep(t / 2.0)
        roll = 0.06 * swing * np.sin(1.7 * t)
        pitch = 0.04 * swing * np.sin(2.3 * t + 0.5)
        z = 0.1 * swing * np.sin(1.1 * t)
        return np.stack([roll, pitch, motion.heading_rad], axis=1), z

    def at(self, t: Array) -> Truth:
        """The state at (n,) seconds after the start."""
        h = 1e-3
        # Angles and heights at five instants are all that the derivatives take.
        before2, before, now, after, after2 = (self._rpy_z(t + k * h) for k in (-2, -1, 0, 1, 2))

        motion = self.drive.motion(np.round(1e9 * t).astype(np.int64))
        z, z_before, z_after = now[1], before[1], after[1]
        c, s = np.cos(motion.heading_rad), np.sin(motion.heading_rad)
        v, a = motion.speed_m_s, motion.acceleration_m_s2
        turn = v * v * motion.curvature_1_m
        velocity = np.stack([v * c, v * s, (z_after - z_before) / (2 * h)], axis=1)
        acceleration = np.stack(
            [a * c - turn * s, a * s + turn * c, (z_after - 2 * z + z_before) / h**2], axis=1
        )
        rates_before, rates, rates_after = (
            _rates(middle[0], (last[0] - first[0]) / (2.0 * h))
            for first, middle, last in (
                (before2, before, now),
                (before, now, after),
                (now, after, after2),
            )
        )
        return Truth(
            R_map_vehicle=np.asarray(Rotation.from_euler("ZYX", now[0][:, ::-1]).as_matrix()),
            p_map_vehicle=np.column_stack([motion.xy_map, z]),
            velocity_map=velocity,
            acceleration_map=acceleration,
            rates=rates,
            rates_rate=(rates_after - rates_before) / (2.0 * h),
        )


def _rates(rpy: Array, change: Array) -> Array:
    """(n, 3) angular velocity in vehicle axes, of roll, pitch and yaw and what they change by."""
    roll, pitch, _ = rpy.T
    of_roll, of_pitch, of_yaw = change.T
    across = np.cos(pitch) * of_yaw
    return np.stack(
        [
            of_roll - np.sin(pitch) * of_yaw,
            np.cos(roll) * of_pitch + np.sin(roll) * across,
            np.cos(roll) * across - np.sin(roll) * of_pitch,
        ],
        axis=1,
    )


@dataclass(frozen=True)
class Sensors:
    """Extrinsics, rates and noise; the noise is the paper's, `noise` scales all of it."""

    T_vehicle_imu: gtsam.Pose3 = field(default_factory=gtsam.Pose3)
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    imu_hz: float = 100.0
    gnss_hz: float = 10.0
    gnss_delay_s: float = 0.0
    twist_hz: float = 10.0
    twist_delay_s: float = 0.0
    noise: float = 1.0
    force_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gyro_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_bias_rad: float = 0.0


def stamps(duration_s: float, hz: float, delay_s: float = 0.0) -> IntArray:
    """Regular stamps over a drive, ns."""
    t = np.arange(0.0, duration_s + 1e-9, 1.0 / hz) + delay_s
    return START_NS + np.round(1e9 * t[t <= duration_s]).astype(np.int64)


def seconds(stamps_ns: IntArray) -> Array:
    """Seconds since the start."""
    return np.asarray((stamps_ns - START_NS) * 1e-9)


def record(course: Course, sensors: Sensors, seed: int) -> MotionData:
    """What the sensors say of a drive."""
    rng = np.random.default_rng(seed)
    k = sensors.noise

    def white(n: int, sigma: float) -> Array:
        return k * sigma * rng.standard_normal((n, 3))

    at = stamps(course.duration_s, sensors.imu_hz)
    truth = course.at(seconds(at))
    R_vi = sensors.T_vehicle_imu.rotation().matrix()
    arm = sensors.T_vehicle_imu.translation()
    acceleration = np.einsum("nji,nj->ni", truth.R_map_vehicle, truth.acceleration_map)
    up = np.einsum("nji,j->ni", truth.R_map_vehicle, [0.0, 0.0, GRAVITY])
    turning = np.cross(truth.rates_rate, arm) + np.cross(truth.rates, np.cross(truth.rates, arm))
    gyro = truth.rates @ R_vi + sensors.gyro_bias + white(len(at), 0.005)
    force = (acceleration + up + turning) @ R_vi + sensors.force_bias + white(len(at), 0.05)
    turned = Rotation.from_euler("z", sensors.yaw_bias_rad)
    said = turned * Rotation.from_matrix(truth.R_map_vehicle @ R_vi)
    said = said * Rotation.from_rotvec(white(len(at), 0.005))
    imu = ImuSamples(at, gyro, force, np.asarray(said.as_quat()))

    fixes = stamps(course.duration_s, sensors.gnss_hz, sensors.gnss_delay_s)
    where = course.at(seconds(fixes))
    antenna = where.p_map_vehicle + where.R_map_vehicle @ np.array(sensors.lever_arm)
    antenna = antenna + white(len(fixes), 1.0) * [0.0167, 0.0167, 0.02]
    east, north, up = antenna.T
    latitude, longitude, altitude = pymap3d.enu2geodetic(east, north, up, *ORIGIN)
    gnss = GnssFixes(fixes, np.asarray(latitude), np.asarray(longitude), np.asarray(altitude))

    when = stamps(course.duration_s, sensors.twist_hz, sensors.twist_delay_s)
    moving = course.at(seconds(when))
    velocity = np.einsum("nji,nj->ni", moving.R_map_vehicle, moving.velocity_map)
    twist = TwistSamples(when, velocity + white(len(when), 0.1))
    return MotionData("drive/", imu=imu, gnss=gnss, twist=twist)


def first_fix_map(motion: MotionData) -> Array:
    """(3,) the map's origin, the first fix, in the truth's coordinates."""
    gnss = motion.gnss
    assert gnss is not None
    first = pymap3d.geodetic2enu(
        gnss.latitude_deg[:1], gnss.longitude_deg[:1], gnss.altitude_m[:1], *ORIGIN
    )
    return np.concatenate(first)


def config_for(sensors: Sensors, **sections: Mapping[str, object]) -> Config:
    """A config that knows extrinsics, clocks and gyroscope exactly, but for what `sections` say."""
    rpy = np.degrees(sensors.T_vehicle_imu.rotation().rpy())
    known: dict[str, object] = {} if not any(sensors.lever_arm) else {"lever_arm_sigma": 1e-7}
    same = sensors.T_vehicle_imu.equals(gtsam.Pose3(), 1e-9)
    turned: dict[str, object] = {} if same else {"rotation_sigma_deg": 1e-6, "xyz_sigma": 1e-7}
    raw: dict[str, object] = {
        "lidars": {"front": {"topic": "/front", "initial": {"xyz": [2, 0, 2]}}},
        **sections,
    }
    clock = {"time_offset_sigma_s": 0.0}
    arm = {"lever_arm": list(sensors.lever_arm), **known}
    raw["gnss"] = {**clock, **sections.get("gnss", arm)}
    raw["wheels"] = {**clock, **sections.get("wheels", {})}
    raw["imu"] = {
        **clock,
        "gyroscope_scale_sigma": 0.0,
        "T_vehicle_imu": {
            "xyz": sensors.T_vehicle_imu.translation().tolist(),
            "rpy_deg": rpy.tolist(),
        },
        **turned,
        **sections.get("imu", {}),
    }
    return parse_config(raw, "test", Path())


def errors(
    course: Course, motion: MotionData, stamps_ns: IntArray, R: Array, p: Array
) -> tuple[Array, Array]:
    """(n, 3) rotation errors (rad, vehicle axes) and (n, 3) position errors (m, map axes)."""
    truth = course.at(seconds(stamps_ns))
    dR = Rotation.from_matrix(np.swapaxes(truth.R_map_vehicle, 1, 2) @ R)
    origin = first_fix_map(motion) if motion.gnss is not None else np.zeros(3)
    return np.asarray(dR.as_rotvec()), p - (truth.p_map_vehicle - origin)


def mounted_askew() -> Sensors:
    """IMU and antenna off the vehicle's origin, the IMU turned."""
    rotation = gtsam.Rot3.RzRyRx(math.radians(5.0), math.radians(-4.0), math.radians(88.0))
    T = gtsam.Pose3(rotation, np.array([1.2, -0.4, 0.6]))
    return replace(Sensors(), T_vehicle_imu=T, lever_arm=(0.3, 0.5, 1.8))


def rows_of(samples: Samples, keep: BoolArray) -> Samples:
    """Some of the messages; covariances that all have in common stay."""
    arrays = {f.name: getattr(samples, f.name) for f in fields(samples)}
    own = {n: a for n, a in arrays.items() if a is not None and len(a) == len(keep)}
    return replace(samples, **{n: a[keep] for n, a in own.items()})
