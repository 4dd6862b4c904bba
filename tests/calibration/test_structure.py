"""Structure as a factor of the calibration graph, against the same quadratic added by hand."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.assemble import height_is_used
from caliv_graph.calibration.graph import (
    CalibrationGraph,
    initial_values,
    merged,
    motion_graph,
    offset_graph,
    optimise,
    pose_graph,
    prior_graph,
)
from caliv_graph.calibration.linear import CloudLinearisation, retract
from caliv_graph.calibration.problem import Problem, moved_map, pose_problem
from caliv_graph.calibration.reduced import Reduced, reduce_to_extrinsics
from caliv_graph.calibration.structure import FAR_M, FAR_RAD, far_from, structure_graph
from caliv_graph.config.model import Config
from caliv_graph.conventions import key_imu_rotation, key_lever_arm, key_offset, key_vehicle
from caliv_graph.products import (
    Array,
    IntArray,
    PoseNoise,
    Stance,
    StandingErrors,
    StructureTerm,
    Trajectory,
)
from caliv_graph.trajectory.select import GivenTrajectory, VehicleTrajectory
from tests.calibration.problems import PERIOD_NS, eight
from tests.calibration.test_vehicle_parameters import CONFIG, WANTED, drive
from tests.samples import MOUNTINGS, pose

NOISE = PoseNoise(2e-4, 2e-3, 1e-3, 0.01, 1.5)
ORIGIN = (4.0e5, 5.0e6, 300.0)
NO_CLOUDS = CloudLinearisation((), (), ())


def config_of(*lidars: str, reference: str = "rear", time_offset: bool = False) -> Config:
    raw = {
        "lidars": {
            n: {
                "topic": n,
                "initial": dict(zip(("xyz", "rpy_deg"), MOUNTINGS[n], strict=True)),
            }
            for n in lidars
        },
        "reference": reference,
        "solve": {"time_offset": time_offset},
        "noise": {"pose_time_offset_s": 0.0},
    }
    return Config.model_validate(raw)


def given(count: int = 5) -> GivenTrajectory:
    stamps = np.arange(count, dtype=np.int64) * PERIOD_NS
    return GivenTrajectory(Trajectory(stamps, tuple(eight(count, ORIGIN))))


def term_of(
    trajectory: VehicleTrajectory,
    stamps: IntArray,
    lidars: tuple[str, ...],
    offsets: tuple[str, ...] = (),
    parameters: dict[str, Array | gtsam.Rot3] | None = None,
    seed: int = 3,
) -> StructureTerm:
    """A semidefinite term of a random half of all directions, linearised near the guesses."""
    rng = np.random.default_rng(seed)
    scale = np.concatenate(
        [
            np.tile([1e-3] * 3 + [5e-3] * 3, len(stamps)),
            np.full(3 * len(parameters or {}), 5e-3),
            np.full(len(offsets), 1e-3),
            np.tile([1e-3] * 3 + [5e-3] * 3, len(lidars)),
        ]
    )
    root = rng.normal(size=(len(scale) // 2, len(scale))) / scale
    R, t = trajectory.poses_at(stamps)
    near = np.array([2e-3] * 3 + [0.01] * 3)
    return StructureTerm(
        drive=0,
        stamps_ns=stamps,
        T_map_vehicle=tuple(
            gtsam.Pose3(gtsam.Rot3(a), b).retract(0.1 * near * rng.normal(size=6))
            for a, b in zip(R, t, strict=True)
        ),
        parameters=parameters or {},
        time_offsets_s=dict.fromkeys(offsets, 4e-3),
        T_vehicle_lidar={n: pose(*MOUNTINGS[n]).retract(near * rng.normal(size=6)) for n in lidars},
        information=root.T @ root,
        gradient=root.T @ rng.normal(size=len(root)),
        strips=(),
        offset_m=0.002,
    )


def at_guesses(term: StructureTerm, trajectory: GivenTrajectory) -> StructureTerm:
    """The same quadratic of all poses, about the given poses and the guesses."""
    return replace(
        term,
        T_map_vehicle=trajectory.trajectory.T_map_vehicle,
        T_vehicle_lidar={n: pose(*MOUNTINGS[n]) for n in term.T_vehicle_lidar},
    )


def by_hand(problem: Problem, term: StructureTerm, values: gtsam.Values) -> float:
    """The quadratic of a term, its arguments as differences of the graph's values."""
    index = {stamp: i for i, (_, stamp) in enumerate(problem.poses)}
    d = [
        gtsam.Pose3.Logmap(
            moved_map(T, -problem.origins_map[0]).between(values.atPose3(key_vehicle(index[stamp])))
        )
        for stamp, T in zip(term.stamps_ns.tolist(), term.T_map_vehicle, strict=True)
    ]
    for value in term.parameters.values():
        if isinstance(value, gtsam.Rot3):
            d.append(gtsam.Rot3.Logmap(value.between(values.atRot3(key_imu_rotation()))))
        else:
            d.append(values.atVector(key_lever_arm()) - value)
    for name, offset_s in term.time_offsets_s.items():
        key = key_offset(problem.lidars.index(name))
        d.append((values.atVector(key) if values.exists(key) else np.zeros(1)) - offset_s)
    d += [
        gtsam.Pose3.Logmap(T.between(problem.extrinsic(values, name)))
        for name, T in term.T_vehicle_lidar.items()
    ]
    v = np.concatenate(d)
    return float(0.5 * v @ term.information @ v - term.gradient @ v)


def random_steps(values: gtsam.Values, keys: list[int], size: float) -> list[gtsam.Values]:
    rng = np.random.default_rng(8)
    zero = values.zeroVectors()
    sizes = [zero.at(key).size for key in keys]
    return [retract(values, keys, size * rng.normal(size=sum(sizes))) for _ in range(6)]


@pytest.mark.parametrize("case", ["all", "without_reference", "held_offset"])
def test_the_factor_is_the_quadratic_of_the_term(case: str) -> None:
    trajectory = given()
    stamps = trajectory.trajectory.stamps_ns[[0, 2, 3]]
    free = case != "held_offset"
    config = config_of("front", "rear", "left", time_offset=free)
    lidars = ("front", "left") if case == "without_reference" else ("front", "rear", "left")
    term = term_of(trajectory, stamps, lidars, ("left",))
    problem = pose_problem(
        [], [trajectory], config, others=config.lidars, kept_ns={0: trajectory.trajectory.stamps_ns}
    )
    graph = structure_graph(problem, [term])
    values = initial_values(problem, [], term.T_vehicle_lidar)

    assert graph.kinds == ["structure"]
    keys = [int(key) for key in graph.keyVector()]
    # The expected size of what is neglected is the step times a few sigmas.
    for step in random_steps(values, keys, 1e-6):
        change = by_hand(problem, term, step) - by_hand(problem, term, values)
        assert graph.error(step) - graph.error(values) == pytest.approx(change, rel=2e-2, abs=2e-4)
    assert graph.error(values) > -1e-6


def test_lever_arm_and_imu_are_arguments_too() -> None:
    arm, R = drive(1).data.lever_arm, drive(1).data.T_vehicle_imu.rotation()
    parameters: dict[str, Array | gtsam.Rot3] = {
        "gnss.lever_arm": np.asarray(arm) + 0.01,
        "imu.T_vehicle_imu": R,
    }
    term = term_of(drive(1), WANTED[:3], ("front",), parameters=parameters)
    problem = pose_problem([], [drive(1)], CONFIG, others=["front"], kept_ns={0: WANTED})
    held = replace(problem, motion_terms={}, parameters={})
    values = initial_values(problem, [])

    graph, fewer = structure_graph(problem, [term]), structure_graph(held, [term])

    keys = [int(key) for key in graph.keyVector()]
    assert {key_lever_arm(), key_imu_rotation()} == set(keys) - {
        int(key) for key in fewer.keyVector()
    }
    for step in random_steps(values, keys, 1e-6):
        change = by_hand(problem, term, step) - by_hand(problem, term, values)
        assert graph.error(step) - graph.error(values) == pytest.approx(change, rel=2e-2, abs=2e-4)


def reduced_of(problem: Problem, term: StructureTerm) -> tuple[Reduced, gtsam.Values]:
    base = merged(
        pose_graph(problem, NOISE, motion_graph(problem)),
        offset_graph(problem),
        structure_graph(problem, [term]),
    )
    values = initial_values(problem, [])
    none = np.zeros((0, 0)), np.zeros(0)
    return reduce_to_extrinsics(problem, values, base, none, NO_CLOUDS), values


def test_reduced_to_the_extrinsics_it_is_the_term_with_the_poses_prior() -> None:
    trajectory = given()
    stamps = trajectory.trajectory.stamps_ns
    # Linearised at the guesses, so that no number is neglected.
    term = at_guesses(term_of(trajectory, stamps, ("front", "rear")), trajectory)
    config = config_of("front", "rear")
    problem = pose_problem([], [trajectory], config, others=config.lidars, kept_ns={0: stamps})

    reduced, values = reduced_of(problem, term)

    # By hand: poses under their prior and the term, eliminated; right to vehicle axes.
    alone = reduce_to_extrinsics(
        problem,
        values,
        pose_graph(problem, NOISE),
        (np.zeros((0, 0)), np.zeros(0)),
        NO_CLOUDS,
    ).system
    m = 6 * len(stamps)
    whole, b = term.information.copy(), term.gradient.copy()
    whole[:m, :m] += alone.H[:m, :m]
    pull = np.linalg.solve(whole[:m, :m], np.column_stack([whole[:m, m:], b[:m]]))
    D = whole[m:, m:] - whole[m:, :m] @ pull[:, :-1]
    c = b[m:] - whole[m:, :m] @ pull[:, -1]
    axes = np.zeros((12, 12))
    for i, name in enumerate(problem.lidars):
        R = pose(*MOUNTINGS[name]).rotation().matrix()
        axes[6 * i : 6 * i + 3, 6 * i : 6 * i + 3] = R
        axes[6 * i + 3 : 6 * i + 6, 6 * i + 3 : 6 * i + 6] = R
    np.testing.assert_allclose(reduced.D, axes @ D @ axes.T, rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(reduced.c, axes @ c, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize(("height", "tilt"), [(True, True), (True, False), (False, True)])
def test_errors_of_the_stand_count_once_as_variables_of_the_graph(height: bool, tilt: bool) -> None:
    trajectory = given()
    stamps = trajectory.trajectory.stamps_ns
    config = config_of("front", "rear")
    term = at_guesses(term_of(trajectory, stamps, ("front", "rear")), trajectory)
    problem = pose_problem([], [trajectory], config, others=config.lidars, kept_ns={0: stamps})
    rng, n = np.random.default_rng(6), len(term.gradient)
    kinds = {"h": (1, 0.02)} if height else {}
    kinds |= {"p": (2, 2e-3)} if tilt else {}
    sigmas = np.concatenate([np.full(size, sigma) for size, sigma in kinds.values()])
    rows, right = rng.standard_normal((4, n + len(sigmas))), rng.standard_normal(4)
    scale = np.concatenate([np.sqrt(np.diag(term.information)) / 2.0, 2.0 / sigmas])
    H, b = (rows * scale).T @ (rows * scale), (rows * scale).T @ right
    standing = StandingErrors(
        height=height,
        tilt=tilt,
        value=0.3 * sigmas,
        coupling=H[:n, n:],
        information=H[n:, n:],
        gradient=b[n:],
        prior=sigmas**-2.0,
    )
    # Eliminated under their priors, as in a term.
    with_priors = H[n:, n:] + np.diag(sigmas**-2.0)
    pull = b[n:] - standing.prior * standing.value
    by_them = np.linalg.solve(with_priors, np.column_stack([H[n:, :n], pull]))
    term = replace(
        term,
        information=term.information + H[:n, :n] - H[:n, n:] @ by_them[:, :-1],
        gradient=term.gradient + b[:n] - H[:n, n:] @ by_them[:, -1],
        standing=standing,
    )
    values = initial_values(problem, [])
    priors = CalibrationGraph()
    for letter, (size, sigma) in kinds.items():
        noise = gtsam.noiseModel.Isotropic.Sigma(size, sigma)
        key = gtsam.symbol(letter, 0)
        priors.append("ground_height", gtsam.PriorFactorVector(key, np.zeros(size), noise))
        values.insert(key, np.zeros(size))
    none = np.zeros((0, 0)), np.zeros(0)

    def reduced(base: CalibrationGraph) -> Reduced:
        whole = merged(pose_graph(problem, NOISE), base)
        return reduce_to_extrinsics(problem, values, whole, none, NO_CLOUDS)

    eliminated = reduced(structure_graph(problem, [term]))
    kept = reduced(merged(structure_graph(problem, [term], standing=[0]), priors))

    np.testing.assert_allclose(kept.D, eliminated.D, rtol=1e-5, atol=1e-2)
    np.testing.assert_allclose(kept.c, eliminated.c, rtol=1e-5, atol=1e-2)
    # Planes of another LiDAR that know the errors add nothing but that.
    known = merged(structure_graph(problem, [term], standing=[0]), priors, priors)
    assert np.trace(reduced(known).D - eliminated.D) > 0.0


def test_a_semidefinite_term_is_optimised_in_the_whole_graph() -> None:
    trajectory = given()
    stamps = trajectory.trajectory.stamps_ns
    config = config_of("front", "rear")
    term = term_of(trajectory, stamps, ("front", "rear"))
    problem = pose_problem([], [trajectory], config, others=config.lidars, kept_ns={0: stamps})
    graph = merged(
        pose_graph(problem, NOISE),
        structure_graph(problem, [term]),
        prior_graph(problem, problem.lidars),
    )
    values = optimise(graph, initial_values(problem, []), 20)

    assert float(np.linalg.norm(graph.linearize(values).gradientAtZero().vector())) < 1e-1


def test_another_map_other_names_and_another_reference_change_nothing() -> None:
    trajectory = given()
    stamps = trajectory.trajectory.stamps_ns
    lidars = ("front", "rear", "left")
    # Linearised at the guesses: E and S_a are curved differently.
    term = at_guesses(term_of(trajectory, stamps, lidars), trajectory)
    problem = pose_problem([], [trajectory], config_of(*lidars), others=lidars, kept_ns={0: stamps})
    first, _ = reduced_of(problem, term)

    T_new_map = gtsam.Pose3(gtsam.Rot3.Yaw(1.1), np.array([-4e5, 20.0, 7.0]))
    moved = GivenTrajectory(
        Trajectory(stamps, tuple(map(T_new_map.compose, trajectory.trajectory.T_map_vehicle)))
    )
    order = ("left", "front", "rear")
    same = replace(term, T_map_vehicle=tuple(map(T_new_map.compose, term.T_map_vehicle)))
    turned = pose_problem(
        [], [moved], config_of(*order, reference="left"), others=order, kept_ns={0: stamps}
    )
    second, _ = reduced_of(turned, same)

    rows = np.concatenate([6 * lidars.index(n) + np.arange(6) for n in order])
    np.testing.assert_allclose(second.D, first.D[np.ix_(rows, rows)], rtol=1e-5, atol=10.0)
    np.testing.assert_allclose(second.c, first.c[rows], rtol=1e-5, atol=1e-2)


def test_a_term_is_linearised_anew_where_a_lidar_is_far_from_where_it_was() -> None:
    trajectory = given()
    term = term_of(trajectory, trajectory.trajectory.stamps_ns, ("front", "rear"))
    there = dict(term.T_vehicle_lidar)
    assert not far_from((term,), there)
    assert not far_from((), there)
    for step, far in ((0.9, False), (1.1, True)):
        for d in (
            [0.0, 0.0, step * FAR_RAD, 0.0, 0.0, 0.0],
            [0.0, 0.0, 0.0, 0.0, step * FAR_M, 0.0],
        ):
            moved = there | {"rear": there["rear"].retract(np.array(d))}
            assert far_from((term,), moved) is far
    # Of a LiDAR that a term says nothing of, it does not matter where it is.
    rear = slice(len(term.information) - 6, None)
    silent = term.information.copy()
    silent[rear] = silent[:, rear] = 0.0
    gone = there | {"rear": pose((9.0, 9.0, 9.0), (0.0, 0.0, 90.0))}
    assert not far_from((replace(term, information=silent),), gone)


def test_a_lidar_or_a_pose_that_the_problem_lacks_is_refused() -> None:
    trajectory = given()
    stamps = trajectory.trajectory.stamps_ns
    term = term_of(trajectory, stamps, ("front", "left"))
    problem = pose_problem(
        [], [trajectory], config_of("front", "rear", "left"), others=["front"], kept_ns={0: stamps}
    )
    with pytest.raises(ValueError, match="'left'"):
        structure_graph(problem, [term])
    with pytest.raises(ValueError, match="pose at"):
        structure_graph(
            pose_problem(
                [],
                [trajectory],
                config_of("front", "rear"),
                others=["front"],
                kept_ns={0: stamps[:2]},
            ),
            [replace(term, T_vehicle_lidar={"front": term.T_vehicle_lidar["front"]})],
        )


def test_the_height_of_the_vehicle_is_used_where_it_is_seen_to_stand() -> None:
    term = term_of(given(), given().trajectory.stamps_ns[:2], ("front", "rear"))
    stance = Stance(np.zeros(1), np.zeros((1, len(term.gradient))), np.eye(1), 0.005, False)
    standing = replace(term, stance=stance)
    assert height_is_used((standing,), target=False)
    assert height_is_used((term, standing), target=False)
    assert not height_is_used((term,), target=False)
    # Planes of the ground stand where a target was seen and no strips stand for them.
    assert height_is_used((term,), target=True)
    assert not height_is_used((replace(term, on_ground=False),), target=True)
    assert height_is_used((replace(term, odometry_of="front"),), target=False)
