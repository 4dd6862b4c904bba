"""Noise along the beam of a LiDAR, by the patches of its scans."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from caliv_graph.products import Array, TargetCloud, TargetObservation
from caliv_graph.structure.patches import RangeNoise
from caliv_graph.structure.planar import ScanPatches, planar_patches
from caliv_graph.structure.range_noise import OPEN_M, measured_noise, with_range_noise
from tests.structure.test_planar import DENSE, of_one_scan, on_plane

FACING = np.array([1.0, 0.0, 0.0])
STATED_M = 0.01


def cut(*walls: tuple[float, float], scatter_m: float = 0.0, seed: int = 0) -> list[ScanPatches]:
    """A scan of each wall at a distance, with that noise of the ranges.

    Its surface scatters by `scatter_m` beside: leaves.
    """
    rng = np.random.default_rng(seed)
    out = []
    for distance_m, sigma_m in walls:
        ranges = on_plane(DENSE, FACING, distance_m)
        ranges = ranges + np.hypot(sigma_m, scatter_m) * rng.standard_normal(len(ranges))
        out.append(planar_patches(DENSE * ranges[:, None], RangeNoise.constant(OPEN_M)))
    return out


def measured(*found: ScanPatches) -> RangeNoise:
    return measured_noise(found, STATED_M)


def test_noise_is_measured_by_distance() -> None:
    noise = measured(*cut((6.0, 0.02), (20.0, 0.03), (40.0, 0.045)))

    found = noise.at(np.array([1.0, 6.3, 21.0, 42.0, 100.0]))

    assert found == pytest.approx([0.02, 0.02, 0.03, 0.045, 0.045], rel=0.12)


def test_what_is_stated_is_the_least_of_it_and_all_where_nothing_is_seen() -> None:
    assert measured(*cut((6.0, 0.002), (20.0, 0.003))).at(np.array([6.0])) == STATED_M
    nothing = measured_noise([], STATED_M)
    assert nothing.at(np.array([1.0, 50.0])) == pytest.approx([STATED_M] * 2)


def test_leaves_nearby_are_no_noise_where_a_wall_beyond_has_less() -> None:
    hedge = cut((5.0, 0.015), scatter_m=0.035)
    assert measured(*hedge).at(np.array([5.0])) == pytest.approx(0.038, rel=0.12)

    beside_a_wall = measured(*hedge, *cut((20.0, 0.015)))

    assert beside_a_wall.at(np.array([5.0])) == pytest.approx(0.015, rel=0.12)


def test_leaves_far_away_are_noise_at_most_in_proportion_to_the_distance() -> None:
    near, hedge = cut((8.0, 0.015)), cut((16.0, 0.015), scatter_m=0.055)

    found = measured(*near, *hedge).at(np.array([16.5]))

    assert found[0] < 1.15 * 2.0 * 0.015


@pytest.mark.parametrize("sigma_m", [0.03, 0.045])
def test_walls_of_a_noisy_lidar_are_flat_by_its_noise(sigma_m: float) -> None:
    ranges = on_plane(DENSE, FACING, 20.0)
    rng = np.random.default_rng(1)
    points = DENSE * (ranges + sigma_m * rng.standard_normal(len(ranges)))[:, None]
    noise = measured(*cut((20.0, sigma_m)))

    stated, told = (planar_patches(points, n) for n in (RangeNoise.constant(STATED_M), noise))

    assert len(told.time_s) > 40
    assert len(stated.time_s) < 0.2 * len(told.time_s)
    # The few that pass by what is stated pretend less noise than there is.
    assert np.median(told.scatter_m) == pytest.approx(sigma_m, rel=0.15)
    assert np.median(stated.scatter_m) < 0.8 * np.median(told.scatter_m)


def observation(*clouds: tuple[str, float]) -> TargetObservation:
    """A target seen by LiDARs at a distance."""
    some: Array = np.array([[1.0, 0.0, 0.0]] * 3)
    return TargetObservation(
        0,
        "target",
        np.zeros(3),
        tuple(TargetCloud(name, 0, 0, some * at_m, "0.pcd") for name, at_m in clouds),
    )


def test_the_noise_at_the_distance_of_the_target_goes_with_its_clouds() -> None:
    noise = RangeNoise(np.array([10.0, 30.0]), np.array([0.02, 0.04]))
    (found,) = cut((10.0, 0.02))
    patches = of_one_scan(found, gtsam.Pose3())
    patches = replace(patches, noise={0: noise})

    told = with_range_noise(observation(("front", 20.0)), [patches])

    assert told.range_noise_m == pytest.approx({"front": 0.03})
    # Of another drive, or of a LiDAR of which nothing was read, nothing is told.
    other = replace(patches, drive=1)
    assert with_range_noise(observation(("front", 20.0)), [other]).range_noise_m == {}
    silent = replace(patches, noise={})
    assert with_range_noise(observation(("front", 20.0)), [silent]).range_noise_m == {}
