"""The mixture by hand: responsibilities, components, and its quadratic by numerical derivatives."""

from __future__ import annotations

import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from caliv_graph.products import Array, IntArray, Mixture
from caliv_graph.registration.clouds import CloudStack, stack_clouds
from caliv_graph.registration.mixture import (
    ALONG_SURFACE,
    MAX_TURN_RAD,
    expect,
    maximise_shape,
    seed_mixture,
)
from caliv_graph.registration.moments import Responsibilities, cell_moments
from caliv_graph.registration.quadratic import ShapeQuadratic, shape_quadratic
from caliv_graph.registration.register import left_step
from tests.registration.scenes import (
    looking_at_target,
    matrices,
    observe,
    rectangle_points,
    seen_from,
)

IDENTITY = (np.eye(3)[None], np.zeros((1, 3)))


def stack_of(
    points: Array,
    normals: Array,
    *,
    beams: Array | None = None,
    flatness: Array | None = None,
    starts: tuple[int, ...] = (0,),
    sigma_range_m: float = 0.01,
) -> CloudStack:
    """Points with normals as they are given; beams against the normals unless given."""
    count = len(points)
    cloud = np.searchsorted(np.array(starts), np.arange(count), side="right") - 1
    return CloudStack(
        points=points,
        cloud=cloud.astype(np.int64),
        starts=np.array(starts, dtype=np.int64),
        beams=-normals if beams is None else beams,
        normals=normals,
        flatness=np.ones(count) if flatness is None else flatness,
        whole=(points,),
        sigma_range_m=sigma_range_m,
    )


def component(
    mean: tuple[float, float, float],
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0),
    *,
    sigma_normal: float = 0.1,
    sigma_tangent: float = 0.1,
    weight: float = 1.0,
) -> Mixture:
    return Mixture(
        means_target=np.array([mean]),
        normals_target=np.array([normal]),
        var_normal=np.array([sigma_normal**2]),
        var_tangent=np.array([sigma_tangent**2]),
        weights=np.array([weight]),
    )


def together(*mixtures: Mixture) -> Mixture:
    return Mixture(
        *(
            np.concatenate([getattr(m, name) for m in mixtures])
            for name in (
                "means_target",
                "normals_target",
                "var_normal",
                "var_tangent",
                "weights",
            )
        )
    )


UP = np.array([[0.0, 0.0, 1.0]])


def held(component: IntArray, alpha: Array, clouds: int = 1) -> Responsibilities:
    nothing = np.zeros((clouds, 3)), np.zeros((int(component.max()) + 1, 3))
    return Responsibilities(component, alpha, np.ones(clouds), *nothing, np.zeros(len(alpha)))


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
    expected = cells, quadratic.orientation_information, quadratic.torque
    return maximise_shape(stack, R, t, mixture, floor_m, *expected)


# ------------------------------------------------------------------ E-step


def test_responsibility_of_one_component_by_hand() -> None:
    # 0.1 m along x from the mean, sigma 0.1 m: N = (2 pi)^-3/2 0.1^-3 e^-1/2 = 38.51 per m^3.
    stack = stack_of(np.array([[0.1, 0.0, 0.0]]), UP)
    density = 38.51
    who = expect(stack, *IDENTITY, component((0.0, 0.0, 0.0)), density, np.ones(1))
    assert who.component.tolist() == [[0]]
    assert who.alpha == pytest.approx(np.array([[0.5]]), abs=1e-4)
    assert who.inlier_ratio == pytest.approx([0.5], abs=1e-4)
    # Half the prior: 19.25 against 38.51.
    who = expect(stack, *IDENTITY, component((0.0, 0.0, 0.0), weight=0.5), density, np.ones(1))
    assert who.alpha == pytest.approx(np.array([[1.0 / 3.0]]), abs=1e-4)


def test_normal_and_tangent_have_their_own_variance() -> None:
    # 20 mm off: 1 sigma along the normal (z), 0.2 sigmas across it. Both densities are
    # (2 pi)^-3/2 / (0.02 0.1^2) = 317.5 times e^-0.5 and e^-0.02.
    flat = component((0.0, 0.0, 0.0), sigma_normal=0.02, sigma_tangent=0.1)
    stack = stack_of(np.array([[0.0, 0.0, 0.02], [0.02, 0.0, 0.0]]), UP.repeat(2, axis=0))
    density = 100.0
    who = expect(stack, *IDENTITY, flat, density, np.ones(1))
    expected = [317.47 * math.exp(-0.5), 317.47 * math.exp(-0.02)]
    assert who.alpha[:, 0] == pytest.approx([n / (n + density) for n in expected], rel=1e-4)


def test_a_point_belongs_where_its_beam_meets_the_surface() -> None:
    # 60 degrees from the normal, 30 mm too far: 15 mm below the surface and 26 mm along it. The
    # beam met the surface at the mean: only the height counts.
    beam = np.array([[math.sin(math.radians(60.0)), 0.0, -0.5]])
    flat = component((0.0, 0.0, 0.0), sigma_normal=0.02, sigma_tangent=0.05)
    density = 100.0
    who = expect(stack_of(0.03 * beam, UP, beams=beam), *IDENTITY, flat, density, np.ones(1))
    expected = math.exp(-0.5 * (0.015 / 0.02) ** 2) / ((2 * math.pi) ** 1.5 * 0.02 * 0.05**2)
    assert who.alpha[0, 0] == pytest.approx(expected / (expected + density), rel=1e-6)
    # What the noise along the beam does not explain stands where it is.
    still = stack_of(0.03 * beam, UP, beams=beam, sigma_range_m=1e-9)
    apart = expect(still, *IDENTITY, flat, density, np.ones(1))
    farther = expected * math.exp(-0.5 * (0.03 * math.sin(math.radians(60.0)) / 0.05) ** 2)
    assert apart.alpha[0, 0] == pytest.approx(farther / (farther + density), rel=1e-6)
    # A beam along the surface meets it nowhere: the point counts where it is.
    flush = np.array([[1.0, 0.0, 0.0]])
    near = expect(stack_of(0.03 * flush, UP, beams=flush), *IDENTITY, flat, density, np.ones(1))
    aside = 0.5 / ((2 * math.pi) ** 1.5 * 0.02 * 0.05**2) * math.exp(-0.5 * (0.03 / 0.05) ** 2)
    assert near.alpha[0, 0] == pytest.approx(aside / (aside + density), rel=1e-6)


def test_a_beam_nearly_along_the_surface_is_hardly_followed() -> None:
    # 1.7 degrees off it, 10 mm below: the beam meets the surface 0.33 m away, and a normal that is
    # off by a degree would make 0.2 m of it. Followed are 0.01 x 0.03 / 0.1^2 = 30 mm; a beam that
    # flat sees the surface for 0.8.
    beam = np.array([[math.sqrt(1.0 - 0.03**2), 0.0, -0.03]])
    flat = component((0.0, 0.0, 0.0), sigma_normal=0.02, sigma_tangent=0.05)
    stack = stack_of(np.array([[0.0, 0.0, -0.01]]), UP, beams=beam, sigma_range_m=0.05)
    who = expect(stack, *IDENTITY, flat, 100.0, np.ones(1))
    squares = (0.01 / 0.02) ** 2 + (0.03 * beam[0, 0] / 0.05) ** 2
    expected = 0.8 * math.exp(-0.5 * squares) / ((2 * math.pi) ** 1.5 * 0.02 * 0.05**2)
    assert who.alpha[0, 0] == pytest.approx(expected / (expected + 100.0), rel=1e-6)


def test_levers_are_those_of_the_residual_along_the_beam() -> None:
    # Half the squared distance to the surface along the beam, over what that has for a variance:
    # its derivative by a rotation is that of the distance across the surface, plus the levers.
    n, y, b = np.array([0.6, 0.0, 0.8]), np.array([0.3, -0.2, 0.5]), np.array([0.48, 0.6, -0.64])
    mu = y - 0.01 * n
    flat = component((mu[0], mu[1], mu[2]), (0.6, 0.0, 0.8), sigma_normal=0.02, sigma_tangent=0.1)
    many = [np.tile(v, (10, 1)) for v in (y, n, b)]
    stack = stack_of(many[0], many[1], beams=many[2], sigma_range_m=0.05)
    who = expect(stack, *IDENTITY, flat, 1e-9, np.ones(1))
    a = 1.0 / 0.02**2 - ALONG_SURFACE / 0.1**2

    def costs(d: Array) -> Array:
        R = gtsam.Rot3.Expmap(d).matrix()
        across = n @ (R @ y - mu)
        return 0.5 * a * np.array([(n @ b) ** 2 * (across / (n @ R @ b)) ** 2, across**2])

    step = 1e-5
    slopes = np.array([costs(d) - costs(-d) for d in step * np.eye(3)]) / (2.0 * step)
    assert who.levers[0] == pytest.approx(10.0 * (slopes[:, 0] - slopes[:, 1]), rel=1e-5)
    assert who.component_levers == pytest.approx(who.levers)
    assert np.abs(who.levers).max() > 5.0


def test_a_turn_of_all_clouds_changes_nothing() -> None:
    # Of pulls, the levers' too: the components that clouds share are turned with them.
    stack, R, t, quadratic = skins()
    who = expect(stack, R, t, seed_mixture(stack, R, t, 150, 0.01), 0.05, np.ones(6))
    assert np.abs(who.levers).max() > 1.0
    assert who.levers.sum(axis=0) == pytest.approx(who.component_levers.sum(axis=0))
    scale = np.abs(quadratic.gradient).max()
    assert np.abs(quadratic.gradient.sum(axis=0)).max() < 1e-3 * scale


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
    shape = together(
        *[
            component(tuple(p), tuple(normal), sigma_normal=0.01, sigma_tangent=0.012)
            for p in points[0][:300]
        ]
    )

    def expected() -> Responsibilities:
        who = expect(stack, R, t, shape, 1e-3, np.ones(2))
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
    flat = component((0.0, 0.0, 0.0), sigma_normal=0.01, sigma_tangent=0.03)
    found = []
    for noise_m in (1e-6, 0.01):
        stack = slanted(np.random.default_rng(3), noise_m, UP[0])
        who = expect(stack, *IDENTITY, flat, 1e-9, np.ones(1))
        found.append((stack, who, quadratic_of(stack, *IDENTITY, flat, who)))
    (_, _, still), (stack, who, noisy) = found
    for axis in (0, 1):
        expected = still.orientation_information[0, axis, axis]
        assert noisy.orientation_information[0, axis, axis] == pytest.approx(expected, rel=0.02)
        assert noisy.blocks[0, axis, axis] == pytest.approx(still.blocks[0, axis, axis], rel=0.02)
    at_points = replace(who, slides_m=np.zeros(len(stack.points)))
    longer = quadratic_of(stack, *IDENTITY, flat, at_points)
    assert longer.orientation_information[0, 1, 1] > 1.1 * still.orientation_information[0, 1, 1]
    # Nor does the component become wider.
    after = maximised(stack, *IDENTITY, flat, who, 0.001)
    assert math.sqrt(after.var_tangent[0]) == pytest.approx(0.08 / math.sqrt(12.0), rel=0.02)


def test_a_component_turns_into_the_plane_of_its_points() -> None:
    # The normals of the points are 0.1 rad off; the points themselves tell to
    # 5 mm / (23 mm sqrt(4000)) = 3 mrad.
    wrong = np.array([math.sin(0.1), 0.0, math.cos(0.1)])
    stack = slanted(np.random.default_rng(4), 0.01, wrong)
    mixture = component((0, 0, 0), tuple(wrong), sigma_normal=0.01, sigma_tangent=0.03)
    for _ in range(8):
        who = expect(stack, *IDENTITY, mixture, 1e-9, np.ones(1))
        mixture = maximised(stack, *IDENTITY, mixture, who, 0.001)
    assert mixture.normals_target[0] == pytest.approx(UP[0], abs=0.012)
    assert math.sqrt(mixture.var_normal[0]) == pytest.approx(0.005, rel=0.05)


def test_a_component_turns_no_further_at_once_than_where_it_is_nearly_linear() -> None:
    # The points' normals agree with the component's, and the points stand 0.6 rad off them.
    wrong = np.array([math.sin(0.6), 0.0, math.cos(0.6)])
    stack = slanted(np.random.default_rng(4), 0.001, wrong)
    mixture = component((0, 0, 0), tuple(wrong), sigma_normal=0.02, sigma_tangent=0.03)
    who = expect(stack, *IDENTITY, mixture, 1e-9, np.ones(1))
    after = maximised(stack, *IDENTITY, mixture, who, 0.001)
    turned = math.acos(float(after.normals_target[0] @ wrong))
    assert turned == pytest.approx(MAX_TURN_RAD, abs=1e-6)


def test_points_on_a_line_leave_the_turn_about_it_to_their_normals() -> None:
    rng = np.random.default_rng(6)
    points = np.column_stack([np.zeros(200), rng.uniform(-0.05, 0.05, 200), np.zeros(200)])
    leaning = np.array([math.sin(0.3), 0.0, math.cos(0.3)])
    stack = stack_of(points, np.tile(leaning, (200, 1)), beams=np.tile(-UP, (200, 1)))
    flat = component((0.0, 0.0, 0.0), sigma_normal=0.01, sigma_tangent=0.03)
    who = expect(stack, *IDENTITY, flat, 1e-9, np.ones(1))
    after = maximised(stack, *IDENTITY, flat, who, 0.001)
    assert after.normals_target[0] == pytest.approx(leaning, abs=1e-3)


def test_two_components_share_a_point_between_them() -> None:
    pair = together(component((-0.1, 0.0, 0.0), weight=0.5), component((0.1, 0.0, 0.0), weight=0.5))
    stack = stack_of(np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0]]), UP.repeat(2, axis=0))
    who = expect(stack, *IDENTITY, pair, 1e-9, np.ones(1))
    alpha = {
        (n, k): a for n in range(2) for k, a in zip(who.component[n], who.alpha[n], strict=True)
    }
    assert alpha[0, 0] == pytest.approx(0.5)
    assert alpha[0, 1] == pytest.approx(0.5)
    # 0.05 and 0.15 m: the ratio is e^(0.125 - 1.125) = e^-1.
    assert alpha[1, 0] / alpha[1, 1] == pytest.approx(math.exp(-1.0))
    assert who.alpha.sum(axis=1) == pytest.approx([1.0, 1.0])


def test_points_are_looked_at_under_the_pose_of_their_cloud() -> None:
    # A point 5 m ahead of a LiDAR that stands 5 m from the component, and looks at it.
    T = gtsam.Pose3(gtsam.Rot3.Yaw(math.pi / 2), np.array([0.3, -5.0, 0.0]))
    R, t = matrices([T])
    ahead = np.array([[1.0, 0.0, 0.0]])
    stack = stack_of(5.0 * ahead, -ahead)
    shape = component((0.3, 0.0, 0.0), (0.0, -1.0, 0.0), sigma_normal=0.01, sigma_tangent=0.01)
    assert expect(stack, R, t, shape, 1.0, np.ones(1)).alpha[0, 0] > 0.99
    assert expect(stack, *IDENTITY, shape, 1.0, np.ones(1)).alpha[0, 0] < 1e-9


def test_normals_that_disagree_cost_their_exponent() -> None:
    # Same place, seen from the front: normals 0, 60 and 90 degrees from the component's.
    angles = np.radians([0.0, 60.0, 90.0])
    normals = np.column_stack([np.sin(angles), np.zeros(3), np.cos(angles)])
    stack = stack_of(np.zeros((3, 3)), normals, beams=-UP.repeat(3, axis=0))
    density = 1e6  # so that alpha is the density of the component over it
    alpha = expect(stack, *IDENTITY, component((0, 0, 0)), density, np.ones(1)).alpha[:, 0]
    # 60 degrees a factor of e^2, 90 degrees e^4.
    assert alpha[1] / alpha[0] == pytest.approx(math.exp(-2.0), rel=1e-3)
    assert alpha[2] / alpha[0] == pytest.approx(math.exp(-4.0), rel=1e-3)
    # A normal that cannot be trusted costs nothing.
    blind = replace(stack, flatness=np.zeros(3))
    alpha = expect(blind, *IDENTITY, component((0, 0, 0)), density, np.ones(1)).alpha[:, 0]
    assert alpha == pytest.approx(np.full(3, alpha[0]))


def test_a_component_is_not_seen_from_behind() -> None:
    # Beams at 0, 45, 135 and 180 degrees from the component's back; nothing known of normals.
    angles = np.radians([0.0, 45.0, 135.0, 180.0])
    beams = -np.column_stack([np.sin(angles), np.zeros(4), np.cos(angles)])
    stack = stack_of(np.zeros((4, 3)), -beams, beams=beams, flatness=np.zeros(4))
    alpha = expect(stack, *IDENTITY, component((0, 0, 0)), 1e6, np.ones(1)).alpha[:, 0]
    assert alpha[1] == pytest.approx(alpha[0])
    assert alpha[2] < 2e-3 * alpha[0]
    assert alpha[3] < 2e-3 * alpha[0]


def test_weights_of_clouds_scale_responsibilities_and_leave_the_ratio_alone() -> None:
    points = np.array([[0.1, 0.0, 0.0], [0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [0.0, 0.1, 0.0]])
    stack = stack_of(points, UP.repeat(4, axis=0), starts=(0, 1))
    R, t = np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3))
    full = expect(stack, R, t, component((0, 0, 0)), 1.0, np.ones(2))
    weighted = expect(stack, R, t, component((0, 0, 0)), 1.0, np.array([1.0, 0.25]))
    assert weighted.alpha[0] == pytest.approx(full.alpha[0])
    assert weighted.alpha[1:] == pytest.approx(0.25 * full.alpha[1:])
    # Of the second cloud's three points one is 5 m away.
    assert full.inlier_ratio[1] == pytest.approx(2.0 / 3.0, abs=0.02)
    assert weighted.inlier_ratio == pytest.approx(full.inlier_ratio)


# ------------------------------------------------------------------ the quadratic


Case = tuple[CloudStack, Array, Array, Mixture, Responsibilities]


def random_case(seed: int = 0) -> Case:
    """Anything at all: the quadratic is exact whatever the responsibilities are."""
    clouds, points, components = 3, 60, 8
    rng = np.random.default_rng(seed)
    poses = [
        looking_at_target(float(azimuth), float(rng.uniform(4.0, 12.0)))
        for azimuth in rng.uniform(0.0, 360.0, clouds)
    ]
    target = rng.normal(size=(clouds, points, 3)) * [0.3, 0.3, 0.5]
    lidar = np.concatenate([p.transformTo(part.T).T for p, part in zip(poses, target, strict=True)])
    stack = stack_of(
        lidar,
        directions(rng, len(lidar)),
        beams=lidar / np.linalg.norm(lidar, axis=1, keepdims=True),
        starts=tuple(points * j for j in range(clouds)),
    )
    mixture = Mixture(
        means_target=rng.normal(size=(components, 3)),
        normals_target=directions(rng, components),
        var_normal=rng.uniform(0.01, 0.03, components) ** 2,
        var_tangent=rng.uniform(0.03, 0.1, components) ** 2,
        weights=np.full(components, 1.0 / components),
    )
    component = np.array([rng.permutation(components)[:4] for _ in lidar])
    # Many points' worth each, so that what keeps abandoned components defined does not matter.
    alpha = rng.uniform(1.0, 30.0, component.shape)
    return stack, *matrices(poses), mixture, held(component, alpha, clouds)


def directions(rng: np.random.Generator, count: int) -> Array:
    v = rng.normal(size=(count, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def weight_matrices(case: Case) -> Array:
    """(N, 4, 3, 3) weight of each pair, across its component and a part of it along."""
    _, _, _, mixture, who = case
    out = np.empty((*who.component.shape, 3, 3))
    for n, (ks, alphas) in enumerate(zip(who.component, who.alpha, strict=True)):
        for i, (k, a) in enumerate(zip(ks, alphas, strict=True)):
            normal = np.outer(mixture.normals_target[k], mixture.normals_target[k])
            out[n, i] = a * normal / mixture.var_normal[k]
            out[n, i] += a * ALONG_SURFACE * (np.eye(3) - normal) / mixture.var_tangent[k]
    return out


def offsets(case: Case, d: Array) -> Array:
    """(N, 4, 3) of each pair of point and component: the point from the component's mean."""
    stack, R, t, mixture, who = case
    R, t = left_step(R, t, d.reshape(-1, 6))
    y = np.array([R[j] @ p + t[j] for p, j in zip(stack.points, stack.cloud, strict=True)])
    mu = np.zeros((len(mixture.weights), 3))
    for k in range(len(mu)):
        n, i = np.nonzero(who.component == k)
        mu[k] = np.average(y[n], axis=0, weights=who.alpha[n, i])
    return np.asarray(y[:, None] - mu[who.component])


def whitened(case: Case, d: Array) -> Array:
    """Residuals whose halved square is the negative log-likelihood, components at their best."""
    who, W = case[4], weight_matrices(case)
    r, lever = offsets(case, d), offsets(case, np.zeros(18))
    G = np.cross(np.eye(3), lever[..., None, :])  # rows e_i x lever: turns about the mean
    for k in range(len(case[3].weights)):
        n, i = np.nonzero(who.component == k)
        C = np.einsum("nap,npq,nbq->ab", G[n, i], W[n, i], G[n, i])
        turn = np.linalg.solve(C, np.einsum("nap,npq,nq->a", G[n, i], W[n, i], r[n, i]))
        r[n, i] -= np.einsum("a,nap->np", turn, G[n, i])
    return np.asarray(np.einsum("nkji,nkj->nki", np.linalg.cholesky(W), r)).ravel()


def test_gradient_is_that_of_the_negative_log_likelihood() -> None:
    case = random_case()
    quadratic = quadratic_of(*case)
    step = 1e-5
    numerical = np.array(
        [
            0.25 * (np.sum(whitened(case, d) ** 2) - np.sum(whitened(case, -d) ** 2)) / step
            for d in step * np.eye(18)
        ]
    )
    scale = np.abs(numerical).max()
    assert quadratic.gradient.shape == (3, 6)
    assert quadratic.gradient.ravel() / scale == pytest.approx(numerical / scale, abs=2e-4)


@pytest.mark.parametrize("thick", [False, True])
def test_joint_is_the_square_of_the_numerical_jacobian(thick: bool) -> None:
    case = random_case(1)
    if thick:
        # Half of the components are so much thicker than wide that they hold along, not across.
        stack, R, t, mixture, who = case
        var_tangent = mixture.var_tangent.copy()
        var_tangent[::2] = 0.03 * mixture.var_normal[::2]
        case = stack, R, t, replace(mixture, var_tangent=var_tangent), who
        assert (quadratic_of(*case).sign < 0.0).sum() == 4
    step = 1e-5
    J = np.array(
        [(whitened(case, d) - whitened(case, -d)) / (2.0 * step) for d in step * np.eye(18)]
    ).T
    expected = J.T @ J
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert quadratic_of(*case).joint() / scale == pytest.approx(expected / scale, abs=1e-3)


def test_blocks_are_the_information_given_the_shape() -> None:
    # GMMCalib: the sum of alpha J^T W J, J = [-skew(y), I]; -skew(y) by the cross product.
    case = random_case(2)
    stack, R, t, _, _ = case
    W = weight_matrices(case).sum(axis=1)
    expected = np.zeros((3, 6, 6))
    for n, j in enumerate(stack.cloud):
        y = R[j] @ stack.points[n] + t[j]
        J = np.hstack([np.cross(np.eye(3), y).T, np.eye(3)])
        expected[j] += J.T @ W[n] @ J
    blocks = quadratic_of(*case).blocks
    assert blocks == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())


def test_isotropic_components_have_the_paper_s_information() -> None:
    # Where a component is no surface, W = alpha / s^2: that of a shift is the count over s^2.
    stack, R, t, mixture, who = random_case(3)
    even = replace(
        mixture,
        var_normal=np.full(8, 0.02**2),
        var_tangent=np.full(8, ALONG_SURFACE * 0.02**2),
    )
    blocks = quadratic_of(stack, R, t, even, who).blocks
    mass = stack.sum_per_cloud(who.alpha.sum(axis=1))
    for j in range(3):
        assert blocks[j, 3:, 3:] == pytest.approx(np.eye(3) * mass[j] / 0.02**2, abs=1e-6)


def common(quadratic: ShapeQuadratic) -> Array:
    """(6,) information on a common motion of all clouds, over what the blocks claim of it."""
    together = np.tile(np.eye(6), (len(quadratic.blocks), 1))
    claimed = np.diag(quadratic.blocks.sum(axis=0))
    return np.asarray(np.diag(together.T @ quadratic.joint() @ together) / claimed)


def test_joint_is_positive_semidefinite_with_a_common_shift_in_its_null_space() -> None:
    quadratic = quadratic_of(*random_case(4))
    H = quadratic.joint()
    np.testing.assert_allclose(H, H.T, rtol=0.0, atol=1e-12 * np.abs(H).max())
    eigenvalues = np.linalg.eigvalsh(H)
    assert eigenvalues[0] > -1e-9 * eigenvalues[-1]
    assert common(quadratic)[3:] == pytest.approx(np.zeros(3), abs=1e-4)
    pull = quadratic.gradient.sum(axis=0)[3:]
    assert np.abs(pull).max() < 1e-3 * np.abs(quadratic.gradient[:, 3:]).max()
    # Of the 18 directions it is all that is lost: one shape ties three clouds together.
    assert eigenvalues[6] > 1e-4 * eigenvalues[-1]


def test_joint_never_claims_more_than_the_blocks() -> None:
    quadratic = quadratic_of(*random_case(5))
    taken = np.zeros((18, 18))
    for j in range(3):
        taken[6 * j : 6 * j + 6, 6 * j : 6 * j + 6] = quadratic.blocks[j]
    less = np.linalg.eigvalsh(taken - quadratic.joint())
    assert less[0] > -1e-9 * less[-1]
    assert less[-1] > 0.0


def test_quadratic_grows_with_the_weight_of_a_cloud() -> None:
    stack, R, t, mixture, who = random_case(6)
    half = replace(who, alpha=who.alpha * np.array([1.0, 0.5, 1.0])[stack.cloud][:, None])
    full_blocks = quadratic_of(stack, R, t, mixture, who).blocks
    half_blocks = quadratic_of(stack, R, t, mixture, half).blocks
    assert half_blocks[1] == pytest.approx(0.5 * full_blocks[1])
    assert half_blocks[[0, 2]] == pytest.approx(full_blocks[[0, 2]])


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
        who = expect(stack, R, t, mixture, 0.05, np.ones(6))
        mixture = maximised(stack, R, t, mixture, who, 0.005)
    return stack, R, t, quadratic_of(stack, R, t, mixture, who)


RELATIVE = np.kron(np.array([0.5, -0.5] * 3)[:, None], np.eye(6))
"""(36, 6) clouds of the front against clouds of the back."""


def test_disjoint_skins_are_explained_by_their_own_components() -> None:
    stack, _, _, quadratic = skins()
    # What ties clouds is the coupling: none between a front and a back cloud.
    H = quadratic.joint().reshape(6, 6, 6, 6)
    own = np.linalg.norm(H[0, :, 2, :])
    other = max(np.linalg.norm(H[0, :, j, :]) for j in (1, 3, 5))
    assert other < 1e-3 * own
    assert stack.count == 6


def test_a_common_turn_is_in_the_null_space() -> None:
    _, _, _, quadratic = skins()
    assert common(quadratic)[:3] == pytest.approx(np.zeros(3), abs=1e-3)


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


# ------------------------------------------------------------------ components


def test_means_are_weighted_means() -> None:
    points = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0], [2.0, 0.0, 0.0]])
    who = held(
        np.array([[0, 1], [1, 0], [0, 2]]),
        np.array([[300.0, 100.0], [100.0, 100.0], [400.0, 0.0]]),
    )
    places = [component((0.1 * k, 0.0, 0.0), sigma_tangent=0.3) for k in range(3)]
    after = maximised(
        stack_of(points, UP.repeat(3, axis=0)), *IDENTITY, together(*places), who, 0.01
    )
    # (300 x 0 + 100 x (1, 2, 3) + 400 x (2, 0, 0)) / 800.
    assert after.means_target[0] == pytest.approx([900 / 800, 200 / 800, 300 / 800], rel=1e-4)
    assert after.means_target[1] == pytest.approx([0.5, 1.0, 1.5], rel=1e-4)
    assert after.weights == pytest.approx([0.8, 0.2, 0.0], abs=1e-4)


def test_components_learn_the_surface_and_its_noise() -> None:
    # One component on a plane tilted by 30 degrees, 4 mm of noise, 0.2 m wide.
    rng = np.random.default_rng(8)
    tilt = math.radians(30.0)
    normal = np.array([math.sin(tilt), 0.0, math.cos(tilt)])
    along = np.array([math.cos(tilt), 0.0, -math.sin(tilt)])
    u, v = rng.uniform(-0.1, 0.1, (2, 4000, 1))
    points = u * along + v * np.array([0, 1.0, 0]) + 0.004 * rng.normal(size=(4000, 1)) * normal
    points += np.array([1.0, 2.0, 3.0])
    stack = stack_of(points, np.tile(normal, (4000, 1)))
    who = held(np.zeros((4000, 1), np.int64), np.ones((4000, 1)))
    before = component((0.9, 2.0, 3.0), (0.0, 0.0, 1.0))

    after = maximised(stack, *IDENTITY, before, who, 0.001)

    assert after.means_target[0] == pytest.approx([1.0, 2.0, 3.0], abs=5e-3)
    # The points' own plane: 4 mm over 58 mm and the root of 4000 are 1.1 mrad.
    assert after.normals_target[0] == pytest.approx(normal, abs=4e-3)
    assert math.sqrt(after.var_normal[0]) == pytest.approx(0.004, rel=0.05)
    # Uniform over 0.2 m: 0.2 / sqrt(12).
    assert math.sqrt(after.var_tangent[0]) == pytest.approx(0.0577, rel=0.05)
    floored = maximised(stack, *IDENTITY, before, who, 0.01)
    assert math.sqrt(floored.var_normal[0]) == pytest.approx(0.01)
    assert floored.var_tangent == pytest.approx(after.var_tangent)


def test_normals_of_components_are_those_that_can_be_trusted() -> None:
    # Of 20 points 4 have a normal, upwards; what the others say, sideways, is noise.
    normals = np.tile([1.0, 0.0, 0.0], (20, 1))
    normals[:4] = UP
    flatness = np.where(np.arange(20) < 4, 1.0, 0.0)
    stack = stack_of(np.zeros((20, 3)), normals, flatness=flatness)
    who = held(np.zeros((20, 1), np.int64), np.ones((20, 1)))
    after = maximised(stack, *IDENTITY, component((0, 0, 0)), who, 0.01)
    assert after.normals_target[0] == pytest.approx([0.0, 0.0, 1.0], abs=1e-3)


def test_weights_of_components_are_their_part_of_the_points() -> None:
    rng = np.random.default_rng(9)
    stack = stack_of(rng.normal(size=(40, 3)), UP.repeat(40, axis=0))
    who = held(np.tile([0, 1], (40, 1)), np.tile([0.6, 0.2], (40, 1)))
    pair = together(component((0, 0, 0)), component((1, 0, 0)))
    after = maximised(stack, *IDENTITY, pair, who, 0.01)
    assert after.weights == pytest.approx([0.75, 0.25], abs=1e-4)


def test_an_abandoned_component_stays_defined() -> None:
    stack = stack_of(np.full((20, 3), 0.3), UP.repeat(20, axis=0))
    who = held(np.zeros((20, 1), np.int64), np.ones((20, 1)))
    pair = together(component((0.3, 0.3, 0.3)), component((1, 0, 0), (0.0, 1.0, 0.0)))
    after = maximised(stack, *IDENTITY, pair, who, 0.01)
    for values in (after.means_target, after.var_normal, after.var_tangent, after.weights):
        assert np.isfinite(values).all()
    assert after.normals_target[1] == pytest.approx([0.0, 1.0, 0.0])
    assert after.weights[1] < 1e-4
    assert (after.var_normal >= 0.01**2 - 1e-12).all()


def test_an_abandoned_component_stays_where_it_was() -> None:
    stack = stack_of(np.full((20, 3), 0.3), UP.repeat(20, axis=0))
    who = held(np.zeros((20, 1), np.int64), np.ones((20, 1)))
    pair = together(component((0.3, 0.3, 0.3)), component((1, 0, 0), (0.0, 1.0, 0.0)))
    after = maximised(stack, *IDENTITY, pair, who, 0.01)
    assert after.means_target[1] == pytest.approx([1.0, 0.0, 0.0])


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


def test_every_cloud_seeds_as_many_components() -> None:
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
    assert mixture.var_normal == pytest.approx(np.full(90, 0.03**2))
    assert mixture.var_tangent == pytest.approx(np.full(90, 0.03**2))
    assert mixture.weights.sum() == pytest.approx(1.0)


def test_seeds_are_the_same_points_wherever_the_clouds_are() -> None:
    stack, R, t = seed_case()
    moved_R, moved_t = left_step(R, t, np.random.default_rng(11).normal(size=(3, 6)) * 0.1)
    here = seed_mixture(stack, R, t, 100, 0.03).means_target
    there = seed_mixture(stack, moved_R, moved_t, 100, 0.03).means_target
    row = {tuple(p): n for n, p in enumerate(stack.moved(R, t).tolist())}
    moved_row = {tuple(p): n for n, p in enumerate(stack.moved(moved_R, moved_t).tolist())}
    assert [row[tuple(m)] for m in here.tolist()] == [moved_row[tuple(m)] for m in there.tolist()]


def test_no_more_components_than_points_can_tell() -> None:
    stack, R, t = seed_case()
    mixture = seed_mixture(stack, R, t, 5000, 0.03)
    # Ten points of each: 900 + 150 + 90 in all.
    assert len(mixture.weights) == 114
    assert mixture.weights == pytest.approx(np.full(114, 1.0 / 114))
