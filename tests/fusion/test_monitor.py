from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest

from caliv_graph.fusion.monitor import (
    WINDOWS,
    Innovation,
    MountAlarm,
    MountMonitor,
    alarm_threshold,
    extrinsic_innovation,
)
from caliv_graph.products import Array

LOOKS_BACK = gtsam.Pose3(gtsam.Rot3.Yaw(math.pi), np.array([-0.4, 0.0, 2.0]))
LOOKS_AHEAD = gtsam.Pose3(gtsam.Rot3.Pitch(0.17), np.array([2.0, 0.0, 2.0]))
MOUNTINGS = {"front": LOOKS_AHEAD, "rear": LOOKS_BACK}

SIGMA = np.repeat([5e-4, 5e-3], 3)
COV = np.diag(SIGMA**2)


def white(rng: np.random.Generator, shift: Array | None = None) -> Innovation:
    return Innovation(SIGMA * rng.normal(size=6) + (0.0 if shift is None else shift), COV)


def feed(monitor: MountMonitor, lidar: str, innovations: list[Innovation]) -> list[MountAlarm]:
    heard = [monitor.add(lidar, k, innovation) for k, innovation in enumerate(innovations)]
    return [alarm for alarm in heard if alarm is not None]


def test_threshold_is_that_of_the_rate_asked_for() -> None:
    scans_per_hour, rate = 7200.0, 0.1

    x = alarm_threshold(scans_per_hour, rate)

    # The survival function of six degrees of freedom in closed form.
    p = math.exp(-x / 2.0) * (1.0 + x / 2.0 + x**2 / 8.0)
    assert p * scans_per_hour * len(WINDOWS) == pytest.approx(rate)


@pytest.mark.parametrize("rates", [(0.0, 0.1), (7200.0, 0.0), (-1.0, 0.1)])
def test_rates_have_to_be_above_zero(rates: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="above zero"):
        alarm_threshold(*rates)


def test_false_alarms_are_no_more_than_promised() -> None:
    rng = np.random.default_rng(5)
    scans = 10_000
    # So many that they can be counted: one test in a hundred, five tests a scan.
    monitor = MountMonitor(MOUNTINGS, 1.0, 0.01 * len(WINDOWS) * 3600.0)
    innovations = [white(rng) for _ in range(scans)]

    alarms = feed(monitor, "front", innovations)

    # One scan by itself is left out that often: 100 of them, give or take 10.
    assert sum(map(monitor.suspicious, innovations)) == pytest.approx(100, abs=40)
    # Fewer alarms than the tests are promised to give, since no single scan can make one.
    assert 5 < len(alarms) < 0.01 * len(WINDOWS) * scans


def test_no_alarm_in_hours_of_silence() -> None:
    rng = np.random.default_rng(6)
    monitor = MountMonitor(MOUNTINGS, 1.0, 0.01)

    assert not feed(monitor, "rear", [white(rng) for _ in range(3600)])


def test_a_knock_is_found_at_the_second_scan_and_estimated_in_vehicle_axes() -> None:
    rng = np.random.default_rng(7)
    monitor = MountMonitor(MOUNTINGS, 2.0)
    # Nose up by the LiDAR's own pitch; it looks back, so the vehicle calls it the opposite.
    knock = np.array([0.0, math.radians(0.5), 0.0, 0.0, 0.0, 0.0])
    clean = [white(rng) for _ in range(20)]
    knocked = [white(rng, knock) for _ in range(16)]

    alarms = feed(monitor, "rear", clean + knocked)

    assert alarms[0].stamp_ns == 21
    assert alarms[0].lidar == "rear"
    assert alarms[-1].scans == 16
    # Scans from before the knock are not averaged in.
    assert [alarm.scans for alarm in alarms] == list(range(2, 17))
    for alarm in alarms:
        off = alarm.movement[1] + math.radians(0.5)
        assert abs(off) < 4.0 * 5e-4 / math.sqrt(alarm.scans)
    assert alarms[-1].movement[1] == pytest.approx(-math.radians(0.5), abs=4.0 * 5e-4 / 4.0)
    assert np.abs(alarms[-1].movement[[0, 2]]).max() < 4.0 * 5e-4 / 4.0
    assert alarms[-1].sigma == pytest.approx(SIGMA)


def test_a_shift_that_no_scan_shows_is_found_by_many() -> None:
    rng = np.random.default_rng(8)
    monitor = MountMonitor(MOUNTINGS, 2.0)
    shift = 1.7 * SIGMA * np.eye(6)[3]

    alarms = feed(monitor, "front", [white(rng, shift) for _ in range(60)])

    assert alarms
    assert alarms[0].scans >= 8
    assert alarms[0].alone


def test_one_failed_registration_is_no_knock_but_suspicious() -> None:
    rng = np.random.default_rng(9)
    monitor = MountMonitor(MOUNTINGS, 2.0)
    innovations = [white(rng) for _ in range(60)]
    innovations[30] = white(rng, 200.0 * SIGMA)

    assert monitor.suspicious(innovations[30])
    assert not monitor.suspicious(innovations[29])
    assert not feed(monitor, "front", innovations)


def test_two_failed_registrations_far_apart_in_what_they_say_do_not_hide_a_knock() -> None:
    rng = np.random.default_rng(10)
    monitor = MountMonitor(MOUNTINGS, 2.0)
    knock = 20.0 * SIGMA * np.eye(6)[2]
    innovations = [white(rng, knock) for _ in range(6)]
    innovations[2] = white(rng, -50.0 * SIGMA)

    assert feed(monitor, "front", innovations)


def test_if_all_lidars_disagree_with_the_pose_none_is_alone() -> None:
    rng = np.random.default_rng(11)
    monitor = MountMonitor(MOUNTINGS, 2.0)
    jump = 20.0 * SIGMA * np.eye(6)[4]
    alarms = [
        monitor.add(lidar, k, white(rng, jump if k >= 6 else None))
        for k in range(12)
        for lidar in MOUNTINGS
    ]
    late = [alarm for alarm in alarms[2 * 8 :] if alarm is not None]

    assert {alarm.lidar for alarm in late} == set(MOUNTINGS)
    assert not any(alarm.alone for alarm in late)


def test_nothing_depends_on_the_units_or_axes_of_the_innovations() -> None:
    rng = np.random.default_rng(12)
    turn = np.linalg.qr(rng.normal(size=(6, 6)))[0] @ np.diag([1.0, 10.0, 3.0, 0.1, 2.0, 5.0])
    innovations = [white(rng, 5.0 * SIGMA * np.eye(6)[0]) for _ in range(10)]
    turned = [Innovation(turn @ i.movement, turn @ i.cov @ turn.T) for i in innovations]

    plain, other = (
        feed(MountMonitor(MOUNTINGS, 2.0), "front", those) for those in (innovations, turned)
    )

    assert plain
    assert [a.chi2 for a in other] == pytest.approx([a.chi2 for a in plain])
    assert [a.stamp_ns for a in other] == [a.stamp_ns for a in plain]


def test_after_a_reset_the_past_is_forgotten() -> None:
    rng = np.random.default_rng(13)
    monitor = MountMonitor(MOUNTINGS, 2.0)
    knock = 20.0 * SIGMA * np.eye(6)[0]
    assert feed(monitor, "rear", [white(rng, knock) for _ in range(5)])

    monitor.reset("rear", LOOKS_BACK.retract(knock))

    assert all(monitor.add("rear", 10 + k, white(rng)) is None for k in range(20))
    with pytest.raises(ValueError, match="'side': is not watched; those are front, rear"):
        monitor.reset("side", LOOKS_BACK)


def test_innovation_is_the_movement_of_the_mount() -> None:
    X = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, -0.01, 2.0), np.array([5.0, -3.0, 0.1]))
    d = np.array([1e-3, -2e-3, 3e-3, 0.01, 0.02, -0.01])
    measured = X.compose(LOOKS_BACK.retract(d))

    innovation = extrinsic_innovation(X, LOOKS_BACK, np.zeros((12, 12)), measured, COV)

    assert innovation.movement == pytest.approx(d, abs=1e-12)
    assert innovation.cov == pytest.approx(COV)


def test_covariance_of_an_innovation_is_that_of_draws() -> None:
    rng = np.random.default_rng(14)
    X = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, -0.01, 2.0), np.array([50.0, -30.0, 0.1]))
    root = np.tril(rng.normal(size=(12, 12))) * np.repeat([1e-3, 1e-2, 5e-4, 5e-3], 3)[:, None]
    cov_predicted, T_map_lidar = root @ root.T, X.compose(LOOKS_BACK)

    draws = []
    for _ in range(4000):
        e, n = root @ rng.normal(size=12), SIGMA * rng.normal(size=6)
        innovation = extrinsic_innovation(
            X.retract(e[:6]),
            LOOKS_BACK.retract(e[6:]),
            cov_predicted,
            T_map_lidar.retract(n),
            COV,
        )
        draws.append(innovation.movement)

    stated = extrinsic_innovation(X, LOOKS_BACK, cov_predicted, T_map_lidar, COV).cov
    nees = np.einsum("ni,ij,nj->n", draws, np.linalg.inv(stated), draws)
    # Six degrees of freedom; 4000 draws leave their mean uncertain by 0.055, their variance by 4%.
    assert np.mean(nees) == pytest.approx(6.0, abs=0.25)
    assert np.var(nees) == pytest.approx(12.0, rel=0.2)


@pytest.mark.parametrize(
    ("lidar", "stamp_ns", "innovation", "message"),
    [
        ("side", 9, Innovation(np.zeros(6), COV), "is not watched"),
        ("front", 5, Innovation(np.zeros(6), COV), "stamps do not increase: 5, then 5"),
        ("front", 9, Innovation(np.full(6, np.nan), COV), "not finite"),
        ("front", 9, Innovation(np.zeros(6), COV * np.nan), "not finite"),
        ("front", 9, Innovation(np.zeros(6), -COV), "not positive definite"),
    ],
)
def test_what_is_no_innovation_is_refused(
    lidar: str, stamp_ns: int, innovation: Innovation, message: str
) -> None:
    monitor = MountMonitor(MOUNTINGS, 2.0)
    monitor.add("front", 5, Innovation(np.zeros(6), COV))

    with pytest.raises(ValueError, match=message):
        monitor.add(lidar, stamp_ns, innovation)


def test_there_has_to_be_a_lidar() -> None:
    with pytest.raises(ValueError, match="at least one"):
        MountMonitor({}, 2.0)
