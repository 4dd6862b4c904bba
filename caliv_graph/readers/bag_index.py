"""The first pass over a bag: all stamps and all motion data; of clouds only the header."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from caliv_graph.config.lidars import LidarConfig
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import IntArray
from caliv_graph.readers.bag import Bag, DamagedMessageError, Header, Topic
from caliv_graph.readers.clock import Clock, clock_warnings, effective_stamps, read_clock
from caliv_graph.readers.collectors import Collector
from caliv_graph.readers.definitions import WITHOUT_HEADER
from caliv_graph.readers.frames import TF_TYPES, clean_frame
from caliv_graph.readers.heading import HeadingCollector
from caliv_graph.readers.imu import ImuCollector
from caliv_graph.readers.motion import GnssCollector, TwistCollector
from caliv_graph.readers.navigation import COLLECTORS, own_stamp_ns
from caliv_graph.readers.poses import PoseCollector, TfCollector
from caliv_graph.readers.stamps import StampMark
from caliv_graph.readers.sweeps import Sample, is_sampled, mark_of

_COLLECTORS: Mapping[str, type[Collector]] = {
    "imu": ImuCollector,
    "gnss": GnssCollector,
    "twist": TwistCollector,
    "heading": HeadingCollector,
    "pose": PoseCollector,
}

_STATIC_TOPIC = "/tf_static"


@dataclass(frozen=True)
class ScanTimes:
    """When the clouds of a LiDAR were taken and recorded.

    Attributes:
        stamps_ns: (n,), ascending, each once.
        records_ns: (n,) record time of each.
    """

    stamps_ns: IntArray
    records_ns: IntArray

    def records(self, wanted: Container[int] | None = None) -> dict[int, int]:
        """Record time by stamp, in the order of the stamps; of all, or of those that are wanted."""
        both = zip(self.stamps_ns.tolist(), self.records_ns.tolist(), strict=True)
        return {stamp: record for stamp, record in both if wanted is None or stamp in wanted}


@dataclass(frozen=True)
class BagIndex:
    """The result of the first pass over a bag.

    Attributes:
        clocks: the stamps of each topic, summarised.
        frame_ids: the frame in the first header of each topic.
        scans: of each LiDAR's clouds.
        collectors: motion data by kind and topic, until they are taken.
        marks: what the stamps of each LiDAR mark.
        warnings: what is missing or damaged, a line each.
    """

    clocks: Mapping[str, Clock]
    frame_ids: Mapping[str, str]
    scans: Mapping[str, ScanTimes]
    collectors: dict[tuple[str, str], Collector]
    marks: Mapping[str, StampMark]
    warnings: tuple[str, ...]


@dataclass
class _Read:
    """What the pass has read so far, by topic: stamps of headers and of the record, samples."""

    header_ns: dict[str, array[int]]
    records_ns: dict[str, array[int]]
    samples: dict[str, list[Sample]]
    frame_ids: dict[str, str] = field(default_factory=dict)
    damaged: Counter[str] = field(default_factory=Counter)

    def add(self, topic: str, record_ns: int, header: Header, raw: bytes) -> None:
        """Counts a message in; a few clouds are kept as they are, for what their stamps mark."""
        self.frame_ids.setdefault(topic, clean_frame(header.frame_id))
        if topic in self.samples and is_sampled(len(self.header_ns[topic])):
            self.samples[topic].append(Sample(header.stamp_ns or record_ns, bytes(raw)))
        self.header_ns[topic].append(header.stamp_ns)
        self.records_ns[topic].append(record_ns)


def read_index(
    bag: Bag,
    lidars: Mapping[str, LidarConfig],
    lidar_topics: Mapping[str, Topic],
    motion_topics: Iterable[tuple[str, str]],
) -> BagIndex:
    """Reads a bag once.

    Args:
        bag: opened.
        lidars: the LiDARs of the config.
        lidar_topics: the topic of each LiDAR's clouds.
        motion_topics: kind and topic of the motion data.

    Raises:
        RecordingError: the bag is damaged.
    """
    collectors = {
        (kind, topic): _collector(kind, bag.topics[topic].type) for kind, topic in motion_topics
    }
    read = _read(bag, {topic.name for topic in lidar_topics.values()}, collectors)
    stamps: dict[str, tuple[IntArray, IntArray]] = {
        topic: (np.array(header_ns, np.int64), np.array(read.records_ns[topic], np.int64))
        for topic, header_ns in read.header_ns.items()
    }
    evenly = {
        topic for (_, topic), taking in collectors.items() if isinstance(taking, ImuCollector)
    }
    clocks = {topic: read_clock(*both, topic in evenly) for topic, both in stamps.items()}
    return BagIndex(
        clocks=clocks,
        frame_ids=read.frame_ids,
        scans={name: _by_stamp(*stamps[topic.name]) for name, topic in lidar_topics.items()},
        collectors=collectors,
        marks={
            name: mark_of(
                bag,
                topic,
                lidars[name].stamp,
                read.samples[topic.name],
                stamps[topic.name],
                clocks[topic.name].period_s,
            )
            for name, topic in lidar_topics.items()
        },
        warnings=_warnings(bag, read, clocks),
    )


def _read(
    bag: Bag, lidar_topics: set[str], collectors: Mapping[tuple[str, str], Collector]
) -> _Read:
    """One pass over the messages of these topics; the collectors take what is theirs."""
    taking: dict[str, list[Collector]] = {}
    for (_, topic), collector in collectors.items():
        taking.setdefault(topic, []).append(collector)
    topics = dict.fromkeys([*lidar_topics, *taking])
    read = _Read(
        header_ns={topic: array("q") for topic in topics},
        records_ns={topic: array("q") for topic in topics},
        samples={topic: [] for topic in lidar_topics},
    )
    trees = [c for c in collectors.values() if isinstance(c, TfCollector | PoseCollector)]
    also = {_STATIC_TOPIC} & set(bag.topics) if trees else set()
    for topic, record_ns, raw in bag.messages({*topics, *also}):
        try:
            message = bag.decode(topic, raw) if topic in taking or topic in also else None
            header = _header(bag, topic, record_ns, raw, message)
        except DamagedMessageError:
            read.damaged[topic] += 1
            continue
        if topic in also:
            for tree in trees:
                tree.add_static(message)
        if topic in topics:
            read.add(topic, record_ns, header, raw)
            for collector in taking.get(topic, ()):
                collector.add(header.stamp_ns or record_ns, message)
    return read


def _header(bag: Bag, topic: str, record_ns: int, raw: bytes, message: Any) -> Header:
    type_name = bag.topics[topic].type
    if type_name in WITHOUT_HEADER:
        return Header(own_stamp_ns(message, record_ns), "")
    if type_name not in TF_TYPES:
        return bag.header(raw)
    if not message.transforms:
        return Header(0, "")
    first = message.transforms[0].header
    stamp_ns = first.stamp.sec * NANOSECONDS_PER_SECOND + first.stamp.nanosec
    return Header(stamp_ns, first.frame_id)


def _warnings(bag: Bag, read: _Read, clocks: Mapping[str, Clock]) -> tuple[str, ...]:
    found = {topic: len(stamps) + read.damaged[topic] for topic, stamps in read.header_ns.items()}
    missing = [
        f"{bag.name}: {topic} should have {bag.topics[topic].messages} messages, "
        f"but {count} were found: the bag seems to be damaged"
        for topic, count in found.items()
        if count != bag.topics[topic].messages
    ]
    # A message of /tf has no stamp of its own, and its senders keep no common order.
    own = {t: c for t, c in clocks.items() if bag.topics[t].type not in TF_TYPES}
    damaged = [
        f"{bag.name}: {count} messages of {topic} are damaged and not used"
        for topic, count in read.damaged.items()
    ]
    return (*missing, *clock_warnings(bag.name, own), *damaged)


def _collector(kind: str, type_name: str) -> Collector:
    if type_name in TF_TYPES:
        return TfCollector()
    return COLLECTORS.get((kind, type_name), _COLLECTORS[kind])()


def _by_stamp(header_ns: IntArray, record_ns: IntArray) -> ScanTimes:
    """The clouds in the order of their stamps; of equal stamps the first recorded."""
    stamps, first = np.unique(effective_stamps(header_ns, record_ns), return_index=True)
    return ScanTimes(stamps, record_ns[first])
