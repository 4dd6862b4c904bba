"""Sentences about contradictions: what, by how much, and what to check."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.conventions import AXES
from caliv_graph.products import Array, Guess
from caliv_graph.uncertainty.consistency import (
    Assumed,
    CloudCount,
    CoarseRegistrations,
    Creeping,
    GuessContradiction,
    Heading,
    RangesDisagree,
    ScoreTest,
    ScoreTestKind,
    Strain,
)
from caliv_graph.wording.contradictions import contradiction_sentence
from tests.samples import MOUNTINGS, pose

GUESS_SIGMAS = np.array([math.radians(1.73)] * 3 + [0.058] * 3)
FRONT = pose(*MOUNTINGS["front"])


def along(axis: str, size: float) -> Array:
    return np.asarray(size * np.eye(6)[AXES.index(axis)])


def off_guess(off: Array, swapped: str | None = None, late_s: float | None = None) -> str:
    axes = tuple(np.flatnonzero(off).tolist())
    guess = Guess(FRONT, GUESS_SIGMAS)
    return contradiction_sentence(
        GuessContradiction("front", guess, off, GUESS_SIGMAS, axes, swapped, late_s, 2.0)
    )


def split(
    d: Array, sigma: Array | float, kind: ScoreTestKind = "halves", lidar: str = "front"
) -> ScoreTest:
    information = np.diag(np.atleast_1d(sigma) ** -2.0)
    return ScoreTest(lidar, kind, information, information @ np.atleast_1d(d))


def counted(outliers: int, offset: Array | None = None, **parts: tuple[int, int]) -> CloudCount:
    halves = dict.fromkeys(("left", "right", "early", "late"), (40, outliers // 2))
    return CloudCount("front", 80, outliers, **{**halves, **parts}, offset_vehicle=offset)


def test_a_late_clock_explains_an_offset_along_x() -> None:
    assert off_guess(along("x", -0.58), late_s=0.29) == (
        "lidar 'front': x differs from the initial guess 2.00 +- 0.06 m by 0.58 m: 10 sigma. "
        "Stamps that are 0.29 s late at 2.0 m/s have this effect: check the clock of the LiDAR, "
        "then the guess"
    )
    assert "0.29 s early" in off_guess(along("x", 0.58), late_s=-0.29)


def test_swapped_topics_are_named() -> None:
    text = off_guess(along("x", -2.4), swapped="rear")
    assert "The estimate agrees with the guess of 'rear': check whether their topics are" in text


def test_a_wrong_rotation_may_be_a_wrong_sign() -> None:
    text = off_guess(along("pitch", 0.35))
    assert "pitch differs from the initial guess (+- 1.7 degrees) by 20.1 degrees: 12 sigma" in text
    assert "signs and the unit (degrees) of rpy_deg" in text
    assert "Check the guess (metres" in off_guess(along("y", 0.6))


def test_outliers_come_with_their_number_and_offset() -> None:
    assert contradiction_sentence(counted(25, np.array([-0.2, 0.0, 0.05]))) == (
        "lidar 'front': 25 of its 80 target clouds contradict the other clouds, median offset "
        "0.21 m (-0.20 forward, +0.00 left, +0.05 up); an outlier ratio of 10% does not explain "
        "that many. The result follows the other clouds, which may be the wrong ones: check its "
        "stamps, its mount and the target"
    )
    far = contradiction_sentence(counted(25, np.array([40.0, 0.0, 0.0])))
    assert ", median offset above 3 m;" in far


def test_the_part_of_the_drive_is_named_if_most_outliers_are_in_it() -> None:
    text = contradiction_sentence(counted(40, right=(40, 38), left=(40, 2)))
    assert "contradict the other clouds, 38 of them in right turns;" in text
    text = contradiction_sentence(counted(40, early=(40, 0), late=(40, 40)))
    assert "in the second half" in text
    assert "turns" not in contradiction_sentence(counted(40))
    # On an arc all clouds are in one turn: that is no information.
    assert "turns" not in contradiction_sentence(counted(40, right=(80, 40), left=(0, 0)))


def test_coarse_registrations_name_where_it_shows_most() -> None:
    late = split(np.array([0.017]), 0.0028, "clock")
    both = ("front", "rear")
    assert contradiction_sentence(CoarseRegistrations(10.0, (0.032, 0.015), both, late)) == (
        "the target clouds (lidars 'front' and 'rear') and the motion of the vehicle contradict "
        "each other: they fit only with registration errors of 32 mrad and 15 mm, 10 times what "
        "the scatter of their points gives (limit 5). It shows most here: lidar 'front': its "
        "stamps and the motion of the vehicle contradict each other: the stamps are 17 +- 3 ms "
        "late (5 sigma). Check the stamps of every LiDAR, and that no mount and no target moved"
    )
    text = contradiction_sentence(CoarseRegistrations(10.0, (0.032, 0.015), both, counted(3)))
    assert "It shows most here: lidar 'front': 3 of its 80 target clouds contradict" in text
    assert "shows most" not in contradiction_sentence(
        CoarseRegistrations(10.0, (0.032, 0.015), both, None)
    )


def test_a_registration_that_has_not_come_to_rest_says_how_it_moves() -> None:
    found = Creeping(240, 2e-4, 0.0017, 1.4, ("front", "rear"))
    assert contradiction_sentence(found) == (
        "the registration has not come to rest: at the end of 240 iterations LiDARs still moved by "
        "up to 0.20 mrad and 1.7 mm (1.4 sigma) in one; they may be off by many of their sigmas. "
        "Give better initial guesses (lidars.<name>.initial), a target with edges that all LiDARs "
        "see, or structure around it"
    )
    assert contradiction_sentence(found, led=True).endswith("many of their sigmas")
    slow = contradiction_sentence(replace(found, sigmas=0.4, way_sigmas=3.7))
    assert "(0.4 sigma) in one, and by 4 sigma in the last ten; they may" in slow


def test_extrinsics_that_differ_come_with_their_size() -> None:
    sigma = np.array([2e-4] * 3 + [2e-3] * 3)
    # 50 mm over hypot(2, 5) mm: 9.3 sigma in one of six axes, a little less in all.
    assert contradiction_sentence(split(along("x", -0.05), sigma)) == (
        "lidar 'front': its extrinsics from the first and from the second half of its clouds "
        "differ: x by -50.0 +- 5.4 mm (8 sigma in total). Check whether its mount or the target "
        "moved during the drive, and its clock"
    )
    turns = contradiction_sentence(split(along("yaw", 0.02), sigma, "turns"))
    assert "from left turns and from right turns differ: yaw by +20.0 +- 1.0 mrad" in turns
    assert "(fixed: true)" in contradiction_sentence(split(along("y", 0.2), sigma, "trust"))


def test_a_clock_comes_with_its_lateness() -> None:
    text = contradiction_sentence(split(np.array([0.3]), 1e-3, "clock"))
    assert "the stamps are 300 +- 2 ms late" in text
    assert text.endswith("Correct its clock, or set solve.time_offset")
    assert "early" in contradiction_sentence(split(np.array([-0.3]), 1e-3, "clock"))


@pytest.mark.parametrize(
    ("found", "text"),
    [
        (
            Assumed("drive", "height", -0.1, 0.005),
            "drive: the height of the vehicle frame above the ground differs from the config by "
            "-0.1 m (sigma 0.005 m): 20 sigma. Check ground.vehicle_height and ground.sigma",
        ),
        (
            Assumed("drive", "tilt_y", 0.02, 0.001),
            "drive: the tilt of the vehicle against the ground (y) differs from the config by "
            "+0.02 rad (sigma 0.001 rad): 20 sigma. Check ground.parallel_sigma_deg and "
            "imu.T_vehicle_imu",
        ),
    ],
    ids=["height", "tilt"],
)
def test_an_assumption_comes_with_its_key(found: Assumed, text: str) -> None:
    assert contradiction_sentence(found) == text


def test_a_heading_comes_with_its_angle_and_the_allowance() -> None:
    degree = math.radians(1.0)
    text = contradiction_sentence(Heading("drive", degree, 1e-3, told_apart=True))
    assert "contradict each other by +1.00 +- 0.12 degrees (9 sigma)" in text
    measured = Heading("drive", degree, 3e-3, told_apart=True, measured=True)
    assert "+1.00 +- 0.17 degrees" in contradiction_sentence(measured)


def test_without_an_orientation_source_the_mounting_of_the_imu_is_what_tells_the_heading() -> None:
    found = Heading("drive", math.radians(-3.0), 1e-3, told_apart=True, source="none")
    text = contradiction_sentence(found)
    assert "the yaw of imu.T_vehicle_imu and the direction of travel" in text
    assert text.endswith("Check imu.T_vehicle_imu: -3.0 degrees more of yaw would fit")
    assert "yaw_bias" in contradiction_sentence(replace(found, source="imu"))
    text = contradiction_sentence(replace(found, source="antennas"))
    assert text.endswith("Check heading.yaw_deg and the antennas of topics.heading")


def test_ranges_that_disagree_give_no_advice_after_a_suspect() -> None:
    found = RangesDisagree(0.013, ("front", "rear"))
    alone, after = contradiction_sentence(found), contradiction_sentence(found, led=True)
    assert alone.startswith(f"{after}. Check the range calibration of the LiDARs")
    assert after.endswith("off by at least 13 mm (1 sigma; limit 10 mm)")


def test_poses_that_are_strained_come_with_the_keys_of_the_noise() -> None:
    found = Strain("drive", 3844.0, 961)
    text = contradiction_sentence(found)
    assert "drive 'drive'" in text
    assert "2.0 times" in text
    assert "gyroscope_density_rad_s_sqrthz" in text
    assert "data sheets" not in contradiction_sentence(found, led=True)
