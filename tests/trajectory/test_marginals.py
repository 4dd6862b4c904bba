"""Marginal covariances against the inverse of the whole."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
import pytest

from caliv_graph.conventions import key_bias, key_imu, key_velocity, key_yaw_bias
from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array
from caliv_graph.trajectory.marginals import Marginals, node_ordering

NODES = 5


def random_graph(units: float, loose: int = -1) -> gtsam.GaussianFactorGraph:
    """Neighbours tied to each other, and every pose to the yaw bias; `loose`: a node left out.

    Variables are of very different size: `units` is the spread of their sigmas in powers of ten.
    """
    rng = np.random.default_rng(3)
    graph, unit = gtsam.GaussianFactorGraph(), gtsam.noiseModel.Unit.Create(6)

    make: Any = gtsam.JacobianFactor

    def some(size: int) -> Array:
        return rng.standard_normal((6, size)) * 10.0 ** rng.uniform(-units, units, size)

    def add(*parts: tuple[int, int]) -> None:
        terms = [term for key, size in parts for term in (key, some(size))]
        graph.add(make(*terms, np.zeros(6), unit))

    for i in range(NODES):
        if i == loose:
            continue
        add((key_imu(i), 6), (key_velocity(i), 3))
        add((key_imu(i), 6), (key_bias(i), 6))
        add((key_bias(i), 6), (key_imu(i), 6))
        add((key_imu(i), 6), (key_yaw_bias(), 1))
        if i and i - 1 != loose:
            add((key_imu(i - 1), 6), (key_imu(i), 6))
            add((key_bias(i - 1), 6), (key_velocity(i), 3))
    if loose >= 0:
        # In the graph, but five of its six coordinates unknown.
        one = np.zeros((6, 6))
        one[0, 0] = 1.0
        for key, size in ((key_imu(loose), 6), (key_bias(loose), 6), (key_velocity(loose), 3)):
            graph.add(gtsam.JacobianFactor(key, one[:, :size], np.zeros(6), unit))
    return graph


@pytest.mark.parametrize("units", [0.0, 1.5])
def test_marginals_are_blocks_of_the_inverse(units: float) -> None:
    graph, ordering = random_graph(units), node_ordering(NODES, True)
    H, _ = graph.hessian(ordering)
    scale = np.sqrt(H.diagonal())
    inverse = np.linalg.inv(H / np.outer(scale, scale)) / np.outer(scale, scale)

    marginals = Marginals(graph, ordering)

    # Order within a node: bias, velocity, pose; the yaw bias is the last of all.
    for keys, first in (([key_bias(i) for i in range(NODES)], 0), ([key_imu(1), key_imu(4)], 9)):
        found = marginals.covariances(keys)
        for cov, key in zip(found, keys, strict=True):
            at = 15 * gtsam.Symbol(key).index() + first
            expected = inverse[at : at + 6, at : at + 6]
            size = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
            np.testing.assert_allclose(cov / size, expected / size, atol=1e-7)
    (yaw,) = marginals.covariances([key_yaw_bias()])
    assert yaw[0, 0] == pytest.approx(inverse[-1, -1], rel=1e-7)


def test_what_nothing_determines_is_an_error() -> None:
    with pytest.raises(TrajectoryError, match="do not determine"):
        Marginals(random_graph(0.0, loose=2), node_ordering(NODES, True)).covariances([key_imu(2)])
