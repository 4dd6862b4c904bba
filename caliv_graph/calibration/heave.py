"""The heave of the body on its springs, added to a Gaussian on the poses of a smoother."""

from __future__ import annotations

import numpy as np

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.chain import POSE

HEAVE_TIME_S = 0.1
"""Time over which the correlation of the heave falls to none, evenly: heave is white from scan to
scan at 10 Hz, and common to LiDARs whose stamps are milliseconds apart. A body on its springs moves
at 1 to 2 Hz, hence more slowly: its heave is correlated over more than this."""


def heave_covariance(stamps_ns: IntArray, heave_m: float) -> Array:
    """(m, m) of the heave at m stamps, m^2: a triangle of `HEAVE_TIME_S` over time."""
    seconds = (stamps_ns - stamps_ns[:1]) / NANOSECONDS_PER_SECOND
    apart = np.abs(seconds[:, None] - seconds) / HEAVE_TIME_S
    return np.asarray(heave_m**2 * np.maximum(1.0 - apart, 0.0))


def with_heave(
    information: Array, gradient: Array, stamps_ns: IntArray, heave_m: float
) -> tuple[Array, Array]:
    """A Gaussian on poses and what follows them, with the heave at each pose.

    The heave moves a pose along the vehicle's z; it is eliminated here (Woodbury): a matrix of the
    size of the heights is inverted, not one of all coordinates.

    Args:
        information: (6 m + p, 6 m + p), right perturbations of m poses first.
        gradient: (6 m + p,).
        stamps_ns: (m,) of the poses.
        heave_m: 1 sigma.
    """
    m = len(stamps_ns)
    z = np.arange(5, POSE * m, POSE)
    # (C^-1 + W)^-1 = C (I + W C)^-1: the heave at two stamps may be all but the same.
    heights = np.eye(m) + information[np.ix_(z, z)] @ heave_covariance(stamps_ns, heave_m)
    known = np.linalg.solve(heights, np.column_stack([information[z], gradient[z]]))
    known = heave_covariance(stamps_ns, heave_m) @ known
    out = information - information[:, z] @ known[:, :-1]
    return 0.5 * (out + out.T), gradient - information[:, z] @ known[:, -1]


def poses_with_heave(information: Array, stamps_ns: IntArray, heave_m: float) -> Array:
    """`with_heave` of a Gaussian (6 m, 6 m) on poses alone."""
    return with_heave(information, np.zeros(len(information)), stamps_ns, heave_m)[0]
