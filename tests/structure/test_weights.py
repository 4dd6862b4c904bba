"""Which sightings count: offsets, and of ground tilts, bends and scatter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.products import Array
from caliv_graph.structure.layout import Layout, Nuisances
from caliv_graph.structure.residuals import PLANE_ROWS, Geometry
from caliv_graph.structure.sightings import Sightings
from caliv_graph.structure.weights import bend_weights, scatter_weights, tilt_weights

STRIPS = 30


def by_tilts(count: int) -> Array:
    """Derivatives by the tilts of level ground, all others zero."""
    by = np.zeros((count, PLANE_ROWS.stop, 4))
    by[:, PLANE_ROWS.start, 0] = by[:, PLANE_ROWS.start + 1, 1] = 1.0
    return by


def test_a_sighting_that_is_tilted_has_no_weight_though_its_middle_is_right() -> None:
    """Points of ground 1.8 m below, one sighting in twenty over a kerb; one is a single line."""
    rng = np.random.default_rng(8)
    x, y = (g.ravel() for g in np.meshgrid(np.linspace(4.0, 5.0, 6), np.linspace(-0.3, 0.3, 8)))
    moments = np.zeros((40, 4, 4))
    slopes = 2e-3 * rng.standard_normal((40, 2))
    slopes[[3, 20]] = [0.1, 0.0], [0.0, -0.05]
    for own, (along, across) in zip(moments, slopes, strict=True):
        z = -1.8 + along * (x - x.mean()) + across * (y - y.mean())
        h = np.column_stack([x, y, z + 0.003 * rng.standard_normal(len(x)), np.ones(len(x))])
        own[:] = h.T @ h * 0.003**-2.0
    line = np.column_stack([np.full(8, 4.5), y[::6], np.full(8, -1.8), np.ones(8)])
    moments[30] = line.T @ line * 0.003**-2.0
    none = np.zeros(40, np.int64)
    sightings = Sightings(
        none, none, moments, np.zeros_like(moments), np.zeros(40), np.ones(40), ()
    )
    up = np.tile([0.0, 0.0, 1.0], (40, 1))
    geometry = Geometry(
        plain=np.column_stack([up, np.full(40, 1.8)]),
        placed=np.zeros((40, 4)),
        by=by_tilts(40),
        columns=np.zeros((40, 15), np.int64),
        normals_lidar=up,
    )
    assert np.abs(geometry.offsets_m(sightings)).max() < 0.002
    weights = tilt_weights(geometry, sightings, np.ones(1, bool))
    walls = tilt_weights(geometry, sightings, np.zeros(1, bool))
    assert (walls == 1.0).all()
    assert np.flatnonzero(weights < 0.5).tolist() == [3, 20]
    assert weights[[3, 20]].tolist() == [0.0, 0.0]
    assert weights[30] == 1.0


def test_small_pieces_of_ground_that_noise_tilts_keep_their_weight() -> None:
    """A LiDAR on the bumper, 0.6 m up: pieces of 4 cm rise by 20 mrad, by noise of 10 mm alone."""
    rng = np.random.default_rng(9)
    count, points, range_sigma_m, weight = 80, 400, 0.01, 0.006**-2.0
    half = np.where(np.arange(count) < 8, 0.04, 0.3)  # of the others noise tilts none
    moments, noise = np.zeros((count, 4, 4)), np.zeros((count, 4, 4))
    for own, of_noise, extent in zip(moments, noise, half, strict=True):
        p = np.array([0.96, 0.0, -0.6]) + np.column_stack(
            [
                rng.uniform(-extent, extent, points),
                rng.uniform(-0.06, 0.06, points),
                np.zeros(points),
            ]
        )
        u = p / np.linalg.norm(p, axis=1)[:, None]
        p += range_sigma_m * rng.standard_normal((points, 1)) * u
        h = np.column_stack([p, np.ones(points)])
        own[:] = weight * h.T @ h
        of_noise[:3, :3] = weight * range_sigma_m**2 * u.T @ u
    none, up = np.zeros(count, np.int64), np.tile([0.0, 0.0, 1.0], (count, 1))
    plane = np.column_stack([up, np.full(count, 0.6)])
    geometry = Geometry(plane, plane, by_tilts(count), np.zeros((count, 15), int), up)
    sightings = Sightings(
        none, none, moments, noise, np.zeros(count), np.full(count, float(points)), ()
    )
    told = tilt_weights(geometry, sightings, np.ones(1, bool))
    untold = tilt_weights(
        geometry, replace(sightings, noise=np.zeros_like(noise)), np.ones(1, bool)
    )
    assert told.min() > 0.5
    assert np.median(untold[:8]) < 0.1


def test_a_strip_that_bends_as_no_other_ground_does_has_no_weight() -> None:
    """Patches on both sides of a kerb lie on a bent strip; a crown, or a hill, is no kerb.

    By 0.06/m along x, along the diagonal, and along y; 0.02/m is four of the 0.005/m of all.
    """
    layout = Layout(1, 0, (), 1, tuple(range(STRIPS)), bent=True)
    errors = np.zeros(layout.size)
    bends = errors[layout.bend : layout.surface_error].reshape(3, STRIPS)
    bends[:] = 0.005 * np.random.default_rng(10).standard_normal((3, STRIPS))
    bends[:, 4], bends[:, 5], bends[:, 6] = (0.06, 0.0, 0.0), (0.03, -0.03, 0.03), (0.0, 0.0, -0.06)
    bends[:, 7], bends[:, 8] = (0.0, 0.0, 0.02), (0.0, 0.0, 0.06)
    level = np.arange(STRIPS) != 8
    zero = np.zeros(STRIPS)
    nuisances = Nuisances(
        0.003, 0.003, 0.003, 0.003, zero, zero, zero, zero, 0.0, 0.0, bend=np.full(STRIPS, 0.005)
    )
    weights = bend_weights(errors, layout, nuisances, level)
    assert np.flatnonzero(weights < 1.0).tolist() == [4, 5, 6]
    assert weights[4:7].tolist() == [0.0, 0.0, 0.0]
    flat = Layout(1, 0, (), 1, tuple(range(STRIPS)))
    assert (bend_weights(np.zeros(flat.size), flat, nuisances, level) == 1.0).all()


def ground_of(scatter_m: Array, points: int, weight: float) -> Sightings:
    """Sightings of level ground 5 m away, each with its scatter."""
    rng = np.random.default_rng(11)
    moments = []
    for scatter in scatter_m.tolist():
        x, y = rng.uniform(4.5, 5.5, points), rng.uniform(-0.3, 0.3, points)
        z = -1.8 + scatter * rng.standard_normal(points)
        h = np.column_stack([x, y, z, np.ones(points)])
        moments.append(weight * h.T @ h)
    count = len(scatter_m)
    return Sightings(
        scan=np.zeros(count, np.int64),
        strip=np.arange(count) % 2,
        moments=np.array(moments),
        noise=np.zeros((count, 4, 4)),
        time_s=np.zeros(count),
        points=np.full(count, float(points)),
        T_vehicle_lidar=(),
    )


@pytest.mark.parametrize(("points", "kept"), [(6, 0.97), (100, 0.9999)])
def test_ground_that_is_thicker_than_elsewhere_has_no_weight(points: int, kept: float) -> None:
    """A sighting on road and pavement; one LiDAR has more noise than the other; noise is none."""
    lidar = np.repeat([0, 1], 200)
    scatter = np.where(lidar == 0, 0.004, 0.012)
    scatter[[20, 220]] = 0.05, 0.15
    seen = ground_of(scatter, points, 0.004**-2.0)
    weights = scatter_weights(seen, lidar, np.ones(2, bool))
    assert weights[[20, 220]].tolist() == [0.0, 0.0]
    others = np.delete(weights, [20, 220])
    # Of 6 points the variance has 3 degrees of freedom: one in 40 is four times the median.
    assert others.mean() > kept
    walls = scatter_weights(seen, lidar, np.array([False, True]))
    assert walls[20] == walls[220] == 1.0
    exact = scatter_weights(
        ground_of(np.full(400, 1e-7), points, 0.004**-2.0), lidar, np.ones(2, bool)
    )
    assert (exact == 1.0).all()


def test_ground_that_is_seen_flat_keeps_its_weight_though_it_has_more_noise() -> None:
    """Noise of 4 mm at 4 m and of 20 mm at 12 m: five times as much is usual there."""
    far = np.linspace(4.0, 12.0, 400)
    seen = ground_of(0.004 + 0.002 * (far - 4.0), 60, 0.004**-2.0)
    away = np.tile(np.eye(4), (400, 1, 1))
    away[:, 0, 3] = far - 5.0
    seen = replace(seen, moments=away @ seen.moments @ np.swapaxes(away, 1, 2))
    weights = scatter_weights(seen, np.zeros(400, np.int64), np.ones(2, bool))
    assert weights.mean() > 0.999
