from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from caliv_graph.calibration.requirements import unmet_requirements
from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config
from caliv_graph.conventions import AXES
from caliv_graph.products import Array, Calibration, Direction
from caliv_graph.uncertainty.pairs import sigmas_s2s, sigmas_s2v
from tests.samples import make_calibration, pose, trusted, unseen

DEGREE = math.radians(1.0)

STRAIGHT = {"xyz": [0.0, 0.0, 0.0], "rpy_deg": [0.0, 0.0, 0.0]}


def config_for(calibration: Calibration, *fixed: str, **sections: object) -> Config:
    """A config of these LiDARs, read as a file would be."""
    lidars = {
        name: {"topic": f"sensor_{i}", "initial": STRAIGHT, "fixed": name in fixed}
        for i, name in enumerate(calibration.lidars)
    }
    raw = {"lidars": lidars, "reference": calibration.reference, **sections}
    return parse_config(raw, "config.yaml", Path())


def unmet(calibration: Calibration, *fixed: str, **sections: object) -> tuple[str, ...]:
    config = config_for(calibration, *fixed, **sections)
    return unmet_requirements(calibration, config).unmet


def alone(lidar: str, other: str, axis: str) -> Direction:
    """One LiDAR moves along one axis, the other stays."""
    vector = np.zeros(6)
    vector[AXES.index(axis)] = 1.0
    return Direction(
        vector={lidar: vector, other: np.zeros(6)},
        sigma_data=math.inf,
        sigma_prior=1.0,
        together=False,
        text=f"{axis} of lidar '{lidar}'",
    )


def with_covariance(calibration: Calibration, cov_joint: Array) -> Calibration:
    """The same calibration with another joint covariance (right perturbations)."""
    lidars = {
        name: replace(lidar, cov=cov_joint[6 * i : 6 * i + 6, 6 * i : 6 * i + 6])
        for i, (name, lidar) in enumerate(calibration.lidars.items())
    }
    return replace(calibration, lidars=lidars, cov_joint=cov_joint)


def level(front_x_m: float = 0.0) -> Calibration:
    """Two LiDARs that look ahead, level: their axes are the vehicle's. The rear one is at x = 0."""
    calibration = make_calibration()
    lidars = {
        name: replace(lidar, T_vehicle_lidar=pose((x, 0.0, 2.0), (0.0, 0.0, 0.0)))
        for (name, lidar), x in zip(calibration.lidars.items(), (front_x_m, 0.0), strict=True)
    }
    return replace(calibration, lidars=lidars)


# ------------------------------------------------------------------ require


def test_by_default_an_arc_is_enough() -> None:
    # x and yaw of all LiDARs are lost together: sensor to sensor is not.
    assert unmet(make_calibration()) == ()


def test_s2s_wants_every_pair_determined() -> None:
    calibration = make_calibration(undetermined=(alone("front", "rear", "z"),))

    (sentence,) = unmet(calibration, require=["s2s"])

    assert sentence.startswith("require s2s: ")
    # Up in the vehicle is up and, by 10 degrees of pitch, forward in the rear LiDAR.
    for word in ("z", "front", "rear", "not determined"):
        assert word in sentence


def test_s2s_names_the_pairs_that_are_lost_and_no_other() -> None:
    calibration = make_calibration("front", "left", "rear")
    direction = Direction(
        vector={"front": np.zeros(6), "left": np.eye(6)[2], "rear": np.zeros(6)},
        sigma_data=math.inf,
        sigma_prior=1.0,
        together=False,
        text="yaw of lidar 'left'",
    )
    calibration = make_calibration(*calibration.lidars, undetermined=(direction,))

    sentences = unmet(calibration, require=["s2s"])

    assert len(sentences) == 2
    assert all("'left'" in sentence for sentence in sentences)
    assert {"'front'" in sentence for sentence in sentences} == {True, False}


@pytest.mark.parametrize(
    ("requirement", "axes"), [("s2v_rotation", "yaw"), ("s2v", "yaw, x")], ids=str
)
def test_s2v_names_the_axes_that_the_arc_lost(requirement: str, axes: str) -> None:
    sentences = unmet(make_calibration(), require=[requirement])

    assert sentences == (
        f"require {requirement}: {axes} of 'front' not determined",
        f"require {requirement}: {axes} of 'rear' not determined",
    )


def test_s2v_rotation_does_not_ask_for_translation() -> None:
    calibration = make_calibration()
    without_x = {axis: axis != "x" for axis in AXES}
    lidars = {n: replace(r, determined=without_x) for n, r in calibration.lidars.items()}
    calibration = replace(calibration, lidars=lidars)

    assert unmet(calibration, require=["s2v_rotation"]) == ()
    assert len(unmet(calibration, require=["s2v"])) == 2


def test_several_requirements_are_all_checked_and_none_is_asked_for_twice() -> None:
    calibration = make_calibration()

    sentences = unmet(calibration, require=["s2s", "s2v_rotation", "s2v_rotation"])

    assert len(sentences) == 2
    assert unmet(calibration, require=[]) == ()


def test_the_rest_of_the_calibration_is_left_alone() -> None:
    calibration = make_calibration()

    checked = unmet_requirements(calibration, config_for(calibration, require=["s2v"]))

    assert checked.unmet
    assert (checked.status, checked.lidars) == (calibration.status, calibration.lidars)


# ------------------------------------------------------------------ LiDARs that never saw a target


def test_a_lidar_that_never_saw_the_target_is_a_promise_not_kept_whatever_was_required() -> None:
    calibration = unseen(make_calibration(), "front")

    for require in ([], ["s2s"]):
        assert unmet(calibration, require=require) == ("lidar 'front' never saw the target",)


def test_what_was_required_is_asked_of_those_that_saw_it() -> None:
    calibration = unseen(make_calibration(), "front")

    sentences = unmet(calibration, require=["s2v"], limits={"s2v_x_m": 1e-9})

    assert len(sentences) == 3
    assert sentences[0] == "lidar 'front' never saw the target"
    assert all("'rear'" in sentence for sentence in sentences[1:])


def test_a_trusted_lidar_need_not_see_anything() -> None:
    assert unmet(unseen(make_calibration(), "front"), "front") == ()


def test_what_is_required_of_pairs_is_asked_of_a_trusted_lidar_that_saw_nothing() -> None:
    calibration = trusted(make_calibration(undetermined=(alone("rear", "front", "z"),)), "front")

    sentences = unmet(calibration, "front", require=["s2s"], limits={"s2s_x_m": 1e-9})

    assert [sentence.split(":")[0] for sentence in sentences] == ["require s2s", "limits s2s_x_m"]
    assert all("'front' to 'rear'" in sentence for sentence in sentences)


# ------------------------------------------------------------------ limits


def test_sigmas_are_in_vehicle_axes() -> None:
    # The left LiDAR looks left: its x is the vehicle's y, its y points back.
    calibration = make_calibration("left", "rear")
    sigmas = np.array([1e-3, 2e-3, 3e-3, 4e-3, 5e-3, 6e-3, *[1e-3] * 6])
    calibration = with_covariance(calibration, np.diag(sigmas**2))

    assert sigmas_s2v(calibration, "left") == pytest.approx([2e-3, 1e-3, 3e-3, 5e-3, 4e-3, 6e-3])


def test_errors_that_two_lidars_share_are_none_of_the_pair() -> None:
    # One 2 m before the other: what shifts both, or turns both about one point, does not show.
    shift, turn = np.zeros(12), np.zeros(12)
    shift[[3, 9]] = 0.1
    # A turn about the rear LiDAR by 10 mrad: the front one goes 20 mm to the left.
    turn[[2, 8]], turn[4] = 0.01, 0.02
    own = np.zeros(12)
    own[5] = 3e-3
    cov = np.outer(shift, shift) + np.outer(turn, turn) + np.outer(own, own)
    calibration = with_covariance(level(front_x_m=2.0), cov)

    assert sigmas_s2v(calibration, "front") == pytest.approx([0.0, 0.0, 0.01, 0.1, 0.02, 3e-3])
    assert sigmas_s2s(calibration, "front", "rear") == pytest.approx(
        [0.0, 0.0, 0.0, 0.0, 0.0, 3e-3], abs=1e-9
    )


@pytest.mark.parametrize(
    ("key", "sigma", "unit"),
    [
        ("s2v_roll_deg", 1e-3, "degrees"),
        ("s2v_pitch_deg", 2e-3, "degrees"),
        ("s2v_yaw_deg", 3e-3, "degrees"),
        ("s2v_x_m", 4e-3, "m"),
        ("s2v_y_m", 5e-3, "m"),
        ("s2v_z_m", 6e-3, "m"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_limit_is_on_the_sigma_of_its_own_axis(key: str, sigma: float, unit: str) -> None:
    sigmas = np.array([1e-3, 2e-3, 3e-3, 4e-3, 5e-3, 6e-3])
    cov = np.diag(np.concatenate([sigmas, 0.5 * sigmas]) ** 2)
    calibration = with_covariance(level(), cov)
    given = sigma / DEGREE if unit == "degrees" else sigma

    assert unmet(calibration, require=[], limits={key: 1.01 * given}) == ()
    (sentence,) = unmet(calibration, require=[], limits={key: 0.99 * given})
    assert sentence == (
        f"limits {key}: sigma of 'front' is {given:.3g} {unit}, limit {0.99 * given:g}"
    )


def test_a_limit_on_pairs_is_on_what_is_between_them() -> None:
    # Independent errors of 3 and 4 mm along z are 5 mm between two LiDARs that are level.
    cov = np.zeros((12, 12))
    cov[5, 5], cov[11, 11] = 3e-3**2, 4e-3**2
    calibration = with_covariance(level(), cov)

    assert unmet(calibration, require=[], limits={"s2s_z_m": 5.01e-3}) == ()
    (sentence,) = unmet(calibration, require=[], limits={"s2s_z_m": 4.99e-3})
    assert sentence == "limits s2s_z_m: sigma of 'front' to 'rear' is 0.005 m, limit 0.00499"


def test_limits_and_requirements_add_up() -> None:
    sentences = unmet(make_calibration(), require=["s2v"], limits={"s2v_z_m": 1e-6})

    assert [sentence.split(":")[0] for sentence in sentences] == [
        *["require s2v"] * 2,
        *["limits s2v_z_m"] * 2,
    ]
