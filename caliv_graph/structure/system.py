"""The linearised system of structure: poses, extrinsics, planes, and what errs with them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import scipy.sparse

from caliv_graph.geometry.se3 import skew, stack, tangent_axes
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.elimination import Surfaces, eliminated
from caliv_graph.structure.prior import PosePrior
from caliv_graph.structure.sightings import Sightings, without_own_error
from caliv_graph.structure.standing import Standing, Stands, standing_rows
from caliv_graph.structure.strips import LEVEL
from caliv_graph.trajectory.imu import exp_so3

TILT_PRIOR_RAD = 5.0
PLACE_PRIOR_M = 1000.0
"""Prior of a plane: a single ring of beams does not determine its tilt. A thousand planes together
must say next to nothing of what turns and shifts all of them, such as the roll of all LiDARs on a
straight drive: 5 rad / sqrt(1000) is five times the guess's 30 mrad."""


DENT_RAD = 0.05
"""Largest angle of a strip to its tile that is a dent of the ground. What is steeper, such as a
bonnet, is a surface of its own."""

MOST_NOISE = 0.5
"""Largest part of a strip's information on its tilt that may be noise of the points."""

BIASES = 3
"""Biases of a LiDAR that hold for the whole drive: bias, growth with incidence, on the ground."""

PLANE_ROWS = slice(12, 15)
"""Where the derivatives by the plane are in `Geometry.by`: after pose and extrinsic."""


@dataclass(frozen=True)
class Nuisances:
    """1 sigma of errors of the LiDARs that are estimated beside all else, metres.

    Attributes:
        bias: bias of the ranges of a LiDAR.
        incidence: growth of that bias with 1 / cos(incidence).
        ground: bias of a LiDAR on all level strips: asphalt is darker than walls are.
        surface: bias of a LiDAR on a surface: colour, gloss.
        strip: (K,) how far a LiDAR sees each strip from where others do: bumps, other beams.
        sighting: (K,) offset of each strip from scan to scan.
        shared: offset of a surface from scan to scan, which its strips share: incidence, and how
            the beams fall, change along a wall slowly.
        repeated: share of the variances of `sighting` and `shared` that is the same in all scans
            from one place, beyond what `strip` has of it.
        jitter_s: of the stamp of each scan, s; 0: no such variables.
    """

    bias: float
    incidence: float
    ground: float
    surface: float
    strip: Array
    sighting: Array
    shared: float
    repeated: float
    jitter_s: float = 0.0


@dataclass(frozen=True)
class State:
    """An estimate; M poses, n LiDARs, K strips.

    Attributes:
        R_map_vehicle: (M, 3, 3).
        t_map_vehicle: (M, 3) metres.
        moved: (6 M + 3 k,) where poses and parameters of the vehicle are from the pose prior; with
            the errors of the rates, 6 more.
        T_vehicle_lidar: n poses.
        offsets_s: (n,) time offsets; zero where they are not free.
        centres_map: (K, 3) points of the planes.
        normals_map: (K, 3).
        errors: (D,) errors of LiDARs, height and tilt at their coordinates; else zero.
    """

    R_map_vehicle: Array
    t_map_vehicle: Array
    moved: Array
    T_vehicle_lidar: tuple[gtsam.Pose3, ...]
    offsets_s: Array
    centres_map: Array
    normals_map: Array
    errors: Array


@dataclass(frozen=True)
class Layout:
    """Where each variable is among the D coordinates of the system.

    In this order: poses (6 each), parameters of the vehicle, errors of the rates by which points
    were moved (6, if any were), time offsets, extrinsics (6), bias of each LiDAR, its growth with
    incidence, and that on the ground (3), error of the vehicle's height and tilt above the ground
    (3), jitter of the stamp of each scan, if there is any; and what belongs to one surface each:
    planes (two tilts, offset), bias of each LiDAR on each surface, offset of each LiDAR on each
    strip.
    """

    poses: int
    parameters: int
    offsets: tuple[int, ...]
    lidars: int
    surface_of: tuple[int, ...]
    jitters: int = 0
    rates: int = 0

    @property
    def strips(self) -> int:
        """K."""
        return len(self.surface_of)

    @property
    def surfaces(self) -> int:
        """Number of surfaces."""
        return max(self.surface_of, default=-1) + 1

    @property
    def rate(self) -> int:
        """First error of the rates."""
        return 6 * self.poses + self.parameters

    @property
    def offset(self) -> int:
        """First time offset; before it is what the pose prior is on."""
        return self.rate + self.rates

    @property
    def extrinsic(self) -> int:
        """First coordinate of the extrinsics."""
        return self.offset + len(self.offsets)

    @property
    def error(self) -> int:
        """First coordinate of the biases of the LiDARs."""
        return self.extrinsic + 6 * self.lidars

    @property
    def plane(self) -> int:
        """First coordinate of the planes, and of all that belongs to one surface."""
        return self.jitter + self.jitters

    @property
    def jitter(self) -> int:
        """First jitter of a stamp."""
        return self.standing + 3

    @property
    def standing(self) -> int:
        """Error of the vehicle's height above ground, and the two of its tilt."""
        return self.error + BIASES * self.lidars

    @property
    def surface_error(self) -> int:
        """First bias of a LiDAR on a surface."""
        return self.plane + 3 * self.strips

    @property
    def strip_error(self) -> int:
        """First offset of a LiDAR on a strip."""
        return self.surface_error + self.lidars * self.surfaces

    @property
    def size(self) -> int:
        """D."""
        return self.strip_error + self.lidars * self.strips

    def error_columns(self) -> IntArray:
        """Coordinates of all errors of the LiDARs, in the order of `error_sigmas`."""
        return np.concatenate(
            [np.arange(self.error, self.standing), np.arange(self.surface_error, self.size)]
        )

    def error_sigmas(self, nuisances: Nuisances) -> Array:
        """1 sigma of each error of the LiDARs."""
        of_lidar = np.array([nuisances.bias, nuisances.incidence, nuisances.ground])
        return np.concatenate(
            [
                np.tile(of_lidar, self.lidars),
                np.full(self.lidars * self.surfaces, nuisances.surface),
                np.tile(nuisances.strip, self.lidars),
            ]
        )

    def of_surfaces(self) -> list[IntArray]:
        """Coordinates that belong to each surface."""
        surface = np.array(self.surface_of, dtype=np.int64)
        strips = np.arange(self.strips)
        where = [self.plane + 3 * strips + i for i in range(3)]
        where += [self.strip_error + self.strips * i + strips for i in range(self.lidars)]
        own = [np.arange(self.surfaces)] * self.lidars
        of = np.concatenate([surface] * len(where) + own)
        where += [self.surface_error + self.surfaces * i + own[0] for i in range(self.lidars)]
        columns = np.concatenate(where)
        order = np.argsort(of, kind="stable")
        ends = np.cumsum(np.bincount(of, minlength=self.surfaces))[:-1]
        return [np.sort(part) for part in np.split(columns[order], ends)]


@dataclass(frozen=True)
class Geometry:
    """Residuals of all sightings as linear functions of h = (p, 1), and their derivatives.

    Attributes:
        plain: (Q, 4) the residual, metres.
        by: (Q, C, 4) its derivatives.
        columns: (Q, C) coordinates of these.
        normals_lidar: (Q, 3) normals of the strips in the lidar frame at the scan's stamp.
    """

    plain: Array
    by: Array
    columns: IntArray
    normals_lidar: Array

    def offsets_m(self, sightings: Sightings) -> Array:
        """(Q,) distance of the middle of each sighting from its plane."""
        return np.asarray(np.einsum("qi,qi->q", self.plain, _middles(sightings)))

    def offset_rows(self, sightings: Sightings, size: int) -> scipy.sparse.csr_array:
        """(Q, `size`) derivatives of `offsets_m`."""
        data = np.einsum("qci,qi->qc", self.by, _middles(sightings))
        return _rows_of(data[:, None], self.columns, size)


def _rows_of(data: Array, columns: IntArray, size: int) -> scipy.sparse.csr_array:
    """A sparse matrix (r q, `size`) of r rows (q, r, C) each with the same columns (q, C)."""
    q, r, c = data.shape
    column = np.repeat(columns.astype(np.int32), r, axis=0).ravel()
    ends = np.arange(0, q * r * c + 1, c, dtype=np.int32)
    return scipy.sparse.csr_array((data.ravel(), column, ends), shape=(q * r, size))


def _middles(sightings: Sightings) -> Array:
    centroid = sightings.centroids_lidar
    return np.concatenate([centroid, np.ones((len(centroid), 1))], axis=1)


@dataclass(frozen=True)
class Rows:
    """Whitened residuals of all sightings.

    Attributes:
        J: (4 Q, D).
        r: (4 Q,).
        shared: (4 Q, G) derivatives by the offset of each surface in each scan, 1 sigma each.
        of_noise: (D,) what the noise of the points adds to `J^T r` in the mean.
        shared_noise: (G,) the same of `shared^T r`.
    """

    J: scipy.sparse.csr_array
    r: Array
    shared: scipy.sparse.csr_array
    of_noise: Array
    shared_noise: Array

    def normal_equations(
        self,
    ) -> tuple[scipy.sparse.csr_array, scipy.sparse.csr_array, Array]:
        """H and V with H - V V^T of the system, (D, D) and (D, G), and its b (D,).

        The shared offsets are eliminated; V has their couplings. The product would couple all
        strips of a surface with each other: most of the memory of the solve.
        """
        B = self.shared
        J_t = self.J.T.tocsr()
        inner = 1.0 / (1.0 + np.asarray(B.multiply(B).sum(axis=0)).ravel())
        V = (J_t @ (B @ scipy.sparse.diags_array(np.sqrt(inner)))).tocsr()
        b = self.of_noise - J_t @ self.r
        b += V @ (np.sqrt(inner) * (B.T @ self.r - self.shared_noise))
        return (J_t @ self.J).tocsr(), V, np.asarray(b)


def whitened(
    geometry: Geometry,
    sightings: Sightings,
    group: IntArray,
    repeated: IntArray,
    alike: IntArray,
    nuisances: Nuisances,
    weights: Array,
    size: int,
) -> Rows:
    """Residuals by the noise of points and sightings, the latter eliminated.

    `group` (Q,) numbers scan and surface of each, `repeated` (Q,) says how many scans have its
    view: what these share counts as often, so that their mean has the error of one. `alike` (Q,)
    says how many sightings of its strip its LiDAR has. `weights` (Q,) are robust, `size` is D.
    """
    more = repetition(nuisances, repeated)
    own = nuisances.sighting[sightings.strip] * more
    # A strip that two LiDARs see apart they see tilted against each other, too, and alike in all
    # scans: bumps within it. As often as it is seen, so often the error counts.
    tilt = np.sqrt(own**2 + (alike - 1.0) * nuisances.strip[sightings.strip] ** 2)
    S, noise = without_own_error(sightings, geometry.normals_lidar, own, tilt)
    S, noise = S * weights[:, None, None], noise * weights[:, None, None]
    values, vectors = np.linalg.eigh(S)
    C = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    data = np.swapaxes(geometry.by @ C, 1, 2)
    q = sightings.count
    J = _rows_of(data, geometry.columns, size)
    groups, number = np.unique(group, return_inverse=True)
    by_offset = (nuisances.shared * more)[:, None] * C[:, 3]
    own_group = np.broadcast_to(number.ravel()[:, None], by_offset.shape)
    shared = scipy.sparse.csr_array(
        (by_offset.ravel(), (np.arange(4 * q), own_group.ravel())), shape=(4 * q, len(groups))
    )
    noise *= _bearable(geometry, S, noise, sightings.strip)[:, None, None]
    of_plane = np.einsum("qij,qj->qi", noise, geometry.plain)
    pull = np.einsum("qci,qi->qc", geometry.by, of_plane)
    of_noise = np.bincount(geometry.columns.ravel(), pull.ravel(), minlength=size)
    of_offset = nuisances.shared * more * of_plane[:, 3]
    of_groups = np.bincount(number.ravel(), of_offset, len(groups))
    r = np.einsum("qi,qij->qj", geometry.plain, C).ravel()
    return Rows(J, r, shared, np.asarray(of_noise), np.asarray(of_groups))


def repetition(nuisances: Nuisances, repeated: IntArray) -> Array:
    """(Q,) factor on sigmas of sightings whose views have `repeated` (Q,) scans."""
    return np.asarray(np.sqrt(1.0 + (repeated - 1.0) * nuisances.repeated))


def _bearable(geometry: Geometry, S: Array, noise: Array, strip: IntArray) -> Array:
    """(Q,) factors on the noise: less than MOST_NOISE of what a strip's moments say of its tilt.

    Where a single ring of beams meets a wall all that is known of its tilt is noise.
    """
    by = geometry.by[:, PLANE_ROWS][:, :2]
    count = int(strip.max(initial=-1)) + 1
    both = []
    for of in (S, noise):
        blocks = by @ of @ np.swapaxes(by, 1, 2)
        total = [np.bincount(strip, blocks[:, i, j], count) for i, j in ((0, 0), (0, 1), (1, 1))]
        both.append(np.stack([total[0], total[1], total[1], total[2]], axis=1).reshape(-1, 2, 2))
    known = both[0] + TILT_PRIOR_RAD**-2.0 * np.eye(2)
    largest = np.abs(np.linalg.eigvals(np.linalg.solve(known, both[1]))).max(axis=1, initial=0.0)
    return np.asarray(np.minimum(1.0, MOST_NOISE / np.maximum(largest, 1e-9))[strip])


def lidar_poses(
    state: State, lidar: IntArray, pose: IntArray, twists: Array | None
) -> tuple[Array, Array]:
    """R_map_lidar (Q, 3, 3) and t_map_lidar (Q, 3) of LiDARs at poses, time offsets included."""
    R_e, t_e = stack(state.T_vehicle_lidar)
    R_v, t_v = state.R_map_vehicle[pose], state.t_map_vehicle[pose]
    if twists is not None and state.offsets_s.any():
        late = [gtsam.Pose3.Expmap(v) for v in -state.offsets_s[lidar][:, None] * twists[pose]]
        R_d, t_d = stack(late)
        R_v, t_v = R_v @ R_d, t_v + np.einsum("qij,qj->qi", R_v, t_d)
    return R_v @ R_e[lidar], t_v + np.einsum("qij,qj->qi", R_v, t_e[lidar])


def geometry_of(
    state: State,
    sightings: Sightings,
    layout: Layout,
    lidar: IntArray,
    pose: IntArray,
    twists: Array | None,
    dents: bool = True,
) -> Geometry:
    """Residuals `n^T (L p - c)` of the points of all sightings, as functions of h = (p, 1).

    Args:
        state: where they are linearised.
        sightings: Q of them.
        layout: the coordinates.
        lidar: (Q,) index of the LiDAR of each.
        pose: (Q,) index of the pose of each.
        twists: (M, 6) velocity at each pose, right perturbation per second; None: no offset is
            free.
        dents: whether dents of the ground tell where a LiDAR is (`smooth_normals`).
    """
    q = sightings.count
    strip = sightings.strip
    surface = np.array(layout.surface_of, dtype=np.int64)[strip]
    R, t = lidar_poses(state, lidar, pose, twists)
    centre, normal = state.centres_map[strip], state.normals_map[strip]
    m = np.einsum("qji,qj->qi", R, normal)
    error_columns = _error_columns(layout, lidar, surface, strip)
    by_error = _by_error(sightings, m, normal[:, 2] > LEVEL)

    plain = np.zeros((q, 4))
    plain[:, :3] = m
    plain[:, 3] = np.einsum("qi,qi->q", normal, t - centre)
    plain += np.einsum("qe,qei->qi", state.errors[error_columns], by_error)

    normals = state.normals_map if dents else smooth_normals(state.normals_map, layout)
    smooth = np.einsum("qji,qj->qi", R, normals[strip])
    by_extrinsic = np.zeros((q, 6, 4))
    by_extrinsic[:, :3, :3] = -skew(smooth)
    by_extrinsic[:, 3:, 3] = smooth
    back = np.array([np.asarray(T.inverse().AdjointMap()) for T in state.T_vehicle_lidar])
    by_pose = np.swapaxes(back[lidar], 1, 2) @ by_extrinsic
    if twists is not None and layout.rates:
        by_extrinsic = by_extrinsic + _by_compensation(
            sightings.time_s, np.einsum("qij,qj->qi", back[lidar], twists[pose]), by_extrinsic
        )
    B = tangent_axes(normal)
    by_plane = np.zeros((q, 3, 4))
    by_plane[:, :2, :3] = B @ R
    by_plane[:, :2, 3] = np.einsum("qki,qi->qk", B, t - centre)
    by_plane[:, 2, 3] = -1.0
    parts = [by_pose, by_extrinsic, by_plane, by_error]
    columns = [
        6 * pose[:, None] + np.arange(6),
        layout.extrinsic + 6 * lidar[:, None] + np.arange(6),
        layout.plane + 3 * strip[:, None] + np.arange(3),
        error_columns,
    ]
    if twists is not None and layout.rates:
        # Points move with the velocity in the map, whatever way the vehicle is turned.
        by_turn = sightings.time_s[:, None, None] * (
            np.swapaxes(skew(twists[pose, 3:]), 1, 2) @ by_pose[:, 3:]
        )
        turned = state.moved[6 * pose[:, None] + np.arange(3)]
        plain += np.einsum("qc,qci->qi", turned, by_turn)
        parts[0] = np.concatenate([by_pose[:, :3] + by_turn, by_pose[:, 3:]], axis=1)
    moved = _by_motion(state, sightings, layout, lidar, pose, twists, by_pose)
    for by, own, value in moved:
        plain += np.einsum("qc,qci->qi", value, by)
        parts.append(by)
        columns.append(own)
    return Geometry(plain, np.concatenate(parts, axis=1), np.concatenate(columns, axis=1), m)


def _by_compensation(time_s: Array, twists_lidar: Array, by_extrinsic: Array) -> Array:
    """(Q, 6, 4) further derivatives by the extrinsic: points were moved in time with it.

    A point taken tau later is at `X Exp(tau xi) E p`: a right perturbation of E there is one by
    `Ad(Exp(tau xi_lidar))` at the stamp. With it, a turn of the LiDAR on the vehicle that the
    vehicle's poses make up for is told by nothing, the rates following the poses.
    """
    turn, shift = skew(twists_lidar[:, :3]), skew(twists_lidar[:, 3:])
    ad = np.zeros((len(time_s), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = turn
    ad[:, 3:, :3] = shift
    return np.asarray(time_s[:, None, None] * (np.swapaxes(ad, 1, 2) @ by_extrinsic))


def _by_motion(
    state: State,
    sightings: Sightings,
    layout: Layout,
    lidar: IntArray,
    pose: IntArray,
    twists: Array | None,
    by_pose: Array,
) -> list[tuple[Array, IntArray, Array]]:
    """What moves a whole scan, or its points by their times, as errors of its pose do.

    Each with its derivatives (Q, c, 4), their coordinates (Q, c), and the values (Q, c) that are
    not in the poses of `state` yet.
    """
    q = sightings.count
    out = []
    if layout.rates:
        # Points taken tau later: X Exp(tau e) in the place of X.
        own = np.broadcast_to(layout.rate + np.arange(layout.rates), (q, layout.rates))
        by_rates = sightings.time_s[:, None, None] * by_pose
        out.append((by_rates, own, state.moved[own]))
    if twists is None or not (layout.offsets or layout.jitters):
        return out
    by_time = -np.einsum("qi,qij->qj", twists[pose], by_pose)[:, None]
    if layout.jitters:
        own = layout.jitter + sightings.scan[:, None]
        out.append((by_time, own, state.errors[own]))
    if layout.offsets:
        by_offset = by_time.copy()
        place = np.full(layout.lidars, -1)
        place[list(layout.offsets)] = layout.offset + np.arange(len(layout.offsets))
        by_offset[place[lidar] < 0] = 0.0
        out.append((by_offset, np.maximum(place[lidar], 0)[:, None], np.zeros((q, 1))))
    return out


def smooth_normals(normals_map: Array, layout: Layout) -> Array:
    """(K, 3) normals by which a motion of a LiDAR changes the distances from the strips.

    Of level strips that of their tile: dents of the ground are no flat pieces, and which of them a
    beam meets depends on where it falls. They tell height and tilt, a ramp tells more.
    """
    surface = np.array(layout.surface_of, dtype=np.int64)
    level = normals_map[:, 2] > LEVEL
    total = np.stack([np.bincount(surface, n, layout.surfaces) for n in normals_map.T], axis=1)
    mean = total / np.linalg.norm(total, axis=1)[:, None]
    dent = level & (np.einsum("ki,ki->k", mean[surface], normals_map) > math.cos(DENT_RAD))
    return np.where(dent[:, None], mean[surface], normals_map)


def _error_columns(layout: Layout, lidar: IntArray, surface: IntArray, strip: IntArray) -> IntArray:
    """(Q, 5) columns of the errors of each sighting, in the order of `_by_error`."""
    of_surface = layout.surface_error + layout.surfaces * lidar + surface
    of_strip = layout.strip_error + layout.strips * lidar + strip
    first = layout.error + BIASES * lidar
    return np.stack([first, first + 1, first + 2, of_surface, of_strip], axis=1)


def _by_error(sightings: Sightings, normals_lidar: Array, level: BoolArray) -> Array:
    """(Q, 5, 4) what each error of a LiDAR adds to the residual, linear in h = (p, 1).

    A range that is too long by b moves a point by `-b cos(incidence)` along the normal; the cosine
    changes over a strip: on ground that looks like a tilt. Errors: bias, its growth with
    1 / cos(incidence), bias on the ground (`level` strips), bias on the surface, offset on the
    strip.
    """
    centroid = sightings.centroids_lidar
    distance = np.linalg.norm(centroid, axis=1)[:, None]
    u = centroid / distance
    cos = -np.einsum("qi,qi->q", normals_lidar, u)
    # Along the plane only: a change along the normal would scale the points' scatter away.
    slope = -cos[:, None] * (u + cos[:, None] * normals_lidar) / distance
    out = np.zeros((len(u), 5, 4))
    out[:, 0, :3] = slope
    out[:, 0, 3] = cos - np.einsum("qi,qi->q", slope, centroid)
    out[:, 1] = -out[:, 0]
    out[:, 1, 3] += 1.0
    out[:, 2] = np.where(level[:, None], out[:, 0], 0.0)
    out[:, 3] = out[:, 0]
    out[:, 4, 3] = 1.0
    return out


@dataclass(frozen=True)
class System:
    """A quadratic `d^T H d / 2 - b^T d` on all coordinates, the surfaces' own eliminated.

    Attributes:
        layout: the coordinates.
        H: (R, R) of the first R = `layout.plane` coordinates, without guesses of extrinsics.
        b: (R,).
        surfaces: what was eliminated.
        H_prior: (P, P) of it what the motion data say, P coordinates of poses, parameters and
            rates, without the parameters' own priors.
        b_prior: (P,).
    """

    layout: Layout
    H: Array
    b: Array
    surfaces: Surfaces
    H_prior: Array
    b_prior: Array


def system_of(
    rows: Rows,
    state: State,
    layout: Layout,
    prior: PosePrior,
    nuisances: Nuisances,
    standing: Standing,
    stands: Stands,
) -> System:
    """The normal equations of structure, motion data, and how the vehicle stands."""
    sparse, less, right = rows.normal_equations()
    own_errors = slice(layout.standing, layout.jitter)
    J, r = standing_rows(
        standing,
        stands,
        state.R_map_vehicle,
        state.t_map_vehicle,
        state.centres_map,
        state.normals_map,
        state.errors[own_errors],
        layout.standing,
        layout.plane,
        layout.size,
    )
    sparse, right = sparse + J.T @ J, right - J.T @ r
    weight = np.zeros(layout.size)
    weight[layout.plane : layout.surface_error] = np.tile(
        [TILT_PRIOR_RAD**-2.0, TILT_PRIOR_RAD**-2.0, PLACE_PRIOR_M**-2.0], layout.strips
    )
    errors = layout.error_columns()
    weight[errors] = layout.error_sigmas(nuisances) ** -2.0
    tilt = standing.tilt_sigma_rad or 1.0
    weight[own_errors] = np.array([standing.height_sigma_m, tilt, tilt]) ** -2.0
    if nuisances.jitter_s > 0.0:
        weight[layout.jitter : layout.plane] = nuisances.jitter_s**-2.0
    right -= weight * state.errors
    sparse = (sparse + scipy.sparse.diags_array(weight)).tocsr()
    size = layout.offset
    H, b, surfaces = eliminated(sparse, less, right, layout.plane, layout.of_surfaces())
    b_prior = prior.gradient - prior.information @ state.moved
    H[:size, :size] += prior.information
    b[:size] += b_prior
    if layout.parameters:
        own = slice(6 * layout.poses, layout.rate)
        H[own, own] += prior.parameter_information
        b[own] -= prior.parameter_information @ (prior.parameter_offset + state.moved[own])
    return System(layout, H, b, surfaces, prior.information, b_prior)


def stepped(state: State, layout: Layout, d: Array) -> State:
    """The estimate after a step (D,)."""
    m = layout.poses
    xi = d[: 6 * m].reshape(m, 6)
    moved = [gtsam.Pose3.Expmap(v) for v in xi]
    R_d, t_d = stack(moved)
    tangents = d[layout.extrinsic : layout.error].reshape(-1, 6)
    planes = d[layout.plane : layout.surface_error].reshape(-1, 3)
    errors = np.concatenate([layout.error_columns(), np.arange(layout.standing, layout.plane)])
    all_errors = state.errors.copy()
    all_errors[errors] += d[errors]
    B = tangent_axes(state.normals_map)
    turn = np.cross(state.normals_map, np.einsum("kj,kji->ki", planes[:, :2], B))
    normals = np.einsum("kij,kj->ki", exp_so3(turn), state.normals_map)
    offsets = state.offsets_s.copy()
    offsets[list(layout.offsets)] += d[layout.offset : layout.extrinsic]
    return replace(
        state,
        R_map_vehicle=state.R_map_vehicle @ R_d,
        t_map_vehicle=state.t_map_vehicle + np.einsum("mij,mj->mi", state.R_map_vehicle, t_d),
        moved=state.moved + d[: layout.offset],
        T_vehicle_lidar=tuple(
            T.retract(v) for T, v in zip(state.T_vehicle_lidar, tangents, strict=True)
        ),
        offsets_s=offsets,
        centres_map=state.centres_map + planes[:, 2:] * state.normals_map,
        normals_map=normals,
        errors=all_errors,
    )
