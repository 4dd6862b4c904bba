"""Reading a CaLiV folder: clouds by frame number, and the vehicle's pose at each frame.

input/ego_poses.yaml        sensor_N: list of [<k>.pcd, [x, y, z, qx, qy, qz, qw]]
input/sensor_N/<k>.pcd      k is the frame number, common to the sensors
"""

from __future__ import annotations

import math
import re
import reprlib
import textwrap
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from caliv_graph.common.inputs import unreadable
from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.load import read_yaml
from caliv_graph.errors import RecordingError
from caliv_graph.products import GivenPoses, LidarScan, MotionData
from caliv_graph.readers.ahead import worked_ahead
from caliv_graph.readers.pcd import read_pcd
from caliv_graph.readers.returns import is_return

FRAME_PERIOD_NS = 100_000_000
"""Nanoseconds from one frame number to the next. The files carry no time; the LiDARs of the paper
run at 10 Hz. Frames that are missing keep their place, so that durations stay right."""

POSES_FILE = "ego_poses.yaml"

_CLOUD_NAME = re.compile(r"([0-9]{1,10})\.pcd")
"""A frame number without a folder. Stamps of ten digits of frames fit int64."""

_NORM_TOLERANCE = 1e-3
"""Of a quaternion: the effect of rounding to three decimals."""

_MOST_M = 1e8
"""Of a map: the earth is 12,742 km wide."""

_AGREEMENT_M = 1e-4
_AGREEMENT_RAD = 1e-5
"""How far the sensors' poses of one frame may differ: above what rounding to six decimals does to
one pose written twice, below what a calibration can see (about 1 mm and 1 mrad)."""


class CalivFolder:
    """A drive in a CaLiV folder (products.Recording).

    Opening it reads the poses and lists the clouds. Poses of frames without a cloud are skipped.
    """

    def __init__(self, path: Path, lidars: Mapping[str, LidarConfig]) -> None:
        """Opens the folder that holds `input`, or `input` itself.

        The `topic` of a LiDAR is the sensor's folder. Other sensors are not looked at.

        Raises:
            RecordingError: folder, poses or a LiDAR are missing; a pose is damaged, is given twice
                or contradicts the pose of another sensor; a cloud has no pose.
        """
        self._name = str(path)
        self._lidars = dict(lidars)
        poses_path = _find_poses(path)
        listed = _read_pose_lists(poses_path)
        self._clouds: dict[str, dict[int, Path]] = {}
        T_map_vehicle: dict[int, gtsam.Pose3] = {}
        skipped: dict[str, int] = {}
        for name, lidar in self._lidars.items():
            sensor = lidar.topic
            if sensor not in listed:
                raise RecordingError(
                    f"{poses_path}: no poses of sensor '{sensor}' (LiDAR '{name}'). Set "
                    f"lidars.{name}.topic to a sensor there is: {_enumerate(listed)}"
                )
            poses = _parse_poses(listed[sensor], f"{poses_path}: {sensor}")
            clouds = _list_clouds(poses_path.parent, sensor, name)
            _check_every_cloud_has_a_pose(clouds, poses, poses_path, sensor)
            for frame in clouds:
                pose = T_map_vehicle.setdefault(frame, poses[frame])
                _check_agreement(pose, poses[frame], f"{poses_path}: {sensor}, frame {frame}")
            self._clouds[name] = clouds
            if len(poses) > len(clouds):
                skipped[sensor] = len(poses) - len(clouds)
        self._warnings: tuple[str, ...] = ()
        if skipped:
            each = ", ".join(f"{count} of {sensor}" for sensor, count in skipped.items())
            self._warnings = (f"{poses_path}: poses without a cloud are skipped: {each}",)
        frames = sorted(T_map_vehicle)
        self._poses = GivenPoses(
            stamps_ns=np.array(frames, dtype=np.int64) * FRAME_PERIOD_NS,
            T_map_vehicle=tuple(T_map_vehicle[frame] for frame in frames),
        )

    @property
    def name(self) -> str:
        """The path as given."""
        return self._name

    @property
    def lidars(self) -> tuple[str, ...]:
        """LiDARs of the config, in the config's order."""
        return tuple(self._lidars)

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        """Stamps of the clouds of one LiDAR, ascending: frame number times FRAME_PERIOD_NS."""
        return [frame * FRAME_PERIOD_NS for frame in self._clouds[lidar]]

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        """The clouds of one LiDAR in order of their frames (see `Recording`), read a few ahead.

        A scan without returns is still yielded.

        Raises:
            RecordingError: a cloud is missing, empty, cut off or damaged.
        """
        frames = (
            (lidar, frame, path)
            for frame, path in self._clouds[lidar].items()
            if wanted is None or frame * FRAME_PERIOD_NS in wanted
        )
        yield from worked_ahead(self._read_scan, frames)

    def _read_scan(self, cloud: tuple[str, int, Path]) -> LidarScan:
        lidar, frame, path = cloud
        config = self._lidars[lidar]
        points = read_pcd(path)
        kept = is_return(points, config.min_range, config.max_range)
        return LidarScan(
            lidar=lidar,
            stamp_ns=frame * FRAME_PERIOD_NS,
            points_lidar=points.compress(kept, axis=0),  # indexing takes four times as long
            source=str(path),
        )

    def motion(self) -> MotionData:
        """The vehicle's pose at each frame of which a LiDAR of the config has a cloud."""
        return MotionData(self._name, poses=self._poses)

    def warnings(self) -> Sequence[str]:
        """What was left out and why, one line each."""
        return self._warnings


@contextmanager
def _system_errors_named() -> Iterator[None]:
    """Turns an error of the system (no permission, a name too long) into a RecordingError."""
    try:
        yield
    except OSError as e:
        raise RecordingError(f"{e.filename}: {unreadable(e)}") from None


@_system_errors_named()
def _find_poses(path: Path) -> Path:
    if not path.exists():
        raise RecordingError(
            f"{path}: no such folder. Set data.path (or --data) to the folder that holds "
            f"input/{POSES_FILE}"
        )
    if not path.is_dir():
        raise RecordingError(
            f"{path}: is a file, but data.format caliv wants the folder that holds "
            f"input/{POSES_FILE}. For a bag set data.format: rosbag"
        )
    for folder in (path / "input", path):
        if (folder / POSES_FILE).is_file():
            return folder / POSES_FILE
    raise RecordingError(
        f"{path}: holds neither input/{POSES_FILE} nor {POSES_FILE}. Set data.path (or --data) to "
        "the folder of the drive, or add the file: it gives the vehicle's pose of every cloud"
    )


def _read_pose_lists(path: Path) -> dict[str, Any]:
    raw = read_yaml(path, RecordingError)
    if not isinstance(raw, dict) or not raw:
        raise RecordingError(
            f"{path}: holds no poses. Expected 'sensor_1:' and so on, each with a list of "
            "[file, [x, y, z, qx, qy, qz, qw]]"
        )
    return {str(sensor): entries for sensor, entries in raw.items()}


def _parse_poses(entries: Any, where: str) -> dict[int, gtsam.Pose3]:
    """T_map_vehicle by frame number."""
    if not isinstance(entries, list) or not entries:
        raise RecordingError(
            f"{where}: holds no poses. Expected a list of [file, [x, y, z, qx, qy, qz, qw]]"
        )
    poses: dict[int, gtsam.Pose3] = {}
    for number, entry in enumerate(entries, start=1):
        if not (isinstance(entry, list) and len(entry) == 2):
            raise RecordingError(
                f"{where}, entry {number}: {_shorten(entry)}, expected "
                "[file, [x, y, z, qx, qy, qz, qw]]"
            )
        file, values = entry
        name = _CLOUD_NAME.fullmatch(file) if isinstance(file, str) else None
        if name is None:
            raise RecordingError(
                f"{where}, entry {number}: {_shorten(file)} is not the name of a cloud. Expected "
                "its frame number and .pcd, such as 17.pcd, without a folder"
            )
        frame = int(name[1])
        if frame in poses:
            raise RecordingError(
                f"{where}, entry {number}: frame {frame} is given twice. Remove one of the entries"
            )
        poses[frame] = _parse_pose(values, f"{where}, entry {number} ({file})")
    return poses


def _parse_pose(values: Any, where: str) -> gtsam.Pose3:
    numbers = [_to_float(value) for value in values] if isinstance(values, list) else []
    if len(numbers) != 7 or None in numbers:
        raise RecordingError(
            f"{where}: {_shorten(values)}, expected the 7 numbers of a pose: x, y, z in metres, "
            "qx, qy, qz, qw"
        )
    pose = np.array(numbers, dtype=np.float64)
    if not np.isfinite(pose).all():
        raise RecordingError(
            f"{where}: {_shorten(values)} has a value that is not finite. Remove the entry and "
            "its cloud, or mend the pose"
        )
    if np.abs(pose[:3]).max() > _MOST_M:
        raise RecordingError(
            f"{where}: {_shorten(values)} is farther than {_MOST_M:g} m from the origin. Mend the "
            "pose"
        )
    x, y, z, qx, qy, qz, qw = pose
    norm = math.hypot(qx, qy, qz, qw)
    if abs(norm - 1.0) > _NORM_TOLERANCE:
        raise RecordingError(
            f"{where}: the quaternion qx, qy, qz, qw has norm {norm:.6g}, expected 1 within "
            f"{_NORM_TOLERANCE:g}. The order is x, y, z, qx, qy, qz, qw: mend the pose"
        )
    R_map_vehicle = gtsam.Rot3.Quaternion(qw / norm, qx / norm, qy / norm, qz / norm)
    return gtsam.Pose3(R_map_vehicle, np.array([x, y, z]))


def _to_float(value: Any) -> float | None:
    """A number, also as yaml-cpp writes it: 1e-05 has no point and is text to YAML 1.1."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        return float(value)
    except (ValueError, OverflowError):
        return None


@_system_errors_named()
def _list_clouds(folder: Path, sensor: str, lidar: str) -> dict[int, Path]:
    """The clouds of a sensor by frame number, ascending."""
    there = sorted(entry.name for entry in folder.iterdir() if entry.is_dir())
    if sensor not in there:
        raise RecordingError(
            f"{folder}: no folder '{sensor}' (LiDAR '{lidar}'). Set lidars.{lidar}.topic to a "
            f"sensor there is: {_enumerate(there)}"
        )
    clouds: dict[int, Path] = {}
    for path in sorted((folder / sensor).iterdir()):
        # Hidden files are left behind by file managers and sync tools.
        if path.suffix != ".pcd" or path.name.startswith("."):
            continue
        name = _CLOUD_NAME.fullmatch(path.name)
        if name is None:
            raise RecordingError(
                f"{path}: the name is not a frame number and .pcd, such as 17.pcd. Rename the "
                "cloud, or move it elsewhere"
            )
        frame = int(name[1])
        if frame in clouds:
            raise RecordingError(
                f"{path}: frame {frame} is {clouds[frame].name} as well. Remove one of them"
            )
        clouds[frame] = path
    if not clouds:
        raise RecordingError(
            f"{folder / sensor}: holds no clouds (<frame>.pcd) (LiDAR '{lidar}'). Add them, or "
            "take the LiDAR out of the config"
        )
    return dict(sorted(clouds.items()))


def _check_every_cloud_has_a_pose(
    clouds: Mapping[int, Path],
    poses: Mapping[int, gtsam.Pose3],
    poses_path: Path,
    sensor: str,
) -> None:
    missing = [path for frame, path in clouds.items() if frame not in poses]
    if missing:
        more = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
        raise RecordingError(
            f"{missing[0]}: has no pose{more}. Add {missing[0].name} to {sensor} in {poses_path}, "
            "or remove the cloud"
        )


def _check_agreement(
    T_map_vehicle: gtsam.Pose3, T_map_vehicle_other: gtsam.Pose3, where: str
) -> None:
    """Raises unless two poses of one frame are the same: the vehicle is in one place at a time."""
    R_difference = T_map_vehicle.rotation().between(T_map_vehicle_other.rotation())
    rotation_rad = float(np.linalg.norm(gtsam.Rot3.Logmap(R_difference)))
    translation_m = math.dist(T_map_vehicle.translation(), T_map_vehicle_other.translation())
    if translation_m > _AGREEMENT_M or rotation_rad > _AGREEMENT_RAD:
        raise RecordingError(
            f"{where}: the pose differs from another sensor's of the same frame by "
            f"{translation_m * 1e3:.3g} mm and {rotation_rad * 1e3:.3g} mrad (allowed: "
            f"{_AGREEMENT_M * 1e3:g} mm, {_AGREEMENT_RAD * 1e3:g} mrad). A frame is one moment: "
            "give both sensors the vehicle's pose at it, or the clouds different frame numbers"
        )


def _shorten(value: Any) -> str:
    """A value of the file in one short line; with aliases of YAML it can expand to gigabytes."""
    shortener = reprlib.Repr()
    shortener.maxlist, shortener.maxlevel, shortener.maxstring = 8, 2, 80
    text = shortener.repr(value)
    return text if len(text) <= 160 else f"{text[:157]}..."


def _enumerate(names: Iterable[str]) -> str:
    return textwrap.shorten(", ".join(names), 200, placeholder=" ...") or "none"
