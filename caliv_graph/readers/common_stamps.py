"""Stamps of LiDARs that were triggered together and differ by rounding alone.

Drivers that keep seconds as a floating-point number are off by up to 0.2 microseconds. Two poses of
the vehicle within a microsecond are one: as two they would be tied to each other by an IMU without
noise, and each would have a heave of its own.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from caliv_graph.products import IntArray, LidarScan, Recording
from caliv_graph.readers.forwarding import ForwardingRecording

MERGE_NS = 1_000
"""Stamps that are not farther apart share a pose: at 50 m/s a vehicle moves by 0.05 mm."""


def without_neighbours(stamps_ns: IntArray, least_ns: int) -> IntArray:
    """Of stamps (n,), ascending, those (m,) that are more than `least_ns` after the one before."""
    kept: list[int] = []
    for stamp in stamps_ns.tolist():
        if not kept or stamp - kept[-1] > least_ns:
            kept.append(stamp)
    return np.array(kept, dtype=np.int64)


def with_common_stamps(recording: Recording) -> Recording:
    """The recording; where stamps are within `MERGE_NS`, all have the first one.

    Of two clouds of one LiDAR that are so near, the first is kept.
    """
    own = {name: np.asarray(recording.scan_stamps_ns(name), np.int64) for name in recording.lidars}
    every = np.unique(np.concatenate([*own.values(), np.zeros(0, np.int64)]))
    common = without_neighbours(every, MERGE_NS)
    if len(common) == len(every):
        return recording
    taken = {}
    for name, stamps in own.items():
        firsts = common[np.searchsorted(common, stamps, "right") - 1]
        _, once = np.unique(firsts, return_index=True)
        taken[name] = dict(zip(firsts[once].tolist(), stamps[once].tolist(), strict=True))
    return _CommonStamps(recording, taken)


@dataclass(frozen=True)
class _CommonStamps(ForwardingRecording):
    """By LiDAR the recorded stamp of each cloud, by the stamp that it is given."""

    recorded_ns: Mapping[str, Mapping[int, int]]

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        """Stamps of the clouds of one LiDAR, ascending."""
        return list(self.recorded_ns[lidar])

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        """The clouds of one LiDAR in order of their stamps; see `Recording`."""
        recorded = self.recorded_ns[lidar]
        given = {old: new for new, old in recorded.items() if wanted is None or new in wanted}
        for scan in self.recording.scans(lidar, given):
            yield replace(scan, stamp_ns=given[scan.stamp_ns])
