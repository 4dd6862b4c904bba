"""Biases of ranges: eliminated as variables would be, their size found where they contradict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from caliv_graph.calibration.graph import pose_graph
from caliv_graph.calibration.linear import cloud_rows, linearise_clouds
from caliv_graph.calibration.range_bias import (
    BiasSizes,
    RangeBiases,
    fit_bias_sizes,
    most_likely_biases,
    moved_back,
    range_biases,
    without_bias,
)
from caliv_graph.calibration.reduced import Reduced, reduce_to_extrinsics
from caliv_graph.config.range_errors import INCIDENCE_M, LOG_SPREAD, TYPICAL_OFFSET_M
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
    found, found_gradient = without_bias(H, gradient, sigma_m * D)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(
        found_gradient, pull[:18] - full[:18, 18:] @ follows[:, 18], atol=1e-9
    )


def test_biases_that_were_taken_off_before_are_pulled_back_by_their_prior() -> None:
    # Longer ranges by b move what fits back by D b; b0 of them are in the poses already.
    H, gradient = quadratic(3, 11)
    D, applied = any_directions(3, 2, 12), np.array([0.4, -1.3])
    moved = np.random.default_rng(13).normal(size=18)

    def cost(d: Array, b: Array) -> float:
        x = d - D @ (b - applied)
        return float(0.5 * x @ H @ x + gradient @ x + 0.5 * b @ b)

    def best(d: Array) -> Array:
        """The least of a quadratic, by its derivatives."""
        eye = np.eye(2)
        slope = np.array([0.5 * (cost(d, e) - cost(d, -e)) for e in eye])
        bend = np.array(
            [
                [
                    0.25 * sum(p * q * cost(d, p * a + q * b) for p in (1, -1) for q in (1, -1))
                    for a in eye
                ]
                for b in eye
            ]
        )
        return np.asarray(-np.linalg.solve(bend, slope))

    less, less_gradient = without_bias(H, gradient, D, applied)
    found = most_likely_biases(H, gradient, D, applied, moved)
    np.testing.assert_allclose(found, best(moved), rtol=1e-6)
    difference = cost(moved, best(moved)) - cost(np.zeros(18), best(np.zeros(18)))
    assert 0.5 * moved @ less @ moved + less_gradient @ moved == pytest.approx(difference)


def test_eliminated_biases_add_to_the_covariance() -> None:
    # Woodbury: the poses are known by the clouds and by what the biases move them by, added.
    H, gradient = quadratic(2, 3)
    D = any_directions(2, 2, 4)
    less, _ = without_bias(H, gradient, 0.5 * D)
    np.testing.assert_allclose(np.linalg.inv(less), np.linalg.inv(H) + 0.25 * D @ D.T, atol=1e-9)
    assert np.linalg.eigvalsh(H - less).min() > -1e-9


def test_biases_that_do_not_exist_change_nothing() -> None:
    H, gradient = quadratic(2, 5)
    found, found_gradient = without_bias(H, gradient, 1e-9 * any_directions(2, 3, 6))
    np.testing.assert_allclose(found, H, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found_gradient, gradient, rtol=1e-9, atol=1e-9)


def test_nothing_is_known_along_a_bias_that_may_be_any() -> None:
    H, gradient = quadratic(2, 7)
    D = any_directions(2, 1, 8)
    found, found_gradient = without_bias(H, gradient, 1e6 * D)
    assert (D.T @ found @ D)[0, 0] == pytest.approx(0.0, abs=1e-6)
    assert (D.T @ found_gradient)[0] == pytest.approx(0.0, abs=1e-6)


# ------------------------------------------------------------------ directions


def placement(
    number: int, names: tuple[str, ...], apart_deg: float = 12.0, roughness_m: float = 0.0
) -> tuple[JointRegistration, tuple[Array, Array]]:
    """A small plate, seen by the named LiDARs from about it, and the poses of the clouds."""
    rng = np.random.default_rng(number)
    clouds, poses = [], []
    for j, name in enumerate(names):
        T = looking_at_target(40.0 * number + apart_deg * j, 6.0 + j)
        corner = np.array([0.0, -0.1, -0.1])
        plate = rectangle_points(rng, 40, corner, np.array([0, 0.2, 0]), np.array([0, 0, 0.2]))
        clouds.append(TargetCloud(name, 0, j, seen_from(T, plate, 0.0, rng), f"{j}.pcd"))
        poses.append(T)
    observation = TargetObservation(number, f"target_{number}", np.zeros(3), tuple(clouds))
    state = JointRegistration(observation, config_of())
    # The floor of 1 mm is taken off: ranges are quantised to millimetres.
    state.noise = replace(
        state.noise, roughness_m2=np.full(state.clouds.lidars, roughness_m**2 + 1e-6)
    )
    return state, matrices(poses)


def biases_of(
    states: Sequence[JointRegistration], poses: Sequence[tuple[Array, Array]], rounds: int = 0
) -> RangeBiases:
    """Of shapes that begin at these poses, or have settled there for some rounds."""
    quadratics = []
    for state, (R, t) in zip(states, poses, strict=True):
        state.seed(R, t, 0.02)
        for _ in range(rounds):
            state.expect(R, t)
            state.maximise(R, t)
        quadratics.append(state.expect(R, t))
    return range_biases(states, poses, quadratics)


def test_an_offset_moves_the_clouds_of_one_lidar_and_placement_along_their_beams() -> None:
    names = [("front", "rear", "front"), ("rear", "front", "rear", "left")]
    states, poses = zip(*[placement(m, n) for m, n in enumerate(names)], strict=True)
    biases = biases_of(states, poses)
    # Two LiDARs at the first target, three at the second; numbered as they come.
    assert biases.offsets.shape == (6 * 7, 2 + 3)
    # Nothing is rough.
    assert biases.smooth.shape == (6 * 7, 0)
    column = [0, 1, 0, 2, 3, 2, 4]
    by_cloud = biases.offsets.reshape(7, 6, 5)
    t = np.concatenate([t for _, t in poses])
    for j, own in enumerate(column):
        other = np.delete(by_cloud[j], own, axis=1)
        assert not other.any()
        # No turn; from the sensor to the plate in the middle, whose beams spread by a degree.
        assert not by_cloud[j, :3].any()
        beam = by_cloud[j, 3:, own]
        assert np.linalg.norm(beam) == pytest.approx(1.0, abs=1e-3)
        assert beam == pytest.approx(-t[j] / np.linalg.norm(t[j]), abs=0.01)


def test_clouds_with_longer_ranges_fit_nearer_to_their_lidar() -> None:
    """Each LiDAR and target has its own bias; the points are then where they were without."""
    names = [("front", "rear", "front"), ("rear", "front", "rear", "left")]
    states, poses = zip(*[placement(m, n) for m, n in enumerate(names)], strict=True)
    offsets_m = 1e-3 * np.array([5.0, -8.0, 3.0, -2.0, 12.0])
    column = [[0, 1, 0], [2, 3, 2, 4]]
    fitting = moved_back(states, poses, offsets_m)
    for state, (R, t), (R_fit, t_fit), of in zip(states, poses, fitting, column, strict=True):
        clouds = state.clouds
        longer = clouds.points + offsets_m[np.array(of)[clouds.cloud], None] * clouds.beams
        moved = np.einsum("nij,nj->ni", R_fit[clouds.cloud], longer) + t_fit[clouds.cloud]
        # The beams of a cloud spread by a degree: 12 mm across them by 0.2 mm.
        np.testing.assert_allclose(moved, clouds.moved(R, t), atol=3e-4)


def tilted_plate(tilt_deg: float) -> tuple[JointRegistration, tuple[Array, Array], Array]:
    """A plate that 'front' sees square, and 'rear' under `tilt_deg` of incidence; its normal."""
    rng = np.random.default_rng(3)
    corner = np.array([0.0, -0.2, -0.2])
    plate = rectangle_points(rng, 900, corner, np.array([0, 0.4, 0]), np.array([0, 0, 0.4]))
    poses = [looking_at_target(azimuth, 8.0, 0.0) for azimuth in (0.0, tilt_deg)]
    clouds = tuple(
        TargetCloud(name, 0, j, seen_from(T, plate, 0.0, rng), f"{j}.pcd")
        for j, (name, T) in enumerate(zip(("front", "rear"), poses, strict=True))
    )
    observation = TargetObservation(0, "plate", np.zeros(3), clouds)
    return JointRegistration(observation, config_of()), matrices(poses), np.array([1.0, 0.0, 0.0])


def test_incidence_moves_a_face_behind_itself_by_one_less_its_cosine() -> None:
    state, (R, t), normal = tilted_plate(50.0)
    incidence = biases_of([state], [(R, t)]).incidence.reshape(2, 6, 2, 2)
    # Square to the beams, whose incidence is at most 2 degrees at its edges: nothing.
    assert np.abs(incidence[0]).max() < 2e-3
    assert not incidence[1, :, 0].any()
    # Nothing is seen beyond 75 degrees.
    assert not incidence[..., 1].any()
    points = state.clouds.moved(R, t)[state.clouds.cloud == 1]
    moved = displacements(incidence[1, :, 1:, 0], points)[..., 0]
    # A range too long by 1 / cos - 1 is 1 - cos behind the plane.
    expected = -(1.0 - math.cos(math.radians(50.0))) * normal
    np.testing.assert_allclose(moved.mean(axis=0), expected, atol=0.01)
    # Along the plate nothing is seen.
    assert np.abs(moved @ np.array([0.0, 1.0, 0.0])).max() < 0.02


def test_incidence_moves_a_cloud_as_ranges_that_are_too_long_do() -> None:
    # Two plates at right angles, seen under 25 and 65 degrees: against points with such ranges.
    rng = np.random.default_rng(4)
    faces = [
        rectangle_points(rng, 700, np.array([0.0, -0.4, -0.2]), across, np.array([0, 0, 0.4]))
        for across in (np.array([0.0, 0.4, 0.0]), np.array([-0.4, 0.0, 0.0]))
    ]
    T = looking_at_target(-25.0, 8.0)
    clouds, factor = [], 0.05
    for number, size in enumerate((0.0, factor)):
        long_points = []
        for face, normal in zip(faces, ([1.0, 0.0, 0.0], [0.0, -1.0, 0.0]), strict=True):
            beams = face - T.translation()
            beams /= np.linalg.norm(beams, axis=1)[:, None]
            long = size * (1.0 / np.abs(beams @ np.array(normal)) - 1.0)
            long_points.append(face + long[:, None] * beams)
        seen = seen_from(T, np.vstack(long_points), 0.0, rng)
        clouds.append(TargetCloud("front", 0, number, seen, f"{number}.pcd"))
    observation = TargetObservation(0, "corner", np.zeros(3), tuple(clouds))
    state = JointRegistration(observation, config_of())
    poses = matrices([T, T])
    motion = factor * biases_of([state], [poses], 12).incidence.reshape(2, 6, 2)[0].sum(
        1, keepdims=True
    )
    points = np.split(state.clouds.moved(*poses), state.clouds.starts[1:])
    # Both faces move by as much, to the same side.
    after = points[0] + displacements(motion, points[0])[..., 0]
    on_first = np.abs(points[0][:, 0]) < 1e-3
    for own, axis in ((on_first, 0), (~on_first, 1)):
        expected = np.median(points[1][own, axis] - points[0][own, axis])
        assert np.median(after[own, axis] - points[0][own, axis]) == pytest.approx(
            expected, rel=0.1
        )


def test_a_lid_at_a_grazing_angle_decides_how_high_a_cloud_seems() -> None:
    # Its points are far fewer, but their noise is along it: the height is theirs to tell.
    rng = np.random.default_rng(6)
    front = rectangle_points(
        rng, 2000, np.array([0.0, -0.4, 0.0]), np.array([0, 0.8, 0]), np.array([0, 0, 0.5])
    )
    lid = rectangle_points(
        rng, 100, np.array([-0.4, -0.4, 0.5]), np.array([0.4, 0, 0]), np.array([0, 0.8, 0])
    )
    poses = [looking_at_target(azimuth, 6.0, 1.2) for azimuth in (-5.0, 5.0)]
    clouds = tuple(
        TargetCloud("front", 0, j, seen_from(T, np.vstack([front, lid]), 0.0, rng), f"{j}.pcd")
        for j, T in enumerate(poses)
    )
    state = JointRegistration(TargetObservation(0, "bin", np.zeros(3), clouds), config_of())
    R, t = matrices(poses)
    of_front, of_lid = (
        biases_of([state], [(R, t)], 12).incidence.reshape(2, 6, 2).transpose(2, 0, 1)
    )
    on_lid = np.array([[-0.2, 0.0, 0.5]])
    # 0.7 m above the lid and 6.2 m away: a cosine of 0.11; growth by 1 / cos - 1 up to 75 degrees.
    cosine, until = 0.11, 1.0 / math.cos(math.radians(75.0))
    for j in range(2):
        down = [displacements(of[j][:, None], on_lid)[0, 2, 0] for of in (of_front, of_lid)]
        assert down[0] == pytest.approx(-cosine * (until - 1.0), rel=0.15)
        assert down[1] == pytest.approx(-(1.0 - cosine * until), rel=0.15)


def displacements(motions: Array, y: Array) -> Array:
    """(N, 3, C) how the points (N, 3) of a cloud move by its left perturbations (6, C)."""
    turned = np.cross(motions[None, :3], y[:, :, None], axisa=1, axisb=1, axisc=1)
    return np.asarray(motions[None, 3:] + turned)


def smooth_errors(apart_deg: float, *names: str) -> tuple[Array, list[Array], Array]:
    """(J, 6, C) for a plate of 3 mm roughness, its points in each cloud, and the (J, 3) views."""
    state, (R, t) = placement(0, names, apart_deg, 3e-3)
    smooth = biases_of([state], [(R, t)]).smooth
    points = np.split(state.clouds.moved(R, t), state.clouds.starts[1:])
    views = np.array([y.mean(axis=0) - t[j] for j, y in enumerate(points)])
    views /= np.linalg.norm(views, axis=1)[:, None]
    return smooth.reshape(len(names), 6, -1), points, views


def test_smooth_errors_are_as_large_as_the_roughness_and_its_slopes() -> None:
    smooth, points, views = smooth_errors(0.0, "front", "rear")
    # The plate is at right angles to the beams. A constant part and two slopes, each of the
    # roughness in the root mean square of the points.
    for j in range(2):
        depths = np.einsum("nac,a->nc", displacements(smooth[j], points[j]), views[j])
        size = np.sqrt(np.mean(np.sum(depths**2, axis=1)))
        assert size == pytest.approx(np.sqrt(3.0) * 3e-3, rel=0.02)


def test_smooth_errors_neither_move_the_middle_aside_nor_turn_about_the_beams() -> None:
    smooth, points, views = smooth_errors(0.0, "front", "rear")
    moved = displacements(smooth[0], points[0].mean(axis=0, keepdims=True))[0]
    assert np.abs(moved - np.outer(views[0], views[0] @ moved)).max() < 1e-5
    assert np.abs(views[0] @ smooth[0, :3]).max() < 1e-3 * np.abs(smooth[0, :3]).max()


@pytest.mark.parametrize(
    ("apart_deg", "names", "alike"),
    [
        (0.0, ("front", "front"), 1.0),
        (20.0, ("front", "front"), math.exp(-0.5)),
        (80.0, ("front", "front"), 0.0),
        (0.0, ("front", "rear"), 0.0),
    ],
)
def test_smooth_errors_are_those_of_a_lidar_and_a_side(
    apart_deg: float, names: tuple[str, str], alike: float
) -> None:
    smooth, points, views = smooth_errors(apart_deg, *names)
    depth = [
        views[j] @ displacements(smooth[j], points[j].mean(axis=0, keepdims=True))[0]
        for j in range(2)
    ]
    sizes = [np.linalg.norm(d) for d in depth]
    assert depth[0] @ depth[1] / (sizes[0] * sizes[1]) == pytest.approx(alike, abs=0.02)


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


def only_offsets(directions: Array, smooth: Array | None = None) -> RangeBiases:
    """Offsets (6 J, B) of clouds whose faces are square to their beams."""
    nothing = np.zeros((len(directions), 0))
    lidar = np.arange(directions.shape[1]) % 2
    smooth = nothing if smooth is None else smooth
    return RangeBiases(directions, np.zeros_like(directions), lidar, smooth)


def fitted(bias_m: float, seed: int) -> tuple[BiasSizes, Array]:
    reduced, directions, drawn = biased(bias_m, seed)
    prior = reduced.in_tangents(make_case().problem.guess_information())
    return fit_bias_sizes(reduced, only_offsets(directions), prior), drawn


@pytest.mark.parametrize("seed", range(3))
def test_offsets_are_small_where_the_targets_agree(seed: int) -> None:
    found, _ = fitted(0.0, seed)
    assert found.offset_m < 0.6 * TYPICAL_OFFSET_M
    assert found.least_m < 5e-4


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("bias_m", [5e-3, 0.015])
def test_offsets_are_as_large_as_the_targets_contradict_each_other(
    bias_m: float, seed: int
) -> None:
    found, drawn = fitted(bias_m, seed)
    size = np.sqrt(np.mean(drawn**2))
    assert 0.5 < found.offset_m / size < 2.0
    assert 0.2 * size < found.least_m < size


def test_offsets_that_the_place_of_a_target_makes_up_for_say_nothing() -> None:
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
    found = fit_bias_sizes(reduced, only_offsets(common), prior)
    # The root mean square of a log-normal distribution, but for its tail beyond 30 mm.
    assert found.offset_m == pytest.approx(TYPICAL_OFFSET_M * np.exp(LOG_SPREAD**2), rel=0.2)
    assert found.least_m < 0.5e-3
    # Who knows his LiDARs is believed.
    known = fit_bias_sizes(reduced, only_offsets(common), prior, 0.001)
    assert known.offset_m == pytest.approx(0.001)
    assert known.least_m == 0.0
    # So he is of ranges at a slant.
    assert found.incidence_m == pytest.approx([INCIDENCE_M], rel=0.2)
    assert max(known.incidence_m) <= 0.001


@pytest.mark.parametrize(("drawn_m", "low_m", "high_m"), [(0.0, 0.0, 1e-3), (6e-3, 3e-3, 10e-3)])
def test_the_incidence_counts_as_far_as_it_shows(
    drawn_m: float, low_m: float, high_m: float
) -> None:
    # No offsets are known of; what moves the clouds is the incidence, or nothing.
    reduced, directions, _ = biased(drawn_m, 0)
    nothing = np.zeros((len(directions), 0))
    lidar = np.arange(directions.shape[1]) % 2
    biases = RangeBiases(np.zeros_like(directions), directions, lidar, nothing)
    prior = reduced.in_tangents(make_case().problem.guess_information())
    found = fit_bias_sizes(reduced, biases, prior).incidence_m
    assert low_m < min(found) <= max(found) < high_m


def test_turned_faces_are_told_from_offsets() -> None:
    # Four clouds with smooth errors of three times the roughness, and no offsets.
    reduced, offsets, _ = biased(0.0, 1)
    rng = np.random.default_rng(5)
    smooth = 2e-3 * rng.normal(size=(len(offsets), 40))
    H, gradient = reduced.clouds
    drawn = 3.0 * rng.normal(size=40)
    moved = replace(reduced, clouds=(H, gradient - H @ smooth @ drawn))
    # The other variables see the same clouds.
    rows = cloud_rows(reduced.system, reduced.lines)
    system = replace(reduced.system, b=reduced.system.b + rows.T @ H @ smooth @ drawn)
    moved = replace(moved, system=system)
    prior = reduced.in_tangents(make_case().problem.guess_information())
    found = fit_bias_sizes(moved, only_offsets(offsets, smooth), prior)
    assert 2.0 < found.smooth < 4.5
    assert found.offset_m < TYPICAL_OFFSET_M
