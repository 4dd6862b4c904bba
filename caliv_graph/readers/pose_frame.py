"""The frame that given poses are of, beside the vehicle frame of the initial guesses, in words."""

from __future__ import annotations

import math

import gtsam
import numpy as np

from caliv_graph.config.model import Config
from caliv_graph.products import PoseFrame
from caliv_graph.readers.frames import pose_text

SAME_M, SAME_RAD = 0.01, math.radians(0.5)
"""Two frames that are nearer are one: no vehicle frame is known better."""

EXPLAINED_M, EXPLAINED_RAD = 0.3, math.radians(3.0)
"""The frame of the poses explains guesses that are off together if it is as near to where these ask
for it, horizontally: within the errors of several guesses. Poses hardly tell heights."""

AXIS_RAD = math.radians(10.0)
"""A turn this near to a right angle is one of axes."""

_POINTS = {90: "to the right", -90: "to the left", 180: "back", -180: "back"}
"""Turn of the guesses' frame in that of the poses, degrees to the left -> where the latter's x
points."""


def pose_key(config: Config) -> str:
    """Where the config names the given poses."""
    return "data.poses" if config.data.poses is not None else "topics.pose"


def poses_source(config: Config) -> str:
    """Where the given poses are from, for messages."""
    return "input/ego_poses.yaml" if config.data.format == "caliv" else pose_key(config)


def frame_sentence(frame: PoseFrame) -> str:
    """That poses are of a frame that `/tf_static` has elsewhere on the vehicle; or nothing."""
    T = frame.T_vehicle_frame
    if T is None:
        return ""
    if np.linalg.norm(T.translation()) < SAME_M and _angle(T) < SAME_RAD:
        return ""
    return (
        f"its poses are of the frame '{frame.name}', and are taken for those of the vehicle frame. "
        f"By /tf_static, '{frame.name}' is at {pose_text(T)} in '{frame.vehicle}': if the initial "
        f"guesses are in '{frame.vehicle}', give its poses, which are these times "
        f"T_{frame.name}_{frame.vehicle} from the right, {pose_text(T.inverse())}"
    )


def explains(frame: PoseFrame | None, T_vehicle_guessed: gtsam.Pose3) -> bool:
    """Whether guesses are off together because poses are of this frame, by `/tf_static`."""
    if frame is None or frame.T_vehicle_frame is None:
        return False
    left = frame.T_vehicle_frame.compose(T_vehicle_guessed)
    return float(np.hypot(left.x(), left.y())) < EXPLAINED_M and _angle(left) < EXPLAINED_RAD


def different_frames(
    T_vehicle_guessed: gtsam.Pose3, source: str, frame: PoseFrame | None = None
) -> str:
    """What to check where the guesses of all LiDARs are off by one motion.

    Args:
        T_vehicle_guessed: the frame of the guesses, by what the LiDARs see.
        source: where given poses are from (`poses_source`); empty: there were raw sensors.
        frame: that the poses are of; None: nothing names it.
    """
    if not source:
        return (
            "Guesses and motion data are of different vehicle frames: check origin and axes of "
            "the guesses, and the mounts of IMU, antenna and wheels"
        )
    of = ""
    if frame is not None:
        of = f", whose poses are of the frame '{frame.name}'"
        if frame.T_vehicle_frame is not None:
            at = pose_text(frame.T_vehicle_frame)
            of += f" (by /tf_static at {at} in '{frame.vehicle}')"
    roll, pitch, yaw = T_vehicle_guessed.rotation().rpy().tolist()
    quarter = 90 * round(math.degrees(yaw) / 90.0)
    near = max(abs(roll), abs(pitch), abs(yaw - math.radians(quarter))) < AXIS_RAD
    points = ""
    if near and quarter:
        points = f". By the poses, x of the vehicle points {_POINTS[quarter]}"
    return (
        "Guesses and poses are of different vehicle frames: check origin and axes of the guesses, "
        f"and of {source}{of}{points}. If the guesses are right, give poses of their frame, which "
        f"are these times about {pose_text(T_vehicle_guessed)} from the right"
    )


def _angle(T: gtsam.Pose3) -> float:
    return float(np.linalg.norm(gtsam.Rot3.Logmap(T.rotation())))
