"""How well the LiDARs agree about a wall or a pole, and how well they could be expected to.

Everything measured is linear in small errors of the extrinsics, of the vehicle's poses and of the
ranges, so that its variance follows from their joint covariances (propagation of errors). The
errors of extrinsics and of poses are taken as independent. On the very drive that was calibrated
they are not: the extrinsics were found such that they fit the poses, errors and all, and what is
expected is then rather too large than too small.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
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
"""A LiDAR with fewer points on a surface has no surface of its own."""

WALL_TRUE_M = 0.002
POLE_TRUE_M = 0.005
"""How far a wall is from a plane over metres, 1 sigma, and a pole from a round one, ranges that
depend on angle and material included: what two LiDARs that see different parts of it differ by."""

NEIGHBOURS = 8
"""Points of the other LiDAR that make up its surface next to a point."""

REACH_M = 0.5
"""Without that many of them so near, the other LiDAR has no surface there."""

COMPARED_POINTS = 4000
"""Of one LiDAR that the cloud-to-cloud distance is taken at."""

SURFACE_FLATNESS = 0.35
"""Neighbours are a surface if they scatter across it by less than this part of along it."""


@dataclass(frozen=True)
class Errors:
    """What the alignment may be off by.

    Attributes:
        cov_extrinsics: (6 L, 6 L) joint, vehicle axes, LiDARs in the order of the clouds.
        cov_poses: (6 S, 6 S) joint, of the vehicle's poses at the scans, right perturbations.
        sigma_range_m: along the beam.
        sigma_heave_m: of the body on its springs, per scan, which the trajectory does not know.
    """

    cov_extrinsics: Array
    cov_poses: Array
    sigma_range_m: float
    sigma_heave_m: float = 0.0


@dataclass(frozen=True)
class Thickness:
    """Scatter of points about a surface fitted to them, root mean square, metres.

    Attributes:
        merged: all LiDARs on one surface.
        alone: per LiDAR, on a surface of its own.
    """

    merged: float
    alone: Mapping[str, float]


@dataclass(frozen=True)
class Apart:
    """How far two LiDARs have a surface apart.

    Attributes:
        lidars: the two.
        distance_m: root mean square distance between their surfaces, where both have it; of poles
            the distance between their axes at middle height.
        offset_m: (k,) in the middle, signed: along the normal of a wall, in x and y for a pole.
    """

    lidars: tuple[str, str]
    distance_m: float
    offset_m: Array


@dataclass(frozen=True)
class Expected:
    """What an alignment without other errors than those known would show.

    Attributes:
        merged: thickness, root of the expected square, metres.
        alone: likewise, per LiDAR.
        distance_m: per pair, root of the expected square.
        rows: per pair (k, 6 L + 6 S), how the offset moves with extrinsics and poses.
        noise: per pair (k, k) covariance of the offset from ranges and shape.
    """

    merged: float
    alone: Mapping[str, float]
    distance_m: Mapping[tuple[str, str], float]
    rows: Mapping[tuple[str, str], Array]
    noise: Mapping[tuple[str, str], Array]


@dataclass(frozen=True)
class _Refitted:
    """A surface as one set of extrinsics has its points."""

    surface: Wall | Pole
    points: Array
    residual: Array


class SurfaceMeter:
    """Measures one surface under any extrinsics; its points stay the same."""

    def __init__(self, clouds: Clouds, surface: Wall | Pole) -> None:
        """Binds the points.

        Args:
            clouds: all points.
            surface: as the best alignment has it, with its points.
        """
        self._clouds = clouds
        self._surface = surface
        self._lidar = clouds.lidar[surface.members]
        self.points = {name: int((self._lidar == i).sum()) for i, name in enumerate(clouds.lidars)}
        self._own = [i for i, name in enumerate(clouds.lidars) if self.points[name] >= OWN_POINTS]

    def pairs(self) -> list[tuple[str, str]]:
        """LiDARs that both have a surface of their own."""
        names = [self._clouds.lidars[i] for i in self._own]
        return list(itertools.combinations(names, 2))

    def measure(
        self, placed: Placed, poses: Sequence[gtsam.Pose3] | None = None
    ) -> tuple[Thickness, dict[tuple[str, str], Apart]]:
        """Thickness and distances between LiDARs.

        Args:
            placed: the points under some extrinsics.
            poses: T_vehicle_lidar to take instead, in the order of the LiDARs.
        """
        points = self._clouds.points_map(placed, poses)[self._surface.members]
        beams = self._clouds.beams_map(placed, poses)[self._surface.members]
        merged = _refitted(points, beams, self._surface)
        alone, fits = {}, {}
        for i in self._own:
            name = self._clouds.lidars[i]
            of = self._lidar == i
            own = _refitted(points[of], beams[of], self._surface)
            alone[name] = _rms(own.residual)
            fits[name] = _own_parameters(merged, of, beams[of])
        apart = {}
        for a, b in self.pairs():
            at = self._where(merged, a, b)
            if len(at):
                gap = fits[a] - fits[b]
                distance = np.linalg.norm(at @ gap, axis=1)
                apart[a, b] = Apart((a, b), _rms(distance), at.mean(axis=0) @ gap)
        return Thickness(_rms(merged.residual), alone), apart

    def _where(self, merged: _Refitted, a: str, b: str) -> Array:
        """(m, k, parameters) where two LiDARs' surfaces are compared; m is 0 if nowhere."""
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

    def expect(self, placed: Placed, errors: Errors) -> Expected:
        """What `measure` would give on average, if only the known errors were there."""
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
            return float(np.sqrt(square + variance[which].mean() + of_shape**2))

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
    """(k,) how the surface of some of the points differs from the merged one."""
    points = merged.points[which]
    if isinstance(merged.surface, Wall):
        residual, _, basis = linearised(merged.surface, points)
        return np.asarray(np.linalg.lstsq(basis, residual)[0])
    pole = merged.surface
    own = fit_pole(points, beams, np.arange(len(points)), pole.radius_m)
    assert own is not None  # a known radius is never refused
    shift = pole.middle_z - own.middle_z
    return np.array([*(own.foot + own.slope * shift - pole.foot), *(own.slope - pole.slope)])


def _propagated(rows: Array, errors: Errors) -> Array:
    """Covariance (k, k) of what moves with extrinsics and poses by `rows`."""
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
    """The surface through its points as they are now."""
    if isinstance(surface, Wall):
        centre, axes, _ = plane_of(points)
        # The same sides and directions as before, so that signs compare.
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
    # Torn apart by extrinsics that are wrong it has no radius: that of the best ones is taken.
    pole = fit_pole(points, beams, members, surface.radius_m)
    assert pole is not None  # a known radius is never refused
    residual, _ = pole_residuals(points, pole.foot, pole.slope, pole.middle_z, pole.radius_m)
    return _Refitted(pole, points, residual)


def _sparse(own: Array, lidar: IntArray, lidars: int) -> Array:
    """(n, 6 L) of (n, 6) that belong to a LiDAR each."""
    out = np.zeros((len(own), 6 * lidars))
    np.put_along_axis(out, 6 * lidar[:, None] + np.arange(6), own, axis=1)
    return out


def _scatter(J: Array, cov: Array, basis: Array) -> float:
    """Mean square of what errors of covariance `cov` leave after the surface was fitted."""
    kept = J - basis @ np.linalg.lstsq(basis, J)[0]
    return float(np.einsum("ni,ij,nj->", kept, cov, kept)) / len(J)


def _scatter_of_scans(J: Array, scan: IntArray, cov: Array, basis: Array) -> float:
    """The same, of errors of the scans' poses: J (n, 6) is that of each point's own scan."""
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
    """Distance of each LiDAR's points from the surfaces that the others' points make up.

    Args:
        points: (N, 3) metres, map.
        lidar: (N,) index into `names`.
        names: of the LiDARs.

    Returns:
        Per (from, to) the median distance in metres, and the part of the points of `from` that have
        a surface of `to` within `REACH_M`; only the pairs of which any has.
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
        # Points in a line or a heap have no surface: the nearest of them stands for it.
        flat = np.sqrt(np.maximum(values[:, 0], 0.0)) < SURFACE_FLATNESS * np.sqrt(
            np.maximum(values[:, 1], 1e-12)
        )
        found = np.where(flat, to_plane, np.asarray(distance)[near, 0])
        out[names[a], names[b]] = (float(np.median(found)), float(near.mean()))
    return out


def thing_distance(points: Array, lidar: IntArray, a: int, b: int) -> float | None:
    """Mean distance of each point of an object from the nearest one of the other LiDAR, metres.

    Both ways (chamfer distance). Never zero: beams do not meet the same spots.

    Args:
        points: (n, 3) metres, map.
        lidar: (n,) index of each one's LiDAR.
        a: a LiDAR.
        b: another one.

    Returns:
        None if one of them has fewer than `OWN_POINTS`.
    """
    p, q = points[lidar == a], points[lidar == b]
    if min(len(p), len(q)) < OWN_POINTS:
        return None
    there, back = cKDTree(q).query(p)[0], cKDTree(p).query(q)[0]
    return float(0.5 * (np.mean(there) + np.mean(back)))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0
