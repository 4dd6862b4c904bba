"""Sentences about suspects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.products import MountSlip, Suspect
from caliv_graph.wording.suspects import (
    doubt_sentence,
    motion_sentence,
    moved_sentence,
    ranking_sentence,
    remedy,
    slip_finding,
    suspect_row,
)

ARM = Suspect(
    "gnss.lever_arm",
    (1.19, 0.31, 0.84),
    (0.02, 0.02, 0.3),
    (0.19, 0.01, -0.06),
    ("m",) * 3,
    0.96,
    41.2,
    41.2,
)


def suspect(name: str, sigmas: float, left: float) -> Suspect:
    return Suspect(name, (0.1,), (0.01,), (0.1,), ("s",), 0.5, sigmas, left)


def test_the_first_suspect_leads_and_what_remains_follows() -> None:
    rest = [suspect("lidars.rear.time_offset", 20.0, 4.0), suspect("gnss.time_offset", 12.0, 0.3)]
    assert ranking_sentence([ARM, *rest]) == (
        "most likely: gnss.lever_arm, by (0.19, 0.01, -0.06) m, so that it is (1.19, 0.31, 0.84) m "
        "(sigma (0.02, 0.02, 0.30) m); it explains 96 percent of the contradiction (41 sigma); "
        "next, with it freed: lidars.rear.time_offset (4 sigma). Measure the antenna in the "
        "vehicle frame again, or set gnss.lever_arm: null"
    )


@pytest.mark.parametrize(
    ("sigmas", "left", "alike"),
    [(34.0, 1.3, True), (30.0, 1.3, False), (34.0, 9.0, False)],
    ids=["hardly told apart", "explains less", "explains something else"],
)
def test_an_input_that_explains_nearly_as_much_is_named(
    sigmas: float, left: float, alike: bool
) -> None:
    rest = [suspect("lidars.rear.time_offset", 33.0, 0.0), suspect("imu.time_offset", sigmas, left)]
    if not alike:
        del rest[0]
    text = ranking_sentence([ARM, *rest])
    late = "imu.time_offset, the stamps are 0.100 +- 0.010 s late"
    assert (f"{late}, explains it nearly as well ({sigmas:.0f} sigma)" in text) == alike
    assert ("hardly tells them apart" in text) == alike
    assert text.endswith("or set gnss.lever_arm: null")


def test_a_coordinate_that_is_not_determined_has_no_number() -> None:
    flat = replace(ARM, determined=(True, True, False))
    assert ranking_sentence([flat]).startswith(
        "most likely: gnss.lever_arm, by (0.19, 0.01, -) m, so that it is (1.19, 0.31, not "
        "determined) m (sigma (0.02, 0.02, -) m); it explains"
    )
    _, by, value, *_ = suspect_row(flat)
    assert by == "(0.19, 0.01, not determined) m (sigma (0.02, 0.02, -) m)"
    assert value == "(1.19, 0.31, not determined) m"


def test_a_clock_is_late_or_early_and_has_a_key() -> None:
    text = ranking_sentence([suspect("lidars.rear.time_offset", 9.0, 9.0)])
    assert "the stamps are 0.100 +- 0.010 s late" in text
    assert "if it is off by a sweep, set lidars.rear.stamp: start or end" in text
    assert "without a time per point look the same, and no offset mends them" in text
    assert text.endswith("deskewed before they were recorded (lidars.rear.deskewed: true)")


def test_nothing_is_said_below_five_sigma() -> None:
    assert motion_sentence([suspect("gnss.time_offset", 4.9, 4.9)]) == ""
    assert motion_sentence([]) == ""


@pytest.mark.parametrize(("sigmas", "said"), [(3.9, False), (4.8, True), (5.1, False)])
def test_what_is_nearly_a_contradiction_is_a_doubt(sigmas: float, said: bool) -> None:
    height = Suspect(
        "ground.vehicle_height", (0.0,), (0.041,), (-0.2,), ("m",), 0.9, sigmas, sigmas
    )
    text = doubt_sentence([height])
    assert text == (
        "ground.vehicle_height may be wrong, by -0.20 m, so that it is 0.00 m (sigma 0.04 m): the "
        "data would rather have it so by 4.8 sigma, and 5 are a contradiction. Measure the height "
        "of the vehicle frame above the ground again, and check that z of the guesses counts from "
        "that frame"
        if said
        else ""
    )
    assert doubt_sentence([]) == ""


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("imu.T_vehicle_imu", "rpy_deg: null"),
        ("ground.vehicle_height", "height of the vehicle frame"),
        ("lidars.front.initial", "guess of lidar 'front'"),
        ("lidars.front.mount.halves", "the mount of lidar 'front' or the target moved during"),
        ("poses.drift", "given poses drift"),
        ("gnss.drift.1", "GNSS positions drift"),
        ("imu.yaw_bias", "imu.yaw_bias"),
        ("imu.gyroscope.scale", "IMU's messages"),
        ("twist.scale", "topics.twist"),
    ],
)
def test_every_suspect_has_a_remedy(name: str, said: str) -> None:
    text = remedy(suspect(name, 9.0, 9.0))
    assert said in text
    # A moved mount is named for a mount only.
    assert ("moved" in text) == (".mount." in name)


def test_without_an_imu_an_axle_that_is_elsewhere_looks_like_the_antenna() -> None:
    told = (True, True, False)
    arm = Suspect(
        "gnss.lever_arm",
        (2.1, 0.1, 1.6),
        (0.04, 0.01, 1.0),
        (1.3, 0.0, 0.0),
        ("m",) * 3,
        0.5,
        14.0,
        14.0,
        told,
    )
    assert "wheels" not in ranking_sentence([arm])
    text = ranking_sentence([arm], of_wheels=True)
    assert "Or the axle that does not steer is elsewhere: wheels.T_vehicle_wheels.xyz" in text
    assert "by (-1.30, " in text


SLIP = MountSlip(
    ("front",), (), 13.2, 25.0, np.array([0.0, -0.00349, 0.01745, 0.003, 0.004, 0.0]), 16.4
)
SIZE = (
    "turned by 1.02 degrees (roll, pitch, yaw +0.00, -0.20, +1.00) and shifted by 5 mm (x, y, z "
    "+3, +4, +0)"
)


def said(slip: MountSlip) -> str:
    found = slip_finding("drive", slip)
    assert found is not None
    return found.sentence


def test_a_mount_that_slips_is_named_with_its_size_and_what_to_do() -> None:
    assert said(SLIP) == (
        "drive: the mount of lidar 'front' slips about 13 s after the first scan, of 25 s, by the "
        f"surfaces around (16 sigma): it is {SIZE}. One extrinsic cannot be right before and after "
        "it: S2S and S2V are in between. Fasten the mount and record again, or cut the recording "
        "there and calibrate each part by itself. A cab or a rack on springs that leans in curves "
        "looks the same, and no part is right then: fix it to the frame, or drive more slowly"
    )
    either = said(replace(SLIP, others=("rear",)))
    assert "the mount of lidar 'front' or 'rear' slips about" in either
    assert f": the drive does not tell which; if it is 'front', it is {SIZE}." in either
    assert "lidar 'front' may slip about" in said(replace(SLIP, sigmas=4.5))
    alone = said(replace(SLIP, alone=True))
    assert "Fasten the mount, and those of IMU and antenna, and record" in alone
    assert f"it is roughly {SIZE}" in alone
    together = said(replace(SLIP, lidars=("front", "rear")))
    assert "all lidars move together against the motion data about 13 s" in together
    assert f"they are {SIZE}. " in together
    assert "Check whether their common rack, the IMU or an antenna moved" in together
    assert slip_finding("drive", replace(SLIP, sigmas=3.9)) is None


def test_what_is_stated_is_told_of_where_the_result_is_far_from_it() -> None:
    assert moved_sentence({"gnss.lever_arm": 3.9, "imu.T_vehicle_imu": 0.2}) == ""
    said = moved_sentence({"gnss.lever_arm": 4.66, "imu.T_vehicle_imu": 3.4})
    assert said.startswith("gnss.lever_arm (4.7 sigma): the result is that far from what")
    both = moved_sentence({"gnss.lever_arm": 4.66, "imu.T_vehicle_imu.xyz": 5.24})
    assert both.startswith("gnss.lever_arm (4.7 sigma) and imu.T_vehicle_imu.xyz (5.2 sigma): ")
