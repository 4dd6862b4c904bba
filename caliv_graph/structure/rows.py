"""Residuals of sightings in units of their noise: what goes into the normal equations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from caliv_graph.products import Array, IntArray
from caliv_graph.structure.layout import Layout, Nuisances
from caliv_graph.structure.residuals import PLANE_ROWS, Geometry, rows_of
from caliv_graph.structure.sightings import Sightings, without_own_error
from caliv_graph.structure.sparse_parts import difference_of_squares, members

MOST_NOISE = 0.5
"""Largest part of a strip's information on its tilt that may be noise of the points."""

FITTED = 2.5
"""Points fewer by which the noise counts in what errors of beams add to sightings: these are fitted
to the points, noise included. Of 12 points in two channels 0.79 of it are there, of 21 in three
0.88, of 40 in four 0.93 (simulated)."""

TOGETHER = 1000
"""Sightings whose rows are made at a time: temporary memory is small."""

TILT_PRIOR_RAD = 5.0


PLACE_PRIOR_M = 1000.0
"""Prior of a plane: a single ring of beams does not determine its tilt. A thousand planes together
must say next to nothing of what turns and shifts all of them, such as the roll of all LiDARs on a
straight drive: 5 rad / sqrt(1000) is five times the guess's 30 mrad."""


@dataclass(frozen=True)
class Rows:
    """Whitened residuals of all sightings.

    Attributes:
        J: (4 Q, D).
        r: (4 Q,).
        shared: (4 Q, G) derivatives by the offset of each surface in each scan, 1 sigma each.
        of_noise: (D,) what the noise of the points adds to `J^T r` in the mean.
        shared_noise: (G,) the same of `shared^T r`.
        scan: (Q,) the scan of each sighting.
        scan_of_group: (G,) the scan of each of the shared offsets.
    """

    J: scipy.sparse.csr_array
    r: Array
    shared: scipy.sparse.csr_array
    of_noise: Array
    shared_noise: Array
    scan: IntArray
    scan_of_group: IntArray

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
        rows = {s: (4 * own[:, None] + np.arange(4)).ravel() for s, own in sightings.items()}
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
    tilts: tuple[Array, Array],
    nuisances: Nuisances,
    weights: Array,
    layout: Layout,
) -> Rows:
    """Residuals by the noise of points and sightings, the latter eliminated.

    `group` (Q,) numbers scan and surface of each, `repeated` (Q,) says how many scans have its
    view: what these share counts as often, so that their mean has the error of one. `alike` (Q,)
    says how many sightings of its strip its LiDAR has. `tilts` are `Nuisances.tilts` of each.
    `weights` (Q,) are robust.
    """
    more = repetition(nuisances, repeated)
    own = nuisances.sighting[sightings.strip] * more
    # A strip that two LiDARs see apart they see tilted against each other, too, and alike in all
    # scans: bumps within it. As often as it is seen, so often the error counts.
    own_tilt, strip_tilt = tilts
    tilt = np.sqrt((own_tilt * more) ** 2 + (alike - 1.0) * strip_tilt**2)
    S, noise = without_own_error(sightings, geometry.normals_lidar, own, tilt)
    S, noise = S * weights[:, None, None], noise * weights[:, None, None]
    values, vectors = np.linalg.eigh(S)
    C = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    q = sightings.count
    J = rows_of(_times(geometry.by, C), geometry.columns, layout.size)
    J.eliminate_zeros()
    groups, first, number = np.unique(group, return_index=True, return_inverse=True)
    by_offset = (nuisances.shared * more)[:, None] * C[:, 3]
    own_group = np.broadcast_to(number.ravel()[:, None], by_offset.shape)
    shared = scipy.sparse.csr_array(
        (by_offset.ravel(), (np.arange(4 * q), own_group.ravel())), shape=(4 * q, len(groups))
    )
    noise *= _bearable(geometry, S, noise, sightings.strip)[:, None, None]
    of_plane = np.einsum("qij,qj->qi", noise, geometry.placed)
    pull = np.einsum("qci,qi->qc", geometry.by, of_plane)
    of_noise = np.bincount(geometry.columns.ravel(), pull.ravel(), minlength=layout.size)
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
    r = np.einsum("qi,qij->qj", geometry.plain, C).ravel()
    scan = sightings.scan
    return Rows(J, r, shared, np.asarray(of_noise), np.asarray(of_groups), scan, scan[first])


def _times(by: Array, C: Array) -> Array:
    """(Q, 4, C) transposed products of derivatives (Q, C, 4) and (Q, 4, 4); no copy of all."""
    out = np.empty((len(by), 4, by.shape[1]))
    for begin in range(0, len(by), TOGETHER):
        some = slice(begin, begin + TOGETHER)
        out[some] = np.swapaxes(by[some] @ C[some], 1, 2)
    return out


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
