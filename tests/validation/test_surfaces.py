from __future__ import annotations

import math

import numpy as np
import pytest

from caliv_graph.products import Array, IntArray
from caliv_graph.validation.surfaces import Structure, find_structure, fit_pole

SCANS = 20


def found(points: Array, scan: IntArray | None = None, gate_m: float = 0.06) -> Structure:
    """Structure of points that are seen along x."""
    scan = np.arange(len(points)) % SCANS if scan is None else scan
    beams = np.broadcast_to(np.array([1.0, 0.0, 0.0]), points.shape)
    return find_structure(points, beams, scan, gate_m, with_ground=False)


def wall(rng: np.random.Generator, at: float, count: int = 400, sigma_m: float = 0.01) -> Array:
    return np.column_stack(
        [
            at + rng.normal(0.0, sigma_m, count),
            rng.uniform(0.0, 6.0, count),
            rng.uniform(0.0, 2.0, count),
        ]
    )


def number(structure: Structure) -> int:
    """Of walls, poles and objects."""
    return len(structure.surfaces) + len(structure.things)


def test_two_walls_one_behind_the_other() -> None:
    rng = np.random.default_rng(1)
    points = np.vstack([wall(rng, 5.0), wall(rng, 6.0, 300)])
    structure = found(points)

    # Lengths leave out two percent of the points at either end.
    assert [len(w.members) for w in structure.walls] == [400, 300]
    assert [w.centre[0] for w in structure.walls] == pytest.approx([5.0, 6.0], abs=0.003)
    assert structure.walls[0].extent_m == pytest.approx((5.76, 1.92), rel=0.05)
    assert not structure.poles + structure.things


def test_what_is_far_along_is_another_wall() -> None:
    rng = np.random.default_rng(1)
    points = np.vstack([wall(rng, 5.0), wall(rng, 5.0) + np.array([0.0, 12.0, 0.0])])

    assert len(found(points).walls) == 2


def test_a_hedge_is_no_wall() -> None:
    rng = np.random.default_rng(1)
    hedge = wall(rng, 5.0, 2000)
    hedge[:, 0] = rng.uniform(4.5, 5.5, 2000)

    assert number(found(hedge)) == 0


def test_level_planes_are_not_for_validation() -> None:
    rng = np.random.default_rng(1)
    ground = np.column_stack([rng.uniform(0.0, 9.0, (900, 2)), np.zeros(900)])

    assert number(found(ground)) == 0


def test_what_is_in_few_scans_may_be_passing_by() -> None:
    rng = np.random.default_rng(1)
    points = wall(rng, 5.0)

    assert number(found(points, np.arange(len(points)) % 4)) == 0
    assert number(found(points, np.arange(len(points)) % 5)) == 1


def test_who_walks_through_is_no_object() -> None:
    rng = np.random.default_rng(1)
    scan = np.repeat(np.arange(SCANS), 30)
    place = np.column_stack([0.3 * scan, np.zeros(600), np.full(600, 0.9)])
    walker = place + rng.uniform(-1.0, 1.0, (600, 3)) * [0.2, 0.2, 0.85]
    box = rng.uniform(-0.25, 0.25, (600, 3)) + np.array([0.0, 9.0, 0.3])
    structure = found(np.vstack([walker, box]), np.concatenate([scan, scan]))

    (thing,) = structure.things
    assert thing.centre == pytest.approx([0.0, 9.0, 0.3], abs=0.05)
    assert not structure.walls + structure.poles


@pytest.mark.parametrize("radius_m", [0.05, 0.1, 0.25])
def test_a_pole_seen_from_one_side(radius_m: float) -> None:
    rng = np.random.default_rng(4)
    angle, z = rng.uniform(-1.3, 1.3, 400) + math.pi, rng.uniform(0.0, 3.0, 400)
    lean = np.array([0.01, -0.02])
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    axis = np.array([7.0, -3.0]) + lean * (z - 1.5)[:, None]
    beams = np.broadcast_to(np.array([1.0, 0.0, 0.0]), (400, 3))
    exact = np.column_stack([axis + radius_m * ring, z])
    noisy = np.column_stack([axis + (radius_m + rng.normal(0.0, 0.005, 400))[:, None] * ring, z])

    pole = fit_pole(exact, beams, np.arange(400))
    assert pole is not None
    at = pole.foot - pole.slope * (pole.middle_z - 1.5)
    assert at == pytest.approx([7.0, -3.0], abs=2e-3)
    assert pole.slope == pytest.approx(lean, abs=1e-3)
    assert pole.radius_m == pytest.approx(radius_m, abs=2e-3)
    pole = fit_pole(noisy, beams, np.arange(400))
    assert pole is not None
    assert pole.radius_m == pytest.approx(radius_m, abs=8e-3)
    known = fit_pole(noisy, beams, np.arange(400), radius_m)
    assert known is not None
    assert known.radius_m == pytest.approx(radius_m, abs=1e-6)
    assert known.foot == pytest.approx([7.0, -3.0], abs=3e-3)


def test_a_barrel_is_no_pole() -> None:
    angle = np.linspace(0.0, 2.0 * math.pi, 400)
    points = np.column_stack([np.cos(angle), np.sin(angle), np.linspace(0.0, 3.0, 400)])

    assert fit_pole(points, -points, np.arange(400)) is None
