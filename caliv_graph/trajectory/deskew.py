"""Motion compensation of a sweep: all of its points as if taken at the stamp."""

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
"""Spacing of the poses between which a point's motion is linear. A vehicle at 1 rad/s and
10 m/s^2 strays from that by 0.1 microradians and 1.3 micrometres."""


def deskew(
    scan: LidarScan, T_vehicle_lidar: gtsam.Pose3, trajectory: VehicleTrajectory
) -> LidarScan:
    """Moves every point into the LiDAR's frame at the scan's stamp.

    A point with time dt was measured at stamp + dt: `p' = (X(stamp) E)^-1 X(stamp + dt) E p`, X the
    vehicle's pose, E its mounting. Points of the sweep that are outside the trajectory's span by
    at most a sweep are moved as if the vehicle stood there: the first and last scan of a drive.

    Args:
        scan: with per-point times; one without is returned as it is.
        T_vehicle_lidar: mounting, guess or estimate.
        trajectory: of the drive.

    Returns:
        The scan with `point_times_s` None.

    Raises:
        TrajectoryError: the stamp is outside the trajectory's span, or the times are no times.
    """
    (points,) = deskewed(scan, [T_vehicle_lidar], trajectory)
    return replace(scan, points_lidar=points, point_times_s=None)


def deskewed(
    scan: LidarScan, T_vehicle_lidar: Iterable[gtsam.Pose3], trajectory: VehicleTrajectory
) -> Iterator[Array]:
    """Points (N, 3) of a scan moved as `deskew` does, for each of several extrinsics.

    The vehicle's motion, which takes as long as all the rest, is asked for once.

    Raises:
        TrajectoryError: as `deskew`, when the first is asked for.
    """
    if scan.point_times_s is None or not len(scan.points_lidar):
        yield from (scan.points_lidar for _ in T_vehicle_lidar)
        return
    if not np.isfinite(scan.point_times_s).all() or np.abs(scan.point_times_s).max() > 1.0:
        raise TrajectoryError(
            f"{scan.source}: per-point times from {scan.point_times_s.min():g} s to "
            f"{scan.point_times_s.max():g} s about the stamp: no sweep takes a second. Check its "
            "time field with 'caliv-graph inspect'"
        )
    offsets_ns: IntArray = np.round(1e9 * scan.point_times_s).astype(np.int64)
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
            f"{end} ns"
        )
    at = np.clip(scan.stamp_ns + np.append(knots, 0), begin, end)
    R, t = trajectory.poses_at(at)
    for mounting in T_vehicle_lidar:
        R_mount, t_mount = stack([mounting])
        R_lidar = R @ R_mount[0]
        t_lidar = t + R @ t_mount[0]
        back = R_lidar[-1].T
        R_knots = back @ R_lidar[:-1]
        t_knots = (t_lidar[:-1] - t_lidar[-1]) @ back.T
        yield _moved(scan.points_lidar, offsets_ns, knots, R_knots, t_knots)


def _moved(points: Array, offsets_ns: IntArray, knots: IntArray, R: Array, t: Array) -> Array:
    """Points between the two knots around their time, linear in time."""
    k = np.clip(np.searchsorted(knots, offsets_ns, "right") - 1, 0, len(knots) - 2)
    span = np.maximum(np.diff(knots), 1)[k]
    share = ((offsets_ns - knots[k]) / span)[:, None]
    before = np.einsum("nij,nj->ni", R[k], points) + t[k]
    after = np.einsum("nij,nj->ni", R[k + 1], points) + t[k + 1]
    return np.asarray(before + share * (after - before))
