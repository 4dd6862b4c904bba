"""Poses between given poses are those of the motion, not of a chord."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caliv_graph.geometry.interpolation import PoseCurve
from caliv_graph.products import Array

RADIUS_M, SPEED_M_S = 8.0, 4.0  # 2 m/s^2 across


def circle(seconds: Array) -> tuple[Array, Array]:
    """Poses of a vehicle that drives in a circle, its nose along it."""
    angle = SPEED_M_S / RADIUS_M * seconds
    t = RADIUS_M * np.stack([np.sin(angle), 1.0 - np.cos(angle), 0.0 * angle], axis=1)
    return Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0]).as_matrix(), t


def turns_between(R_a: Array, R_b: Array) -> Array:
    """(n,) angles between rotations, rad."""
    apart = Rotation.from_matrix(np.swapaxes(R_a, 1, 2) @ R_b)
    return np.asarray(apart.magnitude())


# A chord cuts a T^2 / 8: 2.5 and 10 mm.
@pytest.mark.parametrize(("period_s", "most_m"), [(0.1, 2e-5), (0.2, 2e-4)])
def test_a_circle_is_not_cut(period_s: float, most_m: float) -> None:
    at = np.linspace(0.0, 6.0, 991)
    seconds = np.arange(0.0, 6.0 + period_s, period_s)
    R, t = PoseCurve(seconds, *circle(seconds)).at(at)
    R_true, t_true = circle(at)
    inside = (at > period_s) & (at < 6.0 - period_s)
    assert np.abs(t - t_true)[inside].max() < most_m
    assert np.abs(t - t_true).max() < 10.0 * most_m  # first and last piece: one neighbour
    assert turns_between(R, R_true).max() < 1e-9


def test_it_goes_through_its_poses_however_they_are_spaced() -> None:
    rng = np.random.default_rng(1)
    seconds = np.cumsum(rng.uniform(0.05, 0.15, 40))
    R, t = circle(seconds)
    R_found, t_found = PoseCurve(seconds, R, t).at(seconds)
    assert np.abs(t_found - t).max() < 1e-12
    assert np.abs(R_found - R).max() < 1e-12


def test_unequal_pieces_of_one_acceleration_and_angular_acceleration_are_exact() -> None:
    seconds = np.array([0.0, 0.1, 0.25, 0.32, 0.48])
    at = np.linspace(0.0, 0.48, 97)

    def motion(s: Array) -> tuple[Array, Array]:
        turn = (0.3 * s + 0.8 * s**2)[:, None] * np.array([0.6, 0.0, 0.8])
        place = np.outer(s, [3.0, 0.0, 0.1]) + np.outer(s**2, [0.5, 2.0, -1.0])
        return Rotation.from_rotvec(turn).as_matrix(), place

    R, t = PoseCurve(seconds, *motion(seconds)).at(at)
    R_true, t_true = motion(at)
    assert np.abs(t - t_true).max() < 1e-12
    assert turns_between(R, R_true).max() < 1e-9


def test_velocities_are_continuous_at_poses_whatever_the_axes_of_the_turns() -> None:
    seconds = np.linspace(0.0, 2.0, 11)
    turn = np.stack([0.2 * np.sin(2 * seconds), 0.3 * np.cos(seconds), 0.9 * seconds], axis=1)
    place = np.stack([np.sin(seconds), np.cos(2 * seconds), seconds], axis=1)
    found = PoseCurve(seconds, Rotation.from_rotvec(turn).as_matrix(), place)
    step = 1e-6
    for knot in seconds[1:-1]:
        R, t = found.at(np.array([knot - step, knot, knot + step]))
        assert (t[2] - t[1]) / step == pytest.approx((t[1] - t[0]) / step, abs=1e-4)
        before, after = (
            Rotation.from_matrix(R[a].T @ R[b]).as_rotvec() / step for a, b in ((0, 1), (1, 2))
        )
        # The change of a rotation vector by a rate is taken to its second order.
        assert after == pytest.approx(before, abs=1e-4)


def test_curves_are_not_cut_beside_noise_either() -> None:
    """Noise of 5 mm has accelerations of metres per second squared at 10 Hz: no jumps."""
    rng = np.random.default_rng(5)
    seconds = np.arange(0.0, 400.0, 0.1)
    R, t = circle(seconds)
    _, found = PoseCurve(seconds, R, t + rng.normal(0.0, 0.005, t.shape)).at(seconds[5:-5] + 0.05)
    centre = np.array([0.0, RADIUS_M])
    outside = np.linalg.norm(found[:, :2] - centre, axis=1) - RADIUS_M
    assert outside.mean() == pytest.approx(0.0, abs=3e-4)  # a chord: -2.5 mm; of 4000: 0.06


@pytest.mark.parametrize(("period_s", "jump"), [(0.1, 0.02), (0.2, 0.1), (0.5, 1.3)])
def test_a_jump_of_the_poses_bends_no_piece_beside_it(period_s: float, jump: float) -> None:
    """Of fixes that lose their ambiguities, or a map that is corrected; by metres and by radians.

    Twice the jump over the square of a period is the change of acceleration: 20 per second of it.
    """
    seconds = period_s * np.arange(20.0)
    place = np.outer(seconds, [4.0, 0.0, 0.0])
    place[10:, 1] += jump
    turn = np.zeros((20, 3))
    turn[10:, 2] = jump
    at = period_s * np.array([8.5, 10.5])
    R, t = PoseCurve(seconds, Rotation.from_rotvec(turn).as_matrix(), place).at(at)
    assert t[:, 1] == pytest.approx([0.0, jump], abs=1e-12)
    assert Rotation.from_matrix(R).as_rotvec()[:, 2] == pytest.approx([0.0, jump], abs=1e-9)

    # Half of it might be motion: it bends its neighbours, by a sixteenth of it.
    place[10:, 1] -= 0.6 * jump
    _, t = PoseCurve(seconds, np.tile(np.eye(3), (20, 1, 1)), place).at(at)
    assert t[0, 1] == pytest.approx(-0.4 * jump / 16.0, rel=1e-6)


def test_noise_of_poses_is_not_made_larger_in_a_gap_between_them() -> None:
    """Velocities from steps of 20 ms, times 0.3 s of a gap, would be many times the noise."""
    rng = np.random.default_rng(3)
    seconds = np.concatenate([np.arange(0.0, 1.0, 0.02), np.arange(1.28, 2.0, 0.02)])
    place = rng.normal(0.0, 0.003, (len(seconds), 3))
    gap = np.linspace(0.98, 1.28, 31)
    _, t = PoseCurve(seconds, np.tile(np.eye(3), (len(seconds), 1, 1)), place).at(gap)
    ends = place[[49, 50]]
    assert (t <= ends.max(axis=0) + 1e-12).all()
    assert (t >= ends.min(axis=0) - 1e-12).all()


def test_white_noise_between_poses_is_smaller_than_at_them() -> None:
    rng = np.random.default_rng(4)
    seconds = np.arange(0.0, 200.0, 0.1)
    place = rng.normal(0.0, 0.003, (len(seconds), 3))
    middle = seconds[5:-5] + 0.05
    _, t = PoseCurve(seconds, np.tile(np.eye(3), (len(seconds), 1, 1)), place).at(middle)
    # Weights of -1, 9, 9, -1 sixteenths, against two halves of a chord.
    assert t.std() == pytest.approx(0.003 * np.sqrt(164.0) / 16.0, rel=0.03)


def test_two_poses_are_a_straight_line() -> None:
    seconds = np.array([0.0, 1.0])
    turn = np.array([[0.0, 0.0, 0.0], [0.0, 0.4, 0.0]])
    found = PoseCurve(seconds, Rotation.from_rotvec(turn).as_matrix(), np.eye(2, 3))
    R, t = found.at(np.array([0.25]))
    assert t[0] == pytest.approx([0.75, 0.25, 0.0])
    assert Rotation.from_matrix(R[0]).as_rotvec() == pytest.approx([0.0, 0.1, 0.0])
