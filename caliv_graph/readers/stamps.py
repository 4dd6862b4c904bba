"""What the stamp of a cloud marks: the start or the end of its sweep.

Times of points that count from the start of the sweep are added to a stamp that some drivers take
at its end: all points are then late by a sweep. The times alone do not tell, but the recorder does:
no cloud is recorded before its last point is measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from caliv_graph.config.lidars import StampSetting
from caliv_graph.products import Array

Told = Literal["config", "times", "records", "nothing", ""]
"""What tells it: the config; the sign or the kind of the times; the record times; nothing, it is
assumed; empty: there is nothing to tell, for all points are of one instant."""

INSTANT_S = 2e-3
"""Seconds: of a shorter sweep, start and end are the same to a calibration."""

_SLACK_S = 2e-3
"""Seconds by which times of points may lie on the other side of the stamp: a packet or two."""

_COPIED_S = 1e-5
"""Seconds: record times that follow the stamps this closely throughout were made from them."""

_FAR_S = 1.0
"""Seconds between stamps and record times from which they are of different clocks."""

_LEAST_SEEN = 0.5
"""Of the time between two clouds: from there on, the rest may be a part of the sweep in which the
beams hit nothing. What is shorter is a LiDAR that pauses, or a recorder that drops clouds."""

_PERIOD_TOLERANCE = 1.02
"""A sweep takes at most so much of the time between two clouds: what takes longer is damaged."""


@dataclass(frozen=True)
class StampMark:
    """What the stamps of one LiDAR mark.

    Attributes:
        marks: start or end of the sweep.
        told_by: what tells it.
        shift_s: seconds, to be added to the times of all points.
        note: what a person should know, a sentence without a subject; empty: nothing.
        time_problem: why the times of the points cannot be right; empty: they may be.
    """

    marks: Literal["start", "end"] = "start"
    told_by: Told = ""
    shift_s: float = 0.0
    note: str = ""
    time_problem: str = ""


def sweep_span(spans_s: Sequence[tuple[float, float]], period_s: float | None) -> Array | None:
    """First and last time of a sweep, (2,) seconds, of those of some clouds; None without any.

    The ends may be missing in single clouds, where the beams hit nothing.
    """
    if not spans_s:
        return None
    spans = np.array(spans_s)
    if period_s is not None:
        sound = spans[:, 1] - spans[:, 0] <= _PERIOD_TOLERANCE * period_s
        if sound.any():
            spans = spans[sound]
        else:
            return np.asarray(np.median(spans, axis=0))
    return np.array([spans[:, 0].min(), spans[:, 1].max()])


def stamp_mark(
    setting: StampSetting,
    span_s: Array | None,
    is_absolute: bool,
    delays_s: Array,
    period_s: float | None = None,
) -> StampMark:
    """What stamps mark, from the config or, with `auto`, from the data.

    Args:
        setting: of the config.
        span_s: (2,) first and last time of a sweep, seconds after the stamp (`sweep_span`).
        is_absolute: the times of the points are not relative to the stamp.
        delays_s: (n,) record time minus stamp of each cloud that has a stamp; empty: none has one,
            and the record time stands in.
        period_s: usual time between two clouds; None: not known.
    """
    if span_s is None or span_s[1] - span_s[0] < INSTANT_S:
        return StampMark("end" if setting == "end" else "start")
    first_s, last_s = span_s.tolist()
    if setting == "start":
        return StampMark("start", "config", -first_s if first_s < -_SLACK_S else 0.0)
    if setting == "end":
        return StampMark("end", "config", -last_s if last_s > _SLACK_S else 0.0)
    if is_absolute or first_s < -_SLACK_S:
        # Signed and absolute times say themselves where they belong.
        return StampMark("end" if last_s < -first_s else "start", "times")
    whole = period_s is not None and last_s < period_s < last_s / _LEAST_SEEN
    return _told_by_records(last_s, period_s if whole and period_s else last_s, delays_s)


def _told_by_records(last_s: float, sweep_s: float, delays_s: Array) -> StampMark:
    """Of times that run from the stamp to `last_s` after it, in a sweep of `sweep_s`.

    The quickest cloud counts: others waited. Half a sweep is more than transport takes, and a
    quarter more than clocks of one vehicle that are set by each other differ.
    """
    shown = f"their times run to {last_s:.4f} s after it"
    if not len(delays_s):
        return StampMark(
            "end",
            "records",
            -last_s,
            f"its clouds have no stamp. The time of their recording stands in, and {shown}: it is "
            "taken for the end of the sweep",
        )
    least_s = float(delays_s.min())
    if 0.75 * last_s <= least_s <= 1.5 * sweep_s:
        return StampMark("start", "records")
    if -0.25 * last_s <= least_s <= 0.5 * last_s and np.ptp(delays_s) + abs(least_s) > _COPIED_S:
        return StampMark(
            "end",
            "records",
            -last_s,
            f"its stamps mark the end of the sweep: clouds are recorded {1e3 * least_s:.0f} ms "
            f"after their stamp, but {shown}, counted from the start of the sweep. They are "
            f"shifted by {-last_s:.4f} s. If the LiDAR's clock is that much ahead instead, set "
            "stamp: start",
        )
    return StampMark("start", "nothing", 0.0, f"{_assumed(least_s, delays_s)}, and {shown}")


def _assumed(least_s: float, delays_s: Array) -> str:
    if np.ptp(delays_s) + abs(least_s) <= _COPIED_S:
        why = "the clouds have no time of recording but their stamps"
    elif abs(least_s) > _FAR_S:
        why = f"the record times are {least_s:.1f} s from the stamps"
    else:
        why = f"clouds are recorded {1e3 * least_s:.0f} ms after their stamp at the least"
    return (
        "its stamps are assumed to mark the start of the sweep (stamp: end if they mark the end; "
        f"the error would be one sweep). The data do not tell: {why}"
    )
