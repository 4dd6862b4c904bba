"""Speeds beside an IMU that are stamped late, as by a vehicle's bus."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import Array, MotionData
from caliv_graph.trajectory.inputs import TWIST_CLOCK
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from tests.trajectory.motions import stamps
from tests.trajectory.test_wheels import DRIVE, SCALE, beside_imu, settings, whitened


def late(late_s: float) -> MotionData:
    motion = beside_imu(1)
    assert motion.twist is not None
    later = motion.twist.stamps_ns + round(late_s * NANOSECONDS_PER_SECOND)
    return replace(motion, twist=replace(motion.twist, stamps_ns=later))


def smooth(motion: MotionData, **wheels: object) -> SmoothedTrajectory:
    wheels = {"time_offset_sigma_s": None, **wheels}  # as by default
    return smooth_trajectory(motion, settings(**wheels), stamps(DRIVE.duration_s, 5.0, 0.05))


@cache
def smoothed(late_s: float) -> SmoothedTrajectory:
    return smooth(late(late_s))


def delay_s(found: SmoothedTrajectory) -> tuple[float, float]:
    sigmas = found.sigmas_of("twist.delay")
    assert sigmas is not None
    return found.data.late_s(TWIST_CLOCK), float(sigmas[0])


@pytest.mark.parametrize("late_s", [0.0, 0.12, -0.03])
def test_the_delay_is_found(late_s: float) -> None:
    told_s, sigma_s = delay_s(smoothed(late_s))
    assert sigma_s < 0.01
    assert told_s == pytest.approx(late_s, abs=4.0 * sigma_s)


def positions(found: SmoothedTrajectory) -> Array:
    return np.array([T.translation() for T in found.trajectory.T_map_vehicle])


def test_poses_are_those_of_speeds_in_time() -> None:
    # Taken as they are stamped, the vehicle would be 0.12 s, a quarter of a metre, elsewhere.
    off = np.linalg.norm(positions(smoothed(0.12)) - positions(smoothed(0.0)), axis=1)
    assert off.max() < 0.01
    nees, *_ = whitened(late(0.12), smoothed(0.12))
    assert nees.mean() < 9.0


def test_their_noise_is_not_enlarged_by_it() -> None:
    in_time, late_ones = smoothed(0.0).data.scales, smoothed(0.12).data.scales
    assert late_ones.keys() == in_time.keys()
    assert late_ones["speed"] == pytest.approx(in_time["speed"], rel=0.05)
    assert len(smoothed(0.12).data.slipped) == 0


def test_a_delay_is_found_where_the_scale_is_exact() -> None:
    # Lateral velocities are measured, too: nothing but the delay is estimated roughly first. By
    # default that would be exact as well.
    motion = late(0.3)
    assert motion.twist is not None
    velocity = motion.twist.velocity.copy()
    velocity[:, 0] /= SCALE
    velocity[:, 1:] = 0.03 * np.random.default_rng(4).standard_normal((len(velocity), 2))
    motion = replace(motion, twist=replace(motion.twist, velocity=velocity))
    found = smooth(motion, time_offset_sigma_s=0.05)
    told_s, sigma_s = delay_s(found)
    assert sigma_s < 0.01
    assert told_s == pytest.approx(0.3, abs=4.0 * sigma_s)
    assert len(found.data.slipped) == 0
    assert smooth(motion).sigmas_of("twist.delay") is None


def test_late_speeds_belong_to_the_nodes_where_they_were_measured() -> None:
    # Else the IMU carries them over the delay, and its errors turn its own mount.
    assert smoothed(0.12).data.about_late_ns == pytest.approx(0.12e9, abs=10e6)
    assert abs(smoothed(0.0).data.about_late_ns) < 10e6


def test_an_imu_that_is_late_moves_no_other_clock() -> None:
    # Fixes and speeds agree with each other, and not with it.
    motion = beside_imu(1)
    assert motion.imu is not None
    imu = replace(motion.imu, stamps_ns=motion.imu.stamps_ns + 20_000_000, orientation_xyzw=None)
    config = settings(time_offset_sigma_s=None)
    clocks = {"gnss": 0.02, "imu": 0.005}
    config = config.model_copy(
        update={
            name: getattr(config, name).model_copy(update={"time_offset_sigma_s": sigma_s})
            for name, sigma_s in clocks.items()
        }
    )
    motion = replace(motion, imu=imu)
    found = smooth_trajectory(motion, config, stamps(DRIVE.duration_s, 5.0, 0.05))
    assert abs(found.data.late_s(TWIST_CLOCK)) < 1e-3
    assert abs(found.data.late_s("gnss")) < 1e-3
    nees, *_ = whitened(motion, found)
    assert nees.mean() < 9.0


def test_a_delay_is_said_from_20_ms_on() -> None:
    assert any("ms late in the clock of the IMU" in w for w in smoothed(0.12).warnings)
    assert any("ms early in the clock of the IMU" in w for w in smoothed(-0.03).warnings)
    assert not any("in the clock of the IMU" in w for w in smoothed(0.0).warnings)


def test_stamps_that_are_exact_have_no_delay() -> None:
    found = smooth(late(0.0), time_offset_sigma_s=0.0)
    assert found.sigmas_of("twist.delay") is None
    assert TWIST_CLOCK not in found.data.late_ns
