"""The smoothed trajectory against drives that are known exactly."""

from __future__ import annotations

import gc
import math
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, GnssFixes, ImuSamples, IntArray, MotionData
from caliv_graph.trajectory import uncertain
from caliv_graph.trajectory.build import TrajectoryGraph
from caliv_graph.trajectory.factors import marginal_factor
from caliv_graph.trajectory.nodes import place_nodes
from caliv_graph.trajectory.outliers import lost_fixes
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.solve import solve
from tests.trajectory.motions import (
    GRAVITY,
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

ARC = Course(arc_drive())
SHORT = Course(arc_drive(9.0))
ROUGH = Course(eight_drive(24.0), rough=1.0)
AWKWARD = replace(
    mounted_askew(),
    force_bias=(0.1, -0.05, 0.08),
    gyro_bias=(0.01, -0.008, 0.012),
    gnss_delay_s=0.033,
    twist_hz=20.0,
    twist_delay_s=0.017,
)
"""IMU and antenna off the origin, biases, and no two sensors at the same instant."""


def position_rmse(shift: Array) -> float:
    return float(np.sqrt((shift**2).sum(axis=1).mean()))


@cache
def awkward() -> tuple[MotionData, SmoothedTrajectory, IntArray]:
    """A smoothed rough drive that several tests look at."""
    motion = record(ROUGH, AWKWARD, 5)
    wanted = stamps(ROUGH.duration_s, 10.0, 0.0512)
    return motion, smooth_trajectory(motion, config_for(AWKWARD), wanted), wanted


def whitened(
    course: Course, motion: MotionData, smoothed: SmoothedTrajectory
) -> tuple[Array, Array, Array]:
    """(n,) NEES, (n, 3) rotation errors and (n, 3) position errors at the wanted stamps."""
    trajectory = smoothed.trajectory
    R, t = stack(trajectory.T_map_vehicle)
    turn, shift = errors(course, motion, trajectory.stamps_ns, R, t)
    e = np.hstack([turn, np.einsum("nji,nj->ni", R, shift)])
    assert trajectory.cov is not None
    return np.einsum("ni,nij,nj->n", e, np.linalg.inv(trajectory.cov), e), turn, shift


def test_without_noise_it_is_the_truth() -> None:
    sensors = replace(AWKWARD, noise=0.0, force_bias=(0.0, 0.0, 0.0), gyro_bias=(0.0, 0.0, 0.0))
    course = Course(arc_drive(), rough=1.0)
    motion = record(course, sensors, 0)
    smoothed = smooth_trajectory(motion, config_for(sensors), stamps(17.0, 10.0, 0.0512))
    _, turn, shift = whitened(course, motion, smoothed)
    assert np.abs(turn).max() < 5e-5
    assert np.abs(shift).max() < 1e-3


def test_accuracy_and_covariance_agree_on_the_arc() -> None:
    squares, nees = [], []
    drives = 3
    for seed in range(drives):
        motion = record(ARC, Sensors(), seed)
        smoothed = smooth_trajectory(motion, config_for(Sensors()), stamps(17.0, 10.0))
        values, turn, shift = whitened(ARC, motion, smoothed)
        squares.append([(turn**2).sum(axis=1).mean(), (shift**2).sum(axis=1).mean()])
        nees.append(values.mean())
    turn_rmse, shift_rmse = np.sqrt(np.mean(squares, axis=0))
    # A smoother of white angles (0.005 rad at 100 Hz) and a gyroscope (0.0005 rad/sqrt(s)) ends
    # at sqrt(sqrt(q r) / 2) = 0.35 mrad per axis, 0.61 mrad in all; gravity helps a little.
    assert 0.45e-3 < turn_rmse < 0.66e-3
    assert 3e-3 < shift_rmse < 8e-3
    low, high = (float(chi2.ppf(p, 6 * drives)) / drives for p in (0.025, 0.975))
    assert low < float(np.mean(nees)) < high


def test_mountings_biases_delays_and_a_rough_road_cost_nothing() -> None:
    motion, smoothed, _ = awkward()
    nees, turn, shift = whitened(ROUGH, motion, smoothed)
    assert position_rmse(shift) < 9e-3
    assert position_rmse(turn) < 0.8e-3
    assert 4.0 < nees.mean() < 9.0
    assert not smoothed.warnings
    np.testing.assert_allclose(smoothed.states.gyro_bias[-1], AWKWARD.gyro_bias, atol=5e-4)
    np.testing.assert_allclose(smoothed.states.force_bias[-1], AWKWARD.force_bias, atol=1e-2)


def test_poses_between_the_stamps_are_as_good() -> None:
    motion, smoothed, wanted = awkward()
    rng = np.random.default_rng(0)
    at = wanted[0] + np.sort(rng.integers(0, int(wanted[-1] - wanted[0]), 2000))
    R, t = smoothed.poses_at(at)
    turn, shift = errors(ROUGH, motion, at, R, t)
    assert position_rmse(shift) < 9e-3
    assert position_rmse(turn) < 0.8e-3
    # No seam at the nodes: a microsecond apart, the poses are too.
    nodes = smoothed.nodes_ns[1:-1]
    for sign in (-1, 1):
        R_side, t_side = smoothed.poses_at(nodes + sign * 1000)
        R_node, t_node = smoothed.poses_at(nodes)
        assert np.abs(t_side - t_node).max() < 1e-5
        assert np.abs(R_side - R_node).max() < 1e-5


def test_poses_at_the_wanted_stamps_are_those_of_the_trajectory() -> None:
    _, smoothed, wanted = awkward()
    R, t = smoothed.poses_at(wanted[::-1])
    R_nodes, t_nodes = stack(smoothed.trajectory.T_map_vehicle)
    np.testing.assert_allclose(R[::-1], R_nodes, atol=1e-9)
    np.testing.assert_allclose(t[::-1], t_nodes, atol=1e-9)


def test_velocities_are_those_of_the_vehicle() -> None:
    _, smoothed, wanted = awkward()
    truth = ROUGH.at(seconds(wanted))
    velocity = np.einsum("nji,nj->ni", truth.R_map_vehicle, truth.velocity_map)
    found, rates = smoothed.velocities_at(wanted)
    assert np.sqrt(np.mean((found - velocity) ** 2)) < 0.01
    assert np.sqrt(np.mean((rates - truth.rates) ** 2)) < 3e-3


def test_a_stamp_outside_the_span_is_an_error() -> None:
    _, smoothed, _ = awkward()
    with pytest.raises(TrajectoryError, match="is outside its span"):
        smoothed.poses_at([smoothed.span_ns[1] + 1])


def test_wanted_stamps_outside_the_span_are_lost_and_told() -> None:
    motion = record(SHORT, Sensors(), 0)
    wanted = stamps(9.0, 10.0, 0.05) + 1_000_000_000
    smoothed = smooth_trajectory(motion, config_for(Sensors()), wanted)
    lost = wanted[wanted > START_NS + 9_000_000_000]
    assert smoothed.lost_ns == tuple(lost.tolist())
    assert smoothed.warnings == ("drive/: 10 of 90 scans are outside the trajectory's span, lost",)
    assert smoothed.trajectory.stamps_ns.tolist() == wanted[:-10].tolist()
    with pytest.raises(TrajectoryError, match=r"all 90 scans are outside .* Check their clocks"):
        smooth_trajectory(motion, config_for(Sensors()), wanted + 10**12)


def test_joint_information_is_that_of_gtsam() -> None:
    sensors = replace(mounted_askew(), noise=1.0)
    course = Course(arc_drive(5.0))
    motion = record(course, sensors, 2)
    wanted = stamps(5.0, 5.0, 0.01)
    smoothed = smooth_trajectory(motion, config_for(sensors), wanted)
    some = wanted[[3, 4, 9, 20]]

    information, poses = smoothed.joint_information(some)

    keys = [
        gtsam.symbol("i", int(np.flatnonzero(smoothed.nodes_ns == s)[0])) for s in some.tolist()
    ]
    estimate = smoothed.estimate()
    marginals = gtsam.Marginals(estimate.graph.factors, estimate.values)
    joint = marginals.jointMarginalCovariance(keys)
    cov_imu = np.block([[joint.at(a, b) for b in keys] for a in keys])
    Ad = np.kron(np.eye(4), sensors.T_vehicle_imu.AdjointMap())
    cov = Ad @ cov_imu @ Ad.T
    # Product with the covariance: the identity, in units of each coordinate's own sigma.
    sigma = np.sqrt(cov.diagonal())
    product = (sigma[:, None] * information) @ (cov / sigma)
    np.testing.assert_allclose(product, np.eye(24), atol=1e-4)
    for pose, at in zip(poses, [3, 4, 9, 20], strict=True):
        assert pose.equals(smoothed.trajectory.T_map_vehicle[at], 1e-9)
    marginal = smoothed.trajectory.cov
    assert marginal is not None
    np.testing.assert_allclose(cov[6:12, 6:12], marginal[4], rtol=1e-5, atol=1e-12)


def test_poses_do_not_depend_on_what_else_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """The IMU is dead reckoned around the times that are asked for, in parts of the drive."""
    sensors = replace(mounted_askew(), noise=1.0)
    motion = record(Course(arc_drive(8.0)), sensors, 2)
    smoothed = smooth_trajectory(motion, config_for(sensors), stamps(7.0, 5.0, 0.01))
    begin, end = smoothed.span_ns
    at = np.random.default_rng(0).permutation(np.linspace(begin, end, 200).astype(np.int64))
    whole = (*smoothed.poses_at(at), *smoothed.velocities_at(at))

    monkeypatch.setattr("caliv_graph.trajectory.smoothed.PART_NS", 700_000_000)
    monkeypatch.setattr("caliv_graph.trajectory.smoothed.WINDOW_NS", 900_000_000)
    monkeypatch.setattr("caliv_graph.trajectory.smoothed.OVERLAP_NS", 200_000_000)
    apart = replace(smoothed)
    parts = (*apart.poses_at(at), *apart.velocities_at(at))
    singly = [apart.poses_at([stamp]) for stamp in at.tolist()]
    again = replace(smoothed)
    backwards = [again.poses_at([stamp]) for stamp in reversed(at.tolist())]

    for one, other in zip(whole, parts, strict=True):
        np.testing.assert_allclose(other, one, atol=1e-10)
    np.testing.assert_allclose(np.concatenate([t for _, t in singly]), whole[1], atol=1e-10)
    # Not by a bit: the result of a calibration does not depend on which thread asks first.
    for (R, t), (R_again, t_again) in zip(singly, reversed(backwards), strict=True):
        assert np.array_equal(R, R_again)
        assert np.array_equal(t, t_again)


def test_another_measurement_weighs_the_same_on_the_marginal_as_on_the_whole() -> None:
    sensors = mounted_askew()
    motion = record(Course(arc_drive(5.0)), sensors, 3)
    wanted = stamps(5.0, 5.0, 0.01)
    smoothed = smooth_trajectory(motion, config_for(sensors), wanted)
    some = wanted[4:16:3]
    keys = list(range(100, 104))
    information, poses = smoothed.joint_information(some)
    moved = poses[1].retract(np.array([0.001, -0.0005, 0.001, 0.01, -0.008, 0.005]))
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([3e-4] * 3 + [3e-3] * 3))

    small = gtsam.NonlinearFactorGraph()
    small.add(marginal_factor(keys, information, poses))
    small.add(gtsam.PriorFactorPose3(keys[1], moved, noise))
    start = gtsam.Values()
    for key, pose in zip(keys, poses, strict=True):
        start.insert(key, pose)
    by_marginal = gtsam.GaussNewtonOptimizer(small, start).optimize()

    estimate = smoothed.estimate()
    whole = gtsam.NonlinearFactorGraph(estimate.graph.factors)
    node = gtsam.symbol("i", int(np.flatnonzero(smoothed.nodes_ns == some[1])[0]))
    Ad = sensors.T_vehicle_imu.inverse().AdjointMap()
    cov_imu = Ad @ np.diag(noise.sigmas() ** 2) @ Ad.T
    whole.add(
        gtsam.PriorFactorPose3(
            node,
            moved.compose(sensors.T_vehicle_imu),
            gtsam.noiseModel.Gaussian.Covariance(cov_imu),
        )
    )
    by_whole = gtsam.GaussNewtonOptimizer(whole, estimate.values).optimize()

    for key, stamp, before in zip(keys, some.tolist(), poses, strict=True):
        i = gtsam.symbol("i", int(np.flatnonzero(smoothed.nodes_ns == stamp)[0]))
        expected = by_whole.atPose3(i).compose(sensors.T_vehicle_imu.inverse())
        found = by_marginal.atPose3(key)
        step = np.linalg.norm(before.localCoordinates(expected)[3:])
        apart = np.linalg.norm(expected.localCoordinates(found)[3:])
        assert step > 5e-4  # the measurement moves all of them
        assert apart < 0.03 * step  # what a linearised factor leaves


def test_joint_information_needs_nodes() -> None:
    _, smoothed, wanted = awkward()
    with pytest.raises(KeyError):
        smoothed.joint_information([int(wanted[3]) + 20_000_000])
    with pytest.raises(ValueError, match="increase"):
        smoothed.joint_information([int(wanted[3]), int(wanted[3])])


def drop(motion: MotionData, *what: str) -> MotionData:
    """A recording without some of its sensors."""
    if "gnss" in what:
        motion = replace(motion, gnss=None)
    if "twist" in what:
        motion = replace(motion, twist=None)
    if "orientation" in what and motion.imu is not None:
        motion = replace(motion, imu=replace(motion.imu, orientation_xyzw=None))
    return motion


@pytest.mark.parametrize(
    ("missing", "worst_position_m", "worst_turn_rad"),
    [
        (("twist",), 9e-3, 0.8e-3),
        (("orientation",), 20e-3, 8e-3),
        (("orientation", "twist"), 25e-3, 25e-3),
    ],
    ids=["no-twist", "no-orientation", "imu-and-gnss"],
)
def test_what_is_missing_is_made_up_for(
    missing: tuple[str, ...], worst_position_m: float, worst_turn_rad: float
) -> None:
    motion = drop(record(ROUGH, AWKWARD, 2), *missing)
    wanted = stamps(ROUGH.duration_s, 5.0, 0.1)
    smoothed = smooth_trajectory(motion, config_for(AWKWARD), wanted)
    nees, turn, shift = whitened(ROUGH, motion, smoothed)
    assert position_rmse(shift) < worst_position_m
    assert position_rmse(turn) < worst_turn_rad
    assert nees.mean() < 14.0


def test_without_gnss_the_motion_is_known_from_the_start_on() -> None:
    motion = drop(record(ARC, mounted_askew(), 4), "gnss", "orientation")
    config = config_for(mounted_askew(), noise={"gyroscope_bias_rad_s": 0.0005})
    wanted = stamps(17.0, 5.0)
    smoothed = smooth_trajectory(motion, config, wanted)
    nees, turn, _ = whitened(ARC, motion, smoothed)
    assert smoothed.origin_deg_m is None
    assert "no GNSS: the map's origin is the vehicle's start" in smoothed.warnings[0]
    # The arc starts at the origin, along x: the gauge is the truth's own.
    assert np.abs(turn).max() < 0.03
    assert np.median(nees[5:]) < 14.0


@pytest.mark.parametrize(
    ("missing", "message"),
    [
        (("gnss", "twist"), "neither GNSS fixes nor velocities"),
        (("imu", "twist"), "no IMU and no velocities: set topics.imu"),
    ],
    ids=["imu-alone", "no-imu"],
)
def test_what_cannot_be_made_up_for_is_said(missing: tuple[str, ...], message: str) -> None:
    motion = drop(record(ARC, Sensors(), 0), *missing)
    if "imu" in missing:
        motion = replace(motion, imu=None)
    with pytest.raises(TrajectoryError, match=f"^drive/: {message}"):
        smooth_trajectory(motion, config_for(Sensors()), stamps(17.0, 10.0))


def test_a_bias_that_the_config_does_not_expect_is_told() -> None:
    sensors = replace(Sensors(), force_bias=(0.0, 0.9, 0.0))
    motion = record(ARC, sensors, 0)
    smoothed = smooth_trajectory(motion, config_for(sensors), stamps(17.0, 10.0))
    (warning,) = smoothed.warnings
    assert "the accelerometer's bias comes out as 0.8" in warning
    assert "noise.accelerometer_bias_m_s2 is 0.1" in warning


def test_an_orientation_with_z_down_is_refused() -> None:
    motion = record(ARC, Sensors(), 0)
    assert motion.imu is not None
    # North, east, down of a frame forward, right, down; specific force left as it is.
    down = Rotation.from_euler("x", math.pi) * Rotation.from_quat(
        np.asarray(motion.imu.orientation_xyzw)
    )
    turned = replace(motion, imu=replace(motion.imu, orientation_xyzw=np.asarray(down.as_quat())))
    with pytest.raises(TrajectoryError, match=r"disagree by 1[78]\d degrees on where up is"):
        smooth_trajectory(turned, config_for(Sensors()), stamps(17.0, 10.0))


def standing(motion: MotionData) -> MotionData:
    """The first second of a drive over and over: standstill."""
    imu, gnss = motion.imu, motion.gnss
    assert imu is not None
    assert gnss is not None
    still = imu.stamps_ns < START_NS + 1_000_000_000
    early = gnss.stamps_ns < START_NS + 1_000_000_000
    return replace(
        motion,
        imu=ImuSamples(
            imu.stamps_ns[still], imu.angular_velocity[still], imu.specific_force[still]
        ),
        gnss=GnssFixes(
            gnss.stamps_ns[early],
            gnss.latitude_deg[early],
            gnss.longitude_deg[early],
            gnss.altitude_m[early],
        ),
        twist=None,
    )


def test_heading_that_nothing_tells_is_said() -> None:
    motion = standing(record(ARC, Sensors(), 0))
    with pytest.raises(TrajectoryError, match=r"do not determine heading.* Record orientation"):
        smooth_trajectory(motion, config_for(Sensors()), stamps(0.9, 10.0))


def shifted(motion: MotionData, first_s: float, last_s: float, north_m: float) -> MotionData:
    """Fixes that jump north for a while."""
    gnss = motion.gnss
    assert gnss is not None
    t = seconds(gnss.stamps_ns)
    latitude = gnss.latitude_deg + np.where((t > first_s) & (t < last_s), north_m / 111_200.0, 0.0)
    return replace(motion, gnss=replace(gnss, latitude_deg=latitude))


@pytest.mark.parametrize("kernel", ["huber", "tls"])
def test_fixes_that_jump_are_dropped(kernel: str) -> None:
    motion = shifted(record(ROUGH, AWKWARD, 3), 12.0, 16.0, 3.0)
    config = config_for(AWKWARD, robust={"kernel": kernel})
    smoothed = smooth_trajectory(motion, config, stamps(ROUGH.duration_s, 5.0, 0.0512))
    nees, _, shift = whitened(ROUGH, motion, smoothed)
    t = seconds(smoothed.gnss_rejected)
    assert 40 <= len(t) <= 42  # one sound fix in a thousand goes with tls
    assert ((t > 12.0) & (t < 16.0)).sum() == 40
    assert position_rmse(shift) < 12e-3
    assert nees.mean() < 10.0
    assert "GNSS fixes disagree with the motion, dropped" in smoothed.warnings[-1]
    # A minority is no finding; of most it is not known whether they or the rest are right.
    assert smoothed.data.positions is not None
    half = len(smoothed.data.positions.stamps_ns) // 2
    assert lost_fixes(smoothed.data, np.arange(half)) is None
    lost = lost_fixes(smoothed.data, np.arange(half + 1))
    assert lost is not None
    assert (lost.dropped, lost.count) == (half + 1, len(smoothed.data.positions.stamps_ns))
    few = replace(smoothed.data.positions, stamps_ns=smoothed.data.positions.stamps_ns[:7])
    assert lost_fixes(replace(smoothed.data, positions=few), np.arange(7)) is None
    trimmed = replace(smoothed.data, config=config_for(AWKWARD, robust={"kernel": "trimmed"}))
    assert lost_fixes(trimmed, np.arange(half + 1)) is None


def tilting(motion: MotionData, tilt_rad: float) -> MotionData:
    """Orientations whose vertical goes around in half a minute."""
    imu = motion.imu
    assert imu is not None
    phase = 2.0 * math.pi * seconds(imu.stamps_ns) / 30.0
    off = tilt_rad * np.column_stack([np.sin(phase), np.cos(phase), np.zeros(len(phase))])
    turned = Rotation.from_rotvec(off) * Rotation.from_quat(np.asarray(imu.orientation_xyzw))
    return replace(motion, imu=replace(imu, orientation_xyzw=np.asarray(turned.as_quat())))


def test_sound_fixes_stay_beside_orientations_that_err_slowly() -> None:
    """A third of them were dropped: 200 orientations a second were believed to their noise."""
    sensors = replace(AWKWARD, gnss_hz=1.0, imu_hz=200.0)
    motion = replace(tilting(record(ROUGH, sensors, 4), 5e-3), twist=None)
    config = config_for(AWKWARD, noise={"orientation_deg": 0.0573})
    smoothed = smooth_trajectory(motion, config, stamps(ROUGH.duration_s, 5.0, 0.0512))
    assert not len(smoothed.gnss_rejected)
    assert not any("GNSS" in warning for warning in smoothed.warnings)


def test_without_a_kernel_a_jump_is_believed() -> None:
    motion = shifted(record(ROUGH, AWKWARD, 3), 12.0, 16.0, 3.0)
    config = config_for(AWKWARD, robust={"kernel": "none"})
    smoothed = smooth_trajectory(motion, config, stamps(ROUGH.duration_s, 5.0, 0.0512))
    _, _, shift = whitened(ROUGH, motion, smoothed)
    assert np.abs(shift).max() > 1.0


def test_a_receiver_worse_than_the_papers_is_noticed() -> None:
    motion = record(ROUGH, AWKWARD, 3)
    gnss = motion.gnss
    assert gnss is not None
    noise = np.random.default_rng(1).standard_normal((2, len(gnss.stamps_ns))) * 0.5 / 111_200.0
    poor = replace(
        gnss,
        latitude_deg=gnss.latitude_deg + noise[0],
        longitude_deg=gnss.longitude_deg + noise[1] / math.cos(math.radians(48.26)),
    )
    smoothed = smooth_trajectory(
        replace(motion, gnss=poor),
        config_for(AWKWARD),
        stamps(ROUGH.duration_s, 5.0, 0.0512),
    )
    assert any("Set noise.gnss_horizontal_m" in w for w in smoothed.warnings)
    cov = smoothed.trajectory.cov
    assert cov is not None
    assert np.sqrt(cov[:, 3, 3]).min() > 0.02


def test_fixes_without_ambiguities_bend_the_trajectory_no_more_than_one_of_them() -> None:
    """Six seconds that state 15 cm and are all off by as much."""
    motion = record(ROUGH, AWKWARD, 6)
    assert motion.gnss is not None
    t = seconds(motion.gnss.stamps_ns)
    rough = (t > 10.0) & (t < 16.0)
    sigma = np.where(rough, 0.15, 0.0167)
    stated = sigma[:, None, None] ** 2 * np.eye(3)
    north = motion.gnss.latitude_deg + np.where(rough, 0.15 / 111_200.0, 0.0)
    motion = replace(motion, gnss=replace(motion.gnss, latitude_deg=north, cov_enu=stated))

    wanted = stamps(ROUGH.duration_s, 5.0, 0.0512)
    smoothed = smooth_trajectory(motion, config_for(AWKWARD), wanted)

    nees, _, shift = whitened(ROUGH, motion, smoothed)
    assert np.abs(shift[:, 1]).max() < 0.02  # 0.032 if they were independent
    assert nees.max() < 20.0  # 27
    # What they err by does not count as noise of the sound ones.
    assert "gnss_horizontal" not in smoothed.data.scales


def test_an_outage_of_the_gnss_widens_the_covariance_there() -> None:
    motion = record(ROUGH, AWKWARD, 6)
    gnss = motion.gnss
    assert gnss is not None
    t = seconds(gnss.stamps_ns)
    keep = (t < 12.0) | (t > 20.0)
    motion = replace(motion, gnss=rows_of(gnss, keep))
    smoothed = smooth_trajectory(motion, config_for(AWKWARD), stamps(ROUGH.duration_s, 5.0, 0.0512))
    nees, _, shift = whitened(ROUGH, motion, smoothed)
    cov = smoothed.trajectory.cov
    assert cov is not None
    sigma = np.sqrt(cov[:, 3, 3])
    assert sigma[80] > 2.0 * sigma[30]  # 16 s and 6 s
    assert np.abs(shift).max() < 0.08
    assert nees.mean() < 12.0


def test_a_gap_in_the_imu_is_bridged_and_the_covariance_says_so() -> None:
    motion = record(ROUGH, AWKWARD, 7)
    imu = motion.imu
    assert imu is not None
    t = seconds(imu.stamps_ns)
    motion = replace(motion, imu=rows_of(imu, (t < 10.0) | (t > 10.6)))
    smoothed = smooth_trajectory(
        motion, config_for(AWKWARD), stamps(ROUGH.duration_s, 10.0, 0.0512)
    )
    nees, _, _ = whitened(ROUGH, motion, smoothed)
    cov = smoothed.trajectory.cov
    assert cov is not None
    at = int(np.argmin(np.abs(seconds(smoothed.trajectory.stamps_ns) - 10.3)))
    assert np.sqrt(cov[at, 2, 2]) > 5.0 * np.sqrt(cov[at - 50, 2, 2])
    assert nees.mean() < 12.0
    assert nees[at - 3 : at + 4].max() < 40.0
    assert "1 gap(s) in the IMU" in smoothed.warnings[0]
    # The IMU is no better because the vehicle turned less in the gap than it may.
    assert smoothed.data.scales == {}


def test_a_yaw_bias_is_found_where_it_is_asked_for() -> None:
    sensors = replace(AWKWARD, yaw_bias_rad=0.035)
    motion = record(ROUGH, sensors, 8)
    wanted = stamps(ROUGH.duration_s, 5.0, 0.0512)
    smoothed = smooth_trajectory(motion, config_for(sensors, imu={"yaw_bias": True}), wanted)
    nees, _, _ = whitened(ROUGH, motion, smoothed)
    assert smoothed.yaw_bias is not None
    value, sigma = smoothed.yaw_bias
    assert abs(value - 0.035) < 3.5 * sigma
    assert sigma < 2e-3
    assert nees.mean() < 12.0
    # Its uncertainty is one for the whole drive: it does not average out between two poses.
    information, _ = smoothed.joint_information(wanted[[5, 100]])
    cov = np.linalg.inv(information)
    assert cov[2, 8] > 0.8 * sigma**2


def test_starting_later_and_farther_away_changes_nothing() -> None:
    motion = record(SHORT, Sensors(), 1)
    wanted = stamps(9.0, 5.0)
    config = config_for(Sensors(), imu={"gravity_m_s2": GRAVITY})
    first = smooth_trajectory(motion, config, wanted)
    assert motion.imu is not None
    assert motion.gnss is not None
    assert motion.twist is not None
    later = 7_777_777_777
    turned = Rotation.from_quat(np.asarray(motion.imu.orientation_xyzw))
    moved = replace(
        motion,
        imu=replace(
            motion.imu,
            stamps_ns=motion.imu.stamps_ns + later,
            orientation_xyzw=-np.asarray(turned.as_quat()),  # the same rotations
        ),
        gnss=replace(
            motion.gnss,
            stamps_ns=motion.gnss.stamps_ns + later,
            longitude_deg=motion.gnss.longitude_deg + 50.0,
        ),
        twist=replace(motion.twist, stamps_ns=motion.twist.stamps_ns + later),
    )
    second = smooth_trajectory(moved, config, wanted + later)
    for a, b in zip(first.trajectory.T_map_vehicle, second.trajectory.T_map_vehicle, strict=True):
        assert a.equals(b, 1e-6)


def test_noise_is_taken_from_messages_and_config_and_said() -> None:
    motion = record(SHORT, Sensors(), 1)
    wanted = stamps(9.0, 5.0)
    assert motion.gnss is not None
    n = len(motion.gnss.stamps_ns)
    cov = np.tile(np.diag([1.0, 1.0, 1.0]), (n, 1, 1))
    told = replace(motion, gnss=replace(motion.gnss, cov_enu=cov))
    table = smooth_trajectory(motion, config_for(Sensors()), wanted)
    messages = smooth_trajectory(told, config_for(Sensors()), wanted)
    config = config_for(Sensors(), noise={"gnss_horizontal_m": 0.0167, "gnss_vertical_m": 0.02})
    configured = smooth_trajectory(told, config, wanted)
    assert table.noise_sources["gnss"] == "the paper's table"
    # A metre for fixes that are good to 17 mm: the residuals contradict it.
    assert messages.noise_sources["gnss"].startswith("messages, horizontal times 0.0")
    assert configured.noise_sources["gnss"] == "config"
    for smoothed in (table, messages, configured):
        assert smoothed.trajectory.cov is not None
    assert messages.trajectory.cov is not None
    assert table.trajectory.cov is not None
    assert configured.trajectory.cov is not None
    assert messages.trajectory.cov[22, 5, 5] > 1.5 * table.trajectory.cov[22, 5, 5]
    np.testing.assert_allclose(configured.trajectory.cov, table.trajectory.cov, rtol=0.02)


def test_a_node_at_a_gap_costs_no_scan_its_own() -> None:
    """A scan 0.6 us after a gap's end, which is 0.7 us after another scan."""
    motion = record(Course(arc_drive(5.0)), Sensors(), 1)
    inertial = smooth_trajectory(motion, config_for(Sensors()), []).inertial
    first = int(inertial.stamps_ns[200])
    gap = np.array([[first - 200_000_000, first + 700]])

    nodes = place_nodes(replace(inertial, gaps_ns=gap), np.array([first, first + 1_300]))

    assert {first, first + 1_300} <= set(nodes.tolist())


def test_stamps_a_breath_apart_share_a_node() -> None:
    motion = record(Course(arc_drive(5.0)), Sensors(), 1)
    wanted = np.sort(np.concatenate([stamps(5.0, 5.0, 0.01), stamps(5.0, 5.0, 0.01) + 500]))
    smoothed = smooth_trajectory(motion, config_for(Sensors()), wanted)
    assert len(smoothed.trajectory.T_map_vehicle) == len(wanted)
    assert (np.diff(smoothed.nodes_ns) > 1000).all()


def test_a_solve_with_parameters_begins_when_the_last_graph_is_gone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two graphs of a long drive at a time would take twice the memory."""
    motion = record(SHORT, mounted_askew(), 5)
    typed = {"lever_arm": [1.3, 0.2, 0.8], "lever_arm_sigma": 0.1}
    alive = []

    def watched(*arguments: object) -> object:
        graphs = [o for o in gc.get_objects() if isinstance(o, TrajectoryGraph)]
        alive.append(len(graphs))
        return solve(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(uncertain, "solve", watched)
    smooth_trajectory(motion, config_for(mounted_askew(), gnss=typed), stamps(9.0, 5.0))
    assert alive
    assert set(alive) == {0}
