"""A drive past walls, a pole and a box, made of points on their surfaces: no rays, all is known."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.model import Config, GroundConfig, TargetRegion
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.config.sections import Triple
from caliv_graph.geometry.se3 import retract_vehicle_axes
from caliv_graph.products import (
    Array,
    Calibration,
    GivenPoses,
    Guess,
    LidarResult,
    LidarScan,
)
from tests.drives_with_chair import Memory
from tests.samples import make_calibration, pose

FRAME_NS = 200_000_000
FRAMES = 60

MOUNTINGS: Mapping[str, tuple[Triple, Triple]] = {
    "front": ((2.0, 0.0, 2.0), (0.0, 10.0, 0.0)),
    "rear": ((-0.4, 0.0, 2.0), (0.0, 10.0, 180.0)),
}
GUESSES: Mapping[str, tuple[Triple, Triple]] = {
    "front": ((2.06, -0.05, 2.04), (1.5, 8.5, 2.0)),
    "rear": ((-0.45, 0.04, 1.97), (-1.0, 11.0, 178.5)),
}

POLE_XY = (4.0, -22.0)
POLE_RADIUS_M = 0.15
BOX_XY = (-14.0, -8.0)
SIGMA_M = 0.01


@dataclass(frozen=True)
class Scene:
    """What stands around; each a part that may be left out."""

    walls: bool = True
    pole: bool = True
    box: bool = True
    ground: bool = True

    def points(self, rng: np.random.Generator) -> Array:
        """(n, 3) metres, map: new ones for every scan."""
        parts = [np.zeros((0, 3))]
        if self.walls:
            y, z = rng.uniform(-25.0, 5.0, 120), rng.uniform(0.0, 3.0, 120)
            parts.append(np.column_stack([np.full(120, 22.0), y, z]))
            x, z = rng.uniform(-15.0, 15.0, 120), rng.uniform(0.0, 3.0, 120)
            parts.append(np.column_stack([x, 8.0 + 0.1 * x, z]))
        if self.pole:
            # Towards the drive only, which goes round (0, -9).
            angle = math.atan2(-9.0 - POLE_XY[1], -POLE_XY[0]) + rng.uniform(-1.2, 1.2, 12)
            ring = np.array(POLE_XY) + POLE_RADIUS_M * np.column_stack(
                [np.cos(angle), np.sin(angle)]
            )
            parts.append(np.column_stack([ring, rng.uniform(0.0, 4.0, 12)]))
        if self.box:
            side, z = rng.uniform(-0.25, 0.25, (2, 12)), rng.uniform(0.0, 0.6, (2, 12))
            faces = [
                np.column_stack([np.full(12, 0.25), side[0], z[0]]),
                np.column_stack([side[1], np.full(12, 0.25), z[1]]),
            ]
            parts.append(np.vstack(faces) + np.array([*BOX_XY, 0.0]))
        if self.ground:
            xy = rng.uniform(-30.0, 30.0, (600, 2)) + np.array([0.0, -9.0])
            parts.append(np.column_stack([xy, np.zeros(600)]))
        return np.vstack(parts)


def vehicle_pose(frame: float) -> gtsam.Pose3:
    """T_map_vehicle on a right-hand arc of 9 m about (0, -9), a little more than half a circle."""
    yaw = -3.6 * frame / (FRAMES - 1)
    at = np.array([-9.0 * math.sin(yaw), -9.0 + 9.0 * math.cos(yaw), 0.0])
    return gtsam.Pose3(gtsam.Rot3.Yaw(yaw), at)


def make_recording(
    scene: Scene | None = None, late_s: Mapping[str, float] | None = None, seed: int = 1
) -> Memory:
    """Both LiDARs see what is within 120 degrees and 30 m of them.

    Args:
        scene: what stands around; None: everything.
        late_s: per LiDAR how much its stamps are late.
        seed: of the points and their noise.
    """
    scene = Scene() if scene is None else scene
    rng = np.random.default_rng(seed)
    poses = [vehicle_pose(i) for i in range(FRAMES)]
    stamps = np.arange(FRAMES, dtype=np.int64) * FRAME_NS
    clouds: dict[str, tuple[LidarScan, ...]] = {}
    for name, (xyz, rpy) in MOUNTINGS.items():
        late_ns = round(1e9 * (late_s or {}).get(name, 0.0))
        scans = []
        for i in range(3, FRAMES - 3):
            T_map_vehicle = vehicle_pose(i - late_ns / FRAME_NS)
            T = T_map_vehicle.compose(pose(xyz, rpy))
            points = (scene.points(rng) - T.translation()) @ T.rotation().matrix()
            range_m = np.linalg.norm(points, axis=1)
            seen = (np.abs(np.arctan2(points[:, 1], points[:, 0])) < math.radians(60.0)) & (
                range_m < 30.0
            )
            points, range_m = points[seen], range_m[seen]
            points *= (1.0 + rng.normal(0.0, SIGMA_M, len(points)) / range_m)[:, None]
            scans.append(LidarScan(name, int(stamps[i]), points, f"{name} {i}"))
        clouds[name] = tuple(scans)
    return Memory(clouds, GivenPoses(stamps, tuple(poses)))


def make_config(
    guesses: Mapping[str, tuple[Triple, Triple]] = GUESSES,
    *,
    ground: bool = True,
    region: TargetRegion | None = None,
) -> Config:
    """A config with a target region where nothing stands, if no other is given."""
    nowhere = TargetRegion(min=(-1.0, -10.0, 0.0), max=(1.0, -8.0, 2.0))
    return Config(
        lidars={
            name: LidarConfig(topic=f"sensor_{i}", initial=PoseConfig(xyz=xyz, rpy_deg=rpy))
            for i, (name, (xyz, rpy)) in enumerate(guesses.items(), start=1)
        },
        target=(region or nowhere,),
        ground=GroundConfig(use=ground),
    )


def calibration_of(
    moved: Mapping[str, Sequence[float]] | None = None,
    offsets: Mapping[str, tuple[float, float]] | None = None,
) -> Calibration:
    """The truth with sigmas of 0.3 mrad and 2 mm, given poses being all but perfect.

    Args:
        moved: per LiDAR, error in vehicle axes: rad, rad, rad, m, m, m.
        offsets: per LiDAR its time offset and sigma in seconds.
    """
    cov = np.diag([3e-4**2] * 3 + [2e-3**2] * 3)
    lidars = {}
    for name, (xyz, rpy) in MOUNTINGS.items():
        T = retract_vehicle_axes(pose(xyz, rpy), np.array((moved or {}).get(name, (0.0,) * 6)))
        guess = Guess(pose(*GUESSES[name]), np.array([0.03] * 3 + [0.058] * 3))
        result = LidarResult(
            T,
            cov,
            dict.fromkeys(("roll", "pitch", "yaw", "x", "y", "z"), True),
            50,
            True,
            (offsets or {}).get(name),
            guess,
        )
        lidars[name] = result
    noise = {
        "white_rotation_rad": 1e-5,
        "white_position_m": 1e-4,
        "drift_rotation_rad": 1e-5,
        "drift_position_m": 1e-4,
        "drift_time_s": 4.0,
    }
    both = np.zeros((12, 12))
    both[:6, :6] = both[6:, 6:] = cov
    return replace(
        make_calibration(),
        lidars=lidars,
        cov_joint=both,
        undetermined=(),
        status="ok",
        provenance={"pose_noise": noise},
    )
