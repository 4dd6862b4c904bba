"""Sigmas and verdicts from information alone."""

from __future__ import annotations

import math

import numpy as np
import pytest

from caliv_graph.geometry.se3 import retract_vehicle_axes
from caliv_graph.products import Array, Guess
from caliv_graph.uncertainty.evaluation import evaluate
from caliv_graph.uncertainty.predicted import (
    PredictedCovariance,
    predict_covariance,
)
from tests.samples import MOUNTINGS, pose

LIDARS = {name: pose(*MOUNTINGS[name]) for name in ("front", "rear")}
SIGMAS = np.array([0.03] * 3 + [0.06] * 3)


def make_predicted() -> tuple[Array, PredictedCovariance]:
    rng = np.random.default_rng(5)
    root = rng.normal(size=(12, 48)) * np.tile(1.0 / np.array([1e-3] * 3 + [5e-3] * 3), 2)[:, None]
    D = root @ root.T
    guesses = {name: Guess(T, SIGMAS) for name, T in LIDARS.items()}
    return D, predict_covariance(
        D, ("front", "rear"), "rear", LIDARS, guesses, {"front": 9, "rear": 9}, {}
    )


def test_sigmas_of_a_pair_are_those_of_evaluates_errors() -> None:
    # Draw extrinsics, and let `evaluate` say how far the one is off against the other.
    D, predicted = make_predicted()
    rng = np.random.default_rng(6)
    root = np.linalg.cholesky(np.linalg.inv(D))
    errors = []
    calibration = predicted.calibration
    cov_pairs = {("front", "rear"): np.eye(6)}
    for _ in range(400):
        e = (root @ rng.normal(size=12)).reshape(2, 6)
        truth = {n: retract_vehicle_axes(T, -e[i]) for i, (n, T) in enumerate(LIDARS.items())}
        pair = evaluate(calibration, truth, cov_pairs)["pairs"][0]
        errors.append([*pair["rotation_rad"], *pair["translation_m"]])

    sigma = predicted.sigma_s2s["front", "rear"]
    # 400 draws: a sigma to 3.5 percent, 1 sigma.
    assert np.std(errors, axis=0) / sigma == pytest.approx(np.ones(6), abs=0.15)


def test_a_lidar_without_data_keeps_its_guess() -> None:
    lidars = {**LIDARS, "left": pose(*MOUNTINGS["left"])}
    sigmas = {"front": SIGMAS, "rear": SIGMAS, "left": 2.0 * SIGMAS}
    guesses = {name: Guess(T, sigmas[name]) for name, T in lidars.items()}

    predicted = predict_covariance(
        np.diag(np.tile([1e8] * 3 + [1e6] * 3, 2)),
        ("front", "rear"),
        "rear",
        LIDARS,
        guesses,
        {"front": 20, "rear": 30},
        {},
    )

    assert predicted.unseeing == ("left",)
    assert predicted.sigma_s2v["left"] == pytest.approx(2.0 * SIGMAS)
    result = predicted.calibration.lidars["left"]
    assert not any(result.determined.values())
    assert not result.saw_target
    assert result.cov.trace() == pytest.approx(4.0 * (SIGMAS**2).sum())
    assert predicted.sigma_s2v["front"] == pytest.approx([1e-4] * 3 + [1e-3] * 3)
    expected = math.hypot(1e-3, 1e-3)
    # x of the pair: both, and nothing of rotations for LiDARs in a row along x.
    assert predicted.sigma_s2s["front", "rear"][3] == pytest.approx(expected, rel=1e-6)


def test_without_an_initial_guess_the_solve_is_no_knowledge() -> None:
    """Nothing on x of all; one guess is enough for its own LiDAR, and for no other."""
    axis = [1e-3**-2.0] * 3 + [0.0] + [1e-2**-2.0] * 2
    lidars = {**LIDARS, "left": pose(*MOUNTINGS["left"])}
    found = {name: Guess(T, SIGMAS, found=name != "rear") for name, T in lidars.items()}

    predicted = predict_covariance(
        np.diag(np.tile(axis, 2)), ("front", "rear"), "rear", LIDARS, found, {"front": 9}, {}
    )

    known = [1e-3] * 3
    assert predicted.sigma_s2v["front"] == pytest.approx([*known, 10.0, 1e-2, 1e-2], rel=1e-6)
    assert predicted.sigma_s2v["rear"] == pytest.approx([*known, 0.06, 1e-2, 1e-2], rel=1e-6)
    assert predicted.sigma_s2v["left"] == pytest.approx([math.pi] * 3 + [10.0] * 3)
    results = predicted.calibration.lidars
    assert [axis for axis, told in results["front"].determined.items() if not told] == ["x"]
    assert [name for name, result in results.items() if result.without_guess] == ["front", "left"]
