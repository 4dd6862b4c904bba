"""The mean rates of a trajectory as functions of its poses."""

import itertools

import gtsam
import numpy as np
import pytest

from caliv_graph.products import Array
from caliv_graph.trajectory.rates import rate_rows, with_rates

STAMPS = np.array([0, 100, 130, 400, 900, 1000]) * 1_000_000


def driven(rng: np.random.Generator) -> list[gtsam.Pose3]:
    """Poses of a turn with changing velocities."""
    out = [gtsam.Pose3.Expmap(rng.uniform(-0.5, 0.5, 6))]
    for s in np.diff(STAMPS) * 1e-9:
        twist = np.array([0.0, 0.0, 0.3, 2.0, 0.0, 0.0]) + 0.05 * rng.standard_normal(6)
        out.append(out[-1].compose(gtsam.Pose3.Expmap(s * twist)))
    return out


def mean_rates(poses: list[gtsam.Pose3]) -> Array:
    steps = [gtsam.Pose3.Logmap(a.between(b)) for a, b in itertools.pairwise(poses)]
    return np.asarray(np.sum(steps, axis=0) / (STAMPS[-1] * 1e-9))


def turned(poses: list[gtsam.Pose3], i: int) -> Array:
    """(3, 3) what a turn of pose i changes of the mean of the velocities in vehicle axes."""
    out = np.zeros((3, 3))
    for k in (i - 1, i):
        if 0 <= k < len(poses) - 1:
            shift = gtsam.Pose3.Logmap(poses[k].between(poses[k + 1]))[3:]
            out += 0.5 * np.cross(shift, np.eye(3)).T
    return np.asarray(out / (STAMPS[-1] * 1e-9))


def test_rows_are_derivatives_of_the_mean_rates() -> None:
    poses = driven(np.random.default_rng(0))
    rows = rate_rows(STAMPS, poses)
    assert rows is not None
    for i in range(len(poses)):
        for k, d in enumerate(1e-6 * np.eye(6)):
            ahead, behind = list(poses), list(poses)
            ahead[i], behind[i] = poses[i].retract(d), poses[i].retract(-d)
            change = (mean_rates(ahead) - mean_rates(behind)) / 2e-6
            change[3:] -= turned(poses, i) @ d[:3] / 1e-6
            assert rows[:, 6 * i + k] == pytest.approx(change, abs=1e-6)


def test_a_constant_roll_on_an_arc_is_a_rate_of_pitch() -> None:
    """0.2 rad/s times 3 mrad. A constant pitch is one of roll; the velocity in the map stays."""
    arc = np.array([0.0, 0.0, 0.2, 2.0, 0.0, 0.0])
    stamps = np.arange(0, 20) * 500_000_000
    rows = rate_rows(stamps, [gtsam.Pose3.Expmap(1e-9 * s * arc) for s in stamps])
    assert rows is not None
    assert rows @ np.tile([3e-3, 0.0, 0.0, 0.0, 0.0, 0.0], 20) == pytest.approx(
        [0.0, 6e-4, 0.0, 0.0, 0.0, 0.0], abs=1e-9
    )
    assert rows @ np.tile([0.0, 3e-3, 0.0, 0.0, 0.0, 0.0], 20) == pytest.approx(
        [-6e-4, 0.0, 0.0, 0.0, 0.0, 0.0], abs=1e-9
    )


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
    assert all_cov[n:, n:] == pytest.approx(of_rates + np.diag([1e-10] * 3 + [1e-8] * 3), rel=1e-4)
    assert np.linalg.solve(joint, gradient)[:n] == pytest.approx(np.linalg.solve(H, b), rel=1e-4)
