"""What a covariance knows of a LiDAR without a guess, where the drive determines nothing."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from caliv_graph.products import Guess, Uncertainty
from caliv_graph.uncertainty.assemble import assemble_matrices, second_order
from caliv_graph.uncertainty.observability import UNKNOWN_SIGMAS, unguessed

SIGMAS = np.array([0.03] * 3 + [0.2] * 3)
T = gtsam.Pose3(gtsam.Rot3.Yaw(0.5), np.array([2.0, 0.0, 1.8]))
FOUND, GIVEN = Guess(T, SIGMAS, found=True), Guess(T, SIGMAS)


def test_along_what_is_open_the_sigma_is_that_of_nothing() -> None:
    D = np.diag([1e-3**-2.0] * 3 + [0.0] + [1e-2**-2.0] * 2)  # x is open
    held = np.diag([1e-6] * 3 + [0.2**2] + [1e-4] * 2)
    more = unguessed(D, [FOUND])
    assert (held + more)[3, 3] == pytest.approx(UNKNOWN_SIGMAS[3] ** 2)
    assert np.abs(np.delete(more, 3, 0)).max() < 1e-9
    assert not unguessed(D, [GIVEN]).any()


def test_one_guess_is_enough_for_what_lidars_share() -> None:
    """Only the difference of two LiDARs in x is measured: with one guess both are known by it."""
    D = np.diag([1e-3**-2.0] * 3 + [0.0] + [1e-2**-2.0] * 2)
    D = np.asarray(np.kron(np.eye(2), D))
    D[[3, 9, 3, 9], [3, 9, 9, 3]] = np.array([1.0, 1.0, -1.0, -1.0]) * 1e-3**-2.0
    # The sum of both is open; the variance of their mean is that of the one guess.
    total = unguessed(D, [FOUND, GIVEN])[3, 3] + 0.2**2 / 2.0
    assert total == pytest.approx(0.2**2, rel=1e-2)
    alone = unguessed(D, [FOUND, FOUND])[3, 3] + 0.2**2 / 2.0
    assert alone == pytest.approx(10.0**2 / 2.0, rel=1e-2)


def test_an_axis_that_takes_part_in_what_is_open_is_not_determined() -> None:
    yes = dict.fromkeys(("roll", "pitch", "yaw", "x", "y", "z"), True)
    lean = np.array([0.0, 0.0, 0.0, 1.0, 0.1, 0.0])  # open: x with a tenth of y
    D = 1e6 * (np.eye(6) - np.outer(lean, lean) / (lean @ lean))
    cov = np.linalg.inv(D + np.diag(SIGMAS**-2.0))
    uncertainty = Uncertainty((), (), {"front": yes | {"x": False}}, np.zeros(6))
    for guess, determined in ((FOUND, False), (GIVEN, True)):
        found = assemble_matrices(
            {"front": T}, {"front": guess}, cov, D, uncertainty, "front", {"front": 9}
        ).lidars["front"]
        assert found.determined["y"] is determined
        assert found.determined["roll"]
        assert not found.determined["x"]


def test_an_axis_that_an_arc_leaves_only_in_second_order_is_not_determined() -> None:
    """On an arc about (0, -9), a LiDAR at x = 0: a turn moves it along x, and y by its square."""
    yes = dict.fromkeys(("roll", "pitch", "yaw", "x", "y", "z"), True)
    T = gtsam.Pose3(gtsam.Rot3.Yaw(0.5), np.array([0.0, 0.3, 1.8]))
    open_direction = np.array([0.0, 0.0, 1.0, -9.3, 0.0, 0.0])  # turn and place, vehicle axes
    known = 1e-4 * np.eye(6)
    uncertainty = Uncertainty((), (), {"front": yes | {"x": False, "yaw": False}}, np.zeros(6))
    for turn_rad, determined in ((0.7, False), (0.01, True)):
        in_vehicle = turn_rad**2 * np.outer(open_direction, open_direction) + known
        found = assemble_matrices(
            {"front": T},
            {"front": FOUND},
            in_vehicle,
            1e8 * np.eye(6),  # nothing of the prior that is to be taken out
            uncertainty,
            "front",
            {"front": 9},
        ).lidars["front"]
        assert found.determined["y"] is determined
        assert found.determined["z"]


def test_what_a_turn_adds_in_second_order_is_that_of_draws() -> None:
    direction = np.array([0.0, 0.0, 1.0, -9.3, 2.0, 0.0])
    turns = 0.05 * np.random.default_rng(1).standard_normal(200_000)
    # About (0, -9): the place (2, 0.3) on its circle, less where it is in first order.
    arm = np.array([2.0, 9.3])
    moved = np.column_stack(
        [
            np.cos(turns) * arm[0] - np.sin(turns) * arm[1] - arm[0] + turns * arm[1],
            np.sin(turns) * arm[0] + np.cos(turns) * arm[1] - arm[1] - turns * arm[0],
        ]
    )
    expected = second_order(0.05**2 * np.outer(direction, direction))
    np.testing.assert_allclose(expected[3:5], (moved**2).mean(axis=0), rtol=0.1)
    assert not expected[[0, 1, 2, 5]].any()
