from __future__ import annotations

import pytest

from caliv_graph.report.bag_inspection import BagInspection, BagLidarSummary, TopicSummary
from caliv_graph.report.inspection import (
    DriveSummary,
    Inspection,
    LidarSummary,
    Points,
    Sighting,
    TargetSummary,
)
from caliv_graph.report.timeline import timeline

POINTS = Points(1, 2, 3)


def topic(span_s: tuple[float, float] | None, **keys: object) -> TopicSummary:
    return TopicSummary("type", 10, 10.0, span_s is not None, span_s=span_s, **keys)  # type: ignore[arg-type]


def bag(topics: dict[str, TopicSummary], seen: Sighting | None = None) -> BagInspection:
    front = BagLidarSummary(
        "/front/points", "front", 10, 10.0, 10, POINTS, None, "", "start", "", 0.0
    )
    targets = None if seen is None else (TargetSummary("chair", (0.0, 0.0, 0.0), {"front": seen}),)
    return BagInspection("drive", 0, 60.0, topics, {"front": front}, {}, {}, None, targets)


def test_topics_gaps_and_what_sees_the_target() -> None:
    topics = {
        "/chatter": topic(None),
        "/fix": topic((1.0, 59.0), gaps=30, longest_gaps_s=((3.0, 4.5), (20.0, 21.0))),
        "/front/points": topic((0.0, 60.0)),
    }
    seen = Sighting(5, (), POINTS, (5.0, 9.0), ((2.0, 8.0), (30.0, 33.0)))

    shown = timeline(bag(topics, seen))

    assert (shown.begin_s, shown.end_s) == (0.0, 60.0)
    assert shown.ticks == pytest.approx((0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0))
    # LiDARs first; a topic that was not read has no times.
    front, fix, sees = shown.rows
    assert (front.name, front.bars) == ("front (/front/points)", ((0.0, 60.0),))
    assert (fix.name, fix.gaps) == ("/fix", ((3.0, 4.5), (20.0, 21.0)))
    assert (sees.name, sees.bars, sees.sees) == (
        "front sees chair",
        ((2.0, 8.0), (30.0, 33.0)),
        True,
    )
    assert shown.percent(15.0) == pytest.approx(25.0)
    assert (shown.percent(-5.0), shown.percent(99.0)) == (0.0, 100.0)


def test_a_clock_that_is_off_does_not_squeeze_the_others() -> None:
    shown = timeline(bag({"/a": topic((0.0, 60.0)), "/b": topic((-500.0, -440.0))}))

    assert (shown.begin_s, shown.end_s) == (0.0, 60.0)
    assert shown.rows[1].bars == ()
    assert shown.rows[1].note == "stamps of another time: -500.0 to -440.0 s"


def test_clocks_that_are_all_off_are_shown_by_their_own_time() -> None:
    shown = timeline(bag({"/a": topic((1000.0, 1060.0)), "/b": topic((1001.0, 1070.0))}))

    assert (shown.begin_s, shown.end_s) == (1000.0, 1070.0)
    assert [len(row.bars) for row in shown.rows] == [1, 1]


def test_frames_of_a_folder_are_a_tenth_of_a_second() -> None:
    lidar = LidarSummary(8, (10, 60), 1, ((20, 30),), 10.0, POINTS)
    drive = DriveSummary(1, 0.0, 0.0, 0.0, 0.0, 0.0)
    target = TargetSummary("chair", (0.0, 0.0, 0.0), {"front": Sighting(3, ((12, 14), (40, 41)))})

    shown = timeline(Inspection("drive", {"front": lidar}, drive, (target,)))

    front, sees = shown.rows
    assert front.bars[0] == pytest.approx((1.0, 6.0))
    assert front.gaps[0] == pytest.approx((2.0, 3.0))
    assert [b for span in sees.bars for b in span] == pytest.approx([1.2, 1.4, 4.0, 4.1])


def test_a_recording_of_one_moment() -> None:
    shown = timeline(bag({"/a": topic((0.0, 0.0))}))

    assert shown.percent(0.0) == pytest.approx(0.0)
    assert shown.ticks
