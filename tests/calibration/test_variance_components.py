"""Sigmas that add up in one covariance, found by their restricted likelihood."""

from __future__ import annotations

import math

import numpy as np
import pytest

from caliv_graph.calibration.variance_components import (
    Block,
    Component,
    Likelihood,
    Observed,
    Unknown,
    maximise_exactly,
)

SIZE = 60
WANDERING = np.exp(-np.abs(np.arange(SIZE)[:, None] - np.arange(SIZE)) / 8.0)


def likelihood(white: float, slow: float, far: float) -> Likelihood:
    """Of white errors, slow ones, and those of the last six residuals, with an unknown mean."""
    cov = white**2 * np.eye(SIZE) + slow**2 * WANDERING
    cov[-6:, -6:] += far**2 * np.eye(6)
    residuals = 3.0 + np.linalg.cholesky(cov) @ np.random.default_rng(0).standard_normal(SIZE)
    observed = Observed(residuals, np.ones((SIZE, 1)), np.full(1, 1e-6), np.zeros((SIZE, SIZE)))
    parts = (np.eye(SIZE), WANDERING, Block(slice(SIZE - 6, SIZE), np.eye(6)))
    return Likelihood(observed, [Component(part, (i,)) for i, part in enumerate(parts)])


UNKNOWNS = [Unknown(1.0, math.log(10.0), (1e-2, 1e2))] * 3


def test_information_of_white_errors_is_that_of_a_mean_square() -> None:
    # -log p = N log s + r^T r / (2 s^2) by log s: observed 2 r^T r / s^2, expected 2 N, and of the
    # variance, where the average is taken, r^T r / (2 s^6).
    r = np.random.default_rng(0).standard_normal(SIZE)
    observed = Observed(r, np.zeros((SIZE, 1)), np.ones(1), np.zeros((SIZE, SIZE)))
    _, slope, information = observed.cost([np.eye(SIZE)], np.log([2.0]))
    assert slope[0] == pytest.approx(SIZE - r @ r / 4.0)
    assert information[0, 0] == pytest.approx(2.0 * (r @ r) / 4.0)


@pytest.mark.parametrize("start", [0.03, 1.0, 30.0])
def test_the_maximum_is_found_from_anywhere(start: float) -> None:
    of = likelihood(0.3, 2.0, 20.0)
    found, cost = maximise_exactly(of.cost, UNKNOWNS, np.full(3, start))
    assert found == pytest.approx([0.3, 2.0, 20.0], rel=0.6)
    nearest, least = maximise_exactly(of.cost, UNKNOWNS, np.array([0.3, 2.0, 20.0]))
    assert np.log(found) == pytest.approx(np.log(nearest), abs=1e-3)
    assert cost == pytest.approx(least, abs=1e-6)
    _, slope, _ = of.cost(np.log(found))
    surprise = np.log(found) / math.log(10.0) ** 2
    assert slope + surprise == pytest.approx(0.0, abs=5e-3)


def test_what_is_fixed_stays_and_the_others_end_at_their_bounds_or_between() -> None:
    of = likelihood(0.3, 2.0, 0.0)
    fixed = Unknown(1.5, 1.0, (1.5, 1.5))
    unknowns = [UNKNOWNS[0], fixed, Unknown(10.0, 3.0, (5.0, 1e2))]
    (white, slow, far), _ = maximise_exactly(of.cost, unknowns, np.array([1.0, 1.5, 10.0]))
    assert slow == pytest.approx(1.5, rel=1e-12)
    assert far == pytest.approx(5.0, rel=1e-12)
    assert white == pytest.approx(0.3, rel=0.6)
