"""Whether the points of a sweep were moved to one time before they were recorded.

Some drivers and datasets deskew clouds and leave the times of the points in them. Where the end of
a sweep meets its beginning, on a wall or by a second look of a rosette, a LiDAR sees the same
surface at two times: measured points are apart there by the motion in between, deskewed points are
not. So is what moves with the vehicle, its own body or a car that follows: the surface has to stand
still from scan to scan.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from caliv_graph.common.statistics import MAD
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.geometry.se3 import cross, stack
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.trajectory.select import VehicleTrajectory

NEAR_M = 1.5
"""Between the middles of two patches that are pieces of one surface, along it."""

ALIKE_COS = float(np.cos(np.radians(15.0)))
"""Of the angle between their normals."""

LEAST_M, MOST_M = 0.03, 1.0
"""Motion along the normal with which two patches tell. Their noise, and what a guess 3 degrees off
makes of the motion along a wall, are below; beyond it is hard to say what is one surface."""

BEYOND_M = 0.15
"""How far two patches may be from both answers, and half of the motion: else they are of two
surfaces."""

WITHIN_S = 5.0
"""Between two scans that show the same surface."""

FARTHER, STILL = 5.0, 0.3
"""The vehicle has gone along the normal by so many times the motion within the sweep from the one
to the other, and the surface in the map by less than this part of that."""

MOST_PAIRS = 20
"""Of a scan that are looked at."""

LEAST_SCANS = 8
"""Scans that have to tell."""

NEAR_SHARE, AGREEING = 0.35, 0.75
"""How near to an answer the share of a scan is to count for it, and the part of the scans that has
to: what is no wall, in an open place, has any share."""

GUESS_SHARE = 0.1
"""1 sigma of the share beside its scatter: the guess of the LiDAR, walls that are no planes."""

MOST_SHARE, SIGMAS = 0.25, 5.0
"""How far the median may be from an answer; and it has to be so many sigmas from the other one."""


@dataclass(frozen=True)
class MotionLeft:
    """How much of the motion within sweeps the points of a LiDAR have.

    Attributes:
        share: 1 as they were measured, 0 where they were deskewed; the median of the scans.
        sigma: of it.
        scans: that tell.
        near_none: part of them that are near 0.
        near_all: part of them that are near 1.
    """

    share: float
    sigma: float
    scans: int
    near_none: float
    near_all: float

    @property
    def deskewed(self) -> bool:
        """Whether the points were deskewed."""
        near = abs(self.share) < MOST_SHARE and self.near_none >= AGREEING
        return near and 1.0 - self.share > SIGMAS * self.sigma

    @property
    def measured(self) -> bool:
        """Whether the points are as they were measured."""
        near = abs(self.share - 1.0) < MOST_SHARE and self.near_all >= AGREEING
        return near and self.share > SIGMAS * self.sigma


def motion_left(
    drives: Sequence[DrivePatches],
    trajectories: Sequence[VehicleTrajectory],
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
) -> dict[str, MotionLeft]:
    """Of each LiDAR that sees surfaces at two times of its sweeps, by its name.

    With the offset r of two patches along their normal, and the motion d along it between their
    times, r = -share d: least squares in each scan, and the median of the scans, of which one that
    sees something else has as much weight as any.

    Args:
        drives: patches as they were read, at least those of upright surfaces.
        trajectories: by the index of the drive.
        T_vehicle_lidar: guesses.

    Raises:
        TrajectoryError: a scan is outside the trajectory's span.
    """
    found: dict[str, list[float]] = {}
    for of in drives:
        if of.swept is None or not len(of.scan):
            continue
        seen = _Seen(of, trajectories[of.drive], T_vehicle_lidar)
        for scan, lidar in enumerate(of.scan_lidar.tolist()):
            offset, motion = seen.twice(scan)
            if len(offset):
                share = -float(offset @ motion) / float(motion @ motion)
                found.setdefault(of.lidars[lidar], []).append(share)
    out = {}
    for name, shares in found.items():
        if len(shares) < LEAST_SCANS:
            continue
        of_each = np.array(shares)
        median = float(np.median(of_each))
        scatter = MAD * float(np.median(np.abs(of_each - median)))
        out[name] = MotionLeft(
            share=median,
            sigma=float(np.hypot(1.25 * scatter / np.sqrt(len(shares)), GUESS_SHARE)),
            scans=len(shares),
            near_none=float(np.mean(np.abs(of_each) < NEAR_SHARE)),
            near_all=float(np.mean(np.abs(of_each - 1.0) < NEAR_SHARE)),
        )
    return out


class _Seen:
    """The patches of a drive, and where they are in the map by the guesses."""

    def __init__(
        self,
        patches: DrivePatches,
        trajectory: VehicleTrajectory,
        T_vehicle_lidar: Mapping[str, gtsam.Pose3],
    ) -> None:
        assert patches.swept is not None
        self._patches, self._twist = patches, patches.swept.twist_lidar
        self._centres = patches.centres_lidar
        R, t = trajectory.poses_at(patches.stamps_ns)
        R_guess, t_guess = stack([T_vehicle_lidar[name] for name in patches.lidars])
        self._at_map = t + np.einsum("nij,nj->ni", R, t_guess[patches.scan_lidar])
        self._R_map = R @ R_guess[patches.scan_lidar]
        scan = patches.scan
        self._normals_map = np.einsum("nij,nj->ni", self._R_map[scan], patches.normal_lidar)
        self._centres_map = self._at_map[scan] + np.einsum(
            "nij,nj->ni", self._R_map[scan], self._centres
        )
        self._tree = cKDTree(self._centres_map)

    def twice(self, scan: int) -> tuple[Array, Array]:
        """Offsets and motion (n,), metres, of what stands still and a scan shows at two times."""
        a, b = self._pairs(scan)
        normal = self._patches.normal_lidar[a] + self._patches.normal_lidar[b]
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-9)[:, None]
        at = 0.5 * (self._centres[a] + self._centres[b])
        twist = 0.5 * (self._twist[a] + self._twist[b])
        apart_s = (self._patches.time_s[b] - self._patches.time_s[a])[:, None]
        moved = (twist[:, 3:] + cross(twist[:, :3], at)) * apart_s
        between = self._centres[b] - self._centres[a]
        motion = np.einsum("ni,ni->n", moved, normal)
        offset = np.einsum("ni,ni->n", between, normal)
        along = np.linalg.norm(between - offset[:, None] * normal, axis=1)
        one = np.abs(offset + 0.5 * motion) < 0.5 * np.abs(motion) + BEYOND_M
        size = np.abs(motion)
        tells = one & (along < NEAR_M) & (size > LEAST_M) & (size < MOST_M)
        some = np.flatnonzero(tells)[:: max(np.count_nonzero(tells) // MOST_PAIRS, 1)]
        a, offset, motion = a[some], offset[some], motion[some]
        still = self._still(scan, a, np.abs(motion))
        return offset[still], motion[still]

    def _pairs(self, scan: int) -> tuple[IntArray, IntArray]:
        """Patches (n,) of a scan that are near and alike, and more than half a sweep apart."""
        begin, end = np.searchsorted(self._patches.scan, [scan, scan + 1])
        rows = np.arange(begin, end)
        none = np.zeros(0, np.int64)
        times_s = self._patches.time_s[rows]
        if len(rows) < 2 or not np.ptp(times_s):
            return none, none
        middle_s = 0.5 * (times_s.min() + times_s.max())
        early, late = rows[times_s < middle_s], rows[times_s >= middle_s]
        reach_m = float(np.hypot(NEAR_M, MOST_M + BEYOND_M))
        near = cKDTree(self._centres[early]).query_ball_tree(cKDTree(self._centres[late]), reach_m)
        a = np.repeat(early, [len(n) for n in near])
        b = late[np.array([j for n in near for j in n], dtype=np.int64)]
        normals = self._patches.normal_lidar
        alike = np.einsum("ni,ni->n", normals[a], normals[b]) > ALIKE_COS
        twice = alike & (self._patches.time_s[b] - self._patches.time_s[a] > 0.5 * np.ptp(times_s))
        return a[twice], b[twice]

    def _still(self, scan: int, rows: IntArray, motion_m: Array) -> BoolArray:
        """Whether another scan shows each of some patches (n,) of a scan at the same place.

        After the vehicle has gone much farther along its normal than in a sweep (n,).
        """
        stamps_ns = self._patches.stamps_ns
        out = np.zeros(len(rows), dtype=bool)
        for k, row in enumerate(rows.tolist()):
            normal, at = self._normals_map[row], self._centres_map[row]
            others = np.array(self._tree.query_ball_point(at, NEAR_M), dtype=np.int64)
            of = self._patches.scan[others]
            gone = np.abs((self._at_map[of] - self._at_map[scan]) @ normal)
            seconds = np.abs(stamps_ns[of] - stamps_ns[scan]) / NANOSECONDS_PER_SECOND
            alike = self._normals_map[others] @ normal > ALIKE_COS
            off = np.abs((self._centres_map[others] - at) @ normal)
            far = (gone > FARTHER * motion_m[k]) & (seconds < WITHIN_S)
            far &= self._patches.scan_lidar[of] == self._patches.scan_lidar[scan]
            out[k] = bool((alike & far & (off < STILL * gone)).any())
        return out
