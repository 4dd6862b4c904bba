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
    """(6, 3) what a turn of pose i changes of the mean of the rates in vehicle axes."""
    out = np.zeros((6, 3))
    for k in (i - 1, i):
        if 0 <= k < len(poses) - 1:
            step = gtsam.Pose3.Logmap(poses[k].between(poses[k + 1]))
            out += 0.5 * np.vstack([np.cross(part, np.eye(3)).T for part in (step[:3], step[3:])])
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
            change -= turned(poses, i) @ d[:3] / 1e-6
            assert rows[:, 6 * i + k] == pytest.approx(change, abs=1e-6)


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
        assert rows @ common == pytest.approx(np.zeros(6), abs=1e-9)


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
    assert all_cov[n:, n:] == pytest.approx(of_rates + np.diag([1e-10] * 3 + [1e-8] * 3), rel=1e-4)
    assert np.linalg.solve(joint, gradient)[:n] == pytest.approx(np.linalg.solve(H, b), rel=1e-4)
