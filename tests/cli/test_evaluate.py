from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner, Result

from caliv_graph.cli.main import app
from caliv_graph.errors import ConfigError
from caliv_graph.results.calibration_file import write_calibration
from tests.samples import make_calibration


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    path = tmp_path / "calibration.yaml"
    write_calibration(make_calibration(), path)
    return path


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    """The front LiDAR is 10 mm further left than it was found, the rear where it was found."""
    # Nose down by 10 degrees; the rear LiDAR turned by 180 besides.
    sin, cos = math.sin(math.radians(5.0)), math.cos(math.radians(5.0))
    extrinsics = {
        "front": {"translation": [2.0, 0.01, 2.0], "quaternion_xyzw": [0.0, sin, 0.0, cos]},
        "rear": {"translation": [-0.4, 0.0, 2.0], "quaternion_xyzw": [-sin, 0.0, cos, 0.0]},
    }
    path = tmp_path / "truth.yaml"
    lidars = {name: {"T_vehicle_lidar": pose} for name, pose in extrinsics.items()}
    path.write_text(yaml.safe_dump({"lidars": lidars}))
    return path


def evaluate(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["evaluate", *map(str, arguments)])


def test_json_of_the_specification(calibration: Path, truth: Path) -> None:
    result = evaluate(calibration, truth, "--json")

    assert (result.exit_code, result.stderr) == (0, "")
    document = json.loads(result.stdout)
    front = document["lidars"]["front"]["s2v"]
    assert front["translation_m"] == pytest.approx([0.0, -0.01, 0.0], abs=1e-9)
    assert front["rotation_rad"] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)
    assert front["nees"] > 0.0
    (pair,) = document["pairs"]
    assert set(pair) == {"from", "to", "translation_m", "rotation_rad", "nees"}
    assert (pair["from"], pair["to"]) == ("front", "rear")
    assert pair["translation_m"] == pytest.approx([0.0, -0.01, 0.0], abs=1e-9)


def test_table_in_millimetres(calibration: Path, truth: Path) -> None:
    result = evaluate(calibration, truth)

    assert result.exit_code == 0
    row = next(line for line in result.stdout.splitlines() if line.startswith("S2V front"))
    assert row.split()[2:5] == ["(0.00)", "-10.00", "0.00"]


def test_a_calibration_against_another(calibration: Path) -> None:
    document = json.loads(evaluate(calibration, calibration, "--json").stdout)

    assert document["pairs"][0]["nees"] == pytest.approx(0.0, abs=1e-12)


def test_lidars_without_truth_are_left_out_and_named(calibration: Path, truth: Path) -> None:
    document = yaml.safe_load(truth.read_text())
    del document["lidars"]["front"]
    truth.write_text(yaml.safe_dump(document))

    result = evaluate(calibration, truth, "--json")

    assert result.exit_code == 0
    assert list(json.loads(result.stdout)["lidars"]) == ["rear"]
    assert result.stderr == f"warning: {truth}: has no LiDAR 'front': left out\n"


def test_no_lidar_in_common(calibration: Path, truth: Path) -> None:
    truth.write_text(truth.read_text().replace("front", "L1").replace("rear", "L2"))

    result = evaluate(calibration, truth)

    assert isinstance(result.exception, ConfigError)
    assert str(result.exception) == (
        f"{truth}: has none of the LiDARs of {calibration} (front, rear), but L1, L2. Give them "
        "the same names"
    )
