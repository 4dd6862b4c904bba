"""Heading against course over ground: a check of the vehicle frame's yaw.

An error of that yaw turns every LiDAR's extrinsic by the same angle. Only the vehicle's motion
shows it: its rear axle does not slip sideways.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from caliv_graph.products import Array, IntArray, MotionData
from caliv_graph.trajectory.measurements import rotations_of, usable_orientations
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.wheels import is_planar

MIN_SPEED_M_S = 0.5
"""Below, velocity noise of 10 mm/s is more than 20 mrad of direction."""

MIN_DRIVING_S = 2.0
"""Of driving; less has fewer than two independent samples."""

SIGMAS = 4.0
"""A larger disagreement is reported: probability 6e-5 without one."""

FLOOR_RAD = math.radians(0.2)
"""A smaller disagreement is never reported: slip of the tyres and banked roads cause as much."""

MAP_TURN_RAD = math.radians(10.0)
"""The same against the path of the fixes: another zero of a compass, not noise of fixes."""

PATH_NS = 2_000_000_000
MIN_PATH_M = 1.0
"""Pieces of the path that are compared: so long in time, and at least so far."""

SPACING_NS = 100_000_000
"""Of the samples that are compared."""

MIN_CURVATURE_RANGE_1_M = 0.02
"""Range of curvatures (5th to 95th percentile) from which the axle is estimated, and the curvature
above which an axle's place explains a yaw: a turning radius of 50 m."""


HeadingSource = Literal["imu", "antennas", "none"]

HEADING_REMEDIES: Mapping[HeadingSource, str] = {
    "imu": "Check imu.T_vehicle_imu, or set imu.yaw_bias",
    "antennas": "Check heading.yaw_deg and the antennas of topics.heading",
    "none": "Check imu.T_vehicle_imu",
}
"""What a heading that is turned against the course comes from, by what tells it."""

_MAP_REMEDIES: Mapping[HeadingSource, str] = {
    **HEADING_REMEDIES,
    "imu": (
        "Check that the IMU's yaw counts from east to the left, and imu.T_vehicle_imu, or set "
        "imu.yaw_bias"
    ),
}


@dataclass(frozen=True)
class HeadingDisagreement:
    """How course over ground and heading differ.

    Attributes:
        yaw_rad: of the heading against the motion, positive to the left.
        sigma_rad: of it.
        axle_m: x in the vehicle frame of the point that does not slip sideways; NaN where the
            curves do not determine it.
        duration_s: of driving that was compared.
        measured: whether the lateral velocity was measured (twist), not assumed to be zero.
        source: what tells the heading: orientations of the IMU's messages, two antennas, or none;
            then fixes and gyroscope tell that of the IMU.
        warning: a line for the user; empty without a significant disagreement.
    """

    yaw_rad: float
    sigma_rad: float
    axle_m: float
    duration_s: float
    measured: bool
    source: HeadingSource
    warning: str


def heading_disagreement(
    smoothed: SmoothedTrajectory, motion: MotionData
) -> HeadingDisagreement | None:
    """Compares the direction in which the vehicle points with the one in which it moves.

    The motion in vehicle axes is compared with recorded velocities that have a lateral part.
    Without them the rear axle is assumed not to slip (`README.md`, section 10). None if the vehicle
    hardly moves, or if without an IMU the heading was made from the course.
    """
    if smoothed.data.wheels is not None:
        return None
    begin, end = smoothed.span_ns
    at = np.arange(begin, end, SPACING_NS, dtype=np.int64)
    velocity, rates = smoothed.velocities_at(at)
    fast = np.hypot(velocity[:, 0], velocity[:, 1]) > MIN_SPEED_M_S
    duration_s = float(fast.sum()) * SPACING_NS * 1e-9
    if duration_s < MIN_DRIVING_S:
        return None
    measured = _measured_at(motion, at[fast], begin)
    source = _source(smoothed)
    map_turn, map_sigma, assumed = _turn_of_map(smoothed, motion, source)
    if abs(map_turn) > MAP_TURN_RAD:
        return HeadingDisagreement(
            yaw_rad=map_turn,
            sigma_rad=math.hypot(map_sigma, FLOOR_RAD),
            axle_m=math.nan,
            duration_s=duration_s,
            measured=measured is not None,
            source=source,
            warning=(
                f"{motion.name}: heading is turned by {math.degrees(map_turn):+.0f} degrees "
                f"against the path of the GNSS fixes{assumed}, which hardly count therefore. "
                f"{_MAP_REMEDIES[source]}"
            ),
        )
    velocity, turn = velocity[fast, :2], rates[fast, 2]
    along = _ahead(motion, at[fast], begin) if measured is None else measured
    # The coarse part may be a right angle (north instead of east); the rest is small.
    coarse = _turn_between(velocity, along, axis_only=motion.twist is None)
    c, s = math.cos(coarse), math.sin(coarse)
    forward = c * velocity[:, 0] - s * velocity[:, 1]
    sideways = s * velocity[:, 0] + c * velocity[:, 1]
    if measured is not None:
        sideways = sideways - along[:, 1]
    # The curvature varies: curves to both sides, or curves and straights.
    curvatures = float(np.ptp(np.percentile(turn / forward, [5, 95])))
    separable = measured is None and curvatures > MIN_CURVATURE_RANGE_1_M
    solution, variance = _fit(forward, turn if separable else None, sideways, measured is not None)
    sigma = math.sqrt(variance + _heading_sigma(smoothed) ** 2)
    yaw = coarse + float(solution[0])
    warning = ""
    if abs(yaw) > max(SIGMAS * sigma, FLOOR_RAD):
        axle = _or_axle(yaw, forward, turn, separable or measured is not None)
        warning = (
            f"{motion.name}: heading is turned by {math.degrees(yaw):+.2f} degrees "
            f"(sigma {math.degrees(sigma):.2f}) against the direction in which the vehicle goes: "
            "yaw of every LiDAR to the vehicle is off by as much. "
            f"{HEADING_REMEDIES[source]}{axle}"
        )
    return HeadingDisagreement(
        yaw_rad=yaw,
        sigma_rad=sigma,
        axle_m=float(solution[1]) if separable else math.nan,
        duration_s=duration_s,
        measured=measured is not None,
        source=source,
        warning=warning,
    )


def _source(smoothed: SmoothedTrajectory) -> HeadingSource:
    """What tells the heading of a drive."""
    data = smoothed.data
    if data.orientation:
        return "imu"
    return "none" if data.headings is None and data.baselines is None else "antennas"


def _turn_of_map(
    smoothed: SmoothedTrajectory, motion: MotionData, source: HeadingSource
) -> tuple[float, float, str]:
    """Angle (rad) of the heading against the path of the fixes, 1 sigma, and what is assumed.

    Where fixes were dropped for it, the smoothed path may go anywhere: orientations tell it.
    """
    turn = _turn_against_fixes(smoothed)
    if abs(turn) > MAP_TURN_RAD and source == "imu":
        told, sigma = _turn_of_orientations(smoothed, motion)
        if abs(told) > MAP_TURN_RAD:
            assumed = "" if motion.twist is not None else " of a vehicle that drives forward"
            return told, sigma, assumed
    return turn, _heading_sigma(smoothed), ""


def _turn_against_fixes(smoothed: SmoothedTrajectory) -> float:
    """Angle (rad) from the path of the fixes to that of the smoothed antenna, about the vertical.

    Orientation and velocities together outvote fixes whose map is another; 0 without a path.
    """
    stamps, fixes, pieces = _pieces_of_fixes(smoothed)
    if not len(pieces):
        return 0.0
    R, t = smoothed.poses_at(stamps)
    antenna = t + R @ smoothed.data.lever_arm
    a, b = ((x[pieces[:, 1]] - x[pieces[:, 0]])[:, :2] for x in (fixes, antenna))
    far = np.minimum(np.hypot(*a.T), np.hypot(*b.T)) > MIN_PATH_M
    return _turn_between(a[far], b[far], axis_only=False) if far.any() else 0.0


def _pieces_of_fixes(smoothed: SmoothedTrajectory) -> tuple[IntArray, Array, IntArray]:
    """Stamps (n,) and positions (n, 3) of the fixes, first and last (k, 2) of pieces of `PATH_NS`.

    All of none without GNSS.
    """
    positions = smoothed.data.positions
    if positions is None:
        return np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 2), np.int64)
    begin, end = smoothed.span_ns
    inside = (positions.stamps_ns >= begin) & (positions.stamps_ns <= end)
    stamps = positions.stamps_ns[inside]
    later = np.searchsorted(stamps, stamps + PATH_NS)
    first = np.flatnonzero(later < len(stamps))
    return stamps, positions.position_map[inside], np.stack([first, later[first]], axis=1)


def _turn_of_orientations(smoothed: SmoothedTrajectory, motion: MotionData) -> tuple[float, float]:
    """`turn_of_orientations` of a drive; zeros where they do not tell it."""
    stamps, fixes, pieces = _pieces_of_fixes(smoothed)
    imu, data = motion.imu, smoothed.data
    usable = np.zeros(0, bool) if imu is None else usable_orientations(imu)
    if imu is None or imu.orientation_xyzw is None or not usable.any():
        return 0.0, 0.0
    times = np.asarray(imu.stamps_ns[usable])
    R = rotations_of(imu.orientation_xyzw[usable]) @ data.T_vehicle_imu.rotation().matrix().T
    velocity = _speeds_at(motion, times, int(times[0]))
    return turn_of_orientations(
        times, R, velocity, stamps[pieces], fixes[pieces], np.asarray(data.lever_arm)
    )


def turn_of_orientations(
    times_ns: IntArray,
    R_map_vehicle: Array,
    velocity: Array | None,
    pieces_ns: IntArray,
    pieces_map: Array,
    lever_arm: Array,
) -> tuple[float, float]:
    """Angle (rad) from the path of the fixes to that of the messages' orientations, and 1 sigma.

    Nothing is smoothed. The spread of the pieces tells the sigma. Zeros without a path.

    Args:
        times_ns: (n,) stamps of the orientations, ascending.
        R_map_vehicle: (n, 3, 3) by the orientations.
        velocity: (n, 2) of the vehicle's origin, m/s, vehicle axes; None: it drives forward.
        pieces_ns: (k, 2) stamps of first and last fix of pieces of the path.
        pieces_map: (k, 2, 3) these fixes, metres.
        lever_arm: (3,) antenna in the vehicle frame, metres.
    """
    ahead = np.tile([1.0, 0.0], (len(times_ns), 1)) if velocity is None else velocity
    course = np.einsum("nij,nj->ni", R_map_vehicle[:, :2, :2], ahead)
    steps = 0.5e-9 * np.diff(times_ns)[:, None] * (course[1:] + course[:-1])
    ways = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
    ends = np.minimum(np.searchsorted(times_ns, pieces_ns), len(times_ns) - 1)
    moved = (pieces_map[:, 1] - pieces_map[:, 0])[:, :2]
    told = (pieces_ns[:, 0] >= times_ns[0]) & (pieces_ns[:, 1] <= times_ns[-1])
    told &= (np.hypot(*moved.T) > MIN_PATH_M) & (ends[:, 0] < ends[:, 1])
    went = ways[ends[:, 1]] - ways[ends[:, 0]]
    arm = (R_map_vehicle @ lever_arm)[:, :2]
    turned = arm[ends[:, 1]] - arm[ends[:, 0]]
    if velocity is None:
        # As long as makes the antenna's way, with what it does in a turn, that of the fixes.
        a, b = np.sum(went**2, axis=1), np.sum(went * turned, axis=1)
        root = b**2 - a * (np.sum(turned**2, axis=1) - np.sum(moved**2, axis=1))
        told &= (a > 0.0) & (root > 0.0)
        scale = np.sqrt(np.maximum(root, 0.0)) - b
        went = went * (scale / np.where(a > 0.0, a, 1.0))[:, None]
    if not told.any():
        return 0.0, 0.0
    moved, went = moved[told], (went + turned)[told]
    turn = _turn_between(moved, went, axis_only=False)
    of_piece = np.arctan2(went[:, 1], went[:, 0]) - np.arctan2(moved[:, 1], moved[:, 0])
    left = np.remainder(of_piece - turn + math.pi, math.tau) - math.pi
    lengths_ns = np.diff(pieces_ns[told], axis=1)
    spacing_ns = np.diff(pieces_ns[told, 0], append=pieces_ns[told][-1:, 0])
    covered = np.minimum(spacing_ns, lengths_ns[:, 0]).sum() / np.median(lengths_ns)
    return turn, float(np.sqrt(np.mean(left**2) / max(float(covered), 1.0)))


def _fit(
    forward: Array, turn: Array | None, sideways: Array, measured: bool
) -> tuple[Array, float]:
    """Solution of `sideways = -yaw forward - x_axle turn`, (n,) each, and the variance of yaw.

    Without `turn` the axle is not estimated. `measured`: `sideways` is relative to a measured
    velocity.
    """
    A = np.stack([-forward] if turn is None else [-forward, -turn], axis=1)
    solution, *_ = np.linalg.lstsq(A, sideways, rcond=None)
    residual = sideways - A @ solution
    # Errors of the smoothed velocity are correlated over about a second: so many samples count as
    # one. Errors of measured velocities are white, and larger.
    scale = 1.0 if measured else 1.0 / (1e-9 * SPACING_NS)
    spread = float(residual @ residual) / max(len(forward) - A.shape[1], 1) * scale
    return np.asarray(solution), float((spread * np.linalg.inv(A.T @ A))[0, 0])


def _or_axle(yaw: float, forward: Array, turn: Array, separated: bool) -> str:
    """The other explanation: on a single arc, a vehicle frame off the rear axle looks the same."""
    rate = float(np.median(turn / forward))
    if separated or abs(rate) < MIN_CURVATURE_RANGE_1_M:
        return ""
    axle_m = yaw / rate
    where = f"{abs(axle_m):.2f} m {'behind' if axle_m > 0.0 else 'ahead of'} the rear axle"
    return (
        f". Nothing is wrong if the vehicle frame is {where}: a single arc does not distinguish "
        "the two"
    )


def _measured_at(motion: MotionData, stamps_ns: IntArray, begin_ns: int) -> Array | None:
    """(n, 2) measured velocities; None if the lateral one is not: odometry sets it to 0."""
    if motion.twist is None or is_planar(motion.twist):
        return None
    return _speeds_at(motion, stamps_ns, begin_ns)


def _ahead(motion: MotionData, stamps_ns: IntArray, begin_ns: int) -> Array:
    """(n, 2) forward or backward, by odometry; forward without it."""
    out = np.tile([1.0, 0.0], (len(stamps_ns), 1))
    speeds = _speeds_at(motion, stamps_ns, begin_ns)
    return out if speeds is None else out * np.sign(speeds[:, :1])


def _speeds_at(motion: MotionData, stamps_ns: IntArray, begin_ns: int) -> Array | None:
    """(n, 2) velocities of the messages, forward and to the left; None without them."""
    if motion.twist is None:
        return None
    finite = np.isfinite(motion.twist.velocity).all(axis=1)
    velocity = motion.twist.velocity[finite, :2]
    if len(velocity) < 2:
        return None
    times = np.asarray(motion.twist.stamps_ns[finite])
    x, xp = (stamps_ns - begin_ns) * 1e-9, (times - begin_ns) * 1e-9
    return np.stack([np.interp(x, xp, axis) for axis in velocity.T], 1)


def _turn_between(seen: Array, expected: Array, axis_only: bool) -> float:
    """The angle of the least-squares rotation from (n, 2) directions to those expected.

    With `axis_only` forward and backward are equivalent, and the angle is at most a right angle.
    """
    cross = seen[:, 0] * expected[:, 1] - seen[:, 1] * expected[:, 0]
    dot = (seen * expected).sum(axis=1)
    if not axis_only:
        return math.atan2(float(cross.sum()), float(dot.sum()))
    double = math.atan2(float((2.0 * cross * dot).sum()), float((dot**2 - cross**2).sum()))
    return 0.5 * double


def _heading_sigma(smoothed: SmoothedTrajectory) -> float:
    """1 sigma of the mean heading, taken as that of a single one: errors common to all remain."""
    return float(smoothed.pose_sigmas[2])
