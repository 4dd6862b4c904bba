"""The ground in single scans: a plane about the vehicle, in the frame of the LiDAR.

A LiDAR's noise is along its beams, which graze the ground: a range that is 10 mm off lies 2 mm off
the plane at 10 m. Everything here is therefore judged and selected *along the beam*, where what the
noise does is symmetric; to select by distance from the LiDAR or from the plane of a ball would not
be, and a plane that is 1 mm too high in every scan is what no number of scans averages out.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.geometry.se3 import tangent_axes
from caliv_graph.products import (
    Array,
    BoolArray,
    GroundObservation,
    IntArray,
    LidarScan,
    Recording,
    TargetObservation,
)
from caliv_graph.targets.ground.fit import fit_ground, height_above
from caliv_graph.trajectory.deskew import deskewed
from caliv_graph.trajectory.select import VehicleTrajectory

NORMAL_FLOOR_RAD = 0.5e-3
DISTANCE_FLOOR_M = 2e-3
"""Added to what the noise of the points leaves (SPEC 8). With thousands of points that is 0.02 mrad
and 0.1 mm; but asphalt is no plane, and its waves, longer than the patch, are no noise that
averages out within a scan."""

RADII_M = (15.0, 10.0)
"""The ground is taken to be a plane this far around the LiDAR; if it is none, nearer."""

CELL_M = 1.0
CELL_POINTS = 10
"""No square metre has a say of more than so many points. The rings next to the vehicle, or its own
roof, would else outvote the ground."""

MAX_POINTS = 12_000
"""Points that are looked at at all: more make no better plane."""

RISE = 0.3
"""Points that rise more steeply than this from the LiDAR are no ground, whatever the guess: 10
degrees of error in the mounting, and 7 of the ground."""

START_DISTANCE_M = 0.1
"""Half thickness of the plane that the fit starts from."""

UNEVENNESS_M = 0.005
"""Height of asphalt about its plane from point to point, 1 sigma, beside the noise of the range."""

SCALES = (0.4, 2.0)
"""What the scatter of the points may make of these sigmas. Smooth ground gets a narrow gate, which
the foot of a ramp does not get through; the noise of a rough one is not cut off."""

TUKEY = 4.685
"""Standard deviations at which Tukey's biweight vanishes: 95 % efficient for normal noise."""

MEDIAN_OF_NORMAL = 0.6745
"""Median of the absolute value of a standard normal variable."""

ROUNDS = 6
"""Refits while the gate narrows from `START_DISTANCE_M` to Tukey's."""

MIN_SLOPE = 0.02
"""Sine of the angle between beam and ground below which a return tells more of bumps than of the
plane."""

STANDING_M = (0.1, 2.5)
"""Things between these heights stand on the ground; where they do, their feet are no ground."""

STANDING_CELL_M = 0.5

NEARLY_M = 0.3
"""What is nearer to the plane than this is ground, if perhaps of another plane."""

MIN_SHARE = 0.6
"""Part of that which has to lie on the plane. Kerbs and verges take some; half of a ramp more."""

MAX_BELOW = 0.1
"""Part of the points that may be lower than `NEARLY_M` below the plane. More: it is not the ground,
or the ground falls off."""

MAX_BEND_M = 0.004
"""Root mean square of the best paraboloid over the patch, less its best plane: asphalt bends by
millimetres over 30 m, the foot of a ramp by centimetres."""

MIN_POINTS = 60
"""Points on the plane below which there is none."""

MIN_DISTANCE_M = 0.15
"""No LiDAR sits lower than this."""

EXTRINSIC_STEP_RAD = 1e-3
"""Of the derivative by the mounting's rotation: what it turns is linear far beyond that."""

MAX_APART_NS = 60_000_000
"""How far a scan may be from a pose that it is to speak for: every LiDAR of 10 Hz has one within
half its period, and over that any trajectory is right to a millimetre."""

MAX_NORMAL_SIGMA_RAD = 3e-3
MAX_DISTANCE_SIGMA_M = 0.02
"""What the points leave uncertain, at most: a plane through a single ring has no tilt."""


@dataclass(frozen=True)
class GroundPlane:
    """The ground's plane in one scan: points p with `normal . p + distance = 0`.

    Attributes:
        normal_lidar: (3,) unit normal, upwards, lidar frame.
        distance_m: of the LiDAR's origin above the plane, along the normal.
        axes_lidar: (2, 3) unit vectors u and v, at right angles to the normal and to each other.
        cov: (3, 3) of (a, b, distance), the normal being along `normal + a u + b v` (rad, rad, m):
            what the noise of the points leaves, read off their scatter. Distance is that of the
            LiDAR: with a patch ahead of it, tilt and distance are correlated.
        beyond: (3,) what (a, b, distance) would be more by if the ground went on to the LiDAR's
            foot as bent as the patch is.
        centre_lidar: (3,) metres, centre of the patch on the plane: there, height and tilt are not.
        points: how many points lie on it.
        scatter_m: root mean square height of these points about it.
        radius_m: of the surroundings that were taken for a plane.
    """

    normal_lidar: Array
    distance_m: float
    axes_lidar: Array
    cov: Array
    beyond: Array
    centre_lidar: Array
    points: int
    scatter_m: float
    radius_m: float

    @property
    def cov_with_floors(self) -> Array:
        """`cov`, what unevenness adds to it, and how far `beyond` may be true.

        This is the one to weigh scans against other data by: what is wanted is the ground under the
        wheels, and what is seen begins 5 m ahead of them.
        """
        floors = np.array([NORMAL_FLOOR_RAD, NORMAL_FLOOR_RAD, DISTANCE_FLOOR_M])
        return np.asarray(self.cov + np.diag(floors**2) + np.outer(self.beyond, self.beyond))


def near_points(points: Array, up: Array) -> IntArray:
    """Indices of the points that may be ground about a LiDAR, no place with more than its share.

    Args:
        points: (N, 3) metres, lidar frame.
        up: (3,) unit vector, upwards to 10 degrees.
    """
    height = points @ up
    square = np.einsum("ni,ni->n", points, points)
    across = square - height**2
    # Rather too wide: the plane decides, along the beams.
    reach = (1.2 * RADII_M[0]) ** 2
    may_be = (across < reach) & (height < RISE * np.sqrt(np.maximum(across, 0.0)))
    index = np.flatnonzero(may_be)
    rng = np.random.default_rng(len(index))
    if len(index) > MAX_POINTS:
        index = index[rng.random(len(index)) < MAX_POINTS / len(index)]
    index = index[rng.permutation(len(index))]
    cell = _cells(points[index] @ tangent_axes(up).T, CELL_M)
    order = np.argsort(cell, kind="stable")
    sorted_cell = cell[order]
    first = np.flatnonzero(np.diff(sorted_cell, prepend=-1))
    rank = np.arange(len(order)) - np.repeat(first, np.diff(np.append(first, len(order))))
    return np.asarray(np.sort(index[order[rank < CELL_POINTS]]))


def _cells(xy: Array, size_m: float) -> IntArray:
    """(N,) numbers of the square cells that places (N, 2) are in."""
    cell = np.floor(xy / size_m).astype(np.int64) + 2048
    return np.asarray(cell[:, 0] * 4096 + cell[:, 1])


def measure_ground(scan: LidarScan, up_lidar: Array, sigma_range_m: float) -> GroundPlane | None:
    """The ground about the LiDAR in one scan.

    Args:
        scan: motion compensated.
        up_lidar: (3,) which way is up in the lidar frame, by the initial guess; 10 degrees off
            will do.
        sigma_range_m: noise along the beam, metres.

    Returns:
        The plane; None if no ground is seen, or if it is no plane even close to the vehicle.
    """
    up = np.asarray(up_lidar, np.float64) / np.linalg.norm(up_lidar)
    near = near_points(scan.points_lidar, up)
    plane, _ = _measure(scan.points_lidar[near], up, sigma_range_m)
    return plane


def _measure(points: Array, up: Array, sigma_range_m: float) -> tuple[GroundPlane | None, str]:
    """The plane among the points near a LiDAR, or None and why."""
    if len(points) < MIN_POINTS:
        return None, f"under {MIN_POINTS} points near the ground"
    level = np.vstack([tangent_axes(up), up])
    start = fit_ground(points @ level.T, START_DISTANCE_M)
    if start is None:
        return None, "no near-horizontal plane"
    reason = ""
    for radius_m in RADII_M:
        found, reason = _refined(
            points, level.T @ start[:3], float(start[3]), radius_m, sigma_range_m
        )
        if found is not None:
            return found, ""
    return None, reason


@dataclass(frozen=True)
class _Fit:
    """Points against a plane: all arrays over the points.

    Attributes:
        height: metres above it.
        place: (N, 2) where the beam meets the plane, along its tangent axes, from the LiDAR's foot.
        sigma_m: of the height.
        usable: whether the beam meets the plane, within the radius.
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


def _refined(
    points: Array, normal: Array, distance_m: float, radius_m: float, sigma_range_m: float
) -> tuple[GroundPlane | None, str]:
    """The plane by reweighted least squares from a rough one, or None and why."""
    beams = points / np.linalg.norm(points, axis=1)[:, None]
    standing = np.zeros(len(points), dtype=bool)
    scale = 1.0
    last = TUKEY * math.hypot(UNEVENNESS_M, 0.3 * sigma_range_m)
    gates = max(START_DISTANCE_M / last, 1.0) ** np.linspace(1.0, 0.0, ROUNDS)
    # Settles the last gate: scale and weights move with the plane.
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
    """(N,) whether something stands where a point is."""
    cell = _cells(points @ axes.T, STANDING_CELL_M)
    low, high = STANDING_M
    occupied = np.unique(cell[(fit.height > low) & (fit.height < high)])
    return np.asarray(np.isin(cell, occupied))


def _scale(fit: _Fit, standing: BoolArray) -> float:
    """Scatter of the points on the plane over their sigma, by the median."""
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
    """A fitted plane with its covariance; None and why if it is not the ground or no plane."""
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
    bend_m, beyond = _bend(J[:, :2], height, weight)
    if bend_m > MAX_BEND_M:
        return None, "the ground near the vehicle is bent"
    # Huber's covariance of an M-estimate: from the scatter, not from what the noise should be.
    curvature = (1.0 - part) * (1.0 - 5.0 * part) / sigma_m**2
    bread = (J * curvature[:, None]).T @ J
    push = J * (weight * height)[:, None]
    try:
        nominal: Array = np.asarray(np.linalg.inv(bread), np.float64)
    except np.linalg.LinAlgError:
        return None, "its ground points are in a line"
    cov = nominal @ (push.T @ push) @ nominal
    cov = 0.5 * (cov + cov.T)
    # By chance, points of a line may scatter little; the nominal one knows their arrangement.
    if not all(_is_told(c) for c in (cov, nominal)):
        return None, "too little ground to tell its tilt"
    return (
        GroundPlane(
            normal_lidar=normal,
            distance_m=distance_m,
            axes_lidar=axes,
            cov=cov,
            beyond=beyond,
            centre_lidar=centre @ axes - distance_m * normal,
            points=count,
            scatter_m=float(np.sqrt(np.average(height**2, weights=weight))),
            radius_m=radius_m,
        ),
        "",
    )


def _is_told(cov: Array) -> bool:
    """Whether a covariance of (tilts, distance) is that of a plane worth having."""
    if not np.isfinite(cov).all():
        return False
    # The largest of all tilts, not of those about the axes.
    tilts = np.linalg.eigvalsh(cov[:2, :2])
    return bool(
        tilts[0] >= 0.0
        and tilts[1] < MAX_NORMAL_SIGMA_RAD**2
        and 0.0 <= cov[2, 2] < MAX_DISTANCE_SIGMA_M**2
    )


def _bend(place: Array, height: Array, weight: Array) -> tuple[float, Array]:
    """The best paraboloid through heights, against their best plane.

    Args:
        place: (n, 2) metres from the LiDAR's foot, along the axes.
        height: (n,) metres above the best plane.
        weight: (n,).

    Returns:
        Root mean square of the difference over the patch, metres; and (3,) what (a, b, distance)
        would be more by if it went on to the LiDAR's foot.
    """
    centre = np.average(place, axis=0, weights=weight)
    scale = np.abs(place - centre).max()
    x, y = ((place - centre) / scale).T
    root = np.sqrt(weight)[:, None]
    flat, curved = np.column_stack([np.ones(len(x)), x, y]), np.column_stack([x * x, x * y, y * y])
    coefficients, *_ = np.linalg.lstsq(root * np.hstack([flat, curved]), root[:, 0] * height)
    basis, _ = np.linalg.qr(root * flat)
    bent = (root * curved) @ coefficients[3:]
    bent -= basis @ (basis.T @ bent)
    _, p, q, xx, xy, yy = coefficients
    u, v = -centre / scale
    there = coefficients @ np.array([1.0, u, v, u * u, u * v, v * v])
    slope = np.array([p + 2.0 * xx * u + xy * v, q + xy * u + 2.0 * yy * v]) / scale
    return float(np.sqrt(bent @ bent / weight.sum())), -np.append(slope, there)


def _response(plane: GroundPlane, points: Array, moved: Array, sigma_range_m: float) -> Array:
    """What a plane's (a, b, distance) do when its points move.

    Args:
        plane: as it was fitted.
        points: (N, 3) metres, what it was fitted to.
        moved: (N, 3, k) metres, k ways to move them a little.
        sigma_range_m: noise along the beam.

    Returns:
        (3, k).
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
    return np.asarray(-np.linalg.solve(weighted.T @ J, weighted.T @ rises))


class GroundMeter:
    """Measures the ground in the scans of one drive, one at a time."""

    def __init__(self, config: Config, trajectory: VehicleTrajectory, drive: int) -> None:
        """Binds the initial guesses to the trajectory of a drive."""
        self._sigma_range_m = config.noise.lidar_range_m
        self._trajectory = trajectory
        self._drive = drive
        self._guess: Mapping[str, gtsam.Pose3] = {
            name: lidar.initial.pose() for name, lidar in config.lidars.items()
        }
        self._scans: Counter[str] = Counter()
        self._without: dict[str, Counter[str]] = {name: Counter() for name in config.lidars}

    def measure(self, scan: LidarScan, at_ns: int | None = None) -> GroundObservation | None:
        """The ground in a scan as it was read, or None if it has none that is a plane.

        Args:
            scan: not motion compensated; its stamp within the trajectory's span.
            at_ns: a stamp near the scan's, at which the ground is wanted; None: the scan's own. The
                plane is as seen from where the LiDAR was then, by the trajectory.

        Raises:
            TrajectoryError: the stamp is outside the trajectory's span, or its times are no times.
        """
        self._scans[scan.lidar] += 1
        at_ns = scan.stamp_ns if at_ns is None else at_ns
        R_map_vehicle, _ = self._trajectory.poses_at([at_ns])
        guess = self._guess[scan.lidar]
        up_lidar = (R_map_vehicle[0] @ guess.rotation().matrix())[2]
        # Before the motion compensation, which costs more than all the rest.
        near = near_points(scan.points_lidar, up_lidar)
        times_s = np.full(len(near), (scan.stamp_ns - at_ns) / NANOSECONDS_PER_SECOND)
        if scan.point_times_s is not None:
            times_s += scan.point_times_s[near]
        part = replace(
            scan, stamp_ns=at_ns, points_lidar=scan.points_lidar[near], point_times_s=times_s
        )
        turned = [guess.retract(d) for d in EXTRINSIC_STEP_RAD * np.eye(3, 6)]
        by_guess = deskewed(part, [guess, *turned], self._trajectory)
        points = next(by_guess)
        plane, reason = _measure(points, up_lidar, self._sigma_range_m)
        if plane is None:
            self._without[scan.lidar][reason] += 1
            return None
        by_extrinsic = None
        if times_s.any():
            moved = [of_turned - points for of_turned in by_guess]
            by_extrinsic = (
                _response(plane, points, np.stack(moved, axis=2), self._sigma_range_m)
                / EXTRINSIC_STEP_RAD
            )
        return GroundObservation(
            lidar=scan.lidar,
            drive=self._drive,
            stamp_ns=at_ns,
            normal_lidar=plane.normal_lidar,
            distance_m=plane.distance_m,
            axes_lidar=plane.axes_lidar,
            cov=plane.cov_with_floors,
            centre_lidar=plane.centre_lidar,
            points=plane.points,
            R_vehicle_lidar=None if by_extrinsic is None else guess.rotation().matrix(),
            by_extrinsic=by_extrinsic,
            apart_ns=scan.stamp_ns - at_ns,
        )

    def warnings(self) -> tuple[str, ...]:
        """LiDARs in most of whose scans there was no ground, and why, a line each."""
        lines = []
        for name, reasons in self._without.items():
            lost, scans = sum(reasons.values()), self._scans[name]
            if 2 * lost > scans:
                why = ", ".join(f"{n} {text}" for text, n in reasons.most_common(3))
                lines.append(
                    f"ground: lidar '{name}' has it in {scans - lost} of {scans} scans of drive "
                    f"{self._drive + 1}: {why}"
                )
        return tuple(lines)


def nearest_scans(
    poses_ns: Sequence[int] | IntArray, scans_ns: Sequence[int] | IntArray
) -> dict[int, int]:
    """For each pose the scan that is to speak for it, if one is near enough.

    Args:
        poses_ns: stamps of the poses.
        scans_ns: stamps of the scans of one LiDAR, ascending.

    Returns:
        Stamp of the pose by stamp of the scan. No scan speaks twice: it would count twice.
    """
    scans = np.asarray(scans_ns, dtype=np.int64)
    out: dict[int, int] = {}
    if not len(scans):
        return out
    for pose_ns in map(int, poses_ns):
        after = int(np.searchsorted(scans, pose_ns))
        near = scans[max(after - 1, 0) : after + 1]
        scan_ns = int(near[np.abs(near - pose_ns).argmin()])
        apart = abs(scan_ns - pose_ns)
        if apart <= MAX_APART_NS and (scan_ns not in out or apart < abs(scan_ns - out[scan_ns])):
            out[scan_ns] = pose_ns
    return out


def measure_grounds(
    recordings: Sequence[Recording],
    trajectories: Sequence[VehicleTrajectory],
    targets: Sequence[TargetObservation],
    config: Config,
    progress: Progress,
) -> tuple[tuple[GroundObservation, ...], tuple[str, ...]]:
    """The ground as all LiDARs see it whenever one of them sees a target.

    All of them, at the same poses: what the vehicle's springs and its trajectory do then is common
    to all, and the LiDARs are tied together by the two millimetres of a plane.

    Args:
        recordings: the drives.
        trajectories: one per drive.
        targets: whose clouds' stamps are the poses of the graph.
        config: initial guesses, noise, and whether the ground is to be used.
        progress: told of every scan.

    Returns:
        Observations by drive, LiDAR and stamp, each at the stamp of a pose; and warnings.

    Raises:
        RecordingError: a cloud could not be read.
    """
    if not config.ground.use:
        return (), ()
    poses = sorted({(c.drive, c.stamp_ns) for o in targets for c in o.clouds})
    seeing = {c.lidar for o in targets for c in o.clouds}
    names = [n for n, lidar in config.lidars.items() if n in seeing or lidar.fixed]
    wanted: list[tuple[int, str, dict[int, int]]] = []
    for drive, recording in enumerate(recordings):
        begin, end = trajectories[drive].span_ns
        of_drive = [stamp for d, stamp in poses if d == drive]
        for name in names:
            scans = [t for t in recording.scan_stamps_ns(name) if begin <= t <= end]
            wanted.append((drive, name, nearest_scans(of_drive, scans)))
    found: list[GroundObservation] = []
    meters = [GroundMeter(config, t, drive) for drive, t in enumerate(trajectories)]
    total = sum(len(pairs) for _, _, pairs in wanted)
    with progress.stage("reading the ground", total) as advance:
        for drive, name, pairs in wanted:
            for scan in recordings[drive].scans(name, pairs) if pairs else ():
                observation = meters[drive].measure(scan, pairs[scan.stamp_ns])
                if observation is not None:
                    found.append(observation)
                advance()
    return tuple(found), tuple(line for meter in meters for line in meter.warnings())
