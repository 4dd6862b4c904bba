"""Sigmas and verdicts from information alone, and what would determine a direction."""

from __future__ import annotations

import math
from pathlib import Path

import gtsam
import numpy as np
import pytest
import yaml

from caliv_graph.conventions import AXES
from caliv_graph.geometry.se3 import retract_vehicle_axes, vehicle_axes_difference
from caliv_graph.products import Array
from caliv_graph.results.calibration_file import read_calibration, write_calibration
from caliv_graph.uncertainty.evaluation import evaluate
from caliv_graph.uncertainty.observability import (
    REMEDY_APART,
    REMEDY_HEIGHT,
    REMEDY_MORE,
    REMEDY_STOOD,
    REMEDY_STRAIGHT,
    REMEDY_SYMMETRY,
    REMEDY_TILT,
    REMEDY_TURN_CENTRE,
    UNIT,
    remedy,
)
from caliv_graph.uncertainty.predicted import (
    PredictedCovariance,
    predict_covariance,
    undetermined_offsets,
)
from tests.samples import MOUNTINGS, pose

LIDARS = {name: pose(*MOUNTINGS[name]) for name in ("front", "rear")}
SIGMAS = np.array([0.03] * 3 + [0.06] * 3)


def parts_of(twist: list[float]) -> dict[str, Array]:
    """What each LiDAR does if all are moved by a small twist of the vehicle."""
    step = 1e-6
    motion = gtsam.Pose3.Expmap(step * np.array(twist))
    return {n: vehicle_axes_difference(motion.compose(T), T) / step for n, T in LIDARS.items()}


@pytest.mark.parametrize(
    ("twist", "expected"),
    [
        ([0, 0, 0, 0, 0, 1], REMEDY_HEIGHT),
        ([0, 0, 1, -9.16, 0, 0], REMEDY_TURN_CENTRE),
        ([0, 0, 1, 9.16, 1.0, 0], REMEDY_TURN_CENTRE),
        ([0, 0, 0, 1, 0, 0], REMEDY_STRAIGHT),
        ([0, 0, 0, 0, 1, 0], REMEDY_STRAIGHT),
        ([1, 0, 0, 0, 3, 0], REMEDY_STRAIGHT),
        ([1, 0, 0, 0, 0, 0], REMEDY_TILT),
        ([0, 1, 0, 0, 0, 0], REMEDY_TILT),
    ],
)
def test_every_direction_has_a_manoeuvre_that_fixes_it(twist: list[float], expected: str) -> None:
    for scale in (1.0, -1e-3):
        parts = {name: scale * part for name, part in parts_of(twist).items()}
        assert remedy(parts, LIDARS) == expected


@pytest.mark.parametrize(("axis", "expected"), [("x", REMEDY_APART), ("yaw", REMEDY_SYMMETRY)])
def test_lidars_that_move_apart_have_to_see_the_same_side(axis: str, expected: str) -> None:
    parts = {"front": np.eye(6)[AXES.index(axis)] * UNIT, "rear": np.zeros(6)}

    assert remedy(parts, LIDARS) == expected
    # Where they do see it, what helps is to see it more often.
    assert remedy(parts, LIDARS, weak=True) == REMEDY_MORE


def rigid_loss(*lost: int) -> Array:
    """Information of two LiDARs that know all but some motions of both as one."""
    rows = np.vstack(
        [
            np.array([p / UNIT for p in parts_of(np.eye(6)[i].tolist()).values()]).ravel()
            for i in lost
        ]
    )
    basis = np.linalg.qr(rows.T)[0]
    kept = np.eye(12) - basis @ basis.T
    unit = np.tile(UNIT, 2)
    return np.asarray(1e4 * kept / np.outer(unit, unit))


@pytest.mark.parametrize(
    ("lost", "text"),
    [
        (range(6), "everything to the vehicle: it never moved"),
        (range(5), "everything to the vehicle but its height: it never moved"),
    ],
)
def test_a_vehicle_that_stood_is_told_so(lost: range, text: str) -> None:
    outlook = predict_covariance(
        rigid_loss(*lost), ("front", "rear"), "rear", LIDARS, dict.fromkeys(LIDARS, SIGMAS), {}, {}
    )

    assert [d.text for d in outlook.undetermined] == [text] * len(lost)
    assert {d.remedy for d in outlook.undetermined} == {REMEDY_STOOD}
    # The pair is told all the same.
    assert set(outlook.determined_s2s) == {("front", "rear")}


def test_remedies_stand_in_the_file_and_are_read_back(tmp_path: Path) -> None:
    outlook = predict_covariance(
        rigid_loss(5), ("front", "rear"), "rear", LIDARS, dict.fromkeys(LIDARS, SIGMAS), {}, {}
    )
    file = tmp_path / "calibration.yaml"

    write_calibration(outlook.calibration, file)

    written = yaml.safe_load(file.read_text())["observability"]["undetermined"]
    assert [entry["remedy"] for entry in written] == [REMEDY_HEIGHT]
    assert [d.remedy for d in read_calibration(file).undetermined] == [REMEDY_HEIGHT]


def test_four_lost_motions_are_said_one_by_one() -> None:
    outlook = predict_covariance(
        rigid_loss(0, 3, 4, 5),
        ("front", "rear"),
        "rear",
        LIDARS,
        dict.fromkeys(LIDARS, SIGMAS),
        {},
        {},
    )

    texts = {d.text for d in outlook.undetermined}
    assert len(texts) == 4
    assert not any("never moved" in text for text in texts)


def make_outlook() -> tuple[Array, PredictedCovariance]:
    rng = np.random.default_rng(5)
    root = rng.normal(size=(12, 48)) * np.tile(1.0 / np.array([1e-3] * 3 + [5e-3] * 3), 2)[:, None]
    D = root @ root.T
    guesses = dict.fromkeys(LIDARS, SIGMAS)
    return D, predict_covariance(
        D, ("front", "rear"), "rear", LIDARS, guesses, {"front": 9, "rear": 9}, {}
    )


def test_sigmas_of_a_pair_are_those_of_evaluates_errors() -> None:
    # Draw extrinsics, and let `evaluate` say how far the one is off against the other.
    D, outlook = make_outlook()
    rng = np.random.default_rng(6)
    root = np.linalg.cholesky(np.linalg.inv(D))
    errors = []
    calibration = outlook.calibration
    cov_pairs = {("front", "rear"): np.eye(6)}
    for _ in range(400):
        e = (root @ rng.normal(size=12)).reshape(2, 6)
        truth = {n: retract_vehicle_axes(T, -e[i]) for i, (n, T) in enumerate(LIDARS.items())}
        pair = evaluate(calibration, truth, cov_pairs)["pairs"][0]
        errors.append([*pair["rotation_rad"], *pair["translation_m"]])

    sigma = outlook.sigma_s2s["front", "rear"]
    # 400 draws: a sigma to 3.5 percent, 1 sigma.
    assert np.std(errors, axis=0) / sigma == pytest.approx(np.ones(6), abs=0.15)


def test_a_lidar_without_data_keeps_its_guess() -> None:
    lidars = {**LIDARS, "left": pose(*MOUNTINGS["left"])}
    sigmas = {"front": SIGMAS, "rear": SIGMAS, "left": 2.0 * SIGMAS}

    outlook = predict_covariance(
        np.diag(np.tile([1e8] * 3 + [1e6] * 3, 2)),
        ("front", "rear"),
        "rear",
        lidars,
        sigmas,
        {"front": 20, "rear": 30},
        {},
    )

    assert outlook.unseeing == ("left",)
    assert outlook.sigma_s2v["left"] == pytest.approx(2.0 * SIGMAS)
    result = outlook.calibration.lidars["left"]
    assert not any(result.determined.values())
    assert not result.saw_target
    assert result.cov.trace() == pytest.approx(4.0 * (SIGMAS**2).sum())
    assert outlook.sigma_s2v["front"] == pytest.approx([1e-4] * 3 + [1e-3] * 3)
    expected = math.hypot(1e-3, 1e-3)
    # x of the pair: both, and nothing of rotations for LiDARs in a row along x.
    assert outlook.sigma_s2s["front", "rear"][3] == pytest.approx(expected, rel=1e-6)


def test_an_offset_is_told_below_the_limit_only() -> None:
    lines = list(undetermined_offsets({"front": 0.004, "rear": 0.04}, 0.005))

    assert len(lines) == 1
    assert "'rear'" in lines[0]
    assert "40 ms" in lines[0]
