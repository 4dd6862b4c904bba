"""What is drawn has the statistics that the scenario states."""

import math

import gtsam
import numpy as np
import pytest

from caliv_graph.config.mounting import PoseConfig
from caliv_graph.errors import ConfigError
from caliv_graph.products import Array
from caliv_graph.scenario.model import InitialGuessModel, SuspensionModel
from caliv_graph.scenario.sensor_models import PoseNoiseModel
from caliv_graph.simulation.noise import (
    Stream,
    height_and_heave,
    noisy_poses,
    perturbed_extrinsic,
    random_stream,
)

N = 4000
STAMPS_NS = np.arange(N, dtype=np.int64) * 100_000_000
TRUE = tuple(
    gtsam.Pose3(gtsam.Rot3.Yaw(0.01 * i), np.array([0.1 * i, -0.05 * i, 0.0])) for i in range(N)
)


def errors(model: PoseNoiseModel, seed: int = 0) -> tuple[Array, Array]:
    """(N, 3) rotation errors in vehicle axes, and (N, 3) position errors in map axes."""
    given = noisy_poses(STAMPS_NS, TRUE, model, random_stream(seed, Stream.POSES))
    rotation = [
        gtsam.Rot3.Logmap(true.rotation().between(pose.rotation()))
        for true, pose in zip(TRUE, given, strict=True)
    ]
    position = [p.translation() - t.translation() for t, p in zip(TRUE, given, strict=True)]
    return np.array(rotation), np.array(position)


def test_white_pose_noise_has_its_sigmas() -> None:
    rotation, position = errors(PoseNoiseModel(position_sigma_m=0.005, rotation_sigma_rad=0.001))
    for values, sigma in ((rotation, 0.001), (position, 0.005)):
        for axis in values.T:
            # Within 4 standard errors.
            assert abs(axis.mean()) < 4.0 * sigma / math.sqrt(N)
            assert abs(axis.std() / sigma - 1.0) < 4.0 / math.sqrt(2.0 * N)
            assert abs(np.corrcoef(axis[:-1], axis[1:])[0, 1]) < 4.0 / math.sqrt(N)
        correlation = np.corrcoef(values.T) - np.eye(3)
        assert np.abs(correlation).max() < 4.0 / math.sqrt(N)


def test_walk_starts_at_zero_and_takes_independent_steps() -> None:
    rotation, position = errors(
        PoseNoiseModel(
            position_sigma_m=0.0,
            rotation_sigma_rad=0.0,
            position_walk_m_sqrts=0.01,
            rotation_walk_rad_sqrts=1e-4,
        )
    )
    assert not rotation[0].any()
    assert not position[0].any()
    # Steps of 0.1 s. The rotation walks about the axes of the map.
    rotation_map = np.array(
        [true.rotation().rotate(error) for true, error in zip(TRUE, rotation, strict=True)]
    )
    for values, sigma in ((rotation_map, 1e-4), (position, 0.01)):
        steps = np.diff(values, axis=0)
        for axis in steps.T:
            assert abs(axis.std() / (sigma * math.sqrt(0.1)) - 1.0) < 4.0 / math.sqrt(2.0 * N)
            assert abs(np.corrcoef(axis[:-1], axis[1:])[0, 1]) < 4.0 / math.sqrt(N)


def test_walk_grows_with_the_square_root_of_time() -> None:
    model = PoseNoiseModel(position_sigma_m=0.0, rotation_sigma_rad=0.0, position_walk_m_sqrts=0.01)
    # 17 s in few and in many steps come to the same.
    for step_ns in (100_000_000, 1_000_000_000):
        stamps_ns = np.arange(0, 17_000_000_001, step_ns, dtype=np.int64)
        still = (gtsam.Pose3(),) * len(stamps_ns)
        ends = np.array(
            [
                noisy_poses(stamps_ns, still, model, np.random.default_rng(i))[-1].translation()
                for i in range(300)
            ]
        )
        expected = 0.01 * math.sqrt(17.0)
        assert abs(ends.std() / expected - 1.0) < 4.0 / math.sqrt(2.0 * ends.size)


def test_without_noise_poses_are_true() -> None:
    rotation, position = errors(PoseNoiseModel(position_sigma_m=0.0, rotation_sigma_rad=0.0))
    assert np.abs(rotation).max() < 1e-12
    assert np.abs(position).max() == 0.0


def test_heights_have_a_common_and_a_white_part() -> None:
    model = SuspensionModel(height_sigma_m=0.02, heave_sigma_m=0.005)
    parts = [height_and_heave(model, 100, np.random.default_rng(i)) for i in range(1000)]
    draws = np.array([height_m + heave_m for height_m, heave_m in parts])
    assert draws.mean(axis=1).std() == pytest.approx(0.02, rel=0.1)
    within = draws - draws.mean(axis=1, keepdims=True)
    assert within.std() == pytest.approx(0.005, rel=0.02)


def test_initial_guesses_are_off_as_far_as_stated_and_no_farther() -> None:
    true = PoseConfig(xyz=(-0.4, 0.1, 2.0), rpy_deg=(1.0, 10.0, 180.0))
    model = InitialGuessModel(translation_m=0.1, rotation_deg=3.0)
    R_true = true.pose().rotation()
    shifts, turns = [], []
    for seed in range(2000):
        guess = perturbed_extrinsic(true, model, np.random.default_rng(seed)).pose()
        shifts.append(guess.translation() - np.array(true.xyz))
        turns.append(np.degrees(R_true.between(guess.rotation()).rpy()))
    for values, bound in ((np.array(shifts), 0.1), (np.array(turns), 3.0)):
        assert np.abs(values).max() <= bound * (1.0 + 1e-4)
        assert (np.abs(values).max(axis=0) > 0.99 * bound).all()
        np.testing.assert_allclose(values.std(axis=0), bound / math.sqrt(3.0), rtol=0.05)
        assert np.abs(values.mean(axis=0)).max() < 0.1 * bound


def test_streams_do_not_depend_on_one_another() -> None:
    firsts = {
        (seed, stream, index): random_stream(seed, stream, index).standard_normal()
        for seed in (0, 1)
        for stream in Stream
        for index in (0, 1)
    }
    assert len(set(firsts.values())) == len(firsts)
    assert firsts[1, Stream.LIDAR, 1] == random_stream(1, Stream.LIDAR, 1).standard_normal()


def test_negative_seed_is_an_error() -> None:
    with pytest.raises(ConfigError, match="seed: must be 0 or a positive whole number, not -1"):
        random_stream(-1, Stream.POSES)
