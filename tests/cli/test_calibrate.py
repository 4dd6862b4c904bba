from __future__ import annotations

import json
import types
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner, Result

from caliv_graph.cli.main import app
from caliv_graph.common.progress import Progress
from caliv_graph.config.load import load_config
from caliv_graph.config.model import Config
from caliv_graph.errors import ConfigError, OutputError, RecordingError
from caliv_graph.products import Calibration, Recording
from caliv_graph.results.calibration_file import read_calibration, write_calibration
from tests.cli.commands import write_config, write_drive
from tests.readers.bags import SECOND, START, cloud, imu, write_bag
from tests.samples import make_calibration, make_solution, unseen


@dataclass
class Pipeline:
    """Stands in for `pipeline.calibrate`, and remembers what it was asked."""

    calibration: Calibration = field(default_factory=make_calibration)
    recordings: Sequence[Recording] = ()
    config: Config | None = None
    prior: Calibration | None = None

    def calibrate(
        self,
        recordings: Sequence[Recording],
        config: Config,
        progress: Progress,
        prior: Calibration | None,
    ) -> types.SimpleNamespace:
        self.recordings, self.config, self.prior = recordings, config, prior
        with progress.stage("solving", 2) as advance:
            advance(2, "converged")
        return types.SimpleNamespace(
            calibration=self.calibration,
            solution=make_solution(),
            record=None,
        )


@pytest.fixture
def pipeline(monkeypatch: pytest.MonkeyPatch) -> Pipeline:
    pipeline = Pipeline()
    module = types.ModuleType("caliv_graph.pipeline")
    monkeypatch.setattr(module, "calibrate", pipeline.calibrate, raising=False)
    monkeypatch.setitem(__import__("sys").modules, "caliv_graph.pipeline", module)
    return pipeline


@pytest.fixture
def config(tmp_path: Path) -> Path:
    write_drive(tmp_path / "drive")
    return write_config(tmp_path / "config.yaml")


def calibrate(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["calibrate", *map(str, arguments)])


def test_the_result_is_a_folder(pipeline: Pipeline, config: Path) -> None:
    out = config.parent / "deep/out"

    result = calibrate(config, "--out", out)

    assert (result.exit_code, result.stderr) == (0, "")
    assert sorted(path.name for path in out.iterdir()) == [
        "calibration.yaml",
        "config.yaml",
        "graph.gtsam",
        "graph.values.gtsam",
        "log.jsonl",
        "target.ply",
    ]
    assert read_calibration(out / "calibration.yaml").status == "partial"
    assert "Sensor to vehicle" in result.stdout
    assert "solving" in (out / "log.jsonl").read_text()
    assert [recording.name for recording in pipeline.recordings] == [str(config.parent / "drive")]


def test_the_effective_config_can_be_run_from_where_it_is(pipeline: Pipeline, config: Path) -> None:
    out = config.parent / "deep/out"
    calibrate(config, "--out", out)

    effective = load_config(out / "config.yaml")

    assert effective.data.path == (config.parent / "drive").resolve()
    assert effective.lidars == load_config(config).lidars
    again = calibrate(out / "config.yaml", "--out", config.parent / "again")
    assert again.exit_code == 0


def test_several_drives(pipeline: Pipeline, config: Path) -> None:
    second = write_drive(config.parent / "second")

    result = calibrate(
        config,
        "--out",
        config.parent / "out",
        "--data",
        second,
        "--data",
        config.parent / "drive",
    )

    assert result.exit_code == 0
    assert [Path(recording.name).name for recording in pipeline.recordings] == ["second", "drive"]
    assert load_config(config.parent / "out/config.yaml").data.path == second


def test_a_drive_counts_once(pipeline: Pipeline, config: Path) -> None:
    drive = config.parent / "drive"

    result = calibrate(
        config, "--out", config.parent / "out", "--data", drive, "--data", drive / "../drive"
    )

    assert isinstance(result.exception, ConfigError)
    assert "given twice" in str(result.exception)


def test_json_is_the_content_of_calibration_yaml_and_more(pipeline: Pipeline, config: Path) -> None:
    out = config.parent / "out"
    said = ("poses without a cloud are skipped",)
    pipeline.calibration = replace(pipeline.calibration, warnings=said)

    result = calibrate(config, "--out", out, "--json")

    document = json.loads(result.stdout)
    written = yaml.safe_load((out / "calibration.yaml").read_text())
    assert document["lidars"] == written["lidars"]
    assert document["joint"] == written["joint"]
    assert document["out"] == str(out)
    assert document["warnings"] == written["warnings"] == list(said)
    assert [stage["stage"] for stage in document["stages"]] == ["solving"]
    assert result.stderr == "warning: poses without a cloud are skipped\n"


def test_a_promise_that_is_not_kept_is_exit_3(pipeline: Pipeline, config: Path) -> None:
    pipeline.calibration = make_calibration(unmet=("require s2v: yaw of 'front' not determined",))

    result = calibrate(config, "--out", config.parent / "out")

    assert result.exit_code == 3
    assert result.stderr == "warning: require s2v: yaw of 'front' not determined\n"
    written = read_calibration(config.parent / "out/calibration.yaml")
    assert written.unmet == ("require s2v: yaw of 'front' not determined",)


def test_a_lidar_that_never_saw_the_target_is_exit_3(pipeline: Pipeline, config: Path) -> None:
    pipeline.calibration = unseen(
        make_calibration(unmet=("lidar 'front' never saw the target",)), "front"
    )

    result = calibrate(config, "--out", config.parent / "out")

    assert result.exit_code == 3
    assert "saw neither target nor structure" in result.stdout
    front = read_calibration(config.parent / "out/calibration.yaml").lidars["front"]
    assert not any(front.determined.values())


def test_data_that_contradict_each_other_are_exit_4(pipeline: Pipeline, config: Path) -> None:
    pipeline.calibration = make_calibration(status="inconsistent", unmet=("this and that",))

    result = calibrate(config, "--out", config.parent / "out")

    assert result.exit_code == 4
    assert read_calibration(config.parent / "out/calibration.yaml").status == "inconsistent"


def test_an_earlier_calibration_is_handed_on(pipeline: Pipeline, config: Path) -> None:
    earlier = config.parent / "earlier.yaml"
    write_calibration(make_calibration(reference="front"), earlier)

    result = calibrate(config, "--prior", earlier, "--out", config.parent / "out")

    assert result.exit_code == 0
    assert pipeline.prior is not None
    assert pipeline.prior.reference == "front"


def test_an_earlier_calibration_that_is_not_there(pipeline: Pipeline, config: Path) -> None:
    earlier = config.parent / "earlier.yaml"

    result = calibrate(config, "--prior", earlier, "--out", config.parent / "out")

    assert isinstance(result.exception, ConfigError)
    assert str(result.exception) == f"{earlier}: no such file. Check the path"
    assert pipeline.config is None
    assert not (config.parent / "out").exists()


def test_the_earlier_calibration_is_not_replaced_by_the_result(
    pipeline: Pipeline, config: Path
) -> None:
    out = config.parent / "out"
    calibrate(config, "--out", out)
    before = (out / "calibration.yaml").read_bytes()
    pipeline.config = None

    refused = calibrate(config, "--prior", out / "calibration.yaml", "--out", out, "--force")

    assert isinstance(refused.exception, OutputError)
    assert "which this command reads" in str(refused.exception)
    assert pipeline.config is None, "said only after the work"
    assert (out / "calibration.yaml").read_bytes() == before


def test_an_older_result_is_replaced_only_with_force(pipeline: Pipeline, config: Path) -> None:
    out = config.parent / "out"
    calibrate(config, "--out", out)
    pipeline.calibration = make_calibration(status="ok", undetermined=())
    pipeline.config = None

    refused = calibrate(config, "--out", out)

    assert isinstance(refused.exception, OutputError)
    assert "--force" in str(refused.exception)
    assert pipeline.config is None, "said only after the work"
    assert read_calibration(out / "calibration.yaml").status == "partial"
    assert calibrate(config, "--out", out, "--force").exit_code == 0
    assert read_calibration(out / "calibration.yaml").status == "ok"


def test_the_folder_of_the_drive_is_not_replaced(pipeline: Pipeline, config: Path) -> None:
    result = calibrate(config, "--out", config.parent / "drive", "--force")

    assert isinstance(result.exception, OutputError)
    assert (config.parent / "drive/input/ego_poses.yaml").is_file()


@pytest.mark.parametrize(
    ("sections", "lines"),
    [
        ({}, []),
        ({"ground": {"use": False}}, []),
        ({"ground": {"vehicle_height": 0.0}}, []),
        ({"solve": {"time_offset": True}}, []),
        (
            {"topics": {"imu": "/imu/data"}, "gnss": {"lever_arm": [0, 0, 1]}, "imu": {}},
            [
                "topics: has no effect, since a CaLiV folder contains the vehicle poses",
                "gnss: has no effect, since a CaLiV folder contains the vehicle poses",
            ],
        ),
    ],
)
def test_keys_without_effect_are_warned_about_in_a_line_each(
    pipeline: Pipeline, config: Path, sections: dict[str, object], lines: list[str]
) -> None:
    write_config(config, **sections)

    result = calibrate(config, "--out", config.parent / "out")

    assert result.exit_code == 0
    assert result.stderr.splitlines() == [f"warning: {line}" for line in lines]


def test_topics_that_a_file_of_poses_stands_instead_of_are_warned_about(
    pipeline: Pipeline, tmp_path: Path
) -> None:
    at = [START + k * SECOND // 10 for k in range(5)]
    clouds = [("/lidar", t, cloud(t, [[5.0, 0.0, 0.0], [6.0, 0.0, 0.0]])) for t in at]
    write_bag(tmp_path / "drive", [*clouds, *(("/imu", t, imu(t)) for t in at)])
    (tmp_path / "p.tum").write_text("".join(f"{t / 1e9:.1f} 0 0 0 0 0 0 1\n" for t in at))
    config = write_config(
        tmp_path / "config.yaml",
        data={"path": "drive", "poses": "p.tum"},
        topics={"imu": "/imu"},
        lidars={"a": {"topic": "/lidar", "initial": {"xyz": [1, 0, 1]}}},
    )

    result = calibrate(config, "--out", tmp_path / "out")

    assert (
        "warning: topics.imu: has no effect on the trajectory, since data.poses stands instead. "
        "Remove one of the two"
    ) in result.stderr.splitlines()


def test_guesses_that_nobody_filled_in(pipeline: Pipeline, config: Path) -> None:
    document = yaml.safe_load(config.read_text())
    for lidar in document["lidars"].values():
        lidar["initial"] = {"xyz": [0, 0, 0], "rpy_deg": [0, 0, 0]}
    config.write_text(yaml.safe_dump(document))

    result = calibrate(config, "--out", config.parent / "out")

    assert isinstance(result.exception, ConfigError)
    assert str(result.exception).startswith(
        f"{config}: lidars.front.initial and lidars.rear.initial are all zeros"
    )


def test_bags_cannot_be_read_yet(pipeline: Pipeline, config: Path) -> None:
    write_config(config, data={"path": "drive"})

    result = calibrate(config, "--out", config.parent / "out")

    assert isinstance(result.exception, RecordingError)
    assert not (config.parent / "out").exists()
