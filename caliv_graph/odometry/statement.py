"""Up and ahead for a tracked LiDAR: the ground's normal, and the direction of travel."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from caliv_graph.config.model import Config
from caliv_graph.config.range_errors import range_errors
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.se3 import stack
from caliv_graph.mounting.sharpness import REACH_M
from caliv_graph.mounting.upright import SAME_M, SAME_RAD, Ground, ground_below
from caliv_graph.odometry.track import Track
from caliv_graph.products import Array
from caliv_graph.structure.standing import UNEVEN_M
from caliv_graph.trajectory.odometry import VehicleStatement
from caliv_graph.trajectory.tilt import (
    CLIMB_WINDOW_NS,
    CORRELATED_S,
    MIN_SPEED_M_S,
    STEP_NS,
    body_sigma_rad,
)

SLIP_RAD = math.radians(0.2)
"""1 sigma of the vehicle's x axis against its direction of travel on a straight: tolerance of the
thrust angle of an axle (0.1 to 0.2 degrees), and the slip that a crossfall of 2.5 % asks for (a
tyre has 3 degrees or less at its own load sideways)."""

LEAST_COURSE_RAD = 1e-3
"""Minimum scatter of a sample of the course: 1 mm over a metre."""

FIRST_RAD = 0.1
"""The same before the first fit."""

ROUNDS = 5
"""Of fitting and weighing; the lever enters by a sine, the weights by the residuals."""

GROUND_SCANS = 60
"""Scans in which the ground is looked for first."""

NEAR_GROUND_M = 15.0
"""Ground within this distance is that which the vehicle stands on."""

FEWEST_PATCHES = 5
"""Patches of ground in a scan that tell its normal."""


@dataclass(frozen=True)
class Course:
    """The direction of travel in level axes of a LiDAR.

    Attributes:
        angle_rad: from the axes' x to the direction of travel at zero curvature.
        sigma_rad: 1 sigma of it, without the slip of the vehicle; infinite: it never drove.
        ahead_m: how far the LiDAR is ahead of the point of the vehicle that does not slip.
    """

    angle_rad: float
    sigma_rad: float
    ahead_m: float


def ground_of(found: Track) -> Ground:
    """The plane that a LiDAR stands above all along its way.

    Raises:
        TrajectoryError: it sees none.
    """
    chosen = np.unique(np.linspace(0, len(found.patches) - 1, GROUND_SCANS).astype(np.int64))
    ground = ground_below([found.patches[k] for k in chosen.tolist()])
    if ground is None:
        raise TrajectoryError("it sees no ground below it that stays where it is")
    return ground


def statement_of(
    found: Track, ground: Ground, config: Config, R_vehicle_lidar: Array | None, drives: int
) -> VehicleStatement:
    """What a track says of T_vehicle_lidar.

    Args:
        found: the track.
        ground: below the LiDAR, roughly.
        config: how parallel to the ground the vehicle stands; sigma of its height.
        R_vehicle_lidar: (3, 3) guess: which way is forward; None: most of the way is.
        drives: number of drives of the vehicle. Slip and tilt are the same in all.
    """
    up, distance, scatter = _plane(found, ground)
    level = Ground(up, distance, ground.scans).R_level_lidar
    forward = None
    if R_vehicle_lidar is not None:
        x = level @ R_vehicle_lidar[0]
        forward = math.atan2(x[1], x[0])
    course = course_of(found, level, forward)
    ahead = level.T @ [math.cos(course.angle_rad), math.sin(course.angle_rad), 0.0]
    bias_m = range_errors(config.noise).offsets.usual
    body, height = body_sigma_rad(config), math.hypot(config.ground.sigma, bias_m)
    return VehicleStatement(
        up_lidar=up,
        ahead_lidar=ahead,
        distance_m=distance,
        tilt_rad=math.sqrt(scatter[0] ** 2 + drives * body**2),
        course_rad=math.sqrt(course.sigma_rad**2 + drives * SLIP_RAD**2),
        distance_sigma_m=math.sqrt(scatter[1] ** 2 + drives * height**2),
    )


def _plane(found: Track, ground: Ground) -> tuple[Array, float, Array]:
    """Mean normal and distance of the ground, lidar frame, and 1 sigma of both from the scatter.

    The moments of all patches of ground near by are summed per scan: the normals of single patches
    are noisy, and choosing by them would bias them.
    """
    per_scan = []
    for patches in found.patches:
        centre = patches.moments[:, :3, 3] / patches.moments[:, 3:, 3]
        near = patches.normal_lidar @ ground.up_lidar > math.cos(2.0 * SAME_RAD)
        near &= np.abs(centre @ ground.up_lidar + ground.height_m) < SAME_M
        near &= np.linalg.norm(centre, axis=1) < NEAR_GROUND_M
        if near.sum() >= FEWEST_PATCHES:
            per_scan.append(patches.moments[near].sum(axis=0))
    if not per_scan:
        return ground.up_lidar, ground.height_m, np.array([SAME_RAD, SAME_M])
    S = np.array(per_scan)
    up, distance = _fitted(S.sum(axis=0), ground.up_lidar)
    each = [_fitted(s, ground.up_lidar) for s in S]
    away = np.array([np.linalg.norm(n - up) / math.sqrt(2.0) for n, _ in each])
    higher = np.array([d for _, d in each]) - distance
    count = _independent(found, len(each))
    # The median withstands scans in which the ground is half hidden.
    scatter = 1.48 * np.array([np.median(away), np.median(np.abs(higher))])
    return up, distance, np.hypot(scatter, [0.0, UNEVEN_M]) / math.sqrt(count)


def _fitted(S: Array, up: Array) -> tuple[Array, float]:
    """Normal towards the LiDAR and distance of the plane of moments (4, 4)."""
    centre = S[:3, 3] / S[3, 3]
    normal = np.linalg.eigh(S[:3, :3] / S[3, 3] - np.outer(centre, centre))[1][:, 0]
    normal = normal if normal @ up > 0.0 else -normal
    return normal, -float(normal @ centre)


def _independent(found: Track, scans: int) -> float:
    """How many of so many scans count, as the slope of the ground changes over `CORRELATED_S`."""
    seconds = (found.stamps_ns[-1] - found.stamps_ns[0]) / NANOSECONDS_PER_SECOND
    return float(np.clip(seconds / CORRELATED_S, 1.0, scans))


def course_of(found: Track, R_level_lidar: Array, forward_rad: float | None) -> Course:
    """The direction of travel at zero curvature, in level axes of a LiDAR.

    A LiDAR that is a ahead of the point without slip moves at the angle `asin(a k)` from there, k
    the rate of turn over its signed speed (`README.md`, section 3). Angle and a are estimated
    together, a with a prior of `REACH_M`.

    Args:
        found: the track.
        R_level_lidar: (3, 3).
        forward_rad: roughly where the vehicle's x axis is in level axes; None: where most of the
            way goes.
    """
    heading, path, turned = _driven(found, R_level_lidar)
    if not len(path):
        return Course(forward_rad or 0.0, math.inf, 0.0)
    axis = 0.5 * float(np.angle((path * np.exp(2j * heading)).sum()))
    if forward_rad is not None:
        axis = forward_rad
    ahead = np.cos(heading - axis) > 0.0
    if forward_rad is None and path[ahead].sum() < path[~ahead].sum():
        axis, ahead = axis + math.pi, ~ahead
    curvature = np.where(ahead, turned, -turned) / path
    off = (heading - axis + np.where(ahead, 0.0, math.pi) + math.pi) % (2.0 * math.pi) - math.pi
    angle, sigma, ahead_m = _at_no_curvature(off, curvature)
    return Course(axis + angle, sigma, ahead_m)


def _driven(found: Track, R_level_lidar: Array) -> tuple[Array, Array, Array]:
    """Course in level axes of a LiDAR (rad), way (m) and turn (rad) in windows in which it moves.

    (k,) each; the axes turn with the LiDAR.
    """
    stamps = found.stamps_ns
    R, t = stack(found.T_map_lidar)
    R_level = R_level_lidar @ R @ R_level_lidar.T
    yaw, place = np.unwrap(np.arctan2(R_level[:, 1, 0], R_level[:, 0, 0])), t @ R_level_lidar.T
    at = np.arange(stamps[0] + CLIMB_WINDOW_NS, stamps[-1] - CLIMB_WINDOW_NS, STEP_NS)

    def there(times: Array, values: Array) -> Array:
        return np.asarray(np.interp(times - stamps[0], stamps - stamps[0], values))

    before, after = at - CLIMB_WINDOW_NS, at + CLIMB_WINDOW_NS
    x, y = (there(after, place[:, i]) - there(before, place[:, i]) for i in (0, 1))
    path, turned = np.hypot(x, y), there(after, yaw) - there(before, yaw)
    driving = path > MIN_SPEED_M_S * 2.0 * CLIMB_WINDOW_NS / NANOSECONDS_PER_SECOND
    heading = np.arctan2(y, x) - there(at, yaw)
    return heading[driving], path[driving], turned[driving]


def _at_no_curvature(course_rad: Array, curvature: Array) -> tuple[float, float, float]:
    """The course at zero curvature and 1 sigma (rad), and the lever ahead (m) that bends it.

    Args:
        course_rad: (k,) near zero.
        curvature: (k,) 1/m.
    """
    alike = CORRELATED_S / (STEP_NS / NANOSECONDS_PER_SECOND)
    lever_m, angle, sigma = 0.0, 0.0, math.inf
    for _ in range(ROUNDS):
        bent = np.arcsin(np.clip(lever_m * curvature, -0.9, 0.9))
        slope = curvature / np.cos(bent)
        A = np.stack([np.ones(len(slope)), slope], axis=1)
        y = course_rad - bent + slope * lever_m
        left = y - A @ [angle, lever_m] if math.isfinite(sigma) else np.full(len(y), FIRST_RAD)
        # The median: where a curvature begins, or wheels jump, the course is another one.
        noise = max(1.48 * float(np.median(np.abs(left))), LEAST_COURSE_RAD)
        weight = 1.0 / (1.0 + (left / (3.0 * noise)) ** 2) ** 2 / (noise**2 * alike)
        H = (A * weight[:, None]).T @ A + np.diag([0.0, REACH_M**-2.0])
        angle, lever_m = np.linalg.solve(H, (A * weight[:, None]).T @ y).tolist()
        sigma = math.sqrt(float(np.linalg.inv(H)[0, 0]))
    return angle, sigma, lever_m
