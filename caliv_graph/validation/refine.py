"""Which points belong together: the extrinsics moved until walls and poles are thin.

A measure that looked only at points that are near each other already would find every calibration
good. So the extrinsics are moved, from a gate of half a metre down, until the structure is as thin
as it gets; which points lie on which surface is settled there, and kept for every set of extrinsics
that is measured. What this gives for extrinsics is a bound for how well this structure can be
aligned, and no calibration: its errors follow those of the trajectory.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from caliv_graph.geometry.se3 import retract_vehicle_axes, right_to_vehicle_axes, skew, stack
from caliv_graph.products import Array, IntArray
from caliv_graph.validation.clouds import Clouds, Placed
from caliv_graph.validation.surfaces import Pole, Structure, Wall, find_structure, pole_residuals

GATES_M = (0.6, 0.35, 0.2, 0.1, 0.06)
"""Half thickness of what is taken for one surface, round by round."""

STEPS = 4
"""Of Gauss-Newton in each."""

CORRELATED = 10.0
"""Points of a scan share the error of its pose: they count as so many times fewer."""

LEAST_SIGMA_M = 0.015
"""Scatter of a point about a surface, at least: range noise and the trajectory."""

COUNT_CELL_M = 0.25
"""Cells in which one sees how sharp a map is."""


def sharper(clouds: Clouds, names: Sequence[str]) -> str:
    """Which set of extrinsics has the points in fewer cells of the map, with the fewest first."""

    def cells(name: str) -> int:
        points = clouds.points_map(clouds.placed[name])
        return len(np.unique(np.floor(points / COUNT_CELL_M).astype(np.int64), axis=0))

    return min(names, key=cells)


def align(
    clouds: Clouds, placed: Placed, sigmas: Array, with_ground: bool
) -> tuple[Structure, tuple[gtsam.Pose3, ...]]:
    """Finds the structure, and extrinsics under which it is as thin as it gets.

    Args:
        clouds: points of all LiDARs.
        placed: under the extrinsics to begin with.
        sigmas: (L, 6) how far these may be off, vehicle axes, rad and m: what the structure does
            not tell stays.
        with_ground: level planes count too.

    Returns:
        The structure, its geometry as those extrinsics have it, and T_vehicle_lidar per LiDAR.
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
            moved = np.concatenate([_between(a, b) for a, b in zip(poses, start, strict=True)])
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


def _between(T: gtsam.Pose3, start: gtsam.Pose3) -> Array:
    """(6,) vehicle axes, from `start` to T."""
    R = T.rotation().compose(start.rotation().inverse())
    return np.concatenate([gtsam.Rot3.Logmap(R), T.translation() - start.translation()])


def extrinsic_jacobian(
    clouds: Clouds, placed: Placed, poses: Sequence[gtsam.Pose3], members: IntArray, normal: Array
) -> Array:
    """How points move along a direction with the mounting of their LiDAR.

    Args:
        clouds: the points.
        placed: under some extrinsics.
        poses: T_vehicle_lidar to take instead.
        members: (n,) the points, by index.
        normal: (n, 3) the direction, map.

    Returns:
        (n, 6) per vehicle-axes perturbation of the mounting of each point's own LiDAR.
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
    """Information and gradient on all extrinsics, vehicle axes, the surfaces eliminated."""
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
    """Points against the surface they lie on.

    Args:
        surface: a wall or a pole.
        points: (n, 3) metres, of it.

    Returns:
        Distances (n,) from it; directions (n, 3) in which they grow; and (n, k) how they change
        with the surface's own parameters: offset and two tilts of a wall; place, lean and radius of
        a pole.
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


def vehicle_axes_covariance(poses: Sequence[gtsam.Pose3], cov_right: Array) -> Array:
    """A joint covariance of right perturbations, turned into vehicle axes; (6 L, 6 L)."""
    turn = np.zeros_like(cov_right)
    for i, T in enumerate(poses):
        turn[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = right_to_vehicle_axes(T)
    return np.asarray(turn @ cov_right @ turn.T)


def pose_jacobian(
    clouds: Clouds, placed: Placed, points_vehicle: Array, members: IntArray, normal: Array
) -> Array:
    """How points move along a direction with the vehicle's pose, (n, 6) right perturbation.

    Args:
        clouds: the points.
        placed: under some extrinsics.
        points_vehicle: (n, 3) the points, vehicle frame.
        members: (n,) by index.
        normal: (n, 3) the direction, map.
    """
    R = placed.R_map_vehicle[clouds.scan[members]]
    normal_vehicle = np.einsum("nji,nj->ni", R, normal)
    rotation = -np.einsum("ni,nij->nj", normal_vehicle, skew(points_vehicle))
    return np.hstack([rotation, normal_vehicle])
