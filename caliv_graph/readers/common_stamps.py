"""Stamps of LiDARs that are triggered together, or come to within milliseconds of each other.

Drivers that keep seconds as a floating-point number are off by up to 0.2 microseconds; LiDARs that
are synchronised, by 10 to 100; and free ones pass each other. Two poses of the vehicle so near are
one: as two they are tied to each other by an IMU that in this time has next to no noise, and each
has a heave of its own. At 50 microseconds they are known to each other 1e8 times as well as on the
map, more than double precision holds (`trajectory/README.md`, section 1).
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import IntArray, LidarScan, Recording
from caliv_graph.readers.forwarding import ForwardingRecording

MERGE_NS = 1_000
"""Stamps that are not farther apart are the same: at 50 m/s a vehicle moves by 0.05 mm."""

COMMON_NS = 5_000_000
"""Stamps that are not farther apart share a pose where an IMU or wheels tell the motion between
them: the times of the points count from the common stamp, and the points are moved by it, as within
a sweep. Of given poses each cloud has its own."""


def without_neighbours(stamps_ns: IntArray, least_ns: int) -> IntArray:
    """Of stamps (n,), ascending, those (m,) that are more than `least_ns` after the one before."""
    kept: list[int] = []
    for stamp in stamps_ns.tolist():
        if not kept or stamp - kept[-1] > least_ns:
            kept.append(stamp)
    return np.array(kept, dtype=np.int64)


def with_common_stamps(recording: Recording, within_ns: int) -> Recording:
    """The recording; clouds whose stamps are within `within_ns` have the first of these stamps.

    The times of their points are as before. At most one cloud of each LiDAR has a stamp: of two
    within `MERGE_NS` of each other the first is kept, others begin a stamp of their own.
    """
    own = {name: recording.scan_stamps_ns(name) for name in recording.lidars}
    events = sorted((stamp, name) for name, stamps in own.items() for stamp in stamps)
    taken: dict[str, dict[int, int]] = {name: {} for name in own}
    first: int | None = None
    seen, last = set[str](), dict[str, int]()
    for stamp, name in events:
        if name in last and stamp - last[name] <= MERGE_NS:
            continue
        if first is None or stamp - first > within_ns or name in seen:
            first, seen = stamp, set()
        taken[name][first] = last[name] = stamp
        seen.add(name)
    if all(list(taken[name]) == list(stamps) for name, stamps in own.items()):
        return recording
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
            yield _restamped(scan, given[scan.stamp_ns])


def _restamped(scan: LidarScan, stamp_ns: int) -> LidarScan:
    """A cloud with another stamp, its points as of the same times."""
    later_ns = scan.stamp_ns - stamp_ns
    if later_ns <= MERGE_NS:
        return replace(scan, stamp_ns=stamp_ns)
    times_s = scan.point_times_s
    if times_s is None:
        times_s = np.zeros(len(scan.points_lidar))
    times_s = times_s + later_ns / NANOSECONDS_PER_SECOND
    return replace(scan, stamp_ns=stamp_ns, point_times_s=times_s)
