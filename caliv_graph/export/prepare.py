"""The request of an export, from the options of the command line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from caliv_graph.config.load import load_config
from caliv_graph.config.model import Config
from caliv_graph.config.mounting import ImuConfig
from caliv_graph.errors import ExportError
from caliv_graph.export.consumers import check_options, find_consumer
from caliv_graph.export.edit import read_base
from caliv_graph.export.frames import parse_named, parse_pose
from caliv_graph.export.recording import RecordedFrames, read_frames
from caliv_graph.export.request import ImuExtrinsic, Request
from caliv_graph.products import Calibration
from caliv_graph.readers.frames import FrameTree
from caliv_graph.results.calibration_file import read_calibration

CONFIG_FILE = "config.yaml"
"""Name of the effective config beside a calibration."""


@dataclass(frozen=True)
class Options:
    """The options of `export`; empty or None: not given.

    Attributes:
        base: an existing file to change.
        lidars: names of the LiDARs to export; empty: all.
        frames: NAME=FRAME each.
        housings: NAME=x,y,z,roll,pitch,yaw each, `T_housing_lidar`, metres and radians.
        parents: FRAME=x,y,z,roll,pitch,yaw each, `T_vehicle_frame`.
        imu: x,y,z,roll,pitch,yaw of `T_vehicle_imu`.
    """

    consumer: str
    out: Path
    base: Path | None = None
    lidars: Sequence[str] = ()
    frames: Sequence[str] = ()
    housings: Sequence[str] = ()
    parents: Sequence[str] = ()
    vehicle_frame: str = ""
    imu: str = ""
    config: Path | None = None
    bag: Path | None = None
    letter: str = ""
    form: str = ""


def prepare(path: Path, options: Options) -> Request:
    """Reads all inputs of an export of the calibration.yaml at `path`.

    Raises:
        ExportError: an option is invalid, or names an unknown LiDAR.
        ConfigError: the calibration or its config is invalid.
        RecordingError: the recording is damaged.
    """
    _check(options)
    consumer = find_consumer(options.consumer)
    calibration = read_calibration(path)
    lidars = _chosen(options.lidars, calibration, path)
    frames = parse_named(options.frames, "--frame")
    housing_texts = parse_named(options.housings, "--housing")
    for option, names in (("--frame", frames), ("--housing", housing_texts)):
        for name in names:
            _check_lidar(name, calibration, path, option)
    housings = {name: parse_pose(text, f"--housing {name}") for name, text in housing_texts.items()}
    parents = {
        name: parse_pose(text, f"--parent {name}")
        for name, text in parse_named(options.parents, "--parent").items()
    }
    config, config_path = _config(path, options)
    topics = {} if config is None else {name: c.topic for name, c in config.lidars.items()}
    bag: RecordedFrames | None = None
    recorded = {}
    if options.bag is not None:
        bag = read_frames(options.bag, {n: t for n, t in topics.items() if n in lidars})
        for name in lidars:
            housing = bag.housing(name)
            if housing and consumer.places_housings and name not in housings:
                housings[name] = housing.T_parent_child
                recorded[name] = housing.parent
            elif name in bag.clouds and name not in housings:
                recorded[name] = bag.clouds[name]
    return Request(
        calibration=calibration,
        source=path.name,
        lidars=lidars,
        out=options.out,
        frames=frames,
        recorded=recorded,
        housings=housings,
        parents=parents,
        tree=None if bag is None else FrameTree(bag.links),
        vehicle_frame=options.vehicle_frame,
        imu=_imu(options, config, config_path),
        topics=topics,
        base=None if options.base is None else read_base(options.base),
        letter=options.letter or Request.letter,
        form=options.form,
        recorded_ns=0 if bag is None else bag.start_ns,
    )


def _check(options: Options) -> None:
    given = {
        "--base": options.base,
        "--frame": options.frames,
        "--housing": options.housings,
        "--parent": options.parents,
        "--vehicle-frame": options.vehicle_frame,
        "--imu": options.imu,
        "--bag": options.bag,
        "--letter": options.letter,
        "--form": options.form,
    }
    check_options(options.consumer, [option for option, value in given.items() if value])


def _chosen(names: Sequence[str], calibration: Calibration, path: Path) -> tuple[str, ...]:
    for name in names:
        _check_lidar(name, calibration, path, "--lidar")
    return tuple(name for name in calibration.lidars if not names or name in names)


def _check_lidar(name: str, calibration: Calibration, path: Path, option: str) -> None:
    if name not in calibration.lidars:
        raise ExportError(
            f"{option}: {path} has no LiDAR '{name}'. Give one of {', '.join(calibration.lidars)}"
        )


def _config(path: Path, options: Options) -> tuple[Config | None, Path]:
    """The config given, else the one in the folder of the calibration if the consumer needs it."""
    beside = path.parent / CONFIG_FILE
    if options.config is not None:
        return load_config(options.config), options.config
    consumer = find_consumer(options.consumer)
    needs_imu = "--imu" in consumer.options and not options.imu
    needs_topics = consumer.needs_topics or options.bag is not None
    if (needs_imu or needs_topics) and beside.is_file():
        return load_config(beside), beside
    return None, beside


def _imu(options: Options, config: Config | None, path: Path) -> ImuExtrinsic | None:
    if options.imu:
        return ImuExtrinsic(parse_pose(options.imu, "--imu"), "--imu")
    if config is None:
        return None
    extrinsic = config.imu.T_vehicle_imu
    # The effective config has every key, so a default value counts only if there is an IMU.
    stated = config.topics.imu is not None or extrinsic != ImuConfig().T_vehicle_imu
    return ImuExtrinsic(extrinsic.pose(), path.name, stated)
