"""A recording that counts the clouds without returns: a driver that loses packets, or NaN alone."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, field

from caliv_graph.products import LidarScan
from caliv_graph.readers.forwarding import ForwardingRecording

LEAST = 3
LEAST_PART = 0.05
"""Clouds without a return, in number and as a part of those read, from which they are said: the
first after a start often has none."""


@dataclass(frozen=True)
class CountedRecording(ForwardingRecording):
    """Passes a recording on, and warns of LiDARs of which many clouds have no return."""

    _read: dict[str, dict[int, bool]] = field(default_factory=dict, init=False, repr=False)

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        """The clouds of one LiDAR in order of their stamps; see `Recording`."""
        empty = self._read.setdefault(lidar, {})
        for scan in self.recording.scans(lidar, wanted):
            empty[scan.stamp_ns] = not len(scan.points_lidar)
            yield scan

    def warnings(self) -> Sequence[str]:
        """Those of the recording, and a line for each LiDAR with such clouds."""
        lines = []
        for lidar, empty in self._read.items():
            count, of = sum(empty.values()), len(empty)
            if count >= max(LEAST, LEAST_PART * of):
                lines.append(
                    f"{self.name}: {count} of {of} clouds of LiDAR '{lidar}' that were read have "
                    "no return: no points, NaN alone, or all beyond min_range and max_range. Check "
                    "its driver and its network"
                )
        return [*self.recording.warnings(), *lines]
