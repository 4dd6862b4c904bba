"""The waves of the ground in its planes, which scans of one place share."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from caliv_graph.products import Array, GroundObservation
from caliv_graph.targets.ground.planes import RADII_M
from caliv_graph.trajectory.select import VehicleTrajectory


def with_floors(
    observations: Sequence[GroundObservation],
    trajectories: Sequence[VehicleTrajectory],
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
    before: Array,
    after: Array,
) -> tuple[GroundObservation, ...]:
    """Ground observations with other sigmas (3,) of the ground's waves, as often as they count.

    Waves stay where they are: n scans of one place know the plane's deviation once. Each counts
    as 1 / n of an independent one (`GroundObservation.repeated`), which leaves the information of
    all together right and needs no correlation between factors. How far single scans scatter,
    which tells outliers and heave, is as before.

    Args:
        observations: with the floors `before`, every scan for itself.
        trajectories: one per drive.
        T_vehicle_lidar: of every LiDAR, to a few degrees.
        before: (3,) sigmas of (a, b, distance) that are in the observations.
        after: (3,) those that are to be.
    """
    groups: dict[tuple[int, str], list[int]] = defaultdict(list)
    for n, o in enumerate(observations):
        groups[o.drive, o.lidar].append(n)
    out = list(observations)
    for (drive, lidar), of in groups.items():
        own = [observations[n] for n in of]
        T = T_vehicle_lidar[lidar]
        R, t = trajectories[drive].poses_at([o.stamp_ns for o in own])
        centres = np.array([T.transformFrom(o.centre_lidar) for o in own])
        to_map = np.swapaxes(R @ T.rotation().matrix(), 1, 2)
        sharing = sharing_scans(
            np.array([o.axes_lidar for o in own]) @ to_map,
            t + np.einsum("nij,nj->ni", R, centres),
        )
        for n, o, shares in zip(of, own, sharing, strict=True):
            cov = o.cov + np.diag(after**2 - before**2)
            out[n] = replace(o, cov=cov, repeated=(shares - 1.0) * after**2)
    return tuple(out)


def sharing_scans(axes_map: Array, centres_map: Array) -> Array:
    """(N, 3) how many scans of a LiDAR share the deviation (a, b, distance) of each, itself too.

    The plane is fitted to a disc; waves shorter than it are averaged there, and two planes share
    what their discs share. A tilt stays in the map, while a and b turn with the LiDAR.

    Args:
        axes_map: (N, 2, 3) of a and b.
        centres_map: (N, 3) of the discs, metres.
    """
    overlap = _overlap(centres_map)
    # Half the trace of axes_i axes_j^T: the cosine of how far the LiDAR turned between them.
    along = 0.5 * np.einsum("nki,mki->nm", axes_map, axes_map, optimize=True)
    tilts = np.maximum((overlap * along).sum(axis=1), 1.0)
    return np.column_stack([tilts, tilts, overlap.sum(axis=1)])


def sharing_places(centres_map: Array, weights: Array) -> Array:
    """(N,) the same of the height at places (N, 3), metres, that count with `weights` (N,)."""
    return np.maximum(_overlap(centres_map) @ weights, 1.0)


def _overlap(centres_map: Array) -> Array:
    """(N, N) parts of their area that discs share."""
    apart = np.linalg.norm(centres_map[:, None] - centres_map[None], axis=2)
    return disc_overlap(apart / (2.0 * RADII_M[-1]))


def disc_overlap(x: Array) -> Array:
    """Part of its area that a disc shares with an equal one, `x` diameters away."""
    x = np.minimum(x, 1.0)
    return np.asarray(2.0 / np.pi * (np.arccos(x) - x * np.sqrt(1.0 - x**2)))
