"""Clouds of a bag, whatever their type, and what is known of the times of their points."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from caliv_graph.config.lidars import StampSetting
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import Array, IntArray
from caliv_graph.readers.bag import Bag, DamagedMessageError, Topic
from caliv_graph.readers.pointcloud2 import (
    LIVOX_TYPES,
    POINTCLOUD2,
    VELODYNE,
    DecodedCloud,
    TimeField,
    UnusableCloudsError,
    decode_livox,
    decode_pointcloud2,
    sweep_times,
)
from caliv_graph.readers.stamps import StampMark, stamp_mark, sweep_span
from caliv_graph.readers.velodyne_packets import decode_velodyne

_ANY_RANGE_M = 1e6
"""Farther than any return."""

_MOST_PERIODS = 2.5
"""Times between two clouds that the points of one may span. Two sweeps in a message span two, and
times that are a part of the sweep (0 to 1) five at 5 Hz."""

_LEAST_PERIODS = 0.01
"""The same, at least, where a LiDAR sweeps: microseconds taken for nanoseconds span 0.001."""

_SLOWEST_S = 0.2
"""Of a sweep. Clouds of a recorder that drops most of them come more rarely."""


@dataclass(frozen=True)
class TimesSeen:
    """The times of the points of one LiDAR, over the clouds decoded so far.

    Attributes:
        field: their source; None: there are none.
        first_s: earliest, seconds after the stamp.
        last_s: latest, seconds after the stamp.
        clouds: clouds that have them.
        problems: clouds whose times are not used.
        problem: the reason, of the first such cloud.
        packets: most packets of a cloud with which its times start anew; 0: they do not.
        span_s: most seconds from the first to the last point of a cloud.
    """

    field: TimeField | None = None
    first_s: float = 0.0
    last_s: float = 0.0
    clouds: int = 0
    problems: int = 0
    problem: str = ""
    packets: int = 0
    span_s: float = 0.0

    def with_cloud(self, cloud: DecodedCloud) -> TimesSeen:
        """With those of one more cloud."""
        times_s = cloud.times_s
        if cloud.time_problem:
            problem = self.problem or cloud.time_problem
            return replace(self, problems=self.problems + 1, problem=problem)
        if times_s is None or cloud.time_field is None or not len(times_s):
            return self
        first_s, last_s = float(times_s.min()), float(times_s.max())
        span_s = max(self.span_s, last_s - first_s)
        if self.field is not None:
            first_s, last_s = min(first_s, self.first_s), max(last_s, self.last_s)
        return replace(
            self,
            field=cloud.time_field,
            first_s=first_s,
            last_s=last_s,
            clouds=self.clouds + 1,
            packets=max(self.packets, cloud.packets),
            span_s=span_s,
        )


@dataclass(frozen=True)
class Sample:
    """A cloud that the first pass over the bag keeps, to look at its times."""

    stamp_ns: int
    raw: bytes


def is_sampled(number: int) -> bool:
    """Whether the first pass keeps the cloud of this number, from 0: 0, 1, 4, 16, 64, ...

    The number of clouds is not known before the pass ends, and a few are enough.
    """
    return number == 0 or (number & (number - 1) == 0 and number.bit_length() % 2 == 1)


def decode_cloud(
    bag: Bag,
    topic: Topic,
    raw: bytes,
    stamp_ns: int,
    ranges: tuple[float, float],
    period_s: float | None,
) -> DecodedCloud:
    """The returns within the ranges (metres, least and most) of a cloud of any type.

    `period_s` is the usual time between two clouds; None: not known.

    Raises:
        DamagedMessageError: the message is damaged.
        UnusableCloudsError: the clouds have no x, y, z.
    """
    if topic.type in LIVOX_TYPES:
        return decode_livox(raw, bag.is_ros1, stamp_ns, *ranges)
    if topic.type == VELODYNE:
        return decode_velodyne(bag.decode(topic.name, raw), stamp_ns, *ranges)
    return decode_pointcloud2(bag.decode(topic.name, raw), stamp_ns, *ranges, period_s)


def mark_of(
    bag: Bag,
    topic: Topic,
    setting: StampSetting,
    samples: Sequence[Sample],
    stamps: tuple[IntArray, IntArray],
    period_s: float | None,
) -> StampMark:
    """What the stamps of a LiDAR mark, by some of its clouds and by all record times.

    `stamps` are header stamps and record times (n,), nanoseconds; a stamp is 0 where it is not set.
    """
    clouds: list[DecodedCloud] = []
    for sample in samples:
        # A damaged one is reported where clouds are decoded.
        with suppress(DamagedMessageError, UnusableCloudsError):
            clouds.append(_times(bag, topic, sample, period_s))
    header_ns, record_ns = stamps
    is_set = header_ns != 0
    delays_s = (record_ns[is_set] - header_ns[is_set]) / NANOSECONDS_PER_SECOND
    return mark_of_clouds(setting, clouds, np.asarray(delays_s), period_s)


def mark_of_clouds(
    setting: StampSetting, clouds: Iterable[DecodedCloud], delays_s: Array, period_s: float | None
) -> StampMark:
    """What stamps mark, by the times of some clouds; the others as in `stamp_mark`.

    Times that span more than a sweep can take tell nothing, and are not to be used.
    """
    spans: list[tuple[float, float]] = []
    field: TimeField | None = None
    for cloud in clouds:
        if cloud.times_s is not None and len(cloud.times_s) and cloud.time_field:
            spans.append((float(cloud.times_s.min()), float(cloud.times_s.max())))
            field = cloud.time_field
    problem = "" if field is None else _span_problem(field, spans, period_s)
    if problem:
        return StampMark("end" if setting == "end" else "start", time_problem=problem)
    is_absolute = field is not None and field.unit.endswith("absolute")
    return stamp_mark(setting, sweep_span(spans, period_s), is_absolute, delays_s, period_s)


def _span_problem(
    field: TimeField, spans_s: Sequence[tuple[float, float]], period_s: float | None
) -> str:
    """Why the times of a LiDAR cannot be right, by those of the median cloud; empty: they may be.

    A single cloud may hold several sweeps.
    """
    span_s = float(np.median(np.diff(np.array(spans_s), axis=1)))
    if period_s is None or span_s <= _MOST_PERIODS * period_s:
        return ""
    return (
        f"{_shown(field)}, spans {span_s:.3g} s in a cloud, and a cloud comes every {period_s:.3g} "
        f"s: no sweep takes {span_s / period_s:.2g} times that. Perhaps it is a part of the sweep "
        "(0 to 1), or in another unit: convert the field, and give that recording"
    )


def with_mark(cloud: DecodedCloud, mark: StampMark) -> DecodedCloud:
    """A cloud whose times count from where they do by what the stamps mark.

    It is without times where those of its LiDAR cannot be right.
    """
    if cloud.times_s is None:
        return cloud
    if mark.time_problem:
        return DecodedCloud(cloud.points_lidar, None, time_problem=mark.time_problem)
    return replace(cloud, times_s=cloud.times_s + mark.shift_s)


def _times(bag: Bag, topic: Topic, sample: Sample, period_s: float | None) -> DecodedCloud:
    if topic.type != POINTCLOUD2:
        return decode_cloud(bag, topic, sample.raw, sample.stamp_ns, (0.0, _ANY_RANGE_M), period_s)
    return sweep_times(bag.decode(topic.name, sample.raw), sample.stamp_ns, period_s)


def times_warnings(
    where: str, times: TimesSeen, mark: StampMark, period_s: float | None
) -> list[str]:
    """Warnings about the times of one LiDAR, `where` being its bag and name, a line each."""
    lines = []
    if times.problems:
        lines.append(
            f"{where}: the times of the points of {times.problems} clouds are not used: "
            f"{times.problem}"
        )
    elif times.field and times.first_s == times.last_s == 0.0:
        lines.append(
            f"{where}: field '{times.field.name}' is 0 for all points: its clouds carry no times"
        )
    elif times.field and period_s and 0.0 < times.span_s < _least_span_s(period_s):
        lines.append(
            f"{where}: {_shown(times.field)}, spans {times.span_s:.2g} s in a cloud, and a cloud "
            f"comes every {period_s:.3g} s. If its points are not taken at once, the field is in "
            "another unit, and the motion in a sweep is not compensated: convert the field, and "
            "give that recording"
        )
    if times.packets and times.field and period_s:
        lines.append(
            f"{where}: field '{times.field.name}' starts anew with every packet, "
            f"{times.packets} times a cloud. The times are continued by azimuth, at "
            f"{1.0 / period_s:.3g} turns per second"
        )
    if mark.note:
        lines.append(f"{where}: {mark.note}")
    return lines


def untimed_warning(where: str, seen: Mapping[str, TimesSeen]) -> list[str]:
    """A line if some LiDARs of a recording, of those that were read, have times and others not."""
    timed = [f"'{name}'" for name, times in seen.items() if times.field and times.span_s > 0.0]
    without = [f"'{name}'" for name, times in seen.items() if times.field is None]
    if not timed or not without:
        return []
    return [
        f"{where}: points of {' and '.join(without)} have no times, those of {' and '.join(timed)} "
        "have. All points of a cloud without times are taken at its stamp: unless it is motion-"
        "compensated to that, or taken at once, walls and clocks contradict those of the others. "
        "Let the driver write the time of every point"
    ]


def _least_span_s(period_s: float) -> float:
    return _LEAST_PERIODS * min(period_s, _SLOWEST_S)


def _shown(field: TimeField) -> str:
    return f"field '{field.name}' ({field.type}), read as {field.unit}"
