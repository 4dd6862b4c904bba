"""Patches of a target are no structure: its clouds say the same already, and better.

A chair's back is a patch of half a metre. Counted as a wall it tells twice what the clouds of the
target tell, and few such patches are matched wrongly: with nothing else that stands around, a still
vehicle's S2S yaw went 10 degrees off.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import gtsam
import numpy as np

from caliv_graph.config.model import Config
from caliv_graph.products import Array, BoolArray, IntArray, TargetObservation
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.trajectory.measurements import nearest_node
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
        in_map = partial(
            _in_map, trajectory=trajectory, T_vehicle_lidar=config.lidars[name].guess()
        )
        stamps_ns = patches.stamps_ns[patches.scan[own]]
        centres_map = in_map(patches.centres_lidar[own], stamps_ns)
        for observation in observations:
            of_lidar = (
                c for c in observation.clouds if (c.lidar, c.drive) == (name, patches.drive)
            )
            clouds = sorted(of_lidar, key=lambda cloud: cloud.stamp_ns)
            if not clouds:
                continue
            at_ns = np.array([cloud.stamp_ns for cloud in clouds])
            sizes = [len(cloud.points_lidar) for cloud in clouds]
            points_lidar = np.concatenate([cloud.points_lidar for cloud in clouds])
            points_map = in_map(points_lidar, np.repeat(at_ns, sizes))
            cylinders = np.array(
                [_cylinder(x) for x in np.split(points_map, np.cumsum(sizes[:-1]))]
            )
            keep[own] &= ~_inside(centres_map, cylinders[nearest_node(at_ns, stamps_ns)])
    return patches if keep.all() else patches.part(keep)


def _in_map(
    points_lidar: Array,
    stamps_ns: IntArray,
    trajectory: VehicleTrajectory,
    T_vehicle_lidar: gtsam.Pose3,
) -> Array:
    """(N, 3) points at stamps (N,) in the map."""
    stamps, which = np.unique(stamps_ns, return_inverse=True)
    R, t = trajectory.poses_at(stamps)
    points_vehicle = (
        points_lidar @ T_vehicle_lidar.rotation().matrix().T + T_vehicle_lidar.translation()
    )
    return np.asarray(np.einsum("nab,nb->na", R[which], points_vehicle) + t[which])


def _cylinder(points: Array) -> tuple[float, float, float, float, float]:
    """x, y and radius of an upright cylinder about points (n, 3), and where it begins and ends."""
    x, y = points[:, :2].mean(axis=0).tolist()
    radius_m = float(np.hypot(points[:, 0] - x, points[:, 1] - y).max())
    return x, y, radius_m, float(points[:, 2].min()), float(points[:, 2].max())


def _inside(places: Array, cylinders: Array) -> BoolArray:
    """(N,) whether places (N, 3) are in a cylinder (N, 5) each, or up to `MARGIN_M` beside it."""
    x, y, radius_m, low, high = cylinders.T
    aside_m = np.hypot(places[:, 0] - x, places[:, 1] - y)
    z = places[:, 2]
    return np.asarray((aside_m < radius_m + MARGIN_M) & (z > low) & (z < high + MARGIN_M))
