from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from caliv_graph.cli.main import app
from caliv_graph.config import load_config
from caliv_graph.errors import ConfigError, OutputError
from caliv_graph.readers import open_recording
from tests.cli.commands import write_drive

ORIGINAL = """\
number_of_sensors: 2
transform_sensor_1:
  - [0.0, 10.0, 0.0, 2.259, 0.0, 1.938] # roll pitch yaw x y z
transform_sensor_2: [1.0, 10.0, 180.0, -0.4, 0.003, 2.1]
min_bound:
  - [10.0, -14.0, -5.0]
max_bound:
  - [20.0, -4.0, 5.0]
"""


def init(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["init", *map(str, arguments)])


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    return write_drive(tmp_path / "drive")


def test_guesses_of_a_caliv_config_beside_the_data(drive: Path, tmp_path: Path) -> None:
    (drive / "original_config.yaml").write_text(ORIGINAL)
    out = tmp_path / "configs/config.yaml"

    result = init(drive, "--out", out)

    assert (result.exit_code, result.stderr) == (0, "")
    assert f"taken from {drive / 'original_config.yaml'}" in result.stdout
    config = load_config(out)
    assert list(config.lidars) == ["sensor_1", "sensor_2"]
    assert config.lidars["sensor_1"].initial.xyz == (2.259, 0.0, 1.938)
    assert config.lidars["sensor_1"].initial.rpy_deg == (0.0, 10.0, 0.0)
    assert config.lidars["sensor_2"].initial.xyz == (-0.4, 0.003, 2.1)
    assert config.lidars["sensor_2"].initial.rpy_deg == (1.0, 10.0, 180.0)
    assert config.target is not None
    assert config.target[0].min == (10.0, -14.0, -5.0)
    assert config.target[0].max == (20.0, -4.0, 5.0)
    assert "TODO" not in out.read_text()
    # The path in it leads from the config to the data.
    assert open_recording(config).lidars == ("sensor_1", "sensor_2")


def test_what_is_not_known_is_left_to_a_person(drive: Path, tmp_path: Path) -> None:
    out = tmp_path / "config.yaml"

    result = init(drive / "input", "--out", out)

    assert result.exit_code == 0
    assert result.stderr == (
        f"warning: {out}: fill in before you calibrate: lidars.sensor_1.initial, "
        "lidars.sensor_2.initial, target\n"
    )
    text = out.read_text()
    assert text.count("TODO") == 3
    config = load_config(out)
    assert config.target is None
    assert config.lidars["sensor_1"].initial.xyz == (0.0, 0.0, 0.0)


def test_every_key_is_commented(drive: Path, tmp_path: Path) -> None:
    (drive / "original_config.yaml").write_text(ORIGINAL)
    init(drive, "--out", tmp_path / "config.yaml")

    bare = [
        line
        for line in (tmp_path / "config.yaml").read_text().splitlines()
        if line and "#" not in line
    ]

    # The names of sections and LiDARs, and the path, say what they are.
    names = [line.strip().rstrip(":") for line in bare]
    assert names == ["data", "path: drive", "sensor_1", "sensor_2", "solve", "robust"]


@pytest.mark.parametrize("name", ["a drive, #1: [x]", "1e3", "täst", "'quoted'"])
def test_odd_names_of_folders(tmp_path: Path, name: str) -> None:
    drive = write_drive(tmp_path / name)

    init(drive, "--out", tmp_path / "config.yaml")

    assert open_recording(load_config(tmp_path / "config.yaml")).lidars == ("sensor_1", "sensor_2")


def test_a_config_is_replaced_only_with_force(drive: Path, tmp_path: Path) -> None:
    out = tmp_path / "config.yaml"
    out.write_text("mine")

    refused = init(drive, "--out", out)

    assert isinstance(refused.exception, OutputError)
    assert out.read_text() == "mine"
    assert init(drive, "--out", out, "--force").exit_code == 0
    assert load_config(out).lidars


def test_other_yaml_beside_the_data_is_not_touched_by_it(drive: Path, tmp_path: Path) -> None:
    (drive / "a.yaml").write_text("no: [yaml")
    (drive / "b.yaml").write_text("- a list")
    (drive / "c.yaml").write_text(ORIGINAL)

    result = init(drive, "--out", tmp_path / "config.yaml")

    assert result.exit_code == 0
    assert "c.yaml" in result.stdout


def test_a_damaged_caliv_config_is_named(drive: Path, tmp_path: Path) -> None:
    (drive / "config.yaml").write_text("transform_sensor_1: [[0.0, 10.0, .nan, 1, 2, 3]]")

    result = init(drive, "--out", tmp_path / "out.yaml")

    assert isinstance(result.exception, ConfigError)
    assert "transform_sensor_1[0][2]: expected a finite number" in str(result.exception)
    assert not (tmp_path / "out.yaml").exists()
