"""The information of a chain of states, and its Schur complements (`README.md`, section 8).

A banded solve: for the joint information of hundreds of poses GTSAM's general elimination takes 2
to 8 times as long (`scripts/benchmark_trajectory.py --solvers`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
import scipy.linalg
import scipy.sparse

from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array, IntArray

STATE = 15
"""Rotation, position (right perturbation of the pose), velocity, accelerometer and gyro bias."""

POSE = 6
"""The first ones of these."""

FACTORS_AT_A_TIME = 100
"""Factors of a graph that are turned into a part of the chain at once."""

ROWS_AT_A_TIME = 1000
"""Rows of a Jacobian that are added to a chain at once: the products of all rows would take 0.15 GB
on a drive of 16 minutes."""

UNDETERMINED = (
    "the motion data do not determine the trajectory. Check units, axes and gaps with 'caliv-graph "
    "inspect', and noise and the sigmas of imu and gnss in the config"
)


@dataclass(frozen=True)
class Chain:
    """Information of n states in a row and k coordinates that all of them may share.

    A state has w coordinates: `STATE`, and after them what else is estimated beside it.

    Attributes:
        diagonal: (n, w, w).
        coupling: (n - 1, w, w) between a state (rows) and the next (columns).
        border: (n, w, k) between each state (rows) and the common coordinates.
        corner: (k, k).
    """

    diagonal: Array
    coupling: Array
    border: Array
    corner: Array

    @staticmethod
    def zero(n: int, width: int, k: int) -> Chain:
        """No information on n states of `width` coordinates and k common ones."""
        return Chain(
            np.zeros((n, width, width)),
            np.zeros((max(n - 1, 0), width, width)),
            np.zeros((n, width, k)),
            np.zeros((k, k)),
        )

    @staticmethod
    def from_graph(
        graph: gtsam.GaussianFactorGraph,
        state_keys: Sequence[Sequence[int]],
        state_dims: Sequence[int],
        common_keys: Sequence[int],
        columns: Array | None = None,
    ) -> Chain:
        """The Hessian of a whitened linear graph.

        Every factor touches one state, two neighbours, or common variables. `state_keys` are the
        keys of each state in the order of its coordinates, `state_dims` their dimensions, which add
        up to w. `common_keys` are the common variables, of one dimension each. `columns` (rows of
        the graph, p) are derivatives of its rows by p more common coordinates, which follow those
        of the keys.
        """
        width = sum(state_dims)
        extra = 0 if columns is None else columns.shape[1]
        n, k = len(state_keys), len(common_keys)
        place = places(state_keys, state_dims, common_keys, width)
        out = Chain.zero(n, width, k + extra)
        # In parts: the triplets take ten times the memory of the blocks, gigabytes on a long drive.
        row_from = 0
        for begin in range(0, graph.size(), FACTORS_AT_A_TIME):
            some = gtsam.GaussianFactorGraph()
            for number in range(begin, min(begin + FACTORS_AT_A_TIME, graph.size())):
                some.push_back(graph.at(number))
            J, _ = jacobian(some, place, width * n + k)
            if columns is not None:
                J = beside(J, columns[row_from : row_from + J.shape[0]])
                row_from += J.shape[0]
            out.add(J)
        return out

    def add(self, J: scipy.sparse.csr_array) -> None:
        """Adds the information of a whitened Jacobian, columns as in `places`, in place."""
        for begin in range(0, J.shape[0], ROWS_AT_A_TIME):
            self._add(J[begin : begin + ROWS_AT_A_TIME])

    def _add(self, J: scipy.sparse.csr_array) -> None:
        n, width = self.diagonal.shape[:2]
        H = (J.T @ J).tocoo()
        row, column = (np.asarray(index, np.int64) for index in H.coords)
        (a, r), (b, c), value = np.divmod(row, width), np.divmod(column, width), H.data
        state, other = row < width * n, column < width * n
        if (np.abs(b - a)[state & other] > 1).any():
            raise ValueError("a factor touches states that are not neighbours")
        # After summation each entry of a matrix occurs once.
        on, above = state & other & (b == a), state & other & (b == a + 1)
        self.diagonal[a[on], r[on], c[on]] += value[on]
        self.coupling[a[above], r[above], c[above]] += value[above]
        edge, common = state & ~other, ~state & ~other
        self.border[a[edge], r[edge], column[edge] - width * n] += value[edge]
        self.corner[row[common] - width * n, column[common] - width * n] += value[common]

    def leading(self, width: int) -> Chain:
        """The chain of the first `width` coordinates of every state, the others held."""
        first = slice(0, width)
        return Chain(
            self.diagonal[:, first, first],
            self.coupling[:, first, first],
            self.border[:, first],
            self.corner,
        )

    def part(self, states: slice) -> Chain:
        """The chain of some states in a row, without what the others say of them."""
        diagonal = self.diagonal[states]
        coupling = self.coupling[states][: max(len(diagonal) - 1, 0)]
        return Chain(diagonal, coupling, self.border[states], self.corner)

    def head(self, n: int) -> Chain:
        """The chain of the first n states, all others eliminated."""
        diagonal, border = self.diagonal[-1].copy(), self.border[-1].copy()
        corner = self.corner.copy()
        if n == len(self.diagonal):
            return self
        for i in range(len(self.diagonal) - 1, n - 1, -1):
            inverse, link = inverse_of(diagonal), self.coupling[i - 1]
            to_border = inverse @ border
            corner -= border.T @ to_border
            diagonal = self.diagonal[i - 1] - link @ inverse @ link.T
            border = self.border[i - 1] - link @ to_border
        out = self.part(slice(0, n))
        return Chain(
            np.concatenate([out.diagonal[:-1], diagonal[None]]),
            out.coupling,
            np.concatenate([out.border[:-1], border[None]]),
            corner,
        )

    def only(self, wanted: IntArray) -> Chain:
        """The chain of the states of ascending indices `wanted` (m,), all others eliminated."""
        keep = set(wanted.tolist())
        n, k = len(self.diagonal), self.corner.shape[0]
        diagonal, border = self.diagonal.copy(), self.border.copy()
        corner = self.corner.copy()
        coupling = np.zeros((max(len(wanted) - 1, 0), *self.diagonal.shape[1:]))
        last = -1  # the last kept state
        link: Array | None = None  # its coupling with state i
        kept = 0
        for i in range(n):
            next_link = self.coupling[i] if i + 1 < n else None
            if i in keep:
                if link is not None:
                    coupling[kept - 1] = link
                last, link = i, next_link
                kept += 1
                continue
            inverse = inverse_of(diagonal[i])
            to_border = inverse @ border[i]
            corner -= border[i].T @ to_border
            if next_link is not None:
                to_next = inverse @ next_link
                diagonal[i + 1] -= next_link.T @ to_next
                border[i + 1] -= next_link.T @ to_border
            if link is not None:
                diagonal[last] -= link @ inverse @ link.T
                border[last] -= link @ to_border
                link = None if next_link is None else -link @ to_next
        return Chain(diagonal[wanted], coupling, border[wanted], corner.reshape(k, k))

    def pose_information(
        self, wanted: IntArray, kept: Sequence[int] = (), held: Sequence[int] = ()
    ) -> Array:
        """Joint information of the poses of the states `wanted` (m,), all else eliminated.

        Of the common coordinates those of indices `kept` follow the poses, those of `held` are
        fixed, and the others are eliminated too. (6 m + p, 6 m + p), p the number of `kept`.
        """
        chain = self.only(wanted)
        width = self.diagonal.shape[1]
        m, rest, k = len(wanted), width - POSE, chain.corner.shape[0]
        pose, other = slice(0, POSE), slice(POSE, width)
        cross = _tridiagonal(
            chain.diagonal[:, pose, other],
            chain.coupling[:, pose, other],
            np.swapaxes(chain.coupling[:, other, pose], 1, 2),
        )
        banded = banded_of(chain.diagonal[:, other, other], chain.coupling[:, other, other])
        border_other = chain.border[:, other].reshape(m * rest, k)
        border_pose = chain.border[:, pose].reshape(m * POSE, k)
        # In LAPACK's order of memory: it is hundreds of megabytes on a drive with many scans.
        right = np.empty((m * rest, m * POSE + k), order="F")
        cross.toarray(out=right.T[: m * POSE])
        right[:, m * POSE :] = border_other
        try:
            factor = scipy.linalg.cholesky_banded(banded, lower=True, check_finite=False)
        except np.linalg.LinAlgError:
            raise TrajectoryError(UNDETERMINED) from None
        solved = scipy.linalg.cho_solve_banded(
            (factor, True), right, overwrite_b=True, check_finite=False
        )
        joint = np.zeros((m * POSE + len(kept),) * 2)
        information = joint[: m * POSE, : m * POSE]
        for i in range(m):
            # A state is coupled with the rest of itself and of its neighbours. The rows up to the
            # diagonal: the others are the same.
            near = slice(max(i - 1, 0) * rest, min(i + 2, m) * rest)
            before, own = slice(i * POSE), slice(i * POSE, (i + 1) * POSE)
            row = -(cross[own, near].toarray() @ solved[near, : (i + 1) * POSE])
            row[:, own] += chain.diagonal[i, pose, pose]
            if i:
                row[:, (i - 1) * POSE : i * POSE] += chain.coupling[i - 1, pose, pose].T
            information[own, : (i + 1) * POSE] = row
            information[before, own] = row[:, before].T
        edge = border_pose - cross @ solved[:, m * POSE :]
        corner = chain.corner - border_other.T @ solved[:, m * POSE :]
        gone = [i for i in range(k) if i not in kept and i not in held]
        stay = list(kept)
        if gone:
            inverse = inverse_of(corner[np.ix_(gone, gone)])
            information -= edge[:, gone] @ inverse @ edge[:, gone].T
        if stay:
            cross_stay, corner_stay = edge[:, stay], corner[np.ix_(stay, stay)]
            if gone:
                to_stay = inverse @ corner[np.ix_(gone, stay)]
                cross_stay = cross_stay - edge[:, gone] @ to_stay
                corner_stay = corner_stay - corner[np.ix_(stay, gone)] @ to_stay
            joint[: m * POSE, m * POSE :] = cross_stay
            joint[m * POSE :, : m * POSE] = cross_stay.T
            joint[m * POSE :, m * POSE :] = corner_stay
        return joint


def places(
    state_keys: Sequence[Sequence[int]],
    state_dims: Sequence[int],
    common_keys: Sequence[int],
    width: int,
) -> dict[int, tuple[int, int]]:
    """First column and dimension of each key: states of `width` in a row, then common variables."""
    out = {}
    for i, keys in enumerate(state_keys):
        at = width * i
        for key, dim in zip(keys, state_dims, strict=True):
            out[key] = (at, dim)
            at += dim
    for j, key in enumerate(common_keys):
        out[key] = (width * len(state_keys) + j, 1)
    return out


def jacobian(
    graph: gtsam.GaussianFactorGraph, place: Mapping[int, tuple[int, int]], size: int
) -> tuple[scipy.sparse.csr_array, Array]:
    """The Jacobian (m, `size`) of a whitened linear graph and minus its right-hand side (m,).

    Columns are where `place` (first, how many) has each key; the graph is `J d + r`.
    """
    rows, columns, entries = np.asarray(graph.sparseJacobian_())
    # GTSAM's columns are in ascending order of the keys; the last one is the right-hand side.
    keys = sorted(set(graph.keyVector()))
    order = np.concatenate([np.arange(a, a + d) for a, d in (place[k] for k in keys)])
    keep = columns <= len(order)
    factors: list[Any] = [graph.at(i) for i in range(graph.size())]
    m = sum(factor.rows() for factor in factors)
    where = rows[keep].astype(np.int64) - 1, order[columns[keep].astype(np.int64) - 1]
    # The triplets leave out zeros: rows are counted by the factors.
    r = np.zeros(m)
    r[rows[~keep].astype(np.int64) - 1] = -entries[~keep]
    return scipy.sparse.csr_array((entries[keep], where), shape=(m, size)), r


def beside(J: scipy.sparse.csr_array, columns: Array) -> scipy.sparse.csr_array:
    """J (r, c) with more columns (r, p) after its own."""
    return scipy.sparse.csr_array(scipy.sparse.hstack([J, scipy.sparse.csr_array(columns)]))


def inverse_of(A: Array) -> Array:
    """Inverse of a positive definite matrix, scaled to a unit diagonal for the factorisation.

    Raises:
        TrajectoryError: it is not positive definite.
    """
    scale = np.sqrt(np.diagonal(A))
    if not (scale > 0.0).all():
        raise TrajectoryError(UNDETERMINED)
    try:
        L = np.linalg.cholesky(A / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        raise TrajectoryError(UNDETERMINED) from None
    half = np.linalg.inv(L) / scale
    return np.asarray(half.T @ half)


def _tridiagonal(
    diagonal: Array, above: Array, below: Array | None = None
) -> scipy.sparse.csr_array:
    """A sparse matrix of (n, r, c) diagonal and (n - 1, r, c) neighbouring blocks.

    `below[i]` is block (i + 1, i); without it the matrix is symmetric.
    """
    n, r, c = diagonal.shape
    if below is None:
        below = np.swapaxes(above, 1, 2)
    at = np.arange(n)
    block_row = np.concatenate([at, at[:-1], at[1:]])
    block_column = np.concatenate([at, at[1:], at[:-1]])
    blocks = np.concatenate([diagonal, above, below])
    rows = np.broadcast_to(r * block_row[:, None, None] + np.arange(r)[:, None], blocks.shape)
    columns = np.broadcast_to(c * block_column[:, None, None] + np.arange(c), blocks.shape)
    return scipy.sparse.csr_array(
        (blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(n * r, n * c)
    )


def banded_of(diagonal: Array, above: Array) -> Array:
    """Lower banded storage of a symmetric block-tridiagonal matrix, in LAPACK's order of memory."""
    n, r, _ = diagonal.shape
    out = np.zeros((2 * r, n * r), order="F")
    for column in range(r):
        for row in range(column, r):
            out[row - column, column::r] = diagonal[:, row, column]
        for row in range(r):
            # Block (i + 1, i) is the transpose of `above`.
            out[r + row - column, column : (n - 1) * r : r] = above[:, column, row]
    return out
