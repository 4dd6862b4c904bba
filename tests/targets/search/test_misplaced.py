"""Guesses that the search replaced: for each LiDAR, or for all where they are off by one motion."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import cast

import gtsam
import pytest

from caliv_graph.config.model import Config
from caliv_graph.targets.search.find import FoundTarget
from caliv_graph.targets.search.misplaced import realigned
from tests.samples import pose

GUESSES = {"left": ((2.2, 0.7, 1.3), (0.0, 0.0, 55.0)), "right": ((2.2, -0.7, 1.3), (0, 0, -70.0))}


@dataclass
class Found:
    """What `realigned` looks at of a found target."""

    aligned: dict[str, gtsam.Pose3]
    misplaced: list[str] = field(default_factory=list)


def sentences(moves: dict[str, gtsam.Pose3], given: bool = True) -> tuple[str, ...]:
    """Of guesses that seem off by these motions of the vehicle frame."""
    lidars = {
        name: {"topic": f"/{name}", "initial": {"xyz": [*xyz], "rpy_deg": [*rpy_deg]}}
        for name, (xyz, rpy_deg) in GUESSES.items()
    }
    config = Config.model_validate({"lidars": lidars, "topics": {"pose": "/odom"}})
    aligned = {name: T.compose(config.lidars[name].guess()) for name, T in moves.items()}
    found = cast("FoundTarget", Found(aligned, [*moves]))
    moved, said = realigned(config, [found], given)
    for name, T in aligned.items():
        assert moved.lidars[name].guess().equals(T, 1e-9)
    return said


def test_guesses_of_another_frame_than_the_poses_are_named_together() -> None:
    """A camera 1.6 m ahead; the search leaves 2 degrees and 0.1 m open."""
    left, right = pose((-1.7, -0.1, 0.0), (0, 0, -2)), pose((-1.5, -0.1, 0.0), (0, 0, 2))
    (said,) = sentences({"left": left, "right": right})
    assert "the initial guesses of all are off by about the same" in said
    assert "moved by (-1.6, -0.1, +0.0) m" in said
    assert "and of topics.pose. If the guesses are right, give poses of their frame" in said
    (said,) = sentences({"left": left, "right": right}, given=False)
    assert "mounts of IMU, antenna and wheels" in said
    assert "topics.pose" not in said


@pytest.mark.parametrize(
    ("yaw", "points"), [(90.0, "to the right"), (-90.0, "to the left"), (179.0, "back")]
)
def test_axes_of_the_poses_that_point_elsewhere_are_named(yaw: float, points: str) -> None:
    turned = pose((0.1, -0.1, 0.0), (0.0, 0.0, yaw))
    (said,) = sentences({"left": turned, "right": turned})
    assert f"By the poses, x of the vehicle points {points}" in said


def test_guesses_that_are_off_each_for_itself_are_named_each() -> None:
    T = pose((-1.6, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert len(sentences({"left": T, "right": T.inverse()})) == 2
    (alone,) = sentences({"left": T})
    assert alone.startswith("lidar 'left': the objects that it sees")
