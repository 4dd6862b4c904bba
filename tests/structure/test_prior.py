"""The motion data's Gaussian on poses, away from where it was linearised."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from caliv_graph.geometry.chart import PoseChart
from caliv_graph.products import Array
from caliv_graph.structure.prior import PosePrior

POSES = 3
CHART = PoseChart(np.array([0.5, -0.2, 0.4]))


def test_a_prior_is_linearised_where_its_poses_are() -> None:
    rng = np.random.default_rng(5)
    A = rng.standard_normal((21, 21))
    prior = PosePrior(
        stamps_ns=np.arange(POSES),
        T_map_vehicle=tuple(gtsam.Pose3.Expmap(v) for v in rng.standard_normal((POSES, 6))),
        parameters={"gnss.lever_arm": np.zeros(3)},
        information=A @ A.T,
        gradient=rng.standard_normal(21),
        parameter_information=np.eye(3),
        parameter_offset=np.zeros(3),
        chart=CHART,
    )
    moved = 0.3 * rng.standard_normal(21)

    H, b = prior.at(moved)

    def error(e: Array) -> float:
        d = moved + e
        for i in range(POSES):
            own = slice(6 * i, 6 * i + 6)
            d[own] = CHART.coordinates(CHART.pose(moved[own]).compose(gtsam.Pose3.Expmap(e[own])))
        return float(0.5 * d @ prior.information @ d - prior.gradient @ d)

    slope = [(error(e) - error(-e)) / 2e-5 for e in 1e-5 * np.eye(21)]
    assert -b == pytest.approx(np.array(slope), rel=1e-6, abs=1e-6)
    # What d is to first order, squared: the curvature of the chart has no part in H.
    first = np.eye(21)
    for i, block in enumerate(prior.by_now(moved)):
        own = slice(6 * i, 6 * i + 6)
        first[own, own] = block
    assert pytest.approx(first.T @ prior.information @ first) == H
    assert prior.at(np.zeros(21))[0] is prior.information


def test_the_marginal_is_that_of_the_whole_prior_there() -> None:
    rng = np.random.default_rng(3)
    A = rng.standard_normal((24, 24))
    size = 6 * POSES + 3
    prior = PosePrior(
        stamps_ns=np.arange(POSES),
        T_map_vehicle=tuple(gtsam.Pose3.Expmap(v) for v in rng.standard_normal((POSES, 6))),
        parameters={"gnss.lever_arm": np.zeros(3)},
        information=(A @ A.T)[:size, :size],
        gradient=rng.standard_normal(size),
        parameter_information=np.eye(3),
        parameter_offset=np.zeros(3),
        chart=CHART,
    )
    moved = 0.3 * rng.standard_normal(size)
    H, b = prior.at(moved)
    for kept in ([2, 0], [1], [], [0, 1, 2]):
        own = np.concatenate([*(6 * i + np.arange(6) for i in kept), 6 * POSES + np.arange(3)])
        cov = np.linalg.inv(H)[np.ix_(own, own)]

        information, gradient = prior.marginal_at(moved, np.array(kept, dtype=np.int64))

        assert np.linalg.inv(information) == pytest.approx(cov)
        assert cov @ gradient == pytest.approx(np.linalg.solve(H, b)[own])
