"""Spacing of beams read off points on a grid of directions, and what is linked by it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from caliv_graph.products import Array
from caliv_graph.targets.cloud.beams import (
    BeamSpacing,
    Linking,
    beam_spacing,
    elevations,
    typical_gap,
)


def on_grid(
    elevations_deg: Array, azimuths_deg: Array, range_m: float = 10.0, seed: int = 0
) -> Array:
    """Returns of every beam of a grid; 10 mm of noise along the beam."""
    el, az = np.meshgrid(np.radians(elevations_deg), np.radians(azimuths_deg), indexing="ij")
    beams = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], axis=-1)
    noise = 0.01 * np.random.default_rng(seed).normal(size=el.shape)
    return np.asarray((beams * (range_m + noise)[..., None]).reshape(-1, 3))


@pytest.mark.parametrize("row_deg", [0.2, 0.7, 1.33, 2.0])
@pytest.mark.parametrize("column_deg", [0.1, 0.4])
def test_spacing_of_rows_and_columns(row_deg: float, column_deg: float) -> None:
    rows = np.arange(-15.0, 15.0 + 1e-9, row_deg)
    scan = on_grid(rows, np.arange(-60.0, 60.0, column_deg))
    near = on_grid(rows[np.abs(rows + 5.0) < 3.0], np.arange(10.0, 14.0, column_deg))

    spacing = beam_spacing(near, elevations(scan))

    assert math.degrees(spacing.row) == pytest.approx(row_deg, rel=1e-6)
    assert math.degrees(spacing.column) == pytest.approx(column_deg, rel=1e-6)


def test_uneven_channels_have_the_spacing_of_where_the_object_is() -> None:
    # A third of a degree about the horizon, 3 degrees below.
    rows = np.concatenate([np.arange(-25.0, -5.0, 3.0), np.arange(-4.0, 4.0, 1.0 / 3.0)])
    scan = elevations(on_grid(rows, np.arange(-60.0, 60.0, 0.2)))
    azimuths = np.arange(0.0, 4.0, 0.2)
    low = beam_spacing(on_grid(np.array([-19.0, -16.0]), azimuths), scan)
    high = beam_spacing(on_grid(np.array([0.0, 1.0 / 3.0]), azimuths), scan)
    assert math.degrees(low.row) == pytest.approx(3.0)
    assert math.degrees(high.row) == pytest.approx(1.0 / 3.0)


def test_a_lidar_without_rows_has_next_to_no_row_spacing() -> None:
    rng = np.random.default_rng(1)
    el, az = rng.uniform(-12.0, 12.0, 20000), rng.uniform(-30.0, 30.0, 20000)
    scan = np.concatenate([on_grid(el[[i]], az[[i]]) for i in range(2000)])
    near = scan[np.abs(scan[:, 1]) < 1.0]
    assert math.degrees(beam_spacing(near, elevations(scan)).row) < 0.05


def test_the_gap_that_covers_half_of_the_span_by_hand() -> None:
    # Gaps 0, 1, 1, 4 of a span of 6: half of it is in the gap of 4.
    assert typical_gap(np.array([3.0, 1.0, 1.0, 2.0, 7.0])) == 4.0
    # 1, 1, 1, 1, 2: half of 6 is reached by the ones.
    assert typical_gap(np.array([0.0, 1.0, 2.0, 3.0, 4.0, 6.0])) == 1.0
    assert typical_gap(np.array([5.0])) == 0.0


def test_dense_beams_are_linked_by_plain_distance() -> None:
    points = on_grid(np.arange(-5.0, 0.0, 0.2), np.arange(0.0, 4.0, 0.2))
    linking = Linking.of(points, BeamSpacing(math.radians(0.2), math.radians(0.2)), 10.0)
    assert linking.places is points
    assert linking.link_m == pytest.approx(0.3)
    assert linking.row_m == 0.0


def linked(points: Array, row_deg: float, range_m: float) -> set[tuple[int, int]]:
    spacing = BeamSpacing(math.radians(row_deg), math.radians(0.2))
    pairs = Linking.of(points, spacing, range_m).pairs()
    return {(min(a, b), max(a, b)) for a, b in pairs.tolist()}


def test_rows_are_linked_and_columns_are_not() -> None:
    # 16 channels at 20 m: rows 0.7 m apart. Along x the depth, along y across.
    points = np.array(
        [
            [20.0, 0.0, 0.0],
            [20.0, 0.0, 0.70],  # the next row
            [20.0, 0.5, 0.0],  # as far as legs are apart
            [20.0, -0.7, 0.0],  # another object
            [20.65, 0.0, -0.70],  # a backrest behind, in the next row
            [20.65, 0.1, 0.0],  # behind, in the same row
        ]
    )
    pairs = linked(points, 2.0, 20.0)
    assert {(0, 1), (0, 2), (0, 4)} <= pairs
    assert not {(0, 3), (0, 5), (1, 4)} & pairs
