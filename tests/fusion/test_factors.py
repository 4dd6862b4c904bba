from __future__ import annotations

import gtsam
import numpy as np
import pytest

from caliv_graph.fusion.factors import (
    lidar_pose_error,
    lidar_pose_factor,
    linear_lidar_pose_factor,
    random_walk,
)
from caliv_graph.products import Array

VEHICLE, MOUNTING = int(gtsam.symbol("x", 0)), int(gtsam.symbol("m", 0))


def random_pose(rng: np.random.Generator, size: float = 1.0) -> gtsam.Pose3:
    return gtsam.Pose3.Expmap(size * rng.normal(size=6))


@pytest.mark.parametrize("seed", range(4))
def test_jacobians_of_the_lidar_pose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    X, M, Z = (random_pose(rng) for _ in range(3))
    _, by_vehicle, by_extrinsic = lidar_pose_error(X, M, Z)
    step = 1e-6

    def slope(of: str, axis: int) -> Array:
        d = step * np.eye(6)[axis]
        ends = []
        for sign in (1.0, -1.0):
            moved = (X.retract(sign * d), M) if of == "X" else (X, M.retract(sign * d))
            ends.append(lidar_pose_error(*moved, Z)[0])
        return (ends[0] - ends[1]) / (2.0 * step)

    for axis in range(6):
        assert by_vehicle[:, axis] == pytest.approx(slope("X", axis), abs=1e-7)
        assert by_extrinsic[:, axis] == pytest.approx(slope("M", axis), abs=1e-7)


def test_it_is_zero_where_the_chain_closes() -> None:
    rng = np.random.default_rng(9)
    X, M = random_pose(rng), random_pose(rng)

    error, _, _ = lidar_pose_error(X, M, X.compose(M))

    assert error == pytest.approx(np.zeros(6), abs=1e-12)


def test_a_localiser_finds_the_mounting() -> None:
    """Known vehicle poses with turns about two axes, scans registered to the map."""
    rng = np.random.default_rng(3)
    T_vehicle_lidar = random_pose(rng)
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i in range(6):
        X, key = random_pose(rng), int(gtsam.symbol("x", i))
        graph.add(gtsam.PriorFactorPose3(key, X, noise))
        graph.add(lidar_pose_factor(key, MOUNTING, X.compose(T_vehicle_lidar), noise))
        values.insert(key, X.retract(0.05 * rng.normal(size=6)))
    values.insert(MOUNTING, T_vehicle_lidar.retract(0.1 * rng.normal(size=6)))

    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()

    assert solved.atPose3(MOUNTING).equals(T_vehicle_lidar, 1e-6)


def test_the_native_one_is_its_linearisation_and_survives_an_archive() -> None:
    rng = np.random.default_rng(5)
    X, M, Z = (random_pose(rng) for _ in range(3))
    values = gtsam.Values()
    values.insert(VEHICLE, X)
    values.insert(MOUNTING, M)
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01] * 3 + [0.1] * 3))
    custom, graph = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
    custom.add(lidar_pose_factor(VEHICLE, MOUNTING, Z, noise))
    graph.add(linear_lidar_pose_factor(VEHICLE, MOUNTING, Z, noise, values))

    native = gtsam.NonlinearFactorGraph()
    native.deserialize(graph.serialize())

    assert native.error(values) == pytest.approx(custom.error(values), rel=1e-12)
    for ours, theirs in zip(
        native.linearize(values).hessian(), custom.linearize(values).hessian(), strict=True
    ):
        assert ours == pytest.approx(theirs, rel=1e-12)
    # A tenth of a degree and a centimetre on, it still says nearly the same.
    moved = gtsam.Values()
    moved.insert(VEHICLE, X.retract(np.array([2e-3, 0, 0, 0.01, 0, 0])))
    moved.insert(MOUNTING, M)
    change = custom.error(moved) - custom.error(values)
    assert native.error(moved) - native.error(values) == pytest.approx(change, rel=0.02)


def test_a_walk_grows_with_the_root_of_time() -> None:
    sigmas = np.array([1e-5, 2e-5, 3e-5, 1e-4, 2e-4, 3e-4])
    graph = gtsam.NonlinearFactorGraph()
    tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-9)
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), tight))
    graph.add(random_walk(0, 1, 4.0, sigmas))
    graph.add(random_walk(1, 2, 5.0, sigmas))
    values = gtsam.Values()
    for key in range(3):
        values.insert(key, gtsam.Pose3())

    cov = gtsam.Marginals(graph, values).marginalCovariance(2)

    assert np.sqrt(np.diag(cov)) == pytest.approx(3.0 * sigmas, rel=1e-6)


@pytest.mark.parametrize("duration_s", [0.0, -1.0, float("nan")])
def test_a_walk_without_time(duration_s: float) -> None:
    with pytest.raises(ValueError, match="above zero"):
        random_walk(0, 1, duration_s, np.ones(6))
