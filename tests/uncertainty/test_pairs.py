from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.config.guesses import FOUND_SIGMA
from caliv_graph.conventions import AXES
from caliv_graph.products import Direction, Guess
from caliv_graph.uncertainty.pairs import pair_covariance, pair_determined, sensor_pairs
from tests.samples import make_calibration, trusted, unseen


def direction(**vectors: list[float]) -> Direction:
    return Direction(
        vector={name: np.array(vector) for name, vector in vectors.items()},
        sigma_data=math.inf,
        sigma_prior=1.0,
        together=False,
        text="made up",
    )


def test_every_pair_stands_once_and_ends_at_the_reference() -> None:
    assert sensor_pairs(["a"], "a") == ()
    assert sensor_pairs(["a", "b", "c"], "a") == (("b", "a"), ("c", "a"), ("b", "c"))
    assert sensor_pairs(["a", "b", "c"], "b") == (("a", "b"), ("a", "c"), ("c", "b"))


def test_covariance_takes_the_blocks_of_its_own_lidars() -> None:
    three = make_calibration("front", "left", "rear")
    rows = np.r_[0:6, 12:18]
    two = make_calibration(cov_joint=three.cov_joint[np.ix_(rows, rows)])

    assert pair_covariance(three, "front", "rear") == pytest.approx(
        pair_covariance(two, "front", "rear")
    )


def test_a_turn_of_all_lidars_about_one_centre_leaves_the_pair_determined() -> None:
    assert all(pair_determined(make_calibration(), "front", "rear").values())


def test_a_lidar_that_slides_alone_takes_the_pair_along() -> None:
    # Up in the vehicle is up in the left LiDAR, which stands level; its x is the vehicle's y.
    up = direction(front=[0, 0, 0, 0, 0, 1], left=[0] * 6)
    left = direction(front=[0, 0, 0, 0, 1, 0], left=[0] * 6)
    calibration = make_calibration("front", "left", undetermined=(up,))

    determined = pair_determined(calibration, "front", "left")
    assert [axis for axis in AXES if not determined[axis]] == ["z"]

    calibration = make_calibration("front", "left", undetermined=(up, left))
    determined = pair_determined(calibration, "front", "left")
    assert [axis for axis in AXES if not determined[axis]] == ["x", "z"]


def test_lidars_that_turn_each_about_its_own_origin_take_the_pair_along() -> None:
    # Both yaw by the same angle where they stand: their headings agree, but not their places.
    yaw = [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    calibration = make_calibration(undetermined=(direction(front=yaw, rear=yaw),))

    determined = pair_determined(calibration, "front", "rear")

    assert determined["yaw"]
    assert not determined["y"]


def test_a_lidar_without_a_target_determines_no_pair() -> None:
    calibration = unseen(make_calibration(undetermined=()), "front")

    assert not any(pair_determined(calibration, "front", "rear").values())


def test_a_trusted_lidar_that_saw_nothing_determines_its_pairs() -> None:
    up = direction(front=[0] * 6, left=[0, 0, 0, 0, 0, 1])
    calibration = trusted(make_calibration("front", "left", undetermined=(up,)), "front")

    determined = pair_determined(calibration, "front", "left")

    assert [axis for axis in AXES if not determined[axis]] == ["z"]


def test_a_pair_without_guesses_is_not_determined_where_its_sigma_is_that_of_nothing() -> None:
    calibration = make_calibration(undetermined=())
    cov = calibration.cov_joint.copy()
    cov[9, 9] += 1.0  # x of the rear LiDAR's own axes, which are those of the pair: 1 m
    wide = replace(calibration, cov_joint=cov)
    sigmas = FOUND_SIGMA.sigmas()
    for found, lost in ((False, []), (True, ["x"])):
        lidars = {
            name: replace(lidar, guess=Guess(lidar.T_vehicle_lidar, sigmas, found=found))
            for name, lidar in wide.lidars.items()
        }
        determined = pair_determined(replace(wide, lidars=lidars), "front", "rear")
        assert [axis for axis in AXES if not determined[axis]] == lost


def test_without_undetermined_directions_all_is_determined() -> None:
    assert all(pair_determined(make_calibration(undetermined=()), "front", "rear").values())
