"""Strips that are bent."""

from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.geometry.se3 import tangent_axes, vehicle_axes_difference
from caliv_graph.products import Array, BoolArray
from caliv_graph.structure.bends import BENDS, USUAL_PER_M, seen_bends
from caliv_graph.structure.layout import Layout, Nuisances
from caliv_graph.structure.solve import STEPS
from caliv_graph.structure.weights import bend_weights
from tests.structure.test_solve import NOISE, problem_of, solve
from tests.structure.yards import figure_eight, yard

UP = np.array([0.0, 0.0, 1.0])
CENTRE = np.array([8.0, 3.0, -2.0])


def patches(bends: Array, places: Array) -> tuple[Array, Array]:
    """Points (n, k, 3) of patches 0.5 m wide of a bent strip about `CENTRE`, and their moments."""
    u, v = (g.ravel() for g in np.meshgrid(*[np.linspace(-0.25, 0.25, 7)] * 2))
    first, second = tangent_axes(UP)
    x, y = places[:, :1] + u, places[:, 1:] + v
    a, b, c = bends
    height = 0.5 * a * x**2 + b * x * y + 0.5 * c * y**2
    points = CENTRE + x[..., None] * first + y[..., None] * second + height[..., None] * UP
    h = np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=2)
    return points, np.einsum("nki,nkj->nij", h, h)


@pytest.mark.parametrize("kind", range(BENDS))
def test_a_bend_makes_up_for_where_on_the_strip_a_scan_falls(kind: int) -> None:
    """Two scans, of the near and of the far part: a millimetre or more from one plane."""
    bends = np.zeros(BENDS)
    bends[kind] = 0.02
    near = np.array([[-0.6, -0.4], [-0.6, 0.4], [-0.4, 0.0]])
    far = np.array([[0.9, -0.8], [0.9, 0.3], [0.7, 0.9]])
    points, moments = patches(bends, np.concatenate([near, far]))
    n = len(moments)
    by = seen_bends(
        moments,
        np.tile(CENTRE, (n, 1)),
        np.tile(tangent_axes(UP), (n, 1, 1)),
        np.tile(UP, (n, 1)),
        np.zeros(n, dtype=np.int64),
        np.array([0, 3]),
    )
    height = (points - CENTRE) @ UP
    mean = height.mean()  # all patches have as many points: part of the strip's plane
    for scan, own in enumerate((slice(0, 3), slice(3, 6))):
        function = 0.02 * by[scan, kind]
        added = points[own] @ function[:3] + function[3]
        left = height[own] - mean + added
        assert abs(left.mean()) < 2e-4
        assert abs((height[own] - mean).mean()) > 5e-4
        # What is left is the curvature within the scan, and next to nothing of its tilt (0.018).
        tilt = np.linalg.lstsq(
            np.column_stack([points[own].reshape(-1, 3)[:, :2], np.ones(left.size)]),
            left.ravel(),
            rcond=None,
        )[0]
        assert np.abs(tilt[:2]).max() < 2e-3


def test_flat_walls_bend_by_nothing_and_move_no_lidar() -> None:
    problem = problem_of(yard(), figure_eight(24), 3, replace(NOISE, bump_m=0.0))
    flat, bent = solve(problem), solve(replace(problem, bent=True))
    own = np.arange(bent.layout.bend, bent.layout.surface_error)
    bends = bent.state.errors[own]
    assert len(bends) == BENDS * bent.layout.strips
    assert np.median(np.abs(bends)) < 3e-4
    units = np.zeros((bent.layout.size, len(own)))
    units[own, np.arange(len(own))] = 1.0
    variances = np.diag(bent.system.surfaces.solve(bent.factor, units)[own])
    assert np.abs(bends / np.sqrt(variances)).max() < 3.0
    assert (bent.nuisances.bend < USUAL_PER_M).all()
    for one, other in zip(flat.state.T_vehicle_lidar, bent.state.T_vehicle_lidar, strict=True):
        apart = vehicle_axes_difference(one, other)
        assert np.abs(apart[:3]).max() < 3e-5
        assert np.abs(apart[3:]).max() < 5e-4


def test_a_strip_that_loses_its_weight_by_its_bend_stays_without(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its bend is not estimated any more, and comes out as zero: it must not come back for that.

    Walls with bumps, limits at which some of them are beyond.
    """
    lost: list[set[int]] = []

    def of_bends(errors: Array, layout: Layout, nuisances: Nuisances, _: BoolArray) -> Array:
        found = bend_weights(errors, layout, nuisances, np.ones(layout.strips, bool))
        lost.append(set(np.flatnonzero(found == 0.0).tolist()))
        return found

    monkeypatch.setattr("caliv_graph.structure.weights.LEAST_BEND_PER_M", 0.0)
    monkeypatch.setattr("caliv_graph.structure.weights.BEND_SPREADS", (1.0, 1.3))
    monkeypatch.setattr("caliv_graph.structure.solve.bend_weights", of_bends)
    problem = problem_of(yard(), figure_eight(24), 3, replace(NOISE, bump_m=0.004))
    found = solve(replace(problem, bent=True))
    first, *others = lost[-STEPS[-1] :]
    assert len(first) > 10
    # Without memory they are lost after every second step.
    assert not set().union(*others) & first
    assert first <= set(np.flatnonzero(found.unbent == 0.0).tolist())
    assert found.weights[np.isin(found.sightings.strip, list(first))].max() == 0.0
