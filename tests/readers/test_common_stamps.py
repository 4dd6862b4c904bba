from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from caliv_graph.products import LidarScan
from caliv_graph.readers.common_stamps import with_common_stamps, without_neighbours
from caliv_graph.readers.forwarding import ForwardingRecording

T = 1_750_000_000_123_456_789


@dataclass(frozen=True)
class Stamped(ForwardingRecording):
    """Clouds that hold nothing but the time at which they were taken."""

    stamps: dict[str, list[int]]

    @property
    def lidars(self) -> tuple[str, ...]:
        return tuple(self.stamps)

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        return self.stamps[lidar]

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        for stamp in self.stamps[lidar]:
            if wanted is None or stamp in wanted:
                yield LidarScan(lidar, stamp, np.zeros((1, 3)), source=str(stamp))


def recorded(**stamps: list[int]) -> Stamped:
    return Stamped(None, stamps)  # type: ignore[arg-type]


def test_clouds_within_a_microsecond_have_one_stamp() -> None:
    drive = recorded(front=[T, T + 100_000_238, T + 200_000_000], rear=[T + 999, T + 100_000_000])

    common = with_common_stamps(drive)

    assert list(common.scan_stamps_ns("front")) == [T, T + 100_000_000, T + 200_000_000]
    assert list(common.scan_stamps_ns("rear")) == [T, T + 100_000_000]
    (scan,) = common.scans("front", {T + 100_000_000})
    assert (scan.stamp_ns, scan.source) == (T + 100_000_000, str(T + 100_000_238))
    assert [scan.stamp_ns for scan in common.scans("rear")] == [T, T + 100_000_000]


def test_what_is_farther_apart_stays() -> None:
    drive = recorded(front=[T, T + 100_000_000], rear=[T + 1_001])

    assert with_common_stamps(drive) is drive


def test_stamps_do_not_drift_along_a_chain() -> None:
    """Each is near the one before it, but not near the first."""
    drive = recorded(a=[T], b=[T + 700], c=[T + 1_400], d=[T + 2_100])

    common = with_common_stamps(drive)

    given = [common.scan_stamps_ns(name)[0] - T for name in "abcd"]
    assert given == [0, 0, 1_400, 1_400]


def test_of_two_clouds_of_one_lidar_the_first_is_kept() -> None:
    common = with_common_stamps(recorded(a=[T, T + 10, T + 5_000], b=[T + 5_001]))

    assert list(common.scan_stamps_ns("a")) == [T, T + 5_000]
    assert [scan.source for scan in common.scans("a")] == [str(T), str(T + 5_000)]


def test_distances_are_to_what_is_kept() -> None:
    assert without_neighbours(np.array([0, 700, 1_300, 2_000]), 1_000).tolist() == [0, 1_300]
