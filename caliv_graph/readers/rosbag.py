"""Reading a bag as a drive (`products.Recording`): clouds of the LiDARs, and the motion data.

One pass over the bag reads all stamps and all motion data; of clouds only the header. Clouds are
decoded in `scans`, only those that are wanted, and only from the parts of the bag that hold them.
"""

from __future__ import annotations

import difflib
import textwrap
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.model import PoseAxes, TopicsConfig
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import RecordingError
from caliv_graph.products import GivenPoses, LidarScan, MotionData
from caliv_graph.readers.ahead import worked_ahead
from caliv_graph.readers.bag import Bag, DamagedMessageError, Topic
from caliv_graph.readers.bag_clouds import wanted_clouds
from caliv_graph.readers.bag_index import BagIndex, read_index
from caliv_graph.readers.clock import Clock
from caliv_graph.readers.imu import ImuCheck, ImuCollector, check_imu
from caliv_graph.readers.motion import MOTION_TYPES, ON_REQUEST, GnssCollector
from caliv_graph.readers.pointcloud2 import (
    CLOUD_TYPES,
    DecodedCloud,
    UnusableCloudsError,
    packets_hint,
)
from caliv_graph.readers.pose_file import check_overlap, in_vehicle_axes, read_poses
from caliv_graph.readers.pose_frame import frame_sentence
from caliv_graph.readers.stamps import StampMark
from caliv_graph.readers.sweeps import (
    TimesSeen,
    decode_cloud,
    times_warnings,
    untimed_warning,
    with_mark,
)

_KINDS = {
    "imu": "IMU",
    "gnss": "GNSS receiver",
    "twist": "velocity",
    "heading": "heading",
    "pose": "pose of the vehicle",
}

_LONG_GAP_S = {"imu": 0.1, "gnss": 2.0, "twist": 1.0, "heading": 2.0, "pose": 1.0}
"""Seconds without a message from which there is a warning. Integration over a gap of an IMU soon
drifts."""


class RosbagRecording:
    """A drive in a bag (products.Recording)."""

    def __init__(
        self,
        path: Path,
        lidars: Mapping[str, LidarConfig],
        topics: TopicsConfig,
        also: Iterable[str] = (),
        poses: Path | None = None,
        pose_axes: PoseAxes = "flu",
    ) -> None:
        """Opens the bag and checks that it has the topics; reads its index only.

        `also` names further topics of motion data to look at, which `motion` does not use; `poses`
        a file with the vehicle's poses; `pose_axes` are the axes of poses.

        Raises:
            RecordingError: the bag is missing or damaged; a topic is missing, of the wrong type, or
                has no clouds.
        """
        self._bag = Bag(path)
        self._lidars = dict(lidars)
        self._topics: dict[str, Topic] = {}
        self._warnings: list[str] = []
        for name, lidar in self._lidars.items():
            topic = self._topic(lidar.topic, f"lidars.{name}.topic", "LiDAR clouds", CLOUD_TYPES)
            if not topic.messages:
                raise RecordingError(
                    f"{path}: topic '{topic.name}' (LiDAR '{name}') has no clouds. Record it, or "
                    "take the LiDAR out of the config"
                )
            self._topics[name] = topic
        self._used: dict[str, str] = {
            kind: self._topic(
                topic,
                f"topics.{kind}",
                _KINDS[kind],
                (*MOTION_TYPES[kind], *ON_REQUEST.get(kind, ())),
            ).name
            for kind, topic in topics.model_dump().items()
            if topic is not None
        }
        self._motion_topics = dict.fromkeys(self._used.items())
        for name in also:
            for kind, types in MOTION_TYPES.items():
                if self._bag.topics[name].type in types:
                    self._motion_topics.setdefault((kind, name))
        self._poses, self._pose_axes = poses, pose_axes
        self._motion: MotionData | None = None
        self._fixes: dict[str, int] = {}
        self._times: dict[str, TimesSeen] = {name: TimesSeen() for name in self._lidars}
        self._damaged_clouds: dict[str, set[int]] = {name: set() for name in self._lidars}
        self._damage = ""
        self._looked_at: dict[str, set[int]] = {name: set() for name in self._lidars}

    @property
    def name(self) -> str:
        """The path as given."""
        return self._bag.name

    @property
    def lidars(self) -> tuple[str, ...]:
        """LiDARs of the config, in the config's order."""
        return tuple(self._lidars)

    @property
    def topics(self) -> Mapping[str, Topic]:
        """All topics of the bag by name."""
        return self._bag.topics

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last record time of the bag, nanoseconds."""
        return self._bag.span_ns

    def lidar_topic(self, lidar: str) -> str:
        """The topic of the clouds of a LiDAR."""
        return self._topics[lidar].name

    def clocks(self) -> Mapping[str, Clock]:
        """The stamps of each topic that was read, summarised."""
        return self._index.clocks

    def frame_ids(self) -> Mapping[str, str]:
        """The frame in the header of the first message of each topic that was read."""
        return self._index.frame_ids

    def times_seen(self, lidar: str) -> TimesSeen:
        """The times of the points in the clouds decoded so far."""
        return self._times[lidar]

    def stamp_mark(self, lidar: str) -> StampMark:
        """What the stamps of a LiDAR mark."""
        return self._index.marks[lidar]

    def imu_checks(self) -> Mapping[str, ImuCheck]:
        """The units of each IMU that has samples, by topic."""
        found = {}
        for kind, topic in self._motion_topics:
            collector = self._index.collectors.get((kind, topic))
            if collector is None and kind == "imu" and self._motion is not None:
                samples = self._motion.imu
            else:
                samples = collector.finish() if isinstance(collector, ImuCollector) else None
            if samples is not None:
                found[topic] = check_imu(samples)
        return found

    def gnss_fixes(self) -> Mapping[str, int]:
        """Messages with a fix of each GNSS receiver, by topic."""
        return self._fixes | {
            topic: collector.fixes
            for (_, topic), collector in self._index.collectors.items()
            if isinstance(collector, GnssCollector)
        }

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        """Stamps of the clouds of one LiDAR, ascending, each once.

        Raises:
            RecordingError: the bag is damaged.
        """
        stamps: list[int] = self._index.scans[lidar].stamps_ns.tolist()
        return stamps

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        """The clouds of one LiDAR in the order of their stamps, a few decoded ahead (`Recording`).

        A damaged cloud is left out and counted in `warnings`.

        Raises:
            RecordingError: the bag is damaged, or the clouds have no x, y, z.
        """
        topic = self._topics[lidar].name
        records_ns = self._index.scans[lidar].records(wanted)
        clouds = wanted_clouds(self._bag, topic, records_ns)
        found = ((lidar, stamp_ns, raw) for stamp_ns, raw in clouds)
        for decoded in worked_ahead(self._decoded, found):
            scan = self._scan(lidar, *decoded)
            del decoded  # not kept alive while the next one is read
            if scan is not None:
                yield scan
            del scan

    def motion(self) -> MotionData:
        """The motion data of the topics that the config names.

        Raises:
            RecordingError: the bag is damaged; the specific force of the IMU is not in m/s^2, or
                gravity was removed from it; the file of poses is damaged or of another time.
        """
        if self._motion is None:
            self._motion = self._read_motion()
        return self._motion

    def warnings(self) -> Sequence[str]:
        """What was left out so far and why, one line each."""
        # Each once: a cloud that was requested twice was read twice.
        return list(dict.fromkeys([*self._warnings, *self._cloud_warnings()]))

    def _topic(self, name: str, key: str, what: str, types: Sequence[str]) -> Topic:
        """The topic of the bag that a key of the config names; RecordingError: none that fits."""
        there = self._bag.topics
        fitting = [topic.name for topic in there.values() if topic.type in types]
        topic = there.get(name) or there.get(f"/{name.strip('/')}")
        will_do = (
            f"Topics that fit: {_enumerate(fitting)}"
            if fitting
            else f"No topic of the bag fits: record one, or leave {key} out"
        )
        if topic is None:
            near = difflib.get_close_matches(name, fitting or list(there), n=1, cutoff=0.5)
            hint = f"Did you mean '{near[0]}'? " if near else ""
            raise RecordingError(
                f"{self._bag.name}: has no topic '{name}' ({key}). {hint}{will_do}"
            )
        hint = packets_hint(topic.type)
        if hint and topic.type not in types:
            raise RecordingError(f"{self._bag.name}: topic '{name}' ({key}): {hint}. {will_do}")
        if topic.type not in types:
            raise RecordingError(
                f"{self._bag.name}: topic '{name}' ({key}) is of type {topic.type}; for "
                f"{what} it takes {', '.join(types)}. {will_do}"
            )
        return topic

    @cached_property
    def _index(self) -> BagIndex:
        index = read_index(self._bag, self._lidars, self._topics, self._motion_topics)
        self._warnings += index.warnings
        return index

    def _read_motion(self) -> MotionData:
        index = self._index
        found: dict[str, Any] = {}
        for kind, topic in self._used.items():
            collector: Any = index.collectors[kind, topic]
            found[kind] = collector.finish()
            where = f"{self._bag.name}: topics.{kind} '{topic}'"
            self._warnings += [f"{where}: {note}" for note in collector.notes()]
            gaps_s = [(b - a) / NANOSECONDS_PER_SECOND for a, b in index.clocks[topic].gaps]
            long_s = [gap_s for gap_s in gaps_s if gap_s > _LONG_GAP_S[kind]]
            if long_s:
                self._warnings.append(
                    f"{where}: {len(long_s)} gaps longer than {_LONG_GAP_S[kind]:g} s, the longest "
                    f"{max(long_s):.3g} s"
                )
            if found[kind] is None:
                self._warnings.append(f"{where}: holds nothing that can be used")
        if self._poses is not None:
            found["pose"] = read_poses(self._poses)
            # Record times are of the recorder's clock, poses of that of the stamps.
            stamps = [scans.stamps_ns for scans in index.scans.values() if len(scans.stamps_ns)]
            if stamps:
                span_ns = int(min(s[0] for s in stamps)), int(max(s[-1] for s in stamps))
                check_overlap(found["pose"], self._poses, span_ns, self._bag.name)
        if found.get("pose") is not None:
            found["pose"] = in_vehicle_axes(found["pose"], self._pose_axes)
            self._warnings += self._elsewhere(found["pose"])
        motion = MotionData(
            self._bag.name,
            poses=found.get("pose"),
            imu=found.get("imu"),
            gnss=found.get("gnss"),
            twist=found.get("twist"),
            heading=found.get("heading"),
        )
        if motion.imu is not None:
            where = f"{self._bag.name}: topics.imu '{self._used['imu']}'"
            check = check_imu(motion.imu)
            if check.gravity_problem:
                raise RecordingError(
                    f"{where}: {check.gravity_problem}, or take the IMU out of the config"
                )
            if check.rate_problem:
                self._warnings.append(f"{where}: {check.rate_problem}")
        for kind, topic in self._used.items():
            # The collector has all that it took once more.
            taken = index.collectors.pop((kind, topic))
            if isinstance(taken, GnssCollector):
                self._fixes[topic] = 0 if motion.gnss is None else len(motion.gnss.stamps_ns)
        return motion

    def _elsewhere(self, poses: GivenPoses) -> list[str]:
        """A line if the poses of the topic are of another frame than the vehicle's."""
        said = "" if poses.frame is None else frame_sentence(poses.frame)
        return [f"{self._bag.name}: topics.pose '{self._used['pose']}': {said}"] if said else []

    def _decoded(self, found: tuple[str, int, bytes]) -> tuple[int, DecodedCloud | str]:
        """Stamp and cloud, or the problem of its message. Changes no state: it runs in a thread."""
        lidar, stamp_ns, raw = found
        config = self._lidars[lidar]
        topic = self._topics[lidar]
        ranges = (config.min_range, config.max_range)
        period_s = self._index.clocks[topic.name].period_s
        try:
            cloud = decode_cloud(self._bag, topic, raw, stamp_ns, ranges, period_s)
        except UnusableCloudsError as e:
            raise RecordingError(
                f"{self._bag.name}: clouds of {self._source(lidar, stamp_ns)}: {e}. Set "
                f"lidars.{lidar}.topic to clouds with coordinates"
            ) from None
        except DamagedMessageError as e:
            return stamp_ns, str(e)
        return stamp_ns, with_mark(cloud, self._index.marks[lidar])

    def _source(self, lidar: str, stamp_ns: int) -> str:
        return f"{self._topics[lidar].name} at {_seconds(stamp_ns)} s"

    def _scan(self, lidar: str, stamp_ns: int, cloud: DecodedCloud | str) -> LidarScan | None:
        """The scan of a decoded cloud; counts what `warnings` reports of it."""
        source = self._source(lidar, stamp_ns)
        if isinstance(cloud, str):
            self._damage = self._damage or f"{source} {cloud}"
            self._damaged_clouds[lidar].add(stamp_ns)
            return None
        if stamp_ns not in self._looked_at[lidar]:
            self._looked_at[lidar].add(stamp_ns)
            self._times[lidar] = self._times[lidar].with_cloud(cloud)
        return LidarScan(
            lidar=lidar,
            stamp_ns=stamp_ns,
            points_lidar=cloud.points_lidar,
            source=f"{self._bag.name}: {source}",
            point_times_s=None if self._lidars[lidar].deskewed is True else cloud.times_s,
        )

    def _cloud_warnings(self) -> list[str]:
        lines = []
        for lidar, damaged in self._damaged_clouds.items():
            if damaged:
                lines.append(
                    f"{self._bag.name}: {len(damaged)} clouds of LiDAR '{lidar}' are damaged and "
                    f"not used; {self._damage}"
                )
        for lidar, times in self._times.items():
            if times.clouds or times.problems:
                period_s = self._index.clocks[self._topics[lidar].name].period_s
                where = f"{self._bag.name}: LiDAR '{lidar}'"
                lines += times_warnings(where, times, self._index.marks[lidar], period_s)
        read = {lidar: times for lidar, times in self._times.items() if self._looked_at[lidar]}
        return lines + untimed_warning(self._bag.name, read)


def _seconds(stamp_ns: int) -> str:
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS_PER_SECOND)
    return f"{seconds}.{nanoseconds:09d}"


def _enumerate(names: Iterable[str]) -> str:
    return textwrap.shorten(", ".join(names), 300, placeholder=" ...")
