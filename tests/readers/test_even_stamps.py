from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.readers.clock import clock_warnings, read_clock
from caliv_graph.readers.even_stamps import even_stamps
from caliv_graph.readers.imu import ImuCollector
from tests.readers.bags import START, as_object, imu

HZ, SECONDS = 200.0, 30.0


@dataclass(frozen=True)
class Sent:
    """Samples (n,) at true times, seconds, and when their messages arrived."""

    taken: Array
    arrived: Array

    @property
    def stamps_ns(self) -> IntArray:
        return START + np.rint(1e9 * self.arrived).astype(np.int64)

    def errors_ms(self) -> Array:
        """Of the mended stamps."""
        even = even_stamps(self.stamps_ns)
        assert even is not None
        assert (np.diff(even.stamps_ns) > 0).all()
        return np.asarray(1e-6 * (even.stamps_ns - START) - 1e3 * self.taken)


def times(hz: float = HZ, lost: slice | None = None) -> Array:
    taken = 0.1 + np.arange(round(SECONDS * hz)) / hz
    return taken if lost is None else np.delete(taken, lost)


def in_bursts(taken: Array, of: int) -> Sent:
    """Handed over together when the last of them is there, within half a millisecond."""
    k = np.arange(len(taken))
    last = taken[np.minimum((k // of + 1) * of, len(taken)) - 1]
    late = np.random.default_rng(1).uniform(0.0, 4e-4, len(taken))
    return Sent(taken, last + late[k // of] + 2e-6 * (k % of))


def by_latency_timer(taken: Array, period_s: float = 0.016) -> Sent:
    """A serial line over USB: what has come is handed over every 16 ms, all with one stamp."""
    return Sent(taken, 0.0003 + np.ceil((taken - 0.0003) / period_s) * period_s)


@pytest.mark.parametrize("of", [2, 5, 20])
def test_bursts_are_taken_apart(of: int) -> None:
    sent = in_bursts(times(), of)
    assert np.std(sent.arrived - sent.taken) > 0.4 * of / HZ / np.sqrt(3.0)

    error = sent.errors_ms()

    assert np.abs(error).max() < 0.6


@pytest.mark.parametrize("hz", [100.0, 200.0, 400.0])
def test_so_is_a_latency_timer(hz: float) -> None:
    error = by_latency_timer(times(hz)).errors_ms()

    # 16 ms are no whole number of periods: the least delay of a burst varies by a period.
    assert np.abs(error).max() < 1.0
    assert np.std(error) < 0.4


def test_a_queue_that_is_held_up_is_not_late_for_good() -> None:
    taken = times()
    free = np.maximum.accumulate(taken + np.random.default_rng(2).exponential(3e-3, len(taken)))
    for held_s in (8.0, 15.0, 22.0):
        free[(free > held_s) & (free < held_s + 0.3)] = held_s + 0.3

    assert np.abs(Sent(taken, free).errors_ms()).max() < 1.0


def test_what_was_lost_leaves_a_gap() -> None:
    taken = times(lost=slice(2000, 2160))
    sent = by_latency_timer(taken)

    even = even_stamps(sent.stamps_ns)

    assert even is not None
    steps_s = 1e-9 * np.diff(even.stamps_ns)
    assert steps_s.max() == pytest.approx(161 / HZ, abs=0.02)
    assert np.count_nonzero(steps_s > 0.02) == 1
    # Whose the samples beside the gap are is not known to better than a burst.
    assert np.abs(sent.errors_ms()).max() < 16.0 + 1e3 / HZ


@pytest.mark.parametrize("part", [0.01, 0.1])
def test_single_messages_are_missed_where_bursts_tell(part: float) -> None:
    taken = times()
    sent = in_bursts(taken[np.random.default_rng(6).random(len(taken)) > part], 5)

    even = even_stamps(sent.stamps_ns)

    # Or they are left as they are: what bends more than a burst is no clock.
    if even is not None:
        assert np.std(sent.errors_ms()) < 1e3 * np.std(sent.arrived - sent.taken)
    else:
        assert part > 0.05


def test_a_clock_that_is_slewed_is_followed() -> None:
    taken = times()
    slewed = taken + 5e-4 * np.clip(taken - 8.0, 0.0, 12.0)  # as NTP does
    sent = by_latency_timer(slewed)

    assert np.abs(Sent(slewed, sent.arrived).errors_ms()).max() < 1.5


def test_errors_to_both_sides_are_right_in_the_middle() -> None:
    taken = times()
    noisy = np.sort(taken + np.random.default_rng(3).normal(0.0, 4e-3, len(taken)))
    rounded = np.rint(100.0 * taken) / 100.0

    assert abs(np.mean(Sent(taken, noisy).errors_ms())) < 0.3
    assert abs(np.mean(Sent(taken, rounded).errors_ms())) < 3.0  # half a period, to which side


def jittered(stamps: Array, most_s: float) -> Array:
    return stamps + np.random.default_rng(5).uniform(0.0, most_s, len(stamps))


def throttled(n: int) -> list[BoolArray]:
    """Which of n messages a topic keeps that drops every third or fourth, or two of four."""
    return [np.resize(np.array(kept, bool), n) for kept in ((1, 1, 0), (1, 1, 1, 0), (1, 1, 0, 0))]


def test_stamps_that_are_even_or_truly_uneven_are_left_alone() -> None:
    rng = np.random.default_rng(4)
    taken = times()
    uneven = np.cumsum(rng.uniform(0.1, 1.9, len(taken)) / HZ)

    for stamps in (
        taken,
        taken + rng.uniform(0.0, 0.2 / HZ, len(taken)),
        times(lost=slice(2000, 2160)),
        np.delete(taken, rng.choice(len(taken), len(taken) // 40, replace=False)),
        taken[rng.random(len(taken)) > 0.2],
        taken[rng.random(len(taken)) > 0.7],
        *(jittered(taken[kept], 0.1 / HZ) for kept in throttled(len(taken))),
        np.repeat(taken, 2),
        np.append(in_bursts(taken, 5).arrived, 20.0 + times()),
        np.append(times(100.0), SECONDS + times(200.0)),
        uneven,
        in_bursts(taken, 20).arrived[:150],
        np.full(1000, 5.0),
    ):
        assert even_stamps(START + np.rint(1e9 * stamps).astype(np.int64)) is None


def test_messages_of_one_stamp_are_all_kept_in_their_order() -> None:
    sent = by_latency_timer(times())
    collector = ImuCollector()
    for k, stamp_ns in enumerate(sent.stamps_ns.tolist()):
        message = as_object(imu(stamp_ns, force=(0.0, 0.0, 9.0 + 1e-3 * k)))
        for _ in range(1 + (k % 7 == 0)):  # some are sent again
            collector.add(stamp_ns, message)

    samples = collector.finish()

    assert samples is not None
    np.testing.assert_allclose(
        samples.specific_force[:, 2], 9.0 + 1e-3 * np.arange(len(sent.taken))
    )
    assert np.std(1e-9 * (samples.stamps_ns - START) - sent.taken) < 4e-4
    (note,) = collector.notes()
    assert "stamped as the messages arrived" in note
    assert "one every 5 ms" in note


def test_the_clock_of_the_topic_has_its_true_rate_and_no_gaps() -> None:
    stamps = by_latency_timer(times()).stamps_ns

    clock = read_clock(stamps, stamps, evenly=True)

    assert clock.rate_hz == pytest.approx(HZ, rel=0.02)
    assert (clock.gaps, clock.duplicates) == ((), 0)
    assert clock_warnings("bag", {"/imu": clock}) == []
