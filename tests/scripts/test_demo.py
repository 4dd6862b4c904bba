"""The demo explains what it found, and says in one line what it lacks."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from caliv_graph.cli import main
from scripts import _demo

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stands in for the installed `caliv-graph`, also where the package is not installed."""
    script = tmp_path / "caliv-graph"
    script.write_text(
        f'#!/bin/sh\nPYTHONPATH="{ROOT}" exec "{sys.executable}" -m caliv_graph "$@"\n'
    )
    script.chmod(0o755)
    monkeypatch.setattr(_demo, "COMMAND", script)


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["demo", *map(str, arguments)])
    return _demo.main()


def in_this_process(line: Sequence[str | Path], check: bool) -> SimpleNamespace:
    """Does what `subprocess.run` does with a command, without the imports of a new process.

    Clouds are registered coarsely.
    """
    if line[1] == "calibrate":
        config = Path(line[2])
        document = yaml.safe_load(config.read_text(encoding="utf-8"))
        document["registration"] = {"components": 100, "max_points": 80}
        config.write_text(yaml.safe_dump(document), encoding="utf-8")
    return SimpleNamespace(returncode=main.run([str(argument) for argument in line[1:]]))


@pytest.mark.usefixtures("command")
def test_the_main_job_is_done_and_explained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    error = subprocess.CalledProcessError
    monkeypatch.setattr(
        _demo, "subprocess", SimpleNamespace(run=in_this_process, CalledProcessError=error)
    )
    out = tmp_path / "out"
    # The arc with a quarter of its clouds, and a ninth of their points elsewhere.
    scenario = tmp_path / "demo_arc.yaml"
    text = (ROOT / "configs/scenarios/demo_arc.yaml").read_text(encoding="utf-8")
    assert text.count("rate_hz: 5.0") == 2
    assert text.count("elsewhere_stride: 4 ") == 1
    text = text.replace("rate_hz: 5.0", "rate_hz: 1.25")
    text = text.replace("elsewhere_stride: 4 ", "elsewhere_stride: 12 ")
    scenario.write_text(text, encoding="utf-8")
    monkeypatch.setattr(_demo, "SCENARIO", scenario)

    assert run(monkeypatch, "--out", out) == 0

    shown = " ".join(capfd.readouterr().out.split())
    # Paths beside the checkout are shown relative to the current folder.
    out = Path(os.path.relpath(out)) if out.is_relative_to(ROOT.parent) else out
    for text in (
        f"$ caliv-graph calibrate {out}/drive/config.yaml --out {out}/result --force",
        "Determined: all six axes.",
        f"demo_arc.yaml --out {out}/drive --seed 1 --force",
        "Not determined, in brackets: x, yaw.",
        "On an arc the vehicle turns about one point only.",
    ):
        assert text in shown
    assert (out / "result/calibration.yaml").is_file()


@pytest.mark.usefixtures("command")
def test_a_folder_of_something_else_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive/notes.txt").write_text("mine")

    assert run(monkeypatch, "--keep", tmp_path) == 2

    assert "is not replaced" in capfd.readouterr().err
    assert (tmp_path / "drive/notes.txt").read_text() == "mine"


@pytest.mark.usefixtures("command")
def test_without_the_published_drive_it_says_so_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "config.yaml"
    config.write_text(
        "data: {format: caliv, path: nowhere}\n"
        "lidars: {a: {topic: sensor_1, initial: {xyz: [0, 0, 0]}}}\n"
    )
    monkeypatch.setattr(_demo, "RELEASED", config)

    assert run(monkeypatch, "--released", "--out", tmp_path / "out") == 2

    out, err = capfd.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert f"{tmp_path}/nowhere: the drive that the CaLiV authors published is not there" in err
    assert not (tmp_path / "out").exists()


def test_without_the_command_it_says_so_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(_demo, "COMMAND", tmp_path / "caliv-graph")

    assert run(monkeypatch, "--out", tmp_path / "out") == 2

    assert capfd.readouterr().err == (
        f"error: {tmp_path}/caliv-graph: no such command. Run scripts/demo, which installs it\n"
    )


def test_help_names_both_drives(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        run(monkeypatch, "--help")

    assert ended.value.code == 0
    shown = capfd.readouterr().out
    assert "--released" in shown
    assert "--out DIR" in shown
