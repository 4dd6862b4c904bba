"""Validation of a drive without motion data: S2S is seen, and what all LiDARs share is not."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from typer.testing import CliRunner

from caliv_graph.cli.main import app
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import dump_config
from caliv_graph.conventions import AXES
from caliv_graph.errors import ConfigError, TrajectoryError
from caliv_graph.products import Array, Calibration, LidarResult
from caliv_graph.results.calibration_file import write_calibration
from caliv_graph.trajectory.select import GivenTrajectory
from caliv_graph.validation.findings import AFTER, BEFORE, WITHOUT, Validation
from caliv_graph.validation.held_out import HeldOutOutcome
from caliv_graph.validation.lidars_alone import way_of
from caliv_graph.validation.validate import validate
from tests.odometry.room_drive import s_curve
from tests.odometry.test_run import TRUTH, config_of, room
from tests.samples import make_calibration

ELSEWHERE = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, -0.03, 0.4), np.array([0.8, -0.5, 0.3]))
"""Of a whole vehicle frame: no error of S2S."""


def calibration(b_turned_rad: float = 0.0) -> Calibration:
    """The truth about another vehicle frame, and one LiDAR turned against the other."""
    cov = np.diag([3e-4**2] * 3 + [2e-3**2] * 3)
    turned = {"a": 0.0, "b": b_turned_rad}
    lidars = {
        name: LidarResult(
            ELSEWHERE.compose(T).retract(np.array([0.0, 0.0, turned[name], 0.0, 0.0, 0.0])),
            cov,
            dict.fromkeys(AXES, True),
            scans_used=50,
            saw_target=True,
        )
        for name, T in TRUTH.items()
    }
    both: Array = np.asarray(np.kron(np.eye(2), cov), np.float64)
    return replace(
        make_calibration(),
        lidars=lidars,
        reference="a",
        cov_joint=both,
        undetermined=(),
        weak=(),
    )


@pytest.fixture(scope="module", autouse=True)
def few_points() -> Iterator[None]:
    """Walls are clear with fewer points than are worth having."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr("caliv_graph.validation.clouds.POINTS", 300)
        yield


@pytest.fixture(scope="module")
def found() -> Validation:
    """Stamps of their own; the calibration is right in S2S alone."""
    drive = room(5.5, phase_s={"b": 0.05})
    return validate(drive, calibration(), config_of(), SilentProgress())


def test_places_of_lidars_to_each_other_are_validated(found: Validation) -> None:
    assert found.verdict.word == "good"
    held = found.held_out
    assert held is not None
    assert len(held.tested) > 15
    # Guesses are off by centimetres, and the truth is known to a millimetre.
    assert held.distance_m[AFTER] < 0.003 < 0.03 < held.distance_m[BEFORE]
    for stage in (AFTER, WITHOUT):
        test = held.tests[stage]
        assert test.p_value is not None
        assert test.p_value > 1e-3
        assert 1e-3 < test.expected_m < 0.01
    (pair,) = found.pairs
    assert pair.surfaces >= 3
    assert pair.distance_m[AFTER] < 0.003 < 0.03 < pair.distance_m[BEFORE]
    assert 1e-3 < pair.expected_m < 0.01
    for name in ("a", "b"):
        assert found.alone_m[AFTER][name] == pytest.approx(found.expected_alone_m[name], rel=0.3)


def test_it_says_that_it_does_not_see_the_vehicle(found: Validation) -> None:
    assert "odometry of lidar 'a'" in found.unseen
    assert "all six axes of S2V" in found.unseen


def test_a_lidar_that_is_turned_is_contradicted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Stamps in common.
    monkeypatch.setattr("caliv_graph.readers.open_recording", lambda *_: room(5.5))
    wrong, config = tmp_path / "wrong.yaml", tmp_path / "config.yaml"
    write_calibration(calibration(b_turned_rad=6e-3), wrong)
    config.write_text(dump_config(config_of()))
    out = tmp_path / "out"
    shown = CliRunner().invoke(app, ["validate", str(wrong), str(config), "--out", str(out)])

    assert shown.exit_code == 4
    assert "They do not explain it" in shown.stderr
    first = " ".join(shown.stdout[shown.stdout.index("Verdict:") :].split())
    assert first.startswith("Verdict: contradicted. No motion data: the clouds lie along the odom")
    assert "not tested: without motion data no target is used" in " ".join(shown.stdout.split())
    document = json.loads((out / "validation.json").read_text())
    assert "all six axes of S2V" in document["unseen"]
    assert document["held_out"]["tests"]["without"]["p_value"] > 1e-3
    page = (out / "validation.html").read_text()
    assert "all six axes of S2V" in page
    # A paragraph each, of walls and of what was held out: on a telephone nobody finds one sentence
    # among ten.
    said = re.findall(r"<p>(.*?)</p>", page)
    assert sum("They do not explain it" in sentence for sentence in said) == 2


def test_what_calibrate_refuses_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"set structure\.use: true"):
        validate(
            room(),
            calibration(),
            config_of(structure={"use": False}),
            SilentProgress(),
        )


def test_without_structure_to_solve_it_says_what_to_do() -> None:
    nothing = HeldOutOutcome(None, ("No third: too little of it stands still.",))
    way: GivenTrajectory = s_curve(2.0)
    with pytest.raises(TrajectoryError, match=r"room: .* too little .* --data a longer drive"):
        way_of("room", ("a", "b"), way, nothing)
