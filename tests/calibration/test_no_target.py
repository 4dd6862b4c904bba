"""Structure and ground without a target: the ground's levels are asked of the solution."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from caliv_graph.calibration import no_target
from caliv_graph.calibration.ground_scatter import GroundLevels
from caliv_graph.calibration.no_target import (
    StructureSolve,
    solution_without_target,
    solve_structure_and_ground,
)
from caliv_graph.calibration.structure_evidence import StructureEvidence
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.model import Config
from caliv_graph.errors import SolveError, TargetError
from caliv_graph.products import GroundObservation
from caliv_graph.targets.ground.planes import NORMAL_FLOOR_RAD
from caliv_graph.trajectory.select import GivenTrajectory
from tests.calibration.problems import make_case
from tests.calibration.test_ground import observed
from tests.calibration.test_structure import at_guesses, config_of, given, term_of

PLANE = np.array([0.01, -0.02, 0.7])
LIDARS = ("front", "rear")


class _Structure:
    """Of one drive, and how often it was solved."""

    patches = ()

    def __init__(self, trajectory: GivenTrajectory) -> None:
        self.term = at_guesses(
            term_of(trajectory, trajectory.trajectory.stamps_ns, LIDARS), trajectory
        )
        self.solves = 0

    def terms(self, *_: Any, **__: Any) -> tuple[Any, ...]:
        self.solves += 1
        return (self.term,)


def solved(
    monkeypatch: pytest.MonkeyPatch, tilt_rad: float, config: Config
) -> tuple[StructureSolve, _Structure]:
    """Planes of 12 poses by two LiDARs, that hills tilt by `tilt_rad` at random."""
    case, rng = make_case(*LIDARS, count=12), np.random.default_rng(3)
    tilts = np.array([1.0, 1.0, 0.0]) * tilt_rad
    planes: list[GroundObservation] = observed(
        case.problem, case.truth, PLANE, lambda _: tilts * rng.normal(size=3)
    )
    trajectory = given(12)
    structure: Any = _Structure(trajectory)
    monkeypatch.setattr("caliv_graph.calibration.no_target.kept_stamps", lambda _: {})
    found = solve_structure_and_ground(
        [trajectory], config, SilentProgress(), tuple(planes), structure
    )
    return found, structure


def test_hills_are_waves_of_the_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    config = config_of(*LIDARS)
    flat, _ = solved(monkeypatch, NORMAL_FLOOR_RAD, config)
    hilly, structure = solved(monkeypatch, 0.02, config)

    assert flat.noise.floors[0] == NORMAL_FLOOR_RAD
    assert hilly.noise.floors[0] == pytest.approx(0.02, rel=0.3)
    (level,) = (of for of in hilly.noise.levels if of.name == "ground_normal")
    assert level.sigma == hilly.noise.floors[0]
    # Of heave, which alone is in the term, nothing was asked.
    assert structure.solves == 1
    assert hilly.warnings == ()
    # What the planes say of roll and pitch is 40 times as uncertain.
    before, after = (float(np.sqrt(solution_without_target(of).cov[0, 0])) for of in (flat, hilly))
    assert after > 2.0 * before


def test_ground_of_a_mistake_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    steep, _ = solved(monkeypatch, 0.2, config_of(*LIDARS))

    assert any("scatter too much for ground" in line for line in steep.warnings)


def test_waves_that_the_config_states_are_held(monkeypatch: pytest.MonkeyPatch) -> None:
    config = config_of(*LIDARS)
    noise = config.noise.model_copy(update={"ground_normal_deg": 0.03})

    found, _ = solved(monkeypatch, 0.02, config.model_copy(update={"noise": noise}))

    assert found.noise.floors[0] == pytest.approx(np.radians(0.03))


def test_another_solve_that_fails_leaves_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    solve, calls = no_target._solved, 0

    def once(*arguments: Any) -> StructureSolve:
        nonlocal calls
        calls += 1
        if calls > 1:
            raise SolveError("The graph is singular.")
        return solve(*arguments)

    monkeypatch.setattr(no_target, "_solved", once)

    hilly, _ = solved(monkeypatch, 0.02, config_of(*LIDARS))

    assert calls == 2
    assert hilly.noise.floors[0] == NORMAL_FLOOR_RAD
    (said,) = hilly.warnings
    assert "asks for another solve" in said
    assert "failed: The graph is singular. The result is that of the solve before" in said


def test_a_result_that_never_settles_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    levels = iter(0.001 * 2.0 ** np.arange(9))

    def louder(*_: Any) -> GroundLevels:
        return GroundLevels(float(next(levels)), 0.002, 0.005)

    monkeypatch.setattr(no_target, "asked_levels", louder)

    found, _ = solved(monkeypatch, 0.0, config_of(*LIDARS))

    (said,) = found.warnings
    assert "has not settled: solved again 2 times with what it asked for, planes of" in said


def test_structure_that_says_nothing_is_an_error() -> None:
    evidence = StructureEvidence()
    with pytest.raises(TargetError, match="neither a target nor structure"):
        solve_structure_and_ground([given(12)], config_of(*LIDARS), SilentProgress(), (), evidence)
