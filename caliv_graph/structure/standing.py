"""The vehicle stands on the ground: its height, and its tilt if the user states one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from scipy.spatial import cKDTree

from caliv_graph.geometry.se3 import skew, tangent_axes
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.strips import CELL_M, LEVEL

UNEVEN_M = 0.005
"""1 sigma of the ground below the wheels against the middle of a strip below the vehicle: four
wheels stand on other strips, each uneven by some millimetres."""

UNEVEN_RAD = 0.005
"""1 sigma of the tilt of a strip against that of the ground below four wheels: the same over half a
strip."""


STEP_M = 0.05
"""Largest difference of a height above a strip from the median: kerbs are higher."""

TOO_HIGH_M = 0.5
"""A level strip that is higher than this above where `vehicle_height` has the ground carries no
wheels, beside three of its sigmas. Guesses leave the height of all LiDARs open by less: tape
measures and drawings are good to a decimetre. Decks, roofs and benches are higher."""

TILTED_RAD = 0.2
"""Largest tilt of a strip below the vehicle from the median in its frame: a ramp that its wheels
are on tilts the vehicle as well, and rough guesses are off by less than half of it, which turns
with the heading. A steeper one is the lid of a box or the foot of a bush, and its height goes with
where the vehicle is beside it."""

MOSTLY = 0.5
"""Part of the poses above level strips that are above one that is not so tilted, at least. Where
fewer are, nothing tells which strips the wheels are on, and all count."""

FITTING = 0.1
"""Part of the poses above level strips that are above one that is not too high, at least. Where
fewer are, all strips count: a wrong `vehicle_height` has all of them too high, and the result shows
that it contradicts them."""

BESIDE = 4
"""Level strips next to a pose among which the one below it is looked for."""


@dataclass(frozen=True)
class Standing:
    """What is known of how the vehicle stands.

    Attributes:
        height_m: height of the vehicle frame above the ground; None: unknown.
        height_sigma_m: 1 sigma of it over the drive.
        tilt_sigma_rad: 1 sigma of the vehicle's tilt on the ground over the drive; None: unknown.
        heave_m: 1 sigma of the height from scan to scan.
        sway_rad: 1 sigma of the tilt from scan to scan.
    """

    height_m: float | None
    height_sigma_m: float
    tilt_sigma_rad: float | None
    heave_m: float
    sway_rad: float


@dataclass(frozen=True)
class Stands:
    """Poses and the level strip below each: pose (S,), strip (S,)."""

    pose: IntArray
    strip: IntArray

    def only(self, keep: BoolArray) -> Stands:
        """Those of a mask (S,)."""
        return Stands(self.pose[keep], self.strip[keep])


def stands_of(
    R_map_vehicle: Array,
    t_map_vehicle: Array,
    centres_map: Array,
    normals_map: Array,
    standing: Standing | None = None,
) -> Stands:
    """The level strip below each pose, where there is one.

    Args:
        R_map_vehicle: (M, 3, 3).
        t_map_vehicle: (M, 3) metres.
        centres_map: (K, 3) of all strips.
        normals_map: (K, 3).
        standing: what is known; where other strips are, those far above the ground by it count
            not.
    """
    level = np.flatnonzero(normals_map[:, 2] > LEVEL)
    none = np.zeros(0, dtype=np.int64)
    if not len(level) or not len(t_map_vehicle):
        return Stands(none, none)
    found = cKDTree(centres_map[level, :2]).query(t_map_vehicle[:, :2], np.arange(1, BESIDE + 1))
    apart, beside = np.asarray(found[0]), np.asarray(found[1], dtype=np.int64)
    near = apart < 0.5 * np.sqrt(2.0) * CELL_M
    strip = level[np.where(near, beside, 0)]
    away = t_map_vehicle[:, None] - centres_map[strip]
    heights = np.einsum("mki,mki->mk", normals_map[strip], away)
    fitting = near & (heights > _least_height_m(standing))
    if fitting.any(axis=1).sum() > FITTING * near.any(axis=1).sum():
        near = fitting
    below = np.flatnonzero(near.any(axis=1))
    if not len(below):
        return Stands(none, none)
    tilts = np.einsum("mji,mkj->mki", R_map_vehicle, normals_map[strip])[..., :2]
    usual_tilt = np.median(tilts[below, near[below].argmax(axis=1)], axis=0)
    alike = near & (np.linalg.norm(tilts - usual_tilt, axis=-1) < TILTED_RAD)
    if alike.any(axis=1).sum() >= MOSTLY * len(below):
        near = alike
        below = np.flatnonzero(near.any(axis=1))
    first = below, near[below].argmax(axis=1)
    strip, height = strip[first], heights[first]
    # The nearest strip may be a kerb beside the wheels.
    usual = np.abs(height - np.median(height)) < STEP_M if len(height) else below > 0
    return Stands(below[usual], strip[usual])


def _least_height_m(standing: Standing | None) -> float:
    """Least height of the vehicle frame above a strip that may carry the wheels."""
    if standing is None or standing.height_m is None:
        return -np.inf
    return standing.height_m - TOO_HIGH_M - 3.0 * standing.height_sigma_m


def above_ground_m(
    standing: Standing,
    stands: Stands,
    t_map_vehicle: Array,
    centres_map: Array,
    normals_map: Array,
) -> float:
    """How far above the ground by the known height the strips of the stands are, by the median.

    Zero where they may carry the wheels, there are none, or no height is known. Arguments are as of
    `standing_rows`, at the estimate: what is wrong with the height has moved the LiDARs there.
    """
    if standing.height_m is None or not len(stands.pose):
        return 0.0
    away = t_map_vehicle[stands.pose] - centres_map[stands.strip]
    height_m = float(np.median(np.einsum("si,si->s", normals_map[stands.strip], away)))
    return 0.0 if height_m > _least_height_m(standing) else standing.height_m - height_m


def standing_rows(
    standing: Standing,
    stands: Stands,
    R_map_vehicle: Array,
    t_map_vehicle: Array,
    centres_map: Array,
    normals_map: Array,
    errors: Array,
    first: int,
    plane: int,
    size: int,
) -> tuple[scipy.sparse.csr_array, Array]:
    """Whitened residuals of height and tilt, J (r, `size`) and r.

    Height: `n . (t - c) - height - error`; tilt: x and y of the normal in the vehicle frame, less
    the error of the drive.

    Args:
        standing: what is known.
        stands: which pose is above which strip.
        R_map_vehicle: (M, 3, 3).
        t_map_vehicle: (M, 3) metres.
        centres_map: (K, 3) points of the planes.
        normals_map: (K, 3).
        errors: (3,) errors of height (m) and tilt (rad, x and y) at the estimate.
        first: coordinate of the first of them.
        plane: first coordinate of the planes.
        size: number of coordinates.
    """
    pose, strip = stands.pose, stands.strip
    s = len(pose)
    R, n = R_map_vehicle[pose], normals_map[strip]
    n_vehicle = np.einsum("sji,sj->si", R, n)
    away = t_map_vehicle[pose] - centres_map[strip]
    B = tangent_axes(n)
    blocks, columns, rows, residuals = [], [], [], []
    poses = 6 * pose[:, None] + np.arange(6)
    planes = plane + 3 * strip[:, None] + np.arange(3)
    count = 0
    if standing.height_m is not None:
        sigma = np.hypot(standing.heave_m, UNEVEN_M)
        J = np.zeros((s, 1, 10))
        J[:, 0, 3:6] = n_vehicle
        J[:, 0, 6:8] = np.einsum("ski,si->sk", B, away)
        J[:, 0, 8:10] = -1.0
        r = np.einsum("si,si->s", n, away) - standing.height_m - errors[0]
        blocks.append((J / sigma).ravel())
        residuals.append(r / sigma)
        where = np.concatenate([poses, planes, np.full((s, 1), first)], axis=1)
        columns.append(where.ravel())
        rows.append(np.repeat(np.arange(s), 10))
        count = s
    if standing.tilt_sigma_rad is not None:
        sigma = np.hypot(standing.sway_rad, UNEVEN_RAD)
        J = np.zeros((s, 2, 10))
        J[:, :, :3] = skew(n_vehicle)[:, :2]
        J[:, :, 6:8] = np.einsum("sji,skj->sik", R, B)[:, :2]
        J[:, 0, 8] = J[:, 1, 9] = -1.0
        r = (n_vehicle[:, :2] - errors[1:]) / sigma
        tilt = np.full((s, 1), first + 1)
        where = np.concatenate([poses, planes[:, :2], tilt, tilt + 1], axis=1)
        blocks.append((J / sigma).ravel())
        residuals.append(r.ravel())
        columns.append(np.repeat(where, 2, axis=0).ravel())
        rows.append(count + np.repeat(np.arange(2 * s), 10))
        count += 2 * s
    if not blocks or not count:
        return scipy.sparse.csr_array((0, size)), np.zeros(0)
    where_all = np.concatenate(rows), np.concatenate(columns)
    J_all = scipy.sparse.csr_array((np.concatenate(blocks), where_all), shape=(count, size))
    return J_all, np.concatenate(residuals)


def tilt_rows(
    standing: Standing,
    stands: Stands,
    R_map_vehicle: Array,
    normals_map: Array,
    plane: int,
    size: int,
) -> tuple[Array, Array, float]:
    """Mean of the ground's normal in the vehicle frame: x and y (2,), its rows (2, `size`), sigma.

    The sigma (rad) is that of sway and of the unevenness below the wheels. At least one stand;
    arguments as of `standing_rows`.
    """
    tilted = replace(standing, height_m=None, tilt_sigma_rad=1.0)
    nowhere = np.zeros_like(normals_map)
    t = np.zeros((len(R_map_vehicle), 3))
    J, r = standing_rows(
        tilted, stands, R_map_vehicle, t, nowhere, normals_map, np.zeros(3), size, plane, size + 3
    )
    one = np.hypot(standing.sway_rad, UNEVEN_RAD)
    count = len(stands.pose)
    mean = np.tile(one / count * np.eye(2), count)
    own = UNEVEN_RAD**2 / len(np.unique(stands.strip)) + standing.sway_rad**2 / count
    return mean @ r, np.asarray((J.T @ mean.T).T[:, :size]), float(np.sqrt(own))
