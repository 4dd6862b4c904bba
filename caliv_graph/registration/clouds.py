"""The clouds of a placement, stacked for work in batches: points, beams and surface normals.

A cloud is what one scan shows of the target (`products.TargetCloud`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from caliv_graph.common.cores import share_out
from caliv_graph.geometry.se3 import tangent_axes
from caliv_graph.products import Array, IntArray, TargetObservation

SINGLE_NEIGHBOURS = 16
SINGLE_RADIUS_M = 0.15
"""Neighbourhood of a normal in one cloud, across the beam: two rings of points. In a sparse cloud
it is no larger than the flat parts of a chair."""

MERGED_NEIGHBOURS = 60
MERGED_RADIUS_M = 0.03
"""Neighbourhood in aligned clouds: as wide as the leg of a chair, with enough points for a plane at
10 mm of noise."""

MERGED_WIDEST_M = 0.08
MERGED_FEWEST = 12
"""Where the merged clouds are sparse, the neighbourhood is as wide as so many points ask for, but
no wider than this: a wrong normal is worse than one that is blurred at the edges."""

WINDOW_RAD = math.radians(10.0)
WINDOW_POINTS = 9000
"""Clouds are merged with those of the same LiDAR from about the same side, nearest direction first,
up to this number of points. From other sides, other surfaces are along the same beam."""

DEPTH_GATE_M = 0.06
"""Neighbours farther than this from the initial plane belong to another surface."""

GATE_SIGMAS = 3.0
"""Gate of the final plane, in standard deviations of the noise along the beam."""

GATE_ROUNDS = 5
"""Plane fits per normal, with narrowing gate."""

RIDGE = 1e-6
"""Tikhonov term that keeps plane fits solvable."""

FEWEST_NEIGHBOURS = 6
"""Minimum effective number of neighbours (Kish) for a normal."""

TRUSTED_ANGLE_RAD = 0.35
"""Uncertainty of a normal, 1 sigma, at which its flatness is 0."""

TRUSTED_FLATNESS = 0.2
"""Flatness above which a normal is used as it is. Below, it is blended with the direction to the
sensor. Blending all would bias all."""


@dataclass(frozen=True)
class CloudStack:
    """All clouds of a placement, one after the other.

    Attributes:
        points: (N, 3) metres, each in the frame of its own LiDAR at its own stamp.
        cloud: (N,) index of the cloud of each point, ascending.
        starts: (J,) index of the first point of each cloud.
        lidar: (J,) index of the LiDAR of each cloud, in the order in which they first come.
        beams: (N, 3) unit vectors from the sensor to the point, lidar frame.
        normals: (N, 3) unit vectors, lidar frame, towards the sensor.
        flatness: (N,) reliability of the normal, 0 to 1. It is 0 where the neighbourhood is sparse
            or noisy; there the normal is the direction to the sensor.
        whole: J clouds before thinning, for the normals.
        sigma_range_m: (L,) noise along the beams of each LiDAR, 1 sigma, metres.
        seen_from: (J, 3) metres, where the LiDAR was when it measured each, lidar frame.
    """

    points: Array
    cloud: IntArray
    starts: IntArray
    lidar: IntArray
    beams: Array
    normals: Array
    flatness: Array
    whole: tuple[Array, ...]
    sigma_range_m: Array
    seen_from: Array

    def points_of(self, which: IntArray) -> IntArray:
        """Indices of the points of these clouds, one cloud after the other."""
        sizes = self.sizes[which]
        before = np.cumsum(sizes) - sizes
        return np.asarray(
            np.arange(int(sizes.sum())) + np.repeat(self.starts[which] - before, sizes)
        )

    def only(self, which: IntArray) -> CloudStack:
        """The clouds at these indices; one that is named twice is there twice."""
        sizes, kept = self.sizes[which], self.points_of(which)
        return CloudStack(
            points=self.points[kept],
            cloud=np.repeat(np.arange(len(which)), sizes),
            starts=np.cumsum(sizes) - sizes,
            lidar=self.lidar[which],
            beams=self.beams[kept],
            normals=self.normals[kept],
            flatness=self.flatness[kept],
            whole=tuple(self.whole[j] for j in which.tolist()),
            sigma_range_m=self.sigma_range_m,
            seen_from=self.seen_from[which],
        )

    @property
    def count(self) -> int:
        """Number of clouds."""
        return len(self.starts)

    @property
    def lidars(self) -> int:
        """Number of LiDARs."""
        return int(self.lidar.max()) + 1

    @property
    def sizes(self) -> IntArray:
        """(J,) number of points of each cloud."""
        return np.diff(np.append(self.starts, len(self.points)))

    @cached_property
    def centres(self) -> Array:
        """(J, 3) mean of each cloud's points, lidar frame."""
        return np.asarray(self.sum_per_cloud(self.points) / self.sizes[:, None])

    @cached_property
    def mean_beams(self) -> Array:
        """(J, 3) mean of each cloud's unit vectors, lidar frame."""
        return np.asarray(self.sum_per_cloud(self.beams) / self.sizes[:, None])

    @cached_property
    def features(self) -> Array:
        """(N, 13) what `moments.cell_moments` sums over points, lidar frame.

        `second_moments` of `centred`, and flatness times normal.
        """
        return np.column_stack(
            [second_moments(self.centred), self.flatness[:, None] * self.normals]
        )

    @cached_property
    def centred(self) -> Array:
        """(N, 3) points less the centre of their cloud, lidar frame."""
        return np.asarray(self.points - self.centres[self.cloud])

    def rotated(self, R: Array, vectors: Array) -> Array:
        """Rotates (N, 3) vectors of the points by the (J, 3, 3) rotation of their cloud."""
        out = np.empty_like(vectors)
        ends = np.append(self.starts[1:], len(vectors)).tolist()
        for R_j, first, end in zip(R, self.starts.tolist(), ends, strict=True):
            np.matmul(vectors[first:end], R_j.T, out=out[first:end])
        return out

    def moved(self, R: Array, t: Array) -> Array:
        """The points under the (J, 3, 3), (J, 3) transforms of their clouds; (N, 3)."""
        return self.rotated(R, self.points) + t[self.cloud]

    def sum_per_cloud(self, values: Array) -> Array:
        """Sums (N, ...) values over the points of each cloud; (J, ...)."""
        return np.asarray(np.add.reduceat(values, self.starts, axis=0))


def second_moments(points: Array) -> Array:
    """(N, 10) `h h^T`, upper triangle, of h = (1, point)."""
    out = np.empty((len(points), 10))
    out[:, 0] = 1.0
    out[:, 1:4] = points
    out[:, 4:7] = points[:, :1] * points
    out[:, 7:9] = points[:, 1:2] * points[:, 1:]
    out[:, 9] = points[:, 2] ** 2
    return out


def sampling_order(points: Array) -> npt.NDArray[np.uint64]:
    """Pseudo-random priorities (N,) by which points (N, 3) are drawn: hashes of their coordinates.

    A stride would alias with the scan lines. In the frame of its LiDAR the draw depends neither on
    the initial guess nor on other points at the edge of the region.
    """
    bits = np.ascontiguousarray(points, dtype=np.float64).view(np.uint64)
    state = np.zeros(len(points), dtype=np.uint64)
    for axis in range(3):
        # The finaliser of SplitMix64 (Steele et al. 2014), one round per coordinate.
        state = (state ^ bits[:, axis]) + np.uint64(0x9E3779B97F4A7C15)
        state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        state ^= state >> np.uint64(31)
    return state


def surface_normals(
    points: Array,
    sigma_range_m: float,
    around: Array | None = None,
    beams: Array | None = None,
) -> tuple[Array, Array]:
    """(N, 3) unit normals towards the sensor, and (N,) flatness 0 to 1, of points of one cloud.

    `points` (N, 3) and the whole cloud `around` (M, 3), by default the same, are in metres, lidar
    frame. The noise along the beam limits the flatness. `beams` (M, 3), unit vectors to `around`,
    are by default from the origin.
    """
    around = points if around is None else around
    if beams is None:
        beams = around / np.maximum(np.linalg.norm(around, axis=1), 1e-9)[:, None]
    return _normals_across(points, around, beams, SINGLE_NEIGHBOURS, SINGLE_RADIUS_M, sigma_range_m)


def stack_clouds(
    observation: TargetObservation,
    max_points: int,
    sigma_range_m: Array | float,
    normals: bool = True,
) -> CloudStack:
    """Stacks the clouds of a placement, none of them empty.

    Clouds of more than `max_points` points are thinned (`sampling_order`). Without `normals`, if
    `merged_normals` follows, all normals point to the sensor. The noise along the beam, of each
    LiDAR (L,) or of all, is in metres.
    """
    points, beams, normal, flatness = [], [], [], []
    lidar = _indices([cloud.lidar for cloud in observation.clouds])
    sigmas = np.full(int(lidar.max()) + 1, sigma_range_m)
    for cloud, sigma_m in zip(observation.clouds, sigmas[lidar].tolist(), strict=True):
        kept = cloud.points_lidar
        along = every = cloud.beams_lidar
        if len(kept) > max_points:
            some = np.sort(np.argsort(sampling_order(kept))[:max_points])
            kept, along = kept[some], along[some]
        points.append(kept)
        beams.append(along)
        if normals:
            n, flat = surface_normals(kept, sigma_m, cloud.points_lidar, every)
        else:
            n, flat = np.zeros_like(kept), np.zeros(len(kept))
        normal.append(n)
        flatness.append(flat)
    sizes = np.array([len(p) for p in points])
    stacked = np.concatenate(points)
    flat = np.concatenate(flatness)
    along_beams = np.concatenate(beams)
    return CloudStack(
        points=stacked,
        cloud=np.repeat(np.arange(len(points)), sizes),
        starts=np.concatenate([[0], np.cumsum(sizes)[:-1]]),
        lidar=lidar,
        beams=along_beams,
        normals=_towards_sensor(np.concatenate(normal), flat, along_beams),
        flatness=flat,
        whole=tuple(cloud.points_lidar for cloud in observation.clouds),
        sigma_range_m=sigmas,
        seen_from=np.array([cloud.seen_from_lidar for cloud in observation.clouds]),
    )


def _indices(names: Sequence[str]) -> IntArray:
    """(J,) number of each name, in the order in which they first come."""
    index = {name: i for i, name in enumerate(dict.fromkeys(names))}
    return np.array([index[name] for name in names], dtype=np.int64)


def merged_normals(stack: CloudStack, R: Array, t: Array) -> CloudStack:
    """The same clouds, with normals and flatness from the aligned clouds of each LiDAR, merged.

    One cloud has one or two columns of points on the leg of a chair; a dozen clouds show its faces.
    Clouds of different LiDARs are not merged: their alignment is what is estimated.
    `T_target_lidar` (rotations (J, 3, 3), translations (J, 3), metres) are right to a few
    millimetres at the target.
    """
    lidar = stack.lidar
    points = stack.moved(R, t)
    beams = stack.rotated(R, stack.beams)
    views = stack.sum_per_cloud(beams)
    views /= np.linalg.norm(views, axis=1)[:, None]
    ends = np.append(stack.starts[1:], len(points))
    whole = [cloud @ R[j].T + t[j] for j, cloud in enumerate(stack.whole)]
    sizes = np.array([len(cloud) for cloud in whole])
    normals, flatness = np.zeros_like(points), np.zeros(len(points))

    def of_cloud(j: int) -> None:
        apart = np.where(lidar == lidar[j], np.arccos(np.clip(views @ views[j], -1.0, 1.0)), np.inf)
        near = np.argsort(apart, kind="stable")
        before = np.cumsum(sizes[near]) - sizes[near]
        near = near[(apart[near] <= WINDOW_RAD) & (before < WINDOW_POINTS)]
        around = np.concatenate([whole[i] for i in near])
        own = slice(stack.starts[j], ends[j])
        normals[own], flatness[own] = _normals_across(
            points[own],
            around,
            beams[own],
            MERGED_NEIGHBOURS,
            MERGED_RADIUS_M,
            float(stack.sigma_range_m[lidar[j]]),
            MERGED_WIDEST_M,
        )

    share_out(of_cloud, range(stack.count))
    back = np.swapaxes(R, 1, 2)
    mixed = _towards_sensor(stack.rotated(back, normals), flatness, stack.beams)
    return replace(stack, normals=mixed, flatness=flatness)


def _towards_sensor(normals: Array, flatness: Array, beams: Array) -> Array:
    """Normals, blended with the direction to the sensor where they cannot be estimated."""
    own = np.minimum(flatness / TRUSTED_FLATNESS, 1.0)[:, None]
    mixed = own * normals - (1.0 - own) * beams
    return np.asarray(mixed / np.maximum(np.linalg.norm(mixed, axis=1), 1e-12)[:, None])


def _normals_across(
    points: Array,
    around: Array,
    beams: Array,
    neighbours: int,
    radius_m: float,
    sigma_range_m: float,
    widest_m: float = 0.0,
) -> tuple[Array, Array]:
    """(n, 3) unit normals and (n,) flatness at points (n, 3) of the surface `around` (N, 3).

    By regression of the depth along the mean of `beams` over the position across it, since the
    noise is in the depth alone: the plane of a ball of points is biased (`README.md` of this
    folder).
    """
    along = beams.mean(axis=0)
    along /= np.linalg.norm(along)
    plane = tangent_axes(along).T
    k = min(neighbours, len(around))
    there, here = around @ plane, points @ plane
    # Few queries: the time to build the tree matters.
    tree = cKDTree(there, compact_nodes=False, balanced_tree=False)
    distance, near = tree.query(here, k, distance_upper_bound=max(radius_m, widest_m))
    distance, near = np.reshape(distance, (-1, k)), np.reshape(near, (-1, k))
    enough = distance[:, min(MERGED_FEWEST, k) - 1 :][:, :1]
    radius = np.clip(enough, radius_m, max(radius_m, widest_m))
    inside = distance <= radius
    near = np.where(inside, near, 0)
    # The neighbourhood ends at two standard deviations of the kernel: a point that enters or leaves
    # changes nothing abruptly.
    width_m = 0.5 * np.where(inside[:, -1:], distance[:, -1:], radius)
    width_m = np.maximum(width_m, 1e-6)
    kernel = np.where(inside, np.exp(-0.5 * (np.where(inside, distance, 0.0) / width_m) ** 2), 0.0)
    depth = (around @ along)[near] - (points @ along)[:, None]
    u, v = ((there[:, axis][near] - here[:, axis, None]) / width_m for axis in range(2))
    across = (np.ones_like(u), u, v, u * u, u * v, v * v)
    slope, weight, normal_matrix = _gated_slope(kernel, depth, across, width_m, sigma_range_m)
    normals = slope @ plane.T - along
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return normals, _flatness(slope, weight, normal_matrix, across, width_m, sigma_range_m)


def _gated_slope(
    kernel: Array, depth: Array, across: Sequence[Array], width_m: Array, sigma_range_m: float
) -> tuple[Array, Array, Array]:
    """(n, 2) slopes of planes through depths (n, k); last weights and (n, 3, 3) normal matrices.

    `across` is 1, u, v, u^2, u v, v^2, (n, k) each, of the position across in widths (n, 1) of
    `kernel`.
    """
    _, u, v, *_ = across
    depths = (depth, u * depth, v * depth)
    residual = depth
    # A wide neighbourhood on a slanted surface is deep.
    first = np.maximum(DEPTH_GATE_M, GATE_SIGMAS * width_m)
    last = max(GATE_SIGMAS * sigma_range_m, 1e-3)
    for gate_m in first * (last / first) ** np.linspace(0.0, 1.0, GATE_ROUNDS)[:, None, None]:
        weight = kernel * np.maximum(1.0 - (residual / gate_m) ** 2, 0.0) ** 2
        normal_matrix = _symmetric_sums(weight, across)
        right = _sums(weight, depths)
        fit = np.linalg.solve(normal_matrix, right[..., None])[..., 0]
        residual = depth - fit[:, :1] - fit[:, 1:2] * u - fit[:, 2:] * v
    return fit[:, 1:] / width_m, weight, normal_matrix


def _flatness(
    slope: Array,
    weight: Array,
    normal_matrix: Array,
    across: Sequence[Array],
    width_m: Array,
    sigma_range_m: float,
) -> Array:
    """(n,) reliability of the planes of `_gated_slope`, 0 to 1, by the covariance of the slopes."""
    inverse = np.linalg.inv(normal_matrix)
    # The ridge is not an observation: across a line of points the slope is undetermined.
    cov = inverse @ _symmetric_sums(weight**2, across) @ inverse
    sigma_slope = sigma_range_m / width_m[:, 0] * np.sqrt(np.maximum(cov[:, 1, 1], cov[:, 2, 2]))
    # An angle changes by less than its tangent where the surface is slanted.
    angle = sigma_slope / (1.0 + np.sum(slope**2, axis=1))
    flatness = np.clip(1.0 - angle / TRUSTED_ANGLE_RAD, 0.0, 1.0)
    total, square = weight.sum(axis=1), np.sum(weight**2, axis=1)
    enough = total**2 >= FEWEST_NEIGHBOURS * square
    return np.asarray(np.where(enough, flatness, 0.0))


def _symmetric_sums(weight: Array, products: Sequence[Array]) -> Array:
    """(n, 3, 3) of `_sums` of the upper triangle of a product, and a ridge."""
    sums = _sums(weight, products)[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]]
    return np.asarray(sums.reshape(-1, 3, 3) + RIDGE * np.eye(3))


def _sums(weight: Array, values: Sequence[Array]) -> Array:
    """(n, m) weighted sums of m values of (n, k) over the k neighbours of n points."""
    return np.stack([np.einsum("nk,nk->n", weight, value) for value in values], axis=1)
