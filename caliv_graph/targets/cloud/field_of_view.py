"""The field of view of a LiDAR, read off some of its scans."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caliv_graph.products import Array, BoolArray

EDGE_RAD = math.radians(0.4)
"""A target within this angle of the edge of the field of view may be cut off by it."""

FULL_TURN_GAP_RAD = math.radians(20.0)
"""A LiDAR whose azimuths leave no gap larger than this covers 360 degrees: it has no edge."""

CELL_DEG = 5.0
"""Cells of direction in which points are counted for the resolution."""

LARGEST_TARGET_M2 = 3.0
"""Largest area of a target that a LiDAR sees: 1.5 m wide and 2 m high."""


def azimuth_edges(points_lidar: Array) -> tuple[float, float] | None:
    """Centre and half width, radians, of the azimuths of points (N, 3) of whole scans, lidar frame.

    None if they cover 360 degrees.
    """
    azimuth = np.arctan2(points_lidar[:, 1], points_lidar[:, 0])
    # Bins of 0.1 degrees: finer than EDGE_RAD, and far cheaper than sorting every point.
    bins = np.unique(((azimuth + math.pi) * (1800.0 / math.pi)).astype(np.int64))
    gaps = np.diff(np.append(bins, bins[0] + 3600))
    widest = int(gaps.argmax())
    gap = float(gaps[widest]) * math.pi / 1800.0
    if gap < FULL_TURN_GAP_RAD:
        return None
    half = math.pi - 0.5 * gap
    first = bins[(widest + 1) % len(bins)] * math.pi / 1800.0 - math.pi
    return float(first) + half, half


def is_cut(target_lidar: Array, edges: tuple[float, float] | None, points: int) -> bool:
    """Whether the edge of the field of view may cut the target's points (N, 3) off, lidar frame.

    `edges` are of `azimuth_edges`, `points` is the number of points of the whole scan.
    """
    if edges is None or len(target_lidar) > 0.5 * points:
        # A scan of little else than the target does not show the field of view.
        return False
    centre, half = edges
    azimuth = np.arctan2(target_lidar[:, 1], target_lidar[:, 0])
    off = np.abs((azimuth - centre + math.pi) % (2.0 * math.pi) - math.pi)
    return bool(off.max() > half - EDGE_RAD)


@dataclass(frozen=True)
class FieldOfView:
    """Azimuths and resolution of a LiDAR, estimated from some of its scans.

    Attributes:
        edges: (centre, half width) of its azimuths in radians, or None if it covers 360 degrees.
        density: highest number of points per steradian.
    """

    edges: tuple[float, float] | None
    density: float

    @classmethod
    def of(cls, clouds: Sequence[Array]) -> FieldOfView:
        """Estimates it from the points (N, 3) of some scans, lidar frame."""
        directions = [c / np.maximum(np.linalg.norm(c, axis=1), 1e-9)[:, None] for c in clouds]
        density = 0.0
        for d in directions:
            azimuth = np.floor(np.degrees(np.arctan2(d[:, 1], d[:, 0])) / CELL_DEG)
            elevation = np.floor(np.degrees(np.arcsin(np.clip(d[:, 2], -1.0, 1.0))) / CELL_DEG)
            cells = azimuth * 1000.0 + elevation
            density = max(density, float(np.unique(cells, return_counts=True)[1].max()))
        return cls(azimuth_edges(np.concatenate(clouds)), density / math.radians(CELL_DEG) ** 2)

    def may_see(self, towards: Array, margin_m: Array, min_points: int) -> BoolArray:
        """(m,) whether an object as large as a target may have `min_points` points.

        It is within `margin_m` (m,) of the middles `towards` (m, 3) of a region, metres, lidar
        frame.
        """
        range_m = np.linalg.norm(towards, axis=1)
        nearest = np.maximum(range_m - margin_m, 0.1)
        enough = self.density * LARGEST_TARGET_M2 / nearest**2 >= min_points
        if self.edges is None:
            return np.asarray(enough)
        centre, half = self.edges
        off = np.arctan2(towards[:, 1], towards[:, 0]) - centre
        off = np.abs((off + math.pi) % (2.0 * math.pi) - math.pi)
        widened = np.where(range_m > margin_m, np.arcsin(np.minimum(margin_m / range_m, 1.0)), 4.0)
        return np.asarray(enough & (off <= half + widened))
