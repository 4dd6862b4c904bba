"""The speed and memory benchmarks' arithmetic and verdicts, on runs made up here."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from caliv_graph.errors import CalivError
from caliv_graph.geometry.se3 import cross
from caliv_graph.structure.elimination import factor_of
from scripts import _child, check_memory
from scripts import benchmark_speed as benchmark
from scripts._child import Usage
from scripts._profile import Profile, profile_text, sampled
from tests.cli.commands import write_config, write_drive

ROOT = Path(__file__).resolve().parents[2]

STAGES: Mapping[str, tuple[float, float]] = {
    "reading clouds": (1.5, 1.4),
    "registering the clouds": (1.0, 1.2),
}

USAGE = Usage(code=0, wall_s=3.9, cpu_s=7.0, start_up_cpu_s=0.9, peak_mb=300.0, stages=STAGES)

SECONDS = {"total": 60.0, "cpu": 60.0, "registration": 50.0, "optimisation": 10.0}

GOOD = benchmark.Found(
    cases=(benchmark.Case("authors' drive", 136, {2: USAGE, 1: replace(USAGE, wall_s=7.2)}),),
    growths=(
        benchmark.Growth(
            "clouds of the authors' drive",
            (34, 68, 136),
            (replace(USAGE, cpu_s=2.5), replace(USAGE, cpu_s=4.0), USAGE),
        ),
        benchmark.Growth("points", (1, 2, 4), (USAGE, USAGE, replace(USAGE, cpu_s=14.0))),
    ),
    more_components=1.6,
    inspection=benchmark.Inspection("figure_eight", {2: 3.0, 1: 4.0}, 5.0, 6.0),
    baselines=(
        benchmark.Baseline("authors' drive", SECONDS, {k: v / 8.0 for k, v in SECONDS.items()}),
    ),
    helps_s={"caliv-graph": 0.2, "init": 0.3},
    load=0.1,
)


def missed(found: benchmark.Found) -> list[str]:
    return [verdict.what for verdict in benchmark.verdicts(found) if not verdict.kept]


def with_usage(**changes: object) -> benchmark.Found:
    usage = replace(USAGE, **changes)  # type: ignore[arg-type]
    return replace(GOOD, cases=(benchmark.Case("authors' drive", 136, {2: usage, 1: usage}),))


def test_every_limit_can_be_missed() -> None:
    assert missed(GOOD) == []
    assert missed(with_usage(wall_s=4.1)) == ["136 clouds, 2 cores, wall"]
    slow_reading = {"reading clouds": (2.0, 2.0), "reading the ground": (1.1, 1.0)}
    assert missed(with_usage(stages=slow_reading)) == ["of which reading"]
    little_reading = {"reading clouds": (0.2, 0.2), "reading the ground": (0.2, 0.2)}
    assert missed(with_usage(stages=little_reading)) == ["over reading and cutting out"]
    inspection = GOOD.inspection
    slower = replace(inspection, walls_s={2: 4.1, 1: 4.0})
    assert missed(replace(GOOD, inspection=slower)) == ["inspect, 2 cores against 1, wall"]
    waiting = replace(inspection, busy_cpu_s=6.6)
    assert missed(replace(GOOD, inspection=waiting)) == ["inspect beside 4 processes, CPU"]
    near = benchmark.Baseline("demo", SECONDS, {k: v / 2.9 for k, v in SECONDS.items()})
    assert missed(replace(GOOD, baselines=(near,))) == ["the paper's estimator, demo"]
    quarter, half, whole = GOOD.growths[0].usages
    dear = replace(GOOD.growths[0], usages=(quarter, half, replace(whole, cpu_s=8.9)))
    assert missed(replace(GOOD, growths=(dear,))) == ["twice the clouds, CPU"]
    lidars = benchmark.Growth("LiDARs, a figure-eight", (1, 2), (quarter, replace(half, cpu_s=5.8)))
    assert missed(replace(GOOD, growths=(lidars,))) == ["more LiDARs, CPU"]
    lidars = replace(lidars, usages=(quarter, replace(half, cpu_s=5.7)))
    assert missed(replace(GOOD, growths=(lidars,))) == []
    assert missed(replace(GOOD, more_components=2.1)) == ["1000 components against 300, CPU"]
    slow_help = replace(GOOD, helps_s={"caliv-graph": 0.2, "init": 0.5})
    assert missed(slow_help) == ["--help, slowest (init)"]


def test_the_text_has_stages_rest_ratios_and_limits() -> None:
    text = benchmark.text(GOOD, benchmark.verdicts(GOOD))

    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert "reading clouds 1.50 1.40 1.50 1.40" in lines
    # What no stage has: 3.9 - 2.5 of wall, 7.0 - 2.6 of CPU; on one core 7.2 - 2.5.
    assert "first pass over a bag, tests, report, files 1.40 4.40 4.70 4.40" in lines
    assert any(line.startswith("reading and cutting out: 38 percent") for line in lines)
    assert any("34: 2.5 s, 300 MB (1.00x); 68: 4.0 s, 300 MB (1.60x)" in line for line in lines)
    assert any(line.endswith("optimisation alone 10.00 1.25 8.00") for line in lines)
    assert any(line.endswith("s, at most 4: kept") for line in lines)
    assert any(line.endswith("times as long, at least 3: kept") for line in lines)
    assert "3.0 s on 2 cores, 4.0 s on 1 core; 5.0 s of CPU, 6.0 s beside 4 busy processes" in lines
    assert "longer" not in text
    assert "5.0 cores busy" in benchmark.text(replace(GOOD, load=5.0), [])
    arguments = argparse.Namespace(seed=1, quick=True)
    json.dumps(benchmark.document(arguments, GOOD, benchmark.verdicts(GOOD)), allow_nan=False)


def test_busy_processes_end_with_the_block() -> None:
    with benchmark.busy_processes(2) as others:
        assert [other.poll() for other in others] == [None, None]
    assert None not in [other.poll() for other in others]


def test_the_middle_run_is_the_median() -> None:
    runs = [replace(USAGE, cpu_s=cpu_s) for cpu_s in (9.0, 5.0, 7.0)]
    assert _child.middle(runs).cpu_s == 7.0
    assert _child.middle(runs[:2]).cpu_s == 5.0


def test_part_of_a_folder_is_every_second_cloud_of_each_sensor(tmp_path: Path) -> None:
    drive = write_drive(tmp_path / "drive", frames=12)

    part = benchmark.part_of(drive, 2, tmp_path)

    for sensor in ("sensor_1", "sensor_2"):
        names = {path.name for path in (part / "input" / sensor).iterdir()}
        assert names == {f"{k}.pcd" for k in range(0, 12, 2)}  # by number: 10 is after 8
    config = write_config(tmp_path / "config.yaml", data={"format": "caliv", "path": str(part)})
    assert benchmark.cloud_count(config) == 12


def test_a_child_is_measured_and_its_complaint_is_told(tmp_path: Path) -> None:
    code, usage = _child.run(["--version"], 1)
    assert code == 0
    assert 0.0 < usage["cpu_s"] < 5.0
    assert usage["start_up_cpu_s"] > 0.1  # imports are no part of the work
    assert 50.0 < usage["peak_mb"] < 2000.0

    with pytest.raises(CalivError, match="no such file"):
        _child.calibrate(tmp_path / "absent.yaml", tmp_path / "result", 1)


def test_growth_of_memory_is_per_minute_and_can_exceed_its_limit() -> None:
    lengths = [
        check_memory.Length(minutes, 230.0 * minutes, replace(USAGE, peak_mb=peak_mb))
        for minutes, peak_mb in ((1, 270.0), (4, 300.0), (16, 345.0))
    ]

    assert check_memory.growth(lengths) == pytest.approx(5.0)
    assert check_memory.growth(lengths[:1]) == 0.0
    assert "5.00 MB per minute of drive (at most 6: kept)" in check_memory.text(lengths, 6.0)
    assert "MISSED" in check_memory.text(lengths, 4.0)
    assert check_memory.document(lengths, 4.0)["kept"] is False


def test_a_script_runs_from_anywhere(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "scripts/check_memory.py"), "--help"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert "--json" in done.stdout


def test_samples_count_the_functions_of_the_package_by_processor_time() -> None:
    rows = np.ones((20_000, 3))
    until = time.process_time() + 0.15
    with sampled() as samples:
        while time.process_time() < until:
            cross(rows, rows)
    function = "geometry/se3.py:cross"
    spent_s = sum(samples.own.values())
    assert spent_s >= 0.04
    assert max(samples.own, key=lambda name: samples.own[name]) == function
    assert samples.total[function] >= 0.8 * spent_s
    cross(np.ones((200_000, 3)), np.ones((200_000, 3)))
    assert sum(samples.own.values()) == spent_s  # the timer has stopped


def test_a_long_call_of_compiled_code_counts_with_all_its_time() -> None:
    """The timer is answered when it is over, however often it rang."""
    H = np.diag(np.full(2000, 1.0))
    begun_s = time.process_time()
    with sampled() as samples:
        for _ in range(3):
            factor_of(H)
    spent_s = time.process_time() - begun_s
    assert samples.total["structure/elimination.py:factor_of"] == pytest.approx(spent_s, rel=0.3)


def test_profile_shows_stages_and_functions_in_seconds_and_parts() -> None:
    shown = profile_text(
        Profile("a drive", 4.0, [("reading clouds", 1.0)], {"a.py:f": 3.0}, {"a.py:g": 4.0})
    )
    assert "a drive: 4.00 s" in shown
    assert "1.00 s  25.0 %  reading clouds" in shown
    assert "3.00 s  75.0 %  a.py:f" in shown
    assert "4.00 s 100.0 %  a.py:g" in shown
