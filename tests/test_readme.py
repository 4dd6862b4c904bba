"""What the README shows is run here, so that it stays true."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
import typer
import yaml

from caliv_graph.cli.main import app
from caliv_graph.common import exits
from caliv_graph.config.load import load_config
from caliv_graph.config.model import Config, GroundConfig, LidarConfig
from caliv_graph.results.calibration_file import read_calibration
from caliv_graph.results.truth_file import read_truth
from caliv_graph.simulation import load_scenario, simulate_caliv

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's drive with half of its clouds."""
    scenario = load_scenario(ROOT / "configs/scenarios/demo_arc.yaml")
    lidars = {
        name: lidar.model_copy(update={"rate_hz": 2.5}) for name, lidar in scenario.lidars.items()
    }
    folder = tmp_path_factory.mktemp("readme") / "drive"
    simulate_caliv(scenario.model_copy(update={"lidars": lidars}), folder, seed=1)
    return folder


def test_the_python_example_calibrates(
    drive: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (example,) = blocks("python")
    monkeypatch.chdir(drive)
    names: dict[str, Any] = {}

    exec(compile(example, "README.md", "exec"), names)

    shown = capsys.readouterr().out
    for line in ("front [", "not determined: ['yaw', 'x']", "about the turn centre"):
        assert line in shown
    truth = read_truth(drive / "truth.yaml")
    error = gtsam.Pose3.Logmap(
        names["T_rear_front"].inverse().compose(truth["rear"].between(truth["front"]))
    )
    # The sigmas, in other axes, at least have the right size.
    assert np.linalg.norm(error[:3]) < 4.0 * np.linalg.norm(names["sigma"][:3])
    assert np.linalg.norm(error[3:]) < 4.0 * np.linalg.norm(names["sigma"][3:])
    assert np.linalg.norm(names["sigma"][3:]) < 0.1
    written = read_calibration(drive / "calibration.yaml")
    assert written.lidars.keys() == truth.keys()


def test_the_config_shows_every_section_with_its_defaults(tmp_path: Path) -> None:
    (example,) = blocks("yaml")
    (tmp_path / "config.yaml").write_text(example, encoding="utf-8")

    config = load_config(tmp_path / "config.yaml")

    assert yaml.safe_load(example).keys() == Config.model_fields.keys()
    guesses = {
        name: {"topic": lidar.topic, "initial": lidar.initial}
        for name, lidar in config.lidars.items()
    }
    defaults = Config.model_validate({"lidars": guesses})
    own = {"data", "reference", "target", "ground"}
    assert config.model_dump(exclude=own) == defaults.model_dump(exclude=own)
    assert config.ground == GroundConfig(use=False)
    assert yaml.safe_load(example)["lidars"]["front"].keys() == LidarConfig.model_fields.keys()


def test_the_commands_exist() -> None:
    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]

    named = re.findall(r"^caliv-graph ([a-z]+)", "".join(blocks("sh")), re.MULTILINE)

    assert set(named) == set(commands)


def test_the_exit_codes_are_those_of_the_program() -> None:
    table = {int(code) for code in re.findall(r"^\| (\d+) \|", README, re.MULTILINE)}

    assert table == {value for name, value in vars(exits).items() if name.isupper()}


def test_the_files_it_links_to_exist() -> None:
    links = re.findall(r"\]\((?!https?:)([^)]+)\)", README)

    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []
