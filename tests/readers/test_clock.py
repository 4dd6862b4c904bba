from __future__ import annotations

import numpy as np
import pytest

from caliv_graph.readers.clock import clock_warnings, effective_stamps, read_clock
from tests.readers.bags import SECOND, START

TENTHS = START + np.arange(50, dtype=np.int64) * SECOND // 10


def test_a_steady_clock() -> None:
    clock = read_clock(TENTHS, TENTHS + 20_000_000)

    assert (clock.messages, clock.first_ns, clock.last_ns) == (50, TENTHS[0], TENTHS[-1])
    assert clock.rate_hz == pytest.approx(10.0)
    assert (clock.gaps, clock.unset, clock.backwards, clock.duplicates) == ((), 0, 0, 0)
    assert clock.offset_s == pytest.approx((-0.02, -0.02, -0.02))
    assert clock_warnings("bag", {"/imu": clock, "/lidar": clock}) == []


def test_gaps_duplicates_and_order() -> None:
    stamps = np.delete(TENTHS, [10, 20, 21])
    stamps[5] = stamps[4]
    stamps[[30, 31]] = stamps[[31, 30]]

    clock = read_clock(stamps, TENTHS[: len(stamps)])

    # Frame 5 is gone too, for its stamp is that of frame 4.
    assert clock.gaps == tuple((TENTHS[a], TENTHS[b]) for a, b in ((4, 6), (9, 11), (19, 22)))
    assert (clock.backwards, clock.duplicates) == (1, 1)
    lines = clock_warnings("bag", {"/imu": clock})
    assert [line.split(" of ")[0] for line in lines] == ["bag: 1", "bag: 1"]
    assert "stamped before the one recorded before" in lines[0]


def test_unset_stamps_are_replaced_by_the_record_time() -> None:
    header = TENTHS.copy()
    header[7] = 0

    clock = read_clock(header, TENTHS + 5)

    assert clock.unset == 1
    assert clock.offset_s == pytest.approx((-5e-9,) * 3)
    assert effective_stamps(header, TENTHS + 5)[7] == TENTHS[7] + 5
    (line,) = clock_warnings("bag", {"/x": clock})
    assert "1 of 50 messages of /x have no header stamp" in line


def test_one_clock_that_is_off_is_named() -> None:
    good = read_clock(TENTHS, TENTHS + 1000)
    off = read_clock(TENTHS + 37 * SECOND, TENTHS)

    (line,) = clock_warnings("bag", {"/imu": good, "/lidar": off})

    assert line.startswith("bag: header stamps of /lidar are 37.000 s ahead of the record times")
    assert "TAI" in line


def test_a_replayed_drive_is_told_once() -> None:
    old = read_clock(TENTHS - 10_000 * SECOND, TENTHS)

    (line,) = clock_warnings("bag", {"/imu": old, "/lidar": old})

    assert "of all topics are 10000.000 s behind the record times" in line


def test_a_clock_that_jumps() -> None:
    header = TENTHS.copy()
    header[40:] += 5 * SECOND

    (line,) = clock_warnings("bag", {"/x": read_clock(header, TENTHS)})

    assert "vary from +0.000 to +5.000 s" in line


def test_few_messages() -> None:
    empty = np.array([], dtype=np.int64)
    none = read_clock(empty, empty)
    assert (none.messages, none.rate_hz, none.offset_s) == (0, None, None)
    assert read_clock(TENTHS[:1], TENTHS[:1]).rate_hz is None
    assert read_clock(TENTHS[[0, 0]], TENTHS[:2]).duplicates == 1


def test_a_topic_that_stops_halfway_is_named() -> None:
    times = 1_700_000_000_000_000_000 + np.arange(300) * 100_000_000  # 30 s
    whole, half = read_clock(times, times), read_clock(times[:180], times[:180])
    (line,) = clock_warnings("bag", {"/imu": whole, "/gnss": half})
    assert line.startswith("bag: /gnss ends 12.0 s before the last of the topics")
    late = read_clock(times[50:], times[50:])
    (line,) = clock_warnings("bag", {"/imu": whole, "/gnss": late})
    assert line.startswith("bag: /gnss begins 5.0 s after the first")
    # Of another epoch: what counts is when it was recorded.
    boot = read_clock(times - 1_699_999_000_000_000_000, times)
    assert not any("ends" in line for line in clock_warnings("bag", {"/imu": whole, "/l": boot}))
    # One message in 10 s ends when it does.
    rare = read_clock(times[::100], times[::100])
    assert clock_warnings("bag", {"/imu": whole, "/pose": rare}) == []
    # One message has no end; of headers that are partly unset, of another epoch, none is told.
    once = read_clock(times[:1], times[:1])
    assert clock_warnings("bag", {"/imu": whole, "/map": once}) == []
    partly = np.where(np.arange(300) < 20, 0, times - 1_699_999_000_000_000_000)
    clocks = {"/imu": whole, "/l": read_clock(partly, times)}
    assert not any("of the topics" in line for line in clock_warnings("bag", clocks))
