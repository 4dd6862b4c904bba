"""Sentences about symmetries of the target."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from caliv_graph.registration.symmetry import Symmetry
from caliv_graph.wording.symmetries import symmetry_sentence

SIGMA = math.radians(1.73)


def upright(turn_deg: float, unseen: int = 0) -> Symmetry:
    """A symmetry about the vertical; 0 degrees: after any turn."""
    return Symmetry(
        axis_target=np.array([0.0, 0.0, 1.0]),
        centre_target=np.zeros(3),
        angle_rad=math.radians(turn_deg),
        fitted_rad=math.radians(turn_deg or 160.0),
        compared=0.6,
        contradicted=0.02,
        unseen=np.arange(unseen),
    )


def test_a_drum_leaves_a_rotation_undetermined() -> None:
    assert symmetry_sentence(upright(0.0, unseen=5), "target", SIGMA) == (
        "target: it looks the same after any turn about the vertical (60% of it could be "
        "compared): its clouds do not determine the rotation of a LiDAR about that axis. Drive "
        "around it, or use a target with corners, such as a chair"
    )
    assert "compared" not in symmetry_sentence(upright(0.0), "target", SIGMA)


def test_a_chair_s_back_is_not_told_to_be_a_chair() -> None:
    across = replace(upright(0.0), axis_target=np.array([1.0, 0.0, 0.0]))
    text = symmetry_sentence(across, "target", SIGMA)
    assert "what was seen of it looks nearly the same after any turn about a level axis" in text
    assert "tell little of the rotation" in text
    assert "chair" not in text


def test_a_cube_is_no_danger_to_good_guesses() -> None:
    assert symmetry_sentence(upright(90.0), "target", SIGMA) == (
        "target: it looks the same after a turn by 90 degrees about the vertical: an initial guess "
        "that is off by more than 45 degrees gives a result that is off by 90 degrees. The guesses "
        "are good to 5 degrees (3 sigma), which is enough"
    )
    text = symmetry_sentence(upright(90.0), "target", math.radians(20.0))
    assert text.endswith(
        "The guesses are good to 60 degrees (3 sigma) only: give better ones, or use a target that "
        "looks different from every side"
    )
