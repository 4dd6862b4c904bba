"""Assigns points to surfaces: aligns the extrinsics until walls and poles are thinnest.

A measure on points that are already near each other would rate every calibration as good. So the
assignment at this optimum, found with a gate that shrinks from 0.6 m, is used for every set of
extrinsics. The optimum is no calibration, because it follows the errors of the trajectory.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from caliv_graph.geometry.se3 import retract_vehicle_axes, skew, stack, vehicle_axes_difference
from caliv_graph.products import Array, IntArray
from caliv_graph.validation.clouds import Clouds, Placed
from caliv_graph.validation.surfaces import Pole, Structure, Wall, find_structure, pole_residuals

GATES_M = (0.6, 0.35, 0.2, 0.1, 0.06)
"""Half thickness of the gate around a surface, per round."""

STEPS = 4
"""Gauss-Newton steps per round."""

CORRELATED = 10.0
"""Factor by which the points are down-weighted, because points of a scan share its pose error."""

LEAST_SIGMA_M = 0.015
"""Smallest scatter of a point about a surface, from range noise and the trajectory."""

COUNT_CELL_M = 0.25
"""Size of the cells that are counted to compare how sharp two maps are."""


def sharper(clouds: Clouds, names: Sequence[str]) -> str:
    """The set of extrinsics whose points occupy the fewest cells of the map."""

    def cells(name: str) -> int:
        points = clouds.points_map(clouds.placed[name])
        return len(np.unique(np.floor(points / COUNT_CELL_M).astype(np.int64), axis=0))

    return min(names, key=cells)


def align(
    clouds: Clouds, placed: Placed, sigmas: Array, with_ground: bool
) -> tuple[Structure, tuple[gtsam.Pose3, ...]]:
    """Finds the structure, and the extrinsics under which it is thinnest.

    Args:
        clouds: points of all LiDARs.
        placed: the points under the extrinsics to start from.
        sigmas: (L, 6) prior sigmas of these, vehicle axes, rad and m. They hold the directions that
            the structure does not determine.
        with_ground: whether level planes count too.

    Returns:
        The structure under those extrinsics, and T_vehicle_lidar per LiDAR.
    """
    start = [placed.extrinsics.T_vehicle_lidar[name] for name in clouds.lidars]
    poses = list(start)
    prior = np.diag(sigmas.ravel() ** -2.0)
    for number, gate_m in enumerate(GATES_M):
        columns = number >= len(GATES_M) - 2
        found = _found(clouds, placed, poses, gate_m, with_ground, columns)
        if not found.surfaces:
            continue
        sigma_m = max(0.5 * gate_m, LEAST_SIGMA_M)
        for _ in range(STEPS):
            H, g = _normal_equations(clouds, placed, poses, found, sigma_m)
            moved = np.concatenate(
                [vehicle_axes_difference(a, b) for a, b in zip(poses, start, strict=True)]
            )
            step = np.linalg.solve(H + prior, -g - prior @ moved)
            poses = [retract_vehicle_axes(T, step[6 * i : 6 * i + 6]) for i, T in enumerate(poses)]
    return _found(clouds, placed, poses, GATES_M[-1], with_ground, True), tuple(poses)


def _found(
    clouds: Clouds,
    placed: Placed,
    poses: Sequence[gtsam.Pose3],
    gate_m: float,
    with_ground: bool,
    columns: bool,
) -> Structure:
    points, beams = clouds.points_map(placed, poses), clouds.beams_map(placed, poses)
    return find_structure(points, beams, clouds.scan, gate_m, with_ground, columns)


def extrinsic_jacobian(
    clouds: Clouds, placed: Placed, poses: Sequence[gtsam.Pose3], members: IntArray, normal: Array
) -> Array:
    """(n, 6) derivative of points along a direction by the extrinsic of their LiDAR.

    The perturbation is in vehicle axes. `members` (n,) are the indices of the points, `normal` (n,
    3) is the direction in the map, and `poses` replace the T_vehicle_lidar of `placed`.
    """
    R_map_vehicle = placed.R_map_vehicle[clouds.scan[members]]
    normal_vehicle = np.einsum("nji,nj->ni", R_map_vehicle, normal)
    R, _ = stack(poses)
    arm = np.einsum("nij,nj->ni", R[clouds.lidar[members]], placed.points_lidar[members])
    # n . (w x arm) = (arm x n) . w
    return np.hstack([np.cross(arm, normal_vehicle), normal_vehicle])


def _normal_equations(
    clouds: Clouds,
    placed: Placed,
    poses: Sequence[gtsam.Pose3],
    structure: Structure,
    sigma_m: float,
) -> tuple[Array, Array]:
    """Information and gradient on all extrinsics, vehicle axes; the surfaces are eliminated."""
    size = 6 * len(poses)
    H, g = np.zeros((size, size)), np.zeros(size)
    points = clouds.points_map(placed, poses)
    for surface in structure.surfaces:
        p = points[surface.members]
        residual, normal, basis = linearised(surface, p)
        J = np.zeros((len(p), size))
        columns = 6 * clouds.lidar[surface.members][:, None] + np.arange(6)
        own = extrinsic_jacobian(clouds, placed, poses, surface.members, normal)
        np.put_along_axis(J, columns, own, axis=1)
        weight = 1.0 / np.maximum(1.0, np.abs(residual) / sigma_m) / (sigma_m**2 * CORRELATED)
        weighted = basis * weight[:, None]
        K = weighted.T @ basis + 1e-6 * np.eye(basis.shape[1])
        gain = np.linalg.solve(K, weighted.T @ np.column_stack([J, residual]))
        J, residual = J - basis @ gain[:, :-1], residual - basis @ gain[:, -1]
        H += (J * weight[:, None]).T @ J
        g += (J * weight[:, None]).T @ residual
    return H, g


def linearised(surface: Wall | Pole, points: Array) -> tuple[Array, Array, Array]:
    """Distances of points from their surface, linearised.

    Args:
        surface: a wall or a pole.
        points: (n, 3) metres, points on it.

    Returns:
        Distances (n,); their gradients (n, 3); and their derivatives (n, k) with respect to the
        surface's parameters: offset and two tilts of a wall; position, lean and radius of a pole.
    """
    if isinstance(surface, Wall):
        off = points - surface.centre
        normal = np.broadcast_to(surface.normal, points.shape)
        basis = np.column_stack([np.ones(len(points)), off @ surface.axes.T])
        return off @ surface.normal, normal, basis
    residual, out = pole_residuals(
        points, surface.foot, surface.slope, surface.middle_z, surface.radius_m
    )
    normal = np.column_stack([out, -out @ surface.slope])
    z = (points[:, 2] - surface.middle_z)[:, None]
    return residual, normal, np.column_stack([out, out * z, np.ones(len(points))])


def pose_jacobian(
    clouds: Clouds, placed: Placed, points_vehicle: Array, members: IntArray, normal: Array
) -> Array:
    """(n, 6) derivative of points along a direction by the vehicle's pose, right perturbation.

    `points_vehicle` (n, 3) are the points in the vehicle frame; see `extrinsic_jacobian`.
    """
    R = placed.R_map_vehicle[clouds.scan[members]]
    normal_vehicle = np.einsum("nji,nj->ni", R, normal)
    rotation = -np.einsum("ni,nij->nj", normal_vehicle, skew(points_vehicle))
    return np.hstack([rotation, normal_vehicle])
