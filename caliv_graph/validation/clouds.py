"""Points of the static surroundings of a drive, thinned, from many scans.

Scans are streamed. At most `SCANS` scans of each LiDAR and `POINTS` points of each scan are kept,
so memory does not grow with the duration of the drive.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from threadpoolctl import threadpool_limits

from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config, TargetRegion
from caliv_graph.errors import RecordingError, TargetError
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, BoolArray, IntArray, LidarScan, Recording
from caliv_graph.targets.ground.surface import HALF_SIZE_M, fit_surface
from caliv_graph.targets.search import find_target
from caliv_graph.trajectory.deskew import deskew
from caliv_graph.trajectory.select import VehicleTrajectory

SCANS = 100
"""Number of scans of one LiDAR: one per metre of a figure-eight."""

POINTS = 2000
"""Number of points of one scan that are kept."""

CELL_M = 0.1
"""Cell size with at most one point of a scan each: near walls have thousands of points."""

CLEARANCE_M = 0.15
"""Height above ground below which points are ground."""

GROUND_CELL_M = 0.5
"""Cell size for ground points, which are far more numerous than all others."""

GROUND_RANGE_M = 15.0
"""Largest range of ground points. Farther ground has too flat an angle for its height."""

TARGET_MARGIN_M = 0.5
"""Margin around a target's region, for points moved by a wrong calibration."""

BODY_X_M = (-2.0, 5.0)
BODY_Y_M = (-1.4, 1.4)
"""Limits of the vehicle's body in the vehicle frame. Points within are no structure."""

TURN_M = 5.0
"""Path length that counts like a turn of 1 rad when scans are spread over a drive."""

CREEP_M_S = 0.02
"""Smallest speed that is assumed, so that a drive without motion has scans too."""


@dataclass(frozen=True)
class Extrinsics:
    """A set of extrinsics to measure; a time offset is stamp minus true time, zero if absent."""

    T_vehicle_lidar: Mapping[str, gtsam.Pose3]
    time_offset_s: Mapping[str, float]

    def true_ns(self, lidar: str, stamps_ns: IntArray) -> IntArray:
        """(n,) true times of clouds with stamps (n,)."""
        shift_ns = round(1e9 * self.time_offset_s.get(lidar, 0.0))
        return np.asarray(stamps_ns, dtype=np.int64) - shift_ns


@dataclass(frozen=True)
class Placed:
    """The points under one set of extrinsics.

    Attributes:
        taken_ns: (S,) true time of each scan.
        R_map_vehicle: (S, 3, 3) the vehicle's attitude at these times.
        t_map_vehicle: (S, 3) metres, the vehicle's position.
        points_lidar: (N, 3) metres, motion compensated with these extrinsics.
    """

    extrinsics: Extrinsics
    taken_ns: IntArray
    R_map_vehicle: Array
    t_map_vehicle: Array
    points_lidar: Array


@dataclass(frozen=True)
class Clouds:
    """Points of the static surroundings of a drive, of all LiDARs.

    Attributes:
        lidars: names, in the config's order.
        lidar: (N,) index of the LiDAR of each point.
        scan: (N,) index of the scan of each point, counted over all LiDARs.
        placed: the points by the name of a set of extrinsics.
        scans: number of scans read per LiDAR.
        target_points: number of points left out because they are in a target's region.
    """

    lidars: tuple[str, ...]
    lidar: IntArray
    scan: IntArray
    placed: Mapping[str, Placed]
    scans: Mapping[str, int]
    target_points: int = 0

    def points_vehicle(self, placed: Placed, poses: Sequence[gtsam.Pose3] | None = None) -> Array:
        """(N, 3) metres, vehicle frame; `poses` replace the T_vehicle_lidar of `placed`."""
        if poses is None:
            poses = [placed.extrinsics.T_vehicle_lidar[name] for name in self.lidars]
        R, t = stack(poses)
        turned = np.einsum("nij,nj->ni", R[self.lidar], placed.points_lidar)
        return np.asarray(turned + t[self.lidar])

    def points_map(self, placed: Placed, poses: Sequence[gtsam.Pose3] | None = None) -> Array:
        """(N, 3) metres, map; see `points_vehicle`."""
        vehicle = self.points_vehicle(placed, poses)
        turned = np.einsum("nij,nj->ni", placed.R_map_vehicle[self.scan], vehicle)
        return np.asarray(turned + placed.t_map_vehicle[self.scan])

    def beams_map(self, placed: Placed, poses: Sequence[gtsam.Pose3] | None = None) -> Array:
        """(N, 3) unit vectors from the LiDARs to the points, map; see `points_vehicle`."""
        if poses is None:
            poses = [placed.extrinsics.T_vehicle_lidar[name] for name in self.lidars]
        R, _ = stack(poses)
        beams = np.einsum("nij,nj->ni", R[self.lidar], placed.points_lidar)
        beams = np.einsum("nij,nj->ni", placed.R_map_vehicle[self.scan], beams)
        return np.asarray(beams / np.maximum(np.linalg.norm(beams, axis=1), 1e-9)[:, None])


def choose_scans(stamps_ns: Sequence[int], trajectory: VehicleTrajectory) -> IntArray:
    """At most `SCANS` of ascending stamps in the trajectory, evenly over path and turns."""
    begin, end = trajectory.span_ns
    stamps = np.array([t for t in stamps_ns if begin <= t <= end], dtype=np.int64)
    if len(stamps) <= SCANS:
        return stamps
    R, t = trajectory.poses_at(stamps)
    cosine = 0.5 * (np.einsum("nij,nij->n", R[:-1], R[1:]) - 1.0)
    steps = np.linalg.norm(np.diff(t, axis=0), axis=1) + TURN_M * np.arccos(
        np.clip(cosine, -1.0, 1.0)
    )
    steps += CREEP_M_S * 1e-9 * np.diff(stamps)
    way = np.concatenate([np.zeros(1), np.cumsum(steps)])
    wanted = np.linspace(0.0, way[-1], SCANS)
    return np.asarray(stamps[np.unique(np.searchsorted(way, wanted).clip(0, len(stamps) - 1))])


def target_regions(
    recording: Recording, trajectory: VehicleTrajectory, config: Config, progress: Progress
) -> tuple[tuple[TargetRegion, ...], tuple[str, ...]]:
    """Regions of the targets, which the solve used, and a note if there is none.

    Raises:
        RecordingError: a cloud could not be read.
    """
    if config.target is not None:
        return config.target or (), ()
    try:
        (found,) = find_target([recording], [trajectory], config, progress)
    except TargetError:
        return (), (f"{recording.name}: shows no target; nothing had to be left out for it",)
    return (found.region,), ()


class _Regions:
    """Test whether points of the map are in the region of a target."""

    def __init__(self, regions: Sequence[TargetRegion], trajectory: VehicleTrajectory) -> None:
        begin, _ = trajectory.span_ns
        R, t = trajectory.poses_at([begin])
        self._boxes = [
            (
                (R[0], t[0]) if region.frame == "start" else (np.eye(3), np.zeros(3)),
                np.array(region.min) - TARGET_MARGIN_M,
                np.array(region.max) + TARGET_MARGIN_M,
            )
            for region in regions
        ]

    def hold(self, points_map: Array) -> BoolArray:
        """(n,)."""
        inside = np.zeros(len(points_map), dtype=bool)
        for (R, t), low, high in self._boxes:
            points = (points_map - t) @ R
            inside |= ((points >= low) & (points <= high)).all(axis=1)
        return inside


def read_clouds(
    recording: Recording,
    trajectory: VehicleTrajectory,
    chosen: Mapping[str, IntArray],
    extrinsics: Mapping[str, Extrinsics],
    regions: Sequence[TargetRegion],
    with_ground: bool,
    progress: Progress,
) -> Clouds:
    """Reads the static surroundings of a drive.

    Args:
        recording: the drive.
        trajectory: its trajectory; the chosen stamps are within its span.
        chosen: per LiDAR the stamps of the scans to read.
        extrinsics: sets of extrinsics by name. The first set decides which points are ground and
            target.
        regions: regions of the targets, left out.
        with_ground: whether the ground is kept, because the solve did not use it.
        progress: advanced at every scan.

    Raises:
        RecordingError: a cloud could not be read, or no scan has a point.
    """
    first = next(iter(extrinsics))
    reader = _Reader(trajectory, extrinsics, _Regions(regions, trajectory), with_ground)
    names = tuple(chosen)
    total = sum(map(len, chosen.values()))
    # The matrices are small: threads of the linear algebra library would make this slower.
    with (
        progress.stage("reading the surroundings", total) as advance,
        threadpool_limits(limits=1),
    ):
        for index, name in enumerate(names):
            wanted = set(chosen[name].tolist())
            for scan in recording.scans(name, wanted) if wanted else ():
                reader.add(index, scan)
                advance()
    if not reader.scans:
        raise RecordingError(
            f"{recording.name}: has no cloud of {', '.join(names)} within the trajectory's span. "
            "Check the clocks with 'caliv-graph inspect'"
        )
    counts = [lidar for lidar, _ in reader.scans]
    at = np.repeat(np.arange(len(counts)), [len(points[first]) for _, points in reader.scans])
    of = np.array(counts, dtype=np.int64)
    placed = {}
    for key, m in extrinsics.items():
        taken: IntArray = np.array([t[key] for t in reader.taken_ns], dtype=np.int64)
        R, t = trajectory.poses_at(taken)
        points = np.concatenate([p[key] for _, p in reader.scans])
        placed[key] = Placed(m, taken, R, t, points)
    return Clouds(
        lidars=names,
        lidar=of[at],
        scan=at,
        placed=placed,
        scans={name: counts.count(i) for i, name in enumerate(names)},
        target_points=reader.target_points,
    )


class _Reader:
    """Collects scans and keeps the points of static structure."""

    def __init__(
        self,
        trajectory: VehicleTrajectory,
        extrinsics: Mapping[str, Extrinsics],
        regions: _Regions,
        with_ground: bool,
    ) -> None:
        self._trajectory = trajectory
        self._extrinsics = extrinsics
        self._regions = regions
        self._with_ground = with_ground
        self.scans: list[tuple[int, dict[str, Array]]] = []
        self.taken_ns: list[dict[str, int]] = []
        self.target_points = 0

    def add(self, lidar: int, scan: LidarScan) -> None:
        begin, end = self._trajectory.span_ns
        stamp: IntArray = np.array([scan.stamp_ns], dtype=np.int64)
        taken = {
            key: min(max(int(m.true_ns(scan.lidar, stamp)[0]), begin), end)
            for key, m in self._extrinsics.items()
        }
        thin = _thinned(scan)
        whole = {
            key: deskew(
                replace(thin, stamp_ns=taken[key]), m.T_vehicle_lidar[scan.lidar], self._trajectory
            ).points_lidar
            for key, m in self._extrinsics.items()
        }
        key = next(iter(self._extrinsics))
        kept = self._standing(
            whole[key], self._extrinsics[key].T_vehicle_lidar[scan.lidar], taken[key]
        )
        if len(kept) > POINTS:
            # A fixed seed: the same scan gives the same points.
            rng = np.random.default_rng(0)
            kept = kept[np.sort(rng.choice(len(kept), POINTS, replace=False))]
        self.scans.append((lidar, {k: points[kept] for k, points in whole.items()}))
        self.taken_ns.append(taken)

    def _standing(self, points: Array, T_vehicle_lidar: gtsam.Pose3, at_ns: int) -> IntArray:
        """Indices of the points of structure, without target and vehicle."""
        if not len(points):
            return np.zeros(0, dtype=np.int64)
        R, t = self._trajectory.poses_at([at_ns])
        R_vl = T_vehicle_lidar.rotation().matrix()
        level = points @ (R[0] @ R_vl).T
        vehicle = points @ R_vl.T + T_vehicle_lidar.translation()
        body = _within(vehicle[:, 0], BODY_X_M) & _within(vehicle[:, 1], BODY_Y_M)
        near = (np.abs(level[:, :2]) < HALF_SIZE_M).all(axis=1) & ~body
        surface = fit_surface(level[near]) if near.any() else None
        kept = near
        if surface is not None:
            height = level[:, 2] - surface.height_at(level[:, :2])
            kept = near & (height > CLEARANCE_M)
            if self._with_ground:
                kept |= near & _ground(level, height)
        index = np.flatnonzero(kept)
        inside = self._regions.hold(vehicle[index] @ R[0].T + t[0])
        self.target_points += int(inside.sum())
        return np.asarray(index[~inside])


def _within(values: Array, limits: tuple[float, float]) -> BoolArray:
    return np.asarray((values > limits[0]) & (values < limits[1]))


def _ground(level: Array, height: Array) -> BoolArray:
    """Mask of points on the ground near the LiDAR, one per cell."""
    on = np.flatnonzero(
        (np.abs(height) < CLEARANCE_M) & (np.hypot(level[:, 0], level[:, 1]) < GROUND_RANGE_M)
    )
    _, first = np.unique(np.floor(level[on, :2] / GROUND_CELL_M), axis=0, return_index=True)
    out = np.zeros(len(level), dtype=bool)
    out[on[first]] = True
    return out


def _thinned(scan: LidarScan) -> LidarScan:
    """The scan with its near points only, one per cell."""
    reach_m = math.hypot(HALF_SIZE_M, HALF_SIZE_M)
    near = np.flatnonzero(np.einsum("ni,ni->n", scan.points_lidar, scan.points_lidar) < reach_m**2)
    cell = np.floor(scan.points_lidar[near] / CELL_M).astype(np.int64) + 1024
    _, first = np.unique((cell[:, 0] * 2048 + cell[:, 1]) * 2048 + cell[:, 2], return_index=True)
    some = near[np.sort(first)]
    times = scan.point_times_s
    return replace(
        scan,
        points_lidar=scan.points_lidar[some],
        point_times_s=None if times is None else times[some],
    )
