"""`observability` at the command line."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner, Result

from caliv_graph.cli.main import app, run
from caliv_graph.config.model import Config
from caliv_graph.pipeline import Prepared, prepare
from caliv_graph.simulation.simulate import write_drive as write_simulated
from tests.cli.commands import write_config, write_drive
from tests.workflows.test_survey import scenario_of


def observability(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["observability", *map(str, arguments)])


@pytest.fixture(scope="module")
def arc(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated arc as a bag, with a config that is ready to run."""
    folder = tmp_path_factory.mktemp("drives") / "arc"
    write_simulated(scenario_of("arc"), folder, 1, output="bag", threads=1)
    # What the target tells is the subject.
    config = folder / "config.yaml"
    raw = yaml.safe_load(config.read_text())
    raw |= {"structure": {"use": False}, "registration": {"components": 200, "max_points": 160}}
    config.write_text(yaml.safe_dump(raw))
    return folder


@dataclass(frozen=True)
class Kept:
    """Stages before the graph, and what they were asked for."""

    names: list[str]
    config: Config
    prepared: Prepared


@pytest.fixture(scope="module")
def kept() -> list[Kept]:
    """Those of the arc."""
    return []


@pytest.fixture
def prepared_once(kept: list[Kept], monkeypatch: pytest.MonkeyPatch) -> None:
    """The drive is the same in several commands, which differ in what their configs require."""

    def once(recordings: Any, config: Config, motions: Any, progress: Any) -> Prepared:
        names = [recording.name for recording in recordings]
        if not kept:
            kept.append(Kept(names, config, prepare(recordings, config, motions, progress)))
        (of,) = kept
        assert names == of.names
        asked = {"data": config.data, "require": config.require}
        assert of.config.model_copy(update=asked) == config
        required = of.prepared.config.model_copy(update={"require": config.require})
        return replace(of.prepared, config=required)

    monkeypatch.setattr("caliv_graph.workflows.survey.prepare", once)


@pytest.mark.usefixtures("prepared_once")
def test_an_arc_as_json(arc: Path) -> None:
    result = observability(arc / "config.yaml", "--data", arc / "drive", "--json")

    assert result.exit_code == 0
    found = json.loads(result.stdout)
    lost = found["observability"]["undetermined"]
    assert [d["text"].rpartition(",")[0] for d in lost] == [
        "rotation of all LiDARs about the turn centre: x and yaw together"
    ]
    assert "S-curve or a figure-eight" in lost[0]["remedy"]
    assert set(lost[0]["direction"]) == {"front", "rear"}
    assert found["lidars"]["front"]["determined"]["yaw"] is False
    assert found["lidars"]["front"]["determined"]["z"] is True
    assert found["sensor_to_sensor"][0]["determined"]["yaw"] is True
    assert 1e-4 < found["sensor_to_sensor"][0]["sigma_vehicle_axes"]["xyz"][0] < 0.03
    assert len(found["observability"]["spectrum"]) == 12
    assert {s["lidar"] for s in found["scans"]} == {"front", "rear"}
    assert found["status"] == "partial"


@pytest.mark.parametrize("command", ["observability", "plan"])
def test_zeros_of_a_draft_are_no_guesses(
    command: str, arc: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = yaml.safe_load((arc / "config.yaml").read_text())
    for lidar in raw["lidars"].values():
        lidar["initial"] = {"xyz": [0, 0, 0], "rpy_deg": [0, 0, 0]}
    raw["data"]["path"] = str(arc / "drive")
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump(raw))

    assert run([command, str(config)]) == 2

    told = capsys.readouterr().err
    assert told.startswith(f"error: {config}: lidars.front.initial and lidars.rear.initial are all")
    assert "or 'initial: null': then they are found from the drive" in told


@pytest.mark.usefixtures("prepared_once")
def test_in_words_and_with_exit_3_where_the_config_wants_more(arc: Path, tmp_path: Path) -> None:
    raw = yaml.safe_load((arc / "config.yaml").read_text())
    raw |= {"require": ["s2s", "s2v_rotation"], "data": {"path": str(arc / "drive")}}
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump(raw))

    result = observability(config)

    assert result.exit_code == 3
    assert "Remedy: change the curvature while the target is in view" in result.stdout
    assert "require s2v_rotation: yaw of 'front' not determined" in result.stderr
    assert "registering the clouds: 1/1" in result.stdout
    # Nothing is written.
    assert sorted(p.name for p in tmp_path.iterdir()) == ["config.yaml"]


def test_a_drive_without_a_target_is_exit_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_drive(tmp_path / "drive")
    target = {"min": [10, -1, -1], "max": [12, 1, 3]}
    config = write_config(tmp_path / "config.yaml", target=target)

    code = run(["observability", str(config), "--json"])

    shown = capsys.readouterr()
    assert code == 2
    assert shown.out == ""
    assert len(shown.err.splitlines()) == 1


def test_the_same_drive_twice_is_exit_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive = str(write_drive(tmp_path / "drive"))
    config = str(write_config(tmp_path / "config.yaml"))

    assert run(["observability", config, "--data", drive, "--data", drive]) == 2
    assert "given twice" in capsys.readouterr().err


def test_guesses_that_nobody_filled_in(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive = write_drive(tmp_path / "drive")

    config = tmp_path / "config.yaml"
    assert run(["init", str(drive), "--out", str(config)]) == 0
    capsys.readouterr()
    config.write_text(config.read_text().replace("initial: null", "initial: {xyz: [0, 0, 0]}"))

    assert run(["observability", str(tmp_path / "config.yaml")]) == 2
    assert "lidars.sensor_1.initial and lidars.sensor_2.initial" in capsys.readouterr().err


def test_a_missing_config_is_exit_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["observability", "nowhere.yaml"]) == 2
    assert "nowhere.yaml: no such file" in capsys.readouterr().err
