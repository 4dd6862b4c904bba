"""From what a person gives on the command line to a request."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from caliv_graph.config.load import load_config
from caliv_graph.config.model import Config, ImuConfig
from caliv_graph.errors import ExportError
from caliv_graph.export.consumers import CONSUMERS, check_options
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
class Wishes:
    """Options as they were given; empty or None: not given.

    Attributes:
        consumer: one of `CONSUMERS`.
        out: the output.
        base: an existing file to change.
        lidars: names of those to export.
        frames: NAME=FRAME each.
        housings: NAME=x,y,z,roll,pitch,yaw each, `T_housing_lidar`, metres and radians.
        parents: FRAME=x,y,z,roll,pitch,yaw each, `T_vehicle_frame`.
        vehicle_frame: name of the vehicle frame.
        imu: x,y,z,roll,pitch,yaw of `T_vehicle_imu`.
        config: the config of the calibration.
        bag: a recording to take frames from.
        letter: of the keys of a factor graph.
        form: which of several forms.
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


def prepare(path: Path, wishes: Wishes) -> Request:
    """Reads what an export needs.

    Args:
        path: a calibration.yaml.
        wishes: what was asked for.

    Raises:
        ExportError: an option is not what it should be, or names a LiDAR that there is not.
        ConfigError: the calibration or its config is damaged.
        RecordingError: the recording is.
    """
    _check(wishes)
    calibration = read_calibration(path)
    lidars = _chosen(wishes.lidars, calibration, path)
    frames = parse_named(wishes.frames, "--frame")
    told = parse_named(wishes.housings, "--housing")
    for option, names in (("--frame", frames), ("--housing", told)):
        for name in names:
            _check_lidar(name, calibration, path, option)
    housings = {name: parse_pose(text, f"--housing {name}") for name, text in told.items()}
    parents = {
        name: parse_pose(text, f"--parent {name}")
        for name, text in parse_named(wishes.parents, "--parent").items()
    }
    config, config_path = _config(path, wishes)
    topics = {} if config is None else {name: c.topic for name, c in config.lidars.items()}
    bag: RecordedFrames | None = None
    recorded = {}
    if wishes.bag is not None:
        bag = read_frames(wishes.bag, {n: t for n, t in topics.items() if n in lidars})
        for name in lidars:
            housing = bag.housing(name)
            # Only Autoware's files are about housings unless somebody says so.
            if housing and wishes.consumer == "autoware" and name not in housings:
                housings[name] = housing.T_parent_child
                recorded[name] = housing.parent
            elif name in bag.clouds and name not in housings:
                recorded[name] = bag.clouds[name]
    return Request(
        calibration=calibration,
        source=path.name,
        lidars=lidars,
        out=wishes.out,
        frames=frames,
        recorded=recorded,
        housings=housings,
        parents=parents,
        tree=None if bag is None else FrameTree(bag.links),
        vehicle_frame=wishes.vehicle_frame,
        imu=_imu(wishes, config, config_path),
        topics=topics,
        base=None if wishes.base is None else read_base(wishes.base),
        letter=wishes.letter or Request.letter,
        form=wishes.form,
        recorded_ns=0 if bag is None else bag.start_ns,
    )


def _check(wishes: Wishes) -> None:
    given = {
        "--base": wishes.base,
        "--frame": wishes.frames,
        "--housing": wishes.housings,
        "--parent": wishes.parents,
        "--vehicle-frame": wishes.vehicle_frame,
        "--imu": wishes.imu,
        "--bag": wishes.bag,
        "--letter": wishes.letter,
        "--form": wishes.form,
    }
    check_options(wishes.consumer, [option for option, value in given.items() if value])


def _chosen(names: Sequence[str], calibration: Calibration, path: Path) -> tuple[str, ...]:
    for name in names:
        _check_lidar(name, calibration, path, "--lidar")
    return tuple(name for name in calibration.lidars if not names or name in names)


def _check_lidar(name: str, calibration: Calibration, path: Path, option: str) -> None:
    if name not in calibration.lidars:
        raise ExportError(
            f"{option}: {path} has no LiDAR '{name}', but {', '.join(calibration.lidars)}"
        )


def _config(path: Path, wishes: Wishes) -> tuple[Config | None, Path]:
    """The config of a calibration: the one given, else the one beside it, where one is of use."""
    beside = path.parent / CONFIG_FILE
    if wishes.config is not None:
        return load_config(wishes.config), wishes.config
    uses = "--imu" in CONSUMERS[wishes.consumer].takes and not wishes.imu
    if (uses or wishes.bag is not None or wishes.consumer == "mola") and beside.is_file():
        return load_config(beside), beside
    return None, beside


def _imu(wishes: Wishes, config: Config | None, path: Path) -> ImuExtrinsic | None:
    if wishes.imu:
        return ImuExtrinsic(parse_pose(wishes.imu, "--imu"), "--imu")
    if config is None:
        return None
    mounting = config.imu.T_vehicle_imu
    # The effective config states every key: a default is a statement only where there was an IMU.
    stated = config.topics.imu is not None or mounting != ImuConfig().T_vehicle_imu
    return ImuExtrinsic(mounting.pose(), path.name, stated)
