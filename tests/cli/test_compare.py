from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner, Result

from caliv_graph.cli.main import app
from caliv_graph.errors import ConfigError
from caliv_graph.results.calibration_file import write_calibration
from tests.fusion.drives import arc_information, drive, information, shift

NAMES = ("front", "rear")


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """Between the two, the front LiDAR has been turned by half a degree."""
    D = information(NAMES)
    paths = tmp_path / "before.yaml", tmp_path / "after.yaml"
    turned = shift(NAMES, "front", pitch=math.radians(0.5))
    write_calibration(drive(D, source="a"), paths[0])
    write_calibration(drive(D, source="b", error=turned), paths[1])
    return paths


def compare(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["compare", *map(str, arguments)])


def test_json(files: tuple[Path, Path]) -> None:
    result = compare(*files, "--json")

    assert (result.exit_code, result.stderr) == (0, "")
    document = json.loads(result.stdout)
    assert document["moved"] is True
    assert document["conclusion"] == "LiDAR 'front' has moved."
    front = document["lidars"]["front"]["s2v"]
    assert front["rotation_rad"] == pytest.approx([0.0, math.radians(0.5), 0.0], abs=1e-9)
    assert front["translation_m"] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)
    assert all(0.0 < sigma < 5e-3 for sigma in front["sigma_rotation_rad"])
    assert (front["dof"], front["moved"]) == (6, True)
    assert min(front["p_value"], *front["p_rotation"]) < front["p_corrected"] < 0.01
    assert document["lidars"]["rear"]["s2v"]["moved"] is False
    (pair,) = document["pairs"]
    assert (pair["from"], pair["to"], pair["moved"]) == ("front", "rear", True)
    assert document["joint"]["dof"] == 12
    # Three movements, each as a whole and along six axes.
    assert document["tests"] == 21
    assert front["p_rotation"][1] < 1e-4 < front["p_translation"][0]


def test_axes_that_a_drive_does_not_determine_are_null(tmp_path: Path) -> None:
    D = arc_information(NAMES)
    paths = tmp_path / "a.yaml", tmp_path / "b.yaml"
    for path, source in zip(paths, "ab", strict=True):
        write_calibration(drive(D, source=source, guess_error=np.full(12, 0.01)), path)

    document = json.loads(compare(*paths, "--json").stdout)

    front = document["lidars"]["front"]["s2v"]
    assert front["rotation_rad"][2] is None
    assert front["sigma_rotation_rad"][2] is None
    assert front["translation_m"][0] is None
    assert front["determined"]["yaw"] is False
    assert front["dof"] == 5
    assert "turn centre" in document["undetermined"]["first"][0]
    table = compare(*paths).stdout
    assert "not determined by both calibrations" in table
    assert "turn centre" in table


def test_table(files: tuple[Path, Path]) -> None:
    result = compare(*files)

    assert (result.exit_code, result.stderr) == (0, "")
    assert "LiDAR 'front' has moved." in result.stdout
    row = next(line for line in result.stdout.splitlines() if line.startswith("S2V front"))
    assert row.rstrip().endswith("yes")
    assert f"{1e3 * math.radians(0.5):.1f}" in row


def test_a_looser_limit_finds_more(files: tuple[Path, Path]) -> None:
    document = json.loads(compare(*files, "--p-value", "1e-12", "--json").stdout)

    assert document["p_value_limit"] == 1e-12
    assert document["moved"] is (document["pairs"][0]["p_corrected"] < 1e-12)


def test_a_file_of_another_program(files: tuple[Path, Path]) -> None:
    """Only the required keys of calibration.yaml."""
    for path in files:
        document = yaml.safe_load(path.read_text())
        for lidar in document["lidars"].values():
            del lidar["guess"], lidar["saw_target"], lidar["scans_used"]
        del document["joint"]["data_gradient"], document["provenance"]
        path.write_text(yaml.safe_dump(document))

    document = json.loads(compare(*files, "--json").stdout)

    assert document["conclusion"] == "LiDAR 'front' has moved."


def test_two_results_of_one_drive(files: tuple[Path, Path]) -> None:
    result = compare(files[0], files[0])

    assert (result.exit_code, result.stderr) == (0, "")
    assert "results of one drive, and they agree" in " ".join(result.stdout.split())
    assert len(json.loads(compare(files[0], files[0], "--json").stdout)["shared_data"]) == 1


def test_what_cannot_be_compared(files: tuple[Path, Path], tmp_path: Path) -> None:
    files[1].write_text(files[1].read_text().replace("data_gradient: [", "data_gradient: [7.0, "))
    refused = compare(*files)
    assert isinstance(refused.exception, ConfigError)
    assert str(refused.exception) == (
        f"{files[1]}: 'joint.data_gradient': must be 12 numbers, has 13. Give a calibration.yaml "
        "as 'caliv-graph calibrate' wrote it, unchanged"
    )
