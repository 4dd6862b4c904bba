"""A drive of LiDARs alone: what is calibrated, what stays open, and what is refused."""

from __future__ import annotations

from functools import cache
from typing import Any

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.requirements import unmet_requirements
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.model import Config
from caliv_graph.errors import ConfigError, TrajectoryError
from caliv_graph.fusion.terms import drive_digest
from caliv_graph.odometry.run import needs_odometry, with_odometry
from caliv_graph.pipeline import calibrate
from caliv_graph.products import MotionData, TwistSamples
from caliv_graph.results.run import CalibrationRun
from caliv_graph.trajectory.odometry import OdometryPoses
from caliv_graph.uncertainty.evaluation import evaluate
from caliv_graph.uncertainty.pairs import pair_determined
from tests.odometry.room_drive import RoomDrive, s_curve

TRUTH = {
    "a": gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, 0.1, 0.5), np.array([1.5, 0.3, 1.8])),
    "b": gtsam.Pose3(gtsam.Rot3.RzRyRx(-0.03, 0.05, -2.5), np.array([-0.5, -0.3, 1.6])),
}
OFF = {"a": (0.02, -0.03, 0.02, 0.05, -0.08, 0.04), "b": (-0.03, 0.01, 0.03, -0.06, 0.03, 0.08)}


def config_of(guesses: bool = True, **sections: Any) -> Config:
    lidars: dict[str, dict[str, Any]] = {}
    for name, T in TRUTH.items():
        guess = T.retract(np.array(OFF[name]))
        rpy_deg = np.degrees(guess.rotation().rpy()).tolist()
        initial = {"xyz": guess.translation().tolist(), "rpy_deg": rpy_deg}
        lidars[name] = {"topic": f"/{name}", "initial": initial if guesses else None}
    known: dict[str, Any] = {"lidars": lidars, "ground": {"vehicle_height": 0.0}}
    return Config.model_validate({**known, **sections})


def room(seconds: float = 6.5, **changes: Any) -> RoomDrive:
    return RoomDrive(TRUTH, s_curve(seconds), **changes)


@cache
def calibrated() -> CalibrationRun:
    return calibrate([room(phase_s={"b": 0.05})], config_of(), SilentProgress())


def test_places_of_lidars_to_each_other_without_motion_data() -> None:
    calibration = calibrated().calibration
    assert calibration.status == "partial"
    assert calibration.unmet == ()
    (pair,) = evaluate(calibration, TRUTH)["pairs"]
    assert all(pair_determined(calibration, "b", "a").values())
    assert pair["nees"] < 20.0  # 3 sigma
    assert np.abs(pair["translation_m"]).max() < 0.01
    assert np.abs(pair["rotation_rad"]).max() < 1e-3


def test_the_vehicle_is_known_by_ground_and_course_alone() -> None:
    calibration = calibrated().calibration
    found = evaluate(calibration, TRUTH)["lidars"]
    for name, lidar in calibration.lidars.items():
        determined = {axis for axis, known in lidar.determined.items() if known}
        assert determined == {"roll", "pitch", "yaw", "z"}
        turned = found[name]["s2v"]["rotation_rad"]
        assert np.abs(turned).max() < 0.02
        # As well as a vehicle stands parallel to the ground, however many scans there are.
        sigmas = np.sqrt(np.linalg.eigvalsh(lidar.cov[:3, :3]))
        assert sigmas[0] > 5e-3
        assert np.all(np.abs(turned) < 3.0 * sigmas)
    together = [direction for direction in calibration.undetermined if direction.together]
    assert len(together) == 2
    assert all("record an IMU" in direction.remedy for direction in together)
    assert "odometry of lidar 'a'" in str(calibration.provenance["motion"])
    assert calibrated().calibration.warnings[0].startswith("no motion data")


def test_what_a_user_asks_of_the_vehicle_is_not_promised() -> None:
    config = config_of(require=["s2v"])
    assert "x, y of 'a'" in unmet_requirements(calibrated().calibration, config).unmet[0]


def test_without_a_guess_the_ground_and_the_course_place_the_tracked_lidar() -> None:
    drive, config = room(), config_of(guesses=False)
    motions, with_guess, placements = with_odometry(
        [drive], config, {0: drive.motion()}, SilentProgress()
    )
    poses = motions[0].poses
    assert isinstance(poses, OdometryPoses)
    assert [p.lidar for p in placements] == [poses.lidar] == ["a"]
    T = with_guess.lidars["a"].guess()
    turned = gtsam.Rot3.Logmap(T.rotation().between(TRUTH["a"].rotation()))
    assert np.abs(turned).max() < 0.02
    assert T.z() == pytest.approx(1.8, abs=0.02)
    assert T.translation()[:2] == pytest.approx([0.0, 0.0])
    # A guess moves the vehicle's poses, but the drive stays the same one.
    guessed, _, _ = with_odometry([drive], config_of(), {0: drive.motion()}, SilentProgress())
    assert drive_digest(guessed[0]) == drive_digest(motions[0]) != drive_digest(drive.motion())


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        ({"structure": {"use": False}}, "a target does not: set structure.use: true"),
        ({"solve": {"mode": "staged"}}, "a target does not: set solve.mode: auto"),
        ({"ground": {"use": False}}, "which way is up: set ground.use: true"),
        ({"solve": {"time_offset": True}}, "set solve.time_offset: false"),
    ],
)
def test_what_needs_motion_data_is_refused(sections: dict[str, Any], words: str) -> None:
    drive = room()
    with pytest.raises(ConfigError, match=words):
        with_odometry([drive], config_of(**sections), {0: drive.motion()}, SilentProgress())


def test_a_drive_without_walls_says_what_to_do() -> None:
    drive = room(2.0, walls=())
    with pytest.raises(TrajectoryError, match=r"lidar 'a': .* lidar 'b': .* record an IMU"):
        with_odometry([drive], config_of(), {0: drive.motion()}, SilentProgress())


def test_a_source_that_is_named_is_not_replaced() -> None:
    nothing = MotionData("room")
    assert needs_odometry(nothing, config_of())
    assert not needs_odometry(nothing, config_of(topics={"imu": "/imu"}))
    assert not needs_odometry(nothing, config_of(data={"format": "caliv"}))
    twist = TwistSamples(np.arange(2), np.zeros((2, 3)))
    assert not needs_odometry(MotionData("room", twist=twist), config_of())
