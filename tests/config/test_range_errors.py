"""Sizes of range errors: what is stated, and what errors tell of their own size."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from caliv_graph.config.noise import NoiseConfig
from caliv_graph.config.range_errors import (
    GRAZING_COS,
    GROUND_M,
    INCIDENCE_M,
    LOG_SPREAD,
    SURFACE_M,
    TYPICAL_OFFSET_M,
    flat,
    growth,
    log_normal,
    offset_prior,
    range_errors,
    size_weights,
)


def test_who_knows_all_ranges_knows_those_on_the_ground_and_at_a_slant() -> None:
    unstated = range_errors(NoiseConfig())
    usual = (INCIDENCE_M, GROUND_M, SURFACE_M)
    assert (unstated.incidence_m, unstated.ground_m, unstated.surface_m) == usual
    stated = range_errors(NoiseConfig(lidar_range_bias_m=0.001))
    assert (stated.incidence_m, stated.ground_m, stated.surface_m) == (0.001,) * 3
    assert stated.offsets.usual == pytest.approx(0.001)
    # Larger ones say nothing of the others.
    large = range_errors(NoiseConfig(lidar_range_bias_m=0.02))
    assert (large.incidence_m, large.ground_m, large.surface_m) == usual
    assert large.offsets.usual == pytest.approx(0.02)


def test_the_growth_of_ranges_is_one_over_the_cosine_until_they_graze() -> None:
    cosine = np.array([1.0, 0.5, GRAZING_COS, 0.1])
    steep, grazing = growth(cosine).T
    assert steep + grazing == pytest.approx(1.0 / cosine - 1.0)
    assert steep[:3] == pytest.approx([0.0, 1.0, 1.0 / GRAZING_COS - 1.0])
    assert grazing[:3] == pytest.approx(0.0, abs=1e-12)
    assert steep[3] == steep[2]


def test_the_usual_size_is_the_root_mean_square() -> None:
    # Of a log-normal distribution, but for its tail beyond 30 mm.
    expected = TYPICAL_OFFSET_M * np.exp(LOG_SPREAD**2)
    assert offset_prior(None).usual == pytest.approx(expected, rel=0.15)


def test_the_weights_are_those_of_the_pull_under_each_size() -> None:
    """The pull of errors e is A e + n, n of covariance A: N(0, A + A S A) for errors N(0, S)."""
    rng = np.random.default_rng(2)
    root = rng.normal(size=(3, 5))
    A, pull = root @ root.T, rng.normal(size=3)
    kinds = np.array([0, 1, 0])
    priors = (log_normal(np.array([0.3, 1.0]), 1.0), flat(np.array([0.1, 0.5, 2.0])))
    weights = size_weights(A, pull, kinds, priors)
    expected = np.zeros((2, 3))
    for i, a in enumerate(priors[0].sigmas):
        for j, b in enumerate(priors[1].sigmas):
            S = np.diag(np.array([a, b])[kinds] ** 2)
            likelihood = multivariate_normal(np.zeros(3), A + A @ S @ A).pdf(pull)
            expected[i, j] = likelihood * np.exp(-priors[0].cost[i])
    assert weights == pytest.approx(expected / expected.sum())


def test_errors_of_one_size_have_the_weights_of_the_product() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(4, 6))
    A, pull = root @ root.T, rng.normal(size=4)
    prior = log_normal(np.array([0.1, 0.5, 2.0]), 1.0)
    known = flat(np.array([1.0]))  # of no error
    alone = size_weights(A, pull, np.zeros(4, np.int64), [prior])
    both = size_weights(A, pull, np.zeros(4, np.int64), [prior, known])
    assert alone == pytest.approx(both[:, 0])
    assert alone.min() > 1e-3
