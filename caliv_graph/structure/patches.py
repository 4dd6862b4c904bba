"""Patches of surface: what is kept of a scan.

The points of a scan that lie close together and on a plane are reduced to their moments. These are
sufficient for every later use, at any pose (`README.md`, section 2), so that no point is kept.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import gtsam
import numpy as np

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.geometry.se3 import skew, tangent_axes
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.channels import ChannelSums
from caliv_graph.targets.cloud.beams import elevations


@dataclass(frozen=True)
class Swept:
    """How the points of N patches, taken one after the other, were moved to the patch's time.

    Attributes:
        moments: (N, 4, 4) sum of s h h^T, s in seconds after that time.
        twist_lidar: (N, 6) by which they were moved: turn rad/s, velocity m/s, lidar frame.
    """

    moments: Array
    twist_lidar: Array

    def part(self, keep: BoolArray | IntArray) -> Swept:
        """Some of the patches (N,)."""
        return Swept(self.moments[keep], self.twist_lidar[keep])

    @classmethod
    def joined(cls, parts: Sequence[Swept | None], number: Sequence[int]) -> Swept | None:
        """Of all patches, `number` of each part; zero where a part is taken at once.

        None if all are.
        """
        if all(part is None for part in parts):
            return None
        known = [
            cls(np.zeros((n, 4, 4)), np.zeros((n, 6))) if part is None else part
            for part, n in zip(parts, number, strict=True)
        ]
        return cls(
            np.concatenate([part.moments for part in known]),
            np.concatenate([part.twist_lidar for part in known]),
        )


@dataclass(frozen=True)
class RangeNoise:
    """Noise along the beam, 1 sigma, linear in between, constant beyond both ends.

    Attributes:
        distances_m: (k,) ascending.
        sigmas_m: (k,) there.
    """

    distances_m: Array
    sigmas_m: Array

    @classmethod
    def constant(cls, sigma_m: float) -> RangeNoise:
        """The same at all distances."""
        return cls(np.ones(1), np.full(1, sigma_m))

    def at(self, distance_m: Array) -> Array:
        """(n,) 1 sigma in metres at these distances (n,)."""
        return np.asarray(np.interp(distance_m, self.distances_m, self.sigmas_m))


SMALLEST_SHAPE_M4 = 1e-12
"""Points within a millimetre of a line across their beams tell no scatter."""


@dataclass(frozen=True)
class DrivePatches:
    """Patches of the scans of one drive; N patches, M scans.

    The points of a patch were taken within milliseconds of each other; they are moved to the mean
    of their times, so that motion compensation is exact at any extrinsic.

    Attributes:
        drive: index of the drive.
        lidars: names of the LiDARs.
        stamps_ns: (M,) stamp of each scan, ascending by scan within a LiDAR.
        scan_lidar: (M,) index into `lidars`.
        scan: (N,) index of the scan, ascending.
        time_s: (N,) seconds after the stamp of the scan at which the points were taken.
        moments: (N, 4, 4) sum of h h^T over the points, h = (p, 1), p in metres, lidar frame as of
            the patch's own time. Element (3, 3) is the number of points.
        normal_lidar: (N, 3) unit normal towards the LiDAR.
        scatter_m: (N,) standard deviation of the points along the normal, unbiased.
        swept: how points were moved to that time; None: all are taken at once.
        moved_with: of each LiDAR the T_vehicle_lidar that this was done with.
        channels: what the points of each channel add; None: no LiDAR has channels. They are
            multiplied by errors of millimetres, so that they follow no extrinsics.
        noise: of the LiDARs whose scans were read, by their index in `lidars`.
        without_rows: indices in `lidars` of those whose beams are in no rows: a few lasers take
            turns in all directions.
    """

    drive: int
    lidars: tuple[str, ...]
    stamps_ns: IntArray
    scan_lidar: IntArray
    scan: IntArray
    time_s: Array
    moments: Array
    normal_lidar: Array
    scatter_m: Array
    swept: Swept | None = None
    moved_with: tuple[gtsam.Pose3, ...] = ()
    channels: ChannelSums | None = None
    noise: Mapping[int, RangeNoise] = field(default_factory=dict)
    without_rows: frozenset[int] = frozenset()

    @cached_property
    def reach_m(self) -> Array:
        """(L,) median range of the patches of each LiDAR; zero of one that has none."""
        range_m, own = np.linalg.norm(self.centres_lidar, axis=1), self.scan_lidar[self.scan]
        per_lidar = [range_m[own == of] for of in range(len(self.lidars))]
        return np.array([np.median(of) if len(of) else 0.0 for of in per_lidar])

    @cached_property
    def swept_scans(self) -> BoolArray:
        """(M,) whether patches of a scan differ in time.

        Those of a cloud without times have one, which is not zero where it has the stamp of another
        cloud.
        """
        first = np.full(len(self.stamps_ns), np.inf)
        np.minimum.at(first, self.scan, self.time_s)
        last = np.full(len(self.stamps_ns), -np.inf)
        np.maximum.at(last, self.scan, self.time_s)
        return np.asarray(last > first)

    def part(self, keep: BoolArray) -> DrivePatches:
        """Some of the patches (N,), of the same scans."""
        return replace(
            self,
            scan=self.scan[keep],
            time_s=self.time_s[keep],
            moments=self.moments[keep],
            normal_lidar=self.normal_lidar[keep],
            scatter_m=self.scatter_m[keep],
            swept=self.swept and self.swept.part(keep),
            channels=self.channels and self.channels.part(keep, len(self.scan)),
        )

    def followed(self, T_vehicle_lidar: Mapping[str, gtsam.Pose3]) -> DrivePatches:
        """The patches as motion compensation with these extrinsics would have made them.

        With a guess that is 3 degrees off, what a LiDAR takes in turn on the ground is turned about
        its beams by up to a milliradian. To first order in the time within a patch, 5 ms.
        """
        if self.swept is None:
            return self
        new = tuple(T_vehicle_lidar[name] for name in self.lidars)
        change = np.array(
            [
                T.between(guess).AdjointMap() - np.eye(6)
                for T, guess in zip(new, self.moved_with, strict=True)
            ]
        )
        before = self.swept.twist_lidar
        twist = np.einsum("nij,nj->ni", change[self.scan_lidar[self.scan]], before)
        along = np.zeros((len(twist), 4, 4))
        along[:, :3, :3], along[:, :3, 3] = skew(twist[:, :3]), twist[:, 3:]
        moved = along @ self.swept.moments
        return replace(
            self,
            moments=self.moments + moved + np.swapaxes(moved, 1, 2),
            swept=replace(self.swept, twist_lidar=before + twist),
            moved_with=new,
        )

    @property
    def points(self) -> Array:
        """(N,) number of points."""
        return self.moments[:, 3, 3]

    @property
    def taken_ns(self) -> IntArray:
        """(N,) stamp at which the points were taken."""
        offsets = np.round(NANOSECONDS_PER_SECOND * self.time_s).astype(np.int64)
        return np.asarray(self.stamps_ns[self.scan] + offsets)

    @property
    def centres_lidar(self) -> Array:
        """(N, 3) centroids, metres, lidar frame as of the patch's own time."""
        return self.moments[:, :3, 3] / self.moments[:, 3, 3, None]

    @property
    def elevations_rad(self) -> Array:
        """(N,) of the centroids about the z axis of the LiDAR."""
        return elevations(self.centres_lidar)

    @cached_property
    def scatter_along_beam_m(self) -> Array:
        """(N, 3) direction of the beams; its length: root of the sum of squares of their scatter.

        Metres, lidar frame as of the patch's own time. About the plane that fits the *ranges* best:
        directions of beams have no noise, so that it does not turn towards them.
        """
        u, scatter_m = scatter_of_ranges(*spread_of(self.moments), self.points)
        return np.asarray(u * (scatter_m * np.sqrt(self.points))[:, None])


def spread_of(moments: Array) -> tuple[Array, Array]:
    """Middles (N, 3) of the points of moments (N, 4, 4), and their covariances (N, 3, 3)."""
    points = moments[:, 3, 3]
    centres = moments[:, :3, 3] / points[:, None]
    cov = moments[:, :3, :3] / points[:, None, None] - centres[:, :, None] * centres[:, None, :]
    return centres, cov


def scatter_of_ranges(centres_lidar: Array, cov: Array, points: Array) -> tuple[Array, Array]:
    """Directions (N, 3) of the beams of patches, and (N,) scatter of their ranges, metres.

    About the plane that fits the *ranges* best: directions of beams have no noise. Unbiased. Of
    patches with these middles (N, 3), covariances (N, 3, 3) of their points about them, and numbers
    of points (N,).
    """
    u = centres_lidar / np.maximum(np.linalg.norm(centres_lidar, axis=1), 1e-9)[:, None]
    across = tangent_axes(u)
    known = across @ cov @ np.swapaxes(across, 1, 2)
    shape = known[:, 0, 0] * known[:, 1, 1] - known[:, 0, 1] * known[:, 1, 0]
    squares = np.linalg.det(cov) / np.maximum(shape, SMALLEST_SHAPE_M4)
    # Three degrees of freedom went into the plane; all points' noise is in the moments.
    squares *= points / np.maximum(points - 3.0, 1.0)
    return u, np.sqrt(np.maximum(squares, 0.0))


SHORT_M = 0.05
"""Extent below which a sighting does not show how an error changes along it."""


def fitted_along(moments: Array, normals: Array, total: Array, of: IntArray | None = None) -> Array:
    """(E, k, 4) functions of h that are linear along a surface, nearest to given ones.

    Args:
        moments: (Q, 4, 4) of the points.
        normals: (Q, 3) of their surfaces.
        total: (E, k, 4) moments of the points times the functions.
        of: (E,) whose points; None: those of each (E = Q).
    """
    N = along_surface(moments, normals)
    inner = np.swapaxes(N, 1, 2) @ moments @ N
    inner[:, [1, 2], [1, 2]] += moments[:, 3, 3, None] * SHORT_M**2
    if of is not None:
        N, inner = N[of], inner[of]
    right = np.einsum("eij,eki->ejk", N, total)
    return np.asarray(np.swapaxes(N @ np.linalg.solve(inner, right), 1, 2))


def fitted_over(by_point: Array, moments: Array, normals: Array, starts: IntArray) -> Array:
    """(Q, k, 4) functions of h that are linear along a surface, nearest to those of its patches.

    Args:
        by_point: (n, k, 4) functions of h, of the points of each patch.
        moments: (n, 4, 4) of the points.
        normals: (n, 3) of their surfaces.
        starts: (Q,) first patch of each sum of patches.
    """
    whole = np.add.reduceat(moments, starts)
    return fitted_along(whole, normals[starts], np.add.reduceat(by_point @ moments, starts))


def along_surface(moments: Array, normals: Array) -> Array:
    """(N, 4, 3) functions of h: one, and the two places (m) along a surface about the middle.

    Of moments (N, 4, 4), on surfaces with these normals (N, 3).
    """
    return along_axes(moments, tangent_axes(normals))


def along_axes(moments: Array, axes: Array) -> Array:
    """`along_surface` along two axes (N, 2, 3) of each surface."""
    centroid = moments[:, :3, 3] / moments[:, 3, 3, None]
    out = np.zeros((len(moments), 4, 3))
    out[:, 3, 0] = 1.0
    out[:, :3, 1:] = np.swapaxes(axes, 1, 2)
    out[:, 3, 1:] = -np.einsum("nki,ni->nk", axes, centroid)
    return out
