"""Whether the points of a sweep were moved to one time before they were recorded.

Some drivers and datasets deskew clouds and leave the times of the points in them. Where the end of
a sweep meets its beginning, on a wall or by a second look of a rosette, a LiDAR sees the same
surface at two times: measured points are apart there by the motion in between, deskewed points are
not.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from caliv_graph.geometry.se3 import cross
from caliv_graph.products import Array, IntArray
from caliv_graph.structure.patches import DrivePatches

NEAR_M = 1.5
"""Between the middles of two patches that are pieces of one surface."""

ALIKE_COS = float(np.cos(np.radians(15.0)))
"""Of the angle between their normals."""

LEAST_M = 0.03
"""Motion along the normal, from which two patches tell: their noise, and what a guess 3 degrees off
makes of the motion along a wall, are below."""

BEYOND_M = 0.15
"""How far two patches may be from both answers, and half of the motion: else they are of two
surfaces."""

LEAST_SCANS = 5
"""Scans that have to tell."""

CELL_M, MOST_OFTEN = 0.5, 0.1
"""What is within half a metre of one place in the LiDAR's frame in more than this part of its scans
is the vehicle itself, which does not move within a sweep."""

GUESS_SHARE = 0.1
"""1 sigma of the share beside its scatter: the guess of the LiDAR, walls that are no planes."""

SIGMAS = 5.0
"""Of the share from 1, from which points count as deskewed; and 3 of them from 0 at most."""


@dataclass(frozen=True)
class MotionLeft:
    """How much of the motion within sweeps the points of a LiDAR have.

    Attributes:
        share: 1 as they were measured, 0 where they were deskewed.
        sigma: of it.
        scans: that tell.
    """

    share: float
    sigma: float
    scans: int

    @property
    def deskewed(self) -> bool:
        """Whether the points were deskewed."""
        near = abs(self.share) < 3.0 * self.sigma
        return near and 1.0 - self.share > SIGMAS * self.sigma

    @property
    def measured(self) -> bool:
        """Whether the points are as they were measured."""
        near = abs(self.share - 1.0) < 3.0 * self.sigma
        return near and self.share > SIGMAS * self.sigma


def motion_left(drives: Sequence[DrivePatches]) -> dict[str, MotionLeft]:
    """Of each LiDAR that sees surfaces at two times of its sweeps, by its name.

    With the offset r of two patches along their normal, and the motion d along it between their
    times, r = -share d; least squares, with the scatter from scan to scan.
    """
    found: dict[str, list[tuple[Array, Array]]] = {}
    for of in drives:
        if of.swept is None:
            continue
        for k, name in enumerate(of.lidars):
            scans = np.flatnonzero(of.scan_lidar == k).tolist()
            found.setdefault(name, []).extend(_without_body([_seen_twice(of, s) for s in scans]))
    out = {}
    for name, told in found.items():
        if len(told) < LEAST_SCANS:
            continue
        squares = np.array([float(d @ d) for _, d in told])
        products = np.array([-float(r @ d) for r, d in told])
        share = float(products.sum() / squares.sum())
        scatter = float(np.linalg.norm(products - share * squares) / squares.sum())
        out[name] = MotionLeft(share, float(np.hypot(scatter, GUESS_SHARE)), len(told))
    return out


def _without_body(scans: Sequence[tuple[Array, Array, Array]]) -> list[tuple[Array, Array]]:
    """Offsets and motion of the scans that tell, without pairs that are on the vehicle.

    Of scans of one LiDAR, with places (n, 3) last.
    """
    cells = [np.rint(at / CELL_M).astype(np.int64) for _, _, at in scans]
    often = Counter(cell for of in cells for cell in {tuple(row) for row in of.tolist()})
    out = []
    for (offset, motion, _), of in zip(scans, cells, strict=True):
        rare = [often[tuple(row)] <= max(MOST_OFTEN * len(scans), 1.0) for row in of.tolist()]
        kept = np.array(rare, dtype=bool)
        if kept.any():
            out.append((offset[kept], motion[kept]))
    return out


def _of_scan(of: DrivePatches, scan: int) -> IntArray:
    """The patches of a scan (n,)."""
    begin, end = np.searchsorted(of.scan, [scan, scan + 1])
    return np.arange(begin, end)


def _seen_twice(of: DrivePatches, scan: int) -> tuple[Array, Array, Array]:
    """Offsets and motion (n,) of what a scan shows at two times, and where (n, 3); metres."""
    none = np.zeros(0), np.zeros(0), np.zeros((0, 3))
    assert of.swept is not None
    rows = _of_scan(of, scan)
    times_s = of.time_s[rows]
    if len(rows) < 2 or not np.ptp(times_s):
        return none
    middle_s = 0.5 * (times_s.min() + times_s.max())
    early, late = rows[times_s < middle_s], rows[times_s >= middle_s]
    centres = of.centres_lidar
    near = cKDTree(centres[early]).query_ball_tree(cKDTree(centres[late]), NEAR_M)
    a = np.repeat(early, [len(n) for n in near])
    b = late[np.array([j for n in near for j in n], dtype=np.int64)]
    apart_s = of.time_s[b] - of.time_s[a]
    normals = of.normal_lidar
    alike = np.einsum("ni,ni->n", normals[a], normals[b]) > ALIKE_COS
    twice = alike & (apart_s > 0.5 * np.ptp(times_s))
    a, b, apart_s = a[twice], b[twice], apart_s[twice]
    if not len(a):
        return none
    normal = normals[a] + normals[b]
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    twist = 0.5 * (of.swept.twist_lidar[a] + of.swept.twist_lidar[b])
    at = 0.5 * (centres[a] + centres[b])
    moved = (twist[:, 3:] + cross(twist[:, :3], at)) * apart_s[:, None]
    motion = np.einsum("ni,ni->n", moved, normal)
    offset = np.einsum("ni,ni->n", centres[b] - centres[a], normal)
    one = np.abs(offset + 0.5 * motion) < 0.5 * np.abs(motion) + BEYOND_M
    tells = one & (np.abs(motion) > LEAST_M)
    return offset[tells], motion[tells], at[tells]
