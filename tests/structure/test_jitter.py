"""The jitter of stamps and late clocks, from a linear system with known truth."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from caliv_graph.products import Array
from caliv_graph.structure.jitter import (
    Clocks,
    jitter_sigma_s,
    told_clocks,
    told_of_jitters,
)
from caliv_graph.structure.layout import Layout

LAYOUT = Layout(poses=2, parameters=0, offsets=(), lidars=1, surface_of=(), jitters=150)


def told(seed: int, jitter_s: Callable[[np.random.Generator], Array]) -> tuple[Array, Array]:
    """What 600 residuals of 2 mm, four per scan, at about 2 m/s, tell of jitters (150,)."""
    rng = np.random.default_rng(seed)
    J = np.zeros((600, LAYOUT.plane))
    J[:, : LAYOUT.jitter] = rng.standard_normal((600, LAYOUT.jitter))
    scan = np.repeat(np.arange(150), 4)
    J[np.arange(600), LAYOUT.jitter + scan] = rng.uniform(-2.0, 2.0, 600)
    truth = np.concatenate([rng.standard_normal(LAYOUT.jitter), jitter_s(rng)])
    r = J @ truth + 0.002 * rng.standard_normal(600)
    return told_of_jitters(J.T @ J / 0.002**2, J.T @ r / 0.002**2, LAYOUT)


def drawn(sigma_s: float, seed: int) -> float:
    """The sigma found where it is this."""
    return jitter_sigma_s(*told(seed, lambda rng: sigma_s * rng.standard_normal(150)))


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
        A, u = told(seed, lambda _: truth[scan_lidar])
        late_s, cov = told_clocks(A, u, scan_lidar, 3)
        sigma_s = np.sqrt(np.diag(cov))
        assert (late_s[2], sigma_s[2]) == pytest.approx((0.0, 0.05))
        assert (sigma_s[:2] < 1e-3).all()
        whitened.append((late_s - truth)[:2] / sigma_s[:2])
    assert np.mean(np.square(whitened)) == pytest.approx(1.0, abs=0.35)
    assert np.abs(whitened).max() < 4.0


def test_clocks_are_apart_by_less_than_each_is_unknown() -> None:
    """An error that is common to both is in neither's difference."""
    values, common = np.array([0.003, 0.0041, 0.0]), np.array([1.0, 1.0, 0.0])
    cov = np.diag([1e-8, 3e-8, 2.5e-3]) + 1e-6 * np.outer(common, common)

    clocks = Clocks.told(("a", "b", "unseen"), values, cov)

    assert clocks.late["b"] == pytest.approx((0.0041, math.sqrt(1.03e-6)))
    assert clocks.apart["a", "b"] == pytest.approx((0.0011, 2e-4))
    assert set(clocks.apart) == {("a", "b"), ("a", "unseen"), ("b", "unseen")}
    assert clocks.apart["a", "unseen"][1] == pytest.approx(math.sqrt(1e-6 + 1e-8 + 2.5e-3))
