"""The config that `init` writes: values from the drive, and keys that the user must fill in."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

from caliv_graph.config.load import parse_config
from caliv_graph.errors import ConfigError
from caliv_graph.readers.bag import Bag
from caliv_graph.readers.cloud_folder import poses_file
from caliv_graph.readers.discover import (
    LidarTopics,
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
from caliv_graph.workflows.caliv_config import find_original
from caliv_graph.workflows.draft_text import (
    GNSS_TEMPLATE,
    HEADING_TEMPLATE,
    IMU_TEMPLATE,
    SEARCHED_TARGET_TEMPLATE,
    TEMPLATE,
    TODO_POSE,
    WHEELS_TEMPLATE,
    align,
    comment,
    from_source,
    ground_text,
    lidar_text,
    scalar,
    target_text,
    yaml_list,
)
from caliv_graph.workflows.frame_guesses import Frames, read_frames

_HEIGHT = "ground.vehicle_height"


@dataclass(frozen=True)
class Draft:
    """A config for the user to complete.

    Attributes:
        text: YAML that `config.load_config` accepts.
        lidars: names of its LiDARs.
        unknown: keys that the user must fill in before calibrating.
        origin: a sentence about the source of the guesses; empty: there are none.
        original: config of another program that they were read from.
    """

    text: str
    lidars: tuple[str, ...]
    unknown: tuple[str, ...]
    origin: str
    original: Path | None = None


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
    original = find_original(drive_folder(data))
    extrinsics = original.extrinsics if original else {}
    target = original.target if original else None
    source = original.source if original else ""
    lidars = "\n".join(
        lidar_text(
            sensor,
            sensor,
            "its folder of clouds",
            extrinsics.get(sensor),
            from_source(source) if sensor in extrinsics else "no config beside the data has it",
        )
        for sensor in sensors
    )
    text = align(
        TEMPLATE.format(
            format="caliv\t# a folder with input/ego_poses.yaml and input/sensor_N/<frame>.pcd",
            path=scalar(_relative(data, config)),
            motion="",
            lidars=lidars,
            reference=scalar(sensors[0]),
            target=target_text(target, original.path.name if original else ""),
            ground=ground_text(None),
        )
    )
    what = "Initial guesses and target" if target else "Initial guesses"
    taken = f"{what} taken from {original.path}" if original else ""
    if original and original.radians:
        taken += ", whose angles are radians by their size"
    return Draft(text, sensors, (_HEIGHT,), taken, original.path if original else None)


def _draft_of_clouds(data: Path, config: Path, folders: Sequence[str]) -> Draft:
    names = lidar_names(folders)
    poses = poses_file(data)
    path = scalar(_relative(data, config))
    if poses is None:
        path += "\n  # TODO: poses: FILE\t# of the vehicle: TUM, CSV, KITTI or ego_pose.json"
    else:
        path += f"\n  poses: {scalar(_relative(poses, config))}\t# of the vehicle in the map"
    lidars = [
        lidar_text(name, folder, "its folder of clouds", None, "the clouds name no frames")
        for name, folder in names.items()
    ]
    text = align(
        TEMPLATE.format(
            format="clouds\t# folders of .bin or .pcd clouds, their times in the names",
            path=path,
            motion="",
            lidars="\n".join(lidars),
            reference=scalar(next(iter(names))),
            target=SEARCHED_TARGET_TEMPLATE,
            ground=ground_text(None),
        )
    )
    unknown = (*(() if poses else ("data.poses",)), _HEIGHT)
    return Draft(text, tuple(names), unknown, "")


def _draft_of_bag(data: Path, config: Path, urdf: Path | None) -> Draft:
    bag = Bag(data)
    frames = read_frames(bag, urdf)
    clouds = choose_lidar_topics(bag)
    motion = choose_motion_topics(bag)
    height = frames.height()
    lidars, found = _lidars_of_bag(bag, frames, clouds)
    mounts, unknown_mounts = _mounts_of_bag(bag, frames, motion)
    unknown = [*unknown_mounts, *([] if height else [_HEIGHT])]
    text = align(
        TEMPLATE.format(
            format="rosbag\t# a ROS 2 bag (folder, .mcap) or a ROS 1 .bag",
            path=scalar(_relative(data, config)),
            motion=_topics_text(bag, motion) + mounts,
            lidars=lidars,
            reference=scalar(next(iter(clouds.chosen))),
            target=SEARCHED_TARGET_TEMPLATE,
            ground=ground_text(height),
        )
    )
    taken = f"Initial guesses of {', '.join(found)} taken from {frames.source}" if found else ""
    return Draft(text, tuple(clouds.chosen), tuple(unknown), taken)


def _lidars_of_bag(bag: Bag, frames: Frames, clouds: LidarTopics) -> tuple[str, list[str]]:
    """The sections of the LiDARs, and the names of those with a guess."""
    lidars, found = [], []
    for name, topic in clouds.chosen.items():
        guess = frames.extrinsic(clouds.frame_ids[name], name)
        known = guess.T_vehicle_sensor is not None
        found += [name] * known
        kind = bag.topics[topic].type.rpartition("/")[2]
        note = f"{kind} in frame {clouds.frame_ids[name] or '(none)'}"
        numbers = guess.numbers() if known else None
        lidars.append(lidar_text(name, topic, note, numbers, guess.origin))
    lidars += [comment(f"  # not taken: {topic}, {why}") for topic, why in clouds.others.items()]
    return "\n".join(lidars), found


def _mounts_of_bag(bag: Bag, frames: Frames, motion: MotionTopics) -> tuple[str, list[str]]:
    """The sections of IMU and antenna, and the keys in them that are not known.

    What is not known is estimated: zeros would say that it is exactly zero.
    """
    sections, unknown = "", []
    if "imu" in motion.chosen:
        guess = frames.extrinsic(first_frame(bag, motion.chosen["imu"]) or "")
        known = guess.T_vehicle_sensor is not None
        xyz, rpy_deg = guess.numbers()
        sections += IMU_TEMPLATE.format(
            origin=comment(guess.origin if known else f"{TODO_POSE} ({guess.origin})"),
            xyz=yaml_list(xyz),
            rpy_deg=yaml_list(rpy_deg) if known else "null",
        )
        unknown += [] if known else ["imu.T_vehicle_imu"]
    if "gnss" in motion.chosen:
        guess = frames.extrinsic(first_frame(bag, motion.chosen["gnss"]) or "")
        known = guess.T_vehicle_sensor is not None
        todo = f"TODO: measure it ({guess.origin})"
        sections += GNSS_TEMPLATE.format(
            origin=comment(guess.origin if known else todo),
            arm=yaml_list(guess.numbers()[0]) if known else "null",
        )
        unknown += [] if known else ["gnss.lever_arm"]
    if "heading" in motion.chosen:
        sections += HEADING_TEMPLATE
        unknown += ["heading.yaw_deg"]
    if "twist" in motion.chosen and "imu" not in motion.chosen:
        sections += WHEELS_TEMPLATE
    return sections, unknown


def _topics_text(bag: Bag, motion: MotionTopics) -> str:
    lines = ["topics:\t# of the vehicle's motion: imu, gnss, twist and heading, or pose"]
    if not motion.chosen:
        lines = [
            "topics: {}\t# the bag has no motion data by its types: the LiDARs tell their motion",
            "\t# past walls and ground; S2V's x and y stay open. Else: imu, gnss, twist; or pose",
        ]
    for key, chosen in motion.chosen.items():
        lines.append(f"  {key}: {scalar(chosen)}\t# {bag.topics[chosen].type}")
    for key, others in motion.others.items():
        lines += [f"  # {key}: {scalar(o)}\t# fits, too: {bag.topics[o].type}" for o in others]
    return "\n".join(lines) + "\n\n"


def _relative(data: Path, config: Path) -> str:
    return os.path.relpath(data.resolve(), config.resolve().parent)
