"""Names of directions, and what would determine them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from caliv_graph.conventions import AXES
from caliv_graph.geometry.se3 import retract_vehicle_axes
from caliv_graph.products import Array, Guess, VehicleParameter
from caliv_graph.results.calibration_file import read_calibration, write_calibration
from caliv_graph.uncertainty.observability import UNIT, assess, limited_axes, scaling
from caliv_graph.uncertainty.predicted import PredictedCovariance, predict_covariance
from caliv_graph.wording.directions import (
    describe,
    named,
    named_prediction,
    remedy,
    same_as_parameters,
)
from caliv_graph.wording.remedies import OF_BOTH, OF_STRUCTURE, OF_TARGET, TURNED_ALREADY
from caliv_graph.wording.vehicle import vehicle_text
from tests.drives_with_chair import RADIUS_M
from tests.samples import MOUNTINGS, pose, turn_about, twist_of_all

LIDARS = {name: pose(*MOUNTINGS[name]) for name in ("front", "rear")}
SIGMAS = np.array([0.03] * 3 + [0.06] * 3)

HEIGHT = "height of all LiDARs together"
TURN = f"rotation of all LiDARs about the turn centre: x and yaw together, {RADIUS_M:.2f} m per rad"

# ------------------------------------------------------------------ names


@pytest.mark.parametrize(
    ("twist", "text"),
    [
        ([0, 0, 0, 0, 0, 1], HEIGHT),
        ([0, 0, 0, 1, 0, 0], "shift of all LiDARs together forward: x"),
        ([0, 0, 0, 0, -2, 0], "shift of all LiDARs together sideways: y"),
        ([1, 0, 0, 0, 0, 0], "roll of all LiDARs together"),
        ([0, 0.01, 0, 0, 0, 0], "pitch of all LiDARs together"),
        (
            [0, 0, 1, 0, 0, 0],
            "rotation of all LiDARs about the vertical through the vehicle frame: yaw",
        ),
        (turn_about((0.0, -RADIUS_M)), TURN),
        (turn_about((0.0, RADIUS_M)), TURN),
    ],
    ids=["z", "x", "y", "roll", "pitch", "yaw", "right turn", "left turn"],
)
def test_motions_of_all_lidars_together_are_one_direction(twist: list[float], text: str) -> None:
    for scale in (1.0, -0.3):
        parts = {name: scale * part for name, part in twist_of_all(twist, LIDARS).items()}

        assert describe(parts, LIDARS) == text


@pytest.mark.parametrize("centre", [(-1.0, 7.5), (3.0, -4.0), (0.2, -25.0)], ids=str)
def test_the_radius_is_the_distance_of_the_turn_centre(centre: tuple[float, float]) -> None:
    text = describe(twist_of_all(turn_about(centre), LIDARS), LIDARS)

    assert text.startswith("rotation of all LiDARs about the turn centre: ")
    assert text.endswith(f" and yaw together, {math.hypot(*centre):.2f} m per rad")
    # Turned about that point, a LiDAR keeps its distance from it.
    parts = twist_of_all(turn_about(centre), LIDARS)
    for name, T in LIDARS.items():
        moved = retract_vehicle_axes(T, 1e-3 * parts[name]).translation()
        before = np.linalg.norm(T.translation()[:2] - centre)
        assert np.linalg.norm(moved[:2] - centre) == pytest.approx(before, rel=1e-6)


@pytest.mark.parametrize("axis", AXES)
def test_one_lidar_that_moves_alone_is_named(axis: str) -> None:
    parts = {"front": np.eye(6)[AXES.index(axis)] * UNIT, "rear": np.zeros(6)}

    assert describe(parts, LIDARS) == f"{axis} of lidar 'front'"


def test_axes_that_move_alone_together_are_named_together() -> None:
    parts = {"front": np.zeros(6), "rear": np.array([0.0, 0.0, 1e-3, 9e-3, 0.0, 0.0])}

    assert describe(parts, LIDARS) == "yaw and x of lidar 'rear' together"


def test_lidars_that_move_apart_are_named_with_their_axes() -> None:
    up, down = np.zeros(6), np.zeros(6)
    up[5], down[5], down[2] = 0.01, -0.005, 0.5e-3
    tilted = down + np.array([0.4e-3, 0.0, 0.0, 0.0, 0.0, 0.0])

    assert describe({"front": up, "rear": down}, LIDARS) == (
        "relative z and yaw between lidars 'front' and 'rear'"
    )
    assert describe({"front": up, "rear": tilted}, LIDARS) == (
        "relative z, yaw and roll between lidars 'front' and 'rear'"
    )
    three = {**LIDARS, "left": pose(*MOUNTINGS["left"])}
    assert describe({"front": up, "rear": down, "left": -up}, three) == (
        "relative z and yaw between lidars 'front', 'rear' and 'left'"
    )


def test_a_single_lidar_is_named_instead_of_all() -> None:
    only = {"front": LIDARS["front"]}

    assert describe({"front": np.eye(6)[5]}, only) == "height of lidar 'front'"
    text = describe(twist_of_all(turn_about((0.0, -RADIUS_M)), only), only)
    assert text.startswith("rotation of lidar 'front' about the turn centre: ")


# ------------------------------------------------------------------ remedies


@pytest.mark.parametrize(
    ("twist", "expected"),
    [
        ([0, 0, 0, 0, 0, 1], OF_TARGET.height),
        ([0, 0, 1, -9.16, 0, 0], OF_TARGET.turn_centre),
        ([0, 0, 1, 9.16, 1.0, 0], OF_TARGET.turn_centre),
        ([0, 0, 0, 1, 0, 0], OF_TARGET.straight),
        ([0, 0, 0, 0, 1, 0], OF_TARGET.straight),
        ([1, 0, 0, 0, 3, 0], OF_TARGET.straight),
        ([1, 0, 0, 0, 0, 0], OF_TARGET.tilt),
        ([0, 1, 0, 0, 0, 0], OF_TARGET.tilt),
    ],
)
def test_every_direction_has_a_manoeuvre_that_fixes_it(twist: list[float], expected: str) -> None:
    for scale in (1.0, -1e-3):
        parts = {name: scale * part for name, part in twist_of_all(twist, LIDARS).items()}
        assert remedy(parts, LIDARS) == expected


@pytest.mark.parametrize("twist", [[0, 0, 0, 1, 0, 0], [0, 0, 1, -9.16, 0, 0]])
def test_of_a_drive_that_turned_the_poses_are_what_is_weak(twist: list[float]) -> None:
    """The advice of a figure-eight does not help whoever drove one."""
    parts = twist_of_all(twist, LIDARS)
    weak, lost = remedy(parts, LIDARS, weak=True), remedy(parts, LIDARS)
    assert weak == f"{lost}{TURNED_ALREADY}"
    of_odometry = remedy(parts, LIDARS, weak=True, evidence="odometry")
    assert of_odometry == remedy(parts, LIDARS, evidence="odometry")


@pytest.mark.parametrize(
    ("axis", "expected"), [("x", OF_TARGET.apart), ("yaw", OF_TARGET.apart_yaw)]
)
def test_lidars_that_move_apart_have_to_see_the_same_side(axis: str, expected: str) -> None:
    parts = {"front": np.eye(6)[AXES.index(axis)] * UNIT, "rear": np.zeros(6)}

    assert remedy(parts, LIDARS) == expected
    # Where they do see it, what helps is to see it more often.
    assert remedy(parts, LIDARS, weak=True) == OF_TARGET.more


def rigid_loss(*lost: int) -> Array:
    """Information of two LiDARs that determines all but some motions of both together."""
    rows = np.vstack(
        [
            np.array(
                [p / UNIT for p in twist_of_all(np.eye(6)[i].tolist(), LIDARS).values()]
            ).ravel()
            for i in lost
        ]
    )
    basis = np.linalg.qr(rows.T)[0]
    kept = np.eye(12) - basis @ basis.T
    unit = np.tile(UNIT, 2)
    return np.asarray(1e4 * kept / np.outer(unit, unit))


def predicted(*lost: int) -> PredictedCovariance:
    return named_prediction(
        predict_covariance(
            rigid_loss(*lost),
            ("front", "rear"),
            "rear",
            LIDARS,
            {name: Guess(T, SIGMAS) for name, T in LIDARS.items()},
            {},
            {},
        )
    )


@pytest.mark.parametrize(
    ("lost", "text"),
    [
        (range(6), "all S2V axes: the vehicle did not move"),
        (range(5), "all S2V axes but the height: the vehicle did not move"),
        ((0, 1, 2, 3, 5), "all S2V axes but one: the vehicle did not move"),
    ],
    ids=["all", "but height", "but y"],
)
def test_a_vehicle_that_did_not_move_is_named_as_the_cause(lost: Iterable[int], text: str) -> None:
    found = predicted(*lost)

    assert [d.text for d in found.undetermined] == [text] * len(list(lost))
    assert {d.remedy for d in found.undetermined} == {OF_TARGET.stationary}
    assert [d.text for d in found.calibration.undetermined] == [text] * len(list(lost))
    # The pair is determined all the same.
    assert set(found.determined_s2s) == {("front", "rear")}


def test_remedies_are_in_the_file_and_are_read_back(tmp_path: Path) -> None:
    file = tmp_path / "calibration.yaml"

    write_calibration(predicted(5).calibration, file)

    written = yaml.safe_load(file.read_text())["observability"]["undetermined"]
    assert [entry["remedy"] for entry in written] == [OF_TARGET.height]
    assert [d.remedy for d in read_calibration(file).undetermined] == [OF_TARGET.height]


def test_four_lost_motions_are_named_one_by_one() -> None:
    texts = {d.text for d in predicted(0, 3, 4, 5).undetermined}

    assert len(texts) == 4
    assert not any("did not move" in text for text in texts)


def test_names_do_not_change_the_numbers() -> None:
    unit = scaling(2)
    D = np.diag((0.1 * unit) ** -2.0)
    D[7, 7] = 6e-3**-2.0
    D[11, 11] = 0.0
    plain = assess(D, np.diag(np.tile(SIGMAS, 2) ** -2.0), LIDARS)

    found = named(plain, LIDARS)

    assert [d.text for d in plain.undetermined + plain.weak] == ["", ""]
    assert [d.text for d in found.undetermined] == ["z of lidar 'rear'"]
    assert [d.remedy for d in found.undetermined] == [OF_TARGET.apart]
    assert [d.text for d in found.weak] == ["pitch of lidar 'rear'"]
    assert [d.remedy for d in found.weak] == [OF_TARGET.more]
    for before, after in zip(
        plain.undetermined + plain.weak, found.undetermined + found.weak, strict=True
    ):
        assert replace(after, text="", remedy="") == before
    assert found.determined == plain.determined


def test_a_direction_that_a_lever_arm_shares_says_so() -> None:
    prior = np.diag(np.tile(SIGMAS**-2.0, 2))
    D_knowing = np.diag(np.tile(SIGMAS**-2.0, 2)) * 1e4
    along = np.concatenate(list(twist_of_all([0, 0, 0, 1, 0, 0], LIDARS).values()))
    # A lever arm of 2 m hides the forward shift of all LiDARs.
    lost = D_knowing @ along
    D = D_knowing - np.outer(lost, lost) / (0.25 + along @ lost)
    found = named(assess(D, prior, LIDARS), LIDARS)
    assert len(found.undetermined) == 1

    shared = same_as_parameters(found, D, {"lever_arm": D_knowing, "imu_rotation": D})

    (direction,) = shared.undetermined
    assert direction.text.startswith("shift of all LiDARs together forward: x")
    assert direction.text.endswith("; an error of gnss.lever_arm looks the same")
    assert direction.remedy.startswith("measure gnss.lever_arm")
    assert limited_axes(D, D_knowing, prior) == ("x",)
    assert limited_axes(D, D, prior) == ()


def test_a_measured_figure_comes_with_what_it_limits() -> None:
    arm = VehicleParameter(
        np.array([1.2, 0.3, 0.85]), np.array([0.01, 0.02, 2.0]), (True, True, False), ("x",)
    )
    turn = VehicleParameter(np.radians([90.0, 0.0, 2.0]), np.radians([0.1] * 3), (False,) * 3)

    assert vehicle_text("lever_arm", arm) == (
        "gnss.lever_arm: (1.200, 0.300, 0.850) m, sigma (0.0100, 0.0200, 2.0000) m; the drive "
        "determines x, y. Half or more of the variance of S2V x comes from it"
    )
    assert vehicle_text("imu_rotation", turn) == (
        "imu.T_vehicle_imu: (90.00, 0.00, 2.00) degrees, sigma (0.100, 0.100, 0.100) degrees; the "
        "drive adds nothing"
    )
    scales = VehicleParameter(np.array([1.021, 1.019]), np.array([3e-4, 2e-4]), (True, True))
    assert vehicle_text("speed_scale", scales) == (
        "scale of the speeds in topics.twist: (1.0210, 1.0190), sigma (0.00030, 0.00020), one per "
        "drive"
    )
    yaw = VehicleParameter(np.radians([91.2]), np.radians([0.05]), (True,))
    assert vehicle_text("heading_yaw", yaw) == (
        "heading.yaw_deg: (91.200), sigma (0.050) degrees, one per drive"
    )
    clock = VehicleParameter(np.array([0.0251]), np.array([3.1e-4]), (True,), ("x",))
    assert vehicle_text("gnss_time_offset", clock) == (
        "gnss.time_offset: +25.10 ms, sigma 0.31 ms. Half or more of the variance of S2V x comes "
        "from it"
    )
    open_clock = VehicleParameter(np.array([2e-4]), np.array([8.9e-3]), (False,))
    assert vehicle_text("imu_time_offset", open_clock) == (
        "imu.time_offset: not determined, sigma 8.90 ms"
    )


# ------------------------------------------------------------------ walls instead of a target


@pytest.mark.parametrize(
    ("axis", "part"), [("x", "not parallel"), ("pitch", "not parallel"), ("z", "ground.use")]
)
def test_lidars_apart_are_told_which_walls_they_lack(axis: str, part: str) -> None:
    parts = {"front": np.eye(6)[AXES.index(axis)] * UNIT, "rear": np.zeros(6)}

    text = remedy(parts, LIDARS, evidence="structure")

    assert part in text
    assert "target" not in text
    assert remedy(parts, LIDARS, evidence="both") == f"{remedy(parts, LIDARS)}; or {text}"


def test_no_remedy_of_walls_speaks_of_a_target() -> None:
    assert not any("target" in text for text in vars(OF_STRUCTURE).values())
    assert all("wall" in text or "ground" in text for text in vars(OF_STRUCTURE).values())
    assert all("target" in text or "ground" in text for text in vars(OF_BOTH).values())


def test_straight_past_walls_without_ground_is_no_standstill() -> None:
    # Five motions are lost as at standstill on ground; here the yaw is left.
    texts = {d.text for d in predicted(0, 1, 3, 4, 5).undetermined}

    assert len(texts) == 5
    assert not any("did not move" in text for text in texts)
