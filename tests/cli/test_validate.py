"""`validate` at the command line."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner, Result

from caliv_graph.cli.main import app, run
from caliv_graph.results.calibration_file import write_calibration
from caliv_graph.simulation.caliv_folder import write_ego_poses, write_pcd
from tests.drives_with_chair import Memory
from tests.validation.scenes import FRAME_NS, GUESSES, Scene, calibration_of, make_recording
from tests.validation.test_validate import WRONG


def validate(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["validate", *map(str, arguments)])


def write_scene(folder: Path, recording: Memory, names: dict[str, str] | None = None) -> Path:
    """A CaLiV folder of a recording, and a config beside it."""
    poses = {}
    for number, scans in enumerate(recording.clouds.values(), start=1):
        sensor = folder / "drive" / "input" / f"sensor_{number}"
        sensor.mkdir(parents=True)
        frames = [scan.stamp_ns // FRAME_NS for scan in scans]
        for frame, scan in zip(frames, scans, strict=True):
            # A folder's frames are 0.1 s apart.
            write_pcd(sensor / f"{2 * frame}.pcd", scan.points_lidar)
        poses[sensor.name] = [(2 * f, recording.poses.T_map_vehicle[f]) for f in frames]
    write_ego_poses(folder / "drive" / "input" / "ego_poses.yaml", poses)
    config = {
        "data": {"format": "caliv", "path": "drive"},
        "lidars": {
            (names or {}).get(name, name): {
                "topic": f"sensor_{i}",
                "initial": {"xyz": list(xyz), "rpy_deg": list(rpy)},
            }
            for i, (name, (xyz, rpy)) in enumerate(GUESSES.items(), start=1)
        },
        "target": {"min": [-1, -10, 0], "max": [1, -8, 2]},
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    return folder


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive with its config, a right and a wrong calibration."""
    folder = write_scene(tmp_path_factory.mktemp("drive"), make_recording())
    write_calibration(calibration_of(), folder / "right.yaml")
    write_calibration(calibration_of(WRONG), folder / "wrong.yaml")
    return folder


@pytest.fixture(scope="module")
def right(drive: Path) -> tuple[Result, Path]:
    """What was said of the right calibration, and the folder that was written."""
    out = drive / "out"
    arguments = (drive / "right.yaml", drive / "config.yaml", "--out", out, "--no-repeat")
    return validate(*arguments, "--json"), out


def test_a_right_calibration(drive: Path, right: tuple[Result, Path]) -> None:
    result, out = right
    assert (result.exit_code, result.stderr) == (0, "")
    document = json.loads(result.stdout)
    assert document == json.loads((out / "validation.json").read_text())
    assert document["verdict"] == "good"
    assert document["test"]["better"] > 30.0
    assert document["test"]["contradicts"] is False
    assert document["repeatability"] is None
    (pair,) = document["pairs"]
    assert (pair["from"], pair["to"], pair["surfaces"]) == ("front", "rear", 3)
    assert pair["distance_m"]["after"] < 0.01 < 0.1 < pair["distance_m"]["before"]
    assert [s["name"] for s in document["surfaces"]] == ["wall 1", "wall 2", "pole 1"]
    assert [o["name"] for o in document["objects"]] == ["object 1"]
    # Once more, there is something in the way.
    arguments = (drive / "right.yaml", drive / "config.yaml", "--out", out, "--no-repeat")
    again = validate(*arguments)
    assert again.exit_code == 1
    assert "exists already. Give --force" in str(again.exception)
    assert validate(*arguments, "--force").exit_code == 0


def test_the_page_is_whole_and_needs_no_network(right: tuple[Result, Path]) -> None:
    page = (right[1] / "validation.html").read_text()

    # What plotly itself holds of addresses is never fetched: the page forbids it.
    assert "default-src 'none'" in page
    assert not re.findall(r"<(?:script|link|img)[^>]+(?:src|href)=\"http", page)
    shown = set(re.findall(r'data-figure="([^"]+)"', page))
    assert shown == {"top", "wall-1", "wall-2", "pole-1", "object-1-top", "object-1-side"}
    for name in shown:
        text = re.search(f'id="data-{name}">(.*?)</script>', page, re.DOTALL)
        assert text is not None
        names = {trace["name"] for trace in json.loads(text[1])["data"]}
        assert names == {"front", "rear"}
    assert len(page) < 10e6


def test_a_wrong_calibration(drive: Path) -> None:
    result = validate(drive / "wrong.yaml", drive / "config.yaml", "--no-repeat")

    assert result.exit_code == 4
    assert re.match(r"warning: .*wrong\.yaml: .* They do not explain it", result.stderr)
    # Before the first table.
    _, first = result.stdout.split("Distance between LiDARs")[0].split("Verdict: ")
    assert first.startswith("contradicted. ")
    assert "not seen here: S2V" in " ".join(first.split())
    assert "Distance between LiDARs" in result.stdout
    assert "front alone" in result.stdout


def test_nothing_to_validate_on(tmp_path: Path) -> None:
    bare = make_recording(Scene(walls=False, pole=False, box=False))
    folder = write_scene(tmp_path, bare)
    write_calibration(calibration_of(), folder / "calibration.yaml")
    result = validate(
        folder / "calibration.yaml",
        folder / "config.yaml",
        "--json",
        "--no-repeat",
        "--out",
        tmp_path / "out",
    )

    assert result.exit_code == 3
    document = json.loads(result.stdout)
    assert document["structure"] is False
    assert document["verdict"] == "unclear"
    assert document["test"]["better"] is document["test"]["p_value"] is None
    assert document["thickness_m"]["merged"]["after"] is None
    assert result.stderr.startswith("warning: Nothing can be said: there is no wall")
    assert (tmp_path / "out" / "validation.html").exists()


def test_a_half_that_cannot_be_calibrated_is_said(drive: Path) -> None:
    # There is no target in this drive's region.
    result = validate(drive / "right.yaml", drive / "config.yaml", "--json")

    assert result.exit_code == 0
    repeated = json.loads(result.stdout)["repeatability"]
    assert repeated["agree"] is None
    assert "region" in repeated["not_done"]


def test_names_of_lidars_are_no_markup(tmp_path: Path) -> None:
    evil = "<script>alert(1)</script>"
    folder = write_scene(tmp_path, make_recording(), {"front": evil})
    calibration = calibration_of()
    lidars = {evil: calibration.lidars["front"], "rear": calibration.lidars["rear"]}
    write_calibration(replace(calibration, lidars=lidars), folder / "calibration.yaml")
    result = validate(
        folder / "calibration.yaml", folder / "config.yaml", "--no-repeat", "--out", folder / "out"
    )

    assert result.exit_code == 0
    assert evil in result.stdout
    page = (folder / "out" / "validation.html").read_text()
    assert evil not in page
    assert "&lt;script&gt;alert(1)" in page


def test_bad_input_is_one_line(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    strangers = tmp_path / "strangers.yaml"
    text = (drive / "config.yaml").read_text().replace("front:", "a:").replace("rear:", "b:")
    strangers.write_text(text.replace("path: drive", f"path: {drive / 'drive'}"))
    cases: list[tuple[list[object], str]] = [
        ([drive / "none.yaml", drive / "config.yaml"], r"none\.yaml: no such file"),
        ([drive / "right.yaml", drive / "right.yaml"], r"right\.yaml: unknown key "),
        ([drive / "right.yaml", strangers], r"none of the LiDARs .*\(front, rear\), but a, b"),
        (
            [drive / "right.yaml", drive / "config.yaml", "--data", tmp_path / "nowhere"],
            r"nowhere: no such",
        ),
    ]
    for arguments, message in cases:
        assert run(["validate", *map(str, arguments), "--json"]) == 2
        captured = capsys.readouterr()
        assert captured.out == ""
        assert re.fullmatch(rf"error: .*{message}.*\n", captured.err)
