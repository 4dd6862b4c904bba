"""A drive of LiDARs alone in a room without a ceiling: four walls, and the ground."""

from __future__ import annotations

import math
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from caliv_graph.products import Array, LidarScan, MotionData, Trajectory
from caliv_graph.trajectory.select import GivenTrajectory

SWEEP_S = 0.1
PERIOD_NS = 200_000_000
BEGIN_NS = 1_750_000_000_012_345_678

WALLS = ((16.0, 0.1), (14.0, 1.7), (17.0, 3.0), (13.0, 4.8))
"""Distance from the origin and heading of the normal: no two are parallel."""


def s_curve(seconds: float, rate_rad_s: float = 0.3, speed_m_s: float = 2.0) -> GivenTrajectory:
    """Half of the time to the left, half to the right, after half a second of rolling on."""
    s = np.arange(0.0, seconds + 1e-9, 0.01)
    rate = rate_rad_s * np.sin(2.0 * math.pi * s / seconds)
    speed = speed_m_s * np.minimum(s / 0.5, 1.0)
    yaw = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1])) * 0.01])
    step = 0.01 * speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(s))])
    place = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (step[1:] + step[:-1]), axis=0)])
    poses = tuple(gtsam.Pose3(gtsam.Rot3.Yaw(a), p) for a, p in zip(yaw, place, strict=True))
    return GivenTrajectory(Trajectory(BEGIN_NS + np.round(1e9 * s).astype(np.int64), poses))


def beams(rng: np.random.Generator, channels: int = 40, columns: int = 180) -> Array:
    """(n, 3) unit directions all around, from 35 degrees below to 15 above the horizon."""
    up = np.radians(np.linspace(-35.0, 15.0, channels))
    around = np.linspace(-math.pi, math.pi, columns, endpoint=False) + rng.uniform(0.0, 0.03)
    a, u = np.meshgrid(around, up)
    return np.stack([np.cos(u) * np.cos(a), np.cos(u) * np.sin(a), np.sin(u)], -1).reshape(-1, 3)


@dataclass(frozen=True)
class RoomDrive:
    """A recording without motion data; every point at its own time.

    `walls` may be fewer; LiDARs are stamped 0.2 s apart, one `phase_s` after the others. Scans that
    have been read are `kept`: every stage reads them anew.
    """

    mountings: Mapping[str, gtsam.Pose3]
    way: GivenTrajectory
    walls: Sequence[tuple[float, float]] = WALLS
    phase_s: Mapping[str, float] = field(default_factory=dict)
    name: str = "room"
    kept: dict[tuple[str, int], LidarScan] = field(default_factory=dict, repr=False, compare=False)

    @property
    def lidars(self) -> tuple[str, ...]:
        return tuple(self.mountings)

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        begin, end = self.way.span_ns
        first = begin + round(1e9 * self.phase_s.get(lidar, 0.0))
        return list(range(first, end - 100_000_000, PERIOD_NS))

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        for stamp in self.scan_stamps_ns(lidar):
            if wanted is None or stamp in wanted:
                if (lidar, stamp) not in self.kept:
                    self.kept[lidar, stamp] = self.scan(lidar, stamp)
                yield self.kept[lidar, stamp]

    def scan(self, lidar: str, stamp: int) -> LidarScan:
        rng = np.random.default_rng([stamp % 2**31, len(lidar)])
        u = beams(rng)
        times = SWEEP_S * (np.arctan2(u[:, 1], u[:, 0]) / (2.0 * math.pi) + 0.5)
        R, t = self.way.poses_at(stamp + np.round(1e9 * times).astype(np.int64))
        T = self.mountings[lidar]
        origin = t + R @ T.translation()
        ahead = np.einsum("nij,nj->ni", R, u @ T.rotation().matrix().T)
        range_m = np.full(len(u), np.inf)
        planes = [(d, np.array([math.cos(a), math.sin(a), 0.0])) for d, a in self.walls]
        with np.errstate(divide="ignore"):
            for distance, normal in [*planes, (0.0, np.array([0.0, 0.0, -1.0]))]:
                hit = (distance - origin @ normal) / (ahead @ normal)
                range_m = np.where((hit > 0.0) & (hit < range_m), hit, range_m)
        seen = range_m < 40.0
        range_m = range_m + rng.normal(scale=0.01, size=len(u))
        points = (range_m[:, None] * u)[seen]
        return LidarScan(lidar, stamp, points, f"{lidar} {stamp}", times[seen])

    def motion(self) -> MotionData:
        return MotionData(self.name)

    def warnings(self) -> Sequence[str]:
        return ()
