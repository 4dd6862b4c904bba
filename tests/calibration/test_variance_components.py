"""Restricted likelihood of variances: derivatives, curvature, and the two optimisers."""

from __future__ import annotations

import numpy as np
import pytest

from caliv_graph.calibration.variance_components import (
    Block,
    Component,
    Likelihood,
    Observed,
    Unknown,
    maximise,
)
from caliv_graph.products import Array

CLOUDS, SIZE = 12, 6


def drawn(seed: int) -> Likelihood:
    """Residuals with a white error, one that is correlated over all, and a scale of each cloud.

    True sigmas: 0.5, 2, and 1 to 2 of the clouds, whose level is an unknown of its own.
    """
    rng = np.random.default_rng(seed)
    n = CLOUDS * SIZE
    at = np.repeat(np.arange(CLOUDS), SIZE)
    slow = np.exp(-np.abs(at[:, None] - at) / 4.0) * (
        np.arange(n)[:, None] % SIZE == np.arange(n) % SIZE
    )
    clouds = [Block(slice(SIZE * j, SIZE * j + SIZE), 0.5 * np.eye(SIZE)) for j in range(CLOUDS)]
    cov = 0.5**2 * np.eye(n) + 2.0**2 * slow
    for j, cloud in enumerate(clouds):
        cov[cloud.rows, cloud.rows] += (1.0 + j / CLOUDS) ** 2 * cloud.cov
    residuals = np.linalg.cholesky(cov) @ rng.standard_normal(n)
    design = rng.standard_normal((n, 3))
    observed = Observed(residuals, design, np.full(3, 1e-2), 1e-3 * np.eye(n))
    parts = [Component(np.eye(n), (0,)), Component(slow, (1,))]
    return Likelihood(observed, [*parts, *(Component(c, (2, 3 + j)) for j, c in enumerate(clouds))])


UNKNOWNS = [Unknown(1.0, np.log(10.0), (1e-3, 1e3))] * 3
UNKNOWNS += [Unknown(1.0, np.log(2.0), (1e-2, 1e2))] * CLOUDS


def projection(likelihood: Likelihood, x: Array) -> Array:
    """(N, N) inverse covariance without what the parameters explain."""
    of = likelihood.observed
    inverse = np.linalg.inv(likelihood.covariance(x))
    weighted = inverse @ of.design
    normal = of.design.T @ weighted + np.diag(of.ridge)
    return np.asarray(inverse - weighted @ np.linalg.solve(normal, weighted.T))


def test_curvature_is_the_mean_of_observed_and_expected_information() -> None:
    likelihood = drawn(1)
    dense = Likelihood(likelihood.observed, likelihood.components[:2])
    x = np.log([0.7, 1.5])
    value, slope, curvature = dense.curved(x)
    assert (value, slope.tolist()) == (dense.cost(x)[0], pytest.approx(dense.cost(x)[1]))

    # By variances: the second differences of the cost, and half a trace.
    variances = np.exp(2.0 * x)
    steps = 1e-4 * np.diag(variances)
    observed = np.zeros((2, 2))
    for i in range(2):
        for j in range(2):
            ends = [
                dense.value(0.5 * np.log(variances + a * steps[i] + b * steps[j])) * a * b
                for a in (-1.0, 1.0)
                for b in (-1.0, 1.0)
            ]
            observed[i, j] = sum(ends) / (4.0 * steps[i, i] * steps[j, j])
    P = projection(dense, x)
    parts = [np.asarray(of.part) for of in dense.components]
    expected = np.array([[0.5 * np.trace(P @ a @ P @ b) for b in parts] for a in parts])
    mean = 4.0 * np.outer(variances, variances) * 0.5 * (observed + expected)
    assert curvature == pytest.approx(mean, rel=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_both_optimisers_find_the_same(seed: int) -> None:
    likelihood = drawn(seed)
    usual, cost = maximise(likelihood.cost, UNKNOWNS, np.ones(len(UNKNOWNS)), exactly=True)
    near = usual * np.exp(0.5 * np.random.default_rng(9).standard_normal(len(usual)))
    calls = []

    def curved(x: Array) -> tuple[float, Array, Array]:
        calls.append(x)
        return likelihood.curved(x)

    def none(x: Array) -> tuple[float, Array]:
        raise AssertionError("Newton's method gave up")

    found, same = maximise(none, UNKNOWNS, near, exactly=True, curved=curved)
    assert same == pytest.approx(cost, abs=1e-5)
    assert np.log(found) == pytest.approx(np.log(usual), abs=2e-3)
    assert len(calls) < 20


def test_what_is_stated_stays_and_what_wants_to_pass_a_bound_stops_there() -> None:
    likelihood = drawn(1)
    bounds = [Unknown(0.4, 1.0, (0.4, 0.4)), Unknown(1.0, 2.0, (0.1, 1.2)), *UNKNOWNS[2:]]
    start = np.array([0.4, 1.0, *np.ones(1 + CLOUDS)])
    usual, _ = maximise(likelihood.cost, bounds, start, exactly=True)
    found, _ = maximise(likelihood.cost, bounds, start, exactly=True, curved=likelihood.curved)
    assert found[:2] == pytest.approx([0.4, 1.2])
    assert np.log(found) == pytest.approx(np.log(usual), abs=2e-3)


def test_the_usual_optimiser_goes_on_where_the_curvature_leads_astray() -> None:
    likelihood = drawn(2)

    def astray(x: Array) -> tuple[float, Array, Array]:
        value, slope, curvature = likelihood.curved(x)
        return value, -slope, curvature

    start = np.ones(len(UNKNOWNS))
    usual, _ = maximise(likelihood.cost, UNKNOWNS, start, exactly=True)
    found, _ = maximise(likelihood.cost, UNKNOWNS, start, exactly=True, curved=astray)
    assert found == pytest.approx(usual)
