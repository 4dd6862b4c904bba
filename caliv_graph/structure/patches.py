"""Patches of surface: what is kept of a scan.

The points of a scan that lie close together and on a plane are reduced to their moments. These are
sufficient for every later use, at any pose (`README.md`, section 2), so that no point is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import Array, BoolArray, IntArray


@dataclass(frozen=True)
class DrivePatches:
    """Patches of the scans of one drive; N patches, M scans.

    The points of a patch were taken within milliseconds of each other; they are moved to the mean
    of their times, so that motion compensation is exact at any extrinsic.

    Attributes:
        drive: index of the drive.
        lidars: names of the LiDARs.
        stamps_ns: (M,) stamp of each scan, ascending by scan within a LiDAR.
        scan_lidar: (M,) index into `lidars`.
        scan: (N,) index of the scan, ascending.
        time_s: (N,) seconds after the stamp of the scan at which the points were taken.
        moments: (N, 4, 4) sum of h h^T over the points, h = (p, 1), p in metres, lidar frame as of
            the patch's own time. Element (3, 3) is the number of points.
        normal_lidar: (N, 3) unit normal towards the LiDAR.
        scatter_m: (N,) standard deviation of the points along the normal, unbiased.
    """

    drive: int
    lidars: tuple[str, ...]
    stamps_ns: IntArray
    scan_lidar: IntArray
    scan: IntArray
    time_s: Array
    moments: Array
    normal_lidar: Array
    scatter_m: Array

    def part(self, keep: BoolArray) -> DrivePatches:
        """Some of the patches (N,), of the same scans."""
        return replace(
            self,
            scan=self.scan[keep],
            time_s=self.time_s[keep],
            moments=self.moments[keep],
            normal_lidar=self.normal_lidar[keep],
            scatter_m=self.scatter_m[keep],
        )

    @property
    def points(self) -> Array:
        """(N,) number of points."""
        return self.moments[:, 3, 3]

    @property
    def taken_ns(self) -> IntArray:
        """(N,) stamp at which the points were taken."""
        offsets = np.round(NANOSECONDS_PER_SECOND * self.time_s).astype(np.int64)
        return np.asarray(self.stamps_ns[self.scan] + offsets)

    @property
    def centres_lidar(self) -> Array:
        """(N, 3) centroids, metres, lidar frame as of the patch's own time."""
        return self.moments[:, :3, 3] / self.moments[:, 3, 3, None]
