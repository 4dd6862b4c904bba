"""The heave on a Gaussian of poses."""

import numpy as np
import pytest

from caliv_graph.calibration.heave import HEAVE_TIME_S, heave_covariance, with_heave


def test_heave_adds_its_covariance_to_that_of_the_heights() -> None:
    rng = np.random.default_rng(0)
    stamps = np.array([0, 30_000_000, 100_000_000, 500_000_000])
    J = rng.standard_normal((60, 27))
    information, gradient = J.T @ J, rng.standard_normal(27)
    out, out_gradient = with_heave(information, gradient, stamps, 0.5)
    cov = np.linalg.inv(information)
    z = np.arange(5, 24, 6)
    cov[np.ix_(z, z)] += heave_covariance(stamps, 0.5)
    assert np.linalg.inv(out) == pytest.approx(cov, rel=1e-6, abs=1e-9)
    mean = np.linalg.solve(information, gradient)
    assert np.linalg.solve(out, out_gradient) == pytest.approx(mean, rel=1e-6)


def test_heave_is_common_to_near_stamps_and_white_from_scan_to_scan() -> None:
    C = heave_covariance(np.array([0, 25_000_000, round(1e9 * HEAVE_TIME_S)]), 0.005)
    assert C / 0.005**2 == pytest.approx(
        np.array([[1.0, 0.75, 0.0], [0.75, 1.0, 0.25], [0.0, 0.25, 1.0]])
    )
