"""Small dense parts of large sparse matrices, and the products of these."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import scipy.sparse

from caliv_graph.products import Array, IntArray


def members(of: IntArray) -> dict[int, IntArray]:
    """Number -> its places in `of` (n,), ascending."""
    numbers, count = np.unique(of, return_counts=True)
    places = np.split(np.argsort(of, kind="stable"), np.cumsum(count))[:-1]
    return dict(zip(numbers.tolist(), places, strict=True))


def entries(matrix: scipy.sparse.csr_array, rows: IntArray) -> tuple[IntArray, IntArray, Array]:
    """Row, as a place in `rows`, column and value of all entries of some rows.

    There are hundreds of small parts: the sparse library's own slices would take longer.
    """
    first, count = matrix.indptr[rows], np.diff(matrix.indptr)[rows]
    before = np.cumsum(count) - count
    at = np.arange(count.sum()) + np.repeat(first - before, count)
    return np.repeat(np.arange(len(rows)), count), matrix.indices[at], matrix.data[at]


def difference_of_squares(
    J: scipy.sparse.csr_array,
    rows: Mapping[int, IntArray],
    V_t: scipy.sparse.csr_array,
    rows_V: Mapping[int, IntArray],
    size: int,
) -> Array:
    """(`size`, `size`) first part of `J^T J - V V^T`, part by part of their rows.

    The rows of a part have few columns in all: their products are those of small dense matrices, in
    a fraction of the time of a product of sparse ones.

    Args:
        J: (r, D).
        rows: part -> its rows of J.
        V_t: (G, D) V^T.
        rows_V: part -> its rows of V^T, which have no other columns than its rows of J.
        size: number of columns that are asked for, the first ones.
    """
    out = np.zeros((size, size))
    local = np.zeros(size, dtype=np.int64)
    for part, own in rows.items():
        inside, column, value = _first(size, *entries(J, own))
        used = np.zeros(size, dtype=bool)
        used[column] = True
        columns = np.flatnonzero(used)
        local[columns] = np.arange(len(columns))
        square = _square(inside, local[column], value, len(own), len(columns))
        if part in rows_V:
            inside, column, value = _first(size, *entries(V_t, rows_V[part]))
            square -= _square(inside, local[column], value, len(rows_V[part]), len(columns))
        out[np.ix_(columns, columns)] += square
    return out


def _first(
    size: int, row: IntArray, column: IntArray, value: Array
) -> tuple[IntArray, IntArray, Array]:
    """The entries of the first columns."""
    own = column < size
    return row[own], column[own], value[own]


def _square(row: IntArray, column: IntArray, value: Array, rows: int, columns: int) -> Array:
    """(`columns`, `columns`) A^T A of a matrix A of some entries, summed where they are twice."""
    A = np.bincount(row * columns + column, value, minlength=rows * columns)
    A = A.reshape(rows, columns)
    return np.asarray(A.T @ A)
