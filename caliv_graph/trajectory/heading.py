"""Does the vehicle go where it points? Heading against course over ground.

Calibration to the vehicle is only as good as the vehicle's own axes: an orientation source that is
turned about the vertical, or an IMU mounted a degree off what the config says, turns every LiDAR
with it, and nothing else in the data tells. The vehicle's own motion does: it does not slip
sideways at its rear axle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from caliv_graph.products import Array, IntArray, MotionData
from caliv_graph.trajectory.smoothed import SmoothedTrajectory

FASTER_THAN_M_S = 0.5
"""Below, the direction of travel is noise."""

LEAST_SECONDS = 2.0
"""Of driving, for the comparison to be one."""

SIGMAS = 4.0
"""Of disagreement that are told."""

FLOOR_RAD = math.radians(0.2)
"""Tyres slip, and roads are banked: less is never told."""

SPACING_NS = 100_000_000


@dataclass(frozen=True)
class HeadingDisagreement:
    """How course over ground and heading differ.

    Attributes:
        yaw_rad: by which the heading is turned against the motion, positive to the left.
        sigma_rad: of it.
        axle_m: x in the vehicle frame of the point that does not slip sideways, as the curves show
            it; NaN on a straight drive.
        duration_s: of driving looked at.
        measured: whether the lateral velocity was measured (twist), not taken to be zero.
        warning: a line for a person; empty if there is nothing to tell.
    """

    yaw_rad: float
    sigma_rad: float
    axle_m: float
    duration_s: float
    measured: bool
    warning: str


def heading_disagreement(
    smoothed: SmoothedTrajectory, motion: MotionData
) -> HeadingDisagreement | None:
    """Compares the direction in which the vehicle points and the one in which it goes.

    Where velocities with a lateral part are recorded, the direction of the GNSS's motion in vehicle
    axes is compared with theirs. Else the rear axle is taken not to slip: `v_y = -psi v_x -
    x_axle w_z`, psi the heading's error, x_axle the axle's place in the vehicle frame, which the
    curves of the drive tell apart if they are not all alike. On a single arc they are not told
    apart, and the frame is taken to be at the axle.

    Args:
        smoothed: of the drive.
        motion: what it was smoothed from.

    Returns:
        The comparison, or None if the vehicle hardly moves.
    """
    begin, end = smoothed.span_ns
    at = np.arange(begin, end, SPACING_NS, dtype=np.int64)
    velocity, rates = smoothed.velocities_at(at)
    fast = np.hypot(velocity[:, 0], velocity[:, 1]) > FASTER_THAN_M_S
    duration_s = float(fast.sum()) * SPACING_NS * 1e-9
    if duration_s < LEAST_SECONDS:
        return None
    turn = rates[fast, 2]
    seconds = (at[fast] - begin) * 1e-9
    measured = _measured(motion)
    if measured is not None:
        times, said = measured
        along = np.stack([np.interp(seconds, (times - begin) * 1e-9, axis) for axis in said.T], 1)
        coarse = _turn_between(velocity[fast, :2], along, axis_only=False)
    else:
        along = np.tile([1.0, 0.0], (len(turn), 1))
        coarse = _turn_between(velocity[fast, :2], along, axis_only=True)
    # The coarse part may be a right angle (north for east); what is left is small.
    c, s = math.cos(coarse), math.sin(coarse)
    forward = c * velocity[fast, 0] - s * velocity[fast, 1]
    sideways = s * velocity[fast, 0] + c * velocity[fast, 1]
    if measured is not None:
        sideways = sideways - along[:, 1]
    columns = [-forward]
    # Rate of turn and speed, apart from each other by more than noise: then the axle shows.
    separable = measured is None and _apart(forward, turn)
    if separable:
        columns.append(-turn)
    A = np.stack(columns, axis=1)
    solution, *_ = np.linalg.lstsq(A, sideways, rcond=None)
    residual = sideways - A @ solution
    # The smoothed velocity's error lasts about a second: so many samples are independent. That of
    # measured velocities is white, and larger.
    scale = 1.0 if measured is not None else 1.0 / (1e-9 * SPACING_NS)
    spread = float(residual @ residual) / max(len(forward) - len(columns), 1) * scale
    cov = spread * np.linalg.inv(A.T @ A)
    heading_sigma = _heading_sigma(smoothed)
    sigma = math.sqrt(float(cov[0, 0]) + heading_sigma**2)
    yaw = coarse + float(solution[0])
    axle = float(solution[1]) if separable else math.nan
    warning = ""
    if abs(yaw) > max(SIGMAS * sigma, FLOOR_RAD):
        warning = (
            f"{motion.name}: heading is turned by {math.degrees(yaw):+.2f} degrees "
            f"(sigma {math.degrees(sigma):.2f}) against the direction in which the vehicle goes: "
            "yaw of every LiDAR to the vehicle is off by as much. Check imu.T_vehicle_imu, or set "
            f"imu.yaw_bias{_or_axle(yaw, forward, turn, separable or measured is not None)}"
        )
    return HeadingDisagreement(yaw, sigma, axle, duration_s, measured is not None, warning)


def _or_axle(yaw: float, forward: Array, turn: Array, told_apart: bool) -> str:
    """On a single arc, a vehicle frame off the rear axle looks the same."""
    rate = float(np.median(turn / forward))
    if told_apart or abs(rate) < 0.02:
        return ""
    return (
        f". Nothing is wrong if the vehicle frame is {-yaw / rate:.2f} m behind the rear axle: "
        "a single arc does not tell"
    )


def _measured(motion: MotionData) -> tuple[IntArray, Array] | None:
    """Stamps (n,) and velocities (n, 2), if the lateral one is measured: odometry says zero."""
    if motion.twist is None:
        return None
    finite = np.isfinite(motion.twist.velocity).all(axis=1)
    velocity = motion.twist.velocity[finite, :2]
    if len(velocity) < 2 or not np.abs(velocity[:, 1]).any():
        return None
    return np.asarray(motion.twist.stamps_ns[finite]), velocity


def _turn_between(seen: Array, expected: Array, axis_only: bool) -> float:
    """The angle by which (n, 2) directions have to be turned to be those expected, on average.

    With `axis_only` forward and backward are the same, and the angle is within a right angle.
    """
    cross = seen[:, 0] * expected[:, 1] - seen[:, 1] * expected[:, 0]
    dot = (seen * expected).sum(axis=1)
    if not axis_only:
        return math.atan2(float(cross.sum()), float(dot.sum()))
    double = math.atan2(float((2.0 * cross * dot).sum()), float((dot**2 - cross**2).sum()))
    return 0.5 * double


def _apart(forward: Array, turn: Array) -> bool:
    """Whether the ratio of turn to speed varies: curves to both sides, or curves and straights."""
    curvature = turn / forward
    return float(np.ptp(np.percentile(curvature, [5, 95]))) > 0.02


def _heading_sigma(smoothed: SmoothedTrajectory) -> float:
    """Of the mean heading over the drive: its errors last about a second."""
    cov = smoothed.trajectory.cov
    if cov is None or not len(cov):
        return 0.0
    return float(np.sqrt(np.median(cov[:, 2, 2])))
