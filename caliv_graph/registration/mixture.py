"""The surfels that a target is reconstructed as: seed, E-step, and M-step of the surfels.

What a beam measures of the shape (`README.md` of this folder): it meets the planes of the surfels
near it; it returns from one that faces it and lies there, and the range is the distance to it, with
noise along the beam. GMMCalib's components are isotropic, and pull the front and back of a chair
together, which two LiDARs see 2 to 3 cm apart. The M-step of the poses is in `quadratic`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from caliv_graph.common.cores import parts, shared_map
from caliv_graph.geometry.se3 import cross
from caliv_graph.products import Array, BoolArray, IntArray, Mixture
from caliv_graph.registration.clouds import CloudStack, sampling_order
from caliv_graph.registration.heights import HeightNoise, HeightSums
from caliv_graph.registration.moments import (
    MOMENTS,
    SURFACE_MOMENTS,
    Responsibilities,
    mass_and_means,
    scatter_about,
    to_target,
)
from caliv_graph.registration.surfels import STEEP, Surfels

REACH_SIGMAS = 3.0
"""Standard deviations of the noise along the beam that the intersection may be away from the point.
While poses are wrong by more than that, most points are farther away."""

LEAST_EXTENT_M = 0.006
"""Smallest width of a surfel, 1 sigma: half of the thinnest part that is worth one."""

PART_POINTS = 8192
"""Points of a part of the E-step: what belongs to them stays in the processor's cache."""

MAX_TURN_RAD = 0.2
"""Largest rotation of a surfel in one M-step."""

POINTS_PER_COMPONENT = 10
"""Minimum number of points per surfel. Three points determine place and orientation, and what
the surfels use of the data the poses do not get."""


SEED_FLATNESS = 0.5
"""Reliability of a point's normal from which on a surfel may begin there."""


def seed_mixture(
    stack: CloudStack,
    R: Array,
    t: Array,
    components: int,
    sigma_m: float,
    distinct: float | None = None,
    trusted: BoolArray | None = None,
    everywhere: bool = False,
    draw: int = 0,
) -> Mixture:
    """The initial mixture of width `sigma_m`: components on points with reliable normals.

    Every cloud contributes the same number of points: a near cloud with many does not take all
    components. The draw does not depend on the poses `T_target_lidar`, rotations R (J, 3, 3) and
    translations t (J, 3). There are fewer `components` if few points are `distinct`
    (`POINTS_PER_COMPONENT`): those of scans of one view count as one. None: all are. Clouds (J,)
    that are not `trusted` get no surfels: a cloud in the wrong place would explain itself.
    `everywhere`: on points whose normals are not reliable as well, as on thin parts. Each `draw`
    takes others, as far as there are some.
    """
    distinct = len(stack.points) if distinct is None else distinct
    points = stack.moved(R, t)
    normals = stack.rotated(R, stack.normals)
    components = max(min(components, int(distinct) // POINTS_PER_COMPONENT), 1)
    allowed = np.ones(len(points), bool) if trusted is None else trusted[stack.cloud]
    usable = np.flatnonzero(allowed & (everywhere | (stack.flatness > SEED_FLATNESS)))
    if len(usable) < 2 * components:
        usable = np.flatnonzero(allowed)
    order = usable[np.argsort(sampling_order(stack.points[usable]))]
    # The rank of each point in its own cloud: all first ones, then all second ones, ...
    cloud = stack.cloud[order]
    by_cloud = np.argsort(cloud, kind="stable")
    starts = np.searchsorted(cloud[by_cloud], cloud[by_cloud], side="left")
    rank = np.empty(len(order), dtype=np.int64)
    rank[by_cloud] = np.arange(len(order)) - starts
    chosen = np.roll(order[np.argsort(rank, kind="stable")], -draw * components)[:components]
    count = len(chosen)
    return Mixture(
        means_target=points[chosen].copy(),
        normals_target=normals[chosen].copy(),
        var_tangent=np.maximum(_half_apart(points[chosen]), max(sigma_m, LEAST_EXTENT_M)) ** 2,
        weights=np.full(count, 1.0 / count),
    )


def _half_apart(places: Array) -> Array:
    """(K,) half the distance of each of (K, 3) places to its third neighbour: they tile a face."""
    if len(places) < 4:
        return np.zeros(len(places))
    return np.asarray(0.5 * np.asarray(cKDTree(places).query(places, 4)[0])[:, 3])


def expect(
    stack: CloudStack,
    R: Array,
    t: Array,
    mixture: Mixture,
    noise: HeightNoise,
    outlier_density: float,
    cloud_weights: Array,
    held_along: float = 0.0,
    by_beams: bool = False,
    near: IntArray | None = None,
) -> Responsibilities:
    """E-step: which surfel each beam returned from, and the weights of the points' heights.

    Args:
        stack: the clouds.
        R: (J, 3, 3) rotations of current `T_target_lidar`.
        t: (J, 3) translations of it.
        mixture: the current surfels.
        noise: of the heights of points over the surface.
        outlier_density: of outliers along a beam, per metre.
        cloud_weights: (J,) weight of each cloud: robust weight times view weight.
        held_along: weight of what holds points along the surface, per square metre; 0: nothing.
        by_beams: poses and surfels are right to some millimetres, so that the beam tells which
            surfel it met. Until then the normals of the points do.
        near: (N, k) the surfels of each point that are looked at, by an earlier E-step
            (`Responsibilities.component`); None: searched for.
    """
    step = _EStep(stack, mixture, noise, outlier_density, cloud_weights, held_along, by_beams, near)
    points = stack.moved(R, t)
    normals, beams = stack.rotated(R, stack.normals), stack.rotated(R, stack.beams)
    pieces = parts(len(points), len(points) // PART_POINTS + 1)

    def of_part(part: slice) -> _Expected:
        return step.of(part, points[part], normals[part], beams[part])

    # Parts are independent: the result is the same on any number of cores.
    done = shared_map(of_part, pieces)
    counts, *moments = np.sum([part.on_surfels for part in done], axis=0)
    explained = np.concatenate([part.explained for part in done])
    along = [part.weight_along for part in done if part.weight_along is not None]
    return Responsibilities(
        component=np.concatenate([part.component for part in done]),
        weight=np.concatenate([part.weight for part in done]),
        weight_along=np.concatenate(along) if along else None,
        counts=np.asarray(counts),
        explained=explained,
        inlier_ratio=stack.sum_per_cloud(explained) / stack.sizes,
        levers=stack.sum_per_cloud(np.concatenate([part.levers for part in done])),
        component_levers=cross(np.column_stack(moments), mixture.normals_target),
        slides_m=np.concatenate([part.slides_m for part in done]),
        heights=HeightSums.total([part.heights for part in done]),
    )


@dataclass(frozen=True)
class _Expected:
    """`Responsibilities` of n points; `levers` (n, 3) of each, `on_surfels` (4, K) sums.

    These are the points of each surfel, and what their beams pull it with, an axis each.
    """

    component: IntArray
    weight: Array
    weight_along: Array | None
    explained: Array
    levers: Array
    slides_m: Array
    on_surfels: Array
    heights: HeightSums


@dataclass(frozen=True)
class _EStep:
    """What the points of an E-step share; arguments of `expect`."""

    stack: CloudStack
    mixture: Mixture
    noise: HeightNoise
    outlier_density: float
    cloud_weights: Array
    held_along: float
    by_beams: bool
    near: IntArray | None = None

    @cached_property
    def _surfels(self) -> Surfels:
        return Surfels(self.mixture)

    def of(self, part: slice, points: Array, normals: Array, beams: Array) -> _Expected:
        """The points of a slice of the stack, at places, normals and beams (n, 3)."""
        noise, components = self.noise, len(self.mixture.weights)
        cloud = self.stack.cloud[part]
        lidar, cloud_weight = self.stack.lidar[cloud], self.cloud_weights[cloud]
        reach_m = REACH_SIGMAS * noise.largest_m()
        met = self._surfels.met_by(
            points,
            normals,
            beams,
            self.stack.flatness[part],
            reach_m,
            cloud if self.by_beams else None,
            None if self.near is None else self.near[part],
        )
        cosine = np.maximum(met.facing, STEEP)
        variance = noise.variance(cosine, lidar)
        # The range is what is measured: a density per metre along the beam.
        density = met.presence * np.exp(-0.5 * met.height**2 / variance)
        density *= cosine / np.sqrt(2.0 * np.pi * variance)
        inliers = density.sum(axis=0)
        slides_m = (density * met.slide).sum(axis=0) / np.maximum(inliers, 1e-300)
        density /= inliers + self.outlier_density
        weight = density / variance
        heights = HeightSums.of(
            density, weight, met.height, cosine, variance, cloud_weight, lidar, len(noise.range_m2)
        )
        weight *= cloud_weight
        force = weight * met.height * met.slide
        pull = [(force * n).sum(axis=0) for n in met.normals]
        sums = [density, *(force * beam for beam in beams.T)]
        surfel, along = met.near.T.ravel(), None
        if self.held_along > 0.0:
            along = np.ascontiguousarray((density * (self.held_along * cloud_weight)).T)
        return _Expected(
            component=met.near,
            weight=np.ascontiguousarray(weight.T),
            weight_along=along,
            explained=density.sum(axis=0),
            levers=cross(beams, np.column_stack(pull)),
            slides_m=slides_m,
            on_surfels=np.array([np.bincount(surfel, v.ravel(), components) for v in sums]),
            heights=heights,
        )


def maximise_shape(
    stack: CloudStack,
    R: Array,
    t: Array,
    mixture: Mixture,
    sigma_floor_m: float,
    cells: Array,
    counts: Array,
    turns: Array,
    tiles_held: bool = False,
) -> Mixture:
    """M-step of the surfels at new poses: means, normals, widths, share of the points.

    Args:
        stack: the clouds.
        R: (J, 3, 3) rotations of the new `T_target_lidar`.
        t: (J, 3) translations of it.
        mixture: the surfels of the E-step.
        sigma_floor_m: smallest width; annealed from coarse to that of the thinnest parts.
        cells: `cell_moments` of its responsibilities.
        counts: (K,) points of each surfel.
        turns: (K, 3) rotation of each normal, of the quadratic of the E-step.
        tiles_held: surfels keep their widths, and move along their normals only.
    """
    carry = to_target(stack, R, t)
    mass, means = mass_and_means(np.matmul(cells[..., MOMENTS], carry).sum(axis=0), mixture)
    normals = _turned(mixture.normals_target, turns)
    share = counts / max(float(counts.sum()), 1e-300)
    if tiles_held:
        across = np.einsum("ka,ka->k", means - mixture.means_target, normals)
        places = mixture.means_target + across[:, None] * normals
        return Mixture(places, normals, mixture.var_tangent, share)
    # Across the surface a surfel lies where the points are; along it, where their beams meet it.
    on_surface = np.matmul(cells[..., SURFACE_MOMENTS], carry).sum(axis=0)
    centres = mass_and_means(on_surface, mixture)[1]
    centres += np.einsum("ka,ka->k", means - centres, normals)[:, None] * normals
    scatter = scatter_about(on_surface, centres)
    aside2 = np.trace(scatter, axis1=1, axis2=2) - np.einsum(
        "ka,kab,kb->k", normals, scatter, normals
    )
    floor = max(sigma_floor_m, LEAST_EXTENT_M) ** 2
    return Mixture(
        means_target=centres,
        normals_target=normals,
        var_tangent=np.maximum(aside2 / (2.0 * mass), floor),
        weights=share,
    )


def _turned(normals: Array, turns: Array) -> Array:
    """(K, 3) normals rotated by (K, 3) rotation vectors, each by at most `MAX_TURN_RAD`."""
    size = np.linalg.norm(turns, axis=1)
    rotation = turns * np.minimum(1.0, MAX_TURN_RAD / np.maximum(size, 1e-300))[:, None]
    rotated = Rotation.from_rotvec(rotation).apply(normals)
    return np.asarray(rotated / np.linalg.norm(rotated, axis=1)[:, None])
