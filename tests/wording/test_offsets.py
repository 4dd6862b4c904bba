"""Sentences about time offsets that are undetermined."""

from __future__ import annotations

from caliv_graph.wording.offsets import undetermined_offset_sentences


def test_an_offset_is_undetermined_from_the_limit_on() -> None:
    assert list(undetermined_offset_sentences({"front": 0.004, "rear": 0.04}, 0.005)) == [
        "lidar 'rear': the drive does not determine its time offset (sigma 40 ms, limit 5 ms), and "
        "the sigmas of its extrinsics count that. Drive a figure-eight, or vary the speed; if its "
        "clock is synchronised, set solve.time_offset: false"
    ]
