"""The config that `init` writes: values from the drive, and keys that the user must fill in."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import gtsam
import yaml
from pydantic import BaseModel, BeforeValidator, RootModel

from caliv_graph.config.load import parse_config, read_yaml, validated
from caliv_graph.config.sections import Finite, Triple
from caliv_graph.errors import ConfigError
from caliv_graph.geometry.se3 import rpy
from caliv_graph.readers.bag import Bag, DamagedMessageError
from caliv_graph.readers.cloud_folder import poses_file
from caliv_graph.readers.discover import (
    MotionTopics,
    choose_lidar_topics,
    choose_motion_topics,
    drive_folder,
    first_frame,
    folders_of_clouds,
    is_recorded_bag,
    lidar_names,
    recorded_sensors,
)
from caliv_graph.readers.frames import (
    TF_TYPES,
    FrameTransform,
    FrameTree,
    message_transforms,
    read_urdf,
)

_NO_GUESS = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

_STILL_MESSAGES = 200
"""Messages of /tf in which old senders repeat what does not move: a few seconds of them."""


@dataclass(frozen=True)
class Draft:
    """A config for the user to complete.

    Attributes:
        text: YAML that `config.load_config` accepts.
        lidars: names of its LiDARs.
        unknown: keys that the user must fill in before calibrating.
        origin: a sentence about the source of the guesses; empty: there are none.
    """

    text: str
    lidars: tuple[str, ...]
    unknown: tuple[str, ...]
    origin: str


def _inner_list(raw: Any) -> Any:
    """The numbers of a list, which the CaLiV authors' program writes inside another list."""
    return raw[0] if isinstance(raw, list) and len(raw) == 1 else raw


_Numbers6 = tuple[Finite, Finite, Finite, Finite, Finite, Finite]


class _Transforms(RootModel[dict[str, Annotated[_Numbers6, BeforeValidator(_inner_list)]]]):
    """`transform_sensor_N`: roll, pitch, yaw in degrees, then metres, of T_vehicle_lidar."""


class _Bounds(BaseModel):
    """The target's region in the map, metres."""

    min_bound: Annotated[Triple, BeforeValidator(_inner_list)]
    max_bound: Annotated[Triple, BeforeValidator(_inner_list)]


@dataclass(frozen=True)
class _Original:
    """The values of a config of the CaLiV authors' program, in the units of our config."""

    path: Path
    extrinsics: Mapping[str, tuple[Sequence[float], Sequence[float]]]
    target: tuple[Sequence[float], Sequence[float]] | None


def draft_config(data: Path, config: Path, urdf: Path | None = None) -> Draft:
    """Drafts the config of a drive; paths in it are relative to the folder of `config`.

    Of a bag: LiDARs and motion data by the types of the topics, initial guesses from
    `/tf_static` or a URDF. Of a CaLiV folder: initial guesses and the target's region from a config
    of the CaLiV authors' program (`transform_sensor_N`, `min_bound`, `max_bound`) beside the data.
    Of folders of clouds: the folders, and a file of poses beside them.

    Raises:
        RecordingError: the drive is missing, no recording, or has no clouds.
        ConfigError: the URDF, or the CaLiV config beside the data, is damaged; a URDF for a folder.
    """
    if is_recorded_bag(data):
        draft = _draft_of_bag(data, config, urdf)
    elif urdf is not None:
        raise ConfigError(
            f"{data}: is not a bag: its clouds name no frame of {urdf}. Leave out --urdf"
        )
    elif folders := folders_of_clouds(data):
        draft = _draft_of_clouds(data, config, folders)
    else:
        draft = _draft_of_folder(data, config)
    # A draft that does not load is a defect of this module, not of the data.
    parse_config(yaml.safe_load(draft.text), str(config), config.parent)
    return draft


def _draft_of_folder(data: Path, config: Path) -> Draft:
    sensors = recorded_sensors(data)
    original = _find_original(drive_folder(data))
    extrinsics = original.extrinsics if original else {}
    target = original.target if original else None
    unknown = [f"lidars.{sensor}.initial" for sensor in sensors if sensor not in extrinsics]
    if target is None:
        unknown.append("target")
    source = original.path.name if original else ""
    lidars = "\n".join(
        _lidar_text(
            sensor,
            sensor,
            "its folder of clouds",
            *extrinsics.get(sensor, _NO_GUESS),
            _origin(source if sensor in extrinsics else ""),
        )
        for sensor in sensors
    )
    text = _align(
        _TEMPLATE.format(
            format="caliv\t# a folder with input/ego_poses.yaml and input/sensor_N/<frame>.pcd",
            path=_scalar(_relative(data, config)),
            motion="",
            lidars=lidars,
            reference=_scalar(sensors[0]),
            target=_target_text(target, source),
        )
    )
    taken = f"Initial guesses and target taken from {original.path}" if original else ""
    return Draft(text, sensors, tuple(unknown), taken)


def _draft_of_clouds(data: Path, config: Path, folders: Sequence[str]) -> Draft:
    names = lidar_names(folders)
    poses = poses_file(data)
    path = _scalar(_relative(data, config))
    if poses is None:
        path += "\n  # TODO: poses: FILE\t# of the vehicle: TUM, CSV, KITTI or ego_pose.json"
    else:
        path += f"\n  poses: {_scalar(_relative(poses, config))}\t# of the vehicle in the map"
    lidars = [
        _lidar_text(name, folder, "its folder of clouds", *_NO_GUESS, _origin(""))
        for name, folder in names.items()
    ]
    text = _align(
        _TEMPLATE.format(
            format="clouds\t# folders of .bin or .pcd clouds, their times in the names",
            path=path,
            motion="",
            lidars="\n".join(lidars),
            reference=_scalar(next(iter(names))),
            target=_SEARCHED_TARGET_TEMPLATE,
        )
    )
    unknown = ["data.poses"] * (poses is None) + [f"lidars.{name}.initial" for name in names]
    return Draft(text, tuple(names), tuple(unknown), "")


def _draft_of_bag(data: Path, config: Path, urdf: Path | None) -> Draft:
    bag = Bag(data)
    frames = _read_frames(bag, urdf)
    clouds = choose_lidar_topics(bag)
    motion = choose_motion_topics(bag)
    unknown: list[str] = [] if motion.chosen else ["topics"]
    lidars = []
    for name, topic in clouds.chosen.items():
        guess = frames.extrinsic(clouds.frame_ids[name])
        if guess.T_vehicle_sensor is None:
            unknown.append(f"lidars.{name}.initial")
        kind = bag.topics[topic].type.rpartition("/")[2]
        note = f"{kind} in frame {clouds.frame_ids[name] or '(none)'}"
        lidars.append(_lidar_text(name, topic, note, *guess.numbers(), guess.origin))
    lidars += [_comment(f"  # not taken: {topic}, {why}") for topic, why in clouds.others.items()]
    sections = _topics_text(bag, motion)
    for kind, key, template in (
        ("imu", "imu.T_vehicle_imu", _IMU_TEMPLATE),
        ("gnss", "gnss.lever_arm", _GNSS_TEMPLATE),
    ):
        if kind in motion.chosen:
            guess = frames.extrinsic(first_frame(bag, motion.chosen[kind]) or "")
            if guess.T_vehicle_sensor is None:
                unknown.append(key)
            xyz, rpy_deg = guess.numbers()
            # An unknown lever arm is estimated; zeros would say that it is exactly zero.
            arm = "null" if guess.T_vehicle_sensor is None else _list(xyz)
            sections += template.format(
                origin=guess.origin, xyz=_list(xyz), rpy_deg=_list(rpy_deg), arm=arm
            )
    text = _align(
        _TEMPLATE.format(
            format="rosbag\t# a ROS 2 bag (folder, .mcap) or a ROS 1 .bag",
            path=_scalar(_relative(data, config)),
            motion=sections,
            lidars="\n".join(lidars),
            reference=_scalar(next(iter(clouds.chosen))),
            target=_SEARCHED_TARGET_TEMPLATE,
        )
    )
    found = [name for name in clouds.chosen if f"lidars.{name}.initial" not in unknown]
    taken = f"Initial guesses of {', '.join(found)} taken from {frames.source}" if found else ""
    return Draft(text, tuple(clouds.chosen), tuple(unknown), taken)


@dataclass(frozen=True)
class _Guess:
    """`T_vehicle_sensor`, None if it is not known, and its source or why it is not known."""

    T_vehicle_sensor: gtsam.Pose3 | None
    origin: str

    def numbers(self) -> tuple[Sequence[float], Sequence[float]]:
        """Metres, and roll, pitch, yaw in degrees; zeros if it is not known."""
        if self.T_vehicle_sensor is None:
            return _NO_GUESS
        angles = rpy(self.T_vehicle_sensor.rotation().matrix())
        # To the micrometre and microdegree: the zeros of a quaternion become 1e-15.
        xyz = [round(float(v), 6) + 0.0 for v in self.T_vehicle_sensor.translation()]
        return xyz, [round(math.degrees(v), 6) + 0.0 for v in angles]


@dataclass(frozen=True)
class _Frames:
    """Frames that are fixed to each other, the vehicle's frame (None: unknown) and their source."""

    tree: FrameTree
    vehicle: str | None
    source: str

    def extrinsic(self, frame: str) -> _Guess:
        """`T_vehicle_sensor` of the sensor with this frame."""
        if self.vehicle is None:
            why = f"{self.source} has no frame base_link"
        elif not frame:
            why = "its messages name no frame"
        else:
            T = gtsam.Pose3() if frame == self.vehicle else None
            T = T or self.tree.transform(self.vehicle, frame)
            if T is not None:
                return _Guess(T, f"{self.vehicle} to {frame}, {_origin(self.source)}")
            why = f"{self.source} does not lead from {self.vehicle} to {frame}"
        return _Guess(None, f"{_origin('')} ({why})")


def _read_frames(bag: Bag, urdf: Path | None) -> _Frames:
    links: list[FrameTransform] = []
    for topic in bag.topics.values():
        if topic.type in TF_TYPES and topic.name.rpartition("/")[2] != "tf_static":
            links += _still_links(bag, topic.name)
    static = [name for name in bag.topics if name.rpartition("/")[2] == "tf_static"]
    for _, _, raw in bag.messages(static):
        links += _links(bag, static[0], raw)
    source = "/tf_static"
    vehicle = FrameTree(links).vehicle_frame()
    if urdf is not None:
        fixed = read_urdf(urdf)
        tree = FrameTree(fixed)
        # The root of a URDF may have any name; a known name of a vehicle frame comes first.
        root = tree.root(fixed[0].child) if fixed else None
        vehicle = tree.vehicle_frame() or vehicle or root
        source = f"{urdf.name} and /tf_static" if static else urdf.name
        links += fixed
    elif not links:
        source = "the bag, which has no /tf_static,"
    return _Frames(FrameTree(links), vehicle, source)


def _links(bag: Bag, topic: str, raw: bytes) -> list[FrameTransform]:
    try:
        return [link for _, link in message_transforms(bag.decode(topic, raw))]
    except DamagedMessageError:
        return []


def _still_links(bag: Bag, topic: str) -> Iterable[FrameTransform]:
    """Links that repeat without change: before /tf_static, senders repeated static links."""
    first: dict[tuple[str, str], FrameTransform] = {}
    repeated: dict[tuple[str, str], bool] = {}
    for count, (_, _, raw) in enumerate(bag.messages([topic])):
        for link in _links(bag, topic, raw):
            key = (link.parent, link.child)
            before = first.setdefault(key, link)
            if before is not link:
                same = before.T_parent_child.equals(link.T_parent_child, 1e-9)
                repeated[key] = repeated.get(key, True) and same
        if count >= _STILL_MESSAGES:
            break
    return [first[key] for key, same in repeated.items() if same]


def _topics_text(bag: Bag, motion: MotionTopics) -> str:
    lines = ["topics:\t# of the vehicle's motion: imu, gnss and twist; or pose"]
    if not motion.chosen:
        lines[0] = "topics: {}\t# TODO: imu, gnss and twist, or pose: the bag has none by its types"
    for key, chosen in motion.chosen.items():
        lines.append(f"  {key}: {_scalar(chosen)}\t# {bag.topics[chosen].type}")
    for key, others in motion.others.items():
        lines += [f"  # {key}: {_scalar(o)}\t# fits, too: {bag.topics[o].type}" for o in others]
    return "\n".join(lines) + "\n\n"


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
    expected = "CaLiV config"
    values = {key: value for key, value in raw.items() if str(key).startswith("transform_")}
    transforms = validated(_Transforms, values, str(path), expected).root
    extrinsics = {
        name.removeprefix("transform_"): (numbers[3:], numbers[:3])
        for name, numbers in transforms.items()
    }
    if "min_bound" not in raw or "max_bound" not in raw:
        return _Original(path, extrinsics, None)
    bounds = validated(_Bounds, raw, str(path), expected)
    return _Original(path, extrinsics, (bounds.min_bound, bounds.max_bound))


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


def _origin(source: str) -> str:
    if source:
        return f"taken from {source}"
    return "TODO: these zeros are no guess; measure it, or take it from a drawing"


def _comment(text: str) -> str:
    """Text of the data, such as a frame's name, without characters that would end a comment."""
    return re.sub(r"[^\S ]|[^ -~\u00a1-\uffff]", "?", text)


def _lidar_text(
    name: str,
    topic: str,
    topic_note: str,
    xyz: Sequence[float],
    rpy_deg: Sequence[float],
    origin: str,
) -> str:
    return _LIDAR_TEMPLATE.format(
        name=_scalar(name),
        topic=_scalar(topic),
        topic_note=_comment(topic_note),
        origin=_comment(origin),
        xyz=_list(xyz),
        rpy_deg=_list(rpy_deg),
    )


def _target_text(target: tuple[Sequence[float], Sequence[float]] | None, source: str) -> str:
    if target is None:
        return _NO_TARGET_TEMPLATE
    return _TARGET_TEMPLATE.format(source=source, min=_list(target[0]), max=_list(target[1]))


_TEMPLATE = """\
# Drafted by 'caliv-graph init'. Metres and degrees; paths are relative to this file.
# T_vehicle_lidar maps points of a LiDAR's cloud into the vehicle frame: x forward, y left, z up.

data:
  format: {format}
  path: {path}

{motion}lidars:\t# rename them as you like: front, rear, ...
{lidars}

reference: {reference}\t# the LiDAR that the others are calibrated to

{target}

solve:
  mode: auto\t# auto (the guess decides only what the drive leaves open), staged, joint

robust:
  kernel: huber\t# treatment of outlier scans: huber, tls, trimmed, none

require: [s2s]\t# exit code 0 means that these are determined: s2s, s2v_rotation, s2v
"""

_LIDAR_TEMPLATE = """\
  {name}:
    topic: {topic}\t# {topic_note}
    initial:\t# T_vehicle_lidar, {origin}
      xyz: {xyz}\t# metres forward, left, up
      rpy_deg: {rpy_deg}\t# degrees; pitch > 0 is nose down, yaw > 0 left
    sigma:\t# how far off it may be, 1 sigma: a number, or one per vehicle axis
      xyz: 0.058\t# metres; 0.058 is anything up to +-0.1 m
      rpy_deg: 1.73\t# degrees; 1.73 is anything up to +-3 degrees
    min_range: 1.0\t# metres; nearer returns (the vehicle's own body) are dropped
    max_range: 200.0\t# metres; farther returns are dropped
    stamp: auto\t# what a cloud's stamp marks: start or end of its sweep; auto: by the data"""

_TARGET_TEMPLATE = """\
target:\t# a box around the target, with nothing else above the ground in it
  min: {min}\t# metres, taken from {source}
  max: {max}\t# metres
  frame: map\t# map (the frame of the poses) or start (the vehicle's first pose)"""

_NO_TARGET_TEMPLATE = """\
# TODO: a box around the target, with nothing else above the ground in it: metres, in the frame of
# the poses (map) or of the vehicle's first pose (start). Without it the target is searched for.
# target:
#   min: [10.0, -14.0, -1.0]
#   max: [20.0, -4.0, 3.0]
#   frame: map"""

_SEARCHED_TARGET_TEMPLATE = """\
# The target is searched for. If that fails, or other objects are near it, give a box around it,
# with nothing else above the ground in it: metres, in the map, or from the vehicle's first pose.
# If there is none, 'target: false': walls and other structure calibrate alone.
# target:
#   min: [10.0, -14.0, -1.0]
#   max: [20.0, -4.0, 3.0]
#   frame: start"""

_IMU_TEMPLATE = """\
imu:
  T_vehicle_imu:\t# {origin}
    xyz: {xyz}\t# metres forward, left, up
    rpy_deg: {rpy_deg}\t# degrees

"""

_GNSS_TEMPLATE = """\
gnss:\t# the antenna in the vehicle frame, {origin}
  lever_arm: {arm}\t# metres forward, left, up; null: unknown, estimated from the drive

"""
