"""Elimination of what belongs to one surface: planes and the LiDARs' errors on it.

Poses first, planes left, is the cheaper order where poses form a chain. Here the joint information
of the motion data couples all poses anyway, and a surface has few coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.linalg
import scipy.sparse

from caliv_graph.common.cores import share_out, shared_map
from caliv_graph.errors import SolveError
from caliv_graph.products import Array, IntArray
from caliv_graph.structure.sparse_parts import entries

RIDGES = (1e-12, 1e-11, 1e-10)
"""Relative ridges under which a system is solved, the first that rounding leaves positive: poses
that are known to each other to micrometres lie on a map that an unknown lever arm places to
metres."""

PANEL = 512
"""Rows of a product that are made at a time: temporary memory is small."""


@dataclass(frozen=True)
class _Block:
    """The coordinates of one surface: Cholesky factor, and coupling with others over it."""

    own: IntArray
    others: IntArray
    L: Array
    coupling: Array


@dataclass(frozen=True)
class Surfaces:
    """The eliminated coordinates, surface by surface.

    Attributes:
        rest: number of coordinates that remain, the first ones.
        blocks: one per surface.
        right: (D - R,) right-hand side of the eliminated ones.
    """

    rest: int
    blocks: tuple[_Block, ...]
    right: Array

    def solve(self, factor: tuple[Array, Array], right: Array) -> Array:
        """H^-1 right of the whole system, right (D, ...); `factor` is that of the rest."""
        rest = right[: self.rest].copy()
        halves = []
        for block in self.blocks:
            half = _lower(block.L, right[block.own])
            rest[block.others] -= block.coupling.T @ half
            halves.append(half)
        return self._followed(solved(factor, rest), halves)

    def reduced(self, rows: scipy.sparse.csr_array) -> tuple[Array, Array, Array]:
        """Rows (r, D) on what remains, (r, R), the eliminated coordinates following it.

        Also the covariance (r, r) of the rows by these coordinates, the rest being known, and what
        the rows are (r,) where the rest is zero.
        """
        out = rows[:, : self.rest].toarray()
        cov, at_zero = np.zeros((len(out), len(out))), np.zeros(len(out))
        columns = rows[:, self.rest :].T.tocsr()
        for block in self.blocks:
            own = block.own - self.rest
            place, row, value = entries(columns, own)
            used, row = np.unique(row, return_inverse=True)
            right = np.zeros((len(own), len(used) + 1))
            right[place, row] = value
            right[:, -1] = self.right[own]
            half = _lower(block.L, right)
            half, known = half[:, :-1], half[:, -1]
            out[np.ix_(used, block.others)] -= half.T @ block.coupling
            cov[np.ix_(used, used)] += half.T @ half
            at_zero[used] += half.T @ known
        return out, cov, at_zero

    def follow(self, d: Array) -> Array:
        """The whole step (D,) from that (R,) of the coordinates that remain."""
        halves = [_lower(block.L, self.right[block.own - self.rest]) for block in self.blocks]
        return self._followed(d, halves)

    def _followed(self, rest: Array, halves: Sequence[Array]) -> Array:
        out = np.zeros((self.rest + len(self.right), *rest.shape[1:]))
        out[: self.rest] = rest
        for block, half in zip(self.blocks, halves, strict=True):
            known = half - block.coupling @ rest[block.others]
            out[block.own] = _lower(block.L, known, transposed=True)
        return out


def eliminated(
    first: Array,
    others: scipy.sparse.csr_array,
    V_t: scipy.sparse.csr_array,
    b: Array,
    blocks: Sequence[IntArray],
) -> tuple[Array, Array, Surfaces]:
    """The quadratic `H - V V^T` on its first R coordinates, those of each block eliminated.

    No two blocks are coupled, and no column of V touches two of them.

    Args:
        first: (R, R) of `H - V V^T`; the result takes its memory.
        others: (D - R, D) rows of H of the other coordinates.
        V_t: (G, D) V^T, of a few coordinates a row.
        b: (D,).
        blocks: the other coordinates, block by block.

    It lets go of the sparse matrices when it has what it needs of them.

    Raises:
        SolveError: a block is singular.
    """
    rest, out = len(first), first
    order = np.concatenate(blocks) if len(blocks) else np.zeros(0, dtype=np.int64)
    rows, V_own, V_columns = others[order - rest], V_t.T.tocsr()[order], V_t[:, :rest]
    del others, V_t, first
    ends = np.cumsum([len(own) for own in blocks])

    def factored(k: int) -> _Block:
        return _block(rows, V_own, V_columns, int(ends[k]) - len(blocks[k]), blocks[k], rest)

    # The largest first: what is left at the end is small.
    by_size = sorted(range(len(blocks)), key=lambda k: -len(blocks[k]))
    found = dict(zip(by_size, shared_map(factored, by_size), strict=True))
    done = tuple(found[k] for k in range(len(blocks)))
    starts = range(0, rest, PANEL)
    share_out(partial(_subtract_squares, out, done), reversed(starts))
    _mirror(out)
    right = b[:rest].copy()
    for block in done:
        right[block.others] -= block.coupling.T @ _lower(block.L, b[block.own])
    return np.asarray(out), right, Surfaces(rest, done, b[rest:])


def _block(
    rows: scipy.sparse.csr_array,
    V_own: scipy.sparse.csr_array,
    V_columns: scipy.sparse.csr_array,
    begin: int,
    own: IntArray,
    rest: int,
) -> _Block:
    """One block: its rows of `rows` and `V_own` are those from `begin` on.

    `V_columns` (G, R) are the columns of V on what remains.

    Raises:
        SolveError: it is singular.
    """
    inside, cross, others, local = _dense_rows(rows, begin, own, rest)
    row, column, value = entries(V_own, np.arange(begin, begin + len(own)))
    columns, column = np.unique(column, return_inverse=True)
    low = np.zeros((len(own), len(columns)))
    low[row, column] = value
    inside -= low @ low.T
    row, column, value = entries(V_columns, columns)
    across = np.zeros((len(columns), len(others)))
    across[row, local[column]] = value
    cross -= low @ across
    try:
        L = np.asarray(np.linalg.cholesky(inside), np.float64)
    except np.linalg.LinAlgError:
        raise SolveError("structure: a surface has no information") from None
    return _Block(own, others, L, _lower(L, cross))


def _subtract_squares(out: Array, blocks: Sequence[_Block], begin: int) -> None:
    """Subtracts `coupling^T coupling` of each block from `out` (R, R), in place.

    Of the lower half the rows from `begin` on, `PANEL` of them: whoever does other rows touches
    nothing of this. The product for all would be as large as `out`.
    """
    flat = out.reshape(-1)
    for block in blocks:
        first, last = np.searchsorted(block.others, [begin, begin + PANEL])
        part = block.coupling[:, first:last].T @ block.coupling[:, :last]
        at = block.others[first:last, None] * len(out) + block.others[:last]
        np.subtract.at(flat, at.ravel(), part.ravel())


def _mirror(out: Array) -> None:
    """Copies what is below the diagonal of `out` (R, R) to above it."""
    for begin in range(PANEL, len(out), PANEL):
        own = slice(begin, begin + PANEL)
        out[:begin, own] = out[own, :begin].T


def _dense_rows(
    rows: scipy.sparse.csr_array, begin: int, own: IntArray, rest: int
) -> tuple[Array, Array, IntArray, IntArray]:
    """The rows of a block: within it, with others of the first `rest`, and which these are.

    They are those of `rows` from `begin` on. The last one (D,) has the places of `own` and of the
    others in the results.
    """
    row, column, value = entries(rows, np.arange(begin, begin + len(own)))
    across = column < rest
    coupled = np.zeros(rest, dtype=bool)
    coupled[column[across]] = True
    others = np.flatnonzero(coupled)
    local = np.zeros(rows.shape[1], dtype=np.int64)
    local[others] = np.arange(len(others))
    local[own] = np.arange(len(own))
    inside = np.zeros((len(own), len(own)))
    cross = np.zeros((len(own), len(others)))
    inside[row[~across], local[column[~across]]] = value[~across]
    cross[row[across], local[column[across]]] = value[across]
    return inside, cross, others, local


def _lower(L: Array, right: Array, transposed: bool = False) -> Array:
    """L^-1 right, or L^-T right: LAPACK without the checks, for many small matrices."""
    # The transpose of C's order is Fortran's: L^T is upper.
    out, _ = scipy.linalg.lapack.dtrtrs(L.T, right, lower=0, trans=0 if transposed else 1)
    return np.asarray(out)


def factor_of(H: Array, overwrite: bool = False) -> tuple[Array, Array]:
    """Scale (D,) and lower Cholesky factor of H scaled to a unit diagonal.

    What is above the diagonal is not part of it. With `overwrite` it takes the memory of H, in C
    order.

    Raises:
        SolveError: it is singular.
    """
    scale = np.sqrt(np.diagonal(H))
    if not (scale > 0.0).all():
        raise SolveError("structure: a variable has no information")
    scaled = np.divide(H, scale, out=H if overwrite else None)
    scaled /= scale[:, None]
    diagonal = np.arange(len(H))
    for ridge in RIDGES:
        scaled[diagonal, diagonal] = 1.0 + ridge
        try:
            # The transpose, which is the same, is in LAPACK's order of memory: no copy is needed.
            factor, _ = scipy.linalg.cho_factor(
                scaled.T, lower=True, overwrite_a=True, check_finite=False
            )
        except scipy.linalg.LinAlgError:
            # One half is spoiled, and the other one as it was.
            below = np.tril(scaled, -1)
            scaled = below + below.T
            continue
        return scale, np.asarray(factor)
    raise SolveError("structure: the system is singular")


def solved(factor: tuple[Array, Array], right: Array) -> Array:
    """H^-1 right, from `factor_of(H)`."""
    scale, L = factor
    shaped = scale if right.ndim == 1 else scale[:, None]
    return np.asarray(
        scipy.linalg.cho_solve((L, True), right / shaped, check_finite=False) / shaped
    )


def half_solved(factor: tuple[Array, Array], right: Array) -> Array:
    """F^-1 right (D, r), with `F F^T = H`, from `factor_of(H)`.

    A product of two of them has H^-1 in the middle, for half the work of `solved`.
    """
    scale, L = factor
    return np.asarray(
        scipy.linalg.solve_triangular(
            L, right / scale[:, None], lower=True, overwrite_b=True, check_finite=False
        )
    )


@dataclass(frozen=True)
class Further:
    """k further coordinates of a quadratic.

    Attributes:
        rows: (k, D) their information with the others.
        information: (k, k) of their own.
        gradient: (k,).
    """

    rows: Array
    information: Array
    gradient: Array


def marginal(
    H: Array, b: Array, keep: IntArray, rest: IntArray, further: Further | None = None
) -> tuple[Array, Array]:
    """Information and gradient of coordinates `keep` of a Gaussian, those of `rest` eliminated.

    Those of `further` are kept as well, the last ones. b may be several gradients (R, g).

    Raises:
        SolveError: `rest` is singular.
    """
    inside, own, across = H[np.ix_(keep, keep)], b[keep], H[np.ix_(keep, rest)]
    if further is not None:
        coupling, k = further.rows[:, keep], len(further.gradient)
        inside = np.block([[inside, coupling.T], [coupling, further.information]])
        own = np.concatenate([own.T, np.broadcast_to(further.gradient, (*b.shape[1:], k))], -1).T
        across = np.concatenate([across, further.rows[:, rest]])
    if not len(rest):
        return inside, own
    factor = factor_of(H[np.ix_(rest, rest)], overwrite=True)
    half = half_solved(factor, np.column_stack([across.T, b[rest]]))
    known, n = half.T @ half, len(inside)
    return inside - known[:n, :n], own - known[:n, n:].reshape(own.shape)


def covariance_of(factor: tuple[Array, Array], own: IntArray) -> Array:
    """(n, n) block of H^-1 of n coordinates, from `factor_of(H)`."""
    unit = np.zeros((len(factor[0]), len(own)))
    unit[own, np.arange(len(own))] = 1.0
    return solved(factor, unit)[own]
