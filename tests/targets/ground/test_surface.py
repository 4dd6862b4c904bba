"""The ground of a whole scan."""

from __future__ import annotations

import numpy as np
import pytest

from caliv_graph.products import Array
from caliv_graph.targets.ground.surface import fit_surface
from caliv_graph.targets.search.objects import CLEARANCE_M
from caliv_graph.targets.search.tracks import MIN_HEIGHT_M

LIDAR_HEIGHT_M = 2.0


def scattered(count: int = 40_000, *, half_size_m: float = 30.0, seed: int = 0) -> Array:
    """(n, 2) places, denser near the LiDAR."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.0, 1.0, (count, 2)) * half_size_m * rng.random((count, 1))


def ridge_m(xy: Array) -> Array:
    """A ramp across the way: 0.5 m up over 5 m, 1 m level, 5 m down."""
    return np.interp(xy[:, 0], [2.0, 7.0, 8.0, 13.0], [0.0, 0.5, 0.5, 0.0])


def with_noise(xy: Array, z: Array) -> Array:
    return np.column_stack([xy, z + np.random.default_rng(1).normal(0.0, 0.01, len(z))])


class TestHeight:
    @pytest.mark.parametrize("tilt_deg", [0.0, 3.0, 10.0])
    def test_of_tilted_flat_ground(self, tilt_deg: float) -> None:
        xy = scattered()
        slope = np.tan(np.radians(tilt_deg))
        surface = fit_surface(with_noise(xy, slope * xy[:, 1] - LIDAR_HEIGHT_M))
        assert surface is not None
        at = np.array([[0.0, 0.0], [10.0, -8.0], [-12.0, 14.0]])
        # The lowest point of a cell is two sigmas low: 2 cm.
        assert surface.height_at(at) == pytest.approx(slope * at[:, 1] - LIDAR_HEIGHT_M, abs=0.03)

    def test_of_a_ramp(self) -> None:
        xy = scattered()
        surface = fit_surface(with_noise(xy, ridge_m(xy) - LIDAR_HEIGHT_M))
        assert surface is not None
        off = surface.height_at(xy) - (ridge_m(xy) - LIDAR_HEIGHT_M)
        # Nodes 2.5 m apart round its edges off, by less than the height of the lowest target.
        assert np.abs(off).max() < MIN_HEIGHT_M - 0.03
        assert np.quantile(np.abs(off), 0.95) < CLEARANCE_M

    @pytest.mark.parametrize("width_m", [0.5, 1.5, 4.0])
    def test_is_not_lifted_by_what_stands_on_it(self, width_m: float) -> None:
        xy = scattered()
        inside = np.abs(xy - [9.0, 4.0]).max(axis=1) < 0.5 * width_m
        z = np.where(inside, 1.2, 0.0) - LIDAR_HEIGHT_M
        surface = fit_surface(with_noise(xy, z))
        assert surface is not None
        assert surface.height_at(xy[inside]) == pytest.approx(-LIDAR_HEIGHT_M, abs=0.05)

    def test_is_continued_where_none_is_seen(self) -> None:
        xy = scattered()
        seen = np.linalg.norm(xy - [9.0, 4.0], axis=1) > 3.0
        surface = fit_surface(with_noise(xy, 0.05 * xy[:, 0] - LIDAR_HEIGHT_M)[seen])
        assert surface is not None
        at = np.array([[9.0, 4.0]])
        assert surface.height_at(at) == pytest.approx(0.45 - LIDAR_HEIGHT_M, abs=0.05)
        assert not surface.is_seen_at(at)[0]
        assert surface.is_seen_at(np.array([[0.0, 0.0]]))[0]

    def test_lone_returns_from_below_do_not_pull_it_down(self) -> None:
        xy = scattered()
        z = np.full(len(xy), -LIDAR_HEIGHT_M)
        z[::400] -= 1.0  # as mirrored by a puddle
        surface = fit_surface(with_noise(xy, z))
        assert surface is not None
        at = np.array([[3.0, 3.0], [6.0, -2.0]])
        assert surface.height_at(at) == pytest.approx(-LIDAR_HEIGHT_M, abs=0.08)


class TestNoGround:
    def test_in_a_wall(self) -> None:
        rng = np.random.default_rng(0)
        wall = np.column_stack(
            [np.full(3000, 8.0), rng.uniform(-6, 6, 3000), rng.uniform(-2, 3, 3000)]
        )
        assert fit_surface(wall + rng.normal(0.0, 0.01, wall.shape)) is None

    def test_in_nothing(self) -> None:
        assert fit_surface(np.zeros((0, 3))) is None
