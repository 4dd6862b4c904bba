"""The prior of the poses that structure is solved under: the same as the graph's own."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.graph import initial_values, pose_graph
from caliv_graph.calibration.linear import dense_system
from caliv_graph.calibration.pose_priors import pose_priors
from caliv_graph.calibration.problem import pose_problem
from caliv_graph.calibration.vehicle_parameters import POSE_TIME_OFFSET
from caliv_graph.config.model import Config
from caliv_graph.products import Array, PoseNoise, Trajectory
from caliv_graph.structure.prior import PosePrior
from caliv_graph.trajectory.select import GivenTrajectory, VehicleTrajectory, twists_at
from tests.calibration.problems import eight
from tests.calibration.test_vehicle_parameters import CONFIG, WANTED, drive

EXACT = CONFIG.model_copy(
    update={"noise": CONFIG.noise.model_copy(update={"pose_time_offset_s": 0.0})}
)
NOISE = PoseNoise(2e-4, 2e-3, 1e-3, 0.01, 1.5)
STAMPS = np.arange(8, dtype=np.int64) * 300_000_000


def given(cov: Array | None = None) -> GivenTrajectory:
    return GivenTrajectory(Trajectory(STAMPS, tuple(eight(len(STAMPS))), cov))


def marginal(prior: PosePrior, keep: list[int]) -> Array:
    """Covariance of some poses, the prior of the parameters added."""
    information = prior.information.copy()
    k = len(prior.parameter_offset)
    if k:
        information[-k:, -k:] += prior.parameter_information
    cov = np.linalg.inv(information)
    rows = (6 * np.array(keep)[:, None] + np.arange(6)).ravel()
    return np.asarray(cov[np.ix_(rows, rows)])


def of_graph(trajectory: VehicleTrajectory, config: Config, stamps: list[int]) -> Array:
    """Covariance of the same poses by the graph of the vehicle's poses."""
    problem = pose_problem([], [trajectory], config, others=config.lidars, kept_ns={0: stamps})
    values = initial_values(problem, [])
    system = dense_system(problem, pose_graph(problem, NOISE), values)
    size = 6 * len(problem.lidars)
    cov = np.linalg.inv(system.H[:-size, :-size])
    return np.asarray(cov[: 6 * len(stamps), : 6 * len(stamps)])


@pytest.mark.parametrize("stated", [False, True])
def test_given_poses_have_the_errors_of_the_graph(stated: bool) -> None:
    cov = None
    if stated:
        root = np.random.default_rng(1).normal(size=(len(STAMPS), 6, 9)) * 1e-3
        cov = root @ np.swapaxes(root, 1, 2)
        cov[3] = np.nan
    trajectory = given(cov)
    kept = [0, 3, 6]

    prior = pose_priors([trajectory], {0: STAMPS}, 0.005, NOISE, CONFIG)[0]

    expected = of_graph(trajectory, CONFIG, STAMPS[kept].tolist())
    np.testing.assert_allclose(marginal(prior, kept), expected, rtol=1e-6, atol=1e-14)
    assert list(prior.parameters) == [POSE_TIME_OFFSET]
    assert all(a.equals(b, 1e-9) for a, b in zip(prior.T_map_vehicle, eight(8), strict=True))


def test_given_poses_that_are_late_are_moved_along_the_drive() -> None:
    trajectory = given()
    prior = pose_priors([trajectory], {0: STAMPS}, 0.005, NOISE, CONFIG)[0]
    exact = pose_priors([trajectory], {0: STAMPS}, 0.005, NOISE, EXACT)[0]
    assert not exact.parameters
    late_s = 0.013
    moves = late_s * twists_at(trajectory, STAMPS.tolist()).ravel()

    # Poses that are ahead of the given ones by 13 ms have no residuals if these are as late.
    d = np.append(moves, late_s)
    assert d @ prior.information @ d == pytest.approx(0.0, abs=1e-6)
    # Without the clock they have; and where the clock is known both priors are the same.
    assert moves @ exact.information @ moves > 1.0
    np.testing.assert_allclose(prior.information[:-1, :-1], exact.information, rtol=1e-12)


def test_smoothed_poses_have_heave_and_the_vehicles_parameters() -> None:
    kept = [1, 3, 6]

    prior = pose_priors([drive(1)], {0: WANTED}, 0.005, NOISE, CONFIG)[0]

    expected = of_graph(drive(1), CONFIG, WANTED[kept].tolist())
    np.testing.assert_allclose(marginal(prior, kept), expected, rtol=1e-5, atol=1e-12)
    assert list(prior.parameters) == [
        "gnss.lever_arm",
        "imu.T_vehicle_imu.xyz",
        "imu.T_vehicle_imu",
    ]
    # The priors included, the smoother's own estimate is the maximum.
    k = len(prior.parameter_offset)
    gradient, information = prior.gradient.copy(), prior.information.copy()
    gradient[-k:] -= prior.parameter_information @ prior.parameter_offset
    information[-k:, -k:] += prior.parameter_information
    step = np.linalg.solve(information, gradient)
    assert np.abs(step / np.sqrt(np.diag(np.linalg.inv(information)))).max() < 0.02
    pulls = prior.parameter_offset @ prior.parameter_information @ prior.parameter_offset
    assert pulls > 0.04


def test_without_uncertain_parameters_there_are_poses_alone() -> None:
    exact = replace(drive(1), parameters=())

    prior = pose_priors([given(), exact], {1: WANTED}, 0.005, NOISE, CONFIG)[1]

    assert prior.information.shape == (6 * len(WANTED),) * 2
    assert prior.parameter_information.shape == (0, 0)
    assert isinstance(prior.T_map_vehicle[0], gtsam.Pose3)
