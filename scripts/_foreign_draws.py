"""Random streams and effects of the other simulator, which imports nothing from caliv_graph."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

EFFECTS: Mapping[str, str] = {
    "driver": "speed and steering that are not steady",
    "slip": "side slip of the rear axle",
    "springs": "roll and pitch of the body in bends and when braking",
    "uneven": "waves, bumps and grain of the ground",
    "crown": "crown of a street",
    "kerbs": "kerbs of a street",
    "grass": "grass that beams do not pass",
    "movers": "a walker and a passing car",
    "lever_arm": "errors of the lever arms that the config states",
    "imu_noise": "white noise of the IMU",
    "imu_bias": "biases of the IMU, which walk",
    "imu_scale": "scale errors of the IMU",
    "imu_misalign": "mounting errors of the IMU, and of its gyroscopes to its accelerometers",
    "imu_quantisation": "steps of the IMU's numbers",
    "vibration": "vibration of the IMU while rolling",
    "ins": "errors of the orientation of an INS",
    "gnss_white": "white errors of fixes",
    "gnss_slow": "slow errors of fixes",
    "gnss_worse": "a stretch of worse fixes, which they state",
    "wheel_scale": "scale error of the wheel speed",
    "wheel_noise": "noise of wheel speed and yaw rate",
    "wheel_quantisation": "steps of the wheel speed",
    "pose_white": "white errors of an odometry",
    "pose_slow": "slow errors of an odometry",
    "pose_drift": "drift of an odometry",
    "range_noise": "noise of ranges, which grows with range and flat incidence",
    "range_bias": "range bias of a LiDAR",
    "channel_range": "range biases of the channels",
    "channel_angle": "angle errors of the channels",
    "incidence_bias": "ranges that are longer at flat incidence",
    "edges": "ranges between two surfaces, and lost ones, at edges",
    "dropouts": "beams without an echo",
    "quantisation": "steps of ranges",
}
"""What can be switched off."""


@dataclass(frozen=True)
class Draws:
    """Random numbers of one drive.

    Attributes:
        scenario: its name.
        seed: of all streams.
        off: effects that are switched off.
    """

    scenario: str
    seed: int
    off: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        unknown = sorted(self.off - EFFECTS.keys())
        if unknown:
            raise ValueError(f"no such effect: {', '.join(unknown)}")

    def stream(self, name: str) -> np.random.Generator:
        """A generator that depends on scenario, seed and name alone."""
        return np.random.default_rng([self.seed, zlib.crc32(f"{self.scenario} {name}".encode())])

    def on(self, effect: str) -> bool:
        """Whether an effect is there."""
        if effect not in EFFECTS:
            raise ValueError(f"no such effect: {effect}")
        return effect not in self.off
