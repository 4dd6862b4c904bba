"""Guesses that are tilted against the ground, on level ground and on a slope."""

from __future__ import annotations

import math
from pathlib import Path

import gtsam
import numpy as np
import pytest

from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config
from caliv_graph.products import Array
from caliv_graph.targets.search.level import levelled

HEIGHT_M = 1.8
TRUE = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, math.radians(10.0), 0.5), np.array([1.0, 0.2, HEIGHT_M]))


def config(sigma_deg: float) -> Config:
    lidar = {
        "topic": "front",
        "initial": {"xyz": [1.0, 0.2, HEIGHT_M], "rpy_deg": [0, 0, 0]},
        "sigma": {"xyz": 0.05, "rpy_deg": sigma_deg},
    }
    return parse_config({"data": {"format": "caliv"}, "lidars": {"front": lidar}}, "test", Path())


def scan() -> Array:
    """Ground, as the LiDAR has it: parallel to the vehicle, at z = 0 of its frame."""
    rng = np.random.default_rng(3)
    ground = np.column_stack([rng.uniform(-15.0, 15.0, (4000, 2)), np.zeros(4000)])
    inside = np.linalg.norm(ground[:, :2], axis=1) > 2.0
    return np.array([TRUE.transformTo(p) for p in ground[inside]])


def tilt_deg(T: gtsam.Pose3) -> float:
    """Between the ground's normal and the vehicle's z, as this extrinsic has it."""
    seen = T.rotation().matrix() @ TRUE.rotation().matrix().T @ np.array([0.0, 0.0, 1.0])
    return math.degrees(math.acos(min(float(seen[2]), 1.0)))


def attitude(pitch_deg: float) -> Array:
    return gtsam.Rot3.Ry(math.radians(pitch_deg)).matrix()[None]


@pytest.mark.parametrize("slope_deg", [0.0, 2.0, 5.0, -12.0])
def test_a_right_guess_stays_on_any_slope(slope_deg: float) -> None:
    found = levelled([scan()], attitude(slope_deg), TRUE, "front", config(0.5))
    assert found.equals(TRUE, 0.0)


def test_axes_of_the_vehicle_may_be_inclined_to_the_ground() -> None:
    """Poses of a sensor whose z is not the ground's normal: on level ground the map's is."""
    off = gtsam.Rot3.Ry(math.radians(3.0))
    guess = gtsam.Pose3(off.compose(TRUE.rotation()), TRUE.translation())
    # The ground is level in the map if the vehicle's frame is pitched the other way.
    found = levelled([scan()], off.inverse().matrix()[None], guess, "front", config(0.5))
    assert found.equals(guess, 0.0)


@pytest.mark.parametrize("slope_deg", [0.0, 5.0])
def test_a_guess_that_is_far_off_is_put_right(slope_deg: float) -> None:
    off = gtsam.Rot3.RzRyRx(math.radians(12.0), math.radians(-14.0), 0.0)
    guess = gtsam.Pose3(off.compose(TRUE.rotation()), TRUE.translation())
    found = levelled([scan()], attitude(slope_deg), guess, "front", config(1.7))
    assert tilt_deg(guess) > 15.0
    assert tilt_deg(found) < 0.5
    fixed = config(1.7)
    lidar = fixed.lidars["front"].model_copy(update={"fixed": True})
    fixed = fixed.model_copy(update={"lidars": {"front": lidar}})
    assert levelled([scan()], attitude(slope_deg), guess, "front", fixed).equals(guess, 0.0)
