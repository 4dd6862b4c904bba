"""False alarms and detected faults of the status `inconsistent`, from raw sensors.

Needs the environment that scripts/demo makes:

    .venv/bin/python scripts/benchmark_consistency.py --seeds 50
    .venv/bin/python scripts/benchmark_consistency.py --faults --seeds 3
    .venv/bin/python scripts/benchmark_consistency.py --seeds 8 --scenarios noisy distorted
    .venv/bin/python scripts/benchmark_consistency.py --summary

Clean drives: seed n uses the scenarios in turn. Every run draws all errors that a stated sigma
covers. No run may be `inconsistent`; the most suspect input of each scenario is printed. Faults,
all on figure_eight: wrong stamps of one LiDAR, displaced clouds of one LiDAR, swapped topics. Each
must be `inconsistent` or, if no target is found, an error. A run is a line in
out/consistency/runs.jsonl, written when it ends. A second start runs the missing ones. Runs of
another version of the program do not count unless --any-version is given.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy

import numpy as np

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the modules beside this script from any folder

from caliv_graph.common.progress import SilentProgress
from caliv_graph.errors import CalivError
from caliv_graph.pipeline import calibrate
from caliv_graph.products import LidarScan, Recording
from caliv_graph.readers.forwarding import ForwardingRecording
from caliv_graph.scenario.model import load_scenario
from scripts._command import add_beams
from scripts._runs import add_line, code_digest, json_lines
from scripts._tables_rows import config_for
from scripts._thinned import (
    GroundWaves,
    ThinnedRecording,
    cached_selection,
)

OUT = REPOSITORY / "out" / "consistency"
SCENARIOS = ("figure_eight", "s_curve", "paper_arc", "tri_lidar")


@dataclass(frozen=True)
class Faulty(ForwardingRecording):
    """A recording with a fault (products.Recording).

    Attributes:
        late_ns: per LiDAR, delay of its stamps.
        displaced: per LiDAR, which clouds (number, of how many) lie elsewhere, and by what (metres,
            lidar frame).
        source: per LiDAR, whose clouds come under its name.
    """

    late_ns: Mapping[str, int] = field(default_factory=dict)
    displaced: Mapping[str, tuple[Callable[[int, int], bool], tuple[float, float, float]]] = field(
        default_factory=dict
    )
    source: Mapping[str, str] = field(default_factory=dict)

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        late_ns = self.late_ns.get(lidar, 0)
        source = self.source.get(lidar, lidar)
        return [stamp + late_ns for stamp in self.recording.scan_stamps_ns(source)]

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        late_ns = self.late_ns.get(lidar, 0)
        source = self.source.get(lidar, lidar)
        stamps = self.recording.scan_stamps_ns(source)
        number = {stamp: k for k, stamp in enumerate(stamps)}
        asked = frozenset(s for s in stamps if wanted is None or s + late_ns in wanted)
        which, by = self.displaced.get(lidar, (_none, (0.0, 0.0, 0.0)))
        for scan in self.recording.scans(source, asked):
            shift = np.array(by) * which(number[scan.stamp_ns], len(stamps))
            yield replace(
                scan,
                lidar=lidar,
                stamp_ns=scan.stamp_ns + late_ns,
                points_lidar=scan.points_lidar + shift,
            )


def _none(number: int, count: int) -> bool:
    return False


def _every_other(number: int, count: int) -> bool:
    return number % 2 == 0


def _second_half(number: int, count: int) -> bool:
    return 2 * number >= count


def _by_chance(number: int, count: int) -> bool:
    return bool(np.random.default_rng(number).random() < 0.5)


FAULTS: dict[str, Callable[[Recording], Recording]] = {
    "front 0.3 s late": lambda r: Faulty(r, late_ns={"front": 300_000_000}),
    "rear 0.3 s early": lambda r: Faulty(r, late_ns={"rear": -300_000_000}),
    "front 0.05 s late": lambda r: Faulty(r, late_ns={"front": 50_000_000}),
    "every other cloud 0.2 m forward": lambda r: Faulty(
        r, displaced={"front": (_every_other, (0.2, 0.0, 0.0))}
    ),
    "second half 0.2 m forward": lambda r: Faulty(
        r, displaced={"front": (_second_half, (0.2, 0.0, 0.0))}
    ),
    "half, by chance, 0.2 m left": lambda r: Faulty(
        r, displaced={"front": (_by_chance, (0.0, 0.2, 0.0))}
    ),
    "every other cloud 0.2 m up": lambda r: Faulty(
        r, displaced={"rear": (_every_other, (0.0, 0.0, 0.2))}
    ),
    "swapped topics": lambda r: Faulty(r, source={"front": "rear", "rear": "front"}),
}


@dataclass(frozen=True)
class Task:
    """One run: a scenario, its fault (empty: none), a seed."""

    scenario: str
    fault: str
    seed: int


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=12, help="1 to N (default: 12)")
    parser.add_argument("--faults", action="store_true", help="drives with faults, N of each")
    parser.add_argument("--scenarios", nargs="+", default=SCENARIOS, help="of clean drives")
    parser.add_argument("--summary", action="store_true", help="only print what is there")
    parser.add_argument("--any-version", action="store_true", help="count runs of older text too")
    parser.add_argument("--out", type=Path, default=OUT, help="folder (default: out/consistency)")
    add_beams(parser)
    asked = parser.parse_args(arguments)
    path = asked.out / "runs.jsonl"
    if not asked.summary:
        asked.out.mkdir(parents=True, exist_ok=True)
        done = {
            Task(r["scenario"], r["fault"], r["seed"]) for r in lines_of(path, asked.any_version)
        }
        for task in tasks(asked.seeds, asked.scenarios, faults=asked.faults):
            if task not in done:
                line = perform(task, asked.beams)
                add_line(path, line)
                what = task.fault or "clean"
                print(f"{task.scenario}, {what}, seed {task.seed}: {line['status']}", flush=True)
    text, failures = summary(lines_of(path, asked.any_version))
    print(text)
    return 1 if failures else 0


def tasks(seeds: int, scenarios: Sequence[str], *, faults: bool) -> list[Task]:
    """All runs that are requested."""
    if faults:
        return [Task("figure_eight", f, seed) for seed in range(1, seeds + 1) for f in FAULTS]
    return [Task(scenarios[(n - 1) % len(scenarios)], "", n) for n in range(1, seeds + 1)]


def perform(task: Task, beams: Path) -> dict[str, Any]:
    """Simulates and calibrates once; returns the line to write."""
    model = load_scenario(REPOSITORY / "configs" / "scenarios" / f"{task.scenario}.yaml")
    selection = cached_selection(model, beams)
    drive = ThinnedRecording(model, selection, task.seed, waves=GroundWaves())
    recording: Recording = FAULTS[task.fault](drive) if task.fault else drive
    line: dict[str, Any] = {
        "scenario": task.scenario,
        "fault": task.fault,
        "seed": task.seed,
        "code": code_digest(),
    }
    try:
        run = calibrate([recording], config_for(drive, {}), SilentProgress())
    except CalivError as e:
        return {**line, "status": "error", "said": [str(e)]}
    return {
        **line,
        "status": run.calibration.status,
        "said": list(run.calibration.contradictions),
        "suspects": [(s.input, s.sigmas) for s in run.calibration.suspects[:3]],
        "registration_scale": run.solution.registration_scale,
    }


def lines_of(path: Path, any_version: bool) -> list[dict[str, Any]]:
    """The runs of a file that count, without incomplete lines."""
    return [line for line in json_lines(path) if any_version or line["code"] == code_digest()]


def summary(lines: Sequence[Mapping[str, Any]]) -> tuple[str, int]:
    """Summary of the runs, and the number of wrong ones."""
    clean = [line for line in lines if not line["fault"]]
    alarms = [line for line in clean if line["status"] not in ("ok", "partial")]
    out = [f"clean drives: {len(clean)}, of which {len(alarms)} are called wrong"]
    for scenario in dict.fromkeys(line["scenario"] for line in clean):
        suspects = [
            (sigmas, name)
            for line in clean
            if line["scenario"] == scenario
            for name, sigmas in line.get("suspects", ())
        ]
        if suspects:
            sigmas, name = max(suspects)
            out.append(f"  {scenario}: most suspect {name}, {sigmas:.1f} sigma")
    for line in alarms:
        out += [f"  {line['scenario']} seed {line['seed']}: {said}" for said in line["said"]]
    missed = 0
    for fault in FAULTS:
        runs = [line for line in lines if line["fault"] == fault]
        found = [line for line in runs if line["status"] in ("inconsistent", "error")]
        missed += len(runs) - len(found)
        if runs:
            out.append(f"{fault}: {len(found)} of {len(runs)} are called wrong")
            out += [f"  {said}" for said in (found[0]["said"] if found else ())]
    return "\n".join(out), len(alarms) + missed


if __name__ == "__main__":
    sys.exit(main())
