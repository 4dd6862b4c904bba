"""Noise levels read off simulated poses whose errors are drawn from known ones."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from scipy.linalg import block_diag
from threadpoolctl import threadpool_limits

from caliv_graph.calibration.graph import with_given_poses
from caliv_graph.calibration.linear import linearise_clouds
from caliv_graph.calibration.noise import (
    CEILINGS,
    FLOORS,
    TYPICAL,
    TYPICAL_SCALE,
    evenly_over_drives,
    first_pose_noise,
    fit_pose_noise,
    fit_scale,
)
from caliv_graph.calibration.problem import Problem
from caliv_graph.config.noise import NoiseConfig
from caliv_graph.products import IntArray, PoseNoise
from tests.calibration.problems import PERIOD_NS, Case, make_case, noisy, with_poses


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """As `estimate` does: threads of linear algebra on small matrices wait for each other."""
    with threadpool_limits(limits=1):
        yield


NONE = PoseNoise(0.0, 0.0, 0.0, 0.0, 4.0)
WANDERING = PoseNoise(2e-4, 2e-3, 5e-3, 0.05, 4.0)
BOTH = PoseNoise(1e-3, 5e-3, 2e-3, 0.02, 4.0)
WHITE = PoseNoise(3e-3, 0.02, 5e-4, 3e-3, 4.0)


def given_poses(case: Case, noise: PoseNoise, seed: int) -> list[gtsam.Pose3]:
    """The true poses with white errors and a first-order Gauss-Markov process on them."""
    rng = np.random.default_rng(seed)
    white = np.array([noise.white_rotation_rad] * 3 + [noise.white_position_m] * 3)
    slow = np.array([noise.drift_rotation_rad] * 3 + [noise.drift_position_m] * 3)
    decay = math.exp(-PERIOD_NS * 1e-9 / noise.drift_time_s)
    drift = slow * rng.normal(size=6)
    poses = []
    for T in case.problem.T_map_vehicle:
        off = drift + white * rng.normal(size=6)
        R = T.rotation().compose(gtsam.Rot3.Expmap(off[:3]))
        poses.append(gtsam.Pose3(R, T.translation() + off[3:]))
        drift = decay * drift + math.sqrt(1.0 - decay**2) * slow * rng.normal(size=6)
    return poses


@cache
def drawn(true: PoseNoise, seed: int) -> tuple[PoseNoise, float]:
    """What is found of one drive, its registrations' scale 1, and a config that says nothing."""
    return fitted(true, seed)


def fitted(
    true: PoseNoise, seed: int, *, scale: float = 1.0, config: NoiseConfig | None = None
) -> tuple[PoseNoise, float]:
    case = make_case(count=48, seed=seed)
    problem = with_poses(case, given_poses(case, true, seed))
    measured = noisy(case, seed + 10, scale)
    return fit_pose_noise(
        problem,
        measured,
        case.information,
        np.ones(len(measured), dtype=np.bool_),
        with_given_poses(problem, case.truth),
        config or NoiseConfig(),
    )


def mean_range_m() -> float:
    case = make_case(count=48)
    return float(np.mean([np.linalg.norm(Z.translation()) for Z in case.measured]))


RANGE_M = mean_range_m()
"""Mean range of the target. A rotation of the vehicle and a shift by this times it look alike from
one place; what can be told apart well is what both together do to the target."""


def white_m(noise: PoseNoise) -> float:
    """White error of the target's place, metres."""
    return math.hypot(noise.white_position_m, RANGE_M * noise.white_rotation_rad)


def drift_m(noise: PoseNoise) -> float:
    """Slow error of the target's place, metres."""
    return math.hypot(noise.drift_position_m, RANGE_M * noise.drift_rotation_rad)


SEEDS = range(2)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_scale_of_the_registration_is_found(scale: float, seed: int) -> None:
    _, found = drawn(BOTH, seed) if scale == 1.0 else fitted(BOTH, seed, scale=scale)
    assert found == pytest.approx(scale, rel=0.15)


def scale_of_quadratic(scale: float, seed: int) -> float:
    """Of clouds whose errors are `scale` times those of their quadratic, the poses' noise known."""
    case = make_case(count=24, seed=seed)
    problem = with_poses(case, given_poses(case, BOTH, seed))
    lines = linearise_clouds(problem, case.truth)
    errors = [
        gtsam.Pose3.Logmap(T.compose(Z.inverse()))
        for T, Z in zip(lines.predicted, noisy(case, seed + 10, scale), strict=True)
    ]
    H = np.asarray(block_diag(*case.information))
    return fit_scale(problem, lines, (H, H @ np.concatenate(errors)), case.truth, BOTH)


@pytest.mark.parametrize("seed", SEEDS)
def test_scale_of_a_joint_quadratic_is_found(seed: int) -> None:
    once, twice = (scale_of_quadratic(scale, seed) for scale in (1.0, 2.0))
    assert once == pytest.approx(1.0, rel=0.3)
    assert twice / once == pytest.approx(2.0, rel=0.3)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_scale_does_not_depend_on_where_the_poses_were_solved_to(seed: int) -> None:
    # The solved poses follow their clouds; the errors are counted from the given ones.
    case = make_case(count=24, seed=seed)
    problem = with_poses(case, given_poses(case, BOTH, seed))
    H = np.asarray(block_diag(*case.information))
    measured, scales = noisy(case, seed + 10), []
    for values in (case.truth, with_given_poses(problem, case.truth)):
        lines = linearise_clouds(problem, values)
        errors = [
            gtsam.Pose3.Logmap(T.compose(Z.inverse()))
            for T, Z in zip(lines.predicted, measured, strict=True)
        ]
        clouds = (H, H @ np.concatenate(errors))
        scales.append(fit_scale(problem, lines, clouds, values, BOTH))
    assert scales[1] == pytest.approx(scales[0], rel=0.05)


@pytest.mark.parametrize("seed", SEEDS)
def test_poses_that_wander_are_seen_to_wander(seed: int) -> None:
    found, _ = drawn(WANDERING, seed)
    assert 0.5 < drift_m(found) / drift_m(WANDERING) < 2.0
    # 5 mm at the target, against slow errors of 114 mm.
    assert white_m(found) < 0.4 * drift_m(found)


def typical_ratios(true: PoseNoise) -> tuple[float, float]:
    """Geometric means over seeds of what was found over what was drawn: white, slow."""
    found = [drawn(true, seed)[0] for seed in range(4)]
    white = np.log([white_m(f) / white_m(true) for f in found])
    drift = np.log([drift_m(f) / drift_m(true) for f in found])
    return float(np.exp(white.mean())), float(np.exp(drift.mean()))


def test_both_kinds_of_error_are_found_together() -> None:
    white, drift = typical_ratios(BOTH)
    assert 0.5 < white < 2.0
    assert 0.5 < drift < 2.0


def test_white_errors_are_not_taken_for_slow_ones() -> None:
    # Slow errors of 11 mm beside white ones of 65 mm are hard to see; but they are not larger.
    white, drift = typical_ratios(WHITE)
    assert 0.5 < white < 2.0
    assert drift * drift_m(WHITE) < 0.7 * white_m(WHITE)


@pytest.mark.parametrize("seed", SEEDS)
def test_poses_without_errors(seed: int) -> None:
    found, scale = fitted(NONE, seed)
    # Nothing above what the registration, 1 mm and 2 mrad, would notice in 50 clouds.
    assert white_m(found) < 1.5e-3
    assert drift_m(found) < 1.5e-3
    assert scale == pytest.approx(1.0, rel=0.15)
    for value, floor, ceiling in zip(
        (
            found.white_rotation_rad,
            found.white_position_m,
            found.drift_rotation_rad,
            found.drift_position_m,
        ),
        FLOORS,
        CEILINGS,
        strict=False,
    ):
        assert 0.999 * floor <= value <= 1.001 * ceiling


@pytest.mark.parametrize("time_s", [1.0, 4.0])
def test_the_time_of_slow_errors_is_found(time_s: float) -> None:
    """In the mean of three drives of 10 s: the time of one is hardly known."""
    found = [drawn(replace(WANDERING, drift_time_s=time_s), seed)[0] for seed in range(3)]

    mean = np.exp(np.mean([np.log(noise.drift_time_s) for noise in found]))
    assert time_s / 3.0 < mean < 3.0 * time_s


def test_what_the_config_gives_is_kept() -> None:
    config = NoiseConfig(pose_position_m=0.0123, pose_drift_rotation_deg=0.5, pose_drift_time_s=7.0)
    found, _ = fitted(BOTH, 0, config=config)
    assert found.white_position_m == pytest.approx(0.0123)
    assert found.drift_rotation_rad == pytest.approx(math.radians(0.5))
    assert found.drift_time_s == 7.0
    # The others are fitted, not typical.
    assert found.white_rotation_rad != TYPICAL.white_rotation_rad
    assert found.drift_position_m != TYPICAL.drift_position_m


def test_everything_given_leaves_the_scale_to_be_found() -> None:
    config = NoiseConfig(
        pose_position_m=BOTH.white_position_m,
        pose_rotation_deg=math.degrees(BOTH.white_rotation_rad),
        pose_drift_position_m=BOTH.drift_position_m,
        pose_drift_rotation_deg=math.degrees(BOTH.drift_rotation_rad),
    )
    scales = []
    for seed in range(2):
        found, scale = fitted(BOTH, seed, scale=2.0, config=config)
        scales.append(scale)
        for name in ("white_position_m", "white_rotation_rad", "drift_position_m"):
            assert getattr(found, name) == pytest.approx(getattr(BOTH, name))
    assert np.mean(scales) == pytest.approx(2.0, rel=0.1)


def test_clouds_that_are_not_sound_have_no_say() -> None:
    case = make_case(count=24)
    problem = with_poses(case, given_poses(case, BOTH, 3))
    values = with_given_poses(problem, case.truth)
    measured = list(noisy(case, 4))
    sound = np.ones(len(measured), dtype=np.bool_)
    sound[[3, 20, 41]] = False
    before = fit_pose_noise(problem, measured, case.information, sound, values, NoiseConfig())
    for j in (3, 20, 41):
        measured[j] = gtsam.Pose3.Expmap(np.full(6, 0.3)).compose(measured[j])
    after = fit_pose_noise(problem, measured, case.information, sound, values, NoiseConfig())
    assert after == before
    # Had they had it, they would be noticed.
    sound[:] = True
    spoilt, scale = fit_pose_noise(
        problem, measured, case.information, sound, values, NoiseConfig()
    )
    assert scale > 1.5 * before[1] or white_m(spoilt) > 1.5 * white_m(before[0])


def test_slow_errors_that_messages_state_count_where_clouds_tell_little() -> None:
    case = make_case(count=24)
    problem = with_poses(case, given_poses(case, BOTH, 3))
    vague = np.tile(np.diag([100.0] * 3 + [1.0] * 3), (problem.clouds, 1, 1))

    def drift(stated_m: float | None) -> float:
        asked = replace(problem, slow_stated=(None, stated_m))
        every, values = np.ones(problem.clouds, np.bool_), with_given_poses(problem, case.truth)
        noise, _ = fit_pose_noise(asked, noisy(case, 4), vague, every, values, NoiseConfig())
        return noise.drift_position_m

    assert drift(0.012) == pytest.approx(0.012, rel=0.3)
    assert drift(None) == pytest.approx(0.003, rel=0.3)


def test_wrong_mountings_are_not_taken_for_noise() -> None:
    # Extrinsics and targets are integrated out: 5 mrad and 20 mm of them change nothing much.
    case = make_case(count=32, seed=5)
    problem = with_poses(case, given_poses(case, BOTH, 6))
    measured = noisy(case, 7)
    sound = np.ones(len(measured), dtype=np.bool_)
    values = with_given_poses(problem, case.truth)
    right = fit_pose_noise(problem, measured, case.information, sound, values, NoiseConfig())
    off = gtsam.Values(values)
    for key in (*problem.extrinsic_keys(), *problem.target_keys()):
        off.update(key, off.atPose3(key).retract(np.array([5e-3] * 3 + [0.02] * 3)))
    wrong = fit_pose_noise(problem, measured, case.information, sound, off, NoiseConfig())
    assert wrong[1] == pytest.approx(right[1], rel=0.1)
    assert drift_m(wrong[0]) == pytest.approx(drift_m(right[0]), rel=0.3)


def test_errors_of_different_drives_are_not_correlated() -> None:
    # Two drives with the same stamps. What the poses of the one are off by to the east, those of
    # the other are off by to the west, all the time: slow errors in each, none in common.
    case = make_case(count=24, drives=2)
    wandering = PoseNoise(0.0, 0.0, 0.0, 0.05, 4.0)
    shifts = [
        wrong.translation() - true.translation()
        for wrong, true in zip(
            given_poses(case, wandering, 8), case.problem.T_map_vehicle, strict=True
        )
    ][:24]
    poses = [
        gtsam.Pose3(T.rotation(), T.translation() + shift)
        for T, shift in zip(
            case.problem.T_map_vehicle, [*shifts, *(-s for s in shifts)], strict=True
        )
    ]
    problem = with_poses(case, poses)
    found, scale = fit_pose_noise(
        problem,
        noisy(case, 8),
        case.information,
        np.ones(96, dtype=np.bool_),
        with_given_poses(problem, case.truth),
        NoiseConfig(),
    )
    assert drift_m(found) > 0.02
    assert white_m(found) < 0.2 * drift_m(found)
    assert scale == pytest.approx(1.0, rel=0.2)


def test_first_levels_are_typical_where_the_config_is_silent() -> None:
    assert first_pose_noise(NoiseConfig()) == TYPICAL
    config = NoiseConfig(pose_rotation_deg=0.1, pose_drift_position_m=0.03, pose_drift_time_s=9.0)
    assert first_pose_noise(config) == PoseNoise(
        math.radians(0.1), TYPICAL.white_position_m, TYPICAL.drift_rotation_rad, 0.03, 9.0
    )
    assert TYPICAL_SCALE >= 1.0


def test_the_clouds_of_the_noise_fit_are_of_all_lidars_at_all_times() -> None:
    """Two LiDARs that take turns or scan together, one with gaps: every second cloud is of one."""
    for apart in (0, 1):  # poses of their own, or common ones
        for gaps in (False, True):
            a = [(2 * i, 0) for i in range(80)]
            b = [(2 * i + apart, 1) for i in range(80) if not (gaps and i % 3 == 0)]
            poses, lidars = np.transpose(sorted(a + b, key=lambda pair: (pair[1], pair[0])))
            problem = with_clouds_at(poses, lidars)

            chosen = evenly_over_drives(problem, np.ones(len(poses), dtype=bool), 48)

            share = np.bincount(lidars[chosen]) / 48
            usual = np.bincount(lidars) / len(lidars)
            assert len(chosen) == pytest.approx(48, abs=3)
            assert share == pytest.approx(usual, abs=0.1)
            # No quarter of the drive is without its part.
            parts = np.histogram(poses[chosen], 4, (0, 160))[0]
            assert parts.min() >= 0.2 * len(chosen)
            if not apart:
                # Clouds of one pose stay together.
                _, count = np.unique(poses[chosen], return_counts=True)
                assert (count == 2).mean() > 0.5
            # In another order of the clouds they are the same.
            turned = np.arange(len(poses))[::-1]
            again = evenly_over_drives(
                with_clouds_at(poses[turned], lidars[turned]), np.ones(len(poses), dtype=bool), 48
            )
            assert sorted(turned[again].tolist()) == chosen.tolist()


def with_clouds_at(poses: IntArray, lidars: IntArray) -> Problem:
    return replace(
        make_case(count=6).problem,
        cloud_pose=poses,
        cloud_lidar=lidars,
        cloud_placement=np.zeros(len(poses), np.int64),
    )
