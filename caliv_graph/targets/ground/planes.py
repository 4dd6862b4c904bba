"""The ground's plane in one scan: robust fit, covariance, and the tests that it is a plane.

Points are judged and selected *along the beam*, where the noise is symmetric: selection by distance
from the LiDAR, or from the plane of a ball of points, is biased by 1 mm of height in every scan.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from caliv_graph.common.sorting import stable_order
from caliv_graph.config.noise import NoiseConfig
from caliv_graph.geometry.se3 import tangent_axes
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.targets.ground.fit import fit_ground, height_above

NORMAL_FLOOR_RAD = 0.5e-3
DISTANCE_FLOOR_M = 2e-3
"""Sigmas added to what the noise of the points leaves (thousands of points leave 0.02 mrad and
0.1 mm), where neither config nor data give them. Asphalt is no plane: its waves are longer than the
patch and do not average out within a scan."""

RADII_M = (15.0, 10.0)
"""The ground is fitted this far around the LiDAR; if it is no plane there, nearer."""

CELL_M = 1.0
CELL_POINTS = 10
"""A square metre contributes at most `CELL_POINTS` points. Else the dense rings next to the
vehicle, or its own roof, would outweigh the ground."""

CLASSES, LEAST_CELLS = 3, 8
"""Classes of distance in which the scatter of the ground is compared, and square metres in each
with half as many points at least."""

MAX_POINTS = 12_000
"""Points used at most: more do not improve the plane."""

RISE = 0.3
"""Slope from the LiDAR's foot above which a point is not ground, whatever the guess: 10 degrees of
error of the guess and 7 of the ground."""

START_DISTANCE_M = 0.1
"""Half thickness of the plane that the fit begins with."""

UNEVENNESS_M = 0.005
"""Height of asphalt about its plane from point to point, 1 sigma, beside the noise of the range."""

SCALES = (0.4, 2.0)
"""Bounds of the estimated scale of these sigmas. On smooth ground the gate is narrow, so that the
foot of a ramp does not pass it; on rough ground the noise is not cut off."""

TUKEY = 4.685
"""Standard deviations at which Tukey's biweight vanishes: 95 % efficient for normal noise."""

MEDIAN_OF_NORMAL = 0.6745
"""Median of the absolute value of a standard normal variable."""

ROUNDS = 6
"""Refits while the gate narrows from `START_DISTANCE_M` to Tukey's."""

MIN_SLOPE = 0.02
"""Minimum sine of the angle between beam and ground: flatter beams measure bumps, not the plane."""

STANDING_M = (0.1, 2.5)
"""Height range of things that stand on the ground; points in their cells are not ground."""

STANDING_CELL_M = 0.5

NEARLY_M = 0.3
"""Points within this of the plane are ground, if perhaps of another plane."""

MIN_SHARE = 0.6
"""Minimum part of these that is on the plane. Kerbs and verges take some; half of a ramp takes
more."""

MAX_BELOW = 0.1
"""Maximum part of the points that are lower than `NEARLY_M` below the plane. Above it, the plane is
not the ground, or the ground falls off."""

MAX_PASSED = 0.1
"""Maximum part of the square metres with points on the plane that beams pass through beside them,
to what is lower. Above it, the plane is the vehicle's roof, a deck, or the edge of a platform."""

MAX_BEND_M = 0.004
"""Maximum root mean square of the best paraboloid over the patch, less its best plane: asphalt
bends by millimetres over 30 m, the foot of a ramp by centimetres."""

BENT = "the ground near the vehicle is bent"
"""Why it is no plane then."""

MIN_POINTS = 60
"""Minimum number of points on the plane."""

MIN_DISTANCE_M = 0.15
"""Minimum height of a LiDAR above the plane."""

MAX_NORMAL_SIGMA_RAD = 3e-3
MAX_DISTANCE_SIGMA_M = 0.02
"""Maximum sigmas that the points leave: the tilt of a plane through one ring is undetermined."""


@dataclass(frozen=True)
class GroundPlane:
    """The ground's plane in one scan: points p with `normal . p + distance = 0`.

    Attributes:
        normal_lidar: (3,) unit normal, upwards, lidar frame.
        distance_m: of the LiDAR's origin above the plane, along the normal.
        axes_lidar: (2, 3) unit vectors u and v, at right angles to the normal and to each other.
        cov: (3, 3) of (a, b, distance), the normal being along `normal + a u + b v` (rad, rad, m):
            what the noise of the points leaves, estimated from their scatter. Distance is that of
            the LiDAR: with a patch ahead of it, tilt and distance are correlated.
        beyond: (3,) change of (a, b, distance) if the ground continues to the LiDAR's foot with the
            curvature of the patch.
        beyond_variances: (3,) of `beyond`, by the noise of the points.
        centre_lidar: (3,) metres, centre of the patch on the plane; there, height and tilt are
            uncorrelated.
        points: number of points on it.
        scatter_m: root mean square height of these points about it.
        radius_m: of the surroundings that were fitted.
        roughness_m: scatter of the heights within a square metre, 1 sigma, beside the noise of
            ranges and beams; nan: too few square metres have enough points.
    """

    normal_lidar: Array
    distance_m: float
    axes_lidar: Array
    cov: Array
    beyond: Array
    beyond_variances: Array
    centre_lidar: Array
    points: int
    scatter_m: float
    radius_m: float
    roughness_m: float = math.nan

    def cov_with(self, floors: Array) -> Array:
        """(3, 3) covariance as the ground under the wheels: `cov`, the floors (3,), and `beyond`.

        The points that are seen begin 5 m ahead of the wheels.
        """
        return np.asarray(self.cov + np.diag(floors**2) + np.outer(self.beyond, self.beyond))


def ground_floors(noise: NoiseConfig) -> Array:
    """(3,) 1 sigma of (a, b, distance) by the waves of the ground: of the config, or the usual."""
    normal_deg, distance_m = noise.ground_normal_deg, noise.ground_distance_m
    normal = NORMAL_FLOOR_RAD if normal_deg is None else math.radians(normal_deg)
    return np.array([normal, normal, DISTANCE_FLOOR_M if distance_m is None else distance_m])


def near_points(points: Array, up: Array) -> IntArray:
    """Indices of the points (N, 3) that may be ground, at most `CELL_POINTS` per cell.

    `up` (3,) is a unit vector, upwards in the lidar frame to 10 degrees.
    """
    height = points @ up
    square = np.einsum("ni,ni->n", points, points)
    across = square - height**2
    # Wider than the radius: the fit selects along the beams.
    reach = (1.2 * RADII_M[0]) ** 2
    may_be = (across < reach) & (height < RISE * np.sqrt(np.maximum(across, 0.0)))
    index = np.flatnonzero(may_be)
    rng = np.random.default_rng(len(index))
    if len(index) > MAX_POINTS:
        index = index[rng.random(len(index)) < MAX_POINTS / len(index)]
    index = index[rng.permutation(len(index))]
    cell = _cells(points[index] @ tangent_axes(up).T, CELL_M)
    order = stable_order(cell)
    sorted_cell = cell[order]
    first = np.flatnonzero(np.diff(sorted_cell, prepend=-1))
    rank = np.arange(len(order)) - np.repeat(first, np.diff(np.append(first, len(order))))
    return np.asarray(np.sort(index[order[rank < CELL_POINTS]]))


def _cells(xy: Array, size_m: float) -> IntArray:
    """(N,) numbers of the square cells that places (N, 2) are in."""
    cell = np.floor(xy / size_m).astype(np.int64) + 2048
    return np.asarray(cell[:, 0] * 4096 + cell[:, 1])


def fit_plane(points: Array, up: Array, sigma_range_m: float) -> tuple[GroundPlane | None, str]:
    """Fits the ground's plane to the points (N, 3) of `near_points`, motion compensated.

    `up` (3,) is a unit vector, upwards in the lidar frame to 10 degrees. Without ground, or where
    it is no plane even close to the vehicle: None and the reason.
    """
    if len(points) < MIN_POINTS:
        return None, f"under {MIN_POINTS} points near the ground"
    level = np.vstack([tangent_axes(up), up])
    start = fit_ground(points @ level.T, START_DISTANCE_M)
    if start is None:
        return None, "no near-horizontal plane"
    reason = ""
    for radius_m in RADII_M:
        found, reason = _refit(
            points, level.T @ start[:3], float(start[3]), radius_m, sigma_range_m
        )
        if found is not None:
            return found, ""
    return None, reason


@dataclass(frozen=True)
class _Fit:
    """Points relative to a plane: heights (N,) and their sigmas, metres; whether usable.

    `place` (N, 2) is where the beam meets the plane, along its tangent axes, from the LiDAR's foot.
    """

    height: Array
    place: Array
    sigma_m: Array
    usable: BoolArray


def _against(
    points: Array,
    beams: Array,
    plane: tuple[Array, float],
    axes: Array,
    radius_m: float,
    sigma_range_m: float,
) -> _Fit:
    """Points relative to a plane (normal, distance)."""
    normal, distance_m = plane
    height = height_above(np.append(normal, distance_m), points)
    slope = beams @ normal
    down = slope < -MIN_SLOPE
    # Where the beam meets the plane does not depend on the noise, unlike the point itself.
    foot = points - (height / np.where(down, slope, -1.0))[:, None] * beams
    place = foot @ axes.T
    usable = down & (np.einsum("ni,ni->n", place, place) < radius_m**2)
    sigma_m = np.sqrt((sigma_range_m * slope) ** 2 + UNEVENNESS_M**2)
    return _Fit(height, place, sigma_m, usable)


def _refit(
    points: Array, normal: Array, distance_m: float, radius_m: float, sigma_range_m: float
) -> tuple[GroundPlane | None, str]:
    """The plane by iteratively reweighted least squares from a rough one; or None and why."""
    beams = points / np.linalg.norm(points, axis=1)[:, None]
    standing = np.zeros(len(points), dtype=bool)
    scale = 1.0
    last = TUKEY * math.hypot(UNEVENNESS_M, 0.3 * sigma_range_m)
    gates = max(START_DISTANCE_M / last, 1.0) ** np.linspace(1.0, 0.0, ROUNDS)
    # Three more rounds at the last gate: scale and weights depend on the plane.
    for number, gate in enumerate([*gates, 1.0, 1.0, 1.0]):
        axes = tangent_axes(normal)
        fit = _against(points, beams, (normal, distance_m), axes, radius_m, sigma_range_m)
        if number == ROUNDS // 2:
            standing = _under_things(fit, points, axes)
        if number >= ROUNDS:
            scale = _scale(fit, standing)
        ratio = fit.height / (TUKEY * scale * gate * fit.sigma_m)
        on_plane = fit.usable & ~standing & (np.abs(ratio) < 1.0)
        if on_plane.sum() < MIN_POINTS:
            return None, f"under {MIN_POINTS} points on the ground"
        weight = (1.0 - ratio[on_plane] ** 2) ** 2 / fit.sigma_m[on_plane] ** 2
        J = np.column_stack([fit.place[on_plane], np.ones(on_plane.sum())])
        try:
            step = np.linalg.solve(
                (J * weight[:, None]).T @ J, -J.T @ (weight * fit.height[on_plane])
            )
        except np.linalg.LinAlgError:
            return None, "its ground points are in a line"
        moved = normal + step[:2] @ axes
        length = float(np.linalg.norm(moved))
        normal, distance_m = moved / length, (distance_m + float(step[2])) / length
    return _judged(points, (normal, distance_m), standing, radius_m, sigma_range_m)


def _under_things(fit: _Fit, points: Array, axes: Array) -> BoolArray:
    """(N,) whether something stands in the cell of a point."""
    cell = _cells(points @ axes.T, STANDING_CELL_M)
    low, high = STANDING_M
    occupied = np.unique(cell[(fit.height > low) & (fit.height < high)])
    return np.asarray(np.isin(cell, occupied))


def _scale(fit: _Fit, standing: BoolArray) -> float:
    """Scale of the heights of the points on the plane over their sigmas, by the median."""
    z = np.abs(fit.height / fit.sigma_m)
    near = fit.usable & ~standing & (z < TUKEY * SCALES[1])
    if not near.any():
        return 1.0
    return float(np.clip(np.median(z[near]) / MEDIAN_OF_NORMAL, *SCALES))


def _judged(
    points: Array,
    plane: tuple[Array, float],
    standing: BoolArray,
    radius_m: float,
    sigma_range_m: float,
) -> tuple[GroundPlane | None, str]:
    """A fitted plane with its covariance; None and why if it is not the ground, or no plane."""
    normal, distance_m = plane
    axes = tangent_axes(normal)
    beams = points / np.linalg.norm(points, axis=1)[:, None]
    fit = _against(points, beams, plane, axes, radius_m, sigma_range_m)
    ratio = (fit.height / (TUKEY * _scale(fit, standing) * fit.sigma_m)) ** 2
    on_plane = fit.usable & ~standing & (ratio < 1.0)
    count = int(on_plane.sum())
    if count < MIN_POINTS:
        return None, f"under {MIN_POINTS} points on the ground"
    if distance_m < MIN_DISTANCE_M:
        return None, "the plane is not below the LiDAR"
    nearly = fit.usable & ~standing & (np.abs(fit.height) < NEARLY_M)
    below = fit.usable & (fit.height < -NEARLY_M)
    if count < MIN_SHARE * nearly.sum() or below.sum() > MAX_BELOW * count:
        return None, "the ground near the vehicle is no plane"
    J = np.column_stack([fit.place, np.ones(len(points))])[on_plane]
    height, sigma_m, part = fit.height[on_plane], fit.sigma_m[on_plane], ratio[on_plane]
    weight = (1.0 - part) ** 2 / sigma_m**2
    centre = np.average(fit.place[on_plane], axis=0, weights=weight)
    bend_m, beyond, beyond_variances = _bend(J[:, :2], height, weight)
    if bend_m > MAX_BEND_M:
        return None, BENT
    # Huber's sandwich covariance of an M-estimate: from the scatter, not from the assumed noise.
    curvature = (1.0 - part) * (1.0 - 5.0 * part) / sigma_m**2
    bread = (J * curvature[:, None]).T @ J
    score = J * (weight * height)[:, None]
    try:
        nominal: Array = np.asarray(np.linalg.inv(bread), np.float64)
    except np.linalg.LinAlgError:
        return None, "its ground points are in a line"
    cov = nominal @ (score.T @ score) @ nominal
    cov = 0.5 * (cov + cov.T)
    # By chance, points on a line may scatter little; the nominal covariance depends on geometry.
    if not all(_is_determined(c) for c in (cov, nominal)):
        return None, "too little ground to determine its tilt"
    ground = GroundPlane(
        normal_lidar=normal,
        distance_m=distance_m,
        axes_lidar=axes,
        cov=cov,
        beyond=beyond,
        beyond_variances=beyond_variances,
        centre_lidar=centre @ axes - distance_m * normal,
        points=count,
        scatter_m=float(np.sqrt(np.average(height**2, weights=weight))),
        radius_m=radius_m,
        roughness_m=_roughness_m(fit, standing),
    )
    return ground, ""


def _roughness_m(fit: _Fit, standing: BoolArray) -> float:
    """`GroundPlane.roughness_m`, by the scatter within square metres.

    All points near the plane count, not those on it alone: of grass it is the lower part. Noise of
    the ranges is most of it near the LiDAR, noise of the beams far away, and the ground is as rough
    all about: the least of the classes of distance.
    """
    near = fit.usable & ~standing & (np.abs(fit.height) < START_DISTANCE_M)
    place = fit.place[near]
    _, cell, number = np.unique(_cells(place, CELL_M), return_inverse=True, return_counts=True)
    enough = np.flatnonzero(number >= CELL_POINTS // 2)
    if len(enough) < CLASSES * LEAST_CELLS:
        return math.nan

    def mean(of_points: Array) -> Array:
        return np.asarray(np.bincount(cell, of_points, len(number)) / number)

    height = fit.height[near]
    scatter = mean((height - mean(height)[cell]) ** 2)[enough]
    free = number[enough] - 1.0
    noise = mean(fit.sigma_m[near] ** 2)[enough] - UNEVENNESS_M**2
    variance = scatter * number[enough] / free - noise
    # The median of a variance of few degrees of freedom is below its mean (Wilson, Hilferty).
    variance = variance / (1.0 - 2.0 / (9.0 * free)) ** 3
    order = np.argsort(mean(np.linalg.norm(place, axis=1))[enough], kind="stable")
    least = min(np.median(variance[part]) for part in np.array_split(order, CLASSES))
    return math.sqrt(max(float(least), 0.0))


def _is_determined(cov: Array) -> bool:
    """Whether a covariance of (tilts, distance) is within the maximum sigmas."""
    if not np.isfinite(cov).all():
        return False
    # The largest tilt in any direction, not about the axes alone.
    tilts = np.linalg.eigvalsh(cov[:2, :2])
    return bool(
        tilts[0] >= 0.0
        and tilts[1] < MAX_NORMAL_SIGMA_RAD**2
        and 0.0 <= cov[2, 2] < MAX_DISTANCE_SIGMA_M**2
    )


def is_passed(plane: GroundPlane, points: Array) -> bool:
    """Whether beams to points (N, 3) of the scan pass through a plane where it would have ground.

    All points count, also those beyond the radius of the fit: from 20 cm above a roof the ground is
    seen tens of metres away. They need no motion compensation.
    """
    height = points @ plane.normal_lidar + plane.distance_m
    sinks = height - plane.distance_m < -MIN_SLOPE * np.linalg.norm(points, axis=1)
    on, below = np.abs(height) < STANDING_M[0], height < -NEARLY_M
    met = (on | below) & sinks
    # From the LiDAR at the height of the distance, the beam is at zero here.
    part = plane.distance_m / (plane.distance_m - height[met])
    place = part[:, None] * points[met] @ plane.axes_lidar.T
    near = np.einsum("ni,ni->n", place, place) < plane.radius_m**2
    cells, below = _cells(place[near], CELL_M), below[met][near]
    ground = np.unique(cells[~below])
    passed = np.setdiff1d(cells[below], ground)
    return len(passed) > MAX_PASSED * len(ground)


def _bend(place: Array, height: Array, weight: Array) -> tuple[float, Array, Array]:
    """The best paraboloid through heights (n,) at places (n, 2), relative to their best plane.

    Root mean square of the difference, metres; and (3,) change of (a, b, distance) at the LiDAR's
    foot, with its variances (3,).
    """
    curved, at_foot = _bending(place, weight)
    weighted = np.sqrt(weight) * height
    # One ring is a conic: one of the bends is then another plane, and its part is rounding.
    inverse = np.linalg.pinv(curved, rcond=np.finfo(np.float64).eps * len(curved))
    bends = inverse @ weighted
    bent = curved @ bends
    # From the scatter about the paraboloid, as the plane's covariance.
    left = (at_foot @ inverse) * (weighted - bent)
    return float(np.sqrt(bent @ bent / weight.sum())), at_foot @ bends, (left**2).sum(axis=1)


def _bending(place: Array, weight: Array) -> tuple[Array, Array]:
    """Heights of three bends, x^2, x y and y^2, at places (n, 2), each less its best plane.

    In units of the largest distance from the centre. Heights (n, 3), metres per unit, times the
    roots of the weights; and what each does to (a, b, distance) at the LiDAR's foot (3, 3), rad,
    rad and metres per unit: ground that rises there is nearer, hence with the other sign.
    """
    centre = np.average(place, axis=0, weights=weight)
    scale = np.abs(place - centre).max()
    x, y = ((place - centre) / scale).T
    root = np.sqrt(weight)[:, None]
    flat, curved = np.column_stack([np.ones(len(x)), x, y]), np.column_stack([x * x, x * y, y * y])
    basis, triangle = np.linalg.qr(root * flat)
    along = basis.T @ (root * curved)
    planes, *_ = np.linalg.lstsq(triangle, -along)
    u, v = -centre / scale
    at_foot = np.array([[2.0 * u, v, 0.0], [0.0, u, 2.0 * v], [u * u, u * v, v * v]])
    at_foot += np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, u, v]]) @ planes
    return root * curved - basis @ along, -at_foot / np.array([[scale], [scale], [1.0]])


def response(
    plane: GroundPlane, points: Array, moved: Array, sigma_range_m: float
) -> tuple[Array, Array]:
    """Changes of a plane with k small motions (N, 3, k) of its points, lidar frame, metres.

    (3, k) of its (a, b, distance), and (3, k) of its `beyond`; rad, rad, metres.
    """
    beams = points / np.linalg.norm(points, axis=1)[:, None]
    both = (plane.normal_lidar, plane.distance_m)
    fit = _against(points, beams, both, plane.axes_lidar, plane.radius_m, sigma_range_m)
    standing = _under_things(fit, points, plane.axes_lidar)
    ratio = (fit.height / (TUKEY * _scale(fit, standing) * fit.sigma_m)) ** 2
    on_plane = fit.usable & ~standing & (ratio < 1.0)
    weight = (1.0 - ratio[on_plane]) ** 2 / fit.sigma_m[on_plane] ** 2
    J = np.column_stack([fit.place, np.ones(len(points))])[on_plane]
    rises = np.einsum("i,nik->nk", plane.normal_lidar, moved[on_plane])
    weighted = J * weight[:, None]
    curved, at_foot = _bending(J[:, :2], weight)
    bends, *_ = np.linalg.lstsq(curved, np.sqrt(weight)[:, None] * rises)
    return np.asarray(-np.linalg.solve(weighted.T @ J, weighted.T @ rises)), at_foot @ bends
