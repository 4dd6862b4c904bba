"""Which way is up for a LiDAR whose mounting is unknown: the ground that it always stands above."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caliv_graph.geometry.se3 import skew
from caliv_graph.products import Array, IntArray
from caliv_graph.structure.planar import ScanPatches

SAME_RAD = math.radians(4.0)
SAME_M = 0.2
"""Flat patches whose normals and distances from the LiDAR differ by less are of one plane: a
patch's normal is good to 2 degrees, and roads have camber and waves."""

MIN_SCANS = 5
"""Scans that must show the plane. While the vehicle turns, only the ground keeps its place."""

SEEDS = 400
"""Patches about which planes are tried. Every tenth patch at least is of the ground."""

ROUNDS = 3
"""Of fitting and choosing again; the second changes a few patches at the border."""


@dataclass(frozen=True)
class Ground:
    """The ground below a LiDAR.

    Attributes:
        up_lidar: (3,) unit, lidar frame.
        height_m: of the LiDAR above it.
        scans: number of scans that show it.
    """

    up_lidar: Array
    height_m: float
    scans: int

    @property
    def R_level_lidar(self) -> Array:
        """(3, 3) turns up onto z by the shortest way; the yaw of its axes means nothing."""
        up = np.asarray(self.up_lidar)
        axis = np.cross(up, [0.0, 0.0, 1.0])
        cosine = float(up[2])
        if cosine < -1.0 + 1e-12:  # upside down: any horizontal axis will do
            return np.diag([1.0, -1.0, -1.0])
        K = skew(axis[None])[0]
        return np.asarray(np.eye(3) + K + K @ K / (1.0 + cosine))


def ground_below(scans: Sequence[ScanPatches]) -> Ground | None:
    """The plane that a LiDAR stands above in most scans; None if no `MIN_SCANS` show one.

    Args:
        scans: flat patches of scans from all over the drive, without any guess of the mounting.
    """
    normal = np.concatenate([np.zeros((0, 3)), *(scan.normal_lidar for scan in scans)])
    moments = np.concatenate([np.zeros((0, 4, 4)), *(scan.moments for scan in scans)])
    centre = moments[:, :3, 3] / moments[:, 3:, 3]
    distance = -np.einsum("ni,ni->n", normal, centre)
    scan_of = np.repeat(np.arange(len(scans)), [len(scan.time_s) for scan in scans])
    if not len(normal):
        return None
    seeds = np.random.default_rng(0).permutation(len(normal))[:SEEDS]
    best: IntArray = np.zeros(0, dtype=np.int64)
    most = (0, 0)
    for seed in seeds.tolist():
        members = _members(normal, distance, normal[seed], distance[seed])
        views = len(np.unique(scan_of[members])), len(members)
        if views > most:
            best, most = members, views
    for _ in range(ROUNDS):
        up = normal[best].mean(axis=0)
        up /= np.linalg.norm(up)
        best = _members(normal, distance, up, float(np.median(distance[best])))
    count = len(np.unique(scan_of[best]))
    if count < MIN_SCANS:
        return None
    up = normal[best].mean(axis=0)
    up /= np.linalg.norm(up)
    return Ground(up, float(np.median(-centre[best] @ up)), count)


def _members(normal: Array, distance: Array, up: Array, height_m: float) -> IntArray:
    """Indices of the patches of one plane."""
    near = (normal @ up > math.cos(SAME_RAD)) & (np.abs(distance - height_m) < SAME_M)
    return np.flatnonzero(near)
