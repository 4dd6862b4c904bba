"""Jitter of stamps: a time error of its own of each scan, common to all that the scan sees.

All strips of a scan move together along the vehicle's motion: an error of a stamp, or of the
deskewing, which no offset of a strip explains. Its sigma is estimated (REML); where the data say
that there is none, no variable is added.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from caliv_graph.products import Array, IntArray
from caliv_graph.structure.elimination import Further, marginal
from caliv_graph.structure.layout import Layout
from caliv_graph.structure.noise import LEAST_JITTER_S, MOST_JITTER_S
from caliv_graph.structure.problem import OFFSET_SIGMA_S

EVIDENCE = 3.0
"""Gain of the log-likelihood from which stamps are taken to jitter: chance gains as much in one of
a hundred drives, and a needless jitter costs little."""

SIGMAS = 200
"""Sigmas that are tried, evenly spread in the logarithm: 4 percent apart."""


@dataclass(frozen=True)
class Clocks:
    """What surfaces tell of clocks of LiDARs that are held, seconds.

    Attributes:
        late: LiDAR -> how late its stamps are against the motion data, and 1 sigma.
        apart: two LiDARs -> how much later the stamps of the second are, and 1 sigma. What the
            motion data have wrong is common to both.
    """

    late: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    apart: Mapping[tuple[str, str], tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def told(cls, names: Sequence[str], values: Array, cov: Array) -> Clocks:
        """Of values (n,) and covariance (n, n)."""
        sigmas = np.sqrt(np.diag(cov)).tolist()
        late = {n: (v, s) for n, v, s in zip(names, values.tolist(), sigmas, strict=True)}
        apart = {}
        for (i, one), (j, other) in itertools.combinations(enumerate(names), 2):
            variance = cov[i, i] + cov[j, j] - 2.0 * cov[i, j]
            apart[one, other] = float(values[j] - values[i]), math.sqrt(max(variance, 0.0))
        return cls(late, apart)


def told_of_jitters(
    H: Array, b: Array, layout: Layout, further: Further | None = None
) -> tuple[Array, Array]:
    """Information A (S, S) and gradient u (S,) of the jitters, everything else eliminated.

    Args:
        H: (R, R) of the first `layout.plane` coordinates, no prior of the jitters in it.
        b: (R,), or several gradients (R, g): u (S, g).
        layout: with jitters.
        further: coordinates that are kept as well, the last ones of A and u.
    """
    jitters = np.arange(layout.jitter, layout.plane)
    return marginal(H, b, jitters, np.arange(layout.jitter), further)


def told_clocks(A: Array, u: Array, scan_lidar: IntArray, lidars: int) -> tuple[Array, Array]:
    """How late the stamps of each LiDAR are, (n,) s, and covariance (n, n); by what jitters tell.

    A late clock is the same jitter in all scans of a LiDAR. What the extrinsic could make up for is
    eliminated: in a curve to the left and one to the right, at two speeds, it cannot. Under the
    prior of a time offset.
    """
    own = (scan_lidar[:, None] == np.arange(lidars)).astype(np.float64)
    cov = np.linalg.inv(own.T @ A @ own + np.eye(lidars) / OFFSET_SIGMA_S**2)
    return np.asarray(cov @ (own.T @ u)), np.asarray(cov)


def jitter_sigma_s(A: Array, u: Array) -> float:
    """1 sigma of the jitter, s; 0 where the data say nothing of one.

    u has the covariance `A + sigma^2 A A` with the information A of the jitters
    (`told_of_jitters`): exact REML, all other noise levels given.
    """
    values, vectors = np.linalg.eigh(A)
    seen = values > 1e-9 * max(float(values.max(initial=0.0)), MOST_JITTER_S**-2.0)
    told, square = values[seen], (vectors[:, seen].T @ u) ** 2
    sigmas = np.geomspace(LEAST_JITTER_S, MOST_JITTER_S, SIGMAS)
    variance = told + np.outer(sigmas**2, told**2)
    cost = 0.5 * (square / variance + np.log(variance)).sum(axis=1)
    without = 0.5 * float((square / told + np.log(told)).sum())
    best = int(cost.argmin()) if len(told) else 0
    return float(sigmas[best]) if len(told) and without - cost[best] > EVIDENCE else 0.0
