"""Waves of the ground by the scatter of its planes at a solution, against known sizes."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from caliv_graph.calibration.ground import full_weights
from caliv_graph.calibration.ground_scatter import FEWEST_PLANES, larger_normal_rad
from caliv_graph.products import Array
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


def test_several_drives_with_a_plane_or_two_each_say_nothing() -> None:
    """Each drive's plane is fitted to what is seen of it."""
    case = make_case(count=5)
    drives = tuple((i, stamp_ns) for i, (_, stamp_ns) in enumerate(case.problem.poses))
    problem = replace(case.problem, poses=drives)
    rng = np.random.default_rng(0)
    planes = observed(problem, case.truth, PLANE, lambda _: 10 * SIGMAS * rng.normal(size=3))
    values, weights = with_planes(case.truth, PLANE, range(5)), full_weights(problem, planes)
    assert len(planes) > FEWEST_PLANES
    assert larger_normal_rad(problem, planes, weights, values, NORMAL_RAD) is None


def by_place(waves: Array, n: int) -> Array:
    return np.asarray(waves[n % len(waves)])


def test_scans_of_one_place_are_no_more_than_one() -> None:
    """Three places seen ten times each, waves alone: they are seldom as the mean has it."""
    floors = np.array([NORMAL_RAD, NORMAL_RAD, 0.002]) ** 2
    found = 0
    for seed in range(20):
        case = make_case(count=30)
        rng = np.random.default_rng(seed)
        waves = NORMAL_RAD * np.append(rng.normal(size=(3, 2)), np.zeros((3, 1)), axis=1)
        planes = observed(case.problem, case.truth, PLANE, partial(by_place, waves))
        alike = [replace(o, repeated=9.0 * floors) for o in planes]
        weights, values = full_weights(case.problem, alike), with_planes(case.truth, PLANE)
        found += larger_normal_rad(case.problem, alike, weights, values, NORMAL_RAD) is not None
    assert found <= 1
