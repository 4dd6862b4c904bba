"""How far apart the beams of a LiDAR are, read off a scan, and the distances that follow from it.

A LiDAR of 16 channels over 30 degrees has its rows 0.35 m apart at 10 m and its columns 0.03 m: a
distance that joins the rows of an object in all directions joins it with its neighbours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from caliv_graph.geometry.se3 import tangent_axes
from caliv_graph.products import Array, IntArray
from caliv_graph.targets.search.objects import LINK_BEAMS, LINK_M, MAX_LINK_M

LINK_PER_RANGE = 0.02
"""Distance at which points are linked in any direction, over the range: gaps within one object at
20 m separate two objects at 5 m."""

NEXT_ROW = 1.3
"""Neighbouring rows are linked at any range: one row spacing, and the slope of the object."""

WIDEST_GAP_M = 0.6
"""Points of one row are linked as far as rows are, but no farther than this: where no row meets the
seat of a chair, its legs are this far from its backrest and from one another."""

DEPTH_M = 0.7
"""Depth up to which points of neighbouring rows are linked where rows are far apart: from the front
legs of a chair to its backrest."""

LEAST_SINE = 1e-6
"""Of the angle between a beam and the LiDAR's z below which there is no direction of azimuth."""

WINDOW_RAD = math.radians(3.0)
"""Rows are looked for up to this far above and below an object: channels may be unevenly spaced."""

SAME_ROW = 0.5
"""Points are of one row if their elevations differ by less than this part of the row spacing."""


@dataclass(frozen=True)
class BeamSpacing:
    """Angles between neighbouring beams about an object, radians: of rows and within a row."""

    row: float
    column: float


def elevations(points_lidar: Array) -> Array:
    """(n,) radians above the LiDAR's xy plane, of points (n, 3)."""
    x, y, z = points_lidar.T.copy()  # numpy is fast along a row
    return np.asarray(np.arctan2(z, np.sqrt(x * x + y * y)))  # `hypot` takes twice as long


def typical_gap(values: Array) -> float:
    """The gap between sorted values such that half of their span lies in gaps at least as large.

    Many equal or nearly equal values (a row of returns) do not count. 0 for fewer than two values.
    """
    if len(values) < 2:
        return 0.0
    gaps = np.diff(np.sort(values))
    half = 0.5 * float(gaps.sum())
    # All of the others together are less than half: those within rows, mostly, and not sorted.
    large = np.sort(gaps[gaps >= half / len(gaps)])
    covered = 2.0 * half - float(large.sum()) + np.cumsum(large)
    return float(large[min(int(np.searchsorted(covered, half)), len(large) - 1)])


def beam_spacing(near_lidar: Array, scan_elevations: Array) -> BeamSpacing:
    """Spacing of the beams about an object, from a scan.

    Where a LiDAR has no rows (its beams never repeat an elevation) the row spacing is next to 0.
    Points with the same angle may come in any order: they make gaps of 0.

    Args:
        near_lidar: (n, 3) metres, lidar frame: the points of and about the object.
        scan_elevations: (N,) `elevations` of the whole scan.
    """
    own = elevations(near_lidar)
    low, high = float(own.min()) - WINDOW_RAD, float(own.max()) + WINDOW_RAD
    row = typical_gap(scan_elevations[(scan_elevations > low) & (scan_elevations < high)])
    azimuth = np.arctan2(near_lidar[:, 1], near_lidar[:, 0])
    # Rows one after the other; a step from one to the next is no gap within a row.
    order = np.argsort(own)
    rows = np.cumsum(np.append(0, np.diff(own[order]) > SAME_ROW * row))
    of_row = np.empty(len(order), dtype=np.min_scalar_type(rows[-1]))
    of_row[order] = rows
    along = np.argsort(azimuth)
    along = along[np.argsort(of_row[along], kind="stable")]  # one pass: small whole numbers
    gaps = np.diff(azimuth[along])[np.diff(of_row[along]) == 0]
    column = float(np.quantile(gaps, 0.25)) if len(gaps) else 0.0
    return BeamSpacing(row, column)


@dataclass(frozen=True)
class Linking:
    """Which of some points of a scan are near enough to one another to be of one object.

    Attributes:
        places: (n, 3) the points; where the beams are not dense, in axes across, along and up the
            beams, compressed so that beams are about as far apart in all directions.
        link_m: distance of the places up to which points are linked, metres.
        row_m: spacing of the rows, metres of `places`; 0 where the beams are dense.
    """

    places: Array
    link_m: float
    row_m: float

    @classmethod
    def of(cls, points_lidar: Array, spacing: BeamSpacing, range_m: float) -> Linking:
        """Links points (n, 3), metres, lidar frame, about `range_m` away."""
        row_m = spacing.row * range_m
        link_m = max(LINK_M, LINK_PER_RANGE * range_m)
        up_m = max(min(LINK_BEAMS * row_m, MAX_LINK_M), NEXT_ROW * row_m)
        across_m = min(LINK_BEAMS * spacing.column * range_m, MAX_LINK_M)
        if (up_m <= link_m and across_m <= link_m) or not len(points_lidar):
            return cls(points_lidar, link_m, 0.0)
        link_m = max(link_m, min(up_m, WIDEST_GAP_M))
        up_m, across_m = max(up_m, link_m), max(across_m, link_m)
        along = points_lidar.mean(axis=0)
        along /= np.linalg.norm(along)
        across = np.array([-along[1], along[0], 0.0])
        length = float(np.linalg.norm(across))
        across = across / length if length > LEAST_SINE else tangent_axes(along)[0]
        up = np.cross(along, across)
        axes = np.column_stack([across * (link_m / across_m), along, up * (link_m / up_m)])
        return cls(np.asarray(points_lidar @ axes), link_m, row_m * link_m / up_m)

    def pairs(self) -> IntArray:
        """(p, 2) indices of the linked points."""
        tree = cKDTree(self.places)
        if not self.row_m:
            return np.asarray(tree.query_pairs(self.link_m, output_type="ndarray"), np.int64)
        reach_m = max(DEPTH_M, self.link_m)
        pairs = tree.query_pairs(reach_m, p=np.inf, output_type="ndarray")
        off = np.abs(self.places[pairs[:, 0]] - self.places[pairs[:, 1]])
        near = np.einsum("pi,pi->p", off, off) <= self.link_m**2
        other_row = off[:, 2] > SAME_ROW * self.row_m
        near |= other_row & (off[:, [0, 2]].max(axis=1) <= self.link_m)
        return np.asarray(pairs[near], np.int64)
