"""Stamps of a sensor that samples evenly, where messages are stamped as they arrive.

Serial lines and USB hand messages over in bursts: of an IMU at 200 Hz, three every 16 ms. Their
stamps are true times plus delays that are never negative. A clock that never ran ahead of a stamp
is the line below all of them; lost messages are steps of whole periods in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import Array, IntArray

_LEAST = 200
"""Messages, below which nothing is said of their clock."""

_NEAR, _FAR = 0.5, 1.5
"""Periods: a step between messages that is shorter or longer is not that of an even clock."""

_UNEVEN = 0.1
"""The part of such steps from which stamps are those of the arrival: lost messages are fewer."""

_LEAST_TICK = 0.08
"""Periods: shorter steps are within bursts. Longer ones that all others are multiples of are the
true period, and most of the messages are lost."""

_BLOCK_S, _BLOCK_MESSAGES = 2.0, 40
"""Length of the pieces in which the earliest message tells the clock: many bursts, and a clock that
a computer slews by 5e-4 is straight to half a millisecond."""

_STEADY = 0.5
"""How much the earliest messages of pieces may scatter, of the range of the delays. Where the
sampling itself is uneven, both are as large."""

_LEAST_SPREAD = 0.25
"""Periods that the delays differ by: with less the stamps follow a clock whose rate changes."""

_SHARP = 0.5
"""Part of the lowest tenth of the delays in what is between it and the middle: 0.2 where they are
uniform, as in bursts, 0.16 exponential, 0.8 normal."""

_LOST = 3
"""Periods in a row without a message that are a loss."""

_MOST_LATE_S = 0.5
"""Delay of the latest hundredth of the messages, beyond which they are left as they are."""


@dataclass(frozen=True)
class EvenStamps:
    """When the samples were taken, but for the least delay, which all have in common.

    Attributes:
        stamps_ns: (n,) strictly increasing.
        period_s: between samples.
        spread_s: between the delays that one and nine messages of ten stay below.
    """

    stamps_ns: IntArray
    period_s: float
    spread_s: float


def even_stamps(stamps_ns: IntArray) -> EvenStamps | None:
    """The clock behind stamps (n,), in the order of arrival, ascending; equal ones are possible.

    None where they are even already, too few, or not those of an even clock.
    """
    n = len(stamps_ns)
    if n < _LEAST or stamps_ns[-1] <= stamps_ns[0]:
        return None
    seconds = (stamps_ns - stamps_ns[0]) / NANOSECONDS_PER_SECOND
    index = np.arange(n, dtype=np.float64)
    block = max(_BLOCK_MESSAGES, round(_BLOCK_S * n / seconds[-1]))
    if n < 3 * block:
        return None
    period_s = _period_s(seconds, index, block)
    if period_s <= 0.0 or not _are_uneven(np.diff(seconds) / period_s):
        return None
    # Messages that were lost make the first period too long.
    index += _lost(seconds - period_s * index, seconds, period_s, block)
    period_s = _period_s(seconds, index, block)
    at, low = _earliest(seconds - period_s * index, block)
    ahead = np.interp(index, index[at], low)
    even = ahead + period_s * index
    delay = seconds - even
    even += _least(delay, stamps_ns, period_s)
    delay = seconds - even
    bend = np.abs(low[2:] - 2.0 * low[1:-1] + low[:-2])
    spread_s = float(np.subtract(*np.quantile(delay, (0.9, 0.1))))
    if (
        spread_s < _LEAST_SPREAD * period_s
        or np.median(bend) > _STEADY * spread_s
        or np.quantile(delay, 0.99) > _MOST_LATE_S
        or not (np.diff(even) > 0.0).all()
    ):
        return None
    return EvenStamps(
        stamps_ns[0] + np.rint(even * NANOSECONDS_PER_SECOND).astype(np.int64),
        period_s,
        spread_s,
    )


def said_of(even: EvenStamps) -> str:
    """What was done to the stamps: a sentence without a subject."""
    return (
        "stamped as the messages arrived, in bursts or with delays that differ by "
        f"{1e3 * even.spread_s:.0f} ms: the samples are taken as evenly spaced, one every "
        f"{1e3 * even.period_s:.4g} ms, and on time where a message had the least delay. Better: "
        "stamps by the sensor's own clock, or for a serial line over USB a latency_timer of 1 ms"
    )


def _are_uneven(steps: Array) -> bool:
    """Whether steps (n,) between stamps, in periods, are those of no clock that skips some."""
    if np.mean((steps < _NEAR) | (steps > _FAR)) < _UNEVEN:
        return False
    tick = float(np.quantile(steps, 0.05))
    if tick < _LEAST_TICK:
        return True
    ticks = steps / tick
    return bool(np.mean(np.abs(ticks - np.rint(ticks)) < 0.2) < 1.0 - _UNEVEN)


def _least(delay: Array, stamps_ns: IntArray, period_s: float) -> float:
    """The delay (n,) that all have in common.

    Delays of a queue end sharply at the least. Rounded stamps, and those of a clock that errs to
    both sides, are right in the middle.
    """
    least, early, middle = np.quantile(delay, (0.01, 0.1, 0.5))
    step_ns = int(np.diff(np.unique(stamps_ns)).min())
    rounded = step_ns > 1e9 * _NEAR * period_s and not (stamps_ns % step_ns).any()
    return float(middle if rounded or early - least > _SHARP * (middle - early) else least)


def _earliest(ahead: Array, block: int) -> tuple[IntArray, Array]:
    """Of each piece of `block` messages, where it is least ahead (n,), and how much."""
    starts = np.arange(0, len(ahead) - block // 2, block)
    ends = np.append(starts[1:], len(ahead))
    at = np.array([a + int(np.argmin(ahead[a:b])) for a, b in zip(starts, ends, strict=True)])
    return at, ahead[at]


def _period_s(seconds: Array, index: Array, block: int) -> float:
    """The median step from the earliest message of one piece to that of the next."""
    usual_s = float(seconds[-1] / index[-1])
    at, low = _earliest(seconds - usual_s * index, block)
    return usual_s + float(np.median(np.diff(low) / np.diff(index[at])))


def _lost(ahead: Array, seconds: Array, period_s: float, block: int) -> IntArray:
    """Messages lost before each (n,), from how much the stamps are ahead of counted periods.

    Delays come and go; what never comes back is lost: the least of all that follow. Few messages,
    and the last ones, which nothing follows, are left to the pieces, whose clock bends by as much.
    """
    stays = np.minimum.accumulate(ahead[::-1])[::-1]
    jumps = np.rint(np.diff(stays) / period_s).astype(np.int64)
    lost = np.zeros(len(ahead), np.int64)
    for at in np.flatnonzero(jumps[:-block] >= _LOST).tolist():
        # Which the burst has lost is not known: they are taken to lie in its longest step.
        first = max(at - _BLOCK_MESSAGES // 2, 0)
        steps = np.diff(seconds[first : at + _BLOCK_MESSAGES // 2])
        lost[first + int(np.argmax(steps)) + 1] += jumps[at]
    return np.cumsum(lost)
