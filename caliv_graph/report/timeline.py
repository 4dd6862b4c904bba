"""When the topics of a recording have messages, and which LiDAR sees a target when."""

from __future__ import annotations

import math
from dataclasses import dataclass

from caliv_graph.readers.caliv_folder import FRAME_PERIOD_NS
from caliv_graph.report.bag_inspection import BagInspection
from caliv_graph.report.inspection import Inspection

Span = tuple[float, float]
"""From and to, in seconds from the recording's begin."""

_TICKS = 6
"""On the axis at most."""


@dataclass(frozen=True)
class Row:
    """One line of the timeline.

    Attributes:
        name: of a topic or LiDAR.
        bars: when there is something.
        gaps: when it is missing in between, the longest ones.
        note: what the bars do not show.
        sees: whether the bars are the sightings of a target.
    """

    name: str
    bars: tuple[Span, ...]
    gaps: tuple[Span, ...] = ()
    note: str = ""
    sees: bool = False


@dataclass(frozen=True)
class Timeline:
    """Rows between two times, and the ticks of their axis; all in seconds."""

    begin_s: float
    end_s: float
    ticks: tuple[float, ...]
    rows: tuple[Row, ...]

    def percent(self, time_s: float) -> float:
        """Where a time is, from 0 to 100."""
        part = (time_s - self.begin_s) / (self.end_s - self.begin_s)
        return 100.0 * min(max(part, 0.0), 1.0)


def timeline(inspection: Inspection | BagInspection) -> Timeline:
    """The timeline of a recording; of a CaLiV folder the times are nominal."""
    if isinstance(inspection, Inspection):
        rows, shown = _folder_rows(inspection), None
    else:
        rows, shown = _bag_rows(inspection), (0.0, inspection.duration_s)
    spans = [(row.bars[0][0], row.bars[-1][1]) for row in rows if row.bars]
    if shown is None or not any(a <= shown[1] and b >= shown[0] for a, b in spans):
        # Clocks that are off by far: against the record times nothing would be seen.
        shown = (min((a for a, _ in spans), default=0.0), max((b for _, b in spans), default=1.0))
    begin, end = shown[0], max(shown[1], shown[0] + 1e-3)
    placed = tuple(_placed(row, begin, end) for row in rows)
    return Timeline(begin, end, _ticks(begin, end), placed)


def _placed(row: Row, begin_s: float, end_s: float) -> Row:
    """A row; of one whose stamps are of another time a note."""
    if not row.bars or (row.bars[0][0] <= end_s and row.bars[-1][1] >= begin_s):
        return row
    first, last = row.bars[0][0], row.bars[-1][1]
    return Row(row.name, (), (), f"stamps of another time: {first:.1f} to {last:.1f} s", row.sees)


def _ticks(begin_s: float, end_s: float) -> tuple[float, ...]:
    rough = (end_s - begin_s) / _TICKS
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(n * power for n in (1.0, 2.0, 5.0, 10.0) if n * power >= rough)
    first = math.ceil(begin_s / step)
    return tuple(step * k for k in range(first, math.floor(end_s / step + 1e-9) + 1))


def _bag_rows(inspection: BagInspection) -> list[Row]:
    lidars = {lidar.topic: name for name, lidar in inspection.lidars.items()}
    rows = []
    for name, topic in inspection.topics.items():
        if topic.span_s is None:
            continue
        note = "" if topic.gaps == 0 else f"{topic.gaps} gaps"
        label = f"{lidars[name]} ({name})" if name in lidars else name
        rows.append(Row(label, (topic.span_s,), topic.longest_gaps_s, note))
    rows.sort(
        key=lambda row: not any(row.name.startswith(f"{lidar} (") for lidar in lidars.values())
    )
    return rows + [
        Row(f"{lidar} sees {target.name}", sighting.times_s or (), (), sees=True)
        for target in inspection.targets or ()
        for lidar, sighting in target.lidars.items()
    ]


def _folder_rows(inspection: Inspection) -> list[Row]:
    period_s = 1e-9 * FRAME_PERIOD_NS

    def spans(frames: tuple[tuple[int, int], ...]) -> tuple[Span, ...]:
        return tuple((a * period_s, b * period_s) for a, b in frames)

    rows = [
        Row(name, spans((lidar.frames,)), spans(lidar.gaps))
        for name, lidar in inspection.lidars.items()
    ]
    return rows + [
        Row(f"{lidar} sees {target.name}", spans(sighting.frames), (), sees=True)
        for target in inspection.targets or ()
        for lidar, sighting in target.lidars.items()
    ]
