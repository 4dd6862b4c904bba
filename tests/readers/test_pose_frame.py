"""The frame of given poses beside that of the guesses."""

from __future__ import annotations

import gtsam
import pytest

from caliv_graph.products import PoseFrame
from caliv_graph.readers.pose_frame import different_frames, explains, frame_sentence
from tests.samples import pose

AHEAD = pose((1.6, 0.1, 0.9), (0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("T", "said"),
    [
        (AHEAD, True),
        (pose((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), True),
        (pose((0.005, 0.0, 0.0), (0.0, 0.0, 0.2)), False),
        (None, False),
    ],
)
def test_a_frame_is_said_where_it_is_elsewhere(T: gtsam.Pose3 | None, said: bool) -> None:
    assert bool(frame_sentence(PoseFrame("camera", "base_link", T))) == said


def test_a_frame_explains_guesses_that_are_off_by_its_mount() -> None:
    frame = PoseFrame("camera", "base_link", AHEAD)
    # Heights are hardly told by poses.
    assert explains(frame, pose((-1.65, -0.05, 0.0), (0.0, 0.0, 1.0)))
    assert not explains(frame, pose((-0.8, -0.1, 0.0), (0.0, 0.0, 0.0)))
    assert not explains(frame, pose((-1.6, -0.1, -0.9), (0.0, 0.0, 10.0)))
    assert not explains(PoseFrame("camera"), pose((-1.6, -0.1, -0.9), (0.0, 0.0, 0.0)))
    assert not explains(None, gtsam.Pose3())


def test_what_to_check_of_guesses_that_are_off_together() -> None:
    T = AHEAD.inverse()
    said = different_frames(T, "topics.pose", PoseFrame("camera", "base_link", AHEAD))
    assert "topics.pose, whose poses are of the frame 'camera' (by /tf_static at xyz [1.60," in said
    assert "times about xyz [-1.60, -0.10, -0.90]" in said
    unknown = different_frames(T, "data.poses", PoseFrame("body"))
    assert "data.poses, whose poses are of the frame 'body'. If the guesses" in unknown
    assert "mounts of IMU, antenna and wheels" in different_frames(T, "")
