"""Names that are no harmless words: in tables, the report, exports, file names and messages."""

from __future__ import annotations

import ast
import itertools
import json
import shlex
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from caliv_graph.config.lidars import name_problem
from caliv_graph.config.load import load_config
from caliv_graph.results.calibration_file import write_calibration
from tests.robustness.hostile_drives import SCENARIO, command
from tests.samples import make_calibration

HOSTILE = (
    "<script>alert(1)</script>",
    "</script><img src=x onerror=alert(1)>",
    "../../../tmp/x",
    "/etc/passwd",
    "a; rm -rf / #",
    "$(reboot)",
    "`id`",
    "'; import os; os.abort() #",
    '"quoted" \\ name',
    "{{ 7 * 7 }}",
    "[red]rich[/red]",
    "%s%n{0}",
    "a: b, c",
    "- x",
    "&a *b !c",
    "=cmd()",
    "front=x",
    "..",
    "\u202egnp",
)
"""Names of LiDARs, most of which a config may have."""

ALLOWED = tuple(name for name in HOSTILE if not name_problem(name))


def renamed(name: str, folder: Path) -> Path:
    """A calibration.yaml whose first LiDAR has another name."""
    text = make_calibration()
    lidars = {name: text.lidars["front"], "rear": text.lidars["rear"]}
    directions = tuple(
        type(d)(
            vector={name if k == "front" else k: v for k, v in d.vector.items()},
            sigma_data=d.sigma_data,
            sigma_prior=d.sigma_prior,
            together=d.together,
            text=d.text,
        )
        for d in text.undetermined
    )
    path = folder / "calibration.yaml"
    changed = type(text)(**{**vars(text), "lidars": lidars, "undetermined": directions})
    write_calibration(changed, path)
    return path


def exported(path: Path, form: str, out: Path, *more: object) -> str | None:
    """What was written, or None where the name was refused, in one line."""
    done = command("export", path, "--to", form, "--out", out, *more)
    assert "Traceback" not in done.err
    if done.code == 2:
        assert len(done.err.splitlines()) == 1
        assert done.err[:-1].isprintable()
        assert not out.exists()
        return None
    assert done.code == 0, done.err
    return out.read_text()


@pytest.mark.parametrize("name", ALLOWED)
def test_exports_quote_or_refuse(name: str, tmp_path: Path) -> None:
    path = renamed(name, tmp_path)
    before = sorted(tmp_path.iterdir())

    text = exported(path, "json", tmp_path / "out.json")
    assert text is not None
    assert name in json.loads(text)["lidars"]
    text = exported(path, "urdf", tmp_path / "out.urdf")
    if text is not None:
        joints = ET.fromstring(text).findall("joint")
        assert len(joints) == 2
    text = exported(path, "autoware", tmp_path / "out.yaml")
    if text is not None:
        (frames,) = yaml.safe_load(text).values()
        assert len(frames) == 2
    text = exported(path, "tf", tmp_path / "out.sh")
    if text is not None:
        words = [shlex.split(line, comments=True) for line in text.replace("\\\n", " ").split("\n")]
        commands = [line for line in words if line]
        # Programs that publish, and nothing else that a shell would run.
        assert all("static_transform_publisher" in line for line in commands), commands
    text = exported(path, "tf", tmp_path / "out.py")
    if text is not None:
        calls = [n.func for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Call)]
        names = {getattr(f, "id", getattr(f, "attr", "")) for f in calls}
        assert names <= {"LaunchDescription", "Node"}, names
    made = {path.name for path in tmp_path.iterdir()} - {path.name for path in before}
    assert made <= {"out.json", "out.urdf", "out.yaml", "out.sh", "out.py"}


@pytest.mark.parametrize("name", ALLOWED)
def test_tables_show_names_as_they_are(name: str, tmp_path: Path) -> None:
    """Rich would take brackets for colours, and leave them out."""
    path = renamed(name, tmp_path)

    done = command("evaluate", path, path)

    assert done.code == 0, done.err
    # A long name is broken into lines.
    assert name[:5] in done.out or name.split()[0] in done.out


@pytest.mark.parametrize("name", ["../../x", "a/b", "a b", "<b>", "x" * 200, "a\x00b", "é"])
@pytest.mark.parametrize("output", ["bag", "caliv"])
def test_names_of_a_scenario_stay_in_its_folder(name: str, output: str, tmp_path: Path) -> None:
    scenario = dict(SCENARIO)
    scenario["drive"] = {"kind": "standstill", "duration_s": 0.6}
    scenario["lidars"] = {name: SCENARIO["lidars"]["front"]}
    scenario["reference"] = name
    path = tmp_path / "scenario.yaml"
    path.write_text(yaml.safe_dump(scenario))

    done = command("simulate", path, "--out", tmp_path / "a" / "drive", "--format", output)

    assert done.code in (0, 2), done.err
    assert {entry.name for entry in tmp_path.iterdir()} <= {"a", "scenario.yaml"}
    if done.code == 2:
        assert len(done.err.splitlines()) == 1
        assert not (tmp_path / "a").exists()
    else:
        assert [entry.name for entry in (tmp_path / "a").iterdir()] == ["drive"]
        assert list(load_config(tmp_path / "a/drive/config.yaml").lidars) == [name]


@settings(max_examples=15, deadline=None)
@given(st.text(max_size=30))
def test_a_name_is_refused_or_comes_back(tmp_path_factory: Any, name: str) -> None:
    """Through the writer of calibrations, the reader, and the JSON of a command."""
    folder = tmp_path_factory.mktemp("name")
    if name_problem(name) or name == "rear":
        return
    path = renamed(name, folder)

    done = command("merge", path, "--json", "--out", folder / "merged.yaml")

    assert done.code in (0, 2, 3, 4), done.err
    assert "Traceback" not in done.err
    if done.code != 2:
        assert name in json.loads(done.out)["lidars"]


def test_messages_name_what_is_hostile_in_one_line(tmp_path: Path) -> None:
    for name, place in itertools.product(("a\nb", "\x1b[2J", "\r", "\u2028"), ("--lidar", "--to")):
        done = command("export", tmp_path / f"no{name}", "--to", "json", "--out", "x", place, name)

        assert done.code == 2
        assert len(done.err.splitlines()) == 1
        assert done.err[:-1].isprintable()
