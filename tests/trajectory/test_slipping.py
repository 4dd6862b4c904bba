"""Speeds of wheels that slip for a moment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.products import IntArray, MotionData
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from tests.trajectory.motions import stamps
from tests.trajectory.test_wheels import DRIVE, SCALE, beside_imu, settings, whitened

BEGIN_S = 10.0


def slipping(motion: MotionData, seconds: float, m_s: float) -> MotionData:
    """The wheels turn faster than the vehicle goes, for some seconds."""
    assert motion.twist is not None
    velocity = motion.twist.velocity.copy()
    velocity[during(motion, seconds), 0] += m_s
    return replace(motion, twist=replace(motion.twist, velocity=velocity))


def during(motion: MotionData, seconds: float) -> IntArray:
    assert motion.twist is not None
    at_s = (motion.twist.stamps_ns - motion.twist.stamps_ns[0]) * 1e-9
    return np.flatnonzero((at_s >= BEGIN_S) & (at_s < BEGIN_S + seconds))


def smooth(motion: MotionData, **more: object) -> SmoothedTrajectory:
    return smooth_trajectory(motion, settings(**more), stamps(DRIVE.duration_s, 5.0, 0.05))


def without_orientation(motion: MotionData) -> MotionData:
    assert motion.imu is not None
    return replace(motion, imu=replace(motion.imu, orientation_xyzw=None, orientation_cov=None))


def test_wheels_that_spin_for_a_second_are_left_out_and_said() -> None:
    motion = slipping(beside_imu(1), 1.5, 0.4)
    found = smooth(motion)
    assert motion.twist is not None
    # A node has the messages of its tenth of a second.
    spun, out = during(motion, 1.5), found.data.slipped
    assert np.isin(spun[6:-6], out).all()
    assert out.min() >= spun[0] - 6
    assert out.max() <= spun[-1] + 6
    assert len(found.gnss_dropped) == 0
    (line,) = [w for w in found.warnings if "speeds disagree" in w]
    assert f"{len(out)} of {len(motion.twist.stamps_ns)} speeds" in line
    nees, *_ = whitened(motion, found)
    assert nees.mean() < 9.0


def test_wheels_that_spin_fast_bend_nothing() -> None:
    # While they count, fixes beside the slip seem wrong, and scale and delay of the speeds too.
    motion = slipping(beside_imu(1), 1.5, 6.0)
    found = smooth(without_orientation(motion), time_offset_sigma_s=None)
    assert np.isin(during(motion, 1.5)[6:-6], found.data.slipped).all()
    assert len(found.gnss_dropped) == 0
    nees, turn, _ = whitened(motion, found)
    assert nees.mean() < 9.0
    assert np.sqrt((turn[:, 2] ** 2).mean()) < 0.02
    assert abs(found.data.speed_scale - SCALE) < 0.01


def test_wheels_that_lock_while_the_vehicle_goes_on_are_left_out() -> None:
    motion = beside_imu(1)
    assert motion.twist is not None
    velocity = motion.twist.velocity.copy()
    locked = during(motion, 1.0)
    velocity[locked] = 0.0
    motion = replace(motion, twist=replace(motion.twist, velocity=velocity))
    found = smooth(without_orientation(motion), time_offset_sigma_s=None)
    assert np.isin(locked[6:-6], found.data.slipped).all()
    assert abs(found.data.speed_scale - SCALE) < 0.01


@pytest.mark.parametrize("step_m_s", [0.05, 0.1, 0.278])
def test_steps_of_the_numbers_are_no_slips(step_m_s: float) -> None:
    motion = beside_imu(1)
    assert motion.twist is not None
    velocity = motion.twist.velocity.copy()
    velocity[:, 0] = step_m_s * np.round(velocity[:, 0] / step_m_s)
    found = smooth(replace(motion, twist=replace(motion.twist, velocity=velocity)))
    assert len(found.data.slipped) == 0


def test_their_noise_is_that_of_the_others() -> None:
    sound, slipped = smooth(beside_imu(1)), smooth(slipping(beside_imu(1), 1.5, 0.4))
    assert "speed" in sound.data.scales
    # One in thirty speeds is missing.
    ratio = slipped.data.scales["speed"] / sound.data.scales["speed"]
    assert ratio == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_sound_speeds_stay(seed: int) -> None:
    found = smooth(beside_imu(seed))
    assert len(found.data.slipped) == 0
    assert not any("speeds disagree" in w for w in found.warnings)


def test_speeds_that_lie_apart_for_half_of_the_drive_are_no_outliers() -> None:
    found = smooth(slipping(beside_imu(1), 0.5 * DRIVE.duration_s, 0.4))
    assert len(found.data.slipped) == 0


def test_without_robust_weights_all_are_believed() -> None:
    config = settings()
    robust = config.robust.model_copy(update={"kernel": "none"})
    config = config.model_copy(update={"robust": robust})
    motion = slipping(beside_imu(1), 1.5, 0.4)
    found = smooth_trajectory(motion, config, stamps(DRIVE.duration_s, 5.0, 0.05))
    assert len(found.data.slipped) == 0


def test_velocities_of_all_axes_are_left_out_likewise() -> None:
    motion = beside_imu(1)
    assert motion.twist is not None
    rng = np.random.default_rng(4)
    velocity = motion.twist.velocity.copy()
    velocity[:, 1:] = 0.03 * rng.standard_normal((len(velocity), 2))
    beside = during(motion, 1.0)
    velocity[beside, 1] += 0.3
    found = smooth(replace(motion, twist=replace(motion.twist, velocity=velocity)))
    assert not found.data.speed_alone
    assert np.isin(beside[6:-6], found.data.slipped).all()
    assert len(found.data.slipped) <= len(beside) + 12
