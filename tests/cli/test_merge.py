from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from caliv_graph.cli.main import app
from caliv_graph.errors import ConfigError, OutputError
from caliv_graph.results.calibration_file import read_calibration, write_calibration
from tests.cli.commands import run
from tests.fusion.drives import arc_information, drive, information, shift

NAMES = ("front", "rear")


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """A right and a left arc."""
    paths = tmp_path / "right.yaml", tmp_path / "left.yaml"
    write_calibration(drive(arc_information(NAMES), source="a"), paths[0])
    write_calibration(drive(arc_information(NAMES, 2, left=True), source="b"), paths[1])
    return paths


def merge(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["merge", *map(str, arguments)])


def test_two_arcs_make_a_whole(files: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "deep" / "merged.yaml"

    result = merge(*files, "--out", out)

    assert (result.exit_code, result.stderr) == (0, "")
    assert read_calibration(files[0]).status == "partial"
    merged = read_calibration(out)
    assert merged.status == "ok"
    assert merged.provenance["drive_sha256"] == ["a", "b"]
    assert "Status: ok" in result.stdout
    assert "agrees" in result.stdout
    assert f"Written to {out}" in result.stdout


def test_json(files: tuple[Path, Path], tmp_path: Path) -> None:
    result = merge(*files, "--out", tmp_path / "merged.yaml", "--json")

    document = json.loads(result.stdout)
    assert document["schema"] == "caliv-graph/calibration/1"
    assert document["status"] == "ok"
    assert document["warnings"] == []
    (agreement,) = document["agreement"].values()
    assert agreement["moved"] is False
    # What either leaves open is not tested.
    assert agreement["lidars"]["front"]["s2v"]["dof"] == 4


def test_files_that_contradict_each_other(tmp_path: Path) -> None:
    D = information(NAMES)
    paths = tmp_path / "a.yaml", tmp_path / "b.yaml"
    write_calibration(drive(D, source="a"), paths[0])
    write_calibration(drive(D, source="b", error=shift(NAMES, "front", z=0.2)), paths[1])

    result = merge(*paths, "--out", tmp_path / "merged.yaml")

    assert result.exit_code == 4
    assert read_calibration(tmp_path / "merged.yaml").status == "inconsistent"
    assert result.stderr.startswith(f"warning: {paths[1]}: disagrees with the other: ")
    assert "z +200.00 +- " in result.stderr
    assert "disagrees" in result.stdout


def test_an_older_file_is_kept(files: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "merged.yaml"
    out.write_text("mine")

    result = merge(*files, "--out", out)

    assert isinstance(result.exception, OutputError)
    assert str(result.exception) == f"{out}: exists already. Give --force to replace it"
    assert out.read_text() == "mine"
    assert merge(*files, "--out", out, "--force").exit_code == 0
    assert read_calibration(out).status == "ok"


def test_what_cannot_be_merged(files: tuple[Path, Path], tmp_path: Path) -> None:
    copy = tmp_path / "copy.yaml"
    copy.write_bytes(files[0].read_bytes())

    result = run("merge", files[0], copy, "--out", tmp_path / "merged.yaml")

    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr == (
        f"error: {copy}: stems from the same drive as {files[0]}, which would count twice. Leave "
        "one of them out\n"
    )
    assert not (tmp_path / "merged.yaml").exists()
    for arguments, message in (
        ((files[0],), "is one calibration. Give two or more"),
        ((files[0], files[0]), "given twice, and a calibration counts once. Give it once"),
    ):
        refused = merge(*arguments, "--out", tmp_path / "merged.yaml")
        assert isinstance(refused.exception, ConfigError)
        assert str(refused.exception) == f"{files[0]}: {message}"
