"""Tilts: how far what a LiDAR shows of a strip is turned against the strip, and how alike.

Walls are plastered, rings fall on joints and bumps, and noise of points turns what is fitted to
them. A LiDAR's yaw is told by the tilts of walls for the most part, so that their errors have sizes
of their own: those of offsets per metre say too little.
"""

from __future__ import annotations

import math

import numpy as np

from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.heavy_tails import heavy_tailed
from caliv_graph.structure.layout import Nuisances
from caliv_graph.structure.patches import along_axes
from caliv_graph.structure.residuals import PLANE_ROWS, Geometry
from caliv_graph.structure.sightings import Sightings

FIRST_TILT_PER_M = (2.0, 1.0)
"""Tilts of sightings of level strips and of others in their offsets, to begin with. The error of a
sighting changes by its own sigma over half a strip: how beams fall on joints, edges and bumps
differs over a strip as much as from scan to scan. On ground over the width of a patch, which has
three rings, each on bumps of its own: tilts of sightings are 2.3 mrad on streets of a simulator
where offsets are 0.8 mm."""

SHORTEST_M, LONGEST_M = 0.1, 10.0
"""Bounds of the distance over which it does: a fifth of a patch, and walls as flat as glass."""

USUAL_RAD = 1e-3
"""1 sigma of what a LiDAR repeats of the tilt of a strip where nothing tells, which counts as one:
1 mm per metre."""

LEAST_RAD, MOST_RAD = 2e-4, 0.05
"""Its smallest and largest sigma."""

STEEPEST_RAD = 1.0
"""Prior of the tilt of a sighting: points on a line do not tell it."""

LEAST_TILTS = 20
"""Tilts, beyond those of the means, that tell the distance at least."""

MOST_TIMES = 30.0
"""How much larger the tilts of a LiDAR are than those of all LiDARs, at most."""

ROUNDS = 20
"""Steps of the likelihood of the sizes, each of which costs next to nothing."""


def first_tilts_per_m(level: BoolArray) -> Array:
    """(K,) `FIRST_TILT_PER_M` of strips, of which some are level."""
    return np.where(level, *FIRST_TILT_PER_M)


def tilts_of(
    sightings: Sightings, geometry: Geometry, own: BoolArray | IntArray
) -> tuple[Array, Array]:
    """Tilts (n, 2) of the points of some sightings to their plane, rad; variances by their noise.

    About the axes of the strips. Without what the noise of the points makes of them: a LiDAR on the
    bumper has patches of 4 cm that rise by 20 mrad, by noise alone. Two of five lost their weight,
    and those that were left were the ones whose noise happened to turn them the other way. By the
    moments as they are, noise included: tilts are too small by its share of these, a seventh for
    4 cm and 10 mm.
    """
    moments, noise = sightings.moments[own], sightings.noise[own]
    N = along_axes(moments, geometry.by[:, PLANE_ROWS][own][:, :2, :3])
    of_points = np.swapaxes(N, 1, 2)
    cov = np.linalg.inv(
        of_points @ moments @ N + np.diag([0.0, STEEPEST_RAD**-2.0, STEEPEST_RAD**-2.0])
    )
    told = np.einsum("qij,qj->qi", moments, geometry.plain[own])
    told -= np.einsum("qij,qj->qi", noise, geometry.placed[own])
    fitted = np.einsum("qij,qjk,qk->qi", cov, of_points, told)
    return fitted[:, 1:], np.diagonal(cov, axis1=1, axis2=2)[:, 1:]


def fitted_tilts(
    sightings: Sightings,
    geometry: Geometry,
    lidar: IntArray,
    weights: Array,
    level: BoolArray,
    sighting_m: Array,
    before: Nuisances,
    lidars: int,
) -> tuple[Array, Array, Array]:
    """1 sigma (K,) of the tilt of a sighting of each strip, and of what a LiDAR repeats of it, rad.

    And (L, 2) how much larger both are of each LiDAR, on ground and on others (`_times`).

    The first in proportion to the sigma of the strip's offset: the scatter of the tilts of one
    LiDAR on one strip is as expected. The second by how far two LiDARs see a strip tilted against
    each other, the strip's own tilt left free, with a t distribution as `Nuisances.strip` has.
    Ground and others apart. A turn of all strips of a scan is none of their errors: a late clock or
    a pose is what it says something of.

    Args:
        sightings: Q of them.
        geometry: residuals at the estimate.
        lidar: (Q,) index of the LiDAR of each.
        weights: (Q,) robust.
        level: (K,) which strips are ground.
        sighting_m: (K,) 1 sigma of the offset of each sighting.
        before: all sizes before.
        lidars: number of the LiDARs, some of which may have no sighting.
    """
    own_rad, repeated = sighting_m * first_tilts_per_m(level), np.array(before.strip_tilt)
    times = np.ones((lidars, 2))
    if len(before.tilt_times):
        times = before.tilt_times.copy()
    at = np.flatnonzero(weights > 0.5)
    if not len(at):
        return own_rad, repeated, times
    tilts, variances = tilts_of(sightings, geometry, at)
    strip = sightings.strip[at]
    own_before, _ = before.tilts(strip, lidar[at], level)
    total = variances + own_before[:, None] ** 2
    tilts, free = _without_turns(tilts, total, geometry, sightings.scan, at)
    key = strip * lidars + lidar[at]
    size = len(level) * lidars
    for of in (level, ~level):
        own = of[strip]
        length_m = _length(tilts[own], variances[own], free[own], key[own], sighting_m[strip[own]])
        if length_m is not None:
            own_rad[of] = sighting_m[of] / length_m
        known, mean, left = np.zeros((3, 2, size))
        for i in range(2):
            w = 1.0 / (variances[own, i] + own_rad[strip[own]] ** 2)
            known[i] = np.bincount(key[own], w, size)
            mean[i] = np.bincount(key[own], w * tilts[own, i], size)
            left[i] = np.bincount(key[own], w * free[own, i], size)
        mean /= np.maximum(known, 1e-12)
        left /= np.maximum(known, 1e-12)
        shape = (2, len(level), lidars)
        if of.any():
            told, tilt, share = (part.reshape(shape)[:, of] for part in (known, mean, left))
            repeated[of] = _repeated(told, tilt, share, repeated[of])
    for kind, of in enumerate((level, ~level)):
        own = of[strip]
        sizes = own_rad[strip[own]], repeated[strip[own]]
        part = tilts[own], variances[own], free[own]
        times[:, kind] = _times(*part, strip[own], lidar[at][own], *sizes, times[:, kind])
    return own_rad, repeated, times


def _without_turns(
    tilts: Array, variances: Array, geometry: Geometry, scan: IntArray, at: IntArray
) -> tuple[Array, Array]:
    """Tilts (n, 2) without the turn of all strips of a scan; how much of each is left, 0 to 1.

    `scan` (Q,) is that of each sighting, `at` (n,) are those that have the tilts.
    """
    axes = geometry.by[:, PLANE_ROWS][at][:, :2, :3]
    by_turn = np.cross(geometry.normals_lidar[at][:, None], axes)
    weighted = by_turn / variances[:, :, None]
    _, number = np.unique(scan[at], return_inverse=True)
    number = number.ravel()
    count = int(number.max()) + 1
    H, g = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(H, number, np.swapaxes(weighted, 1, 2) @ by_turn)
    np.add.at(g, number, np.einsum("qki,qk->qi", weighted, tilts))
    cov = np.linalg.inv(H + STEEPEST_RAD**-2.0 * np.eye(3))
    turn = np.einsum("sij,sj->si", cov, g)[number]
    taken = np.einsum("qki,qij,qkj->qk", weighted, cov[number], by_turn)
    return tilts - np.einsum("qki,qi->qk", by_turn, turn), np.clip(1.0 - taken, 0.0, 1.0)


def _length(
    tilts: Array, variances: Array, free: Array, key: IntArray, sigma_m: Array
) -> float | None:
    """Distance over which errors of sightings change by their sigma; None where too few tell."""
    _, number, count = np.unique(key, return_inverse=True, return_counts=True)
    number = number.ravel()
    expected = float(free.sum()) - 2.0 * len(count)
    if expected < LEAST_TILTS:
        return None
    low, high = math.log(SHORTEST_M), math.log(LONGEST_M)
    for _ in range(ROUNDS):
        middle = 0.5 * (low + high)
        total = variances + (sigma_m * math.exp(-middle))[:, None] ** 2
        t = 0.0
        for i in range(2):
            w = 1.0 / total[:, i]
            mean = np.bincount(number, w * tilts[:, i]) / np.bincount(number, w)
            # Outliers count as three sigmas.
            t += float(np.minimum(w * (tilts[:, i] - mean[number]) ** 2, 9.0).sum())
        low, high = (low, middle) if t > expected else (middle, high)
    return math.exp(0.5 * (low + high))


def _times(
    tilts: Array,
    variances: Array,
    free: Array,
    strip: IntArray,
    lidar: IntArray,
    own_rad: Array,
    repeated_rad: Array,
    before: Array,
) -> Array:
    """(L,) how much larger the tilts of each LiDAR are than those of all, at least once.

    The distances of its tilts from the mean of all LiDARs on the strip are as expected:
    `E (t - m)^2 = v + f^2 (own^2 + repeated^2) - var(m)`. A LiDAR whose points on a strip lie on a
    tenth of a metre, where others have two, shows the tilt of each bump. It is `before` where too
    few tell.

    Args:
        tilts: (n, 2) of sightings, rad.
        variances: (n, 2) of these by the noise of their points.
        free: (n, 2) how much of each is left without the turns of scans.
        strip: (n,) their strips.
        lidar: (n,) their LiDARs.
        own_rad: (n,) 1 sigma of the tilt of a sighting of the strip.
        repeated_rad: (n,) 1 sigma of what a LiDAR repeats of it.
        before: (L,) the times before.
    """
    lidars = len(before)
    seen, number = np.unique(strip * lidars + lidar, return_inverse=True)
    of_strip, place = np.unique(seen // lidars, return_inverse=True)
    number, place = number.ravel(), place.ravel()
    times = before[lidar]
    own_size = np.hypot(own_rad, repeated_rad)
    squares, less = np.zeros((2, len(tilts), 2))
    for i in range(2):
        w = 1.0 / (variances[:, i] + (times * own_rad) ** 2)
        known = np.bincount(number, w, len(seen))
        mean = np.bincount(number, w * tilts[:, i], len(seen)) / np.maximum(known, 1e-12)
        shared = np.zeros(len(seen))
        shared[number] = (times * repeated_rad) ** 2
        of_lidar = 1.0 / (1.0 / np.maximum(known, 1e-12) + shared)
        total = np.bincount(place, of_lidar, len(of_strip))
        middle = np.bincount(place, of_lidar * mean, len(of_strip)) / total
        squares[:, i] = (tilts[:, i] - middle[place[number]]) ** 2
        less[:, i] = 1.0 / total[place[number]]
    out = before.copy()
    for k in range(lidars):
        own = lidar == k
        sizes = own_size[own, None], variances[own], less[own]
        out[k] = _times_of_one(squares[own], *sizes, free[own], float(before[k]))
    return out


def _times_of_one(
    squares: Array, size: Array, variances: Array, less: Array, free: Array, before: float
) -> float:
    """`_times` of one LiDAR, from its rows of the arrays there."""

    def told(times: float) -> tuple[float, float]:
        """Squares in their variances, outliers as three sigmas; and what is expected of them."""
        total = variances + (times * size) ** 2
        expected = free * np.clip(1.0 - less / total, 0.0, 1.0)
        return float(np.minimum(squares / total, 9.0).sum()), float(expected.sum())

    found, expected = told(1.0)
    if expected < LEAST_TILTS:
        return before
    if found <= expected:
        return 1.0
    low, high = 0.0, math.log(MOST_TIMES)
    for _ in range(1, ROUNDS):
        middle = 0.5 * (low + high)
        found, expected = told(math.exp(middle))
        low, high = (middle, high) if found > expected else (low, middle)
    return math.exp(low)


def _repeated(known: Array, mean: Array, left: Array, before: Array) -> Array:
    """(K,) sigmas of what each LiDAR repeats of the tilt of each of K strips.

    Args:
        known: (2, K, L) information of each LiDAR on each of the two tilts, 1/rad^2.
        mean: (2, K, L) these, rad.
        left: (2, K, L) how much of them is left without the turns of scans, 0 to 1.
        before: (K,) the sigmas before.
    """
    seen = known > 0.0
    sigma = before
    for _ in range(ROUNDS):
        variance = sigma[None, :, None] ** 2
        w = np.where(seen, 1.0 / (1.0 / np.where(seen, known, 1.0) + variance), 0.0)
        total = np.maximum(w.sum(axis=2, keepdims=True), 1e-12)
        # The strip's own tilt is free.
        middle = (w * mean).sum(axis=2, keepdims=True) / total
        errors = variance * w * (mean - middle)
        told = np.where(seen, left * variance * w * (1.0 - w / total), 0.0)
        sigma = heavy_tailed(
            told.sum(axis=(0, 2)),
            (errors**2).sum(axis=(0, 2)),
            sigma,
            USUAL_RAD,
            (LEAST_RAD, MOST_RAD),
        )
    return sigma
