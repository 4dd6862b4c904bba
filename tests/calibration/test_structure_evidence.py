"""The ground of a LiDAR counts once: in strips, or as planes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.calibration.structure_evidence import other_grounds
from caliv_graph.products import GroundObservation, PoseNoise
from tests.calibration.test_structure import given, term_of

NOISE = PoseNoise(2e-4, 2e-3, 1e-3, 0.01, 1.5)


def plane(lidar: str) -> GroundObservation:
    return GroundObservation(
        lidar=lidar,
        drive=0,
        stamp_ns=0,
        normal_lidar=np.array([0.0, 0.0, 1.0]),
        distance_m=2.0,
        axes_lidar=np.eye(2, 3),
        cov=np.eye(3),
        centre_lidar=np.zeros(3),
        points=100,
    )


@pytest.mark.parametrize(
    ("strips_have", "planes", "left"),
    [
        ({"front", "rear"}, ["front", "rear"], []),
        # Range biases of the planes and of the strips are variables of their own.
        ({"front"}, ["front", "rear"], ["rear"]),
        (set(), ["front", "rear"], ["front", "rear"]),
    ],
)
def test_ground_of_a_lidar_is_in_strips_or_in_planes(
    strips_have: set[str], planes: list[str], left: list[str]
) -> None:
    trajectory = given()
    term = term_of(trajectory, trajectory.trajectory.stamps_ns, ("front", "rear"))
    term = replace(term, ground=frozenset(strips_have))
    grounds = tuple(map(plane, planes))

    assert [o.lidar for o in other_grounds(grounds, (term,))] == left
    elsewhere = tuple(replace(o, drive=1) for o in grounds)
    assert other_grounds(elsewhere, (term,)) == elsewhere
