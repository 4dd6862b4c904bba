"""Noise levels from the residuals of the LiDARs along smoothed trajectories."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from caliv_graph.calibration import sensor_noise
from caliv_graph.calibration.evidence import Evidence, motion_evidence
from caliv_graph.calibration.open_errors import limits_by_motion
from caliv_graph.calibration.problem import HEAVE_SIGMA_M
from caliv_graph.calibration.sensor_noise import (
    LEVELS,
    OPEN,
    SLOW,
    SensorNoise,
    estimated,
    noise_of_motion,
)
from caliv_graph.calibration.variance_components import Block, Observed, Part, Unknown, maximise
from caliv_graph.config.noise import NoiseConfig
from caliv_graph.products import Array
from caliv_graph.trajectory.correlated import GROUPS, MOVES, CorrelatedError
from caliv_graph.trajectory.effects import ErrorEffects, smoothed_in_time
from caliv_graph.trajectory.error_likelihood import ErrorLikelihood
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from tests.trajectory.test_variances import base, recorded, shifted, smoothed

POSES = 16
STEPS = 48
STAMPS = np.arange(STEPS) * 500_000_000
H = 1e-4
NEAR = ((math.exp(H), 1.0), (1.0, math.exp(H)))
"""Factors on a sigma and on a time, for slopes by their logarithms."""


def gain() -> Array:
    """(6 POSES, 3, STEPS): positions follow the errors of the fixes, averaged over two seconds."""
    out = np.zeros((POSES, 6, 3, STEPS))
    for i in range(POSES):
        near = np.exp(-0.5 * ((np.arange(STEPS) - 3.0 * i) / 2.0) ** 2)
        out[i, 3:] = np.eye(3)[:, :, None] * near / near.sum()
    return out.reshape(6 * POSES, 3, STEPS)


def evidence(seed: int, heave_m: float, error: CorrelatedError | None) -> Evidence:
    """Two observations of every pose, of 2 mm and 0.3 mrad; an unknown shift of them all."""
    rng = np.random.default_rng(seed)
    n = 6 * POSES
    by_pose = np.vstack([np.eye(n), np.eye(n)])
    cloud = np.diag(np.array([0.3e-3] * 3 + [2e-3] * 3) ** 2)
    registration = np.kron(np.eye(2 * POSES), cloud)
    known = by_pose @ np.diag(np.tile([0.2e-3] * 3 + [1e-3] * 3, POSES) ** 2) @ by_pose.T
    lift = by_pose[:, 5::6]
    effects = ErrorEffects("gnss", STAMPS, gain())
    cov = known + registration + heave_m**2 * lift @ lift.T
    if error is not None:
        for axis, sigma in enumerate(error.sigmas):
            moved = by_pose @ effects.gain[:, axis]
            cov += sigma**2 * smoothed_in_time(moved, STAMPS, error.time_s) @ moved.T
    residuals = np.linalg.cholesky(cov) @ rng.standard_normal(2 * n)
    design = np.tile(np.eye(6), (2 * POSES, 1))
    observed = Observed(residuals, design, np.full(6, 1e-2), known)
    clouds = [Block(slice(6 * j, 6 * j + 6), cloud) for j in range(2 * POSES)]
    drives = [(np.arange(n), {"gnss": effects})]
    return Evidence(observed, by_pose, {"heave": lift @ lift.T}, drives, clouds=clouds)


def test_the_slope_of_the_likelihood_is_right() -> None:
    made = evidence(0, 5e-3, None)
    parts: list[Part] = [made.white["heave"], made.clouds[3], made.slow("gnss", (0, 1), 8.0)]
    made.observed.known[...] += np.diag(np.full(12 * POSES, 1e-6))
    x = np.log([4e-3, 1.2, 6e-3])
    value, slope, _ = made.observed.cost(parts, x)

    assert made.observed.value(parts, x) == pytest.approx(value, rel=1e-12)
    for i in range(3):
        more, less = (made.observed.cost(parts, x + s * np.eye(3)[i])[0] for s in (1e-4, -1e-4))
        assert slope[i] == pytest.approx((more - less) / 2e-4, rel=1e-4, abs=1e-4)


def test_variances_are_found_and_parameters_do_not_count_as_precision() -> None:
    rng = np.random.default_rng(3)
    design = rng.standard_normal((60, 20))
    residuals = design @ rng.standard_normal(20) + 0.1 * rng.standard_normal(60)
    observed = Observed(residuals, design, np.full(20, 1e-6), 1e-12 * np.eye(60))
    unknown = Unknown(1.0, math.log(10.0), (1e-4, 1e4))

    (sigma,), _ = maximise(lambda x: observed.cost([np.eye(60)], x), [unknown], np.ones(1))

    orthogonal = np.linalg.qr(design, mode="complete")[0][:, 20:]
    assert sigma == pytest.approx(np.sqrt(np.mean((orthogonal.T @ residuals) ** 2)), rel=0.03)


@pytest.mark.parametrize("heave_m", [2.5e-3, 10e-3])
def test_heave_is_found_and_no_error_where_there_is_none(heave_m: float) -> None:
    found = estimated(evidence(1, heave_m, None), NoiseConfig())

    assert found.heave_m == pytest.approx(heave_m, rel=0.35)
    assert found.correlated == ()
    sources = {level.name: level.source for level in found.levels}
    assert sources["heave"] == "residuals of the LiDARs"
    assert sources["ground_normal"] == "the usual figure"


def test_without_an_imu_the_heave_is_at_least_the_usual_one() -> None:
    made = evidence(1, 3e-4, None)
    assert estimated(made, NoiseConfig()).heave_m < 1.5e-3

    found = estimated(made, NoiseConfig(), of_wheels=True)

    assert found.heave_m == pytest.approx(HEAVE_SIGMA_M)
    assert estimated(made, NoiseConfig(heave_m=2e-3), of_wheels=True).heave_m == 2e-3
    larger = estimated(evidence(1, 12e-3, None), NoiseConfig(), of_wheels=True)
    assert larger.heave_m == pytest.approx(12e-3, rel=0.35)


def test_an_error_of_the_fixes_that_is_correlated_over_time_is_found() -> None:
    true = CorrelatedError("gnss", (0.02, 0.02, 0.015), 10.0)

    found = estimated(evidence(2, 5e-3, true), NoiseConfig())

    (error,) = found.correlated
    assert error.kind == "gnss"
    assert error.sigmas == pytest.approx(true.sigmas, rel=0.9)
    assert error.time_s == pytest.approx(10.0, rel=1.0)
    assert found.heave_m == pytest.approx(5e-3, rel=0.35)
    names = {level.name: level for level in found.levels}
    assert names["gnss_correlated_horizontal"].time_s == error.time_s


def test_an_error_that_the_motion_data_rule_out_is_none_of_the_fixes() -> None:
    """What the LiDARs have wrong looks like 30 mm of them; an IMU knows them to 2 mm."""
    made = evidence(2, 5e-3, CorrelatedError("gnss", (0.03, 0.03, 0.0075), 4.0))
    (alone,) = estimated(made, NoiseConfig()).correlated
    assert alone.sigmas[0] > 0.02
    size = 3 * STEPS
    known = np.diag(np.full(size, 0.002**-2.0))
    small = 0.002 * np.random.default_rng(1).standard_normal(size)
    motion = ErrorLikelihood(("gnss",), STAMPS, known, known @ small)
    within = replace(made, motion=[motion], sensor_sigmas={"gnss": np.full(3, 0.01)})
    for error in estimated(within, NoiseConfig()).correlated:
        assert error.sigmas[0] < 0.005


@pytest.mark.parametrize("swing_m", [0.0, 1.0])
def test_motion_data_ask_for_no_error_that_the_lidars_do_not_show(swing_m: float) -> None:
    """A wrong level of the accelerometer looks like a slow error of any size."""
    made = evidence(2, 5e-3, CorrelatedError("gnss", (0.02, 0.02, 0.015), 10.0))
    (alone,) = estimated(made, NoiseConfig()).correlated
    size = 3 * STEPS
    swing = np.tile(swing_m * np.sin(0.2 * np.arange(STEPS)), 3)
    weak = np.eye(size)
    motion = ErrorLikelihood(("gnss",), STAMPS, weak, weak @ swing)
    (error,) = estimated(replace(made, motion=[motion]), NoiseConfig()).correlated
    assert error.sigmas == pytest.approx(alone.sigmas, rel=0.1)


def test_what_motion_data_rule_out_grows_with_the_size_and_has_the_right_slope() -> None:
    size = 3 * STEPS
    known = np.diag(np.full(size, 0.01**-2.0))
    motion = ErrorLikelihood(("gnss",), STAMPS, known, np.zeros(size))
    only = replace(evidence(0, 5e-3, None), motion=[motion, motion])
    horizontal, vertical = limits_by_motion(only, "gnss")
    error = CorrelatedError("gnss", (0.02, 0.02, 0.0), 10.0)
    (gain,) = motion.gains(error, np.ones(1))
    lost, by_sigma, by_time = horizontal(math.log(0.02), math.log(10.0))
    assert lost == pytest.approx(-2.0 * gain, rel=0.01)
    more, longer = (horizontal(math.log(0.02 * a), math.log(10.0 * b))[0] for a, b in NEAR)
    assert [by_sigma, by_time] == pytest.approx([(more - lost) / H, (longer - lost) / H], rel=0.02)
    assert horizontal(math.log(1e-5), math.log(10.0))[0] == pytest.approx(0.0, abs=1e-3)
    assert 0.0 < vertical(math.log(0.02), math.log(10.0))[0] < lost
    assert limits_by_motion(replace(only, motion=[]), "gnss") == []


def test_an_error_of_the_heading_is_none_of_roll_and_pitch() -> None:
    """An INS has its heading from elsewhere. A tilt that errs as fast takes up the gyroscope."""
    true = CorrelatedError("orientation", (1e-4, 1e-4, 3e-3), 10.0)
    made = evidence(2, 5e-3, None)
    ((columns, effects),) = made.effects
    shifted_by = effects["gnss"].gain.reshape(POSES, 6, 3, STEPS)
    turned = np.roll(shifted_by, 3, axis=1).reshape(6 * POSES, 3, STEPS)
    made = replace(made, effects=[(columns, {"orientation": ErrorEffects("", STAMPS, turned)})])
    rng = np.random.default_rng(4)
    moved = np.hstack([s * made.by_pose @ turned[:, a] for a, s in enumerate(true.sigmas)])
    swing = np.exp(-np.abs(STAMPS[:, None] - STAMPS) * 1e-9 / true.time_s)
    error = (np.linalg.cholesky(swing) @ rng.standard_normal((STEPS, 3))).T.ravel()
    seen = replace(made.observed, residuals=made.observed.residuals + moved @ error)

    (found,) = estimated(replace(made, observed=seen), NoiseConfig()).correlated

    assert found.kind == "orientation"
    assert found.sigmas[2] == pytest.approx(true.sigmas[2], rel=0.7)
    assert found.sigmas[0] < 0.2 * found.sigmas[2]
    levels = estimated(replace(made, observed=seen), NoiseConfig()).levels
    sizes = {level.name: level.sigma for level in levels}
    assert sizes["orientation_correlated_yaw"] == found.sigmas[2]
    assert sizes["orientation_correlated_tilt"] == found.sigmas[0]


def test_the_slope_of_all_levels_and_factors_of_clouds_is_right() -> None:
    made, names = evidence(0, 5e-3, None), ["heave", "registration"]
    rng = np.random.default_rng(1)
    x = np.log([4e-3, 1.2, *rng.uniform(0.5, 3.0, 2 * POSES), 6e-3, 3e-3, 8.0])
    likelihood = sensor_noise._likelihood(made, names, ["gnss"])
    _, slope, _ = likelihood.cost(x)

    step = 1e-4 * np.eye(len(x))
    for i in (0, 1, 2, 7, len(x) - 3, len(x) - 2):
        more, less = (likelihood.value(x + sign * step[i]) for sign in (1.0, -1.0))
        assert slope[i] == pytest.approx((more - less) / 2e-4, rel=1e-4, abs=1e-4)


def test_clouds_that_are_far_off_do_not_hide_an_error_of_the_fixes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Six of 32 clouds are off by ten to forty of their sigmas, as ones of a few points are."""
    true = CorrelatedError("gnss", (0.015, 0.015, 0.01), 10.0)
    made = evidence(2, 5e-3, true)
    far = made.observed.residuals.copy()
    rng = np.random.default_rng(3)
    for j in (3, 8, 13, 17, 22, 30):
        far[6 * j : 6 * j + 6] += (
            20.0 * rng.standard_normal(6) * np.sqrt(np.diag(made.clouds[j].cov))
        )

    made = replace(made, observed=replace(made.observed, residuals=far))

    found = estimated(made, NoiseConfig())

    (error,) = found.correlated
    assert error.sigmas[0] == pytest.approx(true.sigmas[0], rel=0.4)
    assert found.heave_m == pytest.approx(5e-3, rel=0.35)
    # As if all clouds were as good.
    monkeypatch.setattr(sensor_noise, "CLOUD", Unknown(1.0, 1e-3, (0.99, 1.01)))
    assert estimated(made, NoiseConfig()).correlated == ()


def test_an_error_that_the_lidars_neither_show_nor_rule_out_is_called_open() -> None:
    white_m = 5e-3
    made = replace(evidence(2, 5e-3, None), sensor_sigmas={"gnss": np.full(3, white_m)})

    found = estimated(made, NoiseConfig())

    (error,) = found.correlated
    assert found.opened == ("gnss",)
    assert 0.02 < error.sigmas[0] / white_m < 0.7
    sources = {level.name: level.source for level in found.levels}
    assert sources["gnss_correlated_vertical"] == OPEN
    assert estimated(made, NoiseConfig(gnss_correlated_horizontal_m=0.0)).correlated == ()
    precise = replace(made, sensor_sigmas={"gnss": np.full(3, 0.2)})
    assert estimated(precise, NoiseConfig()).correlated == ()  # it would show


def test_an_error_that_the_lidars_show_has_its_expected_size() -> None:
    true = CorrelatedError("gnss", (0.02, 0.02, 0.02), 10.0)
    made = replace(evidence(2, 5e-3, true), sensor_sigmas={"gnss": np.full(3, 0.02)})

    found = estimated(made, NoiseConfig())

    (error,) = found.correlated
    assert found.opened == ()
    assert error.sigmas == pytest.approx(true.sigmas, rel=0.5)
    assert OPEN not in {level.source for level in found.levels}


def test_a_lever_arm_that_is_off_is_no_error_of_the_fixes_once_it_is_free() -> None:
    """Its effect turns with the vehicle, as slowly as an error of seconds."""
    heading = np.linspace(0.0, 4.0 * math.pi, POSES)
    turned = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    moved = np.zeros((POSES, 6, 2))
    moved[:, 3:5] = -turned.transpose(2, 0, 1)
    sound = evidence(1, 5e-3, None)
    by_arm = sound.by_pose @ moved.reshape(-1, 2)
    seen = replace(sound.observed, residuals=sound.observed.residuals + by_arm @ [0.1, -0.05])
    free = replace(
        seen,
        design=np.hstack([seen.design, by_arm]),
        ridge=np.concatenate([seen.ridge, [1.0, 1.0]]),
    )

    (error,) = estimated(replace(sound, observed=seen), NoiseConfig()).correlated
    assert error.sigmas[0] > 0.02
    assert estimated(replace(sound, observed=free), NoiseConfig()).correlated == ()


def test_levels_of_the_config_are_kept() -> None:
    true = CorrelatedError("gnss", (0.02, 0.02, 0.015), 10.0)
    config = NoiseConfig(heave_m=0.004, gnss_correlated_horizontal_m=0.0)

    found = estimated(evidence(2, 5e-3, true), config)

    assert found.heave_m == 0.004
    assert found.correlated == ()
    assert {level.source for level in found.levels if level.name == "heave"} == {"config"}


def test_every_axis_of_an_error_has_a_sigma() -> None:
    assert GROUPS.keys() == SLOW.keys() == MOVES.keys()
    for groups in GROUPS.values():
        assert sorted(axis for group in groups for axis in group) == [0, 1, 2]
    assert all(
        low < level.median < high for level in LEVELS.values() for low, high in [level.bounds]
    )


def test_without_lidars_the_motion_data_must_rather_have_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Fixes that swing by 50 mm, 35 mm RMS; the accelerometer's level has taken up most of it."""
    motion = recorded()
    assert motion.gnss is not None
    seconds = 1e-9 * (motion.gnss.stamps_ns - motion.gnss.stamps_ns[0])
    wave = smoothed(shifted(motion, 0.05 * np.sin(seconds)))
    assert wave.data.scales["accelerometer"] > 3.0

    found = noise_of_motion([wave], NoiseConfig())

    (error,) = found.correlated
    assert error.kind == "gnss"
    assert found.opened == ("gnss",)
    assert 0.02 < error.sigmas[0] < 0.04
    assert {level.source for level in found.levels} == {"the usual figure", OPEN}
    none = NoiseConfig(gnss_correlated_horizontal_m=0.0, orientation_correlated_deg=0.0)
    assert noise_of_motion([wave], none).correlated == ()
    assert noise_of_motion([], NoiseConfig()).correlated == ()
    monkeypatch.setattr("caliv_graph.calibration.sensor_noise.RATHER_NONE", 0.0)
    assert noise_of_motion([wave], NoiseConfig()).correlated == ()


def test_structure_tells_whether_there_is_an_error() -> None:
    """Structure that knows the errors of the fixes to a millimetre, and says what they are."""
    trajectory = base()
    (motion,) = motion_evidence([trajectory]).motion
    steps, size = len(motion.stamps_ns), len(motion.gradient)
    swing = np.zeros(size)
    own = size // len(motion.kinds) * motion.kinds.index("gnss")
    swing[own : own + steps] = 0.03 * np.sin(1e-9 * (motion.stamps_ns - motion.stamps_ns[0]))
    sure = np.eye(size) * 1e-3**-2.0

    none = noise_of_motion([trajectory], NoiseConfig(), {0: (sure, np.zeros(size))})
    some = noise_of_motion([trajectory], NoiseConfig(), {0: (sure, sure @ swing)})

    assert not any((np.array(e.sigmas) > 2e-3).any() for e in none.correlated if e.kind == "gnss")
    found = next(e for e in some.correlated if e.kind == "gnss")
    assert 0.01 < found.sigmas[0] < 0.04


def test_drives_keep_their_numbers_beside_given_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the structure of drive 1 says is not taken for that of drive 0."""
    given: Any = object()
    drive = base()
    quieter = replace(drive, data=replace(drive.data, scales={"orientation": 0.5}))
    drive = replace(drive, data=replace(drive.data, scales={"orientation": 1.0}))
    monkeypatch.setattr(sensor_noise, "with_noise", lambda *_: (given, quieter))
    noise = SensorNoise(0.0, np.zeros(3), (CorrelatedError("gnss", (0.1, 0.1, 0.1), 8.0),))
    evidence = motion_evidence([given, drive])

    again = sensor_noise._with_other_levels(noise, evidence, [given, drive])

    assert again[0] is given
    assert isinstance(again[1], SmoothedTrajectory)
    assert again[1].data.scales == {"orientation": 0.5}
