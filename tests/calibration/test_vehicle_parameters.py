"""Lever arm and rotation of the IMU as variables of the calibration graph."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.graph import initial_values, motion_graph
from caliv_graph.calibration.problem import HEAVE_SIGMA_M, Problem, pose_problem
from caliv_graph.calibration.vehicle_parameters import (
    HELD_M,
    ParameterPrior,
    estimated_parameters,
    motion_term,
    parameter_priors,
    sigmas_from_stated,
)
from caliv_graph.config.model import Config
from caliv_graph.conventions import key_imu_place, key_imu_rotation, key_lever_arm
from caliv_graph.products import Array, TargetCloud, TargetObservation, VehicleParameter
from caliv_graph.trajectory.parameters import IMU_ROTATION, LEVER_ARM
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from tests.trajectory.motions import Course, config_for, eight_drive, mounted_askew, record, stamps

COURSE = Course(eight_drive(16.0), rough=1.0)
SENSORS = replace(mounted_askew(), twist_hz=50.0)
CONFIG = config_for(
    SENSORS,
    gnss={"lever_arm": list(SENSORS.lever_arm)},
    imu={"rotation_sigma_deg": None, "xyz_sigma": None},
)
WANTED = stamps(16.0, 0.5, 0.3)


@cache
def drive(seed: int) -> SmoothedTrajectory:
    return smooth_trajectory(record(COURSE, SENSORS, seed), CONFIG, WANTED)


def problem_of(trajectories: list[SmoothedTrajectory], config: Config = CONFIG) -> Problem:
    """A problem in which every wanted pose has a cloud."""
    points = np.random.default_rng(0).standard_normal((10, 3))
    clouds = [
        TargetCloud("front", d, int(stamp), points, "cloud")
        for d in range(len(trajectories))
        for stamp in WANTED
    ]
    observation = TargetObservation(0, "target", np.array([5.0, 0.0, 0.0]), tuple(clouds))
    return pose_problem([observation], trajectories, config)


def dense(problem: Problem) -> tuple[Array, Array]:
    """Information and right-hand side of the motion graph: poses, lever arm, place, rotation."""
    values = initial_values(problem, [gtsam.Pose3()] * problem.clouds)
    ordering = gtsam.Ordering()
    for key in (*problem.pose_keys(), key_lever_arm(), key_imu_place(), key_imu_rotation()):
        ordering.push_back(key)
    H, b = motion_graph(problem).linearize(values).hessian(ordering)
    return np.asarray(H), np.asarray(b).ravel()


def marginal(H: Array, keep: slice) -> Array:
    return np.asarray(np.linalg.inv(np.linalg.inv(H)[keep, keep]))


def test_the_estimate_of_one_drive_is_that_of_its_smoother() -> None:
    problem = problem_of([drive(1)])

    H, b = dense(problem)

    # No step, although the data alone and the priors alone would move the parameters.
    sigma = np.sqrt(np.diag(np.linalg.inv(H)))
    assert np.abs(np.linalg.solve(H, b) / sigma).max() < 0.02
    pulls = [np.abs(np.asarray(p.offset) / p.sigmas) for p in drive(1).parameters]
    assert np.concatenate(pulls).max() > 0.2


def test_without_its_parameters_a_drive_has_the_poses_of_its_smoother_and_heave() -> None:
    problem = problem_of([drive(1)])

    H, _ = dense(problem)

    poses = slice(0, 6 * len(WANTED))
    cov = np.linalg.inv(drive(1).joint_information(WANTED)[0])
    z = np.arange(5, len(cov), 6)
    cov[z, z] += HEAVE_SIGMA_M**2
    np.testing.assert_allclose(np.linalg.inv(marginal(H, poses)), cov, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(np.linalg.inv(problem.motion[0]), cov, rtol=1e-5, atol=1e-12)


def test_several_drives_share_one_prior() -> None:
    one, other, both = (
        problem_of(list(d)) for d in ((drive(1),), (drive(2),), (drive(1), drive(2)))
    )
    last = slice(-9, None)

    informations = [marginal(dense(p)[0], last) for p in (one, other, both)]

    prior = np.diag(np.repeat([0.01**-2.0, np.radians(0.1) ** -2.0], [6, 3]))
    expected = informations[0] + informations[1] - prior
    np.testing.assert_allclose(informations[2], expected, rtol=1e-6, atol=1e-3)
    assert motion_graph(both).kinds.count("vehicle_parameter") == 3


def test_an_antenna_of_unknown_height_lifts_the_map_and_nothing_tells_its_height() -> None:
    sensors = replace(SENSORS, lever_arm=(1.2, 0.3, 0.85))
    config = config_for(sensors, gnss={"lever_arm": None})
    level = record(Course(eight_drive(16.0)), sensors, 1)
    trajectory = smooth_trajectory(level, config, WANTED)
    term = motion_term(trajectory, WANTED.tolist(), HEAVE_SIGMA_M)
    assert term is not None

    z = 6 * len(WANTED) + 2
    lift = np.zeros(len(term.gradient))
    lift[z] = 1.0
    for i, (R, _) in enumerate(zip(*trajectory.poses_at(WANTED), strict=True)):
        lift[6 * i + 3 : 6 * i + 6] = -R.T[:, 2]

    scale = np.sqrt(np.diag(term.information))
    assert np.abs(term.information @ lift / scale).max() < 1e-6
    assert abs(term.gradient @ lift) < 1e-6
    # It is held, and reported with what is known of it.
    held = parameter_priors([trajectory])["gnss.lever_arm"]
    assert (held.held, held.sigmas.tolist()) == ((False, False, True), [2.0, 2.0, 2.0])
    assert np.sqrt(np.diag(held.cov)) == pytest.approx([2.0, 2.0, HELD_M])
    # What tells x and y of it is as it was.
    along = trajectory.sigmas_of("gnss.lever_arm")
    assert along is not None
    known = np.repeat([0.5, 1e7, 1.0 / np.radians(0.1)], 3)  # arm, place and rotation of the IMU
    prior = np.concatenate([np.zeros(z - 2), known])
    cov = np.linalg.inv(term.information + np.diag(prior**2))
    assert np.sqrt(np.diag(cov)[z - 2 : z]) == pytest.approx(along[:2], rel=0.05)


def test_exact_figures_are_no_variables() -> None:
    sensors = replace(SENSORS, T_vehicle_imu=gtsam.Pose3(), lever_arm=(0.0, 0.0, 0.0))
    trajectory = smooth_trajectory(record(COURSE, sensors, 1), config_for(sensors), WANTED)

    problem = problem_of([trajectory], config_for(sensors))

    assert trajectory.parameters == ()
    assert motion_graph(problem).kinds == ["motion"]
    assert problem.parameter_values() == {}


@pytest.mark.parametrize("name", ["gnss.lever_arm", "imu.T_vehicle_imu"])
def test_the_factor_predicts_the_poses_of_a_moved_parameter(name: str) -> None:
    """The smoother of a config that is moved far within its sigma finds the same trajectory."""
    raw = CONFIG.model_dump()
    if name == "gnss.lever_arm":
        raw["gnss"] |= {"lever_arm": (0.31, 0.5, 1.8), "lever_arm_sigma": 1e-5}
    else:
        R = gtsam.Rot3.Expmap(np.array([0.0, 1e-3, 0.0]))
        R = R.compose(SENSORS.T_vehicle_imu.rotation())
        raw["imu"]["T_vehicle_imu"]["rpy_deg"] = tuple(np.degrees(R.rpy()))
        raw["imu"]["rotation_sigma_deg"] = 1e-4
    config = Config.model_validate(raw)
    moved = smooth_trajectory(record(COURSE, SENSORS, 1), config, WANTED)
    problem = problem_of([drive(1)])
    values = initial_values(problem, [gtsam.Pose3()] * problem.clouds)
    graph = motion_graph(problem)
    # The same prior as that config has, in the place of its own.
    own = problem_of([moved], config).parameters[name]
    held = gtsam.noiseModel.Gaussian.Covariance(own.cov)
    if isinstance(own.mean, gtsam.Rot3):
        graph.add(gtsam.PriorFactorRot3(key_imu_rotation(), own.mean, held))
    else:
        graph.add(gtsam.PriorFactorVector(key_lever_arm(), own.mean, held))

    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()

    start = drive(1).trajectory.T_map_vehicle
    seen, expected = [], []
    for key, before, after in zip(
        problem.pose_keys(), start, moved.trajectory.T_map_vehicle, strict=True
    ):
        own_start = values.atPose3(key)
        seen.append(gtsam.Pose3.Logmap(own_start.between(solved.atPose3(key))))
        expected.append(gtsam.Pose3.Logmap(before.between(after)))
    scale = np.abs(expected).max()
    assert scale > 1e-4
    np.testing.assert_allclose(seen, expected, atol=0.06 * scale)  # products of a turn and a shift


@pytest.mark.parametrize(
    ("prior_m", "sigma_m", "determined", "reported_m"),
    [
        (0.01, 0.004, True, 0.004),  # the data alone: 4.4 mm
        (0.01, 0.008, False, 0.008),  # 13 mm
        (2.0, 0.02, True, 0.02),
        (2.0, 0.5, False, 2.0),  # worse than a usual guess: nothing that a tilt's noise would not
    ],
)
def test_verdicts_on_a_lever_arm(
    prior_m: float, sigma_m: float, determined: bool, reported_m: float
) -> None:
    class Solved:
        """A solved problem in which the lever arm has one sigma."""

        def covariance_of(self, key: int, cov: Array) -> Array:
            return np.eye(3) * sigma_m**2

    values = gtsam.Values()
    values.insert(key_lever_arm(), np.array([1.0, 2.0, 3.0]))
    prior = ParameterPrior(np.zeros(3), np.eye(3) * prior_m**2, np.full(3, prior_m))

    found = estimated_parameters({"gnss.lever_arm": prior}, values, Solved(), np.zeros((6, 6)))

    arm = found["gnss.lever_arm"]
    assert arm.value.tolist() == [1.0, 2.0, 3.0]
    assert arm.determined == (determined,) * 3
    assert arm.sigma == pytest.approx([reported_m] * 3)


def test_how_far_a_result_is_from_what_was_measured_is_in_its_sigmas() -> None:
    smoothed = drive(0)
    priors = parameter_priors([smoothed])
    arm, turned = priors[LEVER_ARM.name], priors[IMU_ROTATION.name]
    assert isinstance(turned.mean, gtsam.Rot3)
    assert not isinstance(arm.mean, gtsam.Rot3)
    # About the vehicle's y axis, as its sigmas are.
    R = gtsam.Rot3.Expmap(np.array([0.0, 3.0 * turned.sigmas[1], 0.0])).compose(turned.mean)
    vehicle = {
        "lever_arm": VehicleParameter(
            arm.mean + np.array([0.0, 1.0, -5.0]) * arm.sigmas, arm.sigmas, (False,) * 3
        ),
        "imu_rotation": VehicleParameter(R.rpy(), turned.sigmas, (False,) * 3),
        "gnss_time_offset": VehicleParameter(np.ones(1), np.ones(1), (False,)),
    }

    found = sigmas_from_stated(vehicle, [smoothed])

    assert found == pytest.approx({LEVER_ARM.name: 5.0, IMU_ROTATION.name: 3.0}, rel=1e-6)
