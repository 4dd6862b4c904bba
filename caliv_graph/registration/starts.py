"""Other starts for clouds that show less of the target than the rest.

Where the motion says little, clouds begin with their middles together. One without its lower third
is then off by a sixth of the target's height, and may end in the nearest fit instead of the right
one. Such a cloud is tried at several places on the shape of the others; the best explanation wins.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from caliv_graph.common.cores import parts
from caliv_graph.products import Array, BoolArray, IntArray, Mixture
from caliv_graph.registration.clouds import CloudStack
from caliv_graph.registration.heights import HeightNoise
from caliv_graph.registration.mixture import expect
from caliv_graph.registration.moments import cell_moments
from caliv_graph.registration.quadratic import quadratic_given_shape
from caliv_graph.targets.cloud.beams import elevations, typical_gap

LESS_HIGH_M = 0.08
"""A cloud whose height is less than the median of all by more than this is suspicious."""

ROWS = 1.2
"""The same in row spacings, where those are wider: how many rows meet a target is chance."""

LESS_WIDE = 0.3
"""A cloud narrower than the median by more than this part of it is suspicious: the width of a chair
differs by less from side to side."""

MOST_SUSPICIOUS = 0.5
"""Where a larger part of the clouds is suspicious, the rest is no shape to compare with."""

START_STEP_M = 0.1
"""Distance between starts: a cloud is drawn in from half of it, one sigma of the first width."""

TRIED_TOGETHER = 64
"""Starts that are fitted in one batch: their sums over points and surfels stay small."""

START_SIGMA_M = 0.05
"""Roughness and width of the surfels at a start. It falls by `NARROWER` per iteration."""

NARROWER = 0.85
ITERATIONS = 16
"""Iterations from each start: annealed to 4 mm, which tells the places apart."""

COMPARED_SIGMA_M = 0.01
"""Places are compared with surfels at least so rough: none of the fits has ended to the
millimetre."""

OUTLIER_DENSITY = 0.1
"""Density of outliers along a beam, per metre and inlier: a tenth of outliers over a metre."""

MISSING_NATS = 4.0
"""Cost of a return that the shape calls for and that is not there: about that of an outlier."""

FACING = 0.3
"""Cosine between beam and surface above which a return is called for."""

BEHIND_M = 0.1
"""A return this much nearer than the surface occludes it, this much farther contradicts it."""

BEAMS_APART = 2.0
"""A surface has a return if there is one within so many spacings of the cloud's own points."""

SAME_PLACE_M = 0.03
"""A start that ends nearer to the present place of the cloud than this is no other one."""

LEAST_WEIGHT = 1e-3
"""Components with less than this part of the mean weight were seeded on clouds that are left out:
each of them would explain its own cloud where that is now."""

LARGEST_STEP = 0.1
"""Largest step of a cloud in one iteration, rad and m."""

STEP_RIDGE = 1e-3
"""Levenberg-Marquardt damping of the steps of a single cloud, relative to its information."""


Move = Callable[[Array, Array, Array], tuple[Array, Array]]
"""From rotations (J, 3, 3), translations (J, 3) and left perturbations (J, 6) to moved ones."""


@dataclass(frozen=True)
class Suspicion:
    """Which clouds show less of the target than the rest.

    Attributes:
        clouds: (S,) their indices.
        up_m: (S,) height that they lack, metres, at least 0.
        across_m: (S,) width that they lack, at right angles to the view, metres, at least 0.
        across: (S, 3) unit vectors of that direction, target frame.
    """

    clouds: IntArray
    up_m: Array
    across_m: Array
    across: Array


def suspicious(clouds: CloudStack, R: Array, t: Array) -> Suspicion:
    """The clouds that are lower or narrower than the median at `T_target_lidar` (R, t).

    None if they are the majority.
    """
    points = clouds.moved(R, t)
    beams = clouds.rotated(R, clouds.beams)
    ends = np.append(clouds.starts, len(points))
    count = clouds.count
    high, wide, rows = np.empty(count), np.empty(count), np.empty(count)
    across = np.empty((count, 3))
    for j in range(count):
        own = slice(ends[j], ends[j + 1])
        view = beams[own].mean(axis=0)
        across[j] = np.array([-view[1], view[0], 0.0]) / max(float(np.hypot(*view[:2])), 1e-9)
        high[j] = float(np.ptp(np.percentile(points[own, 2], [2, 98])))
        wide[j] = float(np.ptp(np.percentile(points[own] @ across[j], [2, 98])))
        range_m = float(np.linalg.norm(clouds.centres[j]))
        rows[j] = typical_gap(elevations(clouds.points[own])) * range_m
    up_m = np.median(high) - high
    across_m = np.median(wide) - wide
    low = up_m > np.maximum(LESS_HIGH_M, ROWS * rows)
    narrow = across_m > LESS_WIDE * np.median(wide)
    found = np.flatnonzero(low | narrow)
    if len(found) > MOST_SUSPICIOUS * count:
        found = found[:0]
    return Suspicion(
        found,
        np.where(low, up_m, 0.0)[found],
        np.where(narrow, across_m, 0.0)[found],
        across[found],
    )


def best_starts(
    clouds: CloudStack,
    mixture: Mixture,
    noise: HeightNoise,
    R: Array,
    t: Array,
    found: Suspicion,
    move: Move,
) -> tuple[Array, Array, BoolArray]:
    """Where the suspicious clouds fit the shape of the others best.

    Args:
        clouds: all clouds.
        mixture: the shape that the others show.
        noise: of the heights of points over it.
        R: (J, 3, 3) rotations of `T_target_lidar`.
        t: (J, 3) translations of it, metres.
        found: the suspicious clouds, S of them.
        move: applies left perturbations to poses (`register.left_step`).

    Returns:
        R (S, 3, 3) and t (S, 3) of them, and (S,) whether that is another place than before.
    """
    mixture = _shown_by_others(mixture)
    R_now, t_now = R[found.clouds], t[found.clouds]
    best_R, best_t, best = R_now.copy(), t_now.copy(), np.full(len(R_now), -np.inf)
    tried, shifts = _shifts(found)
    for some in parts(len(tried), -(-len(tried) // TRIED_TOGETHER)):
        of = tried[some]
        part = clouds.only(found.clouds[of])
        R_end, t_end = _fitted(part, mixture, noise, R_now[of], t_now[of] + shifts[some], move)
        score = _log_likelihood(part, *_widened(mixture, noise, COMPARED_SIGMA_M), R_end, t_end)
        score -= MISSING_NATS * _missing(part, mixture, R_end, t_end)
        for i, s in enumerate(of.tolist()):
            if score[i] > best[s]:
                best_R[s], best_t[s], best[s] = R_end[i], t_end[i], score[i]
    middle = clouds.centres[found.clouds]
    moved = np.einsum("sab,sb->sa", best_R - R_now, middle) + best_t - t_now
    return best_R, best_t, np.linalg.norm(moved, axis=1) > SAME_PLACE_M


def _shifts(found: Suspicion) -> tuple[IntArray, Array]:
    """Where each cloud is tried: over what it lacks itself, and no closer than need be.

    (P,) index of the cloud among the suspicious ones, ascending; (P, 3) displacements, metres,
    target frame, those of a cloud by size: the first is none.
    """
    tried, shifts = [], []
    up = np.array([0.0, 0.0, 1.0])
    lacks = zip(found.up_m.tolist(), found.across_m.tolist(), found.across, strict=True)
    for s, (up_m, across_m, across) in enumerate(lacks):
        own = [u * up + a * across for u in _steps(up_m) for a in _steps(across_m)]
        shifts += sorted(own, key=lambda shift: float(np.abs(shift).max()))
        tried += [s] * len(own)
    return np.array(tried), np.array(shifts)


def _steps(lacks_m: float) -> list[float]:
    """From one end of what a cloud lacks to the other, metres from its middle; with 0."""
    half = math.ceil(0.5 * lacks_m / START_STEP_M)
    return np.linspace(-0.5 * lacks_m, 0.5 * lacks_m, 2 * half + 1).tolist() if half else [0.0]


def _shown_by_others(mixture: Mixture) -> Mixture:
    """The components that stand for points of the other clouds, not for those left out."""
    kept = mixture.weights > LEAST_WEIGHT / len(mixture.weights)
    weights = mixture.weights[kept]
    return Mixture(
        means_target=mixture.means_target[kept],
        normals_target=mixture.normals_target[kept],
        var_tangent=mixture.var_tangent[kept],
        weights=weights / weights.sum(),
    )


def _widened(mixture: Mixture, noise: HeightNoise, sigma_m: float) -> tuple[Mixture, HeightNoise]:
    """The shape and its noise, both at least so wide."""
    wide = np.maximum(mixture.var_tangent, sigma_m**2)
    return replace(mixture, var_tangent=wide), replace(noise, floor_m=sigma_m)


def _fitted(
    clouds: CloudStack, mixture: Mixture, noise: HeightNoise, R: Array, t: Array, move: Move
) -> tuple[Array, Array]:
    """The poses of the clouds, each for itself, on a shape that stays."""
    ones = np.ones(clouds.count)
    for i in range(ITERATIONS):
        shape, wide = _widened(mixture, noise, START_SIGMA_M * NARROWER**i)
        who = expect(clouds, R, t, shape, wide, OUTLIER_DENSITY, ones)
        cells = cell_moments(clouds, who, len(shape.weights))
        H, gradient = quadratic_given_shape(clouds, R, t, shape, cells, who)
        size = np.trace(H, axis1=1, axis2=2) / 6.0
        H = H + (STEP_RIDGE * size + 1e-9)[:, None, None] * np.eye(6)
        d = -np.linalg.solve(H, gradient[..., None])[..., 0]
        largest = np.abs(d).max(axis=1, keepdims=True)
        d = d * np.minimum(1.0, LARGEST_STEP / np.maximum(largest, 1e-12))
        R, t = move(R, t, d)
    return R, t


def _log_likelihood(
    clouds: CloudStack, mixture: Mixture, noise: HeightNoise, R: Array, t: Array
) -> Array:
    """(S,) sums over each cloud's points of the log of inliers and outliers over outliers."""
    who = expect(clouds, R, t, mixture, noise, OUTLIER_DENSITY, np.ones(clouds.count))
    outlier = np.maximum(1.0 - who.explained, 1e-15)
    return -clouds.sum_per_cloud(np.log(outlier))


def _missing(clouds: CloudStack, mixture: Mixture, R: Array, t: Array) -> Array:
    """(S,) how many returns the shape calls for where a cloud has none.

    A component that faces the LiDAR, that lies where the cloud has beams on all sides, and that
    nothing occludes, has to have returned some. What lies outside the cloud's directions may be
    hidden, or outside the field of view.
    """
    out = np.zeros(clouds.count)
    ends = np.append(clouds.starts, len(clouds.points))
    for j in range(clouds.count):
        points = clouds.points[ends[j] : ends[j + 1]]
        means = (mixture.means_target - t[j]) @ R[j]
        normals = mixture.normals_target @ R[j]
        range_m = np.linalg.norm(means, axis=1)
        facing = -np.einsum("ka,ka->k", normals, means) / range_m > FACING
        own, shape = _directions(points), _directions(means)[facing]
        weights, spacing = mixture.weights[facing], _spacing(own)
        # Azimuth and elevation (k, n) apart: numpy is slow along an axis of two.
        off = [shape[:, None, axis] - own[None, :, axis] for axis in (0, 1)]
        apart = [np.abs(of_axis) for of_axis in off]
        beside = [of / one <= BEAMS_APART for of, one in zip(apart, spacing, strict=True)]
        near = beside[0] & beside[1]
        depth = np.linalg.norm(points, axis=1)[None] - range_m[facing, None]
        occluded = (near & (depth < -BEHIND_M)).any(axis=1)
        returned = (near & (np.abs(depth) <= BEHIND_M)).any(axis=1)
        called = ~occluded & _within(off, apart, spacing)
        expected = float(weights[called].sum())
        if expected > 0.0:
            lacking = float(weights[called & ~returned].sum())
            out[j] = len(points) * lacking / expected
    return out


def _directions(points: Array) -> Array:
    """(n, 2) azimuth and elevation of points (n, 3), radians; a target is never behind the jump."""
    middle = points.mean(axis=0)
    turn = np.arctan2(middle[1], middle[0])
    azimuth = np.arctan2(points[:, 1], points[:, 0]) - turn
    azimuth = (azimuth + np.pi) % (2.0 * np.pi) - np.pi + turn
    return np.column_stack([azimuth, elevations(points)])


def _spacing(directions: Array) -> Array:
    """(2,) typical distance of directions (n, 2) along either angle, if they were on a grid."""
    span = np.maximum(np.ptp(directions, axis=0), 1e-4)
    row = max(typical_gap(directions[:, 1]), 1e-4)
    column = span[0] * span[1] / (row * max(len(directions), 1))
    return np.array([max(column, 1e-4), row])


def _within(off: Sequence[Array], apart: Sequence[Array], spacing: Array) -> BoolArray:
    """(k,) which directions of a shape have directions of a cloud on all four sides.

    `off` are the differences (k, n) of all from all along either angle, `apart` their sizes.
    """
    inside = np.ones(len(off[0]), dtype=bool)
    for axis in (0, 1):
        level = apart[1 - axis] <= BEAMS_APART * spacing[1 - axis]
        inside &= (level & (off[axis] >= 0.0)).any(axis=1)
        inside &= (level & (off[axis] <= 0.0)).any(axis=1)
    return np.asarray(inside)
