"""The mixture that a target is reconstructed as: E-step, and the quadratic that it puts on poses.

GMMCalib (Evangelidis & Horaud 2018 behind it) has isotropic components. A chair is seen from its
front by one LiDAR and from its back by another, 2 to 3 cm apart; isotropic components pull the two
skins together, which on the CaLiV authors' drive is 36 mrad of roll between the LiDARs. So a
component here has a normal, a variance along it and one across it, and explains only points whose
beam came from the side that its normal points to. With equal variances and no normals the formulas
are those of SPEC 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import blas
from scipy.spatial import cKDTree

from caliv_graph.geometry.se3 import skew
from caliv_graph.products import Array, IntArray, Mixture
from caliv_graph.registration.clouds import CloudStack, sampling_order

NEIGHBOURS = 6
"""Components that a point may belong to: the nearest. Farther ones have no weight to speak of."""

NORMAL_METRES = 0.1
"""In the search for near components, normals that are opposite count as 2 x 0.1 m apart."""

NORMAL_CONCENTRATION = 4.0
"""Exponent of the agreement of normals: 60 degrees cost a factor of e^2."""

GRAZING = 0.05
"""Cosine between beam and surface at which visibility fades."""

SEARCH_THREADS = 2
"""Threads of the neighbour search, the one part of the E-step that is worth sharing out."""

ALONG_SURFACE = 0.1
"""Part of what a point's position *along* the surface seems to say that is believed. Components
are pieces of a surface, and how the beams fell on them differs from view to view: a LiDAR sees more
of the side of a piece that is turned to it, so that with all of it every cloud seems to be too
near, by 5 mm of a sparse LiDAR's mounting, with a precision that is not there. Edges and legs do
say something, and normals there lean to the sensor: without any of it an exact arc is off by 6 mm.
"""

PRIOR_COUNT = 1e-6
"""Points' worth of weight that keeps an abandoned component defined."""


@dataclass(frozen=True)
class Responsibilities:
    """Which components explain which points.

    Attributes:
        component: (N, k) indices of components.
        alpha: (N, k) responsibilities times the weight of the point's cloud; the rest of each row
            belongs to the outlier class.
        inlier_ratio: (J,) part of each cloud's points that components explain.
    """

    component: IntArray
    alpha: Array
    inlier_ratio: Array


@dataclass(frozen=True)
class ShapeQuadratic:
    """What the points say about the poses of all clouds, with the shape estimated from them.

    As a function of left perturbations `Exp(d_j) T_target_lidar_j` (target frame; rotation then
    translation) the negative log-likelihood is `d^T H d / 2 + g^T d`, where H is `blocks` on the
    diagonal minus `coupling^T coupling`: the means of the components are eliminated, since they
    come from the same points. `blocks` alone, per-cloud information given the shape, claims more.

    Attributes:
        blocks: (J, 6, 6).
        gradient: (J, 6).
        coupling: (3 K, 6 J).
    """

    blocks: Array
    gradient: Array
    coupling: Array

    def joint(self) -> Array:
        """H, (6 J, 6 J), symmetric positive semidefinite."""
        size = self.coupling.shape[1]
        # Transposed, its memory is in the order that BLAS wants; only a triangle comes back.
        upper = blas.dsyrk(-1.0, self.coupling.T)
        H = upper + upper.T
        diagonal = np.arange(size)
        H[diagonal, diagonal] *= 0.5
        H4 = H.reshape(size // 6, 6, size // 6, 6)
        j = np.arange(size // 6)
        H4[j, :, j, :] += self.blocks
        return np.asarray(H)


def seed_mixture(stack: CloudStack, R: Array, t: Array, components: int, sigma_m: float) -> Mixture:
    """A first mixture: components on points drawn where normals can be trusted.

    Every cloud gives the same number of points, so that a near cloud with many does not take all
    components. Which points are drawn does not depend on the poses (`sampling_order`).

    Args:
        stack: the clouds.
        R: (J, 3, 3) rotations of current `T_target_lidar`.
        t: (J, 3) translations of current `T_target_lidar`.
        components: how many; fewer if there are fewer points.
        sigma_m: first standard deviation along and across the normal.
    """
    points = stack.moved(R, t)
    normals = stack.rotated(R, stack.normals)
    usable = np.flatnonzero(stack.flatness > 0.5)
    if len(usable) < 2 * components:
        usable = np.arange(len(points))
    order = usable[np.argsort(sampling_order(stack.points[usable]))]
    # The rank of each point in its own cloud: all first ones, then all second ones, ...
    cloud = stack.cloud[order]
    by_cloud = np.argsort(cloud, kind="stable")
    starts = np.searchsorted(cloud[by_cloud], cloud[by_cloud], side="left")
    rank = np.empty(len(order), dtype=np.int64)
    rank[by_cloud] = np.arange(len(order)) - starts
    chosen = order[np.argsort(rank, kind="stable")[:components]]
    count = len(chosen)
    return Mixture(
        means_target=points[chosen].copy(),
        normals_target=normals[chosen].copy(),
        var_normal=np.full(count, sigma_m**2),
        var_tangent=np.full(count, sigma_m**2),
        weights=np.full(count, 1.0 / count),
    )


def expect(
    stack: CloudStack,
    R: Array,
    t: Array,
    mixture: Mixture,
    outlier_density: float,
    cloud_weights: Array,
) -> Responsibilities:
    """E-step: the responsibilities of SPEC 3, of the nearest components only.

    Args:
        stack: the clouds.
        R: (J, 3, 3) rotations of current `T_target_lidar`.
        t: (J, 3) translations of current `T_target_lidar`.
        mixture: the current components.
        outlier_density: gamma / (h (gamma + 1)), per cubic metre.
        cloud_weights: (J,) robust weight of each cloud.
    """
    points = stack.moved(R, t)
    normals = stack.rotated(R, stack.normals)
    beams = stack.rotated(R, stack.beams)
    k = min(NEIGHBOURS, len(mixture.weights))
    tree = cKDTree(np.column_stack([mixture.means_target, NORMAL_METRES * mixture.normals_target]))
    _, near = tree.query(
        np.column_stack([points, NORMAL_METRES * normals]), k, workers=SEARCH_THREADS
    )
    near = near.reshape(len(points), k)
    n_k = mixture.normals_target[near]
    offset = points[:, None] - mixture.means_target[near]
    along = np.einsum("nki,nki->nk", offset, n_k)
    across2 = np.maximum(np.einsum("nki,nki->nk", offset, offset) - along**2, 0.0)
    var_n, var_t = mixture.var_normal[near], mixture.var_tangent[near]
    agreement = np.einsum("nki,ni->nk", n_k, normals)
    facing = -np.einsum("nki,ni->nk", n_k, beams)
    log_alpha = (
        np.log(mixture.weights[near])
        - 1.5 * np.log(2.0 * np.pi)
        - 0.5 * np.log(var_n)
        - np.log(var_t)
        - 0.5 * along**2 / var_n
        - 0.5 * across2 / var_t
        + NORMAL_CONCENTRATION * stack.flatness[:, None] * (agreement - 1.0)
    )
    visible = np.clip((facing + GRAZING) / (2.0 * GRAZING), 1e-3, 1.0)
    alpha = np.exp(log_alpha) * visible
    alpha /= alpha.sum(axis=1, keepdims=True) + outlier_density
    inlier = stack.sum_per_cloud(alpha.sum(axis=1)) / np.diff(
        np.append(stack.starts, len(stack.points))
    )
    return Responsibilities(near, alpha * cloud_weights[stack.cloud][:, None], inlier)


def component_means(points: Array, who: Responsibilities, before: Array) -> tuple[Array, Array]:
    """Weighted means of the points of each component (K, 3), and their weights (K,).

    Args:
        points: (N, 3) in the target frame.
        who: responsibilities of the components for them.
        before: (K, 3) means that components without points keep.
    """
    components = len(before)
    flat = who.component.ravel()
    mass = np.asarray(np.bincount(flat, who.alpha.ravel(), components) + PRIOR_COUNT, np.float64)
    sums = [
        np.bincount(flat, (who.alpha * points[:, None, axis]).ravel(), components)
        for axis in range(3)
    ]
    means = (np.stack(sums, axis=1) + PRIOR_COUNT * before) / mass[:, None]
    return np.asarray(means, np.float64), mass


def shape_quadratic(
    stack: CloudStack, R: Array, t: Array, mixture: Mixture, who: Responsibilities
) -> ShapeQuadratic:
    """The quadratic of `ShapeQuadratic` at the current poses, means eliminated.

    A point y of cloud j contributes `alpha (y - mu)^T W (y - mu)`, with `dy = [-skew(y), I] d_j`
    and `W = n n^T / var_normal + ALONG_SURFACE (I - n n^T) / var_tangent` of its component.
    """
    count, K = stack.count, len(mixture.weights)
    points = stack.moved(R, t)
    means, mass = component_means(points, who, mixture.means_target)
    near, alpha = who.component, who.alpha
    n_k = mixture.normals_target[near]
    w_t = ALONG_SURFACE * alpha / mixture.var_tangent[near]
    w_n = alpha / mixture.var_normal[near] - w_t
    rows = np.empty((*near.shape, 6))
    rows[..., :3] = _cross(points[:, None], n_k)
    rows[..., 3:] = n_k
    weighted = w_n[..., None] * rows
    offset = points[:, None] - means[near]
    along = np.einsum("nki,nki->nk", offset, n_k)
    even = np.einsum("nk,nki->ni", w_t, offset)
    pull = np.einsum("nk,nka->na", along, weighted)
    pull += np.concatenate([_cross(points, even), even], axis=1)
    gradient = stack.sum_per_cloud(pull)
    blocks = _even_blocks(stack, points, w_t.sum(axis=1))
    ends = np.append(stack.starts[1:], len(points))
    for j, (start, end) in enumerate(zip(stack.starts, ends, strict=True)):
        blocks[j] += weighted[start:end].reshape(-1, 6).T @ rows[start:end].reshape(-1, 6)

    # Sums of alpha and alpha * y per cloud and component: what the component means depend on.
    cell = (stack.cloud[:, None] * K + near).ravel()
    mass_jk = np.bincount(cell, alpha.ravel(), count * K).reshape(count, K)
    sums = [
        np.bincount(cell, (alpha * points[:, None, axis]).ravel(), count * K) for axis in range(3)
    ]
    sum_jk = np.stack(sums, axis=-1, dtype=np.float64).reshape(count, K, 3)
    n = mixture.normals_target
    root_t = (ALONG_SURFACE / mixture.var_tangent) ** 0.5
    root = (mixture.var_normal**-0.5 - root_t)[:, None, None] * (n[:, :, None] * n[:, None, :])
    diagonal = np.arange(3)
    root[:, diagonal, diagonal] += root_t[:, None]
    root /= np.sqrt(mass)[:, None, None]
    coupling = np.empty((K, 3, count, 6))
    for i in range(3):
        coupling[:, i, :, :3] = _cross(sum_jk, root[:, i]).transpose(1, 0, 2)
        coupling[:, i, :, 3:] = mass_jk.T[..., None] * root[:, i, None]
    return ShapeQuadratic(blocks, gradient, coupling.reshape(3 * K, 6 * count))


def _even_blocks(stack: CloudStack, points: Array, weight: Array) -> Array:
    """(J, 6, 6) sums of `weight J^T J`, J = [-skew(y), I], over the points (N, 3) of each cloud."""
    first = stack.sum_per_cloud(weight[:, None] * points)
    second = stack.sum_per_cloud((weight[:, None] * points)[:, :, None] * points[:, None])
    out = np.zeros((stack.count, 6, 6))
    identity = np.eye(3)
    trace = np.trace(second, axis1=1, axis2=2)[:, None, None]
    out[:, :3, :3] = trace * identity - second
    out[:, 3:, 3:] = stack.sum_per_cloud(weight)[:, None, None] * identity
    out[:, :3, 3:] = skew(first)
    out[:, 3:, :3] = np.swapaxes(skew(first), 1, 2)
    return out


def _cross(a: Array, b: Array) -> Array:
    """Cross products of (..., 3); numpy's own takes several times as long."""
    return np.stack(
        [
            a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
            a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
            a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
        ],
        axis=-1,
    )


def maximise_shape(
    stack: CloudStack,
    R: Array,
    t: Array,
    mixture: Mixture,
    who: Responsibilities,
    sigma_floor_m: float,
) -> Mixture:
    """M-step of the components at new poses: means, normals, variances, priors.

    Args:
        stack: the clouds.
        R: (J, 3, 3) rotations of the new `T_target_lidar`.
        t: (J, 3) translations of the new `T_target_lidar`.
        mixture: the components of the E-step.
        who: its responsibilities.
        sigma_floor_m: smallest standard deviation; annealed from coarse to the noise level.
    """
    K = len(mixture.weights)
    points = stack.moved(R, t)
    means, mass = component_means(points, who, mixture.means_target)
    flat = who.component.ravel()
    trusted = who.alpha * stack.flatness[:, None]
    rotated = stack.rotated(R, stack.normals)
    normals = PRIOR_COUNT * mixture.normals_target + np.stack(
        [np.bincount(flat, (trusted * rotated[:, None, axis]).ravel(), K) for axis in range(3)],
        axis=1,
    )
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
    offset = points[:, None] - means[who.component]
    along2 = np.einsum("nki,nki->nk", offset, normals[who.component]) ** 2
    all2 = np.einsum("nki,nki->nk", offset, offset)
    floor = sigma_floor_m**2
    var_n = np.bincount(flat, (who.alpha * along2).ravel(), K) / mass
    var_t = np.bincount(flat, (who.alpha * (all2 - along2)).ravel(), K) / (2.0 * mass)
    return Mixture(
        means_target=means,
        normals_target=normals,
        var_normal=np.maximum(var_n, floor),
        var_tangent=np.maximum(var_t, floor),
        weights=mass / mass.sum(),
    )
