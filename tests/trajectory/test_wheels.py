"""Wheels and fixes without an IMU, against drives that are known exactly."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest

from caliv_graph.config.model import Config
from caliv_graph.config.noise import NoiseConfig
from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, MotionData, TwistSamples
from caliv_graph.scenario.drives import Drive
from caliv_graph.trajectory.heading import heading_disagreement
from caliv_graph.trajectory.imu import DeadReckoning
from caliv_graph.trajectory.inputs import check_input
from caliv_graph.trajectory.measurements import velocities_at_nodes
from caliv_graph.trajectory.parameters import SPEED_POINT
from caliv_graph.trajectory.physics import motion_physics
from caliv_graph.trajectory.rates import turn_variances
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.uncertain import AXLE_SLIP_SIGMA
from caliv_graph.trajectory.wheels import (
    accelerations,
    level_sigmas,
    node_spans_s,
    wheel_model,
    wheel_noise,
)
from caliv_graph.wording.physics import motion_findings
from tests.trajectory.motions import (
    START_NS,
    Course,
    Sensors,
    arc_drive,
    config_for,
    eight_drive,
    errors,
    mounted_askew,
    record,
    rows_of,
    seconds,
    stamps,
)

DRIVE = Course(eight_drive(14.0))
ANTENNA = replace(Sensors(), lever_arm=(0.3, 0.5, 1.8))
SCALE = 1.03


def wheels(seed: int, yaw_rate: bool = True) -> MotionData:
    """Fixes and odometry at 50 Hz: forward speed, and a yaw rate with a bias."""
    motion = record(DRIVE, ANTENNA, seed)
    rng = np.random.default_rng([seed, 9])
    at = stamps(DRIVE.duration_s, 50.0)
    truth = DRIVE.at(seconds(at))
    speed = np.linalg.norm(truth.velocity_map, axis=1)
    velocity = np.zeros((len(at), 3))
    velocity[:, 0] = SCALE * speed + 0.03 * rng.standard_normal(len(at))
    rate = truth.rates[:, 2] + 0.004 + 0.005 * rng.standard_normal(len(at))
    twist = TwistSamples(at, velocity, yaw_rate=rate if yaw_rate else None)
    return replace(motion, imu=None, twist=twist)


def settings(**more: object) -> Config:
    return config_for(ANTENNA, wheels={"tilt_sigma_deg": 0.1, "slip_sigma_deg": 0.1, **more})


@cache
def smoothed(yaw_rate: bool) -> tuple[MotionData, SmoothedTrajectory]:
    motion = wheels(1, yaw_rate=yaw_rate)
    return motion, smooth_trajectory(motion, settings(), stamps(DRIVE.duration_s, 5.0, 0.05))


def whitened(motion: MotionData, found: SmoothedTrajectory) -> tuple[Array, Array, Array]:
    R, t = stack(found.trajectory.T_map_vehicle)
    turn, shift = errors(DRIVE, motion, found.trajectory.stamps_ns, R, t)
    e = np.hstack([turn, np.einsum("nji,nj->ni", R, shift)])
    assert found.trajectory.cov is not None
    nees = np.einsum("ni,nij,nj->n", e, np.linalg.inv(found.trajectory.cov), e)
    return nees, turn, shift


@pytest.mark.parametrize(("yaw_rate", "worst_rad"), [(True, 4e-3), (False, 10e-3)])
def test_wheels_and_fixes_tell_the_motion(yaw_rate: bool, worst_rad: float) -> None:
    motion, found = smoothed(yaw_rate)
    nees, turn, shift = whitened(motion, found)
    assert np.sqrt((turn**2).mean(axis=0)).max() < worst_rad
    assert np.sqrt((shift[:, :2] ** 2).mean(axis=0)).max() < 12e-3
    # Flat ground and no slip: less than what the sigmas allow.
    assert nees.mean() < 9.0
    assert found.gravity_m_s2 == 0.0


def test_the_scale_of_the_wheels_is_found() -> None:
    _, found = smoothed(True)
    sigmas = found.sigmas_of("twist.scale")
    assert sigmas is not None
    assert sigmas[0] < 2e-3
    assert abs(found.data.speed_scale - SCALE) < 4.0 * sigmas[0]


def beside_imu(seed: int, point_m: float = 0.0) -> MotionData:
    """The same beside an IMU; the speed is that of a point to the left of the vehicle's x axis."""
    motion, inertial = wheels(seed), record(DRIVE, ANTENNA, seed)
    assert motion.twist is not None
    turn = DRIVE.at(seconds(motion.twist.stamps_ns)).rates[:, 2]
    velocity = motion.twist.velocity.copy()
    velocity[:, 0] -= SCALE * point_m * turn
    return replace(motion, imu=inertial.imu, twist=replace(motion.twist, velocity=velocity))


def test_an_axle_that_slips_in_curves_is_no_axle_elsewhere() -> None:
    # At 2 m/s an axle that slips by 8 mrad per m/s^2 goes as one 32 mm ahead of it would: an
    # antenna that is as much farther ahead of the first.
    softness, speed_m_s = 0.008, 2.0
    x, y, z = ANTENNA.lever_arm
    found = []
    for ahead_m in (0.0, softness * speed_m_s**2):
        antenna = replace(ANTENNA, lever_arm=(x + ahead_m, y, z))
        known = {"tilt_sigma_deg": 0.1, "slip_sigma_deg": 0.1, "rotation_sigma_deg": 0.01}
        config = config_for(antenna, wheels=known)
        found.append(smooth_trajectory(wheels(1), config, stamps(DRIVE.duration_s, 5.0, 0.05)))
    sigmas = found[1].sigmas_of("wheels.slip")
    assert sigmas is not None
    # What the drive tells of it, the rest is the prior's zero.
    told = 1.0 - (sigmas[0] / AXLE_SLIP_SIGMA) ** 2
    slips = [each.data.axle_slip for each in found]
    assert told > 0.25
    assert slips[1] - slips[0] == pytest.approx(told * softness, rel=0.2)
    assert abs(slips[0]) < 2.0 * sigmas[0]


def test_a_yaw_rate_of_the_course_is_found_where_fixes_tell_the_course() -> None:
    # A steering angle gives the rate of the course. That of the body, which slips by 8 mrad per
    # m/s^2, is ahead of it where the lateral acceleration changes.
    softness = 0.008
    found = []
    for lag in (0.0, softness):
        motion = wheels(1)
        assert motion.twist is not None
        assert motion.twist.yaw_rate is not None
        at = seconds(motion.twist.stamps_ns)
        of = DRIVE.at(at)
        swing = np.linalg.norm(of.velocity_map, axis=1) * of.rates[:, 2]
        yaw_rate = motion.twist.yaw_rate - lag * np.gradient(swing, at)
        motion = replace(motion, twist=replace(motion.twist, yaw_rate=yaw_rate))
        found.append(smooth_trajectory(motion, settings(), stamps(DRIVE.duration_s, 5.0, 0.05)))
    lags = [offset_of(each, "wheels.course") for each in found]
    sigmas = found[1].sigmas_of("wheels.course")
    assert sigmas is not None
    told = 1.0 - (sigmas[0] / AXLE_SLIP_SIGMA) ** 2
    assert told > 0.05
    assert lags[1] - lags[0] == pytest.approx(told * softness, rel=0.35)
    assert abs(lags[0]) < 2.0 * sigmas[0]


def offset_of(found: SmoothedTrajectory, name: str) -> float:
    (each,) = [p for p in found.parameters if p.parameter.name == name]
    assert each.offset is not None
    return float(each.offset[0])


@pytest.mark.parametrize("speed", [2.0, -2.0])
def test_an_axle_slips_to_the_outside_forwards_and_backwards(speed: float) -> None:
    # A circle to the left or, backwards, with the wheels to the left: its centre is on the left.
    rate, softness = speed / 5.0, 0.005
    at = START_NS + 10_000_000 * np.arange(300)
    none = np.zeros((len(at), 3))
    dead = DeadReckoning(at, np.tile([0.0, 0.0, rate], (len(at), 1)), none)
    odometry = TwistSamples(at[5:-5], np.tile([speed, 0.0, 0.0], (290, 1)))
    cov = np.tile(np.eye(3), (290, 1, 1))
    noise = wheel_noise(odometry, settings())
    lateral = []
    for slip in (0.0, softness):
        found = velocities_at_nodes(
            odometry, cov, at[50:-50:10], dead, noise, gtsam.Pose3(), slip_s2_m=slip
        )
        assert found is not None
        lateral.append(found.velocity_imu[:, 1])
    # 0.8 m/s^2 to the left: 4 mrad of 2 m/s to the right.
    assert lateral[1] - lateral[0] == pytest.approx(-0.008, rel=1e-3)


def test_rates_of_roll_and_pitch_err_by_what_the_springs_allow() -> None:
    _, found = smoothed(True)
    white, constant = turn_variances(found)
    model = found.data.wheels
    assert model is not None
    assert np.sqrt(constant[:2]) == pytest.approx(np.sqrt(2.0) * model.tilt_rad)
    # Nothing measures them: what is known of them at a node is little more.
    assert np.median(found.bias_sigmas()[1][:, :2], axis=0).min() > 0.5 * np.sqrt(constant[0])
    # The yaw rate is that of the odometry.
    assert constant[2] < 1e-4 * constant[0]
    assert white[2] > 0.0


def test_accelerations_are_those_ahead_and_into_the_curve() -> None:
    motion = wheels(1)
    data, _ = check_input(motion, settings())
    assert motion.twist is not None
    nodes = stamps(DRIVE.duration_s, 10.0, 0.5)
    dead = DeadReckoning(data.inertial.stamps_ns, data.inertial.gyro, data.inertial.force)
    found = accelerations(motion.twist, nodes, dead, np.eye(3))
    truth = DRIVE.at(seconds(nodes))
    speed = np.linalg.norm(truth.velocity_map, axis=1)
    steady = speed > 1.99
    # v^2 / r of both circles; the yaw rate has a bias of 4 mrad/s, the speed a scale.
    left = SCALE * speed * (truth.rates[:, 2] + 0.004)
    assert np.ptp(left[steady]) > 0.8
    assert np.abs(found[steady, 1] - left[steady]).max() < 0.04
    # In axes turned to the left by a right angle; stamps that are late by a second are not.
    y_ahead = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = replace(
        motion.twist,
        velocity=motion.twist.velocity @ y_ahead,
        stamps_ns=motion.twist.stamps_ns + 1_000_000_000,
    )
    same = accelerations(turned, nodes, dead, y_ahead, 1_000_000_000)
    assert np.abs(same - found).max() < 1e-9
    late = accelerations(motion.twist, nodes, dead, np.eye(3), 1_000_000_000)
    assert late[-1, 0] == 0.0
    assert np.isfinite(late).all()
    # 2 m/s within seconds, and back.
    ahead = SCALE * np.gradient(speed, seconds(nodes))
    assert np.ptp(ahead) > 2.0
    assert np.sqrt(np.mean((found[:, 0] - ahead) ** 2)) < 0.1


def test_roll_and_pitch_do_not_tell_the_height_of_an_antenna() -> None:
    z = ANTENNA.lever_arm[2] + 0.3
    stated = replace(ANTENNA, lever_arm=(0.3, 0.5, z))
    config = config_for(stated, gnss={"lever_arm": [0.3, 0.5, z]})
    found = smooth_trajectory(wheels(1), config, stamps(DRIVE.duration_s, 5.0, 0.05))
    # The sigma of 10 mm stays, and the value.
    sigmas = found.sigmas_of("gnss.lever_arm")
    assert sigmas is not None
    assert sigmas[2] == pytest.approx(0.01, rel=1e-3)
    assert found.data.lever_arm[2] == pytest.approx(z, abs=1e-4)


def test_with_an_imu_scale_and_place_of_the_speed_are_found() -> None:
    motion = beside_imu(3, point_m=0.08)
    wanted = stamps(DRIVE.duration_s, 2.0)
    found = smooth_trajectory(motion, settings(), wanted)
    sigmas, point = found.sigmas_of("twist.scale"), found.sigmas_of("twist.point")
    assert sigmas is not None
    assert sigmas[0] < 2e-3
    assert abs(found.data.speed_scale - SCALE) < 4.0 * sigmas[0]
    assert point is not None
    assert point[0] < 0.02
    assert abs(found.data.speed_point[0] - 0.08) < 4.0 * point[0]
    exact = smooth_trajectory(beside_imu(3), settings(speed_scale_sigma=0), wanted)
    assert exact.data.speed_scale == 1.0
    assert exact.sigmas_of("twist.scale") is None


def test_the_place_of_the_speed_is_to_the_left_and_above_the_origin() -> None:
    data, _ = check_input(beside_imu(3), settings())
    assert data.T_vehicle_twist.equals(gtsam.Pose3(), 0.0)
    moved = SPEED_POINT.moved(data, np.array([0.1, 0.4]))
    assert moved.T_vehicle_twist.translation().tolist() == [0.0, 0.1, 0.4]
    # Without an IMU the axle's frame stands in for it, and is where the speed is measured.
    alone, _ = check_input(wheels(3), settings())
    assert not alone.speed_alone
    assert alone.T_vehicle_twist.equals(alone.T_vehicle_imu, 0.0)


def test_forward_speeds_do_not_tell_how_an_imu_is_turned() -> None:
    """On level ground, from an axle that does not slip: what they would tell is their noise."""
    motion = beside_imu(4)
    config = settings().model_copy(deep=True)
    imu = config.imu.model_copy(update={"rotation_sigma_deg": 0.3})
    found = smooth_trajectory(
        motion, config.model_copy(update={"imu": imu}), stamps(DRIVE.duration_s, 2.0)
    )
    sigmas = found.sigmas_of("imu.T_vehicle_imu")
    assert sigmas is not None
    assert sigmas[1:] == pytest.approx(np.radians([0.3, 0.3]), rel=0.1)


def test_receivers_of_one_hertz_tell_the_course_too() -> None:
    motion, usual = wheels(1), smoothed(True)[1]
    assert motion.gnss is not None
    kept = np.arange(len(motion.gnss.stamps_ns)) % 10 == 0
    few = replace(motion, gnss=rows_of(motion.gnss, kept))
    found = smooth_trajectory(few, settings(), stamps(DRIVE.duration_s, 5.0, 0.05))
    nees, turn, _ = whitened(few, found)
    assert np.sqrt((turn[:, 2] ** 2).mean()) < 15e-3
    assert nees.mean() < 12.0
    assert found.data.speed_scale == pytest.approx(usual.data.speed_scale, abs=0.01)


def test_fixes_that_stay_where_they_are_tell_no_course() -> None:
    motion = wheels(1)
    assert motion.gnss is not None
    still = rows_of(motion.gnss, np.arange(len(motion.gnss.stamps_ns)) < 10)
    with pytest.raises(TrajectoryError, match="heading is unknown"):
        smooth_trajectory(replace(motion, gnss=still), settings(), stamps(DRIVE.duration_s, 5.0))


AHEAD_M = 1.4
"""Of the axle, where the frame of the vehicle may be: in a curve it does not go along its x."""


@pytest.mark.parametrize("drive", [eight_drive(20.0), arc_drive(14.0)], ids=["eight", "arc"])
def test_beside_an_imu_odometry_tells_the_forward_velocity_alone(drive: Drive) -> None:
    """Its zeros to the side are those of the axle, not of the vehicle's origin: 140 mrad of yaw."""
    course, there = Course(drive), mounted_askew()
    motion = record(course, there, 5)
    assert motion.imu is not None
    truth = course.at(seconds(at := stamps(course.duration_s, 50.0)))
    velocity = np.zeros((len(at), 3))
    noise = 0.03 * np.random.default_rng(6).standard_normal(len(at))
    velocity[:, 0] = np.linalg.norm(truth.velocity_map, axis=1) + noise
    motion = replace(
        motion,
        imu=replace(motion.imu, orientation_xyzw=None),
        twist=TwistSamples(at, velocity),
    )
    # The course is that of the axle; seen from a frame that is ahead of it.
    back = np.array([-AHEAD_M, 0.0, 0.0])
    T = gtsam.Pose3(there.T_vehicle_imu.rotation(), there.T_vehicle_imu.translation() + back)
    x, y, z = np.array(there.lever_arm) + back
    config = config_for(replace(there, T_vehicle_imu=T, lever_arm=(x, y, z)))
    wanted = stamps(course.duration_s, 4.0, 0.05)

    found = smooth_trajectory(motion, config, wanted)

    R, p = stack(found.trajectory.T_map_vehicle)
    turn, _ = errors(course, motion, found.trajectory.stamps_ns, R, p)
    assert found.trajectory.cov is not None
    sigma = np.sqrt(np.median(found.trajectory.cov[:, 2, 2]))
    assert np.abs(turn[:, 2]).max() < 4.0 * sigma
    assert sigma < 0.012
    # Stated as 0.1 m/s; of one axis, however the IMU is turned.
    assert found.data.scales == {"speed": pytest.approx(0.3, rel=0.1)}
    assert not len(found.gnss_rejected)
    seen = heading_disagreement(found, motion)
    assert seen is not None
    assert not seen.measured
    if drive.duration_s == pytest.approx(20.0):
        assert seen.axle_m == pytest.approx(-AHEAD_M, abs=0.1)
        assert not seen.warning
        return
    assert re.search(r"vehicle frame is 1\.[345]\d m ahead of the rear axle", seen.warning)
    # A filter in the plane leaves rounding in the place of zeros.
    velocity = velocity + 1e-12 * np.random.default_rng(7).standard_normal(velocity.shape)
    rounded = smooth_trajectory(replace(motion, twist=TwistSamples(at, velocity)), config, wanted)
    np.testing.assert_allclose(stack(rounded.trajectory.T_map_vehicle)[0], R, atol=1e-6)


def test_rounding_does_not_change_the_model_of_an_axle() -> None:
    motion = wheels(1)
    assert motion.twist is not None
    noise = 1e-12 * np.random.default_rng(7).standard_normal(motion.twist.velocity.shape)
    rounded = replace(motion.twist, velocity=motion.twist.velocity + noise)
    assert wheel_model(rounded, settings()) == wheel_model(motion.twist, settings())
    slipping = motion.twist.velocity + np.array([0.0, 0.01, 0.0])
    assert not wheel_model(replace(motion.twist, velocity=slipping), settings()).planar


def test_noise_of_velocities_to_the_side_is_that_of_the_data_without_an_imu_too() -> None:
    motion = wheels(1)
    assert motion.twist is not None
    noise = 0.03 * np.random.default_rng(8).standard_normal((len(motion.twist.stamps_ns), 2))
    velocity = motion.twist.velocity.copy()
    velocity[:, 1:] = noise
    motion = replace(motion, twist=replace(motion.twist, velocity=velocity))
    wanted = stamps(DRIVE.duration_s, 5.0, 0.05)

    found = smooth_trajectory(motion, settings(), wanted)

    # Stated as 0.1 m/s. A tenth too small: part of it passes for braking between the samples.
    scale = found.data.scales["velocity"]
    assert scale == pytest.approx(0.3, rel=0.2)
    stated = settings().model_copy(update={"noise": NoiseConfig(velocity_m_s=0.1 * scale)})
    told = smooth_trajectory(motion, stated, wanted)
    covs = found.trajectory.cov, told.trajectory.cov
    sigmas, usual = (np.sqrt(np.einsum("nii->ni", np.asarray(cov))) for cov in covs)
    np.testing.assert_allclose(sigmas, usual, rtol=0.02)


def test_without_fixes_nothing_pulls_the_scale() -> None:
    motion = replace(wheels(2), gnss=None)
    found = smooth_trajectory(motion, settings(), stamps(DRIVE.duration_s, 2.0))
    sigmas = found.sigmas_of("twist.scale")
    assert sigmas is not None
    assert abs(found.data.speed_scale - 1.0) < 2e-3
    assert sigmas[0] == pytest.approx(0.02, rel=0.05)


def test_poses_within_a_sweep_follow_the_turn() -> None:
    motion, found = smoothed(True)
    at = START_NS + 10_000_000_000 + np.arange(0, 100_000_000, 5_000_000)
    R, t = found.poses_at(at)
    turn, shift = errors(DRIVE, motion, at, R, t)
    # Over 0.1 s the vehicle goes 0.2 m and turns by 22 mrad.
    assert np.abs(turn - turn[0]).max() < 0.5e-3
    assert np.abs(shift - shift[0]).max() < 1e-3


def test_roll_and_pitch_are_a_stationary_process() -> None:
    # Rates that walk and a pull to level, as in the graph: the covariance is
    # s^2 exp(-a) (cos a + sin a), a = |dt| / T.
    config = settings()
    twist = wheels(1).twist
    assert twist is not None
    model, noise = wheel_model(twist, config), wheel_noise(twist, config)
    step_s, variance = 0.05, model.tilt_rad**2
    nodes = START_NS + np.arange(0, 12_000_000_000, round(step_s * 1e9))
    change = np.diff(np.eye(len(nodes)), n=2, axis=0) / step_s
    information = change.T @ change / (noise.gyro_walk[0] ** 2 * step_s)
    information += np.diag(level_sigmas(nodes, model) ** -2)
    cov = np.linalg.inv(information)
    middle, later = len(nodes) // 2, round(model.correlation_s / step_s)
    assert cov[middle, middle] == pytest.approx(variance, rel=0.02)
    after = variance * np.exp(-1.0) * (np.cos(1.0) + np.sin(1.0))
    assert cov[middle, middle + later] == pytest.approx(after, rel=0.03)
    rates = np.diff(np.eye(len(nodes)), axis=0) / step_s
    rate = np.sqrt((rates @ cov @ rates.T)[middle, middle])
    assert rate == pytest.approx(noise.gyro_bias[0], rel=0.03)
    assert node_spans_s(nodes).sum() == pytest.approx((nodes[-1] - nodes[0]) * 1e-9)


def test_what_wheels_cannot_tell_is_said() -> None:
    speeds = replace(wheels(1, yaw_rate=False), gnss=None)
    with pytest.raises(TrajectoryError, match=r"speeds alone .* set topics.gnss"):
        check_input(speeds, settings())
    unread = config_for(ANTENNA, topics={"imu": "/imu"})
    with pytest.raises(TrajectoryError, match=r"no IMU: topics.imu '/imu' .* or leave it out"):
        check_input(wheels(1), unread)


@pytest.mark.parametrize(
    ("speed", "turn", "said"),
    [(3.6, 1.0, "km/h"), (1.0, -1.0, "opposite sign: check the axes of topics.twist")],
)
def test_units_and_signs_of_wheels_are_checked(speed: float, turn: float, said: str) -> None:
    motion = wheels(1)
    twist = motion.twist
    assert twist is not None
    assert twist.yaw_rate is not None
    wrong = replace(twist, velocity=speed * twist.velocity, yaw_rate=turn * twist.yaw_rate)
    found = motion_physics(replace(motion, twist=wrong), settings())
    assert found is not None
    assert [said in finding.sentence for finding in motion_findings(found, settings())] == [True]
    sound = motion_physics(motion, settings())
    assert sound is not None
    assert motion_findings(sound, settings()) == ()
