"""The stages of an estimate: what is done when one of them fails."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import caliv_graph.calibration.estimate as stages
from caliv_graph.common.progress import SilentProgress
from caliv_graph.errors import SolveError
from caliv_graph.pipeline import calibrate
from tests.drives_with_chair import FIGURE_EIGHT, QUICK, paper_scenario, simulated


def test_a_result_is_kept_when_the_solve_that_begins_at_it_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
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
    scenario = paper_scenario(FIGURE_EIGHT, rate_hz=0.625)
    drive = simulated(scenario, 1, tmp_path).asked(registration=QUICK)

    run = calibrate([drive.recording], drive.config, SilentProgress())

    result = run.calibration
    first = solved[0].solution.T_vehicle_lidar["front"]
    assert result.lidars["front"].T_vehicle_lidar.equals(first, 1e-12)
    (said,) = (line for line in result.warnings if "failed" in line)
    assert "failed: an axis is open. The result is that of the first" in said
    assert run.solution.sensor_noise  # that of the first, too
