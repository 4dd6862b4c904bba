"""The field of view of a LiDAR, read off some of its scans."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caliv_graph.products import Array, BoolArray, Side
from caliv_graph.targets.cloud.beams import elevations

EDGE_RAD = math.radians(0.4)
"""A target within this azimuth of the edge of the field of view may be cut off by it."""

FULL_TURN_GAP_RAD = math.radians(20.0)
"""A LiDAR whose azimuths leave no gap larger than this covers 360 degrees: it has no edge."""

AZIMUTH_BINS = 3600
"""Bins of azimuth of the full circle in which returns are looked for."""

CELL_DEG = 5.0
"""Cells of direction in which points are counted for the resolution."""

LARGEST_TARGET_M2 = 3.0
"""Largest area of a target that a LiDAR sees: 1.5 m wide and 2 m high."""


EDGE_ROWS = 0.6
"""A target whose highest or lowest row is within this part of the row spacing of the highest or
lowest channel is cut: it is in that channel, and the next one is not."""

ELEVATION_BLUR_RAD = math.radians(0.05)
"""Spread of the elevations of one channel: its beams do not begin in the LiDAR's origin."""

SCANS_OF_AN_EDGE = 5
"""From this number of scans on, the outermost elevation of the scans is left out: one stray return
shall not end the field of view where no channel is."""

MOST_OF_A_SCAN = 0.5
"""A scan of little else than the target, this part of its points, does not show the edges."""


def _bins_of_azimuth(points_lidar: Array) -> BoolArray:
    """(3600,) which bins of azimuth, from -pi on, have points (N, 3), lidar frame.

    Bins of 0.1 degrees: finer than EDGE_RAD, and far cheaper than sorting every point.
    """
    x, y = points_lidar[:, :2].T.copy()  # numpy is fast along a row
    seen = np.zeros(AZIMUTH_BINS + 1, dtype=np.bool_)
    seen[((np.arctan2(y, x) + math.pi) * (1800.0 / math.pi)).astype(np.int64)] = True
    seen[0] |= seen[AZIMUTH_BINS]  # pi is -pi
    return seen[:AZIMUTH_BINS]


def _azimuth_edges(seen: BoolArray) -> tuple[float, float] | None:
    """Centre and half width, radians, of the bins of azimuth in view; None if they go round."""
    bins = np.flatnonzero(seen)
    gaps = np.diff(np.append(bins, bins[:1] + AZIMUTH_BINS))
    widest = int(gaps.argmax())
    gap = float(gaps[widest]) * math.pi / 1800.0
    if gap < FULL_TURN_GAP_RAD:
        return None
    half = math.pi - 0.5 * gap
    first = bins[(widest + 1) % len(bins)] * math.pi / 1800.0 - math.pi
    return float(first) + half, half


def azimuth_edges(points_lidar: Array) -> tuple[float, float] | None:
    """Centre and half width, radians, of the azimuths of points (N, 3) of whole scans, lidar frame.

    None if they cover 360 degrees.
    """
    return _azimuth_edges(_bins_of_azimuth(points_lidar))


class SeenEdges:
    """The edges of a LiDAR's field of view, as its scans show them one after the other."""

    def __init__(self) -> None:
        """No scan yet: no edge is known."""
        self._azimuths = np.zeros(AZIMUTH_BINS, dtype=np.bool_)
        self._lowest: list[float] = []
        self._highest: list[float] = []

    def add(self, points_lidar: Array, scan_elevations: Array) -> None:
        """Another scan: its points (N, 3), lidar frame, and their `beams.elevations` (N,)."""
        self._azimuths |= _bins_of_azimuth(points_lidar)
        self._lowest.append(float(scan_elevations.min()))
        self._highest.append(float(scan_elevations.max()))

    def cuts(self, target_lidar: Array, row_rad: float) -> frozenset[Side]:
        """The sides on which the edge may cut the target's points (n, 3), lidar frame, off.

        They are as measured, without motion compensation; rows of beams are `row_rad` apart. What
        no beam ever reached is taken for outside: below an empty sky the highest beam that returned
        is the edge.
        """
        if not self._lowest:
            return frozenset()
        out: set[Side] = set()
        edges = _azimuth_edges(self._azimuths)
        if edges is not None:
            centre, half = edges
            azimuth = np.arctan2(target_lidar[:, 1], target_lidar[:, 0])
            off = (azimuth - centre + math.pi) % (2.0 * math.pi) - math.pi
            if off.max() > half - EDGE_RAD:
                out.add("left")
            if off.min() < EDGE_RAD - half:
                out.add("right")
        elevation = elevations(target_lidar)
        outermost = 1 if len(self._lowest) >= SCANS_OF_AN_EDGE else 0
        within = EDGE_ROWS * row_rad + ELEVATION_BLUR_RAD
        if elevation.max() > sorted(self._highest)[-1 - outermost] - within:
            out.add("top")
        if elevation.min() < sorted(self._lowest)[outermost] + within:
            out.add("bottom")
        return frozenset(out)


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
