"""The random drives: what is drawn, and the verdicts on runs by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from caliv_graph.scenario.drives import make_drive
from scripts import benchmark_random as benchmark
from scripts._random_drives import TARGET_FROM_PATH_M, random_drive, with_options


def a_line(exit_code: int, sigmas: float, **changes: Any) -> dict[str, Any]:
    of = {"error": [1e-3 * sigmas] * 5 + [None], "sigma": [1e-3] * 6, "nees": 5.0, "axes": 5}
    line: dict[str, Any] = {
        "seed": 1,
        "forced": None,
        "code": "a",
        "text": "arc",
        "cpu_s": 1.0,
        "exit": exit_code,
    }
    line |= {"said": [], "warnings": [], "undetermined": [], "errors": {"S2V lidar_0": of}}
    return {**line, **changes}


@pytest.mark.parametrize("seed", range(100, 112))
def test_the_vehicle_passes_every_target_and_hits_none(seed: int) -> None:
    model = random_drive(seed).scenario
    drive = make_drive(model.drive)
    stamps_ns = np.arange(0, int(drive.duration_s * 1e9), 50_000_000)
    path = drive.states(stamps_ns).position_map[:, :2]
    for name in model.world.targets:
        away = np.linalg.norm(path - model.world.objects[name].xy_m, axis=1).min()
        assert TARGET_FROM_PATH_M[0] - 0.1 < away < TARGET_FROM_PATH_M[1]


def test_a_drive_is_drawn_from_its_seed_alone() -> None:
    assert random_drive(7) == random_drive(7)
    assert random_drive(7).scenario.drive != random_drive(8).scenario.drive


def test_options_are_drawn_beside_the_drive() -> None:
    found = [with_options(random_drive(seed)) for seed in range(40)]
    assert found == [with_options(random_drive(seed)) for seed in range(40)]
    for seed, drive in enumerate(found):
        late = [lidar.time_offset_s for lidar in drive.scenario.lidars.values()]
        assert any(late) == bool(drive.options.get("solve", {}).get("time_offset"))
        assert drive.scenario.world == random_drive(seed).scenario.world
    sections = {section for drive in found for section in drive.options}
    assert sections == {"solve", "robust", "gnss", "imu", "structure", "ground"}


@pytest.mark.parametrize(
    ("exit_code", "sigmas", "wrong", "false_alarm"),
    [
        (0, 3.9, False, False),
        (0, -4.1, True, False),
        (3, 4.1, True, False),
        (4, 4.1, False, False),
        (4, 2.9, False, True),
        (4, 3.5, False, False),
    ],
)
def test_a_run_is_wrong_or_a_false_alarm_by_its_largest_error(
    exit_code: int, sigmas: float, wrong: bool, false_alarm: bool
) -> None:
    line = a_line(exit_code, sigmas)
    assert benchmark.is_wrong(line) == wrong
    assert benchmark.is_false_alarm(line) == false_alarm


def test_the_summary_takes_nees_per_determined_axis_and_quotes_failures() -> None:
    failed = a_line(2, 0.0, seed=5, errors={}, said=["TargetError: nothing was seen"])
    text = benchmark.summary([a_line(0, 1.0), a_line(0, 5.0, seed=4), failed])
    assert "3 drives; exit 0: 2, 2: 1" in text
    assert "median 6.0" in text
    assert "over 4 sigma: 1: 4 (5.0)" in text
    assert "exit 2, seed 5: TargetError: nothing was seen" in text
