"""What scans from one place are worth."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest

from caliv_graph.targets.cloud.views import (
    SAME_VIEW_M,
    TYPICAL_SHARED,
    chosen,
    evenly_spread,
    preference,
    view_weights,
    views,
    weights_of_views,
)


def test_scans_of_a_moving_vehicle_count_fully() -> None:
    # 2 m/s, 10 Hz: 0.2 m are four times the width of a view.
    path = np.column_stack([0.2 * np.arange(50), np.full(50, 5.0), np.zeros(50)])
    # Gaussian of 4 sigmas: 3e-4 of a scan to either side.
    assert view_weights(path) == pytest.approx(np.ones(50), abs=2e-4)
    assert view_weights(np.zeros((0, 3))).tolist() == []


def test_weights_are_those_of_equally_correlated_errors() -> None:
    # Kish: the mean of c errors is worth c / (1 + (c - 1) shared). Of two with a quarter shared
    # 2 / 1.25 = 1.6, of 80 80 / 20.75 = 3.86.
    counts = np.array([1.0, 2.0, 80.0])
    assert weights_of_views(counts, 0.25) == pytest.approx([1.0, 0.8, 1.0 / 20.75])
    # Nothing shared: all are worth themselves. All shared: together they are worth one.
    assert weights_of_views(counts, 0.0) == pytest.approx([1.0, 1.0, 1.0])
    assert weights_of_views(counts, 1.0) == pytest.approx([1.0, 0.5, 1.0 / 80.0])
    # Of each cloud its own.
    assert weights_of_views(np.full(2, 5.0), np.array([0.0, 0.5])) == pytest.approx([1.0, 1 / 3])


def test_weight_is_the_variance_of_a_simulated_mean() -> None:
    rng = np.random.default_rng(2)
    same, own = rng.normal(size=(20000, 1)), rng.normal(size=(20000, 6))
    means = (math.sqrt(0.3) * same + math.sqrt(0.7) * own).mean(axis=1)
    worth = float(weights_of_views(np.full(6, 6.0), 0.3).sum())
    assert worth == pytest.approx(1.0 / float(means.var()), rel=0.05)


@pytest.mark.parametrize("count", [10, 80, 300])
def test_scans_from_one_place_are_worth_a_few_together(count: int) -> None:
    worth = count / (1.0 + (count - 1.0) * TYPICAL_SHARED)
    assert worth < 1.0 / TYPICAL_SHARED
    weights = view_weights(np.tile([3.0, 1.0, -1.0], (count, 1)))
    assert weights == pytest.approx(np.full(count, worth / count))
    # Millimetres of noise in the poses make no new view.
    shaky = np.random.default_rng(1).normal(scale=0.002, size=(count, 3))
    assert view_weights(shaky).sum() == pytest.approx(worth, rel=0.02)


def test_minutes_of_standing_are_counted_in_little_memory() -> None:
    """All pairs of 20000 scans would be 8 GB; places that wander count as Gaussians say."""
    rng = np.random.default_rng(3)
    places = rng.normal(scale=0.01, size=(20000, 3)) + np.array([8.0, 1.0, -1.0])
    tracemalloc.start()
    count = views(places)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6
    some = slice(0, 20000, 500)
    apart = np.linalg.norm(places[some, None] - places[None], axis=2)
    expected = np.exp(-0.5 * (apart / SAME_VIEW_M) ** 2).sum(axis=1)
    assert count[some] == pytest.approx(expected, rel=0.1)
    assert count[some].mean() == pytest.approx(expected.mean(), rel=0.02)


def test_views_are_counted_by_how_far_scans_are_apart() -> None:
    # A Gaussian of 5 cm over scans every 2.5 cm sums to sqrt(2 pi) 5 / 2.5 = 5.013.
    path = np.column_stack([0.025 * np.arange(100), np.zeros(100), np.zeros(100)])
    assert views(path)[50] == pytest.approx(5.013, rel=1e-3)
    assert view_weights(path)[50] == pytest.approx(1.0 / (1.0 + 4.013 * TYPICAL_SHARED), rel=1e-3)
    # An end has half as many about it.
    assert views(path)[0] == pytest.approx(0.5 * (5.013 + 1.0), rel=1e-3)


def test_of_equal_scans_evenly_many_are_taken() -> None:
    assert evenly_spread(np.ones(5), 8).tolist() == [0, 1, 2, 3, 4]
    assert evenly_spread(np.ones(9), 3).tolist() == [0, 4, 8]


def test_a_long_stand_does_not_crowd_out_the_drive() -> None:
    # A minute of standing and 8 s of driving past: of 80 places nearly all are of the drive.
    standing = np.tile([10.0, 5.0, 0.0], (600, 1))
    driving = np.column_stack([10.0 - 0.2 * np.arange(1, 81), np.full(80, 5.0), np.zeros(80)])
    taken = evenly_spread(view_weights(np.concatenate([standing, driving])), 60)
    assert len(taken) <= 60
    assert (taken >= 600).sum() >= 55
    assert taken[0] < 600


def test_a_long_stand_does_not_crowd_out_the_drive_whichever_scans_are_preferred() -> None:
    standing = np.tile([10.0, 5.0, 0.0], (600, 1))
    driving = np.column_stack([10.0 - 0.2 * np.arange(1, 81), np.full(80, 5.0), np.zeros(80)])
    weights = view_weights(np.concatenate([standing, driving]))
    taken = chosen(preference(np.arange(680), 680), weights, 60)
    assert len(taken) == 60
    assert 50 <= (taken >= 600).sum() < 60
    # Of the drive every part has its share.
    assert np.diff(taken[taken >= 600]).max() <= 4


def test_preferred_scans_are_spread_evenly_however_many_are_taken() -> None:
    # Bits in reversed order: 0, 4, 2, 6, 1, 5, 3, 7 of eight, each half a step above.
    order = np.argsort(preference(np.arange(8), 8))
    assert order.tolist() == [0, 4, 2, 6, 1, 5, 3, 7]
    assert preference(np.array([0]), 1).tolist() == [0.25]
    for most in (10, 64, 100, 150):
        taken = chosen(preference(np.arange(200), 200), np.ones(200), most)
        assert len(taken) == most
        assert np.diff(taken).max() <= 2 ** np.ceil(np.log2(200 / most)) + 1e-9


def test_a_scan_more_or_less_changes_one_choice() -> None:
    preferences = preference(np.arange(570), 570)
    seen = np.arange(100, 400)
    weights = np.random.default_rng(3).uniform(0.5, 1.0, 570)
    before = seen[chosen(preferences[seen], weights[seen], 80)]
    for more in (np.arange(99, 400), np.arange(101, 400)):
        after = more[chosen(preferences[more], weights[more], 80)]
        assert len(set(before) - set(after)) <= 1
