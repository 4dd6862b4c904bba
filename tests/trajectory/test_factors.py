"""Factors of the trajectory: residuals by hand, Jacobians against numerical derivatives."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from caliv_graph.products import Array
from caliv_graph.trajectory.factors import (
    Gaussian,
    baseline_factor,
    biased_orientation_factor,
    heading_factor,
    level_factor,
    marginal_factor,
    orientation_factor,
    position_factor,
    position_residuals,
    tangent_size,
    velocity_factor,
    velocity_residuals,
)
from caliv_graph.trajectory.states import States

POSE, VELOCITY, BIAS = 0, 1, 2
UNIT = gtsam.noiseModel.Unit.Create(3)


def values() -> gtsam.Values:
    out = gtsam.Values()
    out.insert(POSE, gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.2, 2.0), np.array([4.0, -3.0, 1.0])))
    out.insert(VELOCITY, np.array([2.0, 1.0, -0.5]))
    out.insert(BIAS, np.array([0.1]))
    return out


def check_jacobians(factor: gtsam.NoiseModelFactor, at: gtsam.Values) -> None:
    """Linearised against central differences on the manifold."""
    A, b = factor.linearize(at).jacobian()
    np.testing.assert_allclose(b, -factor.unwhitenedError(at), atol=1e-12)
    column = 0
    for key in factor.keys():  # noqa: SIM118  # GTSAM's keys, not a dictionary's
        dim = {POSE: 6, VELOCITY: 3, BIAS: 1}[key]
        for j in range(dim):
            step = 1e-6 * np.eye(dim)[j]
            ends = []
            for sign in (1.0, -1.0):
                delta = gtsam.VectorValues()
                delta.insert(key, sign * step)
                ends.append(factor.unwhitenedError(at.retract(delta)))
            numerical = (ends[0] - ends[1]) / 2e-6
            np.testing.assert_allclose(A[:, column], numerical, atol=1e-7)
            column += 1


def test_residuals_of_all_factors_at_once_are_theirs() -> None:
    at, rng = values(), np.random.default_rng(1)
    T, V = at.atPose3(POSE), at.atVector(VELOCITY)
    none = np.zeros((1, 3))
    states = States(T.rotation().matrix()[None], T.translation()[None], V[None], none, none)
    measured, offset, delay_s = rng.normal(size=(2, 3)), rng.normal(size=(2, 3)), [0.0, -0.03]
    nodes = np.zeros(2, dtype=np.int64)

    positions = position_residuals(states, nodes, measured, offset, np.array(delay_s), 9.8)
    delays_s = np.array(delay_s)[:, None, None] * np.array([[1, 0.1, 0], [0, 0.9, 0], [0, 0, 1.1]])
    velocities = velocity_residuals(states, nodes, measured, delays_s, 9.8)

    for k, late_s in enumerate(delay_s):
        of_fix = position_factor(POSE, VELOCITY, measured[k], offset[k], late_s, 9.8, UNIT)
        of_speed = velocity_factor(POSE, VELOCITY, measured[k], delays_s[k], 9.8, UNIT)
        np.testing.assert_allclose(positions[k], of_fix.unwhitenedError(at), atol=1e-12)
        np.testing.assert_allclose(velocities[k], of_speed.unwhitenedError(at), atol=1e-12)


@pytest.mark.parametrize("delay_s", [0.0, 0.05, -0.03])
def test_position(delay_s: float) -> None:
    z, q = np.array([1.0, 2.0, 3.0]), np.array([0.5, -0.2, 1.8])
    factor = position_factor(POSE, VELOCITY, z, q, delay_s, 9.8, UNIT)
    at = values()
    T = at.atPose3(POSE)
    fallen = np.array([0.0, 0.0, -0.5 * 9.8 * delay_s**2])
    expected = T.transformFrom(q) + delay_s * at.atVector(VELOCITY) + fallen - z
    np.testing.assert_allclose(factor.unwhitenedError(at), expected, atol=1e-12)
    check_jacobians(factor, at)


def test_velocity() -> None:
    z, late_s = (
        np.array([1.0, 0.2, 0.1]),
        np.array([[0.03, 0.01, 0], [0, -0.02, 0], [0.01, 0, 0.04]]),
    )
    factor = velocity_factor(POSE, VELOCITY, z, late_s, 9.8, UNIT)
    at = values()
    R = at.atPose3(POSE).rotation()
    g = np.array([0.0, 0.0, -9.8])
    expected = R.unrotate(at.atVector(VELOCITY)) + late_s @ R.unrotate(g) - z
    np.testing.assert_allclose(factor.unwhitenedError(at), expected, atol=1e-12)
    check_jacobians(factor, at)


def test_orientation_with_a_yaw_bias() -> None:
    at = values()
    R = at.atPose3(POSE).rotation()
    # A source turned by 0.1 says the true orientation turned by 0.1 about the map's z.
    exact = biased_orientation_factor(POSE, BIAS, gtsam.Rot3.Rz(0.1).compose(R), UNIT)
    np.testing.assert_allclose(exact.unwhitenedError(at), 0.0, atol=1e-12)
    check_jacobians(
        biased_orientation_factor(POSE, BIAS, gtsam.Rot3.RzRyRx(0.4, 0.1, 2.3), UNIT), at
    )


def test_orientation_residual_is_in_the_axes_of_the_imu() -> None:
    at = values()
    d = np.array([0.01, -0.02, 0.03])
    measured = at.atPose3(POSE).rotation().compose(gtsam.Rot3.Expmap(-d))
    factor = orientation_factor(POSE, measured, UNIT)
    np.testing.assert_allclose(factor.unwhitenedError(at), d, atol=1e-12)


def test_a_marginal_factor_is_its_gaussian() -> None:
    rng = np.random.default_rng(0)
    poses = tuple(gtsam.Pose3.Expmap(rng.standard_normal(6)) for _ in range(4))
    A = rng.standard_normal((24, 24))
    information = A @ A.T
    factor = marginal_factor([10, 11, 12, 13], information, poses)

    d = 1e-3 * rng.standard_normal((4, 6))
    moved = gtsam.Values()
    for key, pose, step in zip([10, 11, 12, 13], poses, d, strict=True):
        moved.insert(key, pose.retract(step))

    assert factor.error(moved) == pytest.approx(0.5 * d.ravel() @ information @ d.ravel())


def gaussian_and_moved() -> tuple[Gaussian, gtsam.Values]:
    """A Gaussian on two poses, a rotation and a vector, and variables far from its means."""
    rng = np.random.default_rng(1)
    means: tuple[gtsam.Pose3 | gtsam.Rot3 | Array, ...] = (
        gtsam.Pose3.Expmap(rng.standard_normal(6)),
        gtsam.Pose3.Expmap(rng.standard_normal(6)),
        gtsam.Rot3.Expmap(rng.standard_normal(3)),
        rng.standard_normal(3),
    )
    A = rng.standard_normal((18, 18))
    found = Gaussian((10, 11, 12, 13), means, A @ A.T, rng.standard_normal(18), 3.0)
    moved = gtsam.Values()
    for key, mean in zip(found.keys, means, strict=True):
        d = 0.3 * rng.standard_normal(tangent_size(mean))
        moved.insert(key, mean + d if isinstance(mean, np.ndarray) else mean.retract(d))
    return found, moved


def test_a_gaussian_is_linearised_where_its_variables_are() -> None:
    found, moved = gaussian_and_moved()
    H, b = found.at(moved)
    factor, zero = found.factor(), moved.zeroVectors()

    def error(d: Array) -> float:
        delta, start = gtsam.VectorValues(), 0
        for key in found.keys:
            size = zero.at(key).size
            delta.insert(key, d[start : start + size])
            start += size
        return float(factor.error(moved.retract(delta)))

    slope = [(error(d) - error(-d)) / 2e-5 for d in 1e-5 * np.eye(18)]
    np.testing.assert_allclose(-b, slope, rtol=1e-6, atol=1e-6)
    # Nothing is to be gained at the means, and H is that of GTSAM there.
    at_means = gtsam.Values()
    for key, mean in zip(found.keys, found.means, strict=True):
        at_means.insert(key, mean)
    np.testing.assert_allclose(found.at(at_means)[0], found.information, atol=1e-9)
    # GTSAM's own is far off: what `Gaussian` is there for.
    assert np.abs(factor.linearize(moved).information() - H).max() > 0.1 * np.abs(H).max()


def test_what_leaves_a_common_turn_open_leaves_it_open_wherever_it_went() -> None:
    """Where a LiDAR is at two stamps, X_i E, is known: the vehicle's own axes are anyone's choice.

    The choice moves hundredths of a radian while a graph is solved; here, it is half a radian.
    """
    rng = np.random.default_rng(2)
    X = [gtsam.Pose3.Expmap(rng.standard_normal(6)) for _ in range(2)]
    E = gtsam.Pose3.Expmap(rng.standard_normal(6))
    of_vehicle, nothing = E.inverse().AdjointMap(), np.zeros((6, 6))
    J = np.block([[of_vehicle, nothing, np.eye(6)], [nothing, of_vehicle, np.eye(6)]])
    known = Gaussian((10, 11, 12), (*X, E), 1e8 * J.T @ J, np.zeros(18))
    turn = gtsam.Pose3.Expmap(np.array([0.3, -0.2, 0.4, 1.0, 0.5, -0.3]))
    values = gtsam.Values()
    values.insert(10, X[0].compose(turn))
    values.insert(11, X[1].compose(turn))
    values.insert(12, turn.inverse().compose(E))

    H, b = known.at(values)

    other_turns = np.vstack([np.eye(6), np.eye(6), -values.atPose3(12).inverse().AdjointMap()])
    assert np.abs(other_turns.T @ H @ other_turns).max() < 1e-12 * np.abs(H).max()
    np.testing.assert_allclose(b, 0.0, atol=1e-12 * np.abs(H).max())
    by_gtsam = known.factor().linearize(values).information()
    assert np.abs(other_turns.T @ by_gtsam @ other_turns).max() > 0.01 * np.abs(H).max()


def test_where_a_lidar_was_tells_no_turn_of_the_vehicle_frame_after_the_map_has_moved() -> None:
    """Poses of a LiDAR in any map, those of the vehicle behind it: both moves are open at once.

    With logarithms of the vehicle's poses a map moved by centimetres held S2V roll and pitch of a
    drive of circles where they had been, to 0.5 mrad (random drive 131 of the second simulator).
    """
    rng = np.random.default_rng(3)
    X = [gtsam.Pose3.Expmap(rng.standard_normal(6)) for _ in range(3)]
    E = gtsam.Pose3.Expmap(rng.standard_normal(6))
    of_vehicle = E.inverse().AdjointMap()
    L = [T.compose(E) for T in X]
    by_lidar = np.hstack([np.kron(np.eye(3), of_vehicle), np.tile(np.eye(6), (3, 1))])
    # Of its poses in the first one's axes: the map is open.
    between = [
        np.hstack([-L[i].between(L[0]).AdjointMap(), *(np.eye(6) * (k == i) for k in (1, 2))])
        for i in (1, 2)
    ]
    J = np.vstack(between) @ by_lidar
    keys = (10, 11, 12, 13)
    known = Gaussian(keys, (*X, E), 1e8 * J.T @ J, np.zeros(24), carried=13)
    turn = gtsam.Pose3.Expmap(np.array([0.03, -0.02, 0.04, 0.1, 0.05, -0.03]))
    moved = gtsam.Pose3.Expmap(np.array([-0.02, 0.01, 0.3, 2.0, -3.0, 1.0]))
    values = gtsam.Values()
    for key, T in zip(keys, X, strict=False):
        values.insert(key, moved.compose(T).compose(turn))
    values.insert(13, turn.inverse().compose(E))

    H, _ = known.at(values)

    at = values.atPose3(13).inverse().AdjointMap()
    turns = np.vstack([np.tile(np.eye(6), (3, 1)), -at])
    assert np.abs(turns.T @ H @ turns).max() < 1e-12 * np.abs(H).max()
    in_map = [values.atPose3(key).inverse().AdjointMap() for key in keys[:3]]
    moves = np.vstack([*in_map, np.zeros((6, 6))])
    assert np.abs(moves.T @ H @ moves).max() < 1e-12 * np.abs(H).max()
    assert abs(known.chi_square(values)) < 1e-3
    in_logarithms = replace(known, carried=None).at(values)[0]
    assert np.abs(turns.T @ in_logarithms @ turns).max() > 1e-3 * np.abs(H).max()


def test_what_a_lidar_tells_is_linearised_where_its_variables_are() -> None:
    rng = np.random.default_rng(4)
    poses = [gtsam.Pose3.Expmap(rng.standard_normal(6)) for _ in range(4)]
    middle = rng.standard_normal(2)
    means: tuple[gtsam.Pose3 | gtsam.Rot3 | Array, ...] = (*poses[:2], middle, *poses[2:])
    A = rng.standard_normal((26, 26))
    keys = (10, 11, 12, 13, 14)
    found = Gaussian(keys, means, A @ A.T, rng.standard_normal(26), 3.0, carried=13)

    def away(d: Array) -> gtsam.Values:
        out, start = gtsam.Values(), 0
        for key, mean in zip(keys, means, strict=True):
            own = d[start : start + tangent_size(mean)]
            start += len(own)
            out.insert(key, mean + own if isinstance(mean, np.ndarray) else mean.retract(own))
        return out

    # At the means it is the quadratic in right perturbations that it was given.
    H, b = found.at(away(np.zeros(26)))
    np.testing.assert_allclose(H, found.information, atol=1e-9)
    np.testing.assert_allclose(b, found.gradient, atol=1e-9)
    there = away(0.3 * rng.standard_normal(26))
    H, b = found.at(there)

    def chi_square(d: Array) -> float:
        out, start = gtsam.Values(), 0
        for key, mean in zip(keys, means, strict=True):
            own = d[start : start + tangent_size(mean)]
            start += len(own)
            if isinstance(mean, np.ndarray):
                out.insert(key, there.atVector(key) + own)
            else:
                out.insert(key, there.atPose3(key).retract(own))
        return found.chi_square(out)

    slope = [(chi_square(d) - chi_square(-d)) / 4e-5 for d in 1e-5 * np.eye(26)]
    np.testing.assert_allclose(-b, slope, rtol=1e-6, atol=1e-6)


def test_a_scaled_velocity_has_the_right_jacobians() -> None:
    at = values()
    factor = velocity_factor(POSE, VELOCITY, np.ones(3), 0.03 * np.eye(3), 9.8, UNIT, 1.03)
    check_jacobians(factor, at)
    plain = velocity_factor(POSE, VELOCITY, np.zeros(3), 0.03 * np.eye(3), 9.8, UNIT)
    scaled = velocity_factor(POSE, VELOCITY, np.zeros(3), 0.03 * np.eye(3), 9.8, UNIT, 1.03)
    np.testing.assert_allclose(scaled.unwhitenedError(at), 1.03 * plain.unwhitenedError(at))


def test_level_ground_is_below_the_frame() -> None:
    at = values()
    up = np.array([0.1, -0.2, 1.0]) / np.linalg.norm([0.1, -0.2, 1.0])
    check_jacobians(
        level_factor(POSE, up, np.array([0.01, -0.02]), gtsam.noiseModel.Unit.Create(2)), at
    )
    at.update(POSE, gtsam.Pose3(gtsam.Rot3.RzRyRx(0.01, -0.02, 2.0), np.zeros(3)))
    factor = level_factor(
        POSE, np.array([0.0, 0.0, 1.0]), np.zeros(2), gtsam.noiseModel.Unit.Create(2)
    )
    # Nose up by 20 mrad is pitch -0.02; left side up by 10 mrad is roll 0.01.
    np.testing.assert_allclose(factor.unwhitenedError(at), [0.02, 0.01], atol=1e-5)


def test_a_heading_is_the_azimuth_of_a_direction() -> None:
    at = values()
    noise = gtsam.noiseModel.Unit.Create(1)
    check_jacobians(heading_factor(POSE, np.array([0.2, 0.9, 0.3]), 1.0, noise), at)
    at.update(POSE, gtsam.Pose3(gtsam.Rot3.Rz(3.0), np.zeros(3)))
    # 3.0 + pi / 2 is beyond half a turn.
    left = heading_factor(POSE, np.array([0.0, 1.0, 0.0]), 3.0 + np.pi / 2 - 0.2, noise)
    np.testing.assert_allclose(left.unwhitenedError(at), [0.2], atol=1e-12)


def test_a_baseline_is_a_turned_vector() -> None:
    at = values()
    factor = baseline_factor(POSE, np.array([0.2, 1.9, 0.3]), np.array([1.0, 2.0, 3.0]), UNIT)
    check_jacobians(factor, at)
    at.update(POSE, gtsam.Pose3(gtsam.Rot3.Rz(np.pi / 2), np.ones(3)))
    factor = baseline_factor(POSE, np.array([2.0, 0.0, 0.5]), np.array([0.0, 1.9, 0.5]), UNIT)
    np.testing.assert_allclose(factor.unwhitenedError(at), [0.0, 0.1, 0.0], atol=1e-12)
