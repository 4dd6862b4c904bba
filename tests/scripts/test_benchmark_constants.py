"""Every constant of the table can be changed, a change has an effect, and the effect is by hand."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration import robust
from caliv_graph.conventions import AXES
from caliv_graph.scenario.model import load_scenario
from caliv_graph.uncertainty import consistency
from scripts import _constants_drives as drives
from scripts import benchmark_constants as benchmark
from scripts._constants_table import CONFIG, CONSTANTS
from scripts._patched import PACKAGE, Place, UnreachableError, current, patched
from tests.kept import KeptDrive
from tests.scan_rates import scanned_at

SMALL: Mapping[str, Mapping[str, Any]] = {
    "registration": {"components": 60, "max_points": 120, "max_iterations": 20},
    "extraction": {"max_scans": 12},
    "structure": {"use": False},
}
"""A calibration of a second: millimetres do not count here."""

COPY = Place("caliv_graph.calibration.check", "FAR_OFF")
"""What `from robust import FAR_OFF` makes there."""


# ------------------------------------------------------------------ changes


def test_every_constant_of_the_table_can_be_changed() -> None:
    benchmark.check(CONSTANTS)

    assert len({constant.name for constant in CONSTANTS}) == len(CONSTANTS)
    for constant in CONSTANTS:
        assert (PACKAGE / constant.file).exists()
        assert {drive for drive, _ in constant.drives} <= set(drives.DRIVES)


def test_a_change_reaches_copies_and_what_follows_and_ends() -> None:
    before = robust.FAR_OFF, consistency.CONTRADICTION_P, consistency.MIN_HEADING_RAD
    with patched("caliv_graph.calibration.robust", "FAR_OFF", 9.0) as changed:
        assert robust.FAR_OFF == current(COPY.module, COPY.name) == 9.0
    assert COPY in changed
    with patched("caliv_graph.uncertainty.consistency", "CONTRADICTION_SIGMAS", 1.0):
        # Two-sided probability of one sigma.
        assert pytest.approx(0.3173, abs=1e-4) == consistency.CONTRADICTION_P
    with patched("caliv_graph.uncertainty.consistency", "CRAB_RAD", 0.5):
        assert consistency.MIN_HEADING_RAD == 1.0
    assert before == (robust.FAR_OFF, consistency.CONTRADICTION_P, consistency.MIN_HEADING_RAD)
    assert before[0] == current(COPY.module, COPY.name)


def test_what_cannot_be_changed_is_an_error() -> None:
    with (
        pytest.raises(UnreachableError, match="no attribute 'GONE'"),
        patched("caliv_graph.calibration.robust", "GONE", 1.0),
    ):
        pass
    # A default of the planner's dataclass took it at import.
    module, name = "caliv_graph.calibration.problem", "HEAVE_SIGMA_M"
    with pytest.raises(UnreachableError, match="class Assumptions"), patched(module, name, 1.0):
        pass
    with patched(module, name, 1.0, ("caliv_graph.planning", "caliv_graph.validation")):
        assert current("caliv_graph.planning.assumptions", name) == 0.005
    with (
        pytest.raises(UnreachableError, match="read by no function"),
        patched("caliv_graph.calibration.robust", "__doc__", ""),
    ):
        pass


# ------------------------------------------------------------------ effects


def line(x_m: float, yaw_rad: float = 0.0, **changes: Any) -> dict[str, Any]:
    """A run whose front LiDAR is off by so much, its rear LiDAR exact."""
    front = gtsam.Pose3(gtsam.Rot3.Yaw(yaw_rad), np.array([2.0 + x_m, 0.0, 0.0]))
    sigma, determined = [1e-3] * 3 + [2e-3] * 3, [axis != "z" for axis in AXES]
    error = [0.0, 0.0, yaw_rad, x_m, 0.0, 9.0]
    stated = {"error": error, "sigma": sigma, "determined": determined, "nees": 4.0}
    still = {**stated, "error": [0.0] * 6, "nees": None}
    whole = {
        "failure": "",
        "status": "ok",
        "down": 3,
        "poses": {
            "front": front.matrix().ravel().tolist(),
            "rear": gtsam.Pose3().matrix().ravel().tolist(),
        },
        "quantities": {"S2V front": stated, "S2V rear": still, "S2S front to rear": stated},
    }
    return {**whole, **changes}


def test_an_effect_is_as_by_hand() -> None:
    found = benchmark.effect(
        [line(0.001), line(0.001)], [line(0.004, 0.002), line(0.001, status="partial")]
    )

    assert found.s2s == pytest.approx((3.0, 2.0))
    assert found.s2s_sigmas == pytest.approx((1.5, 2.0))
    assert found.s2v == pytest.approx((3.0, 2.0))
    assert found.sigma == 1.0
    # x of two runs, and y, which is exact; z is not determined.
    assert found.error_s2s[0] == pytest.approx(math.sqrt((16.0 + 1.0) / 4.0))
    assert found.error_s2s[1] == pytest.approx(math.sqrt(4.0 / 6.0))
    assert (found.nees_s2s, found.nees_s2v) == (4.0, 4.0)
    assert found.said == {"ok": 1, "partial": 1}
    assert not found.same
    assert benchmark.effect([line(0.001)], [line(0.001)]).same


def test_a_failure_is_counted_and_compared_with_nothing() -> None:
    failed = {"failure": "no LiDAR sees the target"}
    found = benchmark.effect([line(0.0), line(0.0)], [line(0.001), failed])

    assert (found.runs, found.failures) == (2, 1)
    assert found.s2s[0] == pytest.approx(1.0)
    assert found.said == {"ok": 1, "failed": 1}


def test_a_constant_changes_a_drive(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    scenario = load_scenario(drives.SCENARIOS / "demo_arc.yaml")
    # Few clouds are enough for a change: `SMALL` takes 12 of each LiDAR.
    # Of seeds 1 and 6 the noise of the poses, fitted to so few clouds, leaves none with a weight.
    recording = KeptDrive(scanned_at(scenario, 1.25), 3)
    monkeypatch.setattr(drives, "_recording", lambda *_: recording)

    own = drives.performed("given", 3, tmp_path, SMALL, early=False)
    with patched("caliv_graph.registration.quadratic", "NORMAL_SIGMA_RAD", 0.8):
        other = drives.performed("given", 3, tmp_path, SMALL, early=False)

    found = benchmark.effect([own], [other])
    assert not found.same
    assert found.s2s[0] > 0.05


# ------------------------------------------------------------------ files


@pytest.fixture
def done(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Values that were run with; runs themselves are made up."""
    values: list[str] = []

    def run(
        drive: str,
        seed: int,
        beams: Path,
        settings: Mapping[str, Mapping[str, Any]],
        early: bool = True,
    ) -> dict[str, Any]:
        values.append(f"{drive} {seed} {robust.FAR_OFF:g} {dict(settings)}")
        return line(0.001 * len(values), seconds=1.0)

    monkeypatch.setattr(benchmark, "performed", run)
    return values


def test_a_second_start_does_what_is_missing(
    tmp_path: Path, done: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["--only", "robust.FAR_OFF", "config.robust.huber_k", "--out", str(tmp_path)]
    assert benchmark.main([*asked, "--seeds", "1"]) == 0
    # One run as it is serves both constants; every constant has its own value again after it.
    assert done == [
        "noisy 1 54 {}",
        "noisy 1 27 {}",
        "noisy 1 108 {}",
        "noisy 1 54 {'robust': {'huber_k': 0.75}}",
        "noisy 1 54 {'robust': {'huber_k': 3.0}}",
        "staged 1 54 {}",
        "staged 1 27 {}",
        "staged 1 108 {}",
    ]
    told = capsys.readouterr().out
    assert "| `robust.FAR_OFF` | calibration/robust.py | 54 |" in told
    # The third run of noisy moved by 2 mm, one sigma; nothing else did.
    assert "| `robust.FAR_OFF` | 108 | 1 | 2 (1) | 0 (0) | 2 (1) | 0 (0) | 1.00 | 2.12" in told
    rows = json.loads((tmp_path / "constants.json").read_text())["rows"]
    assert {row["drive"] for row in rows} == {"noisy", "staged"}

    (tmp_path / "runs.jsonl").open("a").write('{"half a line')
    assert benchmark.main([*asked, "--summary"]) == 0
    assert len(done) == 8
    assert benchmark.main([*asked, "--seeds", "2"]) == 0
    assert len(done) == 16


def test_an_unknown_constant_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        benchmark.main(["--only", "robust.GONE"])
    assert "no constant robust.GONE; there are surfels." in capsys.readouterr().err


def test_a_setting_of_the_config_is_its_default() -> None:
    settings = {c.name: c for c in CONSTANTS if c.module == CONFIG}
    assert settings["config.robust.huber_k"].value() == 1.5
    assert settings["config.registration.components"].value() == 1000
