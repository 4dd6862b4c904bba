"""The config with the mountings of LiDARs that have no initial guess."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from caliv_graph.common.progress import Advance, Progress
from caliv_graph.config.guesses import with_found_guess
from caliv_graph.config.model import Config
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import ConfigError
from caliv_graph.mounting.sharpness import (
    MOST_POINTS,
    Found,
    Sightings,
    difference_m,
    sharpest,
)
from caliv_graph.mounting.upright import Ground, ground_below
from caliv_graph.products import Array, BoolArray, IntArray, LidarScan, Recording
from caliv_graph.structure.patches import RangeNoise
from caliv_graph.structure.planar import ScanPatches, planar_patches
from caliv_graph.targets.ground.surface import HALF_SIZE_M, fit_surface
from caliv_graph.targets.search.find import scans_to_read
from caliv_graph.trajectory.deskew import checked_times
from caliv_graph.trajectory.select import VehicleTrajectory

GROUND_SCANS = 20
"""Scans in which the ground is looked for."""

FEW_POINTS = 10_000
"""Scans with fewer points are all looked at: those of a sparse LiDAR show ground here and there."""

VOXEL_M = 0.1
"""One point of a scan is kept per voxel of this size until up is known."""

LOW_M, HIGH_M = 0.25, 4.0
"""Heights above the ground of what stands there: above kerbs, below branches."""

THIN_M = 0.3
"""One point of a scan counts per cell of this size: near walls have thousands."""

MOST_PER_SCAN = 150
"""Points of a scan that count, so that no single scan draws the map."""

OWN_SHARE = 0.6
"""A cell that moves with the LiDAR and is filled in so many scans holds the vehicle's own body."""

FARTHEST_M = 60.0
"""Points farther away are not kept: the surface of the ground ends at half of this."""

FEWEST_POINTS = 40
"""Points above ground below which there is nothing to draw a map of."""

AMBIGUOUS = 0.9
"""Another mounting whose map is so much as sharp may be the right one."""

OTHER_M = 2.0
"""Mountings that put a point at 15 m less than this apart are the same for the stages after."""


@dataclass(frozen=True)
class Placement:
    """The mounting of one LiDAR, found without a guess.

    Attributes:
        lidar: its name.
        T_vehicle_lidar: good to 0.2 m and 2 degrees where the drive determines it.
        others: mountings that fit nearly as well.
    """

    lidar: str
    T_vehicle_lidar: gtsam.Pose3
    others: tuple[gtsam.Pose3, ...]


def place_lidars(
    recordings: Sequence[Recording],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    progress: Progress,
) -> tuple[Config, tuple[Placement, ...]]:
    """Finds the mountings of the LiDARs without an initial guess, in the drive that turns most.

    LiDARs with a guess are taken as they are, and what they see helps to place the others, if they
    see the ground and what stands on it.

    Returns:
        The config with what was found as guesses, and the placements.

    Raises:
        ConfigError: a LiDAR without a guess sees no ground, or nothing that stands on it.
        RecordingError: a cloud could not be read.
    """
    missing = [name for name, lidar in config.lidars.items() if lidar.initial is None]
    if not missing:
        return config, ()
    drive = max(range(len(recordings)), key=lambda i: _turned_rad(trajectories[i]))
    recording, trajectory = recordings[drive], trajectories[drive]
    stamps = {n: scans_to_read(recording.scan_stamps_ns(n), trajectory) for n in config.lidars}
    views: dict[str, View] = {}
    total = sum(map(len, stamps.values()))
    with progress.stage("finding the mountings", total) as advance:
        for name in config.lidars:
            try:
                views[name] = view_of(recording, trajectory, config, name, stamps[name], advance)
            except ConfigError:
                if name in missing:
                    raise
        known = {
            n: in_level_axes(views[n], config.lidars[n].guess()) for n in views if n not in missing
        }
        alone = {name: sharpest(views[name].sightings) for name in missing}
        placements: dict[str, Placement] = {}
        # The clearest first: on an arc the others are placed about it.
        for name in sorted(missing, key=lambda n: _clearness(alone[n]), reverse=True):
            found = alone[name]
            if known:
                others = [(views[n].sightings, mounting) for n, mounting in known.items()]
                found = sharpest(views[name].sightings, others)
            known[name] = found.mountings[0]
            placements[name] = _placement(name, views[name].ground, found, config)
    for name in missing:
        config = with_found_guess(config, name, placements[name].T_vehicle_lidar)
    return config, tuple(placements[name] for name in missing)


@dataclass(frozen=True)
class View:
    """What one LiDAR saw of a drive: the ground below it, and what stands around."""

    ground: Ground
    sightings: Sightings

    @property
    def right_handed(self) -> View:
        """What it saw if the y of its clouds points to the right: x forward, z up, left-handed."""
        level = replace(self.sightings, level=self.sightings.level.conj())
        up = self.ground.up_lidar * np.array([1.0, -1.0, 1.0])
        return View(replace(self.ground, up_lidar=up), level)


def _turned_rad(trajectory: VehicleTrajectory) -> float:
    """How far a vehicle turns on its way, summed over both directions."""
    begin, end = trajectory.span_ns
    count = max((end - begin) // NANOSECONDS_PER_SECOND, 1)
    R, _ = trajectory.poses_at(begin + (end - begin) * np.arange(count + 1) // count)
    return float(np.abs(np.diff(np.unwrap(np.arctan2(R[:, 1, 0], R[:, 0, 0])))).sum())


def _clearness(found: Found) -> float:
    """How much sharper the best map is than other good ones."""
    return float(found.sharpness[0] / found.sharpness[-1])


def view_of(
    recording: Recording,
    trajectory: VehicleTrajectory,
    config: Config,
    name: str,
    stamps_ns: IntArray,
    advance: Advance,
) -> View:
    """Reads the chosen scans of one LiDAR.

    Raises:
        ConfigError: it sees no ground, or nothing that stands on it.
        RecordingError: a cloud could not be read.
    """
    lidar = config.lidars[name]
    scans: list[_Scan] = []
    patches: list[ScanPatches] = []
    noise = RangeNoise.constant(config.noise.lidar_range_m)
    looked = set(_even(len(stamps_ns), GROUND_SCANS).tolist())
    for k, scan in enumerate(recording.scans(name, wanted=set(stamps_ns.tolist()))):
        range_m = np.linalg.norm(scan.points_lidar, axis=1)
        near = (range_m >= lidar.min_range) & (range_m <= lidar.max_range)
        if k in looked or len(near) < FEW_POINTS:
            patches.append(planar_patches(scan.points_lidar[near], noise))
        scans.append(_thinned(scan, near & (range_m < FARTHEST_M)))
        advance()
    ground = ground_below(patches)
    if ground is None:
        raise ConfigError(
            f"lidars.{name}.initial is not given, and lidar '{name}' sees no ground that would "
            f"tell its mounting: {len(patches)} scans looked at show no plane that stays where it "
            f"is. Enter lidars.{name}.initial: xyz in metres, rpy_deg in degrees",
        )
    sightings = _sightings(scans, ground.R_level_lidar, trajectory)
    if len(sightings.level) < FEWEST_POINTS:
        raise ConfigError(
            f"lidars.{name}.initial is not given, and nothing stands on the ground within "
            f"{HALF_SIZE_M:.0f} m of lidar '{name}' that would tell its mounting "
            f"({len(sightings.level)} points in {len(scans)} scans, needs {FEWEST_POINTS}). "
            f"Enter lidars.{name}.initial, or drive past walls, cars or a chair",
        )
    return View(ground, sightings)


def _even(count: int, most: int) -> IntArray:
    """At most so many of `count` indices, evenly spread."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(most, count)).astype(np.int64))


@dataclass(frozen=True)
class _Scan:
    """A thinned scan: points (n, 3) in metres, lidar frame, and the stamp of each (n,)."""

    points: Array
    stamps_ns: IntArray


def _thinned(scan: LidarScan, near: BoolArray) -> _Scan:
    points = scan.points_lidar[near]
    voxel = np.floor(points / VOXEL_M).astype(np.int64) + (1 << 19)
    _, first = np.unique((voxel[:, 0] << 40) | (voxel[:, 1] << 20) | voxel[:, 2], return_index=True)
    first = np.sort(first)
    times_s = checked_times(scan)
    offset_s = np.zeros(len(first)) if times_s is None else times_s[near][first]
    stamps = scan.stamp_ns + np.round(NANOSECONDS_PER_SECOND * offset_s).astype(np.int64)
    return _Scan(points[first], stamps)


def _sightings(
    scans: Sequence[_Scan], R_level_lidar: Array, trajectory: VehicleTrajectory
) -> Sightings:
    """What stands around, without the vehicle's own body; every point at its own time."""
    begin, end = trajectory.span_ns
    level, stamps, scan_of = [], [], []
    for k, scan in enumerate(scans):
        points = scan.points @ R_level_lidar.T
        surface = fit_surface(points)
        if surface is None:
            continue
        height = points[:, 2] - surface.height_at(points[:, :2])
        inside = (np.abs(points[:, :2]) < HALF_SIZE_M).all(axis=1)
        stands = np.flatnonzero((height > LOW_M) & (height < HIGH_M) & inside)
        cell = np.floor(points[stands, :2] / THIN_M).astype(np.int64)
        _, first = np.unique(cell @ np.array([1 << 20, 1]), return_index=True)
        stands = stands[np.sort(first)]
        stands = stands[_even(len(stands), MOST_PER_SCAN)]
        level.append(points[stands, :2])
        stamps.append(scan.stamps_ns[stands])
        scan_of.append(np.full(len(stands), k))
    places = np.concatenate([np.zeros((0, 2)), *level])
    at = np.concatenate([np.zeros(0, dtype=np.int64), *stamps])
    use = _not_own(places, np.concatenate([np.zeros(0, dtype=np.int64), *scan_of]), len(scans))
    places, at = places[use], np.clip(at[use], begin, end)
    if not len(at):
        empty = np.zeros(0, dtype=np.complex128)
        return Sightings(empty, empty, empty)
    moments, back = np.unique(at, return_inverse=True)
    R, t = trajectory.poses_at(moments)
    yaw = np.arctan2(R[:, 1, 0], R[:, 0, 0])[back]
    return Sightings(
        level=places[:, 0] + 1j * places[:, 1],
        heading=np.exp(1j * yaw),
        position=(t[:, 0] + 1j * t[:, 1])[back],
    )


def _not_own(places: Array, scan_of: IntArray, scans: int) -> IntArray:
    """Indices of points that do not move with the LiDAR, at most `MOST_POINTS`."""
    cell = np.floor(places / THIN_M).astype(np.int64) @ np.array([1 << 20, 1])
    _, back = np.unique(cell, return_inverse=True)
    pairs = np.unique(np.column_stack([back, scan_of]), axis=0)
    filled = np.bincount(pairs[:, 0], minlength=int(back.max(initial=-1)) + 1)
    use = np.flatnonzero(filled[back] < max(OWN_SHARE * scans, 2.0))
    return use[_even(len(use), MOST_POINTS)]


def in_level_axes(view: View, T_vehicle_lidar: gtsam.Pose3) -> Array:
    """A mounting as (yaw, x, y) of the level axes of the view."""
    R = T_vehicle_lidar.rotation().matrix() @ view.ground.R_level_lidar.T
    x, y, _ = T_vehicle_lidar.translation()
    return np.array([math.atan2(R[1, 0], R[0, 0]), x, y])


def _placement(name: str, ground: Ground, found: Found, config: Config) -> Placement:
    best = found.mountings[0]
    others = [
        mounting
        for mounting, sharpness in zip(found.mountings[1:], found.sharpness[1:], strict=True)
        if sharpness > AMBIGUOUS * found.sharpness[0] and difference_m(mounting, best) > OTHER_M
    ]
    return Placement(
        name,
        _pose(best, ground, config),
        tuple(_pose(other, ground, config) for other in others),
    )


def _pose(mounting: Array, ground: Ground, config: Config) -> gtsam.Pose3:
    """T_vehicle_lidar; without `ground.vehicle_height` the vehicle frame is taken on the ground."""
    yaw, x, y = mounting.tolist()
    R = gtsam.Rot3.Yaw(yaw).compose(gtsam.Rot3(ground.R_level_lidar))
    z = ground.height_m - (config.ground.vehicle_height or 0.0)
    return gtsam.Pose3(R, np.array([x, y, z]))
