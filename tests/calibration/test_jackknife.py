"""Scale of the registration by leaving out clouds: which, when, and what it leaves as it is."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, replace
from functools import cache

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.jackknife import (
    GROUPS,
    LEAST_LIDAR_CLOUDS,
    ROUNDS,
    TOGETHER,
    _groups,
    _stays_below_one,
    _tell,
    jackknife_scale,
)
from caliv_graph.calibration.linear import CloudLinearisation, linearise_clouds
from caliv_graph.calibration.problem import Problem
from caliv_graph.conventions import key_extrinsic, key_pose_error, key_target, key_vehicle
from caliv_graph.products import BoolArray
from caliv_graph.registration.register import JointRegistration
from tests.calibration.problems import PERIOD_NS, SIGMAS, make_case, with_clouds
from tests.registration.scenes import chair_scene, config_of, matrices
from tests.samples import pose

CLOUDS = 32


def every(problem: Problem) -> BoolArray:
    """All clouds have a say."""
    return np.ones(problem.clouds, dtype=bool)


# ------------------------------------------------------------------ what is left out


def test_neighbouring_clouds_of_a_lidar_are_left_out_together() -> None:
    problem = make_case("front", "rear", count=24, drives=2).problem
    group = _groups(problem, every(problem))
    assert set(group.tolist()) == set(range(GROUPS))
    for lidar in range(2):
        for placement in range(2):
            own = (problem.cloud_lidar == lidar) & (problem.cloud_placement == placement)
            assert np.bincount(group[own]).tolist() == [24 // GROUPS] * GROUPS
            in_time = group[own][np.argsort(problem.cloud_pose[own])]
            runs = in_time.reshape(-1, TOGETHER)
            np.testing.assert_array_equal(runs, np.tile(runs[:, :1], (1, TOGETHER)))
            # In turn: what a part misses, parts before and after it have.
            assert runs[:, 0].tolist() == [n % GROUPS for n in range(len(runs))]


def test_clouds_of_a_lidar_with_few_are_left_out_one_by_one() -> None:
    problem = make_case("front", "rear", count=24).problem
    kept = (problem.cloud_lidar == 0) | (problem.cloud_pose % 2 == 0)
    some = with_clouds(problem, kept)
    group = _groups(some, every(some))
    for lidar, in_a_row in ((0, TOGETHER), (1, 1)):
        own = np.flatnonzero(some.cloud_lidar == lidar)
        own = own[np.argsort(some.cloud_pose[own])]
        assert group[own].tolist() == [n // in_a_row % GROUPS for n in range(len(own))]


def test_clouds_are_grouped_in_the_order_of_time() -> None:
    problem = make_case("front", count=24).problem
    order = np.random.default_rng(3).permutation(24)
    mixed = with_clouds(problem, order)
    np.testing.assert_array_equal(
        _groups(mixed, every(mixed)), _groups(problem, every(problem))[order]
    )


def test_few_clouds_of_several_placements_are_spread_over_the_parts() -> None:
    problem = make_case("front", count=8).problem
    for placements in (2, 4, 8):
        several = replace(problem, cloud_placement=np.arange(8) % placements, placements=placements)
        assert np.bincount(_groups(several, every(several))).tolist() == [2] * GROUPS


# ------------------------------------------------------------------ a chair


@dataclass(frozen=True)
class Chair:
    """A chair seen by one LiDAR from all about it, vehicle and mounting known."""

    problem: Problem
    extrinsic: gtsam.Pose3
    state: JointRegistration
    lines: CloudLinearisation

    def scale(self, problem: Problem | None = None) -> float:
        return jackknife_scale(problem or self.problem, [self.extrinsic], [self.state], self.lines)


@cache
def seen_chair(count: int = CLOUDS, seed: int = 1, shared_m: float = 0.0) -> Chair:
    """With `shared_m`, 1 sigma, each pair of neighbouring clouds is off by a shift of its own."""
    azimuths = [360.0 / CLOUDS * j for j in range(count)]
    ranges = [6.0 + 1.5 * math.sin(1.7 * j) for j in range(count)]
    scene = chair_scene(azimuths, ranges, 0.01, seed)
    # The map is the target's frame. The LiDAR always looks at the chair, and is mounted askew.
    E = pose((1.0, 0.2, 1.5), (3.0, -8.0, 25.0))
    shifts = shared_m * np.random.default_rng(seed).normal(size=(CLOUDS // TOGETHER, 3))
    vehicles = [
        gtsam.Pose3(gtsam.Rot3(), shifts[j // TOGETHER]).compose(T).compose(E.inverse())
        for j, T in enumerate(scene.T_target_lidar)
    ]
    problem = Problem(
        lidars=("front",),
        reference="front",
        guesses={"front": E},
        prior_sigmas={"front": SIGMAS},
        fixed=frozenset(),
        poses=tuple((0, j * PERIOD_NS) for j in range(count)),
        T_map_vehicle=tuple(vehicles),
        origins_map={0: np.zeros(3)},
        cloud_lidar=np.zeros(count, np.int64),
        cloud_pose=np.arange(count),
        cloud_placement=np.zeros(count, np.int64),
        placements=1,
    )
    values = gtsam.Values()
    for j, X in enumerate(vehicles):
        values.insert(key_vehicle(j), X)
        values.insert(key_pose_error(j), np.zeros(6))
    values.insert(key_extrinsic(), E)
    values.insert(key_target(0), gtsam.Pose3())
    state = JointRegistration(scene.observation, config_of(components=150, max_points=200))
    state.by_beams, state.held_along = True, 0.0
    lines = linearise_clouds(problem, values)
    R, t = matrices(lines.predicted)
    state.seed(R, t, 0.02)
    while not state.finest:
        state.expect(R, t)
        state.maximise(R, t)
    for _ in range(4):
        state.expect(R, t)
        state.maximise(R, t)
    return Chair(problem, E, state, lines)


def test_scale_of_a_chair_in_full_view_is_not_large() -> None:
    chair = seen_chair()
    assert 1.0 <= chair.scale() < 3.0
    # The same clouds give the same.
    assert chair.scale() == chair.scale()


def test_errors_that_neighbouring_clouds_share_are_seen() -> None:
    # Shifts of 2 cm of two clouds at a time, where the information knows of none.
    assert seen_chair(shared_m=0.02).scale() > 1.5 * seen_chair().scale()


def test_the_registration_stays_as_it_is() -> None:
    chair = seen_chair()
    before = dict(vars(chair.state))
    weights = chair.state.weights.copy()
    means = chair.state.mixture.means_target.copy()
    chair.scale()
    after = vars(chair.state)
    assert after.keys() == before.keys()
    for name, value in before.items():
        assert after[name] is value, name
    np.testing.assert_array_equal(chair.state.weights, weights)
    np.testing.assert_array_equal(chair.state.mixture.means_target, means)


def test_clouds_of_few_views_tell_nothing() -> None:
    # A vehicle that stands: 32 clouds of one view; two more places make three.
    chair = seen_chair()
    one = np.full(CLOUDS, float(CLOUDS))
    assert chair.scale(replace(chair.problem, views=one)) == 1.0
    three = np.repeat([16.0, 8.0, 8.0], [16, 8, 8])
    assert chair.scale(replace(chair.problem, views=three)) == 1.0
    # That all differ is what no views say.
    every = replace(chair.problem, views=np.ones(CLOUDS))
    assert chair.scale(every) == chair.scale()


def test_few_views_of_many_scans_tell_nothing() -> None:
    """Left out one by one, scans of one view are in every part. Three thirds are one view."""
    chair = seen_chair()
    assert chair.scale(replace(chair.problem, views=np.full(CLOUDS, CLOUDS / 8.0))) == 1.0
    thirds = replace(
        chair.problem,
        cloud_lidar=np.zeros(72, np.int64),
        cloud_pose=np.arange(72),
        cloud_placement=np.zeros(72, np.int64),
        views=np.full(72, 3.0),
    )
    assert _tell(thirds, every(thirds))


def test_clouds_that_are_left_out_have_no_part() -> None:
    chair = seen_chair()
    which = np.arange(0, CLOUDS, 2)
    R, t = matrices(chair.lines.predicted)
    alone = chair.state.only(which).expect(R[which], t[which])
    # As beside clouds of no weight.
    beside = copy(chair.state)
    beside.weights = np.where(np.isin(np.arange(CLOUDS), which), 1.0, 1e-12)
    expected = beside.expect(R, t)
    size = np.abs(expected.gradient[which]).max()
    assert alone.gradient / size == pytest.approx(expected.gradient[which] / size, abs=1e-6)
    np.testing.assert_allclose(alone.blocks, expected.blocks[which], rtol=1e-9, atol=1e-6)


def test_a_placement_may_lose_all_its_clouds() -> None:
    # Two clouds of a second placement: a part by themselves.
    chair = seen_chair()
    problem = replace(
        chair.problem,
        cloud_lidar=np.append(chair.problem.cloud_lidar, [0, 0]),
        cloud_pose=np.append(chair.problem.cloud_pose, [0, 1]),
        cloud_placement=np.append(chair.problem.cloud_placement, [1, 1]),
        placements=2,
    )
    states = [chair.state, chair.state.only(np.array([0, 1]))]
    predicted = (*chair.lines.predicted, *chair.lines.predicted[:2])
    lines = replace(chair.lines, predicted=predicted)
    assert _groups(problem, every(problem))[-2:].tolist() == [0, 0]
    scale = jackknife_scale(problem, [chair.extrinsic], states, lines)
    assert scale == pytest.approx(chair.scale(), rel=0.2)


def test_few_clouds_tell_it_too_but_not_very_few() -> None:
    """22 of 80 clouds on a bumper had a scale of 1; S2S was 3.6 sigmas off, 1.5 with 2.8."""
    few = 12
    assert seen_chair(few, shared_m=0.02).scale() > 1.5 * seen_chair(few).scale()
    assert seen_chair(LEAST_LIDAR_CLOUDS - 1, shared_m=0.02).scale() == 1.0


def test_clouds_without_a_say_are_no_clouds() -> None:
    """Without one of them nothing changes: a part of them alone says that nothing does."""
    chair = seen_chair()
    say = np.arange(CLOUDS) % 4 != 1  # all of a part, if they were put in turn
    group = _groups(chair.problem, say)
    assert np.bincount(group[say]).tolist() == [CLOUDS * 3 // 4 // GROUPS] * GROUPS
    few = copy(chair.state)
    few.weights = np.where(np.arange(CLOUDS) < LEAST_LIDAR_CLOUDS - 1, 1.0, 0.0)
    assert jackknife_scale(chair.problem, [chair.extrinsic], [few], chair.lines) == 1.0


def test_clouds_of_little_weight_are_in_all_parts() -> None:
    """Together in one part they would make it unlike the others: a scale of 5 on a sound chair."""
    chair = seen_chair()
    little = copy(chair.state)
    little.weights = np.where(np.arange(CLOUDS) < 9, 1.0, 0.45)
    assert jackknife_scale(chair.problem, [chair.extrinsic], [little], chair.lines) < 2.0


def test_information_along_a_motion_is_that_of_the_joint_quadratic() -> None:
    chair = seen_chair()
    # At a state that is held along the surface, too.
    rng = np.random.default_rng(5)
    J = rng.normal(size=(CLOUDS, 6, 7))
    R, t = matrices(chair.lines.predicted)
    for held_along in (0.0, 400.0):
        state = JointRegistration(chair.state.observation, config_of(components=150))
        state.held_along = held_along
        state.seed(R, t, 0.02)
        quadratic = state.expect(R, t)
        rows = J.reshape(6 * CLOUDS, 7)
        expected = rows.T @ quadratic.joint() @ rows
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        assert quadratic.along(J) / scale == pytest.approx(expected / scale, abs=1e-8)


@pytest.mark.parametrize(
    ("scales", "stays"),
    [
        ([], False),
        ([0.2], False),
        ([0.6, 0.7], True),  # three more rounds of at most 0.1: the true course ends below 1
        ([0.6, 0.75], False),
        ([0.6, 0.75, 0.8], True),
        ([0.9, 0.8], True),
        ([1.1, 1.05], False),
    ],
)
def test_rounds_end_where_the_scale_will_not_come_to_one(scales: list[float], stays: bool) -> None:
    assert ROUNDS == 5
    assert _stays_below_one(scales) is stays
