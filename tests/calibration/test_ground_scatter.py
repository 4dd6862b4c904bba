"""Waves and heave by the scatter of planes and stands at a solution, against known sizes."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.ground import full_weights, ground_centre
from caliv_graph.calibration.ground_factors import height_over, plane_normal
from caliv_graph.calibration.ground_scatter import FEWEST_PLANES, MOST, GroundLevels, larger_levels
from caliv_graph.calibration.problem import usual_heave_m
from caliv_graph.calibration.sensor_noise import RESIDUALS, usual_noise
from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.model import Config, GroundConfig
from caliv_graph.config.noise import NoiseConfig
from caliv_graph.conventions import key_height
from caliv_graph.products import Array
from tests.calibration.problems import make_case
from tests.calibration.test_ground import SIGMAS, observed, with_planes

LIDARS = {"front": LidarConfig(topic="front")}
NO_HEIGHT = Config(lidars=LIDARS)
HEIGHT_M = 0.4
WITH_HEIGHT = Config(lidars=LIDARS, ground=GroundConfig(vehicle_height=HEIGHT_M, sigma=0.01))
PLANE = np.array([0.01, -0.02, 0.7])
NORMAL_RAD = float(SIGMAS[0])


def asked(waves: Array, seed: int = 0, count: int = 20, odd: int = 0) -> GroundLevels:
    """Planes with the sigmas that they state, and waves (3,); `odd` are 0.1 rad and m off."""
    case = make_case(count=count)
    rng = np.random.default_rng(seed)

    def off(n: int) -> np.ndarray:
        own, common = SIGMAS * rng.normal(size=3), waves * rng.normal(size=3)
        return np.asarray(own + common + (0.1 if n < odd else 0.0))

    planes = observed(case.problem, case.truth, PLANE, off)
    weights = full_weights(case.problem, planes)
    values = with_planes(case.truth, PLANE)
    return larger_levels(case.problem, planes, weights, values, NO_HEIGHT)


TILTS, DISTANCES = np.array([1.0, 1.0, 0.0]) * SIGMAS, np.array([0.0, 0.0, 1.0]) * SIGMAS
STATED = GroundLevels(NORMAL_RAD, float(SIGMAS[2]), usual_heave_m())
"""Those of the problem: `observed` has no other errors than these."""


@pytest.mark.parametrize("seed", range(5))
def test_planes_that_scatter_as_they_state_ask_for_nothing(seed: int) -> None:
    assert asked(0.0 * TILTS, seed) == STATED


@pytest.mark.parametrize("seed", range(5))
def test_waves_are_found_and_added(seed: int) -> None:
    tilted = asked(4 * TILTS, seed)
    assert tilted.normal_rad == pytest.approx(NORMAL_RAD * np.hypot(1, 4), rel=0.25)
    assert replace(tilted, normal_rad=NORMAL_RAD) == STATED
    lifted = asked(4 * DISTANCES, seed)
    assert lifted.distance_m == pytest.approx(STATED.distance_m * np.hypot(1, 4), rel=0.35)
    assert replace(lifted, distance_m=STATED.distance_m) == STATED


def test_a_plane_that_is_far_off_is_no_waves() -> None:
    assert asked(0.0 * TILTS, odd=1) == STATED


def test_few_planes_say_nothing() -> None:
    case = make_case(count=2)
    assert len(case.problem.lidars) * 2 < FEWEST_PLANES
    assert asked(10 * (TILTS + DISTANCES), count=2) == STATED


def test_several_drives_with_a_plane_or_two_each_say_nothing() -> None:
    """Each drive's plane is fitted to what is seen of it."""
    case = make_case(count=5)
    drives = tuple((i, stamp_ns) for i, (_, stamp_ns) in enumerate(case.problem.poses))
    problem = replace(case.problem, poses=drives)
    rng = np.random.default_rng(0)
    planes = observed(problem, case.truth, PLANE, lambda _: 10 * SIGMAS * rng.normal(size=3))
    values, weights = with_planes(case.truth, PLANE, range(5)), full_weights(problem, planes)
    assert len(planes) > FEWEST_PLANES
    assert larger_levels(problem, planes, weights, values, NO_HEIGHT) == STATED


def standing(
    heave_m: float,
    seed: int,
    error_m: float = 0.0,
    waves_m: float = 0.0,
    noise: NoiseConfig | None = None,
    at_once: int = 1,
) -> GroundLevels:
    """What is asked for where the vehicle heaves and stands on waves, which planes see too.

    `error_m` is the drive's, so many poses are of one moment and have one heave.
    """
    case, rng = make_case(count=80), np.random.default_rng(seed)
    problem, values = case.problem, with_planes(case.truth, PLANE)
    poses = tuple(
        (d, problem.poses[i - i % at_once][1] + i) for i, (d, _) in enumerate(problem.poses)
    )
    problem = replace(problem, poses=poses)
    values.update(key_height(0), np.array([error_m]))
    centre = ground_centre(problem, 0)
    waves, lifts = waves_m * rng.normal(size=80), heave_m * rng.normal(size=80)
    for i, key in enumerate(problem.pose_keys()):
        T = values.atPose3(key)
        above = height_over(PLANE, centre, T.translation())[0]
        lift = HEIGHT_M + error_m + waves[i] + lifts[i - i % at_once] - above
        up = lift * plane_normal(PLANE)
        values.update(key, gtsam.Pose3(T.rotation(), T.translation() + up))
    planes = observed(problem, values, PLANE, lambda n: np.array([0.0, 0.0, waves[n % 80]]))
    config = WITH_HEIGHT if noise is None else WITH_HEIGHT.model_copy(update={"noise": noise})
    return larger_levels(problem, planes, full_weights(problem, planes), values, config)


USUAL_M = math.hypot(STATED.heave_m, STATED.distance_m)
"""1 sigma of a stand, of heave and the waves below it."""


@pytest.mark.parametrize("seed", range(5))
def test_heave_is_found_by_how_the_vehicle_stands(seed: int) -> None:
    assert standing(USUAL_M, seed, error_m=0.05) == STATED
    found = standing(5 * USUAL_M, seed, error_m=0.05)
    assert math.hypot(found.heave_m, found.distance_m) == pytest.approx(5 * USUAL_M, rel=0.2)
    assert replace(found, heave_m=STATED.heave_m) == STATED


@pytest.mark.parametrize("seed", range(5))
def test_waves_below_the_vehicle_are_no_heave(seed: int) -> None:
    found = standing(0.0, seed, waves_m=5 * USUAL_M)
    assert found.distance_m == pytest.approx(5 * USUAL_M, rel=0.2)
    assert found.heave_m == STATED.heave_m


def test_poses_of_one_moment_have_one_heave() -> None:
    found = [standing(USUAL_M, seed, at_once=10).heave_m for seed in range(20)]
    assert sum(heave > STATED.heave_m for heave in found) <= 1


def test_what_a_config_states_is_held() -> None:
    waves_m = 5 * USUAL_M
    stated = NoiseConfig(ground_distance_m=0.002)
    found = standing(0.0, 0, waves_m=waves_m, noise=stated)
    assert found.distance_m == STATED.distance_m
    assert found.heave_m == pytest.approx(waves_m, rel=0.2)
    stated = NoiseConfig(heave_m=0.005)
    found = standing(waves_m, 0, noise=stated)
    assert found.heave_m == STATED.heave_m


def test_a_level_beyond_any_ground_is_not_asked_for() -> None:
    assert standing(1.0, 0).heave_m == MOST.heave_m


def test_levels_that_are_larger_say_where_they_are_from() -> None:
    noise = usual_noise(NoiseConfig())
    found = GroundLevels(2 * NORMAL_RAD, STATED.distance_m, 0.03)
    after = noise.with_ground_levels(found)
    np.testing.assert_array_equal(after.floors, [2 * NORMAL_RAD, 2 * NORMAL_RAD, SIGMAS[2]])
    assert after.heave_m == 0.03
    source = {level.name: level.source for level in after.levels}
    assert source["ground_normal"] == source["heave"] == RESIDUALS
    assert source["ground_distance"] == "the usual figure"


def by_place(waves: Array, n: int) -> Array:
    return np.asarray(waves[n % len(waves)])


def test_scans_of_one_place_are_no_more_than_one() -> None:
    """Three places seen ten times each, waves alone: they are seldom as the mean has it."""
    floors = SIGMAS**2
    found = 0
    for seed in range(20):
        case = make_case(count=30)
        rng = np.random.default_rng(seed)
        waves = NORMAL_RAD * np.append(rng.normal(size=(3, 2)), np.zeros((3, 1)), axis=1)
        planes = observed(case.problem, case.truth, PLANE, partial(by_place, waves))
        alike = [replace(o, repeated=np.diag(9.0 * floors)) for o in planes]
        weights, values = full_weights(case.problem, alike), with_planes(case.truth, PLANE)
        levels = larger_levels(case.problem, alike, weights, values, NO_HEIGHT)
        found += levels.normal_rad > NORMAL_RAD
    assert found <= 1
