"""Small dense parts of large sparse matrices against the products of whole ones."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from caliv_graph.structure.sparse_parts import difference_of_squares, entries, members


def test_squares_part_by_part_are_those_of_all_rows() -> None:
    """Parts share columns, one has no rows of V^T, and an entry is there twice."""
    rng = np.random.default_rng(0)
    J = rng.standard_normal((40, 12)) * (rng.random((40, 12)) < 0.4)
    part = rng.permutation(np.repeat([0, 2, 5, 7], 10))
    for number in (0, 2, 5, 7):
        J[part == number, number] = 0.0  # not all columns
    V_t = np.stack([J[part == number].sum(axis=0) for number in (0, 0, 5, 7)])
    row, column = np.nonzero(J)
    value = J[row, column]
    value[0] /= 2.0
    again = np.append(np.arange(len(value)), 0)
    row, column, value = row[again], column[again], value[again]
    order = np.argsort(row, kind="stable")
    ends = np.append(0, np.cumsum(np.bincount(row, minlength=40)))
    sparse = scipy.sparse.csr_array((value[order], column[order], ends), shape=J.shape)

    found = difference_of_squares(
        sparse,
        members(part),
        scipy.sparse.csr_array(V_t),
        members(np.array([0, 0, 5, 7])),
        9,
    )
    assert found == pytest.approx((J.T @ J - V_t.T @ V_t)[:9, :9], abs=1e-12)


def test_members_and_entries() -> None:
    assert {k: of.tolist() for k, of in members(np.array([3, 1, 3, 3])).items()} == {
        1: [1],
        3: [0, 2, 3],
    }
    assert members(np.zeros(0, np.int64)) == {}
    matrix = scipy.sparse.csr_array(np.array([[0.0, 1.0], [0.0, 0.0], [2.0, 3.0]]))
    row, column, value = entries(matrix, np.array([2, 1, 0]))
    assert row.tolist() == [0, 0, 2]
    assert column.tolist() == [0, 1, 1]
    assert value.tolist() == [2.0, 3.0, 1.0]
