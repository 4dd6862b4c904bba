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

from caliv_graph.readers.pose_file import read_poses

RATE_HZ = 50
SPEED_M_S, YAW_RATE_RAD_S = 0.03, 0.005
"""White noise of the odometry."""

SCALE, YAW_RATE_BIAS_RAD_S = 0.02, 0.01
AXES_RAD = np.radians([0.3, 0.3, 0.1])
"""1 sigma of what is drawn once per drive, as the defaults of `wheels` and `noise` say."""

HALF_STEP_S = 0.01
"""Of the differences of the true poses, which are every 10 ms."""

Message = tuple[int, str, str, dict[str, Any]]
"""Stamp, topic, type and fields of a message."""


@dataclass(frozen=True)
class Drawn:
    """Errors of one drive: the scale of the speeds, and (3,) the turn of the vehicle's axes."""

    scale: float
    yaw_rate_bias: float
    axes_rad: np.typing.NDArray[np.float64]


def drawn(seed: int) -> Drawn:
    """The errors of the drive of a seed."""
    rng = np.random.default_rng([seed, 1])
    return Drawn(
        1.0 + SCALE * float(rng.standard_normal()),
        YAW_RATE_BIAS_RAD_S * float(rng.standard_normal()),
        AXES_RAD * rng.standard_normal(3),
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
        header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}}
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
