"""Input and output of an exporter, and the declaration of a consumer."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import gtsam

from caliv_graph.errors import ExportError
from caliv_graph.products import Calibration
from caliv_graph.readers.frames import FrameTree

DEFAULT_VEHICLE_FRAME = "base_link"
"""Name of the vehicle frame unless another is given (REP-105)."""

FRAME_OPTIONS = frozenset(("--frame", "--housing", "--vehicle-frame", "--bag"))
"""Options of consumers that place named frames in the vehicle frame."""

IMU_OPTIONS = frozenset(("--base", "--imu"))
"""Options of consumers that need the pose of the IMU."""


@dataclass(frozen=True)
class ImuExtrinsic:
    """The pose of the IMU.

    Attributes:
        origin: file or option that states it, for comments and messages.
        stated: False if it is only the default of the config.
    """

    T_vehicle_imu: gtsam.Pose3
    origin: str
    stated: bool = True


@dataclass(frozen=True)
class Base:
    """An existing file of the consumer; `text` has its line ends unchanged."""

    path: Path
    text: str


@dataclass(frozen=True)
class Transform:
    """One transform of a LiDAR as it is written: `p_parent = T_parent_child p_child`.

    The remark is a sentence for the comment, or empty.
    """

    lidar: str
    parent: str
    child: str
    T_parent_child: gtsam.Pose3
    remark: str = ""


@dataclass(frozen=True)
class Request:
    """A calibration to export, with all options of the command line.

    Attributes:
        source: name of its file, for comments.
        lidars: names of the LiDARs to export, in the order of the calibration.
        frames: per LiDAR the name of its frame, given by the user.
        recorded: per LiDAR the name of its frame in a recording.
        housings: per LiDAR `T_housing_lidar`, the frame of its clouds in the frame of its housing.
        parents: per frame its pose `T_vehicle_frame`, given by the user.
        tree: frames of the `/tf_static` of a recording; None: no recording.
        vehicle_frame: name of the vehicle frame; empty: not given.
        imu: pose of the IMU; None: unknown.
        topics: per LiDAR the topic of its clouds, where known.
        base: an existing file to change; None: a new file.
        letter: of the keys of a factor graph.
        form: one of the forms of a consumer; empty: chosen by the name of the output.
        recorded_ns: start of the recording of `tree`, nanoseconds; 0: unknown.
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

    @property
    def parent(self) -> str:
        """Name of the vehicle frame as given, else `DEFAULT_VEHICLE_FRAME`."""
        return self.vehicle_frame or DEFAULT_VEHICLE_FRAME

    def frame(self, lidar: str) -> str | None:
        """Name of a LiDAR's frame: given by the user, else recorded, else None."""
        return self.frames.get(lidar) or self.recorded.get(lidar)

    def frame_among(self, lidar: str, known: Container[str]) -> str | None:
        """Name of a LiDAR's frame: given by the user, else recorded if it is known, else None."""
        recorded = self.recorded.get(lidar)
        return self.frames.get(lidar) or (recorded if recorded in known else None)

    def T_vehicle_lidar(self, lidar: str) -> gtsam.Pose3:
        """Extrinsic of a LiDAR."""
        return self.calibration.lidars[lidar].T_vehicle_lidar

    def T_vehicle_child(self, lidar: str) -> gtsam.Pose3:
        """Pose of the exported frame: of the LiDAR's housing if it is known, else of the LiDAR."""
        T_vehicle_lidar = self.T_vehicle_lidar(lidar)
        housing = self.housings.get(lidar)
        return T_vehicle_lidar if housing is None else T_vehicle_lidar.compose(housing.inverse())

    def vehicle_transforms(self, remark: str = "") -> tuple[Transform, ...]:
        """The exported frame of every LiDAR in the vehicle frame."""
        return tuple(
            Transform(
                name, self.parent, self.frame(name) or name, self.T_vehicle_child(name), remark
            )
            for name in self.lidars
        )

    def one_lidar(self, consumer: str) -> tuple[str, tuple[str, ...]]:
        """The LiDAR for a consumer of one: the reference of several, then with a warning."""
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
        """Pose of the IMU in the frame of a LiDAR, and a warning if it is only a default.

        Raises:
            ExportError: the pose of the IMU is unknown.
        """
        if self.imu is None:
            raise ExportError(
                f"{consumer}: needs the pose of the IMU, and there is no config.yaml beside "
                f"{self.source}. Give --config CONFIG.yaml, or --imu x,y,z,roll,pitch,yaw of "
                "T_vehicle_imu"
            )
        T_lidar_imu = self.T_vehicle_lidar(lidar).inverse().compose(self.imu.T_vehicle_imu)
        if self.imu.stated:
            return T_lidar_imu, ()
        return T_lidar_imu, (
            f"{self.imu.origin}: names no IMU (topics.imu), so the IMU is assumed at the vehicle "
            "frame. Give --imu x,y,z,roll,pitch,yaw of T_vehicle_imu if it is elsewhere",
        )


@dataclass(frozen=True)
class Export:
    """The file at `Request.out`, its transforms, warnings, and further files by their paths."""

    content: bytes
    transforms: tuple[Transform, ...]
    warnings: tuple[str, ...] = ()
    beside: Mapping[Path, bytes] = field(default_factory=dict)


@dataclass(frozen=True)
class Consumer:
    """The declaration of a consumer, `CONSUMER` in its file.

    Attributes:
        export: makes the export of a request.
        options: options of the command line that it uses.
        needs_topics: whether it needs the topics of the config.
        places_housings: whether its frames are the housings of LiDARs, so that their poses in the
            housing are taken from a recording.
    """

    export: Callable[[Request], Export]
    options: frozenset[str] = frozenset()
    needs_topics: bool = False
    places_housings: bool = False


def check_names(consumer: str, transforms: tuple[Transform, ...]) -> None:
    """Refuses frames with the same name.

    Raises:
        ExportError: two frames have the same name.
    """
    names = [*{transform.parent for transform in transforms}, *(t.child for t in transforms)]
    for name in names:
        if names.count(name) > 1:
            raise ExportError(
                f"{consumer}: '{name}' would be the name of two frames. Give other names by "
                "--frame NAME=FRAME or --vehicle-frame FRAME"
            )
