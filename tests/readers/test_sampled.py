"""What is kept of a recording for pictures."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence

import numpy as np

from caliv_graph.products import Array, LidarScan, MotionData
from caliv_graph.readers.sampled import CELL_M, POINTS, RANGE_M, SCANS, SampledRecording, thinned


def cloud(points: int, seed: int, reach_m: float = 60.0) -> Array:
    """Points about a LiDAR, most of them near it, on both sides of every axis."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.0, 1.0, (points, 3)) * reach_m * rng.random((points, 1)) ** 2


class Memory:
    """A recording of made-up clouds."""

    name = "memory"
    lidars = ("front",)

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        return list(range(0, 1000, 10))

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        for stamp_ns in self.scan_stamps_ns(lidar):
            yield LidarScan(lidar, stamp_ns, cloud(3000, stamp_ns), "memory")

    def motion(self) -> MotionData:
        return MotionData("memory")

    def warnings(self) -> Sequence[str]:
        return ()


def test_one_point_of_each_cell_is_kept_the_first() -> None:
    points = cloud(20_000, 1)
    points[:3] = [
        [RANGE_M, 0.0, 0.0],
        [-RANGE_M, 0.0, 0.0],
        [0.0, 0.0, -RANGE_M],
    ]  # outermost cells
    times = 1e-6 * np.arange(len(points), dtype=np.float64)
    first: dict[tuple[int, ...], int] = {}
    for i, point in enumerate(points):
        if np.linalg.norm(point) <= RANGE_M:
            first.setdefault(tuple(np.floor(point / CELL_M).astype(int).tolist()), i)
    assert len(first) > POINTS

    kept = thinned(LidarScan("front", 0, points, "memory", times))

    assert kept.point_times_s is not None
    chosen = np.rint(kept.point_times_s * 1e6).astype(int)
    assert len(chosen) == POINTS
    assert set(chosen.tolist()) <= set(first.values())
    np.testing.assert_array_equal(kept.points_lidar, points[chosen])
    assert (np.diff(chosen) > 0).all()


def test_few_points_are_all_kept() -> None:
    points = np.array([[1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 0.0, 0.3]])
    np.testing.assert_array_equal(thinned(LidarScan("a", 0, points, "")).points_lidar, points)


def test_a_few_clouds_are_kept_over_the_drive_and_all_are_passed_on() -> None:
    recording = SampledRecording(Memory())

    passed = [scan.stamp_ns for scan in recording.scans("front")]

    assert passed == list(range(0, 1000, 10))
    stamps = [scan.stamp_ns for scan in recording.kept()]
    assert len(stamps) == SCANS
    assert stamps[0] == 0
    assert max(np.diff(stamps)) < 150
