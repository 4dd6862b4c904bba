"""The config that `init` writes: what can be known from a drive, and what a person must fill in."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from caliv_graph.config import parse_config, read_yaml
from caliv_graph.errors import ConfigError
from caliv_graph.fields import Field
from caliv_graph.readers.discover import drive_folder, recorded_sensors

_NO_GUESS = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Draft:
    """A config to be completed.

    Attributes:
        text: YAML that `config.load_config` accepts.
        lidars: names of its LiDARs.
        unknown: keys that a person must fill in before calibrating.
        source: the CaLiV config that guesses and target were taken from; None: there was none.
    """

    text: str
    lidars: tuple[str, ...]
    unknown: tuple[str, ...]
    source: Path | None


@dataclass(frozen=True)
class _Original:
    """What a config of the CaLiV authors' program says.

    Attributes:
        path: the file.
        mountings: per sensor, metres and roll, pitch, yaw in degrees of T_vehicle_lidar.
        target: lower and upper corner in the map, metres; None if it says nothing.
    """

    path: Path
    mountings: Mapping[str, tuple[Sequence[float], Sequence[float]]]
    target: tuple[Sequence[float], Sequence[float]] | None


def draft_config(data: Path, config: Path) -> Draft:
    """Drafts the config of a CaLiV drive.

    Initial guesses and the target's region are taken from a config of the CaLiV authors' program
    (`transform_sensor_N`, `min_bound`, `max_bound`) if one lies beside the data.

    Args:
        data: the drive.
        config: where the config will be written: paths in it are relative to its folder.

    Raises:
        RecordingError: the drive is missing, or no CaLiV folder.
        ConfigError: the CaLiV config beside it is damaged.
    """
    sensors = recorded_sensors(data)
    original = _find_original(drive_folder(data))
    mountings = original.mountings if original else {}
    target = original.target if original else None
    unknown = [f"lidars.{sensor}.initial" for sensor in sensors if sensor not in mountings]
    if target is None:
        unknown.append("target")
    source = original.path.name if original else ""
    lidars = "\n".join(
        _lidar_text(
            sensor, *mountings.get(sensor, _NO_GUESS), source if sensor in mountings else ""
        )
        for sensor in sensors
    )
    text = _align(
        _TEMPLATE.format(
            path=_scalar(_relative(data, config)),
            lidars=lidars,
            reference=_scalar(sensors[0]),
            target=_target_text(target, source),
        )
    )
    # A draft that does not load would be a defect of this module, not of the user's data.
    parse_config(yaml.safe_load(text), str(config), config.parent)
    return Draft(text, sensors, tuple(unknown), original.path if original else None)


def _find_original(folder: Path) -> _Original | None:
    """Looks for a CaLiV config beside the poses, and beside the folder `input` that holds them."""
    folders = [folder, folder.parent] if folder.name == "input" else [folder]
    for candidate in folders:
        for path in sorted(candidate.iterdir()):
            if path.suffix in (".yaml", ".yml") and path.is_file():
                original = _read_original(path)
                if original:
                    return original
    return None


def _read_original(path: Path) -> _Original | None:
    try:
        raw = read_yaml(path)
    except ConfigError:
        return None
    if not isinstance(raw, dict) or "transform_sensor_1" not in raw:
        return None
    root = Field(raw, str(path))
    mountings = {}
    for name, field in root.names().items():
        if name.startswith("transform_"):
            values = _numbers(field, 6)
            mountings[name.removeprefix("transform_")] = (values[3:], values[:3])
    if "min_bound" not in raw or "max_bound" not in raw:
        return _Original(path, mountings, None)
    bounds = (_numbers(root.child("min_bound"), 3), _numbers(root.child("max_bound"), 3))
    return _Original(path, mountings, bounds)


def _numbers(field: Field, size: int) -> list[float]:
    """The numbers of a list, which that program writes inside another list."""
    items = field.items()
    inner = items[0] if len(items) == 1 else field
    return [float(v) for v in inner.vector(size)]


def _relative(data: Path, config: Path) -> str:
    return os.path.relpath(data.resolve(), config.resolve().parent)


def _align(template: str) -> str:
    """Puts the comments, which follow a tab, below one another."""
    lines = [line.split("\t") for line in template.splitlines()]
    return "".join(f"{line[0]:<30}  {line[1]}\n" if line[1:] else f"{line[0]}\n" for line in lines)


def _scalar(text: str) -> str:
    """A string as YAML reads it back, in quotes only if it needs them."""
    plain = re.fullmatch(r"[\w./][\w./ -]*(?<! )", text) and yaml.safe_load(text) == text
    return text if plain else json.dumps(text, ensure_ascii=False)


def _list(values: Sequence[float]) -> str:
    shown: list[Any] = [round(float(v), 9) for v in values]
    return yaml.safe_dump(shown, default_flow_style=True, width=1000).strip()


def _lidar_text(sensor: str, xyz: Sequence[float], rpy_deg: Sequence[float], source: str) -> str:
    origin = (
        f"taken from {source}"
        if source
        else "TODO: these zeros are no guess; measure, or read it off a drawing"
    )
    return _LIDAR_TEMPLATE.format(
        name=_scalar(sensor), origin=origin, xyz=_list(xyz), rpy_deg=_list(rpy_deg)
    )


def _target_text(target: tuple[Sequence[float], Sequence[float]] | None, source: str) -> str:
    if target is None:
        return _NO_TARGET_TEMPLATE
    return _TARGET_TEMPLATE.format(source=source, min=_list(target[0]), max=_list(target[1]))


_TEMPLATE = """\
# Drafted by 'caliv-graph init'. Metres and degrees; paths are relative to this file.
# T_vehicle_lidar maps points of a LiDAR's cloud into the vehicle frame: x forward, y left, z up.

data:
  format: caliv\t# a folder with input/ego_poses.yaml and input/sensor_N/<frame>.pcd
  path: {path}

lidars:\t# rename them as you like: front, rear, ...
{lidars}

reference: {reference}\t# the LiDAR that the others are calibrated to

{target}

solve:
  mode: auto\t# auto (the guess decides only what the drive leaves open), staged, joint

robust:
  kernel: huber\t# what becomes of bad scans: huber, tls, trimmed, none

require: [s2s]\t# what exit code 0 promises to have determined: s2s, s2v_rotation, s2v
"""

_LIDAR_TEMPLATE = """\
  {name}:
    topic: {name}\t# its folder of clouds
    initial:\t# T_vehicle_lidar, {origin}
      xyz: {xyz}\t# metres forward, left, up
      rpy_deg: {rpy_deg}\t# degrees; pitch > 0 is nose down, yaw > 0 left
    sigma:\t# how far off it may be, 1 sigma: a number, or one per vehicle axis
      xyz: 0.058\t# metres; 0.058 is anything up to +-0.1 m
      rpy_deg: 1.73\t# degrees; 1.73 is anything up to +-3 degrees
    min_range: 1.0\t# metres; nearer returns (the vehicle's own body) are dropped
    max_range: 200.0\t# metres; farther returns are dropped"""

_TARGET_TEMPLATE = """\
target:\t# a box in which the target, and nothing else above the ground, stands
  min: {min}\t# metres, taken from {source}
  max: {max}\t# metres
  frame: map\t# map (the frame of the poses) or start (the vehicle's first pose)"""

_NO_TARGET_TEMPLATE = """\
# TODO: a box in which the target, and nothing else above the ground, stands: metres, in the frame
# of the poses (map) or of the vehicle's first pose (start). Without it the target is searched for.
# target:
#   min: [10.0, -14.0, -1.0]
#   max: [20.0, -4.0, 3.0]
#   frame: map"""
