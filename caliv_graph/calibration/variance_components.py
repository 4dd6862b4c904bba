"""Restricted maximum likelihood of variances that add up in one covariance."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from scipy.optimize import minimize

from caliv_graph.products import Array

MAX_STEPS = 100
"""Of an optimiser; five to forty do."""

HALVINGS = 20
"""Of a step that gains nothing, at most."""

GAIN = 1e-7
"""Of the log-likelihood that another step promises: less is none."""

NEAR = 1.0
"""The same below which the likelihood is as good as quadratic."""

TIME_STEP = 1e-2
"""Change of the logarithm of a correlation time by which its derivative is taken."""


@dataclass(frozen=True)
class Block:
    """Errors of some residuals only.

    Attributes:
        rows: of the residuals, d in a row.
        cov: (d, d) covariance at sigma 1.
    """

    rows: slice
    cov: Array


Part = Array | Block
"""Errors of one sigma: the (N, N) covariance that they have at sigma 1, or a block of it."""


@dataclass(frozen=True)
class Observed:
    """Residuals that depend on parameters and on errors of known shape.

    Attributes:
        residuals: (N,).
        design: (N, p) derivatives by the parameters, which are integrated out.
        ridge: (p,) weak information on these.
        known: (N, N) covariance of errors of known size.
    """

    residuals: Array
    design: Array
    ridge: Array
    known: Array

    def covariance(self, parts: Sequence[Part], logarithms: Array) -> Array:
        """(N, N) of all errors, at logarithms (k,) of the sigmas of `parts`."""
        V = self.known.copy()
        for variance, part in zip(np.exp(2.0 * logarithms), parts, strict=True):
            if isinstance(part, Block):
                V[part.rows, part.rows] += variance * part.cov
            else:
                V += variance * part
        return V

    def cost(self, parts: Sequence[Part], logarithms: Array) -> tuple[float, Array, Array]:
        """Minus the log-likelihood; by the logarithms (k,) of the sigmas its slope and information.

        Patterson & Thompson (1971). The information is the average of the observed and of the
        expected one, of the variances, and never negative (Gilmour et al. 1995).
        """
        V = self.covariance(parts, logarithms)
        try:
            L = scipy.linalg.cholesky(V, lower=True, check_finite=False)
        except scipy.linalg.LinAlgError:
            return 1e12, np.zeros(len(parts)), np.zeros((len(parts), len(parts)))
        inverse = _inverse(L)
        weighted = inverse @ self.design
        LN = scipy.linalg.cholesky(self.design.T @ weighted + np.diag(self.ridge), lower=True)
        half = scipy.linalg.solve_triangular(LN, weighted.T, lower=True)
        inverse -= half.T @ half
        y = inverse @ self.residuals
        value = np.log(np.diag(L)).sum() + np.log(np.diag(LN)).sum() + 0.5 * self.residuals @ y
        slope, moved = np.empty(len(parts)), np.zeros((len(parts), len(y)))
        for i, part in enumerate(parts):
            rows, cov = (part.rows, part.cov) if isinstance(part, Block) else (slice(None), part)
            moved[i, rows] = cov @ y[rows]
            slope[i] = np.vdot(inverse[rows, rows], cov) - y[rows] @ moved[i, rows]
        variances = np.exp(2.0 * logarithms)
        moved *= variances[:, None]
        return float(value), variances * slope, 2.0 * moved @ inverse @ moved.T

    def value(self, parts: Sequence[Part], logarithms: Array) -> float:
        """Minus the log-likelihood as `cost` has it, in a third of the time."""
        V = self.covariance(parts, logarithms)
        try:
            L = scipy.linalg.cholesky(V, lower=True, check_finite=False)
        except scipy.linalg.LinAlgError:
            return 1e12
        both = np.column_stack([self.design, self.residuals])
        white = scipy.linalg.solve_triangular(L, both, lower=True, check_finite=False)
        A, r = white[:, :-1], white[:, -1]
        LN = scipy.linalg.cholesky(A.T @ A + np.diag(self.ridge), lower=True)
        taken = scipy.linalg.solve_triangular(LN, A.T @ r, lower=True)
        logarithm = np.log(np.diag(L)).sum() + np.log(np.diag(LN)).sum()
        return float(logarithm + 0.5 * (r @ r - taken @ taken))


def _inverse(L: Array) -> Array:
    """(N, N) inverse of `L L^T`, L lower triangular: a third of the work of solving for it."""
    lower = scipy.linalg.lapack.dpotri(L, lower=1)[0]
    inverse = lower + lower.T
    diagonal = np.arange(len(L))
    inverse[diagonal, diagonal] *= 0.5
    return np.asarray(inverse)


@dataclass(frozen=True)
class Component:
    """Errors whose sigma is a product of unknowns, by their numbers."""

    part: Part
    sigma: tuple[int, ...]


@dataclass(frozen=True)
class SlowComponent:
    """Errors that are correlated over time, in groups that share the time.

    Attributes:
        parts: correlation time in seconds -> covariance (N, N) of each group at sigma 1.
        sigmas: numbers of the unknowns, one for each group.
        time: the same of the correlation time.
    """

    parts: Callable[[float], Sequence[Array]]
    sigmas: tuple[int, ...]
    time: int


@dataclass(frozen=True)
class Likelihood:
    """The restricted likelihood of unknown sigmas, factors and times."""

    observed: Observed
    components: Sequence[Component]
    slow: Sequence[SlowComponent] = ()

    def value(self, x: Array) -> float:
        """Minus the log-likelihood at the logarithms (k,) of the unknowns."""
        return self.observed.value(*self._errors(x, self._slow_parts(x)))

    def covariance(self, x: Array) -> Array:
        """(N, N) of all errors there."""
        return self.observed.covariance(*self._errors(x, self._slow_parts(x)))

    def cost(self, x: Array) -> tuple[float, Array, Array]:
        """As that of `Observed`, by the unknowns; times: slope by a difference, no information."""
        slow = self._slow_parts(x)
        parts, logarithms = self._errors(x, slow)
        value, by_part, information = self.observed.cost(parts, logarithms)
        products = self._products(len(x))
        slope = by_part @ products
        for i, of in enumerate(self.slow):
            later = [*slow[:i], of.parts(math.exp(x[of.time] + TIME_STEP)), *slow[i + 1 :]]
            changed = self.observed.value(self._errors(x, later)[0], logarithms)
            slope[of.time] += (changed - value) / TIME_STEP
        return value, slope, products.T @ information @ products

    def _slow_parts(self, x: Array) -> list[Sequence[Array]]:
        return [of.parts(math.exp(x[of.time])) for of in self.slow]

    def _errors(self, x: Array, slow: Sequence[Sequence[Array]]) -> tuple[list[Part], Array]:
        """All parts and the logarithms of their sigmas."""
        parts = [*(of.part for of in self.components), *(part for of in slow for part in of)]
        return parts, self._products(len(x)) @ x

    def _products(self, unknowns: int) -> Array:
        """(parts, k) 1 where an unknown is a factor of the sigma of a part."""
        factors = [of.sigma for of in self.components]
        factors += [(number,) for of in self.slow for number in of.sigmas]
        out = np.zeros((len(factors), unknowns))
        rows = np.repeat(np.arange(len(factors)), [len(numbers) for numbers in factors])
        out[rows, [number for numbers in factors for number in numbers]] = 1.0
        return out


Cost = Callable[[Array], tuple[float, Array, Array]]
"""Minus a log-likelihood at logarithms (k,) of unknowns, with slope and information."""


def together(likelihoods: Sequence[Likelihood]) -> Cost:
    """Of residuals that are independent of each other and have the same unknowns."""

    def cost(x: Array) -> tuple[float, Array, Array]:
        values, slopes, informations = zip(*(of.cost(x) for of in likelihoods), strict=True)
        return sum(values), np.sum(slopes, axis=0), np.sum(informations, axis=0)

    return cost


@dataclass(frozen=True)
class Unknown:
    """A positive quantity to estimate: its log-normal prior and its bounds.

    Attributes:
        median: of the prior.
        spread: 1 sigma of its logarithm.
        bounds: of the estimate.
    """

    median: float
    spread: float
    bounds: tuple[float, float]


def time_of_expected(variances: Array, times_s: Array) -> float:
    """Time of one Gauss-Markov error of expected size, seconds.

    It changes over short times as the hypotheses do together, and over longer ones by no less
    (Jensen). `variances` (..., n) are the expected ones by each of their times (n,).
    """
    return float(variances.sum() / (variances / times_s).sum())


def maximise(cost: Cost, unknowns: Sequence[Unknown], start: Array) -> tuple[Array, float]:
    """The most likely values (k,) under their priors, and minus the logarithm of both there.

    To a hundredth of the log-likelihood, by small steps: in the basin where the search starts.

    Args:
        cost: of the likelihood.
        unknowns: priors and bounds.
        start: (k,) values.
    """
    penalised = _penalised(cost, unknowns)
    first = cost(np.log(start))[0]

    def less(x: Array) -> tuple[float, Array]:
        value, slope, _ = penalised(x)
        # Less the value at the start: the optimiser's tolerance is relative.
        return value - first, slope

    found = minimize(
        less,
        np.log(start),
        jac=True,
        method="L-BFGS-B",
        bounds=[tuple(np.log(u.bounds)) for u in unknowns],
        options={"ftol": 1e-7, "gtol": 0.05, "maxiter": MAX_STEPS},
    )
    return np.exp(np.asarray(found.x)), float(found.fun) + first


def maximise_exactly(cost: Cost, unknowns: Sequence[Unknown], start: Array) -> tuple[Array, float]:
    """`maximise` to where rounding does not matter any more, where there is one maximum.

    Newton's method with the average information, which is good far from the maximum. Near it that
    would take many steps: the last information is corrected by how the slopes change (BFGS).
    """
    penalised = _penalised(cost, unknowns)
    low, high = np.log([u.bounds for u in unknowns]).T
    x = np.clip(np.log(start), low, high)
    value, slope, information = penalised(x)
    for _ in range(MAX_STEPS):
        free = np.where(slope > 0.0, x > low, x < high)
        step = np.zeros(len(x))
        step[free] = np.linalg.solve(information[np.ix_(free, free)], -slope[free])
        gain = -0.5 * float(slope @ step)
        if gain < GAIN:
            break
        step /= max(float(np.abs(step).max()), 1.0)
        for _ in range(HALVINGS):
            d = np.clip(x + step, low, high) - x
            there, slope_there, information_there = penalised(x + d)
            if there < value:
                break
            step *= 0.5
        else:
            break
        if gain < NEAR:
            change, known, information_there = slope_there - slope, information @ d, information
            if change @ d > 0.0:
                information_there = information + np.outer(change, change) / (change @ d)
                information_there -= np.outer(known, known) / (known @ d)
        x, value, slope, information = x + d, there, slope_there, information_there
    return np.exp(x), value


def _penalised(cost: Cost, unknowns: Sequence[Unknown]) -> Cost:
    """With the priors of the unknowns."""
    centre = np.log([u.median for u in unknowns])
    weight = np.array([u.spread for u in unknowns]) ** -2.0

    def penalised(x: Array) -> tuple[float, Array, Array]:
        value, slope, information = cost(x)
        off = x - centre
        surprise = 0.5 * float(off @ (weight * off))
        return value + surprise, slope + weight * off, information + np.diag(weight)

    return penalised
