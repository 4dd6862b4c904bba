from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from caliv_graph.batch.manifest import Job, effective_config, load_manifest
from caliv_graph.errors import ConfigError
from tests.cli.commands import ROOT, write_config


def load(folder: Path, content: Any) -> tuple[Job, ...]:
    path = folder / "fleet.yaml"
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return load_manifest(path)


def message(folder: Path, content: Any) -> str:
    with pytest.raises(ConfigError) as caught:
        load(folder, content)
    text = str(caught.value)
    assert "\n" not in text
    assert len(text) < 400 + len(str(folder))
    return text.removeprefix(f"{folder / 'fleet.yaml'}: ")


def test_paths_are_relative_to_the_manifest_and_defaults_hold_for_all(tmp_path: Path) -> None:
    first, second = load(
        tmp_path,
        {
            "defaults": {"config": "van.yaml", "vehicle": "van 7", "prior": "old.yaml"},
            "jobs": [
                {"name": "mon"},
                {
                    "name": "tue",
                    "config": "/else/where.yaml",
                    "data": "drives/tue",
                    "vehicle": None,
                    "prior": None,
                    "require": "s2v",
                },
            ],
        },
    )

    assert first == Job("mon", tmp_path / "van.yaml", vehicle="van 7", prior=tmp_path / "old.yaml")
    assert second == Job(
        "tue", Path("/else/where.yaml"), data=(tmp_path / "drives/tue",), require=("s2v",)
    )


@pytest.mark.parametrize(
    "name",
    [
        "../escape",
        "/etc/passwd",
        "a/b",
        "..",
        ".",
        ".hidden",
        "-rf",
        "trailing.",
        "",
        " ",
        "new\nline",
        "nul\0",
        "<script>",
        "a\\b",
        "x" * 81,
        "=cmd()",
    ],
)
def test_names_that_are_no_plain_folder_names_are_refused(tmp_path: Path, name: str) -> None:
    text = message(tmp_path, {"jobs": [{"name": name, "config": "c.yaml"}]})

    assert text.startswith("'jobs.0.name': ")


@pytest.mark.parametrize("name", ["mon", "2026-11-20_van7.a", "Süd", "7"])
def test_plain_names_are_taken(tmp_path: Path, name: str) -> None:
    assert load(tmp_path, {"jobs": [{"name": name, "config": "c.yaml"}]})[0].name == name


def test_a_name_of_digits_needs_no_quotes(tmp_path: Path) -> None:
    text = "jobs: [{name: 2026-11-20, config: c}, {name: 0012, config: 7, data: [0001, 3]}]"

    dated, numbered = load(tmp_path, text)

    assert (dated.name, numbered.name) == ("2026-11-20", "0012")
    assert numbered.config == tmp_path / "7"
    assert numbered.data == (tmp_path / "0001", tmp_path / "3")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("jobs: [{name: mon, confg: c.yaml}]", "unknown key 'jobs.0.confg': did you mean 'config'"),
        ("job: []", "unknown key 'job': did you mean 'jobs'?"),
        ("defaults: {confi: c}\njobs: [{name: a}]", "unknown key 'defaults.confi'"),
        ("defaults: {data: d}\njobs: [{name: a}]", "unknown key 'defaults.data'"),
        ("jobs: []", "'jobs': "),
        ("jobs: [{config: c.yaml}]", "'jobs.0.name' is missing"),
        ("jobs: [{name: mon}]", "job 'mon' has no config: give it 'config'"),
        ("jobs: [{name: 1.5, config: c}]", "'jobs.0.name': is not text in YAML: write it in quote"),
        ("jobs: [{name: a, config: c}, {name: a, config: d}]", "job name 'a' is used twice"),
        ("jobs: [{name: a, config: c}, {name: A, config: d}]", "job name 'A' is used beside 'a'"),
        ("jobs: [{name: Summary.json, config: c}]", "'jobs.0.name': is the name of a file of the"),
        ("jobs: [{name: a, config: c, mode: magic}]", "'jobs.0.mode': "),
        ("jobs: [{name: a, config: c, require: [s3s]}]", "'jobs.0.require.0': "),
        ("jobs: [{name: a, config: c, limits: {yaw: 1}}]", "'jobs.0.limits': unknown limit 'yaw'"),
        ("jobs: [{name: a, config: c, vehicle: <b>}]", "'jobs.0.vehicle': must be letters"),
        ("- a", "holds no manifest: expected 'jobs' with a list"),
        ("jobs: [", "not valid YAML in line"),
        ("jobs: !!python/object/apply:os.system [x]", "not valid YAML"),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path: Path, content: str, said: str) -> None:
    assert message(tmp_path, content).startswith(said)


def test_overrides_take_the_place_of_what_the_config_says(tmp_path: Path) -> None:
    config = write_config(
        tmp_path / "config.yaml",
        solve={"time_offset": True},
        require=["s2v", {"limits": {"s2v_yaw_deg": 0.1}}],
    )

    def effective(**settings: Any) -> Any:
        return effective_config(Job("a", config, **settings))

    assert effective().require == ("s2v",)
    assert effective().limits == {"s2v_yaw_deg": 0.1}
    assert (effective(mode="joint").solve.mode, effective(mode="joint").solve.time_offset) == (
        "joint",
        True,
    )
    assert effective(limits={"s2s_x_m": 0.01}).limits == {"s2s_x_m": 0.01}
    assert effective(limits={"s2s_x_m": 0.01}).require == ("s2v",)
    assert effective(limits={}).limits == {}
    assert effective(require=()).require == ()
    # The limits of the config stay, wherever it has them.
    assert effective(require=("s2s",)).require == ("s2s",)
    assert effective(require=("s2s",)).limits == {"s2v_yaw_deg": 0.1}
    assert effective(require=("s2s",), limits={"s2s_x_m": 0.01}).limits == {"s2s_x_m": 0.01}
    assert effective(require=("s2s",), limits={}).limits == {}
    assert effective().data.path == tmp_path / "drive"


@pytest.mark.parametrize(
    "inside",
    [
        {"limits": {"s2v_yaw_deg": 0.1}},
        {"s2v_yaw_deg": 0.1},
        ["s2v", {"s2v_yaw_deg": 0.1}],
        [{"limits": {"s2v_yaw_deg": 0.1}}],
    ],
)
def test_a_job_with_other_requirements_keeps_the_limits_inside_them(
    tmp_path: Path, inside: Any
) -> None:
    config = write_config(tmp_path / "config.yaml", require=inside, limits={"s2s_x_m": 0.02})

    effective = effective_config(Job("a", config, require=("s2s", "s2v_rotation")))

    assert effective.require == ("s2s", "s2v_rotation")
    assert effective.limits == {"s2s_x_m": 0.02, "s2v_yaw_deg": 0.1}


def test_a_section_that_is_empty_or_no_section(tmp_path: Path) -> None:
    config = write_config(tmp_path / "config.yaml", solve=None, require=None)
    assert effective_config(Job("a", config, mode="joint")).solve.mode == "joint"

    write_config(config, solve="fast")
    with pytest.raises(ConfigError, match="'solve'"):
        effective_config(Job("a", config, mode="joint"))


def test_the_example_is_a_manifest() -> None:
    path = ROOT / "configs/batch.yaml"

    jobs = load_manifest(path)

    assert [job.name for job in jobs] == ["monday", "tuesday", "both-days", "van8"]
    assert jobs[0].limits == {"s2s_yaw_deg": 0.5}
    assert jobs[2].vehicle is None
    assert len(jobs[2].data) == 2
    written = yaml.safe_load(path.read_text())
    keys = {key for job in [written["defaults"], *written["jobs"]] for key in job}
    assert keys == set(Job.__dataclass_fields__), "every key is shown"
