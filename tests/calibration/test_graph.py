"""The graph against GTSAM's own answers, numerical derivatives and a known truth."""

from __future__ import annotations

import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.graph import (
    CalibrationGraph,
    cloud_graph,
    initial_values,
    merged,
    optimise,
    pose_error_sigmas,
    pose_graph,
    prior_graph,
    with_given_poses,
)
from caliv_graph.calibration.linear import (
    GAUGE_PRIOR,
    CloudLinearisation,
    DenseSystem,
    add_shape,
    adjusted_residuals,
    dense_system,
    linearise_clouds,
    retract,
)
from caliv_graph.conventions import key_extrinsic, key_pose_error, key_target, key_vehicle
from caliv_graph.errors import SolveError
from caliv_graph.geometry.se3 import retract_vehicle_axes, vehicle_axes_difference
from caliv_graph.products import Array, PoseNoise
from tests.calibration.problems import (
    PERIOD_NS,
    SIGMAS,
    Case,
    correlated_information,
    make_case,
    moved,
    noisy,
    predictions,
    with_clouds,
    with_poses,
)

NOISE = PoseNoise(2e-4, 2e-3, 1e-3, 0.01, 1.5)


def whole_graph(case: Case, measured: tuple[gtsam.Pose3, ...]) -> CalibrationGraph:
    return merged(
        pose_graph(case.problem, NOISE),
        prior_graph(case.problem, case.problem.lidars),
        cloud_graph(case.problem, measured, case.information),
    )


def solved(case: Case, seed: int = 1) -> tuple[CalibrationGraph, gtsam.Values]:
    """A graph of noisy clouds, and its minimum."""
    graph = whole_graph(case, noisy(case, seed))
    return graph, optimise(graph, case.truth, 50)


def at(values: gtsam.Values, *keys: int) -> list[gtsam.Pose3]:
    return [values.atPose3(key) for key in keys]


# ------------------------------------------------------------------ given poses and their errors


def test_slow_errors_are_a_stationary_process_of_each_drive() -> None:
    case = make_case(count=5, drives=2)
    problem = replace(
        case.problem,
        # Gaps of 0.2, 0.2, 1 and 0.2 s in the first drive.
        poses=(*((0, s * PERIOD_NS) for s in (0, 1, 2, 7, 8)), *case.problem.poses[5:]),
    )
    marginals = gtsam.Marginals(pose_graph(problem, NOISE), case.truth)
    stationary = pose_error_sigmas(NOISE)
    assert stationary == pytest.approx([1e-3] * 3 + [0.01] * 3)
    for i in range(10):
        sigma = np.sqrt(np.diag(marginals.marginalCovariance(key_pose_error(i))))
        assert sigma == pytest.approx(stationary)
    for i, j, correlation in (
        (0, 1, math.exp(-0.2 / 1.5)),
        (2, 3, math.exp(-1.0 / 1.5)),
        (0, 4, math.exp(-1.6 / 1.5)),
        (4, 5, 0.0),
    ):
        joint = marginals.jointMarginalCovariance(
            gtsam.KeyVector([key_pose_error(i), key_pose_error(j)])
        )
        expected = correlation * stationary**2
        assert np.diag(joint.at(key_pose_error(i), key_pose_error(j))) == pytest.approx(
            expected, abs=1e-12
        )


def test_a_given_pose_is_as_good_as_its_white_and_slow_error_together() -> None:
    case = make_case(count=4)
    marginals = gtsam.Marginals(pose_graph(case.problem, NOISE), case.truth)
    cov = marginals.marginalCovariance(key_vehicle(2))
    assert np.sqrt(np.diag(cov)) == pytest.approx(
        [math.hypot(2e-4, 1e-3)] * 3 + [math.hypot(2e-3, 0.01)] * 3
    )


def test_poses_as_given_are_the_minimum_of_their_graph() -> None:
    case = make_case(count=6, drives=2)
    graph = pose_graph(case.problem, NOISE)
    assert graph.error(case.truth) == pytest.approx(0.0, abs=1e-12)
    result = optimise(graph, moved(case.truth, 2, 0.01, 0.1), 20)
    for i, T in enumerate(case.problem.T_map_vehicle):
        assert result.atPose3(key_vehicle(i)).equals(T, 1e-6)


def test_guesses_are_of_the_named_lidars_only() -> None:
    case = make_case("front", "rear", "left", reference="rear")
    assert prior_graph(case.problem, ()).size() == 0
    graph = prior_graph(case.problem, ("left", "rear"))
    assert graph.size() == 2
    # The mounting of `front` may be anything.
    values = gtsam.Values(case.truth)
    front, left = (case.problem.extrinsic_keys_of(n)[1] for n in ("front", "left"))
    values.update(front, gtsam.Pose3())
    assert graph.error(values) == pytest.approx(0.0, abs=1e-15)
    values.update(left, gtsam.Pose3())
    assert graph.error(values) > 1.0


# ------------------------------------------------------------------ first values


def test_first_values_are_guesses_and_given_poses() -> None:
    case = make_case("front", "rear", "left", reference="left", drives=2)
    values = initial_values(case.problem, case.measured)
    assert set(values.keys()) == set(case.truth.keys())
    for name, guess in case.problem.guesses.items():
        assert case.problem.extrinsic(values, name).equals(guess, 1e-12)
    for m in range(2):
        assert values.atPose3(key_target(m)).equals(case.truth.atPose3(key_target(m)), 1e-9)
    np.testing.assert_array_equal(values.atVector(key_pose_error(3)), np.zeros(6))


def test_first_target_frame_is_not_that_of_clouds_that_are_far_off() -> None:
    case = make_case(count=9)
    measured = list(case.measured)
    rng = np.random.default_rng(0)
    for j in range(0, 18, 3):
        measured[j] = gtsam.Pose3.Expmap(rng.uniform(-2, 2, 6)).compose(measured[j])
    target = initial_values(case.problem, measured).atPose3(key_target(0))
    assert target.equals(case.truth.atPose3(key_target(0)), 1e-6)


def test_poses_go_back_to_what_was_given() -> None:
    case = make_case()
    elsewhere = moved(case.truth, 3, 0.1, 1.0)
    elsewhere.update(key_pose_error(2), np.ones(6))
    back = with_given_poses(case.problem, elsewhere)
    for i, T in enumerate(case.problem.T_map_vehicle):
        assert back.atPose3(key_vehicle(i)).equals(T, 0.0)
        np.testing.assert_array_equal(back.atVector(key_pose_error(i)), np.zeros(6))
    for key in (*case.problem.extrinsic_keys(), key_target(0)):
        assert back.atPose3(key).equals(elsewhere.atPose3(key), 0.0)
    # And the values that were given are left as they were.
    assert elsewhere.atVector(key_pose_error(2)).tolist() == [1.0] * 6


# ------------------------------------------------------------------ solving


def test_a_known_truth_is_found_without_guesses() -> None:
    # Up and down a hill on a figure-eight: nothing is left for a prior to decide.
    case = make_case("front", "rear", "left", reference="left", count=20)
    graph = merged(
        pose_graph(case.problem, NOISE),
        cloud_graph(case.problem, case.measured, case.information),
    )
    result = optimise(graph, moved(case.truth, 4, math.radians(3.0), 0.1), 50)
    for name, true in case.problem.guesses.items():
        found = case.problem.extrinsic(result, name)
        assert vehicle_axes_difference(found, true) == pytest.approx(np.zeros(6), abs=1e-4)
    assert result.atPose3(key_target(0)).equals(case.truth.atPose3(key_target(0)), 1e-3)


def mountings_in_a_map_at(origin: tuple[float, float, float]) -> Array:
    """(2, 6) how the extrinsics that are found differ from those in a map that begins here."""
    here, there = make_case(count=10), make_case(count=10, origin=origin)
    (_, at_here), (_, at_there) = solved(here), solved(there)
    return np.array(
        [
            vehicle_axes_difference(
                there.problem.extrinsic(at_there, name), here.problem.extrinsic(at_here, name)
            )
            for name in here.problem.lidars
        ]
    )


def test_moving_the_map_leaves_the_mountings() -> None:
    # A hundredth of their sigmas, which are 0.8 mrad and 4 to 16 mm.
    difference = np.abs(mountings_in_a_map_at((300.0, -200.0, 50.0)))
    assert difference[:, :3].max() < 1e-5
    assert difference[:, 3:].max() < 5e-5


def test_another_reference_finds_the_same_mountings() -> None:
    by_rear = make_case("front", "rear", "left", reference="rear", count=10)
    by_left = make_case("front", "rear", "left", reference="left", count=10)
    (_, rear), (_, left) = solved(by_rear), solved(by_left)
    for name in by_rear.problem.lidars:
        first = by_rear.problem.extrinsic(rear, name)
        second = by_left.problem.extrinsic(left, name)
        assert vehicle_axes_difference(first, second) == pytest.approx(np.zeros(6), abs=1e-5)


def drawn(case: Case, seed: int) -> Case:
    """The case with given poses and guesses that are off by what is said of them."""
    rng = np.random.default_rng(seed)
    slow = pose_error_sigmas(NOISE)
    decay = math.exp(-PERIOD_NS * 1e-9 / NOISE.drift_time_s)
    drift, poses = slow * rng.normal(size=6), []
    for T in case.problem.T_map_vehicle:
        white = np.array([NOISE.white_rotation_rad] * 3 + [NOISE.white_position_m] * 3)
        off = drift + white * rng.normal(size=6)
        R = T.rotation().compose(gtsam.Rot3.Expmap(off[:3]))
        poses.append(gtsam.Pose3(R, T.translation() + off[3:]))
        drift = decay * drift + math.sqrt(1.0 - decay**2) * slow * rng.normal(size=6)
    guesses = {
        name: retract_vehicle_axes(T, SIGMAS * rng.normal(size=6))
        for name, T in case.problem.guesses.items()
    }
    return replace(case, problem=replace(with_poses(case, poses), guesses=guesses))


def test_errors_are_as_large_as_is_said_of_them() -> None:
    # Everything that has a sigma is drawn from it. Of all residuals, 24 clouds, 12 poses, 12 slow
    # errors and 2 guesses of 6 dimensions, less all variables: 24 - 1 are left, the target's frame
    # being the only one without a residual of its own. 138, give or take 17 / sqrt(10).
    case = make_case(count=12)
    squared, nees = [], []
    for seed in range(10):
        some = drawn(case, 100 + seed)
        graph, values = solved(some, seed)
        squared.append(2.0 * graph.error(values))
        keys = some.problem.extrinsic_keys()
        D = dense_system(some.problem, graph, values).schur()[0]
        e = np.concatenate(
            [values.atPose3(k).localCoordinates(case.truth.atPose3(k)) for k in keys]
        )
        nees.append(e @ D @ e)
    assert np.mean(squared) == pytest.approx(138.0, abs=17.0)
    # Of the two extrinsics' 12 dimensions, 12 give or take 4.9 / sqrt(10).
    assert np.mean(nees) == pytest.approx(12.0, abs=5.0)


def test_an_error_that_is_no_number_is_a_solve_error() -> None:
    case = make_case(count=4)
    lost = gtsam.Values(case.truth)
    lost.update(key_vehicle(1), gtsam.Pose3(gtsam.Rot3(), np.array([math.nan, 0.0, 0.0])))
    with pytest.raises(SolveError, match="the graph could not be solved"):
        optimise(whole_graph(case, case.measured), lost, 5)


# ------------------------------------------------------------------ the clouds' Jacobians


@pytest.mark.parametrize("reference", ["front", "left"])
def test_predictions_move_as_their_jacobians_say(reference: str) -> None:
    case = make_case("front", "rear", "left", reference=reference, count=3, drives=2)
    values = moved(case.truth, 5, 0.5, 2.0)
    lines = linearise_clouds(case.problem, values)
    for T, expected in zip(lines.predicted, predictions(case.problem, values), strict=True):
        assert T.equals(expected, 1e-9)
    rng = np.random.default_rng(6)
    keys = (*case.problem.pose_keys(), *case.problem.target_keys(), *case.problem.extrinsic_keys())
    d = 1e-6 * rng.uniform(-1.0, 1.0, 6 * len(keys))
    after = predictions(case.problem, retract(values, keys, d))
    for j, T in enumerate(after):
        expected_move = sum(
            J @ d[6 * keys.index(key) : 6 * keys.index(key) + 6]
            for key, J in zip(lines.keys[j], lines.jacobians[j], strict=True)
        )
        move = gtsam.Pose3.Logmap(T.compose(lines.predicted[j].inverse()))
        np.testing.assert_allclose(move, expected_move, atol=1e-9)


def test_each_variable_moves_by_its_own_tangent() -> None:
    case = make_case(count=3)
    keys = (key_target(0), key_vehicle(2), key_extrinsic())
    d = np.arange(18.0) * 0.01
    after = retract(case.truth, keys, d)
    for i, key in enumerate(keys):
        expected = case.truth.atPose3(key).compose(gtsam.Pose3.Expmap(d[6 * i : 6 * i + 6]))
        assert after.atPose3(key).equals(expected, 1e-9)
    for key in (key_vehicle(0), key_vehicle(1), case.problem.extrinsic_keys()[1]):
        assert after.atPose3(key).equals(case.truth.atPose3(key), 0.0)
    assert case.truth.atPose3(key_extrinsic()).equals(case.problem.guesses["rear"], 0.0)


# ------------------------------------------------------------------ the dense system


def joint_marginals(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, *keys: int) -> Array:
    marginals = gtsam.Marginals(graph, values)
    joint = marginals.jointMarginalCovariance(gtsam.KeyVector(list(keys)))
    blocks = np.block([[joint.at(a, b) for b in keys] for a in keys])
    return np.asarray(blocks, dtype=np.float64)


def scaled(information: Array, like: Array) -> Array:
    """Information over the root of its diagonal, so that rotations and metres compare."""
    scale = np.sqrt(np.diag(like))
    return np.asarray(information / np.outer(scale, scale))


@pytest.mark.parametrize("reference", ["front", "rear"])
def test_reduced_information_is_that_of_gtsam_s_marginals(reference: str) -> None:
    case = make_case("front", "rear", "left", reference=reference, count=6, drives=2)
    graph, values = solved(case)
    system = dense_system(case.problem, graph, values)
    D, _, _, _ = system.schur()
    keys = case.problem.extrinsic_keys()
    assert system.keys[-len(keys) :] == keys
    expected = np.asarray(np.linalg.inv(joint_marginals(graph, values, *keys)), np.float64)
    np.testing.assert_allclose(scaled(D, expected), scaled(expected, expected), atol=1e-5)


def test_reduced_step_is_gauss_newton_s() -> None:
    case = make_case("front", "rear", "left", count=6)
    graph = whole_graph(case, noisy(case, 7))
    values = moved(case.truth, 8, 0.01, 0.05)
    system = dense_system(case.problem, graph, values)
    D, c, G, g = system.schur()
    extrinsic = np.linalg.solve(D, c)
    rest = g - G @ extrinsic
    full = graph.linearize(values).optimize()
    for i, key in enumerate(system.keys):
        mine = np.concatenate([rest, extrinsic])[6 * i : 6 * i + 6]
        np.testing.assert_allclose(mine, full.at(key), atol=1e-6)
        assert system.offset(key) == 6 * i
        assert system.sizes[i] == 6


def test_eliminating_the_slow_errors_loses_nothing() -> None:
    case = make_case(count=5, drives=2)
    graph, values = solved(case)
    values = moved(values, 9, 1e-3, 1e-3)
    problem = case.problem
    keys = (*problem.pose_keys(), *problem.target_keys(), *problem.extrinsic_keys())
    ordering = gtsam.Ordering()
    for key in (*problem.pose_error_keys(), *keys):
        ordering.push_back(key)
    H, b = graph.linearize(values).hessian(ordering)
    n = 6 * len(problem.pose_error_keys())
    gain = np.linalg.solve(H[:n, :n], H[:n, n:]).T
    system = dense_system(problem, graph, values)
    expected = H[n:, n:] - gain @ H[:n, n:]
    assert system.keys == keys
    assert len(system.b) == len(expected)
    np.testing.assert_allclose(scaled(system.H, expected), scaled(expected, expected), atol=1e-8)
    expected_b = b[n:] - gain @ b[:n]
    np.testing.assert_allclose(system.b, expected_b, rtol=1e-6, atol=1e-6 * np.abs(b).max())


def test_what_the_graph_does_not_touch_has_zero_rows() -> None:
    case = make_case(count=3)
    system = dense_system(case.problem, prior_graph(case.problem, ("rear",)), case.truth)
    E = system.offset(key_extrinsic())
    assert system.H.shape == (6 * (3 + 1 + 2),) * 2
    touched = np.zeros(len(system.b), dtype=bool)
    touched[E : E + 6] = True
    assert np.diag(system.H)[touched].min() > 0.0
    np.testing.assert_array_equal(system.H[~touched], 0.0)
    np.testing.assert_array_equal(system.H[:, ~touched], 0.0)
    with pytest.raises(SolveError, match="a pose or a target has no measurement"):
        system.schur()


def test_lidars_that_share_nothing_know_nothing_of_each_other() -> None:
    # Each LiDAR has a drive of its own and no target in common: without priors the extrinsics are
    # known, each by itself. With the target frames tied to nothing else, no covariance between.
    case = make_case(count=10, drives=2)
    keep = [j for j in range(40) if case.problem.cloud_lidar[j] == case.problem.cloud_placement[j]]
    problem = with_clouds(case.problem, keep)
    graph = merged(
        pose_graph(problem, NOISE),
        cloud_graph(problem, [case.measured[j] for j in keep], case.information[keep]),
    )
    D = dense_system(problem, graph, case.truth).schur()[0]
    Q = np.linalg.inv(problem.to_vehicle_axes(case.truth))
    D = Q.T @ D @ Q
    np.testing.assert_allclose(scaled(D, D)[:6, 6:], 0.0, atol=1e-6)


# ------------------------------------------------------------------ the clouds' quadratic


def block_diagonal(blocks: Array) -> Array:
    out = np.zeros((6 * len(blocks),) * 2)
    for j, block in enumerate(blocks):
        out[6 * j : 6 * j + 6, 6 * j : 6 * j + 6] = block
    return out


def empty_system(case: Case, values: gtsam.Values) -> DenseSystem:
    return dense_system(case.problem, CalibrationGraph(), values)


@pytest.mark.parametrize("drives", [1, 2])
def test_a_quadratic_of_blocks_is_as_good_as_pose_factors(drives: int) -> None:
    case = make_case("front", "rear", "left", count=4, drives=drives)
    # Residuals of 0.1 mm and 0.1 mrad: the factor's residual turns with the pose, by as much.
    rng = np.random.default_rng(10)
    r = 1e-4 * rng.uniform(-1.0, 1.0, (len(case.measured), 6))
    measured = [gtsam.Pose3.Expmap(-d).compose(Z) for d, Z in zip(r, case.measured, strict=True)]
    steady = pose_graph(case.problem, NOISE)
    factors = cloud_graph(case.problem, measured, case.information)

    by_factors = dense_system(case.problem, merged(steady, factors), case.truth)
    by_quadratic = add_shape(
        dense_system(case.problem, steady, case.truth),
        linearise_clouds(case.problem, case.truth),
        block_diagonal(case.information),
        np.einsum("jab,jb->ja", case.information, r).ravel(),
    )

    assert by_quadratic.keys == by_factors.keys
    assert by_quadratic.extrinsics == by_factors.extrinsics == 3
    H = by_factors.H
    np.testing.assert_allclose(scaled(by_quadratic.H, H), scaled(H, H), atol=1e-3)
    scale = np.sqrt(np.diag(H))
    np.testing.assert_allclose(
        by_quadratic.b / scale, by_factors.b / scale, atol=1e-3 * np.abs(by_factors.b / scale).max()
    )


def dense_jacobian(system: DenseSystem, lines: CloudLinearisation) -> Array:
    J = np.zeros((6 * len(lines.predicted), len(system.b)))
    for j, (keys, jacobians) in enumerate(zip(lines.keys, lines.jacobians, strict=True)):
        for key, jacobian in zip(keys, jacobians, strict=True):
            column = system.offset(key)
            J[6 * j : 6 * j + 6, column : column + 6] = jacobian
    return J


def test_cross_terms_between_clouds_are_kept() -> None:
    case = make_case(count=4)
    values = moved(case.truth, 11, 0.2, 1.0)
    rng = np.random.default_rng(12)
    size = 6 * len(case.measured)
    root = rng.normal(size=(size, size))
    H, g = root @ root.T, rng.normal(size=size)
    before = dense_system(case.problem, whole_graph(case, case.measured), values)
    lines = linearise_clouds(case.problem, values)
    after = add_shape(before, lines, H, g)
    J = dense_jacobian(before, lines)
    expected = before.H + J.T @ H @ J
    frame = np.arange(6) + before.offset(key_target(0))
    expected[frame, frame] += GAUGE_PRIOR
    np.testing.assert_allclose(after.H, expected, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(after.b, before.b - J.T @ g, rtol=1e-9, atol=1e-6)


def test_a_shape_that_moves_with_its_clouds_says_nothing_of_the_target_frame() -> None:
    # Information on clouds against each other only, as `ShapeQuadratic.joint` has it: moving the
    # target frame moves all of them together.
    case = make_case(count=4)
    count = len(case.measured)
    centred = np.eye(count) - 1.0 / count
    information = correlated_information(np.random.default_rng(13))
    H = np.asarray(np.kron(centred, information), np.float64)
    system = add_shape(
        empty_system(case, case.truth),
        linearise_clouds(case.problem, case.truth),
        H,
        np.zeros(6 * count),
    )
    # A left perturbation of all clouds is one of T_target_map.
    C = system.offset(key_target(0))
    everything = np.abs(system.H).max()
    assert np.abs(system.H[C : C + 6]).max() < 1e-9 * everything
    X = system.offset(key_vehicle(0))
    assert np.abs(system.H[X : X + 6, X : X + 6]).max() > 1e-3 * everything


def test_the_step_of_the_quadratic_leads_to_the_measurements() -> None:
    # Poses known, targets and extrinsics wrong: Gauss-Newton on quadratics finds the truth.
    case = make_case("front", "rear", count=16)
    steady = pose_graph(case.problem, NOISE)
    values = with_given_poses(case.problem, moved(case.truth, 14, 0.02, 0.05))
    for _ in range(5):
        lines = linearise_clouds(case.problem, values)
        r = np.concatenate(
            [
                gtsam.Pose3.Logmap(Z.compose(measured.inverse()))
                for Z, measured in zip(lines.predicted, case.measured, strict=True)
            ]
        )
        H = block_diagonal(case.information)
        system = add_shape(dense_system(case.problem, steady, values), lines, H, H @ r)
        D, c, G, g = system.schur()
        step = np.linalg.solve(D, c)
        values = retract(values, system.keys, np.concatenate([g - G @ step, step]))
    for name, true in case.problem.guesses.items():
        found = case.problem.extrinsic(values, name)
        assert vehicle_axes_difference(found, true) == pytest.approx(np.zeros(6), abs=1e-6)


def test_what_is_left_over_moves_with_an_error_of_the_clouds_by_its_information() -> None:
    case = make_case(count=6)
    count = len(case.measured)
    H = np.asarray(
        np.kron(np.eye(count) - 1.0 / count, correlated_information(np.random.default_rng(15)))
    )
    graph = merged(pose_graph(case.problem, NOISE), prior_graph(case.problem, case.problem.lidars))
    system = dense_system(case.problem, graph, case.truth)
    lines = linearise_clouds(case.problem, case.truth)
    r = 1e-3 * np.random.default_rng(16).normal(size=(count, 6))
    W, v = adjusted_residuals(system, lines, H, r)

    # Gauss-Newton's step by itself, and the gradient there.
    full = add_shape(system, lines, H, H @ r.ravel())
    d = np.linalg.solve(full.H, full.b)
    expected = H @ (r.ravel() + dense_jacobian(system, lines) @ d)
    scale = np.abs(v).max()
    np.testing.assert_allclose(v, expected, atol=1e-6 * scale)
    error = 1e-3 * np.random.default_rng(17).normal(size=6 * count)
    _, after = adjusted_residuals(system, lines, H, r + error.reshape(-1, 6))
    np.testing.assert_allclose(after - v, W @ error, atol=1e-6 * scale)
    # A turn of the target's frame is taken up by it.
    common = np.tile(np.eye(6), (count, 1))
    assert np.abs(W @ common).max() < 1e-6 * np.abs(W).max()
    # Without any error nothing is left.
    assert np.abs(adjusted_residuals(system, lines, H, 0.0 * r)[1]).max() < 1e-9 * scale


def test_what_is_left_over_of_poses_that_nothing_ties_is_a_solve_error() -> None:
    case = make_case(count=4)
    H = block_diagonal(case.information)
    with pytest.raises(SolveError, match="has no measurement"):
        adjusted_residuals(
            empty_system(case, case.truth),
            linearise_clouds(case.problem, case.truth),
            H,
            np.zeros((len(case.measured), 6)),
        )


def test_poses_that_are_off_are_told_from_mountings_that_are() -> None:
    # All given poses 2 cm further east: a matter of the target's place, not of any mounting.
    case = make_case(count=10)
    east = gtsam.Pose3(gtsam.Rot3(), np.array([0.02, 0.0, 0.0]))
    problem = with_poses(case, [east.compose(T) for T in case.problem.T_map_vehicle])
    graph = merged(
        pose_graph(problem, NOISE), cloud_graph(problem, case.measured, case.information)
    )
    values = optimise(graph, case.truth, 30)
    for name, true in problem.guesses.items():
        difference = vehicle_axes_difference(problem.extrinsic(values, name), true)
        assert difference == pytest.approx(np.zeros(6), abs=1e-5)
    C = values.atPose3(key_target(0)).inverse().translation()
    true_C = case.truth.atPose3(key_target(0)).inverse().translation()
    assert C - true_C == pytest.approx([0.02, 0.0, 0.0], abs=1e-4)
