"""The stages of an estimate: what is done when one of them fails."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

import caliv_graph.calibration.estimate as stages
from caliv_graph.calibration.ground_scatter import FURTHER_SOLVES, MOST, GroundLevels
from caliv_graph.common.progress import SilentProgress
from caliv_graph.errors import SolveError
from caliv_graph.pipeline import calibrate
from tests.drives_with_chair import FIGURE_EIGHT, QUICK, ChairDrive, paper_scenario, simulated

FIRST_SOLVE: list[Any] = []
"""Of `eight`: the tests of further solves ask for none but this."""


@cache
def eight() -> ChairDrive:
    with TemporaryDirectory() as folder:
        scenario = paper_scenario(FIGURE_EIGHT, rate_hz=0.625)
        return simulated(scenario, 1, Path(folder)).asked(registration=QUICK)


def test_a_result_is_kept_when_the_solve_that_begins_at_it_fails(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    solved: list[Any] = []
    solve = stages._solved

    def louder(whole: Any, *_: Any) -> Any:
        return replace(whole, noise=replace(whole.noise, levels=()))

    def once(whole: Any, observations: Any, begun_at: Any, *more: Any) -> Any:
        if solved:
            assert begun_at is solved[0].state
            raise SolveError("an axis is open", "drive on")
        solved.append(solve(whole, observations, begun_at, *more))
        return solved[0]

    monkeypatch.setattr(stages, "_for_another_solve", louder)
    monkeypatch.setattr(stages, "_solved", once)

    run = calibrate([eight().recording], eight().config, SilentProgress())

    result = run.calibration
    first = solved[0].solution.T_vehicle_lidar["front"]
    assert result.lidars["front"].T_vehicle_lidar.equals(first, 1e-12)
    (said,) = (line for line in result.warnings if "failed" in line)
    assert "failed: an axis is open. The result is that of the solve before" in said
    assert run.solution.sensor_noise  # that of the first, too


@pytest.mark.parametrize("solves", [3, 4])
def test_a_result_that_asks_for_one_more_solve_after_the_last_says_so(
    monkeypatch: pytest.MonkeyPatch, solves: int
) -> None:
    solve, calls = stages._solved, 0

    def louder(whole: Any, *_: Any) -> Any:
        if calls >= solves:
            return None
        problem = replace(whole.problem, heave_m=2.0 * whole.problem.heave_m)
        return replace(whole, problem=problem)

    def counted(*arguments: Any) -> Any:
        nonlocal calls
        calls += 1
        if not FIRST_SOLVE:
            FIRST_SOLVE.append(solve(*arguments))
        return FIRST_SOLVE[0]

    monkeypatch.setattr(stages, "_for_another_solve", louder)
    monkeypatch.setattr(stages, "_solved", counted)

    run = calibrate([eight().recording], eight().config, SilentProgress())

    warnings = run.calibration.warnings

    said = [line for line in warnings if "has not settled: solved again 2 times" in line]
    assert calls == min(solves, 1 + FURTHER_SOLVES)
    assert len(said) == (solves > FURTHER_SOLVES + 1)


def test_levels_that_no_ground_has_are_a_warning() -> None:
    usual = GroundLevels(normal_rad=1e-3, distance_m=0.01, heave_m=0.01)

    assert usual.beyond_ground == ()
    (said,) = replace(usual, distance_m=MOST.distance_m).beyond_ground
    assert "scatter too much for ground, as by 1 mrad and 200 mm of waves, 10 mm of heave" in said
