"""The trajectory benchmark runs, and one seed of it shows what twenty do."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from caliv_graph.scenario.model import load_scenario

REPOSITORY = Path(__file__).resolve().parents[2]


def test_help_says_what_is_compared(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from scripts.benchmark_trajectory import main

    monkeypatch.setattr(sys, "argv", ["benchmark", "--help"])
    with pytest.raises(SystemExit) as ended:
        main()

    assert ended.value.code == 0
    assert "UKF" in capsys.readouterr().out


def test_the_smoother_is_better_than_the_filter_and_both_are_honest() -> None:
    from scripts.benchmark_trajectory import run, table

    scenario = load_scenario(REPOSITORY / "configs/scenarios/paper_arc.yaml")
    runs = [run(scenario, seed) for seed in (100, 101)]
    for one in runs:
        assert one.filtered[0] > one.smoothed[0]
        assert one.filtered[1] > one.smoothed[1]
        assert one.nees == pytest.approx(6.0, abs=3.5)
        assert one.nees_filtered == pytest.approx(6.0, abs=3.5)
        assert one.joint_nees / one.joint_dof == pytest.approx(1.0, abs=0.3)
    lines = table("paper_arc", runs).splitlines()
    assert [line.split()[0] for line in lines[2:7]] == ["UKF", "smoothed", "ratio", "NEES", "joint"]
