"""Given poses whose messages state a covariance: it is the white part of their error."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from caliv_graph.calibration.factors import given_pose_factor
from caliv_graph.calibration.graph import (
    cloud_graph,
    initial_values,
    merged,
    optimise,
    pose_graph,
    prior_graph,
    with_given_poses,
)
from caliv_graph.calibration.linear import linearise_clouds
from caliv_graph.calibration.noise import fit_pose_noise, sound_clouds, squares_without_own_pose
from caliv_graph.calibration.problem import Problem, pose_problem
from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.model import Config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.config.noise import NoiseConfig
from caliv_graph.products import (
    Array,
    GivenPoses,
    MotionData,
    PoseNoise,
    TargetCloud,
    TargetObservation,
)
from caliv_graph.trajectory.select import smooth_trajectories
from tests.calibration.problems import Case, make_case, noisy, with_poses

GOOD, POOR = np.array([2e-4] * 3 + [2e-3] * 3), np.array([0.02] * 3 + [0.2] * 3)
"""1 sigma of the white errors of every other pose, rotation and position."""

STEADY = PoseNoise(2e-4, 2e-3, 1e-4, 1e-3, 4.0)


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    with threadpool_limits(limits=1):
        yield


def sigmas_of(count: int) -> Array:
    """(n, 6) 1 sigma of the white error of each pose: good and poor in turn."""
    return np.where(np.arange(count)[:, None] % 2 == 0, GOOD, POOR)


def half_poor(seed: int, count: int = 24) -> tuple[Case, Problem, Problem]:
    """A case, and its problem with such errors in the poses: stated, and not stated."""
    case = make_case(count=count, seed=seed)
    rng = np.random.default_rng(seed)
    sigmas = sigmas_of(count)
    poses = []
    for T, sigma in zip(case.problem.T_map_vehicle, sigmas, strict=True):
        off = sigma * rng.normal(size=6)
        R = T.rotation().compose(gtsam.Rot3.Expmap(off[:3]))
        poses.append(gtsam.Pose3(R, T.translation() + off[3:]))
    silent = with_poses(case, poses)
    cov = np.array([np.diag(sigma**2) for sigma in sigmas])
    return case, replace(silent, stated_cov=cov), silent


def test_the_factor_takes_the_whole_covariance() -> None:
    given, values = gtsam.Pose3(), gtsam.Values()
    values.insert(1, gtsam.Pose3(gtsam.Rot3.Roll(0.01), np.array([0.0, 0.3, 0.0])))
    values.insert(2, np.zeros(6))
    cov = np.diag([0.01, 0.01, 0.01, 0.1, 0.1, 0.1]) ** 2
    cov[0, 4] = cov[4, 0] = 0.8 * 0.01 * 0.1
    r = np.array([0.01, 0, 0, 0, 0.3, 0])

    factor = given_pose_factor(1, 2, given, 9.0, 9.0, cov)

    assert factor.error(values) == pytest.approx(0.5 * r @ np.linalg.solve(cov, r))


def test_a_pose_is_as_certain_as_its_message_and_the_wandering_allow() -> None:
    _, stated, _ = half_poor(0)
    marginals = gtsam.Marginals(
        pose_graph(stated, STEADY), with_given_poses(stated, initial(stated))
    )
    for i in (0, 1, 10, 11):
        sigma = np.sqrt(np.diagonal(marginals.marginalCovariance(stated.pose_keys()[i])))
        expected = np.hypot(sigmas_of(12)[i % 2], [1e-4] * 3 + [1e-3] * 3)
        np.testing.assert_allclose(sigma, expected, rtol=1e-6)


def initial(problem: Problem) -> gtsam.Values:
    """All variables of a problem, targets at their origin."""
    return initial_values(problem, [gtsam.Pose3()] * problem.clouds)


def solved_error(
    case: Case, problem: Problem, measured: Sequence[gtsam.Pose3], noise: PoseNoise
) -> float:
    """Length of the extrinsics' error, in units of 2 mrad and 20 mm."""
    graph = merged(
        pose_graph(problem, noise),
        cloud_graph(problem, measured, case.information),
        prior_graph(problem, problem.lidars),
    )
    values = optimise(graph, initial_values(problem, measured), 50)
    errors = [
        problem.extrinsic(values, n).localCoordinates(case.problem.guesses[n])
        for n in problem.lidars
    ]
    return float(np.linalg.norm(np.array(errors) / ([2e-3] * 3 + [2e-2] * 3)))


def test_poor_poses_weigh_less_and_the_extrinsics_are_better() -> None:
    with_message, without = [], []
    for seed in range(4):
        case, stated, silent = half_poor(seed)
        measured = noisy(case, seed + 10, 1.0)
        # One level for all: what a fit finds where half of the poses is poor.
        common = PoseNoise(0.014, 0.14, 1e-4, 1e-3, 4.0)
        with_message.append(solved_error(case, stated, measured, STEADY))
        without.append(solved_error(case, silent, measured, common))
    assert np.mean(with_message) < 0.4 * np.mean(without)


def test_what_is_stated_is_not_fitted() -> None:
    case, stated, _ = half_poor(1, count=48)
    measured = noisy(case, 11, 1.0)
    every = np.ones(len(measured), dtype=np.bool_)
    values = with_given_poses(stated, case.truth)

    noise, scale = fit_pose_noise(stated, measured, case.information, every, values, NoiseConfig())

    # The figures for the report: the root mean square of good and poor.
    assert noise.white_rotation_rad == pytest.approx(np.sqrt((GOOD[0] ** 2 + POOR[0] ** 2) / 2))
    assert noise.white_position_m == pytest.approx(np.sqrt((GOOD[3] ** 2 + POOR[3] ** 2) / 2))
    # Nothing wanders here, and the registration is as good as it says.
    assert noise.drift_position_m < 3e-3
    assert 0.8 < scale < 1.3


def test_poses_without_a_covariance_among_others_are_fitted() -> None:
    case, stated, _ = half_poor(2, count=48)
    assert stated.stated_cov is not None
    cov = stated.stated_cov.copy()
    cov[1::2] = np.nan
    mixed = replace(stated, stated_cov=cov)
    measured = noisy(case, 12, 1.0)
    every = np.ones(len(measured), dtype=np.bool_)

    noise, _ = fit_pose_noise(
        mixed, measured, case.information, every, with_given_poses(mixed, case.truth), NoiseConfig()
    )

    # Rotation and position trade against each other at 10 m: together they are what is drawn.
    assert np.hypot(noise.white_position_m, 10.0 * noise.white_rotation_rad) == pytest.approx(
        np.hypot(POOR[3], 10.0 * POOR[0]), rel=0.4
    )


def test_a_cloud_is_judged_by_the_covariance_of_its_own_pose() -> None:
    case, stated, silent = half_poor(3, count=48)
    measured = noisy(case, 13, 1.0)
    values = with_given_poses(stated, case.truth)
    noise = replace(STEADY, white_rotation_rad=0.0, white_position_m=0.0)
    lines = linearise_clouds(stated, values)
    r = np.array(
        [
            gtsam.Pose3.Logmap(p.compose(Z.inverse()))
            for p, Z in zip(lines.predicted, measured, strict=True)
        ]
    )
    squares = squares_without_own_pose(stated, lines, r, case.information, values, noise)
    assert 4.0 < squares.mean() < 8.5  # six degrees of freedom
    assert sound_clouds(stated, measured, case.information, values, STEADY).all()
    # Without it, the clouds at poor poses look wrong.
    poor = stated.cloud_pose % 2 == 1
    alone = squares_without_own_pose(silent, lines, r, case.information, values, noise)
    assert np.median(alone[poor]) > 100.0


def test_messages_reach_the_problem() -> None:
    poses = tuple(gtsam.Pose3(gtsam.Rot3.Yaw(np.pi / 2), np.array([k, 0.0, 0.0])) for k in range(3))
    cov = np.array([np.diag(np.arange(1.0, 7.0) ** 2)] * 3)
    cov[2] = np.nan

    class Recorded:
        """A recording of which nothing but the poses is read."""

        def motion(self) -> MotionData:
            stamps = np.array([0, 10, 20], dtype=np.int64)
            return MotionData("drive/", poses=GivenPoses(stamps, poses, cov))

    front = LidarConfig(topic="/front", initial=PoseConfig(xyz=(2, 0, 2)))
    config = Config(lidars={"front": front})
    trajectories = smooth_trajectories([Recorded()], config, [[0, 10, 20]])  # type: ignore[list-item]
    clouds = [
        TargetCloud("front", 0, stamp, np.zeros((60, 3)), f"{stamp}") for stamp in (10, 15, 20)
    ]
    problem = pose_problem(
        [TargetObservation(0, "target", np.zeros(3), tuple(clouds))], trajectories, config
    )

    assert problem.stated().tolist() == [True, False, False]
    assert problem.stated_cov is not None
    # Forward and left in the vehicle are north and west in the map.
    np.testing.assert_allclose(np.diagonal(problem.stated_cov[0]), [1, 4, 9, 25, 16, 36])
