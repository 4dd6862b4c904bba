"""A chain's information against dense algebra."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
import pytest

from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array
from caliv_graph.trajectory.chain import STATE, Chain


def random_chain(n: int, common: int, seed: int = 0) -> tuple[Chain, Array]:
    """A chain and the dense information it stands for."""
    rng = np.random.default_rng(seed)
    size = STATE * n + common
    H = np.zeros((size, size))
    for i in range(n - 1):
        at = np.r_[STATE * i : STATE * (i + 2)]
        J = rng.standard_normal((20, 2 * STATE))
        H[np.ix_(at, at)] += J.T @ J
    for i in range(n):
        at = np.r_[STATE * i : STATE * (i + 1), STATE * n : size]
        J = rng.standard_normal((4, len(at)))
        H[np.ix_(at, at)] += J.T @ J
    H += 0.5 * np.eye(size)
    units = np.exp(rng.uniform(-4.0, 4.0, size))  # rad, m, m/s: some large, some small
    H = H * np.outer(units, units)
    body = H[: STATE * n, : STATE * n].reshape(n, STATE, n, STATE)
    at = np.arange(n)
    return (
        Chain(
            diagonal=body[at, :, at, :],
            coupling=body[at[:-1], :, at[1:], :],
            border=H[: STATE * n, STATE * n :].reshape(n, STATE, common),
            corner=H[STATE * n :, STATE * n :],
        ),
        H,
    )


def marginal(H: Array, keep: list[int]) -> Array:
    """The information of some coordinates, the others eliminated: the inverse of their part."""
    return np.asarray(np.linalg.inv(np.linalg.inv(H)[np.ix_(keep, keep)]))


@pytest.mark.parametrize("common", [0, 2])
@pytest.mark.parametrize("n", [1, 4, 7])
def test_the_head_of_a_chain_is_the_marginal(n: int, common: int) -> None:
    chain, H = random_chain(7, common, seed=5)

    head = chain.head(n)

    size = STATE * n
    expected = marginal(H, [*range(size), *range(STATE * 7, len(H))])
    scale = np.sqrt(np.diag(expected))
    found = np.zeros_like(expected)
    for i in range(n):
        own = slice(STATE * i, STATE * (i + 1))
        found[own, own] = head.diagonal[i]
        found[own, size:] = head.border[i]
        found[size:, own] = head.border[i].T
        if i + 1 < n:
            after = slice(own.stop, own.stop + STATE)
            found[own, after] = head.coupling[i]
            found[after, own] = head.coupling[i].T
    found[size:, size:] = head.corner
    np.testing.assert_allclose(
        found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-6
    )


@pytest.mark.parametrize("common", [0, 1])
@pytest.mark.parametrize(
    "wanted", [[0], [3], [6], [0, 6], [1, 2, 5], [0, 1, 2, 3, 4, 5, 6]], ids=str
)
def test_joint_information_of_poses_is_the_marginal(wanted: list[int], common: int) -> None:
    chain, H = random_chain(7, common, seed=3)
    keep = [STATE * i + j for i in wanted for j in range(6)]

    information = chain.pose_information(np.array(wanted))

    expected = marginal(H, keep)
    scale = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
    np.testing.assert_allclose(information / scale, expected / scale, atol=1e-7)


def test_what_nothing_determines_is_an_error() -> None:
    chain, _ = random_chain(3, 0)
    chain.diagonal[1] = 0.0
    chain.coupling[:] = 0.0

    with pytest.raises(TrajectoryError, match="do not determine"):
        chain.pose_information(np.array([0, 2]))


def linear_graph(states: int, seed: int = 5) -> gtsam.GaussianFactorGraph:
    """Random factors on states of three variables each, on neighbours, and with a common one."""
    rng = np.random.default_rng(seed)
    graph = gtsam.GaussianFactorGraph()
    unit = gtsam.noiseModel.Unit.Create(4)
    make: Any = gtsam.JacobianFactor

    def add(*keys: int) -> None:
        parts = [(key, rng.standard_normal((4, DIMS[key % 10]))) for key in keys]
        terms = [term for part in parts for term in part]
        graph.add(make(*terms, rng.standard_normal(4), unit))

    for i in range(states):
        add(10 * i, 10 * i + 1)
        add(10 * i + 1, 10 * i + 2)
        add(10 * i, COMMON)
        if i:
            add(10 * i - 10, 10 * i)
            add(10 * i - 8, 10 * i + 1)
    return graph


DIMS = {0: 6, 1: 3, 2: 6, 9: 1}
COMMON = 1009
STATES = 7
KEYS = [(10 * i, 10 * i + 1, 10 * i + 2) for i in range(STATES)]


@pytest.mark.parametrize(("factors", "rows"), [(1, 1000), (4, 1000), (1000, 1000), (1000, 5)])
def test_a_graph_becomes_a_chain_in_parts(
    factors: int, rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("caliv_graph.trajectory.chain.FACTORS_AT_A_TIME", factors)
    monkeypatch.setattr("caliv_graph.trajectory.chain.ROWS_AT_A_TIME", rows)
    graph = linear_graph(STATES)
    ordering = gtsam.Ordering()
    for key in [key for keys in KEYS for key in keys] + [COMMON]:
        ordering.push_back(key)
    H, _ = graph.hessian(ordering)

    chain = Chain.from_graph(graph, KEYS, (6, 3, 6), [COMMON])

    dense = np.zeros_like(H)
    for i in range(STATES):
        at, after = slice(STATE * i, STATE * i + STATE), slice(STATE * i + STATE, STATE * (i + 2))
        dense[at, at] = chain.diagonal[i]
        if i + 1 < STATES:
            dense[at, after], dense[after, at] = chain.coupling[i], chain.coupling[i].T
        dense[at, -1:] = chain.border[i]
        dense[-1:, at] = chain.border[i].T
    dense[-1:, -1:] = chain.corner
    np.testing.assert_allclose(dense, H, atol=1e-12)


def test_a_graph_that_is_no_chain_is_refused() -> None:
    graph = linear_graph(STATES)
    unit = gtsam.noiseModel.Unit.Create(4)
    graph.add(gtsam.JacobianFactor(0, np.ones((4, 6)), 20, np.ones((4, 6)), np.zeros(4), unit))
    with pytest.raises(ValueError, match="not neighbours"):
        Chain.from_graph(graph, KEYS, (6, 3, 6), [COMMON])
