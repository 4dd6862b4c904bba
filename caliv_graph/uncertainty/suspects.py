"""Ranking of suspects: which input, if it were freed, would explain the contradictions.

Every input that could be wrong is a parameter that the model leaves out. All of them together are
one quadratic, all other variables eliminated; what freeing some of them explains follows from it
without another solve. The derivation is in `caliv_graph/uncertainty/README.md`, "Suspects".
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
from scipy.special import gammaincc, gammaln, ndtri_exp

from caliv_graph.products import Array, BoolArray

DRIFT_M = 0.01
"""Allowance, 1 sigma per half wave over a drive, of given poses: what a good GNSS/INS leaves. The
Gauss-Markov error that the fit of their noise finds comes on top, up to the same size."""

DRIFT_RAD = 1e-3
"""The same of their yaw: 0.06 degrees."""

GNSS_DRIFT_M = 0.02
"""The same of GNSS fixes, whose noise is taken as white: an RTK receiver's error that does not
average out in minutes (multipath, troposphere) is one to two centimetres."""

FREED = 30.0
"""1 sigma of the weak prior on parameters that are freed beside the tested one, in their scales:
it only keeps the elimination invertible where two parameters have the same effect."""

RIDGE = 1e-9
"""Of the scaled information of all variables: what nothing determines stays where it is."""

_LARGE = 600.0
"""Half a chi-square beyond which its tail probability is taken from its asymptotic series."""


@dataclass(frozen=True)
class Candidate:
    """An input that could be wrong: k parameters, zero where it is right.

    Attributes:
        name: of the input.
        allowance: (k,) 1 sigma that a sound input may be off by. Zero: the model has its sigma.
        scale: (k,) largest sigma at which a direction counts as determined.
    """

    name: str
    allowance: Array
    scale: Array

    def __post_init__(self) -> None:
        """Both have a number per parameter."""
        if self.allowance.shape != self.scale.shape:
            raise ValueError(f"{self.name}: an allowance and a scale for each parameter")


@dataclass(frozen=True)
class Freed:
    """What one candidate, or several, would explain.

    Attributes:
        change: (k,) that the parameters would take, along what is determined.
        cov: (k, k) of it, all allowances considered; along what is not determined, what the data
            leave, at most `FREED` scales.
        squares: what freeing them takes off chi-square.
        dof: directions that are determined.
        determined: (k,) whether each parameter lies mostly along these.
    """

    change: Array
    cov: Array
    squares: float
    dof: int
    determined: BoolArray

    @property
    def log_p(self) -> float:
        """Logarithm of the probability of more `squares` if the inputs are sound."""
        return log_tail(self.squares, self.dof)

    @property
    def sigmas(self) -> float:
        """Of a normal variable with the same two-sided probability."""
        if self.log_p > -1e-12:
            return 0.0
        return float(-ndtri_exp(self.log_p - math.log(2.0)))


@dataclass(frozen=True)
class Ranked:
    """A candidate in the ranking.

    Attributes:
        candidate: which.
        freed: what freeing it alone explains.
        explains: part of what freeing all candidates explains, 0 to 1.
        sigmas_left: its sigmas once the first of the ranking is freed; of the first, its sigmas.
    """

    candidate: Candidate
    freed: Freed
    explains: float
    sigmas_left: float


@dataclass(frozen=True)
class Scores:
    """The left-out parameters of all candidates as one quadratic.

    `d^T information d / 2 - gradient^T d` is minus the log-likelihood of parameters d, all other
    variables eliminated.

    Attributes:
        candidates: in the order of the parameters.
        information: (K, K).
        gradient: (K,).
        misfit: variance of the data over what their model states, at least 1: where noise is
            stated too small, scores spread by as much more.
    """

    candidates: tuple[Candidate, ...]
    information: Array
    gradient: Array
    misfit: float = 1.0

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """The parameters of each candidate."""
        ends = np.cumsum([len(c.scale) for c in self.candidates]).tolist()
        return tuple(slice(a, b) for a, b in zip([0, *ends], ends, strict=False))

    @cached_property
    def scale(self) -> Array:
        """(K,) of all parameters."""
        return np.concatenate([c.scale for c in self.candidates])

    @cached_property
    def allowance(self) -> Array:
        """(K,) of all parameters."""
        return np.concatenate([c.allowance for c in self.candidates])

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of the candidates."""
        return tuple(c.name for c in self.candidates)

    def index(self, name: str) -> int:
        """Of a candidate; ValueError if it is none of them."""
        return self.names.index(name)

    def freed(self, tested: Collection[int], beside: Collection[int] = ()) -> Freed:
        """Frees candidates by index, those `beside` having been freed before.

        All others may be off by their allowances. Everything is in units of `scale`.
        """
        of = self._rows(tested)
        free = np.zeros(len(self.scale), dtype=bool)
        free[self._rows(beside)] = True
        D = self.information * np.outer(self.scale, self.scale)
        c = self.gradient * self.scale
        allowance = self.allowance / self.scale
        spread = np.where(free, FREED, allowance)
        others = np.setdiff1d(np.flatnonzero(spread > 0.0), of)
        D_i, c_i = D[np.ix_(of, of)], c[of]
        if len(others):
            inner = D[np.ix_(others, others)] + np.diag(spread[others] ** -2.0)
            cross = D[np.ix_(others, of)]
            solved = scipy.linalg.solve(inner, np.column_stack([cross, c[others]]), assume_a="pos")
            D_i = D_i - cross.T @ solved[:, :-1]
            c_i = c_i - cross.T @ solved[:, -1]
        values, vectors = np.linalg.eigh(0.5 * (D_i + D_i.T))
        known = values > 1.0
        left = np.maximum(values[~known], FREED**-2.0)
        V, values = vectors[:, known], values[known]
        along = (V.T @ c_i) / values
        cov = np.diag(self.misfit / values)
        null = cov + (V.T * allowance[of] ** 2) @ V
        squares = float(along @ np.linalg.solve(null, along)) if len(along) else 0.0
        unit, lost = self.scale[of], vectors[:, ~known]
        spread_all = V @ cov @ V.T + (lost / left) @ lost.T + np.diag(allowance[of] ** 2)
        return Freed(
            change=unit * (V @ along),
            cov=np.outer(unit, unit) * spread_all,
            squares=max(squares, 0.0),
            dof=len(along),
            determined=np.asarray((V**2).sum(axis=1) > 0.5),
        )

    def _rows(self, which: Collection[int]) -> Array:
        """Parameters of some candidates, ascending."""
        parts = [np.arange(*self.slices[i].indices(len(self.scale))) for i in sorted(which)]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)


def ranking(scores: Scores) -> tuple[Ranked, ...]:
    """All candidates of which the data say something, the least probable by chance first.

    The probability counts the parameters: of two inputs that explain the same, the simpler one
    comes first.
    """
    alone = [scores.freed([i]) for i in range(len(scores.candidates))]
    order = sorted(
        (i for i, freed in enumerate(alone) if freed.dof), key=lambda i: (alone[i].log_p, i)
    )
    if not order:
        return ()
    together = scores.freed(range(len(scores.candidates)))
    # The noise alone gives one per degree of freedom.
    whole = max(together.squares - together.dof, 1.0)
    first = order[0]
    out = []
    for i in order:
        left = alone[i] if i == first else scores.freed([i], [first])
        gained = max(alone[i].squares - alone[i].dof, 0.0)
        part = min(gained / max(whole, gained, 1.0), 1.0)
        out.append(Ranked(scores.candidates[i], alone[i], part, left.sigmas))
    return tuple(out)


def log_tail(squares: float, dof: int) -> float:
    """Logarithm of the probability that a chi-square variable exceeds `squares`; 0 for no dof."""
    if dof == 0:
        return 0.0
    a, x = 0.5 * dof, 0.5 * squares
    if x < max(_LARGE, 10.0 * a):
        return math.log(max(float(gammaincc(a, x)), 1e-300))
    # Q(a, x) ~ x^(a-1) e^-x / Gamma(a) (1 + (a-1)/x + ...): Abramowitz & Stegun 6.5.32.
    series = 1.0 + (a - 1.0) / x + (a - 1.0) * (a - 2.0) / x**2
    return float((a - 1.0) * math.log(x) - x - gammaln(a) + math.log(series))


def assembled(
    candidates: Sequence[Candidate],
    information: Array,
    gradient: Array,
    cross: Array,
    graph_information: Array,
    graph_gradient: Array,
) -> Scores:
    """Eliminates the variables of a graph from a quadratic over them and all parameters.

    Args:
        candidates: of the parameters, in order.
        information: (K, K) of the parameters.
        gradient: (K,) of the parameters.
        cross: (M, K) between variables and parameters.
        graph_information: (M, M) of the variables.
        graph_gradient: (M,) of the variables.

    Raises:
        scipy.linalg.LinAlgError: the graph is singular.
    """
    # Units differ by a million: the ridge is relative to each variable's own information.
    unit = 1.0 / np.sqrt(np.maximum(np.diag(graph_information), 1e-12))
    H = graph_information * np.outer(unit, unit)
    H[np.diag_indices_from(H)] += RIDGE
    factor = scipy.linalg.cho_factor(H, lower=True, overwrite_a=True, check_finite=False)
    right = np.column_stack([cross, graph_gradient]) * unit[:, None]
    half = scipy.linalg.solve_triangular(factor[0], right, lower=True, check_finite=False)
    D = information - half[:, :-1].T @ half[:, :-1]
    c = gradient - half[:, :-1].T @ half[:, -1]
    return Scores(tuple(candidates), 0.5 * (D + D.T), c)
