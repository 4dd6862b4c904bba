"""Scans from one place: their beams fall alike, so that they repeat their own errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, IntArray
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.prior import PosePrior
from caliv_graph.trajectory.imu import log_so3

SAME_VIEW_M = 0.02
SAME_VIEW_RAD = 1e-3
"""Scans from this near see the same: beams 20 mm apart fall on the same joints, and at 20 m a
milliradian is as much."""


@dataclass(frozen=True)
class Views:
    """Which scans of a LiDAR are from one place.

    Attributes:
        of_scan: (S,) number of the view of each scan; scans of two LiDARs never share one.
        count: (S,) number of scans of the view of each, itself included.
    """

    of_scan: IntArray
    count: IntArray

    @staticmethod
    def numbered(of_scan: IntArray) -> Views:
        """From the number of the view of each scan (S,)."""
        _, number, count = np.unique(of_scan, return_inverse=True, return_counts=True)
        return Views(number.ravel(), count[number.ravel()])


def views_of(patches: DrivePatches, pose_of_scan: IntArray, prior: PosePrior) -> Views:
    """The views of the scans of a drive: each scan belongs to the last view if it is still near.

    Args:
        patches: of the drive, S scans.
        pose_of_scan: (S,) index of the pose of each scan.
        prior: poses that are good to centimetres over the drive, and far better in a standstill.
    """
    R, t = stack(prior.T_map_vehicle)
    turns = SAME_VIEW_M / SAME_VIEW_RAD * log_so3(np.swapaxes(R[:1], 1, 2) @ R)
    places = np.concatenate([t, turns], axis=1)[pose_of_scan]
    of_scan = np.zeros(len(places), dtype=np.int64)
    last = -1
    for lidar in range(len(patches.lidars)):
        first: Array | None = None
        for i in np.flatnonzero(patches.scan_lidar == lidar).tolist():
            if first is None or np.linalg.norm(places[i] - first) > SAME_VIEW_M:
                first, last = places[i], last + 1
            of_scan[i] = last
    return Views.numbered(of_scan)
