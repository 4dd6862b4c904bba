"""E-step by beams: which surfel a beam met, whatever the noise of its range is."""

from __future__ import annotations

import numpy as np
import pytest

from caliv_graph.products import Array, Mixture
from caliv_graph.registration.heights import HeightNoise
from caliv_graph.registration.mixture import expect
from caliv_graph.registration.moments import cell_moments
from caliv_graph.registration.quadratic import quadratic_given_shape
from tests.registration.scenes import IDENTITY, stack_of

SIGMA_M = 0.02
NOISE = HeightNoise(np.array([SIGMA_M**2]), np.array([1e-6]), 0.0)
DENSITY = 0.05


def faces(normals: Array, middles: Array, width_m: float, apart_m: float) -> Mixture:
    """Upright faces of `width_m`, 0.5 m high, tiled by surfels `apart_m` apart."""
    means, directions = [], []
    for n, middle in zip(normals, middles, strict=True):
        along = np.cross(n, [0.0, 0.0, 1.0])
        for u in np.arange(-width_m / 2 + apart_m / 2, width_m / 2, apart_m):
            for z in np.arange(-0.25 + apart_m / 2, 0.25, apart_m):
                means.append(middle + u * along + [0.0, 0.0, z])
                directions.append(n)
    K = len(means)
    extents = np.full(K, (0.6 * apart_m) ** 2)
    return Mixture(np.array(means), np.array(directions), extents, np.full(K, 1.0 / K))


def leg(width_m: float = 0.05) -> Mixture:
    """A post of a square section about the origin."""
    normals = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    return faces(normals, normals * width_m / 2, width_m, 0.0125)


def seen_leg(yaw_rad: float, noise_m: Array, width_m: float = 0.05) -> tuple[Array, Array]:
    """Points and beams, all parallel, on the post from a direction, with errors of the ranges."""
    rng = np.random.default_rng(3)
    beam = -np.array([np.cos(yaw_rad), np.sin(yaw_rad), 0.0])
    across = np.array([-beam[1], beam[0], 0.0])
    reach = width_m / 2 * (abs(beam[0]) + abs(beam[1]))
    start = np.outer(rng.uniform(-reach, reach, len(noise_m)), across) - beam
    start[:, 2] = rng.uniform(-0.2, 0.2, len(noise_m))
    # A convex body: the beam enters it where it has passed the last of the planes that face it.
    with np.errstate(divide="ignore"):
        enters = (-np.sign(beam[:2]) * width_m / 2 - start[:, :2]) / beam[:2]
    place = start + enters.max(axis=1)[:, None] * beam
    beams = np.tile(beam, (len(noise_m), 1))
    return place + noise_m[:, None] * beam, beams


def pull(mixture: Mixture, points: Array, beams: Array, by_beams: bool) -> float:
    """How far a cloud without known normals would go along the view, the shape held (metres)."""
    stack = stack_of(points, -beams, flatness=np.zeros(len(points)))
    who = expect(stack, *IDENTITY, mixture, NOISE, DENSITY, np.ones(1), by_beams=by_beams)
    cells = cell_moments(stack, who, len(mixture.weights))
    H, g = quadratic_given_shape(stack, *IDENTITY, mixture, cells, who)
    view = np.concatenate([np.zeros(3), beams[0]])
    return -float(view @ g[0]) / float(view @ H[0] @ view)


@pytest.mark.parametrize("yaw_rad", [0.15, 0.5, 0.785])
def test_noise_does_not_draw_a_cloud_from_a_thin_part(yaw_rad: float) -> None:
    """A leg of 5 cm, 20 mm of noise: the side of a point is that of its beam, not of its noise."""
    errors = SIGMA_M * np.random.default_rng(5).standard_normal(20_000)
    points, beams = seen_leg(yaw_rad, np.concatenate([errors, -errors]))

    by_beams = pull(leg(), points, beams, by_beams=True)

    assert abs(by_beams) < 0.5e-3
    if yaw_rad != 0.785:  # there the two sides are seen alike, and their errors cancel
        by_points = pull(leg(), points, beams, by_beams=False)
        assert abs(by_points) > 2e-3


def share_of_first(mixture: Mixture, place: Array, noise_m: float) -> float:
    """Part that the first of two surfels has in a beam along -x that meets a place."""
    beam = np.array([-1.0, 0.0, 0.0])
    stack = stack_of(np.array([place + noise_m * beam]), -beam[None])
    who = expect(stack, *IDENTITY, mixture, NOISE, DENSITY, np.ones(1), by_beams=True)
    return float(who.counts[0] / who.counts.sum())


@pytest.mark.parametrize("noise_m", [-0.03, 0.0, 0.03])
@pytest.mark.parametrize("sticks_out", [True, False])
def test_a_beam_beside_an_edge_returns_from_its_own_side(noise_m: float, sticks_out: bool) -> None:
    """Two faces at 45 degrees to the beams meet at y = 0; they are wide, and overlap there.

    The range, 1.5 sigmas off, has its say as well: on neither side more than a quarter.
    """
    side = 1.0 if sticks_out else -1.0
    normals = np.array([[1.0, side, 0.0], [1.0, -side, 0.0]]) / np.sqrt(2.0)
    means = np.array([[-side * 0.03, 0.03, 0.0], [-side * 0.03, -0.03, 0.0]])
    roof = Mixture(means, normals, np.full(2, 0.04**2), np.full(2, 0.5))

    first = share_of_first(roof, np.array([-side * 0.015, 0.015, 0.0]), noise_m)
    second = share_of_first(roof, np.array([-side * 0.015, -0.015, 0.0]), noise_m)

    assert first > 0.75
    assert second < 0.25


def test_a_cloud_that_all_surfels_face_away_from_has_no_inliers() -> None:
    behind = faces(np.array([[-1.0, 0.0, 0.0]]), np.zeros((1, 3)), 0.1, 0.0125)
    stack = stack_of(np.zeros((5, 3)), np.tile([1.0, 0.0, 0.0], (5, 1)))
    who = expect(stack, *IDENTITY, behind, NOISE, DENSITY, np.ones(1), by_beams=True)
    assert who.inlier_ratio[0] < 1e-6


def test_surfels_of_a_cloud_do_not_hang_on_which_others_are_stacked() -> None:
    """Parts of the E-step begin anywhere in a cloud."""
    points, beams = seen_leg(0.5, np.zeros(300))
    mixture = leg()
    alone = stack_of(points, -beams)
    one = expect(alone, *IDENTITY, mixture, NOISE, DENSITY, np.ones(1), by_beams=True)
    twice = stack_of(np.tile(points, (2, 1)), -np.tile(beams, (2, 1)), starts=(0, len(points)))
    R, t = np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3))
    both = expect(twice, R, t, mixture, NOISE, DENSITY, np.ones(2), by_beams=True)
    np.testing.assert_array_equal(both.component[300:], one.component)
    np.testing.assert_allclose(both.weight[300:], one.weight)
