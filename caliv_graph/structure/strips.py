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
"""Edge of the cells of the map that strips are found in: walls are not flat beyond 2 m."""

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
    centres: list[Array] = []
    normals: list[Array] = []
    points = moments_map[:, 3, 3]
    positions = moments_map[:, :3, 3] / points[:, None]
    for members in _cells(positions, normals_map):
        for strip in _strips_of(members, moments_map, positions, normals_map, scan, gate_m):
            own, centre, normal = strip
            of_patch[own] = len(centres)
            centres.append(centre)
            normals.append(normal)
    if not centres:
        return Strips(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int64), of_patch)
    return Strips(
        np.array(centres),
        np.array(normals),
        _surfaces(np.array(centres), np.array(normals)),
        of_patch,
    )


def _cells(positions: Array, normals: Array) -> list[IntArray]:
    """Indices of the patches of each column of the map, columns in a fixed order.

    Patches whose normals are nearest to the same axis of the map and point the same way share a
    column along it. A surface must not be cut where it lies: ground at the height of a boundary
    would be two strips, of patches whose errors have the same sign.
    """
    if not len(positions):
        return []
    axis = np.abs(normals).argmax(axis=1)
    each = np.arange(len(axis))
    cell = np.floor(positions / CELL_M).astype(np.int64)
    cell[each, axis] = 0
    side = np.where(normals[each, axis] > 0.0, axis, -1 - axis)
    _, inverse = np.unique(np.column_stack([side, cell]), axis=0, return_inverse=True)
    inverse = inverse.ravel()
    order = np.argsort(inverse, kind="stable")
    ends = np.flatnonzero(np.diff(inverse[order])) + 1
    return list(np.split(order, ends))


def _strips_of(
    members: IntArray,
    moments: Array,
    positions: Array,
    normals: Array,
    scan: IntArray,
    gate_m: float,
) -> list[tuple[IntArray, Array, Array]]:
    """Strips of the patches of a cell: their patches, centre and normal."""
    out: list[tuple[IntArray, Array, Array]] = []
    left = members
    for _ in range(STRIPS_OF_A_CELL):
        if len(left) < MIN_SCANS:
            break
        seed = left[np.argmax(moments[left, 3, 3])]
        centre, normal = positions[seed], normals[seed]
        at, facing = positions[left], normals[left]
        for _ in range(3):
            taken = _on_plane(at, facing, centre, normal, gate_m)
            own = left[taken]
            if len(own) < MIN_SCANS:
                break
            centre, normal = plane_of_moments(moments[own].sum(axis=0), normals[own].mean(axis=0))
        taken[left == seed] = True
        if len(own) >= MIN_SCANS and len(np.unique(scan[own])) >= MIN_SCANS:
            out.append((own, centre, normal))
        left = left[~taken]
    return out


def _on_plane(
    positions: Array, normals: Array, centre: Array, normal: Array, gate_m: float
) -> BoolArray:
    near = np.abs((positions - centre) @ normal) < gate_m
    angle = min(max(WIDE_ANGLE_RAD * gate_m / WIDE_GATE_M, NARROW_ANGLE_RAD), WIDE_ANGLE_RAD)
    return np.asarray(near & (normals @ normal > math.cos(angle)))


def plane_of_moments(moments: Array, towards: Array) -> tuple[Array, Array]:
    """Centre (3,) and unit normal (3,) of the plane of moments (4, 4), facing `towards` (3,)."""
    centre = moments[:3, 3] / moments[3, 3]
    spread = moments[:3, :3] - moments[3, 3] * np.outer(centre, centre)
    normal = np.linalg.eigh(spread)[1][:, 0]
    return centre, normal if normal @ towards > 0.0 else -normal


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
