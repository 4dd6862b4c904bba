"""Scans within pauses of the given poses are left out, and the user is told."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence

import numpy as np
import pytest

from caliv_graph.products import LidarScan, MotionData
from caliv_graph.readers.pose_pauses import pauses_of, without_pauses

MS = 1_000_000


class Scans:
    """Two LiDARs, 10 Hz for 10 s, the second 30 ms later."""

    name = "drive"
    lidars = ("front", "rear")

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        return [100 * MS * k + 30 * MS * (lidar == "rear") for k in range(101)]

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        for stamp in self.scan_stamps_ns(lidar):
            if wanted is None or stamp in wanted:
                yield LidarScan(lidar, stamp, np.zeros((1, 3)), "scan")

    def motion(self) -> MotionData:
        return MotionData("drive")

    def warnings(self) -> Sequence[str]:
        return ()


def poses_without(*pauses_ms: tuple[int, int], step_ms: int = 20) -> np.ndarray:
    at = np.arange(0, 10_001, step_ms)
    for begin, end in pauses_ms:
        at = at[(at <= begin) | (at >= end)]
    return at * MS


def test_a_pause_is_longer_than_what_is_usual() -> None:
    assert len(pauses_of(poses_without())) == 0
    # 0.2 s of 50 Hz are bridged; 3 s are not.
    found = pauses_of(poses_without((2000, 2200), (4000, 7000)))
    assert (found // MS).tolist() == [[4000, 7000]]
    # Poses every second pause where three of them are missing.
    found = pauses_of(poses_without((2000, 4000), (5000, 9000), step_ms=1000))
    assert (found // MS).tolist() == [[5000, 9000]]
    assert len(pauses_of(np.array([0, 10**10]))) == 0


def test_scans_of_a_pause_are_left_out_and_told() -> None:
    recording, line = without_pauses(Scans(), poses_without((4000, 7000)))
    for lidar in ("front", "rear"):
        left = np.array(recording.scan_stamps_ns(lidar)) // MS
        assert not ((left > 4000) & (left < 7000)).any()
        assert [scan.stamp_ns // MS for scan in recording.scans(lidar)] == left.tolist()
    # Those at the poses on both sides stay: 4.0 and 7.0 s of the front.
    assert {4000, 7000} <= {s // MS for s in recording.scan_stamps_ns("front")}
    # 4.1 to 6.9 of the front, 4.03 to 6.93 of the rear.
    assert "the 59 scans within are left out" in line
    assert "once, for 3.0 s at most (from 4.000 s on)" in line
    wanted = {4000 * MS, 5000 * MS}
    assert [s.stamp_ns for s in recording.scans("front", wanted)] == [4000 * MS]


@pytest.mark.parametrize("poses", [poses_without(), poses_without((20, 90))])
def test_without_a_pause_or_a_scan_in_it_nothing_changes(poses: np.ndarray) -> None:
    scans = Scans()
    assert without_pauses(scans, poses) == (scans, "")
