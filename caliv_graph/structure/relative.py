"""Structure of a drive without motion data: the LiDARs to each other, and nothing of the vehicle.

The poses come from the odometry of one LiDAR. Any rigid change G of the vehicle frame, X_i to
X_i G^-1 and E_a to G E_a, is then a gauge freedom. It is removed by holding E of the tracked LiDAR,
and put back into the term exactly (`README.md`, section 11a).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from caliv_graph.config.guesses import configured_guess
from caliv_graph.config.lidars import FoundLidarConfig
from caliv_graph.config.model import Config
from caliv_graph.geometry.covariance import about_one_jacobian
from caliv_graph.products import Array
from caliv_graph.structure.problem import Problem
from caliv_graph.trajectory.odometry import OdometryPoses

HELD_RAD, HELD_M = 1e-7, 1e-6
"""1 sigma of the mounting of the tracked LiDAR in the steps of the solve: far below what structure
tells, and still no matter for double precision."""


def start_about(
    odometry: OdometryPoses, start: Mapping[str, gtsam.Pose3], config: Config
) -> dict[str, gtsam.Pose3]:
    """Rough T_vehicle_lidar in the vehicle frame by which an odometry defines its poses.

    Guesses keep their places to each other. Those that were found are found in that frame.
    """
    turned = odometry.T_vehicle_lidar.compose(start[odometry.lidar].inverse())
    return {
        name: T if isinstance(config.lidars[name], FoundLidarConfig) else turned.compose(T)
        for name, T in start.items()
    } | {odometry.lidar: odometry.T_vehicle_lidar}


def held_sigmas(odometry: OdometryPoses, config: Config) -> dict[str, Array]:
    """(6,) per LiDAR: of its place to the tracked one, as the guesses of both know it; 0: held."""
    own = configured_guess(config, odometry.lidar).sigmas
    out = {}
    for name in config.lidars:
        guess = configured_guess(config, name)
        out[name] = guess.sigmas if guess.found else np.hypot(guess.sigmas, own)
    return out | {odometry.lidar: np.zeros(6)}


def relative_problem(
    problem: Problem, odometry: OdometryPoses, start: Mapping[str, gtsam.Pose3], config: Config
) -> Problem:
    """The problem with the tracked LiDAR held, and without the vehicle's stand on the ground."""
    sigmas = []
    for name in problem.patches.lidars:
        held = np.repeat([HELD_RAD, HELD_M], 3)
        sigmas.append(np.maximum(held_sigmas(odometry, config)[name], held))
    begun = tuple(start[name] for name in problem.patches.lidars)
    return replace(
        problem,
        guesses=begun,
        held_at=begun,
        held_information=np.diag(np.concatenate(sigmas) ** -2.0),
        standing=replace(problem.standing, height_m=None, tilt_sigma_rad=None),
    )


def relative_quadratic(
    information: Array,
    gradient: Array,
    T_vehicle_lidar: Sequence[gtsam.Pose3],
    tracked: int,
) -> tuple[Array, Array]:
    """What a quadratic on n extrinsics says with one of them held, on the places to each other.

    Args:
        information: (6 n, 6 n), right perturbations of T_vehicle_lidar; all poses eliminated.
        gradient: (6 n,).
        T_vehicle_lidar: n, where it was linearised.
        tracked: index of the LiDAR that is held.

    Returns:
        Information and gradient on the same coordinates. A common motion of all LiDARs changes
        nothing.
    """
    B = about_one_jacobian(T_vehicle_lidar, tracked)
    out = B.T @ information @ B
    return 0.5 * (out + out.T), B.T @ gradient
