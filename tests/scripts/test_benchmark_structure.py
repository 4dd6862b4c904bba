"""The benchmark of structure: its scenarios, what a run draws, its verdicts by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caliv_graph.scenario.world_models import WallModel
from caliv_graph.simulation.recording import simulate_drive
from scripts import benchmark_structure as benchmark
from scripts._structure_rows import CHAIR, ROWS, Row, WholeRecording, drawn, scenario_of


def a_line(seed: int, error_m: float, sigma_m: float, **changes: Any) -> dict[str, Any]:
    found = {
        "error": [1e-3 * error_m] * 3 + [error_m] * 3,
        "sigma": [1e-3 * sigma_m] * 3 + [sigma_m] * 3,
        "determined": [True] * 6,
        "nees": 6.0,
    }
    line = {
        "digest": benchmark.digest("yard"),
        "code": "a",
        "seed": seed,
        "failure": "",
        "exit": 0,
        "status": "ok",
        "undetermined": [],
        "seconds": {"total": 9.0},
        "cast_s": 4.0,
        "clouds": 300,
        "quantities": {"S2S front to rear": found},
    }
    return {**line, **changes}


@pytest.mark.parametrize("name", sorted(ROWS))
def test_rows_differ_from_the_shipped_scenario_as_they_say(name: str) -> None:
    row, scenario = ROWS[name], scenario_of(name)
    assert scenario.drive.kind == (row.drive or scenario.drive.kind)
    assert scenario.world.targets == ((CHAIR,) if row.chair else ())
    assert scenario.reference in scenario.lidars
    phases = [model.phase_s for model in scenario.lidars.values()]
    assert len(set(phases)) == (3 if row.lidars == "three" else 1)
    assert all(model.range_bias_sigma_m > 0.0 for model in scenario.lidars.values())


@pytest.mark.parametrize("name", [name for name, row in ROWS.items() if row.chair])
def test_both_lidars_see_the_chair_where_it_is_a_target(name: str) -> None:
    recording = WholeRecording(scenario_of(name), 1)
    chair = recording.world.names.index(CHAIR)
    for lidar in recording.lidars:
        stamps = recording.scan_stamps_ns(lidar)
        some = stamps[:: len(stamps) // 10]
        seen = [(s.objects == chair).sum() for s in recording.scans_with_truth(lidar, some)]
        assert max(seen) > 30, lidar


@pytest.mark.parametrize("name", ["yard", "yard_s", "yard_arc_chair", "street", "car_park"])
def test_nothing_stands_in_the_way(name: str) -> None:
    recording = simulate_drive(scenario_of(name), 1)
    stamps = np.array(recording.scan_stamps_ns(recording.lidars[0])[::5])
    xy = recording.truth.states(stamps).position_map[:, :2]
    for thing, mesh in recording.world.meshes.items():
        corners = mesh.vertices[:: max(len(mesh.vertices) // 500, 1), :2]
        gap_m = np.linalg.norm(corners[:, None] - xy, axis=2).min()
        assert thing == "ground" or gap_m > 2.5, thing


def test_a_run_draws_bumps_and_leaves_the_rest() -> None:
    scenario = scenario_of("yard")
    one, other = drawn(scenario, 1), drawn(scenario, 2)
    walls = [name for name, x in scenario.world.objects.items() if isinstance(x, WallModel)]
    assert len(walls) == 8
    seeds = [run.world.objects[name].seed for run in (one, other) for name in walls]  # type: ignore[union-attr]
    assert len(set(seeds)) == 16
    assert one.world.ground.bumps_seed != other.world.ground.bumps_seed
    rest = {"world": scenario.world}
    assert one.model_copy(update=rest) == other.model_copy(update=rest) == scenario
    for name in set(scenario.world.objects) - set(walls):
        assert one.world.objects[name] == scenario.world.objects[name]


def test_clouds_are_whole_and_cast_once() -> None:
    scenario = drawn(scenario_of("yard_stand"), 1)
    recording = WholeRecording(scenario, 1)
    whole = simulate_drive(scenario, 1)
    stamps = recording.scan_stamps_ns("left")
    assert stamps == whole.scan_stamps_ns("left")
    (cloud,) = recording.scans("left", {stamps[5]})
    (reference,) = whole.scans("left", {stamps[5]})
    # The noise has other draws, so a return at the limit of the range may differ.
    assert len(cloud.points_lidar) == pytest.approx(len(reference.points_lidar), abs=3)
    (again,) = recording.scans("left", {stamps[5]})
    assert again is cloud
    assert recording.clouds == 1
    assert recording.truth.range_bias_m == whole.truth.range_bias_m


def test_verdicts_name_what_is_missed() -> None:
    # RMSE of 0.1 mrad and 100 mm at sigmas of 0.1 mrad and 50 mm.
    lines = [a_line(seed, 0.1, 0.1) for seed in (1, 2)]
    for line in lines:
        line["quantities"]["S2S front to rear"]["sigma"][3:] = [0.05] * 3
    row = Row("", "yard", limits={"S2S": (200.0, 50.0, float("nan"), 0.2, 0.05, 0.1001)})
    head, rmse, ratio = benchmark.verdicts(row, lines)
    assert "exit codes [0]; simulation 4.0 s" in head
    assert "x 100 of 200, y 100 of 50 MISS, roll 0.1 of 0.2, pitch 0.1 of 0.05 MISS, yaw" in rmse
    assert not rmse.endswith("MISS")
    assert "x 2.00 MISS, y 2.00 MISS, z 2.00 MISS, roll 1.00, pitch 1.00, yaw 1.00" in ratio
    assert ratio.endswith("NEES 6.00")


def test_a_row_that_must_fail_counts_refusals() -> None:
    refused = a_line(1, 0.1, 0.1, failure="nothing", exit=2, quantities={})
    row = Row("", "field", must_fail=True)
    assert [*benchmark.verdicts(row, [refused])][-1].endswith("1 of 1")
    assert [*benchmark.verdicts(row, [refused, a_line(2, 0.1, 0.1)])][-1].endswith("1 of 2 MISS")


def test_a_second_start_does_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seeds: list[int] = []

    def run(row: str, seed: int) -> dict[str, Any]:
        seeds.append(seed)
        if seed == 2:
            raise ZeroDivisionError("a defect")
        return a_line(seed, 0.001, 0.001)

    monkeypatch.setattr(benchmark, "run_row", run)
    monkeypatch.setattr(benchmark, "bound", lambda row: {})
    asked = ["--rows", "yard", "--out", str(tmp_path), "--runs"]
    assert benchmark.main([*asked, "2"]) == 1
    assert capsys.readouterr().err == "yard seed 2: ZeroDivisionError: a defect\n"
    assert benchmark.main([*asked, "1"]) == 0
    assert seeds == [1, 2]
    lines = (tmp_path / "yard.jsonl").read_text().splitlines()
    assert [json.loads(line)["seed"] for line in lines] == [1]
    assert benchmark.main(["--rows", "yard", "--out", str(tmp_path), "--summary"]) == 0
    assert "walls and ground: n = 1 of 1" in capsys.readouterr().out
