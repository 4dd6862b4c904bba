from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from caliv_graph.products import LidarScan
from caliv_graph.readers.common_stamps import (
    COMMON_NS,
    MERGE_NS,
    with_common_stamps,
    without_neighbours,
)
from caliv_graph.readers.forwarding import ForwardingRecording

T = 1_750_000_000_123_456_789


@dataclass(frozen=True)
class Stamped(ForwardingRecording):
    """Clouds that hold nothing but the time at which they were taken."""

    stamps: dict[str, list[int]]
    swept: tuple[str, ...] = ()

    @property
    def lidars(self) -> tuple[str, ...]:
        return tuple(self.stamps)

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        return self.stamps[lidar]

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        for stamp in self.stamps[lidar]:
            if wanted is None or stamp in wanted:
                times = np.array([0.0, 0.1]) if lidar in self.swept else None
                yield LidarScan(lidar, stamp, np.zeros((2, 3)), str(stamp), times)


def recorded(**stamps: list[int]) -> Stamped:
    return Stamped(None, stamps)  # type: ignore[arg-type]


def test_clouds_within_a_microsecond_have_one_stamp() -> None:
    drive = recorded(front=[T, T + 100_000_238, T + 200_000_000], rear=[T + 999, T + 100_000_000])

    common = with_common_stamps(drive, MERGE_NS)

    assert list(common.scan_stamps_ns("front")) == [T, T + 100_000_000, T + 200_000_000]
    assert list(common.scan_stamps_ns("rear")) == [T, T + 100_000_000]
    (scan,) = common.scans("front", {T + 100_000_000})
    assert (scan.stamp_ns, scan.source) == (T + 100_000_000, str(T + 100_000_238))
    assert [scan.stamp_ns for scan in common.scans("rear")] == [T, T + 100_000_000]


def test_what_is_farther_apart_stays() -> None:
    drive = recorded(front=[T, T + 100_000_000], rear=[T + 1_001])

    assert with_common_stamps(drive, MERGE_NS) is drive


def test_stamps_do_not_drift_along_a_chain() -> None:
    """Each is near the one before it, but not near the first."""
    drive = recorded(a=[T], b=[T + 700], c=[T + 1_400], d=[T + 2_100])

    common = with_common_stamps(drive, MERGE_NS)

    given = [common.scan_stamps_ns(name)[0] - T for name in "abcd"]
    assert given == [0, 0, 1_400, 1_400]


def test_of_two_clouds_of_one_lidar_the_first_is_kept() -> None:
    common = with_common_stamps(recorded(a=[T, T + 10, T + 5_000], b=[T + 5_001]), MERGE_NS)

    assert list(common.scan_stamps_ns("a")) == [T, T + 5_000]
    assert [scan.source for scan in common.scans("a")] == [str(T), str(T + 5_000)]


def test_points_keep_their_times_where_stamps_are_milliseconds_apart() -> None:
    stamps = {"top": [T], "left": [T + 50_000], "right": [T + 2_000_000], "far": [T + 5_000_001]}
    drive = Stamped(None, stamps, swept=("left",))  # type: ignore[arg-type]

    common = with_common_stamps(drive, COMMON_NS)

    of = {name: next(iter(common.scans(name))) for name in stamps}
    assert [of[name].stamp_ns - T for name in stamps] == [0, 0, 0, 5_000_001]
    assert of["top"].point_times_s is None
    assert of["left"].point_times_s == pytest.approx([0.00005, 0.10005])
    # No times: all points are as of the stamp, which was 2 ms later.
    assert of["right"].point_times_s == pytest.approx([0.002, 0.002])


def test_clouds_of_one_lidar_stay_apart_however_many_it_takes() -> None:
    drive = recorded(fast=[T, T + 2_000_000, T + 4_000_000], slow=[T + 3_000_000])

    common = with_common_stamps(drive, COMMON_NS)

    assert list(common.scan_stamps_ns("fast")) == [T, T + 2_000_000, T + 4_000_000]
    assert list(common.scan_stamps_ns("slow")) == [T + 2_000_000]


def test_a_cloud_that_comes_twice_is_kept_once_wherever_its_group_begins() -> None:
    drive = recorded(a=[T + 3_000_000, T + 3_000_500], b=[T])

    common = with_common_stamps(drive, COMMON_NS)

    assert list(common.scan_stamps_ns("a")) == [T]
    assert [scan.source for scan in common.scans("a")] == [str(T + 3_000_000)]


def test_distances_are_to_what_is_kept() -> None:
    assert without_neighbours(np.array([0, 700, 1_300, 2_000]), 1_000).tolist() == [0, 1_300]
