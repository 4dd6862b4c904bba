"""The mounting that draws the sharpest map, from drives past posts at known places."""

from __future__ import annotations

import math

import numpy as np
import pytest

from caliv_graph.mounting.sharpness import (
    CELLS_M,
    Sightings,
    _cell_of,
    _side,
    difference_m,
    sharpest,
)
from caliv_graph.products import Array

POSTS = np.array([12.0 + 3.0j, -4.0 + 9.0j, 5.0 - 11.0j, 20.0 - 6.0j, -12.0 - 3.0j])


def seen(
    mounting: Array, heading: Array, position: Array, posts: Array, sigma_m: float
) -> Sightings:
    """What a LiDAR sees of posts within 25 m, from poses of the vehicle (n,)."""
    yaw, x, y = mounting
    rng = np.random.default_rng(1)
    h, p = (np.repeat(of, len(posts)) for of in (heading, position))
    world = np.tile(posts, len(heading))
    level = ((world - p) / h - (x + 1j * y)) * np.exp(-1j * yaw)
    level = level + sigma_m * (rng.normal(size=len(level)) + 1j * rng.normal(size=len(level)))
    near = np.abs(level) < 25.0
    return Sightings(level[near], h[near], p[near])


def figure_eight() -> tuple[Array, Array]:
    s = np.linspace(0.0, 2.0 * math.pi, 60)
    yaw = np.concatenate([s, -s])
    left = 9.0j + 9.0 * np.exp(1j * (s - 0.5 * math.pi))
    right = -9.0j + 9.0 * np.exp(-1j * (s - 0.5 * math.pi))
    return np.exp(1j * yaw), np.concatenate([left, right])


@pytest.mark.parametrize("mounting", [(0.0, 2.0, 0.0), (3.0, -0.5, 0.8), (-1.4, -6.0, -1.2)])
def test_any_yaw_and_place_is_found(mounting: tuple[float, float, float]) -> None:
    true = np.array(mounting)
    found = sharpest(seen(true, *figure_eight(), POSTS, 0.03))
    assert difference_m(found.mountings[0], true) < 0.4
    # Nothing else draws a map that is nearly as sharp.
    assert found.sharpness[1] < 0.8 * found.sharpness[0]


def test_on_an_arc_two_lidars_agree_although_neither_is_determined() -> None:
    s = np.linspace(0.0, 2.0, 60)
    heading = np.exp(1j * s)
    position = 9.0j + 9.0 * np.exp(1j * (s - 0.5 * math.pi))
    front, rear = np.array([0.0, 2.0, 0.0]), np.array([3.1, -0.4, 0.1])
    of_front = seen(front, heading, position, POSTS[:1], 0.03)
    of_rear = seen(rear, heading, position, POSTS[:1], 0.03)
    first = sharpest(of_front)
    second = sharpest(of_rear, [(of_front, first.mountings[0])])
    # A turn of both about the centre of the arc is free.
    turn = first.mountings[0][0] - front[0]
    centre = 9.0j
    place = centre + (rear[1] + 1j * rear[2] - centre) * np.exp(1j * turn)
    expected = np.array([rear[0] + turn, place.real, place.imag])
    assert difference_m(second.mountings[0], expected) < 0.6


def test_a_turn_by_a_whole_circle_is_none() -> None:
    assert difference_m(np.array([math.pi, 0.0, 0.0]), np.array([-math.pi, 0.0, 0.0])) < 1e-12
    assert difference_m(np.array([0.1, 0.0, 0.0]), np.zeros(3)) == pytest.approx(1.5)


@pytest.mark.parametrize("cell", CELLS_M)
def test_the_grid_repeats_after_its_side(cell: float) -> None:
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-500.0, 500.0, (2, 2000))
    side = _side(cell)

    found = _cell_of(x + 1j * y, cell, 0.5)

    column, row = (np.floor(at / cell + 0.5).astype(np.int64) % side for at in (x, y))
    assert np.array_equal(found, column * side + row)
