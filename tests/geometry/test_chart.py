"""Coordinates of poses about a pivot."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from caliv_graph.geometry.chart import PoseChart

CHART = PoseChart(np.array([1.2, -0.3, 0.5]))


def test_a_pose_is_that_of_its_coordinates() -> None:
    rng = np.random.default_rng(1)
    d = 0.5 * rng.standard_normal(6)
    assert CHART.coordinates(CHART.pose(d)) == pytest.approx(d)
    # To the first order they are a right perturbation.
    assert CHART.coordinates(gtsam.Pose3.Expmap(1e-6 * d)) == pytest.approx(1e-6 * d, abs=1e-11)


def test_derivatives_are_those_of_the_coordinates() -> None:
    directions = np.random.default_rng(2).standard_normal((6, 6))
    # On both sides of where a series ends.
    sizes = np.array([0.0, 1e-4, 0.1, 0.29, 0.31, 2.0]) / np.linalg.norm(directions[:, :3], axis=1)
    moved = sizes[:, None] * directions
    for d, derivative in zip(moved, CHART.derivatives(moved), strict=True):
        T = CHART.pose(d)
        for k, e in enumerate(1e-6 * np.eye(6)):
            ahead, behind = (CHART.coordinates(T.retract(step)) for step in (e, -e))
            assert derivative[:, k] == pytest.approx((ahead - behind) / 2e-6, abs=1e-8)


def test_derivatives_where_a_series_ends_are_to_the_last_digits() -> None:
    turns = np.zeros((2, 6))
    turns[:, :3] = np.array([[0.3 - 1e-13], [0.3 + 1e-13]]) * [0.6, 0.0, 0.8]
    one, other = CHART.derivatives(turns)
    assert one == pytest.approx(other, abs=1e-12)


def test_a_turn_about_the_pivot_moves_all_shifts_alike() -> None:
    """The IMU at 1.2 -0.3 0.5 m is askew by 60 mrad; the vehicle heaves by 10 and -20 mm."""
    c, turn = CHART.pivot_vehicle, gtsam.Rot3.Expmap(np.array([0.06, 0.01, -0.02]))
    about = gtsam.Pose3(turn, c - turn.matrix() @ c)
    moves = []
    for heave in (0.0, 0.01, -0.02):
        before = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, heave]))
        moves.append(CHART.coordinates(before.compose(about)) - CHART.coordinates(before))
    assert moves[1:] == [pytest.approx(moves[0], abs=1e-15)] * 2
