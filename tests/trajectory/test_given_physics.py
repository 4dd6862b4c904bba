"""Given poses that are right in another convention than they are read in."""

from __future__ import annotations

import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caliv_graph.config.model import Config
from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.se3 import stack
from caliv_graph.physics import raise_fatal, raw_findings
from caliv_graph.products import Array, GivenPoses, MotionData, PoseFrame
from caliv_graph.trajectory.given_physics import PosesPhysics, poses_physics

NORTH_EAST = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
DOWN = np.diag([1.0, -1.0, -1.0])
CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""(3, 3) from the axes of a camera, x to the right, y down, z ahead, to x forward, y left, z up."""
CONFIG = {"lidars": {"a": {"topic": "/a"}}, "topics": {"pose": "/pose"}}


def s_curve(radius_m: float = 9.0, ahead_m: float = 0.0) -> tuple[Array, Array]:
    """Poses of a vehicle that turns left, then right, on a slope of 3 degrees; 40 m of way.

    `ahead_m`: of the vehicle frame before the rear axle.
    """
    s = np.arange(0.0, 40.0, 0.2)
    yaw = 0.7 + np.where(s < 20.0, s, 40.0 - s) / radius_m
    step = 0.2 * np.column_stack([np.cos(yaw), np.sin(yaw), np.full(len(s), 0.05)])
    R = Rotation.from_euler("ZYX", np.column_stack([yaw, np.full(len(s), -0.05), 0.0 * s]))
    t = np.cumsum(step, axis=0) + np.array([300.0, -200.0, 5.0])
    return R.as_matrix(), t + ahead_m * R.as_matrix()[:, :, 0]


def recorded(R: Array, t: Array) -> MotionData:
    poses = tuple(gtsam.Pose3(gtsam.Rot3(a), b) for a, b in zip(R, t, strict=True))
    stamps = (1e8 * np.arange(len(R))).astype(np.int64)
    return MotionData("drive", poses=GivenPoses(stamps, poses))


def found(R: Array, t: Array) -> PosesPhysics | None:
    return poses_physics(recorded(R, t))


def other(reading: str) -> tuple[Array, Array]:
    """The same drive as somebody else would write it."""
    R, t = s_curve()
    q = Rotation.from_matrix(R).as_quat()
    match reading:
        case "wxyz":
            return Rotation.from_quat(q[:, [3, 0, 1, 2]]).as_matrix(), t
        case "frd":
            return R @ DOWN, t
        case "inverse":
            inverse = [gtsam.Pose3(gtsam.Rot3(a), b).inverse() for a, b in zip(R, t, strict=True)]
            return stack(inverse)
        case "compass":
            return NORTH_EAST @ R @ DOWN, t
        case "y":
            return R, t * [1.0, -1.0, 1.0]
        case "camera":
            # 3 m ahead of the axle: in curves of 9 m it goes 18 degrees off where it looks.
            R, t = s_curve(ahead_m=3.0)
            return R @ CAMERA, t
        case "camera_map":
            R, t = s_curve(ahead_m=3.0)
            return CAMERA.T @ R @ CAMERA, t @ CAMERA
        case "rfu":
            R, t = s_curve(ahead_m=3.0)
            return R @ Rotation.from_euler("z", -90.0, degrees=True).as_matrix(), t
        case _:
            return R, t[:, [1, 0, 2]]


def test_a_vehicle_that_goes_where_it_points() -> None:
    assert found(*s_curve()) is None


def test_a_frame_ahead_of_the_axle_is_no_other_convention() -> None:
    assert found(*s_curve(5.0, ahead_m=3.0)) is None


def test_a_vehicle_that_reverses_or_goes_sideways_is_no_other_convention() -> None:
    R, t = s_curve()
    for turn in (180.0, 90.0):
        assert found(R @ Rotation.from_euler("z", turn, degrees=True).as_matrix(), t) is None


@pytest.mark.parametrize("back", [0.6, 0.9, 1.0])
def test_a_vehicle_that_goes_back_as_far_as_ahead_is_no_other_convention(back: float) -> None:
    R, t = s_curve(ahead_m=1.0)
    returning = slice(None, -1 - round(back * (len(t) - 1)), -1)
    R, t = np.concatenate([R, R[returning]]), np.concatenate([t, t[returning]])
    assert found(R, t + np.random.default_rng(2).normal(scale=0.01, size=t.shape)) is None


def test_noisy_poses_are_no_other_convention() -> None:
    R, t = s_curve()
    assert found(R, t + np.random.default_rng(1).normal(scale=0.1, size=t.shape)) is None


def test_a_short_way_tells_no_course() -> None:
    R, t = other("y")
    assert found(R[:20], t[:20]) is None
    assert found(R[:3], t[:3]) is None


@pytest.mark.parametrize(
    "reading", ["wxyz", "inverse", "compass", "y", "xy", "camera", "camera_map"]
)
def test_poses_of_another_convention_stop_with_what_they_are(reading: str) -> None:
    R, t = other(reading)
    physics = found(R, t)
    assert physics is not None
    assert reading in physics.readings
    ahead = reading.startswith("camera")
    assert math.degrees(physics.then.spread_rad) < (19.0 if ahead else 1.0)
    assert not ahead or physics.readings == (reading,)
    config = Config.model_validate(CONFIG)
    findings = raw_findings({0: recorded(R, t)}, config)
    with pytest.raises(TrajectoryError, match=r"drive: by the poses in topics.pose, .*median"):
        raise_fatal(findings)


def test_the_order_of_quaternions_is_said_with_its_numbers() -> None:
    config = Config.model_validate({"lidars": {"a": {"topic": "/a"}}, "data": {"format": "caliv"}})
    (finding,) = raw_findings({0: recorded(*other("wxyz"))}, config)
    assert finding.input == "topics.pose"
    assert "input/ego_poses.yaml" in finding.sentence
    assert "degrees from z of the map" in finding.sentence
    assert "in the order w x y z" in finding.sentence
    assert finding.sentence.endswith("Write them in the order x y z w")


def test_a_frame_with_z_down_is_a_warning() -> None:
    """Guesses may be in the same axes."""
    config = Config.model_validate({"lidars": {"a": {"topic": "/a"}}, "data": {"poses": "a.tum"}})
    (finding,) = raw_findings({0: recorded(*other("frd"))}, config)
    assert finding.severity == "warning"
    assert "z of the vehicle is 177 degrees from z of the map" in finding.sentence
    assert "data.pose_axes: frd" in finding.sentence


def test_a_vehicle_whose_y_is_ahead_is_a_warning() -> None:
    """Guesses may be in the same axes."""
    (finding,) = raw_findings({0: recorded(*other("rfu"))}, Config.model_validate(CONFIG))
    assert finding.severity == "warning"
    assert "the direction of travel is 90 degrees off where the vehicle points" in finding.sentence
    assert "x of the vehicle to the right and y ahead" in finding.sentence


def test_a_vehicle_frame_that_is_meant_to_lean_does_not_stop() -> None:
    leaning = Config.model_validate({**CONFIG, "ground": {"parallel_sigma_deg": 30.0}})
    (finding,) = raw_findings({0: recorded(*other("camera"))}, leaning)
    assert finding.severity == "warning"
    (finding,) = raw_findings({0: recorded(*other("camera"))}, Config.model_validate(CONFIG))
    assert "z of the vehicle is 87 degrees from z of the map" in finding.sentence
    assert "T_camera_vehicle, from the right" in finding.sentence


def test_the_frame_of_a_camera_is_said_with_its_mount() -> None:
    motion = recorded(*other("camera"))
    assert motion.poses is not None
    T = gtsam.Pose3(gtsam.Rot3(CAMERA), np.array([3.0, 0.0, 1.0]))
    frame = PoseFrame("camera_optical", "base_link", T)
    posed = replace(motion, poses=replace(motion.poses, frame=frame))
    (finding,) = raw_findings({0: posed}, Config.model_validate(CONFIG))
    assert "by the poses in topics.pose of the frame 'camera_optical'" in finding.sentence
    # The vehicle's origin is 1 m below (y), and 3 m behind (-z).
    assert "T_camera_optical_base_link is xyz [0.00, 1.00, -3.00]" in finding.sentence


def test_positions_in_millimetres_make_a_vehicle_that_is_too_fast() -> None:
    R, t = s_curve()  # at 2 m/s
    assert raw_findings({0: recorded(R, t)}, Config.model_validate(CONFIG)) == ()
    (fast,) = raw_findings({0: recorded(R, 1000.0 * t)}, Config.model_validate(CONFIG))
    assert "the vehicle goes 1998 m/s" in fast.sentence
    assert "of millimetres 2)" in fast.sentence
    with pytest.raises(TrajectoryError, match="Give positions in metres"):
        raise_fatal([fast])


def test_poses_that_are_inverted_far_from_the_origin_are_not_in_another_unit() -> None:
    R, t = s_curve()
    poses = [gtsam.Pose3(gtsam.Rot3(a), 5.0 * b).inverse() for a, b in zip(R, t, strict=True)]
    (found,) = raw_findings({0: recorded(*stack(poses))}, Config.model_validate(CONFIG))
    assert "Invert them" in found.sentence
