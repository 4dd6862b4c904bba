"""The surfels that a target is reconstructed as: seed, E-step, and M-step of the surfels.

What a beam measures of the shape (`README.md` of this folder): it meets the planes of the surfels
near it; it returns from one that faces it and lies there, and the range is the distance to it, with
noise along the beam. GMMCalib's components are isotropic, and pull the front and back of a chair
together, which two LiDARs see 2 to 3 cm apart. The M-step of the poses is in `quadratic`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, pairwise

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import expit

from caliv_graph.common.cores import parts, share_out
from caliv_graph.geometry.se3 import cross, tangent_axes
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

NEIGHBOURS = 8
"""Surfels that a beam may return from: the nearest to the point. Farther ones have a negligible
density."""

NORMAL_METRES = 0.1
"""In the search for near surfels, opposite normals count as 2 x 0.1 m apart."""

BEAM_NEIGHBOURS = 12
"""The same where beams alone tell the surfel: those nearest across the beam."""

ALONG_BEAM = 4.0
"""A distance along the beam counts less by this factor in the search for these. The noise is along
it, and surfels about the noisy point itself are on the side that its noise chose."""

AWAY = -0.2
"""Cosine of incidence at the middle of a cloud below which none of its beams sees a surfel."""

EDGE_M = 0.004
"""At an edge between two surfels, metres: how much farther one of them is along the beam for it to
be the one that the beam returns from; and how far one lies behind the plane of the other for there
to be an edge. Thin parts are known to this."""

EDGE_REACH_M = 0.1
"""Surfels that are farther apart have no edge in common."""

PAIRED = 4
"""Of the surfels near a beam, those that edges are looked for between: the most present."""

NORMAL_CONCENTRATION = 4.0
"""Concentration of a reliable normal about that of its surfel (von Mises-Fisher, times flatness):
0.5 rad. Normals of neighbouring points share their errors at edges."""

GRAZING = 0.05
"""Cosine of incidence about which a surfel begins to be visible: a normal is not known better."""

STEEP = 0.1
"""Cosine of incidence below which the intersection of beam and plane is damped: the normal is not
known well enough to compute it."""

REACH_SIGMAS = 3.0
"""Standard deviations of the noise along the beam that the intersection may be away from the point.
While poses are wrong by more than that, most points are farther away."""

LEAST_SEEN = 1e-3
"""What is left of the presence of a surfel that is hidden at edges."""

BESIDE = 1e-4
"""Presence of "no surface here" in the weights of the surfels along a beam: a beam that passes a
surfel at more than 4.3 of its widths does not return from it."""

LEAST_EXTENT_M = 0.006
"""Smallest width of a surfel, 1 sigma: half of the thinnest part that is worth one."""

PART_POINTS = 8192
"""Points of a part of the E-step: what belongs to them stays in the processor's cache."""

ORDER_BITS = 4
"""Bits per axis of the cells in whose order points are looked up: 16 cells across the target. One
look-up follows another nearby, and takes three quarters of the time."""

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
) -> Mixture:
    """The initial mixture of width `sigma_m`: components on points with reliable normals.

    Every cloud contributes the same number of points: a near cloud with many does not take all
    components. The draw does not depend on the poses `T_target_lidar`, rotations R (J, 3, 3) and
    translations t (J, 3). There are fewer `components` if few points are `distinct`
    (`POINTS_PER_COMPONENT`): those of scans of one view count as one. None: all are. Clouds (J,)
    that are not `trusted` get no surfels: a cloud in the wrong place would explain itself.
    `everywhere`: on points whose normals are not reliable as well, as on thin parts.
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
    chosen = order[np.argsort(rank, kind="stable")[:components]]
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


class _Surfels:
    """The surfels for the E-step: means and normals (3, K), and factors (K,) of the exponents.

    They lie on surfaces: boxes halved in the middle fit them better than those halved in number,
    and the search in `tree` is a sixth faster.
    """

    def __init__(self, mixture: Mixture) -> None:
        places = np.column_stack([mixture.means_target, NORMAL_METRES * mixture.normals_target])
        self.tree = cKDTree(places, balanced_tree=False)
        self.neighbours = min(NEIGHBOURS, len(mixture.weights))
        self.low = mixture.means_target.min(axis=0)
        self.extent_m = max(float(np.ptp(mixture.means_target, axis=0).max()), 1e-6)
        self.aside = -0.5 / mixture.var_tangent
        self.means = mixture.means_target.T.copy()
        self.normals = mixture.normals_target.T.copy()

    def nearest(self, points: Array, normals: Array) -> IntArray:
        """(n, k) surfels nearest to points with normals (n, 3)."""
        # Along a curve that fills space (Morton): what the search reads is in the cache.
        cell = (points - self.low) * (2**ORDER_BITS / self.extent_m)
        cell = np.clip(cell, 0, 2**ORDER_BITS - 1).astype(np.int16)
        along = np.zeros(len(cell), dtype=np.int16)
        for bit in range(ORDER_BITS):
            for axis in range(3):
                along |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
        order = np.argsort(along, kind="stable")
        places = np.column_stack([points, NORMAL_METRES * normals])[order]
        found = np.empty((len(points), self.neighbours), dtype=np.int64)
        found[order] = np.reshape(self.tree.query(places, self.neighbours)[1], found.shape)
        return found

    def nearest_to_beams(self, points: Array, beams: Array, cloud: IntArray) -> IntArray:
        """(n, k) surfels nearest to the beams of points (n, 3) of clouds (n,), ascending."""
        found = np.empty((len(points), min(BEAM_NEIGHBOURS, self.means.shape[1])), dtype=np.int64)
        starts = np.append(np.flatnonzero(np.diff(cloud, prepend=-1)), len(cloud)).tolist()
        for first, end in pairwise(starts):
            along = beams[first:end].mean(axis=0)
            along /= np.linalg.norm(along)
            facing = np.flatnonzero(-(along @ self.normals) > AWAY)
            if len(facing) < found.shape[1]:
                facing = np.arange(self.means.shape[1])
            axes = np.vstack([tangent_axes(along), along / ALONG_BEAM])
            places = (axes @ self.means[:, facing]).T
            tree = cKDTree(places, balanced_tree=False, compact_nodes=False)
            near = tree.query(points[first:end] @ axes.T, found.shape[1])[1]
            found[first:end] = facing[np.reshape(near, (end - first, -1))]
        return found

    @cached_property
    def edges(self) -> npt.NDArray[np.float32]:
        """(K, K) 1 where two surfels meet at an edge that sticks out, -1 at one that is hollow.

        At the first each lies behind the plane of the other, at the second before it.
        """
        heights = self.normals.T @ self.means
        heights -= np.diag(heights)[:, None]  # of surfel l over the plane of surfel k
        low = np.minimum(heights, heights.T)
        high = np.maximum(heights, heights.T)
        bend = np.maximum(-high, 0.0) - np.maximum(low, 0.0)
        square = np.sum(self.means**2, axis=0)
        apart2 = square + square[:, None] - 2.0 * self.means.T @ self.means
        return np.where(apart2 < EDGE_REACH_M**2, np.tanh(bend / EDGE_M), 0.0).astype(np.float32)

    def _hidden_at_edges(self, found: IntArray, there: Array, slide: Array) -> None:
        """Takes from `there` (k, n) the surfels whose planes the beams meet beyond an edge.

        Two planes that stick out at their edge: a beam returns from the farther, the nearer one it
        meets in the air. At a hollow edge it returns from the nearer.
        """
        if len(there) > PAIRED:
            kept = np.argpartition(there, -PAIRED, axis=0)[-PAIRED:]
        else:
            kept = np.arange(len(there))[:, None]
        surfel, own, s = (np.take_along_axis(a, kept, axis=0) for a in (found, there, slide))
        share = own / (own.sum(axis=0) + BESIDE)
        lost = np.zeros_like(own)
        for k, other in combinations(range(len(own)), 2):
            edge = self.edges[surfel[k], surfel[other]]
            farther = expit((s[k] - s[other]) / EDGE_M)
            out, hollow = np.maximum(edge, 0.0), np.maximum(-edge, 0.0)
            lost[k] += share[other] * (out * (1.0 - farther) + hollow * farther)
            lost[other] += share[k] * (out * farther + hollow * (1.0 - farther))
        own *= np.clip(1.0 - lost, LEAST_SEEN, 1.0)
        np.put_along_axis(there, kept, own, axis=0)

    def met_by(
        self,
        points: Array,
        normals: Array,
        beams: Array,
        flatness: Array,
        reach_m: float,
        cloud: IntArray | None = None,
    ) -> _Met:
        """What the beams of points meet; all (n, 3), flatness (n,), target frame.

        With their clouds (n,), ascending, beams alone tell which surfels, and not the normals of
        the points.
        """
        by_beams = cloud is not None
        near = (
            self.nearest(points, normals)
            if cloud is None
            else self.nearest_to_beams(points, beams, cloud)
        )
        found = np.ascontiguousarray(near.T)
        height, all2, agreement, facing, depth = (np.zeros(found.shape) for _ in range(5))
        of_points = (np.ascontiguousarray(v.T) for v in (points, normals, beams))
        of_surfels = []
        for axis, (p, normal, beam) in enumerate(zip(*of_points, strict=True)):
            n = self.normals[axis].take(found)
            offset = p - self.means[axis].take(found)
            height += offset * n
            all2 += offset * offset
            agreement += n * normal
            facing -= n * beam
            depth += offset * beam
            of_surfels.append(n)
        # From the point along its beam to the surface, damped where the beam grazes it.
        slide = height * np.maximum(facing, 0.0) / np.maximum(facing, STEEP) ** 2
        slide = np.clip(slide, -reach_m, reach_m)
        aside2 = all2 + slide * (2.0 * depth + slide) - (height - facing * slide) ** 2
        visible = np.clip((facing + GRAZING) / (2.0 * GRAZING), 0.0, 1.0)
        there = np.exp(self.aside.take(found) * np.maximum(aside2, 0.0)) * visible
        if by_beams:
            self._hidden_at_edges(found, there, slide)
        # Where the beam returns from, if it does: surfels share it.
        presence = there / (there.sum(axis=0) + BESIDE)
        if not by_beams:
            presence *= _agreement(flatness, agreement)
        return _Met(near, presence, height, slide, facing, of_surfels)


@dataclass(frozen=True)
class _Met:
    """The surfels near n points, (k, n) each: numpy is fast along the points.

    Attributes:
        near: (n, k) indices of the surfels.
        presence: what the likelihood has of a surfel before the range is known: that it is visible,
            reaches to where the beam meets its plane, and agrees with the point's normal.
        height: of the point over it, metres.
        slide: along the beam to it, metres.
        facing: cosine of incidence.
        normals: its normal, an array per axis.
    """

    near: IntArray
    presence: Array
    height: Array
    slide: Array
    facing: Array
    normals: Sequence[Array]


def _agreement(flatness: Array, cosine: Array) -> Array:
    """(k, n) density of normals (n,) whose flatness is given about those of surfels.

    Von Mises-Fisher, in units of the uniform density on the sphere, which outliers have; `cosine`
    (k, n) between the two.
    """
    kappa = np.maximum(NORMAL_CONCENTRATION * flatness, 1e-6)
    uniform = 2.0 * kappa / -np.expm1(-2.0 * kappa)
    return np.asarray(uniform * np.exp(kappa * (cosine - 1.0)))


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
    """
    step = _EStep(stack, mixture, noise, outlier_density, cloud_weights, held_along, by_beams)
    points = stack.moved(R, t)
    normals, beams = stack.rotated(R, stack.normals), stack.rotated(R, stack.beams)
    pieces = parts(len(points), len(points) // PART_POINTS + 1)
    found: list[_Expected | None] = [None] * len(pieces)

    def of_part(i: int) -> None:
        part = pieces[i]
        found[i] = step.of(part, points[part], normals[part], beams[part])

    # Parts are independent: the result is the same on any number of cores.
    share_out(of_part, range(len(pieces)))
    done = [part for part in found if part is not None]
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

    @cached_property
    def _surfels(self) -> _Surfels:
        return _Surfels(self.mixture)

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
    """
    carry = to_target(stack, R, t)
    mass, means = mass_and_means(np.matmul(cells[..., MOMENTS], carry).sum(axis=0), mixture)
    normals = _turned(mixture.normals_target, turns)
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
        weights=counts / max(float(counts.sum()), 1e-300),
    )


def _turned(normals: Array, turns: Array) -> Array:
    """(K, 3) normals rotated by (K, 3) rotation vectors, each by at most `MAX_TURN_RAD`."""
    size = np.linalg.norm(turns, axis=1)
    rotation = turns * np.minimum(1.0, MAX_TURN_RAD / np.maximum(size, 1e-300))[:, None]
    rotated = Rotation.from_rotvec(rotation).apply(normals)
    return np.asarray(rotated / np.linalg.norm(rotated, axis=1)[:, None])
