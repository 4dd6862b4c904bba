from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from caliv_graph.cli.main import run as run_program
from caliv_graph.results.calibration_file import write_calibration
from tests.cli.commands import write_config
from tests.export.requests import T_VEHICLE_LIDAR, calibration_of, quaternion_xyzw

CONSUMERS = {
    "urdf": "a.urdf",
    "tf": "a.mcap",
    "autoware": "a.yaml",
    "glim": "a.json",
    "lio-sam": "a.yaml",
    "fast-lio": "a.yaml",
    "mola": "a.yaml",
    "npz": "a.npz",
    "json": "a.json",
    "gtsam": "a.gtsam",
}


@dataclass(frozen=True)
class Done:
    returncode: int
    stdout: str
    stderr: str


Run = Callable[..., Done]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs the program in this process, which spares its imports."""

    def run_here(*arguments: object) -> Done:
        code = run_program([str(argument) for argument in arguments])
        return Done(code, *capsys.readouterr())

    return run_here


@pytest.fixture
def result(tmp_path: Path) -> Path:
    """A calibration with its config beside it."""
    folder = tmp_path / "result"
    folder.mkdir()
    write_calibration(calibration_of(), folder / "calibration.yaml")
    write_config(folder / "config.yaml", topics={"imu": "/imu"})
    return folder / "calibration.yaml"


@pytest.mark.parametrize("consumer", CONSUMERS)
def test_every_consumer(run: Run, consumer: str, result: Path, tmp_path: Path) -> None:
    out = tmp_path / CONSUMERS[consumer]

    done = run("export", result, "--to", consumer, "--out", out, "--json")

    assert done.returncode == 0
    document = json.loads(done.stdout)
    assert document["to"] == consumer
    assert document["status"] == "partial"
    assert all(Path(file).is_file() for file in document["files"])
    assert document["files"][0] == str(out)
    assert all(line.startswith("warning: ") for line in done.stderr.splitlines())
    assert "(vehicle axes) not determined by the drive" in done.stderr
    assert document["warnings"] == [line[9:] for line in done.stderr.splitlines()]


def test_a_base_is_copied_and_what_was_written_is_said(
    run: Run, result: Path, tmp_path: Path
) -> None:
    old = tmp_path / "old.urdf"
    old.write_text(
        '<robot name="r">  <!-- mine -->\n<link name="base_link"/><link name="lidar_front"/>\n'
        '<joint name="j" type="fixed"><origin xyz="0 0 0"/><parent link="base_link"/>'
        '<child link="lidar_front"/></joint></robot>'
    )
    arguments = ["export", result, "--to", "urdf", "--base", old, "--lidar", "front"]

    done = run(*arguments, "--out", tmp_path / "new.urdf")

    assert done.returncode == 0
    assert done.stdout.splitlines() == [
        "front: pose of 'lidar_front' in 'base_link'; not determined by the drive: yaw, x",
        f"{tmp_path / 'new.urdf'} written",
    ]
    assert "<!-- mine -->" in (tmp_path / "new.urdf").read_text()
    # In place, too: it is read before it is written.
    assert run(*arguments, "--out", old).returncode == 2
    assert run(*arguments, "--out", old, "--force").returncode == 0
    assert old.read_text() == (tmp_path / "new.urdf").read_text()


def test_transforms_in_json(run: Run, result: Path, tmp_path: Path) -> None:
    done = run("export", result, "--to", "urdf", "--out", tmp_path / "a", "--json")

    front = json.loads(done.stdout)["transforms"][0]
    T = T_VEHICLE_LIDAR["front"]
    assert (front["lidar"], front["parent"], front["child"]) == ("front", "base_link", "front")
    np.testing.assert_allclose(front["translation"], T.translation(), atol=1e-9)
    assert abs(np.dot(front["quaternion_xyzw"], quaternion_xyzw(T))) == pytest.approx(1.0, abs=1e-9)
    assert front["undetermined"] == ["yaw", "x"]


def test_contradictions_are_warned_about(run: Run, result: Path, tmp_path: Path) -> None:
    write_calibration(replace(calibration_of(), status="inconsistent"), result, force=True)

    done = run("export", result, "--to", "tf", "--out", tmp_path / "tf.sh")

    assert done.returncode == 0
    assert "warning: calibration.yaml: status inconsistent" in done.stderr
    assert "# ATTENTION: calibration.yaml: status inconsistent" in (tmp_path / "tf.sh").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--to", "ply"], "Invalid value for '--to'"),
        (["--to", "tf", "--form", "xml"], "not by 'xml'. Give --form lines, launch or mcap"),
        (["--to", "tf", "--letter", "l"], "--letter: is not for --to tf, but for gtsam"),
        (["--to", "urdf", "--base", "none"], "none: no such file"),
        (["--to", "glim", "--config", "none"], "none: no such file"),
        (["--to", "tf", "--bag", "none"], "none: no such file or folder"),
        (["--to", "gtsam", "--letter", "xy"], "letter 'xy': expected one letter"),
    ],
)
def test_what_is_wrong_is_one_line(
    run: Run, arguments: list[str], message: str, result: Path, tmp_path: Path
) -> None:
    done = run("export", result, *arguments, "--out", tmp_path / "out.sh")

    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""
    assert [path.name for path in tmp_path.iterdir()] == ["result"]


def test_no_calibration(run: Run, tmp_path: Path) -> None:
    done = run("export", tmp_path / "none.yaml", "--to", "urdf", "--out", tmp_path / "a.urdf")

    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "none.yaml: no such file" in done.stderr


def test_the_imu_is_never_made_up(run: Run, result: Path, tmp_path: Path) -> None:
    (result.parent / "config.yaml").unlink()

    done = run("export", result, "--to", "fast-lio", "--out", tmp_path / "a.yaml")

    assert done.returncode == 2
    assert "needs where the IMU is" in done.stderr
    told = run("export", result, "--to", "fast-lio", "--out", tmp_path / "a.yaml", "--imu", "0,0,1")
    assert told.returncode == 0


def test_nothing_is_written_over_what_is_there(run: Run, result: Path, tmp_path: Path) -> None:
    beside = tmp_path / "a.yaml"
    beside.write_text("mine")
    arguments = ["export", result, "--to", "gtsam", "--out", tmp_path / "a.gtsam"]

    refused = run(*arguments)

    assert refused.returncode == 2
    assert f"{beside}: exists already" in refused.stderr
    assert not (tmp_path / "a.gtsam").exists()
    assert run(*arguments, "--force").returncode == 0
    assert yaml.safe_load(beside.read_text())["schema"] == "caliv-graph/gtsam/1"
