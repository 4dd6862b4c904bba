"""Residuals of sightings in units of their noise: what goes into the normal equations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from caliv_graph.products import Array, IntArray
from caliv_graph.structure.layout import Layout, Nuisances
from caliv_graph.structure.residuals import EXTRINSIC_ROWS, PLANE_ROWS, Geometry
from caliv_graph.structure.sightings import Sightings, without_own_error
from caliv_graph.structure.sparse_parts import difference_of_squares, members

MOST_NOISE = 0.5
"""Largest part of a strip's information on its tilt that may be noise of the points."""

FITTED = 2.5
"""Points fewer by which the noise counts in what errors of beams add to sightings: these are fitted
to the points, noise included. Of 12 points in two channels 0.79 of it are there, of 21 in three
0.88, of 40 in four 0.93 (simulated)."""

LEAST_PIVOT = 1e-12
"""Part of a moment that is its rounding: what is left of it says nothing."""

TILT_PRIOR_RAD = 5.0


PLACE_PRIOR_M = 1000.0
"""Prior of a plane: a single ring of beams does not determine its tilt. A thousand planes together
must say next to nothing of what turns and shifts all of them, such as the roll of all LiDARs on a
straight drive: 5 rad / sqrt(1000) is five times the guess's 30 mrad."""


@dataclass(frozen=True)
class Rows:
    """Whitened residuals of all sightings: the first of each, then the second of each, ...

    Attributes:
        J: (4 Q, D).
        r: (4 Q,).
        shared: (4 Q, G) derivatives by the offset of each surface in each scan, 1 sigma each.
        of_noise: (D,) what the noise of the points adds to `J^T r` in the mean.
        shared_noise: (G,) the same of `shared^T r`.
        scan: (Q,) the scan of each sighting.
        scan_of_group: (G,) the scan of each of the shared offsets.
        noise_by_extrinsic: (Q, 6) what each sighting adds to `of_noise` of its LiDAR's extrinsic.
    """

    J: scipy.sparse.csr_array
    r: Array
    shared: scipy.sparse.csr_array
    of_noise: Array
    shared_noise: Array
    scan: IntArray
    scan_of_group: IntArray
    noise_by_extrinsic: Array

    def normal_equations(self, rest: int) -> Quadratic:
        """The system, the shared offsets eliminated.

        Args:
            rest: number of coordinates that are not of one surface each, the first ones.
        """
        J, B = self.J, self.shared
        inner = 1.0 / (1.0 + np.asarray(B.multiply(B).sum(axis=0)).ravel())
        scaled = B.copy()
        scaled.data *= np.sqrt(inner)[B.indices]
        V_t = (scaled.T.tocsr() @ J).tocsr()
        b = self.of_noise - J.T @ self.r
        b += V_t.T @ (np.sqrt(inner) * (B.T @ self.r - self.shared_noise))
        others = (J[:, rest:].T.tocsr() @ J).tocsr()
        # What two scans have in common are errors of their LiDARs.
        sightings, groups = members(self.scan), members(self.scan_of_group)
        each = len(self.scan) * np.arange(4)[:, None]
        rows = {scan: (each + own).ravel() for scan, own in sightings.items()}
        first = difference_of_squares(J, rows, V_t, groups, rest)
        return Quadratic(first, others, V_t, np.asarray(b))


@dataclass(frozen=True)
class Quadratic:
    """A quadratic on D coordinates, the first R of which belong to no surface.

    Attributes:
        first: (R, R) information of the first ones.
        others: (D - R, D) rows of the others, without `- V V^T`.
        V_t: (G, D) couplings V^T by shared offsets. The product would couple all strips of a
            surface with each other: most of the memory of the solve.
        b: (D,) right-hand side.
    """

    first: Array
    others: scipy.sparse.csr_array
    V_t: scipy.sparse.csr_array
    b: Array


def whitened(
    geometry: Geometry,
    sightings: Sightings,
    group: IntArray,
    repeated: IntArray,
    alike: IntArray,
    errors: tuple[Array, Array, Array],
    nuisances: Nuisances,
    weights: Array,
    layout: Layout,
) -> Rows:
    """Residuals by the noise of points and sightings, the latter eliminated.

    `group` (Q,) numbers scan and surface of each, `repeated` (Q,) says how many scans have its
    view: what these share counts as often, so that their mean has the error of one. `alike` (Q,)
    says how many sightings of its strip its LiDAR has. `errors` are `Nuisances.errors` of each.
    `weights` (Q,) are robust.
    """
    more = repetition(nuisances, repeated)
    own_offset, own_tilt, strip_tilt = errors
    own = own_offset * more
    # A strip that two LiDARs see apart they see tilted against each other, too, and alike in all
    # scans: bumps within it. As often as it is seen, so often the error counts.
    tilt = np.sqrt((own_tilt * more) ** 2 + (alike - 1.0) * strip_tilt**2)
    S, noise = without_own_error(sightings, geometry.normals_lidar, own, tilt)
    S, noise = S * weights[:, None, None], noise * weights[:, None, None]
    C = roots_of(S)
    q = sightings.count
    derivatives = _Derivatives.of(geometry)
    J = derivatives.rows(C, layout.size)
    groups, first, number = np.unique(group, return_index=True, return_inverse=True)
    # The last coordinate of h, to which an offset adds, is in the first residual alone.
    by_offset = nuisances.shared * more * C[:, 3, 0]
    shared = scipy.sparse.csr_array(
        (by_offset, (np.arange(q), number.ravel())), shape=(4 * q, len(groups))
    )
    noise *= _bearable(geometry, S, noise, sightings.strip)[:, None, None]
    of_plane = np.einsum("qij,qj->qi", noise, geometry.placed)
    pull = derivatives.along(of_plane)
    of_noise = np.bincount(derivatives.column, pull, minlength=layout.size)
    beams = geometry.beams
    if beams is not None:
        less = -FITTED / sightings.points[:, None]
        own = less * np.einsum("qci,qi->qc", beams.by, of_plane)
        # All azimuths together are a turn of the LiDAR, noise included.
        turning = (own * (beams.turning > 0.0)).sum(axis=1, keepdims=True)
        own -= beams.turning * turning
        of_noise += np.bincount(
            (layout.beam + beams.column).ravel(), own.ravel(), minlength=layout.size
        )
    of_offset = nuisances.shared * more * of_plane[:, 3]
    of_groups = np.bincount(number.ravel(), of_offset, len(groups))
    r = np.einsum("qi,qij->jq", geometry.plain, C).ravel()
    scan = sightings.scan
    return Rows(
        J,
        r,
        shared,
        np.asarray(of_noise),
        np.asarray(of_groups),
        scan,
        scan[first],
        np.einsum("qci,qi->qc", geometry.by[:, EXTRINSIC_ROWS], of_plane),
    )


def roots_of(S: Array) -> Array:
    """(Q, 4, 4) C with `C C^T = S` of information matrices S (Q, 4, 4), which may be singular.

    Cholesky's, from the last coordinate on: in columns but the first it is zero, and derivatives
    that only shift a plane are so as well.
    """
    C, left = np.zeros_like(S), S.copy()
    order = [3, 0, 1, 2]
    for k, i in enumerate(order):
        pivot = left[:, i, i]
        known = pivot > LEAST_PIVOT * S[:, i, i]
        column = left[:, :, i] / np.sqrt(np.where(known, pivot, 1.0))[:, None]
        column[~known] = 0.0
        column[:, order[:k]] = 0.0
        C[:, :, k] = column
        left -= column[:, :, None] * column[:, None, :]
    return C


@dataclass(frozen=True)
class _Derivatives:
    """The derivatives of a geometry that are not zero, one sighting after the other.

    Most errors of beams are those of channels that a sighting has no point of.

    Attributes:
        each: (Q,) how many a sighting has.
        by: (4, n) derivatives, by the coordinates of h.
        column: (n,).
    """

    each: IntArray
    by: Array
    column: IntArray

    @classmethod
    def of(cls, geometry: Geometry) -> _Derivatives:
        """Those of a geometry."""
        by = geometry.by
        used = by[:, :, 3] != 0.0
        for i in range(3):
            used |= by[:, :, i] != 0.0
        at = np.flatnonzero(used)
        some = by.reshape(-1, 4)[at]
        return cls(
            np.count_nonzero(used, axis=1),
            np.ascontiguousarray(some.T),
            geometry.columns.ravel()[at].astype(np.int32),
        )

    def along(self, of: Array) -> Array:
        """(n,) products with vectors (Q, 4)."""
        total = np.zeros(len(self.column))
        for of_i, by_i in zip(of.T, self.by, strict=True):
            if of_i.any():
                total += np.repeat(of_i, self.each) * by_i
        return total

    def rows(self, C: Array, size: int) -> scipy.sparse.csr_array:
        """(4 Q, `size`) products with roots (Q, 4, 4) of `roots_of`."""
        values = np.concatenate([self.along(C[:, :, k]) for k in range(4)])
        ends = np.concatenate([[0], np.cumsum(np.tile(self.each, 4))]).astype(np.int32)
        shape = (4 * len(C), size)
        J = scipy.sparse.csr_array((values, np.tile(self.column, 4), ends), shape=shape)
        J.eliminate_zeros()
        return J


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
