"""Sentences about mountings without a guess."""

from __future__ import annotations

import gtsam

from caliv_graph.mounting.place import Placement
from caliv_graph.wording.mounting import region_sentence

CLEAR = Placement("rear", gtsam.Pose3(), ())
OPEN = Placement("front", gtsam.Pose3(), (gtsam.Pose3(gtsam.Rot3.Yaw(0.4), [5.0, 0.0, 0.0]),))


def test_a_region_is_doubted_only_where_several_mountings_fit() -> None:
    assert region_sentence(()) == ""
    assert region_sentence((CLEAR,)) == ""
    text = region_sentence((CLEAR, OPEN))
    assert "'front'" in text
    assert "'rear'" not in text
    assert "leave out 'target'" in text
