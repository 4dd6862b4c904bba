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

_AT_ONCE, _UNEVEN = 0.3, 0.1
"""Periods below which a step is one within a burst, and the part of such steps from which stamps
are those of the arrival: an even clock has none, however many messages are lost."""

_LEAST_TICK = 0.08
"""Periods: shorter steps are within bursts. Longer ones that all others are multiples of are the
true period, and most of the messages are lost."""

_BACKWARDS_S = 0.02
"""A step back in the order of arrival, beyond which a clock was set."""

_BLOCK_S, _BLOCK_MESSAGES = 2.0, 40
"""Length of the pieces in which the earliest message tells the clock: many bursts, and a clock that
a computer slews by 5e-4 is straight to half a millisecond. Messages of a piece at least."""

_STEADY = 0.5
"""How much the earliest messages of pieces may scatter, of the range of the delays. Where the
sampling itself is uneven, both are as large."""

_LEAST_SPREAD = 0.25
"""Periods that the delays differ by: with less the stamps follow a clock whose rate changes."""

_SHARP = 0.5
"""Part of the lowest tenth of the delays in what is between it and the middle: 0.2 where they are
uniform, as in bursts, 0.16 exponential, 0.8 normal."""

_LOST = 0.6
"""Periods by which stamps are ahead for good, from which messages are lost."""

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


def even_stamps(arrived_ns: IntArray) -> EvenStamps | None:
    """The clock behind stamps (n,), in the order of arrival; equal ones are possible.

    Those of `EvenStamps` are in the order of the stamps, equal ones as they arrived. None where
    they are even already, too few, or not those of an even clock.
    """
    n = len(arrived_ns)
    if n < _LEAST or np.diff(arrived_ns).min() < -_BACKWARDS_S * NANOSECONDS_PER_SECOND:
        return None
    stamps_ns = np.sort(arrived_ns)
    seconds = (stamps_ns - stamps_ns[0]) / NANOSECONDS_PER_SECOND
    index = np.arange(n, dtype=np.float64)
    steps = np.diff(seconds)
    if not seconds[-1] or _are_sent_twice(steps):
        return None
    block = max(_BLOCK_MESSAGES, round(_BLOCK_S * n / seconds[-1]))
    if n < 3 * block or not _are_uneven(steps / (seconds[-1] / (n - 1))):
        return None
    # Where none are lost a piece is shortest: a fifth of them, and small ones.
    slopes = _slopes_s(seconds, index, max(block // 5, _BLOCK_MESSAGES))
    period_s = float(np.quantile(slopes, 0.2))
    for _ in range(2):
        if period_s <= 0.0:
            return None
        counted = np.arange(n, dtype=np.float64)
        index = counted + _lost(seconds - period_s * counted, seconds, period_s, block)
        period_s = float(np.median(_slopes_s(seconds, index, block)))
    at, low = _earliest(seconds - period_s * index, block)
    even = np.interp(index, index[at], low) + period_s * index
    delay = seconds - even
    even += _least(delay, stamps_ns, period_s)
    delay = seconds - even
    bend = np.abs(low[2:] - 2.0 * low[1:-1] + low[:-2])
    spread_s = float(np.subtract(*np.quantile(delay, (0.9, 0.1))))
    if (
        spread_s < _LEAST_SPREAD * period_s
        or spread_s > np.quantile(steps, 0.99)  # a burst is no longer than the step before it
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


def _are_sent_twice(steps: Array) -> bool:
    """Whether nearly every stamp is there twice: two publishers, or a relay."""
    return bool(len(steps) > 2 and np.mean((steps[1:] == 0.0) != (steps[:-1] == 0.0)) > 0.95)


def _are_uneven(steps: Array) -> bool:
    """Whether steps (n,), in periods, are those of arrivals, not of a clock that skips some."""
    if np.mean(steps < _AT_ONCE) < _UNEVEN:
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
    rounded = step_ns > 0.5e9 * period_s and not (stamps_ns % step_ns).any()
    return float(middle if rounded or early - least > _SHARP * (middle - early) else least)


def _earliest(ahead: Array, block: int) -> tuple[IntArray, Array]:
    """Of each piece of `block` messages, where it is least ahead (n,), and how much."""
    starts = np.arange(0, len(ahead) - block // 2, block)
    ends = np.append(starts[1:], len(ahead))
    at = np.array([a + int(np.argmin(ahead[a:b])) for a, b in zip(starts, ends, strict=True)])
    return at, ahead[at]


def _slopes_s(seconds: Array, index: Array, block: int) -> Array:
    """Steps from the earliest message of each piece to that of the next (n,), per message."""
    usual_s = float(seconds[-1] / index[-1])
    at, low = _earliest(seconds - usual_s * index, block)
    return np.asarray(usual_s + np.diff(low) / np.diff(index[at]))


def _lost(ahead: Array, seconds: Array, period_s: float, block: int) -> IntArray:
    """Messages lost before each (n,), from how much the stamps are ahead of counted periods.

    Delays come and go; what never comes back is lost: the least of all that follow. The last ones,
    which nothing follows, are left to the pieces, whose clock bends by as much.
    """
    _, low = _earliest(ahead, block)
    noise = float(np.median(np.abs(np.diff(low, 2)))) / period_s
    stays = np.minimum.accumulate(ahead[::-1])[::-1]
    jumps = np.diff(stays) / period_s
    lost = np.zeros(len(ahead), np.int64)
    for at in np.flatnonzero(jumps[:-block] >= max(_LOST, 3.0 * noise)).tolist():
        # Which the burst has lost is not known: they are taken to lie in its longest step.
        first = max(at - _BLOCK_MESSAGES // 2, 0)
        steps = np.diff(seconds[first : at + _BLOCK_MESSAGES // 2])
        lost[first + int(np.argmax(steps)) + 1] += round(float(jumps[at]))
    return np.cumsum(lost)
