"""What the README and the pages that it leads to show is run here, so that it stays true."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Union, get_args, get_origin

import click
import gtsam
import numpy as np
import pytest
import typer
import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from caliv_graph.batch.manifest import load_manifest
from caliv_graph.cli.main import app
from caliv_graph.common import exits
from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.load import load_config
from caliv_graph.config.model import Config, GroundConfig
from caliv_graph.results.calibration_file import read_calibration
from caliv_graph.results.truth_file import read_truth
from caliv_graph.results.vehicle import VehiclePart
from caliv_graph.scenario.model import Scenario
from caliv_graph.simulation import load_scenario, simulate_caliv
from tests.scan_rates import scanned_at

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
CONFIGS = ROOT / "configs/README.md"
PACKAGE = ROOT / "caliv_graph/README.md"
FUSION = ROOT / "caliv_graph/fusion/README.md"
RESULTS = ROOT / "caliv_graph/results/README.md"
BATCH = ROOT / "caliv_graph/batch/README.md"
PAGES = sorted(
    [README, CONFIGS, ROOT / "scripts/README.md", *(ROOT / "caliv_graph").rglob("README.md")]
)

MOST_LINES = 250
"""Of the first page, which is read whole."""


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def blocks(language: str, page: Path) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text_of(page), re.DOTALL | re.MULTILINE)


def commands() -> dict[str, Any]:
    found: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    return found


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's drive with a quarter of its clouds, registered coarsely."""
    scenario = load_scenario(ROOT / "configs/scenarios/demo_arc.yaml")
    folder = tmp_path_factory.mktemp("readme") / "drive"
    simulate_caliv(scanned_at(scenario, 1.25), folder, seed=1)
    config = folder / "config.yaml"
    document = yaml.safe_load(config.read_text(encoding="utf-8"))
    document["registration"] = {"components": 200, "max_points": 160}
    config.write_text(yaml.safe_dump(document), encoding="utf-8")
    return folder


def run_example(page: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    (example,) = blocks("python", page)
    monkeypatch.chdir(folder)
    names: dict[str, Any] = {}
    exec(compile(example, name_of(page), "exec"), names)
    return names


@pytest.fixture(scope="module")
def calibrated(drive: Path) -> tuple[Path, dict[str, Any], str]:
    """Folder, names and output of the example that calibrates."""
    shown = io.StringIO()
    with pytest.MonkeyPatch.context() as monkeypatch, contextlib.redirect_stdout(shown):
        names = run_example(PACKAGE, drive, monkeypatch)
    return drive, names, shown.getvalue()


def test_the_python_example_calibrates(calibrated: tuple[Path, dict[str, Any], str]) -> None:
    drive, names, shown = calibrated

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


def test_the_example_of_a_localiser_runs(
    calibrated: tuple[Path, dict[str, Any], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    drive, _, _ = calibrated

    names = run_example(FUSION, drive, monkeypatch)

    # The scan is where the calibration has it: nothing moves, and nothing alarms.
    for name, lidar in names["calibration"].lidars.items():
        moved = lidar.T_vehicle_lidar.localCoordinates(names["solved"].atPose3(names["key"](name)))
        assert np.linalg.norm(moved) < 1e-6
    assert names["alarm"] is None


def test_the_keys_of_a_result_are_those_of_the_table(
    calibrated: tuple[Path, dict[str, Any], str],
) -> None:
    drive, _, _ = calibrated
    document = yaml.safe_load((drive / "calibration.yaml").read_text(encoding="utf-8"))
    written = set(document)
    written |= {f"lidars.<name>.{key}" for key in document["lidars"]["front"]}
    written |= {
        f"{section}.{key}" for section in ("joint", "observability") for key in document[section]
    }
    written -= {"lidars", "joint", "observability", "vehicle"}
    # Only where a time offset was estimated, with --prior, where what was measured by hand has a
    # sigma, and where structure was used.
    written |= {"lidars.<name>.time_offset", "lidars.<name>.saw_structure", "joint.earlier"}
    written |= {f"vehicle.{name}" for name in VehiclePart.model_fields} | {"structure"}

    assert set(first_cells(RESULTS, "## Keys of calibration.yaml")) == written


def test_the_config_shows_every_section_with_its_defaults(tmp_path: Path) -> None:
    (example,) = blocks("yaml", CONFIGS)
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


@pytest.mark.parametrize(
    ("model", "begin", "end"),
    [(Config, "### Recording", "## Scenarios"), (Scenario, "### Keys of a scenario", None)],
)
def test_the_tables_have_every_key_with_its_default(
    model: type[BaseModel], begin: str, end: str | None
) -> None:
    stated = {
        key: default
        for key, default, _, _ in rows(CONFIGS, begin, end, columns=4)
        if key != "key" and not key.startswith("---")
    }
    found = dict(leaves(model))

    assert stated.keys() == found.keys()
    for key, defaults in found.items():
        values = [yaml.safe_load(part) for part in re.findall(r"`([^`]*)`", stated[key])]
        words = re.sub(r"`[^`]*`", "", stated[key])
        assert ("required" in words) == any(not known for known, _ in defaults), key
        assert ("absent" in words) == any(known and value is None for known, value in defaults), key
        for known, value in defaults:
            if known and value is not None:
                assert value in values, key
        assert len(values) <= len(defaults), key


Defaults = list[tuple[bool, Any]]
"""Whether there is one, and which; several where a key means several models."""


def leaves(
    model: type[BaseModel], prefix: str = "", instance: BaseModel | None = None
) -> Iterator[tuple[str, Defaults]]:
    """All keys that hold a value, or that may be left out with all keys below them.

    `instance` is the default of a section that has one of its own.
    """
    merged: dict[str, Defaults] = {}
    for name, field in model.model_fields.items():
        key = prefix + name
        has = instance is not None or not field.is_required()
        default = plain(getattr(instance, name) if instance is not None else own_default(field))
        sections = models_in(field.annotation)
        if sections:
            # `target` has a section of its own, which says what its absence means.
            if has and default in (None, [], {}) and key != "target":
                merged.setdefault(key, []).append((True, default))
            own = default if isinstance(default, BaseModel) else None
            for section in sections:
                for inner, defaults in leaves(section, f"{key}{below_key(field)}.", own):
                    merged.setdefault(inner, []).extend(defaults)
        elif name in ("kind", "shape"):
            merged[key] = [(False, None)]  # it chooses the model
        else:
            merged[key] = [(has, default)]
    for key, defaults in merged.items():
        yield key, [one for i, one in enumerate(defaults) if one not in defaults[:i]]


def below_key(field: FieldInfo) -> str:
    text = str(field.annotation)
    if get_origin(field.annotation) is dict:
        return ".<name>"
    return "[]" if "tuple[" in text else ""


def models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if get_origin(annotation) in (Union, types.UnionType, tuple, dict):
        return [model for part in get_args(annotation) for model in models_in(part)]
    if get_origin(annotation) is not None and get_args(annotation):  # Annotated
        return models_in(get_args(annotation)[0])
    return []


def own_default(field: FieldInfo) -> Any:
    return None if field.is_required() else field.get_default(call_default_factory=True)


def plain(value: Any) -> Any:
    """A value as YAML has it."""
    return list(value) if isinstance(value, tuple) else value


def test_the_manifest_of_a_batch_has_the_keys_of_the_table(tmp_path: Path) -> None:
    stated = [key for key in first_cells(BATCH, "## The manifest") if key != "key of a job"]
    document = yaml.safe_load((ROOT / "configs/batch.yaml").read_text(encoding="utf-8"))
    used = set(document["defaults"]).union(*map(set, document["jobs"]))

    assert load_manifest(ROOT / "configs/batch.yaml")
    assert set(stated) == used


def test_the_first_page_names_every_command() -> None:
    table = re.findall(r"^\| `caliv-graph ([a-z]+)` \|", text_of(README), re.MULTILINE)

    assert sorted(table) == sorted(commands())


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_and_their_options_exist(page: Path) -> None:
    for block in blocks("sh", page):
        for line in block.replace("\\\n", " ").splitlines():
            words = line.split("#")[0].split()
            if words[:1] == ["caliv-graph"] and not words[1].startswith("-"):
                known = {
                    name
                    for p in commands()[words[1]].params
                    for name in (*p.opts, *p.secondary_opts)
                }
                assert {word for word in words if word.startswith("--")} <= known, line
            scripts = [word for word in words if re.match(r"scripts/\w+(\.py)?$", word)]
            for script in scripts:
                assert (ROOT / script).is_file(), line
            if scripts and scripts[0].endswith(".py"):
                options = {word for word in words if word.startswith("--")}
                code = (ROOT / scripts[0]).read_text(encoding="utf-8")
                assert [option for option in options if f'"{option}"' not in code] == [], line


def lines_of_configs() -> Iterator[tuple[str, str]]:
    """Command lines in comments of configs: on a line of their own, or quoted."""
    for path in sorted((ROOT / "configs").rglob("*.yaml")):
        text = text_of(path)
        for line in re.findall(r"^# (caliv-graph .+)$|'(caliv-graph [a-z]+ [^']+)'", text, re.M):
            yield name_of(path), line[0] or line[1]


def test_lines_in_comments_of_configs_are_whole() -> None:
    """They are parsed as the program does, required arguments included."""
    found = list(lines_of_configs())

    assert {path for path, _ in found} >= {"configs/batch.yaml", "configs/caliv_released.yaml"}
    for path, line in found:
        words = shlex.split(line)[1:]
        try:
            commands()[words[0]].make_context(words[0], words[1:])
        except click.ClickException as problem:
            pytest.fail(f"{path}: {line}: {problem.format_message()}")


def test_commands_that_messages_name_exist() -> None:
    """Remedies quote command lines, with placeholders: their commands and options are real."""
    named = 0
    for path in sorted((ROOT / "caliv_graph").rglob("*.py")):
        # Strings that go on in the next line are one.
        text = re.sub(r"\"\s*\n\s*f?\"", "", text_of(path))
        for command, rest in re.findall(r"'caliv-graph ([a-z]+)([^'\n]*)'", text):
            named += 1
            known = {
                name for p in commands()[command].params for name in (*p.opts, *p.secondary_opts)
            } | {"--help"}
            assert set(re.findall(r"--[a-z-]+", rest)) <= known, f"{path.name}: {command}{rest}"
    assert named > 20


def test_every_command_has_an_example() -> None:
    shown = "".join(block for page in PAGES for block in blocks("sh", page))

    assert set(re.findall(r"^caliv-graph ([a-z]+)", shown, re.MULTILINE)) == set(commands())


def test_the_exit_codes_are_those_of_the_program() -> None:
    table = {int(code) for code in re.findall(r"^\| (\d+) \|", text_of(README), re.MULTILINE)}

    assert table == {value for name, value in vars(exits).items() if name.isupper()}


def test_the_first_page_is_short_and_names_what_a_newcomer_runs() -> None:
    text = text_of(README)

    assert len(text.splitlines()) <= MOST_LINES
    for needed in ("scripts/demo", "scripts/test"):
        assert needed in text


def test_what_contributing_names_exists() -> None:
    section = text_of(PACKAGE).split("## Contributing")[1]
    named = re.findall(r"`((?:caliv_graph|tests)/[\w/]+\.py)", section)
    named += [
        f"caliv_graph/{path}"
        for path in re.findall(r"`((?!caliv_graph|tests)\w+/\w+\.py)", section)
    ]

    assert len(named) > 8
    missing = [path for path in named if "NAME" not in path and not (ROOT / path).is_file()]
    assert missing == []


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_the_files_and_headings_that_it_links_to_exist(page: Path) -> None:
    links = re.findall(r"\]\((?!https?:)([^)]+)\)|src=\"([^\"]+)\"", text_of(page))

    for link in (first or second for first, second in links):
        file, _, heading = link.partition("#")
        target = (page.parent / file).resolve() if file else page
        assert target.exists(), link
        if heading:
            assert heading in headings(target), link


def headings(page: Path) -> set[str]:
    """Anchors as GitHub makes them."""
    code = re.sub(r"^```.*?^```", "", text_of(page), flags=re.DOTALL | re.MULTILINE)
    titles = re.findall(r"^#+ (.*)$", code, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def rows(page: Path, begin: str, end: str | None, columns: int) -> Iterator[list[str]]:
    """Cells of the tables with so many columns between two headings; the keys without backticks."""
    text = text_of(page).split(f"\n{begin}", 1)[1]
    if end is not None:
        text = text.split(f"\n{end}\n", 1)[0]
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.split("|")][1:-1]
        if line.startswith("|") and len(cells) == columns:
            yield [cells[0].strip("`"), *cells[1:]]


def first_cells(page: Path, heading: str) -> list[str]:
    """Code in the first column of the first table below a heading."""
    section = text_of(page).split(f"{heading}\n", 1)[1].split("\n## ")[0]
    return re.findall(r"^\| `([^`]+)` \|", section, re.MULTILINE)
