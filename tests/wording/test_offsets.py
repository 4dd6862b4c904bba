"""Sentences about time offsets that are undetermined, and about clocks that are late."""

from __future__ import annotations

import numpy as np

from caliv_graph.products import VehicleParameter
from caliv_graph.wording.offsets import late_clock_sentences, undetermined_offset_sentences


def test_an_offset_is_undetermined_from_the_limit_on() -> None:
    assert list(undetermined_offset_sentences({"front": 0.004, "rear": 0.04}, 0.005)) == [
        "lidar 'rear': the drive does not determine its time offset (sigma 40 ms, limit 5 ms), and "
        "the sigmas of its extrinsics count that. Drive a figure-eight, or vary the speed; if its "
        "clock is synchronised, set solve.time_offset: false"
    ]


def test_a_clock_that_the_drive_does_not_determine_may_be_an_arm() -> None:
    found = {"gnss_time_offset": VehicleParameter(np.array([0.04]), np.array([0.009]), (False,))}
    (text,) = late_clock_sentences(found)
    assert text.startswith("gnss.time_offset: the stamps seem 40.0 +- 9.0 ms late")
    assert "or gnss.lever_arm is wrong" in text


def test_a_clock_is_late_beyond_its_sigma_and_beyond_what_matters() -> None:
    def clock(value_s: float, sigma_s: float) -> VehicleParameter:
        return VehicleParameter(np.array([value_s]), np.array([sigma_s]), (True,))

    found = {"gnss_time_offset": clock(-0.0196, 0.0018), "imu_time_offset": clock(0.0019, 1e-4)}
    found["pose_time_offset"] = clock(0.03, 0.008)
    assert list(late_clock_sentences(found)) == [
        "gnss.time_offset: the stamps are 19.6 +- 1.8 ms early against the other sensors. The "
        "extrinsics count that; whatever else merges these sensors has to: correct the clock"
    ]
