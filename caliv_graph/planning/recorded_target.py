"""The object of a scenario that comes nearest to a recorded target, by its silhouettes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from caliv_graph.products import Array, TargetObservation
from caliv_graph.scenario.shapes import object_mesh
from caliv_graph.scenario.world_models import (
    BicycleModel,
    BinModel,
    BoxesModel,
    ChairModel,
    ConesModel,
    ObjectModel,
    StrollerModel,
    TableModel,
    ThinChairModel,
)
from caliv_graph.trajectory.select import VehicleTrajectory

CANDIDATES = (
    ChairModel,
    ThinChairModel,
    BoxesModel,
    ConesModel,
    BicycleModel,
    StrollerModel,
    BinModel,
    TableModel,
)
"""Shapes with no symmetry about the vertical, or that of half a turn."""

YAW_STEP_DEG = 10.0
"""Between the yaws that are tried: the sides of a silhouette change by 0.1 m at most."""

STRAYS_PERCENT = 1.0
"""Of a cloud's points that its extent leaves out on each side."""


@dataclass(frozen=True)
class Silhouettes:
    """Extents of a target in clouds that no side of a field of view cuts.

    Attributes:
        across_map: (n, 2) unit vectors in the map, level, at right angles to the line of sight.
        width_m: (n,) along them.
        height_m: (n,) from its lowest to its highest point.
    """

    across_map: Array
    width_m: Array
    height_m: Array


def silhouettes(
    observation: TargetObservation,
    trajectory: VehicleTrajectory,
    mounts: Mapping[str, gtsam.Pose3],
) -> Silhouettes:
    """Extents of a target as its clouds show them.

    Args:
        observation: its clouds; all are taken if each is cut.
        trajectory: of the vehicle.
        mounts: LiDAR -> T_vehicle_lidar.
    """
    clouds = [c for c in observation.clouds if not c.cut] or list(observation.clouds)
    R, _ = trajectory.poses_at([c.stamp_ns for c in clouds])
    across, width, height = [], [], []
    for cloud, R_v in zip(clouds, R, strict=True):
        T = mounts[cloud.lidar]
        R_l, t_l = T.rotation().matrix(), T.translation()
        level = (cloud.points_lidar @ R_l.T + t_l) @ R_v.T
        sight = level.mean(axis=0)[:2] - (R_v @ t_l)[:2]
        sight /= max(float(np.linalg.norm(sight)), 1e-9)
        side = np.array([-sight[1], sight[0]])
        spread = np.column_stack([level[:, :2] @ side, level[:, 2]])
        low, high = np.percentile(spread, [STRAYS_PERCENT, 100.0 - STRAYS_PERCENT], axis=0)
        across.append(side)
        width.append(high[0] - low[0])
        height.append(high[1] - low[1])
    return Silhouettes(np.array(across), np.array(width), np.array(height))


def nearest_object(seen: Silhouettes, centre_map: Array, clear_m: float) -> ObjectModel:
    """The object and the yaw whose widths and height agree best with a target's.

    Args:
        seen: the target's silhouettes.
        centre_map: (3,) its centre.
        clear_m: height above the ground below which its points were left out.
    """
    best: tuple[float, ObjectModel] | None = None
    height_m = float(np.quantile(seen.height_m, 0.9)) + clear_m
    for candidate in CANDIDATES:
        model = candidate(xy_m=(0.0, 0.0))
        vertices = object_mesh(model).vertices
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        tall = (float(high[2]) - height_m) ** 2
        for yaw_deg in np.arange(0.0, 360.0, YAW_STEP_DEG).tolist():
            yaw = math.radians(yaw_deg)
            turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
            width = np.ptp(vertices[:, :2] @ turn.T @ seen.across_map.T, axis=0)
            off = float(np.median((width - seen.width_m) ** 2)) + tall
            if best is None or off < best[0]:
                middle = turn @ (0.5 * (low + high))[:2]
                x, y = (round(float(v), 2) for v in centre_map[:2] - middle)
                best = (off, candidate(xy_m=(x, y), yaw_deg=yaw_deg))
    assert best is not None
    return best[1]
