"""Quadratics on tangents, as which Gaussian likelihoods are added up."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from caliv_graph.products import Array


def without_errors(
    H: Array, gradient: Array, directions: Array, pull: Array | None = None
) -> tuple[Array, Array]:
    """A quadratic (n, n) and (n,) in `d` as one in `d + directions e`, e of sigma 1 eliminated.

    `directions` (n, k); `pull` (k,) is the gradient in e; None: that at no errors.
    """
    seen = H @ directions
    known = np.eye(directions.shape[1]) + directions.T @ seen
    root = scipy.linalg.cholesky(known, lower=True)
    taken = scipy.linalg.solve_triangular(root, seen.T, lower=True)
    pull = directions.T @ gradient if pull is None else pull
    pulled = scipy.linalg.solve_triangular(root, pull, lower=True)
    # A matrix by its own transpose is half the work.
    return H - taken.T @ taken, gradient - taken.T @ pulled
