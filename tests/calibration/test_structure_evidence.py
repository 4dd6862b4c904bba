"""What structure is asked beside a target; the ground of a LiDAR counts once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from caliv_graph.calibration.graph import CalibrationGraph
from caliv_graph.calibration.robust import RobustWeights
from caliv_graph.calibration.solve import SolveState
from caliv_graph.calibration.structure_evidence import StructureEvidence, other_grounds
from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.model import Config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.products import GroundObservation, PoseNoise, StructureTerm
from caliv_graph.structure.patches import DrivePatches
from tests.calibration.problems import make_case, with_clouds
from tests.calibration.test_structure import given, term_of

ANYWHERE = PoseConfig(xyz=(0.0, 0.0, 0.0))
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


def test_where_the_ground_is_bent_strips_alone_stand_for_it() -> None:
    trajectory = given()
    term = term_of(trajectory, trajectory.trajectory.stamps_ns, ("front", "rear"))
    some, none = (replace(term, ground=frozenset(names)) for names in (["front"], []))
    bent = (replace(plane("rear"), bent=0.5),)

    assert other_grounds(bent, (some,)) == ()
    assert other_grounds(bent, (none,)) == bent  # planes are all that is known of it
    hardly = (replace(plane("rear"), bent=0.2),)
    assert other_grounds(hardly, (some,)) == hardly


def test_what_no_target_has_placed_is_not_held_and_keeps_its_pieces_of_ground() -> None:
    """A solve that had structure has LiDARs that saw no target: a second one begins at it."""
    case = make_case("front", "rear", "left")
    seen = case.problem.cloud_lidar < 2
    problem = with_clouds(case.problem, seen)
    config = Config(
        lidars={name: LidarConfig(topic=name, initial=ANYWHERE) for name in problem.lidars}
    )
    state = SolveState(
        problem=problem,
        config=config,
        values=case.truth,
        noise=NOISE,
        scale=1.0,
        weights=RobustWeights(config.robust, problem.clouds),
        motion=CalibrationGraph(),
        sound=np.ones(problem.clouds, dtype=bool),
        grounds=(plane("rear"), plane("left")),
    )
    asked: list[tuple[Any, ...]] = []

    def solve(*given: Any) -> tuple[StructureTerm, ...]:
        asked.append(given)
        return ()

    patches = DrivePatches(
        drive=0,
        lidars=problem.lidars,
        stamps_ns=np.zeros(1, dtype=np.int64),
        scan_lidar=np.zeros(1, dtype=np.int64),
        scan=np.zeros(1, dtype=np.int64),
        time_s=np.zeros(1),
        moments=np.eye(4)[None],
        normal_lidar=np.eye(1, 3),
        scatter_m=np.zeros(1),
    )
    evidence = StructureEvidence((patches,), solve)

    evidence.terms_beside(state, problem, [given(problem.clouds)], 0.005)

    ((_, _, _, _, start, held, *_, on_planes),) = asked
    assert set(start) == {"front", "rear", "left"}
    assert set(held) == {"front", "rear"}
    assert on_planes == {(0, "rear")}
