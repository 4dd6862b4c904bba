"""Factors: Jacobians by numerical derivatives, frames and noise by hand."""

from __future__ import annotations

import math
from collections.abc import Sequence

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.factors import (
    CloudMotion,
    chain_jacobians,
    extrinsic_prior,
    gauss_markov_factor,
    given_pose_factor,
    predict_cloud,
    target_pose_factor,
)
from caliv_graph.calibration.rates import rates_factor
from caliv_graph.conventions import (
    key_extrinsic,
    key_offset,
    key_pose_error,
    key_rates,
    key_sensor,
    key_target,
    key_vehicle,
)
from caliv_graph.geometry.se3 import retract_vehicle_axes
from caliv_graph.products import Array
from caliv_graph.trajectory.rates import RATES, by_rates
from tests.calibration.problems import correlated_information, numerical_jacobian
from tests.samples import MOUNTINGS, pose

C, X, B, E, S = key_target(0), key_vehicle(0), key_pose_error(0), key_extrinsic(), key_sensor(1)
V = key_rates(0)
LATE = key_offset(0)

OFFSETS_M = (0.0, 30.0, 2000.0)
"""How far poses are from their origin: at it, on a drive, and in a map of a city."""


def values_of(**poses: gtsam.Pose3 | Array) -> gtsam.Values:
    keys = {"C": C, "X": X, "B": B, "E": E, "S": S}
    values = gtsam.Values()
    for name, value in poses.items():
        values.insert(keys[name], value)
    return values


def random_pose(rng: np.random.Generator, offset_m: float, angle_rad: float = 2.5) -> gtsam.Pose3:
    w = rng.normal(size=3)
    w *= rng.uniform(0.0, angle_rad) / np.linalg.norm(w)
    return gtsam.Pose3(gtsam.Rot3.Expmap(w), offset_m * rng.uniform(-1.0, 1.0, 3))


def check_jacobians(
    factor: gtsam.NoiseModelFactor, values: gtsam.Values, keys: Sequence[int]
) -> None:
    """Linearised, whitened Jacobians and residual against the factor's own error."""

    def error(at: gtsam.Values) -> Array:
        return np.asarray(factor.whitenedError(at))

    A, b = factor.linearize(values).jacobian()
    assert list(factor.keys()) == list(keys)
    np.testing.assert_allclose(b, -error(values), atol=1e-9)
    assert 2.0 * factor.error(values) == pytest.approx(np.sum(error(values) ** 2))
    sizes = [{LATE: 1, V: RATES}.get(key, 6) for key in keys]
    for key, size, end in zip(keys, sizes, np.cumsum(sizes).tolist(), strict=True):
        numerical = numerical_jacobian(error, values, key, size=size)
        scale = np.abs(numerical).max()
        np.testing.assert_allclose(
            A[:, end - size : end] / scale, numerical / scale, atol=1e-6, err_msg=str(key)
        )


# ------------------------------------------------------------------ registered clouds


@pytest.mark.parametrize("offset_m", OFFSETS_M)
@pytest.mark.parametrize("residual_rad", [0.0, 1e-3, 1.0])
def test_jacobians_of_a_cloud(offset_m: float, residual_rad: float) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        values = values_of(
            C=random_pose(rng, offset_m),
            X=random_pose(rng, offset_m),
            E=random_pose(rng, 2.0),
            S=random_pose(rng, 2.0),
        )
        Z, _ = chain_jacobians([values.atPose3(key) for key in (C, X, E, S)])
        off = np.concatenate([residual_rad * rng.uniform(-1, 1, 3), rng.uniform(-1, 1, 3)])
        measured = gtsam.Pose3.Expmap(off).compose(Z)
        factor = target_pose_factor((C, X, E, S), measured, correlated_information(rng))
        check_jacobians(factor, values, (C, X, E, S))


@pytest.mark.parametrize("offset_m", OFFSETS_M)
def test_jacobians_of_a_cloud_of_the_reference(offset_m: float) -> None:
    rng = np.random.default_rng(5)
    values = values_of(
        C=random_pose(rng, offset_m), X=random_pose(rng, offset_m), E=random_pose(rng, 2.0)
    )
    Z, _ = chain_jacobians([values.atPose3(key) for key in (C, X, E)])
    measured = gtsam.Pose3.Expmap(rng.uniform(-0.5, 0.5, 6)).compose(Z)
    factor = target_pose_factor((C, X, E), measured, correlated_information(rng))
    check_jacobians(factor, values, (C, X, E))


@pytest.mark.parametrize("offset_m", OFFSETS_M)
def test_jacobians_of_a_cloud_that_wrong_rates_moved(offset_m: float) -> None:
    rng = np.random.default_rng(6)
    values = values_of(
        C=random_pose(rng, offset_m), X=random_pose(rng, offset_m), E=random_pose(rng, 2.0)
    )
    values.insert(V, 0.1 * rng.normal(size=RATES))
    used, twist = random_pose(rng, 2.0), rng.normal(size=6)
    R = gtsam.Rot3.Expmap(1e-2 * rng.normal(size=3)).compose(values.atPose3(X).rotation())
    motion = CloudMotion(twist, R.matrix(), apart_s=0.05, T_vehicle_lidar=used)
    # A point as it was measured is where the true rates have it, and the cloud had it elsewhere.
    point = rng.normal(size=3)
    stamped = used.inverse().compose(gtsam.Pose3.Expmap(0.05 * twist)).compose(used)
    to_now = values.atPose3(X).rotation().matrix().T @ R.matrix()
    now = np.concatenate([to_now @ twist[:3], to_now @ twist[3:]])
    wrong = by_rates(now[:3]) @ values.atVector(V)
    true = gtsam.Pose3.Expmap(0.05 * (now + wrong)).compose(values.atPose3(E))
    Z, _ = predict_cloud((C, X, V, E), values, motion)
    there = values.atPose3(C).compose(values.atPose3(X)).compose(true).transformFrom(point)
    assert Z.transformFrom(stamped.transformFrom(point)) == pytest.approx(there)
    measured = gtsam.Pose3.Expmap(1e-3 * rng.uniform(-1.0, 1.0, 6)).compose(Z)
    factor = target_pose_factor((C, X, V, E), measured, correlated_information(rng), motion)
    assert np.abs(factor.unwhitenedError(values)).max() < 2e-3
    check_jacobians(factor, values, (C, X, V, E))


def driven(t: float, turning: float) -> gtsam.Pose3:
    """Starts to move: `turning` rad/s^2 about z and 3 m/s^2 along x, from 0.2 rad/s and 2 m/s."""
    T, steps = gtsam.Pose3(), 400
    for k in range(steps):
        at = t * (k + 0.5) / steps
        twist = np.array([0.0, 0.0, 0.2 + turning * at, 2.0 + 3.0 * at, 0.0, 0.0])
        T = T.compose(gtsam.Pose3.Expmap(twist * t / steps))
    return T


@pytest.mark.parametrize("apart_s", [0.0, 0.05])
@pytest.mark.parametrize("late_s", [0.03, -0.03])
def test_a_late_cloud_of_a_vehicle_that_accelerates(late_s: float, apart_s: float) -> None:
    """1.35 mm and 0.54 mrad beyond a constant velocity, and in a sweep 1.8 mrad and 4.5 mm more:
    on a curve that turns into another, such clouds took S2V x 25 mm off."""
    T = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 1.0), np.array([1.0, 0.5, 2.0]))
    values = values_of(C=gtsam.Pose3(), X=gtsam.Pose3(), E=T)
    values.insert(LATE, np.array([late_s]))
    keys = [C, X, LATE, E]
    if apart_s:
        values.insert(V, np.zeros(RATES))
        keys.insert(3, V)
    motion = CloudMotion(
        np.array([0.0, 0.0, 0.2, 2.0, 0.0, 0.0]),
        np.eye(3),
        offset=True,
        apart_s=apart_s,
        T_vehicle_lidar=T if apart_s else None,
        acceleration=np.array([0.0, 0.0, 1.2, 3.0, 0.0, 0.0]),
    )
    Z, _ = predict_cloud(keys, values, motion)
    # Points were taken apart_s after the cloud, and moved to it with the twist at the stamp.
    taken = driven(apart_s - late_s, 1.2).compose(T)
    off = gtsam.Pose3.Logmap(taken.compose(motion.undone()).between(Z))
    sweep = 0.5 * apart_s**2 * np.array([1.2, 3.0])  # acceleration within the sweep itself
    assert np.abs(off[:3]).max() < 1e-4 + sweep[0]
    assert np.abs(off[3:]).max() < 2e-4 + sweep[1] + 2.5 * sweep[0]
    measured = gtsam.Pose3.Expmap(np.full(6, 1e-3)).compose(Z)
    information = correlated_information(np.random.default_rng(2))
    check_jacobians(target_pose_factor(keys, measured, information, motion), values, keys)


@pytest.mark.parametrize("keys", [(C, X, V, E), (C, X, LATE, E), (C, X, LATE, V, E)])
def test_a_turn_of_the_vehicle_frame_changes_no_cloud(keys: tuple[int, ...]) -> None:
    """By 30 mrad, as by an IMU that is askew: neither a sweep nor a late stamp shows it.

    The mean rates of a figure-eight cannot follow, which turns both ways.
    """
    rng = np.random.default_rng(8)
    values = values_of(C=random_pose(rng, 9.0), X=random_pose(rng, 9.0), E=random_pose(rng, 2.0))
    values.insert(V, np.zeros(RATES))
    values.insert(LATE, np.array([0.03]))
    motion = CloudMotion(
        np.array([0.0, 0.0, 0.3, 2.0, 0.0, 0.0]),
        values.atPose3(X).rotation().matrix(),
        offset=LATE in keys,
        apart_s=0.05 if V in keys else 0.0,
        T_vehicle_lidar=values.atPose3(E) if V in keys else None,
        acceleration=np.array([0.0, 0.0, 0.6, 1.0, 0.0, 0.0]),
    )
    before, _ = predict_cloud(keys, values, motion)
    turn = gtsam.Pose3(gtsam.Rot3.Expmap(np.array([3e-2, 1e-2, 0.0])), np.zeros(3))
    values.update(X, values.atPose3(X).compose(turn))
    values.update(E, turn.inverse().compose(values.atPose3(E)))
    after, _ = predict_cloud(keys, values, motion)
    assert after.equals(before, 1e-12)
    measured = gtsam.Pose3.Expmap(np.full(6, 1e-3)).compose(after)
    factor = target_pose_factor(keys, measured, correlated_information(rng), motion)
    check_jacobians(factor, values, keys)


def test_a_shift_of_the_vehicle_frame_changes_no_cloud() -> None:
    """By 5 cm, as by an antenna whose place is wrong: the shift of the rates follows."""
    rng = np.random.default_rng(8)
    values = values_of(C=random_pose(rng, 9.0), X=random_pose(rng, 9.0), E=random_pose(rng, 2.0))
    values.insert(V, np.zeros(RATES))
    motion = CloudMotion(
        np.array([0.02, 0.01, 0.3, 2.0, 0.0, 0.0]),
        values.atPose3(X).rotation().matrix(),
        apart_s=0.05,
        T_vehicle_lidar=values.atPose3(E),
    )
    keys = (C, X, V, E)
    before, _ = predict_cloud(keys, values, motion)
    shift = np.array([0.05, -0.03, 0.02])
    moved = gtsam.Pose3(gtsam.Rot3(), shift)
    values.update(X, values.atPose3(X).compose(moved))
    values.update(E, moved.inverse().compose(values.atPose3(E)))
    assert not predict_cloud(keys, values, motion)[0].equals(before, 1e-4)
    values.update(V, np.concatenate([np.zeros(6), shift]))
    assert predict_cloud(keys, values, motion)[0].equals(before, 1e-12)


def test_rates_of_a_drive_follow_from_its_poses() -> None:
    rng = np.random.default_rng(7)
    poses = {X: random_pose(rng, 30.0), key_vehicle(1): random_pose(rng, 30.0)}
    factor = rates_factor(V, poses, rng.normal(size=(RATES, 12)))
    values = gtsam.Values()
    for key, T in poses.items():
        values.insert(key, T)
    values.insert(V, np.zeros(RATES))
    assert factor.error(values) == pytest.approx(0.0, abs=1e-15)
    for key, T in poses.items():
        values.update(key, T.retract(0.1 * rng.normal(size=6)))
    values.update(V, rng.normal(size=RATES))
    check_jacobians(factor, values, (*poses, V))


def a_drive_past_a_target() -> gtsam.Values:
    """The target at (15, -9), the vehicle 5 m up the road and turned by 0.3 rad."""
    T_map_target = gtsam.Pose3(gtsam.Rot3(), np.array([15.0, -9.0, 0.6]))
    return values_of(
        C=T_map_target.inverse(),
        X=gtsam.Pose3(gtsam.Rot3.Yaw(-0.3), np.array([5.0, -1.0, 0.0])),
        E=pose(*MOUNTINGS["rear"]),
        S=pose(*MOUNTINGS["rear"]).between(pose(*MOUNTINGS["front"])),
    )


def cloud_error(values: gtsam.Values, measured: gtsam.Pose3) -> Array:
    factor = target_pose_factor((C, X, E, S), measured, np.eye(6))
    return np.asarray(factor.unwhitenedError(values))


def predicted(values: gtsam.Values) -> gtsam.Pose3:
    """T_target_map X_i E S_a, by points: a point of the LiDAR, through every frame."""
    front = values.atPose3(E).compose(values.atPose3(S))
    return values.atPose3(C).compose(values.atPose3(X).compose(front))


def test_a_true_measurement_has_no_residual() -> None:
    values = a_drive_past_a_target()
    T_map_front = values.atPose3(X).compose(pose(*MOUNTINGS["front"]))
    # The LiDAR is where the target frame, at (15, -9, 0.6) with the map's axes, sees it.
    measured = gtsam.Pose3(T_map_front.rotation(), T_map_front.translation() - [15.0, -9.0, 0.6])
    assert cloud_error(values, measured) == pytest.approx(np.zeros(6), abs=1e-12)


def test_a_turn_about_the_target_is_rotation_only() -> None:
    # The registration got the target's yaw wrong by 5 mrad: the LiDAR swings 55 mm around it,
    # 11 m away, but at the target nothing moves.
    values = a_drive_past_a_target()
    yaw = gtsam.Pose3(gtsam.Rot3.Yaw(-0.005), np.zeros(3))
    measured = yaw.compose(predicted(values))
    swing = np.linalg.norm(measured.translation() - predicted(values).translation())
    assert swing > 0.04
    assert cloud_error(values, measured) == pytest.approx([0, 0, 0.005, 0, 0, 0], abs=1e-9)


def test_a_shift_of_the_target_is_along_the_target_s_axes() -> None:
    # Predicted 1, 2, 3 mm off along the axes of the target frame, whatever the LiDAR's are.
    values = a_drive_past_a_target()
    shift = gtsam.Pose3(gtsam.Rot3(), np.array([-0.001, -0.002, -0.003]))
    measured = shift.compose(predicted(values))
    assert cloud_error(values, measured) == pytest.approx([0, 0, 0, 0.001, 0.002, 0.003], abs=1e-12)


def test_a_lidar_turned_about_itself_moves_the_target_across() -> None:
    # The mounting is wrong by 2 mrad of yaw: the target is seen 2 mrad x its distance aside.
    values = a_drive_past_a_target()
    measured = predicted(values)
    distance = float(np.linalg.norm(measured.translation()[:2]))
    turned = gtsam.Values(values)
    front = pose(*MOUNTINGS["front"])
    wrong = retract_vehicle_axes(front, np.array([0.0, 0.0, 0.002, 0.0, 0.0, 0.0]))
    turned.update(S, values.atPose3(E).between(wrong))
    r = cloud_error(turned, measured)
    assert r[:3] == pytest.approx([0.0, 0.0, 0.002], abs=1e-9)
    assert np.linalg.norm(r[3:]) == pytest.approx(0.002 * distance, rel=1e-3)


def test_information_of_a_cloud_is_about_the_target() -> None:
    # 2 mrad at 1 mrad and 3 mm at 1 mm: (4 + 9) / 2.
    values = a_drive_past_a_target()
    sigmas = np.array([1e-3, 5e-3, 5e-3, 9e-3, 1e-3, 9e-3])
    off = gtsam.Pose3.Expmap(np.array([0.002, 0.0, 0.0, 0.0, 0.003, 0.0]))
    factor = target_pose_factor(
        (C, X, E, S), off.inverse().compose(predicted(values)), np.diag(sigmas**-2.0)
    )
    assert factor.error(values) == pytest.approx(6.5, rel=1e-6)
    # A correlation counts.
    information = np.diag(sigmas**-2.0)
    information[0, 4] = information[4, 0] = 0.5 / (1e-3 * 1e-3)
    factor = target_pose_factor((C, X, E, S), off.inverse().compose(predicted(values)), information)
    assert factor.error(values) == pytest.approx(6.5 + 0.5 * 2.0 * 3.0, rel=1e-6)


def test_moving_the_map_changes_no_residual() -> None:
    values = a_drive_past_a_target()
    measured = gtsam.Pose3.Expmap(np.full(6, 0.01)).compose(predicted(values))
    before = cloud_error(values, measured)
    G = random_pose(np.random.default_rng(2), 500.0)
    values.update(X, G.compose(values.atPose3(X)))
    values.update(C, values.atPose3(C).compose(G.inverse()))
    assert cloud_error(values, measured) == pytest.approx(before, abs=1e-9)


# ------------------------------------------------------------------ given poses


@pytest.mark.parametrize("offset_m", OFFSETS_M)
def test_jacobians_of_a_given_pose(offset_m: float) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        given = random_pose(rng, offset_m)
        values = values_of(X=given.compose(random_pose(rng, 1.0, 1.0)), B=rng.uniform(-0.1, 0.1, 6))
        check_jacobians(given_pose_factor(X, B, given, 1e-3, 0.02), values, (X, B))
        values.insert(LATE, rng.uniform(-0.1, 0.1, 1))
        late = given_pose_factor(X, B, given, 1e-3, 0.02, None, (LATE, rng.uniform(-2.0, 2.0, 6)))
        check_jacobians(late, values, (X, B, LATE))


def test_a_given_pose_that_is_late_is_where_the_vehicle_was() -> None:
    # Heading north at 2 m/s and turning left at 0.3 rad/s; the pose is of 10 ms before its stamp.
    given = gtsam.Pose3(gtsam.Rot3.Yaw(math.pi / 2), np.array([100.0, 50.0, 1.0]))
    turned = given.rotation().compose(gtsam.Rot3.Yaw(0.003))
    now = gtsam.Pose3(turned, np.array([100.0, 50.02, 1.0]))
    values = values_of(X=now, B=np.zeros(6))
    values.insert(LATE, np.array([0.01]))
    rates = np.array([0.0, 0.0, 0.3, 0.0, 2.0, 0.0])
    factor = given_pose_factor(X, B, given, 1e-3, 0.02, None, (LATE, rates))
    assert factor.unwhitenedError(values) == pytest.approx(np.zeros(6), abs=1e-12)


def test_rotation_in_vehicle_axes_position_in_map_axes() -> None:
    # The vehicle heads north. It is rolled by 4 mrad about its own x, and 3 cm east of the pose.
    given = gtsam.Pose3(gtsam.Rot3.Yaw(math.pi / 2), np.array([100.0, 50.0, 1.0]))
    rolled = given.rotation().compose(gtsam.Rot3.Roll(0.004))
    values = values_of(X=gtsam.Pose3(rolled, np.array([100.03, 50.0, 1.0])), B=np.zeros(6))
    factor = given_pose_factor(X, B, given, 1e-3, 0.02)
    assert factor.unwhitenedError(values) == pytest.approx([0.004, 0, 0, 0.03, 0, 0], abs=1e-12)
    # 4 sigmas and 1.5 sigmas.
    assert factor.error(values) == pytest.approx(0.5 * (16.0 + 2.25))


def test_slow_error_is_what_the_given_pose_is_off_by() -> None:
    # A pose that is 3 cm east of where the filter has it, because the filter is 3 cm off.
    given = gtsam.Pose3(gtsam.Rot3.Yaw(math.pi / 2), np.array([100.0, 50.0, 1.0]))
    turned = given.rotation().compose(gtsam.Rot3.Yaw(0.002))
    values = values_of(
        X=gtsam.Pose3(turned, np.array([100.03, 50.0, 1.0])),
        B=np.array([0.0, 0.0, 0.002, 0.03, 0.0, 0.0]),
    )
    factor = given_pose_factor(X, B, given, 1e-3, 0.02)
    assert factor.error(values) == pytest.approx(0.0, abs=1e-12)


# ------------------------------------------------------------------ slow errors


def test_slow_error_decays_towards_zero() -> None:
    factor = gauss_markov_factor(1, 2, 0.8, np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0]))
    values = gtsam.Values()
    values.insert(1, np.array([1.0, 0.0, 0.0, 10.0, 0.0, 0.0]))
    values.insert(2, np.array([0.8, 0.0, 0.0, 8.0, 0.0, 0.0]))
    assert factor.error(values) == pytest.approx(0.0, abs=1e-12)
    # 3 off at a sigma of 1, and 4 off at a sigma of 2.
    values.update(2, np.array([3.8, 0.0, 0.0, 12.0, 0.0, 0.0]))
    assert factor.error(values) == pytest.approx(0.5 * (9.0 + 4.0))


def test_slow_error_keeps_its_variance() -> None:
    # From the stationary variance, a step of stationary (1 - decay^2) leads back to it.
    stationary = np.array([1e-3, 2e-3, 3e-3, 0.01, 0.02, 0.03])
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorVector(0, np.zeros(6), gtsam.noiseModel.Diagonal.Sigmas(stationary)))
    values.insert(0, np.zeros(6))
    decays = (0.9, 0.5, 0.99, 0.1)
    for i, decay in enumerate(decays):
        graph.add(gauss_markov_factor(i, i + 1, decay, stationary * math.sqrt(1.0 - decay**2)))
        values.insert(i + 1, np.zeros(6))
    marginals = gtsam.Marginals(graph, values)
    for i in range(len(decays) + 1):
        sigma = np.sqrt(np.diag(marginals.marginalCovariance(i)))
        assert sigma == pytest.approx(stationary)
    # And the first and third remember each other by 0.9 x 0.5.
    joint = marginals.jointMarginalCovariance(gtsam.KeyVector([0, 2]))
    assert np.diag(joint.at(0, 2)) == pytest.approx(0.45 * stationary**2)


# ------------------------------------------------------------------ initial guesses


@pytest.mark.parametrize("off_by", [1e-3, 0.5])
def test_jacobians_of_a_guess(off_by: float) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        values = values_of(E=random_pose(rng, 3.0), S=random_pose(rng, 3.0))
        sigmas = rng.uniform(0.01, 0.1, 6)
        mounting = values.atPose3(E).compose(values.atPose3(S))
        guess = retract_vehicle_axes(mounting, off_by * rng.uniform(-1, 1, 6))
        check_jacobians(extrinsic_prior((E, S), guess, sigmas), values, (E, S))
        guess = retract_vehicle_axes(values.atPose3(E), off_by * rng.uniform(-1, 1, 6))
        check_jacobians(extrinsic_prior((E,), guess, sigmas), values, (E,))


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("name", ["front", "rear", "left"])
def test_sigmas_of_a_guess_are_those_of_the_vehicle_s_axes(name: str, axis: int) -> None:
    # Whatever way the LiDAR looks: two sigmas along one axis of the vehicle.
    sigmas = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
    guess = pose(*MOUNTINGS[name])
    off = np.zeros(6)
    off[axis] = 2.0 * sigmas[axis]
    actual = retract_vehicle_axes(guess, off)
    reference = pose(*MOUNTINGS["rear"])
    values = values_of(E=reference, S=reference.between(actual))
    factor = extrinsic_prior((E, S), guess, sigmas)
    assert factor.unwhitenedError(values) == pytest.approx(off, abs=1e-12)
    assert factor.error(values) == pytest.approx(2.0)


# ------------------------------------------------------------------ products of poses


def test_chain_is_a_product_from_left_to_right() -> None:
    rng = np.random.default_rng(9)
    chain = [random_pose(rng, 20.0) for _ in range(4)]
    product, jacobians = chain_jacobians(chain)
    p = np.array([1.0, 2.0, 3.0])
    through = p
    for T in reversed(chain):
        through = T.transformFrom(through)
    assert product.transformFrom(p) == pytest.approx(through)
    step = 1e-6
    for i, J in enumerate(jacobians):
        columns = []
        for d in step * np.eye(6):
            nudged = [T.retract(d) if k == i else T for k, T in enumerate(chain)]
            columns.append(
                gtsam.Pose3.Logmap(chain_jacobians(nudged)[0].compose(product.inverse())) / step
            )
        np.testing.assert_allclose(J, np.array(columns).T, atol=1e-3, rtol=1e-4)
