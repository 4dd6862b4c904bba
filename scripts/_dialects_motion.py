"""Motion data of a simulated drive as drivers of wheels and of two antennas write them.

What the config states with a sigma is drawn: the scale of the speeds, the bias of the yaw rate, the
turn of the vehicle frame against the wheels, that of the baseline of the antennas.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pymap3d

from caliv_graph.readers.pose_file import read_poses

RATE_HZ = 50
SPEED_M_S, YAW_RATE_RAD_S = 0.03, 0.005
"""White noise of the odometry."""

SCALE, YAW_RATE_BIAS_RAD_S = 0.02, 0.01
AXES_RAD = np.radians([0.3, 0.3, 0.1])
"""1 sigma of what is drawn once per drive, as the defaults of `wheels` and `noise` say."""

HALF_STEP_S = 0.01
"""Of the differences of the true poses, which are every 10 ms."""

HEADING_HZ = 10
HEADING_RAD, BASELINE_RAD = math.radians(0.2), math.radians(1.0)
"""White noise of a heading, and 1 sigma of the direction of the baseline, which is drawn."""

BASELINE_DEG = 90.0
"""Direction of the baseline as the config has it: to the left."""

SECOND_ARM, ARM_M = (-1.2, 0.4, 0.0), 0.01
"""The second antenna as the config has it, and 1 sigma of it, which is drawn."""

FIX_M = (0.0167, 0.0167, 0.02)
"""White noise of its fixes, that of the first."""

Message = tuple[int, str, str, dict[str, Any]]
"""Stamp, topic, type and fields of a message."""


def time_message(at_ns: int) -> dict[str, int]:
    """The fields of a builtin_interfaces/Time."""
    return {"sec": at_ns // 10**9, "nanosec": at_ns % 10**9}


@dataclass(frozen=True)
class Drawn:
    """Errors of one drive.

    The scale of the speeds; bias of the yaw rate; (3,) turn of the vehicle's axes; error of the
    direction of the baseline; (3,) error of the place of the second antenna.
    """

    scale: float
    yaw_rate_bias: float
    axes_rad: np.typing.NDArray[np.float64]
    baseline_rad: float
    arm_m: np.typing.NDArray[np.float64]


def drawn(seed: int) -> Drawn:
    """The errors of the drive of a seed."""
    rng = np.random.default_rng([seed, 1])
    return Drawn(
        1.0 + SCALE * float(rng.standard_normal()),
        YAW_RATE_BIAS_RAD_S * float(rng.standard_normal()),
        AXES_RAD * rng.standard_normal(3),
        BASELINE_RAD * float(rng.standard_normal()),
        ARM_M * rng.standard_normal(3),
    )


def turned(T_vehicle_lidar: gtsam.Pose3, seed: int) -> gtsam.Pose3:
    """A true mounting in the vehicle frame that is turned against the wheels."""
    return gtsam.Pose3(gtsam.Rot3.Expmap(drawn(seed).axes_rad), np.zeros(3)).compose(
        T_vehicle_lidar
    )


def odometry(folder: Path, seed: int, yaw_rate: bool = True) -> Iterator[Message]:
    """Speeds of the rear axle: `Odometry` with a yaw rate and drifting poses, or `TwistStamped`."""
    truth = read_poses(folder / "trajectory.tum")
    rng = np.random.default_rng([seed, 2])
    errors = drawn(seed)
    every = round(1.0 / (2.0 * HALF_STEP_S) / RATE_HZ * 2)
    x = y = yaw = 0.0
    for i in range(1, len(truth.stamps_ns) - 1, every):
        before, after = truth.T_map_vehicle[i - 1], truth.T_map_vehicle[i + 1]
        step = gtsam.Pose3.Logmap(before.between(after)) / (2.0 * HALF_STEP_S)
        speed = errors.scale * step[3] + SPEED_M_S * rng.standard_normal()
        rate = step[2] + errors.yaw_rate_bias + YAW_RATE_RAD_S * rng.standard_normal()
        x += speed * math.cos(yaw) / RATE_HZ
        y += speed * math.sin(yaw) / RATE_HZ
        yaw += rate / RATE_HZ
        stamp = int(truth.stamps_ns[i])
        twist = {"linear": {"x": speed}, "angular": {"z": rate if yaw_rate else 0.0}}
        header = {"stamp": time_message(stamp)}
        if not yaw_rate:
            fields = {"header": {**header, "frame_id": "base_link"}, "twist": twist}
            yield stamp, "/vehicle/speed", "geometry_msgs/msg/TwistStamped", fields
            continue
        # As drivers of wheel odometry do: what they do not measure has a large variance or none.
        cov = np.diag([SPEED_M_S**2, 0.0, 0.0, 0.0, 0.0, YAW_RATE_RAD_S**2]).ravel()
        q = {"z": math.sin(0.5 * yaw), "w": math.cos(0.5 * yaw)}
        yield (
            stamp,
            "/odom",
            "nav_msgs/msg/Odometry",
            {
                "header": {**header, "frame_id": "odom"},
                "child_frame_id": "base_link",
                "pose": {"pose": {"position": {"x": x, "y": y}, "orientation": q}},
                "twist": {"twist": twist, "covariance": cov},
            },
        )


def headings(folder: Path, seed: int, as_imu: bool = False) -> Iterator[Message]:
    """Headings of a baseline to the left.

    As nmea_navsat_driver writes them (`QuaternionStamped`, from north to the right), or as
    ublox_gps does (`Imu`, from east to the left, with a variance).
    """
    truth = read_poses(folder / "trajectory.tum")
    rng = np.random.default_rng([seed, 3])
    direction = math.radians(BASELINE_DEG) + drawn(seed).baseline_rad
    every = round(1.0 / HALF_STEP_S / HEADING_HZ)
    for i in range(3, len(truth.stamps_ns), every):
        R = truth.T_map_vehicle[i].rotation().matrix()
        x, y, _ = R @ [math.cos(direction), math.sin(direction), 0.0]
        azimuth = math.atan2(y, x) + HEADING_RAD * rng.standard_normal()
        yaw = azimuth if as_imu else 0.5 * math.pi - azimuth
        q = {"z": math.sin(0.5 * yaw), "w": math.cos(0.5 * yaw)}
        stamp = int(truth.stamps_ns[i])
        header = {"stamp": time_message(stamp), "frame_id": "gnss"}
        if not as_imu:
            fields = {"header": header, "quaternion": q}
            yield stamp, "/heading", "geometry_msgs/msg/QuaternionStamped", fields
            continue
        cov = np.diag([1e3, 1e3, HEADING_RAD**2]).ravel()
        unknown = np.array([-1.0] + [0.0] * 8)
        fields = {
            **{"header": header, "orientation": q, "orientation_covariance": cov},
            **{"angular_velocity_covariance": unknown, "linear_acceleration_covariance": unknown},
        }
        yield stamp, "/navheading", "sensor_msgs/msg/Imu", fields


def second_fixes(folder: Path, seed: int, origin: tuple[float, float, float]) -> Iterator[Message]:
    """Fixes of a second antenna, as NavSatFix; `origin` (degrees, m) is that of the map."""
    truth = read_poses(folder / "trajectory.tum")
    rng = np.random.default_rng([seed, 4])
    arm = np.array(SECOND_ARM) + drawn(seed).arm_m
    every = round(1.0 / HALF_STEP_S / HEADING_HZ)
    for i in range(0, len(truth.stamps_ns), every):
        place = truth.T_map_vehicle[i].transformFrom(arm) + FIX_M * rng.standard_normal(3)
        east, north, up = place
        latitude, longitude, altitude = pymap3d.enu2geodetic(east, north, up, *origin)
        stamp = int(truth.stamps_ns[i])
        header = {"stamp": time_message(stamp), "frame_id": "gnss_2"}
        fields = {
            **{"header": header, "status": {"status": 2, "service": 1}},
            **{"latitude": float(latitude), "longitude": float(longitude)},
            "altitude": float(altitude),
            "position_covariance": np.diag(np.square(FIX_M)).ravel(),
            "position_covariance_type": 2,
        }
        yield stamp, "/gnss/second/fix", "sensor_msgs/msg/NavSatFix", fields
