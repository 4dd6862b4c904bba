"""Elimination of what belongs to one surface: planes and the LiDARs' errors on it.

Poses first, planes left, is the cheaper order where poses form a chain. Here the joint information
of the motion data couples all poses anyway, and a surface has few coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse

from caliv_graph.errors import SolveError
from caliv_graph.products import Array, IntArray

RIDGE = 1e-12
"""Relative ridge under which the system is solved."""


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

    def follow(self, d: Array) -> Array:
        """The whole step (D,) from that (R,) of the coordinates that remain."""
        halves = [_lower(block.L, self.right[block.own - self.rest]) for block in self.blocks]
        return self._followed(d, halves)

    def _followed(self, rest: Array, halves: Sequence[Array]) -> Array:
        out = np.zeros((self.rest + len(self.right), *rest.shape[1:]))
        out[: self.rest] = rest
        for block, half in zip(self.blocks, halves, strict=True):
            known = half - block.coupling @ rest[block.others]
            out[block.own] = scipy.linalg.solve_triangular(
                block.L, known, lower=True, trans=1, check_finite=False
            )
        return out


def eliminated(
    H: scipy.sparse.csr_array, b: Array, rest: int, blocks: Sequence[IntArray]
) -> tuple[Array, Array, Surfaces]:
    """The quadratic on the first `rest` coordinates, those of each block eliminated.

    No two blocks are coupled.

    Raises:
        SolveError: a block is singular.
    """
    out = H[:rest, :rest].toarray()
    right = b[:rest].copy()
    done = []
    for own in blocks:
        rows = H[own]
        inside = rows[:, own].toarray()
        cross = rows[:, :rest].tocsc()
        others = np.flatnonzero(np.diff(cross.indptr))
        try:
            L = np.linalg.cholesky(inside)
        except np.linalg.LinAlgError:
            raise SolveError("structure: a surface has no information") from None
        coupling = _lower(L, cross[:, others].toarray())
        out[np.ix_(others, others)] -= coupling.T @ coupling
        right[others] -= coupling.T @ _lower(L, b[own])
        done.append(_Block(own, others, L, coupling))
    return np.asarray(out), right, Surfaces(rest, tuple(done), b[rest:])


def _lower(L: Array, right: Array) -> Array:
    return np.asarray(scipy.linalg.solve_triangular(L, right, lower=True, check_finite=False))


def factor_of(H: Array) -> tuple[Array, Array]:
    """Scale (D,) and lower Cholesky factor of H scaled to a unit diagonal.

    Raises:
        SolveError: it is singular.
    """
    scale = np.sqrt(np.diagonal(H))
    if not (scale > 0.0).all():
        raise SolveError("structure: a variable has no information")
    scaled = H / np.outer(scale, scale)
    scaled[np.arange(len(H)), np.arange(len(H))] += RIDGE
    try:
        factor = scipy.linalg.cholesky(scaled, lower=True, overwrite_a=True, check_finite=False)
    except scipy.linalg.LinAlgError:
        raise SolveError("structure: the system is singular") from None
    return scale, np.asarray(factor)


def solved(factor: tuple[Array, Array], right: Array) -> Array:
    """H^-1 right, from `factor_of(H)`."""
    scale, L = factor
    shaped = scale if right.ndim == 1 else scale[:, None]
    return np.asarray(
        scipy.linalg.cho_solve((L, True), right / shaped, check_finite=False) / shaped
    )
