"""Jitter of stamps: a time error of its own of each scan, common to all that the scan sees.

All strips of a scan move together along the vehicle's motion: an error of a stamp, or of the
deskewing, which no offset of a strip explains. Its sigma is estimated (REML); where the data say
that there is none, no variable is added.
"""

from __future__ import annotations

import numpy as np

from caliv_graph.products import Array
from caliv_graph.structure.elimination import marginal
from caliv_graph.structure.layout import Layout
from caliv_graph.structure.noise import LEAST_JITTER_S, MOST_JITTER_S

EVIDENCE = 3.0
"""Gain of the log-likelihood from which stamps are taken to jitter: chance gains as much in one of
a hundred drives, and a needless jitter costs little."""

SIGMAS = 200
"""Sigmas that are tried, evenly spread in the logarithm: 4 percent apart."""


def jitter_sigma_s(H: Array, b: Array, layout: Layout) -> float:
    """1 sigma of the jitter, s; 0 where the data say nothing of one.

    Everything but the jitter is eliminated, which leaves u of covariance `A + sigma^2 A A` with the
    information A of the jitters: exact REML, all other noise levels given.

    Args:
        H: (R, R) of the first `layout.plane` coordinates, no prior of the jitters in it.
        b: (R,).
        layout: with jitters.
    """
    own = np.arange(layout.jitter, layout.plane)
    rest = np.arange(layout.jitter)
    A, u = marginal(H, b, own, rest)
    values, vectors = np.linalg.eigh(A)
    seen = values > 1e-9 * max(float(values.max(initial=0.0)), MOST_JITTER_S**-2.0)
    told, square = values[seen], (vectors[:, seen].T @ u) ** 2
    sigmas = np.geomspace(LEAST_JITTER_S, MOST_JITTER_S, SIGMAS)
    variance = told + np.outer(sigmas**2, told**2)
    cost = 0.5 * (square / variance + np.log(variance)).sum(axis=1)
    without = 0.5 * float((square / told + np.log(told)).sum())
    best = int(cost.argmin()) if len(told) else 0
    return float(sigmas[best]) if len(told) and without - cost[best] > EVIDENCE else 0.0
