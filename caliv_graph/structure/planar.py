"""Flat patches of one scan: points are grouped by direction, fitted, tested and reduced.

Points are grouped by the *direction of their beam*, not by their place. The noise of a range moves
a point along its beam and never into another group. Cells in space would cut the noise of a wall
that lies along their border, and bias both halves.

Cells are those of a cube around the LiDAR, halved until they span about `PATCH_M` at the range they
see. A cell with too few points, or with one or two lines of them (the rings of a LiDAR of few
channels), is judged again together with its neighbours: first above and below, then all around.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from caliv_graph.common.sorting import stable_order
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.channels import ChannelSums, PointChannels
from caliv_graph.structure.patches import RangeNoise, Swept, scatter_of_ranges, spread_of

PATCH_M = 0.5
"""Width of a patch across the beams: below the cells of 1 to 2 m over which real walls are uneven,
and wide enough for tens of points."""

MAX_PATCH_M = 2.0
"""Greatest length of a patch. Walls are not flat beyond this (bumps of 5 mm per 1 to 2 m)."""

ROOT_CELLS = 12
"""Coarsest cells along the edge of a face of the cube: 7.5 degrees, 0.5 m at 4 m."""

FINEST = 5
"""Halvings of the coarsest cells at most: 0.23 degrees, 0.5 m at 120 m."""

SHAPES = ((0, 0), (0, 1), (0, 2), (2, 2))
"""Halvings that are undone across and along the axis of the LiDAR, in this order, for what is still
undecided: rings of 2 degrees need cells of 7.5 to have three of them, but not so wide ones."""

SLOT_S = 0.01
"""Points of a patch are from one slot of this length. Within 5 ms of their mean time, an extrinsic
that is 3 degrees off moves a point by 1 mm at 0.3 rad/s and 15 m; the mean itself is exact."""

MIN_POINTS = 12
"""Of a patch: a plane takes three, and its tests need as many again for each axis."""

ROUGHNESS_M = 0.01
"""Scatter of plaster, brick and cladding about a plane of 0.5 m, 1 sigma, beside the range noise.
Hedges have 30 mm and more."""

MAX_SCATTER = 1.5
"""Largest scatter in units of the expected one. 12 points scatter so much by chance in 1 of 100
patches; a step of 0.1 m under a patch makes 25 mm."""

MIN_WIDTH = 4.0
"""Smallest width in units of the scatter, across the surface and of the ranges in the direction of
the width, all standard deviations: the narrower direction is then clearly in the surface. One line
of points on the ground at a grazing angle is as wide as its ranges scatter, and on no plane but
that of its beams: 14 mm of noise in 18 of width tilt a patch by 0.1 rad (`slalom` of the second
simulator, a rosette at the bumper: S2S pitch 2.7 mrad off at a claimed 0.16)."""

MAX_TILT_RAD = 0.03
"""Greatest uncertainty of the normal that the points leave: 2 degrees."""

MIN_SPREAD = 0.25
"""Pearson's kurtosis - skewness^2 - 1 of the places along an axis is zero for points on two lines,
0.5 on three, 0.8 for evenly spread ones. Two lines always lie on some plane, so they prove none."""

MIN_CHANNELS = 3
"""Channels of a patch at least, where they are known and so many fit into one. The rings of two are
curved, so that they pass for three lines; where they fall on either side of a kerb, all that is
seen of it is a tilt."""

MAX_BEND_M = 0.005
"""Greatest root mean square of bend and steps (second and third order) beyond what noise makes: a
corner or a reveal of 3 cm within the patch makes more."""

MAX_SKEWNESS = 4.0
"""Largest skewness of the points along the normal, in units of that of symmetric noise by chance,
sqrt(6/n). At an edge a patch holds some points of what stands up or lies lower: the foot of a kerb,
a tyre, the jamb of a window. They are all on one side. On ground at a grazing angle, with 3 mm of
noise along its normal, 5 points of 100 that are 20 mm up do not even double the scatter, but tilt
the patch towards its LiDAR by 10 mrad. The skewness is 2.5 then, ten times that of chance."""

LEAST_SKEWNESS = 0.5
"""Skewness that is accepted however many points there are: noise of real ranges is not quite
symmetric. It takes 2 points of 1000 at seven sigmas, which move a patch by 0.01 sigmas."""

MIN_INCIDENCE_COS = math.cos(math.radians(80.0))
"""Patches under a larger incidence are dropped. The normal of a patch is known to some 20 mrad:
patches that are chosen by it lean towards the LiDAR where the limit is, by 10 mrad. So what is used
is chosen by the normals of strips (`sightings.MIN_COS`)."""

MAX_POINTS = 50_000
"""Points of a scan that are used; of denser clouds an even part. Patches of 0.5 m keep enough."""

MAX_PATCHES = 1500
"""Patches that are kept of a scan; of more an even part over all directions."""

GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
"""Multiples of the golden ratio are evenly spread and have no period that a pattern of channels
could share."""


@dataclass(frozen=True)
class ScanPatches:
    """Patches of one scan, as in `DrivePatches`.

    Attributes:
        time_s: (n,) seconds after the stamp.
        moments: (n, 4, 4) metres, lidar frame at the patch's own time.
        normal_lidar: (n, 3) unit, towards the LiDAR.
        scatter_m: (n,) standard deviation along the normal.
        swept: how points were moved to that time; None without motion.
        channels: what the points of each channel add; None: the scan has none.
        undecided: points in groups that are too few or too thin to be judged.
        uneven: points in groups that are not flat.
        grazing: points in flat groups under a flat angle or too long.
    """

    time_s: Array
    moments: Array
    normal_lidar: Array
    scatter_m: Array
    swept: Swept | None = None
    channels: ChannelSums | None = None
    undecided: int = 0
    uneven: int = 0
    grazing: int = 0

    def part(self, keep: BoolArray | IntArray) -> ScanPatches:
        """Some of the patches; the counts stay."""
        return replace(
            self,
            time_s=self.time_s[keep],
            moments=self.moments[keep],
            normal_lidar=self.normal_lidar[keep],
            scatter_m=self.scatter_m[keep],
            swept=self.swept and self.swept.part(keep),
            channels=self.channels and self.channels.part(keep, len(self.time_s)),
        )


@dataclass(frozen=True)
class SweepMotion:
    """Motion of a LiDAR during a scan: constant twist in each slot.

    Attributes:
        first_s: start of the first slot, seconds after the stamp.
        turn: (k, 3) rad/s, lidar frame, of each slot of `SLOT_S`.
        velocity: (k, 3) m/s, lidar frame.
    """

    first_s: float
    turn: Array
    velocity: Array


def planar_patches(
    points: Array,
    noise: RangeNoise,
    times_s: Array | None = None,
    motion: SweepMotion | None = None,
    by_channel: bool = False,
) -> ScanPatches:
    """The flat patches of a scan.

    Args:
        points: (N, 3) metres, lidar frame, as measured, without the origin.
        noise: along the beam.
        times_s: (N,) seconds after the stamp; None: all at the stamp.
        motion: of the LiDAR, over the span of these times; given with them.
        by_channel: whether what the points of each channel add is kept, where it has channels.
    """
    points, times_s = _even_part(points, times_s)
    cells = _cells(points)
    channels = PointChannels.found(points) if by_channel else None
    slot = np.zeros(len(points), dtype=np.int64)
    if times_s is not None and motion is not None:
        slot = np.clip(((times_s - motion.first_s) / SLOT_S).astype(np.int64), 0, None)
        slot = np.minimum(slot, len(motion.turn) - 1)
    left = np.arange(len(points))
    by_axis = points.T.copy()  # numpy is fast along a row
    found: list[ScanPatches] = []
    uneven = grazing = 0
    for undone in SHAPES:
        groups = _grouped(cells, left, undone, slot)
        left = left[groups.order]
        enough = groups.count >= MIN_POINTS
        chosen = np.repeat(enough, groups.count)
        some = left[chosen]
        at, times = by_axis.take(some, axis=1), None if times_s is None else times_s[some]
        own, number = channels and channels.only(some), groups.count[enough]
        patches, decided = _judged(number, at, times, motion, slot[some], noise, own)
        judged = np.zeros(len(left), dtype=bool)
        judged[chosen] = np.repeat(decided, number)
        found.append(patches)
        uneven += patches.uneven
        grazing += patches.grazing
        left = left[~judged]
        left = left[cells.level[left] > 0]
        if not len(left):
            break
    return _joined(found, len(points), uneven, grazing)


def _even_part(points: Array, times_s: Array | None) -> tuple[Array, Array | None]:
    """At most `MAX_POINTS` points, the same of the same cloud."""
    if len(points) <= MAX_POINTS:
        return points, times_s
    turns = np.arange(len(points)) * GOLDEN
    keep = turns - np.floor(turns) < MAX_POINTS / len(points)
    # Indexing with a mask takes four times as long.
    return points.compress(keep, axis=0), None if times_s is None else times_s.compress(keep)


@dataclass(frozen=True)
class _Cells:
    """The finest cell of each point (N,): face of the cube, places across and along the axis z.

    `level` is how often the coarsest cell of the point is halved.
    """

    face: IntArray
    across: IntArray
    along: IntArray
    level: IntArray


def _cells(points: Array) -> _Cells:
    """The cells of points (N, 3)."""
    x, y, z = points.T.copy()  # numpy is fast along a row
    is_y = np.abs(y) > np.abs(x)
    wider = np.where(is_y, y, x)
    is_z = np.abs(z) > np.abs(wider)
    height = np.where(is_z, z, wider)
    face = 2 * np.where(is_z, 2, is_y) + (height < 0.0)
    width = ROOT_CELLS << FINEST
    # x: y and z; y: x and z; z: x and y.
    across = np.where(is_y | is_z, x, y)
    along = np.where(is_z, y, z)
    place = []
    for side in (across, along):
        part = (np.arctan(side / np.abs(height)) * (2.0 / math.pi) + 0.5) * width
        place.append(np.clip(part.astype(np.int64), 0, width - 1))
    root = (face * ROOT_CELLS + (place[0] >> FINEST)) * ROOT_CELLS + (place[1] >> FINEST)
    # The level is common to a whole coarse cell, so that it does not depend on a point's noise.
    number = 6 * ROOT_CELLS**2
    count = np.maximum(np.bincount(root, minlength=number), 1)
    log_range = 0.5 * np.log2(np.einsum("ni,ni->n", points, points))
    mean = np.bincount(root, log_range, number) / count
    level = np.round(mean + math.log2(0.5 * math.pi / ROOT_CELLS / PATCH_M))
    level = np.clip(level, 0, FINEST).astype(np.int64)
    return _Cells(face, place[0], place[1], level[root])


@dataclass(frozen=True)
class _Groups:
    """Points sorted by group: `order` (n,), and how many each group has."""

    order: IntArray
    count: IntArray


def _grouped(cells: _Cells, some: IntArray, undone: tuple[int, int], slot: IntArray) -> _Groups:
    """Groups some points by cell, with halvings undone in either direction, and slot of time."""
    width = ROOT_CELLS << FINEST
    level = cells.level[some]
    key = (slot[some] * 6 + cells.face[some]) * (FINEST + 1) + level
    for place, back in zip((cells.across, cells.along), undone, strict=True):
        key = key * width + (place[some] >> (FINEST - np.maximum(level - back, 0)))
    order = stable_order(key)
    key = key[order]
    starts = np.ones(len(key), dtype=bool)
    starts[1:] = key[1:] != key[:-1]
    first = np.flatnonzero(starts)
    return _Groups(order, np.diff(np.append(first, len(key))))


def _judged(
    number: IntArray,
    p: Array,
    times_s: Array | None,
    motion: SweepMotion | None,
    slot: IntArray,
    noise: RangeNoise,
    channels: PointChannels | None,
) -> tuple[ScanPatches, BoolArray]:
    """Patches among groups; and (n,) whether each group is decided, flat or not.

    Points p (3, N) are in the order of the groups, `number` (n,) of each, of one slot.
    """
    count = number.astype(np.float64)
    first = np.concatenate([[0], np.cumsum(number)[:-1]]).astype(np.int64)
    time_s = np.zeros(len(count))
    if not len(count):
        empty = ScanPatches(time_s, np.zeros((0, 4, 4)), np.zeros((0, 3)), np.zeros(0))
        return empty, np.zeros(0, dtype=bool)
    swept = None
    if times_s is not None and motion is not None:
        time_s = np.add.reduceat(times_s, first) / count
        k = slot[first]
        after_s = times_s - np.repeat(time_s, number)
        p = _moved(p, after_s, motion.turn[k], motion.velocity[k], number)
        swept = Swept(
            _moments(p, first, np.add.reduceat(after_s, first), after_s),
            np.hstack([motion.turn, motion.velocity])[k],
        )
    moments = _moments(p, first, count)
    centre, cov = spread_of(moments)
    values, axes = np.linalg.eigh(cov)
    width = np.sqrt(np.maximum(values, 0.0))
    normal = axes[:, :, 0]
    normal = np.where((np.einsum("ni,ni->n", normal, centre) > 0.0)[:, None], -normal, normal)
    range_m = np.sqrt(np.einsum("ni,ni->n", centre, centre))
    cosine = -np.einsum("ni,ni->n", normal, centre) / range_m
    of_range = noise.at(range_m) * cosine
    expected = np.hypot(of_range, ROUGHNESS_M)
    # Three degrees of freedom went into the plane.
    scatter = width[:, 0] * np.sqrt(count / (count - 3.0))
    flat = scatter < MAX_SCATTER * expected
    # A thick group may become flat when it is seen as a part of nothing else: it is decided.
    tilt = np.maximum(scatter, of_range) / (width[:, 1] * np.sqrt(count) + 1e-12)
    u, ranges = scatter_of_ranges(centre, cov, count)
    along = ranges[:, None] * np.abs(np.einsum("ni,nik->nk", u, axes[:, :, 1:]))
    thick = np.maximum(np.maximum(scatter, 1e-6)[:, None], along)
    broad = (width[:, 1:] > MIN_WIDTH * thick).all(axis=1) & (tilt < MAX_TILT_RAD)
    spread, bend, skewness, length = _shape(p, number, first, count, centre, axes, width)
    broad &= spread > MIN_SPREAD
    if channels is not None:
        several, span = channels.number(first)
        apart = range_m * span / np.maximum(cosine, MIN_INCIDENCE_COS)
        broad &= (several >= MIN_CHANNELS) | (2.0 * apart > MAX_PATCH_M)
    uneven = bend > MAX_BEND_M + 2.0 * scatter / np.sqrt(count)
    uneven |= np.abs(skewness) > np.maximum(MAX_SKEWNESS * np.sqrt(6.0 / count), LEAST_SKEWNESS)
    seen = (cosine > MIN_INCIDENCE_COS) & (length < MAX_PATCH_M)
    good = flat & broad & ~uneven & seen
    decided = ~flat | broad
    by_channel = None
    if channels is not None:
        kept, patch = np.repeat(good, number), np.arange(np.count_nonzero(good))
        own = channels.only(kept)
        by_channel = own.sums(p[:, kept], np.repeat(patch, number[good]))
    patches = ScanPatches(
        time_s=time_s[good],
        moments=moments[good],
        normal_lidar=normal[good],
        scatter_m=scatter[good],
        swept=swept and swept.part(good),
        channels=by_channel,
        uneven=int(count[decided & (~flat | uneven)].sum()),
        grazing=int(count[flat & broad & ~uneven & ~seen].sum()),
    )
    return patches, decided


def _moved(p: Array, after_s: Array, turn: Array, velocity: Array, number: IntArray) -> Array:
    """Points p (3, N), moved over times (N,) by the twists (n, 3) of groups of `number` (n,).

    Axis by axis: each is a row, along which numpy is fast.
    """
    w, v = (np.repeat(of_groups.T, number, axis=1) for of_groups in (turn, velocity))
    crossed = (w[i] * p[j] - w[j] * p[i] for i, j in ((1, 2), (2, 0), (0, 1)))
    return np.stack([at + after_s * (c + s) for at, c, s in zip(p, crossed, v, strict=True)])


def _along(axis: Array, number: IntArray, p: Array) -> Array:
    """(N,) coordinates of points p (3, N) along the axes (n, 3) of groups of `number` (n,)."""
    x, y, z = (np.repeat(part, number) for part in axis.T)
    out = x * p[0]
    out += y * p[1]
    out += z * p[2]
    return np.asarray(out)


def _moments(p: Array, first: IntArray, count: Array, weight: Array | None = None) -> Array:
    """(n, 4, 4) sums of h h^T over groups of points p (3, N) that start at `first` (n,).

    With a `weight` (N,) of each point, whose sums over the groups are `count` (n,).
    """
    x, y, z = p
    products = np.stack([x, y, z, x * x, x * y, x * z, y * y, y * z, z * z])
    if weight is not None:
        products *= weight
    sums = np.add.reduceat(products, first, 1)
    out = np.empty((len(first), 4, 4))
    out[:, :3, 3] = out[:, 3, :3] = sums[:3].T
    for k, (i, j) in enumerate([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]):
        out[:, i, j] = out[:, j, i] = sums[3 + k]
    out[:, 3, 3] = count
    return out


def _shape(
    p: Array,
    number: IntArray,
    first: IntArray,
    count: Array,
    centre: Array,
    axes: Array,
    width: Array,
) -> tuple[Array, Array, Array, Array]:
    """Spread, bend, skewness and length of groups; each (n,). `count` is their `number`.

    The spread is how evenly a group is spread along its worse axis, the length is in metres, the
    skewness is that of the points along the normal. The bend, metres, is the root mean square of
    the residuals' parts of second and third order.
    """
    off = p - np.repeat(centre.T, number, axis=1)
    scaled = axes / np.maximum(width, 1e-9)[:, None, :]
    v, u = (_along(scaled[:, :, k], number, off) for k in (1, 2))
    r = _along(axes[:, :, 0], number, off)
    uu, vv = u * u, v * v
    powers = np.stack([uu * u, vv * v, uu * uu, vv * vv, uu * v, u * vv, uu * vv])
    u3, v3, u4, v4, uuv, uvv, uuvv = np.add.reduceat(powers, first, 1) / count
    spread = np.minimum(u4 - u3**2, v4 - v3**2) - 1.0
    by_r = np.stack([r * uu, r * u * v, r * vv, r * uu * u, r * vv * v, r * r * r])
    ruu, ruv, rvv, ru3, rv3, r3 = np.add.reduceat(by_r, first, 1) / count
    # Residuals have no constant and no linear part, so that only the terms' own remainder counts.
    bend = (
        ruu**2 / np.maximum(u4 - u3**2 - 1.0, MIN_SPREAD)
        + ruv**2 / np.maximum(uuvv - uuv**2 - uvv**2, MIN_SPREAD)
        + rvv**2 / np.maximum(v4 - v3**2 - 1.0, MIN_SPREAD)
    )
    sixth = np.add.reduceat(np.stack([uu * uu * uu, vv * vv * vv]), first, 1) / count
    bend += ru3**2 / np.maximum(sixth[0] - u3**2 - u4**2, MIN_SPREAD)
    bend += rv3**2 / np.maximum(sixth[1] - v3**2 - v4**2, MIN_SPREAD)
    length = np.maximum.reduceat(u, first) - np.minimum.reduceat(u, first)
    skewness = r3 / np.maximum(width[:, 0], 1e-9) ** 3
    return spread, np.sqrt(bend), skewness, length * width[:, 2]


def _joined(found: list[ScanPatches], points: int, uneven: int, grazing: int) -> ScanPatches:
    """All patches of a scan, at most `MAX_PATCHES`, and what became of its points."""
    number = [len(f.time_s) for f in found]
    moments = np.concatenate([f.moments for f in found])
    used = int(moments[:, 3, 3].sum())
    joined = ScanPatches(
        time_s=np.concatenate([f.time_s for f in found]),
        moments=moments,
        normal_lidar=np.concatenate([f.normal_lidar for f in found]),
        scatter_m=np.concatenate([f.scatter_m for f in found]),
        swept=Swept.joined([f.swept for f in found], number),
        channels=ChannelSums.joined([f.channels for f in found], number),
        undecided=points - used - uneven - grazing,
        uneven=uneven,
        grazing=grazing,
    )
    if len(joined.time_s) <= MAX_PATCHES:
        return joined
    return joined.part(np.linspace(0, len(joined.time_s) - 1, MAX_PATCHES).astype(np.int64))
