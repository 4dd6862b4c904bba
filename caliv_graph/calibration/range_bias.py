"""A bias of the ranges of each LiDAR on each target: eliminated, its size estimated.

The ranges of real LiDARs are off by some millimetres, by material, incidence and unit: the same for
all points of one LiDAR on one target, nearly, and so no noise that averages out. A bias b of LiDAR
a on target m moves all its clouds there along their mean beams. It is a nuisance with a normal
prior; the prior's sigma is estimated where targets and LiDARs contradict each other
(`caliv_graph/calibration/README.md`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import scipy.linalg
from scipy.optimize import minimize_scalar

from caliv_graph.calibration.linear import cloud_rows
from caliv_graph.calibration.reduced import Reduced
from caliv_graph.products import Array
from caliv_graph.registration.register import JointRegistration

TYPICAL_BIAS_M = 1e-3
"""Median of the prior of a bias's sigma. Data sheets state an accuracy of 10 to 30 mm over all
ranges and materials; two OS1-128 differ by 4.4 mm each on three boxes of one material."""

LOG_SPREAD = math.log(2.5)
"""1 sigma of its logarithm: 4.4 mm are 1.6 sigmas."""

EVIDENCE = 8.0
"""Logarithm of the ratio of likelihoods above which the sigma is not `TYPICAL_BIAS_M`: what a few
clouds on one target seem to say of biases is chance, and takes what they say of the mountings."""

LEAST_BIAS_M, LARGEST_BIAS_M = 1e-4, 0.05
"""Bounds of the sigma."""


def bias_directions(
    states: Sequence[JointRegistration], poses: Sequence[tuple[Array, Array]]
) -> Array:
    """(6 J, B) how the clouds' poses seem to move by a metre of bias of each LiDAR and placement.

    Left perturbations of `T_target_lidar` at the poses (J, 3, 3), (J, 3) of each placement.
    """
    blocks = []
    for state, (R, _) in zip(states, poses, strict=True):
        clouds = state.clouds
        beams = clouds.sum_per_cloud(clouds.rotated(R, clouds.beams)) / clouds.sizes[:, None]
        out = np.zeros((clouds.count, 6, clouds.lidars))
        out[np.arange(clouds.count), 3:, clouds.lidar] = beams
        blocks.append(out.reshape(6 * clouds.count, clouds.lidars))
    return np.asarray(scipy.linalg.block_diag(*blocks))


def without_bias(
    H: Array, gradient: Array, directions: Array, sigma_m: float
) -> tuple[Array, Array]:
    """(6 J, 6 J) and (6 J,) of the clouds with the biases of sigma `sigma_m` eliminated."""
    seen = H @ directions
    own = directions.T @ seen + np.eye(directions.shape[1]) / sigma_m**2
    factor = scipy.linalg.cho_factor(own, lower=True)
    pull = scipy.linalg.cho_solve(factor, directions.T @ gradient)
    return H - seen @ scipy.linalg.cho_solve(factor, seen.T), gradient - seen @ pull


def fit_bias_sigma(reduced: Reduced, directions: Array, prior: Array) -> float:
    """The sigma of the biases, metres, by restricted maximum likelihood with its prior.

    `TYPICAL_BIAS_M` if the data do not contradict that (`EVIDENCE`).

    Extrinsics, poses, targets and shape are integrated out: a bias that a mounting can make up for
    says nothing.

    Args:
        reduced: the linearised problem with the clouds' quadratic, no bias eliminated.
        directions: of `bias_directions`.
        prior: (6n, 6n) information of the guesses, tangents of the graph's extrinsics.
    """
    H, gradient = reduced.clouds
    system = reduced.system
    rows = cloud_rows(system, reduced.lines)
    seen = H @ directions
    across = rows.T @ seen
    full = system.H.copy()
    full[-len(prior) :, -len(prior) :] += prior
    full[np.diag_indices_from(full)] *= 1.0 + 1e-9
    factor = scipy.linalg.cho_factor(full, lower=True)
    information = directions.T @ seen - across.T @ scipy.linalg.cho_solve(factor, across)
    # Minus the gradient of the negative logarithm, what the other variables follow taken off.
    pull = -(directions.T @ gradient) - across.T @ scipy.linalg.cho_solve(factor, system.b)
    own, axes = np.linalg.eigh(0.5 * (information + information.T))
    own, pull = np.maximum(own, 0.0), axes.T @ pull

    def cost(logarithm: float) -> float:
        variance = math.exp(2.0 * logarithm)
        surprise = ((logarithm - math.log(TYPICAL_BIAS_M)) / LOG_SPREAD) ** 2
        fit = np.sum(np.log1p(variance * own) - pull**2 / (1.0 / variance + own))
        return 0.5 * (float(fit) + surprise)

    bounds = (math.log(LEAST_BIAS_M), math.log(LARGEST_BIAS_M))
    found = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-2})
    if cost(math.log(TYPICAL_BIAS_M)) - cost(float(found.x)) < EVIDENCE:
        return TYPICAL_BIAS_M
    return math.exp(float(found.x))
