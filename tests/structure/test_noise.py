"""Noise levels of structure, from patches whose noise is known."""

from __future__ import annotations

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
from caliv_graph.structure.layout import Layout
from caliv_graph.structure.noise import (
    PROBES,
    _Asked,
    _lidar_offsets,
    _of_usual,
    _strip_sigmas,
    beam_sigmas,
    range_sigmas,
)
from caliv_graph.structure.patches import DrivePatches

POINTS = 20


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


def test_the_lidar_whose_offsets_scatter_by_more_has_an_error_of_its_own() -> None:
    """6 mm on walls alone; others that are as noisy as their sightings say have hardly any."""
    rng = np.random.default_rng(9)
    lidar = np.repeat([0, 1, 2], [2000, 400, 10])
    level = np.arange(len(lidar)) % 2 == 0
    known = np.full(len(lidar), 2e-3**2)
    of_lidar = np.where((lidar == 1) & ~level, 6e-3, 0.0) + np.where(lidar == 2, 0.1, 0.0)
    offsets = np.sqrt(known + of_lidar**2) * rng.standard_normal(len(lidar))

    found = _lidar_offsets(offsets, known, lidar, level, 1.0, 4)

    assert found[1, 1] == pytest.approx(6e-3, rel=0.15)
    assert found[0].max() < 6e-4
    assert found[1, 0] < 8e-4
    assert found[:2].min(axis=0).max() == 0.0  # what both have is the strips' own
    assert (found[2:] == 0.0).all()  # ten sightings tell nothing, none even less


STRIPS, OF_STRIPS_M = 200, 2e-3


def strips_seen_apart(before: Array) -> tuple[_Asked, Layout, Array]:
    """Two LiDARs and the offsets that they see strips apart; of the last one nothing tells."""
    layout = Layout(poses=0, parameters=0, offsets=(), lidars=2, surface_of=(0,) * STRIPS)
    errors = np.zeros(layout.size)
    own = slice(layout.strip_error, layout.size)
    errors[own] = OF_STRIPS_M * np.random.default_rng(3).standard_normal(2 * STRIPS)
    told = np.tile(np.arange(STRIPS) < STRIPS - 1, 2)
    errors[own] *= told
    signs = np.ones((2 * STRIPS, PROBES))
    left = np.where(told, 0.0, np.tile(before, 2) ** 2)[:, None]
    of_signs = {layout.strip_error: (signs, left * signs)}
    return _Asked(np.zeros((0, PROBES)), np.zeros((0, 0)), of_signs), layout, errors


def test_a_strip_that_two_lidars_see_tilted_apart_they_see_apart() -> None:
    """Where its offset is all that tells a LiDAR's height, no residual shows that it is wrong."""
    before, of_tilts = np.full(STRIPS, OF_STRIPS_M), np.ones(STRIPS)
    asked, layout, errors = strips_seen_apart(before)

    alike = _strip_sigmas(asked, layout, before, errors, of_tilts)
    assert np.median(alike[:-1]) == pytest.approx(OF_STRIPS_M, rel=0.15)
    assert alike[-1] == pytest.approx(OF_STRIPS_M, rel=0.15)

    of_tilts[[0, -1]] = 5.0
    before[[0, -1]] *= 5.0
    asked, layout, errors = strips_seen_apart(before)
    tilted = _strip_sigmas(asked, layout, before, errors, of_tilts)
    assert tilted[1:-1] == pytest.approx(alike[1:-1], rel=0.02)
    assert tilted[-1] == pytest.approx(5.0 * alike[-1], rel=0.02)
    # What its offsets say counts as well.
    assert alike[0] < tilted[0] < 5.0 * alike[0]


def test_tilts_of_strips_are_compared_with_those_of_their_kind() -> None:
    level = np.array([True] * 3 + [False] * 6)
    ground, walls = [2e-3, 2e-3, 25e-3], [3e-4, 4e-4, 5e-4, 5e-4, 6e-4, 10e-3]
    found = _of_usual(np.array(ground + walls), level)
    # The median of ground and 1 mrad is 2 mrad; that of walls and 1 mrad 0.5. None is below 1.
    assert found == pytest.approx([1.0, 1.0, 12.5, 1.0, 1.0, 1.0, 1.0, 1.2, 20.0])
    # One strip is compared with what is usual.
    assert _of_usual(np.array([25e-3]), np.array([True])) == pytest.approx([25.0 / 13.0])
