"""Scans that were taken while the given poses of the vehicle paused.

Between two poses the trajectory is interpolated. Over a pause of seconds, of a filter without a
solution or a topic that stalled, that cuts curves by decimetres: half a metre in 3 s at 2 m/s on a
circle of 9 m, with the sigmas of the poses on both sides.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import IntArray, LidarScan, Recording
from caliv_graph.readers.common_stamps import MERGE_NS
from caliv_graph.readers.forwarding import ForwardingRecording

PAUSE_NS = 300_000_000
"""Shortest pause: at 1.5 m/s^2 across, interpolation cuts 17 mm."""

USUAL_STEPS = 3.0
"""Steps of usual length, the median, up to which there is no pause: some poses may be missing."""


def pauses_of(stamps_ns: IntArray) -> IntArray:
    """(k, 2) begin and end of the pauses between poses at stamps (n,), ascending."""
    if len(stamps_ns) < 3:
        return np.zeros((0, 2), dtype=np.int64)
    steps = np.diff(stamps_ns)
    long = np.flatnonzero(steps > max(PAUSE_NS, USUAL_STEPS * float(np.median(steps))))
    return np.stack([stamps_ns[long], stamps_ns[long + 1]], axis=1)


def without_pauses(recording: Recording, poses_ns: IntArray) -> tuple[Recording, str]:
    """The recording without the scans of the pauses between its poses; and a warning, or nothing.

    A scan at the pose before or after a pause stays.
    """
    pauses = pauses_of(np.asarray(poses_ns, np.int64))
    if not len(pauses):
        return recording, ""
    kept, lost = {}, 0
    for name in recording.lidars:
        stamps = np.asarray(recording.scan_stamps_ns(name), np.int64)
        after = np.searchsorted(pauses[:, 0] + MERGE_NS, stamps) - 1
        inside = (after >= 0) & (stamps < pauses[after, 1] - MERGE_NS)
        kept[name] = tuple(stamps[~inside].tolist())
        lost += int(inside.sum())
    if not lost:
        return recording, ""
    longest_s = float(np.diff(pauses).max()) / NANOSECONDS_PER_SECOND
    begin_s = pauses[int(np.diff(pauses).argmax()), 0] / NANOSECONDS_PER_SECOND
    many = f"{len(pauses)} times" if len(pauses) > 1 else "once"
    line = (
        f"{recording.name}: the vehicle's poses pause {many}, for {longest_s:.1f} s at most "
        f"(from {begin_s:.3f} s on): the {lost} scans within are left out"
    )
    return _Posed(recording, kept), line


@dataclass(frozen=True)
class _Posed(ForwardingRecording):
    """By LiDAR the stamps of the clouds that have a pose."""

    kept_ns: Mapping[str, tuple[int, ...]]

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        """Stamps of the clouds of one LiDAR, ascending."""
        return self.kept_ns[lidar]

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        """The clouds of one LiDAR in order of their stamps; see `Recording`."""
        kept = {stamp for stamp in self.kept_ns[lidar] if wanted is None or stamp in wanted}
        return self.recording.scans(lidar, kept)
