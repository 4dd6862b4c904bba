"""A map of flat surfaces that grows with the way: moments of patches, summed per cell and side."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from caliv_graph.geometry.se3 import cross
from caliv_graph.products import Array, IntArray
from caliv_graph.structure.sightings import moved_moments

CELL_M = 1.0
"""Side of a cell: half of the 2 m over which surfaces are flat, so that the plane of a cell holds
for a patch beside it, too."""

REACH_M = 1.5
"""A patch belongs to a surface whose middle is nearer: the diagonal of a cell's face."""

SAME_SIDE_COS = float(np.cos(np.radians(25.0)))
"""Cosine between the normals of a patch and of its surface: 2 degrees of noise of either, bumps,
and what a prediction of the motion may be off."""

NEIGHBOURS = 4
"""Surfaces that are looked at for each patch: at a corner of walls the nearest is another side."""

BITS = 20
"""Of a coordinate of a cell."""


@dataclass
class SurfaceMap:
    """Surfaces seen so far; N cells.

    Attributes:
        moments: (N, 4, 4) sums of h h^T, map frame.
        sides: (N, 3) sums of the normals of the patches, by their points.
    """

    moments: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    sides: Array = field(default_factory=lambda: np.zeros((0, 3)))
    _number: dict[int, int] = field(default_factory=dict)
    _centres: Array = field(default_factory=lambda: np.zeros((0, 3)))
    _normals: Array = field(default_factory=lambda: np.zeros((0, 3)))
    _tree: cKDTree | None = None

    def add(self, moments: Array, normals: Array, R_map_lidar: Array, t_map_lidar: Array) -> None:
        """Adds patches (n, 4, 4) with normals (n, 3), both in the lidar frame at one pose."""
        count = len(moments)
        R, t = np.broadcast_to(R_map_lidar, (count, 3, 3)), np.broadcast_to(t_map_lidar, (count, 3))
        in_map, facing = moved_moments(moments, R, t), normals @ R_map_lidar.T
        points = in_map[:, 3, 3]
        cells = _cells(in_map[:, :3, 3] / points[:, None], facing)
        keys, own = np.unique(cells, return_inverse=True)
        index = np.array([self._number.setdefault(k, len(self._number)) for k in keys.tolist()])
        more = len(self._number) - len(self.moments)
        self.moments = np.concatenate([self.moments, np.zeros((more, 4, 4))])
        self.sides = np.concatenate([self.sides, np.zeros((more, 3))])
        self._centres = np.concatenate([self._centres, np.zeros((more, 3))])
        self._normals = np.concatenate([self._normals, np.zeros((more, 3))])
        np.add.at(self.moments, index[own.ravel()], in_map)
        np.add.at(self.sides, index[own.ravel()], points[:, None] * facing)
        self._fit(index)
        self._tree = cKDTree(self._centres)

    def _fit(self, index: IntArray) -> None:
        """The planes of some cells anew."""
        S = self.moments[index]
        centre = S[:, :3, 3] / S[:, 3:, 3]
        cov = S[:, :3, :3] / S[:, 3:, 3, None] - centre[:, :, None] * centre[:, None, :]
        normal = np.linalg.eigh(cov)[1][:, :, 0]
        side = np.einsum("ni,ni->n", normal, self.sides[index])
        self._centres[index] = centre
        self._normals[index] = np.where((side < 0.0)[:, None], -normal, normal)

    def nearest(self, centres: Array, normals: Array) -> tuple[IntArray, Array, Array, int]:
        """Surfaces of patches at (n, 3), with normals (n, 3), map frame.

        Returns:
            Indices (m,) of the patches that have one; centres (m, 3) and normals (m, 3) of these;
            and how many have any surface near, whichever way it faces.
        """
        if self._tree is None or not len(centres):
            return np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3)), 0
        most = min(NEIGHBOURS, len(self._centres))
        found = self._tree.query(centres, k=most, distance_upper_bound=REACH_M)
        near = np.asarray(found[1]).reshape(len(centres), most)
        there = near < len(self._centres)
        near = np.where(there, near, 0)
        alike = np.einsum("nki,ni->nk", self._normals[near], normals) > SAME_SIDE_COS
        good = there & alike
        which = np.flatnonzero(good.any(axis=1))
        first = near[which, np.argmax(good[which], axis=1)]
        around = int(there.any(axis=1).sum())
        return which, self._centres[first], self._normals[first], around


def _cells(centres: Array, normals: Array) -> IntArray:
    """(n,) a number for the cell of each patch and the side that it faces."""
    place = np.floor(centres / CELL_M).astype(np.int64) + (1 << (BITS - 1))
    axis = np.argmax(np.abs(normals), axis=1)
    side = 2 * axis + (normals[np.arange(len(normals)), axis] < 0.0)
    x, y, z = place.T
    return np.asarray((((side << BITS) + x << BITS) + y << BITS) + z)


def point_to_plane(R_map_lidar: Array, points_lidar: Array, residuals_normals: Array) -> Array:
    """(n, 6) derivatives of `n . (T p - c)` by a right perturbation of T; normals in the map."""
    m = residuals_normals @ R_map_lidar
    return np.concatenate([cross(points_lidar, m), m], axis=1)
