"""A recording that passes another one on: the base of those that change a part of it."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass

from caliv_graph.products import LidarScan, MotionData, Recording


@dataclass(frozen=True)
class ForwardingRecording:
    """Answers as another recording does (`products.Recording`)."""

    recording: Recording

    @property
    def name(self) -> str:
        """The name in messages: the path."""
        return self.recording.name

    @property
    def lidars(self) -> tuple[str, ...]:
        """LiDARs of the config, in the config's order."""
        return self.recording.lidars

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        """Stamps of the clouds of one LiDAR, ascending, without reading a cloud."""
        return self.recording.scan_stamps_ns(lidar)

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        """The clouds of one LiDAR in order of their stamps; see `Recording`."""
        return self.recording.scans(lidar, wanted)

    def motion(self) -> MotionData:
        """The motion data of the recording, read in one pass."""
        return self.recording.motion()

    def warnings(self) -> Sequence[str]:
        """What was left out so far and why, one line each."""
        return self.recording.warnings()
