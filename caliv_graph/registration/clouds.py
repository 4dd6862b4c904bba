"""The clouds of a placement, stacked for work in batches: points, beams and surface normals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from caliv_graph.products import Array, IntArray, TargetObservation

NORMAL_NEIGHBOURS = 9
"""Points of a local plane fit: a ring of eight and the point itself."""


@dataclass(frozen=True)
class CloudStack:
    """All clouds of a placement, one after the other.

    Attributes:
        points: (N, 3) metres, each in the frame of its own LiDAR at its own stamp.
        cloud: (N,) index of the cloud that a point belongs to, ascending.
        starts: (J,) index of each cloud's first point.
        beams: (N, 3) unit vectors from the sensor to the point, lidar frame.
        normals: (N, 3) unit vectors, lidar frame, towards the sensor.
        flatness: (N,) 0 to 1, how far the normal can be trusted: 0 where the neighbourhood is
            sparse, thin or noisy (there the normal is the direction to the sensor).
    """

    points: Array
    cloud: IntArray
    starts: IntArray
    beams: Array
    normals: Array
    flatness: Array

    @property
    def count(self) -> int:
        """Number of clouds."""
        return len(self.starts)

    def rotated(self, R: Array, vectors: Array) -> Array:
        """Rotates (N, 3) vectors of the points by the (J, 3, 3) rotation of their cloud."""
        return np.asarray(np.einsum("nij,nj->ni", R[self.cloud], vectors))

    def moved(self, R: Array, t: Array) -> Array:
        """The points under the (J, 3, 3), (J, 3) transforms of their clouds; (N, 3)."""
        return self.rotated(R, self.points) + t[self.cloud]

    def sum_per_cloud(self, values: Array) -> Array:
        """Sums (N, ...) values over the points of each cloud; (J, ...)."""
        return np.asarray(np.add.reduceat(values, self.starts, axis=0))


def sampling_order(points: Array) -> npt.NDArray[np.uint64]:
    """A pseudo-random priority of each point, (N,), by which points are drawn.

    A stride would alias with the scan lines. The priority depends on the point's own coordinates
    in its own LiDAR's frame and on nothing else, so that another initial guess, or a point more
    at the edge of the region, draws the same points: the result shall not depend on them.
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


def surface_normals(points: Array, sigma_range_m: float) -> tuple[Array, Array]:
    """Surface normals of one cloud by local principal components, towards the sensor.

    Args:
        points: (N, 3) metres, lidar frame.
        sigma_range_m: noise along the beam; a neighbourhood no larger than it has no normal.

    Returns:
        (N, 3) unit normals and (N,) flatness between 0 and 1.
    """
    k = min(NORMAL_NEIGHBOURS, len(points))
    _, near = cKDTree(points).query(points, k)
    local = points[near] - points[near].mean(axis=1, keepdims=True)
    scatter = np.einsum("nki,nkj->nij", local, local) / k
    spread, axes = np.linalg.eigh(scatter)
    normals = axes[:, :, 0]
    normals *= -np.where(np.sum(normals * points, axis=1) < 0, -1.0, 1.0)[:, None]
    # A plane has one small and two large spreads. Half the noise variance is added to the small
    # one: a patch as small as the noise looks flat by chance.
    thin = (spread[:, 0] + 0.5 * sigma_range_m**2) / np.maximum(spread[:, 1], 1e-12)
    return normals, np.clip(1.0 - 2.0 * thin, 0.0, 1.0)


def stack_clouds(
    observation: TargetObservation, max_points: int, sigma_range_m: float
) -> CloudStack:
    """Stacks the clouds of a placement, at most `max_points` points of each.

    Args:
        observation: the clouds, none of them empty.
        max_points: a larger cloud is thinned (`sampling_order`).
        sigma_range_m: noise along the beam, metres.
    """
    points, normals, flatness = [], [], []
    for cloud in observation.clouds:
        n, flat = surface_normals(cloud.points_lidar, sigma_range_m)
        keep: slice | IntArray = slice(None)
        if len(cloud.points_lidar) > max_points:
            keep = np.sort(np.argsort(sampling_order(cloud.points_lidar))[:max_points])
        points.append(cloud.points_lidar[keep])
        normals.append(n[keep])
        flatness.append(flat[keep])
    sizes = np.array([len(p) for p in points])
    stacked = np.concatenate(points)
    flat = np.concatenate(flatness)
    beams = stacked / np.linalg.norm(stacked, axis=1)[:, None]
    return CloudStack(
        points=stacked,
        cloud=np.repeat(np.arange(len(points)), sizes),
        starts=np.concatenate([[0], np.cumsum(sizes)[:-1]]),
        beams=beams,
        normals=_towards_sensor(np.concatenate(normals), flat, beams),
        flatness=flat,
    )


MERGED_NEIGHBOURS = 60
MERGED_RADIUS_M = 0.03
"""Neighbourhood of a normal in aligned clouds: as wide as a chair's leg, and enough points to see
a plane through the noise."""

FEWEST_NEIGHBOURS = 6
"""Fewer points make no normal."""

TRUSTED_ANGLE_RAD = 0.35
"""Uncertainty of a normal at which it is no longer trusted at all."""


def merged_normals(
    stack: CloudStack, R: Array, t: Array, lidar: IntArray, sigma_range_m: float
) -> CloudStack:
    """Normals again, from all clouds of a LiDAR together, once they are aligned.

    One cloud has a column or two of points on a leg; forty of them show its faces. The noise along
    the beams would tilt the planes: it is taken out of the covariances.

    Args:
        stack: the clouds.
        R: (J, 3, 3) rotations of `T_target_lidar`, right to a few millimetres at the target.
        t: (J, 3) translations of it.
        lidar: (J,) which LiDAR each cloud is of. Clouds of different LiDARs are not merged: whether
            they are aligned is the question.
        sigma_range_m: noise along the beam, metres.

    Returns:
        The same clouds with new normals and flatness.
    """
    points = stack.moved(R, t)
    beams = stack.rotated(R, stack.beams)
    normals, flatness = np.zeros_like(points), np.zeros(len(points))
    for which in np.unique(lidar):
        member = np.flatnonzero(lidar[stack.cloud] == which)
        n, flat = _aligned_normals(points[member], beams[member], sigma_range_m)
        normals[member], flatness[member] = n, flat
    back = np.swapaxes(R, 1, 2)
    mixed = _towards_sensor(stack.rotated(back, normals), flatness, stack.beams)
    return replace(stack, normals=mixed, flatness=flatness)


def _towards_sensor(normals: Array, flatness: Array, beams: Array) -> Array:
    """Normals, leaning the more to the sensor the less they can be trusted.

    Where the neighbourhood tells no normal, the surface at least faces the sensor.
    """
    mixed = flatness[:, None] * normals - (1.0 - flatness[:, None]) * beams
    return np.asarray(mixed / np.maximum(np.linalg.norm(mixed, axis=1), 1e-12)[:, None])


def _aligned_normals(points: Array, beams: Array, sigma_range_m: float) -> tuple[Array, Array]:
    """Normals (N, 3) and flatness (N,) of aligned points with their beams."""
    k = min(MERGED_NEIGHBOURS, len(points))
    distance, near = cKDTree(points).query(points, k, distance_upper_bound=MERGED_RADIUS_M)
    inside = np.isfinite(distance)
    near = np.where(inside, near, 0)
    count = inside.sum(axis=1)
    weight = inside / count[:, None]
    centre = np.einsum("nk,nki->ni", weight, points[near])
    local = points[near] - centre[:, None]
    beam = np.einsum("nk,nki->ni", weight, beams[near])
    scatter = np.einsum("nk,nki,nkj->nij", weight, local, local, optimize=True)
    noise = sigma_range_m**2 * beam[:, :, None] * beam[:, None, :]
    spread, axes = np.linalg.eigh(scatter - noise)
    normals = axes[:, :, 0]
    normals *= np.where(np.einsum("ni,ni->n", normals, beams) > 0.0, -1.0, 1.0)[:, None]
    # How well the plane's direction is known: noise across it, over the width of the patch.
    across2 = np.einsum("ni,nij,nj->n", normals, scatter, normals)
    width2 = np.maximum(spread[:, 1], 1e-12)
    angle = np.sqrt(across2 / (width2 * np.maximum(count - 3, 1)))
    thin = np.maximum(spread[:, 0], 0.0) / width2
    flatness = np.clip(1.0 - angle / TRUSTED_ANGLE_RAD, 0.0, 1.0) * np.clip(1.0 - 2.0 * thin, 0, 1)
    return normals, np.where(count >= FEWEST_NEIGHBOURS, flatness, 0.0)
