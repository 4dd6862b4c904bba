"""Clouds without returns are counted, and said where they are many."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from caliv_graph.products import LidarScan, MotionData
from caliv_graph.readers.empty import CountedRecording


@dataclass(frozen=True)
class Clouds:
    """Clouds of one LiDAR, of which every `each`th has no point."""

    each: int
    name: str = "drive"

    @property
    def lidars(self) -> tuple[str, ...]:
        return ("front",)

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        return range(100)

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        for stamp in self.scan_stamps_ns(lidar):
            if wanted is None or stamp in wanted:
                yield LidarScan(lidar, stamp, np.ones((int(stamp % self.each > 0), 3)), "")

    def motion(self) -> MotionData:
        return MotionData(self.name)

    def warnings(self) -> Sequence[str]:
        return ("another",)


def test_clouds_without_returns_are_said_once_each() -> None:
    recording = CountedRecording(Clouds(2))
    for _ in range(2):
        assert len(list(recording.scans("front", set(range(80))))) == 80
    first, line = recording.warnings()
    assert first == "another"
    assert line.startswith("drive: 40 of 80 clouds of LiDAR 'front' that were read have no return")


@pytest.mark.parametrize("each", [50, 1000])
def test_a_few_of_them_are_not(each: int) -> None:
    recording = CountedRecording(Clouds(each))
    list(recording.scans("front"))
    assert recording.warnings() == ["another"]
