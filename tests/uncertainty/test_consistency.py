"""What contradicts what: numbers by hand, and how often chance alone is called a contradiction."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.stats import binom, kstest

from caliv_graph.conventions import AXES
from caliv_graph.geometry.se3 import (
    retract_vehicle_axes,
    right_to_vehicle_axes,
    vehicle_axes_difference,
)
from caliv_graph.products import Array, Guess, LidarResult, PoseFrame
from caliv_graph.uncertainty.consistency import (
    CONTRADICTION_P,
    OUTLIERS,
    REGISTRATION_BIAS,
    SCALE_LIMIT,
    Assumed,
    CheckInputs,
    CloudCount,
    CoarseRegistrations,
    GuessContradiction,
    GuessesTogether,
    Heading,
    ScoreTest,
    ScoreTestKind,
    Strain,
    against_guesses,
    assumption_contradicted,
    contradictions,
    difference,
    heading_contradicted,
    lateness,
    p_value,
    perhaps_together,
    too_many_outliers,
)
from caliv_graph.wording.contradictions import (
    PosesGiven,
    contradiction_sentence,
    together_doubt,
)
from tests.samples import MOUNTINGS, pose

GUESS_SIGMAS = np.array([0.03] * 3 + [0.058] * 3)
DATA_SIGMAS = np.array([1e-4, 1e-4, 2e-4, 2e-3, 2e-3, 5e-3])
ALL = dict.fromkeys(AXES, True)


def result(
    guess: gtsam.Pose3, off: Array, determined: Mapping[str, bool] = ALL, fixed: bool = False
) -> LidarResult:
    """An extrinsic estimated `off` (vehicle axes) its guess."""
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
    """A score test whose difference is d with these sigmas."""
    information = np.diag(np.atleast_1d(sigma) ** -2.0)
    return ScoreTest(lidar, kind, information, information @ np.atleast_1d(d))


def counted(outliers: int, clouds: int = 80) -> CloudCount:
    one, other = (clouds // 2, outliers // 2), (clouds // 2, outliers - outliers // 2)
    return CloudCount("front", clouds, outliers, one, other, one, other)


# ------------------------------------------------------------------ guesses


@pytest.mark.parametrize("name", ["front", "rear"])
def test_an_estimate_ten_sigma_off_its_guess_is_found_with_its_axis_and_the_likely_cause(
    name: str,
) -> None:
    guess = pose(*MOUNTINGS[name])
    (found,) = against_guesses({name: result(guess, along("x", -0.6))}, speed_m_s=2.0)

    assert found.lidar == name
    assert found.axes == (3,)
    assert found.difference == pytest.approx(along("x", -0.6))
    assert found.sigma == pytest.approx(np.hypot(GUESS_SIGMAS, DATA_SIGMAS))
    assert found.late_s == pytest.approx(0.3)
    assert found.swapped_with is None
    (found,) = against_guesses({name: result(guess, along("x", 0.6))}, 2.0)
    assert found.late_s == pytest.approx(-0.3)
    (found,) = against_guesses({name: result(guess, along("y", 0.6))}, 2.0)
    assert found.late_s is None
    (found,) = against_guesses({name: result(guess, along("x", 0.6))}, speed_m_s=0.0)
    assert found.late_s is None


def test_the_limit_is_five_sigma_of_guess_and_data_together() -> None:
    guess = pose(*MOUNTINGS["front"])
    for i, (axis, guessed, data) in enumerate(zip(AXES, GUESS_SIGMAS, DATA_SIGMAS, strict=True)):
        sigma = math.hypot(guessed, data)
        assert not [*against_guesses({"front": result(guess, along(axis, 4.99 * sigma))})]
        (found,) = against_guesses({"front": result(guess, along(axis, -5.01 * sigma))})
        assert found.axes == (i,)


def test_the_worst_axis_comes_first() -> None:
    off = along("y", 0.5) + along("z", -0.9)
    (found,) = against_guesses({"front": result(pose(*MOUNTINGS["front"]), off)})
    assert found.axes == (5, 4)


def test_what_is_held_trusted_or_never_seen_is_not_held_against_the_guess() -> None:
    guess, off = pose(*MOUNTINGS["front"]), along("x", 0.6)
    held = {**ALL, "x": False}
    assert not [*against_guesses({"front": result(guess, off, held)})]
    assert not [*against_guesses({"front": result(guess, off, fixed=True)})]
    unseen = replace(result(guess, off), saw_target=False)
    assert not [*against_guesses({"front": unseen})]


def test_swapped_topics_are_found() -> None:
    front, rear = pose(*MOUNTINGS["front"]), pose(*MOUNTINGS["rear"])
    lidars = {}
    for name, guess, found in (("front", front, rear), ("rear", rear, front)):
        lidar = result(guess, np.zeros(6))
        lidars[name] = LidarResult(found, lidar.cov, ALL, 80, True, guess=lidar.guess)
    assert [found.swapped_with for found in against_guesses(lidars)] == ["rear", "front"]
    assert not any(found.mirrored for found in against_guesses(lidars))


def test_swapped_guesses_of_either_side_mirror_each_other() -> None:
    """Topics that are swapped, or y to the right: the estimates do not tell which."""
    left = pose((1.2, 0.6, 1.8), (0.0, 3.0, 40.0))
    right = pose((1.23, -0.57, 1.77), (2.0, 1.0, -42.0))
    lidars = {}
    for name, guess, found in (("left", right, left), ("right", left, right)):
        lidar = result(guess, np.zeros(6))
        lidars[name] = LidarResult(found, lidar.cov, ALL, 80, True, guess=lidar.guess)
    contradictions = [*against_guesses(lidars)]
    assert [found.mirrored for found in contradictions] == [True, True]
    assert "y counts to the right" in contradiction_sentence(contradictions[0])


def test_clouds_that_are_in_another_frame_already_are_named() -> None:
    """Of the vehicle, height unknown, or of another LiDAR: there is no place for a second one."""
    front, rear = pose(*MOUNTINGS["front"]), pose(*MOUNTINGS["rear"])
    level = {**ALL, "z": False}
    lidars = {"front": result(front, np.zeros(6)), "rear": result(rear, np.zeros(6), level)}
    lidars["rear"] = replace(
        lidars["rear"], T_vehicle_lidar=pose((0.01, 0.0, 2.0), (0.1, 0.0, 0.1))
    )
    (found,) = against_guesses(lidars)
    assert "The estimate is the vehicle frame" in contradiction_sentence(found)
    lidars["rear"] = replace(
        lidars["rear"], T_vehicle_lidar=retract_vehicle_axes(front, along("x", 0.01))
    )
    lidars["front"] = replace(lidars["front"], guess=None)  # at its guess, topics were swapped
    (found,) = against_guesses(lidars)
    assert found.frame is None  # one above the other on a mast
    lidars["rear"] = replace(lidars["rear"], determined=ALL)
    (found,) = against_guesses(lidars)
    assert "The estimate is that of 'front': the clouds of 'rear'" in contradiction_sentence(found)
    lidars["rear"] = replace(
        lidars["rear"], T_vehicle_lidar=retract_vehicle_axes(front, along("x", 0.3))
    )
    (found,) = against_guesses(lidars)
    assert found.frame is None


def test_guesses_of_another_vehicle_frame_are_off_together() -> None:
    """Those of a frame 0.8 m behind, turned by 12 degrees; errors of the guesses on top."""
    T = pose((-0.8, 0.0, 0.0), (0.0, 0.0, 12.0))
    lidars = {}
    for sign, (name, mounting) in zip((1.0, -1.0, 0.5), MOUNTINGS.items(), strict=True):
        guess = T.inverse().compose(pose(*mounting))
        guess = retract_vehicle_axes(guess, sign * along("y", 0.05))
        lidar = result(guess, np.zeros(6))
        lidars[name] = replace(lidar, T_vehicle_lidar=pose(*mounting))
    (found,) = contradictions(CheckInputs(lidars=lidars))
    assert isinstance(found, GuessesTogether)
    assert found.lidars == tuple(MOUNTINGS)
    off = vehicle_axes_difference(found.T_vehicle_guessed, T)
    assert np.abs(off).max() < 0.03
    assert "moved by (-0.8" in contradiction_sentence(found)
    assert "turned by (+0.0, +0.0, +12.0) degrees" in contradiction_sentence(found)
    assert "mounts of IMU, antenna and wheels" in contradiction_sentence(found)
    posed = PosesGiven("topics.pose", PoseFrame("gps", "base_link", T.inverse()))
    assert "whose poses are of the frame 'gps'" in contradiction_sentence(found, given=posed)
    # What /tf_static explains needs no clock.
    late = replace(found, late_s=0.4, speed_m_s=2.0)
    assert "Stamps of all LiDARs that are 0.40 s late" in contradiction_sentence(late)
    assert "Stamps" not in contradiction_sentence(late, given=posed)
    # One that is right as it is: then the others are off for themselves.
    lidars["front"] = result(pose(*MOUNTINGS["front"]), np.zeros(6))
    alone = contradictions(CheckInputs(lidars=lidars))
    assert {each.lidar for each in alone if isinstance(each, GuessContradiction)} == {
        "rear",
        "left",
    }


def test_guesses_that_are_each_off_too_little_are_told_by_what_they_have_in_common() -> None:
    """Three, 3.5 sigma each in y: by chance their mean is as far off once in 500,000 rigs."""
    off = along("y", 3.5 * float(GUESS_SIGMAS[4]))
    lidars = {name: result(pose(*at), off) for name, at in MOUNTINGS.items()}
    assert contradictions(CheckInputs(lidars=lidars)) == ()
    found = perhaps_together(lidars)
    assert found is not None
    assert 4.5 < found.sigmas < 6.1
    said = together_doubt(found)
    assert "the initial guesses may all be off by the same" in said
    assert "mounts of IMU, antenna and wheels" in said
    far = {name: result(pose(*at), 1.3 * off) for name, at in MOUNTINGS.items()}
    (beyond,) = contradictions(CheckInputs(lidars=far))
    assert isinstance(beyond, GuessesTogether)
    # The error of the poses is in all of them alike, and does not average.
    wide = {name: replace(of, cov=of.cov + np.eye(6) * 0.05**2) for name, of in lidars.items()}
    assert perhaps_together(wide) is None
    # To opposite sides: each for itself, and not beyond 5 sigma.
    lidars["rear"] = result(pose(*MOUNTINGS["rear"]), -off)
    assert perhaps_together(lidars) is None


def test_guesses_that_are_off_by_something_of_their_own_are_not_off_together() -> None:
    lidars = {
        name: result(pose(*MOUNTINGS[name]), along("x", off))
        for name, off in (("front", 0.8), ("rear", -0.8))
    }
    found = contradictions(CheckInputs(lidars=lidars))
    assert [type(each) for each in found] == [GuessContradiction] * 2


def test_a_motion_that_explains_a_part_of_two_guesses_does_not_make_them_off_together() -> None:
    """One is off in x and one in y: by the half of both, each would be 1.7 sigma off."""
    sigma = float(GUESS_SIGMAS[3])
    lidars = {
        name: result(pose(*MOUNTINGS[name]), along(axis, 5.5 * sigma))
        for name, axis in (("front", "x"), ("rear", "y"))
    }
    found = contradictions(CheckInputs(lidars=lidars))
    assert [type(each) for each in found] == [GuessContradiction] * 2


@pytest.mark.parametrize("doubt", ["trusted", "x", "yaw"])
def test_what_does_not_tell_the_frame_of_the_guesses_blames_each(doubt: str) -> None:
    """A third LiDAR that is trusted and fits; axes that the drive does not determine."""
    off = along("x", 1.0)
    lidars = {name: result(pose(*MOUNTINGS[name]), off) for name in ("front", "rear")}
    (found,) = contradictions(CheckInputs(lidars=lidars))
    assert isinstance(found, GuessesTogether)
    if doubt == "trusted":
        left = result(pose(*MOUNTINGS["left"]), np.zeros(6))
        assert left.guess is not None
        lidars["left"] = replace(left, guess=replace(left.guess, fixed=True))
    else:
        front = lidars["front"]
        lidars["front"] = replace(front, determined={**front.determined, doubt: False})
    found_now = contradictions(CheckInputs(lidars=lidars))
    assert found_now
    assert all(isinstance(each, GuessContradiction) for each in found_now)


# ------------------------------------------------------------------ clouds


def test_outliers_are_too_many_where_their_ratio_is_no_chance() -> None:
    least = next(k for k in range(81) if binom.sf(k - 1, 80, OUTLIERS) < CONTRADICTION_P)
    assert 22 <= least <= 28  # a third of the clouds, not a tenth and not the half
    assert not too_many_outliers(counted(least - 1))
    assert too_many_outliers(counted(least))
    assert not too_many_outliers(counted(3, clouds=8))


def test_registrations_that_would_have_to_be_coarse_are_a_contradiction() -> None:
    fine = CheckInputs({}, counts=[counted(0)], registration_scale=0.99 * SCALE_LIMIT)
    assert not contradictions(fine)
    late = split(np.array([0.009]), np.array([0.0015]), "clock")
    coarse = CheckInputs(
        {},
        score_tests=[split(np.zeros(6), DATA_SIGMAS), late],
        counts=[counted(0)],
        registration_scale=10.0,
        registration_sigma=(0.032, 0.015),
    )
    # 9 ms over hypot(1.5, 2) ms: 3.6 sigma, not enough by itself and enough to be named.
    (found,) = contradictions(coarse)
    assert found == CoarseRegistrations(10.0, (0.032, 0.015), ("front",), late)
    few = replace(coarse, counts=[counted(0), replace(counted(2), lidar="rear")])
    (found,) = contradictions(few)
    assert isinstance(found, CoarseRegistrations)
    assert found.likely == few.counts[1]


# ------------------------------------------------------------------ score tests


def test_p_values_of_score_tests_are_uniform_if_nothing_is_wrong() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(6, 9)) * (np.array([3e-4] * 3 + [3e-3] * 3)[:, None] / 3.0)
    cov = root @ root.T
    information = np.asarray(np.linalg.inv(cov), np.float64)
    p = []
    for _ in range(400):
        d = rng.multivariate_normal(np.zeros(6), cov) + REGISTRATION_BIAS * rng.normal(size=6)
        p.append(p_value(ScoreTest("front", "turns", information, information @ d)))
    assert kstest(p, "uniform").pvalue > 0.01


def test_an_extrinsic_that_differs_is_found_with_its_size() -> None:
    sigma = np.array([2e-4] * 3 + [2e-3] * 3)
    test = split(along("x", -0.05), sigma)
    d, cov, _ = difference(test)
    assert d == pytest.approx(along("x", -0.05))
    # hypot(2, 5) mm.
    assert math.sqrt(cov[3, 3]) == pytest.approx(5.39e-3, rel=1e-3)
    assert contradictions(CheckInputs({}, [test])) == (test,)
    assert not contradictions(CheckInputs({}, [split(along("x", 0.02), sigma)]))


def test_what_is_undetermined_contradicts_nothing() -> None:
    vague = np.array([2e-4, 2e-4, math.inf, 2.0, 2e-3, 2e-3])
    d = np.array([0.0, 0.0, 5.0, 100.0, 0.0, 0.0])
    information = np.diag(vague**-2.0)
    test = ScoreTest("front", "halves", information, information @ d)
    found, _, directions = difference(test)
    assert directions.shape == (6, 4)
    assert not found.any()
    assert p_value(test) == 1.0
    assert p_value(ScoreTest("front", "halves", np.zeros((6, 6)), np.zeros(6))) == 1.0
    assert p_value(ScoreTest("front", "clock", np.zeros((1, 1)), np.zeros(1))) == 1.0


def test_a_clock_contradicts_beyond_five_sigma() -> None:
    sigma_s = 1e-3
    limit = 5.0 * math.hypot(sigma_s, 2e-3)
    for size, wrong in ((0.99, False), (1.01, True), (-1.01, True)):
        test = split(np.array([size * limit]), np.array([sigma_s]), "clock")
        assert lateness(test) == pytest.approx((size * limit, math.hypot(sigma_s, 2e-3)))
        assert bool(contradictions(CheckInputs({}, [test]))) is wrong


# ------------------------------------------------------------------ vehicle


def test_a_height_beyond_five_sigma_of_its_assumption_is_contradicted() -> None:
    assert not assumption_contradicted(Assumed("drive", "height", 0.024, 0.005))
    assert assumption_contradicted(Assumed("drive", "height", -0.026, 0.005))


def test_a_heading_a_degree_off_is_found_and_side_slip_is_not() -> None:
    degree = math.radians(1.0)
    heading = Heading("drive", degree, 1e-3, told_apart=True)
    assert heading_contradicted(heading)
    assert heading.sigma_with_allowance_rad == pytest.approx(math.hypot(1e-3, math.radians(0.1)))
    # A rear axle that is off by a fifth of a degree is no contradiction, however well it is known.
    assert not heading_contradicted(Heading("drive", math.radians(0.2), 1e-6, told_apart=True))
    measured = Heading("drive", degree, 3e-3, told_apart=True, measured=True)
    assert heading_contradicted(measured)
    assert measured.sigma_with_allowance_rad == 3e-3
    tiny = Heading("drive", math.radians(0.19), 1e-6, told_apart=True, measured=True)
    assert not heading_contradicted(tiny)
    # On a single arc side slip, or a frame that is off the axle, looks like a turned heading.
    assert not heading_contradicted(Heading("drive", degree, 1e-3, told_apart=False))


def test_together_the_tests_seldom_err() -> None:
    """Eight LiDARs of good data: six axes, two score tests and a count each."""
    rng = np.random.default_rng(2)
    guess = pose(*MOUNTINGS["front"])
    total = np.hypot(GUESS_SIGMAS, DATA_SIGMAS)
    sigma = np.array([2e-4] * 3 + [2e-3] * 3)
    for _ in range(50):
        lidars = {str(i): result(guess, total * rng.normal(size=6)) for i in range(8)}
        spread = np.hypot(sigma, REGISTRATION_BIAS)
        score_tests = [
            split(spread * rng.normal(size=6), sigma, kind, name)
            for name in lidars
            for kind in ("halves", "turns")
        ]
        counts = [counted(int(rng.binomial(80, OUTLIERS))) for _ in lidars]
        assert not contradictions(CheckInputs(lidars, score_tests, counts, registration_scale=1.5))


@pytest.mark.parametrize(
    ("chi_square", "coordinates", "contradicted"),
    [
        (500.0, 960, False),  # all sigmas right
        (1200.0, 960, False),  # beyond chance, but sigmas are not known to a tenth
        (2400.0, 960, False),  # a drive that was right
        (5100.0, 960, True),
        (80.0, 18, True),
        (14.0, 6, False),  # large, but chance does it
    ],
)
def test_poses_far_from_the_motion_data_contradict_them(
    chi_square: float, coordinates: int, contradicted: bool
) -> None:
    strain = Strain("drive", chi_square, coordinates)
    found = contradictions(CheckInputs(lidars={}, strains=[strain]))
    assert found == ((strain,) if contradicted else ())
