"""The sensors of a recording, found without a config."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from caliv_graph.common.inputs import unreadable
from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.load import read_yaml
from caliv_graph.config.model import TopicsConfig
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.errors import RecordingError
from caliv_graph.products import Recording
from caliv_graph.readers.caliv_folder import POSES_FILE, CalivFolder

if TYPE_CHECKING:
    from caliv_graph.readers.bag import Bag, Topic

_ANY_RANGE_M = 1e6
"""Farther than any return: no point is dropped for its range."""

_GENERIC = re.compile(
    r"lidars?|sensing|sensors?|points?|raw|clouds?|pointclouds?|pointcloud2|packets|driver\d?|scan|"
    r"data|ros"
)
"""Words in the names of topics that do not distinguish LiDARs."""

_DERIVED = re.compile(
    r"map|radar|camera|depth|ground|filter|crop|downsampl|concat|fused|merged|obstacle|cluster|"
    r"segment|deskew|undistort|rectif|corrected|aligned|registered|accumul|debug|freespace|free_space"
)
"""Words in the names of clouds that are not the raw cloud of one LiDAR."""

_SECONDARY = re.compile(r"raw|livox|ouster|os_cloud|os\d|velodyne|camera|realsense|zed|mag|cmd")
"""Words in the names of topics that are probably not the vehicle's own IMU, velocity or pose."""


_HEADING = re.compile(r"heading|hdt|hehdt|azimuth|dual")
"""Words in the names of topics that hold the heading of two antennas."""

_ODOMETRY = "nav_msgs/msg/Odometry"


@dataclass(frozen=True)
class MotionTopics:
    """Topics of a bag with the vehicle's motion.

    Attributes:
        chosen: by key of `topics` in the config: imu, gnss, twist, heading, pose.
        others: further topics that fit, by the same keys.
    """

    chosen: Mapping[str, str]
    others: Mapping[str, tuple[str, ...]]


@dataclass(frozen=True)
class LidarTopics:
    """Topics of clouds of a bag.

    Attributes:
        chosen: topic by a name made from it.
        frame_ids: frame of the first cloud, by that name.
        others: topics of clouds that are probably derived or repeated, and why.
    """

    chosen: Mapping[str, str]
    frame_ids: Mapping[str, str]
    others: Mapping[str, str]


def drive_folder(path: Path) -> Path:
    """The folder of a CaLiV drive that holds the poses and a folder of clouds per sensor.

    Raises:
        RecordingError: the path is missing, or neither that folder nor the one around it.
    """
    # Without LiDARs this checks the poses alone.
    CalivFolder(path, {})
    return path / "input" if (path / "input" / POSES_FILE).is_file() else path


def recorded_sensors(path: Path) -> tuple[str, ...]:
    """Sensors of a CaLiV drive that have poses, in the order of their numbers.

    Raises:
        RecordingError: the path is missing, or no CaLiV folder.
    """
    listed = read_yaml(drive_folder(path) / POSES_FILE, RecordingError)
    return tuple(sorted((str(sensor) for sensor in listed), key=_by_number))


def is_recorded_bag(path: Path) -> bool:
    """Whether a drive is a bag rather than folders of clouds.

    Raises:
        RecordingError: it is neither, or missing.
    """
    from caliv_graph.readers.bag import is_bag

    try:
        if path.exists() and is_bag(path):
            return True
        if _is_caliv_folder(path) or folders_of_clouds(path):
            return False
        raise RecordingError(f"{path}: {_no_drive(path)}")
    except OSError as e:
        raise RecordingError(f"{path}: {unreadable(e)}") from None
    except ValueError as e:
        raise RecordingError(f"{path}: cannot be read: {e}. Check the path") from None


def _is_caliv_folder(path: Path) -> bool:
    return (path / "input" / POSES_FILE).is_file() or (path / POSES_FILE).is_file()


def _no_drive(path: Path) -> str:
    """Why a path is no drive, and what to give instead."""
    from caliv_graph.readers.bag import BAG_SUFFIXES, is_bag

    bag = f"a bag ({', '.join(BAG_SUFFIXES)}, or the folder of one)"
    if not path.exists():
        return f"no such file or folder. Give {bag}, or a CaLiV folder with input/{POSES_FILE}"
    if path.suffix in (".yaml", ".yml") and path.is_file():
        return (
            "is a YAML file, not a drive. Give the drive itself, which data.path of a config names"
        )
    if not path.is_dir():
        return f"is not {bag}. Unpack it first if it is packed"
    inside = [
        entry
        for entry in sorted(path.iterdir())
        if entry.is_dir() and (is_bag(entry) or _is_caliv_folder(entry) or folders_of_clouds(entry))
    ]
    if inside:
        return f"is not a drive, but holds drives. Give {' or '.join(map(str, inside[:3]))}"
    return (
        f"holds neither {bag} nor input/{POSES_FILE}, the vehicle's pose of each cloud of a CaLiV "
        "folder. Give the folder of a drive"
    )


def folders_of_clouds(path: Path) -> tuple[str, ...]:
    """The folders of .bin clouds in a folder that is neither a bag nor a CaLiV folder."""
    from caliv_graph.readers.cloud_folder import cloud_folders

    if not path.is_dir() or any((path / f / POSES_FILE).is_file() for f in (".", "input")):
        return ()
    return cloud_folders(path)


def open_all(path: Path) -> Recording:
    """Opens a drive with all its LiDARs, each by its own name, and all ranges.

    Of a bag, all topics of motion data are read.

    Raises:
        RecordingError: the path is missing, no recording, or incomplete.
    """
    if not is_recorded_bag(path):
        folders = folders_of_clouds(path)
        if folders:
            from caliv_graph.readers.cloud_folder import CloudFolder

            names = lidar_names(folders)
            return CloudFolder(path, {name: _any_lidar(topic) for name, topic in names.items()})
        return CalivFolder(path, {sensor: _any_lidar(sensor) for sensor in recorded_sensors(path)})
    from caliv_graph.readers.bag import Bag
    from caliv_graph.readers.motion import MOTION_TYPES
    from caliv_graph.readers.pointcloud2 import CLOUD_TYPES
    from caliv_graph.readers.rosbag import RosbagRecording

    bag = Bag(path)
    filled = [topic for topic in bag.topics.values() if topic.messages]
    names = lidar_names(topic.name for topic in filled if topic.type in CLOUD_TYPES)
    motion = {kind_type for types in MOTION_TYPES.values() for kind_type in types}
    return RosbagRecording(
        path,
        {name: _any_lidar(topic) for name, topic in names.items()},
        TopicsConfig(**choose_motion_topics(bag).chosen),
        also=[t.name for t in filled if t.type in motion and not t.name.endswith("/tf_static")],
    )


def lidar_names(topics: Iterable[str]) -> dict[str, str]:
    """Names LiDARs after the parts of their topics that differ; topic by name.

    `/lidar/front/points` and `/lidar/rear/points` become `front` and `rear`.
    """
    topics = list(topics)
    words = {topic: _words(topic) for topic in topics}
    common = set.intersection(*map(set, words.values())) if len(words) > 1 else set()
    names: dict[str, str] = {}
    for topic in topics:
        distinct = [word for word in words[topic] if word not in common] or words[topic]
        stem = "_".join(distinct) or "lidar"
        name, number = stem, 2
        while name in names:
            name, number = f"{stem}_{number}", number + 1
        names[name] = topic
    return names


def choose_lidar_topics(bag: Bag) -> LidarTopics:
    """Topics of a bag that are likely to be the LiDARs' own clouds.

    Raises:
        RecordingError: the bag is damaged, or has no clouds.
    """
    from caliv_graph.readers.pointcloud2 import CLOUD_TYPES, POINTCLOUD2, VELODYNE, packets_hint

    frames: dict[str, str] = {}
    for topic in bag.topics.values():
        frame = first_frame(bag, topic.name) if topic.type in CLOUD_TYPES else None
        if frame is not None:
            frames[topic.name] = frame
    if not frames:
        shown = ", ".join(f"{topic.name} ({topic.type})" for topic in bag.topics.values())
        for topic in bag.topics.values():
            if hint := packets_hint(topic.type):
                raise RecordingError(f"{bag.name}: topic '{topic.name}': {hint}")
        raise RecordingError(
            f"{bag.name}: has no clouds ({', '.join(CLOUD_TYPES)}). It has: {shown or 'nothing'}. "
            "Record the topics of the LiDARs"
        )
    others: dict[str, str] = {}
    own = [topic for topic in frames if not _DERIVED.search(topic.lower())]
    others.update({topic: "by its name made from others" for topic in frames if topic not in own})
    if not own:
        own, others = list(frames), {}
    # Packets beside the cloud that was made from them. An unknown frame tells nothing.
    made = {frames[name] for name in own if bag.topics[name].type == POINTCLOUD2} - {""}
    for name in own:
        if bag.topics[name].type == VELODYNE and frames[name] in made:
            others[name] = "packets of a cloud that is there"
    own = [name for name in own if name not in others]
    # /points_without_body repeats /points if the frame is the same. An equal frame alone proves
    # nothing: drivers are often started twice with the same frame.
    for name in list(own):
        plain = next(
            (p for p in own if p != name and name.startswith(p) and frames[p] == frames[name]), None
        )
        if plain is not None:
            others[name] = f"of the same frame as {plain}"
    own = [name for name in own if name not in others]
    names = lidar_names(own)
    return LidarTopics(names, {name: frames[topic] for name, topic in names.items()}, others)


def first_frame(bag: Bag, topic: str) -> str | None:
    """The frame of the first message of a topic; empty: it is damaged; None: there is none."""
    from caliv_graph.readers.bag import DamagedMessageError
    from caliv_graph.readers.definitions import WITHOUT_HEADER
    from caliv_graph.readers.frames import clean_frame

    if bag.topics[topic].type in WITHOUT_HEADER:
        return ""
    raw = bag.first_message(topic)
    try:
        return None if raw is None else clean_frame(bag.header(raw).frame_id)
    except DamagedMessageError:
        return ""


def choose_motion_topics(bag: Bag) -> MotionTopics:
    """The topics of a bag that are probably the best for the vehicle's motion.

    IMU and GNSS with a velocity if there are both; else poses, but for those of wheels, which drift
    away: GNSS and the velocity of the wheels are better.

    Raises:
        RecordingError: the bag is damaged.
    """
    from caliv_graph.readers.motion import MOTION_TYPES

    ranked = {}
    for kind, types in MOTION_TYPES.items():
        fitting = [t for t in bag.topics.values() if t.type in types and t.messages]
        # A command is not a measurement, and a static link is not a pose of the vehicle.
        fitting = [t for t in fitting if "cmd" not in t.name and not t.name.endswith("/tf_static")]
        if kind == "heading":
            # Headings also come as Imu: of an Imu by its name.
            fitting = [t for t in bag.topics.values() if t.messages and _is_heading(t)]
        elif kind == "imu":
            fitting = [t for t in fitting if not _is_heading(t)]
        fitting.sort(
            key=lambda t: (
                bool(_SECONDARY.search(t.name.lower())),
                types.index(t.type) if t.type in types else len(types),
                -t.messages,
                t.name,
            )
        )
        ranked[kind] = [t.name for t in fitting]
    # Transforms without a vehicle frame hold no pose of the vehicle.
    ranked["pose"] = [name for name in ranked["pose"] if _has_poses(bag, name)]
    ranked["pose"].sort(key=lambda name: _drifts(bag, name))
    if not ranked["imu"]:
        # Wheels tell a yaw rate; another twist may be that of a GNSS receiver, in map axes.
        ranked["twist"].sort(key=lambda name: bag.topics[name].type != _ODOMETRY)
    drifting = all(_drifts(bag, name) for name in ranked["pose"])
    raw = ["imu", "gnss", "twist", "heading"]
    if ranked["pose"] and not (
        ranked["gnss"] and (ranked["imu"] or (ranked["twist"] and drifting))
    ):
        keys = ["pose"]
    else:
        keys = raw
    chosen = {key: ranked[key][0] for key in keys if ranked[key]}
    others = {
        kind: tuple(name for name in names if chosen.get(kind) != name)
        for kind, names in ranked.items()
    }
    return MotionTopics(chosen, others)


def _is_heading(topic: Topic) -> bool:
    """Whether a topic has the heading of two antennas, by its type and name."""
    from caliv_graph.readers.heading import IMU, QUATERNION

    return topic.type in (QUATERNION, IMU) and bool(_HEADING.search(topic.name.lower()))


def _drifts(bag: Bag, topic: str) -> bool:
    """Whether poses are those of an odometry: by REP 105 they drift in the frame `odom`."""
    from caliv_graph.readers.frames import TF_TYPES

    if bag.topics[topic].type in TF_TYPES:
        return False
    return (first_frame(bag, topic) or "").rpartition("/")[2] == "odom"


def _has_poses(bag: Bag, topic: str) -> bool:
    """Whether a topic holds poses of the vehicle: a topic of transforms need not."""
    from caliv_graph.readers.bag import DamagedMessageError
    from caliv_graph.readers.frames import TF_TYPES, VEHICLE_FRAMES, message_transforms

    if bag.topics[topic].type not in TF_TYPES:
        return True
    for count, (_, _, raw) in enumerate(bag.messages([topic])):
        try:
            links = [link for _, link in message_transforms(bag.decode(topic, raw))]
        except DamagedMessageError:
            continue
        if any(link.child in VEHICLE_FRAMES for link in links):
            return True
        if count > 200:  # a few seconds: a sender of the vehicle's pose has begun by then
            break
    return False


def _any_lidar(topic: str) -> LidarConfig:
    return LidarConfig(
        topic=topic,
        initial=PoseConfig(xyz=(0.0, 0.0, 0.0)),
        min_range=0.0,
        max_range=_ANY_RANGE_M,
    )


def _words(topic: str) -> list[str]:
    """The parts of a topic's name that may distinguish LiDARs."""
    found = []
    for part in topic.split("/"):
        kept = [word for word in part.split("_") if word and not _GENERIC.fullmatch(word.lower())]
        if kept:
            found.append(re.sub(r"\W", "_", "_".join(kept)))
    return found


def _by_number(sensor: str) -> tuple[str, int]:
    """Puts sensor_10 after sensor_9."""
    stem = sensor.rstrip("0123456789")
    return stem, int(sensor[len(stem) :] or 0)
