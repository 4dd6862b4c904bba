"""A chain's information against dense algebra."""

from __future__ import annotations

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


@pytest.mark.parametrize("common", [0, 1, 2])
def test_covariances_are_the_blocks_of_the_inverse(common: int) -> None:
    chain, H = random_chain(6, common)
    inverse = np.linalg.inv(H)

    covariances = chain.covariances()

    for i in range(6):
        at = slice(STATE * i, STATE * (i + 1))
        np.testing.assert_allclose(covariances[i], inverse[at, at], rtol=1e-6, atol=1e-12)
    if common:
        at = slice(STATE * 6, None)
        np.testing.assert_allclose(chain.common_covariance(), inverse[at, at], rtol=1e-6)


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
        chain.covariances()
