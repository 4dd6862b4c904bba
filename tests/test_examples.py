"""Every command line of the pages and of `--help` is run as it stands.

In a folder that has what the lines name. What takes long is replaced: the lines have to be
understood, and their files found, read and written. That the work is right is tested elsewhere.
"""

from __future__ import annotations

import re
import shlex
import shutil
import types
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import yaml

from caliv_graph.cli import main
from caliv_graph.export.text import quaternion_xyzw
from caliv_graph.pipeline import Look
from caliv_graph.planning import Assumptions
from caliv_graph.planning.suggest import Planned
from caliv_graph.results.calibration_file import write_calibration
from caliv_graph.scenario.model import Scenario, load_scenario
from tests.cli.commands import ROOT
from tests.cli.test_init import write_sensors
from tests.fusion.drives import TRUTH, drive, information
from tests.samples import make_calibration, make_solution
from tests.test_readme import PAGES, blocks, commands, name_of

NAMES = ("front", "rear")

URDF = """<robot name="van"><link name="base_link"/>
<joint name="f" type="fixed"><origin xyz="2 0 2" rpy="0 0.17 0"/>
<parent link="base_link"/><child link="lidar_front"/></joint>
<joint name="r" type="fixed"><origin xyz="-0.4 0 2" rpy="0 0.17 3.14"/>
<parent link="base_link"/><child link="lidar_rear_link"/></joint></robot>"""

HOUSING = {"x": 0.0, "y": 0.0, "z": 0.0, "roll": 0.0, "pitch": 0.0, "yaw": 0.0}


def lines() -> Iterator[tuple[str, str]]:
    """Where each line stands, and the line."""
    for page in PAGES:
        for block in blocks("sh", page):
            for line in block.replace("\\\n", " ").splitlines():
                if line.startswith("caliv-graph "):
                    yield name_of(page), line
    for name, command in commands().items():
        for line in re.findall(r"Example: (caliv-graph [^\n]+)", command.help):
            yield f"{name} --help", line


LINES = list(dict.fromkeys(line for _, line in lines()))


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all files that the lines read."""
    folder = tmp_path_factory.mktemp("world")
    write_sensors(folder / "drive")
    for config in ("config.yaml", "drive/config.yaml"):
        assert main.run(["init", str(folder / "drive"), "--out", str(folder / config)]) == 0
    mounts = {
        name: {
            "translation": T.translation().tolist(),
            "quaternion_xyzw": list(quaternion_xyzw(T)),
        }
        for name, T in TRUTH.items()
    }
    truth = {"lidars": {name: {"T_vehicle_lidar": mount} for name, mount in mounts.items()}}
    (folder / "drive/truth.yaml").write_text(yaml.safe_dump(truth))
    for result in ("result", "spring", "autumn", "monday", "friday"):
        (folder / result).mkdir()
        found = drive(information(NAMES), NAMES, source=result)
        write_calibration(found, folder / result / "calibration.yaml")
    for name in ("vehicle.urdf", "old.urdf", "van.urdf"):
        (folder / name).write_text(URDF)
    kit = {"sensor_kit_base_link": {f"{name}_base_link": HOUSING for name in NAMES}}
    (folder / "sensor_kit_calibration.yaml").write_text(yaml.safe_dump(kit))
    vehicle = {"base_link": {"sensor_kit_base_link": {**HOUSING, "z": 1.9}}}
    (folder / "sensors_calibration.yaml").write_text(yaml.safe_dump(vehicle))
    (folder / "fleet.yaml").write_text("jobs: [{name: monday, config: config.yaml}]")
    shutil.copytree(ROOT / "configs", folder / "configs")
    for name in ("scenario.yaml", "next.yaml"):
        shutil.copy(ROOT / "configs/scenarios/paper_arc.yaml", folder / name)
    return folder


def calibrated(*_: Any) -> Any:
    """What `pipeline.calibrate` gives."""
    return types.SimpleNamespace(
        calibration=make_calibration(), solution=make_solution(), record=None
    )


def quiet(*_: Any, **__: Any) -> Any:
    """A result that says nothing, of a survey, a validation, a batch or a simulation."""
    verdict = types.SimpleNamespace(contradicts=False, sentences=())
    lists: dict[str, Any] = dict.fromkeys(("warnings", "unmet", "rows"), ())
    lists |= {"assumptions": Assumptions()}
    lists |= {"scans": {}, "duration_s": 1.0, "folder": "drive", "exit": 0}
    return types.SimpleNamespace(**lists, verdict=verdict, has_structure=True)


def planned(*_: Any) -> Planned:
    """What is known of a vehicle whose drive shows no target."""
    return Planned(None, load_scenario(ROOT / "configs/scenarios/paper_arc.yaml"), Assumptions())


def suggested(scenario: Scenario, *_: Any) -> Any:
    """The drive itself as the best one."""
    nothing = types.SimpleNamespace(sigma_s2v={}, sigma_s2s={})
    return types.SimpleNamespace(
        scenario=scenario, met=False, manoeuvre="arc", prediction=nothing, space_m=(1.0, 1.0)
    )


REPLACED = {
    # First, for it takes the real `look` when it is imported.
    "caliv_graph.workflows.next_drive.recorded_drive": quiet,
    "caliv_graph.workflows.next_drive.next_drive": planned,
    "caliv_graph.pipeline.calibrate": calibrated,
    "caliv_graph.pipeline.look": lambda *_: Look(None, (), ()),
    "caliv_graph.workflows.survey.survey": quiet,
    "caliv_graph.report.predicted.survey_table": lambda *_: "",
    "caliv_graph.planning.suggest.suggest": suggested,
    "caliv_graph.simulation.write_drive": quiet,
    "caliv_graph.validation.validate": quiet,
    "caliv_graph.workflows.repeatability.split_halves": lambda *_: None,
    "caliv_graph.workflows.repeatability.with_halves": lambda found, *_: found,
    "caliv_graph.report.validation.validation_document": lambda *_: {},
    "caliv_graph.report.validation.validation_table": lambda *_: "",
    "caliv_graph.report.validation.render_validation": lambda *_: "",
    "caliv_graph.batch.run.run_batch": quiet,
    "caliv_graph.batch.page.summary_table": lambda *_: "",
}


@pytest.mark.parametrize("line", LINES)
def test_a_line_runs_as_it_stands(
    line: str,
    world: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    here = tmp_path / "here"
    shutil.copytree(world, here)
    monkeypatch.chdir(here)
    words = shlex.split(line, comments=True)[1:]
    out = Path(words[words.index("--out") + 1]) if "--out" in words else None
    if out is not None:
        # Nobody has it yet.
        shutil.rmtree(out) if out.is_dir() else out.unlink(missing_ok=True)

    with ExitStack() as stack:
        for name, replacement in REPLACED.items():
            stack.enter_context(mock.patch(name, replacement))
        code = main.run(words)

    told = capsys.readouterr().err
    # A plan tells by its exit code that the drive of the example does not keep the limits.
    assert code == (3 if words[0] == "plan" and "--sigma" in words else 0), told
    if out is not None and words[0] not in ("simulate", "batch"):
        assert out.exists()


def test_there_are_lines_of_every_command() -> None:
    assert {line.split()[1] for line in LINES} == {*commands(), "--help"}
