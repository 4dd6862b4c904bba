"""A recording that keeps a few of the clouds that were read from it, for pictures."""

from __future__ import annotations

import math
from collections.abc import Container, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from caliv_graph.products import IntArray, LidarScan
from caliv_graph.readers.forwarding import ForwardingRecording

SCANS = 12
"""Of one LiDAR over a drive: enough to see whether a wall appears once or twice."""

POINTS = 1500
"""Of one scan."""

CELL_M = 0.25
"""Of the grid for thinning: most points lie on the ground near the vehicle."""

RANGE_M = 40.0
"""Farther points would make the picture small."""


@dataclass(frozen=True)
class SampledRecording(ForwardingRecording):
    """Passes a recording on, and keeps `SCANS` clouds of `POINTS` points of each LiDAR."""

    _kept: dict[tuple[str, int], LidarScan] = field(default_factory=dict, init=False, repr=False)

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        """The clouds of one LiDAR in order of their stamps; see `Recording`."""
        stamps = self.scan_stamps_ns(lidar)
        begin, end = (stamps[0], stamps[-1]) if len(stamps) else (0, 0)
        for scan in self.recording.scans(lidar, wanted):
            # The first cloud that is read of each twelfth of the drive.
            part = min(SCANS * (scan.stamp_ns - begin) // max(end - begin, 1), SCANS - 1)
            if (lidar, part) not in self._kept:
                self._kept[lidar, part] = thinned(scan)
            yield scan

    def kept(self) -> tuple[LidarScan, ...]:
        """The thinned clouds, by LiDAR and stamp."""
        return tuple(self._kept[key] for key in sorted(self._kept))


def thinned(
    scan: LidarScan, most: int = POINTS, cell_m: float = CELL_M, range_m: float = RANGE_M
) -> LidarScan:
    """At most `most` points of a cloud, one per cell of a grid, with their times.

    The same cloud gives the same points.
    """
    near = np.flatnonzero(np.linalg.norm(scan.points_lidar, axis=1) <= range_m)
    # One number per cell, for rows are slow to compare. The radius bounds them.
    x, y, z = np.floor(scan.points_lidar[near] / cell_m).astype(np.int64).T
    side = 2 * (math.ceil(range_m / cell_m) + 1)
    _, first = np.unique((x * side + y) * side + z, return_index=True)
    some: IntArray = near[np.sort(first)]
    if len(some) > most:
        some = some[np.sort(np.random.default_rng(0).choice(len(some), most, replace=False))]
    times = scan.point_times_s
    return replace(
        scan,
        points_lidar=scan.points_lidar[some],
        point_times_s=None if times is None else times[some],
    )
