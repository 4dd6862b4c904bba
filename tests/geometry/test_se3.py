"""SE(3) helpers against numbers worked out by hand, numerical derivatives and the group's laws."""

from __future__ import annotations

import math
from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from caliv_graph.config.mounting import PoseConfig
from caliv_graph.geometry.se3 import (
    joint_right_to_vehicle_axes,
    left_jacobian_inverse,
    quaternion_xyzw,
    retract_vehicle_axes,
    right_to_vehicle_axes,
    rpy,
    skew,
    stack,
    tangent_axes,
    unstack,
    vehicle_axes_difference,
)
from caliv_graph.products import Array
from tests.samples import MOUNTINGS, pose

FRONT = pose(*MOUNTINGS["front"])
REAR = pose(*MOUNTINGS["rear"])

SIN_10, COS_10 = math.sin(math.radians(10.0)), math.cos(math.radians(10.0))

NEAR_PI = math.pi - 1e-4
"""Rotation angle near which the logarithm turns over."""

ANGLES = st.one_of(
    st.sampled_from([0.0, 1e-12, 1e-8, 1e-5, 1e-3, 3.0, NEAR_PI]), st.floats(0.0, NEAR_PI)
)

SEEDED = settings(derandomize=True, deadline=None, max_examples=50, database=None)


@st.composite
def tangents(draw: st.DrawFn, *, metres: float = 30.0) -> Array:
    """(6,) rotation of any size below pi, often next to nothing or to pi, then a translation."""
    axis = np.array([draw(st.floats(-1.0, 1.0)) for _ in range(3)])
    length = float(np.linalg.norm(axis))
    axis = axis / length if length > 1e-3 else np.array([0.0, 0.0, 1.0])
    shift = [draw(st.floats(-metres, metres)) for _ in range(3)]
    return np.concatenate([draw(ANGLES) * axis, shift])


def numerical(function: Callable[[Array], Array], step: float = 1e-6) -> Array:
    """Central differences of a function of a (6,) vector at zero."""
    return np.array([(function(d) - function(-d)) / (2.0 * step) for d in step * np.eye(6)]).T


def test_tangent_is_rotation_then_translation_on_the_right() -> None:
    # What GTSAM does; every covariance of this project relies on it.
    d = np.array([0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0])
    turned = FRONT.retract(d)
    assert turned.translation() == pytest.approx(FRONT.translation())
    # A turn about the LiDAR's own z: its y axis lies where its -x axis was, and x where y was.
    assert turned.rotation().matrix()[:, 0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)
    assert turned.rotation().matrix()[:, 1] == pytest.approx([-COS_10, 0.0, SIN_10], abs=1e-12)
    shifted = FRONT.retract(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]))
    assert shifted.translation() == pytest.approx([2.0 + COS_10, 0.0, 2.0 - SIN_10])


@given(tangents(), tangents())
@SEEDED
def test_retraction_is_the_exponential_and_local_coordinates_undo_it(a: Array, d: Array) -> None:
    T = gtsam.Pose3.Expmap(a)
    moved = T.retract(d)
    assert moved.equals(T.compose(gtsam.Pose3.Expmap(d)), 1e-8)
    # Near pi the translation part of the logarithm loses a few digits.
    assert T.localCoordinates(moved) == pytest.approx(d, abs=1e-5)


def test_skew_by_hand() -> None:
    expected = [[0.0, -3.0, 2.0], [3.0, 0.0, -1.0], [-2.0, 1.0, 0.0]]
    assert skew(np.array([1.0, 2.0, 3.0])) == pytest.approx(np.array(expected))


def test_skew_is_the_cross_product_for_any_batch() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 4, 5, 3))
    product = np.einsum("...ij,...j->...i", skew(a), b)
    assert product == pytest.approx(np.cross(a, b))
    assert skew(a).shape == (4, 5, 3, 3)


def test_positive_pitch_is_nose_down() -> None:
    T = PoseConfig(xyz=(2.0, 0.0, 2.0), rpy_deg=(0.0, 10.0, 0.0)).pose()
    assert T.translation() == pytest.approx([2.0, 0.0, 2.0])
    # Columns: the LiDAR's axes in the vehicle. Its x dips, its z leans forward.
    expected = [[COS_10, 0.0, SIN_10], [0.0, 1.0, 0.0], [-SIN_10, 0.0, COS_10]]
    assert T.rotation().matrix() == pytest.approx(np.array(expected))
    # 10 m ahead of the LiDAR.
    assert T.transformFrom(np.array([10.0, 0.0, 0.0])) == pytest.approx(
        [2.0 + 10.0 * COS_10, 0.0, 2.0 - 10.0 * SIN_10]
    )


def test_lidar_that_looks_back() -> None:
    T = PoseConfig(xyz=(-0.4, 0.0, 2.0), rpy_deg=(0.0, 10.0, 180.0)).pose()
    expected = [[-COS_10, 0.0, -SIN_10], [0.0, -1.0, 0.0], [-SIN_10, 0.0, COS_10]]
    assert T.rotation().matrix() == pytest.approx(np.array(expected), abs=1e-12)
    # 10 m in front of it is behind the vehicle, and below; its left is the vehicle's right.
    assert T.transformFrom(np.array([10.0, 1.0, 0.0])) == pytest.approx(
        [-0.4 - 10.0 * COS_10, -1.0, 2.0 - 10.0 * SIN_10]
    )


def test_roll_comes_before_yaw() -> None:
    # Rz(90) Rx(90): y -> z -> z, x -> x -> y, z -> -y -> x. The other order would leave x at z.
    R = PoseConfig(xyz=(0.0, 0.0, 0.0), rpy_deg=(90.0, 0.0, 90.0)).pose().rotation().matrix()
    expected = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    np.testing.assert_allclose(R, expected, atol=1e-12)


@given(st.floats(-179.0, 179.0), st.floats(-89.0, 89.0), st.floats(-179.0, 179.0))
@SEEDED
def test_rpy_undoes_a_mounting(roll: float, pitch: float, yaw: float) -> None:
    T = PoseConfig(xyz=(0.0, 0.0, 0.0), rpy_deg=(roll, pitch, yaw)).pose()
    assert np.degrees(rpy(T.rotation().matrix())) == pytest.approx([roll, pitch, yaw], abs=1e-7)


@given(tangents())
@example(np.zeros(6))
@example(np.array([1e-9, 0.0, 0.0, 20.0, 0.0, 0.0]))
@example(np.array([3.0, 0.0, 0.0, 20.0, -5.0, 1.0]))
@SEEDED
def test_left_jacobian_is_the_numerical_derivative(xi: Array) -> None:
    # Not nearer to pi than the steps of the numerical derivative.
    xi = xi * np.array([0.99, 0.99, 0.99, 1.0, 1.0, 1.0])
    T = gtsam.Pose3.Expmap(xi)

    def log_of_moved(d: Array) -> Array:
        return np.asarray(gtsam.Pose3.Logmap(gtsam.Pose3.Expmap(d).compose(T)))

    expected = numerical(log_of_moved)
    assert left_jacobian_inverse(xi) == pytest.approx(expected, rel=1e-5, abs=1e-4)


@given(tangents())
@SEEDED
def test_left_and_right_jacobian_differ_by_the_adjoint(xi: Array) -> None:
    # Exp(d) T = T Exp(Ad(T^-1) d).
    T = gtsam.Pose3.Expmap(xi)
    right = gtsam.Pose3.LogmapDerivative(T)
    expected = right @ T.inverse().AdjointMap()
    assert left_jacobian_inverse(xi) == pytest.approx(expected, rel=1e-6, abs=1e-5)


def test_vehicle_axes_of_a_lidar_turned_left() -> None:
    # Its x is the vehicle's y and its y the vehicle's -x.
    turned = pose((0.5, 0.9, 1.5), (0.0, 0.0, 90.0))
    d = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    in_vehicle_axes = right_to_vehicle_axes(turned) @ d
    assert in_vehicle_axes == pytest.approx([-2.0, 1.0, 3.0, -5.0, 4.0, 6.0])


@given(tangents(), tangents(metres=2.0))
@SEEDED
def test_right_perturbations_turn_into_vehicle_axes(a: Array, d: Array) -> None:
    T = gtsam.Pose3.Expmap(a)
    Q = right_to_vehicle_axes(T)
    np.testing.assert_allclose(Q @ Q.T, np.eye(6), atol=1e-9)
    small = 1e-5 * d
    moved = vehicle_axes_difference(T.retract(small), T)
    # To first order: what is left is of the size of small^2.
    assert moved == pytest.approx(Q @ small, abs=1e-8)


def test_joint_axes_of_several_lidars() -> None:
    # The first LiDAR looks to the left: its x is the vehicle's y.
    T = gtsam.Pose3(gtsam.Rot3.Yaw(math.pi / 2.0), np.zeros(3))
    cov = np.diag(np.arange(1.0, 13.0))

    axes = joint_right_to_vehicle_axes([T, gtsam.Pose3()])

    turned = np.diag(axes @ cov @ axes.T)
    assert turned[:6] == pytest.approx([2.0, 1.0, 3.0, 5.0, 4.0, 6.0])
    assert turned[6:] == pytest.approx(np.arange(7.0, 13.0))


def test_quaternions_end_with_the_scalar() -> None:
    rotation = gtsam.Rot3.RzRyRx(0.4, 0.0, 0.0)
    assert quaternion_xyzw(rotation) == pytest.approx((math.sin(0.2), 0.0, 0.0, math.cos(0.2)))


def test_difference_in_vehicle_axes_by_hand() -> None:
    # A yaw of 4 mrad about the vehicle's z and 10 mm along its x, of LiDARs that are pitched.
    moved = pose((2.01, 0.0, 2.0), (0.0, 10.0, math.degrees(0.004)))
    expected = [0.0, 0.0, 0.004, 0.01, 0.0, 0.0]
    assert vehicle_axes_difference(moved, FRONT) == pytest.approx(expected, abs=1e-12)
    moved = pose((-0.4, -0.02, 2.0), (0.0, 10.0, 180.0 + math.degrees(0.004)))
    expected = [0.0, 0.0, 0.004, 0.0, -0.02, 0.0]
    assert vehicle_axes_difference(moved, REAR) == pytest.approx(expected, abs=1e-12)


def test_retraction_in_vehicle_axes_turns_about_the_lidar() -> None:
    # The LiDAR's origin stays where it is; a quarter turn about the vehicle's z.
    turned = retract_vehicle_axes(FRONT, np.array([0.0, 0.0, math.pi / 2, 0.1, 0.2, 0.3]))
    assert turned.translation() == pytest.approx([2.1, 0.2, 2.3])
    expected = [[0.0, -1.0, 0.0], [COS_10, 0.0, SIN_10], [-SIN_10, 0.0, COS_10]]
    assert turned.rotation().matrix() == pytest.approx(np.array(expected), abs=1e-12)


@given(tangents(), tangents())
@example(np.zeros(6), np.array([0.0, NEAR_PI, 0.0, 1.0, 2.0, 3.0]))
@SEEDED
def test_difference_undoes_retraction(a: Array, d: Array) -> None:
    T = gtsam.Pose3.Expmap(a)
    moved = retract_vehicle_axes(T, d)
    assert vehicle_axes_difference(moved, T) == pytest.approx(d, abs=1e-6)
    assert retract_vehicle_axes(T, vehicle_axes_difference(moved, T)).equals(moved, 1e-8)


def test_stack_and_unstack_are_inverse() -> None:
    poses = [FRONT, REAR, gtsam.Pose3.Expmap(np.array([1.0, -2.0, 0.5, 3.0, 4.0, 5.0]))]
    R, t = stack(poses)
    assert R.shape == (3, 3, 3)
    point = np.array([1.0, 2.0, 3.0])
    for Ri, ti, T in zip(R, t, poses, strict=True):
        assert Ri @ point + ti == pytest.approx(T.transformFrom(point))
    for back, T in zip(unstack(R, t), poses, strict=True):
        assert back.equals(T, 1e-12)


def test_stack_of_nothing_keeps_its_shapes() -> None:
    R, t = stack([])
    assert R.shape == (0, 3, 3)
    assert t.shape == (0, 3)
    assert unstack(R, t) == ()


def test_unstack_mends_a_shear() -> None:
    rng = np.random.default_rng(4)
    R, t = stack([FRONT, REAR])
    (first, second) = unstack(R + 1e-5 * rng.normal(size=R.shape), t)
    for mended, true in ((first, FRONT), (second, REAR)):
        M = mended.rotation().matrix()
        np.testing.assert_allclose(M @ M.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(M) == pytest.approx(1.0)
        assert mended.equals(true, 1e-4)


def test_axes_across_directions_form_right_handed_frames() -> None:
    # By hand: of z the axis farthest is x; two rows of directions, as of any number.
    assert tangent_axes(np.array([0.0, 0.0, 1.0])).tolist() == [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]
    directions = np.random.default_rng(3).normal(size=(2, 50, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    frames = np.concatenate([tangent_axes(directions), directions[..., None, :]], axis=-2)
    np.testing.assert_allclose(
        frames @ np.swapaxes(frames, -1, -2), np.tile(np.eye(3), (2, 50, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(frames), np.ones((2, 50)), atol=1e-12)
    one_by_one = [[tangent_axes(direction) for direction in row] for row in directions]
    np.testing.assert_array_equal(one_by_one, frames[..., :2, :])
