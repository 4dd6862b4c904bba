"""The waves and bends of the ground in its planes, which scans of one place share."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np
from scipy.spatial.distance import cdist

from caliv_graph.calibration.ground_factors import turn_from_guess
from caliv_graph.config.noise import NoiseConfig
from caliv_graph.geometry.se3 import tangent_axes
from caliv_graph.products import Array, GroundObservation
from caliv_graph.targets.ground.planes import RADII_M, ground_floors
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
    which tells outliers and heave, is as before. A bend stays as well (`bends_of_ground`), less
    what of it was the guess with which the scans were compensated.

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
        centres = t + np.einsum("nij,nj->ni", R, centres)
        bends = np.array([_bend_at(o, T.rotation().matrix()) for o in own])
        # The axes of scans jump by a right angle where the ground is level in the LiDAR's frame.
        normal = np.mean([o.normal_lidar for o in own], axis=0)
        axes = tangent_axes(normal / np.linalg.norm(normal))
        turned = np.array([o.axes_lidar for o in own]) @ axes.T
        overlap = overlap_of_discs(centres)
        of_ground = bends_of_ground(
            bends, np.array([o.beyond_variances for o in own]), turned, overlap
        )
        more = np.sqrt(sharing_scans(axes @ to_map, overlap) - 1.0)
        for n, o, by_bend, root in zip(of, own, of_ground, more, strict=True):
            cov = o.cov + np.diag(after**2 - before**2) + by_bend - o.by_bend
            repeated = root[:, None] * (np.diag(after**2) + by_bend) * root
            out[n] = replace(o, cov=cov, by_bend=by_bend, repeated=repeated)
    return tuple(out)


def sharing_scans(axes_map: Array, overlap: Array) -> Array:
    """(N, 3) how many scans of a LiDAR share the deviation (a, b, distance) of each, 1 at least.

    The plane is fitted to a disc; waves shorter than it are averaged there, and two planes share
    what their discs share. A tilt stays in the map, while a and b turn with the LiDAR.

    Args:
        axes_map: (N, 2, 3) of a and b.
        overlap: (N, N) of the discs (`overlap_of_discs`).
    """
    # Half the trace of axes_i axes_j^T: the cosine of how far the LiDAR turned between them.
    along = 0.5 * np.einsum("nki,mki->nm", axes_map, axes_map, optimize=True)
    tilts, distances = (overlap * along).sum(axis=1), overlap.sum(axis=1)
    return np.asarray(np.maximum(np.column_stack([tilts, tilts, distances]), 1.0))


def _bend_at(observation: GroundObservation, R_vehicle_lidar: Array) -> Array:
    """(3,) of (a, b, distance): `beyond` if the scan is compensated with another rotation.

    With a guess that is 3 degrees off, level ground is bent by 0.3 mrad at 3 m/s, in every scan.
    """
    turn = turn_from_guess(observation, R_vehicle_lidar)
    if turn is None or observation.beyond_by_extrinsic is None:
        return observation.beyond
    return np.asarray(observation.beyond + observation.beyond_by_extrinsic @ turn)


def bends_of_ground(bends: Array, variances: Array, turned: Array, overlap: Array) -> Array:
    """(N, 3, 3) of (a, b, distance), what bends the ground at the place of each scan may do.

    What the curvature of a patch does to its plane is of the ground, or of the noise of the scan,
    which is new in each. The bend of a single scan may be small by chance. So this is the mean
    square of the scans that share its disc, less the noise, weighted by how well each tells it. One
    bend tilts a plane and shifts it: both are correlated as in the scans.

    Args:
        bends: (N, 3) of (a, b, distance), rad and metres.
        variances: (N, 3) of these, by noise.
        turned: (N, 2, 2) from axes that are the same in all scans to a and b.
        overlap: (N, N) of the discs (`overlap_of_discs`).
    """
    to_own = np.tile(np.eye(3), (len(bends), 1, 1))
    to_own[:, :2, :2] = turned
    alike = np.einsum("nki,nk->ni", to_own, bends)
    noise = np.einsum("nki,nk->ni", to_own**2, variances)
    # Bends are worth telling from noise down to the size that waves usually have.
    weights = (noise + ground_floors(NoiseConfig()) ** 2) ** -2.0
    total = overlap @ weights
    weighted = np.sqrt(weights) * alike
    squares = np.einsum("na,nb->nab", weighted, weighted).reshape(-1, 9)
    means = (overlap @ squares).reshape(-1, 3, 3)
    of_all = np.einsum("naa->na", means) / total
    left = np.maximum(of_all - overlap @ (weights * noise) / total, 0.0)
    # Of the mean squares a part: a factor on each coordinate keeps them positive definite.
    parts = np.sqrt(left / (np.maximum(of_all, np.finfo(np.float64).tiny) * total))
    return np.asarray(to_own @ (parts[:, :, None] * means * parts[:, None]) @ to_own.swapaxes(1, 2))


def sharing_places(centres_map: Array, weights: Array) -> Array:
    """(N,) the same of the height at places (N, 3), metres, that count with `weights` (N,)."""
    return np.maximum(overlap_of_discs(centres_map) @ weights, 1.0)


def overlap_of_discs(centres_map: Array) -> Array:
    """(N, N) parts of their area that discs about places (N, 3), metres, share."""
    return disc_overlap(cdist(centres_map, centres_map) / (2.0 * RADII_M[-1]))


def disc_overlap(x: Array) -> Array:
    """Part of its area that a disc shares with an equal one, `x` diameters away."""
    x = np.minimum(x, 1.0)
    return np.asarray(2.0 / np.pi * (np.arccos(x) - x * np.sqrt(1.0 - x**2)))
