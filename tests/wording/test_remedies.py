"""Remedies that the config has followed already are not given again."""

from __future__ import annotations

from caliv_graph.products import Direction
from caliv_graph.wording.remedies import OF_ODOMETRY, OF_STRUCTURE, OF_TARGET, with_height_set


def test_a_height_that_is_set_is_not_asked_for() -> None:
    found = with_height_set(
        Direction({}, 1.0, 1.0, "height", together=True, remedy=OF_TARGET.height), 0.005, True
    )
    assert found.remedy == (
        "measure ground.vehicle_height better than its ground.sigma of 5 mm, and set both, or "
        "cross a ramp while the target is in view"
    )
    found = with_height_set(
        Direction({}, 1.0, 1.0, "height", together=True, remedy=OF_ODOMETRY.height), 0.02, True
    )
    assert found.remedy.endswith("ground.sigma of 20 mm, and set both")


def test_a_height_that_is_set_but_not_used_is_not_blamed() -> None:
    found = with_height_set(
        Direction({}, 1.0, 1.0, "height", together=True, remedy=OF_STRUCTURE.height), 0.005, False
    )
    assert found.remedy == (
        "let the LiDARs see the ground that the vehicle drives over, for ground.vehicle_height, or "
        "cross a ramp while walls are in view"
    )


def test_other_remedies_stay() -> None:
    direction = Direction({}, 1.0, 1.0, "x", together=True, remedy=OF_TARGET.straight)
    assert with_height_set(direction, 0.005, True) is direction
