"""The matrix of targets and LiDARs: its scenarios, what counts as done, and its tables by hand."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caliv_graph.conventions import AXES
from caliv_graph.errors import TargetError
from caliv_graph.results.run import CalibrationRun
from caliv_graph.scenario.drive_models import ArcDrive
from caliv_graph.scenario.model import SuspensionModel, load_scenario
from caliv_graph.scenario.shapes import object_mesh
from scripts import _targets as targets
from scripts import benchmark_targets as benchmark
from scripts._targets import DRIVES, LIDARS, OBJECTS, Result, Task
from tests.scan_rates import scanned_at

BIN = Task("bin", "spin32", "figure_eight", 1)


@pytest.fixture
def short_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drives of 5 seconds with a cloud a second."""

    def short(name: str) -> Any:
        whole = scanned_at(load_scenario(targets.SCENARIOS / f"{name}.yaml"), 1.0)
        still = SuspensionModel(height_sigma_m=0.0, heave_sigma_m=0.0)
        drive = ArcDrive(duration_s=5.0)
        return whole.model_copy(update={"drive": drive, "suspension": still})

    monkeypatch.setattr(targets, "_drive", short)


def raises(error: Exception) -> Any:
    def work(*_: object) -> CalibrationRun:
        raise error

    return work


# ------------------------------------------------------------------ scenarios


@pytest.mark.parametrize("name", OBJECTS)
def test_every_object_is_within_the_box_whose_beams_are_cast(name: str) -> None:
    vertices = object_mesh(OBJECTS[name](xy_m=(0.0, 0.0))).vertices
    half_x, half_y, height = 0.5 * targets.ENVELOPE_M[0], 0.5 * targets.ENVELOPE_M[1], 1.3
    assert targets.ENVELOPE_M[2] == height
    assert (np.abs(vertices) <= [half_x, half_y, height]).all()


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("lidar", LIDARS)
def test_a_cell_is_the_drive_with_another_target_and_other_beams(drive: str, lidar: str) -> None:
    own = load_scenario(targets.SCENARIOS / f"{drive}.yaml")
    scenario = targets.scenario_of(Task("stroller", lidar, drive, 1, range_sigma_m=0.02))

    assert scenario.drive == own.drive
    (target,) = scenario.world.targets
    placed = scenario.world.objects[target]
    assert placed.shape == "stroller"
    assert placed.xy_m == own.world.objects["chair"].xy_m
    assert set(scenario.world.objects) - {target} == set(own.world.objects) - {"chair"}
    for name, model in scenario.lidars.items():
        assert model.range_sigma_m == 0.02
        assert model.mounting.xyz == own.lidars[name].mounting.xyz
        low, high = model.horizontal_fov_deg
        assert high - low == (120.0 if lidar == "wide" else 360.0)


@pytest.mark.parametrize("lidar", ["spin16", "wide"])
def test_beams_of_the_box_give_every_point_of_an_object(
    lidar: str, short_drives: None, tmp_path: Path
) -> None:
    thinned = targets.recording_of(Task("bicycle", lidar, "s_curve", 1), tmp_path)
    whole = targets.recording_of(Task("bicycle", lidar, "s_curve", 1, whole=True), tmp_path)
    target = whole.world.names.index(targets.TARGET)
    seen = 0
    for name in whole.lidars:
        taken = {s.scan.stamp_ns: s for s in whole.scans_with_truth(name)}
        for few in thinned.scans_with_truth(name):
            on_target = int(np.count_nonzero(few.objects == target))
            assert on_target == np.count_nonzero(taken[few.scan.stamp_ns].objects == target)
            seen += on_target
    assert seen > 50


# ------------------------------------------------------------------ runs


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (TargetError("no target found"), 2, "no target found"),
        (ValueError("of the program"), 1, "ValueError: of the program"),
    ],
)
def test_a_failed_calibration_is_a_result(error: Exception, code: int, said: str) -> None:
    result = targets.judged(raises(error), lambda _: {})

    assert (result.exit, result.failure) == (code, said)
    assert result.quantities == {}


def test_a_second_start_runs_what_is_missing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ran: list[Task] = []

    def run(task: Task, beams: Path) -> Result:
        ran.append(task)
        if task.seed == 2:
            raise MemoryError
        return Result(2, "no target found", seconds={"total": 1.0})

    monkeypatch.setattr(benchmark, "run", run)
    monkeypatch.setattr(benchmark, "selection_of", lambda *_: None)
    out = tmp_path / "results.json"
    asked = ["--objects", "bin", "--lidars", "spin32", "--drives", "s_curve", "--out", str(out)]

    assert benchmark.main([*asked, "--seeds", "2"]) == 1
    assert [task.seed for task in ran] == [1, 2]
    with out.open("a") as file:
        file.write('{"object": "bi')
    ran.clear()
    assert benchmark.main([*asked, "--first-seed", "2", "--seeds", "2"]) == 1
    assert [task.seed for task in ran] == [3]
    ran.clear()
    # Another noise is another run, and so is another version of the program.
    assert benchmark.main([*asked, "--seeds", "1", "--range-sigma", "0.02"]) == 0
    assert len(ran) == 1
    monkeypatch.setattr(benchmark, "code_digest", lambda: "another")
    assert benchmark.read(out) == {}
    assert len(benchmark.read(out, any_version=True)) == 4
    assert "seed 1, exit 2: no target found" in capsys.readouterr().out


def test_without_the_data_it_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(targets, "DATA", tmp_path)

    assert benchmark.main(["--released", "--edgar"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line]
    assert len(lines) == 3
    assert all(": skipped: " in line for line in lines)


@pytest.mark.parametrize("bad", [["--seeds", "0"], ["--objects", "sofa"], ["--range-sigma", "0"]])
def test_bad_arguments_are_refused(bad: list[str]) -> None:
    with pytest.raises(SystemExit) as refused:
        benchmark.main(bad)
    assert refused.value.code == 2


def test_the_reference_of_edgar_turns_as_its_readme_says() -> None:
    T = targets.EDGAR_REFERENCE
    np.testing.assert_allclose(T.rotation().rpy(), [0.7001, -0.0065, 0.0222], atol=1e-12)
    # A point of the second LiDAR, straight below it by 1 m, in the first one.
    point = T.transformFrom(np.array([0.0, 0.0, -1.0]))
    assert point[1] == pytest.approx(-1.231 + np.sin(0.7), abs=0.01)


# ------------------------------------------------------------------ tables


def line(seed: int, x_mm: float, **changes: Any) -> dict[str, Any]:
    """A run with an error in x, sigmas of 1 mm and 1 mrad."""
    error = [0.5e-3] * 6
    error[AXES.index("x")] = 1e-3 * x_mm
    errors: Mapping[str, Any] = {
        "error": error,
        "sigma": [1e-3] * 6,
        "determined": [axis != "yaw" for axis in AXES],
        "nees": 6.0,
    }
    return {
        "seed": seed,
        "exit": 0,
        "failure": "",
        "status": "ok",
        "contradictions": [],
        "undetermined": [],
        "quantities": {"S2V front": errors, "S2S front to rear": errors},
        "scale": 1.0,
        "clouds": {"front": 40, "rear": 30},
        "points": 55.0,
        "seconds": {"total": 12.0},
        **changes,
    }


def row(text: str, label: str) -> list[str]:
    return next(r for r in text.splitlines() if r.strip().startswith(label)).split()


def test_table_of_a_cell_is_as_by_hand() -> None:
    lines = {Task("bin", "wide", "s_curve", n): line(n, 0.0 if n % 2 else 2.0) for n in range(20)}
    text = benchmark.summary(lines)

    # Ten of 0 and ten of 2 mm: a mean of 1 mm, a spread of sqrt(20 / 19) mm.
    error = row(text, "mean error ")
    assert error[2:] == ["1.00", "0.50", "0.50", "0.500", "0.500", "-"]
    assert row(text, "in its standard errors")[4] == f"{np.sqrt(19.0):.2f}"
    assert row(text, "mean error / sigma")[4:6] == ["1.00!", "0.50"]
    # RMSE sqrt(2) in x, 0.5 elsewhere: both outside 0.8 to 1.25.
    assert row(text, "RMSE / sigma")[3:5] == ["1.41!", "0.50!"]
    assert row(text, "NEES")[1] == "6.0"
    assert "clouds: front 40, rear 30, of 55 points (median)" in text
    last = text.splitlines()[-1].split()
    assert last[:3] == ["bin", "wide", "s_curve"]
    assert "1.00!" in last
    assert last[-3:] == ["70", "55", "12.0"]


def test_errors_over_sigmas_are_pooled_over_cells() -> None:
    # Ten of two LiDARs each, 0 and 2 mm at 1 mm: 20 of the bin, 10 of a LiDAR, which is not judged.
    lines = {
        Task("bin", lidar, "s_curve", n): line(n, 0.0 if n % 2 else 2.0)
        for lidar in ("spin16", "wide")
        for n in range(10)
    }
    text = benchmark.summary(lines)
    of_bin = text[text.index("pooled over cells") :].split("bin ")[1].splitlines()

    assert " ".join(of_bin[0].split()) == "S2V front mean 20 1.00! 0.50 0.50 0.50 0.50 - 6.0"
    assert " ".join(of_bin[1].split()) == "RMS 1.41! 0.50! 0.50! 0.50! 0.50! -"
    assert "S2V front   mean    10    1.00    0.50" in text


def test_with_apart_no_two_cells_share_a_seed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ran: list[Task] = []
    monkeypatch.setattr(benchmark, "run_missing", lambda tasks, *_, **__: ran.extend(tasks))
    for some in ([], ["--objects", "bin", "--lidars", "wide"]):
        benchmark.main(["--apart", "--seeds", "3", "--out", str(tmp_path / "none"), *some])
    seeds = {task.seed for task in ran}

    assert len(seeds) == 3 * len(OBJECTS) * len(LIDARS) * len(DRIVES)
    # A part of the matrix has the seeds that it has in the whole.
    assert len(set(ran)) == len(seeds)


def test_few_runs_are_not_judged_but_their_scale_is() -> None:
    few = {BIN: line(1, 9.0, scale=5.0)}
    text = benchmark.summary(few)

    assert row(text, "mean error / sigma")[4] == "9.00"
    assert "registration_scale 5.00!" in text


def test_failures_are_counted_and_explained() -> None:
    lines = {
        BIN: line(1, 1.0),
        Task("bin", "spin32", "figure_eight", 2): {
            **line(2, 0.0, exit=2, failure="no target found"),
            **{"quantities": {}, "scale": None, "points": None, "clouds": {}},
        },
        Task("bin", "spin32", "figure_eight", 3): line(
            3, 1.0, exit=4, status="inconsistent", contradictions=["two LiDARs disagree"]
        ),
    }
    text = benchmark.summary(lines)

    assert "3 runs, exit 0: 1x, 2: 1x, 4: 1x" in text
    assert "seed 2, exit 2: no target found" in text
    assert "seed 3, exit 4: two LiDARs disagree" in text
    assert benchmark.summary({}) == "no runs yet"


def test_lines_of_the_file_are_what_the_tables_read(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    content = line(1, 1.0)
    result = Result(**{key: value for key, value in content.items() if key != "seed"})
    monkeypatch.setattr(benchmark, "run", lambda task, beams: result)
    monkeypatch.setattr(benchmark, "selection_of", lambda *_: None)
    out = tmp_path / "results.json"
    benchmark.run_missing([BIN], out, 1)

    assert json.loads(out.read_text())["object"] == "bin"
    assert benchmark.summary(benchmark.read(out)) == benchmark.summary({BIN: content})


def test_table_of_a_recorded_drive_marks_three_sigmas() -> None:
    content = line(1, 4.0)
    result = Result(**{key: value for key, value in content.items() if key != "seed"})
    text = "\n".join(benchmark.recorded_table("a drive", result))

    assert row(text, "error / sigma")[3:5] == ["4.00!", "0.50"]
    failed = Result(2, "no target found")
    assert list(benchmark.recorded_table("a drive", failed)) == [
        "\na drive: exit 2, no target found"
    ]
