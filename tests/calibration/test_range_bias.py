"""Biases of ranges: eliminated as variables would be, their size found where they contradict."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag

from caliv_graph.calibration.graph import pose_graph
from caliv_graph.calibration.linear import linearise_clouds
from caliv_graph.calibration.range_bias import (
    LEAST_BIAS_M,
    TYPICAL_BIAS_M,
    bias_directions,
    fit_bias_sigma,
    without_bias,
)
from caliv_graph.calibration.reduced import Reduced, reduce_to_extrinsics
from caliv_graph.products import Array, PoseNoise, TargetCloud, TargetObservation
from caliv_graph.registration.register import JointRegistration
from tests.calibration.problems import Case, make_case
from tests.registration.scenes import (
    config_of,
    looking_at_target,
    matrices,
    rectangle_points,
    seen_from,
)

# ------------------------------------------------------------------ eliminating them


def quadratic(clouds: int, seed: int) -> tuple[Array, Array]:
    """A positive definite (6 J, 6 J) and a gradient (6 J,)."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6 * clouds, 8 * clouds))
    return root @ root.T, rng.normal(size=6 * clouds)


def any_directions(clouds: int, biases: int, seed: int) -> Array:
    return np.random.default_rng(seed).normal(size=(6 * clouds, biases))


def test_biases_are_eliminated_as_variables_are() -> None:
    # The clouds move by d + D b, b of sigma 0.3: minimised over b, for any d.
    H, gradient = quadratic(3, 1)
    D = any_directions(3, 2, 2)
    sigma_m = 0.3
    both = np.hstack([np.eye(18), D])
    full = both.T @ H @ both + block_diag(np.zeros((18, 18)), np.eye(2) / sigma_m**2)
    pull = both.T @ gradient
    follows = np.linalg.solve(full[18:, 18:], np.column_stack([full[18:, :18], pull[18:]]))
    expected = full[:18, :18] - full[:18, 18:] @ follows[:, :18]
    found, found_gradient = without_bias(H, gradient, D, sigma_m)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(
        found_gradient, pull[:18] - full[:18, 18:] @ follows[:, 18], atol=1e-9
    )


def test_eliminated_biases_add_to_the_covariance() -> None:
    # Woodbury: the poses are known by the clouds and by what the biases move them by, added.
    H, gradient = quadratic(2, 3)
    D = any_directions(2, 2, 4)
    less, _ = without_bias(H, gradient, D, 0.5)
    np.testing.assert_allclose(np.linalg.inv(less), np.linalg.inv(H) + 0.25 * D @ D.T, atol=1e-9)
    assert np.linalg.eigvalsh(H - less).min() > -1e-9


def test_biases_that_do_not_exist_change_nothing() -> None:
    H, gradient = quadratic(2, 5)
    found, found_gradient = without_bias(H, gradient, any_directions(2, 3, 6), 1e-9)
    np.testing.assert_allclose(found, H, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found_gradient, gradient, rtol=1e-9, atol=1e-9)


def test_nothing_is_known_along_a_bias_that_may_be_any() -> None:
    H, gradient = quadratic(2, 7)
    D = any_directions(2, 1, 8)
    found, found_gradient = without_bias(H, gradient, D, 1e6)
    assert (D.T @ found @ D)[0, 0] == pytest.approx(0.0, abs=1e-6)
    assert (D.T @ found_gradient)[0] == pytest.approx(0.0, abs=1e-6)


# ------------------------------------------------------------------ directions


def placement(number: int, names: tuple[str, ...]) -> tuple[JointRegistration, tuple[Array, Array]]:
    """A small plate, seen by the named LiDARs from about it, and the poses of the clouds."""
    rng = np.random.default_rng(number)
    clouds, poses = [], []
    for j, name in enumerate(names):
        T = looking_at_target(40.0 * number + 12.0 * j, 6.0 + j)
        corner = np.array([0.0, -0.1, -0.1])
        plate = rectangle_points(rng, 40, corner, np.array([0, 0.2, 0]), np.array([0, 0, 0.2]))
        clouds.append(TargetCloud(name, 0, j, seen_from(T, plate, 0.0, rng), f"{j}.pcd"))
        poses.append(T)
    observation = TargetObservation(number, f"target_{number}", np.zeros(3), tuple(clouds))
    return JointRegistration(observation, config_of()), matrices(poses)


def test_a_bias_moves_the_clouds_of_one_lidar_and_placement_along_their_beams() -> None:
    names = [("front", "rear", "front"), ("rear", "front", "rear", "left")]
    states, poses = zip(*[placement(m, n) for m, n in enumerate(names)], strict=True)
    directions = bias_directions(states, poses)
    # Two LiDARs at the first target, three at the second; numbered as they come.
    assert directions.shape == (6 * 7, 2 + 3)
    column = [0, 1, 0, 2, 3, 2, 4]
    by_cloud = directions.reshape(7, 6, 5)
    t = np.concatenate([t for _, t in poses])
    for j, own in enumerate(column):
        other = np.delete(by_cloud[j], own, axis=1)
        assert not other.any()
        # No turn; from the sensor to the plate in the middle, whose beams spread by a degree.
        assert not by_cloud[j, :3].any()
        beam = by_cloud[j, 3:, own]
        assert np.linalg.norm(beam) == pytest.approx(1.0, abs=1e-3)
        assert beam == pytest.approx(-t[j] / np.linalg.norm(t[j]), abs=0.01)


# ------------------------------------------------------------------ their size


NOISE = PoseNoise(1e-5, 1e-4, 1e-5, 1e-4, 4.0)
"""Of given poses that contradict nothing: what is found is of the clouds."""


def directions_of(case: Case) -> Array:
    """As `bias_directions`, of clouds that have poses and no points."""
    problem = case.problem
    out = np.zeros((problem.clouds, 6, len(problem.lidars) * problem.placements))
    for j, Z in enumerate(case.measured):
        column = int(problem.cloud_placement[j]) * len(problem.lidars) + int(problem.cloud_lidar[j])
        place = np.asarray(Z.translation())
        out[j, 3:, column] = -place / np.linalg.norm(place)
    return out.reshape(6 * problem.clouds, -1)


def biased(bias_m: float, seed: int, *, placements: int = 6) -> tuple[Reduced, Array, Array]:
    """Two LiDARs at several targets, with noise of the clouds and biases of sigma `bias_m`.

    The linearised problem, the directions of the biases, and the biases that were drawn.
    """
    case = make_case(count=10, drives=placements, seed=seed)
    rng = np.random.default_rng(100 + seed)
    directions = directions_of(case)
    drawn = bias_m * rng.normal(size=(directions.shape[1],))
    moved = directions @ drawn
    for j, information in enumerate(case.information):
        root = np.linalg.cholesky(information)
        moved[6 * j : 6 * j + 6] += np.linalg.solve(root.T, rng.normal(size=6))
    H = np.asarray(block_diag(*case.information))
    lines = linearise_clouds(case.problem, case.truth)
    graph = pose_graph(case.problem, NOISE)
    reduced = reduce_to_extrinsics(case.problem, case.truth, graph, (H, -H @ moved), lines)
    return reduced, directions, drawn


def fitted(bias_m: float, seed: int) -> tuple[float, Array]:
    reduced, directions, drawn = biased(bias_m, seed)
    prior = reduced.in_tangents(make_case().problem.guess_information())
    return fit_bias_sigma(reduced, directions, prior), drawn


@pytest.mark.parametrize("seed", range(3))
def test_biases_are_small_where_the_targets_agree(seed: int) -> None:
    found, _ = fitted(0.0, seed)
    assert LEAST_BIAS_M <= found < 1.5e-3


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("bias_m", [5e-3, 0.015])
def test_biases_are_as_large_as_the_targets_contradict_each_other(bias_m: float, seed: int) -> None:
    found, drawn = fitted(bias_m, seed)
    assert 0.5 < found / np.sqrt(np.mean(drawn**2)) < 2.0


def test_a_bias_that_the_place_of_a_target_makes_up_for_says_nothing() -> None:
    # All clouds of one target shifted alike, by 20 mm: its frame goes along. The prior is left.
    case = make_case("front", count=4)
    H = np.asarray(block_diag(*case.information))
    common = np.tile([0.0, 0.0, 0.0, 0.6, 0.8, 0.0], 4)[:, None]
    reduced = reduce_to_extrinsics(
        case.problem,
        case.truth,
        pose_graph(case.problem, NOISE),
        (H, -0.02 * (H @ common)[:, 0]),
        linearise_clouds(case.problem, case.truth),
    )
    prior = reduced.in_tangents(case.problem.guess_information())
    assert fit_bias_sigma(reduced, common, prior) == pytest.approx(TYPICAL_BIAS_M, rel=0.1)
