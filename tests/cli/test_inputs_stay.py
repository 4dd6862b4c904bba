"""No command replaces what it reads, with `--force` neither."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from caliv_graph.cli.main import app
from caliv_graph.common.files import check_output_file
from caliv_graph.errors import OutputError


@pytest.fixture
def inputs(tmp_path: Path) -> dict[str, str]:
    (tmp_path / "drive").mkdir()
    names = ("drive/drive.mcap", "config.yaml", "vehicle.urdf", "a.yaml", "b.yaml")
    for name in names:
        (tmp_path / name).write_text("mine")
    return {name: str(tmp_path / name) for name in ("drive", *names)}


@pytest.mark.parametrize(
    "words",
    [
        "init drive --out drive/drive.mcap",
        "init drive --urdf vehicle.urdf --out vehicle.urdf",
        "inspect drive --html drive/drive.mcap",
        "inspect drive --config config.yaml --html config.yaml",
        "export a.yaml --to json --out a.yaml",
        "export a.yaml --to tf --bag drive --out drive/drive.mcap",
        "merge a.yaml b.yaml --out b.yaml",
        "plan config.yaml --out config.yaml",
        "plan config.yaml --data drive --out drive/drive.mcap",
    ],
)
def test_what_is_read_stays(words: str, inputs: dict[str, str]) -> None:
    result = CliRunner().invoke(app, [*(inputs.get(w, w) for w in words.split()), "--force"])
    assert isinstance(result.exception, OutputError)
    assert re.search("wh(at|ich) this command reads", str(result.exception))
    assert all(Path(path).read_text() == "mine" for path in inputs.values() if "." in path[-6:])


@pytest.mark.parametrize("name", ["page.html", "config.yaml", "vehicle.urdf"])
def test_older_outputs_may_lie_in_the_folder_of_the_drive(name: str, tmp_path: Path) -> None:
    drive = tmp_path / "drive"
    drive.mkdir()
    for file in ("drive.mcap", "metadata.yaml", name):
        (drive / file).write_text("older")
    check_output_file(drive / name, True, [drive])
    for file in ("drive.mcap", "metadata.yaml"):
        with pytest.raises(OutputError, match="is part of"):
            check_output_file(drive / file, True, [drive])


def test_the_recording_of_a_config_stays(tmp_path: Path) -> None:
    (tmp_path / "drive.mcap").write_text("mine")
    config = tmp_path / "config.yaml"
    config.write_text("data: {path: drive.mcap}\nlidars: {a: {topic: /a}}\n")
    arguments = ["plan", str(config), "--out", str(tmp_path / "drive.mcap"), "--force"]
    result = CliRunner().invoke(app, arguments)
    assert isinstance(result.exception, OutputError)
    assert (tmp_path / "drive.mcap").read_text() == "mine"
