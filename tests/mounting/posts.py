"""A recorded figure-eight past posts on level ground, and configs with and without guesses."""

from __future__ import annotations

import math
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caliv_graph.config.model import Config
from caliv_graph.mounting.place import View, view_of
from caliv_graph.products import LidarScan, MotionData, Trajectory
from caliv_graph.trajectory.select import GivenTrajectory

SPEED_M_S, RATE_RAD_S = 3.0, 0.36
SWEEP_S = 0.1

SPIN = gtsam.Pose3(
    gtsam.Rot3(Rotation.from_euler("xyz", [2.9, 0.4, 1.2]).as_matrix()), np.array([1.4, -0.5, 1.9])
)
"""Nearly upside down."""
AHEAD = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.2, -0.3), np.array([-2.0, 0.6, 2.2]))

POSTS = np.array([[9.0, 4.0], [-3.0, 12.0], [14.0, -9.0], [3.0, -14.0], [-9.0, -6.0]])


def trajectory() -> GivenTrajectory:
    """A figure-eight of two circles."""
    s = np.arange(0.0, 2.0 * 2.0 * math.pi / RATE_RAD_S, 0.05)
    half = s[-1] / 2.0
    yaw = np.where(s < half, RATE_RAD_S * s, RATE_RAD_S * (2.0 * half - s))
    step = SPEED_M_S * 0.05 * np.column_stack([np.cos(yaw), np.sin(yaw)])
    poses = tuple(
        gtsam.Pose3(gtsam.Rot3.Yaw(a), np.array([x, y, 0.0]))
        for a, (x, y) in zip(yaw, np.cumsum(step, axis=0), strict=True)
    )
    return GivenTrajectory(Trajectory(np.round(1e9 * s).astype(np.int64), poses))


@dataclass(frozen=True)
class Drive:
    """A recording of ground and posts around a figure-eight, every point at its own time."""

    mountings: Mapping[str, gtsam.Pose3]
    posts: bool = True
    ground: bool = True
    blind: str = ""
    name: str = "drive"

    @property
    def lidars(self) -> tuple[str, ...]:
        return tuple(self.mountings)

    @cached_property
    def way(self) -> GivenTrajectory:
        return trajectory()

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        begin, end = self.way.span_ns
        return list(range(begin + 200_000_000, end - 200_000_000, 1_400_000_000))

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        for stamp in self.scan_stamps_ns(lidar):
            if wanted is None or stamp in wanted:
                yield self.scan(lidar, stamp)

    @cached_property
    def _kept(self) -> dict[tuple[str, int], LidarScan]:
        return {}

    def scan(self, lidar: str, stamp: int) -> LidarScan:
        """Drawn once: tests calibrate the same drive many times."""
        if (lidar, stamp) not in self._kept:
            self._kept[lidar, stamp] = self._drawn(lidar, stamp)
        return self._kept[lidar, stamp]

    def _drawn(self, lidar: str, stamp: int) -> LidarScan:
        rng = np.random.default_rng(stamp % 2**31)
        parts = []
        if self.ground and lidar != self.blind:  # dense near the LiDAR, about its own place
            _, t = self.way.poses_at([stamp])
            range_m, angle = rng.uniform(2.0, 12.0, 1500), rng.uniform(-math.pi, math.pi, 1500)
            flat = np.column_stack([range_m * np.cos(angle), range_m * np.sin(angle)])
            parts.append(np.column_stack([t[0, :2] + flat, np.zeros(1500)]))
        if self.posts:
            angle, height = rng.uniform(-math.pi, math.pi, 60), rng.uniform(0.0, 2.0, 60)
            ring = np.column_stack([0.2 * np.cos(angle), 0.2 * np.sin(angle), height])
            parts += [ring + np.array([x, y, 0.0]) for x, y in POSTS]
        world = np.concatenate([np.zeros((0, 3)), *parts])
        times = rng.uniform(0.0, SWEEP_S, len(world))
        R, t = self.way.poses_at(stamp + np.round(1e9 * times).astype(np.int64))
        T = self.mountings[lidar]
        vehicle = np.einsum("nji,nj->ni", R, world - t)
        points = (vehicle - T.translation()) @ T.rotation().matrix()
        points += rng.normal(scale=0.01, size=points.shape)
        return LidarScan(lidar, stamp, points, f"{lidar} {stamp}", times)

    def motion(self) -> MotionData:
        raise AssertionError("the trajectory is given")

    def warnings(self) -> Sequence[str]:
        return ()


def config_of(*missing: str, **guesses: gtsam.Pose3) -> Config:
    lidars: dict[str, object] = {name: {"topic": f"/{name}"} for name in missing}
    for name, T in guesses.items():
        xyz, rpy = T.translation().tolist(), np.degrees(T.rotation().rpy()).tolist()
        lidars[name] = {"topic": f"/{name}", "initial": {"xyz": xyz, "rpy_deg": rpy}}
    return Config.model_validate({"lidars": lidars, "ground": {"vehicle_height": 0.0}})


@contextmanager
def views_kept() -> Iterator[None]:
    """Inside, what a LiDAR sees of a drive is made out once: no guess is part of it."""
    kept: dict[tuple[int, int, str], tuple[View, object]] = {}

    def once(recording: Any, trajectory: Any, config: Config, name: str, *more: Any) -> View:
        key = (id(recording), id(trajectory), name)
        if key not in kept:
            # With what the key is of, lest another gets its number.
            of = view_of(recording, trajectory, config, name, *more)
            kept[key] = (of, (recording, trajectory))
        return kept[key][0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("caliv_graph.mounting.doubts.view_of", once)
        patch.setattr("caliv_graph.mounting.place.view_of", once)
        yield
