"""What is known of the extrinsics before any data: the initial guesses and their sigmas."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from caliv_graph.config.lidars import FoundLidarConfig, LidarConfig, PoseSigmaConfig
from caliv_graph.config.model import Config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.products import Array, Guess

DEFAULT_GUESS_SIGMAS = PoseSigmaConfig().sigmas()
"""(6,) 1 sigma of a guess for which nothing is stated: the defaults of the config."""

TRUSTED_SIGMAS = np.array([1e-5] * 3 + [1e-4] * 3)
"""Sigmas of an extrinsic that the user trusts (`fixed: true`): 0.1 mm and 0.01 mrad, far below what
any drive determines, and still an invertible covariance."""


FOUND_SIGMA = PoseSigmaConfig(xyz=0.2, rpy_deg=2.0)
"""How far off a mounting is that was found in the drive, where the drive determines it: a cell of
the finest grid, and what that turns at 10 m. What the drive tells no better than half of this is
undetermined, and then the covariance knows nothing of it (`products.Guess.found`)."""


def with_found_of(config: Config, other: Config) -> Config:
    """The config with the guesses that another one has found for LiDARs without any."""
    lidars = {
        name: other.lidars[name] if lidar.initial is None else lidar
        for name, lidar in config.lidars.items()
    }
    return config.model_copy(update={"lidars": lidars})


def configured_guess(config: Config, name: str) -> Guess:
    """The initial guess of a LiDAR, as the config states it, or as it was found in the drive.

    Raises:
        ConfigError: there is none.
    """
    lidar = config.lidars[name]
    found = isinstance(lidar, FoundLidarConfig)
    return Guess(lidar.guess(), stated_sigmas(lidar), lidar.fixed, found)


def stated_sigmas(lidar: LidarConfig) -> Array:
    """(6,) 1 sigma of the guess of a LiDAR, vehicle axes, rad and m."""
    return TRUSTED_SIGMAS if lidar.fixed else lidar.sigma.sigmas()


def prior_sigmas(guess: Guess) -> Array:
    """(6,) sigmas of the prior that a guess is in a solve, vehicle axes, rad and m.

    A trusted guess (`fixed: true`) is a measurement. Its prior has the default sigmas: with its own
    the prior would be as good as the data, and its axes would count as undetermined.
    """
    return DEFAULT_GUESS_SIGMAS if guess.fixed else guess.sigmas


def trust_information(guesses: Sequence[Guess]) -> Array:
    """(6n, 6n) information that trusted guesses add to the data, vehicle axes; zero for others."""
    trusted = [guess.fixed * guess.sigmas**-2.0 for guess in guesses]
    return np.diag(np.concatenate([*trusted, np.zeros(0)]))


def with_guess(config: Config, name: str, T_vehicle_lidar: gtsam.Pose3) -> Config:
    """The config with another initial guess of a LiDAR; its sigma stays."""
    return _replaced(config, name, config.lidars[name], T_vehicle_lidar)


def with_found_guess(config: Config, name: str, T_vehicle_lidar: gtsam.Pose3) -> Config:
    """The config with a guess of a LiDAR that was found in the drive."""
    given = {key: value for key, value in config.lidars[name] if key != "sigma"}
    lidar = FoundLidarConfig.model_construct(**given, sigma=FOUND_SIGMA)
    return _replaced(config, name, lidar, T_vehicle_lidar)


def _replaced(
    config: Config, name: str, lidar: LidarConfig, T_vehicle_lidar: gtsam.Pose3
) -> Config:
    x, y, z = (float(v) for v in T_vehicle_lidar.translation())
    roll, pitch, yaw = (float(v) for v in np.degrees(T_vehicle_lidar.rotation().rpy()))
    initial = PoseConfig(xyz=(x, y, z), rpy_deg=(roll, pitch, yaw))
    moved = lidar.model_copy(update={"initial": initial})
    return config.model_copy(update={"lidars": {**config.lidars, name: moved}})
