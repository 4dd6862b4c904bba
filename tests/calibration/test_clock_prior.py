"""The prior of the clock of the GNSS: the Gaussian that stands for a mixture."""

from __future__ import annotations

import numpy as np
import pytest

from caliv_graph.calibration.clock_prior import Moments, gaussian_prior
from caliv_graph.products import Array

WIDE = Moments(0.0, 0.02**2)
EXACT = (0.5, Moments(0.0, 1e-4**2))
WITH_IMU = (0.3, Moments(-5e-3, 3e-4**2))


def normal(x: Array, of: Moments) -> Array:
    return np.asarray(np.exp(-0.5 * (x - of.mean) ** 2 / of.variance) / np.sqrt(of.variance))


def product(one: Moments, other: Moments) -> Moments:
    """Mean and variance of the product of two Gaussians."""
    variance = 1.0 / (1.0 / one.variance + 1.0 / other.variance)
    return Moments(variance * (one.mean / one.variance + other.mean / other.variance), variance)


@pytest.mark.parametrize("data", [0.0, 2e-3, -3e-3, 4.5e-3])
def test_its_posterior_has_mean_and_variance_of_the_mixture(data: float) -> None:
    likelihood = Moments(data, 2e-3**2)
    by_lidars, by_imu = EXACT, WITH_IMU
    # By the trapezoidal rule on a fine grid.
    x = np.linspace(-0.1, 0.1, 400_001)
    mixture = 0.5 * normal(x, by_lidars[1]) + 0.3 * normal(x, by_imu[1]) + 0.2 * normal(x, WIDE)
    posterior = mixture * normal(x, likelihood)
    posterior /= posterior.sum()
    mean = float(posterior @ x)
    variance = float(posterior @ (x - mean) ** 2)

    prior = gaussian_prior(product(likelihood, WIDE), WIDE, [by_lidars, by_imu])

    found = product(prior, likelihood)
    # The Gaussian that is wider than the wide one, where two clocks are as likely, is the wide one.
    if prior != WIDE:
        assert found.mean == pytest.approx(mean, abs=1e-7)
        assert found.variance == pytest.approx(variance, rel=1e-3)
    else:
        assert variance > product(WIDE, likelihood).variance


def test_a_clock_that_is_late_keeps_the_wide_prior_and_one_that_fits_is_exact() -> None:
    def posterior(data: float, clocks: list[tuple[float, Moments]]) -> Moments:
        likelihood = Moments(data, 2e-3**2)
        return product(gaussian_prior(product(likelihood, WIDE), WIDE, clocks), likelihood)

    late = posterior(0.03, [EXACT])
    # 30 ms by the data to 2 ms, under a prior of 20 ms: 30 (1 - 2^2 / (20^2 + 2^2)).
    assert late.mean == pytest.approx(0.0297, abs=1e-4)
    assert np.sqrt(late.variance) == pytest.approx(1.99e-3, rel=0.01)
    fits = posterior(0.0, [EXACT])
    assert abs(fits.mean) < 1e-6
    # By hand: the odds are 0.5 / 2.002 to 0.5 / 20.1, 9 percent late: 0.0906 1.99^2 + 0.91 0.1^2.
    assert np.sqrt(fits.variance) == pytest.approx(0.607e-3, rel=0.01)
    # 5 ms off, as the IMU is: one clock for both.
    assert posterior(-5e-3, [EXACT, WITH_IMU]).mean == pytest.approx(-5e-3, abs=4e-4)


def test_data_that_say_nothing_leave_the_mixture() -> None:
    prior = gaussian_prior(WIDE, WIDE, [(0.8, EXACT[1])])

    assert prior.mean == pytest.approx(0.0, abs=1e-9)
    assert prior.variance == pytest.approx(0.8 * 1e-8 + 0.2 * 0.02**2, rel=1e-3)
