"""The IMU alone, against motions that are known exactly."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt
import pytest

from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array, ImuSamples
from caliv_graph.trajectory.imu import (
    DeadReckoning,
    clean_inertial,
    log_so3,
    preintegrate,
)
from caliv_graph.trajectory.noise import imu_noise
from tests.trajectory.motions import (
    GRAVITY,
    START_NS,
    Course,
    Sensors,
    arc_drive,
    config_for,
    eight_drive,
    record,
    seconds,
)

EXACT = replace(Sensors(), noise=0.0)


def exact_imu(course: Course) -> ImuSamples:
    imu = record(course, EXACT, 0).imu
    assert imu is not None
    return imu


def carried_to(course: Course, imu: ImuSamples, from_s: float, to_s: float) -> tuple[Array, Array]:
    """(3,) rotation and (3,) position error of dead reckoning from the true state."""
    dead = DeadReckoning(imu.stamps_ns, imu.angular_velocity, imu.specific_force)
    at = START_NS + np.round(1e9 * np.array([from_s, to_s])).astype(np.int64)
    dR, _, dp = dead.between(at[:1], at[1:])
    truth = course.at(seconds(at))
    dt = to_s - from_s
    p = truth.p_map_vehicle[0] + truth.velocity_map[0] * dt + truth.R_map_vehicle[0] @ dp[0]
    p[2] -= 0.5 * GRAVITY * dt**2
    R_error = truth.R_map_vehicle[1].T @ truth.R_map_vehicle[0] @ dR[0]
    return log_so3(R_error[None])[0], p - truth.p_map_vehicle[1]


@pytest.mark.parametrize(("from_s", "to_s"), [(0.0, 17.0), (3.0037, 9.1041), (9.1041, 3.0037)])
def test_dead_reckoning_of_the_arc_ends_where_the_arc_does(from_s: float, to_s: float) -> None:
    course = Course(arc_drive())
    turn, shift = carried_to(course, exact_imu(course), from_s, to_s)
    # A hold of the last sample would be off by half a sample's turn: 1 mrad, and decimetres.
    assert np.abs(turn).max() < 2e-6
    assert np.abs(shift).max() < 1e-3


def test_dead_reckoning_over_a_rough_road() -> None:
    course = Course(eight_drive(), rough=1.0)
    turn, shift = carried_to(course, exact_imu(course), 10.0, 20.0)
    assert np.abs(turn).max() < 5e-5
    assert np.abs(shift).max() < 2e-2


def test_preintegration_agrees_with_the_truth_between_stamps_of_no_sample() -> None:
    course = Course(arc_drive())
    imu = exact_imu(course)
    nodes = START_NS + np.array([3_003_700_000, 3_104_100_000, 3_350_000_001], dtype=np.int64)
    inertial, _ = clean_inertial(imu, "drive/")
    bias = [gtsam.imuBias.ConstantBias()] * 3
    noise = imu_noise(imu, config_for(EXACT))
    truth = course.at(seconds(nodes))

    for i, measured in enumerate(preintegrate(inertial, nodes, bias, noise, GRAVITY)):
        assert measured.deltaTij() == pytest.approx((nodes[i + 1] - nodes[i]) * 1e-9, abs=1e-12)
        start = gtsam.NavState(
            gtsam.Pose3(gtsam.Rot3(truth.R_map_vehicle[i]), truth.p_map_vehicle[i]),
            truth.velocity_map[i],
        )
        end = measured.predict(start, bias[0])
        np.testing.assert_allclose(end.position(), truth.p_map_vehicle[i + 1], atol=2e-6)
        np.testing.assert_allclose(end.velocity(), truth.velocity_map[i + 1], atol=1e-5)
        turned = truth.R_map_vehicle[i + 1].T @ end.attitude().matrix()
        assert np.abs(log_so3(turned[None])).max() < 1e-6


def test_preintegrated_noise_is_that_of_the_samples() -> None:
    course = Course(arc_drive())
    imu = exact_imu(course)
    nodes = START_NS + np.array([0, 500_000_000], dtype=np.int64)  # at rest
    inertial, _ = clean_inertial(imu, "drive/")
    noise = imu_noise(imu, config_for(EXACT))
    (measured,) = preintegrate(inertial, nodes, [gtsam.imuBias.ConstantBias()] * 2, noise, GRAVITY)
    sigma = np.sqrt(measured.preintMeasCov().diagonal())
    # 50 samples of 0.005 rad/s and 0.05 m/s^2, 10 ms each.
    np.testing.assert_allclose(sigma[:3], 0.005 * 0.01 * np.sqrt(50), rtol=0.01)
    np.testing.assert_allclose(sigma[8], 0.05 * 0.01 * np.sqrt(50), rtol=0.02)
    # Position is the integral of the velocity's random walk: over sqrt(3).
    np.testing.assert_allclose(sigma[5], sigma[8] * 0.5 / np.sqrt(3), rtol=0.03)


def some_imu(times_s: npt.NDArray[Any]) -> ImuSamples:
    n = len(times_s)
    force = np.tile([0.0, 0.0, GRAVITY], (n, 1))
    return ImuSamples(START_NS + np.round(1e9 * times_s).astype(np.int64), np.zeros((n, 3)), force)


def test_samples_that_are_not_finite_are_left_out_and_told() -> None:
    imu = some_imu(np.arange(100) * 0.01)
    imu.angular_velocity[3, 1] = np.nan
    imu.specific_force[[3, 50]] = np.inf

    inertial, warnings = clean_inertial(imu, "drive/")

    assert len(inertial.stamps_ns) == 98
    assert warnings == ("drive/: 2 of 100 IMU messages are not finite, left out",)
    assert not len(inertial.gaps_ns)


def test_a_short_gap_is_bridged() -> None:
    t = np.arange(300) * 0.01
    inertial, warnings = clean_inertial(some_imu(t[(t < 1.0) | (t > 1.5)]), "drive/")

    assert ((inertial.gaps_ns - START_NS) * 1e-9).tolist() == [[pytest.approx(0.99), 1.51]]
    assert "1 gap(s) in the IMU, 0.52 s together: bridged" in warnings[0]


def test_of_pieces_far_apart_the_longest_is_used() -> None:
    t = np.arange(1000) * 0.01
    inertial, warnings = clean_inertial(some_imu(t[(t < 3.0) | (t > 5.5)]), "drive/")

    assert (inertial.begin_ns - START_NS) * 1e-9 == pytest.approx(5.51)
    assert "only the longest piece is used, 4.5 s of 10.0 s" in warnings[0]


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (lambda i: replace(i, specific_force=i.specific_force * np.nan), "linear acceleration"),
        (lambda i: replace(i, angular_velocity=i.angular_velocity * np.nan), "angular velocity"),
        (lambda i: replace(i, stamps_ns=i.stamps_ns[::-1].copy()), "do not increase"),
        (lambda i: replace(i, specific_force=i.specific_force / 9.8), "is 1.00 m/s"),
        (lambda i: replace(i, specific_force=0.0 * i.specific_force), "gravity is taken out"),
        (
            lambda i: ImuSamples(i.stamps_ns[:1], i.angular_velocity[:1], i.specific_force[:1]),
            "1 usable IMU message",
        ),
    ],
    ids=["no-accelerometer", "no-gyroscope", "backwards", "in-g", "no-gravity", "one-sample"],
)
def test_an_unusable_imu_is_an_error(broken: object, message: str) -> None:
    assert callable(broken)
    with pytest.raises(TrajectoryError, match=f"^drive/: .*{message}"):
        clean_inertial(broken(some_imu(np.arange(100) * 0.01)), "drive/")


@pytest.mark.parametrize("moved_ns", [(0, 0), (-600, 900)], ids=["own", "scan"])
def test_in_a_gap_the_factor_is_looser(moved_ns: tuple[int, int]) -> None:
    """Also where nodes of scans within a microsecond stand for the ends of the gap."""
    t = np.arange(300) * 0.01
    imu = some_imu(t[(t < 1.0) | (t > 1.5)])
    inertial, _ = clean_inertial(imu, "drive/")
    ends = inertial.gaps_ns[0] + np.array(moved_ns)
    nodes = np.array([inertial.begin_ns, *ends, inertial.end_ns])
    bias = [gtsam.imuBias.ConstantBias()] * 4
    noise = imu_noise(imu, config_for(EXACT))

    before, gap, _ = preintegrate(inertial, nodes, bias, noise, GRAVITY)

    def sigma(m: gtsam.PreintegratedCombinedMeasurements) -> float:
        return float(np.sqrt(m.preintMeasCov()[2, 2]))

    # 0.3 rad/s for 0.52 s, wrong the same way all the time.
    assert sigma(gap) == pytest.approx(0.3 * 0.52, rel=0.02)
    assert sigma(before) < 1e-3


def test_rates_are_averaged_about_the_instant() -> None:
    at = START_NS + np.arange(100, dtype=np.int64) * 10_000_000
    ramp = np.zeros((100, 3))
    ramp[:, 2] = np.arange(100) * 0.01
    dead = DeadReckoning(at, ramp, np.zeros((100, 3)))
    wanted = at[[0, 50, 99]]
    np.testing.assert_allclose(dead.rates(wanted, 50_000_000)[:, 2], [0.0, 0.5, 0.99], atol=2e-3)
