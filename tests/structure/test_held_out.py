"""A third of the structure, held out: which, and what LiDARs differ by on it."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from caliv_graph.structure.distances import (
    Measured,
    OtherStrips,
    at_extrinsics,
    at_extrinsics_on_the_poses,
    at_guesses,
    at_the_solve,
    other_strips,
)
from caliv_graph.structure.held_out import HeldOut, hold_out
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.problem import Problem, first_state, part_of, placed_patches
from caliv_graph.structure.solve import solve_structure
from caliv_graph.structure.strips import TILE_M
from caliv_graph.structure.term import strips_of
from tests.structure.test_solve import problem_of
from tests.structure.yards import TRUE, figure_eight, yard

FILE_SIGMAS = np.array([1e-4] * 3 + [1e-3] * 3)
COV = np.diag(np.tile(FILE_SIGMAS**2, 2))


def held_out(problem: Problem) -> tuple[HeldOut, np.ndarray, np.ndarray]:
    """Which patches are, and places and normals of all."""
    placed = placed_patches(problem, first_state(problem, TRUE))
    positions = placed.moments_map[:, :3, 3] / placed.moments_map[:, 3, 3, None]
    return hold_out(problem.patches, positions, placed.normals_map), positions, placed.normals_map


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of(yard(), figure_eight(24), 1)


@pytest.fixture(scope="module")
def others(problem: Problem) -> OtherStrips:
    held, _, _ = held_out(problem)
    used = solve_structure(
        part_of(problem, ~held.patches), dict(zip(TRUE, problem.guesses, strict=True))
    )
    assert used is not None
    found = other_strips(used, part_of(problem, held.patches))
    assert found is not None
    return found


def p_value(measured: Measured) -> float:
    d, cov = measured.distances_m, measured.cov_m2
    assert cov is not None
    return float(chi2.sf(d @ np.linalg.solve(cov, d), len(d)))


def test_a_third_of_the_places_is_held_out_with_all_that_stands_there(problem: Problem) -> None:
    held, positions, _ = held_out(problem)
    tile = np.floor(positions[:, :2] / TILE_M).astype(int)
    inside = (tile[:, None] == held.tiles).all(axis=2).any(axis=1)
    assert (inside == held.patches).all()
    assert held.of == len(np.unique(tile, axis=0))
    assert len(held.tiles) == pytest.approx(held.of / 3.0, abs=1.0)


def test_every_lidar_and_direction_has_its_share(problem: Problem) -> None:
    held, _, normals = held_out(problem)
    lidar = problem.patches.scan_lidar[problem.patches.scan]
    sector = np.round(np.arctan2(normals[:, 1], normals[:, 0]) / (np.pi / 2.0)).astype(int) % 2
    for of in (lidar, sector):
        for value in (0, 1):
            assert 0.15 < held.patches[of == value].mean() < 0.5


def test_the_choice_does_not_depend_on_the_order_of_patches(problem: Problem) -> None:
    held, positions, normals = held_out(problem)
    some = np.sort(np.random.default_rng(0).permutation(len(positions)))
    again = hold_out(problem.patches, positions[some], normals[some])
    assert (again.tiles == held.tiles).all()


def test_no_structure_holds_nothing_out(problem: Problem) -> None:
    none: DrivePatches = problem.patches.part(np.zeros(len(problem.patches.scan), dtype=bool))
    held = hold_out(none, np.zeros((0, 3)), np.zeros((0, 3)))
    assert (held.patches.sum(), len(held.tiles), held.of) == (0, 0, 0)


def test_a_calibration_without_the_strips_is_explained_on_them(others: OtherStrips) -> None:
    found = at_the_solve(others)
    assert len(found.distances_m) > 25
    assert p_value(found) > 1e-3
    assert np.sqrt(np.mean(found.distances_m**2)) < 0.004
    assert found.expected_m is not None
    assert np.median(found.thickness_m / found.expected_m) == pytest.approx(0.85, abs=0.35)


def test_a_right_calibration_is_explained_and_a_wrong_one_is_not(others: OtherStrips) -> None:
    rng = np.random.default_rng(2)
    right = {name: T.retract(FILE_SIGMAS * rng.standard_normal(6)) for name, T in TRUE.items()}
    turned = np.array([0.0, 0.0, 0.003, 0.0, 0.0, 0.0])
    wrong = {**right, "front": right["front"].retract(turned)}

    assert p_value(at_extrinsics(others, right, {}, COV)) > 1e-3
    assert p_value(at_extrinsics(others, wrong, {}, COV)) < 1e-9
    # A calibration that knows how bad it is does not contradict.
    vague = COV.copy()
    vague[2, 2] = 0.003**2
    assert p_value(at_extrinsics(others, wrong, {}, vague)) > 1e-3


def test_on_the_poses_of_the_solve_it_is_the_same(others: OtherStrips) -> None:
    rng = np.random.default_rng(2)
    right = {name: T.retract(FILE_SIGMAS * rng.standard_normal(6)) for name, T in TRUE.items()}
    turned = np.array([0.0, 0.0, 0.003, 0.0, 0.0, 0.0])
    wrong = {**right, "front": right["front"].retract(turned)}

    found = at_extrinsics_on_the_poses(others, right, {}, COV)
    assert p_value(found) > 1e-3
    assert found.expected_m is not None
    assert np.median(found.thickness_m / found.expected_m) == pytest.approx(0.85, abs=0.35)
    assert p_value(at_extrinsics_on_the_poses(others, wrong, {}, COV)) < 1e-9
    # The extrinsics of the solve itself are where the solve is.
    names, poses = tuple(TRUE), others.used.state.T_vehicle_lidar
    own = at_extrinsics_on_the_poses(others, dict(zip(names, poses, strict=True)), {}, COV)
    assert own.distances_m == pytest.approx(at_the_solve(others).distances_m, abs=1e-9)


def test_a_lidar_that_is_moved_is_apart_by_that_along_the_normal(others: OtherStrips) -> None:
    """The distance on a strip is n . t, in the sign that is stated."""
    shift = np.array([0.004, 0.0, 0.0])
    moved = {
        name: gtsam.Pose3(T.rotation(), T.translation() + (shift if name == "front" else 0.0))
        for name, T in zip(TRUE, others.used.state.T_vehicle_lidar, strict=True)
    }
    poses = others.used.state
    names = others.problem.patches.lidars
    front = names.index("front")
    before = at_the_solve(others).distances_m
    # Poses as they are: only the extrinsics differ.
    still = replace(others.used, state=replace(poses, T_vehicle_lidar=tuple(moved.values())))
    after = at_the_solve(replace(others, used=still)).distances_m
    change = after - before
    sign = np.where(others.lidar_of == front, 1.0, -1.0)
    expected = sign * _mean_shift(others, front, shift)
    # Not to the digit: scans weigh by their noise, and tilts take up a part.
    assert expected @ change / (expected @ expected) == pytest.approx(1.0, abs=0.1)
    assert np.corrcoef(expected, change)[0, 1] > 0.97


def _mean_shift(others: OtherStrips, front: int, shift: np.ndarray) -> np.ndarray:
    """(m,) mean of n . R_map_vehicle shift over the scans of the front LiDAR that see a strip."""
    patches = others.problem.patches
    own = np.flatnonzero(patches.scan_lidar[patches.scan] == front)
    own = own[others.strips.of_patch[own] >= 0]
    strip = others.strips.of_patch[own]
    pose = others.problem.pose_of_scan[patches.scan[own]]
    along = np.einsum(
        "ni,nij,j->n",
        others.strips.normals_map[strip],
        others.used.state.R_map_vehicle[pose],
        shift,
    )
    weight = patches.points[own]
    count = others.strips.count
    total = np.bincount(strip, weight, count)
    mean = np.bincount(strip, weight * along, count) / np.maximum(total, 1e-9)
    return np.asarray(mean[others.strip_of])


def test_guesses_are_worse(others: OtherStrips) -> None:
    guessed, found = at_guesses(others), at_the_solve(others)
    assert guessed.cov_m2 is None
    assert np.mean(guessed.distances_m**2) > 9.0 * np.mean(found.distances_m**2)
    assert np.median(guessed.thickness_m) > 2.0 * np.median(found.thickness_m)


def test_strips_have_their_thickness_before_and_after(others: OtherStrips) -> None:
    strips = [strip for strip in strips_of(others.used) if strip.weight > 0.0]
    before = np.median([strip.before_m for strip in strips])
    after = np.median([strip.scatter_m for strip in strips])
    assert 0.001 < after < 0.004  # sightings err by 2 mm
    assert before > 3.0 * after
