"""What is said of structure."""

from __future__ import annotations

from caliv_graph.wording.structure import own_body_sentence


def test_a_body_that_is_seen_comes_with_the_setting_that_ends_it() -> None:
    said = own_body_sentence("rear", 0.0209, 1.18)
    assert said.startswith("lidar 'rear' sees the vehicle itself: 2.1 % of its flat pieces")
    assert "up to 1.2 m away" in said
    # A piece reaches a quarter of a metre beyond its middle.
    assert "Set lidars.rear.min_range to 1.5 m" in said
