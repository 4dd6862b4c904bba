"""Weights of every kernel by numbers worked out by hand."""

from __future__ import annotations

import math
from typing import get_args

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import chi2

from caliv_graph.calibration.kernels import DOF, GNC_FACTOR, KERNELS
from caliv_graph.calibration.robust import (
    MIN_WEIGHT,
    RobustWeights,
    deletion_squares,
    own_blocks,
    weighted_joint,
)
from caliv_graph.config.model import RobustConfig, RobustKernel
from caliv_graph.products import Array

SQUARED = np.array([0.0, 1.0, 6.0, 12.0, 54.0, 600.0])


def settle(weights: RobustWeights, squared: Array, rounds: int = 100) -> int:
    """Updates until the kernel has its final shape; the number of rounds it took."""
    for done in range(1, rounds + 1):
        change = weights.update(squared)
        if weights.kernel.settled and change == 0.0:
            return done
    raise AssertionError(f"not settled after {rounds} rounds")


def test_all_clouds_count_fully_at_first() -> None:
    weights = RobustWeights(RobustConfig(), 4)
    assert weights.values.tolist() == [1.0] * 4


def test_without_a_kernel_all_clouds_count() -> None:
    weights = RobustWeights(RobustConfig(kernel="none"), 6)
    assert weights.update(SQUARED) == 0.0
    assert weights.values.tolist() == [1.0] * 6
    assert weights.kernel.settled


def test_huber_by_hand() -> None:
    # It bends at 1.5 sqrt(6) = 3.674, that is at a square of 13.5; beyond, 3.674 / |r|:
    # 3.674 / 7.348 and 3.674 / 24.49.
    weights = RobustWeights(RobustConfig(kernel="huber"), 6)
    change = weights.update(SQUARED)
    assert weights.values == pytest.approx([1.0, 1.0, 1.0, 1.0, 0.5, 0.15])
    assert change == pytest.approx(0.85)
    assert weights.kernel.settled
    assert weights.update(SQUARED) == 0.0


def test_huber_bends_where_the_config_says() -> None:
    weights = RobustWeights(RobustConfig(kernel="huber", huber_k=1.0), 2)
    # At sqrt(6): a square of 24 is twice that.
    weights.update(np.array([5.9, 24.0]))
    assert weights.values == pytest.approx([1.0, 0.5])


@pytest.mark.parametrize(
    ("clouds", "percent", "dropped"),
    [(20, 10.0, 2), (100, 10.0, 10), (136, 10.0, 13), (40, 25.0, 10), (9, 10.0, 0), (20, 0.0, 0)],
)
def test_trimmed_drops_exactly_the_worst(clouds: int, percent: float, dropped: int) -> None:
    weights = RobustWeights(RobustConfig(kernel="trimmed", trim_percent=percent), clouds)
    squared = np.random.default_rng(clouds).permutation(np.arange(1.0, clouds + 1.0))
    weights.update(squared)
    np.testing.assert_array_equal(weights.values < 0.5, squared > clouds - dropped)
    assert set(weights.values.tolist()) <= {1.0, MIN_WEIGHT}


def test_trimmed_chooses_anew_every_round() -> None:
    weights = RobustWeights(RobustConfig(kernel="trimmed", trim_percent=25.0), 4)
    weights.update(np.array([1.0, 2.0, 9.0, 3.0]))
    assert weights.values.round(3).tolist() == [1.0, 1.0, 0.0, 1.0]
    assert weights.update(np.array([9.0, 2.0, 1.0, 3.0])) == pytest.approx(1.0, abs=1e-5)
    assert weights.values.round(3).tolist() == [0.0, 1.0, 1.0, 1.0]


def test_trimmed_drops_one_of_equals_only() -> None:
    weights = RobustWeights(RobustConfig(kernel="trimmed", trim_percent=10.0), 20)
    weights.update(np.ones(20))
    assert int((weights.values < 0.5).sum()) == 2


def test_tls_starts_by_the_formula_of_graduated_non_convexity() -> None:
    # Yang et al. 2020: with c^2 = 22.46, mu = c^2 / (2 max r^2 - c^2); then the weight is
    # c sqrt(mu (mu + 1)) / |r| - mu, one below and zero above it.
    config = RobustConfig(kernel="tls")
    c2 = float(chi2.isf(0.001, DOF))
    assert c2 == pytest.approx(22.458, abs=1e-3)
    weights = RobustWeights(config, 3)
    weights.update(np.array([1.0, 50.0, 100.0]))
    mu = 22.458 / (200.0 - 22.458)
    middle = math.sqrt(22.458 / 50.0 * mu * (mu + 1.0)) - mu
    last = math.sqrt(22.458 / 100.0 * mu * (mu + 1.0)) - mu
    assert weights.values == pytest.approx([1.0, middle, last], abs=1e-4)
    # At first nobody is dropped: the surrogate is convex.
    assert 0.0 < last < middle < 1.0
    assert not weights.kernel.settled
    weights.update(np.array([1.0, 50.0, 100.0]))
    mu *= GNC_FACTOR
    middle = math.sqrt(22.458 / 50.0 * mu * (mu + 1.0)) - mu
    assert weights.values[1] == pytest.approx(middle, abs=1e-4)


@pytest.mark.parametrize("worst", [30.0, 1e3, 1e6])
def test_tls_ends_at_a_hard_cut(worst: float) -> None:
    c2 = float(chi2.isf(0.001, DOF))
    squared = np.array([0.1, 6.0, c2 - 0.01, c2 + 0.01, 30.0, worst])
    weights = RobustWeights(RobustConfig(kernel="tls"), 6)
    settle(weights, squared)
    assert weights.values.tolist() == [1.0, 1.0, 1.0] + [MIN_WEIGHT] * 3


def test_tls_is_graduated_over_many_rounds() -> None:
    # From mu = 22.46 / (2 x 100 - 22.46) = 0.126 to 1000 by factors of 1.4: 27 rounds.
    weights = RobustWeights(RobustConfig(kernel="tls"), 3)
    squared = np.array([1.0, 22.6, 100.0])
    for _ in range(20):
        weights.update(squared)
    assert not weights.kernel.settled
    # By then the cut is hard but for what is right at it: r^2 / c^2 = 1.006.
    assert 0.1 < weights.values[1] < 0.9
    assert weights.values[2] == MIN_WEIGHT
    assert 26 <= 20 + settle(weights, squared) <= 30


def test_tls_takes_clouds_back_in_that_fit_in_the_end() -> None:
    weights = RobustWeights(RobustConfig(kernel="tls"), 3)
    settle(weights, np.array([1.0, 2.0, 500.0]))
    assert weights.values[2] == MIN_WEIGHT
    weights.update(np.array([1.0, 2.0, 5.0]))
    assert weights.values.tolist() == [1.0] * 3


def test_tls_without_outliers_is_over_at_once() -> None:
    weights = RobustWeights(RobustConfig(kernel="tls"), 3)
    assert weights.update(np.array([1.0, 6.0, 11.0])) == 0.0
    assert weights.kernel.settled
    assert weights.values.tolist() == [1.0] * 3


def test_tls_cuts_where_the_config_says() -> None:
    weights = RobustWeights(RobustConfig(kernel="tls", tls_p_value=0.1), 2)
    c2 = float(chi2.isf(0.1, DOF))
    settle(weights, np.array([c2 - 0.1, c2 + 20.0]))
    assert weights.values.tolist() == [1.0, MIN_WEIGHT]


@pytest.mark.parametrize("kernel", ["huber", "tls", "trimmed", "none"])
def test_order_of_the_clouds_does_not_matter(kernel: str) -> None:
    rng = np.random.default_rng(3)
    squared = rng.chisquare(DOF, 50) * np.where(rng.random(50) < 0.2, 40.0, 1.0)
    order = rng.permutation(50)
    config = RobustConfig.model_validate({"kernel": kernel})
    first, second = RobustWeights(config, 50), RobustWeights(config, 50)
    for _ in range(60):
        first.update(squared)
        second.update(squared[order])
    assert second.values == pytest.approx(first.values[order])
    assert (first.values > 0.0).all()


def test_gross_outliers_lose_their_say_under_every_kernel_that_has_a_cut() -> None:
    # The mean of ten clouds at 0 and two at 100: 16.7 without a kernel.
    position = np.array([0.0] * 10 + [100.0] * 2)
    means = {}
    for kernel in ("none", "huber", "tls", "trimmed"):
        config = RobustConfig.model_validate({"kernel": kernel, "trim_percent": 20.0})
        weights = RobustWeights(config, 12)
        for _ in range(60):
            mean = float(weights.values @ position / weights.values.sum())
            weights.update((position - mean) ** 2)
        means[kernel] = mean
    assert means["none"] == pytest.approx(100.0 / 6.0)
    assert means["huber"] < 1.0
    assert means["tls"] < 1e-3
    assert means["trimmed"] < 1e-3


def shared_shape(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    """Blocks (J, 6, 6), and their joint information (6 J, 6 J) about a shape with a free place."""
    roots = rng.normal(size=(count, 6, 6))
    blocks = roots @ np.swapaxes(roots, 1, 2) + np.eye(6)
    pull = np.vstack(list(blocks))
    return blocks, block_diag(*blocks) - pull @ np.linalg.solve(blocks.sum(axis=0), pull.T)


def test_a_weight_is_that_part_of_a_cloud_s_own_information() -> None:
    blocks, _ = shared_shape(np.random.default_rng(1), 3)
    weights = np.array([1.0, 0.3, 1e-6])
    found = weighted_joint(block_diag(*blocks), weights)
    assert found == pytest.approx(block_diag(*(blocks * weights[:, None, None])), abs=1e-7)


def test_a_weight_is_that_part_of_what_the_others_let_a_cloud_say() -> None:
    # With all others held; the shape takes a good part of what it says by itself.
    _, H = shared_shape(np.random.default_rng(4), 4)
    own = np.r_[6:12]
    found = weighted_joint(H, np.array([1.0, 0.2, 1.0, 1.0]))
    expected = 0.2 * H[np.ix_(own, own)]
    assert found[np.ix_(own, own)] == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_a_cloud_without_weight_is_free() -> None:
    _, H = shared_shape(np.random.default_rng(2), 4)
    found = weighted_joint(H, np.array([1.0, 1.0, 0.0, 1.0]))
    kept, free = np.r_[0:12, 18:24], np.r_[12:18]
    left = H[np.ix_(kept, free)] @ np.linalg.solve(H[np.ix_(free, free)], H[np.ix_(free, kept)])
    assert found[np.ix_(kept, kept)] == pytest.approx(H[np.ix_(kept, kept)] - left, abs=1e-5)
    assert np.abs(found[free]).max() < 1e-4


@pytest.mark.parametrize("seed", range(3))
def test_weights_say_nothing_of_a_common_motion(seed: int) -> None:
    # Else the frame of the target is tied by a little, and moves by metres along it.
    rng = np.random.default_rng(seed)
    _, H = shared_shape(rng, 5)
    common = np.tile(np.eye(6), (5, 1))
    assert np.abs(H @ common).max() < 1e-9
    for weights in (rng.uniform(0.0, 1.0, 5), np.ones(5), 1.0 - 1e-4 * rng.uniform(size=5)):
        found = weighted_joint(H, weights)
        assert np.abs(found @ common).max() < 1e-6
        assert found == pytest.approx(found.T, abs=1e-9)
        assert np.linalg.eigvalsh(found).min() > -1e-7
        # No more than without weights.
        assert np.linalg.eigvalsh(H - found).min() > -1e-7


def least_squares(
    A: Array, H: Array, y: Array, free: tuple[int, ...] = ()
) -> tuple[float, Array, Array]:
    """Least sum of squares of `y - A x`, the clouds of `free` left out, and W and v there."""
    every = np.eye(len(y))
    A = np.hstack([A, *(every[:, 6 * j : 6 * j + 6] for j in free)])
    r = y - A @ np.linalg.lstsq(np.linalg.cholesky(H).T @ A, np.linalg.cholesky(H).T @ y)[0]
    W = H - H @ A @ np.linalg.pinv(A.T @ H @ A) @ A.T @ H
    return float(r @ H @ r), W, H @ r


def correlated(rng: np.random.Generator, count: int) -> Array:
    """(6 J, 6 J) information of clouds that share errors."""
    root = rng.normal(size=(6 * count, 12 * count)) / count
    return np.asarray(root @ root.T + 0.5 * np.eye(6 * count))


def test_a_cloud_s_square_is_what_the_fit_gains_without_it() -> None:
    rng = np.random.default_rng(1)
    H, A = correlated(rng, 5), rng.normal(size=(30, 8))
    y = rng.normal(size=30)
    whole, W, v = least_squares(A, H, y)
    found, freedom = deletion_squares(W, v, own_blocks(H))
    assert freedom.tolist() == [6] * 5
    for j in range(5):
        assert found[j] == pytest.approx(whole - least_squares(A, H, y, (j,))[0], rel=1e-6)


def test_squares_of_good_clouds_have_six_degrees_of_freedom() -> None:
    rng = np.random.default_rng(2)
    H, A = correlated(rng, 10), rng.normal(size=(60, 8))
    root = np.linalg.cholesky(np.linalg.inv(H))
    found = []
    for _ in range(300):
        _, W, v = least_squares(A, H, root @ rng.normal(size=60))
        found.append(deletion_squares(W, v, own_blocks(H))[0])
    # 3000 of them, those of one draw correlated; the standard error would be 0.06 without.
    assert np.mean(found) == pytest.approx(6.0, abs=0.3)
    assert np.mean(np.array(found) > chi2.isf(0.01, 6)) == pytest.approx(0.01, abs=0.005)


def test_of_a_cloud_that_nothing_controls_nothing_is_said() -> None:
    # The last cloud has a place of its own to be free in; the first has two coordinates of it.
    rng = np.random.default_rng(3)
    H, A = correlated(rng, 4), rng.normal(size=(24, 5))
    A = np.hstack([A, np.eye(24)[:, [0, 1, 18, 19, 20, 21, 22, 23]]])
    y = 100.0 * rng.normal(size=24)
    whole, W, v = least_squares(A, H, y)
    found, freedom = deletion_squares(W, v, own_blocks(H))
    assert freedom.tolist() == [4, 6, 6, 0]
    assert found[3] == 0.0
    assert found[0] == pytest.approx(whole - least_squares(A, H, y, (0,))[0], rel=1e-6)


def test_along_what_a_cloud_does_not_say_it_is_not_judged() -> None:
    # A drum: turns about its axis are taken out of what each cloud says, all but rounding.
    rng = np.random.default_rng(6)
    H, A = correlated(rng, 4), rng.normal(size=(24, 3))
    turns = np.kron(np.eye(4), np.array([0.1, -0.2, 1.0, 0.5, 0.0, 0.3])[:, None])
    H = H - H @ turns @ np.linalg.solve(turns.T @ H @ turns, turns.T @ H)
    A, y = np.hstack([A, turns]), rng.normal(size=24)
    r = y - A @ np.linalg.pinv(A.T @ H @ A, rcond=1e-9) @ A.T @ H @ y
    W = H - H @ A @ np.linalg.pinv(A.T @ H @ A, rcond=1e-9) @ A.T @ H
    found, freedom = deletion_squares(W, H @ r, own_blocks(H))
    assert freedom.tolist() == [5] * 4
    for j in range(4):
        B = np.hstack([A, np.eye(24)[:, 6 * j : 6 * j + 6]])
        left = y - B @ np.linalg.pinv(B.T @ H @ B, rcond=1e-9) @ B.T @ H @ y
        assert found[j] == pytest.approx(r @ H @ r - left @ H @ left, rel=1e-5)


def off_together(seed: int) -> tuple[Array, Array, Array]:
    """Twenty clouds of which three lie in the same wrong place, and pull others along."""
    rng = np.random.default_rng(seed)
    H, A = correlated(rng, 20), rng.normal(size=(120, 12))
    y = np.linalg.cholesky(np.linalg.inv(H)) @ rng.normal(size=120)
    y.reshape(20, 6)[[4, 5, 6]] += 60.0 * rng.normal(size=6)
    return A, H, y


@pytest.mark.parametrize("seed", range(5))
def test_the_worst_is_dropped_before_the_others_are_judged(seed: int) -> None:
    A, H, y = off_together(seed)
    _, W, v = least_squares(A, H, y)
    at_once = RobustWeights(RobustConfig(), 20)
    at_once.update(deletion_squares(W, v, own_blocks(H))[0])
    assert (at_once.values < 0.5).sum() > 3
    weights = RobustWeights(RobustConfig(), 20)
    kept = weights.snoop(W, v, own_blocks(H))
    assert np.flatnonzero(~kept).tolist() == [4, 5, 6]
    np.testing.assert_array_equal(weights.values[[4, 5, 6]], MIN_WEIGHT)
    # The others have the weights of their squares without the three.
    _, W, v = least_squares(A, H, y, (4, 5, 6))
    alone = RobustWeights(RobustConfig(), 20)
    alone.update(deletion_squares(W, v, own_blocks(H))[0])
    assert weights.values[kept] == pytest.approx(alone.values[kept], rel=1e-6)


def test_half_of_the_clouds_are_never_taken_for_wrong() -> None:
    rng = np.random.default_rng(4)
    H, A = correlated(rng, 20), rng.normal(size=(120, 12))
    _, W, v = least_squares(A, H, 1000.0 * rng.normal(size=120))
    assert RobustWeights(RobustConfig(), 20).snoop(W, v, own_blocks(H)).sum() == 10


@pytest.mark.parametrize(("kernel", "kept"), [("none", 20), ("tls", 17), ("trimmed", 17)])
def test_other_kernels_drop_what_they_say_they_drop(kernel: str, kept: int) -> None:
    A, H, y = off_together(0)
    _, W, v = least_squares(A, H, y)
    config = RobustConfig.model_validate({"kernel": kernel, "trim_percent": 15.0})
    weights = RobustWeights(config, 20)
    for _ in range(60):
        found = weights.snoop(W, v, own_blocks(H))
    assert found.sum() == kept
    assert np.flatnonzero(weights.values > 0.5).tolist() == np.flatnonzero(found).tolist()
    explained = np.linspace(0.0, 1.0, 20)
    weights.snoop(W, v, own_blocks(H), explained)
    expected = 1.0 if kernel == "none" else explained
    assert weights.values[found] == pytest.approx(
        np.broadcast_to(np.maximum(expected, MIN_WEIGHT), 20)[found]
    )


def test_every_kernel_of_the_config_is_there() -> None:
    assert set(KERNELS) == set(get_args(RobustKernel))
