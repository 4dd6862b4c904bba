"""The ground in the graph: Jacobians, numbers by hand, null directions, wrong planes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.graph import (
    CalibrationGraph,
    cloud_graph,
    initial_values,
    merged,
    optimise,
    pose_graph,
    prior_graph,
)
from caliv_graph.calibration.ground import (
    GROUND_BIASES,
    GroundWeights,
    full_weights,
    ground_centre,
    ground_graph,
    ground_values,
)
from caliv_graph.calibration.ground_factors import (
    ground_plane_factor,
    held,
    parallel_factor,
    plane_normal,
    standing_factor,
)
from caliv_graph.calibration.ground_weights import ground_weights
from caliv_graph.calibration.linear import dense_system
from caliv_graph.calibration.problem import HEAVE_SIGMA_M, Problem, moved_map
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import parse_config
from caliv_graph.config.model import GroundConfig
from caliv_graph.config.range_errors import RangeErrors
from caliv_graph.conventions import (
    key_extrinsic,
    key_ground,
    key_ground_bias,
    key_height,
    key_parallel,
    key_rates,
    key_sensor,
    key_vehicle,
)
from caliv_graph.geometry.se3 import (
    retract_vehicle_axes,
    right_to_vehicle_axes,
    tangent_axes,
    vehicle_axes_difference,
)
from caliv_graph.products import (
    Array,
    GroundObservation,
    PoseNoise,
    TargetCloud,
    TargetObservation,
    Trajectory,
)
from caliv_graph.simulation import load_scenario, simulate_drive
from caliv_graph.targets.ground.measure import measure_grounds
from caliv_graph.targets.ground.planes import DISTANCE_FLOOR_M, NORMAL_FLOOR_RAD
from caliv_graph.trajectory.rates import RATES
from caliv_graph.trajectory.select import GivenTrajectory
from caliv_graph.uncertainty.observability import scaling
from tests.calibration.problems import Case, make_case, moved, predictions
from tests.samples import pose

X, E, S, G, H, P = (
    key_vehicle(0),
    key_extrinsic(),
    key_sensor(1),
    key_ground(0),
    key_height(0),
    key_parallel(0),
)

GROUND_Z = 0.7
VEHICLE_HEIGHT = 0.25

QUIET = PoseNoise(1e-5, 1e-4, 1e-5, 1e-4, 4.0)
"""Poses that leave only what the drive itself leaves."""

SIGMAS = np.array([NORMAL_FLOOR_RAD, NORMAL_FLOOR_RAD, DISTANCE_FLOOR_M])

PLANE_ALONE = GroundConfig()
HEIGHT_KNOWN = GroundConfig(vehicle_height=VEHICLE_HEIGHT)


# ------------------------------------------------------------------ planes of known truth


def seen_from(
    T_map_lidar: gtsam.Pose3,
    g: Array,
    anchor: Array,
    *,
    lidar: str = "rear",
    drive: int = 0,
    stamp_ns: int = 0,
    off: Array | None = None,
) -> GroundObservation:
    """A plane as a LiDAR sees it, by plain geometry; `off` (3,) along its axes and in distance."""
    n = np.array([-g[0], -g[1], 1.0]) / math.sqrt(g[0] ** 2 + g[1] ** 2 + 1.0)
    foot = np.array([anchor[0], anchor[1], g[2]])
    n_lidar = T_map_lidar.rotation().matrix().T @ n
    distance = float(n @ (T_map_lidar.translation() - foot))
    if off is not None:
        n_lidar = n_lidar + off[:2] @ tangent_axes(n_lidar)
        n_lidar /= np.linalg.norm(n_lidar)
        distance += off[2]
    return GroundObservation(
        lidar=lidar,
        drive=drive,
        stamp_ns=stamp_ns,
        normal_lidar=n_lidar,
        distance_m=distance,
        axes_lidar=tangent_axes(n_lidar),
        cov=np.diag(SIGMAS**2),
        centre_lidar=np.zeros(3),
        points=1000,
    )


def observed(
    problem: Problem,
    truth: gtsam.Values,
    g: Array,
    off: Callable[[int], Array] | None = None,
) -> list[GroundObservation]:
    """What every LiDAR sees of a plane from every pose."""
    out: list[GroundObservation] = []
    for name in problem.lidars:
        for i, (drive, stamp_ns) in enumerate(problem.poses):
            T = truth.atPose3(key_vehicle(i)).compose(problem.extrinsic(truth, name))
            out.append(
                seen_from(
                    T,
                    g,
                    ground_centre(problem, drive),
                    lidar=name,
                    drive=drive,
                    stamp_ns=stamp_ns,
                    off=off(len(out)) if off else None,
                )
            )
    return out


def on_path(case: Case, poses: Sequence[gtsam.Pose3]) -> Case:
    """The same vehicle, LiDARs and target on other poses."""
    truth = gtsam.Values(case.truth)
    for i, T in enumerate(poses):
        truth.update(key_vehicle(i), T)
    problem = replace(case.problem, T_map_vehicle=tuple(poses))
    return Case(problem, truth, tuple(predictions(problem, truth)), case.information)


def path(curvatures: Sequence[float], slopes: Sequence[float] | None = None) -> list[gtsam.Pose3]:
    """A vehicle with its frame 0.25 m above the ground, a metre per step."""
    x, y, z, yaw = 1.0, -2.0, GROUND_Z + VEHICLE_HEIGHT, 0.4
    poses = []
    for curvature, slope in zip(curvatures, slopes or [0.0] * len(curvatures), strict=True):
        rotation = gtsam.Rot3.RzRyRx(0.0, -slope, yaw)
        poses.append(gtsam.Pose3(rotation, np.array([x, y, z])))
        x, y = x + math.cos(yaw), y + math.sin(yaw)
        z += math.tan(slope)
        yaw += curvature
    return poses


def with_planes(values: gtsam.Values, g: Array, drives: Sequence[int] = (0,)) -> gtsam.Values:
    out = gtsam.Values(values)
    for drive in drives:
        out.insert(key_ground(drive), g)
        out.insert(key_height(drive), np.zeros(1))
        out.insert(key_parallel(drive), np.zeros(2))
    return out


# ------------------------------------------------------------------ factors


def check_jacobians(factor: gtsam.NoiseModelFactor, values: gtsam.Values) -> None:
    """Linearised, whitened Jacobians and residual against the factor's own error."""
    A, b = factor.linearize(values).jacobian()
    np.testing.assert_allclose(b, -factor.whitenedError(values), atol=1e-9)
    column = 0
    for key in factor.keys():  # noqa: SIM118 - a gtsam factor is no dict
        size = values.zeroVectors().at(key).size
        numerical = []
        for d in 1e-5 * np.eye(size):
            ends = []
            for sign in (1.0, -1.0):
                delta = gtsam.VectorValues()
                delta.insert(key, sign * d)
                ends.append(np.asarray(factor.whitenedError(values.retract(delta))))
            numerical.append((ends[0] - ends[1]) / 2e-5)
        expected = np.array(numerical).T
        scale = max(np.abs(expected).max(), 1.0)
        np.testing.assert_allclose(
            A[:, column : column + size] / scale, expected / scale, atol=1e-6, err_msg=str(key)
        )
        column += size
    assert column == A.shape[1]


def random_values(seed: int, offset_m: float) -> tuple[gtsam.Values, Array]:
    rng = np.random.default_rng(seed)

    def draw(metres: float) -> gtsam.Pose3:
        return gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), metres * rng.uniform(-1, 1, 3))

    values = gtsam.Values()
    values.insert(X, draw(offset_m))
    values.insert(E, draw(2.0))
    values.insert(S, draw(2.0))
    values.insert(G, np.append(0.3 * rng.normal(size=2), offset_m * rng.normal()))
    values.insert(H, rng.normal(size=1))
    values.insert(P, 0.1 * rng.normal(size=2))
    return values, rng.normal(size=2) * offset_m


def plane_squares_of(
    problem: Problem, observations: Sequence[GroundObservation], values: gtsam.Values
) -> Array:
    """Squared whitened residuals of the planes that the LiDARs saw, 3 degrees of freedom each."""
    graph = ground_graph(problem, observations, PLANE_ALONE)
    return np.array(
        [
            2.0 * graph.at(i).error(values)
            for i, kind in enumerate(graph.kinds)
            if kind == "ground_plane"
        ]
    )


def test_ground_that_is_held_is_that_of_the_extrinsic_and_stays() -> None:
    values, anchor = random_values(3, 1.0)
    T = values.atPose3(X).compose(values.atPose3(E))
    seen = seen_from(T, values.atVector(G), anchor)
    R = values.atPose3(E).rotation()
    guess = R.compose(gtsam.Rot3.Expmap(np.array([0.02, -0.03, 0.01]))).matrix()
    by_extrinsic = 0.02 * np.random.default_rng(1).normal(size=(3, 3))
    swept = replace(seen, R_vehicle_lidar=guess, by_extrinsic=by_extrinsic)

    free = ground_plane_factor((X, E), G, anchor, swept)
    fixed = ground_plane_factor((X, E), G, anchor, held(swept, R.matrix()))
    # Tilts of below 1 mrad: their axes turn by as little, which is below a microradian.
    np.testing.assert_allclose(
        fixed.unwhitenedError(values), free.unwhitenedError(values), atol=2e-6
    )
    # The LiDAR stays in the map, the vehicle frame turns: only the free one depends on it.
    turn = gtsam.Pose3(gtsam.Rot3.Expmap(np.array([0.01, 0.0, 0.0])), np.zeros(3))
    moved = gtsam.Values(values)
    moved.update(X, values.atPose3(X).compose(turn.inverse()))
    moved.update(E, turn.compose(values.atPose3(E)))
    np.testing.assert_allclose(
        fixed.unwhitenedError(moved), fixed.unwhitenedError(values), atol=1e-12
    )
    assert np.abs(free.unwhitenedError(moved) - free.unwhitenedError(values)).max() > 1e-5


@pytest.mark.parametrize("offset_m", [1.0, 30.0, 2000.0])
def test_jacobians(offset_m: float) -> None:
    for seed in range(4):
        values, anchor = random_values(seed, offset_m)
        T = values.atPose3(X).compose(values.atPose3(E)).compose(values.atPose3(S))
        g = values.atVector(G) + np.array([0.05, -0.1, 0.2])
        observation = seen_from(T, g, anchor)
        correlated = np.diag(SIGMAS**2) + np.outer(SIGMAS, SIGMAS) * 0.5
        observation = replace(observation, cov=correlated)
        swept = replace(
            observation,
            R_vehicle_lidar=random_values(seed + 9, 1.0)[0].atPose3(E).rotation().matrix(),
            by_extrinsic=0.1 * np.random.default_rng(seed).normal(size=(3, 3)),
        )
        check_jacobians(ground_plane_factor((X, E, S), G, anchor, swept), values)
        check_jacobians(ground_plane_factor((X, E), G, anchor, swept), values)
        check_jacobians(ground_plane_factor((X, E, S), G, anchor, observation), values)
        check_jacobians(ground_plane_factor((X, E), G, anchor, observation, 0.3), values)
        biased = replace(observation, by_range_bias=np.random.default_rng(seed).normal(size=(3, 3)))
        values.insert(
            key_ground_bias(0), 0.01 * np.random.default_rng(seed).normal(size=GROUND_BIASES)
        )
        check_jacobians(
            ground_plane_factor((X, E, S), G, anchor, biased, key_bias=key_ground_bias(0)), values
        )
        moved = replace(
            observation,
            by_rates=np.random.default_rng(seed).normal(size=(3, 6)),
            twist_map=np.array([0.1, -0.2, 0.5, 2.0, -1.0, 0.1]),
            R_map_vehicle=random_values(seed + 9, 1.0)[0].atPose3(X).rotation().matrix(),
        )
        values.insert(key_rates(0), np.random.default_rng(seed).normal(size=RATES))
        check_jacobians(
            ground_plane_factor((X, E), G, anchor, moved, key_rates=key_rates(0)), values
        )
        check_jacobians(standing_factor(X, G, H, anchor, 0.4), values)
        check_jacobians(parallel_factor(X, G, P), values)


def test_a_plane_that_fits_leaves_nothing() -> None:
    values, anchor = random_values(1, 20.0)
    T = values.atPose3(X).compose(values.atPose3(E)).compose(values.atPose3(S))
    factor = ground_plane_factor((X, E, S), G, anchor, seen_from(T, values.atVector(G), anchor))
    assert factor.error(values) == pytest.approx(0.0, abs=1e-15)


def test_residuals_by_hand() -> None:
    # A LiDAR 2 m above a level plane at z = 0.7; it is said to be 1.99 m up and tilted by 2 mrad
    # about its own x axis: 10 mm over 2 mm, 2 mrad over 0.5 mrad.
    values = gtsam.Values()
    values.insert(X, pose((3.0, 4.0, 0.7), (0.0, 0.0, 30.0)))
    values.insert(E, pose((0.0, 0.0, 2.0), (0.0, 0.0, 0.0)))
    values.insert(G, np.array([0.0, 0.0, 0.7]))
    values.insert(H, np.array([0.02]))
    values.insert(P, np.array([0.001, 0.0]))
    said = GroundObservation(
        lidar="rear",
        drive=0,
        stamp_ns=0,
        normal_lidar=np.array([0.0, 2e-3, 1.0]),
        distance_m=1.99,
        axes_lidar=np.array([[1.0, 0.0, 0.0], [0.0, 1.0, -2e-3]]),
        cov=np.diag(SIGMAS**2),
        centre_lidar=np.zeros(3),
        points=100,
    )
    factor = ground_plane_factor((X, E), G, np.array([50.0, -20.0]), said)
    assert factor.whitenedError(values) == pytest.approx([0.0, -4.0, 5.0], abs=1e-9)
    # The vehicle's frame is on the plane, and would be 10 mm above it but for 20 mm of error.
    standing = standing_factor(X, G, H, np.zeros(2), 0.01)
    assert standing.whitenedError(values) == pytest.approx([-0.03 / HEAVE_SIGMA_M], abs=1e-9)
    # A ground that rises by 0.003 to the north leans back: -0.003 along y, in vehicle axes.
    values.update(G, np.array([0.0, 3e-3, 0.7]))
    expected = np.array([-3e-3 * 0.5 - 1e-3, -3e-3 * math.sqrt(0.75)]) / 1e-3
    assert parallel_factor(X, G, P).whitenedError(values) == pytest.approx(expected, abs=1e-4)


def test_weight_scales_information() -> None:
    values, anchor = random_values(3, 5.0)
    observation = seen_from(gtsam.Pose3(), np.zeros(3), anchor)
    for full, half in (
        [ground_plane_factor((X, E), G, anchor, observation, w) for w in (1.0, 0.5)],
        [standing_factor(X, G, H, anchor, 0.1, w) for w in (1.0, 0.5)],
        [parallel_factor(X, G, P, w) for w in (1.0, 0.5)],
    ):
        assert half.error(values) == pytest.approx(0.5 * full.error(values))


def test_plane_normal() -> None:
    # 3-4-5: a slope of 0.75 along x.
    assert plane_normal(np.array([0.75, 0.0, 9.0])) == pytest.approx([-0.6, 0.0, 0.8])


# ------------------------------------------------------------------ the graph


def test_plane_is_found_from_guesses_and_solved() -> None:
    case = make_case(count=16)
    g = np.array([0.03, -0.02, -0.4])
    observations = observed(case.problem, case.truth, g)
    start = moved(case.truth, 3, math.radians(3.0), 0.1)
    config = GroundConfig(vehicle_height=0.0, parallel_sigma_deg=0.05)
    start.insert(ground_values(case.problem, observations, start, config))
    assert start.atVector(G) == pytest.approx(g, abs=0.15)
    graph = merged(
        pose_graph(case.problem, QUIET),
        cloud_graph(case.problem, case.measured, case.information),
        ground_graph(case.problem, observations, PLANE_ALONE),
    )
    assert set(ground_graph(case.problem, observations, config).keyVector()) <= set(start.keys())
    for key in (H, P):
        start.erase(key)
    solved = optimise(graph, start, 50)
    assert solved.atVector(G) == pytest.approx(g, abs=1e-5)
    assert np.nanmax(plane_squares_of(case.problem, observations, solved)) < 1e-2
    for name in case.problem.lidars:
        difference = case.problem.extrinsic(case.truth, name).between(
            case.problem.extrinsic(solved, name)
        )
        assert gtsam.Pose3.Logmap(difference) == pytest.approx(np.zeros(6), abs=1e-5)


def test_switched_off_or_unseen_there_is_nothing() -> None:
    case = make_case(count=4)
    observations = observed(case.problem, case.truth, np.zeros(3))
    off = GroundConfig(use=False, vehicle_height=0.0)
    assert ground_graph(case.problem, observations, off).size() == 0
    assert ground_values(case.problem, observations, case.truth, off).size() == 0
    assert ground_graph(case.problem, [], HEIGHT_KNOWN).size() == 0
    # Of a LiDAR, a stamp, a drive that are not in the problem.
    strange = [
        replace(observations[0], lidar="third"),
        replace(observations[0], stamp_ns=17),
        replace(observations[0], drive=1),
    ]
    assert ground_graph(case.problem, strange, HEIGHT_KNOWN).size() == 0
    assert ground_values(case.problem, strange, case.truth, HEIGHT_KNOWN).size() == 0
    assert full_weights(case.problem, strange).planes.tolist() == [0.0, 0.0, 0.0]


def test_factors_by_role() -> None:
    case = make_case(count=6, drives=2)
    observations = observed(case.problem, case.truth, np.zeros(3))
    # The last pose of the second drive is seen by nobody: nothing is said of standing there.
    last = case.problem.poses[-1]
    observations = [o for o in observations if (o.drive, o.stamp_ns) != last]
    assert len(observations) == 22
    sizes = [
        ground_graph(case.problem, observations, config).size()
        for config in (
            PLANE_ALONE,
            HEIGHT_KNOWN,
            GroundConfig(vehicle_height=0.1, parallel_sigma_deg=0.1),
        )
    ]
    # A prior per drive and an observation each; and a prior per drive and one per pose.
    assert sizes == [2 + 22, 24 + 2 + 11, 37 + 2 + 11]
    weights = GroundWeights(np.zeros(22), np.zeros(12), np.zeros(22))
    assert ground_graph(case.problem, observations, HEIGHT_KNOWN, weights).size() == 4


def test_the_waves_below_a_vehicle_count_once_per_place() -> None:
    """Half a millimetre of heave is no reason to believe that a yard is as flat."""
    case = make_case(count=4)
    here, far = gtsam.Pose3(gtsam.Rot3(), np.zeros(3)), gtsam.Pose3(gtsam.Rot3(), [99.0, 0.0, 0.0])
    problem = replace(
        case.problem,
        T_map_vehicle=(here, here, here, far),
        heave_m=5e-4,
        floors=np.array([1e-3, 1e-3, 4e-3]),
    )
    observations = observed(problem, case.truth, np.zeros(3))
    config = GroundConfig(vehicle_height=0.1, parallel_sigma_deg=0.1)
    graph = ground_graph(problem, observations, config, sway_rad=2e-3)

    factors: list[Any] = [graph.at(i) for i in range(graph.size())]
    for kind, own, wave in (("standing", 5e-4, 4e-3), ("parallel", 2e-3, 1e-3)):
        sigmas = [
            factor.noiseModel().sigmas()[0]
            for of, factor in zip(graph.kinds, factors, strict=True)
            if of == kind
        ]
        three, one = math.hypot(own, math.sqrt(3.0) * wave), math.hypot(own, wave)
        assert sigmas == pytest.approx([three] * 3 + [one])


def test_moving_the_map_changes_nothing() -> None:
    shift = np.array([300.0, -500.0, 40.0])
    g = np.array([0.03, -0.02, -0.4])
    errors = []
    for origin in (np.zeros(3), shift):
        case = make_case(count=8)
        poses = [moved_map(T, origin) for T in case.problem.T_map_vehicle]
        case = on_path(case, poses)
        # The height is told at the anchor, which moves along.
        observations = observed(case.problem, case.truth, g + np.array([0, 0, origin[2]]))
        start = with_planes(moved_mountings(case), g + np.array([1e-3, 2e-3, 0.01 + origin[2]]))
        config = GroundConfig(vehicle_height=0.1, parallel_sigma_deg=0.2)
        errors.append(ground_graph(case.problem, observations, config).error(start))
    assert errors[0] == pytest.approx(errors[1], rel=1e-6)
    assert errors[0] > 1.0


def moved_mountings(case: Case) -> gtsam.Values:
    values = gtsam.Values(case.truth)
    d = np.array([3e-3, -2e-3, 1e-3, 0.01, 0.02, -0.01])
    values.update(E, retract_vehicle_axes(values.atPose3(E), d))
    return values


# ------------------------------------------------------------------ null directions

COUNT = 16
STRAIGHT = path([0.0] * COUNT)
ARC = path([-1.0 / 9.16] * COUNT)
S_CURVE = path([-1.0 / 9.16] * (COUNT // 2) + [1.0 / 9.16] * (COUNT // 2))
HILL = [0.15 * math.sin(2.0 * math.pi * i / COUNT) for i in range(COUNT)]
RAMP = path([-1.0 / 9.16] * (COUNT // 2) + [1.0 / 9.16] * (COUNT // 2), HILL)
STANDSTILL = [STRAIGHT[0]] * COUNT


@dataclass(frozen=True)
class Row:
    """A row of the table: null directions without ground, with the plane, with the height too."""

    poses: list[gtsam.Pose3]
    none: int
    plane: int
    height: int


TABLE = {
    "straight": Row(STRAIGHT, 4, 4, 3),
    "arc": Row(ARC, 2, 2, 1),
    "change of curvature": Row(S_CURVE, 1, 1, 0),
    "ramp": Row(RAMP, 0, 0, 0),
    "standstill": Row(STANDSTILL, 6, 6, 5),
}

SIGMA_UNKNOWN = 30.0
"""In scaled units (1 mrad, 10 mm): nothing is known to a sigma worse than that, and all that is
known is known to one far better."""


def vehicle_information(case: Case, graph: CalibrationGraph, values: gtsam.Values) -> Array:
    """(12, 12) of both extrinsics, scaled, vehicle axes, all else eliminated."""
    D, _, _, _ = dense_system(case.problem, graph, values).schur()
    back = np.linalg.inv(case.problem.to_vehicle_axes(values))
    unit = scaling(len(case.problem.lidars))
    return np.asarray(back.T @ D @ back * np.outer(unit, unit))


def null_directions(row: Row, config: GroundConfig | None) -> Array:
    """(12, k) orthonormal, scaled."""
    case = on_path(make_case(count=COUNT), row.poses)
    values = with_planes(case.truth, np.array([0.0, 0.0, GROUND_Z]))
    graph = merged(
        pose_graph(case.problem, QUIET),
        cloud_graph(case.problem, case.measured, case.information),
    )
    if config is not None:
        # On the ramp, the LiDARs see the level ground; the vehicle does not stand on it.
        observations = observed(case.problem, case.truth, values.atVector(G))
        weights = ground_weights(case.problem, observations, values)
        graph = merged(graph, ground_graph(case.problem, observations, config, weights))
    D = vehicle_information(case, graph, values)
    eigenvalues, vectors = np.linalg.eigh(D)
    unknown = eigenvalues < SIGMA_UNKNOWN**-2
    assert np.all(eigenvalues[~unknown] > 0.1), eigenvalues
    return np.asarray(vectors[:, unknown])


@pytest.mark.parametrize("name", list(TABLE))
@pytest.mark.parametrize("column", ["none", "plane", "height"])
def test_table_of_null_directions(name: str, column: str) -> None:
    row = TABLE[name]
    config = {"none": None, "plane": PLANE_ALONE, "height": HEIGHT_KNOWN}[column]
    assert null_directions(row, config).shape[1] == getattr(row, column)


def test_what_the_height_leaves_on_an_arc_is_the_turn_about_its_centre() -> None:
    found = null_directions(TABLE["arc"], HEIGHT_KNOWN)[:, 0]
    case = on_path(make_case(count=COUNT), ARC)
    # The turn is to the right: its centre is at y = -rho of the vehicle.
    centre, up = np.array([0.0, -9.16, 0.0]), np.array([0.0, 0.0, 1.0])
    expected = []
    for name in case.problem.lidars:
        t = case.problem.extrinsic(case.truth, name).translation()
        expected += [*up, *np.cross(up, t - centre)]
    direction = np.array(expected) / scaling(2)
    direction /= np.linalg.norm(direction)
    # The poses are a chain of chords; the vehicle's path between two of them is none of its own.
    assert abs(found @ direction) > 0.999


def test_height_fixes_z_of_a_straight_drive_to_its_sigma() -> None:
    for sigma in (0.005, 0.02):
        case = on_path(make_case(count=COUNT), S_CURVE)
        values = with_planes(case.truth, np.array([0.0, 0.0, GROUND_Z]))
        observations = observed(case.problem, case.truth, values.atVector(G))
        config = GroundConfig(vehicle_height=VEHICLE_HEIGHT, sigma=sigma)
        graph = merged(
            pose_graph(case.problem, QUIET),
            cloud_graph(case.problem, case.measured, case.information),
            ground_graph(case.problem, observations, config),
        )
        unit = scaling(2)
        cov = np.linalg.inv(vehicle_information(case, graph, values)) * np.outer(unit, unit)
        # The heave of 16 scans is small beside the error that they share.
        expected = math.hypot(sigma, HEAVE_SIGMA_M / math.sqrt(COUNT))
        for z in (5, 11):
            assert math.sqrt(cov[z, z]) == pytest.approx(expected, rel=0.1)
        # Both LiDARs share it: between them z is far better known.
        assert math.sqrt(cov[5, 5] + cov[11, 11] - 2.0 * cov[5, 11]) < 2e-3


def test_parallel_gives_roll_on_a_straight_drive_to_its_sigma() -> None:
    case = on_path(make_case(count=COUNT), STRAIGHT)
    values = with_planes(case.truth, np.array([0.0, 0.0, GROUND_Z]))
    observations = observed(case.problem, case.truth, values.atVector(G))
    base = merged(
        pose_graph(case.problem, QUIET),
        cloud_graph(case.problem, case.measured, case.information),
        prior_graph(case.problem, case.problem.lidars),
    )
    unit = scaling(2)
    flat = replace(case.problem, floors=np.zeros(3))
    for degrees, expected in ((0.05, 8.7e-4), (0.5, 8.7e-3)):
        config = GroundConfig(vehicle_height=VEHICLE_HEIGHT, parallel_sigma_deg=degrees)
        graph = merged(base, ground_graph(flat, observations, config))
        cov = np.linalg.inv(vehicle_information(case, graph, values)) * np.outer(unit, unit)
        # With 16 scans of sway, which the drive does not know either.
        sway = math.hypot(expected, 1e-3 / 4.0)
        assert math.sqrt(cov[0, 0]) == pytest.approx(sway, rel=0.1)
    alone = merged(base, ground_graph(case.problem, observations, HEIGHT_KNOWN))
    cov = np.linalg.inv(vehicle_information(case, alone, values)) * np.outer(unit, unit)
    assert math.sqrt(cov[0, 0]) > 0.015


# ------------------------------------------------------------------ noise and wrong planes


def test_solved_errors_are_what_the_graph_claims() -> None:
    case = on_path(make_case(count=COUNT), S_CURVE)
    g = np.array([0.0, 0.0, GROUND_Z])
    unit = scaling(2)
    squares, plane_squares = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        draws = SIGMAS * rng.normal(size=(2 * COUNT, 3))
        observations = observed(case.problem, case.truth, g, draws.__getitem__)
        measured = [
            gtsam.Pose3.Expmap(
                np.linalg.solve(np.linalg.cholesky(info).T, rng.normal(size=6))
            ).compose(Z)
            for Z, info in zip(case.measured, case.information, strict=True)
        ]
        height = VEHICLE_HEIGHT + 0.005 * rng.normal()
        config = GroundConfig(vehicle_height=height)
        start = moved(case.truth, seed, 0.01, 0.03)
        start.insert(ground_values(case.problem, observations, start, config))
        graph = merged(
            pose_graph(case.problem, QUIET),
            cloud_graph(case.problem, measured, case.information),
            ground_graph(case.problem, observations, config),
        )
        solved = optimise(graph, start, 50)
        error = np.concatenate(
            [
                right_to_vehicle_axes(case.problem.extrinsic(solved, name))
                @ gtsam.Pose3.Logmap(
                    case.problem.extrinsic(case.truth, name).between(
                        case.problem.extrinsic(solved, name)
                    )
                )
                for name in case.problem.lidars
            ]
        )
        D = vehicle_information(case, graph, solved)
        squares.append((error / unit) @ D @ (error / unit))
        plane_squares.append(plane_squares_of(case.problem, observations, solved).sum())
    # 144 degrees of freedom: 110 to 181 in 95 of 100 cases. No heave is drawn, z claims too much.
    assert 95.0 < sum(squares) < 190.0
    # 96 residuals, less what the plane and the extrinsics take.
    assert 75.0 < np.mean(plane_squares) < 100.0


def test_wrong_planes_are_dropped_and_good_ones_kept() -> None:
    case = on_path(make_case(count=COUNT), S_CURVE)
    g = np.array([0.0, 0.0, GROUND_Z])
    rng = np.random.default_rng(5)
    wrong = {
        3: np.array([0.0, 0.0, 0.15]),
        7: np.array([0.05, 0.0, 0.0]),
        20: np.array([0.0, -0.03, -0.4]),
    }
    observations = observed(
        case.problem, case.truth, g, lambda n: SIGMAS * rng.normal(size=3) + wrong.get(n, 0.0)
    )
    # At the guesses: 3 degrees and 0.1 m off, and planes found from those.
    start = gtsam.Values(case.truth)
    rng = np.random.default_rng(1)
    for name in case.problem.lidars:
        d = np.array([math.radians(3.0)] * 3 + [0.1] * 3) * rng.uniform(-1.0, 1.0, 6)
        guess = retract_vehicle_axes(case.problem.extrinsic(case.truth, name), d)
        keys = case.problem.extrinsic_keys_of(name)
        base = start.atPose3(E) if len(keys) > 1 else gtsam.Pose3()
        start.update(keys[-1], base.between(guess))
    start.insert(ground_values(case.problem, observations, start, HEIGHT_KNOWN))
    base_graph = merged(
        pose_graph(case.problem, QUIET),
        cloud_graph(case.problem, case.measured, case.information),
    )
    values, weights = start, full_weights(case.problem, observations)
    for _ in range(4):
        graph = ground_graph(case.problem, observations, HEIGHT_KNOWN, weights)
        values = optimise(merged(base_graph, graph), values, 50)
        weights = ground_weights(case.problem, observations, values)
    dropped = np.flatnonzero(weights.planes == 0.0)
    assert dropped.tolist() == sorted(wrong)
    good = np.delete(weights.planes, dropped)
    assert np.mean(good == 1.0) > 0.9
    assert values.atVector(G) == pytest.approx(g, abs=1e-3)
    # Each pose of a wrong plane is still seen by the other LiDAR.
    assert np.all(weights.stands > 0.5)


def test_few_observations_are_all_believed() -> None:
    case = make_case(count=3)
    g = np.array([0.01, 0.02, 0.3])
    observations = observed(case.problem, case.truth, g, lambda n: np.full(3, 0.02 * n))
    weights = ground_weights(case.problem, observations, with_planes(case.truth, g))
    assert weights.planes.tolist() == [1.0] * 6


def test_on_a_ramp_the_vehicle_does_not_stand_on_the_plane() -> None:
    slopes = [0.0] * 10 + [0.0, 0.12, 0.12, -0.12, -0.12, 0.0]
    poses = path([-0.1] * COUNT, slopes)
    # The last place is level and low again; the one after the summit is not.
    case = on_path(make_case(count=COUNT), poses)
    g = np.array([0.0, 0.0, GROUND_Z])
    observations = observed(case.problem, case.truth, g)
    weights = ground_weights(case.problem, observations, with_planes(case.truth, g))
    # The LiDARs see the level ground from the ramp as well as from before it.
    assert weights.planes.tolist() == [1.0] * 32
    assert weights.stands.tolist() == [1.0] * 11 + [0.0] * 4 + [1.0]


def test_on_a_platform_the_vehicle_does_not_stand_on_the_plane() -> None:
    poses = path([-0.1] * COUNT)
    for i in (9, 10):
        poses[i] = moved_map(poses[i], np.array([0.0, 0.0, 0.1]))
    case = on_path(make_case(count=COUNT), poses)
    g = np.array([0.0, 0.0, GROUND_Z])
    observations = observed(case.problem, case.truth, g)
    weights = ground_weights(case.problem, observations, with_planes(case.truth, g))
    assert weights.planes.tolist() == [1.0] * 32
    assert np.flatnonzero(weights.stands < 1.0).tolist() == [9, 10]
    assert weights.stands[[9, 10]].tolist() == [0.0, 0.0]


def test_a_pose_that_has_followed_a_wrong_plane_does_not_excuse_it() -> None:
    case = on_path(make_case(count=COUNT), S_CURVE)
    g = np.array([0.0, 0.0, GROUND_Z])
    wrong = np.array([0.0, 0.0, 0.1])
    # Both LiDARs say so at the fifth pose, and the solve has lifted it by just that.
    observations = observed(
        case.problem, case.truth, g, lambda n: wrong if n % COUNT == 5 else 0.0 * wrong
    )
    values = with_planes(case.truth, g)
    values.update(key_vehicle(5), moved_map(values.atPose3(key_vehicle(5)), wrong))
    assert plane_squares_of(case.problem, observations, values).max() < 1e-9
    weights = ground_weights(case.problem, observations, values)
    assert np.flatnonzero(weights.planes < 1.0).tolist() == [5, 5 + COUNT]
    assert weights.stands[5] == 0.0


# ------------------------------------------------------------------ heave between scan and pose


def one_later(
    apart_ns: int, heave_m: float, count: int = 80
) -> tuple[Case, list[GroundObservation]]:
    """Smoothed poses; the second LiDAR saw the vehicle lifted by something else."""
    case = on_path(make_case(count=count), path([-0.05] * count))
    case = replace(case, problem=replace(case.problem, motion={0: np.eye(6 * count)}))
    rng = np.random.default_rng(5)
    later = case.problem.lidars[1]

    def off(n: int) -> Array:
        noise = SIGMAS * rng.normal(size=3)
        if n >= count:  # of the second LiDAR
            noise[2] += heave_m * rng.normal()
        return np.asarray(noise)

    observations = observed(case.problem, case.truth, np.array([0.0, 0.0, GROUND_Z]), off)
    return case, [replace(o, apart_ns=apart_ns * (o.lidar == later)) for o in observations]


def heave_found(case: Case, observations: Sequence[GroundObservation]) -> Array:
    """(n,) of all observations."""
    values = with_planes(case.truth, np.array([0.0, 0.0, GROUND_Z]))
    return ground_weights(case.problem, observations, values).heave_m


@pytest.mark.parametrize("heave_m", [0.004, 0.007, 0.015])
def test_heave_between_scans_is_read_off_the_scans(heave_m: float) -> None:
    case, observations = one_later(40_000_000, heave_m)
    found = heave_found(case, observations)
    assert found[:80].tolist() == [0.0] * 80
    # 80 pairs tell a median to 13 percent.
    assert found[80:] == pytest.approx(np.full(80, heave_m), rel=0.35)


def test_where_scans_share_the_heave_none_is_found() -> None:
    assert heave_found(*one_later(40_000_000, 0.0)).max() < 0.0015
    # A few milliseconds apart it is not even asked, nor are poses that know their heave.
    assert not heave_found(*one_later(4_000_000, 0.007)).any()
    case, observations = one_later(40_000_000, 0.007)
    given = replace(case, problem=replace(case.problem, motion={}))
    assert not heave_found(given, observations).any()


def test_heave_between_a_few_scans_is_that_of_two() -> None:
    case, observations = one_later(40_000_000, 0.0, count=8)
    expected = math.sqrt(2.0) * HEAVE_SIGMA_M
    assert heave_found(case, observations)[8:] == pytest.approx(np.full(8, expected))
    assert full_weights(case.problem, observations).heave_m.tolist() == [0.0] * 8 + [expected] * 8


def test_heave_is_in_the_sigma_of_the_distance_and_in_nothing_else() -> None:
    case, observations = one_later(40_000_000, 0.0, count=2)
    g = np.array([0.0, 0.0, GROUND_Z])
    keys = (X, *case.problem.extrinsic_keys_of(observations[2].lidar))
    anchor = ground_centre(case.problem, 0)
    factor = ground_plane_factor(keys, G, anchor, observations[2], 0.5, 0.007)
    plain = ground_plane_factor(keys, G, anchor, observations[2])
    values = with_planes(case.truth, g)
    expected = plain.unwhitenedError(values) / np.hypot(SIGMAS, [0.0, 0.0, 0.007]) * math.sqrt(0.5)
    assert factor.whitenedError(values) == pytest.approx(expected)


# ------------------------------------------------------------------ a drive


def test_simulated_sweeps_tie_the_lidars_together() -> None:
    """From wrong guesses, with which the sweeps were compensated, and the ground alone."""
    path_to = Path(__file__).parents[2] / "configs" / "scenarios" / "distorted.yaml"
    recording = simulate_drive(load_scenario(path_to), 3)
    truth = recording.truth
    lidars = {
        name: {"topic": name, "initial": guess.model_dump()}
        for name, guess in recording.guesses.items()
    }
    config = parse_config({"lidars": lidars, "reference": "rear"}, "simulated", path_to.parent)
    # One LiDAR sees a target, in the first circle and in the second.
    stamps = list(recording.scan_stamps_ns("front"))[20:-20:10]
    clouds = tuple(TargetCloud("front", 0, t, np.zeros((1, 3)), "cloud") for t in stamps)
    clouds += (replace(clouds[0], lidar="rear"),)
    grid = np.arange(truth.start_ns, truth.end_ns, 10_000_000, dtype=np.int64)
    trajectory = GivenTrajectory(Trajectory(grid, truth.T_map_vehicle(grid)))
    observations, warnings = measure_grounds(
        [recording],
        [trajectory],
        [TargetObservation(0, "chair", np.zeros(3), clouds)],
        config,
        SilentProgress(),
    )
    assert warnings == ()
    assert len(observations) == 2 * len(stamps)

    rng = np.random.default_rng(0)
    sigmas = np.array([3e-4] * 3 + [2e-3] * 3)
    poses = [
        T.retract(sigmas * rng.normal(size=6))
        for T in truth.T_map_vehicle(np.array(stamps, dtype=np.int64))
    ]
    none = np.zeros(0, dtype=np.int64)
    problem = replace(
        make_case(count=2).problem,
        guesses={name: guess.pose() for name, guess in recording.guesses.items()},
        poses=tuple((0, t) for t in stamps),
        T_map_vehicle=tuple(poses),
        cloud_lidar=none,
        cloud_pose=none,
        cloud_placement=none,
        placements=0,
    )
    exact = RangeErrors(*[1e-5] * 4)  # as they are simulated
    # The poses do not know of the heave.
    noise = PoseNoise(3e-4, math.hypot(2e-3, HEAVE_SIGMA_M), 1e-5, 1e-4, 4.0)
    ground = GroundConfig(vehicle_height=0.0)
    values = initial_values(problem, ())
    values.insert(ground_values(problem, observations, values, ground))
    base = merged(pose_graph(problem, noise), prior_graph(problem, problem.lidars))
    weights = full_weights(problem, observations)
    for _ in range(2):
        graph = merged(base, ground_graph(problem, observations, ground, weights, ranges=exact))
        values = optimise(graph, values, 50)
        weights = ground_weights(problem, observations, values)
    assert weights.planes.min() > 0.5

    front, rear = (
        vehicle_axes_difference(problem.extrinsic(values, name), truth.T_vehicle_lidar[name])
        for name in ("front", "rear")
    )
    # S2S to hundredths of a milliradian and of a millimetre, roll and pitch to the vehicle to the
    # poses' noise, and its height to the 5 mm that the scenario draws.
    assert np.abs(front[:2] - rear[:2]).max() < 3e-5
    between = problem.extrinsic(values, "rear").between(problem.extrinsic(values, "front"))
    true_between = truth.T_vehicle_lidar["rear"].between(truth.T_vehicle_lidar["front"])
    up = truth.T_vehicle_lidar["rear"].rotation().matrix()[2]
    # Yaw and place are the guesses': the height is compared where both agree on the ground.
    assert abs(up @ (between.translation() - true_between.translation())) < 1.5e-3
    assert np.abs(front[:2]).max() < 1.5e-4
    assert abs(front[5] - (truth.level_z_map - recording.world.ground_z_map)) < 3e-3


@pytest.mark.parametrize("scans", [5, 40])
def test_scans_of_one_place_know_the_waves_of_the_ground_as_one_does(scans: int) -> None:
    """By what each says of how often it counts, and not by the weight of a view once more."""
    case = make_case(count=scans)
    still = on_path(case, [case.truth.atPose3(X)] * scans)
    values = with_planes(still.truth, np.array([0.003, 0.0, GROUND_Z]))
    one, *_ = observed(still.problem, still.truth, np.array([0.0, 0.0, GROUND_Z]))
    floors = np.array([NORMAL_FLOOR_RAD, NORMAL_FLOOR_RAD, DISTANCE_FLOOR_M])
    one = replace(one, cov=np.diag(floors**2))
    alike = [
        replace(one, stamp_ns=stamp_ns, repeated=np.diag((scans - 1.0) * floors**2))
        for _, stamp_ns in still.problem.poses
    ]

    def squares(observations: Sequence[GroundObservation]) -> float:
        graph = ground_graph(still.problem, observations, GroundConfig(use=True))
        factors = [graph.at(i) for i, kind in enumerate(graph.kinds) if kind == "ground_plane"]
        assert len(factors) == len(observations)
        return sum(factor.error(values) for factor in factors)

    assert squares(alike) == pytest.approx(squares([one]), rel=1e-6)
    # Before the waves are known, a view counts as four scans at most.
    assert 2.0 < squares([replace(o, repeated=None) for o in alike]) / squares([one]) < 4.0


def test_on_grass_planes_tell_no_more_than_each_lidar_sees_its_frame() -> None:
    """What all ground that a LiDAR sees is turned and lifted by is the LiDAR's own turn and height,
    however many scans there are."""
    case = make_case(count=40)
    g = np.array([0.0, 0.0, GROUND_Z])
    seen = [
        replace(o, by_range_bias=np.zeros((3, 3))) for o in observed(case.problem, case.truth, g)
    ]
    config = GroundConfig(use=True)
    values = gtsam.Values(case.truth)
    values.insert(ground_values(case.problem, seen, values, config))
    base = merged(
        pose_graph(case.problem, PoseNoise(1e-4, 1e-3, 1e-5, 1e-4, 4.0)),
        prior_graph(case.problem, case.problem.lidars),
    )

    def known(tilt_rad: float, height_m: float) -> Array:
        """1 sigma of the second LiDAR against the first about two level axes, and of its height."""
        ranges = RangeErrors(ground_tilt_rad=tilt_rad, ground_height_m=height_m)
        graph = merged(base, ground_graph(case.problem, seen, config, ranges=ranges))
        S = case.problem.extrinsic_keys_of("front")[-1]
        cov = gtsam.Marginals(graph, values).marginalCovariance(S)
        up = case.problem.extrinsic(values, "front").rotation().matrix()[2]
        return np.sqrt([*np.linalg.eigvalsh(cov[:3, :3])[:2], up @ cov[3:, 3:] @ up])

    on_road, on_grass = known(0.0, 0.0), known(1e-3, 0.0)
    assert on_road[:2].max() < 5e-4
    assert on_grass[:2] == pytest.approx(np.hypot(on_road[:2], math.sqrt(2.0) * 1e-3), rel=0.02)
    lifted = known(0.0, 0.01)
    assert lifted[:2] == pytest.approx(on_road[:2], rel=1e-3)
    assert lifted[2] == pytest.approx(math.hypot(on_road[2], math.sqrt(2.0) * 0.01), rel=0.02)
