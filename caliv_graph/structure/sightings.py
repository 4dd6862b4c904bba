"""Sightings: what one scan of one LiDAR says of one strip, as weighted moments."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from caliv_graph.config.range_errors import GRAZING_COS
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.beams import BeamGroups, SeenBeams, seen_beams
from caliv_graph.structure.bends import seen_bends
from caliv_graph.structure.patches import DrivePatches, along_surface, fitted_over
from caliv_graph.structure.strips import Strips

ROUGHNESS_M = 0.003
"""1 sigma of the surface about its plane from point to point: plaster, joints of bricks."""

BEAM_RAD = 3e-4
"""1 sigma of the direction of a beam: a tenth of the usual divergence of 3 mrad."""

MIN_COS = GRAZING_COS
"""Smallest cosine of the incidence: beyond, footprints are metres long."""


@dataclass(frozen=True)
class Sightings:
    """Q sightings, each of one strip in one scan.

    Attributes:
        scan: (Q,) index of the scan.
        strip: (Q,) index of the strip.
        moments: (Q, 4, 4) sum of w h h^T, h = (p, 1), p in the lidar frame at the scan's stamp, w
            in 1/m^2.
        noise: (Q, 4, 4) what the noise of the points adds to `moments` in the mean. A plane that
            is fitted to moments with noise in them turns towards the beams: on ground by 0.1 mrad
            for a LiDAR on a roof, by 20 for one at the bumper, of each to its own side.
        time_s: (Q,) weighted mean of the times of the points, seconds after the scan's stamp.
        points: (Q,) their number.
        T_vehicle_lidar: of each LiDAR, with which points of other times were moved to the stamps.
        beams: what errors of the beams add; None: they have none.
        bends: (Q, BENDS, 4) what bends of the strips add (`bends.py`); None: strips are flat.
        by_range: (Q, 4) what ranges that are a metre too long add (`seen_ranges`); None: none is.
    """

    scan: IntArray
    strip: IntArray
    moments: Array
    noise: Array
    time_s: Array
    points: Array
    T_vehicle_lidar: tuple[gtsam.Pose3, ...]
    beams: SeenBeams | None = None
    bends: Array | None = None
    by_range: Array | None = None

    @property
    def count(self) -> int:
        """Q."""
        return len(self.scan)

    @property
    def centroids_lidar(self) -> Array:
        """(Q, 3) weighted mean of the points."""
        return self.moments[:, :3, 3] / self.moments[:, 3, 3, None]

    def only(self, keep: IntArray | BoolArray | slice) -> Sightings:
        """Those of a mask or of indices; of a slice without copies."""
        return replace(
            self,
            scan=self.scan[keep],
            strip=self.strip[keep],
            moments=self.moments[keep],
            noise=self.noise[keep],
            time_s=self.time_s[keep],
            points=self.points[keep],
            beams=self.beams and self.beams.only(keep),
            bends=None if self.bends is None else self.bends[keep],
            by_range=None if self.by_range is None else self.by_range[keep],
        )


def moved_moments(moments: Array, R: Array, t: Array) -> Array:
    """Moments (N, 4, 4) of points moved by `R p + t`, (N, 3, 3) and (N, 3)."""
    L = np.zeros_like(moments)
    L[:, :3, :3], L[:, :3, 3], L[:, 3, 3] = R, t, 1.0
    return np.asarray(L @ moments @ np.swapaxes(L, 1, 2))


def point_weights(
    centres_lidar: Array, normals_lidar: Array, range_sigma_m: Array | float
) -> Array:
    """(N,) weight of a point's distance from its plane, 1/m^2.

    Noise along the beam counts by the cosine of the incidence, that across it by the sine.
    `centres_lidar` (N, 3) are seen from where the LiDAR was.
    """
    distance = np.linalg.norm(centres_lidar, axis=1)
    cos = np.abs(np.einsum("ni,ni->n", centres_lidar, normals_lidar)) / distance
    across = (BEAM_RAD * distance) ** 2 * (1.0 - cos**2)
    return np.asarray(1.0 / ((range_sigma_m * cos) ** 2 + across + ROUGHNESS_M**2))


def seen_ranges(moments: Array, origins: Array, normals: Array, starts: IntArray) -> Array:
    """(Q, 4) what ranges that are a metre too long add to the residuals of sightings.

    A point moves by `-cos(incidence)` along the normal. The cosine is by the beam from where the
    LiDAR was when the patch was measured: at the stamp it is half a metre away, and ground that
    is a metre from there would be tilted. Linear within a patch, fitted by a plane over a sighting;
    along the surface only: a change along the normal would scale the points' scatter away.

    Args:
        moments: (n, 4, 4) weighted, of the patches, sighting by sighting, in a lidar frame.
        origins: (n, 3) where the LiDAR was, in that frame.
        normals: (n, 3) of their strips in that frame.
        starts: (Q,) first patch of each sighting.
    """
    middle = moments[:, :3, 3] / moments[:, 3, 3, None]
    from_lidar = middle - origins
    distance = np.maximum(np.linalg.norm(from_lidar, axis=1), 1e-9)[:, None]
    u = from_lidar / distance
    cos = -np.einsum("ni,ni->n", normals, u)
    by_point = np.zeros((len(u), 1, 4))
    by_point[:, 0, :3] = -cos[:, None] * (u + cos[:, None] * normals) / distance
    by_point[:, 0, 3] = cos - np.einsum("ni,ni->n", by_point[:, 0, :3], middle)
    # About their mean: that of a sighting too short to show a slope is known all the same.
    weight = moments[:, 3, 3, None, None]
    mean = np.add.reduceat(weight * by_point, starts) / np.add.reduceat(weight, starts)
    number = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(moments)))
    return np.asarray((mean + fitted_over(by_point - mean[number], moments, normals, starts))[:, 0])


def sightings_of(
    patches: DrivePatches,
    moments_at_stamp: Array,
    origins_at_stamp: Array,
    normals_at_stamp: Array,
    scatter_at_stamp: Array,
    strips: Strips,
    range_sigma_m: Array,
    T_vehicle_lidar: tuple[gtsam.Pose3, ...],
    beams: BeamGroups | None = None,
    bent: tuple[Array, Array] | None = None,
) -> Sightings:
    """Adds up the patches of each strip in each scan.

    Args:
        patches: all patches.
        moments_at_stamp: (N, 4, 4) moments in the lidar frame at the scan's stamp.
        origins_at_stamp: (N, 3) where the LiDAR was when it saw them, in that frame.
        normals_at_stamp: (N, 3) normals of their strips in that frame, of patches on a strip.
        scatter_at_stamp: (N, 3) scatter of their points along the beams, in that frame.
        strips: which patch is on which.
        range_sigma_m: (L,) noise along the beam of each LiDAR.
        T_vehicle_lidar: of each LiDAR, with which points were moved to the stamp.
        beams: what errors of the beams do to the patches; None: they have none.
        bent: centres (N, 3) of their strips in that frame, and axes (N, 2, 3), of patches on a
            strip; None: strips are flat.
    """
    own = np.flatnonzero(strips.of_patch >= 0)
    middles = moments_at_stamp[:, :3, 3] / moments_at_stamp[:, 3, 3, None]
    from_lidar = middles - origins_at_stamp
    seen = np.abs(np.einsum("ni,ni->n", from_lidar[own], normals_at_stamp[own]))
    own = own[seen > MIN_COS * np.linalg.norm(from_lidar[own], axis=1)]
    key = patches.scan[own] * max(strips.count, 1) + strips.of_patch[own]
    order = np.argsort(key, kind="stable")
    own, key = own[order], key[order]
    if not len(own):
        none, nothing = np.zeros(0, np.int64), np.zeros((0, 4, 4))
        return Sightings(none, none, nothing, nothing, np.zeros(0), np.zeros(0), T_vehicle_lidar)
    starts = np.flatnonzero(np.diff(key, prepend=-1))
    sigma = range_sigma_m[patches.scan_lidar[patches.scan[own]]]
    normals = normals_at_stamp[own]
    weight = point_weights(from_lidar[own], normals, sigma)
    weighted = weight[:, None, None] * moments_at_stamp[own]
    moments = np.add.reduceat(weighted, starts)
    of_beams = None
    if beams is not None:
        number = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(own)))
        of_beams = seen_beams(beams, own, number, weight, moments, normals[starts])
    bends = None
    if bent is not None:
        middles, axes = (part[own] for part in bent)
        bends = seen_bends(weighted, middles, axes, normals, strips.of_patch[own], starts)
    noise = np.zeros_like(moments)
    of_patch = weight * moments_at_stamp[own, 3, 3]
    along = np.sqrt(weight)[:, None] * scatter_at_stamp[own]
    noise[:, :3, :3] = np.add.reduceat(along[:, :, None] * along[:, None, :], starts)
    return Sightings(
        scan=patches.scan[own[starts]],
        strip=strips.of_patch[own[starts]],
        moments=moments,
        noise=noise,
        time_s=np.add.reduceat(of_patch * patches.time_s[own], starts) / moments[:, 3, 3],
        points=np.add.reduceat(moments_at_stamp[own, 3, 3], starts),
        T_vehicle_lidar=T_vehicle_lidar,
        beams=of_beams,
        bends=bends,
        by_range=seen_ranges(weighted, origins_at_stamp[own], normals, starts),
    )


def without_own_error(
    sightings: Sightings, normals_lidar: Array, offset_m: Array, tilt_rad: Array
) -> tuple[Array, Array]:
    """Moments (Q, 4, 4) without the own error of each sighting; and what noise adds.

    That error is an offset and two tilts: `S - S N (Sigma^-1 + N^T S N)^-1 N^T S`. However many
    points it has, a sighting knows its strip no better than `offset_m` (Q,) at its middle, and its
    tilt no better than `tilt_rad` (Q,). `normals_lidar` (Q, 3) at the
    scan's stamp.
    """
    S = sightings.moments
    N = along_surface(S, normals_lidar)
    SN = S @ N
    inner = np.swapaxes(N, 1, 2) @ SN
    inner[:, range(3), range(3)] += np.stack([offset_m, tilt_rad, tilt_rad], axis=1) ** -2.0
    K = N @ np.linalg.solve(inner, np.swapaxes(SN, 1, 2))
    left = np.eye(4) - K
    out = S @ left
    noise = np.swapaxes(left, 1, 2) @ sightings.noise @ left
    return np.asarray(0.5 * (out + np.swapaxes(out, 1, 2))), np.asarray(noise)
