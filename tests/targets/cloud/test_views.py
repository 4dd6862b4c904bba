"""What scans from one place are worth."""

from __future__ import annotations

import numpy as np
import pytest

from caliv_graph.targets.cloud.views import SCANS_OF_A_VIEW, evenly_spread, view_weights


def test_scans_of_a_moving_vehicle_count_fully() -> None:
    # 2 m/s, 10 Hz: 0.2 m are four times the width of a view.
    path = np.column_stack([0.2 * np.arange(50), np.full(50, 5.0), np.zeros(50)])
    assert view_weights(path).tolist() == [1.0] * 50
    assert view_weights(np.zeros((0, 3))).tolist() == []


@pytest.mark.parametrize("count", [10, 80, 300])
def test_scans_from_one_place_are_worth_a_few_together(count: int) -> None:
    weights = view_weights(np.tile([3.0, 1.0, -1.0], (count, 1)))
    assert weights == pytest.approx(np.full(count, SCANS_OF_A_VIEW / count))
    # Millimetres of noise in the poses make no new view.
    shaky = np.random.default_rng(1).normal(scale=0.002, size=(count, 3))
    assert view_weights(shaky).sum() == pytest.approx(SCANS_OF_A_VIEW, rel=0.02)


def test_few_scans_of_a_place_are_all_worth_themselves() -> None:
    assert view_weights(np.zeros((3, 3))).tolist() == [1.0] * 3


def test_slow_scans_count_by_how_far_they_are_apart() -> None:
    # A Gaussian of 5 cm over scans every 2.5 cm sums to sqrt(2 pi) 5 / 2.5 = 5.013.
    path = np.column_stack([0.025 * np.arange(100), np.zeros(100), np.zeros(100)])
    assert view_weights(path)[50] == pytest.approx(SCANS_OF_A_VIEW / 5.013, rel=1e-3)


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
