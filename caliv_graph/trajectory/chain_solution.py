"""The solution of a chain: estimate, determinant, and covariance next to the diagonal.

From one banded Cholesky factor: the inverse of a chain is needed only where the chain has entries
(Takahashi et al. 1973), for gradients of a likelihood and for marginal covariances.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from caliv_graph.common.cores import parts
from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.chain import UNDETERMINED, Chain, banded_of

COLUMNS_TOGETHER = 128
"""Columns that `solved_in_blocks` solves for at a time, at most: 20 MB for two minutes of nodes."""

BYTES_TOGETHER = 20_000_000
"""Of these columns; on longer drives they are fewer."""


@dataclass(frozen=True)
class ChainSolution:
    """Of `information d = -gradient`, for n states of w coordinates and k common ones.

    Attributes:
        step: (n w + k,) d.
        log_determinant: of the information.
        cov: (n, w, w) covariance of each state.
        cov_next: (n - 1, w, w) between a state (rows) and the next (columns).
        cov_border: (n, w, k) between each state and the common coordinates.
        cov_corner: (k, k) of the common coordinates.
    """

    step: Array
    log_determinant: float
    cov: Array
    cov_next: Array
    cov_border: Array
    cov_corner: Array


def solved(chain: Chain, gradient: Array) -> ChainSolution:
    """Solves a chain for a gradient (n w + k,).

    Raises:
        TrajectoryError: the chain is singular.
    """
    n, w = chain.diagonal.shape[:2]
    k = len(chain.corner)
    size, factor, border = _factorised(chain)
    right = np.column_stack([-gradient[: n * w] / size.ravel(), border])
    by_state = scipy.linalg.cho_solve_banded((factor, True), right, check_finite=False)
    alone, to_border = by_state[:, 0], by_state[:, 1:]
    left = chain.corner - border.T @ to_border
    cov_corner: Array = np.asarray(np.linalg.inv(left)) if k else left
    common = cov_corner @ (-gradient[n * w :] - border.T @ alone)
    own, next_ = _selected_inverse(*_blocks(factor, n, w))
    edge = to_border.reshape(n, w, k)
    own = own + edge @ cov_corner @ np.swapaxes(edge, 1, 2)
    next_ = next_ + edge[:-1] @ cov_corner @ np.swapaxes(edge[1:], 1, 2)
    log_determinant = 2.0 * (np.log(factor[0]).sum() + np.log(size).sum())
    if k:
        log_determinant += np.linalg.slogdet(left)[1]
    return ChainSolution(
        step=np.concatenate([(alone - to_border @ common) / size.ravel(), common]),
        log_determinant=float(log_determinant),
        cov=own / (size[:, :, None] * size[:, None]),
        cov_next=next_ / (size[:-1, :, None] * size[1:, None]),
        cov_border=-(edge @ cov_corner) / size[:, :, None],
        cov_corner=cov_corner,
    )


def inverse_in_blocks(chain: Chain, coordinates: IntArray) -> Iterator[tuple[slice, Array]]:
    """(n w + k, m) columns of the inverse of a chain's information, some at a time.

    `coordinates` (m,) are of states, each i w + j.

    Raises:
        TrajectoryError: the chain is singular.
    """
    n, w = chain.diagonal.shape[:2]

    def unit(block: slice) -> Array:
        some = coordinates[block]
        right = np.zeros((n * w + len(chain.corner), len(some)))
        right[some, np.arange(len(some))] = 1.0
        return right

    return solved_in_blocks(chain, unit, len(coordinates))


def solved_columns(chain: Chain, right: Array) -> Array:
    """The inverse of a chain's information times columns (n w + k, m).

    Raises:
        TrajectoryError: the chain is singular.
    """
    return _Factor(chain).solved(right)


def solved_in_blocks(
    chain: Chain, right: Callable[[slice], Array], count: int
) -> Iterator[tuple[slice, Array]]:
    """`solved_columns` of many columns, some at a time: what is kept of each is the caller's.

    Args:
        chain: the information.
        right: (n w + k, b) of a slice of the columns.
        count: of all columns.

    Raises:
        TrajectoryError: the chain is singular.
    """
    factor = _Factor(chain)
    most = min(COLUMNS_TOGETHER, max(BYTES_TOGETHER // (8 * chain.diagonal[:, 0].size), 1))
    for block in parts(count, -(-count // most)):
        yield block, factor.solved(right(block))


class _Factor:
    """The factor of a chain's information, for columns of right sides."""

    def __init__(self, chain: Chain) -> None:
        n, w = chain.diagonal.shape[:2]
        size, factor, border = _factorised(chain)
        self._shape, self._size, self._border = (n, w), size.reshape(-1, 1), border
        L, self._below = _blocks(factor, n, w)
        self._inverse = _inverse_of_lower(L)
        self._to_border = self._substituted(border.copy())
        self._left = chain.corner - border.T @ self._to_border

    def solved(self, right: Array) -> Array:
        """The inverse times columns (n w + k, m)."""
        states = len(self._size)
        alone = self._substituted(right[:states] / self._size)
        common = np.linalg.solve(self._left, right[states:] - self._border.T @ alone)
        alone -= self._to_border @ common
        alone /= self._size
        return np.vstack([alone, common])

    def _substituted(self, right: Array) -> Array:
        """The inverse of `F F^T` times columns (n w, c), F as in `_selected_inverse`; in place.

        By blocks: LAPACK's banded solution goes through the columns one by one, and takes several
        times as long for hundreds of them.
        """
        inverse, below = self._inverse, self._below
        of = right.reshape(*self._shape, right.shape[1])
        of[0] = inverse[0] @ of[0]
        for i in range(1, len(of)):
            of[i] = inverse[i] @ (of[i] - below[i - 1] @ of[i - 1])
        of[-1] = inverse[-1].T @ of[-1]
        for i in range(len(of) - 2, -1, -1):
            of[i] = inverse[i].T @ (of[i] - below[i].T @ of[i + 1])
        return right


def _factorised(chain: Chain) -> tuple[Array, Array, Array]:
    """Scale (n, w) to a unit diagonal, banded Cholesky factor, and border (n w, k), both scaled."""
    n, w = chain.diagonal.shape[:2]
    # Variances of rad and of m/s^2 differ by ten orders of magnitude.
    size = np.sqrt(np.diagonal(chain.diagonal, axis1=1, axis2=2))
    if not (size > 0.0).all():
        raise TrajectoryError(UNDETERMINED)
    diagonal = chain.diagonal / (size[:, :, None] * size[:, None])
    coupling = chain.coupling / (size[:-1, :, None] * size[1:, None])
    border = (chain.border / size[:, :, None]).reshape(n * w, len(chain.corner))
    try:
        factor = scipy.linalg.cholesky_banded(
            banded_of(diagonal, coupling), overwrite_ab=True, lower=True, check_finite=False
        )
    except np.linalg.LinAlgError:
        raise TrajectoryError(UNDETERMINED) from None
    return size, factor, border


def _blocks(factor: Array, n: int, w: int) -> tuple[Array, Array]:
    """(n, w, w) diagonal and (n - 1, w, w) lower blocks of a banded Cholesky factor."""
    diagonal, below = np.zeros((n, w, w)), np.zeros((max(n - 1, 0), w, w))
    for column in range(w):
        for row in range(column, w):
            diagonal[:, row, column] = factor[row - column, column::w]
        for row in range(w):
            below[:, row, column] = factor[w + row - column, column : (n - 1) * w : w]
    return diagonal, below


def _inverse_of_lower(L: Array) -> Array:
    """Inverses of lower triangular matrices (n, w, w), by halves: half the time of any others'."""
    w = L.shape[1]
    if w == 1:
        return np.asarray(1.0 / L)
    first, rest = slice(0, w // 2), slice(w // 2, w)
    out = np.zeros_like(L)
    out[:, first, first] = _inverse_of_lower(L[:, first, first])
    out[:, rest, rest] = _inverse_of_lower(L[:, rest, rest])
    out[:, rest, first] = -out[:, rest, rest] @ L[:, rest, first] @ out[:, first, first]
    return out


def _selected_inverse(L: Array, below: Array) -> tuple[Array, Array]:
    """Diagonal and next blocks of the inverse of `F F^T`.

    F has the blocks L (n, w, w) on its diagonal and `below` (n - 1, w, w) under it.
    """
    inverse = _inverse_of_lower(L)
    own = np.swapaxes(inverse, 1, 2) @ inverse
    carry = below @ inverse[:-1]
    next_ = np.empty_like(below)
    for i in range(len(L) - 2, -1, -1):
        across = own[i + 1] @ carry[i]
        next_[i] = -across.T
        own[i] += carry[i].T @ across
    return own, next_
