"""What contradicts what: numbers by hand, and how often chance alone is called a contradiction."""

from __future__ import annotations

import math
from collections.abc import Mapping

import gtsam
import numpy as np
import pytest
from scipy.stats import binom, kstest

from caliv_graph.conventions import AXES
from caliv_graph.geometry.se3 import retract_vehicle_axes, right_to_vehicle_axes
from caliv_graph.products import Array, Guess, LidarResult
from caliv_graph.uncertainty.consistency import (
    BIAS,
    CHANCE,
    OUTLIERS,
    SCALE_LIMIT,
    Assumed,
    CheckInputs,
    CloudCount,
    Heading,
    ScoreTest,
    ScoreTestKind,
    against_guesses,
    chance,
    contradictions,
    contrasted,
    denied,
    difference,
    misfits,
    turned,
)
from tests.samples import MOUNTINGS, pose

GUESS_SIGMAS = np.array([0.03] * 3 + [0.058] * 3)
DATA_SIGMAS = np.array([1e-4, 1e-4, 2e-4, 2e-3, 2e-3, 5e-3])
ALL = dict.fromkeys(AXES, True)


def result(
    guess: gtsam.Pose3, off: Array, determined: Mapping[str, bool] = ALL, fixed: bool = False
) -> LidarResult:
    """A mounting that came out `off` (vehicle axes) its guess."""
    T = retract_vehicle_axes(guess, off)
    Q = right_to_vehicle_axes(T)
    return LidarResult(
        T_vehicle_lidar=T,
        cov=Q.T @ np.diag(DATA_SIGMAS**2) @ Q,
        determined=determined,
        scans_used=80,
        saw_target=True,
        guess=Guess(guess, GUESS_SIGMAS, fixed),
    )


def along(axis: str, size: float) -> Array:
    return np.asarray(size * np.eye(6)[AXES.index(axis)])


def split(
    d: Array, sigma: Array, kind: ScoreTestKind = "halves", lidar: str = "front"
) -> ScoreTest:
    """A contrast that comes out at d with these sigmas."""
    information = np.diag(np.atleast_1d(sigma) ** -2.0)
    return ScoreTest(lidar, kind, information, information @ np.atleast_1d(d))


def counted(down: int, clouds: int = 80, **changes: object) -> CloudCount:
    half = clouds // 2
    parts: dict[str, object] = {
        "left": (half, down // 2),
        "right": (half, down - down // 2),
        "early": (half, down // 2),
        "late": (half, down - down // 2),
    }
    return CloudCount("front", clouds, down, **{**parts, **changes})  # type: ignore[arg-type]


# ------------------------------------------------------------------ guesses


@pytest.mark.parametrize("name", ["front", "rear"])
def test_an_estimate_ten_sigma_off_its_guess_is_told_with_its_axis_and_the_likely_cause(
    name: str,
) -> None:
    lidar = result(pose(*MOUNTINGS[name]), along("x", -0.6))
    (text,) = against_guesses({name: lidar}, speed_m_s=2.0)
    x = MOUNTINGS[name][0][0]
    assert text.startswith(f"lidar '{name}': x is 0.60 m from the guess {x:.2f} +- 0.06: 10 sigma.")
    assert "0.30 s late at 2.0 m/s" in text
    (text,) = against_guesses({name: result(pose(*MOUNTINGS[name]), along("x", 0.6))}, 2.0)
    assert "0.30 s early" in text


def test_the_limit_is_five_sigma_of_guess_and_data_together() -> None:
    guess = pose(*MOUNTINGS["front"])
    for axis, guessed, data in zip(AXES, GUESS_SIGMAS, DATA_SIGMAS, strict=True):
        sigma = math.hypot(guessed, data)
        assert not against_guesses({"front": result(guess, along(axis, 4.99 * sigma))})
        (text,) = against_guesses({"front": result(guess, along(axis, -5.01 * sigma))})
        assert f"'front': {axis} is" in text


def test_what_is_held_trusted_or_never_seen_is_not_held_against_the_guess() -> None:
    guess, off = pose(*MOUNTINGS["front"]), along("x", 0.6)
    held = {**ALL, "x": False}
    assert not against_guesses({"front": result(guess, off, held)})
    assert not against_guesses({"front": result(guess, off, fixed=True)})


def test_swapped_topics_are_named() -> None:
    front, rear = pose(*MOUNTINGS["front"]), pose(*MOUNTINGS["rear"])
    lidars = {}
    for name, guess, found in (("front", front, rear), ("rear", rear, front)):
        lidar = result(guess, np.zeros(6))
        lidars[name] = LidarResult(found, lidar.cov, ALL, 80, True, guess=lidar.guess)
    texts = against_guesses(lidars)
    assert len(texts) == 2
    assert "It is where 'rear' was guessed to be: are their topics swapped?" in texts[0]


def test_a_wrong_sign_of_rpy_is_what_is_thought_of_for_a_wrong_rotation() -> None:
    (text,) = against_guesses({"front": result(pose(*MOUNTINGS["front"]), along("pitch", 0.35))})
    assert "pitch is 20.1 degrees from the guess +- 1.7: 12 sigma" in text
    assert "signs and the unit (degrees) of rpy_deg" in text


# ------------------------------------------------------------------ clouds


def test_so_many_clouds_that_do_not_fit_are_no_chance() -> None:
    least = next(k for k in range(81) if binom.sf(k - 1, 80, OUTLIERS) < CHANCE)
    assert 22 <= least <= 28  # a third of the clouds, not a tenth and not the half
    assert not misfits([counted(least - 1)])
    (text,) = misfits([counted(least, offset_vehicle=np.array([-0.2, 0.0, 0.05]))])
    assert f"{least} of its 80 clouds" in text
    assert "off by 0.21 m (-0.20 forward, +0.00 left, +0.05 up)" in text
    assert not misfits([counted(3, clouds=8)])


def test_where_they_are_is_told_if_most_are_in_one_part_of_the_drive() -> None:
    (text,) = misfits([counted(40, right=(40, 38), left=(40, 2))])
    assert "in right turns" in text
    (text,) = misfits([counted(40, early=(40, 0), late=(40, 40))])
    assert "in the second half" in text
    assert "turns" not in misfits([counted(40)])[0]
    # On an arc all clouds are in one turn: that says nothing.
    assert "turns" not in misfits([counted(40, right=(80, 40), left=(0, 0))])[0]


def test_registrations_that_would_have_to_be_coarse_are_a_contradiction() -> None:
    fine = CheckInputs({}, counts=[counted(0)], registration_scale=0.99 * SCALE_LIMIT)
    assert not contradictions(fine)
    late = split(np.array([0.017]), np.array([0.0028]), "clock")
    coarse = CheckInputs(
        {},
        score_tests=[late],
        counts=[counted(0)],
        registration_scale=10.0,
        registration_sigma=(0.032, 0.015),
    )
    text = contradictions(coarse)[0]
    assert "32 mrad and 15 mm, 10 times what the scatter of its points allows" in text
    assert "It shows most here: lidar 'front'" in text
    assert "17 +- 3 ms late" in text


# ------------------------------------------------------------------ score_tests


def test_p_values_of_contrasts_are_uniform_if_nothing_is_wrong() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(6, 9)) * (np.array([3e-4] * 3 + [3e-3] * 3)[:, None] / 3.0)
    cov = root @ root.T
    information = np.asarray(np.linalg.inv(cov), np.float64)
    p = []
    for _ in range(400):
        d = rng.multivariate_normal(np.zeros(6), cov) + BIAS * rng.normal(size=6)
        p.append(chance(ScoreTest("front", "turns", information, information @ d)))
    assert kstest(p, "uniform").pvalue > 0.01


def test_a_mounting_that_differs_is_told_with_its_size() -> None:
    sigma = np.array([2e-4] * 3 + [2e-3] * 3)
    text = contrasted(split(along("x", -0.05), sigma))
    # 50 mm over hypot(2, 5) mm: 9.3 sigma in one of six axes, a little less in all.
    assert "x by -50.0 +- 5.4 mm" in text
    assert "first half of its clouds and the second" in text
    assert not contrasted(split(along("x", 0.02), sigma))
    assert "left turns and right turns" in contrasted(split(along("yaw", 0.02), sigma, "turns"))
    assert "(fixed)" in contrasted(split(along("y", 0.2), sigma, "trust"))


def test_what_is_not_told_contradicts_nothing() -> None:
    vague = np.array([2e-4, 2e-4, math.inf, 2.0, 2e-3, 2e-3])
    d = np.array([0.0, 0.0, 5.0, 100.0, 0.0, 0.0])
    information = np.diag(vague**-2.0)
    contrast = ScoreTest("front", "halves", information, information @ d)
    assert not contrasted(contrast)
    found, _, directions = difference(contrast)
    assert directions.shape == (6, 4)
    assert not found.any()
    assert chance(ScoreTest("front", "halves", np.zeros((6, 6)), np.zeros(6))) == 1.0
    assert not contrasted(ScoreTest("front", "clock", np.zeros((1, 1)), np.zeros(1)))


def test_a_clock_is_told_beyond_five_sigma() -> None:
    sigma_s = 1e-3
    limit = 5.0 * math.hypot(sigma_s, 2e-3)
    assert not contrasted(split(np.array([0.99 * limit]), np.array([sigma_s]), "clock"))
    text = contrasted(split(np.array([0.3]), np.array([sigma_s]), "clock"))
    assert "seem 300 +- 2 ms late" in text
    assert "solve.time_offset" in text
    assert "early" in contrasted(split(np.array([-0.3]), np.array([sigma_s]), "clock"))


# ------------------------------------------------------------------ vehicle


def test_a_height_that_the_data_deny() -> None:
    height = "drive: height of the vehicle above the ground"
    assert not denied(Assumed(height, 0.024, 0.005, "m", "Check it"))
    text = denied(Assumed(height, -0.1, 0.005, "m", "Check it"))
    said = "the data have it -0.1 m from what the config says +- 0.005: 20 sigma. Check it"
    assert text == f"{height}: {said}"


def test_a_heading_a_degree_off_is_told_and_side_slip_is_not() -> None:
    degree = math.radians(1.0)
    text = turned(Heading("drive", degree, 1e-3, told_apart=True))
    assert "contradict each other by +1.00 +- 0.12 degrees (9 sigma)" in text
    # A rear axle that is off by a fifth of a degree is no contradiction, however well it is known.
    assert not turned(Heading("drive", math.radians(0.2), 1e-6, told_apart=True))
    measured = Heading("drive", degree, 3e-3, told_apart=True, measured=True)
    assert "+1.00 +- 0.17 degrees" in turned(measured)
    tiny = Heading("drive", math.radians(0.19), 1e-6, told_apart=True, measured=True)
    assert not turned(tiny)
    # On a single arc side slip, or a frame that is off the axle, looks like a turned heading.
    assert not turned(Heading("drive", degree, 1e-3, told_apart=False))


def test_together_the_tests_seldom_err() -> None:
    """Eight LiDARs of good data: six axes, three score_tests and a count each."""
    rng = np.random.default_rng(2)
    guess = pose(*MOUNTINGS["front"])
    total = np.hypot(GUESS_SIGMAS, DATA_SIGMAS)
    sigma = np.array([2e-4] * 3 + [2e-3] * 3)
    for _ in range(50):
        lidars = {str(i): result(guess, total * rng.normal(size=6)) for i in range(8)}
        spread = np.hypot(sigma, BIAS)
        score_tests = [
            split(spread * rng.normal(size=6), sigma, kind, name)
            for name in lidars
            for kind in ("halves", "turns")
        ]
        counts = [counted(int(rng.binomial(80, OUTLIERS))) for _ in lidars]
        assert not contradictions(CheckInputs(lidars, score_tests, counts, registration_scale=1.5))
