"""The bound of a still view: planes by hand, and what scans average."""

from __future__ import annotations

import math

import numpy as np
import pytest

from scripts.show_static_bound import Spots, bound, information


def faces(normals: list[list[float]], count: int = 200) -> Spots:
    """Spots of two LiDARs on faces about (3, 0, 0), 0.2 m wide; both stand at the origin."""
    rng = np.random.default_rng(1)
    points, of_spots, second = [], [], []
    for k, normal in enumerate(np.array(normals)):
        # Every face in a cell of its own.
        middle = np.array([3.5, 0.5 + k, 0.5])
        plane = np.linalg.svd(normal[None])[2][1:]
        points.append(middle + rng.uniform(-0.1, 0.1, (2 * count, 2)) @ plane)
        of_spots.append(np.tile(normal, (2 * count, 1)))
        second.append(np.repeat([0.0, 1.0], count))
    total = 2 * count * len(normals)
    return Spots(
        np.concatenate(points),
        np.concatenate(of_spots),
        np.ones(total),
        np.concatenate(second),
        np.zeros(3),
    )


def test_one_plane_knows_its_distance_and_two_turns() -> None:
    spots = faces([[-1.0, 0.0, 0.0]])
    H = information(spots, np.full(400, 0.01**2), 1.0)
    assert np.linalg.matrix_rank(H, tol=1e-6 * np.linalg.norm(H)) == 3
    # Along its normal, beside the two turns about its middle: two means of 200 spots.
    middle = spots.points.mean(axis=0)
    turns = [np.r_[axis, -np.cross(axis, middle)] for axis in np.eye(3)[1:]]
    known = np.column_stack([np.eye(6)[3], *turns])
    cov = np.linalg.inv(known.T @ H @ known)
    assert math.sqrt(cov[0, 0]) == pytest.approx(0.01 * math.sqrt(2.0 / 200.0), rel=0.02)


def test_scans_average_what_they_do_not_share() -> None:
    spots = faces([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
    one, many = (bound(spots, 0.01, 0.0, scans, 1.0) for scans in (1, 100))
    # The prior of the slopes, 0.2 rad, hardly matters.
    np.testing.assert_allclose(many, one / 10.0, rtol=0.05)
    shared = [bound(spots, 0.01, 0.003, scans, 1.0) for scans in (100, 10**6)]
    np.testing.assert_allclose(shared[0], shared[1], rtol=0.1)
