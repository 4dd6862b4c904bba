"""What motion data alone say of the smoother's inputs, on drives with known mistakes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.motion_suspects import motion_parts, motion_scores
from caliv_graph.calibration.suspect_values import motion_suspects
from caliv_graph.config.model import Config
from caliv_graph.products import MotionData, Suspect
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import JointInformation, SmoothedTrajectory
from caliv_graph.uncertainty.suspects import ranking
from caliv_graph.wording.suspects import motion_sentence
from tests.trajectory.motions import Course, config_for, eight_drive, mounted_askew, record, stamps
from tests.trajectory.test_wheels import ANTENNA, wheels

COURSE = Course(eight_drive(14.0), rough=1.0)
SENSORS = replace(mounted_askew(), imu_hz=50.0)
WANTED = stamps(14.0, 2.0, 0.0512)
CONFIG = config_for(SENSORS)


@cache
def drive(noise: float = 1.0, seed: int = 1) -> MotionData:
    return record(COURSE, replace(SENSORS, noise=noise), seed)


def suspects_of(motion: MotionData, config: Config = CONFIG) -> tuple[Suspect, ...]:
    return motion_suspects([smooth_trajectory(motion, config, WANTED)], {0: motion}, config)


def with_arm(arm: tuple[float, float, float]) -> Config:
    gnss = CONFIG.gnss.model_copy(update={"lever_arm": arm})
    return CONFIG.model_copy(update={"gnss": gnss})


def fixes_late(motion: MotionData) -> MotionData:
    assert motion.gnss is not None
    gnss = replace(motion.gnss, stamps_ns=motion.gnss.stamps_ns + 150_000_000)
    return replace(motion, gnss=gnss)


def too_fast(motion: MotionData) -> MotionData:
    assert motion.twist is not None
    twist = replace(motion.twist, velocity=1.2 * motion.twist.velocity)
    return replace(motion, twist=twist)


def test_poses_that_rounding_makes_indefinite_are_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scans 0.5 ms apart on a map whose height nothing tells: 1e12 beside 5 per square metre."""
    motion = replace(drive(), gnss=None)
    close = np.sort(np.concatenate([WANTED, WANTED[::3] + 500_000]))
    smoothed = smooth_trajectory(motion, CONFIG, close)
    exact = motion_parts({0: smoothed}, {0: close})[1][0]
    joint = SmoothedTrajectory.joint

    def rounded(*args: Any) -> JointInformation:
        found = joint(*args)
        information = found.information.copy()
        heights = 6 * np.arange(len(close)) + 5
        information[heights, heights] *= 1.0 - 1e-11
        of_poses = information[: 6 * len(close), : 6 * len(close)]
        assert np.linalg.eigvalsh(of_poses)[0] < 0.0
        return replace(found, information=information)

    monkeypatch.setattr(SmoothedTrajectory, "joint", rounded)
    candidates, parts = motion_parts({0: smoothed}, {0: close})

    # Of the clock and of the gyroscope's scale, which heights tell nothing of.
    assert [candidates[i].name for i in (0, 4)] == ["imu.time_offset", "imu.gyroscope.scale"]
    np.testing.assert_allclose(parts[0].own[[0, 6], [0, 6]], exact.own[[0, 6], [0, 6]], rtol=0.01)


def test_wheels_without_an_imu_have_suspects_whose_clocks_are_estimated() -> None:
    """All of them are in the chain of the smoothed trajectory, which has the wanted poses alone."""
    motion = wheels(1)
    config = config_for(
        ANTENNA,
        gnss={"lever_arm": list(ANTENNA.lever_arm), "time_offset_sigma_s": 0.02},
        wheels={"tilt_sigma_deg": 0.1, "slip_sigma_deg": 0.1, "time_offset_sigma_s": 0.01},
    )
    smoothed = smooth_trajectory(motion, config, WANTED)
    assert {"gnss.time_offset", "twist.time_offset"} <= {
        p.parameter.name for p in smoothed.parameters
    }
    found = motion_suspects([smoothed], {0: motion}, config)
    assert {"gnss.time_offset", "twist.time_offset"} <= {s.input for s in found}
    assert all(s.sigmas < 4.0 for s in found)


@pytest.mark.parametrize(("noise", "seed"), [(1.0, 1), (2.0, 2)])
def test_a_sound_drive_has_no_suspect_even_with_doubled_noise(noise: float, seed: int) -> None:
    motion = drive(noise, seed)
    ranked = ranking(motion_scores([smooth_trajectory(motion, CONFIG, WANTED)]))
    assert {r.candidate.name for r in ranked} >= {"gnss.lever_arm", "imu.T_vehicle_imu"}
    assert all(r.freed.sigmas < 4.0 for r in ranked)


def test_a_lever_arm_of_zeros_is_found_with_its_value() -> None:
    first = suspects_of(drive(), with_arm((0.0, 0.0, 0.0)))[0]
    assert first.input == "gnss.lever_arm"
    assert first.sigmas > 5.0
    off = np.abs(np.array(first.value) - np.array(SENSORS.lever_arm)) / np.array(first.sigma)
    assert (off < 3.0).all()
    said = motion_sentence([first])
    assert said.startswith("The motion data contradict each other, most likely: gnss.lever_arm, by")
    assert "Measure the antenna in the vehicle frame again" in said


@pytest.mark.parametrize(
    ("broken", "name", "value"),
    [(fixes_late, "gnss.time_offset", 0.15), (too_fast, "twist.scale", 1.2)],
)
def test_a_wrong_clock_and_a_wrong_scale_are_found_with_their_values(
    broken: Callable[[MotionData], MotionData], name: str, value: float
) -> None:
    first = suspects_of(broken(drive()))[0]
    assert first.input == name
    assert first.sigmas > 5.0
    assert first.value[0] == pytest.approx(value, abs=3.0 * first.sigma[0])


def test_an_imu_that_is_turned_is_found_with_its_angles() -> None:
    right = CONFIG.imu.T_vehicle_imu
    R = gtsam.Rot3.Expmap(np.radians([0.0, 4.0, 0.0])).compose(right.pose().rotation())
    wrong = right.model_copy(update={"rpy_deg": tuple(np.degrees(R.rpy()).tolist())})
    imu = CONFIG.imu.model_copy(update={"T_vehicle_imu": wrong})
    first = suspects_of(drive(), CONFIG.model_copy(update={"imu": imu}))[0]
    assert first.input == "imu.T_vehicle_imu"
    assert first.sigmas > 5.0
    assert first.change[1] == pytest.approx(-4.0, abs=3.0 * first.sigma[1])


def test_small_mistakes_are_not_called_a_contradiction() -> None:
    """An arm that is off by its sigma of a centimetre."""
    x, y, z = SENSORS.lever_arm
    suspects = suspects_of(drive(), with_arm((x + 0.01, y - 0.01, z)))
    assert all(s.sigmas < 4.0 for s in suspects)
    assert motion_sentence(suspects) == ""
