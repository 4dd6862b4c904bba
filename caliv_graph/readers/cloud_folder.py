"""A drive as folders of clouds, one per LiDAR, and a file of poses: KITTI, nuScenes and others.

sequences/00/velodyne/000000.bin, sequences/00/times.txt, poses/00.txt       KITTI odometry
samples/LIDAR_TOP/n015-..__LIDAR_TOP__1532402927647951.pcd.bin               nuScenes
LiDAR/Ouster/1693019372543222016.bin, LiDAR_GT/Ouster_gt.txt                 HeLiPR

The time of a cloud is in its name (ns, us or ms since 1970, or seconds with a point), or in the
line of a file of times beside it: clouds count by the numbers in their names, 2.bin before 10.bin.
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from caliv_graph.common.inputs import read_input, unreadable
from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.model import PoseAxes
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import RecordingError
from caliv_graph.products import GivenPoses, LidarScan, MotionData
from caliv_graph.readers.ahead import worked_ahead
from caliv_graph.readers.bag import Topic
from caliv_graph.readers.bin_clouds import bin_sweep_times, plain_fields, read_bin
from caliv_graph.readers.clock import Clock, read_clock
from caliv_graph.readers.imu import ImuCheck
from caliv_graph.readers.pcd import read_pcd_table
from caliv_graph.readers.plain_points import table_as_message
from caliv_graph.readers.pointcloud2 import (
    TIME_FIELDS,
    DecodedCloud,
    decode_pointcloud2,
    sweep_times,
)
from caliv_graph.readers.pose_file import check_overlap, in_vehicle_axes, read_poses, stamp_of
from caliv_graph.readers.stamps import StampMark
from caliv_graph.readers.sweeps import (
    TimesSeen,
    is_sampled,
    mark_of_clouds,
    times_warnings,
    untimed_warning,
    with_mark,
)

CLOUD_TYPE = "folder of clouds"

_TIMES_FILES = ("times.txt", "timestamps.txt")
"""KITTI odometry and KITTI raw, beside the folder of clouds or above it."""

_POSES_FILES = ("poses.txt", "poses.csv", "poses.tum", "ego_pose.json")
"""Names under which a file of poses beside the clouds is found without a config."""

_TIME_IN_NAME = re.compile(r"(\d{12,19}|\d{9,10}[._]\d{1,9})(?!\d)")
"""Milliseconds to nanoseconds since 1970, or seconds with a point; a shorter number counts."""

_LEAST_DIGITS = 3
"""Behind the seconds, in the longest name of a folder: else that number counts something."""

_MOST_BYTES = 100_000_000


class CloudFolder:
    """A drive in folders of clouds (products.Recording). Opening it lists the clouds."""

    def __init__(
        self,
        path: Path,
        lidars: Mapping[str, LidarConfig],
        poses: Path | None = None,
        pose_axes: PoseAxes = "flu",
    ) -> None:
        """Opens the folder; the `topic` of a LiDAR is its folder of clouds in it.

        Raises:
            RecordingError: a folder is missing or has no clouds; clouds have no times or have other
                fields; the poses are missing, damaged or of another time.
        """
        if not path.is_dir():
            raise RecordingError(
                f"{path}: is no folder. Set data.path (or --data) to the folder that holds the "
                "folders of clouds"
            )
        self._path = path
        self._lidars = dict(lidars)
        self._clouds = {name: _clouds(path, lidar, name) for name, lidar in lidars.items()}
        self._fields = {
            name: _fields_of(self._clouds[name], lidar, name) for name, lidar in lidars.items()
        }
        self._times = {name: TimesSeen() for name in lidars}
        self._looked_at: dict[str, set[int]] = {name: set() for name in lidars}
        self._poses_path = poses or poses_file(path)
        self._pose_axes = pose_axes

    @property
    def name(self) -> str:
        """The path as given."""
        return str(self._path)

    @property
    def lidars(self) -> tuple[str, ...]:
        """LiDARs of the config, in the config's order."""
        return tuple(self._lidars)

    @property
    def topics(self) -> Mapping[str, Topic]:
        """The folders of clouds by name."""
        return {
            lidar.topic: Topic(lidar.topic, CLOUD_TYPE, len(self._clouds[name]))
            for name, lidar in self._lidars.items()
        }

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last stamp of a cloud, nanoseconds."""
        stamps = [stamp for clouds in self._clouds.values() for stamp in clouds]
        return (min(stamps), max(stamps)) if stamps else (0, 0)

    def lidar_topic(self, lidar: str) -> str:
        """The folder of the clouds of a LiDAR."""
        return self._lidars[lidar].topic

    def clocks(self) -> Mapping[str, Clock]:
        """The stamps of each folder, summarised. Files have no times of recording."""
        return self._clocks

    @cached_property
    def _clocks(self) -> dict[str, Clock]:
        found = {}
        for name, clouds in self._clouds.items():
            stamps = np.array(list(clouds), np.int64)
            clock = read_clock(stamps, stamps)
            found[self._lidars[name].topic] = replace(clock, offset_s=None)
        return found

    def frame_ids(self) -> Mapping[str, str]:
        """None: files name no frames."""
        return {}

    def times_seen(self, lidar: str) -> TimesSeen:
        """The times of the points in the clouds decoded so far."""
        return self._times[lidar]

    def stamp_mark(self, lidar: str) -> StampMark:
        """What the stamps of a LiDAR mark."""
        return self._marks[lidar]

    def imu_checks(self) -> Mapping[str, ImuCheck]:
        """None: there is no IMU."""
        return {}

    def gnss_fixes(self) -> Mapping[str, int]:
        """None: there is no GNSS."""
        return {}

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        """Stamps of the clouds of one LiDAR, ascending."""
        return list(self._clouds[lidar])

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        """The clouds of one LiDAR in order of their stamps (see `Recording`), read a few ahead.

        Raises:
            RecordingError: a cloud is missing, cut off or damaged.
        """
        chosen = (
            (lidar, stamp_ns)
            for stamp_ns in self._clouds[lidar]
            if wanted is None or stamp_ns in wanted
        )
        for stamp_ns, cloud in worked_ahead(self._read, chosen):
            if stamp_ns not in self._looked_at[lidar]:
                self._looked_at[lidar].add(stamp_ns)
                self._times[lidar] = self._times[lidar].with_cloud(cloud)
            yield LidarScan(
                lidar=lidar,
                stamp_ns=stamp_ns,
                points_lidar=cloud.points_lidar,
                source=str(self._clouds[lidar][stamp_ns]),
                point_times_s=None if self._lidars[lidar].deskewed is True else cloud.times_s,
            )

    def motion(self) -> MotionData:
        """The poses of the file; none without one.

        Raises:
            RecordingError: the poses are missing, damaged or of another time.
        """
        return MotionData(self.name, poses=self._poses)

    def warnings(self) -> Sequence[str]:
        """What was left out or assumed, one line each."""
        lines = []
        if self._poses_path is None:
            lines.append(f"{self._path}: has no poses of the vehicle. Set data.poses to their file")
        for lidar, times in self._times.items():
            if times.clouds or times.problems:
                where = f"{self._path}: LiDAR '{lidar}'"
                lines += times_warnings(where, times, self._marks[lidar], self._period_s(lidar))
        read = {lidar: times for lidar, times in self._times.items() if self._looked_at[lidar]}
        return lines + untimed_warning(str(self._path), read)

    @cached_property
    def _poses(self) -> GivenPoses | None:
        if self._poses_path is None:
            return None
        stamps = list(next(iter(self._clouds.values()), {})) if self._clouds else None
        poses = read_poses(self._poses_path, stamps)
        check_overlap(poses, self._poses_path, self.span_ns, str(self._path))
        return in_vehicle_axes(poses, self._pose_axes)

    @cached_property
    def _marks(self) -> dict[str, StampMark]:
        marks = {}
        for name, clouds in self._clouds.items():
            period_s = self._period_s(name)
            times = [
                sweep_times(_pcd_message(path), stamp_ns, period_s)
                if path.suffix == ".pcd"
                else bin_sweep_times(path, self._fields[name], stamp_ns, period_s)
                for i, (stamp_ns, path) in enumerate(clouds.items())
                if is_sampled(i)
            ]
            # No time of recording tells anything: as if each were its stamp.
            marks[name] = mark_of_clouds(self._lidars[name].stamp, times, np.zeros(1), period_s)
        return marks

    def _period_s(self, lidar: str) -> float | None:
        return self._clocks[self._lidars[lidar].topic].period_s

    def _read(self, item: tuple[str, int]) -> tuple[int, DecodedCloud]:
        lidar, stamp_ns = item
        config, path = self._lidars[lidar], self._clouds[lidar][stamp_ns]
        ranges = (config.min_range, config.max_range)
        period_s = self._period_s(lidar)
        if path.suffix == ".pcd":
            cloud = decode_pointcloud2(_pcd_message(path), stamp_ns, *ranges, period_s)
        else:
            cloud = read_bin(path, self._fields[lidar], stamp_ns, ranges, period_s)
        return stamp_ns, cloud if cloud.times_s is None else with_mark(cloud, self._marks[lidar])


def _pcd_message(path: Path) -> Any:
    """The points of a PCD file and their times, with the attributes of a `PointCloud2`."""
    return table_as_message(read_pcd_table(path, TIME_FIELDS))


def poses_file(path: Path) -> Path | None:
    """The file of poses in a folder, by its usual name; None: there is none."""
    return next((found for name in _POSES_FILES if (found := path / name).is_file()), None)


def cloud_folders(path: Path) -> tuple[str, ...]:
    """Folders of .bin clouds below a path, at most three levels down, relative to it.

    Raises:
        RecordingError: the path cannot be read.
    """
    try:
        return tuple(
            folder.relative_to(path).as_posix()
            for pattern in ("*", "*/*", "*/*/*")
            for folder in sorted(path.glob(pattern))
            if folder.is_dir() and next(folder.glob("*.bin"), None) is not None
        )
    except OSError as e:
        raise RecordingError(f"{path}: {unreadable(e)}") from None


def _clouds(root: Path, lidar: LidarConfig, name: str) -> dict[int, Path]:
    """The clouds of a LiDAR by stamp, ascending."""
    folder = root / lidar.topic
    try:
        paths = sorted(
            (
                entry
                for entry in folder.iterdir()
                if entry.suffix in (".bin", ".pcd")
                and not entry.name.startswith(".")
                and entry.is_file()
            ),
            key=lambda path: _by_number(path.name),
        )
    except OSError:
        there = ", ".join(cloud_folders(root)) or "none"
        raise RecordingError(
            f"{folder}: no such folder (LiDAR '{name}'). Set lidars.{name}.topic to a folder of "
            f"clouds in {root}: {there}"
        ) from None
    if not paths:
        raise RecordingError(
            f"{folder}: holds no clouds (.bin, .pcd) (LiDAR '{name}'). Add them, or take the LiDAR "
            "out of the config"
        )
    stamps = _times_in_names([path.name for path in paths])
    if stamps is None:
        stamps = _listed_times(folder, root, len(paths), name)
    clouds: dict[int, Path] = {}
    for stamp_ns, path in zip(stamps, paths, strict=True):
        if stamp_ns is None or stamp_ns in clouds:
            what = "has no time in its name" if stamp_ns is None else "has the time of another"
            raise RecordingError(f"{path}: {what}. Rename or remove the cloud")
        clouds[stamp_ns] = path
    return dict(sorted(clouds.items()))


def _by_number(name: str) -> tuple[list[str | int], str]:
    """Key to sort names by the numbers in them: 2.bin stands before 10.bin."""
    parts = re.split(r"([0-9]+)", name)
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], name


def _times_in_names(names: Sequence[str]) -> list[int | None] | None:
    """The time in each name of a folder's clouds; None: not every name has one.

    Behind the seconds stands a decimal fraction, or a whole number of ns, us or ms. The two differ
    where numbers are not equally long: only a fraction begins with a zero, only a whole number
    that lost its leading zeros ends with one. The longest then tells the unit.
    """
    found = [_TIME_IN_NAME.findall(name) for name in names]
    if not all(found):
        return None
    times = [match[-1] for match in found]
    parts = [re.split("[._]", time)[1] for time in times if not time.isdigit()]
    digits = max(map(len, parts), default=0)
    if parts and digits < _LEAST_DIGITS:
        return None
    begins = any(len(part) > 1 and part[0] == "0" for part in parts)
    ends = any(len(part) > 1 and part[-1] == "0" for part in parts)
    line = all("_" in time for time in times)
    if len(set(map(len, parts))) > 1 and not begins and (ends or line):
        digits = next(unit for unit in (3, 6, 9) if digits <= unit)
        times = [f"{s}.{part:0>{digits}}" for s, part in (re.split("[._]", t) for t in times)]
    return [stamp_of(time.replace("_", ".")) for time in times]


def _listed_times(folder: Path, root: Path, count: int, name: str) -> list[int | None]:
    """The times of numbered clouds, from the lines of a file, in the order of the numbers."""
    for place in dict.fromkeys((folder, folder.parent, root)):
        for file in _TIMES_FILES:
            path = place / file
            if not path.is_file():
                continue
            try:
                text = read_input(path, _MOST_BYTES).decode("utf-8")
            except OSError as e:
                raise RecordingError(f"{path}: {unreadable(e)}") from None
            except UnicodeDecodeError:
                raise RecordingError(f"{path}: is not text in UTF-8. Write it so") from None
            lines = [line.strip() for line in text.splitlines() if line.strip()]
            if len(lines) != count:
                raise RecordingError(
                    f"{path}: has {len(lines)} times, {folder} has {count} clouds. Write "
                    "one line per cloud: its time in seconds"
                )
            stamps = [_time_of_line(line) for line in lines]
            if None in stamps:
                line = lines[stamps.index(None)]
                raise RecordingError(f"{path}: {line[:60]!r} is not a time. Write seconds")
            return stamps
    raise RecordingError(
        f"{folder}: the names of the clouds (LiDAR '{name}') hold no time. Add {_TIMES_FILES[0]} "
        "beside the folder, a line in seconds per cloud"
    )


def _time_of_line(line: str) -> int | None:
    """Nanoseconds of seconds, or of a date and time of day as KITTI raw writes it."""
    stamp_ns = stamp_of(line)
    if stamp_ns is not None:
        return stamp_ns
    match = re.fullmatch(r"(\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?", line)
    if match is None:
        return None
    try:
        day = datetime.datetime.fromisoformat(match[1]).replace(tzinfo=datetime.UTC)
    except ValueError:
        return None
    nanoseconds = int((match[2] or "").ljust(9, "0"))
    return int(day.timestamp()) * NANOSECONDS_PER_SECOND + nanoseconds


def _fields_of(clouds: Mapping[int, Path], lidar: LidarConfig, name: str) -> tuple[str, ...]:
    """Fields of the points of a LiDAR's .bin clouds; empty: its clouds are PCD."""
    paths = [path for path in clouds.values() if path.suffix == ".bin"]
    if not paths:
        return ()
    if lidar.bin_fields is not None:
        return lidar.bin_fields
    fields = plain_fields(paths, [path.stat().st_size for path in paths])
    if fields is None:
        raise RecordingError(
            f"{paths[0].parent}: the sizes of the clouds fit neither 4 nor 5 floats per point. Set "
            f"lidars.{name}.bin_fields to the fields of a point, such as [x f4, y f4, z f4, "
            "intensity f4, t u4]"
        )
    return fields
