"""Motion compensation: moves all points of a sweep to the sweep's stamp."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import gtsam
import numpy as np

from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, IntArray, LidarScan
from caliv_graph.trajectory.select import VehicleTrajectory

KNOT_NS = 1_000_000
"""Spacing of the poses between which a point's motion is taken as linear. At 1 rad/s and 10 m/s^2
the error is 0.1 microradians and 1.3 micrometres."""

MAX_OFFSET_S = 1.0
"""Largest time of a point from the stamp. A sweep of any LiDAR takes at most 0.2 s; larger values
are absolute times or the wrong unit."""


def deskew(
    scan: LidarScan, T_vehicle_lidar: gtsam.Pose3, trajectory: VehicleTrajectory
) -> LidarScan:
    """Moves every point into the LiDAR's frame at the scan's stamp (`README.md`, section 9).

    A scan without per-point times is returned as it is, others with `point_times_s` None. Before
    and after the trajectory's span the vehicle is taken to stand: this concerns points of the first
    and last scan of a drive.

    Raises:
        TrajectoryError: the stamp is outside the trajectory's span, or the times are unusable.
    """
    (points,) = deskewed(scan, [T_vehicle_lidar], trajectory)
    return replace(scan, points_lidar=points, point_times_s=None)


def deskewed_with_origins(
    scan: LidarScan, T_vehicle_lidar: gtsam.Pose3, trajectory: VehicleTrajectory
) -> tuple[Array, Array]:
    """Points (N, 3) of a scan moved as by `deskew`, and where the LiDAR was at their times (N, 3).

    A beam went from there to the point. At 10 m/s that is up to a metre from where the LiDAR is at
    the stamp.

    Raises:
        TrajectoryError: as `deskew`.
    """
    times_s = scan.point_times_s
    both = replace(
        scan,
        points_lidar=np.vstack([scan.points_lidar, np.zeros_like(scan.points_lidar)]),
        point_times_s=None if times_s is None else np.tile(times_s, 2),
    )
    (moved,) = deskewed(both, [T_vehicle_lidar], trajectory)
    points, origins = np.split(moved, 2)
    return points, origins


def deskewed(
    scan: LidarScan, T_vehicle_lidar: Iterable[gtsam.Pose3], trajectory: VehicleTrajectory
) -> Iterator[Array]:
    """Points (N, 3) of a scan moved as by `deskew`, for each of several extrinsics.

    The vehicle's poses, half of the cost, are computed once.

    Raises:
        TrajectoryError: as `deskew`, when the first is asked for.
    """
    times_s = checked_times(scan)
    if times_s is None:
        yield from (scan.points_lidar for _ in T_vehicle_lidar)
        return
    offsets_ns: IntArray = np.round(1e9 * times_s).astype(np.int64)
    first, last = int(offsets_ns.min()), int(offsets_ns.max())
    if last == first == 0:
        yield from (scan.points_lidar for _ in T_vehicle_lidar)
        return
    count = max((last - first) // KNOT_NS + 1, 1)
    knots = first + (last - first) * np.arange(count + 1) // count
    begin, end = trajectory.span_ns
    if not begin <= scan.stamp_ns <= end:
        raise TrajectoryError(
            f"{scan.source}: stamp {scan.stamp_ns} ns is outside the trajectory's span, {begin} to "
            f"{end} ns. Check the clocks with 'caliv-graph inspect'"
        )
    at = np.clip(scan.stamp_ns + np.append(knots, 0), begin, end)
    R, t = trajectory.poses_at(at)
    for extrinsic in T_vehicle_lidar:
        R_extrinsic, t_extrinsic = stack([extrinsic])
        R_lidar = R @ R_extrinsic[0]
        t_lidar = t + R @ t_extrinsic[0]
        back = R_lidar[-1].T
        R_knots = back @ R_lidar[:-1]
        t_knots = (t_lidar[:-1] - t_lidar[-1]) @ back.T
        yield _moved(scan.points_lidar, offsets_ns, knots, R_knots, t_knots)


def checked_times(scan: LidarScan) -> Array | None:
    """Times of a scan's points (N,), seconds after the stamp; None without times or points.

    Raises:
        TrajectoryError: the times are unusable.
    """
    times_s = scan.point_times_s
    if times_s is None or not len(times_s):
        return None
    if not np.isfinite(times_s).all() or np.abs(times_s).max() > MAX_OFFSET_S:
        raise TrajectoryError(
            f"{scan.source}: per-point times from {times_s.min():g} s to {times_s.max():g} s about "
            "the stamp: no sweep takes a second. Check its time field with 'caliv-graph inspect'"
        )
    return times_s


def _moved(points: Array, offsets_ns: IntArray, knots: IntArray, R: Array, t: Array) -> Array:
    """Points interpolated linearly in time between their two neighbouring knots."""
    k = np.clip(np.searchsorted(knots, offsets_ns, "right") - 1, 0, len(knots) - 2)
    span = np.maximum(np.diff(knots), 1)[k]
    part = ((offsets_ns - knots[k]) / span)[:, None]
    before = np.einsum("nij,nj->ni", R[k], points) + t[k]
    after = np.einsum("nij,nj->ni", R[k + 1], points) + t[k + 1]
    return np.asarray(before + part * (after - before))
