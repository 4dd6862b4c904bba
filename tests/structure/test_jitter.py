"""The sigma of the jitter of stamps, from a linear system with known truth."""

import numpy as np
import pytest

from caliv_graph.structure.jitter import jitter_sigma_s, told_clocks, told_of_jitters
from caliv_graph.structure.layout import Layout

LAYOUT = Layout(poses=2, parameters=0, offsets=(), lidars=1, surface_of=(), jitters=150)


def drawn(sigma_s: float, seed: int) -> float:
    """The sigma found in 600 residuals of 2 mm, four per scan, at about 2 m/s."""
    rng = np.random.default_rng(seed)
    J = np.zeros((600, LAYOUT.plane))
    J[:, : LAYOUT.jitter] = rng.standard_normal((600, LAYOUT.jitter))
    scan = np.repeat(np.arange(150), 4)
    J[np.arange(600), LAYOUT.jitter + scan] = rng.uniform(-2.0, 2.0, 600)
    truth = rng.standard_normal(LAYOUT.plane)
    truth[LAYOUT.jitter :] *= sigma_s
    r = J @ truth + 0.002 * rng.standard_normal(600)
    H, b = J.T @ J / 0.002**2, J.T @ r / 0.002**2
    return jitter_sigma_s(*told_of_jitters(H, b, LAYOUT))


def test_the_sigma_is_found() -> None:
    found = [drawn(0.0015, seed) for seed in range(10)]
    assert np.mean(found) == pytest.approx(0.0015, rel=0.07)


def test_without_jitter_there_is_none() -> None:
    assert [drawn(0.0, seed) for seed in range(20)].count(0.0) >= 19


def test_a_late_clock_is_the_same_jitter_in_all_scans_of_a_lidar() -> None:
    """Its value and its sigma; one that is seen in no scan is zero under its prior of 50 ms."""
    truth = np.array([0.02, 0.0, 0.0])
    scan_lidar = np.arange(150) % 2  # nothing of the third
    whitened = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        J = np.zeros((600, LAYOUT.plane))
        J[:, : LAYOUT.jitter] = rng.standard_normal((600, LAYOUT.jitter))
        scan = np.repeat(np.arange(150), 4)
        J[np.arange(600), LAYOUT.jitter + scan] = rng.uniform(-2.0, 2.0, 600)
        d = rng.standard_normal(LAYOUT.plane)
        d[LAYOUT.jitter :] = truth[scan_lidar]
        r = J @ d + 0.002 * rng.standard_normal(600)
        A, u = told_of_jitters(J.T @ J / 0.002**2, J.T @ r / 0.002**2, LAYOUT)
        late_s, sigma_s = told_clocks(A, u, scan_lidar, 3)
        assert (late_s[2], sigma_s[2]) == pytest.approx((0.0, 0.05))
        assert (sigma_s[:2] < 1e-3).all()
        whitened.append((late_s - truth)[:2] / sigma_s[:2])
    assert np.mean(np.square(whitened)) == pytest.approx(1.0, abs=0.35)
    assert np.abs(whitened).max() < 4.0
