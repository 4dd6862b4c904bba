"""A recording whose clouds are as of their stamps: they were deskewed before they were recorded."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, replace

from caliv_graph.config.model import Config
from caliv_graph.products import LidarScan, Recording
from caliv_graph.readers.forwarding import ForwardingRecording


def without_times(recordings: Sequence[Recording], config: Config) -> list[Recording]:
    """Drives without the times of the points of LiDARs whose clouds the config calls deskewed."""
    deskewed = frozenset(name for name, of in config.lidars.items() if of.deskewed is True)
    return [WithoutTimes(of, deskewed) if deskewed else of for of in recordings]


@dataclass(frozen=True)
class WithoutTimes(ForwardingRecording):
    """Passes a recording on, without the times of the points of some LiDARs."""

    deskewed: frozenset[str]

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        """The clouds of one LiDAR in order of their stamps; see `Recording`."""
        for scan in self.recording.scans(lidar, wanted):
            yield replace(scan, point_times_s=None) if lidar in self.deskewed else scan
