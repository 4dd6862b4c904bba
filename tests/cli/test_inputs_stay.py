"""No command replaces what it reads, with `--force` neither."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from caliv_graph.cli.main import app
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


def test_an_older_page_may_lie_in_the_folder_of_the_drive(
    inputs: dict[str, str], tmp_path: Path
) -> None:
    page = tmp_path / "drive" / "page.html"
    page.write_text("older")
    arguments = ["inspect", inputs["drive"], "--html", str(page), "--force"]
    result = CliRunner().invoke(app, arguments)
    assert "reads" not in str(result.exception)  # the drive of this test is no bag
