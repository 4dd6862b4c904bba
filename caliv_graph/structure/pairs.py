"""Pairs of patches of different scans that may lie on one surface, at given extrinsics."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.trajectory.select import VehicleTrajectory

SOURCES = 3000
"""Patches that are compared, of all scans together."""

PAIRS = 8
"""Scans that each of them is compared with."""

TARGETS_PER_SCAN = 400
"""Patches of a scan that others are compared with."""

NEIGHBOUR_M = 0.5
"""Patches of a scan are this far apart, and so is the nearest one along a surface."""

AGREES_M = 0.1
AGREES_RAD = 0.15
"""Residuals of patches of one surface, once it is aligned."""

NORMAL_LEVER_M = 3.0
"""A difference of normals counts as the distance that it makes at this arm, in the search."""


@dataclass(frozen=True)
class PatchCloud:
    """Patches of all drives; n patches, s scans.

    Attributes:
        centre: (n, 3) metres, lidar frame at the patch's own time.
        normal: (n, 3).
        R: (n, 3, 3) R_map_vehicle at the patch's own time.
        t: (n, 3) t_map_vehicle.
        lidar: (n,) index of the LiDAR.
        scan: (n,) index of the scan, of all drives.
        sources: patches that are compared.
        target_scans: scans that have patches.
        targets: per scan its patches that others are compared with.
        trees: per scan these in six dimensions, place and normal.
        R_scan: (s, 3, 3) R_map_vehicle at its stamp; t_scan: (s, 3).
        scan_lidar: (s,) its LiDAR; scan_drive: (s,) its drive.
    """

    centre: Array
    normal: Array
    R: Array
    t: Array
    lidar: IntArray
    scan: IntArray
    sources: IntArray
    target_scans: IntArray
    targets: Mapping[int, IntArray]
    trees: Mapping[int, cKDTree]
    R_scan: Array
    t_scan: Array
    scan_lidar: IntArray
    scan_drive: IntArray

    @property
    def reach_m(self) -> float:
        """Median range of the patches."""
        return float(np.median(np.linalg.norm(self.centre, axis=1))) if len(self.centre) else 0.0

    def per_lidar(self, matches: Matches, lidars: int) -> IntArray:
        """(lidars,) number of matches with a patch of each LiDAR at either end."""
        of_i, of_j = self.lidar[matches.i], self.lidar[matches.j]
        count = np.bincount(of_i, minlength=lidars)
        return np.asarray(count + np.bincount(of_j[of_j != of_i], minlength=lidars))


def gathered(
    patches: Sequence[DrivePatches],
    trajectories: Sequence[VehicleTrajectory],
    names: Sequence[str],
    rng: np.random.Generator,
) -> PatchCloud:
    """All patches of these LiDARs at the vehicle's poses at their own times.

    Raises:
        TrajectoryError: a patch is from outside the span of its trajectory.
    """
    # Centre, normal, R, t, LiDAR, scan of every patch; R, t, LiDAR, drive of every scan.
    patch_rows = [(np.zeros((0, 3)), np.zeros((0, 3)), *_NO_POSES, _NONE, _NONE)]
    scan_rows = [(*_NO_POSES, _NONE, _NONE)]
    scans = 0
    for drive, (own, trajectory) in enumerate(zip(patches, trajectories, strict=True)):
        index = np.array([names.index(n) if n in names else -1 for n in own.lidars], np.int64)
        scan_lidar = index[own.scan_lidar]
        scan_rows.append(
            (*_poses_at(trajectory, own.stamps_ns), scan_lidar, np.full(len(scan_lidar), drive))
        )
        keep = scan_lidar[own.scan] >= 0
        scan = own.scan[keep]
        poses = _poses_at(trajectory, own.taken_ns[keep])
        patch_rows.append(
            (
                own.centres_lidar[keep],
                own.normal_lidar[keep],
                *poses,
                scan_lidar[scan],
                scan + scans,
            )
        )
        scans += len(scan_lidar)
    centre, normal, R, t, lidar, scan = map(np.concatenate, zip(*patch_rows, strict=True))
    R_scan, t_scan, scan_lidar, scan_drive = map(np.concatenate, zip(*scan_rows, strict=True))
    targets: dict[int, IntArray] = {}
    trees: dict[int, cKDTree] = {}
    ends = np.searchsorted(scan, np.arange(scans + 1))
    for s, (first, last) in enumerate(itertools.pairwise(ends.tolist())):
        if last > first:
            some = first + np.sort(rng.permutation(last - first)[:TARGETS_PER_SCAN])
            targets[s] = some
            trees[s] = cKDTree(np.hstack([centre[some], NORMAL_LEVER_M * normal[some]]))
    return PatchCloud(
        centre=centre,
        normal=normal,
        R=R,
        t=t,
        lidar=lidar,
        scan=scan,
        sources=np.sort(rng.permutation(len(centre))[:SOURCES]),
        target_scans=np.array(list(targets), dtype=np.int64),
        targets=targets,
        trees=trees,
        R_scan=R_scan,
        t_scan=t_scan,
        scan_lidar=scan_lidar,
        scan_drive=scan_drive,
    )


_NO_POSES = (np.zeros((0, 3, 3)), np.zeros((0, 3)))
_NONE: IntArray = np.zeros(0, dtype=np.int64)


def _poses_at(trajectory: VehicleTrajectory, stamps_ns: IntArray) -> tuple[Array, Array]:
    """The vehicle's poses, none for no stamps."""
    return trajectory.poses_at(stamps_ns) if len(stamps_ns) else _NO_POSES


@dataclass(frozen=True)
class Matches:
    """m pairs of patches: patch `i`, other patch `j`; q, m of i in the frame of j's LiDAR.

    Attributes:
        i: (m,); j: (m,).
        q: (m, 3) metres.
        m: (m, 3) unit.
        R: (m, 3, 3) rotation from the LiDAR of i to that of j.
        residual: (m,) metres, along the normal of j.
        turned: (m, 3) difference of the normals.
    """

    i: IntArray
    j: IntArray
    q: Array
    m: Array
    R: Array
    residual: Array
    turned: Array

    def part(self, keep: BoolArray) -> Matches:
        """Some of them."""
        return Matches(
            self.i[keep],
            self.j[keep],
            self.q[keep],
            self.m[keep],
            self.R[keep],
            self.residual[keep],
            self.turned[keep],
        )


class Pairs:
    """Which patch is compared with which scan. Pairs without a match are drawn anew."""

    def __init__(self, cloud: PatchCloud, rng: np.random.Generator) -> None:
        self._cloud = cloud
        self._rng = rng
        self._source = np.repeat(cloud.sources, PAIRS)
        self._scan = np.empty(len(self._source), dtype=np.int64)
        self._draw(np.ones(len(self._source), dtype=bool))

    def _draw(self, which: BoolArray) -> None:
        """Draws other scans of the drive for some of the pairs."""
        cloud = self._cloud
        of_drive = cloud.scan_drive[cloud.target_scans]
        drive = cloud.scan_drive[cloud.scan[self._source]]
        for d in np.unique(of_drive).tolist():
            mine = which & (drive == d)
            self._scan[mine] = self._rng.choice(cloud.target_scans[of_drive == d], mine.sum())

    def matched(self, poses: Sequence[gtsam.Pose3], gate: Array) -> Matches:
        """Matches within a gate (metres, radians); the other pairs are drawn anew for later."""
        cloud = self._cloud
        R, t = _lidar_poses(cloud.R, cloud.t, cloud.lidar, poses)
        R_scan, t_scan = _lidar_poses(cloud.R_scan, cloud.t_scan, cloud.scan_lidar, poses)
        some = cloud.sources
        of_source = np.einsum("nij,nj->ni", R[some], cloud.centre[some]) + t[some]
        centre = np.repeat(of_source, PAIRS, axis=0)
        of_source = np.einsum("nij,nj->ni", R[some], cloud.normal[some])
        normal = np.repeat(of_source, PAIRS, axis=0)
        other = np.full(len(self._source), -1)
        order = np.argsort(self._scan, kind="stable")
        numbers, count = np.unique(self._scan, return_counts=True)
        ends = np.cumsum(count)
        reach_m = float(np.hypot(gate[0], NEIGHBOUR_M) + NORMAL_LEVER_M * gate[1])
        for s, last, n in zip(numbers.tolist(), ends.tolist(), count.tolist(), strict=True):
            of_scan = order[last - n : last]
            there = (centre[of_scan] - t_scan[s]) @ R_scan[s]
            at = np.hstack([there, NORMAL_LEVER_M * normal[of_scan] @ R_scan[s]])
            apart, near = cloud.trees[s].query(at, distance_upper_bound=reach_m)
            found = np.isfinite(apart)
            other[of_scan[found]] = cloud.targets[s][np.asarray(near)[found]]
        other[cloud.scan[self._source] == self._scan] = -1
        hit = other >= 0
        i, j = self._source[hit], other[hit]
        back = R[j].transpose(0, 2, 1)
        q = np.einsum("nij,nj->ni", back, centre[hit] - t[j])
        m = np.einsum("nij,nj->ni", back, normal[hit])
        off = q - cloud.centre[j]
        residual = np.einsum("ni,ni->n", cloud.normal[j], off)
        turned = m - cloud.normal[j]
        along2 = np.einsum("ni,ni->n", off, off) - residual**2
        good = (np.abs(residual) < gate[0]) & (np.linalg.norm(turned, axis=1) < gate[1])
        good &= along2 < NEIGHBOUR_M**2 + gate[0] ** 2
        hit[hit] = good
        self._draw(~hit)
        return Matches(i, j, q, m, back @ R[i], residual, turned).part(good)

    def agreement(self, poses: Sequence[gtsam.Pose3], widest: Array) -> tuple[float, Matches]:
        """Part of the matches within the widest gate that agree, and these."""
        self._draw(np.ones(len(self._source), dtype=bool))
        matches = self.matched(poses, widest)
        agrees = np.abs(matches.residual) < AGREES_M
        agrees &= np.linalg.norm(matches.turned, axis=1) < AGREES_RAD
        return float(agrees.sum() / max(len(agrees), 1)), matches.part(agrees)


def _lidar_poses(
    R: Array, t: Array, lidar: IntArray, poses: Sequence[gtsam.Pose3]
) -> tuple[Array, Array]:
    """R_map_lidar (n, 3, 3) and t_map_lidar (n, 3) of the vehicle's poses."""
    R_extrinsic, t_extrinsic = stack(poses)
    return R @ R_extrinsic[lidar], t + np.einsum("nij,nj->ni", R, t_extrinsic[lidar])
