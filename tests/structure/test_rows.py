"""Roots of the information of sightings."""

from __future__ import annotations

import numpy as np
import pytest

from caliv_graph.structure.rows import roots_of


def test_roots_of_moments_that_know_all_three_or_no_directions() -> None:
    """Of points 60 m away, those of a plane, of one beam, and of none."""
    rng = np.random.default_rng(0)
    points = np.array([60.0, -20.0, 3.0]) + rng.uniform(-0.5, 0.5, (4, 30, 3))
    points[1, :, 2] = 3.0
    points[2] = points[2, :1]
    h = np.concatenate([points, np.ones((4, 30, 1))], axis=2)
    S = 1e4 * np.einsum("qni,qnj->qij", h, h)
    S[3] = 0.0

    C = roots_of(S)

    size = np.sqrt(np.einsum("qi,qj->qij", *[np.diagonal(S, axis1=1, axis2=2)] * 2))
    assert np.abs(C @ np.swapaxes(C, 1, 2) - S).max() <= 1e-11 * size.max()
    assert not C[:, 3, 1:].any()  # an offset is in the first residual alone
    known = np.count_nonzero(C.any(axis=1), axis=1)
    assert known.tolist() == [4, 3, 1, 0]
    of_points = np.linalg.norm(h[0] @ np.linalg.inv(C[0]).T, axis=1)
    assert (of_points**2).sum() == pytest.approx(4.0 / 1e4, rel=1e-6)
