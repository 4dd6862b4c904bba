"""Noise of heights by hand, and recovered from simulated heights of two LiDARs."""

from __future__ import annotations

import numpy as np
import pytest

from caliv_graph.products import Array, IntArray
from caliv_graph.registration.heights import (
    LEAST_SIGMA_M,
    PRIOR_POINTS,
    HeightNoise,
    HeightSums,
)


def noise_of(range_m: list[float], roughness_m: list[float], floor_m: float = 0.0) -> HeightNoise:
    return HeightNoise(np.array(range_m) ** 2, np.array(roughness_m) ** 2, floor_m)


def sums_of(
    height: Array, cosine: Array, variance: Array, lidar: IntArray, weight: Array | None = None
) -> HeightSums:
    """Of points (n,) that belong to one surfel each."""
    count = len(height)
    return HeightSums.of(
        np.ones((1, count)),
        1.0 / variance[None],
        height[None],
        cosine[None],
        variance[None],
        np.ones(count) if weight is None else weight,
        lidar,
        int(lidar.max()) + 1,
    )


def fitted(
    start: HeightNoise,
    height: Array,
    cosine: Array,
    lidar: IntArray,
    *,
    parameters: float = 0.0,
    before: HeightNoise | None = None,
    weight: Array | None = None,
) -> HeightNoise:
    """The noise after as many rounds as registration has."""
    noise = start
    for _ in range(20):
        variance = noise.variance(cosine[None], lidar)[0]
        sums = sums_of(height, cosine, variance, lidar, weight)
        noise = noise.fitted(sums, parameters, before or start)
    return noise


def test_variance_by_hand() -> None:
    # LiDAR 0: 10 mm and 3 mm, head-on and at 60 degrees. LiDAR 1: 20 mm and 4 mm.
    noise = noise_of([0.01, 0.02], [0.003, 0.004])
    cosine = np.array([[1.0, 0.5], [1.0, 0.5]])
    expected = np.array([[109.0, 25.0 + 9.0], [416.0, 100.0 + 16.0]]) * 1e-6
    found = noise.variance(cosine.T, np.array([0, 1]))
    assert found == pytest.approx(expected.T)
    # While annealing the floor stands for a smaller roughness, not for a larger one.
    coarse = noise_of([0.01, 0.02], [0.003, 0.06], 0.05)
    expected = np.array([[2600.0, 2525.0], [4000.0, 3700.0]]) * 1e-6
    found = coarse.variance(cosine.T, np.array([0, 1]))
    assert found == pytest.approx(expected.T)
    assert noise.largest_m() == pytest.approx(0.02)


def test_noise_as_configured() -> None:
    noise = HeightNoise.configured(2, 0.01, 0.05)
    assert np.sqrt(noise.range_m2) == pytest.approx([0.01, 0.01])
    assert np.sqrt(noise.roughness_m2) == pytest.approx([LEAST_SIGMA_M] * 2)
    assert noise.floor_m == 0.05
    assert HeightNoise.configured(1, 0.0, 0.0).largest_m() == pytest.approx(LEAST_SIGMA_M)
    of_each = HeightNoise.configured(2, np.array([0.01, 0.03]), 0.05)
    assert np.sqrt(of_each.range_m2) == pytest.approx([0.01, 0.03])


def simulated(
    count: int, range_m: list[float], roughness_m: list[float], seed: int = 1
) -> tuple[Array, Array, IntArray]:
    """Heights, cosines and LiDARs of `count` points of each of two LiDARs."""
    rng = np.random.default_rng(seed)
    lidar = np.repeat([0, 1], count).astype(np.int64)
    cosine = rng.uniform(0.1, 1.0, 2 * count)
    along, across = rng.normal(size=(2, 2 * count))
    height = cosine * np.array(range_m)[lidar] * along + np.array(roughness_m)[lidar] * across
    return height, cosine, lidar


def test_both_noises_of_two_lidars_are_recovered() -> None:
    height, cosine, lidar = simulated(20000, [0.008, 0.03], [0.004, 0.006])
    noise = fitted(HeightNoise.configured(2, 0.015, 0.002), height, cosine, lidar)
    assert np.sqrt(noise.range_m2) == pytest.approx([0.008, 0.03], rel=0.04)
    assert np.sqrt(noise.roughness_m2) == pytest.approx([0.004, 0.006], rel=0.08)
    assert noise.floor_m == 0.002


def test_estimates_are_unbiased_where_points_are_few() -> None:
    # 300 of a LiDAR, 200 draws; the configured noise, a prior of 50, is the true one.
    found = []
    start = noise_of([0.01, 0.02], [0.005, 0.005])
    for seed in range(200):
        height, cosine, lidar = simulated(300, [0.01, 0.02], [0.005, 0.005], seed)
        noise = fitted(start, height, cosine, lidar)
        found.append(np.concatenate([noise.range_m2, noise.roughness_m2]))
    true = np.array([0.01, 0.02, 0.005, 0.005]) ** 2
    assert np.mean(found, axis=0) == pytest.approx(true, rel=0.05)


def test_the_configured_noise_counts_as_fifty_points() -> None:
    # All seen head-on with the same height: the two parts are determined by the prior alone, the
    # sum is between what is configured and what the heights say.
    start = noise_of([0.01], [LEAST_SIGMA_M])
    for count in (5, 50, 5000):
        height, cosine = np.full(count, 0.02), np.ones(count)
        noise = fitted(start, height, cosine, np.zeros(count, np.int64))
        both = float(noise.range_m2[0] + noise.roughness_m2[0])
        # Of the two unknowns each is drawn by the prior: as half as many for their sum.
        prior = 0.5 * PRIOR_POINTS
        expected = (count * 0.02**2 + prior * (0.01**2 + LEAST_SIGMA_M**2)) / (count + prior)
        assert both == pytest.approx(expected, rel=1e-6)


def test_a_lidar_without_points_keeps_its_noise() -> None:
    height, cosine, lidar = simulated(500, [0.01, 0.02], [0.005, 0.005])
    start = HeightNoise.configured(3, 0.01, 0.0)
    variance = start.variance(cosine[None], lidar)
    alpha = np.ones((1, 1000))
    sums = HeightSums.of(
        alpha, alpha / variance, height[None], cosine[None], variance, np.ones(1000), lidar, 3
    )
    noise = start.fitted(sums, 0.0, start)
    assert noise.range_m2[2] == start.range_m2[2]
    assert noise.roughness_m2[2] == start.roughness_m2[2]
    assert noise.range_m2[1] > start.range_m2[1]


@pytest.mark.parametrize("height_m", [0.0, 1e-5])
def test_noise_is_never_below_what_ranges_are_quantised_to(height_m: float) -> None:
    count = 100000
    cosine = np.random.default_rng(3).uniform(0.1, 1.0, count)
    start = noise_of([0.01], [0.004])
    noise = fitted(start, np.full(count, height_m), cosine, np.zeros(count, np.int64))
    assert np.sqrt(noise.range_m2) == pytest.approx([LEAST_SIGMA_M])
    assert np.sqrt(noise.roughness_m2) == pytest.approx([LEAST_SIGMA_M])


@pytest.mark.parametrize(("range_m", "roughness_m"), [(0.0, 0.01), (0.01, 0.0)])
def test_where_one_noise_is_least_the_other_is_still_right(
    range_m: float, roughness_m: float
) -> None:
    height, cosine, lidar = simulated(20000, [range_m] * 2, [roughness_m] * 2)
    noise = fitted(HeightNoise.configured(2, 0.005, 0.0), height, cosine, lidar)
    for found, true in ((noise.range_m2, range_m), (noise.roughness_m2, roughness_m)):
        assert (found >= LEAST_SIGMA_M**2).all()
        if true > 0.0:
            # The millimetre that is assumed too much is that of the range at f = 0.1.
            assert np.sqrt(found) == pytest.approx([true, true], rel=0.05)
        else:
            assert (np.sqrt(found) < 2.0e-3).all()


def planes(points: int, planes: int, sigma_m: float) -> tuple[Array, Array]:
    """Heights of points over planes that were fitted to them, seen at many angles, and cosines."""
    rng = np.random.default_rng(4)
    height, cosine = [], []
    for _ in range(planes):
        A = np.column_stack([np.ones(points), rng.uniform(-1.0, 1.0, (points, 2))])
        f = rng.uniform(0.3, 1.0, points)
        off = f * sigma_m * rng.normal(size=points)
        W = 1.0 / f**2
        fit = np.linalg.solve(A.T @ (W[:, None] * A), A.T @ (W * off))
        height.append(off - A @ fit)
        cosine.append(f)
    return np.concatenate(height), np.concatenate(cosine)


def test_what_the_shape_has_taken_up_is_made_up_for() -> None:
    # Twelve points a plane of three parameters: a quarter of the squares is missing.
    height, cosine = planes(12, 2000, 0.01)
    none = np.zeros(len(height), np.int64)
    start = HeightNoise.configured(1, 0.01, 0.0)
    biased = fitted(start, height, cosine, none)
    right = fitted(start, height, cosine, none, parameters=6000.0)

    def head_on(noise: HeightNoise) -> float:
        return float(noise.range_m2[0] + noise.roughness_m2[0])

    assert head_on(biased) == pytest.approx(0.75 * 0.01**2, rel=0.06)
    assert head_on(right) == pytest.approx(0.01**2, rel=0.06)
    # By hand: 24000 / (24000 - 6000).
    assert head_on(right) / head_on(biased) == pytest.approx(4.0 / 3.0, rel=0.02)
    # More parameters than points are no reason for infinite noise: five times at most.
    many = fitted(start, height, cosine, none, parameters=1e6)
    assert head_on(many) / head_on(biased) == pytest.approx(5.0, rel=0.02)


def test_weights_of_clouds_do_not_change_what_the_shape_has_taken_up() -> None:
    # Clouds that share a view count a tenth each: all sums are a tenth, and so are the points that
    # the planes have taken up.
    height, cosine = planes(12, 2000, 0.01)
    none = np.zeros(len(height), np.int64)
    start = HeightNoise.configured(1, 0.01, 0.0)
    full = fitted(start, height, cosine, none, parameters=6000.0)
    tenth = fitted(start, height, cosine, none, parameters=6000.0, weight=np.full(len(height), 0.1))
    assert tenth.range_m2 == pytest.approx(full.range_m2)
    assert tenth.roughness_m2 == pytest.approx(full.roughness_m2)


def test_clouds_that_are_left_out_say_nothing_of_the_noise() -> None:
    height, cosine, lidar = simulated(2000, [0.01, 0.02], [0.005, 0.005])
    weight = np.ones(4000)
    weight[::3] = 1e-9
    height[::3] = 0.2
    start = HeightNoise.configured(2, 0.01, 0.0)
    noise = fitted(start, height, cosine, lidar, weight=weight)
    kept = np.arange(4000) % 3 > 0
    alone = fitted(start, height[kept], cosine[kept], lidar[kept])
    assert noise.range_m2 == pytest.approx(alone.range_m2, rel=1e-4)
    assert noise.roughness_m2 == pytest.approx(alone.roughness_m2, rel=1e-4)


def test_the_shared_part_is_the_roughness_over_all_by_hand() -> None:
    # Mean cosine^2 of the LiDARs 1 and 0.25: 9 / (100 + 9), 16 / (0.25 x 400 + 16).
    noise = noise_of([0.01, 0.02], [0.003, 0.004])
    cosine, lidar = np.array([1.0, 1.0, 0.5, 0.5]), np.array([0, 0, 1, 1])
    sums = sums_of(np.zeros(4), cosine, np.ones(4), lidar)
    assert sums.mean_cosine2() == pytest.approx([1.0, 0.25])
    assert noise.shared_part(sums) == pytest.approx([9.0 / 109.0, 16.0 / 116.0])
    # At least 3 mm are shared, whatever the surfels show; the floor of annealing is not.
    smooth = noise_of([0.01, 0.02], [0.001, 0.004], 0.01)
    assert smooth.shared_part(sums) == pytest.approx([9.0 / 109.0, 16.0 / 116.0])


def test_sums_by_hand_and_in_parts() -> None:
    # Two points of weights 1 and 1/2, 3 and 4 mm high, variances 1 and 4 mm^2, cosines 1 and 1/2.
    alpha, height = np.array([[1.0, 0.8]]), np.array([[3e-3, 4e-3]])
    cosine, variance = np.array([[1.0, 0.5]]), np.array([[1e-6, 4e-6]])
    weight, lidar = np.array([1.0, 0.5]), np.zeros(2, np.int64)

    def of(i: slice) -> HeightSums:
        a, h, f, v = alpha[:, i], height[:, i], cosine[:, i], variance[:, i]
        return HeightSums.of(a, a / v, h, f, v, weight[i], lidar[i], 1)

    sums = of(slice(None))
    assert sums.points == pytest.approx([1.4])
    assert sums.squares == pytest.approx([1.2])
    assert sums.kish() == pytest.approx([1.4**2 / 1.2])
    assert sums.cosine2 == pytest.approx([1.1])
    # 0.4 / 16e-12 = 0.025e12 of the second; f^2 = 1 / 4.
    assert sums.normal[0] * 1e-12 == pytest.approx(
        np.array([[1.0 + 0.025 / 16.0, 1.0 + 0.025 / 4.0], [1.0 + 0.025 / 4.0, 1.025]])
    )
    assert sums.right[0] * 1e-6 == pytest.approx([9.0 + 0.1, 9.0 + 0.4])
    parts = [of(slice(0, 1)), of(slice(1, 2))]
    total = HeightSums.total([*parts, HeightSums.none(1)])
    for name in ("points", "squares", "cosine2", "normal", "right"):
        assert getattr(total, name) == pytest.approx(getattr(sums, name))
