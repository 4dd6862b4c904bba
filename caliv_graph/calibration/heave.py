"""The heave of the body on its springs, added to a Gaussian on the poses of a smoother."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from caliv_graph.products import Array
from caliv_graph.trajectory.chain import POSE


def with_heave(
    information: Array, gradient: Array, poses: int, heave_m: float
) -> tuple[Array, Array]:
    """A Gaussian on poses and what follows them, with a heave of its own at each pose.

    The heave moves a pose along the vehicle's z; it is a white variable, eliminated here
    (Woodbury): a matrix of the size of the heights is inverted, not one of all coordinates.

    Args:
        information: (6 m + p, 6 m + p), right perturbations of m poses first.
        gradient: (6 m + p,).
        poses: m.
        heave_m: 1 sigma.
    """
    z = np.arange(5, POSE * poses, POSE)
    heights = information[np.ix_(z, z)] + np.eye(poses) / heave_m**2
    half = scipy.linalg.solve_triangular(
        np.linalg.cholesky(heights), np.column_stack([information[z], gradient[z]]), lower=True
    )
    known = half[:, :-1].T @ half[:, :-1]
    return information - known, gradient - half[:, :-1].T @ half[:, -1]


def poses_with_heave(information: Array, heave_m: float) -> Array:
    """`with_heave` of a Gaussian (6 m, 6 m) on poses alone."""
    return with_heave(information, np.zeros(len(information)), len(information) // POSE, heave_m)[0]
