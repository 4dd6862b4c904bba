"""Scans of made-up ground, and the plane in a single scan as `GroundMeter` fits it."""

from __future__ import annotations

import math
from collections.abc import Callable

import gtsam
import numpy as np

from caliv_graph.products import Array, LidarScan
from caliv_graph.targets.ground.planes import GroundPlane, fit_plane, near_points

HEIGHT_M = 2.0
NOSE_DOWN = gtsam.Rot3.Pitch(math.radians(10.0))
UP_LIDAR = np.array([-math.sin(math.radians(10.0)), 0.0, math.cos(math.radians(10.0))])

RING = np.array(
    [
        [math.cos(-0.2) * math.cos(a), math.cos(-0.2) * math.sin(a), math.sin(-0.2)]
        for a in np.linspace(-1.0, 1.0, 1600)
    ]
)
"""One ring of a LiDAR, of 0.07 degrees."""

Depth = Callable[[Array], Array]


def beams(columns: int = 120, channels: int = 26) -> Array:
    """(n, 3) unit directions in the lidar frame, 120 by 25 degrees, column by column."""
    azimuth = np.radians(np.linspace(-60.0, 60.0, columns))[:, None]
    elevation = np.radians(np.linspace(-12.5, 12.5, channels))[None]
    return np.stack(
        np.broadcast_arrays(
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation) + 0.0 * azimuth,
        ),
        axis=-1,
    ).reshape(-1, 3)


def level(directions: Array) -> Array:
    """How far it is to the level ground, directions with z up from 2 m above it."""
    down = -directions[:, 2]
    return np.where(down > 1e-6, HEIGHT_M / np.maximum(down, 1e-6), np.inf)


def wall(x_m: float, height_m: float, half_width_m: float = 100.0) -> Depth:
    """An upright wall ahead, on the ground."""

    def depth(directions: Array) -> Array:
        ahead = directions[:, 0] > 1e-6
        distance = np.where(ahead, x_m / np.maximum(directions[:, 0], 1e-6), np.inf)
        hit = np.where(ahead[:, None], distance[:, None] * directions, 0.0)
        on = ahead & (hit[:, 2] + HEIGHT_M < height_m) & (np.abs(hit[:, 1]) < half_width_m)
        return np.where(on, distance, np.inf)

    return depth


def plateau(x_m: float, end_m: float, half_width_m: float, height_m: float) -> Depth:
    """A level surface between x and end, so far above the ground."""

    def depth(directions: Array) -> Array:
        down = np.maximum(-directions[:, 2], 1e-6)
        distance = (HEIGHT_M - height_m) / down
        hit = distance[:, None] * directions
        on = (directions[:, 2] < 0.0) & (hit[:, 0] > x_m) & (hit[:, 0] < end_m)
        return np.where(on & (np.abs(hit[:, 1]) < half_width_m), distance, np.inf)

    return depth


def terrain(height: Callable[[Array], Array]) -> Depth:
    """Ground of a height over x, found by marching along the beams and then halving."""

    def depth(directions: Array) -> Array:
        def above(distance: Array) -> Array:
            return HEIGHT_M + distance * directions[:, 2] - height(distance * directions[:, 0])

        low, high = np.zeros(len(directions)), np.full(len(directions), np.inf)
        for end in np.arange(0.25, 60.0, 0.25):
            hit = np.isinf(high) & (above(np.full(len(directions), end)) < 0.0)
            high[hit] = end
            low[np.isinf(high)] = end
        found = np.isfinite(high)
        high[~found] = low[~found]
        for _ in range(40):
            middle = 0.5 * (low + high)
            under = above(middle) < 0.0
            high, low = np.where(under, middle, high), np.where(under, low, middle)
        return np.where(found, high, np.inf)

    return depth


def scan_of(
    *surfaces: Depth, sigma_m: float = 0.0, seed: int = 0, directions: Array | None = None
) -> LidarScan:
    """What is seen first along each beam, with noise along the beam."""
    directions = beams() if directions is None else directions
    level_directions = directions @ NOSE_DOWN.matrix().T
    distance = np.min([surface(level_directions) for surface in surfaces], axis=0)
    seen = np.isfinite(distance) & (distance < 100.0)
    distance = distance + sigma_m * np.random.default_rng(seed).normal(size=len(distance))
    return LidarScan("front", 0, (directions * distance[:, None])[seen], "made up")


def plane_in(
    scan: LidarScan, up_lidar: Array = UP_LIDAR, sigma_range_m: float = 0.01
) -> GroundPlane | None:
    """The plane in a scan of one instant; `up_lidar` (3,) is upwards to 10 degrees."""
    near = near_points(scan.points_lidar, up_lidar)
    plane, _ = fit_plane(scan.points_lidar[near], up_lidar, sigma_range_m)
    return plane
