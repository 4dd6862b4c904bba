"""Patches of a target are no structure: its clouds say the same already, and better.

A chair's back is a patch of half a metre. Counted as a wall it tells twice what the clouds of the
target tell, and few such patches are matched wrongly: with nothing else that stands around, a still
vehicle's S2S yaw went 10 degrees off.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caliv_graph.config.model import Config
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, BoolArray, IntArray, TargetCloud, TargetObservation
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.trajectory.select import VehicleTrajectory

MARGIN_M = 0.2
"""How far beside the points of a cloud a patch still belongs to the target."""


def without_targets(
    patches: DrivePatches,
    observations: Sequence[TargetObservation],
    trajectory: VehicleTrajectory,
    config: Config,
) -> DrivePatches:
    """The patches of a drive that belong to none of its targets.

    A target is the upright cylinder of the cloud of the same LiDAR that is next in time, from its
    lowest point up: the ground below it stays. Between two scans so near in time an error of the
    guess hardly matters, which moves both alike.
    """
    keep = np.ones(len(patches.scan), bool)
    for a, name in enumerate(patches.lidars):
        own = np.flatnonzero(patches.scan_lidar[patches.scan] == a)
        if not len(own):
            continue
        R_guess, t_guess = (x[0] for x in stack([config.lidars[name].guess()]))
        stamps_ns = patches.stamps_ns[patches.scan[own]]
        centres_map = _in_map(patches.centres_lidar[own], stamps_ns, trajectory, R_guess, t_guess)
        for observation in observations:
            clouds = sorted(
                (c for c in observation.clouds if (c.lidar, c.drive) == (name, patches.drive)),
                key=lambda cloud: cloud.stamp_ns,
            )
            if clouds:
                points_map = [
                    _in_map(
                        c.points_lidar,
                        np.full(len(c.points_lidar), c.stamp_ns),
                        trajectory,
                        R_guess,
                        t_guess,
                    )
                    for c in clouds
                ]
                keep[own] &= ~_inside(centres_map, stamps_ns, clouds, points_map)
    return patches if keep.all() else patches.part(keep)


def _in_map(
    points_lidar: Array,
    stamps_ns: IntArray,
    trajectory: VehicleTrajectory,
    R_guess: Array,
    t_guess: Array,
) -> Array:
    """(N, 3) points at stamps (N,) in the map, by the guess (R, t) of T_vehicle_lidar."""
    stamps, which = np.unique(stamps_ns, return_inverse=True)
    R, t = trajectory.poses_at(stamps)
    points_vehicle = points_lidar @ R_guess.T + t_guess
    return np.asarray(np.einsum("nab,nb->na", R[which], points_vehicle) + t[which])


def _inside(
    centres_map: Array,
    stamps_ns: IntArray,
    clouds: Sequence[TargetCloud],
    points_map: Sequence[Array],
) -> BoolArray:
    """(N,) whether patches are in the cylinder of the cloud that is next in time."""
    at = np.array([cloud.stamp_ns for cloud in clouds])
    after = np.clip(np.searchsorted(at, stamps_ns), 1 if len(at) > 1 else 0, len(at) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(stamps_ns - at[before] < at[after] - stamps_ns, before, after)
    middle = np.array([points[:, :2].mean(axis=0) for points in points_map])
    radius = np.array(
        [
            np.linalg.norm(points[:, :2] - xy, axis=1).max()
            for points, xy in zip(points_map, middle, strict=True)
        ]
    )
    low = np.array([points[:, 2].min() for points in points_map])
    high = np.array([points[:, 2].max() for points in points_map])
    aside = np.linalg.norm(centres_map[:, :2] - middle[nearest], axis=1)
    z = centres_map[:, 2]
    return np.asarray(
        (aside < radius[nearest] + MARGIN_M) & (z > low[nearest]) & (z < high[nearest] + MARGIN_M)
    )
