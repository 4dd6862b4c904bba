"""The clouds of a placement, stacked for work in batches: points, beams and surface normals."""

from __future__ import annotations

from dataclasses import dataclass

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
    # Where the neighbourhood tells no normal, the surface at least faces the sensor.
    mixed = flat[:, None] * np.concatenate(normals) - (1.0 - flat[:, None]) * beams
    mixed /= np.maximum(np.linalg.norm(mixed, axis=1), 1e-12)[:, None]
    return CloudStack(
        points=stacked,
        cloud=np.repeat(np.arange(len(points)), sizes),
        starts=np.concatenate([[0], np.cumsum(sizes)[:-1]]),
        beams=beams,
        normals=mixed,
        flatness=flat,
    )
