from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner, Result

from caliv_graph.cli.main import app
from caliv_graph.config.load import load_config
from caliv_graph.errors import ConfigError, OutputError
from caliv_graph.results.truth_file import read_truth
from tests.cli.commands import called, run

SCENARIO = """\
name: tiny
drive: {kind: arc, duration_s: 4.5}
lidars:
  front:
    mounting: {xyz: [2.0, 0.0, 2.0], rpy_deg: [0.0, 10.0, 0.0]}
    channels: 24
    horizontal_resolution_deg: 1.0
  rear:
    mounting: {xyz: [-0.4, 0.0, 2.0], rpy_deg: [0.0, 10.0, 180.0]}
    channels: 24
    horizontal_resolution_deg: 1.0
    rate_hz: 5.0
world:
  objects: {chair: {shape: chair, xy_m: [9.0, -3.0]}}
  targets: [chair]
"""


def simulate(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["simulate", *map(str, arguments)])


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.yaml"
    path.write_text(SCENARIO, encoding="utf-8")
    return path


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_bag_is_written_with_a_config_that_is_ready_to_run(
    scenario: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"

    result = simulate(scenario, "--out", out, "--seed", 4)

    assert (result.exit_code, result.stderr) == (0, "")
    assert names(out) == ["config.yaml", "drive", "scenario.yaml", "trajectory.tum", "truth.yaml"]
    lines = result.stdout.splitlines()
    assert lines[-4] == "tiny, seed 4: 4.5 s"
    assert lines[-3].startswith("front: 46 clouds of ")
    assert "with a target of up to" in lines[-3]
    assert lines[-2].startswith("rear: 23 clouds of ")
    assert lines[-2].endswith("no target")
    next_command = f"caliv-graph calibrate {out}/config.yaml --out result"
    assert lines[-1] == f"Written to {out}. Next: {next_command}"
    config = load_config(out / "config.yaml")
    assert config.data.path == out / "drive"
    assert set(read_truth(out / "truth.yaml")) == set(config.lidars)
    assert (out / "scenario.yaml").read_text().startswith("# seed 4\n")


@pytest.mark.parametrize(
    ("output", "content", "data"),
    [("caliv", ["caliv"], "caliv"), ("both", ["caliv", "drive"], "drive")],
)
def test_formats(
    scenario: Path, tmp_path: Path, output: str, content: list[str], data: str
) -> None:
    out = tmp_path / "out"

    result = simulate(scenario, "--out", out, "--format", output)

    assert result.exit_code == 0
    assert [name for name in names(out) if "." not in name] == content
    assert load_config(out / "config.yaml").data.path == out / data


def test_json_is_all_that_stdout_gets(scenario: Path, tmp_path: Path) -> None:
    result = simulate(scenario, "--out", tmp_path / "out", "--json", "--seed", 2)

    document = json.loads(result.stdout)
    assert document["scenario"] == "tiny"
    assert document["seed"] == 2
    assert document["duration_s"] == 4.5
    assert len(document["lidars"]["front"]["points"]) == 46
    assert max(document["lidars"]["front"]["target_points"]) > 10
    assert not any(document["lidars"]["rear"]["target_points"])


def test_a_drive_is_replaced_only_with_force(scenario: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert simulate(scenario, "--out", out, "--format", "caliv").exit_code == 0

    refused = simulate(scenario, "--out", out)

    assert isinstance(refused.exception, OutputError)
    assert "Give --force to replace it" in str(refused.exception)
    assert "caliv" in names(out)
    assert simulate(scenario, "--out", out, "--force").exit_code == 0
    assert "caliv" not in names(out)


def test_what_is_wrong_with_a_scenario_is_said_in_one_line(tmp_path: Path) -> None:
    bad = tmp_path / "bad.yaml"
    bad.write_text(yaml.safe_dump({**yaml.safe_load(SCENARIO), "lidar": {}}))

    for path, message in (
        (bad, "unknown key 'lidar': did you mean 'lidars'?"),
        (tmp_path / "none.yaml", "no such file"),
    ):
        result = simulate(path, "--out", tmp_path / "out")
        assert isinstance(result.exception, ConfigError)
        assert message in str(result.exception)
    assert not (tmp_path / "out").exists()


def test_as_a_shell_sees_it(scenario: Path, tmp_path: Path) -> None:
    done = run("simulate", scenario, "--out", tmp_path / "out", "--format", "caliv")
    assert (done.returncode, done.stderr) == (0, "")

    again = called("simulate", scenario, "--out", tmp_path / "out")
    assert again.returncode == 2
    assert again.stderr.startswith("error: ")
    assert again.stderr.count("\n") == 1

    negative = called("simulate", scenario, "--out", tmp_path / "other", "--seed", "-1")
    assert negative.returncode == 2
    assert "seed: must be 0 or a positive whole number" in negative.stderr
    assert not (tmp_path / "other").exists()
