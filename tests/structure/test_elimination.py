"""The factor of a system, where rounding makes it singular."""

from __future__ import annotations

import numpy as np
import pytest

from caliv_graph.errors import SolveError
from caliv_graph.structure.elimination import factor_of, solved


def test_a_map_that_is_placed_to_metres_and_known_to_micrometres_is_solved() -> None:
    """A chain of places: the rounding of its sums is larger than what is known of it as a whole."""
    n = 400
    D = np.diff(np.eye(n), axis=0)
    H = D.T @ D / 1e-6**2
    pull = np.zeros(n)
    pull[0], pull[-1] = -1.0, 1.0
    H[0, 0] *= 1.0 - 2e-9  # the smallest eigenvalue, of 400 places alike, becomes -5e-12 of it

    found = solved(factor_of(H), pull)

    # The chain is stretched by its n - 1 springs.
    assert found[-1] - found[0] == pytest.approx((n - 1) * 1e-12, rel=0.01)
    assert np.allclose(solved(factor_of(H.copy(), overwrite=True), pull), found)


def test_what_is_not_positive_is_refused() -> None:
    with pytest.raises(SolveError, match="singular"):
        factor_of(np.array([[1.0, 2.0], [2.0, 1.0]]))
