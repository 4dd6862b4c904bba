"""Suspects of a solved graph: the quadratic of all parameters, and how the vehicle stands."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pytest
import scipy.sparse

from caliv_graph.calibration.stance import stance_rows
from caliv_graph.calibration.suspects import _Block, _Motion, _Quadratic, _Shared
from caliv_graph.calibration.vehicle_parameters import KEYS
from caliv_graph.conventions import key_height, key_lever_arm, key_offset
from caliv_graph.geometry.se3 import joint_right_to_vehicle_axes
from caliv_graph.products import Array, LinearisedGraph, Stance, StructureTerm
from caliv_graph.trajectory.parameters import LEVER_ARM
from caliv_graph.trajectory.tilt import BODY_SIGMA_RAD
from caliv_graph.uncertainty.suspects import Candidate

ARM = LEVER_ARM.name
M = 15
"""Coordinates of a pose, a lever arm and an extrinsic."""


def half(size: int, seed: int) -> Array:
    rows = np.random.default_rng(seed).standard_normal((2 * size, size))
    return np.asarray(rows.T @ rows)


def graph_of(starts: dict[int, int], lidars: int = 1) -> LinearisedGraph:
    nothing, none = np.zeros((M, M)), np.zeros((0, 0))
    return LinearisedGraph(
        information=nothing,
        gradient=np.zeros(M),
        information_guesses=nothing,
        cloud_jacobian=scipy.sparse.csr_array((0, M)),
        cloud_information=none,
        cloud_gradient=np.zeros(0),
        by_vehicle=none,
        by_extrinsic=none,
        starts=starts,
        pose_information=nothing,
        pose_gradient=np.zeros(M),
        sound_pose_information=nothing,
        sound_pose_gradient=np.zeros(M),
        to_vehicle_axes=np.eye(6 * lidars),
    )


def test_a_parameter_of_structure_is_that_of_the_motion_data() -> None:
    """Structure depends on the lever arm by eliminated poses: on the one that is a candidate."""
    rng = np.random.default_rng(4)
    S, g, W, P = half(M, 1), rng.standard_normal(M), half(6, 2), rng.standard_normal((6, 3))
    by, off = rng.standard_normal((3, 3)), rng.standard_normal(3)
    pull, own, own_gradient = rng.standard_normal(6), half(3, 3), rng.standard_normal(3)
    candidate = Candidate(ARM, np.zeros(3), np.ones(3))
    motion = _Motion(W, pull, [_Block(candidate, poses=P)], own, own_gradient)
    whole, gradient = S.copy(), g.copy()
    whole[:6, :6] += W
    gradient[:6] += pull
    found = _Quadratic(graph_of({}), motion, motion.blocks, {ARM: _Shared(6, by, off)}).scores(
        whole, gradient
    )

    def cost(v: Array) -> float:
        d, x = v[12:], v[:6]
        z = np.concatenate([x, by @ d - off, v[6:12]])
        moved = x - P @ d
        data = 0.5 * moved @ W @ moved - pull @ moved + 0.5 * d @ own @ d - own_gradient @ d
        return float(0.5 * z @ S @ z - g @ z + data)

    basis, zero = np.eye(15), cost(np.zeros(15))
    b = np.array([0.5 * (cost(-e) - cost(e)) for e in basis])
    H = np.array([[cost(e + f) - cost(e) - cost(f) + zero for f in basis] for e in basis])
    inner = np.linalg.solve(H[:12, :12], np.column_stack([H[:12, 12:], b[:12]]))
    assert found.information == pytest.approx(H[12:, 12:] - H[12:, :12] @ inner[:, :3], rel=1e-5)
    assert found.gradient == pytest.approx(b[12:] - H[12:, :12] @ inner[:, 3], rel=1e-5)


def solution_of(
    term: StructureTerm, T_vehicle: gtsam.Pose3, T_lidar: gtsam.Pose3, offset_s: float | None
) -> Any:
    values, starts = gtsam.Values(), {KEYS[ARM]: 6}
    values.insert(key_lever_arm(), np.array([0.1, 0.0, 0.0]))
    if offset_s is not None:
        values.insert(key_offset(0), np.array([offset_s]))
        starts[key_offset(0)] = 9
    axes = joint_right_to_vehicle_axes([T_lidar])
    gradient = np.zeros(M + (offset_s is not None))
    return SimpleNamespace(
        structure=(term,),
        lidars=("front",),
        T_map_vehicle={(0, 7): T_vehicle},
        T_vehicle_lidar={"front": T_lidar},
        values=values,
        factor_kinds=("structure",),
        linearised=SimpleNamespace(starts=starts, gradient=gradient, to_vehicle_axes=axes),
    )


@pytest.mark.parametrize("offset_s", [0.02, None])
def test_the_stance_of_a_term_is_on_the_variables_of_the_graph(offset_s: float | None) -> None:
    """With the time offset of a LiDAR, which the graph estimates or holds at zero."""
    T_vehicle = gtsam.Pose3(gtsam.Rot3.Yaw(0.3), np.array([1.0, 2.0, 0.0]))
    T_lidar = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, 0.3), np.array([2.0, 0.0, 2.0]))
    rng = np.random.default_rng(5)
    rows, step = rng.standard_normal((3, M + 1)), 1e-3 * rng.standard_normal(12)
    cov = np.diag([1e-4, 1e-6, 1e-6])
    stance = Stance(np.zeros(3), rows, cov, height_sigma_m=0.02, tilt_in_term=False)
    term = StructureTerm(
        drive=0,
        stamps_ns=np.array([7]),
        T_map_vehicle=(T_vehicle,),
        parameters={ARM: np.zeros(3)},
        time_offsets_s={"front": 0.005},
        T_vehicle_lidar={"front": T_lidar},
        information=np.zeros((M + 1, M + 1)),
        gradient=np.zeros(M + 1),
        strips=(),
        offset_m=0.0,
        stance=stance,
    )
    moved = solution_of(term, T_vehicle.retract(step[:6]), T_lidar.retract(step[6:]), offset_s)
    (found,) = stance_rows(moved)
    late = (0.0 if offset_s is None else offset_s) - 0.005
    d = np.concatenate([step[:6], [0.1, 0.0, 0.0, late], step[6:]])
    assert found.residual == pytest.approx(rows @ d, abs=1e-6)
    known = rows if offset_s is not None else np.delete(rows, 9, axis=1)
    assert found.rows == pytest.approx(known, abs=1e-12)
    assert found.by_height.tolist() == [1.0, 0.0, 0.0]
    # The term has the height with its assumed sigma; the tilt is assumed here.
    in_graph = 1.0 / (1e-4 + 0.02**2)
    assert found.in_graph == pytest.approx(np.diag([in_graph, 0.0, 0.0]))
    tilt = 1.0 / (1e-6 + BODY_SIGMA_RAD**2)
    assert found.weight == pytest.approx(np.diag([in_graph, tilt, tilt]))


def test_a_height_that_is_a_variable_of_the_graph_is_not_in_a_terms_stance_again() -> None:
    """What is left is the tilt, given the height that the graph has."""
    T = gtsam.Pose3()
    stance = Stance(
        value=np.array([0.01, 2e-3, -1e-3]),
        rows=np.zeros((3, M)),
        cov=np.array([[4e-4, 2e-5, 0.0], [2e-5, 3e-6, 0.0], [0.0, 0.0, 5e-6]]),
        height_sigma_m=0.02,
        tilt_in_term=False,
    )
    term = StructureTerm(
        drive=0,
        stamps_ns=np.array([7]),
        T_map_vehicle=(T,),
        parameters={ARM: np.zeros(3)},
        time_offsets_s={},
        T_vehicle_lidar={"front": T},
        information=np.zeros((M, M)),
        gradient=np.zeros(M),
        strips=(),
        offset_m=0.0,
        stance=stance,
    )
    solution = solution_of(term, T, T, None)
    solution.linearised.starts[key_height(0)] = M
    solution.linearised.gradient = np.zeros(M + 1)
    solution.linearised.to_vehicle_axes = np.hstack([np.zeros((6, 1)), np.eye(6)])[:, 1:]
    solution.values.insert(key_height(0), np.array([0.05]))

    (found,) = stance_rows(solution)

    # By the joint Gaussian of height and tilt: 2e-5 / 4e-4 = 0.05 rad per metre.
    assert found.residual == pytest.approx([2e-3 + 0.05 * (0.05 - 0.01), -1e-3])
    assert found.rows[:, M] == pytest.approx([0.05, 0.0])
    cov = np.diag([3e-6 - 0.05 * 2e-5, 5e-6]) + BODY_SIGMA_RAD**2 * np.eye(2)
    assert found.weight == pytest.approx(np.linalg.inv(cov))
    assert not found.in_graph.any()
    assert not found.by_height.any()
