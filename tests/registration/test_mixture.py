"""The surfels by hand: E-step, M-step, and the quadratic against numerical derivatives."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import gtsam
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from caliv_graph.geometry.se3 import tangent_axes
from caliv_graph.products import Array, IntArray, Mixture
from caliv_graph.registration.clouds import CloudStack, stack_clouds
from caliv_graph.registration.heights import HeightNoise, HeightSums
from caliv_graph.registration.mixture import (
    LEAST_EXTENT_M,
    MAX_TURN_RAD,
    expect,
    maximise_shape,
    seed_mixture,
)
from caliv_graph.registration.moments import Responsibilities, cell_moments
from caliv_graph.registration.quadratic import (
    NORMAL_SIGMA_RAD,
    SEEN_SIGMA_RAD,
    ShapeQuadratic,
    shape_quadratic,
)
from caliv_graph.registration.register import left_step
from caliv_graph.registration.surfels import BESIDE, STEEP
from tests.registration.scenes import (
    IDENTITY,
    looking_at_target,
    matrices,
    observe,
    rectangle_points,
    seen_from,
    stack_of,
)


def surfel(
    mean: tuple[float, ...],
    normal: tuple[float, ...] = (0.0, 0.0, 1.0),
    *,
    width_m: float = 0.1,
    weight: float = 1.0,
) -> Mixture:
    return Mixture(
        means_target=np.array([mean]),
        normals_target=np.array([normal]),
        var_tangent=np.array([width_m**2]),
        weights=np.array([weight]),
    )


def together(*mixtures: Mixture) -> Mixture:
    return Mixture(
        *(
            np.concatenate([getattr(m, name) for m in mixtures])
            for name in ("means_target", "normals_target", "var_tangent", "weights")
        )
    )


def noise_of(range_m: float = 0.01, roughness_m: float = 0.0, floor_m: float = 0.0) -> HeightNoise:
    """Of one LiDAR."""
    return HeightNoise(np.array([range_m**2]), np.array([roughness_m**2]), floor_m)


UP = np.array([[0.0, 0.0, 1.0]])

SURE = 2.0 * 4.0 / -math.expm1(-8.0)
"""Density of a reliable normal that agrees, over that of any: von Mises-Fisher of 4."""

THERE = 1.0 / (1.0 + BESIDE)
"""Presence of a surfel that a beam meets in its middle, alone."""


def held(component: IntArray, weight: Array, clouds: int = 1) -> Responsibilities:
    """Points that belong to surfels with these weights, whatever their places are."""
    surfels = int(component.max()) + 1
    counts = np.bincount(component.ravel(), weight.ravel(), surfels).astype(np.float64)
    return Responsibilities(
        component=component,
        weight=weight,
        counts=counts,
        explained=np.ones(len(weight)),
        inlier_ratio=np.ones(clouds),
        levers=np.zeros((clouds, 3)),
        weight_along=np.zeros_like(weight),
        component_levers=np.zeros((surfels, 3)),
        slides_m=np.zeros(len(weight)),
        heights=HeightSums.none(1),
    )


def quadratic_of(
    stack: CloudStack, R: Array, t: Array, mixture: Mixture, who: Responsibilities
) -> ShapeQuadratic:
    cells = cell_moments(stack, who, len(mixture.weights))
    return shape_quadratic(stack, R, t, mixture, cells, who)


def maximised(
    stack: CloudStack, R: Array, t: Array, mixture: Mixture, who: Responsibilities, floor_m: float
) -> Mixture:
    cells = cell_moments(stack, who, len(mixture.weights))
    quadratic = shape_quadratic(stack, R, t, mixture, cells, who)
    return maximise_shape(stack, R, t, mixture, floor_m, cells, who.counts, quadratic.turns)


# ------------------------------------------------------------------ E-step


def explained(
    points: Array,
    mixture: Mixture,
    noise: HeightNoise,
    density: float,
    *,
    normals: Array | None = None,
    beams: Array | None = None,
    flatness: Array | None = None,
) -> Array:
    """(N,) responsibility of the mixture for points with normals up, or as given."""
    normals = UP.repeat(len(points), axis=0) if normals is None else normals
    stack = stack_of(points, normals, beams=beams, flatness=flatness)
    return expect(stack, *IDENTITY, mixture, noise, density, np.ones(1)).explained


def test_responsibility_of_one_surfel_by_hand() -> None:
    # 10 mm above it, 1 sigma, straight from above: N = (2 pi)^-1/2 / 0.01 e^-1/2 = 24.20 per metre,
    # times what a normal that agrees adds.
    density = 24.197 * SURE
    alone = surfel((0.0, 0.0, 0.0))
    points = np.array([[0.0, 0.0, 0.01]])
    assert explained(points, alone, noise_of(), density) == pytest.approx([0.5], abs=1e-4)
    # Three times as many outliers.
    assert explained(points, alone, noise_of(), 3.0 * density) == pytest.approx([0.25], abs=1e-4)
    # Where the beam meets the plane, two widths beside the middle, it returns nearly as likely: no
    # other surface is there. At five widths e^-12.5 = 3.7e-6 is less than "no surface here".
    beside = np.array([[0.2, 0.0, 0.01], [0.5, 0.0, 0.01]])
    a, b = math.exp(-2.0), math.exp(-12.5)
    expected = [n / (n + BESIDE) / (n / (n + BESIDE) + 1.0) for n in (a, b)]
    assert explained(beside, alone, noise_of(), density) == pytest.approx(expected, rel=1e-3)
    assert expected[0] > 0.499
    assert expected[1] < 0.04


def test_variance_of_a_height_is_of_the_range_and_of_the_surface() -> None:
    # 60 degrees: f^2 sigma^2 + rho^2 = (5 mm)^2 + (12 mm)^2 = (13 mm)^2; the density of the range
    # is f times that of the height.
    beam = np.array([[math.sin(math.radians(60.0)), 0.0, -0.5]])
    noise = noise_of(0.01, 0.012)
    points = np.array([[0.0, 0.0, 0.013]])
    found = explained(points, surfel((0, 0, 0), width_m=1.0), noise, 1.0, beams=beam)
    # The beam meets the plane 22.5 mm beside the middle of a surfel of a metre.
    density = 0.5 * math.exp(-0.5) / (math.sqrt(2.0 * math.pi) * 0.013) * SURE
    assert found == pytest.approx([density / (density + 1.0)], rel=2e-4)
    # While annealing the floor stands for the roughness: (5 mm)^2 + (12 mm)^2 again.
    coarse = explained(
        points, surfel((0, 0, 0), width_m=1.0), noise_of(0.01, 0.001, 0.012), 1.0, beams=beam
    )
    assert coarse == pytest.approx(found, rel=1e-12)


def test_a_beam_returns_from_where_it_meets_the_surface() -> None:
    # 60 degrees from the normal, 20 mm too far: 10 mm below the surface, 17 mm beside the middle.
    # The beam met the surface in the middle: of two surfels that lie beside each other it is that.
    beam = np.array([[math.sin(math.radians(60.0)), 0.0, -0.5]])
    pair = together(surfel((0, 0, 0), width_m=0.01), surfel((0.0346, 0.0, 0.0), width_m=0.01))
    stack = stack_of(0.02 * beam, UP, beams=beam)
    who = expect(stack, *IDENTITY, pair, noise_of(), 1e-9, np.ones(1))
    weight = dict(zip(who.component[0].tolist(), who.weight[0].tolist(), strict=True))
    # 0 and 34.6 mm, 10 mm wide: e^-5.99.
    assert weight[1] / weight[0] == pytest.approx(math.exp(-0.5 * 3.46**2), rel=1e-3)
    assert who.slides_m == pytest.approx([-0.02], rel=1e-9)
    # A noise of 1 mm does not explain 20: the point counts 3 mm along its beam from where it is.
    still = expect(stack, *IDENTITY, pair, noise_of(0.001), 1e-300, np.ones(1))
    assert still.slides_m == pytest.approx([-0.003])


def test_a_beam_nearly_along_the_surface_is_hardly_followed() -> None:
    # 1.7 degrees off it, 10 mm below: the beam meets the surface 0.33 m away, and a normal that is
    # off by a degree would make 0.2 m of it. Followed are 0.01 x 0.03 / 0.1^2 = 30 mm.
    beam = np.array([[math.sqrt(1.0 - 0.03**2), 0.0, -0.03]])
    flat = surfel((0.0, 0.0, 0.0), width_m=0.05)
    points = np.array([[0.0, 0.0, -0.01]])
    stack = stack_of(points, UP, beams=beam)
    noise = noise_of(0.05, 0.02)
    who = expect(stack, *IDENTITY, flat, noise, 100.0, np.ones(1))
    assert who.slides_m == pytest.approx([-0.03])
    # A beam that flat sees the surface for 0.8; the noise across it is that of f = 0.1.
    there = 0.8 * math.exp(-0.5 * (0.03 * beam[0, 0] / 0.05) ** 2)
    variance = (STEEP * 0.05) ** 2 + 0.02**2
    expected = there / (there + BESIDE) * STEEP / math.sqrt(2.0 * math.pi * variance)
    expected *= math.exp(-0.5 * 0.01**2 / variance) * SURE
    assert who.explained == pytest.approx([expected / (expected + 100.0)], rel=1e-6)
    # From behind, or along it, it is not followed at all.
    for f in (0.0, 0.04):
        beam = np.array([[math.sqrt(1.0 - f**2), 0.0, f]])
        who = expect(stack_of(points, UP, beams=beam), *IDENTITY, flat, noise, 1.0, np.ones(1))
        assert who.slides_m == pytest.approx([0.0])


def test_levers_are_those_of_the_residual_along_the_beam() -> None:
    # Half the squared distance to the surface along the beam, over what that has for a variance:
    # its derivative by a rotation is that of the distance across the surface, plus the levers.
    n, y, b = np.array([0.6, 0.0, 0.8]), np.array([0.3, -0.2, 0.5]), np.array([0.48, 0.6, -0.64])
    mu = y - 0.01 * n
    many = [np.tile(v, (10, 1)) for v in (y, n, b)]
    stack = stack_of(many[0], many[1], beams=many[2])
    noise = noise_of(0.02, 0.01)
    who = expect(
        stack, *IDENTITY, surfel(tuple(mu.tolist()), (0.6, 0.0, 0.8)), noise, 1e-9, np.ones(1)
    )
    variance = (float(n @ b) * 0.02) ** 2 + 0.01**2

    def costs(d: Array) -> Array:
        R = gtsam.Rot3.Expmap(d).matrix()
        across = float(n @ (R @ y - mu))
        along = float(n @ b) * across / float(n @ (R @ b))
        return np.asarray(0.5 / variance * np.array([along**2, across**2]))

    step = 1e-5
    slopes = np.array([costs(d) - costs(-d) for d in step * np.eye(3)]) / (2.0 * step)
    assert who.levers[0] == pytest.approx(10.0 * (slopes[:, 0] - slopes[:, 1]), rel=1e-5)
    assert who.component_levers == pytest.approx(who.levers)
    assert np.abs(who.levers).max() > 5.0


def test_a_turn_of_all_clouds_changes_nothing() -> None:
    # Of pulls, the levers' too: the surfels that clouds share are turned with them, and the normals
    # of the points, which the surfels' are drawn to, as well. Not at convergence only.
    stack, R, t, quadratic = skins()
    who = expect(
        stack, R, t, seed_mixture(stack, R, t, 150, 0.01), noise_of(0.005), 0.05, np.ones(6)
    )
    assert np.abs(who.levers).max() > 1.0
    assert who.levers.sum(axis=0) == pytest.approx(who.component_levers.sum(axis=0))
    rough = quadratic_of(stack, R, t, seed_mixture(stack, R, t, 150, 0.01), who)
    for found in (quadratic, rough):
        scale = np.abs(found.gradient).max()
        assert np.abs(found.gradient.sum(axis=0)).max() < 1e-6 * scale


def half_turned(seed: int, levers: float) -> float:
    """Turn (rad) of a cloud that sees a face at a slant against one that sees it head-on.

    0.6 x 0.4 m, under 40 degrees with a centimetre of noise and head-on with 2 mm, from the truth.

    Args:
        seed: of the noise.
        levers: factor on what is missing in the levers.
    """
    rng = np.random.default_rng(seed)
    tilt = gtsam.Rot3.Ry(math.radians(50.0)).matrix()
    normal, count = tilt[:, 2], 8000
    points, beams = [], []
    for sensor, noise_m in ((8.0 * normal, 0.002), (np.array([8.0, 0.0, 0.0]), 0.01)):
        corner, sides = np.array([-0.3, -0.2, 0.0]), (np.array([0.6, 0, 0]), np.array([0, 0.4, 0]))
        face = rectangle_points(rng, count, corner, *sides) @ tilt.T
        beam = face - sensor
        beam /= np.linalg.norm(beam, axis=1)[:, None]
        points.append(face + noise_m * rng.normal(size=(count, 1)) * beam)
        beams.append(beam)
    stack = stack_of(
        np.vstack(points),
        np.tile(normal, (2 * count, 1)),
        beams=np.vstack(beams),
        starts=(0, count),
    )
    R, t = np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3))
    shape = together(*[surfel(tuple(p), tuple(normal), width_m=0.012) for p in points[0][:300]])

    def expected() -> Responsibilities:
        who = expect(stack, R, t, shape, noise_of(0.01), 1e-3, np.ones(2))
        missing = levers * who.levers, levers * who.component_levers
        return replace(who, levers=missing[0], component_levers=missing[1])

    for _ in range(4):
        shape = maximised(stack, R, t, shape, expected(), 0.006)
    quadratic = quadratic_of(stack, R, t, shape, expected())
    apart = np.vstack([-0.5 * np.eye(6), 0.5 * np.eye(6)])
    # A plane leaves three directions open: they stay.
    H = apart.T @ quadratic.joint() @ apart + np.diag([1e3] * 3 + [1e4] * 3)
    return float(-np.linalg.solve(H, apart.T @ quadratic.gradient.ravel())[1])


def test_noise_along_the_beams_turns_no_surface() -> None:
    def mean(levers: float) -> float:
        return float(np.mean([half_turned(seed, levers) for seed in range(6)]))

    assert abs(mean(1.0)) < 0.6e-3
    # Levers that end at the points would turn every slanted surface edge-on to its beams.
    assert abs(mean(0.0)) > 1.2e-3


def slanted(rng: np.random.Generator, noise_m: float, normal: Array) -> CloudStack:
    """A patch of 80 x 80 mm about the origin in the plane z = 0, seen under 60 degrees."""
    beam = np.array([math.sin(math.radians(60.0)), 0.0, -0.5])
    points = np.column_stack([rng.uniform(-0.04, 0.04, (4000, 2)), np.zeros(4000)])
    points += noise_m * rng.normal(size=(4000, 1)) * beam
    return stack_of(points, np.tile(normal, (4000, 1)), beams=np.tile(beam, (4000, 1)))


def test_levers_do_not_grow_with_the_noise() -> None:
    # Noise of 10 mm moves the points by 8.7 mm along the surface, beside the 23 mm they spread.
    flat = surfel((0.0, 0.0, 0.0), width_m=0.03)
    found = []
    for noise_m in (1e-6, 0.01):
        stack = slanted(np.random.default_rng(3), noise_m, UP[0])
        who = expect(stack, *IDENTITY, flat, noise_of(0.02), 1e-9, np.ones(1))
        found.append((stack, who, quadratic_of(stack, *IDENTITY, flat, who)))
    (_, _, still), (stack, who, noisy) = found
    for axis in (0, 1):
        expected = still.orientation_information[0, axis, axis]
        assert noisy.orientation_information[0, axis, axis] == pytest.approx(expected, rel=0.02)
        assert noisy.blocks[0, axis, axis] == pytest.approx(still.blocks[0, axis, axis], rel=0.02)
    at_points = replace(who, slides_m=np.zeros(len(stack.points)))
    longer = quadratic_of(stack, *IDENTITY, flat, at_points)
    assert longer.orientation_information[0, 1, 1] > 1.1 * still.orientation_information[0, 1, 1]
    # Nor does the surfel become wider.
    after = maximised(stack, *IDENTITY, flat, who, 0.001)
    assert math.sqrt(after.var_tangent[0]) == pytest.approx(0.08 / math.sqrt(12.0), rel=0.02)


def test_a_surfel_turns_into_the_plane_of_its_points() -> None:
    # The normals of the points are 0.1 rad off; the points themselves tell to
    # 5 mm / (23 mm sqrt(4000)) = 3 mrad.
    wrong = np.array([math.sin(0.1), 0.0, math.cos(0.1)])
    stack = slanted(np.random.default_rng(4), 0.01, wrong)
    mixture = surfel((0, 0, 0), tuple(wrong), width_m=0.03)
    for _ in range(8):
        who = expect(stack, *IDENTITY, mixture, noise_of(), 1e-9, np.ones(1))
        mixture = maximised(stack, *IDENTITY, mixture, who, 0.001)
    assert mixture.normals_target[0] == pytest.approx(UP[0], abs=0.012)
    # The noise is that along the beam: 10 mm, of which a half is across the surface.
    fitted = noise_of().fitted(who.heights, 3.0, noise_of())
    assert math.sqrt(fitted.range_m2[0]) == pytest.approx(0.01, rel=0.05)


def test_a_surfel_turns_no_further_at_once_than_where_it_is_nearly_linear() -> None:
    # The points' normals agree with the surfel's, and the points stand 0.6 rad off them.
    wrong = np.array([-math.sin(0.6), 0.0, math.cos(0.6)])
    stack = slanted(np.random.default_rng(4), 0.001, wrong)
    mixture = surfel((0, 0, 0), tuple(wrong), width_m=0.03)
    who = expect(stack, *IDENTITY, mixture, noise_of(0.02), 1e-9, np.ones(1))
    after = maximised(stack, *IDENTITY, mixture, who, 0.001)
    turned = math.acos(float(after.normals_target[0] @ wrong))
    assert turned == pytest.approx(MAX_TURN_RAD, abs=1e-6)


def test_points_on_a_line_leave_the_turn_about_it_to_their_normals() -> None:
    # To 0.2 rad by normals that can be trusted, to 1 rad by where the beams come from: of 0.3 rad
    # a 26th remains after the first turn.
    rng = np.random.default_rng(6)
    points = np.column_stack([np.zeros(200), rng.uniform(-0.05, 0.05, 200), np.zeros(200)])
    leaning = np.array([math.sin(0.15), 0.0, math.cos(0.15)])
    stack = stack_of(points, np.tile(leaning, (200, 1)), beams=np.tile(-UP, (200, 1)))
    mixture = surfel((0.0, 0.0, 0.0), width_m=0.03)
    remains = 0.15
    for _ in range(3):
        who = expect(stack, *IDENTITY, mixture, noise_of(), 1e-9, np.ones(1))
        mixture = maximised(stack, *IDENTITY, mixture, who, 0.001)
        remains /= 1.0 + SEEN_SIGMA_RAD**-2 / NORMAL_SIGMA_RAD**-2
        remains *= SEEN_SIGMA_RAD**-2 / NORMAL_SIGMA_RAD**-2
        off = math.acos(min(float(mixture.normals_target[0] @ leaning), 1.0))
        assert off == pytest.approx(remains, abs=1e-6)


def test_two_surfels_share_a_beam_between_them() -> None:
    pair = together(surfel((-0.1, 0.0, 0.0)), surfel((0.1, 0.0, 0.0)))
    stack = stack_of(np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0]]), UP.repeat(2, axis=0))
    who = expect(stack, *IDENTITY, pair, noise_of(), 1e-9, np.ones(1))
    weight = {
        (n, k): w for n in range(2) for k, w in zip(who.component[n], who.weight[n], strict=True)
    }
    # Half of it each, over the variance.
    assert weight[0, 0] == pytest.approx(0.5 / 0.01**2)
    assert weight[0, 1] == pytest.approx(0.5 / 0.01**2)
    # 0.05 and 0.15 m: the ratio is e^(0.125 - 1.125) = e^-1.
    assert weight[1, 0] / weight[1, 1] == pytest.approx(math.exp(-1.0))
    assert who.explained == pytest.approx([1.0, 1.0])
    assert who.counts.sum() == pytest.approx(2.0)


def test_more_surfels_are_no_more_surface() -> None:
    # What a beam meets there is one surface, however many surfels stand for it.
    points = np.array([[0.03, 0.0, 0.01]])
    one = surfel((0.0, 0.0, 0.0))
    many = together(*[one] * 6)
    alone = explained(points, one, noise_of(), 30.0)
    assert explained(points, many, noise_of(), 30.0) == pytest.approx(alone, rel=1e-3)


def test_points_are_looked_at_under_the_pose_of_their_cloud() -> None:
    # A point 5 m ahead of a LiDAR that stands 5 m from the surfel, and looks at it.
    T = gtsam.Pose3(gtsam.Rot3.Yaw(math.pi / 2), np.array([0.3, -5.0, 0.0]))
    R, t = matrices([T])
    ahead = np.array([[1.0, 0.0, 0.0]])
    stack = stack_of(5.0 * ahead, -ahead)
    shape = surfel((0.3, 0.0, 0.0), (0.0, -1.0, 0.0), width_m=0.01)
    assert expect(stack, R, t, shape, noise_of(), 1.0, np.ones(1)).explained[0] > 0.99
    assert expect(stack, *IDENTITY, shape, noise_of(), 1.0, np.ones(1)).explained[0] < 1e-9


MANY = 1e6
"""Density of outliers beside which responsibilities are the densities of the surfels over it."""


def test_normals_that_disagree_cost_their_exponent() -> None:
    # Same place, seen from the front: normals 0, 60 and 90 degrees from the surfel's.
    angles = np.radians([0.0, 60.0, 90.0])
    normals = np.column_stack([np.sin(angles), np.zeros(3), np.cos(angles)])
    beams = -UP.repeat(3, axis=0)
    flat, where = surfel((0.0, 0.0, 0.0)), np.zeros((3, 3))
    alpha = explained(where, flat, noise_of(), MANY, normals=normals, beams=beams)
    # 60 degrees a factor of e^2, 90 degrees e^4.
    assert alpha[1] / alpha[0] == pytest.approx(math.exp(-2.0), rel=1e-3)
    assert alpha[2] / alpha[0] == pytest.approx(math.exp(-4.0), rel=1e-3)
    # A normal that cannot be trusted costs nothing, and adds nothing.
    none = np.zeros(3)
    blind = explained(where, flat, noise_of(), MANY, normals=normals, beams=beams, flatness=none)
    assert blind == pytest.approx(np.full(3, alpha[0] / SURE), rel=1e-3)


def test_densities_of_normals_add_up_to_one() -> None:
    # Over the sphere, in units of the uniform one: reliable normals gain nothing on the average.
    cosine = np.linspace(-1.0, 1.0, 2001)
    normals = np.column_stack([np.sqrt(1.0 - cosine**2), np.zeros(2001), cosine])
    beams, where = -UP.repeat(2001, axis=0), np.zeros((2001, 3))
    for flat in (0.2, 1.0):
        flatness = np.full(2001, flat)
        sure = explained(
            where,
            surfel((0, 0, 0)),
            noise_of(),
            MANY,
            normals=normals,
            beams=beams,
            flatness=flatness,
        )
        never = explained(
            np.zeros((1, 3)), surfel((0, 0, 0)), noise_of(), MANY, flatness=np.zeros(1)
        )
        assert np.trapezoid(sure, cosine) / 2.0 == pytest.approx(never[0], rel=1e-3)


def test_a_surfel_is_not_seen_from_behind() -> None:
    # Beams at 0, 45, 135 and 180 degrees from the surfel's back; nothing known of normals.
    angles = np.radians([0.0, 45.0, 135.0, 180.0])
    beams = -np.column_stack([np.sin(angles), np.zeros(4), np.cos(angles)])
    found = explained(
        np.zeros((4, 3)), surfel((0, 0, 0)), noise_of(), MANY, beams=beams, flatness=np.zeros(4)
    )
    # On the surface itself the density of the range is the same from everywhere.
    assert found[1] == pytest.approx(found[0])
    assert found[2:].tolist() == [0.0, 0.0]


def test_weights_of_clouds_scale_weights_and_leave_the_ratio_alone() -> None:
    points = np.array([[0.1, 0.0, 0.0], [0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [0.0, 0.1, 0.0]])
    stack = stack_of(points, UP.repeat(4, axis=0), starts=(0, 1))
    R, t = np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3))
    flat = surfel((0, 0, 0))
    full = expect(stack, R, t, flat, noise_of(), 1.0, np.ones(2))
    weighted = expect(stack, R, t, flat, noise_of(), 1.0, np.array([1.0, 0.25]))
    assert weighted.weight[0] == pytest.approx(full.weight[0])
    assert weighted.weight[1:] == pytest.approx(0.25 * full.weight[1:])
    # The noise is that of the clouds that count.
    assert full.heights.points == pytest.approx([3.0], abs=0.02)
    assert weighted.heights.points == pytest.approx([1.5], abs=0.02)
    # Of the second cloud's three points one is 5 m away.
    assert full.inlier_ratio[1] == pytest.approx(2.0 / 3.0, abs=0.02)
    assert weighted.inlier_ratio == pytest.approx(full.inlier_ratio)


# ------------------------------------------------------------------ the quadratic


@dataclass(frozen=True)
class Case:
    """Clouds of tiles that are far apart: each point belongs to one of them, for certain."""

    stack: CloudStack
    R: Array
    t: Array
    mixture: Mixture
    who: Responsibilities
    tile: IntArray
    noise: HeightNoise

    def quadratic(self) -> ShapeQuadratic:
        return quadratic_of(self.stack, self.R, self.t, self.mixture, self.who)


TILES = 6
CLOUDS = 3


@cache
def tiles_case(seed: int = 0, at_optimum: bool = True) -> Case:
    """Three clouds of six tiles, 8 mm of noise along the beams, poses and normals a little wrong.

    Nothing is beyond three of the 12 mm that are assumed: there slides end.
    With `at_optimum` places and normals of the surfels are those that the clouds ask for.
    """
    rng = np.random.default_rng(seed)
    poses = [looking_at_target(azimuth, 6.0 + azimuth / 30.0) for azimuth in (0.0, 35.0, 70.0)]
    centres = 2.0 * np.array([[x, y, z] for x in (0, 1) for y in (0, 1, 2) for z in (0,)], float)
    centres += rng.uniform(-0.2, 0.2, centres.shape)
    # To the middle of the LiDARs, and up to 40 degrees away from there.
    middle = np.mean([T.translation() for T in poses], axis=0)
    normals = middle - centres
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    normals = Rotation.from_rotvec(rng.uniform(-0.4, 0.4, (TILES, 3))).apply(normals)
    points, beams, own, tile = [], [], [], []
    for T in poses:
        for k in range(TILES):
            count = int(rng.integers(20, 60))
            across = tangent_axes(normals[k])
            on = centres[k] + rng.uniform(-0.1, 0.1, (count, 2)) @ across
            seen = seen_from(T, on, 0.008, rng)
            points.append(seen)
            beams.append(seen / np.linalg.norm(seen, axis=1)[:, None])
            leaning = Rotation.from_rotvec(rng.normal(scale=0.1, size=3)).apply(normals[k])
            own.append(np.tile(T.rotation().unrotate(leaning), (count, 1)))
            tile.append(np.full(count, k))
    per_cloud = [sum(len(p) for p in points[TILES * j : TILES * (j + 1)]) for j in range(CLOUDS)]
    starts = np.concatenate([[0], np.cumsum(per_cloud)[:-1]])
    stack = stack_of(
        np.vstack(points),
        np.vstack(own),
        beams=np.vstack(beams),
        flatness=rng.uniform(0.2, 1.0, sum(per_cloud)),
        starts=tuple(int(s) for s in starts),
    )
    d = rng.normal(size=(CLOUDS, 6)) * np.repeat([1e-3, 3e-3], 3)
    R, t = left_step(*matrices(poses), d)
    mixture = together(
        *[
            surfel(tuple(c), tuple(n), width_m=0.06)
            for c, n in zip(centres.tolist(), normals.tolist(), strict=True)
        ]
    )
    noise = noise_of(0.012, 0.004)
    # Weights that differ, as those of clouds with one view do.
    weights = np.array([1.0, 0.5, 0.8])
    for _ in range(60 if at_optimum else 1):
        who = expect(stack, R, t, mixture, noise, 1e-12, weights)
        if at_optimum:
            mixture = maximised(stack, R, t, mixture, who, 0.01)
    if at_optimum:
        who = expect(stack, R, t, mixture, noise, 1e-12, weights)
    return Case(stack, R, t, mixture, who, np.concatenate(tile), noise)


def residuals(case: Case, d: Array, shape: Array) -> Array:
    """Whitened: their halved square is the cost of the ranges, and of the normals' priors.

    Written down from the model alone: the distance s along each beam from the point to the plane of
    its surfel, of variance V / f^2, with responsibility and V those of the E-step.

    Args:
        case: the clouds and the surfels.
        d: (18,) left perturbations of the poses.
        shape: (K, 3) offset of each plane along its normal, and turns about two axes in it.
    """
    poses = d.reshape(CLOUDS, 6)
    R, t = left_step(case.R, case.t, poses)
    stack, mixture, k = case.stack, case.mixture, case.tile
    before = mixture.normals_target
    axes = np.array([tangent_axes(n) for n in before])
    turns = np.einsum("ka,kab->kb", shape[:, 1:], axes)
    normals = Rotation.from_rotvec(turns).apply(before)
    places = mixture.means_target + shape[:, :1] * before
    y, b = stack.moved(R, t), stack.rotated(R, stack.beams)
    n = normals[k]
    s = np.einsum("na,na->n", n, y - places[k]) / -np.einsum("na,na->n", n, b)
    f0 = -np.einsum("na,na->n", before[k], stack.rotated(case.R, stack.beams))
    V = case.noise.variance(f0[None], np.zeros(len(f0), np.int64))[0]
    weight = np.array([1.0, 0.5, 0.8])[stack.cloud]
    of_ranges = np.sqrt(weight * f0**2 / V) * s
    # The mean normal of the points, which turn with their clouds, and the beams, which do as well.
    flat = (weight / V * stack.flatness)[:, None]
    seen, seen_before = (flat * stack.rotated(Q, stack.normals) for Q in (R, case.R))
    of_normals = []
    for i in range(TILES):
        own = k == i
        mass = (weight / V)[own].sum()
        known = np.linalg.norm(seen_before[own].sum(axis=0)) / mass / NORMAL_SIGMA_RAD**2
        mean = seen[own].sum(axis=0)
        mean /= np.linalg.norm(mean)
        of_normals.append(math.sqrt(known) * np.cross(normals[i], mean))
        part = np.bincount(stack.cloud[own], (weight / V)[own], CLOUDS) / mass
        turned = np.cross(turns[i] - part @ poses[:, :3], before[i])
        of_normals.append(turned / SEEN_SIGMA_RAD)
    return np.concatenate([of_ranges, *of_normals])


def jacobians(case: Case) -> tuple[Array, Array, Array]:
    """Residuals, and their derivatives by poses (., 18) and by the shape (., 3 K)."""
    step = 1e-6
    zero, still = np.zeros(3 * CLOUDS * 2), np.zeros((TILES, 3))

    def slopes(of: Callable[[Array], Array], count: int) -> Array:
        return np.array([(of(e) - of(-e)) / (2.0 * step) for e in step * np.eye(count)]).T

    by_pose = slopes(lambda d: residuals(case, d, still), 6 * CLOUDS)
    by_shape = slopes(lambda e: residuals(case, zero, e.reshape(TILES, 3)), 3 * TILES)
    return residuals(case, zero, still), by_pose, by_shape


def test_the_shape_that_is_found_is_the_best_for_the_ranges() -> None:
    r, _, by_shape = jacobians(tiles_case())
    curvature = np.sqrt(np.diag(by_shape.T @ by_shape))
    # In sigmas of each place and each normal.
    assert np.abs(by_shape.T @ r / curvature).max() < 2e-3
    # Before, they are not.
    r, _, by_shape = jacobians(tiles_case(0, False))
    assert np.abs(by_shape.T @ r / np.sqrt(np.diag(by_shape.T @ by_shape))).max() > 1.0


def test_gradient_is_that_of_the_likelihood_of_the_ranges() -> None:
    # The shape at its best for every displaced pose, by a general minimiser.
    case = tiles_case()

    def cost(d: Array) -> float:
        def of_shape(shape: Array) -> Array:
            return residuals(case, d, shape.reshape(TILES, 3) * scale)

        scale = np.array([1e-3, 1e-2, 1e-2])
        best = least_squares(of_shape, np.zeros(3 * TILES), method="lm", ftol=1e-12, xtol=1e-10)
        return float(best.cost)

    step = 1e-4
    found = case.quadratic().gradient.ravel()
    scale = np.sqrt(np.diag(case.quadratic().joint()))
    # A turn or a shift of each cloud, along each axis: all 18 take long. Those of the next but one
    # test are all there, where Gauss-Newton is enough.
    for i in (0, 4, 7, 11, 17):
        d = step * np.eye(18)[i]
        numerical = (cost(d) - cost(-d)) / (2.0 * step)
        assert found[i] / scale[i] == pytest.approx(numerical / scale[i], abs=5e-3)
    assert np.abs(found / scale).max() > 2.0


def test_gradient_given_the_shape_is_that_of_the_ranges_alone() -> None:
    # At any shape, also one that is not the best.
    for at_optimum in (False, True):
        case = tiles_case(1, at_optimum)
        r, by_pose, _ = jacobians(case)
        of_ranges = slice(0, len(case.tile))
        expected = (by_pose[of_ranges].T @ r[of_ranges]).reshape(CLOUDS, 6)
        found = case.quadratic().gradient_given_shape
        assert found == pytest.approx(expected, rel=1e-8, abs=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("at_optimum", [False, True])
def test_gradient_has_the_shape_eliminated_wherever_the_shape_is(at_optimum: bool) -> None:
    # Gauss-Newton: what the shape takes up of the residuals is projected out.
    case = tiles_case(5, at_optimum)
    r, by_pose, by_shape = jacobians(case)
    taken = np.linalg.lstsq(by_shape, r, rcond=None)[0]
    expected = by_pose.T @ (r - by_shape @ taken)
    scale = np.sqrt(np.diag(by_pose.T @ by_pose))
    found = case.quadratic().gradient.ravel()
    assert found / scale == pytest.approx(expected / scale, abs=5e-4)
    assert np.abs(expected / scale).max() > 1.0


def test_joint_is_the_information_of_the_ranges_with_the_shape_eliminated() -> None:
    case = tiles_case(4)
    _, by_pose, by_shape = jacobians(case)
    left = by_pose - by_shape @ np.linalg.lstsq(by_shape, by_pose, rcond=None)[0]
    expected = left.T @ left
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert case.quadratic().joint() / scale == pytest.approx(expected / scale, abs=2e-5)
    # Given the orientations: offsets alone are estimated.
    offsets = by_shape[:, ::3]
    left = by_pose - offsets @ np.linalg.lstsq(offsets, by_pose, rcond=None)[0]
    given = case.quadratic().joint(given_orientations=True)
    assert given / scale == pytest.approx(left.T @ left / scale, abs=2e-5)


def test_blocks_are_the_information_given_the_shape() -> None:
    case = tiles_case(4)
    _, by_pose, _ = jacobians(case)
    of_ranges = by_pose[: len(case.tile)]
    expected = of_ranges.T @ of_ranges
    blocks = case.quadratic().blocks
    for j in range(CLOUDS):
        own = slice(6 * j, 6 * j + 6)
        largest = np.abs(expected[own, own]).max()
        assert blocks[j] == pytest.approx(expected[own, own], rel=1e-6, abs=1e-6 * largest)


def test_nothing_holds_a_cloud_along_one_plane() -> None:
    # A floor tells three of six: a shift along it and the turn about its normal are free.
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (3000, 2)), np.zeros(3000)])
    stack = stack_of(points, UP.repeat(3000, axis=0), flatness=np.zeros(3000))
    floor = together(*[surfel(tuple(p), width_m=0.05) for p in points[:200].tolist()])
    who = expect(stack, *IDENTITY, floor, noise_of(), 1e-9, np.ones(1))
    blocks = quadratic_of(stack, *IDENTITY, floor, who).blocks[0]
    assert np.diag(blocks)[[2, 3, 4]] == pytest.approx(np.zeros(3), abs=1e-6)
    # Heights of 10 mm: a shift upwards is known to 10 mm over the root of 3000.
    assert blocks[5, 5] == pytest.approx(3000.0 / 0.01**2, rel=1e-3)


def test_shape_parameters_are_those_that_the_ranges_determine() -> None:
    # Offset and two turns of each tile, none of the turn about its own normal: of a tile of 60 mm
    # with 100 points and 12 mm of noise the prior of 0.2 rad has hardly a part.
    known = tiles_case().quadratic().shape_parameters()
    assert 3.0 * TILES - 0.5 < known <= 3.0 * TILES
    # Points on a line determine two; the turn about it is that of the priors.
    line = np.column_stack([np.zeros(200), np.linspace(-0.2, 0.2, 200), np.zeros(200)])
    stack = stack_of(line, UP.repeat(200, axis=0))
    flat = surfel((0.0, 0.0, 0.0), width_m=0.1)
    who = expect(stack, *IDENTITY, flat, noise_of(), 1e-12, np.ones(1))
    assert quadratic_of(stack, *IDENTITY, flat, who).shape_parameters() == pytest.approx(
        2, abs=0.01
    )


def common(quadratic: ShapeQuadratic) -> Array:
    """(6,) information on a common motion of all clouds, over what the blocks claim of it."""
    motion = np.tile(np.eye(6), (len(quadratic.blocks), 1))
    claimed = np.diag(quadratic.blocks.sum(axis=0))
    return np.asarray(np.diag(motion.T @ quadratic.joint() @ motion) / claimed)


@pytest.mark.parametrize("at_optimum", [False, True])
def test_a_common_motion_is_a_gauge_freedom(at_optimum: bool) -> None:
    quadratic = tiles_case(4, at_optimum).quadratic()
    H = quadratic.joint()
    np.testing.assert_allclose(H, H.T, rtol=0.0, atol=1e-12 * np.abs(H).max())
    eigenvalues = np.linalg.eigvalsh(H)
    assert eigenvalues[0] > -1e-9 * eigenvalues[-1]
    assert common(quadratic) == pytest.approx(np.zeros(6), abs=1e-9)
    pull = np.abs(quadratic.gradient.sum(axis=0))
    assert (pull < 1e-7 * np.abs(quadratic.gradient).max(axis=0)).all()
    # Of the 18 directions it is all that is lost: one shape ties three clouds together.
    assert eigenvalues[6] > 1e-6 * eigenvalues[-1]


def test_joint_never_claims_more_than_the_blocks() -> None:
    quadratic = tiles_case(5).quadratic()
    taken = np.zeros((18, 18))
    for j in range(3):
        taken[6 * j : 6 * j + 6, 6 * j : 6 * j + 6] = quadratic.blocks[j]
    less = np.linalg.eigvalsh(taken - quadratic.joint())
    # But for the priors of six normals: 0.2 rad each.
    assert less[0] > -TILES / NORMAL_SIGMA_RAD**2
    assert less[0] > -1e-6 * less[-1]
    assert less[-1] > 0.0


def test_quadratic_grows_with_the_weight_of_a_cloud() -> None:
    case = tiles_case(6)
    stack, R, t, mixture, noise = case.stack, case.R, case.t, case.mixture, case.noise
    weights = np.array([1.0, 1.0, 1.0]), np.array([1.0, 0.5, 1.0])
    full, half = (
        quadratic_of(stack, R, t, mixture, expect(stack, R, t, mixture, noise, 1e-12, w)).blocks
        for w in weights
    )
    assert half[1] == pytest.approx(0.5 * full[1])
    assert half[[0, 2]] == pytest.approx(full[[0, 2]])


def skins(thickness_m: float = 0.025) -> tuple[CloudStack, Array, Array, ShapeQuadratic]:
    """Six clouds of a plate, in turn of its front and of its back, after a few EM rounds."""
    rng = np.random.default_rng(0)
    clouds, poses = [], []
    for j in range(6):
        front = j % 2 == 0
        T = looking_at_target((0.0 if front else 180.0) + 10.0 * (j // 2), 8.0, 1.0)
        x = 0.5 * thickness_m * (1.0 if front else -1.0)
        plate = rectangle_points(
            rng, 500, np.array([x, -0.4, -0.5]), np.array([0, 0.8, 0]), np.array([0, 0, 1.0])
        )
        clouds.append(seen_from(T, plate, 0.005, rng))
        poses.append(T)
    stack = stack_clouds(observe(clouds), 1000, 0.005)
    R, t = matrices(poses)
    mixture = seed_mixture(stack, R, t, 150, 0.01)
    for _ in range(6):
        who = expect(stack, R, t, mixture, noise_of(0.005), 0.05, np.ones(6))
        mixture = maximised(stack, R, t, mixture, who, 0.005)
    return stack, R, t, quadratic_of(stack, R, t, mixture, who)


RELATIVE = np.kron(np.array([0.5, -0.5] * 3)[:, None], np.eye(6))
"""(36, 6) clouds of the front against clouds of the back."""


def test_disjoint_skins_are_explained_by_their_own_surfels() -> None:
    stack, _, _, quadratic = skins()
    # What ties clouds is the coupling: none between a front and a back cloud.
    H = quadratic.joint().reshape(6, 6, 6, 6)
    own = np.linalg.norm(H[0, :, 2, :])
    other = max(np.linalg.norm(H[0, :, j, :]) for j in (1, 3, 5))
    assert other < 1e-3 * own
    assert stack.count == 6


def test_a_common_motion_of_skins_is_in_the_null_space() -> None:
    _, _, _, quadratic = skins()
    assert common(quadratic) == pytest.approx(np.zeros(6), abs=1e-9)


def test_clouds_of_disjoint_skins_have_no_information_on_each_other() -> None:
    _, _, _, quadratic = skins()
    information = RELATIVE.T @ quadratic.joint() @ RELATIVE
    sigma = np.diag(information) ** -0.5
    # Ten times the sigma of a guess (the default config: 30 mrad, 58 mm).
    assert sigma[:3].min() > 0.3
    assert sigma[3:].min() > 0.6


def test_clouds_of_disjoint_skins_have_less_relative_information_than_the_blocks() -> None:
    _, _, _, quadratic = skins()
    joint = np.diag(RELATIVE.T @ quadratic.joint() @ RELATIVE)
    claimed = 0.25 * np.diag(quadratic.blocks.sum(axis=0))
    assert (joint / claimed).max() < 0.05


# ------------------------------------------------------------------ surfels


def test_planes_go_through_the_weighted_means_of_their_points() -> None:
    # Straight from above: the beams meet the plane at the points' places along it.
    points = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0], [2.0, 0.0, 0.0]])
    who = held(
        np.array([[0, 1], [1, 0], [0, 2]]),
        np.array([[300.0, 100.0], [100.0, 100.0], [400.0, 0.0]]),
    )
    places = [surfel((0.1 * k, 0.0, 0.0), width_m=0.3) for k in range(3)]
    stack = stack_of(points, UP.repeat(3, axis=0), flatness=np.zeros(3))
    cells = cell_moments(stack, who, 3)
    after = maximise_shape(
        stack, *IDENTITY, together(*places), 0.01, cells, who.counts, np.zeros((3, 3))
    )
    # (300 x 0 + 100 x (1, 2, 3) + 400 x (2, 0, 0)) / 800.
    assert after.means_target[0] == pytest.approx([900 / 800, 200 / 800, 300 / 800], rel=1e-4)
    assert after.means_target[1] == pytest.approx([0.5, 1.0, 1.5], rel=1e-4)
    assert after.weights == pytest.approx([0.8, 0.2, 0.0], abs=1e-4)


def test_held_tiles_move_along_their_normals_alone() -> None:
    # A surfel at the origin that faces up. All of its points are 2 m above it and 1 m aside: left
    # free it goes to them, as narrow as they lie; as a held tile it rises by 2 m.
    stack = stack_of(np.array([[1.0, 0.0, 2.0]] * 3), UP.repeat(3, axis=0), flatness=np.zeros(3))
    who = held(np.zeros((3, 1), np.int64), np.full((3, 1), 100.0))
    before = surfel((0.0, 0.0, 0.0), width_m=0.3)
    sums = cell_moments(stack, who, 1), who.counts, np.zeros((1, 3))
    free = maximise_shape(stack, *IDENTITY, before, 0.01, *sums)
    assert free.means_target[0] == pytest.approx([1.0, 0.0, 2.0])
    assert math.sqrt(free.var_tangent[0]) == pytest.approx(0.01)
    tile = maximise_shape(stack, *IDENTITY, before, 0.01, *sums, tiles_held=True)
    assert tile.means_target[0] == pytest.approx([0.0, 0.0, 2.0])
    assert math.sqrt(tile.var_tangent[0]) == pytest.approx(0.3)
    # Its normal turned by 0.1 rad about y, towards +x: the plane goes through the points as before.
    turned = (*sums[:2], np.array([[0.0, 0.1, 0.0]]))
    tile = maximise_shape(stack, *IDENTITY, before, 0.01, *turned, tiles_held=True)
    normal = tile.normals_target[0]
    assert normal == pytest.approx([math.sin(0.1), 0.0, math.cos(0.1)])
    assert normal @ (tile.means_target[0] - [1.0, 0.0, 2.0]) == pytest.approx(0.0, abs=1e-9)
    assert np.cross(tile.means_target[0], normal) == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)


def test_surfels_learn_the_surface() -> None:
    # One surfel on a plane tilted by 30 degrees, 4 mm of noise, 0.2 m wide.
    rng = np.random.default_rng(8)
    tilt = math.radians(30.0)
    normal = np.array([math.sin(tilt), 0.0, math.cos(tilt)])
    along = np.array([math.cos(tilt), 0.0, -math.sin(tilt)])
    u, v = rng.uniform(-0.1, 0.1, (2, 4000, 1))
    points = u * along + v * np.array([0, 1.0, 0]) + 0.004 * rng.normal(size=(4000, 1)) * normal
    points += np.array([1.0, 2.0, 3.0])
    stack = stack_of(points, np.tile(normal, (4000, 1)))
    mixture = surfel((0.9, 2.0, 3.0), (0.0, 0.0, 1.0), width_m=0.2)
    for _ in range(12):
        who = expect(stack, *IDENTITY, mixture, noise_of(0.02), 1e-9, np.ones(1))
        mixture = maximised(stack, *IDENTITY, mixture, who, 0.001)
    assert mixture.means_target[0] == pytest.approx([1.0, 2.0, 3.0], abs=5e-3)
    # The points' own plane: 4 mm over 58 mm and the root of 4000 are 1.1 mrad.
    assert mixture.normals_target[0] == pytest.approx(normal, abs=4e-3)
    # Uniform over 0.2 m: 0.2 / sqrt(12).
    assert math.sqrt(mixture.var_tangent[0]) == pytest.approx(0.0577, rel=0.05)
    floored = maximised(stack, *IDENTITY, mixture, who, 0.1)
    assert math.sqrt(floored.var_tangent[0]) == pytest.approx(0.1)


def test_a_point_on_its_own_has_the_least_width() -> None:
    stack = stack_of(np.full((20, 3), 0.3), UP.repeat(20, axis=0))
    who = expect(stack, *IDENTITY, surfel((0.3, 0.3, 0.3)), noise_of(), 1e-9, np.ones(1))
    after = maximised(stack, *IDENTITY, surfel((0.3, 0.3, 0.3)), who, 0.0)
    assert math.sqrt(after.var_tangent[0]) == pytest.approx(LEAST_EXTENT_M)


def test_normals_of_surfels_are_drawn_to_those_that_can_be_trusted() -> None:
    # Of 20 points 4 have a normal, leaning 0.1 rad; what the others say, sideways, is noise.
    leaning = np.array([math.sin(0.1), 0.0, math.cos(0.1)])
    normals = np.tile([1.0, 0.0, 0.0], (20, 1))
    normals[:4] = leaning
    flatness = np.where(np.arange(20) < 4, 1.0, 0.0)
    beams = np.tile(-UP, (20, 1))
    stack = stack_of(np.zeros((20, 3)), normals, beams=beams, flatness=flatness)
    who = held(np.zeros((20, 1), np.int64), np.ones((20, 1)))
    flat = surfel((0.0, 0.0, 0.0))
    quadratic = quadratic_of(stack, *IDENTITY, flat, who)
    # A fifth of 1 / 0.2^2 against 1 / 1 rad^2.
    known = 0.2 / NORMAL_SIGMA_RAD**2
    assert quadratic.normal_information == pytest.approx([known + SEEN_SIGMA_RAD**-2])
    turn = 0.1 * known / (known + SEEN_SIGMA_RAD**-2)
    assert quadratic.turns[0] == pytest.approx([0.0, turn, 0.0], abs=1e-9)


def test_weights_of_surfels_are_their_part_of_the_points() -> None:
    rng = np.random.default_rng(9)
    stack = stack_of(rng.normal(size=(40, 3)), UP.repeat(40, axis=0))
    who = held(np.tile([0, 1], (40, 1)), np.tile([0.6, 0.2], (40, 1)))
    pair = together(surfel((0, 0, 0)), surfel((1, 0, 0)))
    after = maximised(stack, *IDENTITY, pair, who, 0.01)
    assert after.weights == pytest.approx([0.75, 0.25], abs=1e-4)


def test_an_abandoned_surfel_stays_where_it_was() -> None:
    stack = stack_of(np.full((20, 3), 0.3), UP.repeat(20, axis=0))
    who = replace(
        held(np.zeros((20, 1), np.int64), np.ones((20, 1))),
        counts=np.array([20.0, 0.0]),
        component_levers=np.zeros((2, 3)),
    )
    pair = together(surfel((0.3, 0.3, 0.3)), surfel((1, 0, 0), (0.0, 1.0, 0.0)))
    after = maximised(stack, *IDENTITY, pair, who, 0.01)
    for values in (after.means_target, after.var_tangent, after.weights):
        assert np.isfinite(values).all()
    assert after.means_target[1] == pytest.approx([1.0, 0.0, 0.0])
    assert after.normals_target[1] == pytest.approx([0.0, 1.0, 0.0])
    assert after.weights[1] < 1e-4


def seed_case() -> tuple[CloudStack, Array, Array]:
    rng = np.random.default_rng(10)
    poses = [looking_at_target(a, 6.0) for a in (0.0, 40.0, 80.0)]
    clouds = [
        seen_from(
            T,
            rectangle_points(
                rng,
                n,
                np.array([0.1, -0.5, -0.5]),
                np.array([0.0, 1.0, 0.0]),
                np.array([0, 0, 1.0]),
            ),
            0.001,
            rng,
        )
        for T, n in zip(poses, (900, 150, 90), strict=True)
    ]
    return stack_clouds(observe(clouds), 2000, 0.001), *matrices(poses)


def test_every_cloud_seeds_as_many_surfels() -> None:
    stack, R, t = seed_case()
    mixture = seed_mixture(stack, R, t, 90, 0.03)
    points = stack.moved(R, t)
    row = {tuple(p): n for n, p in enumerate(points.tolist())}
    drawn = [row[tuple(m)] for m in mixture.means_target.tolist()]
    assert len(set(drawn)) == 90
    assert np.bincount(stack.cloud[drawn]).tolist() == [30, 30, 30]
    # Normals and widths of the seeds.
    expected = stack.rotated(R, stack.normals)[drawn]
    np.testing.assert_array_equal(mixture.normals_target, expected)
    # As wide as asked for, or half of what it is to the third neighbour: they tile the face.
    places = mixture.means_target
    apart = np.sort(np.linalg.norm(places[:, None] - places[None], axis=2), axis=1)
    expected_m = np.maximum(0.5 * apart[:, 3], 0.03)
    assert np.sqrt(mixture.var_tangent) == pytest.approx(expected_m)
    assert 0 < np.sum(expected_m > 0.03) < 90
    assert mixture.weights.sum() == pytest.approx(1.0)


def test_seeds_are_the_same_points_wherever_the_clouds_are() -> None:
    stack, R, t = seed_case()
    moved_R, moved_t = left_step(R, t, np.random.default_rng(11).normal(size=(3, 6)) * 0.1)
    here = seed_mixture(stack, R, t, 100, 0.03).means_target
    there = seed_mixture(stack, moved_R, moved_t, 100, 0.03).means_target
    row = {tuple(p): n for n, p in enumerate(stack.moved(R, t).tolist())}
    moved_row = {tuple(p): n for n, p in enumerate(stack.moved(moved_R, moved_t).tolist())}
    assert [row[tuple(m)] for m in here.tolist()] == [moved_row[tuple(m)] for m in there.tolist()]


def test_another_draw_begins_on_other_points() -> None:
    stack, R, t = seed_case()
    draws = [seed_mixture(stack, R, t, 20, 0.03, draw=draw).means_target for draw in range(3)]
    places = [{tuple(p) for p in means.tolist()} for means in draws]
    assert [len(p) for p in places] == [20, 20, 20]
    assert not places[0] & places[1]
    assert not (places[0] | places[1]) & places[2]


def test_seeds_everywhere_are_on_parts_whose_normals_are_not_known() -> None:
    # A face of 600 points, and a leg of 200 with two columns of points on it, whose normals nobody
    # knows: a quarter of the points, and of the surfels.
    rng = np.random.default_rng(3)
    face = rectangle_points(rng, 600, np.zeros(3), np.array([0.4, 0, 0]), np.array([0, 0.4, 0]))
    leg = face[:200] * [0.1, 1.0, 1.0] - [0.0, 0.5, 0.0]
    up = np.tile([0.0, 0.0, 1.0], (800, 1))
    flatness = np.repeat([0.9, 0.1], [600, 200])
    stack = stack_of(np.concatenate([face, leg]), up, flatness=flatness)
    reliable = seed_mixture(stack, *IDENTITY, 80, 0.01)
    everywhere = seed_mixture(stack, *IDENTITY, 80, 0.01, everywhere=True)
    assert (reliable.means_target[:, 1] > -0.1).all()
    on_leg = everywhere.means_target[:, 1] < -0.1
    assert 10 <= on_leg.sum() <= 30
    # They are no wider than the leg.
    assert np.sqrt(np.median(everywhere.var_tangent[on_leg])) < 0.04


def test_no_more_surfels_than_points_can_tell() -> None:
    stack, R, t = seed_case()
    mixture = seed_mixture(stack, R, t, 5000, 0.03)
    # Ten points of each: 900 + 150 + 90 in all.
    assert len(mixture.weights) == 114
    assert mixture.weights == pytest.approx(np.full(114, 1.0 / 114))
