"""Waves of the ground by the scatter of its planes at a solution, against known sizes."""

from __future__ import annotations

import numpy as np
import pytest

from caliv_graph.calibration.ground import full_weights
from caliv_graph.calibration.ground_scatter import FEWEST_PLANES, larger_normal_rad
from tests.calibration.problems import make_case
from tests.calibration.test_ground import SIGMAS, observed, with_planes

PLANE = np.array([0.01, -0.02, 0.7])
NORMAL_RAD = float(SIGMAS[0])


def asked(waves_rad: float, seed: int = 0, count: int = 20, odd: int = 0) -> float | None:
    """Planes with the sigmas that they state, and waves; `odd` of them are 0.1 rad off."""
    case = make_case(count=count)
    rng = np.random.default_rng(seed)

    def off(n: int) -> np.ndarray:
        tilt = waves_rad * np.array([1.0, 1.0, 0.0]) * rng.normal(size=3)
        return SIGMAS * rng.normal(size=3) + tilt + (0.1 if n < odd else 0.0)

    planes = observed(case.problem, case.truth, PLANE, off)
    weights = full_weights(case.problem, planes)
    values = with_planes(case.truth, PLANE)
    return larger_normal_rad(case.problem, planes, weights, values, NORMAL_RAD)


@pytest.mark.parametrize("seed", range(5))
def test_planes_that_scatter_as_they_state_ask_for_nothing(seed: int) -> None:
    assert asked(0.0, seed) is None


@pytest.mark.parametrize("seed", range(5))
def test_waves_are_found_and_added(seed: int) -> None:
    assert asked(4 * NORMAL_RAD, seed) == pytest.approx(NORMAL_RAD * np.hypot(1, 4), rel=0.25)


def test_a_plane_that_is_far_off_is_no_waves() -> None:
    assert asked(0.0, odd=1) is None


def test_few_planes_say_nothing() -> None:
    case = make_case(count=2)
    assert len(case.problem.lidars) * 2 < FEWEST_PLANES
    assert asked(10 * NORMAL_RAD, count=2) is None
