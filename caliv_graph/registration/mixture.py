"""The mixture that a target is reconstructed as: seed, E-step, and M-step of the components.

GMMCalib's components are isotropic, and pull the front and back of a chair together, which two
LiDARs see 2 to 3 cm apart. So a component here has a normal, a variance along it and one across it,
and explains only points whose beam came from the side that its normal points to. `README.md` of
this folder derives the formulas; the M-step of the poses is in `quadratic`.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from caliv_graph.common.cores import parts, share_out
from caliv_graph.products import Array, IntArray, Mixture
from caliv_graph.registration.clouds import CloudStack, sampling_order
from caliv_graph.registration.moments import (
    MOMENTS,
    NORMALS,
    PRIOR_COUNT,
    SURFACE_MOMENTS,
    Responsibilities,
    cross,
    mass_and_means,
    scatter_about,
    to_target,
)

NEIGHBOURS = 6
"""Components that a point may belong to: the nearest. Farther ones have negligible density."""

NORMAL_METRES = 0.1
"""In the search for near components, opposite normals count as 2 x 0.1 m apart."""

NORMAL_CONCENTRATION = 4.0
"""Concentration of the agreement of normals in the likelihood (von Mises-Fisher, times flatness):
60 degrees between normals cost a factor of e^2."""

GRAZING = 0.05
"""Cosine between beam and surface at which visibility fades."""

STEEP = 0.1
"""Cosine between beam and surface below which the intersection of the two is damped: the normal is
not known well enough to compute it."""

REACH_SIGMAS = 3.0
"""Standard deviations of the noise along the beam that the intersection may be away from the point.
While poses are wrong by more than that, most points are farther away."""

PART_POINTS = 8192
"""Points of a part of the E-step: what belongs to them stays in the processor's cache."""

ALONG_SURFACE = 0.07
"""Factor on the information of residuals *along* the surface, 0 to 1. The sampling of a surface by
the beams differs from view to view: with factor 1 every cloud appears too near, which biases the
extrinsic of a sparse LiDAR by 5 mm. Edges and legs have real information along the surface: with
factor 0 three sparse LiDARs are 1 mm off, the other way."""

NORMAL_SIGMA_RAD = 0.2
"""Prior of a component's normal about the mean normal of its points, 1 sigma. Normals are blurred
near edges, and their noise is that of the same points."""

MAX_TURN_RAD = 0.2
"""Largest rotation of a component in one M-step beyond that to the mean normal of its points."""

POINTS_PER_COMPONENT = 10
"""Minimum number of points per component. Three points determine place and orientation, and what
the components use of the data the poses do not get."""


def seed_mixture(stack: CloudStack, R: Array, t: Array, components: int, sigma_m: float) -> Mixture:
    """The initial mixture of width `sigma_m`: components on points with reliable normals.

    Every cloud contributes the same number of points: a near cloud with many does not take all
    components. The draw does not depend on the poses `T_target_lidar`, rotations R (J, 3, 3) and
    translations t (J, 3). There are fewer `components` if there are few points
    (`POINTS_PER_COMPONENT`).
    """
    points = stack.moved(R, t)
    normals = stack.rotated(R, stack.normals)
    components = max(min(components, len(points) // POINTS_PER_COMPONENT), 1)
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


def information_weights(mixture: Mixture) -> tuple[Array, Array]:
    """(K,) a and b of `W = a n n^T + b I`, the weight of the residuals of a component's points."""
    along = ALONG_SURFACE / mixture.var_tangent
    return np.asarray(1.0 / mixture.var_normal - along), np.asarray(along)


class _Components:
    """The components for the E-step: means and normals (3, K); factors (K,) of the log-density.

    Components lie on surfaces: boxes halved in the middle fit them better than those halved in
    number, and the search in `tree` is a sixth faster.
    """

    def __init__(self, mixture: Mixture) -> None:
        places = np.column_stack([mixture.means_target, NORMAL_METRES * mixture.normals_target])
        self.tree = cKDTree(places, balanced_tree=False)
        self.neighbours = min(NEIGHBOURS, len(mixture.weights))
        self.log_peak = (
            np.log(mixture.weights)
            - 1.5 * np.log(2.0 * np.pi)
            - 0.5 * np.log(mixture.var_normal)
            - np.log(mixture.var_tangent)
        )
        self.above = -0.5 / mixture.var_normal
        self.aside = -0.5 / mixture.var_tangent
        self.means = mixture.means_target.T.copy()
        self.normals = mixture.normals_target.T.copy()

    def densities(
        self, points: Array, normals: Array, beams: Array, flatness: Array, reach_m: float
    ) -> tuple[IntArray, Array, Array, Array]:
        """(n, k) near components; densities; heights above, slides along beams to their surfaces.

        The distance along the surface is measured where the point's beam meets the component's
        plane: the noise along the beam does not choose the component (`README.md`).
        """
        k = self.neighbours
        _, found = self.tree.query(np.column_stack([points, NORMAL_METRES * normals]), k)
        found = np.reshape(found, (-1, k))
        height, all2, agreement, facing, depth = (np.zeros(found.shape) for _ in range(5))
        for axis in range(3):
            n = self.normals[axis][found]
            offset = points[:, axis, None] - self.means[axis][found]
            height += offset * n
            all2 += offset * offset
            agreement += n * normals[:, axis, None]
            facing -= n * beams[:, axis, None]
            depth += offset * beams[:, axis, None]
        # From the point along its beam to the surface, damped where the beam grazes it.
        slide = height * np.maximum(facing, 0.0) / np.maximum(facing, STEEP) ** 2
        slide = np.clip(slide, -reach_m, reach_m)
        aside2 = all2 + slide * (2.0 * depth + slide) - (height - facing * slide) ** 2
        log_density = self.log_peak[found]
        log_density += self.above[found] * height**2
        log_density += self.aside[found] * np.maximum(aside2, 0.0)
        log_density += NORMAL_CONCENTRATION * flatness[:, None] * (agreement - 1.0)
        visible = np.clip((facing + GRAZING) / (2.0 * GRAZING), 1e-3, 1.0)
        return found, np.exp(log_density) * visible, height, slide


def expect(
    stack: CloudStack,
    R: Array,
    t: Array,
    mixture: Mixture,
    outlier_density: float,
    cloud_weights: Array,
) -> Responsibilities:
    """E-step: responsibilities of the nearest components (GMMCalib's, with oriented components).

    The lever of a residual in the gradient ends where the beam meets the surface, not at the noisy
    point, whose lever is correlated with its residual.

    Args:
        stack: the clouds.
        R: (J, 3, 3) rotations of current `T_target_lidar`.
        t: (J, 3) translations of it.
        mixture: the current components.
        outlier_density: gamma / (h (gamma + 1)) with h the volume of the region, per cubic metre.
        cloud_weights: (J,) weight of each cloud: robust weight times view weight.
    """
    components = _Components(mixture)
    near = np.empty((len(stack.points), components.neighbours), dtype=np.int64)
    alpha = np.empty(near.shape)
    forces, directions = np.empty(alpha.shape), np.empty(stack.points.shape)
    levers, slides = np.empty(stack.points.shape), np.empty(len(stack.points))
    a, _ = information_weights(mixture)

    def of_part(part: slice) -> None:
        cloud = stack.cloud[part]
        rotation = R[cloud]
        points = np.einsum("nij,nj->ni", rotation, stack.points[part]) + t[cloud]
        normals = np.einsum("nij,nj->ni", rotation, stack.normals[part])
        beams = np.einsum("nij,nj->ni", rotation, stack.beams[part])
        found, density, height, slide = components.densities(
            points, normals, beams, stack.flatness[part], REACH_SIGMAS * stack.sigma_range_m
        )
        inliers = density.sum(axis=1)
        slides[part] = np.einsum("nk,nk->n", density, slide) / np.maximum(inliers, 1e-300)
        density /= inliers[:, None] + outlier_density
        near[part], alpha[part] = found, density
        force = density * a[found] * height * slide * cloud_weights[cloud][:, None]
        summed = [np.einsum("nk,nk->n", force, n[found]) for n in components.normals]
        levers[part] = cross(beams, np.column_stack(summed))
        forces[part], directions[part] = force, beams

    # Parts are independent: the result is the same on any number of cores.
    share_out(of_part, parts(len(near), len(near) // PART_POINTS + 1))
    moved = [(forces * direction[:, None]).ravel() for direction in directions.T]
    on_components = [np.bincount(near.ravel(), m, len(mixture.weights)) for m in moved]
    return Responsibilities(
        component=near,
        alpha=alpha * cloud_weights[stack.cloud][:, None],
        inlier_ratio=stack.sum_per_cloud(alpha.sum(axis=1)) / stack.sizes,
        levers=stack.sum_per_cloud(levers),
        component_levers=cross(np.column_stack(on_components), mixture.normals_target),
        slides_m=slides,
    )


def maximise_shape(
    stack: CloudStack,
    R: Array,
    t: Array,
    mixture: Mixture,
    sigma_floor_m: float,
    cells: Array,
    orientation_information: Array,
    torque: Array,
) -> Mixture:
    """M-step of the components at new poses: means, normals, variances, priors.

    A normal is estimated from the heights of the points along their beams, with the mean normal of
    the points as a prior.

    Args:
        stack: the clouds.
        R: (J, 3, 3) rotations of the new `T_target_lidar`.
        t: (J, 3) translations of it.
        mixture: the components of the E-step.
        sigma_floor_m: smallest standard deviation; annealed from coarse to the noise level.
        cells: (J, K, 23) `cell_moments` of its responsibilities.
        orientation_information: (K, 3, 3) of the quadratic of the E-step.
        torque: (K, 3) of it.
    """
    carry = to_target(stack, R, t)
    moments = np.matmul(cells[..., MOMENTS], carry).sum(axis=0)
    mass, means = mass_and_means(moments, mixture)
    summed = np.matmul(cells[..., NORMALS], np.swapaxes(R, 1, 2)).sum(axis=0)
    normals = PRIOR_COUNT * mixture.normals_target + summed
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    normals = _updated_normals(mixture.normals_target, normals, orientation_information, torque)
    scatter = scatter_about(moments, means)
    along2 = np.einsum("ka,kab,kb->k", normals, scatter, normals)
    # Along the surface the noise of a slanted beam would make a component wider.
    on_surface = np.matmul(cells[..., SURFACE_MOMENTS], carry).sum(axis=0)
    scatter = scatter_about(on_surface, mass_and_means(on_surface, mixture)[1])
    aside2 = np.trace(scatter, axis1=1, axis2=2) - np.einsum(
        "ka,kab,kb->k", normals, scatter, normals
    )
    floor = sigma_floor_m**2
    return Mixture(
        means_target=means,
        normals_target=normals,
        var_normal=np.maximum(along2 / mass, floor),
        var_tangent=np.maximum(aside2 / (2.0 * mass), floor),
        weights=mass / mass.sum(),
    )


def _updated_normals(
    normals: Array, prior: Array, orientation_information: Array, torque: Array
) -> Array:
    """(K, 3) normals at their maximum a posteriori."""
    axis = cross(normals, prior)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, np.einsum("ka,ka->k", normals, prior))
    rotation = axis * (angle / np.maximum(sine, 1e-300))[:, None]
    residual = torque - np.einsum("kab,kb->ka", orientation_information, rotation)
    more = np.linalg.solve(
        orientation_information + np.eye(3) / NORMAL_SIGMA_RAD**2, residual[..., None]
    )[..., 0]
    size = np.linalg.norm(more, axis=1)
    rotation += more * np.minimum(1.0, MAX_TURN_RAD / np.maximum(size, 1e-300))[:, None]
    rotated = Rotation.from_rotvec(rotation).apply(normals)
    return np.asarray(rotated / np.linalg.norm(rotated, axis=1)[:, None])
