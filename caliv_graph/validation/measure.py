"""Thickness of a wall or pole and distances between LiDARs on it, measured and expected.

Every measure is linear in small errors of the extrinsics, of the vehicle's poses and of the ranges.
Its variance follows from their joint covariances by propagation of errors. The errors of extrinsics
and of poses are assumed independent. On the drive that was calibrated they are correlated, because
the extrinsics fit the poses with their errors. The expected values are then too large.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from caliv_graph.products import Array, IntArray
from caliv_graph.validation.clouds import Clouds, Placed
from caliv_graph.validation.refine import extrinsic_jacobian, linearised, pose_jacobian
from caliv_graph.validation.surfaces import (
    Pole,
    Wall,
    fit_pole,
    plane_of,
    pole_residuals,
)

OWN_POINTS = 15
"""Smallest number of points with which a LiDAR has its own fit of a surface."""

WALL_TRUE_M = 0.002
POLE_TRUE_M = 0.005
"""Deviation of a wall from a plane over metres, and of a pole from a cylinder, 1 sigma. It includes
range errors that depend on angle and material, and makes LiDARs with different views differ."""

RELIEF_CELL_M = 1.0
"""Edge of the cells of a wall whose deviations from its plane count as independent: reveals of
windows, pillars, bricks that bulge."""

RELIEF_POINTS = 5
"""Fewest points of a cell that tell its deviation."""

RELIEF_CELLS = 4
"""Fewest cells that tell the relief of a wall: a plane has three coordinates."""

NEIGHBOURS = 8
"""Number of points of the other LiDAR that define its surface near a point."""

REACH_M = 0.5
"""Largest distance of these points. If one is farther, the other LiDAR has no surface there."""

COMPARED_POINTS = 4000
"""Number of points of one LiDAR at which the cloud-to-cloud distance is measured."""

SURFACE_FLATNESS = 0.35
"""Largest ratio of the neighbours' scatter across the surface to the scatter along it."""


@dataclass(frozen=True)
class Errors:
    """Known errors of the alignment.

    Attributes:
        cov_extrinsics: (6 L, 6 L) joint, vehicle axes, LiDARs in the order of the clouds.
        cov_poses: (6 S, 6 S) joint, of the vehicle's poses at the scans, right perturbations.
        sigma_range_m: range noise along the beam.
        sigma_heave_m: heave per scan, which the trajectory does not contain.
    """

    cov_extrinsics: Array
    cov_poses: Array
    sigma_range_m: float
    sigma_heave_m: float = 0.0


@dataclass(frozen=True)
class Thickness:
    """Scatter of points about a surface fitted to them, root mean square, metres.

    Attributes:
        merged: of the points of all LiDARs on one surface.
        alone: per LiDAR, of its points on its own surface.
    """

    merged: float
    alone: Mapping[str, float]


@dataclass(frozen=True)
class Apart:
    """Distance between the surfaces of two LiDARs on one wall or pole.

    Attributes:
        distance_m: root mean square distance between their surfaces, over the part that both see;
            for poles the distance between their axes at middle height.
        offset_m: (k,) signed distance in the middle: along the normal of a wall, x and y of a pole.
    """

    lidars: tuple[str, str]
    distance_m: float
    offset_m: Array


@dataclass(frozen=True)
class Expected:
    """Measures expected from the known errors alone.

    Attributes:
        merged: thickness, root of the expected square, metres.
        alone: likewise per LiDAR.
        distance_m: per pair, root of the expected square.
        rows: per pair (k, 6 L + 6 S), derivative of the offset by extrinsics and poses.
        noise: per pair (k, k) covariance of the offset from range noise and shape.
    """

    merged: float
    alone: Mapping[str, float]
    distance_m: Mapping[tuple[str, str], float]
    rows: Mapping[tuple[str, str], Array]
    noise: Mapping[tuple[str, str], Array]


@dataclass(frozen=True)
class _Refitted:
    """A surface fitted to its points under one set of extrinsics."""

    surface: Wall | Pole
    points: Array
    residual: Array


class SurfaceMeter:
    """Measures one surface under any extrinsics, always with the same points.

    The surface is that of the best alignment, with its points.
    """

    def __init__(self, clouds: Clouds, surface: Wall | Pole) -> None:
        self._clouds = clouds
        self._surface = surface
        self._lidar = clouds.lidar[surface.members]
        self.points = {name: int((self._lidar == i).sum()) for i, name in enumerate(clouds.lidars)}
        self._own = [i for i, name in enumerate(clouds.lidars) if self.points[name] >= OWN_POINTS]

    def pairs(self) -> list[tuple[str, str]]:
        """Pairs of LiDARs that both have their own fit."""
        names = [self._clouds.lidars[i] for i in self._own]
        return list(itertools.combinations(names, 2))

    def measure(
        self, placed: Placed, poses: Sequence[gtsam.Pose3] | None = None
    ) -> tuple[Thickness, dict[tuple[str, str], Apart]]:
        """Thickness and distances between LiDARs; `poses` replace those of `placed`."""
        points = self._clouds.points_map(placed, poses)[self._surface.members]
        beams = self._clouds.beams_map(placed, poses)[self._surface.members]
        merged = _refitted(points, beams, self._surface)
        alone, fits = {}, {}
        for i in self._own:
            name = self._clouds.lidars[i]
            of = self._lidar == i
            own = _refitted(points[of], beams[of], self._surface)
            alone[name] = rms(own.residual)
            fits[name] = _own_parameters(merged, of, beams[of])
        apart = {}
        for a, b in self.pairs():
            at = self._where(merged, a, b)
            if len(at):
                gap = fits[a] - fits[b]
                distance = np.linalg.norm(at @ gap, axis=1)
                apart[a, b] = Apart((a, b), rms(distance), at.mean(axis=0) @ gap)
        return Thickness(rms(merged.residual), alone), apart

    def _where(self, merged: _Refitted, a: str, b: str) -> Array:
        """(m, k, parameters) places at which two surfaces are compared; m is 0 without overlap."""
        if isinstance(merged.surface, Pole):
            return np.hstack([np.eye(2), np.zeros((2, 2))])[None]
        place = (merged.points - merged.surface.centre) @ merged.surface.axes.T
        index = [self._clouds.lidars.index(name) for name in (a, b)]
        spans = [np.quantile(place[self._lidar == i], [0.05, 0.95], axis=0) for i in index]
        low = np.maximum(spans[0][0], spans[1][0])
        high = np.minimum(spans[0][1], spans[1][1])
        of_both = np.isin(self._lidar, index)
        inside = of_both & ((place >= low) & (place <= high)).all(axis=1)
        if (high <= low).any() or not inside.any():
            return np.zeros((0, 1, 3))
        return np.column_stack([np.ones(int(inside.sum())), place[inside]])[:, None, :]

    def relief_m(
        self, placed: Placed, poses: Sequence[gtsam.Pose3] | None, sigma_range_m: float
    ) -> float:
        """Root mean square deviation of a wall from its plane over cells, beyond noise; metres.

        0 for a pole, and where too few cells tell it. To be asked for at the best alignment: at
        another one, a wrong extrinsic would count as relief.
        """
        if not isinstance(self._surface, Wall):
            return 0.0
        points = self._clouds.points_map(placed, poses)[self._surface.members]
        beams = self._clouds.beams_map(placed, poses)[self._surface.members]
        merged = _refitted(points, beams, self._surface)
        assert isinstance(merged.surface, Wall)
        variance = (sigma_range_m * (beams @ merged.surface.normal)) ** 2
        cell, count = self._cells(points)
        told = count >= RELIEF_POINTS
        if told.sum() < RELIEF_CELLS:
            return 0.0
        mean = np.bincount(cell, merged.residual)[told] / count[told]
        of_noise = np.bincount(cell, variance)[told] / count[told] ** 2
        freedom = (told.sum() - 3) / told.sum()
        return float(np.sqrt(max(np.mean(mean**2) / freedom - np.mean(of_noise), 0.0)))

    def _cells(self, points_map: Array) -> tuple[IntArray, IntArray]:
        """Cell of a wall of each point (n,), and the number of points in each cell."""
        assert isinstance(self._surface, Wall)
        place = (points_map - self._surface.centre) @ self._surface.axes.T
        _, cell, count = np.unique(
            np.floor(place / RELIEF_CELL_M), axis=0, return_inverse=True, return_counts=True
        )
        return cell.ravel(), count

    def expect(self, placed: Placed, errors: Errors, relief_m: float = 0.0) -> Expected:
        """Expectation of `measure` under the known errors alone; `relief_m` as measured."""
        clouds, members = self._clouds, self._surface.members
        names = clouds.lidars
        poses = [placed.extrinsics.T_vehicle_lidar[name] for name in names]
        vehicle = clouds.points_vehicle(placed)[members]
        points = clouds.points_map(placed)[members]
        beam = clouds.beams_map(placed)[members]
        merged = _refitted(points, beam, self._surface)
        _, normal, basis = linearised(merged.surface, points)
        by_extrinsic = extrinsic_jacobian(clouds, placed, poses, members, normal)
        by_pose = pose_jacobian(clouds, placed, vehicle, members, normal)
        across = np.einsum("ni,ni->n", beam, normal)
        variance = (errors.sigma_range_m * across) ** 2 + (errors.sigma_heave_m * normal[:, 2]) ** 2
        of_shape = WALL_TRUE_M if isinstance(self._surface, Wall) else POLE_TRUE_M
        scan = clouds.scan[members]

        def thickness(which: Array) -> float:
            J = _sparse(by_extrinsic[which], self._lidar[which], len(names))
            square = _scatter(J, errors.cov_extrinsics, basis[which])
            square += _scatter_of_scans(by_pose[which], scan[which], errors.cov_poses, basis[which])
            return float(np.sqrt(square + variance[which].mean() + of_shape**2 + relief_m**2))

        everything = np.ones(len(members), dtype=bool)
        alone = {names[i]: thickness(self._lidar == i) for i in self._own}
        gains, rows_of, noise_of = {}, {}, {}
        columns = basis.shape[1] - (1 if isinstance(merged.surface, Pole) else 0)
        for i in self._own:
            which = self._lidar == i
            G = basis[which][:, :columns]
            gain = np.linalg.solve(G.T @ G + 1e-9 * np.eye(columns), G.T)
            gains[names[i]] = gain
            row = np.zeros((columns, len(errors.cov_extrinsics) + len(errors.cov_poses)))
            row[:, 6 * i : 6 * i + 6] = gain @ by_extrinsic[which]
            into = np.zeros((columns, len(errors.cov_poses) // 6, 6))
            for k in range(columns):
                np.add.at(into[k], scan[which], gain[k][:, None] * by_pose[which])
            row[:, len(errors.cov_extrinsics) :] = into.reshape(columns, -1)
            rows_of[names[i]] = row
            noise_of[names[i]] = (gain * variance[which]) @ gain.T
            if relief_m:
                # Each LiDAR sees other cells, and other points in them.
                cell, count = self._cells(points[which])
                shares = np.stack([np.bincount(cell, g, len(count)) for g in gain])
                noise_of[names[i]] += relief_m**2 * shares @ shares.T
        distance, rows, noise = {}, {}, {}
        for a, b in self.pairs():
            at = self._where(merged, a, b)
            if not len(at):
                continue
            row = rows_of[a] - rows_of[b]
            cov_noise = noise_of[a] + noise_of[b]
            cov = _propagated(row, errors) + cov_noise
            square = float(np.einsum("mki,ij,mkj->m", at, cov, at).mean())
            k = at.shape[1]
            distance[a, b] = float(np.sqrt(square + 2.0 * k * of_shape**2))
            middle = at.mean(axis=0)
            rows[a, b] = middle @ row
            noise[a, b] = middle @ cov_noise @ middle.T + 2.0 * of_shape**2 * np.eye(k)
        return Expected(thickness(everything), alone, distance, rows, noise)


def _own_parameters(merged: _Refitted, which: Array, beams: Array) -> Array:
    """(k,) parameters of the surface of some points relative to the merged one."""
    points = merged.points[which]
    if isinstance(merged.surface, Wall):
        residual, _, basis = linearised(merged.surface, points)
        return np.asarray(np.linalg.lstsq(basis, residual)[0])
    pole = merged.surface
    own = fit_pole(points, beams, np.arange(len(points)), pole.radius_m)
    assert own is not None  # with a known radius the fit always succeeds
    shift = pole.middle_z - own.middle_z
    return np.array([*(own.foot + own.slope * shift - pole.foot), *(own.slope - pole.slope)])


def _propagated(rows: Array, errors: Errors) -> Array:
    """Covariance (k, k) of quantities whose derivative by extrinsics and poses is `rows`."""
    split = len(errors.cov_extrinsics)
    by_extrinsics, by_poses = rows[:, :split], rows[:, split:]
    return np.asarray(
        by_extrinsics @ errors.cov_extrinsics @ by_extrinsics.T
        + by_poses @ errors.cov_poses @ by_poses.T
    )


def offset_covariance(
    expected: Sequence[tuple[Expected, tuple[str, str]]], errors: Errors
) -> Array:
    """Joint covariance of the offsets of several surfaces and pairs, in their order."""
    cov = _propagated(np.vstack([e.rows[pair] for e, pair in expected]), errors)
    begin = 0
    for e, pair in expected:
        noise = e.noise[pair]
        cov[begin : begin + len(noise), begin : begin + len(noise)] += noise
        begin += len(noise)
    return np.asarray(0.5 * (cov + cov.T))


def _refitted(points: Array, beams: Array, surface: Wall | Pole) -> _Refitted:
    """The surface fitted to its points at their current places."""
    if isinstance(surface, Wall):
        centre, axes, _ = plane_of(points)
        # The same side and directions as before, so that signs are comparable.
        normal = axes[2] if axes[2] @ surface.normal > 0.0 else -axes[2]
        long = surface.axes[0] - (surface.axes[0] @ normal) * normal
        long /= np.linalg.norm(long)
        fitted: Wall | Pole = Wall(
            surface.members,
            centre,
            normal,
            np.array([long, np.cross(normal, long)]),
            surface.extent_m,
        )
        return _Refitted(fitted, points, (points - centre) @ normal)
    members = np.arange(len(points))
    # Under wrong extrinsics the radius is not observable: that of the best alignment is used.
    pole = fit_pole(points, beams, members, surface.radius_m)
    assert pole is not None  # with a known radius the fit always succeeds
    residual, _ = pole_residuals(points, pole.foot, pole.slope, pole.middle_z, pole.radius_m)
    return _Refitted(pole, points, residual)


def _sparse(own: Array, lidar: IntArray, lidars: int) -> Array:
    """(n, 6 L) rows whose (n, 6) entries are in the columns of each point's LiDAR."""
    out = np.zeros((len(own), 6 * lidars))
    np.put_along_axis(out, 6 * lidar[:, None] + np.arange(6), own, axis=1)
    return out


def _scatter(J: Array, cov: Array, basis: Array) -> float:
    """Mean square residual of a fitted surface due to errors with covariance `cov`."""
    kept = J - basis @ np.linalg.lstsq(basis, J)[0]
    return float(np.einsum("ni,ij,nj->", kept, cov, kept)) / len(J)


def _scatter_of_scans(J: Array, scan: IntArray, cov: Array, basis: Array) -> float:
    """Like `_scatter`, for the scans' poses: J (n, 6) is by the pose of each point's scan."""
    used, at = np.unique(scan, return_inverse=True)
    m, k = len(used), basis.shape[1]
    rows = (6 * used[:, None] + np.arange(6)).ravel()
    C = cov[np.ix_(rows, rows)].reshape(m, 6, m, 6)
    own = np.zeros((m, 6, 6))
    np.add.at(own, at, J[:, :, None] * J[:, None, :])
    blocks = C[np.arange(m), :, np.arange(m), :]
    total = float(np.einsum("mij,mij->", own, blocks))
    Q, _ = np.linalg.qr(basis)
    fitted = np.zeros((k, m, 6))
    for i in range(k):
        np.add.at(fitted[i], at, Q[:, i][:, None] * J)
    absorbed = float(np.einsum("kmi,minj,knj->", fitted, C, fitted, optimize=True))
    return max(total - absorbed, 0.0) / len(J)


def cloud_distances(
    points: Array, lidar: IntArray, names: Sequence[str]
) -> dict[tuple[str, str], tuple[float, float]]:
    """Distance of each LiDAR's points from the surfaces of the other LiDARs' points.

    Args:
        points: (N, 3) metres, map.
        lidar: (N,) index into `names`.
        names: names of the LiDARs.

    Returns:
        Per (from, to) the median distance in metres, and the fraction of the points of `from` with
        a surface of `to` within `REACH_M`; pairs without such points are left out.
    """
    out = {}
    rng = np.random.default_rng(0)
    own = [points[lidar == i] for i in range(len(names))]
    for a, b in itertools.permutations(range(len(names)), 2):
        if len(own[a]) == 0 or len(own[b]) < NEIGHBOURS:
            continue
        some = own[a]
        if len(some) > COMPARED_POINTS:
            some = some[np.sort(rng.choice(len(some), COMPARED_POINTS, replace=False))]
        distance, index = cKDTree(own[b]).query(some, NEIGHBOURS, distance_upper_bound=REACH_M)
        near = np.isfinite(np.asarray(distance)).all(axis=1)
        if not near.any():
            continue
        around = own[b][np.asarray(index)[near]]
        centre = around.mean(axis=1)
        off = around - centre[:, None]
        values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))
        to_plane = np.abs(np.einsum("ni,ni->n", some[near] - centre, vectors[:, :, 0]))
        # Points along a line or in a volume define no surface: the nearest point replaces it.
        flat = np.sqrt(np.maximum(values[:, 0], 0.0)) < SURFACE_FLATNESS * np.sqrt(
            np.maximum(values[:, 1], 1e-12)
        )
        found = np.where(flat, to_plane, np.asarray(distance)[near, 0])
        out[names[a], names[b]] = (float(np.median(found)), float(near.mean()))
    return out


def thing_distance(points: Array, lidar: IntArray, a: int, b: int) -> float | None:
    """Mean distance of each point of an object from the other LiDAR's nearest point, metres.

    It is the mean over both directions (chamfer distance) for LiDARs a and b, of points (n, 3) with
    LiDAR (n,). It is never zero, because beams of two LiDARs do not hit the same points. None if
    one of them has fewer than `OWN_POINTS` points.
    """
    p, q = points[lidar == a], points[lidar == b]
    if min(len(p), len(q)) < OWN_POINTS:
        return None
    there, back = cKDTree(q).query(p)[0], cKDTree(p).query(q)[0]
    return float(0.5 * (np.mean(there) + np.mean(back)))


def rms(values: npt.ArrayLike) -> float:
    """Root mean square; 0 of no values."""
    values = np.asarray(values, dtype=np.float64)
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0
