"""The mean rates of a trajectory as functions of its poses."""

import gtsam
import numpy as np
import pytest

from caliv_graph.products import Array
from caliv_graph.trajectory.rates import (
    LEAST_TURNING_RAD_S,
    RATE_SIGMAS,
    RATES,
    rate_rows,
    with_rates,
)

STAMPS = np.array([0, 100, 130, 400, 900, 1000]) * 1_000_000


def driven(rng: np.random.Generator) -> list[gtsam.Pose3]:
    """Poses of a turn with changing velocities."""
    out = [gtsam.Pose3.Expmap(rng.uniform(-0.5, 0.5, 6))]
    for s in np.diff(STAMPS) * 1e-9:
        twist = np.array([0.0, 0.0, 0.3, 2.0, 0.0, 0.0]) + 0.05 * rng.standard_normal(6)
        out.append(out[-1].compose(gtsam.Pose3.Expmap(s * twist)))
    return out


def errors_of(before: list[gtsam.Pose3], after: list[gtsam.Pose3]) -> Array:
    """(RATES,) what fits the change of all rates best: least squares over time, by hand."""
    rows, changes = [], []
    for k, s in enumerate(np.diff(STAMPS) * 1e-9):
        then, now = (
            gtsam.Pose3.Logmap(poses[k].between(poses[k + 1])) / s for poses in (before, after)
        )
        turns = [gtsam.Pose3.Logmap(before[i].between(after[i]))[:3] for i in (k, k + 1)]
        turn = np.mean(turns, axis=0)
        follows = np.concatenate([np.cross(then[:3], turn), np.cross(then[3:], turn)])
        W = np.zeros((6, RATES))
        W[:, :6] = np.eye(6)
        W[3:, 6:] = [np.cross(then[:3], axis) for axis in np.eye(3)]
        W[3:, 6:] = W[3:, 6:].T
        rows.append(np.sqrt(s) * W)
        changes.append(np.sqrt(s) * (now - then - follows))
    total = np.sqrt(STAMPS[-1] * 1e-9)
    held = np.hstack([np.zeros((3, 6)), LEAST_TURNING_RAD_S * total * np.eye(3)])
    A = np.vstack([*rows, held])
    return np.asarray(np.linalg.lstsq(A, np.concatenate([*changes, np.zeros(3)]), rcond=None)[0])


def test_rows_are_derivatives_of_what_fits_the_rates() -> None:
    poses = driven(np.random.default_rng(0))
    rows = rate_rows(STAMPS, poses)
    assert rows is not None
    for i in range(len(poses)):
        for k, d in enumerate(1e-6 * np.eye(6)):
            ahead, behind = list(poses), list(poses)
            ahead[i], behind[i] = poses[i].retract(d), poses[i].retract(-d)
            change = (errors_of(poses, ahead) - errors_of(poses, behind)) / 2e-6
            assert rows[:, 6 * i + k] == pytest.approx(change, rel=1e-4, abs=1e-4)


def test_a_shift_of_the_origin_is_no_rate() -> None:
    """An antenna 1 cm further ahead: velocities change by omega x s, to both sides."""
    twists = [np.array([0.0, 0.0, turn, 2.0, 0.0, 0.0]) for turn in [0.3] * 10 + [-0.3] * 10]
    poses = [gtsam.Pose3()]
    for twist in twists:
        poses.append(poses[-1].compose(gtsam.Pose3.Expmap(0.5 * twist)))
    rows = rate_rows(np.arange(21) * 500_000_000, poses)
    assert rows is not None
    for s in (np.array([0.01, 0.0, 0.0]), np.array([0.0, -0.02, 0.0])):
        found = rows @ np.tile([0.0, 0.0, 0.0, *s], 21)
        assert found[:6] == pytest.approx(np.zeros(6), abs=1e-6)
        assert found[6:] == pytest.approx(s, rel=2e-3)
    # One of the map turns with the vehicle instead, and changes no velocity in the map.
    in_map = np.concatenate(
        [[0, 0, 0, *T.rotation().unrotate(np.array([0.01, 0, 0]))] for T in poses]
    )
    assert rows @ in_map == pytest.approx(np.zeros(RATES), abs=2e-4)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_turn_of_the_vehicle_frame_leaves_the_rates_in_the_map(way: float) -> None:
    """A roll of 3 mrad at 0.2 rad/s is a rate of pitch of 0.6 mrad/s, and of -0.6 in the other
    curve: no mean rate is both, so that it follows from each pose by itself."""
    twists = [np.array([0.0, 0.0, turn, 2.0, 0.0, 0.0]) for turn in [0.2] * 10 + [0.2 * way] * 10]
    poses = [gtsam.Pose3()]
    for twist in twists:
        poses.append(poses[-1].compose(gtsam.Pose3.Expmap(0.5 * twist)))
    rows = rate_rows(np.arange(21) * 500_000_000, poses)
    assert rows is not None
    for turn in 3e-3 * np.eye(3):
        common = np.tile([*turn, 0.0, 0.0, 0.0], 21)
        assert rows @ common == pytest.approx(np.zeros(RATES), abs=1e-9)


def test_a_turn_about_a_pivot_leaves_the_rates_that_are_turned_about_it() -> None:
    """As structure turns them, about the IMU: its origin moves, which is no shift on the body."""
    pivot = np.array([1.8, 0.2, 0.3])
    poses = driven(np.random.default_rng(2))
    rows = rate_rows(STAMPS, poses, pivot)
    usual = rate_rows(STAMPS, poses)
    assert rows is not None
    assert usual is not None
    for turn in np.eye(3):
        common = np.tile([*turn, *np.cross(pivot, turn)], len(poses))
        assert rows @ common == pytest.approx(np.zeros(RATES), abs=1e-9)
        assert np.abs(usual @ common)[6:].max() > 0.1


def test_a_gyroscope_that_is_off_is_a_rate() -> None:
    """Poses that turn by 1 mrad/s more about y than those of the trajectory, for a second."""
    arc = np.array([0.0, 0.0, 0.2, 2.0, 0.0, 0.0])
    stamps = np.arange(3) * 500_000_000
    poses = [gtsam.Pose3.Expmap(1e-9 * s * arc) for s in stamps]
    faster = arc + np.array([0.0, 1e-3, 0.0, 0.0, 0.0, 0.0])
    off = [gtsam.Pose3.Expmap(1e-9 * s * faster) for s in stamps]
    d = np.concatenate([T.localCoordinates(U) for T, U in zip(poses, off, strict=True)])
    rows = rate_rows(stamps, poses)
    assert rows is not None
    # A pitch of 0.5 mrad in the mean, at 0.2 rad/s: a rate of roll of -0.1 mrad/s would be a turn
    # of the poses, and there is none.
    assert (rows @ d)[:3] == pytest.approx([1e-4, 1e-3, 0.0], abs=1e-5)


def test_poses_that_are_far_apart_tell_no_rates() -> None:
    turned = [gtsam.Pose3(), gtsam.Pose3(gtsam.Rot3.Yaw(1.2), np.zeros(3))]
    assert rate_rows([0, 1_000_000_000], turned) is None
    assert rate_rows([0], turned[:1]) is None


def test_rates_follow_from_the_poses_and_say_nothing_of_them() -> None:
    rng = np.random.default_rng(1)
    poses = driven(rng)
    rows = rate_rows(STAMPS, poses)
    assert rows is not None
    n = 6 * len(poses) + 3
    root = 1e2 * rng.standard_normal((n, n))
    H, b = root @ root.T, rng.standard_normal(n)
    joint, gradient = with_rates(H, b, rows)
    cov = np.linalg.inv(H)
    all_cov = np.linalg.inv(joint)
    scale = np.sqrt(np.diag(cov))
    assert all_cov[:n, :n] / np.outer(scale, scale) == pytest.approx(
        cov / np.outer(scale, scale), abs=1e-6
    )
    of_rates = rows @ cov[: n - 3, : n - 3] @ rows.T
    assert all_cov[n:, n:] == pytest.approx(of_rates + np.diag(np.square(RATE_SIGMAS)), rel=1e-4)
    assert np.linalg.solve(joint, gradient)[:n] == pytest.approx(np.linalg.solve(H, b), rel=1e-4)
