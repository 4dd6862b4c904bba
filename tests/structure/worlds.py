"""Walls and ground made of rectangles, and LiDARs that cast their beams at them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, GivenPoses, IntArray, LidarScan, Trajectory
from caliv_graph.scenario.drives import Drive
from caliv_graph.trajectory.deskew import deskew
from caliv_graph.trajectory.select import GivenTrajectory
from tests.drives_with_chair import Memory


@dataclass(frozen=True)
class World:
    """Rectangles: corner (n, 3) and two edges (n, 3) at right angles, metres, map."""

    corner: Array
    first: Array
    second: Array

    def ranges(self, origin: Array, beams: Array) -> Array:
        """(N,) metres to the nearest rectangle along unit beams (N, 3) from origins (N, 3)."""
        nearest = np.full(len(beams), np.inf)
        for corner, a, b in zip(self.corner, self.first, self.second, strict=True):
            normal = np.cross(a, b)
            slant = beams @ normal
            at = ((corner - origin) @ normal) / np.where(np.abs(slant) > 1e-9, slant, 1e-9)
            nearer = np.flatnonzero((at > 0.0) & (at < nearest))
            hit = origin[nearer] + at[nearer, None] * beams[nearer] - corner
            u, v = hit @ a / (a @ a), hit @ b / (b @ b)
            inside = nearer[(u >= 0.0) & (u <= 1.0) & (v >= 0.0) & (v <= 1.0)]
            nearest[inside] = at[inside]
        return nearest


def wall(x: float, y: float, yaw_deg: float, length: float, height: float = 3.0) -> list[Array]:
    """Corner and edges of an upright wall about its foot."""
    along = np.array([math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg)), 0.0])
    return [
        np.array([x, y, 0.0]) - 0.5 * length * along,
        length * along,
        np.array([0.0, 0.0, height]),
    ]


def ground(half_m: float = 100.0) -> list[Array]:
    return [
        np.array([-half_m, -half_m, 0.0]),
        np.array([2.0 * half_m, 0.0, 0.0]),
        np.array([0.0, 2.0 * half_m, 0.0]),
    ]


def world_of(*rectangles: Sequence[Array]) -> World:
    corner, first, second = (np.array([r[k] for r in rectangles], float) for k in range(3))
    return World(corner, first, second)


def yard() -> World:
    """Eight walls of 8 to 18 m about 19 m from the middle, and the ground."""
    walls = []
    for k, (far, turned, length) in enumerate(
        [(17, 8, 14), (20, -12, 18), (19, 25, 8), (22, 0, 12), (18, -20, 16), (21, 14, 10),
         (19, -6, 13), (23, 30, 18)]
    ):  # fmt: skip
        angle = 45.0 * k + 11.0
        x, y = far * math.cos(math.radians(angle)), far * math.sin(math.radians(angle))
        walls.append(wall(x + 2.0, 1.5 * y, angle + 90.0 + turned, length))
    return world_of(ground(), *walls)


def near_yard() -> World:
    """The yard with walls at three quarters of the distance: a sweep ends at them more often."""
    walls, scale = yard(), np.array([0.75, 0.75, 1.0])
    return World(scale * walls.corner, scale * walls.first, scale * walls.second)


def guessed(guesses: Mapping[str, gtsam.Pose3]) -> dict[str, LidarConfig]:
    """LiDARs of a config with these initial guesses."""
    return {
        name: LidarConfig(
            topic=name,
            initial=PoseConfig(
                xyz=tuple(T.translation()), rpy_deg=tuple(np.degrees(T.rotation().rpy()))
            ),
        )
        for name, T in guesses.items()
    }


@dataclass(frozen=True)
class Spinner:
    """A LiDAR that turns, or looks at once (`sweep_s` zero).

    Attributes:
        T_vehicle_lidar: its true extrinsic.
        elevations_deg: of its channels.
        azimuths_deg: of its columns.
        sigma_m: noise along the beam.
        sweep_s: from the first column to the last; stamps are those of the first.
        body: what moves with the vehicle, in its frame; returns from within 1 m are not reported.
    """

    T_vehicle_lidar: gtsam.Pose3
    elevations_deg: Array = field(default_factory=lambda: np.linspace(-12.5, 12.5, 76))
    azimuths_deg: Array = field(default_factory=lambda: np.linspace(-60.0, 60.0, 330))
    sigma_m: float = 0.01
    sweep_s: float = 0.0
    body: World | None = None

    def beams(self) -> tuple[Array, Array]:
        """Unit beams (N, 3) in the LiDAR's frame, and their times (N,)."""
        azimuth, elevation = np.meshgrid(
            np.radians(self.azimuths_deg), np.radians(self.elevations_deg), indexing="ij"
        )
        times = np.broadcast_to(
            np.linspace(0.0, self.sweep_s, len(self.azimuths_deg))[:, None], azimuth.shape
        )
        flat = np.cos(elevation)
        beams = np.stack(
            [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1
        )
        return beams.reshape(-1, 3), times.ravel()

    def scan(
        self,
        name: str,
        world: World,
        trajectory: GivenTrajectory,
        stamp_ns: int,
        rng: np.random.Generator,
    ) -> LidarScan:
        """What it measures, every beam from where the vehicle is at its time."""
        beams, times = self.beams()
        unique, column = np.unique(times, return_inverse=True)
        at = stamp_ns + np.round(unique * NANOSECONDS_PER_SECOND).astype(np.int64)
        R, t = trajectory.poses_at(at)
        R_extrinsic, t_extrinsic = stack([self.T_vehicle_lidar])
        origin = t + R @ t_extrinsic[0]
        R = R @ R_extrinsic[0]
        ranges = world.ranges(origin[column], np.einsum("nij,nj->ni", R[column], beams))
        if self.body is not None:
            mounted = np.repeat(t_extrinsic, len(beams), axis=0)
            own = self.body.ranges(mounted, beams @ R_extrinsic[0].T)
            ranges = np.where(own < ranges, np.where(own > 1.0, own, np.inf), ranges)
        ranges += rng.normal(0.0, self.sigma_m, len(ranges)) if self.sigma_m else 0.0
        seen = ranges < 80.0
        points = beams[seen] * ranges[seen, None]
        return LidarScan(
            name, stamp_ns, points, f"{name} {stamp_ns}", times[seen] if self.sweep_s else None
        )


def driven(drive: Drive, period_s: float = 0.1) -> GivenTrajectory:
    """The true poses of a drive."""
    stamps: IntArray = np.round(
        np.arange(0.0, drive.duration_s, period_s) * NANOSECONDS_PER_SECOND
    ).astype(np.int64)
    return GivenTrajectory(Trajectory(stamps, drive.poses(stamps)))


def recorded(
    world: World,
    trajectory: GivenTrajectory,
    lidars: Mapping[str, Spinner],
    stamps_ns: Mapping[str, IntArray],
    seed: int = 1,
) -> Memory:
    """A drive in memory."""
    rng = np.random.default_rng(seed)
    clouds = {
        name: tuple(lidar.scan(name, world, trajectory, int(s), rng) for s in stamps_ns[name])
        for name, lidar in lidars.items()
    }
    of = trajectory.trajectory
    return Memory(clouds, GivenPoses(of.stamps_ns, of.T_map_vehicle))


def deskewed_before(
    drive: Memory, trajectory: GivenTrajectory, truth: Mapping[str, gtsam.Pose3]
) -> Memory:
    """The drive with clouds that a driver has deskewed, and whose points keep their times."""
    clouds = {
        name: tuple(
            replace(deskew(scan, truth[name], trajectory), point_times_s=scan.point_times_s)
            for scan in scans
        )
        for name, scans in drive.clouds.items()
    }
    return replace(drive, clouds=clouds)
