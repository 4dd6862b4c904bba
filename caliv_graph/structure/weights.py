"""Robust weights of sightings: which of them are of one piece of surface.

A kerb in a cell of the map makes patches that lie on road and pavement. Some are seen off their
strip or tilted; others make a strip of their own, with a bend that explains them, and each LiDAR
has others: S2S pitch of a drive along kerbs was 0.16 mrad off at a claimed 0.036.
"""

from __future__ import annotations

import numpy as np

from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.bends import BENDS
from caliv_graph.structure.layout import Layout, Nuisances
from caliv_graph.structure.noise import common_sigma, offset_variances
from caliv_graph.structure.residuals import Geometry
from caliv_graph.structure.sightings import Sightings
from caliv_graph.structure.tilts import tilts_of

Spreads = tuple[float, float]
"""Number of sigmas up to which a weight is full, and from which it is none."""

SPREADS: Spreads = (3.0, 6.0)
"""Of the offset of a sighting; and of its tilt, of ground."""

BEND_SPREADS: Spreads = (5.0, 10.0)
"""Of the bend of a strip of ground, in the median of their sizes. On ground without steps the most
of 450 to 660 strips is 4 to 7 (crowns, waves, a hill); strips over a kerb have 11 to 28."""

SCATTER_SPREADS: Spreads = (3.0, 6.0)
"""Of the variance of the points of a sighting of ground about its own plane, in medians."""

LEAST_BEND_PER_M = 1e-3
"""Smallest such median: half a millimetre over 2 m is no step on the flattest floor."""

DISTANCES, LEAST_SIGHTINGS = 8, 50
"""Classes of distance in which these medians are taken, at most, and sightings of each at least."""

LEAST_SCATTER = 0.25
"""Smallest median of that variance, in variances of the noise: where it is less, a sighting with
the noise that was expected keeps its weight."""

CHANCE = 3.0
"""Sigmas by which that variance is larger by chance where a sighting has few points."""


def ground_weights(
    geometry: Geometry, sightings: Sightings, lidar: IntArray, level: BoolArray
) -> Array:
    """(Q,) weights of sightings of ground by tilt and scatter; walls have all of theirs.

    Args:
        geometry: residuals.
        sightings: Q of them.
        lidar: (Q,) index of the LiDAR of each.
        level: (K,) the strips that are ground.
    """
    by_scatter = scatter_weights(sightings, lidar, level)
    return tilt_weights(geometry, sightings, level) * by_scatter


def robust_weights(
    offsets_m: Array, sightings: Sightings, sigma_m: Array, shared_m: float
) -> Array:
    """(Q,) weights by the offset of each sighting: full, falling to none between `SPREADS`.

    Args:
        offsets_m: (Q,).
        sightings: Q of them.
        sigma_m: (Q,) `Nuisances.offsets`.
        shared_m: `Nuisances.shared`.
    """
    variance = offset_variances(sightings, sigma_m) + shared_m**2
    return _falling(np.abs(offsets_m) / np.sqrt(variance), SPREADS)


def tilt_weights(geometry: Geometry, sightings: Sightings, level: BoolArray) -> Array:
    """(Q,) weights by the tilt of each sighting of ground, likewise, in units of what is common.

    Three rings over a kerb lie on a plane, and its middle may well be on the road's. Walls have all
    of theirs: where a vehicle's heading errs, or its clock, they are tilted against each other, and
    this is how it shows. `level` (K,) are the strips that are ground.
    """
    out = np.ones(sightings.count)
    own = level[sightings.strip]
    if not own.any():
        return out
    tilts, variances = tilts_of(sightings, geometry, own)
    common = common_sigma(tilts.ravel(), variances.ravel(), 1.0)
    sigmas = np.abs(tilts) / np.sqrt(variances + common**2)
    out[own] = _falling(sigmas.max(axis=1, initial=0.0), SPREADS)
    return out


def bend_weights(errors: Array, layout: Layout, nuisances: Nuisances, level: BoolArray) -> Array:
    """(K,) weights of strips by their bends: ground that bends far more than the rest has a step.

    `errors` (D,) are at the coordinates of `layout`; `level` (K,) are the strips that are ground.
    """
    out = np.ones(layout.strips)
    if not layout.bent or not level.any():
        return out
    along, twist, across = errors[layout.bend : layout.surface_error].reshape(BENDS, -1)[:, level]
    middle, half = 0.5 * (along + across), np.hypot(0.5 * (along - across), twist)
    most = np.abs(middle) + half  # the larger eigenvalue
    unit = max(float(np.median(nuisances.bend[level])), LEAST_BEND_PER_M)
    out[level] = _falling(most / unit, BEND_SPREADS)
    return out


def scatter_weights(sightings: Sightings, lidar: IntArray, level: BoolArray) -> Array:
    """(Q,) weights by how far the points of a sighting of ground are from their own plane.

    In medians over the ground of the LiDAR that is about as far away: noise may grow with distance
    and flat incidence. `lidar` (Q,) and `level` (K,) as in `ground_weights`.
    """
    out = np.ones(sightings.count)
    ground = np.flatnonzero(level[sightings.strip])
    S, free = sightings.moments[ground], np.maximum(sightings.points[ground] - 3.0, 1.0)
    middle = sightings.centroids_lidar[ground]
    spread = S[:, :3, :3] - S[:, 3, 3, None, None] * middle[:, :, None] * middle[:, None, :]
    square = np.linalg.eigvalsh(spread)[:, 0] / free
    low, high = SCATTER_SPREADS
    for i in np.unique(lidar[ground]).tolist():
        of_lidar = np.flatnonzero(lidar[ground] == i)
        by_distance = of_lidar[np.argsort(np.linalg.norm(middle[of_lidar], axis=1), kind="stable")]
        parts = min(DISTANCES, max(1, len(of_lidar) // LEAST_SIGHTINGS))
        for own in np.array_split(by_distance, parts):
            times = square[own] / max(float(np.median(square[own])), LEAST_SCATTER)
            chance = np.maximum(1.0, (1.0 + CHANCE * np.sqrt(2.0 / free[own])) / low)
            out[ground[own]] = _falling(times / chance, (low, high))
    return out


def _falling(t: Array, spreads: Spreads) -> Array:
    """(n,) weights by numbers of sigmas t (n,)."""
    low, high = spreads
    return np.clip((high - t) / (high - low), 0.0, 1.0)
