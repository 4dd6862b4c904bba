"""What is known of the extrinsics before any data: the initial guesses and their sigmas."""

from __future__ import annotations

import numpy as np

from caliv_graph.config.model import Config, PoseSigmaConfig
from caliv_graph.products import Guess

DEFAULT_GUESS_SIGMAS = PoseSigmaConfig().sigmas()
"""(6,) 1 sigma of a guess for which nothing is stated: the defaults of the config."""

TRUSTED_SIGMAS = np.array([1e-5] * 3 + [1e-4] * 3)
"""Sigmas of an extrinsic that the user trusts (`fixed: true`): 0.1 mm and 0.01 mrad, far below what
any drive determines, and still an invertible covariance."""


def configured_guess(config: Config, name: str) -> Guess:
    """The initial guess of a LiDAR, as the config states it."""
    lidar = config.lidars[name]
    sigmas = TRUSTED_SIGMAS if lidar.fixed else lidar.sigma.sigmas()
    return Guess(lidar.initial.pose(), sigmas, lidar.fixed)
