"""Stamps of a topic against the time of its recording, and against each other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import IntArray
from caliv_graph.readers.even_stamps import even_stamps

_FAR_S = 1.0
"""Seconds between header stamps and record times, from which there is a warning: in a drive of one
computer they differ by the transport, which takes milliseconds."""

_ALIKE_S = 0.5
"""Seconds within which offsets of several topics count as equal: transport takes less."""

_GAP_FACTOR = 1.75
"""An interval of more than so many usual ones is a gap: one lost message makes it two."""

_PART_S, _PART_PERIODS = 3.0, 5.0
"""Seconds, and usual intervals, that a topic may begin after or end before the others: recorders
find topics one after the other, in a second or two."""

TAI_UTC_S = 37.0
"""TAI minus UTC since 2017: the offset of a LiDAR on PTP from a computer on NTP."""


@dataclass(frozen=True)
class Clock:
    """The stamps of one topic.

    Attributes:
        messages: how many there are.
        first_ns: earliest stamp; 0 if there are no messages.
        last_ns: latest stamp; 0 if there are no messages.
        rate_hz: of the median interval; None if there are fewer than two different stamps.
        gaps: (before, after) stamps around each gap, nanoseconds.
        unset: messages without a stamp; their record time is used.
        backwards: messages with an earlier stamp than the message recorded before them.
        duplicates: messages with the stamp of another message.
        offset_s: (min, median, max) of header stamp minus record time; None without stamps.
    """

    messages: int
    first_ns: int
    last_ns: int
    rate_hz: float | None
    gaps: tuple[tuple[int, int], ...]
    unset: int
    backwards: int
    duplicates: int
    offset_s: tuple[float, float, float] | None

    @property
    def period_s(self) -> float | None:
        """The median interval; None if there are fewer than two different stamps."""
        return None if self.rate_hz is None else 1.0 / self.rate_hz


def effective_stamps(header_ns: IntArray, record_ns: IntArray) -> IntArray:
    """Header stamps (n,), or the record time where a header has none."""
    return np.where(header_ns == 0, record_ns, header_ns)


def read_clock(header_ns: IntArray, record_ns: IntArray, evenly: bool = False) -> Clock:
    """Summarises the stamps (n,) of a topic, in the order of the recording.

    A header stamp is 0 where it is not set. Of a sensor that samples `evenly` those of the arrival
    are replaced (`even_stamps`).
    """
    stamps_ns = effective_stamps(header_ns, record_ns)
    even = even_stamps(stamps_ns) if evenly else None
    distinct = np.unique(stamps_ns) if even is None else even.stamps_ns
    steps = np.diff(distinct)
    usual = float(np.median(steps)) if len(steps) else 0.0
    gaps = np.flatnonzero(steps > _GAP_FACTOR * usual)
    is_set = header_ns != 0
    offsets_s = (header_ns[is_set] - record_ns[is_set]) / NANOSECONDS_PER_SECOND
    offset_s = None
    if len(offsets_s):
        median = float(np.median(offsets_s))
        offset_s = (float(offsets_s.min()), median, float(offsets_s.max()))
    return Clock(
        messages=len(stamps_ns),
        first_ns=int(distinct[0]) if len(distinct) else 0,
        last_ns=int(distinct[-1]) if len(distinct) else 0,
        rate_hz=NANOSECONDS_PER_SECOND / usual if len(steps) else None,
        gaps=tuple((int(distinct[i]), int(distinct[i + 1])) for i in gaps),
        unset=int(np.count_nonzero(~is_set)),
        backwards=int(np.count_nonzero(np.diff(stamps_ns) < 0)),
        duplicates=len(stamps_ns) - len(distinct),
        offset_s=offset_s,
    )


def clock_warnings(name: str, clocks: Mapping[str, Clock]) -> list[str]:
    """Warnings about the stamps of some topics of the bag `name`, one line each."""
    return [
        *_offset_warnings(name, clocks),
        *_order_warnings(name, clocks),
        *_part_warnings(name, clocks),
    ]


def _offset_warnings(name: str, clocks: Mapping[str, Clock]) -> list[str]:
    offsets = {topic: clock.offset_s for topic, clock in clocks.items() if clock.offset_s}
    medians = {topic: offset[1] for topic, offset in offsets.items()}
    lines = []
    if medians and all(abs(median) > _FAR_S for median in medians.values()):
        middle = float(np.median(list(medians.values())))
        if all(abs(median - middle) < _ALIKE_S for median in medians.values()):
            lines.append(
                f"{name}: the header stamps of all topics are {_ahead(middle)} the record times, "
                "as in a replayed or simulated drive: harmless if they share one clock"
            )
            medians = {}
    for topic, median in medians.items():
        if abs(median) > _FAR_S:
            tai = abs(abs(median) - TAI_UTC_S) < _FAR_S
            hint = f" ({TAI_UTC_S:g} s: TAI against UTC)" if tai else ""
            lines.append(
                f"{name}: header stamps of {topic} are {_ahead(median)} the record times{hint}, "
                "those of other topics are not so: its clock is off, and it cannot be combined "
                "with theirs. Synchronise the clocks and record again"
                if len(offsets) > 1
                else f"{name}: header stamps of {topic} are {_ahead(median)} the record times{hint}"
            )
    for topic, (low, median, high) in offsets.items():
        if max(median - low, high - median) > _FAR_S:
            lines.append(
                f"{name}: header stamps of {topic} against record times vary from {low:+.3f} to "
                f"{high:+.3f} s: its clock jumped, or messages were held back"
            )
    return lines


def _ahead(offset_s: float) -> str:
    return f"{abs(offset_s):.3f} s {'ahead of' if offset_s > 0 else 'behind'}"


def _order_warnings(name: str, clocks: Mapping[str, Clock]) -> list[str]:
    lines = []
    for topic, clock in clocks.items():
        of_all = f"of {clock.messages} messages of {topic}"
        if clock.unset:
            lines.append(
                f"{name}: {clock.unset} {of_all} have no header stamp: the time of their recording "
                "stands in, which is late by the transport"
            )
        if clock.backwards:
            lines.append(
                f"{name}: {clock.backwards} {of_all} are stamped before the one recorded before "
                "them: sorted by stamp"
            )
        if clock.duplicates:
            lines.append(
                f"{name}: {clock.duplicates} {of_all} have the stamp of another: the first "
                "recorded is taken"
            )
    return lines


def _part_warnings(name: str, clocks: Mapping[str, Clock]) -> list[str]:
    """Topics that cover a part of the drive, by the time of their recording."""
    spans = {}
    for topic, clock in clocks.items():
        # One message has no end, and stamps of two epochs have no common start.
        if clock.period_s is not None and not clock.unset:
            ahead_ns = round(
                (clock.offset_s[1] if clock.offset_s else 0.0) * NANOSECONDS_PER_SECOND
            )
            spans[topic] = clock.first_ns - ahead_ns, clock.last_ns - ahead_ns
    if not spans:
        return []
    begin_ns, end_ns = min(a for a, _ in spans.values()), max(b for _, b in spans.values())
    lines = []
    for topic, (first_ns, last_ns) in spans.items():
        usual_s = max(_PART_S, _PART_PERIODS * (clocks[topic].period_s or 0.0))
        late_s = (first_ns - begin_ns) / NANOSECONDS_PER_SECOND
        early_s = (end_ns - last_ns) / NANOSECONDS_PER_SECOND
        parts = [f"begins {late_s:.1f} s after the first"] if late_s > usual_s else []
        parts += [f"ends {early_s:.1f} s before the last"] if early_s > usual_s else []
        if parts:
            lines.append(
                f"{name}: {topic} {' and '.join(parts)} of the topics: the rest of the drive is "
                "calibrated without it, or not at all"
            )
    return lines
