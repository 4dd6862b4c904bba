"""What walls say of slow errors of the vehicle's sensors."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array
from caliv_graph.structure.problem import Problem, part_of, with_hold
from caliv_graph.structure.slow_errors import (
    of_moved_prior,
    place_all,
    scans_for_errors,
    seeing_lidars,
    told_of_errors,
    told_of_poses,
)
from caliv_graph.structure.solve import Solved
from caliv_graph.structure.thinning import FEW_SCANS
from tests.structure.test_solve import problem_of, solve
from tests.structure.yards import STEP_NS, figure_eight, yard

POSES = 60


def test_a_moved_prior_is_eliminated_as_from_the_joint_quadratic() -> None:
    rng = np.random.default_rng(3)
    rows, of_prior, prior_rows = rng.normal(size=(20, 7)), np.zeros((9, 7)), rng.normal(size=(9, 4))
    of_prior[:, :4] = prior_rows
    gain, residual, prior_residual = (
        rng.normal(size=(4, 3)),
        rng.normal(size=20),
        rng.normal(size=9),
    )
    # Residuals rows d - residual of all else, prior_rows (d + gain b) - residual of the prior.
    J = np.block([[rows, np.zeros((20, 3))], [of_prior, prior_rows @ gain]])
    right = J.T @ np.concatenate([residual, prior_residual])
    whole = J.T @ J
    own, rest = slice(7, 10), slice(0, 7)
    across = whole[own, rest] @ np.linalg.inv(whole[rest, rest])

    information, gradient = of_moved_prior(
        whole[rest, rest],
        right[rest],
        prior_rows.T @ prior_rows,
        prior_rows.T @ prior_residual,
        gain,
    )

    assert information == pytest.approx(whole[own, own] - across @ whole[rest, own])
    assert gradient == pytest.approx(right[own] - across @ right[rest])


@cache
def past_walls() -> Problem:
    return problem_of(yard(), figure_eight(POSES), seed=5)


@cache
def solved() -> Solved:
    return solve(past_walls())


def swinging(period_s: float) -> tuple[Array, Array]:
    """(6 m, 2) gain of an error along map x and y that swings once in a period, and its sine."""
    _, yaw = figure_eight(POSES)
    at = 1e-9 * STEP_NS * np.arange(POSES)
    wave = np.sin(2.0 * np.pi * at / period_s)
    R = np.array([[[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]] for a in yaw])
    gain = np.zeros((POSES, 6, 2))
    gain[:, 3:5] = wave[:, None, None] * R
    return gain.reshape(6 * POSES, 2), wave


@pytest.mark.parametrize("north_m", [0.0, 0.03])
def test_walls_tell_how_far_the_poses_swing(north_m: float) -> None:
    """Poses that swing by 30 mm beside their own slow errors of 20 mm."""
    gain, wave = swinging(period_s=6.0)
    problem = past_walls()
    R, _ = stack(problem.prior.T_map_vehicle)
    off = np.zeros((POSES, 6))
    off[:, 3:] = np.einsum("nji,j->ni", R, [0.0, north_m, 0.0]) * wave[:, None]
    means = [T.retract(d) for T, d in zip(problem.prior.T_map_vehicle, off, strict=True)]
    problem = replace(problem, prior=replace(problem.prior, T_map_vehicle=tuple(means)))

    found = solve(problem) if north_m else solved()
    information, gradient = told_of_errors(found, problem.prior, gain)

    swing = np.linalg.solve(information, gradient)
    sigma = np.sqrt(np.diag(np.linalg.inv(information)))
    assert (sigma < 6e-3).all()
    assert (np.abs(swing - [0.0, north_m]) < 3.0 * sigma).all()


def test_a_lidar_without_sightings_is_not_put_at_its_guess() -> None:
    problem = past_walls()
    both = seeing_lidars(solved())
    assert set(both) == set(problem.patches.lidars)
    of = problem.patches.scan_lidar[problem.patches.scan]
    alone = solve(part_of(problem, of == 1))
    assert set(seeing_lidars(alone)) == {problem.patches.lidars[1]}


def test_few_scans_of_the_first_part_are_used() -> None:
    patches = past_walls().patches

    used = scans_for_errors(patches, 50 * STEP_NS)

    assert used.stamps_ns.max() <= 50 * STEP_NS
    for lidar in range(2):
        count = np.count_nonzero(used.scan_lidar == lidar)
        assert FEW_SCANS <= count <= FEW_SCANS + 11
    every = set(
        zip(patches.stamps_ns[patches.scan].tolist(), patches.scatter_m.tolist(), strict=True)
    )
    own = zip(used.stamps_ns[used.scan].tolist(), used.scatter_m.tolist(), strict=True)
    assert set(own) <= every


def test_a_few_scans_of_one_drive_place_no_lidar_of_all() -> None:
    patches = past_walls().patches
    late = replace(patches, drive=1, lidars=("late", patches.lidars[1]))

    assert place_all([scans_for_errors(patches, 120 * STEP_NS)], [patches])
    assert not place_all([scans_for_errors(patches, 20 * STEP_NS)], [patches])
    assert not place_all([patches], [patches, late])
    assert place_all([patches, late], [patches, late])


def test_what_walls_say_of_poses_is_without_the_prior() -> None:
    """As many poses as there are: the joint quadratic, extrinsics and all eliminated, less it."""
    problem, found = past_walls(), solved()
    every = np.arange(POSES)
    H, b = with_hold(found.problem, found.state, found.system)
    own, rest = slice(0, 6 * POSES), slice(6 * POSES, len(H))
    across = np.linalg.solve(H[rest, rest], np.column_stack([H[rest, own], b[rest]]))
    alone = H[own, own] - H[own, rest] @ across[:, :-1]
    prior = problem.prior.information

    information, gradient = told_of_poses(found, problem.prior, every)

    size = np.abs(information).max()
    # Not `pytest.approx`: half a million numbers, one by one.
    np.testing.assert_allclose(information, alone - prior, 0.0, 1e-6 * size, equal_nan=False)
    moved = found.state.moved[own]
    expected = alone @ moved + b[own] - H[own, rest] @ across[:, -1]
    assert gradient == pytest.approx(expected, abs=1e-6 * np.abs(expected).max())
    some, _ = told_of_poses(found, problem.prior, every[::5])
    values = np.linalg.eigvalsh(some)
    assert values[0] > -1e-6 * values[-1]
