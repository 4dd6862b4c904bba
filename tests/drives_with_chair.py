"""Drives past a chair with known truth: poses alone, and recordings with ray-cast clouds."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import gtsam
import numpy as np

from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.load import load_config
from caliv_graph.config.model import (
    Config,
    GroundConfig,
    RegistrationConfig,
    StructureConfig,
)
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import Array, GivenPoses, IntArray, LidarScan, MotionData
from caliv_graph.readers import open_recording
from caliv_graph.scenario.drive_models import (
    ArcDrive,
    DriveModel,
    FigureEightDrive,
    SCurveDrive,
    StandstillDrive,
    StraightDrive,
)
from caliv_graph.scenario.drives import Drive, make_drive, smoothstep, smoothstep_rate
from caliv_graph.scenario.model import CropModel, Scenario
from caliv_graph.scenario.sensor_models import LidarModel, PoseNoiseModel
from caliv_graph.scenario.world_models import ChairModel, WorldModel
from caliv_graph.simulation import simulate_caliv

RADIUS_M = 9.16
"""Turning radius of the paper's vehicle."""

CHAIR_XYZ_M = (15.16, -9.16, 0.6)
"""Middle of the chair: 6 m outside the right-hand arc."""

S_CHAIR_XY_M = (9.0, -19.0)
"""Where a chair is in sight of the S-curve before and after it changes its curvature."""

ARC = ArcDrive(duration_s=17.0, radius_m=RADIUS_M)
ARC_LEFT = ArcDrive(duration_s=17.0, radius_m=RADIUS_M, turn="left")
S_CURVE = SCurveDrive(duration_s=17.0, radius_m=RADIUS_M)
FIGURE_EIGHT = FigureEightDrive(radius_m=RADIUS_M)
STRAIGHT = StraightDrive(duration_s=17.0)
STANDSTILL = StandstillDrive(duration_s=17.0)

QUICK = RegistrationConfig(components=120, max_points=120)
"""A coarse registration in half the time, for what does not depend on how fine it is."""

RAMP_HEIGHT_M = 1.6
RAMP_LENGTH_M = 12.0


# ------------------------------------------------------------------ poses


def stamps_of(drive: Drive, count: int) -> IntArray:
    """`count` stamps from the start to the end, standing still at both ends included."""
    last_ns = round(drive.duration_s * NANOSECONDS_PER_SECOND)
    return np.linspace(0, last_ns, count).astype(np.int64)


def poses_of(model: DriveModel, count: int) -> list[gtsam.Pose3]:
    """`count` poses of a drive on flat ground."""
    drive = make_drive(model)
    return list(drive.poses(stamps_of(drive, count)))


def over_a_ramp(poses: Sequence[gtsam.Pose3]) -> list[gtsam.Pose3]:
    """The same way, but the ground rises by RAMP_HEIGHT_M about 8 m from the start."""
    steps = [a.range(b) for a, b in itertools.pairwise(poses)]
    out = []
    for pose, way_m in zip(poses, np.cumsum([0.0, *steps]), strict=True):
        part = (way_m - 2.0) / RAMP_LENGTH_M
        slope = RAMP_HEIGHT_M / RAMP_LENGTH_M * float(smoothstep_rate(part))
        z = RAMP_HEIGHT_M * float(smoothstep(part))
        R = pose.rotation().compose(gtsam.Rot3.Pitch(-math.atan(slope)))
        out.append(gtsam.Pose3(R, pose.translation() + np.array([0.0, 0.0, z])))
    return out


# ------------------------------------------------------------------ recordings


@dataclass(frozen=True)
class Memory:
    """A recording in memory (products.Recording), to be changed by tests."""

    clouds: Mapping[str, tuple[LidarScan, ...]]
    poses: GivenPoses
    name: str = "memory"

    @property
    def lidars(self) -> tuple[str, ...]:
        return tuple(self.clouds)

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        return [scan.stamp_ns for scan in self.clouds[lidar]]

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        return (s for s in self.clouds[lidar] if wanted is None or s.stamp_ns in wanted)

    def motion(self) -> MotionData:
        return MotionData(self.name, poses=self.poses)

    def warnings(self) -> Sequence[str]:
        return []


@dataclass(frozen=True)
class ChairDrive:
    """A simulated drive, the config that calibrates it, and the truth.

    Attributes:
        recording: its clouds and given poses.
        config: with perturbed guesses.
        truth: T_vehicle_lidar per LiDAR.
    """

    recording: Memory
    config: Config
    truth: Mapping[str, gtsam.Pose3]

    def asked(self, **sections: object) -> ChairDrive:
        """The same drive with other sections of the config."""
        return replace(self, config=self.config.model_copy(update=sections))

    def with_lidars(self, lidars: Mapping[str, LidarConfig], reference: str) -> ChairDrive:
        """The same drive with other LiDARs, or the same in another order, in the config."""
        config = self.config.model_copy(update={"lidars": dict(lidars), "reference": reference})
        clouds = {name: self.recording.clouds[name] for name in lidars}
        return replace(self, config=config, recording=replace(self.recording, clouds=clouds))

    def renamed(self, names: Mapping[str, str]) -> ChairDrive:
        """The same drive with other names for its LiDARs, in the same order."""
        config = self.config.model_copy(
            update={
                "lidars": {names[n]: lidar for n, lidar in self.config.lidars.items()},
                "reference": names[self.config.reference],
            }
        )
        clouds = {
            names[n]: tuple(replace(scan, lidar=names[n]) for scan in scans)
            for n, scans in self.recording.clouds.items()
        }
        return ChairDrive(
            recording=replace(self.recording, clouds=clouds),
            config=config,
            truth={names[n]: T for n, T in self.truth.items()},
        )

    def moved(self, T_new_map: gtsam.Pose3) -> ChairDrive:
        """The same drive in another map. Regions have to be given from the start of the drive."""
        poses = tuple(T_new_map.compose(T) for T in self.recording.poses.T_map_vehicle)
        given = replace(self.recording.poses, T_map_vehicle=poses)
        return replace(self, recording=replace(self.recording, poses=given))

    def with_points(self, change: Callable[[LidarScan], Array]) -> ChairDrive:
        """The same drive with other points (lidar frame)."""
        clouds = {
            name: tuple(replace(scan, points_lidar=change(scan)) for scan in scans)
            for name, scans in self.recording.clouds.items()
        }
        return replace(self, recording=replace(self.recording, clouds=clouds))


def paper_lidar(
    x_m: float, yaw_deg: float, *, y_m: float = 0.0, rate_hz: float = 5.0
) -> LidarModel:
    """A LiDAR of the paper's section IV: 2 m up, 10 degrees nose down, 120 x 25 degrees, 10 mm."""
    return LidarModel(
        mounting=PoseConfig(xyz=(x_m, y_m, 2.0), rpy_deg=(0.0, 10.0, yaw_deg)), rate_hz=rate_hz
    )


def paper_scenario(
    drive: DriveModel = ARC,
    *,
    rate_hz: float = 5.0,
    position_sigma_m: float = 0.0,
    rotation_sigma_rad: float = 0.0,
    others: Mapping[str, LidarModel] | None = None,
    chair_xy_m: tuple[float, float] = CHAIR_XYZ_M[:2],
) -> Scenario:
    """The paper's front and rear LiDAR, its chair, cropped clouds.

    Args:
        drive: the drive.
        rate_hz: clouds per second.
        position_sigma_m: white error of the given poses; 0: they are the truth.
        rotation_sigma_rad: the same of their rotations.
        others: more LiDARs.
        chair_xy_m: where the chair stands.
    """
    return Scenario(
        name="arc",
        drive=drive,
        lidars={
            "front": paper_lidar(2.0, 0.0, rate_hz=rate_hz),
            "rear": paper_lidar(-0.4, 180.0, rate_hz=rate_hz),
            **(others or {}),
        },
        reference="rear",
        world=WorldModel(
            objects={"chair": ChairModel(xy_m=chair_xy_m, yaw_deg=90.0)}, targets=("chair",)
        ),
        crop=CropModel(margin_m=1.0, elsewhere_stride=16),
        poses=PoseNoiseModel(
            position_sigma_m=position_sigma_m, rotation_sigma_rad=rotation_sigma_rad
        ),
    )


def without_structure(config: Config) -> Config:
    """For tests whose subject is something else: structure takes a part of every run's time."""
    return config.model_copy(update={"structure": StructureConfig(use=False)})


def simulated(scenario: Scenario, seed: int, folder: Path) -> ChairDrive:
    """Simulates a drive into a new folder, and reads it back.

    The target's region is counted from the start of the drive, so that the map may be moved. Ground
    and structure are left out: what the target alone tells is what these drives are for.
    """
    simulate_caliv(scenario, folder, seed, threads=1)
    config = load_config(folder / "config.yaml")
    assert config.target
    regions = tuple(r.model_copy(update={"frame": "start"}) for r in config.target)
    config = without_structure(
        config.model_copy(update={"target": regions, "ground": GroundConfig(use=False)})
    )
    reader = open_recording(config)
    given = reader.motion().poses
    assert given is not None
    clouds = {name: tuple(reader.scans(name)) for name in config.lidars}
    return ChairDrive(
        recording=Memory(clouds, given),
        config=config,
        truth={name: m.mounting.pose() for name, m in scenario.lidars.items()},
    )
