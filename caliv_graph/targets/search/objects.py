"""Segmentation of one scan: the ground removed, the rest clustered, each cluster described."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from caliv_graph.products import Array, IntArray
from caliv_graph.targets.ground.surface import GroundSurface, fit_surface

MAX_RANGE_M = 30.0
"""Maximum range of an object: farther ones have few points, and the guess displaces them far."""

BEYOND_M = 4.0
"""Points up to this much farther are clustered too: an object that reaches beyond MAX_RANGE_M is
recognised."""

CLEARANCE_M = 0.12
"""Points nearer to the ground surface than this are ground."""

CEILING_M = 4.0
"""Points higher above the ground than this belong to no object."""

VOXEL_M = 0.1
"""Clustering looks at one point per voxel of this size."""

LINK_M = 0.3
"""Points nearer than this belong to one object; in sparse clouds the distance is larger."""

MAX_LINK_M = 1.0
"""Points farther apart than this do not, whatever the spacing of the beams."""

LINK_BEAMS = 2.5
"""Points are linked up to this many beam spacings: across one beam that hit something else."""

LINKS_PER_POINT = 4
"""Links per point that connected components are looked for with at first."""

VERTICAL = 0.4
"""Factor on distances along z: rings of a LiDAR are farther apart than its columns."""

AZIMUTH_BIN_RAD = math.radians(0.5)
"""Size of the bins of azimuth in which returns are counted."""

BIN_RAD = math.radians(2.0)
"""Size of the bins of direction in which beams are counted."""

MIN_POINTS = 6
"""Minimum number of points of an object."""

WIDE_M = 1.75
"""Maximum width of a target, 1.5 m, with noise and mixed returns."""

DIRECTIONS = np.linspace(0.0, math.pi, 12, endpoint=False)
"""Directions in which widths are measured: the largest width is at most 1 % larger."""

TRIM = 0.02
"""Part of the points trimmed at each end of a width: mixed returns trail behind edges."""

OCCLUDED_M = 0.4
"""A return nearer than the object by more than this is an occluder."""

BESIDE_RAD = math.radians(0.8)
"""Angle beside an object within which occluders are searched."""


@dataclass(frozen=True)
class ScanObject:
    """A cluster of points above the ground in one scan.

    Lengths in metres, in level axes about the LiDAR: the axes of the map, as good as the guess.

    Attributes:
        centre: (3,) middle of the points, lidar frame.
        base: (3,) below it, on the ground, lidar frame.
        range_m: horizontal distance of the nearest points.
        extent_m: largest horizontal width.
        bottom_m: of its lowest points above the ground; NaN where no ground was seen nearby.
        top_m: of its highest points above the ground; NaN likewise.
        points: how many.
        azimuth: (2,) radians, from and to, lidar frame; from is in (-pi, pi].
        elevation: of its lowest and of its highest beam, lidar frame, radians.
        hidden: it may be larger than it appears, since an occluder is beside it or it reaches
            beyond MAX_RANGE_M.
        outline: (m, 3) some of its points, lidar frame.
    """

    centre: Array
    base: Array
    range_m: float
    extent_m: float
    bottom_m: float
    top_m: float
    points: int
    azimuth: tuple[float, float]
    elevation: tuple[float, float]
    hidden: bool
    outline: Array


@dataclass(frozen=True)
class ScanObjects:
    """The objects of one scan.

    Attributes:
        objects: clusters above the ground.
        azimuths: (n,) bins of 0.5 degrees in which there are returns, ascending.
        elevation: of the lowest and of the highest beam that returned anything, lidar frame,
            radians.
        has_ground: whether ground was found.
    """

    objects: tuple[ScanObject, ...]
    azimuths: IntArray
    elevation: tuple[float, float]
    has_ground: bool


def segment_scan(points_lidar: Array, R_map_lidar: Array) -> ScanObjects:
    """Segments a scan (N, 3), metres, lidar frame, motion compensated, into ground and objects.

    `R_map_lidar` (3, 3) is the attitude of the LiDAR, as good as the guess.
    """
    azimuth = np.arctan2(points_lidar[:, 1], points_lidar[:, 0])
    across = np.hypot(points_lidar[:, 0], points_lidar[:, 1])
    elevation = np.arctan2(points_lidar[:, 2], across)
    bins = np.unique(np.floor(azimuth / AZIMUTH_BIN_RAD).astype(np.int64))
    ends = float(elevation.min(initial=0.5 * math.pi)), float(elevation.max(initial=-0.5 * math.pi))
    range_m = np.hypot(across, points_lidar[:, 2])
    near = np.flatnonzero(range_m < MAX_RANGE_M + BEYOND_M)
    level = points_lidar[near] @ R_map_lidar.T
    surface = fit_surface(level)
    if surface is None:
        return ScanObjects((), bins, ends, False)
    height = level[:, 2] - surface.height_at(level[:, :2])
    above = (height > CLEARANCE_M) & (height < CEILING_M)
    stands = _Standing(
        index=near[above],
        level=level[above],
        height=height[above],
        azimuth=azimuth[near[above]],
        elevation=elevation[near[above]],
        range_m=range_m[near[above]],
    )
    bins_of = _direction_bin(stands.elevation), _direction_bin(stands.azimuth)
    spacing = _beam_spacing(azimuth, elevation)[bins_of]
    labels = _clusters(stands, spacing)
    objects = _describe(stands, labels, points_lidar, R_map_lidar, surface, spacing)
    return ScanObjects(tuple(objects), bins, ends, True)


@dataclass(frozen=True)
class _Standing:
    """Points above the ground: indices (n,) in the scan, places in level axes, directions."""

    index: IntArray
    level: Array
    height: Array
    azimuth: Array
    elevation: Array
    range_m: Array


def _direction_bin(angle: Array) -> IntArray:
    bins: IntArray = np.floor((angle + math.pi) / BIN_RAD).astype(np.int64)
    return bins % round(2.0 * math.pi / BIN_RAD)


def _beam_spacing(azimuth: Array, elevation: Array) -> Array:
    """Angle between neighbouring beams by bins of elevation and azimuth, from the returns.

    Rings may be unevenly spaced. A bin half in the sky takes the density of its neighbours.
    """
    n = round(2.0 * math.pi / BIN_RAD)
    key = _direction_bin(elevation) * n + _direction_bin(azimuth)
    count = np.bincount(key, minlength=n * n).reshape(n, n).astype(np.float64)
    solid = np.cos((np.arange(n) + 0.5) * BIN_RAD - math.pi)[:, None]
    density = count / np.maximum(np.abs(solid), 0.1)
    # The largest of the nine about each bin; scipy.ndimage takes a fifth of a second to import.
    for axis in (0, 1):
        beside = np.roll(density, 1, axis), np.roll(density, -1, axis)
        density = np.maximum(density, np.maximum(*beside))
    return np.asarray(BIN_RAD / np.sqrt(np.maximum(density, 0.25)))


def _clusters(stands: _Standing, spacing: Array) -> IntArray:
    """(n,) labels of connected components, on one point per voxel."""
    if not len(stands.level):
        return np.zeros(0, dtype=np.int64)
    cell = np.floor(stands.level / VOXEL_M).astype(np.int64) + 4096
    key = (cell[:, 0] * 8192 + cell[:, 1]) * 8192 + cell[:, 2]
    _, first, member = np.unique(key, return_index=True, return_inverse=True)
    points = stands.level[first] * np.array([1.0, 1.0, VERTICAL])
    link = np.clip(LINK_BEAMS * spacing[first] * stands.range_m[first], LINK_M, MAX_LINK_M)
    tree = cKDTree(points)
    pairs = [tree.query_pairs(LINK_M, output_type="ndarray")]
    sparse = np.flatnonzero(link > LINK_M)
    if len(sparse):
        found = tree.query_ball_point(points[sparse], link[sparse])
        counts = np.array([len(f) for f in found])
        to = np.fromiter(itertools.chain.from_iterable(found), np.intp, int(counts.sum()))
        pairs.append(np.column_stack([np.repeat(sparse, counts), to]))
    of_point: IntArray = connected(np.vstack(pairs), len(points))[member.ravel()]
    return of_point


def connected(pairs: IntArray, count: int) -> IntArray:
    """Labels (count,) of the connected components of points, given linked pairs (p, 2) of them.

    They are numbered in the order of their first points.
    """
    # A dense object has hundreds of links per point. A few per point join nearly all of it, and
    # only those that join more count then.
    every = max(len(pairs) // (LINKS_PER_POINT * max(count, 1)), 1)
    labels = _components(pairs[::every], count)
    if every > 1:
        first, second = (labels.take(pairs[:, end]) for end in (0, 1))
        apart = np.flatnonzero(first != second)
        ends = np.column_stack([first.take(apart), second.take(apart)])
        labels = _components(ends, int(labels.max()) + 1).take(labels)
    return labels


def _components(pairs: IntArray, count: int) -> IntArray:
    """`connected`, of pairs that are all looked at."""
    links = np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])
    graph = coo_array(links, shape=(count, count))
    _, labels = connected_components(graph, directed=False)
    return np.asarray(labels, dtype=np.int64)


def _describe(
    stands: _Standing,
    labels: IntArray,
    points_lidar: Array,
    R_map_lidar: Array,
    surface: GroundSurface,
    spacing: Array,
) -> list[ScanObject]:
    """The clusters of at least MIN_POINTS points within MAX_RANGE_M."""
    order = np.argsort(labels, kind="stable")
    splits = np.flatnonzero(np.diff(labels[order])) + 1
    by_azimuth = np.argsort(stands.azimuth, kind="stable")
    sorted_azimuth = stands.azimuth[by_azimuth]
    # Of a LiDAR that hangs upside down, the beams of high elevation look at the ground.
    upwards = 1.0 if R_map_lidar[2, 2] >= 0.0 else -1.0
    out = []
    for member in np.split(order, splits):
        if len(member) < MIN_POINTS or stands.range_m[member].min() > MAX_RANGE_M:
            continue
        level = stands.level[member]
        middle, extent = _middle_and_extent(level[:, :2])
        azimuth = _unwrapped(stands.azimuth[member])
        low, high = float(azimuth.min()), float(azimuth.max())
        range_m = float(np.quantile(np.hypot(level[:, 0], level[:, 1]), 0.1))
        hidden = bool(stands.range_m[member].max() > MAX_RANGE_M)
        if not hidden and extent < WIDE_M:
            beside = max(BESIDE_RAD, 2.0 * float(np.median(spacing[member])))
            up = upwards * stands.elevation
            elevations = np.quantile(up[member], [0.3, 1.0])
            for side in (low - beside, high):
                other = by_azimuth[_within(sorted_azimuth, side, side + beside)]
                in_front = stands.range_m[other] < stands.range_m[member].min() - OCCLUDED_M
                level_with = (up[other] > elevations[0]) & (
                    up[other] < elevations[1] + 2.0 * beside
                )
                hidden = hidden or bool((in_front & level_with).sum() >= 2)
        ground_z = float(surface.height_at(middle[None])[0])
        known = bool(surface.is_seen_at(middle[None])[0])
        height = np.quantile(stands.height[member], [TRIM, 1.0 - TRIM]) if known else [math.nan] * 2
        centre = np.array([*middle, ground_z + 0.5 * float(stands.height[member].max())])
        step = max(1, len(member) // 100)
        out.append(
            ScanObject(
                centre=R_map_lidar.T @ centre,
                base=R_map_lidar.T @ np.array([*middle, ground_z]),
                range_m=range_m,
                extent_m=extent,
                bottom_m=float(height[0]),
                top_m=float(height[1]),
                points=len(member),
                azimuth=(low, high),
                elevation=(
                    float(stands.elevation[member].min()),
                    float(stands.elevation[member].max()),
                ),
                hidden=hidden,
                outline=points_lidar[stands.index[member[::step]]],
            )
        )
    return out


def _middle_and_extent(xy: Array) -> tuple[Array, float]:
    """Middle of the points (n, 2) and the largest of their widths, trimmed at both ends."""
    axes = np.stack([np.cos(DIRECTIONS), np.sin(DIRECTIONS)])
    low, high = np.quantile(xy @ axes, [TRIM, 1.0 - TRIM], axis=0)
    quarter = len(DIRECTIONS) // 2
    middle = 0.5 * (low + high)[[0, quarter]]
    return np.asarray(middle), float((high - low).max())


def _unwrapped(azimuth: Array) -> Array:
    """Azimuths within pi of the first of them."""
    reference = float(azimuth[0])
    return np.asarray(reference + (azimuth - reference + math.pi) % (2.0 * math.pi) - math.pi)


def _within(sorted_azimuth: Array, begin: float, end: float) -> IntArray:
    """Indices of the sorted azimuths in [begin, end], across the jump at pi too."""
    out = []
    for circle in (-2.0 * math.pi, 0.0, 2.0 * math.pi):
        first, last = np.searchsorted(sorted_azimuth, [begin + circle, end + circle])
        out.append(np.arange(first, last))
    return np.concatenate(out)
