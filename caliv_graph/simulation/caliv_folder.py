"""Writing a simulated drive as a CaLiV folder: one PCD file per cloud, and noisy given poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import gtsam
import numpy as np

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import ConfigError
from caliv_graph.geometry.se3 import quaternion_xyzw
from caliv_graph.products import Array, IntArray, LidarScan
from caliv_graph.readers.caliv_folder import FRAME_PERIOD_NS, POSES_FILE
from caliv_graph.scenario.model import Scenario
from caliv_graph.simulation.noise import Stream, noisy_poses, random_stream
from caliv_graph.simulation.recording import SimulatedRecording

CALIV_FOLDER = "caliv"
"""Name of the CaLiV folder in the folder of a simulated drive."""

STRIDE_TOLERANCE = 1e-6
"""Tolerance of a LiDAR's period in frames, for rounding of the rate in the YAML file."""


def check_frames(scenario: Scenario) -> None:
    """Checks that a CaLiV folder can represent the times of all clouds.

    Raises:
        ConfigError: a rate, a phase or a sweep that it cannot represent.
    """
    frame_s = FRAME_PERIOD_NS / NANOSECONDS_PER_SECOND
    for name, model in scenario.lidars.items():
        period = NANOSECONDS_PER_SECOND / model.rate_hz / FRAME_PERIOD_NS
        stride = round(period)
        if stride < 1 or abs(period - stride) > STRIDE_TOLERANCE * period:
            raise ConfigError(
                f"lidars.{name}.rate_hz: a CaLiV folder has a frame every {frame_s:g} s, of which "
                f"{model.rate_hz:g} Hz would need one every {period:.3g}. Take 10 Hz divided by a "
                "whole number, or write a bag (--format bag)"
            )
        if round(model.phase_s * NANOSECONDS_PER_SECOND) % FRAME_PERIOD_NS:
            raise ConfigError(
                f"lidars.{name}.phase_s: a CaLiV folder has a frame every {frame_s:g} s and none "
                f"at {model.phase_s:g} s. Write a bag (--format bag), or take 0"
            )
        if model.sweep is not None:
            raise ConfigError(
                f"lidars.{name}.sweep: a CaLiV folder has no time per point. "
                "Write a bag (--format bag), or leave 'sweep' out"
            )


def sensor_folders(scenario: Scenario) -> tuple[str, ...]:
    """Folder of each LiDAR in a CaLiV folder, in the scenario's order: sensor_1, sensor_2, ..."""
    return tuple(f"sensor_{number}" for number in range(1, len(scenario.lidars) + 1))


class CalivWriter:
    """Writes clouds, and at the end noisy poses, as a CaLiV folder: `input/` in `folder`."""

    def __init__(self, folder: Path, recording: SimulatedRecording) -> None:
        self._clouds = folder / "input"
        self._start_ns = recording.truth.start_ns
        self._sensors = dict(zip(recording.lidars, sensor_folders(recording.scenario), strict=True))
        self._poses: dict[str, list[tuple[int, gtsam.Pose3]]] = {}
        for sensor in self._sensors.values():
            (self._clouds / sensor).mkdir(parents=True)
            self._poses[sensor] = []
        # The given poses include the heave; the motion of the IMU does not.
        stamps_ns, poses = frame_poses(recording)
        self._T_map_vehicle_given = noisy_poses(
            stamps_ns,
            poses,
            recording.scenario.poses,
            random_stream(recording.seed, Stream.POSES),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            write_ego_poses(self._clouds / POSES_FILE, self._poses)

    def write(self, scan: LidarScan) -> None:
        """Writes a cloud unless it is empty: a PCD without points is not valid."""
        if not len(scan.points_lidar):
            return
        frame = (scan.stamp_ns - self._start_ns) // FRAME_PERIOD_NS
        sensor = self._sensors[scan.lidar]
        write_pcd(self._clouds / sensor / f"{frame}.pcd", scan.points_lidar)
        self._poses[sensor].append((frame, self._T_map_vehicle_given[frame]))


def frame_poses(recording: SimulatedRecording) -> tuple[IntArray, tuple[gtsam.Pose3, ...]]:
    """Stamps (n,) since the start and true T_map_vehicle, with heave, of all frames."""
    truth = recording.truth
    stamps_ns: IntArray = np.arange(
        0, truth.end_ns - truth.start_ns + 1, FRAME_PERIOD_NS, dtype=np.int64
    )
    return stamps_ns, truth.drive.poses(stamps_ns, truth.level_z_map + truth.heave_m)


def write_pcd(path: Path, points: Array) -> None:
    """Writes a cloud (n, 3) of finite metres as binary PCD v0.7 with fields x y z, float32."""
    n = len(points)
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\n"
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"
    )
    path.write_bytes(header.encode() + np.ascontiguousarray(points, dtype="<f4").tobytes())


def pose_values(pose: gtsam.Pose3) -> list[str]:
    """The numbers x y z qx qy qz qw, with twelve decimals.

    Fixed notation, because YAML 1.1 reads 1e-05 as a string.
    """
    values = (*pose.translation(), *quaternion_xyzw(pose.rotation()))
    # A rounded -1e-17 is minus zero; adding zero makes it zero.
    return [f"{round(v, 12) + 0.0:.12f}" for v in values]


def write_ego_poses(path: Path, poses: Mapping[str, Sequence[tuple[int, gtsam.Pose3]]]) -> None:
    """Writes `ego_poses.yaml`: per sensor (`sensor_1`, ...) its frames with T_map_vehicle."""
    lines = []
    for sensor, entries in poses.items():
        lines.append(f"{sensor}:" if entries else f"{sensor}: []")
        for frame, pose in entries:
            lines.append(f"- [{frame}.pcd, [{', '.join(pose_values(pose))}]]")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
