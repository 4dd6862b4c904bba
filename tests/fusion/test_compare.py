from __future__ import annotations

import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.stats import kstest

from caliv_graph.errors import ConfigError
from caliv_graph.fusion.compare import Comparison, Movement, compare, holm
from caliv_graph.fusion.merge import merge
from caliv_graph.geometry.covariance import parent_axes_covariance
from caliv_graph.products import Array, Calibration
from tests.fusion.drives import (
    DEGREE,
    TRUTH,
    arc_information,
    draw,
    drive,
    information,
    moved,
    shift,
    turned_on_its_arc,
)
from tests.samples import turn_about_centre, unseen

NAMES = ("front", "rear")


def compared(first: Calibration, second: Calibration) -> Comparison:
    return compare(first, second, ("a.yaml", "b.yaml"))


def after(e: Array) -> dict[str, gtsam.Pose3]:
    """Extrinsics that have been moved."""
    return moved({name: TRUTH[name] for name in NAMES}, e)


def test_nothing_has_moved() -> None:
    D = information(NAMES)

    found = compared(drive(D, source="a"), drive(D, source="b"))

    assert not found.moved
    assert found.conclusion == "No mount has moved, as far as these drives can tell."
    assert [m.dof for m in found.movements] == [6, 6, 6]
    assert [m.p_value for m in found.movements] == pytest.approx([1.0, 1.0, 1.0])
    assert found.dof == 12


def test_movement_and_sigma_are_those_of_the_mountings() -> None:
    """The front LiDAR yaws by a degree and goes 20 mm to the left."""
    D = information(NAMES)
    first = drive(D, source="a")
    truth = after(shift(NAMES, "front", yaw=DEGREE, y=0.02))

    found = compared(first, drive(D, source="b", truth=truth))

    front, pair = found.lidars["front"], found.pairs[0]
    assert front.movement == pytest.approx([0, 0, DEGREE, 0, 0.02, 0], abs=1e-9)
    cov = parent_axes_covariance(first.lidars["front"].T_vehicle_lidar, first.lidars["front"].cov)
    assert front.sigma == pytest.approx(np.sqrt(2.0 * np.diag(cov)), rel=1e-3)
    assert front.chi2 == pytest.approx(
        front.movement @ np.linalg.solve(2.0 * cov, front.movement), rel=1e-2
    )
    assert pair.lidars == ("front", "rear")
    assert pair.movement == pytest.approx(front.movement, abs=1e-9)
    assert found.lidars["rear"].movement == pytest.approx(np.zeros(6), abs=1e-9)
    assert (front.moved, pair.moved, found.lidars["rear"].moved) == (True, True, False)
    assert found.conclusion == "LiDAR 'front' has moved."


def test_the_frame_of_the_vehicle_has_moved() -> None:
    D = information(NAMES)
    offset = shift(NAMES, "front", z=0.05) + shift(NAMES, "rear", z=0.05)

    found = compared(drive(D, source="a"), drive(D, source="b", truth=after(offset)))

    assert [m.moved for m in found.movements] == [True, True, False]
    assert found.conclusion.startswith("All LiDARs have moved together against the vehicle frame")


def test_a_shared_guess_proves_nothing() -> None:
    """Two arcs leave x and yaw to the guess; the mounts have moved along just that direction."""
    D = arc_information(NAMES)
    guess = np.full(12, 0.002)
    turn = shift(NAMES, "front", yaw=0.01, x=-0.0916, y=0.02) + shift(
        NAMES, "rear", yaw=0.01, x=-0.0916, y=-0.004
    )
    first = drive(D, source="a", guess_error=guess)
    second = drive(D, source="b", guess_error=guess - turn, truth=after(turn))

    found = compared(first, second)

    assert not found.moved
    for name in NAMES:
        movement = found.lidars[name]
        assert dict(zip("rpwxyz", movement.determined, strict=True))["w"] is False
        assert (movement.determined[3], movement.dof) == (False, 5)
    assert found.pairs[0].dof == 6
    assert all("turn centre" in texts[0] for texts in found.undetermined)


@pytest.mark.parametrize("found", [False, True])
def test_what_the_solves_leave_open_is_no_movement(found: bool) -> None:
    """The same data twice; both solves ended 0.1 rad apart along what an arc leaves open.

    2 m ahead of the centre, y follows a fifth of what x does: 0.2 m. The verdicts of each drive
    call it determined, but its variance is that of the guesses.
    """
    D = np.diag(np.tile([1e4**2] * 3 + [1e3**2] * 3, 2))
    vector = turn_about_centre({name: TRUTH[name] for name in NAMES}).vector
    turn = np.concatenate([vector[name] for name in NAMES])
    D = D - np.outer(D @ turn, D @ turn) / (turn @ D @ turn)
    first = drive(D, source="a", guess_error=-0.05 * turn, found=found)
    second = drive(D, source="b", guess_error=0.05 * turn, found=found)

    there = compared(first, second)

    front = there.lidars["front"]
    assert not there.moved
    # Each drive alone may have been at the other's place: nothing is left of the turn.
    assert front.movement == pytest.approx(np.zeros(6), abs=1e-9)
    assert front.determined == (True, True, False, False, False, True)
    assert front.tests == pytest.approx([1.0] * 4, abs=0.05)
    assert merge({"a": first, "b": second}).calibration.status == "partial"
    # What the drives do tell of is tested as before.
    pitched = shift(NAMES, "front", pitch=1e-3)
    assert compared(first, drive(D, source="b", error=pitched, found=found)).moved


@pytest.mark.parametrize("turn_rad", [0.05, 0.215])
def test_arcs_without_guesses_are_compared_however_far_their_solves_ended(turn_rad: float) -> None:
    """A search takes the place nearest to the vehicle's origin: on the left for a right arc."""
    right = turned_on_its_arc(turn_rad, source="a")
    left = turned_on_its_arc(-turn_rad, source="b", left=True)
    pitched = turned_on_its_arc(
        -turn_rad, source="b", left=True, error=shift(NAMES, "front", pitch=8e-3)
    )

    found, knocked = compared(right, left), compared(right, pitched)

    assert not found.moved
    assert found.dof == 10
    assert found.chi2 == pytest.approx(0.0, abs=1e-3)
    assert knocked.conclusion == "LiDAR 'front' has moved."
    assert knocked.lidars["front"].movement[1] == pytest.approx(8e-3, rel=0.1)


def test_what_the_arcs_do_tell_is_tested() -> None:
    D = arc_information(NAMES)
    truth = after(shift(NAMES, "rear", roll=0.5 * DEGREE))

    found = compared(drive(D, source="a"), drive(D, source="b", truth=truth))

    assert found.moved
    assert found.conclusion == "LiDAR 'rear' has moved."


def test_one_drive_that_says_nothing() -> None:
    blind = drive(1e-3 * np.eye(12), source="a")

    found = compared(blind, drive(information(NAMES), source="b"))

    assert not found.moved
    assert [m.dof for m in found.movements] == [0, 0, 0]
    assert not any(any(m.determined) for m in found.movements)
    assert found.conclusion.startswith("Nothing can be said")


def test_the_prior_of_the_later_one_plays_no_part() -> None:
    """Made with --prior, a calibration lies between; its data alone are what is compared."""
    D = information(NAMES)
    first = drive(D, source="a")
    error = shift(NAMES, "front", yaw=0.004)
    alone = drive(D, source="b", error=error)
    pulled = drive(D, source="b", error=error / 2.0)
    # The same data about another estimate.
    to_right = np.zeros((12, 12))
    for i, lidar in enumerate(pulled.lidars.values()):
        R = lidar.T_vehicle_lidar.rotation().matrix()
        to_right[6 * i : 6 * i + 3, 6 * i : 6 * i + 3] = R.T
        to_right[6 * i + 3 : 6 * i + 6, 6 * i + 3 : 6 * i + 6] = R.T
    fused = replace(
        pulled,
        gradient_data=to_right @ D @ (error / 2.0),
        information_data=to_right @ D @ to_right.T,
    )

    found, expected = compared(first, fused), compared(first, alone)

    for ours, theirs in zip(found.movements, expected.movements, strict=True):
        assert ours.movement == pytest.approx(theirs.movement, abs=1e-8)
        assert ours.chi2 == pytest.approx(theirs.chi2, rel=1e-3)


def test_names_order_and_direction_do_not_matter() -> None:
    names = ("front", "rear", "left")
    D, rng = information(names), np.random.default_rng(5)
    errors = [draw(D, rng) for _ in range(2)]
    first, second = (drive(D, names, source=s, error=e) for s, e in zip("ab", errors, strict=True))
    order = ("left", "front", "rear")
    rows = [6 * names.index(n) + a for n in order for a in range(6)]
    turned = drive(
        D[np.ix_(rows, rows)], order, source="b", error=errors[1][rows], reference="front"
    )

    found, permuted, back = (
        compared(first, second),
        compared(first, turned),
        compared(second, first),
    )

    for name in names:
        assert permuted.lidars[name].chi2 == pytest.approx(found.lidars[name].chi2, rel=1e-6)
        assert back.lidars[name].chi2 == pytest.approx(found.lidars[name].chi2, rel=1e-2)
    assert permuted.chi2 == pytest.approx(found.chi2, rel=1e-6)
    assert [m.lidars for m in found.pairs] == [
        ("front", "rear"),
        ("front", "left"),
        ("rear", "left"),
    ]


def test_only_what_both_saw_is_compared() -> None:
    first = drive(information(("front", "rear")), ("front", "rear"), source="a")
    D = information(("rear", "left", "front"))
    D[12:, :], D[:, 12:] = 0.0, 0.0
    second = unseen(drive(D, ("rear", "left", "front"), source="b"), "front")

    found = compared(first, second)

    assert (list(found.lidars), found.pairs) == (["rear"], ())
    assert found.not_compared == {
        "front": "it saw nothing in the second calibration",
        "left": "the first calibration does not have it",
    }


def test_calibrations_that_cannot_be_compared() -> None:
    D = information(NAMES)
    first = drive(D, source="a")

    others = drive(information(("left",)), ("left",), source="b")
    with pytest.raises(
        ConfigError, match=r"b\.yaml: has none of the LiDARs of a\.yaml \(front, re"
    ):
        compared(first, others)


def test_two_results_of_one_drive_are_compared_and_that_is_said() -> None:
    D = information(NAMES)
    first = drive(D, source="a")
    turned = shift(NAMES, "front", pitch=math.radians(0.5))

    alike, apart = compared(first, first), compared(first, drive(D, source="a", error=turned))

    assert len(alike.shared) == len(apart.shared) == 1
    assert not alike.moved
    assert "results of one drive, and they agree" in alike.conclusion
    assert apart.moved
    assert "differ by more than their sigmas: 'front', 'front' against 'rear'" in apart.conclusion
    assert "No mount has moved" in apart.conclusion
    # A drive of its own beside the shared one can show a movement.
    both = merge({"a": first, "b": drive(D, source="b")}).calibration
    found = compared(first, both)
    assert found.shared == alike.shared
    assert "share data of a drive" in found.conclusion
    assert compared(first, drive(D, source="b")).shared == ()


@pytest.mark.parametrize("arcs", [False, True])
def test_p_values_are_uniform_where_nothing_moves(arcs: bool) -> None:
    """80 pairs of drives; the guess of both is off by what its sigma says."""
    rng = np.random.default_rng(11 + arcs)
    D = (arc_information if arcs else information)(NAMES)
    guess = rng.normal(size=12) * np.tile([0.03] * 3 + [0.058] * 3, 2)
    p_values, alarms = [], 0
    for pair in range(80):
        found = compared(
            *(drive(D, source=f"{pair}{s}", error=draw(D, rng), guess_error=guess) for s in "ab")
        )
        p_values.append([*(m.p_value for m in found.movements), found.p_value])
        alarms += found.moved

    for column in np.array(p_values).T:
        assert kstest(column, "uniform").pvalue > 0.01
        assert np.mean(column < 0.01) <= 0.03
    assert alarms <= 2


def movement(p_value: float, *p_axes: float, dof: int = 6) -> Movement:
    """With the axes whose p-values are given."""
    told = tuple(i < len(p_axes) for i in range(6))
    axes = np.array([*p_axes, *[1.0] * (6 - len(p_axes))])
    return Movement(("front",), np.zeros(6), np.ones(6), told, 0.0, dof, p_value, axes)


def test_holms_correction_by_hand() -> None:
    """Four tests: the smallest counts fourfold, the next threefold but no less than it."""
    tested = holm(
        [movement(0.02), movement(0.5, 0.002), movement(0.0025), movement(1e-9, dof=0)], 0.01
    )

    assert [m.p_corrected for m in tested] == pytest.approx([0.04, 0.008, 0.008, 1.0])
    assert [m.moved for m in tested] == [False, True, True, False]


def test_one_axis_alone_is_found_where_all_six_together_hide_it() -> None:
    """Five sigmas along x: 25 of a chi-square of 6, but one in two million of a normal."""
    D = np.diag(np.tile([1e6] * 3 + [1e5] * 3, 2))
    first = drive(D, source="a")
    sigma = compared(first, drive(D, source="b")).lidars["front"].sigma[3]

    found = compared(
        first, drive(D, source="b", truth=after(shift(NAMES, "front", x=5.0 * float(sigma))))
    )

    front = found.lidars["front"]
    assert front.p_axes[3] == pytest.approx(5.7e-7, rel=0.05)
    assert front.moved
    assert front.p_corrected < front.p_value
