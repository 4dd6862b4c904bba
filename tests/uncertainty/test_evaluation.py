"""Errors and NEES by hand, as the paper's Evaluation section defines them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import gtsam
import numpy as np
import pytest

from caliv_graph.conventions import AXES
from caliv_graph.products import Array, Calibration, LidarResult
from caliv_graph.uncertainty.evaluation import evaluate
from tests.samples import MOUNTINGS, make_calibration, make_covariance, pose

COV = np.diag([1e-3, 1e-3, 1e-3, 1e-2, 1e-2, 1e-2]) ** 2


def calibration_of(poses: Mapping[str, gtsam.Pose3], reference: str = "rear") -> Calibration:
    """Independent LiDARs, 1 mrad and 10 mm each."""
    return make_calibration(
        reference=reference,
        lidars={
            name: LidarResult(T, COV, dict.fromkeys(AXES, True), 60, True)
            for name, T in poses.items()
        },
        cov_joint=np.kron(np.eye(len(poses)), COV),
    )


def truth_of(*names: str) -> dict[str, gtsam.Pose3]:
    return {name: pose(*MOUNTINGS[name]) for name in names or ("front", "rear")}


def s2v(calibration: Calibration, truth: Mapping[str, gtsam.Pose3], name: str) -> dict[str, Any]:
    errors: dict[str, Any] = evaluate(calibration, truth)["lidars"][name]["s2v"]
    return errors


def test_the_truth_has_no_error() -> None:
    truth = truth_of()

    evaluation = evaluate(calibration_of(truth), truth)

    assert list(evaluation) == ["lidars", "pairs"]
    assert list(evaluation["lidars"]) == ["front", "rear"]
    (pair,) = evaluation["pairs"]
    assert list(pair) == ["from", "to", "translation_m", "rotation_rad", "nees"]
    assert (pair["from"], pair["to"]) == ("front", "rear")
    for errors in (evaluation["lidars"]["rear"]["s2v"], pair):
        assert errors["translation_m"] == pytest.approx([0, 0, 0], abs=1e-12)
        assert errors["rotation_rad"] == pytest.approx([0, 0, 0], abs=1e-12)
        assert errors["nees"] == pytest.approx(0, abs=1e-12)


def test_s2v_translation_is_estimate_minus_truth_in_vehicle_axes() -> None:
    # The rear LiDAR looks back, nose down: in its own axes this shift would be another.
    truth = truth_of()
    estimate = {**truth, "rear": pose((-0.4 + 0.01, -0.02, 2.0 + 0.03), (0.0, 10.0, 180.0))}

    errors = s2v(calibration_of(estimate), truth, "rear")

    assert errors["translation_m"] == pytest.approx([0.01, -0.02, 0.03])
    assert errors["rotation_rad"] == pytest.approx([0, 0, 0], abs=1e-12)
    # Equal sigmas on the three axes: no rotation changes 0.01^2 + 0.02^2 + 0.03^2 over 0.01^2.
    assert errors["nees"] == pytest.approx(14.0)


def test_s2v_rotation_is_about_vehicle_axes() -> None:
    # Yaw is about the vehicle's z, also for a LiDAR whose own z is tilted by 10 degrees.
    truth = truth_of()
    estimate = {**truth, "front": pose((2.0, 0.0, 2.0), (0.0, 10.0, math.degrees(0.004)))}

    errors = s2v(calibration_of(estimate), truth, "front")

    assert errors["rotation_rad"] == pytest.approx([0, 0, 0.004], abs=1e-12)
    assert errors["translation_m"] == pytest.approx([0, 0, 0], abs=1e-12)
    assert errors["nees"] == pytest.approx(16.0)


def test_a_common_motion_of_all_lidars_is_no_s2s_error() -> None:
    truth = truth_of("front", "left", "rear")
    motion = pose((0.3, -0.2, 0.1), (3.0, -2.0, 5.0))
    estimate = {name: motion.compose(T) for name, T in truth.items()}

    evaluation = evaluate(calibration_of(estimate), truth)

    for errors in evaluation["lidars"].values():
        assert np.linalg.norm(errors["s2v"]["translation_m"]) > 0.1
    pairs = [(pair["from"], pair["to"]) for pair in evaluation["pairs"]]
    assert pairs == [("front", "left"), ("front", "rear"), ("left", "rear")]
    for pair in evaluation["pairs"]:
        assert pair["translation_m"] == pytest.approx([0, 0, 0], abs=1e-12)
        assert pair["rotation_rad"] == pytest.approx([0, 0, 0], abs=1e-12)
        assert pair["nees"] == pytest.approx(0, abs=1e-12)


def test_s2s_error_of_a_yawed_reference() -> None:
    # The reference is yawed by 10 mrad too far; the front LiDAR is right. By the reference the
    # front, 2.4 m ahead of it, would be 2.4 m sin(0.01) further left and yawed by 10 mrad: that
    # much is the front to the right of where it should be, and yawed the other way.
    truth = truth_of()
    psi = 0.01
    estimate = {**truth, "rear": pose((-0.4, 0.0, 2.0), (0.0, 10.0, 180.0 + math.degrees(psi)))}

    (pair,) = evaluate(calibration_of(estimate), truth)["pairs"]

    assert pair["translation_m"] == pytest.approx(
        [2.4 - 2.4 * math.cos(psi), -2.4 * math.sin(psi), 0.0], abs=1e-12
    )
    assert pair["rotation_rad"] == pytest.approx([0, 0, -psi], abs=1e-12)


def test_a_shift_of_one_lidar_is_its_s2s_error_in_vehicle_axes() -> None:
    truth = truth_of()
    estimate = {**truth, "front": pose((2.01, 0.02, 2.0), (0.0, 10.0, 0.0))}

    (pair,) = evaluate(calibration_of(estimate), truth)["pairs"]

    assert pair["translation_m"] == pytest.approx([0.01, 0.02, 0.0])
    # Variances of two LiDARs add up: (0.01^2 + 0.02^2) / (2 0.01^2) without the rear's rotation,
    # which moves the front 2.4 m away by more than its shift does, across but not along.
    assert pair["nees"] < 2.5


def test_pairs_are_against_the_reference_where_it_takes_part() -> None:
    truth = truth_of()

    (pair,) = evaluate(calibration_of(truth, reference="front"), truth)["pairs"]

    assert (pair["from"], pair["to"]) == ("rear", "front")


def test_nees_knows_the_axes_of_the_covariance() -> None:
    # A LiDAR turned left: 0.1 m along the vehicle's x is along its own -y, where sigma is 0.1 m.
    truth = {"left": pose((0.5, 0.9, 1.5), (0.0, 0.0, 90.0))}
    estimate = pose((0.6, 0.9, 1.5), (0.0, 0.0, 90.0))
    cov = np.diag([1e-3, 1e-3, 1e-3, 1e-3, 0.1, 1e-3]) ** 2
    result = LidarResult(estimate, cov, dict.fromkeys(AXES, True), 60, True)
    calibration = make_calibration("left", lidars={"left": result}, cov_joint=cov, undetermined=())

    assert s2v(calibration, truth, "left")["nees"] == pytest.approx(1.0)


def test_nees_is_that_of_the_right_perturbation() -> None:
    cov: Array = make_covariance(2)
    calibration = make_calibration()
    error = np.array([1e-3, -2e-3, 5e-4, 4e-3, -1e-3, 2e-3])
    estimate = calibration.lidars["front"].T_vehicle_lidar
    truth = {"front": estimate.compose(gtsam.Pose3.Expmap(error))}

    nees = s2v(calibration, truth, "front")["nees"]

    assert nees == pytest.approx(error @ np.linalg.inv(cov[:6, :6]) @ error)


def test_nees_of_pairs_averages_their_degrees_of_freedom() -> None:
    calibration = make_calibration()
    rng = np.random.default_rng(5)
    nees = []
    for d in rng.multivariate_normal(np.zeros(12), calibration.cov_joint, size=2000):
        truth = {
            name: result.T_vehicle_lidar.compose(gtsam.Pose3.Expmap(d[6 * i : 6 * i + 6]))
            for i, (name, result) in enumerate(calibration.lidars.items())
        }
        nees.append(evaluate(calibration, truth)["pairs"][0]["nees"])

    # The mean of 2000 chi-squares with 6 dof has a sigma of sqrt(12 / 2000) = 0.077.
    assert np.mean(nees) == pytest.approx(6.0, abs=0.25)


def test_the_covariance_that_a_file_states_for_a_pair_counts() -> None:
    truth = truth_of()
    estimate = {**truth, "front": pose((2.01, 0.0, 2.0), (0.0, 10.0, 0.0))}

    evaluation = evaluate(calibration_of(estimate), truth, {("front", "rear"): 4.0 * COV})

    assert evaluation["pairs"][0]["nees"] == pytest.approx(0.25)


def test_lidars_that_only_one_side_knows_are_left_out() -> None:
    truth = {"rear": truth_of()["rear"], "roof": gtsam.Pose3()}

    evaluation = evaluate(calibration_of(truth_of()), truth)

    assert list(evaluation["lidars"]) == ["rear"]
    assert evaluation["pairs"] == []


def test_a_covariance_without_an_inverse_gives_no_nees() -> None:
    truth = truth_of("rear")
    result = LidarResult(truth["rear"], np.zeros((6, 6)), dict.fromkeys(AXES, True), 0, False)
    calibration = make_calibration(
        "rear", lidars={"rear": result}, cov_joint=np.zeros((6, 6)), undetermined=()
    )

    evaluation = evaluate(calibration, truth)

    assert evaluation["lidars"]["rear"]["s2v"]["nees"] is None
    json.dumps(evaluation, allow_nan=False)


def test_renaming_the_lidars_changes_nothing_but_names() -> None:
    truth = truth_of()
    estimate = {name: T.compose(gtsam.Pose3.Expmap(np.full(6, 1e-3))) for name, T in truth.items()}
    names = {"front": "L1", "rear": "L2"}

    evaluation = evaluate(calibration_of(estimate), truth)
    renamed = evaluate(
        calibration_of({names[n]: T for n, T in estimate.items()}, "L2"),
        {names[n]: T for n, T in truth.items()},
    )

    assert list(renamed["lidars"].values()) == list(evaluation["lidars"].values())
    for key in ("translation_m", "rotation_rad", "nees"):
        assert renamed["pairs"][0][key] == evaluation["pairs"][0][key]
