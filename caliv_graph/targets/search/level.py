"""Roll, pitch and height of a guess that is far off, by the ground that the LiDAR stands above."""

from __future__ import annotations

import math
from collections.abc import Sequence

import gtsam
import numpy as np

from caliv_graph.config.model import Config
from caliv_graph.products import Array
from caliv_graph.targets.ground.fit import fit_ground
from caliv_graph.targets.search.align import GUESS_SIGMAS

MAX_TILT_RAD = math.radians(45.0)
"""A plane that is steeper under the guess is a wall."""

GROUND_M = 0.1
"""Points this near to a plane are of it: ground waves and camber."""

REACH_M = 20.0
"""Only nearer points: farther away the ground is sparse and walls are not."""

AGREE_RAD = math.radians(2.0)
"""Planes of several scans that differ by more than this are not the ground, or a ramp is in it."""

VEHICLE_UP = np.array([0.0, 0.0, 1.0])


def levelled(
    scans_lidar: Sequence[Array],
    R_map_vehicle: Array,
    guess: gtsam.Pose3,
    name: str,
    config: Config,
) -> gtsam.Pose3:
    """The guess `T_vehicle_lidar` with the tilt that makes the ground parallel to the vehicle.

    The guess itself where no ground is seen, or where the tilt is within `GUESS_SIGMAS`: that to
    the vehicle, which may stand on a slope, or that to the map's vertical, to which the vehicle's
    axes may be inclined. The height is corrected where the config has that of the vehicle, and only
    together with the tilt.

    Args:
        scans_lidar: (N, 3) points of some scans, metres, lidar frame.
        R_map_vehicle: (m, 3, 3) attitudes of the vehicle at these.
        guess: of the LiDAR.
        name: of the LiDAR.
        config: sigmas of the guesses, height of the vehicle.
    """
    lidar = config.lidars[name]
    R_guess = guess.rotation().matrix()
    ups, normals, heights = [], [], []
    for points, R in zip(scans_lidar, R_map_vehicle, strict=True):
        range_m = np.linalg.norm(points, axis=1)
        near = points[(range_m >= lidar.min_range) & (range_m < REACH_M)]
        plane = fit_ground(near @ (R @ R_guess).T, GROUND_M, MAX_TILT_RAD)
        if plane is not None and plane[3] > 0.0:
            normals.append(R.T @ plane[:3])
            ups.append(R[2])
            heights.append(float(plane[3]))
    if lidar.fixed or not normals:
        return guess
    normal, vertical = (np.mean(of, axis=0) for of in (normals, ups))
    normal, vertical = normal / np.linalg.norm(normal), vertical / np.linalg.norm(vertical)
    tilt, to_vertical = (math.acos(min(float(normal @ up), 1.0)) for up in (VEHICLE_UP, vertical))
    spread = max(math.acos(min(float(normal @ each), 1.0)) for each in normals)
    within = GUESS_SIGMAS * max(lidar.sigma.rpy_rad()[:2])
    if min(tilt, to_vertical) <= within or spread > AGREE_RAD:
        return guess
    axis = np.cross(normal, VEHICLE_UP)
    C = gtsam.Rot3.Expmap(tilt * axis / np.linalg.norm(axis))
    t = guess.translation()
    if config.ground.vehicle_height is not None:
        t = np.array([t[0], t[1], float(np.median(heights)) - config.ground.vehicle_height])
    return gtsam.Pose3(C.compose(guess.rotation()), t)
