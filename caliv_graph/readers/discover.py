"""What a recording holds, without a config that says so."""

from __future__ import annotations

from pathlib import Path

from caliv_graph.config import LidarConfig, Mounting, read_yaml
from caliv_graph.errors import RecordingError
from caliv_graph.products import Recording
from caliv_graph.readers.caliv_folder import POSES_FILE, CalivFolder

_BAG_SUFFIXES = (".bag", ".mcap", ".db3")

_ANY_RANGE_M = 1e6
"""Farther than any return: nothing is dropped for its range."""


def drive_folder(path: Path) -> Path:
    """The folder of a CaLiV drive that holds the poses and a folder of clouds per sensor.

    Args:
        path: that folder, or the one around it.

    Raises:
        RecordingError: the path is missing, or no CaLiV folder.
    """
    if _is_bag(path):
        raise RecordingError(
            f"{path}: rosbags cannot be read yet. Export the drive as a CaLiV folder: "
            f"input/{POSES_FILE} and input/sensor_1/<frame>.pcd"
        )
    # Without LiDARs it opens nothing but the poses, and says what is wrong with them.
    CalivFolder(path, {})
    return path / "input" if (path / "input" / POSES_FILE).is_file() else path


def recorded_sensors(path: Path) -> tuple[str, ...]:
    """Sensors of a CaLiV drive that have poses, in the order of their numbers.

    Raises:
        RecordingError: the path is missing, or no CaLiV folder.
    """
    listed = read_yaml(drive_folder(path) / POSES_FILE, RecordingError)
    return tuple(sorted((str(sensor) for sensor in listed), key=_by_number))


def open_all(path: Path) -> Recording:
    """Opens a drive with all its sensors, each by its own name, and all ranges.

    Raises:
        RecordingError: the path is missing, no CaLiV folder, or incomplete.
    """
    lidars = {
        sensor: LidarConfig(
            topic=sensor,
            initial=Mounting(xyz=(0.0, 0.0, 0.0)),
            min_range=0.0,
            max_range=_ANY_RANGE_M,
        )
        for sensor in recorded_sensors(path)
    }
    return CalivFolder(path, lidars)


def _is_bag(path: Path) -> bool:
    if path.suffix in _BAG_SUFFIXES:
        return True
    return path.is_dir() and any(entry.suffix in _BAG_SUFFIXES for entry in path.iterdir())


def _by_number(sensor: str) -> tuple[str, int]:
    """Puts sensor_10 after sensor_9."""
    stem = sensor.rstrip("0123456789")
    return stem, int(sensor[len(stem) :] or 0)
