"""The tables that the README of `uncertainty` quotes are those that the script prints."""

from __future__ import annotations

from pathlib import Path

import pytest

from caliv_graph.results.calibration_file import write_calibration
from scripts import show_hard_switch
from tests.samples import make_calibration

README = Path(__file__).parents[2] / "caliv_graph" / "uncertainty" / "README.md"


def test_the_readme_quotes_the_tables(capsys: pytest.CaptureFixture[str]) -> None:
    assert show_hard_switch.main([]) == 0

    tables = capsys.readouterr().out.strip().split("\n\n")
    assert len(tables) == 4
    text = README.read_text(encoding="utf-8")
    assert all(table in text for table in tables)


def test_margins_of_a_calibration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "calibration.yaml"
    write_calibration(make_calibration(), file)

    assert show_hard_switch.main(["--result", str(file)]) == 0

    out = capsys.readouterr().out
    assert "| scaled eigenvectors | " in out
    assert "| generalized | " in out
