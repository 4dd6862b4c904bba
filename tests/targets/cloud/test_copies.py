"""Clouds under two names: copies are found in any frame, two LiDARs of a kind are not copies."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import pytest

from caliv_graph.products import Array, LidarScan, MotionData
from caliv_graph.targets.cloud.copies import copies

PERIOD_NS = 100_000_000
NOISE_M = 0.01
MOVED = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, 2.5), np.array([2.0, 1.0, 0.5]))


def scan(seed: int, wall_m: float = 20.0, noise_m: float = NOISE_M) -> Array:
    """(N, 3) of a LiDAR 2 m above the ground before a wall, as single precision."""
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(-60.0, 60.0, 0.8)), np.radians(np.linspace(-22.5, 2.5, 48))
    )
    beams = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=-1,
    ).reshape(-1, 3)
    down = np.where(beams[:, 2] < -1e-3, -2.0 / np.minimum(beams[:, 2], -1e-3), np.inf)
    ranges = np.minimum(down, wall_m / beams[:, 0])
    ranges = ranges + noise_m * np.random.default_rng(seed).standard_normal(len(ranges))
    return np.asarray((beams * ranges[:, None]).astype(np.float32), np.float64)


@dataclass
class Clouds:
    """A recording of clouds in memory, at the same stamps for all LiDARs."""

    clouds: Mapping[str, Sequence[Array]]
    name: str = "drive"

    @property
    def lidars(self) -> tuple[str, ...]:
        return tuple(self.clouds)

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        return [k * PERIOD_NS for k in range(len(self.clouds[lidar]))]

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        for stamp, points in zip(self.scan_stamps_ns(lidar), self.clouds[lidar], strict=True):
            if wanted is None or stamp in wanted:
                yield LidarScan(lidar, stamp, points, "made up")

    def motion(self) -> MotionData:
        return MotionData(self.name)

    def warnings(self) -> Sequence[str]:
        return ()


def moved(points: Array) -> Array:
    """In another frame, as single precision."""
    return np.asarray(MOVED.transformFrom(points.T).T.astype(np.float32), np.float64)


ONE = [scan(seed) for seed in range(6)]


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        (ONE, (0.0, 0.0)),
        ([moved(p) for p in ONE], (1.0, 1.0)),
        # A filter of ranges in the other frame, a driver that drops points or rounds.
        ([p[np.linalg.norm(p, axis=1) > 9.0] for p in map(moved, ONE)], (1.0, 1.0)),
        ([p[np.arange(len(p)) % 17 != 0] for p in map(moved, ONE)], (1.0, 1.0)),
        ([np.round(moved(p), 3) for p in ONE], (1.0, 1.0)),
        ([np.random.default_rng(1).permutation(p) for p in ONE], (0.0, 0.0)),
    ],
    ids=["same", "moved", "filtered", "thinned", "millimetres", "another order"],
)
def test_copies_are_found_in_any_frame(other: list[Array], expected: tuple[float, float]) -> None:
    (pair,) = copies(Clouds({"front": ONE, "rear": other}))
    assert pair.lidars == ("front", "rear")
    assert pair.moved_m == pytest.approx(
        expected[0] * np.linalg.norm(MOVED.translation()), abs=1e-3
    )
    turn = float(np.linalg.norm(gtsam.Rot3.Logmap(MOVED.rotation())))
    assert pair.turned_rad == pytest.approx(expected[1] * turn, abs=1e-4)


def test_only_the_pair_is_named() -> None:
    others = [scan(seed) for seed in range(10, 16)]
    (pair,) = copies(Clouds({"a": ONE, "b": others, "c": [moved(p) for p in ONE]}))
    assert pair.lidars == ("a", "c")


@pytest.mark.parametrize("noise_m", [0.002, 0.01])
def test_two_lidars_of_a_kind_before_the_same_wall_are_none(noise_m: float) -> None:
    one = [scan(seed, noise_m=noise_m) for seed in range(6)]
    other = [scan(seed, noise_m=noise_m) for seed in range(10, 16)]
    assert copies(Clouds({"front": one, "rear": other})) == ()


def test_without_noise_equal_rings_on_the_ground_are_no_evidence() -> None:
    one = [scan(0, wall_m, noise_m=0.0) for wall_m in (20.0, 21.0, 22.0, 23.0, 24.0, 25.0)]
    other = [scan(0, wall_m, noise_m=0.0) for wall_m in (30.0, 29.0, 28.0, 27.5, 26.5, 26.0)]
    assert copies(Clouds({"front": one, "rear": other})) == ()
    assert len(copies(Clouds({"front": one, "rear": one}))) == 1


def test_one_scan_in_common_is_no_copy() -> None:
    other = [scan(seed) for seed in range(10, 16)]
    other[2] = ONE[2]
    assert copies(Clouds({"front": ONE, "rear": other})) == ()


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((500, 3), [10.0, 1.0, -1.0])])
def test_clouds_that_show_nothing_are_not_compared(points: Array) -> None:
    assert copies(Clouds({"front": [points] * 6, "rear": [points] * 6})) == ()
    assert copies(Clouds({"front": [], "rear": ONE})) == ()
