"""Noise of given poses by what structure says of them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.given_noise import noise_by_structure, residuals_of_structure
from caliv_graph.calibration.graph import with_given_poses
from caliv_graph.calibration.noise import TYPICAL, fit_pose_noise
from caliv_graph.calibration.problem import slow_stated
from caliv_graph.calibration.structure_evidence import NOTHING_TOLD, ToldErrors
from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config
from caliv_graph.config.noise import NoiseConfig
from caliv_graph.products import Array, PoseNoise, Trajectory
from caliv_graph.trajectory.select import GivenTrajectory
from tests.calibration.problems import make_case, noisy

POSES = 48
STAMPS_NS = np.arange(POSES) * 1_000_000_000
TRUE = PoseNoise(4e-4, 4e-3, 6e-4, 0.015, 10.0)
"""White and slow errors of the poses."""

SEEN = np.array([2e-4] * 3 + [1e-3] * 3)
"""What structure knows each pose to: rad, m."""


def config(**noise: Any) -> Config:
    lidars = {"front": {"topic": "/front", "initial": {"xyz": [0, 0, 0], "rpy_deg": [0, 0, 0]}}}
    return parse_config({"lidars": lidars, "noise": noise}, "test", Path())


def circle() -> GivenTrajectory:
    """Given poses that turn once, 2 m/s."""
    poses = []
    for yaw in np.linspace(0.0, 2.0 * math.pi, POSES):
        at = 15.0 * np.array([math.sin(yaw), 1.0 - math.cos(yaw), 0.0])
        poses.append(gtsam.Pose3(gtsam.Rot3.Yaw(yaw), at))
    return GivenTrajectory(Trajectory(STAMPS_NS, tuple(poses)))


def errors(noise: PoseNoise, rng: np.random.Generator) -> Array:
    """(POSES, 6) rotation in vehicle axes, position in map axes."""
    apart = 1e-9 * np.abs(STAMPS_NS[:, None] - STAMPS_NS)
    half = np.linalg.cholesky(np.exp(-apart / noise.drift_time_s))
    white = np.array([noise.white_rotation_rad] * 3 + [noise.white_position_m] * 3)
    slow = np.array([noise.drift_rotation_rad] * 3 + [noise.drift_position_m] * 3)
    drawn: Array = rng.standard_normal((2, POSES, 6))
    return np.asarray(drawn[0] * white + half @ drawn[1] * slow)


def told(seed: int, noise: PoseNoise, late_s: float = 0.0, seen: Array = SEEN) -> ToldErrors:
    """Structure that knows all poses but for a shift and a turn of all on the vehicle."""
    rng, given = np.random.default_rng(seed), circle()
    off = errors(noise, rng)
    for i, T in enumerate(given.trajectory.T_map_vehicle):
        off[i, 3:] = T.rotation().matrix().T @ off[i, 3:]
    off[:, 3] += 2.0 * late_s
    off[:, 2] += 2.0 / 15.0 * late_s
    residuals = (off + seen * rng.standard_normal(off.shape)).ravel()
    information = np.diag(np.tile(seen**-2.0, POSES))
    # Extrinsics take up what is the same in all poses, vehicle axes.
    common = information @ np.tile(np.eye(6), (POSES, 1))
    information -= common @ np.linalg.solve(np.tile(np.eye(6), POSES) @ common, common.T)
    return ToldErrors({0: (information, -information @ residuals)})


def found_by(of: ToldErrors, config: Config) -> PoseNoise:
    return noise_by_structure(of, {0: STAMPS_NS}, [circle()], config)


def test_white_and_slow_errors_are_told() -> None:
    found = [found_by(told(seed, TRUE), config()) for seed in range(3)]

    for name in ("white_rotation_rad", "white_position_m", "drift_rotation_rad"):
        values = [getattr(of, name) for of in found]
        assert np.mean(values) == pytest.approx(getattr(TRUE, name), rel=0.5), name
    assert np.mean([of.drift_position_m for of in found]) == pytest.approx(0.015, rel=0.5)
    assert all(3.0 < of.drift_time_s < 40.0 for of in found)


def test_poses_without_slow_errors_are_good() -> None:
    found = found_by(told(1, replace(TRUE, drift_rotation_rad=0.0, drift_position_m=0.0)), config())

    assert found.drift_position_m < 1.5e-3
    assert found.white_position_m == pytest.approx(4e-3, rel=0.2)


def test_a_late_clock_is_no_error_of_the_poses() -> None:
    """10 ms at 2 m/s; a clock that is taken as exact leaves nothing but errors, if it turns."""
    quiet = replace(TRUE, drift_rotation_rad=0.0, drift_position_m=0.0)

    late = found_by(told(2, quiet, late_s=0.01), config())

    assert late.drift_position_m == pytest.approx(
        found_by(told(2, quiet), config()).drift_position_m
    )


def test_what_is_stated_is_kept_and_nothing_told_is_the_usual() -> None:
    stated = config(pose_drift_position_m=0.015, pose_drift_time_s=12.0)

    found = found_by(told(1, TRUE), stated)

    assert (found.drift_position_m, found.drift_time_s) == (0.015, 12.0)
    assert found.white_position_m == pytest.approx(4e-3, rel=0.5)
    assert noise_by_structure(NOTHING_TOLD, {}, [], config()) == TYPICAL


def test_slow_errors_that_messages_state_stand_where_the_drive_tells_little() -> None:
    """Structure that knows poses to 0.3 m and 50 mrad, and one that knows them to a millimetre."""
    stating = replace(circle(), slow_stated=(None, 0.015))
    vague = told(1, TRUE, seen=np.array([0.05] * 3 + [0.3] * 3))

    def by(of: ToldErrors, trajectory: GivenTrajectory) -> float:
        drives = {0: STAMPS_NS}
        return noise_by_structure(of, drives, [trajectory], config()).drift_position_m

    assert by(vague, stating) == pytest.approx(0.015, rel=0.3)
    assert by(vague, circle()) < 0.008
    # What it states, 20 times too much, against 48 poses that say otherwise.
    wrong = replace(circle(), slow_stated=(None, 0.3))
    assert by(told(1, TRUE), wrong) < 0.025
    # A placeholder is no statement.
    unknown = replace(circle(), slow_stated=(None, 500.0))
    assert by(told(1, TRUE), unknown) == by(told(1, TRUE), circle())


def test_slow_errors_are_of_the_drives_that_state_some() -> None:
    drives = [replace(circle(), slow_stated=of) for of in ((3e-3, None), (4e-3, 0.02))]

    assert slow_stated([circle(), *drives]) == pytest.approx((math.sqrt(12.5e-6), 0.02))
    assert slow_stated([circle()]) == (None, None)


def test_white_errors_that_messages_state_are_known() -> None:
    """The messages state what is true; the slow errors are found beside them."""
    given = circle()
    white = np.array([TRUE.white_rotation_rad] * 3 + [TRUE.white_position_m] * 3)
    cov = np.tile(np.diag(white**2), (POSES, 1, 1))
    stating = GivenTrajectory(replace(given.trajectory, cov=cov))

    found = noise_by_structure(told(3, TRUE), {0: STAMPS_NS}, [stating], config())

    assert found.white_position_m == pytest.approx(TRUE.white_position_m)
    assert found.drift_position_m == pytest.approx(0.015, rel=0.7)


def test_walls_tell_what_clouds_of_a_target_do_not() -> None:
    """Clouds that know their poses to a tenth of a radian and ten metres."""
    case = make_case(count=24)
    values = with_given_poses(case.problem, case.truth)
    measured = noisy(case, 4)
    vague = np.tile(np.diag([100.0] * 3 + [0.01] * 3), (len(measured), 1, 1))
    every = np.ones(len(measured), dtype=np.bool_)
    walls = residuals_of_structure(told(1, TRUE), {0: STAMPS_NS}, [circle()], config())

    found, _ = fit_pose_noise(
        case.problem, measured, vague, every, values, NoiseConfig(), of_poses=walls
    )

    by_walls = found_by(told(1, TRUE), config())
    for name in (
        "white_rotation_rad",
        "white_position_m",
        "drift_rotation_rad",
        "drift_position_m",
    ):
        assert getattr(found, name) == pytest.approx(getattr(by_walls, name), rel=0.1), name


def test_without_word_of_structure_the_clouds_are_asked_alone() -> None:
    assert residuals_of_structure(NOTHING_TOLD, {}, [], config()) is None
