from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from caliv_graph.cli.main import app
from caliv_graph.config import Config
from caliv_graph.errors import RecordingError
from caliv_graph.products import Recording, TargetCloud, TargetObservation, Trajectory
from caliv_graph.progress import Progress
from tests.cli.commands import write_config, write_drive


def inspect(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["inspect", *map(str, arguments)])


def test_a_folder_without_a_config(tmp_path: Path) -> None:
    drive = write_drive(tmp_path / "drive", sensors=11, frames=5)
    (drive / "input/sensor_1/2.pcd").unlink()

    result = inspect(drive, "--json")

    assert result.exit_code == 0
    document = json.loads(result.stdout)
    # By number: sensor_10 comes after sensor_9.
    assert list(document["lidars"]) == [f"sensor_{number}" for number in range(1, 12)]
    first = document["lidars"]["sensor_1"]
    assert (first["clouds"], first["frames"], first["gaps"]) == (4, [0, 4], [[1, 3]])
    assert first["points"] == {"min": 4, "median": 4, "max": 4}
    assert first["rate_hz"] == pytest.approx(10.0)
    assert document["drive"]["path_length_m"] == pytest.approx(4.0)
    assert document["drive"]["heading_change_deg"] == pytest.approx(0.0)
    assert document["targets"] is None
    assert "poses without a cloud are skipped: 1 of sensor_1" in result.stderr


def test_the_folder_itself_or_the_one_around_it(tmp_path: Path) -> None:
    drive = write_drive(tmp_path / "drive")

    outer, inner = (json.loads(inspect(path, "--json").stdout) for path in (drive, drive / "input"))

    assert outer["lidars"] == inner["lidars"]


def test_a_table(tmp_path: Path) -> None:
    result = inspect(write_drive(tmp_path / "drive"))

    assert result.exit_code == 0
    assert "reading the clouds: 6/6 in " in result.stdout
    row = next(line for line in result.stdout.splitlines() if line.startswith("sensor_2"))
    assert row.split() == ["sensor_2", "3", "0", "to", "2", "1", "10", "4", "/", "4", "/", "4"]


def test_with_a_config_who_sees_the_target_when(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def extract(
        recordings: Sequence[Recording],
        trajectories: Sequence[Trajectory],
        config: Config,
        progress: Progress,
    ) -> tuple[TargetObservation, ...]:
        assert len(trajectories[0].T_map_vehicle) == 3
        cloud = TargetCloud("front", 0, 100_000_000, np.full((60, 3), 4.0), "1.pcd")
        return (TargetObservation(0, "target", np.zeros(3), (cloud,), ("2 scans were cut",)),)

    monkeypatch.setattr("caliv_graph.targets.extract_targets", extract)
    drive = write_drive(tmp_path / "drive")
    config = write_config(tmp_path / "config.yaml")

    result = inspect(drive, "--config", config, "--json")

    assert result.exit_code == 0
    document = json.loads(result.stdout)
    assert list(document["lidars"]) == ["front", "rear"]
    (target,) = document["targets"]
    assert target["lidars"]["front"]["frames"] == [[1, 1]]
    assert target["lidars"]["rear"]["scans"] == 0
    assert result.stderr == "warning: 2 scans were cut\n"


@pytest.mark.parametrize("name", ["drive.bag", "drive.mcap", "bag"])
def test_bags_are_named_as_what_they_are(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if path.suffix:
        path.touch()
    else:
        path.mkdir()
        (path / "bag_0.db3").touch()

    result = inspect(path)

    assert isinstance(result.exception, RecordingError)
    assert "rosbags cannot be read yet" in str(result.exception)
