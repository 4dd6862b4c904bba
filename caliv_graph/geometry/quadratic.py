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
    factor = scipy.linalg.cho_factor(np.eye(directions.shape[1]) + directions.T @ seen, lower=True)
    pulled = scipy.linalg.cho_solve(factor, directions.T @ gradient if pull is None else pull)
    return H - seen @ scipy.linalg.cho_solve(factor, seen.T), gradient - seen @ pulled
