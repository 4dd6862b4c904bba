"""What an export is made from, and what it comes out as."""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import gtsam

from caliv_graph.errors import ExportError
from caliv_graph.products import Calibration
from caliv_graph.readers.frames import FrameTree

DEFAULT_VEHICLE_FRAME = "base_link"
"""Name of the vehicle frame where nothing else is told (REP-105)."""


@dataclass(frozen=True)
class ImuExtrinsic:
    """Where the IMU is.

    Attributes:
        T_vehicle_imu: its pose.
        origin: who said so, for comments and messages.
        stated: False if nobody did, and it is the default of the config.
    """

    T_vehicle_imu: gtsam.Pose3
    origin: str
    stated: bool = True


@dataclass(frozen=True)
class Base:
    """An existing file of the consumer, whose other content is kept.

    Attributes:
        path: where it is.
        text: its content; line ends as they are.
    """

    path: Path
    text: str


@dataclass(frozen=True)
class Request:
    """What is to be exported, and all that a consumer might need besides.

    Attributes:
        calibration: the result.
        source: what to call it in comments: the name of its file.
        lidars: names of those to export, in the calibration's order.
        frames: per LiDAR the name of the frame that the user gave for it.
        recorded: per LiDAR the name of the frame that a recording has for it.
        housings: per LiDAR `T_housing_lidar`, the frame of its cloud in that of its housing.
        parents: per frame its pose `T_vehicle_frame`, as the user gave it.
        tree: frames of a recording's `/tf_static`; None: none was given.
        vehicle_frame: name of the vehicle frame; empty: not given.
        imu: where the IMU is; None: not known.
        topics: per LiDAR the topic of its clouds, as far as it is known.
        base: an existing file to change; None: a new one.
        letter: of the keys of a factor graph.
        form: which of several forms; empty: by the name of the output.
        out: where the result is to go.
        recorded_ns: when the recording began that `tree` comes from; 0: not known.
    """

    calibration: Calibration
    source: str
    lidars: tuple[str, ...]
    out: Path
    frames: Mapping[str, str] = field(default_factory=dict)
    recorded: Mapping[str, str] = field(default_factory=dict)
    housings: Mapping[str, gtsam.Pose3] = field(default_factory=dict)
    parents: Mapping[str, gtsam.Pose3] = field(default_factory=dict)
    tree: FrameTree | None = None
    vehicle_frame: str = ""
    imu: ImuExtrinsic | None = None
    topics: Mapping[str, str] = field(default_factory=dict)
    base: Base | None = None
    letter: str = "m"
    form: str = ""
    recorded_ns: int = 0

    def frame(self, lidar: str) -> str | None:
        """Name of a LiDAR's frame as it was given, or else recorded; None: neither."""
        return self.frames.get(lidar) or self.recorded.get(lidar)

    def frame_among(self, lidar: str, known: Container[str]) -> str | None:
        """Likewise, but a recorded one counts only where it is known: nobody insists on it."""
        told, recorded = self.frames.get(lidar), self.recorded.get(lidar)
        return told or (recorded if recorded in known else None)

    def T_vehicle_lidar(self, lidar: str) -> gtsam.Pose3:
        """PoseConfig of a LiDAR."""
        return self.calibration.lidars[lidar].T_vehicle_lidar

    def T_vehicle_child(self, lidar: str) -> gtsam.Pose3:
        """Pose of what is exported for a LiDAR: its housing if that is told, else its frame."""
        T_vehicle_lidar = self.T_vehicle_lidar(lidar)
        housing = self.housings.get(lidar)
        return T_vehicle_lidar if housing is None else T_vehicle_lidar.compose(housing.inverse())

    def one_lidar(self, consumer: str) -> tuple[str, tuple[str, ...]]:
        """The LiDAR for a consumer that takes one: the reference, if there is a choice.

        Returns:
            Its name, and a warning if it was chosen among several.
        """
        if len(self.lidars) == 1:
            return self.lidars[0], ()
        reference = self.calibration.reference
        chosen = reference if reference in self.lidars else self.lidars[0]
        others = ", ".join(name for name in self.lidars if name != chosen)
        return chosen, (
            f"{consumer} takes one LiDAR: '{chosen}' is written, not {others}. Give --lidar NAME "
            "to choose",
        )

    def T_lidar_imu(self, lidar: str, consumer: str) -> tuple[gtsam.Pose3, tuple[str, ...]]:
        """Pose of the IMU in the frame of a LiDAR, and a warning if nobody said where the IMU is.

        Raises:
            ExportError: the IMU's mounting is not known.
        """
        if self.imu is None:
            raise ExportError(
                f"{consumer}: needs where the IMU is, and there is no config.yaml beside "
                f"{self.source}. Give --config CONFIG.yaml, or --imu x,y,z,roll,pitch,yaw of "
                "T_vehicle_imu"
            )
        T_lidar_imu = self.T_vehicle_lidar(lidar).inverse().compose(self.imu.T_vehicle_imu)
        if self.imu.stated:
            return T_lidar_imu, ()
        return T_lidar_imu, (
            f"{self.imu.origin}: names no IMU (topics.imu): it is taken to be at the vehicle "
            "frame. Give --imu x,y,z,roll,pitch,yaw of T_vehicle_imu if it is elsewhere",
        )


@dataclass(frozen=True)
class Transform:
    """One transform of an export: `p_parent = T_parent_child p_child`.

    Attributes:
        lidar: the LiDAR it was made from.
        parent: frame.
        child: frame.
        T_parent_child: the pose as it is written.
        remark: what else to say of it; may be empty.
    """

    lidar: str
    parent: str
    child: str
    T_parent_child: gtsam.Pose3
    remark: str = ""


@dataclass(frozen=True)
class Export:
    """What is to be written.

    Attributes:
        content: of the file that was asked for.
        transforms: what is in it.
        warnings: what a person should know, a line each.
        beside: further files by their paths.
    """

    content: bytes
    transforms: tuple[Transform, ...]
    warnings: tuple[str, ...] = ()
    beside: Mapping[Path, bytes] = field(default_factory=dict)
