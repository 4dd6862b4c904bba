from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

from caliv_graph.config.guesses import TRUSTED_SIGMAS
from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config
from caliv_graph.errors import ConfigError
from caliv_graph.fusion.merge import Merger, merge, starting_from, with_earlier
from caliv_graph.geometry.se3 import (
    retract_vehicle_axes,
    right_to_vehicle_axes,
    vehicle_axes_difference,
)
from caliv_graph.products import Array, Calibration, Guess, Suspect
from caliv_graph.results.calibration_file import read_calibration, write_calibration
from caliv_graph.uncertainty.pairs import sigmas_s2v
from caliv_graph.wording.remedies import OF_ODOMETRY, OF_STRUCTURE
from tests.fusion.drives import (
    TRUTH,
    arc_information,
    draw,
    drive,
    information,
    shift,
    turned_on_its_arc,
)

NAMES = ("front", "rear")


def merged(*calibrations: Calibration) -> Calibration:
    return merger(*calibrations).calibration


def merger(*calibrations: Calibration) -> Merger:
    return merge({f"{letter}.yaml": c for letter, c in zip("abc", calibrations, strict=False)})


def in_vehicle_axes(calibration: Calibration, matrix: Array) -> Array:
    n = len(calibration.lidars)
    axes = np.zeros((6 * n, 6 * n))
    for i, lidar in enumerate(calibration.lidars.values()):
        axes[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = right_to_vehicle_axes(lidar.T_vehicle_lidar)
    return np.asarray(axes @ matrix @ axes.T)


def errors(calibration: Calibration) -> Array:
    return np.concatenate(
        [
            vehicle_axes_difference(lidar.T_vehicle_lidar, TRUTH[name])
            for name, lidar in calibration.lidars.items()
        ]
    )


def test_two_drives_by_hand() -> None:
    """Informations add up, and the estimate is their weighted mean; the guess has no weight."""
    rng = np.random.default_rng(1)
    D = [information(NAMES, 1), information(NAMES, 2)]
    e = [draw(d, rng) for d in D]
    parts = [
        drive(d, source=s, error=err, guess_error=np.full(12, 0.02))
        for d, s, err in zip(D, "ab", e, strict=True)
    ]

    result = merged(*parts)

    total = D[0] + D[1]
    mean = np.linalg.solve(total, D[0] @ e[0] + D[1] @ e[1])
    # To first order: the errors are of milliradians.
    assert errors(result) == pytest.approx(mean, abs=2e-5)
    scale = 1e-2 * np.sqrt(np.outer(np.diag(total), np.diag(total)))
    assert (np.abs(in_vehicle_axes(result, result.information_data) - total) < scale).all()
    cov = in_vehicle_axes(result, result.cov_joint)
    sigma = np.sqrt(np.diag(np.linalg.inv(total)))
    assert np.sqrt(np.diag(cov)) == pytest.approx(sigma, rel=1e-2)
    assert result.status == "ok"
    assert result.lidars["front"].scans_used == 100


def test_left_and_right_arc_determine_what_neither_does() -> None:
    """A left arc and a right arc as two drives determine what neither does alone."""
    right, left = arc_information(NAMES, 1), arc_information(NAMES, 2, left=True)
    guess = shift(NAMES, "front", x=0.05, yaw=0.01) + shift(NAMES, "rear", x=0.02, yaw=-0.02)
    parts = [
        drive(right, source="a", guess_error=guess),
        drive(left, source="b", guess_error=guess),
    ]
    assert all(not part.lidars["front"].determined["yaw"] for part in parts)
    assert all(np.abs(errors(part)).max() > 0.01 for part in parts)

    result = merged(*parts)

    assert result.status == "ok"
    assert result.undetermined == ()
    assert all(all(lidar.determined.values()) for lidar in result.lidars.values())
    assert errors(result) == pytest.approx(np.zeros(12), abs=1e-4)


def test_the_guess_counts_once() -> None:
    """Two arcs of one radius: along what they leave open, the sigma is that of one guess."""
    D = arc_information(NAMES)
    guess = shift(NAMES, "front", x=0.05) + shift(NAMES, "rear", yaw=0.01)
    parts = [drive(D, source=s, guess_error=guess) for s in "ab"]

    result = merged(*parts)

    assert result.status == "partial"
    (direction,) = result.undetermined
    assert "turn centre" in direction.text
    sigma = np.sqrt(np.diag(in_vehicle_axes(result, result.cov_joint)))
    alone = np.sqrt(np.diag(in_vehicle_axes(parts[0], parts[0].cov_joint)))
    # x and yaw are the guess's; the others are known better by what two drives say.
    assert sigma[[2, 3]] == pytest.approx(alone[[2, 3]], rel=0.05)
    assert (sigma[[0, 1, 5]] < 0.75 * alone[[0, 1, 5]]).all()
    assert errors(result) == pytest.approx(errors(parts[0]), abs=1e-5)


def on_an_arc_without_guesses(source: str, *, left: bool = False) -> Calibration:
    """Nothing on the rotation of all about the centre of a turn; nobody gave a guess."""
    return drive(arc_information(NAMES, left=left), source=source, found=True)


def test_fusing_drives_without_guesses_makes_up_no_knowledge() -> None:
    """Rotation (pi, 1 sigma) and place (10 m) of two LiDARs bound the turn about the centre."""
    first, second = (on_an_arc_without_guesses(source) for source in "ab")
    # y of 'front' is open too: it goes sideways by a fifth of what it goes along x.
    open_axes = {"front": ["yaw", "x", "y"], "rear": ["yaw", "x", "y"]}
    arms = np.array([[2.0, 9.16], [-0.4, 9.16]])
    turn = (2.0 * np.pi**-2.0 + (arms**2).sum() / 10.0**2) ** -0.5

    with_prior, _ = with_earlier(second, first)

    for result in (first, merged(first, second), with_prior):
        cov = in_vehicle_axes(result, result.cov_joint)
        sigmas = np.sqrt(np.diag(cov)).reshape(2, 6)
        assert sigmas[:, 2] == pytest.approx(turn, rel=1e-3)
        assert sigmas[:, 3] == pytest.approx(9.16 * turn, rel=1e-3)
        assert sigmas[:, 4] == pytest.approx([2.0 * turn, 0.4 * turn], rel=1e-2)
        assert {
            name: [axis for axis, known in lidar.determined.items() if not known]
            for name, lidar in result.lidars.items()
        } == open_axes
        for i, lidar in enumerate(result.lidars.values()):
            block = slice(6 * i, 6 * i + 6)
            assert lidar.cov == pytest.approx(result.cov_joint[block, block], abs=1e-12)


def test_a_guess_given_for_one_drive_is_enough_for_both() -> None:
    given = drive(arc_information(NAMES), source="a")
    found = on_an_arc_without_guesses("b")

    for result in (merged(found, given), with_earlier(found, given)[0]):
        both = [np.sqrt(np.diag(in_vehicle_axes(c, c.cov_joint))) for c in (result, given)]
        sigma, of_given = both
        assert sigma[[2, 3, 8, 9]] == pytest.approx(of_given[[2, 3, 8, 9]], rel=0.05)
        assert result.lidars["front"].determined == given.lidars["front"].determined


def test_arcs_to_both_sides_need_no_guess() -> None:
    result = merged(on_an_arc_without_guesses("a"), on_an_arc_without_guesses("b", left=True))

    assert result.status == "ok"
    assert (np.sqrt(np.diag(in_vehicle_axes(result, result.cov_joint))) < 0.02).all()


@pytest.mark.parametrize("turn_rad", [0.05, 0.215])
def test_how_far_solves_without_guesses_ended_does_not_matter(turn_rad: float) -> None:
    """A turn of 0.2 rad about a centre 9 m away leaves its tangent by 0.2 m."""
    right = turned_on_its_arc(turn_rad, source="a")
    left = turned_on_its_arc(-turn_rad, source="b", left=True)

    for result in (merged(right, left), with_earlier(left, right)[0]):
        assert result.status == "ok"
        assert errors(result) == pytest.approx(np.zeros(12), abs=1e-5)


def test_a_lidar_without_guess_that_no_drive_shows_is_not_known() -> None:
    D = information(NAMES)
    D[:6], D[:, :6] = 0.0, 0.0
    first, second = (drive(D, source=source, found=True) for source in "ab")

    for result in (merged(first, second), with_earlier(second, first)[0]):
        sigma = np.sqrt(np.diag(in_vehicle_axes(result, result.cov_joint)))
        assert sigma[:6] == pytest.approx([np.pi] * 3 + [10.0] * 3)
        assert (sigma[6:] < 0.02).all()


def test_order_and_reference_do_not_matter() -> None:
    rng = np.random.default_rng(3)
    D = [information(("front", "rear"), 1), information(("left", "rear"), 2)]
    parts = [
        drive(D[0], ("front", "rear"), source="a", error=draw(D[0], rng), reference="front"),
        drive(D[1], ("left", "rear"), source="b", error=draw(D[1], rng), reference="rear"),
    ]

    there, back = merged(*parts), merged(*reversed(parts))

    assert (list(there.lidars), there.reference) == (["front", "rear", "left"], "front")
    assert (list(back.lidars), back.reference) == (["left", "rear", "front"], "rear")
    for name in there.lidars:
        ours, theirs = there.lidars[name], back.lidars[name]
        assert ours.T_vehicle_lidar.equals(theirs.T_vehicle_lidar, 1e-8)
        assert ours.cov == pytest.approx(theirs.cov, rel=1e-5, abs=1e-14)
    # Front and left never saw the same drive; the rear, which saw both, ties them together.
    assert np.abs(there.cov_joint[:6, 12:]).max() > 0.0


def test_a_lidar_that_no_drive_saw_stays_at_its_guess() -> None:
    D = information(NAMES)
    D[:6], D[:, :6] = 0.0, 0.0
    guess = shift(NAMES, "front", x=0.03, pitch=0.01)
    parts = [drive(D, source=s, guess_error=guess) for s in "ab"]

    result = merged(*parts)

    front = result.lidars["front"]
    assert not front.saw_target
    assert not any(front.determined.values())
    assert vehicle_axes_difference(front.T_vehicle_lidar, TRUTH["front"]) == pytest.approx(
        guess[:6], abs=1e-9
    )
    sigma = np.sqrt(np.diag(in_vehicle_axes(result, result.cov_joint)))[:6]
    guessed = front.guess
    assert guessed is not None
    assert sigma == pytest.approx(guessed.sigmas, rel=1e-6)


def test_a_guess_that_was_given_counts_before_one_that_was_found() -> None:
    D = information(NAMES)
    D[:6], D[:, :6] = 0.0, 0.0
    guess = shift(NAMES, "front", x=0.03, pitch=0.01)
    one, other = (drive(D, source=s, guess_error=e) for s, e in (("a", 3.0 * guess), ("b", guess)))
    front = one.lidars["front"]
    assert front.guess is not None
    found = replace(front, guess=replace(front.guess, found=True))
    one = replace(one, lidars={**one.lidars, "front": found})

    for parts in ((one, other), (other, one)):
        result = merged(*parts).lidars["front"]
        assert not result.without_guess
        assert vehicle_axes_difference(result.T_vehicle_lidar, TRUTH["front"]) == pytest.approx(
            guess[:6], abs=1e-9
        )


def test_drives_count_once() -> None:
    D = information(NAMES)
    first = drive(D, source="a")

    with pytest.raises(ConfigError, match=r"b\.yaml: stems from the same drive as a\.yaml"):
        merged(first, drive(D, source="a"))
    with pytest.raises(ConfigError, match=r"c\.yaml: stems from the same drive as a\.yaml"):
        merged(first, drive(D, source="b"), merged(drive(D, source="c"), first))


def test_a_copy_of_a_recording_does_not_count_twice() -> None:
    """A copy without a topic or cut in time has another digest, and the same messages."""
    whole, part, others = ([f"m{n:012x}" for n in of] for of in (range(16), range(10), (99, 0)))

    def of_drive(source: str, marks: list[str]) -> Calibration:
        made = drive(information(NAMES), source=source)
        return replace(made, provenance={**made.provenance, "drive_marks": [marks]})

    first, copy, another = of_drive("a", whole), of_drive("b", part), of_drive("c", others)
    said = r"b\.yaml: stems from the same drive as a\.yaml.*: 10 of 10 messages"
    with pytest.raises(ConfigError, match=said):
        merged(first, copy)
    with pytest.raises(ConfigError, match="stems from the same drive"):
        merged(merged(first, another), copy)
    with pytest.raises(ConfigError, match="is a result of the drive that is to be calibrated"):
        starting_from(config(), first, ["b"], [part])
    assert merged(first, another).status == "ok"
    assert starting_from(config(), first, ["c"], [others]).lidars


def test_files_that_name_no_drive_are_told_apart_by_what_they_say(tmp_path: Path) -> None:
    first = drive(information(NAMES), source="a")
    nameless = [replace(first, provenance={})]
    nameless += [replace(drive(information(NAMES, 2), source="a"), provenance={})]

    assert merged(*nameless).status == "ok"
    with pytest.raises(ConfigError, match="stems from the same drive"):
        merged(nameless[0], nameless[0])


def test_calibrations_that_disagree_are_merged_and_said_to() -> None:
    D = information(NAMES)
    moved_on = drive(D, source="b", error=shift(NAMES, "front", pitch=0.02))

    found = merger(drive(D, source="a"), moved_on)

    assert found.calibration.status == "inconsistent"
    (warning,) = found.warnings
    assert warning.startswith("b.yaml: disagrees with the other: ")
    assert "pitch" in warning
    assert "mrad" in warning


def test_of_three_the_odd_one_is_named() -> None:
    D = information(NAMES)
    parts = [drive(D, source=s) for s in "ac"]
    odd = drive(D, source="b", error=shift(NAMES, "rear", y=0.2))

    found = merger(parts[0], odd, parts[1])

    assert found.calibration.status == "inconsistent"
    certain = min(
        found.agreement, key=lambda label: min(m.p_value for m in found.agreement[label].movements)
    )
    assert certain == "b.yaml"


def test_three_drives_by_two_ways_are_the_same() -> None:
    rng = np.random.default_rng(8)
    D = [information(NAMES, seed) for seed in (1, 2, 3)]
    parts = [drive(d, source=s, error=draw(d, rng)) for d, s in zip(D, "abc", strict=True)]

    at_once, in_steps = merged(*parts), merged(merged(parts[0], parts[1]), parts[2])

    assert errors(in_steps) == pytest.approx(errors(at_once), abs=1e-7)
    assert in_steps.cov_joint == pytest.approx(at_once.cov_joint, rel=1e-3, abs=1e-13)
    assert in_steps.provenance["drive_sha256"] == ["a", "b", "c"]


def test_a_trusted_mounting_stays() -> None:
    D = information(NAMES)

    def trusting(source: str, error: Array) -> Calibration:
        calibration = drive(D, source=source, error=error)
        trusted = Guess(TRUTH["rear"], np.array([1e-5] * 3 + [1e-4] * 3), fixed=True)
        rear = replace(calibration.lidars["rear"], guess=trusted)
        return replace(calibration, lidars={**calibration.lidars, "rear": rear})

    result = merged(
        trusting("a", shift(NAMES, "rear", x=0.003)), trusting("b", shift(NAMES, "rear", x=0.002))
    )

    assert result.lidars["rear"].T_vehicle_lidar.equals(TRUTH["rear"], 1e-4)
    assert all(result.lidars["rear"].determined.values())


def test_a_trusted_mounting_counts_whichever_file_has_it() -> None:
    D = information(NAMES)
    free = drive(D, source="a")
    fixed, other = (
        with_trusted(drive(D, source=source), shift(NAMES, "rear", x=x))
        for source, x in (("b", 0.001), ("c", 0.003))
    )
    for files in ((free, fixed), (fixed, free)):
        result = merger(*files)
        assert result.warnings == ()
        rear = result.calibration.lidars["rear"]
        assert rear.guess is not None
        assert rear.guess.fixed
        assert sigmas_s2v(result.calibration, "rear")[3] < 1.01e-4
    (warning,) = merger(fixed, free, other).warnings
    assert warning.startswith("c.yaml: its fixed extrinsic of 'rear' is not used: it differs")
    assert "by 2.0 mm and 0.000 degrees" in warning


def test_whether_a_mounting_is_fixed_beside_a_prior_is_what_the_config_says() -> None:
    D = information(NAMES)
    fixed = with_trusted(drive(D, source="a"), np.zeros(12))
    result, _ = with_earlier(drive(D, source="b"), fixed)
    assert result.lidars["rear"].guess is not None
    assert not result.lidars["rear"].guess.fixed
    assert sigmas_s2v(result, "rear")[3] > 1e-3


def with_trusted(calibration: Calibration, error: Array) -> Calibration:
    """The same, its rear LiDAR fixed where it is off by some rows of `error`."""
    at = retract_vehicle_axes(TRUTH["rear"], error[6:])
    trusted = Guess(at, TRUSTED_SIGMAS, fixed=True)
    rear = replace(calibration.lidars["rear"], guess=trusted)
    return replace(calibration, lidars={**calibration.lidars, "rear": rear})


def test_a_merged_file_reads_back(tmp_path: Path) -> None:
    D = information(NAMES)
    result = merged(drive(D, source="a"), drive(D, source="b", error=np.full(12, 1e-3)))

    write_calibration(result, tmp_path / "merged.yaml")
    back = read_calibration(tmp_path / "merged.yaml")

    assert back.gradient_data == pytest.approx(result.gradient_data, rel=1e-9, abs=1e-9)
    assert back.information_data == pytest.approx(result.information_data, rel=1e-9)
    guess, written = back.lidars["front"].guess, result.lidars["front"].guess
    assert guess is not None
    assert written is not None
    assert guess.T_vehicle_lidar.equals(written.T_vehicle_lidar, 1e-9)
    assert guess.sigmas == pytest.approx(written.sigmas, rel=1e-9)
    with pytest.raises(ConfigError, match="same drive"):
        merged(back, drive(D, source="b"))


def test_the_suspects_of_one_drive_are_none_of_all() -> None:
    """Each ranking explains the contradictions of its own drive."""
    late = Suspect("lidars.front.time_offset", (0.1,), (1e-3,), (0.1,), ("s",), 0.9, 40.0, 40.0)
    parts = [
        drive(information(NAMES, seed), source=s, suspects=suspects)
        for seed, s, suspects in ((1, "a", (late,)), (2, "b", ()))
    ]

    for some in (parts, parts[::-1]):
        assert merged(*some).suspects == ()
    assert with_earlier(parts[0], parts[1])[0].suspects == (late,)


def test_the_remedies_of_drives_without_motion_data_are_theirs(tmp_path: Path) -> None:
    """No manoeuvre tells S2V there; as soon as one drive has motion data, a curve does."""

    def past_walls(source: str, **provenance: str) -> Calibration:
        result = drive(arc_information(NAMES), source=source)
        lidars = {
            name: replace(lidar, saw_target=False, scans_used=0, saw_structure=True)
            for name, lidar in result.lidars.items()
        }
        return replace(result, lidars=lidars, provenance={**result.provenance, **provenance})

    def remedy(result: Calibration) -> str:
        return result.undetermined[0].remedy

    a, b = (past_walls(source, motion="odometry of lidar 'rear'") for source in "ab")
    moving = past_walls("c")
    write_calibration(merged(a, b), tmp_path / "ab.yaml")
    both = read_calibration(tmp_path / "ab.yaml")

    for result in (
        merged(a, b),
        with_earlier(b, a)[0],
        with_earlier(past_walls("d", motion=""), both)[0],
    ):
        assert remedy(result) == OF_ODOMETRY.turn_centre
    for result in (merged(a, moving), with_earlier(a, moving)[0], merged(both, moving)):
        assert remedy(result) == OF_STRUCTURE.turn_centre


# ---------------------------------------------------------------- --prior


def two_drives() -> tuple[Calibration, Calibration]:
    rng = np.random.default_rng(21)
    D = [arc_information(NAMES, 1), arc_information(NAMES, 2, left=True)]
    guess = shift(NAMES, "front", x=0.01)
    first, second = (
        drive(d, source=s, error=draw(d, rng), guess_error=guess)
        for d, s in zip(D, "ab", strict=True)
    )
    return first, second


def test_an_earlier_calibration_adds_what_its_data_say() -> None:
    before, alone = two_drives()

    result, warnings = with_earlier(alone, before)

    expected = merged(alone, before)
    assert warnings == ()
    assert errors(result) == pytest.approx(errors(expected), abs=1e-7)
    assert result.cov_joint == pytest.approx(expected.cov_joint, rel=1e-4, abs=1e-13)
    assert (result.status, result.undetermined) == ("ok", ())
    # Its own data's information stays its own.
    own = in_vehicle_axes(alone, alone.information_data)
    assert in_vehicle_axes(result, result.information_data) == pytest.approx(
        own, abs=2e-2 * own.max()
    )


def test_what_came_with_a_prior_counts_once(tmp_path: Path) -> None:
    before, alone = two_drives()
    result, _ = with_earlier(alone, before)
    write_calibration(result, tmp_path / "b.yaml")
    result = read_calibration(tmp_path / "b.yaml")
    third = drive(information(NAMES, 5), source="c")

    with_both, without = merged(before, result), merged(before, alone)
    carried = merged(third, result)

    assert with_both.cov_joint == pytest.approx(without.cov_joint, rel=1e-3, abs=1e-12)
    assert errors(with_both) == pytest.approx(errors(without), abs=1e-6)
    assert carried.provenance["drive_sha256"] == ["c", "b", "a"]
    expected = merged(third, alone, before)
    assert errors(carried) == pytest.approx(errors(expected), abs=1e-6)


def test_a_prior_of_which_a_part_would_count_twice() -> None:
    before, alone = two_drives()
    third = drive(information(NAMES, 5), source="c")
    result, _ = with_earlier(alone, merged(before, third))

    with pytest.raises(ConfigError, match=r"a\.yaml: was made with --prior, of whose drives one"):
        merged(result, third)


def test_a_mount_that_moved_since_the_prior() -> None:
    D = information(NAMES)
    before = drive(D, source="a")
    now = drive(D, source="b", error=shift(NAMES, "rear", yaw=0.02))

    result, warnings = with_earlier(now, before)

    assert result.status == "inconsistent"
    (warning,) = warnings
    assert "--prior and this drive disagree" in warning
    assert "LiDAR 'rear' has moved" in warning
    # What comes of the result later has its status, but is about other drives.
    mixed = replace(result, warnings=(*warnings, "no IMU"))
    assert merged(mixed, drive(D, source="c")).warnings[0] == "no IMU"
    handed_on, _ = with_earlier(drive(D, source="c"), mixed)
    assert handed_on.warnings == ("--prior: no IMU",)
    assert handed_on.status == "inconsistent"


def test_a_prior_that_is_inconsistent_makes_the_result_so(tmp_path: Path) -> None:
    before, alone = two_drives()
    before = replace(before, status="inconsistent", contradictions=("stamps are late",))
    before = replace(before, warnings=("one scan counts less",))
    alone = replace(alone, warnings=("no IMU",))

    result, (warning,) = with_earlier(replace(alone, contradictions=("a cloud is off",)), before)

    assert result.warnings == ("no IMU", "--prior: one scan counts less")
    both = merged(before, alone)
    assert both.warnings[:2] == ("one scan counts less", "no IMU")
    assert "is inconsistent, so the merged" in both.warnings[2]
    assert merged(before, alone).status == result.status == "inconsistent"
    assert warning.startswith("--prior: is inconsistent")
    assert result.contradictions == ("a cloud is off", "--prior: stamps are late")
    write_calibration(result, tmp_path / "b.yaml")
    third = drive(information(NAMES, 5), source="c")
    handed_on, _ = with_earlier(third, read_calibration(tmp_path / "b.yaml"))
    assert handed_on.warnings == ("--prior: no IMU", "--prior: one scan counts less")
    assert handed_on.status == "inconsistent"
    assert handed_on.contradictions == ("--prior: a cloud is off", "--prior: stamps are late")


def test_a_lidar_unseen_now_follows_those_that_were() -> None:
    """The earlier drive tied it to the one that is seen again."""
    before = drive(information(NAMES, 1), source="a", error=shift(NAMES, "front", x=0.001))
    D = information(NAMES, 2)
    D[:6], D[:, :6] = 0.0, 0.0
    now = drive(D, source="b", guess_error=shift(NAMES, "front", x=0.05))

    result, _ = with_earlier(now, before)

    front = result.lidars["front"]
    assert not front.saw_target
    assert not any(front.determined.values())
    assert vehicle_axes_difference(front.T_vehicle_lidar, TRUTH["front"]) == pytest.approx(
        shift(NAMES, "front", x=0.001)[:6], abs=3e-3
    )


def test_a_prior_of_more_lidars_counts_with_what_it_tells_of_the_others() -> None:
    more = ("front", "left", "rear")
    D = [information(more, 1), information(NAMES, 2)]
    error = draw(D[0], np.random.default_rng(4))
    before, now = drive(D[0], more, source="a", error=error), drive(D[1], source="b")

    result, warnings = with_earlier(now, before)

    assert warnings == ()
    assert list(result.lidars) == list(NAMES)
    rows = [*range(6), *range(12, 18)]
    without_left = np.linalg.inv(np.linalg.inv(D[0])[np.ix_(rows, rows)])
    mean = np.linalg.solve(without_left + D[1], without_left @ error[rows])
    assert errors(result) == pytest.approx(mean, abs=2e-5)


def config(**sections: object) -> Config:
    lidars = {
        name: {"topic": name, "initial": {"xyz": [1.0, 2.0, 3.0], "rpy_deg": [1.0, 2.0, 3.0]}}
        for name in ("front", "roof")
    }
    return parse_config({"lidars": lidars, **sections}, "config.yaml", Path())


def test_the_solve_starts_from_the_earlier_mountings() -> None:
    before, _ = two_drives()

    started = starting_from(config(), before, ["b"])

    front = started.lidars["front"]
    T = before.lidars["front"].T_vehicle_lidar
    assert front.given.xyz == pytest.approx(T.translation())
    angles = np.radians(front.given.rpy_deg)
    assert gtsam.Rot3.RzRyRx(*angles).equals(T.rotation(), 1e-12)
    assert front.sigma == config().lidars["front"].sigma
    assert started.lidars["roof"] == config().lidars["roof"]


def test_priors_that_are_none() -> None:
    before, _ = two_drives()

    with pytest.raises(ConfigError, match="--prior: is a result of the drive that is to be"):
        starting_from(config(), before, ["c", "a"])
    with pytest.raises(ConfigError, match=r"--prior: solve\.mode staged"):
        starting_from(config(solve={"mode": "staged"}), before, ["b"])
    other = drive(information(("left",)), ("left",), source="c")
    with pytest.raises(
        ConfigError, match=r"--prior: has none of the LiDARs of the config \(front,"
    ):
        starting_from(config(), other, ["b"])
