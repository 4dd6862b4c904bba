"""The two stages on registered poses with a known truth, some of them in a wrong place."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.linalg import block_diag

from caliv_graph.calibration.problem import Problem
from caliv_graph.calibration.robust import MIN_WEIGHT
from caliv_graph.calibration.snooping import MIN_SNOOPED_WEIGHT, snoop_clouds
from caliv_graph.calibration.solve import solve_registered
from caliv_graph.calibration.staged import staged_solution
from caliv_graph.config.guesses import TRUSTED_SIGMAS
from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.model import Config, RobustConfig, SolveConfig
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.geometry.se3 import retract_vehicle_axes, vehicle_axes_difference
from caliv_graph.products import Array, Registration, Solution
from tests.calibration.problems import SIGMAS, Case, make_case, noisy, with_clouds
from tests.samples import MOUNTINGS, make_solution

LIDARS = ("front", "rear")

SLID = [8, 9, 10, 11]
"""Clouds of the front from places that follow each other."""

SLIDES = (
    np.array([0.0, 0.0, 0.01, 0.1, 0.0, 0.0]),
    np.array([0.0, 0.0, 0.0, 0.03, 0.0, 0.0]),
    np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]),
)
"""How far they are off: 10 cm and 10 mrad, 3 cm, and a metre."""


def config_of(kernel: str, trim_percent: float = 10.0) -> Config:
    return Config(
        lidars={
            name: LidarConfig(
                topic=name, initial=PoseConfig(xyz=MOUNTINGS[name][0], rpy_deg=MOUNTINGS[name][1])
            )
            for name in LIDARS
        },
        reference="rear",
        solve=SolveConfig(mode="staged"),
        robust=RobustConfig.model_validate({"kernel": kernel, "trim_percent": trim_percent}),
    )


def guessed(problem: Problem, rng: np.random.Generator) -> Problem:
    """The same with guesses that are off by their sigmas."""
    return replace(
        problem,
        guesses={
            name: retract_vehicle_axes(T, SIGMAS * rng.normal(size=6))
            for name, T in problem.guesses.items()
        },
    )


def registered(case: Case, measured: tuple[gtsam.Pose3, ...]) -> Registration:
    """Registered poses about a shape whose place is free."""
    blocks = case.information
    pull = np.vstack(list(blocks))
    return replace(
        make_solution().registrations[0],
        T_target_lidar=measured,
        information=blocks,
        information_joint=block_diag(*blocks) - pull @ np.linalg.solve(blocks.sum(axis=0), pull.T),
        inlier_ratio=np.ones(len(measured)),
    )


def solved(
    seed: int, slid: Array, kernel: str = "huber", trim_percent: float = 10.0, count: int = 20
) -> tuple[Case, Solution]:
    """A drive of `count` places by two LiDARs; four clouds of the front are off by `slid`."""
    case = make_case(*LIDARS, count=count, seed=seed)
    measured = list(noisy(case, seed))
    for j in SLID:
        measured[j] = gtsam.Pose3.Expmap(slid).compose(measured[j])
    problem = guessed(case.problem, np.random.default_rng(seed))
    registrations = [registered(case, tuple(measured))]
    state = solve_registered(problem, registrations, (), config_of(kernel, trim_percent))
    return case, staged_solution(state, registrations)


def test_a_fixed_reference_is_determined_and_stays() -> None:
    case = make_case(*LIDARS, count=20, seed=1)
    problem = guessed(case.problem, np.random.default_rng(1))
    true = case.problem.guesses["rear"]
    problem = replace(
        problem,
        guesses={**problem.guesses, "rear": true},
        prior_sigmas={**problem.prior_sigmas, "rear": TRUSTED_SIGMAS},
        fixed=frozenset(["rear"]),
    )
    registrations = [registered(case, noisy(case, 1))]
    state = solve_registered(problem, registrations, (), config_of("huber"))

    solution = staged_solution(state, registrations)

    assert solution.held == ()
    assert solution.T_vehicle_lidar["rear"].equals(true, 1e-4)
    rear = slice(6 * solution.lidars.index("rear"), None)
    sigmas = np.sqrt(np.diag(solution.cov))[rear][:6]
    assert (sigmas < 1.01 * TRUSTED_SIGMAS).all()
    assert s2s_nees(case, solution) < 18.5


def s2s_nees(case: Case, solution: Solution) -> float:
    """Squared error of front to rear in its own covariance, six degrees of freedom."""
    true, found = case.problem.guesses, solution.T_vehicle_lidar
    S = found["rear"].between(found["front"])
    error = gtsam.Pose3.Logmap(S.between(true["rear"].between(true["front"])))
    # By right perturbations of both extrinsics; the covariance is about vehicle axes.
    J = np.zeros((6, 12))
    for name, part in (("front", np.eye(6)), ("rear", -S.inverse().AdjointMap())):
        R = found[name].rotation().matrix().T
        at = 6 * solution.lidars.index(name)
        J[:, at : at + 6] = part @ block_diag(R, R)
    return float(error @ np.linalg.solve(J @ solution.cov @ J.T, error))


def lost(solution: Solution) -> list[int]:
    return np.flatnonzero(solution.cloud_weights[0] < 1e-3).tolist()


def test_clouds_in_a_wrong_place_are_lost_and_nothing_else_changes() -> None:
    seed = 1
    case, whole = solved(seed, np.zeros(6))
    assert lost(whole) == []
    assert s2s_nees(case, whole) < 18.5  # chi squared of six, one in two hundred
    for slid in SLIDES:
        case, solution = solved(seed, slid)
        assert lost(solution) == SLID
        assert s2s_nees(case, solution) < 18.5
        assert solution.registration_scale == pytest.approx(whole.registration_scale, rel=0.1)
        sigma = np.sqrt(np.diag(solution.cov))
        for i, name in enumerate(solution.lidars):
            off = vehicle_axes_difference(
                solution.T_vehicle_lidar[name], whole.T_vehicle_lidar[name]
            )
            assert (np.abs(off) < 2.0 * sigma[6 * i : 6 * i + 6]).all()


@pytest.mark.parametrize(
    ("kernel", "trim_percent"),
    [("tls", 10.0), ("trimmed", 10.0), ("trimmed", 5.0), ("trimmed", 0.0)],
)
def test_other_kernels_lose_them_too(kernel: str, trim_percent: float) -> None:
    case, solution = solved(1, SLIDES[0], kernel, trim_percent)
    assert set(lost(solution)) >= set(SLID)
    assert s2s_nees(case, solution) < 18.5


def test_without_a_kernel_nothing_is_lost() -> None:
    _, solution = solved(1, SLIDES[0], "none")
    assert lost(solution) == []


def test_errors_between_sensors_are_as_large_as_is_said_of_them() -> None:
    found = [s2s_nees(*solved(seed, np.zeros(6), count=12)) for seed in range(10, 18)]
    # 8 draws: the standard error of their mean is 1.2.
    assert np.mean(found) == pytest.approx(6.0, abs=2.0)


def test_a_lidar_that_would_lose_many_clouds_keeps_them_all() -> None:
    # Its clock or its mount is wrong then, and whoever looks at the weights shall see it.
    case = make_case(*LIDARS, count=20, seed=1)
    measured = list(noisy(case, 1))
    for j in range(7, 13):
        measured[j] = gtsam.Pose3.Expmap(SLIDES[0]).compose(measured[j])
    registrations = [registered(case, tuple(measured))]
    state = solve_registered(case.problem, registrations, (), config_of("huber"))
    state.weights.values[25] = 0.4  # of little say already
    before = state.weights.values.copy(), state.noise, state.scale, state.sound.copy()
    snoop_clouds(state, registrations)
    assert (before[0][[7, 8, 11]] > 0.3).all()
    expected = np.where(before[0] < MIN_SNOOPED_WEIGHT, MIN_WEIGHT, before[0])
    assert expected[25] == MIN_WEIGHT
    np.testing.assert_array_equal(state.weights.values, expected)
    assert (state.noise, state.scale) == before[1:3]
    np.testing.assert_array_equal(state.sound, before[3])
    # A fifth of the front's twenty are lost.
    measured[12] = noisy(case, 1)[12]
    measured[11] = noisy(case, 1)[11]
    registrations = [registered(case, tuple(measured))]
    state = solve_registered(case.problem, registrations, (), config_of("huber"))
    snoop_clouds(state, registrations)
    assert np.flatnonzero(state.weights.values < 1e-3).tolist() == [7, 8, 9, 10]


def test_a_lost_cloud_does_not_take_back_what_a_jackknife_said() -> None:
    """Surfels hide errors that the clouds share: residuals alone show a scale near 1."""
    case = make_case(*LIDARS, count=20, seed=1)
    measured = list(noisy(case, 1))
    measured[7] = gtsam.Pose3.Expmap(SLIDES[0]).compose(measured[7])
    registrations = [registered(case, tuple(measured))]
    state = solve_registered(case.problem, registrations, (), config_of("huber"))
    state.scale = state.least_scale = 1.9
    snoop_clouds(state, registrations)
    assert np.flatnonzero(state.weights.values < 1e-3).tolist() == [7]
    assert state.scale == 1.9


def test_clouds_none_of_which_is_the_target_are_solved_as_they_are() -> None:
    case = make_case(*LIDARS, count=6, seed=1)
    registration = registered(case, case.measured)
    registration = replace(registration, inlier_ratio=np.zeros(len(case.measured)))
    state = solve_registered(case.problem, [registration], (), config_of("huber"))
    state.sound[:] = False
    before = state.weights.values.copy(), state.scale
    snoop_clouds(state, [registration])
    np.testing.assert_array_equal(state.weights.values, before[0])
    assert state.scale == before[1]


def test_clouds_of_several_targets_are_judged_together() -> None:
    case = make_case(*LIDARS, count=12, drives=2, seed=3)
    measured = list(noisy(case, 3))
    # Clouds are numbered by LiDAR, then drive: two of the front's in the second drive.
    for j in (14, 20):
        measured[j] = gtsam.Pose3.Expmap(SLIDES[0]).compose(measured[j])
    registrations = []
    for m in range(2):
        mine = np.flatnonzero(case.problem.cloud_placement == m)
        part = replace(case, information=case.information[mine])
        one = registered(part, tuple(measured[j] for j in mine))
        registrations.append(replace(one, view_weights=np.ones(len(mine))))
    order = np.argsort(case.problem.cloud_placement, kind="stable")
    problem = with_clouds(case.problem, order)
    state = solve_registered(problem, registrations, (), config_of("huber"))
    snoop_clouds(state, registrations)
    assert order[state.weights.values < 1e-3].tolist() == [14, 20]


def test_what_biases_of_the_ranges_do_is_in_the_sigmas() -> None:
    # Ranges of the front that are 20 mm too long: every cloud fits nearer to the target.
    case = make_case(*LIDARS, count=20, seed=3)
    directions = np.zeros((case.problem.clouds, 6, 1))
    for j in np.flatnonzero(case.problem.cloud_lidar == LIDARS.index("front")).tolist():
        place = case.measured[j].translation()
        directions[j, 3:, 0] = 0.02 * place / np.linalg.norm(place)
    measured = tuple(
        gtsam.Pose3.Expmap(d[:, 0]).compose(T)
        for d, T in zip(directions, noisy(case, 3), strict=True)
    )
    registrations = [registered(case, measured)]
    nees = []
    for known in (None, directions.reshape(-1, 1)):
        state = solve_registered(case.problem, registrations, (), config_of("huber"))
        state.bias_directions = known
        nees.append(s2s_nees(case, staged_solution(state, registrations)))
    assert nees[0] > 50.0
    assert nees[1] < 16.8, nees  # the 99 % limit for six axes
