"""Noise levels of structure, from patches whose noise is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.config.range_errors import UNSTATED
from caliv_graph.products import Array
from caliv_graph.structure.beams import (
    CHANNEL_KINDS,
    BeamErrors,
    mean_rows,
    parts_of,
    usual_sigmas,
)
from caliv_graph.structure.noise import beam_sigmas, range_sigmas, tilt_weights
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.residuals import PLANE_ROWS, Geometry
from caliv_graph.structure.sightings import Sightings

POINTS = 20


def by_tilts(count: int) -> Array:
    """Derivatives by the tilts of level ground, all others zero."""
    by = np.zeros((count, PLANE_ROWS.stop, 4))
    by[:, PLANE_ROWS.start, 0] = by[:, PLANE_ROWS.start + 1, 1] = 1.0
    return by


def patches_of(range_m: float, beam_rad: float, count: int = 3000) -> DrivePatches:
    """Half on ground 3 to 9 m away, half on walls at 20 to 40 m, none seen straight on."""
    rng = np.random.default_rng(4)
    near = np.arange(count) < count // 2
    distance = np.where(near, rng.uniform(3.0, 9.0, count), rng.uniform(20.0, 40.0, count))
    cos = np.where(near, 1.5 / distance, rng.uniform(0.35, 0.65, count))
    variance = (range_m * cos) ** 2 + (beam_rad * distance) ** 2 * (1.0 - cos**2)
    moments = np.zeros((count, 4, 4))
    moments[:, 0, 3] = moments[:, 3, 0] = POINTS * distance
    moments[:, 3, 3] = POINTS
    return DrivePatches(
        drive=0,
        lidars=("lidar",),
        stamps_ns=np.zeros(1, np.int64),
        scan_lidar=np.zeros(1, np.int64),
        scan=np.zeros(count, np.int64),
        time_s=np.zeros(count),
        moments=moments,
        normal_lidar=np.column_stack([-cos, np.sqrt(1.0 - cos**2), np.zeros(count)]),
        scatter_m=np.sqrt(variance * rng.chisquare(POINTS - 3, count) / (POINTS - 3)),
    )


@pytest.mark.parametrize("beam_rad", [0.0, 1e-4, 2e-4])
@pytest.mark.parametrize("range_m", [0.005, 0.01, 0.025])
def test_noise_along_beams_is_found_whatever_that_of_their_directions(
    range_m: float, beam_rad: float
) -> None:
    """With an assumed noise of 0.3 mrad 10 mm came out as 1 mm where beams have none."""
    found = range_sigmas(patches_of(range_m, beam_rad), 0.1)
    assert found == pytest.approx([range_m], rel=0.05)


def test_what_is_stated_counts_where_there_are_few_patches() -> None:
    assert range_sigmas(patches_of(0.01, 0.0, 200), 0.03).tolist() == [0.03]


CHANNELS = 32
OF_AZIMUTH = 2
RANGES = (BeamErrors(CHANNELS, CHANNEL_KINDS),)


def sizes_of(true: Array, usual: Array, shared: Array | float = 0.0) -> Array:
    """(E,) sigmas of errors of one LiDAR, which the data say to a third of their usual size.

    And a `shared` error (3,) of each kind, which the data see as errors of all: a bias, or how the
    LiDAR is turned, of which they know the yaw not at all.
    """
    cov = np.diag((usual / 3.0) ** 2)
    for _, kind, part in parts_of(RANGES):
        cov[part, part] += ((1000.0 if kind == OF_AZIMUTH else 2.0) * usual[part][0]) ** 2
    data = np.asarray(np.linalg.inv(cov), dtype=np.float64)
    J, _ = mean_rows(RANGES, 0, true)
    pull = data @ (true + np.repeat(shared * np.ones(CHANNEL_KINDS), CHANNELS))
    return beam_sigmas(data, (J.T @ J).toarray(), pull, usual, RANGES, UNSTATED)


def test_what_all_channels_share_says_nothing_of_their_size() -> None:
    """The range bias of a LiDAR, its yaw, and its pitch: each has a variable of its own.

    What the data say of the pitch may be five of their sigmas off, as they know it very well.
    """
    rng = np.random.default_rng(6)
    usual = usual_sigmas(RANGES, UNSTATED)
    true = 3.0 * usual * rng.standard_normal(len(usual))
    alone = sizes_of(true, usual)
    assert 1.5 < np.median(alone / usual) < 3.5
    found = sizes_of(true, usual, np.array([30e-3, 0.5e-3, 2e-3]))
    np.testing.assert_allclose(found, alone, rtol=0.1)


def test_two_channels_that_err_much_are_not_all_of_them() -> None:
    rng = np.random.default_rng(7)
    usual = usual_sigmas(RANGES, UNSTATED)
    true = 2.0 * usual * rng.standard_normal(len(usual))
    true[[CHANNELS + 3, CHANNELS + 4]] = 5e-3, -5e-3
    found = sizes_of(true, usual)[CHANNELS : 2 * CHANNELS]
    assert np.median(found) == pytest.approx(1e-4, rel=0.3)
    assert found[[3, 4]].min() > 1e-3


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
