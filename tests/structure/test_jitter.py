"""The sigma of the jitter of stamps, from a linear system with known truth."""

import numpy as np
import pytest

from caliv_graph.structure.jitter import jitter_sigma_s
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
    return jitter_sigma_s(H, b, LAYOUT)


def test_the_sigma_is_found() -> None:
    found = [drawn(0.0015, seed) for seed in range(10)]
    assert np.mean(found) == pytest.approx(0.0015, rel=0.07)


def test_without_jitter_there_is_none() -> None:
    assert [drawn(0.0, seed) for seed in range(20)].count(0.0) >= 19
