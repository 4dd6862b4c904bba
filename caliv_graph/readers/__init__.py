"""Reading recordings: one reader per format, all of them a `products.Recording`."""

from __future__ import annotations

from pathlib import Path

from caliv_graph.config.model import Config
from caliv_graph.errors import ConfigError
from caliv_graph.products import Recording
from caliv_graph.readers.caliv_folder import CalivFolder

__all__ = ["open_recording"]


def open_recording(config: Config, path: Path | None = None) -> Recording:
    """Opens a drive (absent: `config.data.path`) with the reader that `config.data.format` names.

    Raises:
        ConfigError: there is no path.
        RecordingError: the recording is missing, incomplete or contradicts itself.
    """
    path = config.data.path if path is None else path
    if path is None:
        raise ConfigError("no recording given: set data.path in the config, or give --data")
    if config.data.format == "rosbag":
        # Here, because a CaLiV folder does not need the libraries for bags.
        from caliv_graph.readers.rosbag import RosbagRecording

        return RosbagRecording(
            path,
            config.lidars,
            config.topics,
            poses=config.data.poses,
            pose_axes=config.data.pose_axes,
        )
    if config.data.format == "clouds":
        from caliv_graph.readers.cloud_folder import CloudFolder

        return CloudFolder(path, config.lidars, config.data.poses, config.data.pose_axes)
    return CalivFolder(path, config.lidars)
