"""Biases of the ranges in the solve of structure: their size is found, or stated."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from caliv_graph.config.range_errors import RangeErrors, offset_prior
from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.products import Array
from caliv_graph.structure.solve import Solved
from caliv_graph.structure.term import term_of
from tests.structure.test_solve import (
    GUESS_SIGMAS,
    between,
    information_of,
    problem_of,
    solve,
)
from tests.structure.yards import TRUE, Noise, figure_eight, yard

TURN, POSES = 48, 8
"""The first eight of the poses of a figure-eight: a quarter of a turn, on which place and range
bias of a LiDAR are hard to tell apart."""

WITHOUT_HEIGHT = [0, 1, 2, 3, 4]


@cache
def solved(seed: int, bias_m: float, stated_m: float | None) -> Solved:
    positions, yaws = figure_eight(TURN)
    problem = problem_of(yard(), (positions[:POSES], yaws[:POSES]), seed, Noise(bias_m=bias_m))
    return solve(replace(problem, range_errors=RangeErrors(stated_m)))


def s2s(found: Solved) -> tuple[Array, Array]:
    """Error (5,) of S2S and its covariance, without the height that walls do not tell."""
    pairs = zip(found.state.T_vehicle_lidar, TRUE.values(), strict=True)
    error = np.concatenate([vehicle_axes_difference(T, true) for T, true in pairs])
    H = information_of(term_of(found, np.arange(POSES)), found.problem.prior.information)
    cov = np.linalg.inv(H + np.diag(np.tile(GUESS_SIGMAS**-2.0, 2)))
    axes = np.array([between(column) for column in np.eye(12)]).T[WITHOUT_HEIGHT]
    return axes @ error, axes @ cov @ axes.T


def test_a_centimetre_of_bias_stays_within_the_sigmas() -> None:
    errors = [s2s(solved(seed, 0.01, None)) for seed in range(4)]
    squares = [float(e @ np.linalg.solve(cov, e)) for e, cov in errors]
    assert 5.9 < sum(squares) < 45.3  # 20 degrees of freedom, 1 of 1000 beyond either


def test_what_is_stated_is_believed() -> None:
    stated, unknown = solved(0, 0.01, 0.001), solved(0, 0.01, None)
    assert stated.nuisances.bias == pytest.approx(0.001)
    assert unknown.nuisances.bias > 0.003
    along = [np.sqrt(s2s(found)[1][3, 3]) for found in (stated, unknown)]
    assert along[0] < 0.8 * along[1]


def test_the_size_of_the_biases_is_found() -> None:
    """Where the drive tells the biases apart from the places; elsewhere the prior is left."""
    usual_m = offset_prior(None).usual
    found = {}
    for bias_m in (0.0, 0.01):
        problem = problem_of(yard(3), figure_eight(16), 1, Noise(bias_m=bias_m))
        found[bias_m] = solve(problem).nuisances.bias
    assert found[0.0] < 0.7 * usual_m < usual_m < found[0.01]
