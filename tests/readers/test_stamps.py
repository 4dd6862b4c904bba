from __future__ import annotations

import numpy as np
import pytest

from caliv_graph.readers.stamps import stamp_mark, sweep_span

SWEEP = np.array([0.0, 0.0999])
RNG = np.random.default_rng(1)


def delays(least_s: float, count: int = 50) -> np.ndarray:
    """Record times after the stamps: at least so late, some by milliseconds more."""
    return least_s + np.concatenate([[0.0], RNG.exponential(3e-3, count)])


@pytest.mark.parametrize(
    ("least_s", "marks", "told_by"),
    [
        (0.103, "start", "records"),  # complete 0.1 s after its first point, and sent
        (0.090, "start", "records"),  # a clock that is 13 ms ahead
        (0.003, "end", "records"),
        (-0.004, "end", "records"),  # the same, 7 ms ahead
        (0.060, "start", "nothing"),  # half-way: neither
        (-0.060, "start", "nothing"),
        (0.400, "start", "nothing"),
        (37.003, "start", "nothing"),
    ],
)
def test_the_record_times_tell_what_the_stamp_marks(
    least_s: float, marks: str, told_by: str
) -> None:
    mark = stamp_mark("auto", SWEEP, False, delays(least_s))

    assert (mark.marks, mark.told_by) == (marks, told_by)
    assert mark.shift_s == (-0.0999 if marks == "end" else 0.0)
    assert bool(mark.note) == (told_by == "nothing" or marks == "end")


@pytest.mark.parametrize(
    ("last_s", "least_s", "marks", "told_by"),
    [
        (0.067, 0.103, "start", "records"),  # the last third of the sweep has no returns
        (0.067, 0.003, "end", "records"),
        (0.067, 0.200, "start", "nothing"),
        (0.020, 0.103, "start", "nothing"),  # no third of a sweep, but a LiDAR that pauses
    ],
)
def test_a_sweep_that_ends_in_the_sky_is_as_long_as_the_time_between_clouds(
    last_s: float, least_s: float, marks: str, told_by: str
) -> None:
    mark = stamp_mark("auto", np.array([0.0, last_s]), False, delays(least_s), 0.1)

    assert (mark.marks, mark.told_by) == (marks, told_by)
    assert bool(mark.note) == ((marks, told_by) != ("start", "records"))


def test_record_times_that_are_copies_of_the_stamps_tell_nothing() -> None:
    mark = stamp_mark("auto", SWEEP, False, np.zeros(40))

    assert (mark.marks, mark.told_by, mark.shift_s) == ("start", "nothing", 0.0)
    assert "assumed to mark the start" in mark.note
    assert "no time of recording but their stamps" in mark.note


def test_clouds_without_a_stamp_are_recorded_after_their_end() -> None:
    mark = stamp_mark("auto", SWEEP, False, np.empty(0))

    assert (mark.marks, mark.shift_s) == ("end", -0.0999)


@pytest.mark.parametrize(
    ("span", "is_absolute", "marks"),
    [
        ((-0.0999, 0.0), False, "end"),
        ((-0.05, 0.05), False, "start"),
        ((0.0, 0.0999), True, "start"),
    ],
)
def test_signed_and_absolute_times_stay_as_they_are(
    span: tuple[float, float], is_absolute: bool, marks: str
) -> None:
    mark = stamp_mark("auto", np.array(span), is_absolute, delays(0.003))

    assert (mark.marks, mark.told_by, mark.shift_s, mark.note) == (marks, "times", 0.0, "")


@pytest.mark.parametrize(
    ("setting", "span", "shift_s"),
    [
        ("start", (0.0, 0.1), 0.0),
        ("start", (0.03, 0.1), 0.0),  # its first beams hit nothing: times still count from there
        ("start", (-0.1, 0.0), 0.1),
        ("end", (0.0, 0.1), -0.1),
        ("end", (-0.1, 0.0), 0.0),
        ("end", (0.0, 0.001), 0.0),
    ],
)
def test_the_config_decides(setting: str, span: tuple[float, float], shift_s: float) -> None:
    mark = stamp_mark(setting, np.array(span), False, delays(0.05))  # type: ignore[arg-type]

    assert mark.marks == setting
    assert mark.shift_s == pytest.approx(shift_s)
    assert mark.note == ""


def test_the_sweep_is_the_widest_that_fits_between_two_clouds() -> None:
    spans = [(0.001, 0.095), (0.0, 0.0990), (0.0, 0.2)]  # the last: two sweeps in one message

    assert sweep_span(spans, 0.1) == pytest.approx([0.0, 0.0990])
    assert sweep_span(spans, None) == pytest.approx([0.0, 0.2])
    assert sweep_span([(0.0, 0.3), (0.0, 0.2), (0.0, 0.5)], 0.1) == pytest.approx([0.0, 0.3])
    assert sweep_span([], 0.1) is None
