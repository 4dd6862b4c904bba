"""The ground of a LiDAR counts once: in strips, or as planes that all LiDARs see."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.structure_evidence import StructureEvidence, other_grounds
from caliv_graph.config.model import Config
from caliv_graph.products import GroundObservation, PoseNoise, StructureTerm
from caliv_graph.structure.patches import DrivePatches
from tests.calibration.test_structure import config_of, given, term_of

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


def solved(strips_have: set[str], planes: list[str]) -> tuple[StructureTerm, list[str], list[bool]]:
    """The term; LiDARs whose planes are left; and which of the solves had the ground."""
    trajectory = given()
    stamps = trajectory.trajectory.stamps_ns
    with_ground: list[bool] = []

    def solve(patches: Any, priors: Any, kept: Any, *rest: Any) -> tuple[StructureTerm, ...]:
        config = cast(Config, rest[2])
        with_ground.append(config.ground.use)
        term = term_of(trajectory, stamps, ("front", "rear"))
        return (replace(term, ground=frozenset(strips_have if config.ground.use else ())),)

    patches = cast(DrivePatches, SimpleNamespace(drive=0, scan=np.zeros(1), stamps_ns=stamps))
    grounds = tuple(map(plane, planes))
    start: dict[str, gtsam.Pose3] = {}
    (term,) = StructureEvidence((patches,), solve).terms(
        [trajectory], {0: stamps.tolist()}, start, 0.005, NOISE, config_of("front", "rear"), grounds
    )
    return term, [o.lidar for o in other_grounds(grounds, (term,))], with_ground


@pytest.mark.parametrize(
    ("strips_have", "planes", "left", "solves"),
    [
        ({"front", "rear"}, ["front", "rear"], [], [True]),
        ({"front"}, ["front"], [], [True]),
        # Range biases of the planes and of the strips are variables of their own.
        ({"front"}, ["front", "rear"], ["front", "rear"], [True, False]),
        (set(), ["front", "rear"], ["front", "rear"], [True]),
    ],
)
def test_ground_is_in_the_strips_of_all_lidars_or_of_none(
    strips_have: set[str], planes: list[str], left: list[str], solves: list[bool]
) -> None:
    term, kept, with_ground = solved(strips_have, planes)
    assert (kept, with_ground) == (left, solves)
    assert not term.ground & set(kept)
