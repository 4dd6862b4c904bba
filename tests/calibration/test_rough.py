"""Which clouds the rough solve works with, and which symmetries of a target are told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.calibration.rough import roughly_used, symmetries_of_targets
from caliv_graph.config.lidars import PoseSigmaConfig
from caliv_graph.products import Side, TargetCloud, TargetObservation
from tests.calibration.problems import make_case
from tests.registration.scenes import config_of
from tests.registration.test_symmetry import ALL_AROUND, seen

WHOLE: frozenset[Side] = frozenset()
CUT: frozenset[Side] = frozenset({"top"})


def observation(front: list[frozenset[Side]], rear: list[frozenset[Side]]) -> TargetObservation:
    clouds = [
        TargetCloud(name, 0, j, np.zeros((8, 3)), "", cut)
        for name, cuts in (("front", front), ("rear", rear))
        for j, cut in enumerate(cuts)
    ]
    return TargetObservation(0, "target", np.zeros(3), tuple(clouds))


def test_cut_clouds_wait_where_there_are_enough_whole_ones() -> None:
    problem = replace(
        make_case(count=6).problem,
        views=np.arange(1.0, 13.0),
        cloud_apart_s=0.01 * np.arange(12.0),
        cloud_turn_rad=np.arange(36.0).reshape(12, 3),
    )
    seen = observation([WHOLE, CUT, WHOLE, WHOLE, CUT, WHOLE], [CUT, CUT, CUT, WHOLE, CUT, WHOLE])

    fewer, (used,) = roughly_used(problem, [seen], fewest=4)

    # Of the front LiDAR the whole ones; of the rear one, which has two of them, all.
    front = [0, 2, 3, 5]
    assert [c.stamp_ns for c in used.clouds if c.lidar == "front"] == front
    assert [c.stamp_ns for c in used.clouds if c.lidar == "rear"] == list(range(6))
    assert fewer.cloud_pose.tolist() == [*front, *range(6)]
    assert fewer.cloud_lidar.tolist() == [0] * 4 + [1] * 6
    # Each keeps its own number of scans of one view.
    assert fewer.clouds == 10
    assert fewer.views_of(0).tolist() == [1.0, 3.0, 4.0, 6.0, *range(7, 13)]
    # And its own time from its pose, and what a gyroscope's noise does to it.
    of_rear = list(range(6, 12))
    assert fewer.cloud_apart_s is not None
    assert fewer.cloud_apart_s == pytest.approx(0.01 * np.array([*front, *of_rear]))
    assert fewer.cloud_turn_rad is not None
    assert fewer.cloud_turn_rad[:, 0].tolist() == [3.0 * j for j in (*front, *of_rear)]
    # The graph predicts the poses of the others.
    assert fewer.poses == problem.poses


def test_whole_clouds_are_used_as_they_are() -> None:
    problem = make_case(count=6).problem
    seen = observation([WHOLE] * 6, [WHOLE] * 6)
    fewer, (used,) = roughly_used(problem, [seen], fewest=4)
    assert fewer is problem
    assert used == seen


@pytest.mark.parametrize(
    ("sigma_deg", "told"),
    [(3.0, ()), (14.9, ()), (15.1, ("after a turn by 90 degrees",))],
)
def test_a_cube_is_told_where_three_sigmas_of_a_guess_reach_half_of_its_turn(
    sigma_deg: float, told: tuple[str, ...]
) -> None:
    """Of one LiDAR's guess: 45 degrees."""
    config = config_of()
    first, *others = config.lidars
    rough = PoseSigmaConfig(rpy_deg=(1.0, 1.0, sigma_deg))
    lidars = {name: config.lidars[name] for name in others}
    lidars[first] = config.lidars[first].model_copy(update={"sigma": rough})

    turns, warnings = symmetries_of_targets(
        [seen("cube", ALL_AROUND)], config.model_copy(update={"lidars": lidars})
    )

    assert turns == (None,)
    assert len(warnings) == len(told)
    assert all(part in warning for part, warning in zip(told, warnings, strict=True))
