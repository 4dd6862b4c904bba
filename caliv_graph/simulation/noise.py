"""Random draws of a simulation other than LiDAR noise, each from its own random stream.

Because the streams are separate, a change in one place (another LiDAR, other pose errors) does not
change any other draw of the same seed.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence

import gtsam
import numpy as np

from caliv_graph.config.mounting import PoseConfig
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import ConfigError
from caliv_graph.products import Array, IntArray
from caliv_graph.scenario.beams import channel_elevations_deg
from caliv_graph.scenario.model import InitialGuessModel, SuspensionModel
from caliv_graph.scenario.sensor_models import LidarModel, PoseNoiseModel
from caliv_graph.simulation.lidar import ChannelErrors


class Stream(enum.IntEnum):
    """The random streams. A seed means the same only while the numbers stay: append only."""

    POSES = 0
    SUSPENSION = 1
    INITIAL_GUESS = 2
    LIDAR = 3
    IMU = 4
    IMU_BIAS = 5
    ORIENTATION = 6
    GNSS = 7
    GNSS_OUTLIERS = 8
    VELOCITY = 9
    THINNED_LIDAR = 10
    GROUND_WAVES = 11
    GNSS_CORRELATED = 12
    ORIENTATION_CORRELATED = 13
    RANGE_BIAS = 14
    TIME_JITTER = 15
    CHANNELS = 16
    GYROSCOPE_SCALE = 17


def random_stream(seed: int, stream: Stream, *index: int) -> np.random.Generator:
    """The generator of one stream; `index` is that of a LiDAR, and of a cloud if each has one.

    Raises:
        ConfigError: the seed is negative.
    """
    if seed < 0:
        raise ConfigError(f"seed: must be 0 or a positive whole number, not {seed}")
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(stream, *(index or (0,)))))


def height_and_heave(
    model: SuspensionModel, count: int, rng: np.random.Generator
) -> tuple[float, Array]:
    """Error of the vehicle's height for the drive, and (count,) heave per frame, in metres.

    Heave is white from frame to frame: frames are 0.1 s apart, longer than the correlation time of
    a sprung body.
    """
    height_m = model.height_sigma_m * float(rng.standard_normal())
    heave_m: Array = model.heave_sigma_m * rng.standard_normal(count)
    return height_m, heave_m


def drawn_range_bias_m(model: LidarModel, rng: np.random.Generator) -> float:
    """The constant error of all ranges of a LiDAR on one drive, in metres."""
    return model.range_bias_m + model.range_bias_sigma_m * float(rng.standard_normal())


def drawn_channel_errors(model: LidarModel, rng: np.random.Generator) -> ChannelErrors:
    """The errors of the channels of a LiDAR on one drive."""
    draws = rng.standard_normal((3, len(channel_elevations_deg(model))))
    turned = 1e-3 * model.channel_direction_sigma_mrad
    return ChannelErrors(
        range_m=model.channel_bias_sigma_m * draws[0],
        elevation_rad=turned * draws[1],
        azimuth_rad=turned * draws[2],
    )


def gauss_markov(
    stamps_ns: IntArray, correlation_s: float, rng: np.random.Generator, axes: int = 3
) -> Array:
    """(n, axes) first-order Gauss-Markov errors of unit sigma, stationary from the first stamp."""
    draws = rng.standard_normal((len(stamps_ns), axes))
    dt_s = np.diff(stamps_ns) / NANOSECONDS_PER_SECOND
    decay = np.exp(-dt_s / correlation_s)
    fresh = np.sqrt(1.0 - decay**2)
    out = draws.copy()
    for i, (keep, new) in enumerate(zip(decay.tolist(), fresh.tolist(), strict=True), start=1):
        out[i] = keep * out[i - 1] + new * draws[i]
    return out


def noisy_poses(
    stamps_ns: IntArray,
    T_map_vehicle: Sequence[gtsam.Pose3],
    model: PoseNoiseModel,
    rng: np.random.Generator,
) -> tuple[gtsam.Pose3, ...]:
    """Poses with the errors of a filter: white errors and a random walk.

    Position errors are along map axes. The white rotation error is a right perturbation (vehicle
    axes). The walk is a left perturbation (map axes), like the heading drift of a filter.
    """
    n = len(stamps_ns)
    white = rng.standard_normal((n, 6)) * np.repeat(
        [model.rotation_sigma_rad, model.position_sigma_m], 3
    )
    root_dt = np.sqrt(np.diff(stamps_ns, prepend=stamps_ns[:1]) / NANOSECONDS_PER_SECOND)
    walk = np.cumsum(rng.standard_normal((n, 6)) * root_dt[:, None], axis=0) * np.repeat(
        [model.rotation_walk_rad_sqrts, model.position_walk_m_sqrts], 3
    )
    return tuple(
        gtsam.Pose3(
            gtsam.Rot3.Expmap(w[:3]).compose(true.rotation()).compose(gtsam.Rot3.Expmap(e[:3])),
            true.translation() + w[3:] + e[3:],
        )
        for true, e, w in zip(T_map_vehicle, white, walk, strict=True)
    )


def perturbed_extrinsic(
    extrinsic: PoseConfig, model: InitialGuessModel, rng: np.random.Generator
) -> PoseConfig:
    """An initial guess with uniform errors of position per vehicle axis, and of rotation.

    The rotation is R_true Rxyz, with roll, pitch and yaw of Rxyz drawn uniformly (CaLiV, section
    IV, Evaluation). The guess is rounded to a micrometre and a microdegree.
    """
    shift_m = rng.uniform(-1.0, 1.0, 3) * model.translation_m
    turn_rad = rng.uniform(-1.0, 1.0, 3) * math.radians(model.rotation_deg)
    T_vehicle_lidar = extrinsic.pose()
    rotation = T_vehicle_lidar.rotation().compose(gtsam.Rot3.RzRyRx(*turn_rad))
    return PoseConfig(
        xyz=_rounded(T_vehicle_lidar.translation() + shift_m),
        rpy_deg=_rounded(np.degrees(rotation.rpy())),
    )


def _rounded(values: Array) -> tuple[float, float, float]:
    x, y, z = (round(float(value), 6) for value in values)
    return (x, y, z)
