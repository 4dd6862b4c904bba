"""Calibration by walls and ground, with and without a chair, from raw sensors with known truth.

Needs the environment that scripts/demo makes:

    .venv/bin/python scripts/benchmark_structure.py --jobs 2
    .venv/bin/python scripts/benchmark_structure.py --rows yard yard_s --runs 5
    .venv/bin/python scripts/benchmark_structure.py --summary

Every run draws all errors that a stated sigma covers, the range biases of the LiDARs, and the bumps
of walls and ground. Whole clouds are cast, those that the program reads. A run is a line in
out/structure/<row>.jsonl, written when it ends. A second start runs the missing ones. Runs of
another version of the program, another scenario or another config do not count.
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import math
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: one process per core
REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the modules beside this script from any folder

import numpy as np

import caliv_graph
from caliv_graph.common.exits import UNMET, USAGE
from caliv_graph.config.load import dump_config
from caliv_graph.errors import CalivError
from caliv_graph.planning import predict
from caliv_graph.scenario.model import InitialGuessModel, dump_scenario
from caliv_graph.simulation.recording import simulate_drive
from scripts._runs import add_line, code_digest, json_lines, performed
from scripts._structure_rows import ROWS, Row, run_row, scenario_of
from scripts._tables_rows import config_for
from scripts._tables_statistics import (
    HEADING,
    SHOWN,
    Statistics,
    axis_cells,
    by_quantity,
    line_of,
    row_table,
)

OUT = REPOSITORY / "out" / "structure"

RATIO_INTERVAL = (0.8, 1.25)
"""Interval of RMSE over sigma in which a sigma is called right."""

NEES_INTERVAL = (4.5, 7.5)
"""Interval of the mean NEES of six axes."""

BOUND_LIMIT = 1.5
"""Limit of RMSE over the sigma that `plan` predicts."""


@dataclass(frozen=True)
class Task:
    """One run.

    Attributes:
        row: its name.
        seed: seed of all draws.
    """

    row: str
    seed: int


def main(arguments: Sequence[str] | None = None) -> int:
    asked = _arguments(arguments)
    defects: list[str] = []
    if not asked.summary:
        tasks = [
            Task(row, seed)
            for row in asked.rows
            for seed in range(1, (asked.runs or ROWS[row].runs) + 1)
        ]
        defects = run_missing(tasks, asked.out, asked.jobs, fresh=asked.fresh)
    print(summary(asked.rows, asked.out, asked.runs), flush=True)
    for text in defects:
        print(text, file=sys.stderr)
    return 1 if defects else 0


def _arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    rows_help = "; ".join(f"{name}: {row.text}" for name, row in ROWS.items())
    parser.add_argument(
        "--rows", nargs="+", choices=list(ROWS), default=list(ROWS), metavar="ROW", help=rows_help
    )
    parser.add_argument("--runs", type=int, help="seeds 1 to N (default: 100 of yard, else 20)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default: 1)")
    parser.add_argument("--summary", action="store_true", help="only print what is there")
    parser.add_argument("--fresh", action="store_true", help="discard what is there")
    parser.add_argument("--out", type=Path, default=OUT, help="folder (default: out/structure)")
    return parser.parse_args(arguments)


# ------------------------------------------------------------------ runs


def perform(task: Task) -> dict[str, Any]:
    """Simulates, calibrates and compares once; returns the line to write."""
    known = {"digest": digest(task.row), "code": code_digest(), "seed": task.seed}
    return {**known, **run_row(task.row, task.seed)}


def run_missing(
    tasks: Sequence[Task], out: Path, jobs: int = 1, *, fresh: bool = False
) -> list[str]:
    """Runs the tasks that no file has, and writes each when it ends.

    Returns:
        A message for each task that ended with a defect of the program. These are not written.
    """
    out.mkdir(parents=True, exist_ok=True)
    missing = []
    for row in dict.fromkeys(task.row for task in tasks):
        if fresh:
            file_of(row, out).unlink(missing_ok=True)
        there = {line["seed"] for line in read_lines(row, out)}
        missing += [task for task in tasks if task.row == row and task.seed not in there]
    defects = []
    for number, (task, line) in enumerate(performed(perform, missing, jobs), 1):
        where = f"{number}/{len(missing)} {task.row} seed {task.seed}"
        if isinstance(line, Exception):
            defects.append(f"{task.row} seed {task.seed}: {type(line).__name__}: {line}")
            print(f"{where}: defect", flush=True)
            continue
        add_line(file_of(task.row, out), line)
        print(f"{where}: {one_run(line)}", flush=True)
    return defects


def one_run(line: Mapping[str, Any]) -> str:
    """A run in some lines: exit code, cost, and per quantity error, sigma and NEES."""
    cast = f"{line['cast_s']:.1f} s of them for {line['clouds']} clouds"
    text = f"exit {line['exit']}, {line['seconds']['total']:.1f} s of CPU, {cast}"
    if line["failure"]:
        return f"{text}: {line['failure']}"
    rows = [text, f"  {'':26}{HEADING}"]
    for name, found in line_of(line).quantities.items():
        s = by_quantity([line_of({**line, "quantities": {name: line["quantities"][name]}})])[name]
        nees = "" if found.nees is None else f"  NEES {found.nees:.1f}"
        rows.append(f"  {name:26}{axis_cells(s.mean)}{nees}")
        rows.append(f"  {'  sigma':26}{axis_cells(s.sigma)}")
    return "\n".join(rows)


# ------------------------------------------------------------------ files


def file_of(row: str, out: Path) -> Path:
    return out / f"{row}.jsonl"


@functools.cache
def digest(row: str) -> str:
    """Digest of version, scenario, row and effective config, on which a result depends."""
    scenario = scenario_of(row)
    exact = scenario.model_copy(
        update={"initial_guess": InitialGuessModel(translation_m=0.0, rotation_deg=0.0)}
    )
    config = config_for(simulate_drive(exact, 0), {})
    text = "\n".join([caliv_graph.__version__, row, dump_scenario(scenario), dump_config(config)])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def read_lines(row: str, out: Path, runs: int | None = None) -> list[dict[str, Any]]:
    """The runs of a row with the current digest, by seed."""
    found = {
        line["seed"]: line
        for line in json_lines(file_of(row, out))
        if line.get("digest") == digest(row) and (runs is None or line["seed"] <= runs)
    }
    return [found[seed] for seed in sorted(found)]


# ------------------------------------------------------------------ summary


def bound(row: str) -> Mapping[str, Sequence[float]]:
    """Sigmas that `plan` predicts, by quantity, `conventions.AXES`, rad and m; empty without."""
    try:
        prediction = predict(scenario_of(row))
    except CalivError:
        return {}
    out = {f"S2V {name}": sigma.tolist() for name, sigma in prediction.sigma_s2v.items()}
    for (a, b), sigma in prediction.sigma_s2s.items():
        out[f"S2S {a} to {b}"] = sigma.tolist()
    return out


def summary(rows: Sequence[str], out: Path, runs: int | None = None) -> str:
    """The tables of the existing runs, each with its verdicts."""
    texts = []
    for name in rows:
        lines = read_lines(name, out, runs)
        if not lines:
            continue
        found = [line_of(line) for line in lines]
        texts.append(row_table(name, ROWS[name].text, found, bound(name)))
        texts += verdicts(ROWS[name], lines)
        if len({line.code for line in found}) > 1:
            texts.append("  from several versions of the code: --fresh makes it one")
    return "\n".join(texts) or "no runs yet"


def verdicts(row: Row, lines: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """What of the row's figures is kept and what is not, a line each."""
    cast = np.array([line["cast_s"] for line in lines])
    codes = sorted({line["exit"] for line in lines})
    yield f"  exit codes {codes}; simulation {cast.mean():.1f} s of CPU, {cast.max():.1f} s at most"
    if row.must_fail:
        refused = sum(line["exit"] in (USAGE, UNMET) for line in lines)
        all_refused = _verdict(refused == len(lines))
        yield f"  no result, as it must be: {refused} of {len(lines)}{all_refused}"
        return
    for name, s in by_quantity([line_of(line) for line in lines if not line["failure"]]).items():
        limit = row.limits.get(name[:3])
        if limit is not None:
            yield f"  {name}: {_axes('RMSE', s.rmse, limit)}"
        yield f"  {name}: {_ratios(s)}; NEES {s.nees:.2f}{_verdict(_within(s.nees, NEES_INTERVAL))}"


def _axes(what: str, values: Sequence[float] | np.ndarray[Any, Any], limit: Sequence[float]) -> str:
    """Each axis with its limit; an axis without a limit is left out."""
    parts = [
        f"{axis} {value:.3g} of {most:g}{_verdict(value <= most)}"
        for axis, value, most in zip(SHOWN, np.asarray(values).tolist(), limit, strict=True)
        if not math.isnan(most)
    ]
    return f"{what} {', '.join(parts)}"


def _ratios(s: Statistics) -> str:
    ratios = [
        f"{axis} {value:.2f}{_verdict(_within(value, RATIO_INTERVAL))}"
        for axis, value in zip(SHOWN, s.ratio.tolist(), strict=True)
        if math.isfinite(value)
    ]
    return f"RMSE / sigma {', '.join(ratios)}"


def _within(value: float, interval: tuple[float, float]) -> bool:
    return interval[0] <= value <= interval[1]


def _verdict(kept: bool) -> str:
    return "" if kept else " MISS"


if __name__ == "__main__":
    sys.exit(main())
