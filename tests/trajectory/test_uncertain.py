"""Lever arm and rotation of the IMU, measured roughly or not at all, against known truth."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import gtsam
import numpy as np
import pytest

from caliv_graph.conventions import key_imu, key_parameters
from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, MotionData
from caliv_graph.trajectory import smooth
from caliv_graph.trajectory.columns import columns_of
from caliv_graph.trajectory.inputs import check_input
from caliv_graph.trajectory.mounting import COURSE_SIGMA_RAD, with_guessed_rotation
from caliv_graph.trajectory.nodes import place_nodes
from caliv_graph.trajectory.smooth import _solved_roughly, smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.solve import covariances_of
from caliv_graph.trajectory.uncertain import _eliminated, _with_variable, steps_ahead
from tests.trajectory.motions import (
    Course,
    Sensors,
    config_for,
    eight_drive,
    errors,
    mounted_askew,
    record,
    stamps,
)

COURSE = Course(eight_drive(12.0), rough=1.0)
SENSORS = replace(mounted_askew(), imu_hz=50.0, twist_hz=20.0, twist_delay_s=0.017)
MEDIUM = Course(eight_drive(18.0), rough=1.0)
"""Of 12 s the course tells the rotation of an IMU to 4 degrees only."""

MEDIUM_WANTED = stamps(18.0, 2.0, 0.0512)

LONG = Course(eight_drive(24.0), rough=1.0)
"""Where fixes are late, accelerations of 18 s leave open by how much."""

WANTED = stamps(12.0, 2.0, 0.0512)
ARM: dict[str, object] = {"lever_arm": list(SENSORS.lever_arm), "lever_arm_sigma": 1e-7}


def marginals(smoothed: SmoothedTrajectory) -> Array:
    """Covariance of all its uncertain parameters, their priors included."""
    names = [p.parameter.name for p in smoothed.parameters]
    joint = smoothed.joint(smoothed.trajectory.stamps_ns[:2], names)
    information = joint.information.copy()
    at = np.arange(12, len(information))
    information[at, at] += np.concatenate([np.asarray(p.sigmas) for p in smoothed.parameters]) ** -2
    return np.asarray(np.linalg.inv(information)[12:, 12:])


def by_gtsam(smoothed: SmoothedTrajectory) -> Array:
    """(n, 6, 6) covariances of the vehicle's poses at the nodes, by the Bayes tree.

    The states follow a parameter linearly, whatever moves it: here another mean of its prior.
    """
    data, n = smoothed.data, len(smoothed.nodes_ns)
    parameters = [p.parameter for p in smoothed.parameters]
    sigmas = np.concatenate([np.asarray(p.sigmas) for p in smoothed.parameters])
    estimate = smoothed.estimate()
    linear = estimate.graph.factors.linearize(estimate.values)
    cov_imu, _ = covariances_of(linear, data, estimate.states)
    graph = _with_variable(linear, columns_of(smoothed, estimate, parameters))
    moves, states = [], []
    for mean in np.vstack([np.zeros(len(sigmas)), np.diag(sigmas)]):
        solution = _eliminated(graph, n, data.yaw_bias, mean, 1e-3 * sigmas).optimize()
        moves.append(solution.at(key_parameters()))
        states.append([solution.at(key_imu(i)) for i in range(n)])
    moved, poses = np.array(moves[1:]) - moves[0], np.array(states[1:]) - np.array(states[0])
    by_parameter = np.einsum("kl,lni->nik", np.linalg.inv(moved), poses)
    by_parameter -= np.hstack([p.imu_moves(data) for p in parameters])
    total = cov_imu + by_parameter @ smoothed.parameter_cov @ np.swapaxes(by_parameter, 1, 2)
    Ad = np.asarray(data.T_vehicle_imu.AdjointMap())
    return np.asarray(Ad @ total @ Ad.T)


def nees(motion: MotionData, smoothed: SmoothedTrajectory, course: Course = COURSE) -> float:
    """Mean over the wanted poses; 6 for a covariance that is right."""
    trajectory = smoothed.trajectory
    R, t = stack(trajectory.T_map_vehicle)
    turn, shift = errors(course, motion, trajectory.stamps_ns, R, t)
    e = np.hstack([turn, np.einsum("nji,nj->ni", R, shift)])
    assert trajectory.cov is not None
    return float(np.einsum("ni,nij,nj->n", e, np.linalg.inv(trajectory.cov), e).mean())


def test_an_unknown_lever_arm_is_found() -> None:
    motion = record(COURSE, SENSORS, 1)
    config = config_for(SENSORS, gnss={"lever_arm": None}, imu={"rotation_sigma_deg": None})

    smoothed = smooth_trajectory(motion, config, WANTED)

    sigma = np.sqrt(np.diag(marginals(smoothed)))[:3]
    off = smoothed.data.lever_arm - SENSORS.lever_arm
    assert sigma[:2].max() < 0.03
    assert sigma[2] < 0.2  # the drive rolls and pitches by some degrees
    assert np.abs(off / sigma).max() < 3.0
    assert len(smoothed.gnss_rejected) == 0
    assert nees(motion, smoothed) < 16.0


def test_what_was_measured_roughly_is_in_the_covariance_of_every_pose() -> None:
    motion = record(COURSE, SENSORS, 3)
    usual = config_for(
        SENSORS,
        gnss={"lever_arm": list(SENSORS.lever_arm)},
        imu={"rotation_sigma_deg": None},
    )
    rough = smooth_trajectory(motion, usual, WANTED)

    exact = smooth_trajectory(motion, config_for(SENSORS), WANTED)

    assert rough.trajectory.cov is not None
    assert exact.trajectory.cov is not None
    covs = rough.trajectory.cov, exact.trajectory.cov
    sigma, least = (np.sqrt(np.diagonal(cov, axis1=1, axis2=2)) for cov in covs)
    # 10 mm of the lever arm less what the drive tells of it; 0.1 degrees of pitch and yaw.
    assert (sigma[:, 3:] > least[:, 3:] + 0.003).all()
    assert (sigma[:, :3] > 1e-3).all()
    # Three ways to the same marginals: two of the chain, and GTSAM's Bayes tree.
    cov = np.linalg.inv(rough.joint_information(WANTED)[0])
    blocks = [cov[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(len(WANTED))]
    np.testing.assert_allclose(rough.trajectory.cov, blocks, rtol=1e-5, atol=1e-12)
    at = np.searchsorted(rough.nodes_ns, WANTED)
    np.testing.assert_allclose(rough.trajectory.cov, by_gtsam(rough)[at], rtol=1e-4, atol=1e-11)
    assert nees(motion, rough) < 12.0


def test_the_scale_and_the_axes_of_a_gyroscope_are_estimated() -> None:
    """4 mrad per radian: in a figure-eight the heading is 20 mrad off, and comes back."""
    sensors = replace(SENSORS, noise=0.1)
    motion = record(MEDIUM, sensors, 3)
    imu = motion.imu
    assert imu is not None
    up = sensors.T_vehicle_imu.rotation().matrix()[2]
    response = np.array([1e-3, -2e-3, 4e-3])
    gyro = imu.angular_velocity + np.outer(imu.angular_velocity @ up, response)
    motion = replace(motion, imu=replace(imu, angular_velocity=gyro))
    usual = config_for(sensors, imu={"gyroscope_scale_sigma": 2e-3})

    smoothed = smooth_trajectory(motion, usual, MEDIUM_WANTED)

    (found,) = (p for p in smoothed.parameters if p.parameter.name == "imu.gyroscope")
    sigma = smoothed.sigmas_of("imu.gyroscope")
    assert sigma is not None
    assert found.offset is not None
    assert sigma.max() < 4e-4
    assert np.abs((found.offset - response) / sigma).max() < 3.5
    assert nees(motion, smoothed, MEDIUM) < 12.0
    # A tenth of the usual noise. Held, the scale would be taken for eight times as much.
    exact = smooth_trajectory(motion, config_for(sensors), MEDIUM_WANTED)
    assert smoothed.data.scales["gyroscope"] < 0.15
    assert exact.data.scales["gyroscope"] > 0.5
    # Twenty of its sigmas are said, two are not.
    assert not any("gyroscope" in line for line in smoothed.warnings)
    narrow = config_for(sensors, imu={"gyroscope_scale_sigma": 2e-4})
    again = smooth_trajectory(motion, narrow, MEDIUM_WANTED)
    said = [w for w in again.warnings if "gyroscope" in w]
    assert len(said) == 1
    assert "imu.gyroscope_scale_sigma is 0.02 percent" in said[0]


@pytest.mark.parametrize(("late_s", "sigma_s"), [(0.0, 1e-4), (0.08, 0.02)])
def test_motion_data_free_a_clock_that_is_clearly_late(late_s: float, sigma_s: float) -> None:
    motion = record(COURSE, SENSORS, 3)
    assert motion.gnss is not None
    stamps_ns = motion.gnss.stamps_ns + round(1e9 * late_s)
    motion = replace(motion, gnss=replace(motion.gnss, stamps_ns=stamps_ns))
    config = config_for(
        SENSORS, gnss={"lever_arm": list(SENSORS.lever_arm), "time_offset_sigma_s": 0.02}
    )

    smoothed = smooth_trajectory(motion, config, WANTED)

    clock = next(p for p in smoothed.parameters if p.parameter.name == "gnss.time_offset")
    found, sigma = smoothed.data.late_ns["gnss"] * 1e-9, smoothed.sigmas_of("gnss.time_offset")
    assert sigma is not None
    # Under the prior of 20 ms that of 80 ms is short of it by (sigma / 20 ms)^2 of itself.
    assert abs(found - late_s) < 3.0 * sigma[0] + late_s * (sigma[0] / 0.02) ** 2
    assert sigma[0] < 8e-3
    assert clock.sigmas == pytest.approx(sigma_s)
    # The graph of a calibration has the wide prior in either case.
    assert clock.graph_sigmas == pytest.approx(0.02)


@pytest.mark.parametrize("rpy_deg", [(90.0, 3.0, 40.0), (0.0, 90.0, 20.0)], ids=str)
def test_an_imu_on_its_side_is_found(rpy_deg: tuple[float, float, float]) -> None:
    R = gtsam.Rot3.RzRyRx(*np.radians(rpy_deg))
    T = gtsam.Pose3(R, np.array([1.2, -0.4, 0.6]))
    sensors = replace(SENSORS, T_vehicle_imu=T)
    unknown: dict[str, object] = {
        "T_vehicle_imu": {"xyz": [1.2, -0.4, 0.6], "rpy_deg": None},
        "rotation_sigma_deg": None,
    }

    smoothed = smooth_trajectory(
        record(MEDIUM, sensors, 4),
        config_for(sensors, imu=unknown),
        MEDIUM_WANTED,
    )

    off = gtsam.Rot3.Logmap(smoothed.data.T_vehicle_imu.rotation().compose(R.inverse()))
    sigma = np.sqrt(np.diag(marginals(smoothed)))[3:6]
    assert np.degrees(sigma[1:]).max() < 0.2
    assert np.degrees(sigma[0]) < 1.0  # of roll the lever arm tells, and the mean of the drive
    assert np.abs(off / sigma).max() < 3.0


@pytest.mark.parametrize("yaw_deg", [60.0, 90.0, 180.0])
def test_the_guess_of_an_imu_without_orientation_is_within_its_sigma(yaw_deg: float) -> None:
    """Fixes whose noise is widened by the arm, a metre, beside an IMU: GTSAM's solver calls such a
    system singular, and the guess was that of the first seconds, up to 30 degrees off."""
    R = gtsam.Rot3.RzRyRx(0.02, -0.03, math.radians(yaw_deg))
    sensors = replace(SENSORS, T_vehicle_imu=gtsam.Pose3(R, np.array([1.2, -0.4, 0.6])))
    motion = record(MEDIUM, sensors, 4)
    assert motion.imu is not None
    motion = replace(motion, imu=replace(motion.imu, orientation_xyzw=None), twist=None)
    unknown: dict[str, object] = {
        "T_vehicle_imu": {"xyz": [1.2, -0.4, 0.6], "rpy_deg": None},
        "rotation_sigma_deg": None,
    }
    data, _ = check_input(motion, config_for(sensors, imu=unknown))
    nodes = place_nodes(data.inertial, MEDIUM_WANTED)

    guessed = with_guessed_rotation(data, nodes, partial(_solved_roughly, nodes))

    off = gtsam.Rot3.Logmap(guessed.T_vehicle_imu.rotation().compose(R.inverse()))
    assert np.abs(off).max() < COURSE_SIGMA_RAD


def test_a_course_needs_gnss() -> None:
    motion = replace(record(COURSE, SENSORS, 5), gnss=None)
    unknown: dict[str, object] = {
        "T_vehicle_imu": {"xyz": [1.2, -0.4, 0.6], "rpy_deg": None},
        "rotation_sigma_deg": None,
    }

    with pytest.raises(TrajectoryError, match="measure the rotation of the IMU"):
        smooth_trajectory(motion, config_for(SENSORS, imu=unknown), WANTED)


def test_a_vehicle_frame_that_is_the_imu_s_has_no_parameters() -> None:
    motion = record(COURSE, Sensors(), 6)

    smoothed = smooth_trajectory(motion, config_for(Sensors()), WANTED)

    assert smoothed.parameters == ()


def test_a_rough_lever_arm_and_a_slow_error_of_the_fixes_are_in_one_gaussian() -> None:
    motion = record(COURSE, SENSORS, 3)
    slow = {
        "gnss_correlated_horizontal_m": 0.03,
        "gnss_correlated_vertical_m": 0.03,
        "gnss_correlation_s": 10.0,
    }
    usual = config_for(
        SENSORS,
        gnss={"lever_arm": list(SENSORS.lever_arm)},
        imu={"rotation_sigma_deg": None},
        noise=slow,
    )

    smoothed = smooth_trajectory(motion, usual, WANTED)

    joint = smoothed.joint(WANTED)
    cov = np.linalg.inv(joint.information)
    blocks = [cov[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(len(WANTED))]
    # The step that estimates the errors has the one, the graph linearised after it the other.
    assert smoothed.trajectory.cov is not None
    np.testing.assert_allclose(
        smoothed.trajectory.cov, blocks, atol=1e-3 * float(np.abs(blocks).max())
    )
    assert np.abs(joint.gradient / np.sqrt(np.diag(joint.information))).max() < 0.02
    sigma = np.sqrt(np.diagonal(smoothed.trajectory.cov, axis1=1, axis2=2))
    assert (sigma[:, 3:] > 0.025).all()


@pytest.mark.parametrize("late_s", [0.5, -1.0])
def test_fixes_whose_clock_is_far_off_lead_to_the_right_trajectory(late_s: float) -> None:
    motion = record(LONG, SENSORS, 3)
    assert motion.gnss is not None
    at = motion.gnss.stamps_ns + round(1e9 * late_s)
    late = replace(motion, gnss=replace(motion.gnss, stamps_ns=at))
    # Of the usual prior, which 0.1 s would contradict.
    config = config_for(SENSORS, gnss={"time_offset_sigma_s": 0.02, **ARM})

    smoothed = smooth_trajectory(late, config, stamps(24.0, 2.0, 0.0512))

    (clock,) = (p for p in smoothed.parameters if p.parameter.name == "gnss.time_offset")
    # Free about what accelerations say, so that the calibration knows what is left of it.
    assert clock.sigmas is not None
    assert smoothed.data.found_late_s is not None
    assert clock.sigmas[0] == math.hypot(smoothed.data.found_late_s[1], 0.02)
    assert clock.sigmas[0] < 0.06
    (sigma_s,) = smoothed.sigmas_of("gnss.time_offset") or (math.nan,)
    assert smoothed.data.late_s("gnss") == pytest.approx(late_s, abs=4.0 * sigma_s)
    assert sigma_s < 0.01
    assert len(smoothed.gnss_rejected) == 0
    assert not [w for w in smoothed.warnings if "noise.gnss" in w]
    assert nees(late, smoothed, LONG) < 16.0


@pytest.mark.parametrize("unknown", ["arm", "clock"])
def test_a_smoothing_that_begins_where_another_has_ended_ends_in_the_same_place(
    unknown: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With other nodes, and at the same ones; also of a clock that the motion data free."""
    changes: dict[str, dict[str, dict[str, object]]] = {
        "arm": {"gnss": {"lever_arm": None}},
        "clock": {"gnss": {"lever_arm": list(SENSORS.lever_arm), "time_offset_sigma_s": 0.02}},
    }
    motion = record(COURSE, SENSORS, 3)
    assert motion.gnss is not None
    if unknown == "clock":
        late_ns = motion.gnss.stamps_ns + 80_000_000
        motion = replace(motion, gnss=replace(motion.gnss, stamps_ns=late_ns))
    config = config_for(SENSORS, **changes[unknown])
    first = smooth_trajectory(motion, config, [])
    scales = first.data.scales
    plain = smooth_trajectory(motion, config, WANTED, (), scales)

    monkeypatch.setattr(smooth, "_begun", None)  # nothing is searched for from the measurements
    for earlier in (first, plain):
        found = smooth_trajectory(motion, config, WANTED, (), scales, earlier)
        assert np.array_equal(found.gnss_rejected, plain.gnss_rejected)
        assert found.warnings == plain.warnings
        offsets = [
            np.concatenate([np.asarray(p.offset) for p in t.parameters]) for t in (found, plain)
        ]
        sigmas = np.sqrt(np.diag(plain.parameter_cov))
        assert np.abs((offsets[0] - offsets[1]) / sigmas).max() < 0.02
        cov = plain.trajectory.cov
        assert cov is not None
        for T, other, C in zip(
            found.trajectory.T_map_vehicle, plain.trajectory.T_map_vehicle, cov, strict=True
        ):
            away = gtsam.Pose3.Logmap(other.between(T))
            assert np.abs(away / np.sqrt(np.diag(C))).max() < 0.02


def test_steps_that_shrink_by_a_constant_factor_are_taken_at_once() -> None:
    information = np.diag([100.0, 1.0])
    before = np.array([0.1, 0.2])

    # Halved each time: what follows a half adds up to one.
    assert steps_ahead(before, 0.5 * before, information) == pytest.approx(2.0)
    # Across it, back, and hardly any shorter.
    assert steps_ahead(before, np.array([-0.002, 0.1]), information) == 1.0
    assert steps_ahead(before, -0.5 * before, information) == 1.0
    assert steps_ahead(before, 0.9 * before, information) == 1.0


def test_a_smoothing_with_other_parameters_begins_at_the_measurements() -> None:
    motion = record(COURSE, SENSORS, 3)
    first = smooth_trajectory(motion, config_for(SENSORS, gnss=ARM), [])
    other = config_for(SENSORS, gnss=ARM, imu={"gyroscope_scale_sigma": 0.001})

    plain = smooth_trajectory(motion, other, WANTED)
    found = smooth_trajectory(motion, other, WANTED, earlier=first)

    assert len(first.parameters) < len(plain.parameters)
    np.testing.assert_array_equal(found.states.p_map_imu, plain.states.p_map_imu)
