"""Tables I to III of the paper, and more rows, from simulated raw sensors with known truth.

Needs the environment that scripts/demo makes:

    .venv/bin/python scripts/benchmark_tables.py --jobs 2
    .venv/bin/python scripts/benchmark_tables.py --scenarios figure_eight --rows auto --runs 5
    .venv/bin/python scripts/benchmark_tables.py --summary

Every run draws all errors that a stated sigma covers: vehicle height, heave, waves of the ground,
the noise of every sensor, and initial guesses with errors of up to 0.1 m and 3 degrees. Only the
relevant beams of a cloud are cast (`scripts._thinned`). A run is a line in
out/tables/<scenario>-<row>.jsonl, written when it ends. A second start runs the missing ones. Runs
of another version of the program, another scenario or another config do not count. Errors are in
vehicle axes, as in `evaluate`. Errors of undetermined axes are left out, and their number is shown.
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: one process per core
REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the modules beside this script from any folder

import caliv_graph
from caliv_graph.common.files import atomic_write
from caliv_graph.common.progress import PlainProgress
from caliv_graph.config.load import dump_config
from caliv_graph.errors import CalivError
from caliv_graph.scenario.model import InitialGuessModel, Scenario, dump_scenario, load_scenario
from caliv_graph.simulation.recording import simulate_drive
from scripts._runs import code_digest, json_lines, performed
from scripts._tables_rows import ROWS, ROWS_OF, RUNS_OF, config_for, run_row
from scripts._tables_statistics import (
    Line,
    comparison,
    line_of,
    other_systems,
    row_table,
)
from scripts._thinned import (
    BeamSelection,
    GroundWaves,
    ThinnedRecording,
    cached_selection,
    scenario_digest,
)

SCENARIOS = REPOSITORY / "configs" / "scenarios"
OUT = REPOSITORY / "out" / "tables"

WAVES = GroundWaves()
"""Unevenness of the ground: 0.5 mrad and 2 mm in each cloud, the floors of a plane's sigmas."""


@dataclass(frozen=True)
class Task:
    """One run.

    Attributes:
        scenario: its name.
        row: its name.
        seed: seed of all draws.
        out: folder of the results.
    """

    scenario: str
    row: str
    seed: int
    out: Path


def main(arguments: Sequence[str] | None = None) -> int:
    asked = _arguments(arguments)
    rows = {
        name: tuple(row for row in asked.rows or ROWS_OF.get(name, ("auto",)))
        for name in asked.scenarios
    }
    defects: list[str] = []
    if not asked.summary:
        for name in rows:
            _selection(name, asked.out)  # once, before the processes start
        defects = run_missing(
            [
                Task(name, row, seed, asked.out)
                for name in rows
                for row in rows[name]
                for seed in range(1, runs_of(name, row, asked.runs) + 1)
            ],
            asked.jobs,
            fresh=asked.fresh,
        )
    print(summary(rows, asked.out, asked.runs), flush=True)
    for text in defects:
        print(text, file=sys.stderr)
    return 1 if defects else 0


def _arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenarios", nargs="+", default=list(ROWS_OF), metavar="NAME")
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), metavar="ROW", help=_rows_help())
    parser.add_argument("--runs", type=int, help="seeds 1 to N (default: 100 of auto, 20, 3)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default: 1)")
    parser.add_argument("--summary", action="store_true", help="only print what is there")
    parser.add_argument("--fresh", action="store_true", help="discard what is there")
    parser.add_argument("--out", type=Path, default=OUT, help="folder (default: out/tables)")
    asked = parser.parse_args(arguments)
    for name in asked.scenarios:
        if not (SCENARIOS / f"{name}.yaml").exists():
            parser.error(f"no scenario '{name}' in configs/scenarios")
    return asked


def _rows_help() -> str:
    return "; ".join(f"{name}: {row.text}" for name, row in ROWS.items())


def runs_of(scenario: str, row: str, asked: int | None) -> int:
    """Requested number of runs."""
    return asked or RUNS_OF.get((scenario, row), ROWS[row].runs)


# ------------------------------------------------------------------ runs


@functools.cache
def _scenario(name: str) -> Scenario:
    return load_scenario(SCENARIOS / f"{name}.yaml")


@functools.cache
def _selection(name: str, out: Path) -> BeamSelection:
    return cached_selection(_scenario(name), out / "beams", progress=PlainProgress(print))


def perform(task: Task) -> dict[str, Any]:
    """Simulates, calibrates and compares once; returns the line to write."""
    scenario = _scenario(task.scenario)
    line: dict[str, Any] = {
        "digest": digest(task.scenario, task.row),
        "code": code_digest(),
        "seed": task.seed,
        "failure": "",
    }
    selection = _selection(task.scenario, task.out)
    recording = ThinnedRecording(scenario, selection, task.seed, waves=WAVES)
    try:
        outcome = run_row(task.row, recording, task.seed)
    except CalivError as e:
        return {**line, "failure": str(e)}
    return {**line, **asdict(outcome)}


def run_missing(tasks: Sequence[Task], jobs: int, *, fresh: bool = False) -> list[str]:
    """Runs the tasks that no file has, and writes each when it ends.

    Args:
        tasks: the requested runs.
        jobs: number of processes.
        fresh: whether existing runs of these rows are discarded.

    Returns:
        A message for each task that ended with a defect of the program. These are not written.
    """
    missing = []
    for scenario, row, out in dict.fromkeys((t.scenario, t.row, t.out) for t in tasks):
        path = file_of(scenario, row, out)
        kept = {} if fresh else {line["seed"]: line for line in _usable(path, scenario, row)}
        lines = "".join(f"{json.dumps(kept[seed])}\n" for seed in sorted(kept))
        atomic_write(path, lines, force=True)
        missing += [
            t
            for t in tasks
            if (t.scenario, t.row, t.out) == (scenario, row, out) and t.seed not in kept
        ]
    defects = []
    for number, (task, line) in enumerate(performed(perform, missing, jobs), 1):
        where = f"{task.scenario} {task.row} seed {task.seed}"
        if isinstance(line, Exception):
            defects.append(f"{where}: {type(line).__name__}: {line}")
            print(f"{number}/{len(missing)} {where}: defect", flush=True)
            continue
        with file_of(task.scenario, task.row, task.out).open("a", encoding="utf-8") as file:
            file.write(f"{json.dumps(line)}\n")
        said = line["failure"] or f"{line['seconds']['total']:.1f} s"
        print(f"{number}/{len(missing)} {where}: {said}", flush=True)
    return defects


# ------------------------------------------------------------------ files


def file_of(scenario: str, row: str, out: Path) -> Path:
    return out / f"{scenario}-{row}.jsonl"


@functools.cache
def digest(scenario: str, row: str) -> str:
    """Digest of version, scenario, row and effective config, on which a result depends."""
    model = _scenario(scenario)
    exact = model.model_copy(
        update={"initial_guess": InitialGuessModel(translation_m=0.0, rotation_deg=0.0)}
    )
    config = config_for(simulate_drive(exact, 0), ROWS[row].changes)
    text = "\n".join(
        [
            caliv_graph.__version__,
            row,
            json.dumps(ROWS[row].changes, sort_keys=True, default=dict),
            dump_scenario(model),
            repr(WAVES),
            scenario_digest(model),
            dump_config(config),
        ]
    )
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _usable(path: Path, scenario: str, row: str) -> list[dict[str, Any]]:
    """The lines of a file with the current digest, without incomplete lines."""
    return [line for line in json_lines(path) if line.get("digest") == digest(scenario, row)]


def read_lines(scenario: str, row: str, out: Path, runs: int | None = None) -> list[Line]:
    """The runs of a row, by seed."""
    found = {
        line["seed"]: line
        for line in _usable(file_of(scenario, row, out), scenario, row)
        if runs is None or line["seed"] <= runs
    }
    return [line_of(found[seed]) for seed in sorted(found)]


# ------------------------------------------------------------------ summary


def planned(scenario: str) -> Mapping[str, Sequence[float]]:
    """Sigmas of `plan` by quantity, `conventions.AXES`, rad and m; empty if there are none."""
    try:
        from caliv_graph.planning import predict
    except ImportError:
        return {}
    prediction: Any = predict(_scenario(scenario))
    out = {f"S2V {name}": sigma for name, sigma in prediction.sigma_s2v.items()}
    for (a, b), sigma in prediction.sigma_s2s.items():
        out[f"S2S {a} to {b}"] = sigma
    return out


def summary(rows: Mapping[str, Sequence[str]], out: Path, runs: int | None = None) -> str:
    """All tables of the existing runs; the plots are written beside the files."""
    texts = []
    for name, of_scenario in rows.items():
        found = {row: read_lines(name, row, out, runs) for row in of_scenario}
        found = {row: lines for row, lines in found.items() if lines}
        for row, lines in found.items():
            text = ROWS[row].text
            predicted = planned(name) if row == "auto" else None
            texts.append(row_table(name, text, lines, predicted, judged=row == "auto"))
            codes = sorted({line.code for line in lines})
            if len(codes) > 1:
                texts.append(f"  from {len(codes)} versions of the code: --fresh makes it one")
            texts += _plot(name, row, lines, out)
        if len(found) > 1:
            texts.append(comparison(name, {row: (ROWS[row].text, x) for row, x in found.items()}))
    texts.append(other_systems(lambda name, row: read_lines(name, row, out)))
    return "\n".join(text for text in texts if text) or "no runs yet"


def _plot(name: str, row: str, lines: Sequence[Line], out: Path) -> list[str]:
    from scripts._tables_plots import write_plot

    path = out / f"{name}-{row}.png"
    done = sum(not line.failure for line in lines)
    if not write_plot(path, f"{name}, {ROWS[row].text}, n = {done}", lines):
        return []
    return [f"  plot: {path.name}"]


if __name__ == "__main__":
    sys.exit(main())
