"""Strips: pieces of surface that are taken to be flat, and the patches on each of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from caliv_graph.products import Array, BoolArray, IntArray

CELL_M = 2.0
"""Edge of the cells of the map that strips are found in: walls are not flat beyond 2 m. Ground in
parts of 0.7 m, tied to each other, is no better where each channel has its errors: NEES of S2S 11,
22 and 46 on three drives of the second simulator in place of 8, 5 and 10."""

WIDE_ANGLE_RAD = math.radians(25.0)
WIDE_GATE_M = 0.3
NARROW_ANGLE_RAD = math.radians(6.0)
"""Largest angle between the normal of a patch and that of its strip: at a gate of `WIDE_GATE_M`,
where extrinsics are degrees off, and at the narrowest. A patch knows its normal to 30 mrad. Patches
that straddle a kerb lean towards the LiDAR, and pull the pitch of LiDARs that look ahead and behind
apart."""

STRIPS_OF_A_CELL = 16
"""Most strips of a column: fronts behind each other that face the same way."""

MIN_SCANS = 6
"""Fewest scans that see a strip. What fewer see may have been moving."""

SURFACE_ANGLE_RAD = math.radians(12.0)
SURFACE_STEP_M = 0.3
SURFACE_GAP_M = 3.0
"""Neighbouring strips are one surface up to this angle, step across it and gap along it: a wall
with its reveals, painted alike."""


LEVEL = 0.9
"""Vertical component of a normal above which a strip is level: ground."""

TILE_M = 6.0
"""Edge of the tiles of the ground that count as a surface each."""


@dataclass(frozen=True)
class Strips:
    """K strips of one drive.

    Attributes:
        centres_map: (K, 3) metres.
        normals_map: (K, 3) unit vectors, towards the side that was seen.
        surface: (K,) number of the surface that each is a part of.
        of_patch: (N,) strip of each patch; -1: none.
    """

    centres_map: Array
    normals_map: Array
    surface: IntArray
    of_patch: IntArray

    @property
    def count(self) -> int:
        """K."""
        return len(self.centres_map)

    @property
    def level(self) -> BoolArray:
        """(K,) whether each is level: ground."""
        return np.asarray(self.normals_map[:, 2] > LEVEL)


def find_strips(moments_map: Array, normals_map: Array, scan: IntArray, gate_m: float) -> Strips:
    """Groups patches into strips.

    Patches of a cell of the map that face the same side and lie on one plane are a strip.

    Args:
        moments_map: (N, 4, 4) moments of the patches, map.
        normals_map: (N, 3) their normals.
        scan: (N,) scan of each.
        gate_m: largest distance of a patch from its strip.
    """
    of_patch = np.full(len(scan), -1, dtype=np.int64)
    positions = moments_map[:, :3, 3] / moments_map[:, 3, 3, None]
    left, cell = _cells(positions, normals_map)
    cells: list[IntArray] = []
    found: list[_Found] = []
    for _ in range(STRIPS_OF_A_CELL):
        enough = np.bincount(cell)[cell] >= MIN_SCANS if len(cell) else cell > 0
        left, cell = left[enough], cell[enough]
        if not len(left):
            break
        one = _strip_of_each(cell, moments_map[left], normals_map[left], scan[left], gate_m)
        of_patch[left[one.of_patch >= 0]] = one.of_patch[one.of_patch >= 0] + sum(map(len, cells))
        cells.append(one.cell)
        found.append(one)
        left, cell = left[~one.gone], cell[~one.gone]
    of_cell = np.concatenate([np.zeros(0, np.int64), *cells])
    if not len(of_cell):
        return Strips(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int64), of_patch)
    order = np.argsort(of_cell, kind="stable")
    seen = of_patch >= 0
    of_patch[seen] = np.argsort(order)[of_patch[seen]]
    centres = np.concatenate([one.centres_map for one in found])[order]
    normals = np.concatenate([one.normals_map for one in found])[order]
    return Strips(centres, normals, _surfaces(centres, normals), of_patch)


def _cells(positions: Array, normals: Array) -> tuple[IntArray, IntArray]:
    """Indices (N,) of the patches column by column of the map, and the columns' numbers (N,).

    Patches whose normals are nearest to the same axis of the map and point the same way share a
    column along it. A surface must not be cut where it lies: ground at the height of a boundary
    would be two strips, of patches whose errors have the same sign.
    """
    if not len(positions):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    axis = np.abs(normals).argmax(axis=1)
    each = np.arange(len(axis))
    cell = np.floor(positions / CELL_M).astype(np.int64)
    cell[each, axis] = 0
    side = np.where(normals[each, axis] > 0.0, axis, -1 - axis)
    key = np.zeros(len(axis), dtype=np.int64)
    for part in (side, *cell.T):
        # In the order of the four numbers: one sort of integers.
        key = key * (np.ptp(part) + 1) + part - part.min()
    order = np.argsort(key, kind="stable")
    return order, np.cumsum(np.diff(key[order], prepend=-1) > 0) - 1


@dataclass(frozen=True)
class _Found:
    """At most one strip of each of some columns: S strips.

    Attributes:
        cell: (S,) number of the column.
        centres_map: (S, 3).
        normals_map: (S, 3).
        of_patch: (n,) strip of each patch that was given; -1: none.
        gone: (n,) whether a patch is on a strip, or on what was tried as one.
    """

    cell: IntArray
    centres_map: Array
    normals_map: Array
    of_patch: IntArray
    gone: BoolArray


def _strip_of_each(
    cell: IntArray, moments: Array, normals: Array, scan: IntArray, gate_m: float
) -> _Found:
    """The strip about the patch with the most points of each column.

    Args:
        cell: (n,) number of the column of each patch, ascending.
        moments: (n, 4, 4).
        normals: (n, 3).
        scan: (n,).
        gate_m: largest distance of a patch from its strip.
    """
    points = moments[:, 3, 3]
    positions = moments[:, :3, 3] / points[:, None]
    starts = _starts(cell)
    column = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(cell))))
    most = np.flatnonzero(points == np.maximum.reduceat(points, starts)[column])
    seeds = most[_starts(column[most])]
    centres, directions = positions[seeds], normals[seeds]
    taken = np.zeros(len(cell), dtype=bool)
    going = np.ones(len(starts), dtype=bool)
    for _ in range(3):
        on = _on_plane(positions, normals, centres[column], directions[column], gate_m)
        taken = np.where(going[column], on, taken)
        going &= np.add.reduceat(taken, starts, dtype=np.int64) >= MIN_SCANS
        own = np.flatnonzero(taken & going[column])
        if not len(own):
            break
        first = _starts(column[own])
        centres[going], directions[going] = planes_of_moments(
            np.add.reduceat(moments[own], first), np.add.reduceat(normals[own], first)
        )
    own = np.flatnonzero(taken & going[column])
    scans = int(scan.max()) + 1
    pairs = np.unique(column[own] * scans + scan[own])
    strip = np.bincount(pairs // scans, minlength=len(starts)) >= MIN_SCANS
    of_patch = np.full(len(cell), -1, dtype=np.int64)
    of_patch[own] = np.where(strip, np.cumsum(strip) - 1, -1)[column[own]]
    taken[seeds] = True
    return _Found(cell[starts][strip], centres[strip], directions[strip], of_patch, taken)


def _starts(ascending: IntArray) -> IntArray:
    """Where each value begins."""
    return np.flatnonzero(np.diff(ascending, prepend=-1))


def _on_plane(
    positions: Array, normals: Array, centres: Array, planes: Array, gate_m: float
) -> BoolArray:
    """Whether patches (n,) are on planes, one for each."""
    near = np.abs(np.einsum("ni,ni->n", positions - centres, planes)) < gate_m
    angle = min(max(WIDE_ANGLE_RAD * gate_m / WIDE_GATE_M, NARROW_ANGLE_RAD), WIDE_ANGLE_RAD)
    return np.asarray(near & (np.einsum("ni,ni->n", normals, planes) > math.cos(angle)))


def planes_of_moments(moments: Array, towards: Array) -> tuple[Array, Array]:
    """Centres (S, 3) and unit normals (S, 3) of planes, facing `towards` (S, 3).

    `moments` (S, 4, 4) are those of their points.
    """
    total = moments[:, 3, 3, None]
    centres = moments[:, :3, 3] / total
    spread = moments[:, :3, :3] - total[:, None] * centres[:, :, None] * centres[:, None, :]
    normals = np.linalg.eigh(spread)[1][:, :, 0]
    back = np.einsum("si,si->s", normals, towards) <= 0.0
    return centres, np.where(back[:, None], -normals, normals)


def _surfaces(centres: Array, normals: Array) -> IntArray:
    """(K,) number of the surface of each strip: neighbours in one plane are of one."""
    pairs = cKDTree(centres).query_pairs(SURFACE_GAP_M, output_type="ndarray")
    a, b = pairs.T
    between = centres[b] - centres[a]
    same = np.einsum("ki,ki->k", normals[a], normals[b]) > math.cos(SURFACE_ANGLE_RAD)
    for one in (a, b):
        same &= np.abs(np.einsum("ki,ki->k", between, normals[one])) < SURFACE_STEP_M
    level = np.abs(normals[:, 2]) > LEVEL
    tile = np.floor(centres[:, :2] / TILE_M)
    same &= level[a] == level[b]
    same &= ~level[a] | (tile[a] == tile[b]).all(axis=1)
    k = len(centres)
    links = coo_array((np.ones(int(same.sum())), (a[same], b[same])), shape=(k, k))
    _, number = connected_components(links, directed=False)
    return np.asarray(number, dtype=np.int64)
