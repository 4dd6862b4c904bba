"""Bias and consistency for many kinds of targets and LiDARs, from simulated raw sensors.

Needs the environment that scripts/demo makes:

    .venv/bin/python scripts/benchmark_targets.py --seeds 20 --jobs 2
    .venv/bin/python scripts/benchmark_targets.py --objects bin --lidars spin16 wide --seeds 3
    .venv/bin/python scripts/benchmark_targets.py --apart --seeds 3 --jobs 2
    .venv/bin/python scripts/benchmark_targets.py --summary
    .venv/bin/python scripts/benchmark_targets.py --released --edgar

A cell is an object, a model of both LiDARs, and a drive. Every run draws all errors that a stated
sigma covers: vehicle height, heave, waves of the ground, the noise of every sensor, and initial
guesses with errors of up to 0.1 m and 3 degrees. Only the relevant beams of a cloud are cast
(`scripts._thinned`), unless --whole is given. A run is a line in out/targets/results.json, written
when it ends. A second start runs the missing ones. Runs of another version of the program do not
count unless --any-version is given. Errors are in vehicle axes, as in `evaluate`; of axes that are
not determined they are left out. `!` marks what is beyond its limit, from 20 runs of a cell on. The
motion of the vehicle depends on the seed alone: cells share these errors, unless --apart gives each
cell seeds of its own. Errors over their sigmas are also pooled over all cells of an object, of a
LiDAR and of a drive: three runs of each cell are 30 of an object, 42 of a LiDAR, 105 of a drive.
"""

from __future__ import annotations

import argparse
import functools
import math
import os
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: one process per core
REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the modules beside this script from any folder

import numpy as np

from caliv_graph.common.exits import DEFECT
from caliv_graph.errors import CalivError
from caliv_graph.products import Array, BoolArray
from scripts._command import positive
from scripts._runs import add_line, code_digest, json_lines, performed
from scripts._tables_statistics import (
    HEADING,
    SHOWN,
    Line,
    Statistics,
    axis_cells,
    by_quantity,
    line_of,
)
from scripts._targets import DRIVES, LIDARS, OBJECTS, RECORDED, Result, Task, run, selection_of

OUT = REPOSITORY / "out" / "targets" / "results.json"

JUDGED_RUNS = 20
"""Runs of a cell from which its errors are judged: the mean of 20 is known to 0.22 sigma."""

BIAS_LIMIT = 0.5
"""Limit of the mean error over the stated sigma."""

RATIO_LIMITS = (0.8, 1.25)
"""Limits of RMSE over sigma."""

NEES_LIMITS = (4.5, 7.5)
"""Limits of the mean NEES of a pose; 6 is ideal."""

SCALE_LIMITS = (0.8, 1.5)
"""Limits of the mean `registration_scale`; 1 is ideal."""

RECORDED_LIMIT = 3.0
"""Limit of the error of a single drive over sigma."""

SEEDS_OF_CELL = 1000
"""With --apart, the first seeds of two cells are so far apart."""

Cell = tuple[str, str, str]
"""Object, LiDAR, drive."""


def main(arguments: Sequence[str] | None = None) -> int:
    asked = _arguments(arguments)
    recorded = [name for name in RECORDED if getattr(asked, name)]
    if recorded:
        defects = [_print_recorded(name) for name in recorded]
        return 1 if any(defects) else 0
    tasks = [
        Task(
            thing,
            lidar,
            drive,
            seed + (SEEDS_OF_CELL * number_of((thing, lidar, drive)) if asked.apart else 0),
            asked.range_sigma,
            asked.whole,
        )
        for seed in range(asked.first_seed, asked.first_seed + asked.seeds)
        for drive in asked.drives
        for lidar in asked.lidars
        for thing in asked.objects
    ]
    if not asked.summary:
        run_missing(tasks, asked.out, asked.jobs, any_version=asked.any_version)
    lines = read(asked.out, any_version=asked.any_version)
    lines = {task: lines[task] for task in tasks if task in lines}
    print(summary(lines), flush=True)
    return 1 if any(line["exit"] == DEFECT for line in lines.values()) else 0


def _arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--objects", nargs="+", choices=list(OBJECTS), default=list(OBJECTS))
    parser.add_argument("--lidars", nargs="+", choices=list(LIDARS), default=list(LIDARS))
    parser.add_argument("--drives", nargs="+", choices=DRIVES, default=list(DRIVES))
    parser.add_argument("--seeds", type=positive, default=20, help="how many (default: 20)")
    parser.add_argument("--first-seed", type=positive, default=1, help="(default: 1)")
    parser.add_argument("--apart", action="store_true", help="seeds of its own for each cell")
    parser.add_argument("--jobs", type=positive, default=1, help="processes (default: 1)")
    parser.add_argument("--out", type=Path, default=OUT, help="file of the runs, one a line")
    parser.add_argument(
        "--range-sigma",
        type=float,
        default=0.01,
        help="metres, noise along the beams, 1 sigma (default: 0.01)",
    )
    parser.add_argument("--whole", action="store_true", help="cast whole clouds: slow")
    parser.add_argument("--summary", action="store_true", help="only print what is there")
    parser.add_argument("--any-version", action="store_true", help="count runs of older text too")
    parser.add_argument(
        "--released", action="store_true", help="only the drive that the CaLiV authors published"
    )
    parser.add_argument("--edgar", action="store_true", help="only edgar_static, real clouds")
    asked = parser.parse_args(arguments)
    if not 0.0 < asked.range_sigma < 1.0:
        parser.error("--range-sigma must be above 0 and below 1 (metres)")
    return asked


def number_of(cell: Cell) -> int:
    """Number of a cell in the whole matrix."""
    thing, lidar, drive = cell
    row = DRIVES.index(drive) * len(LIDARS) + list(LIDARS).index(lidar)
    return row * len(OBJECTS) + list(OBJECTS).index(thing)


# ------------------------------------------------------------------ runs


def run_missing(tasks: Sequence[Task], path: Path, jobs: int, *, any_version: bool = False) -> None:
    """Runs the tasks that the file has not, and adds each when it ends."""
    done = read(path, any_version=any_version)
    missing = [task for task in tasks if task not in done]
    beams = path.parent / "beams"
    for drive, lidar in dict.fromkeys((t.drive, t.lidar) for t in missing if not t.whole):
        selection_of(drive, lidar, beams)  # once, before the processes start
    path.parent.mkdir(parents=True, exist_ok=True)
    work = functools.partial(run, beams=beams)
    for number, (task, found) in enumerate(performed(work, missing, jobs), 1):
        # The simulation itself failed, or the process ended.
        result = (
            Result(DEFECT, f"{type(found).__name__}: {found}")
            if isinstance(found, Exception)
            else found
        )
        line = {**asdict(task), "code": code_digest(), **asdict(result)}
        add_line(path, line)
        where = f"{task.object} {task.lidar} {task.drive} seed {task.seed}"
        said = result.failure or f"{result.status}, {result.seconds['total']:.1f} s"
        print(f"{number}/{len(missing)} {where}: exit {result.exit}, {said}", flush=True)


def read(path: Path, *, any_version: bool = False) -> dict[Task, dict[str, Any]]:
    """The runs of a file that count; of several of one task the last."""
    names = [field.name for field in fields(Task)]
    return {
        Task(*(line[name] for name in names)): line
        for line in json_lines(path)
        if any_version or line["code"] == code_digest()
    }


# ------------------------------------------------------------------ tables


def summary(lines: Mapping[Task, Mapping[str, Any]]) -> str:
    """The table of every cell, and below them a line for each cell."""
    by_cell: dict[Cell, list[Mapping[str, Any]]] = {}
    for task, line in lines.items():
        by_cell.setdefault((task.object, task.lidar, task.drive), []).append(line)
    if not by_cell:
        return "no runs yet"
    lidars, things = list(LIDARS), list(OBJECTS)
    ordered = sorted(
        by_cell, key=lambda c: (DRIVES.index(c[2]), things.index(c[0]), lidars.index(c[1]))
    )
    out = [text for cell in ordered for text in cell_table(cell, by_cell[cell])]
    by_cell = {cell: by_cell[cell] for cell in ordered}
    return "\n".join([*out, "", *pooled(by_cell), "", *overview(by_cell)])


def cell_table(cell: Cell, lines: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """All statistics of a cell."""
    counted = _exits(lines)
    done = [line for line in lines if not line["failure"]]
    yield f"\n{' · '.join(cell)}: {len(lines)} runs, exit {counted}"
    for line in lines:
        for said in [line["failure"]] if line["failure"] else line["contradictions"]:
            yield f"  seed {line['seed']}, exit {line['exit']}: {said}"
    if not done:
        return
    clouds = {name: _mean([line["clouds"][name] for line in done]) for name in done[0]["clouds"]}
    used = ", ".join(f"{name} {number:.0f}" for name, number in clouds.items())
    yield (
        f"  clouds: {used}, of {_mean([line['points'] for line in done]):.0f} points (median); "
        f"registration_scale {_scale(done)}; "
        f"{_seconds(done):.1f} s of CPU each"
    )
    for name, s in by_quantity([line_of(line) for line in done]).items():
        yield f"  {name + f', n = {s.runs}':30}{HEADING}"
        if (s.determined < s.runs).any():
            yield _row("runs that determine it", s.determined)
        yield _row("mean error", s.mean)
        yield _row("  in its standard errors", s.bias)
        judged = s.determined >= JUDGED_RUNS
        yield _row(
            "mean error / sigma", s.mean_over_sigma, judged & (s.mean_over_sigma > BIAS_LIMIT)
        )
        yield _row("RMSE", s.rmse)
        yield _row("RMSE / sigma", s.ratio, judged & _beyond(s.ratio, RATIO_LIMITS))
        yield f"    NEES {_nees([s])}"


def _row(label: str, values: Array, marked: BoolArray | None = None) -> str:
    marks = ["!" if m else "" for m in (np.zeros(6, bool) if marked is None else marked)]
    return f"    {label:26}{axis_cells(values, marks)}"


def _beyond(values: Array, limits: tuple[float, float]) -> BoolArray:
    return np.asarray((values < limits[0]) | (values > limits[1]))


def _scale(lines: Sequence[Mapping[str, Any]]) -> str:
    """Mean `registration_scale`. It is marked from one run on: it is hardly by chance."""
    scale = _mean([line["scale"] for line in lines])
    return f"{scale:.2f}{'' if SCALE_LIMITS[0] <= scale <= SCALE_LIMITS[1] else '!'}"


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else math.nan


def _seconds(lines: Sequence[Mapping[str, Any]]) -> float:
    return _mean([line["seconds"].get("total", math.nan) for line in lines])


def _exits(lines: Sequence[Mapping[str, Any]]) -> str:
    count = Counter(line["exit"] for line in lines)
    return ", ".join(f"{code}: {count[code]}x" for code in sorted(count))


def overview(by_cell: Mapping[Cell, Sequence[Mapping[str, Any]]]) -> Iterator[str]:
    """A line for each cell: the worst axes of S2V and of S2S."""
    yield (
        "Worst axis of each cell: mean error / sigma, RMSE / sigma (smallest to largest); mean "
        "NEES;\nmean registration_scale; clouds; points of the median cloud; seconds of CPU"
    )
    yield (
        f"{'':38}{'':22}{'mean / sigma':>16}{'RMSE / sigma':>26}{'NEES':>16}\n"
        f"{'object, LiDAR, drive':38}{'exit':22}{'S2V':>8}{'S2S':>8}{'S2V':>13}{'S2S':>13}"
        f"{'S2V':>8}{'S2S':>8}{'scale':>8}{'clouds':>8}{'points':>8}{'s':>7}"
    )
    for cell, lines in by_cell.items():
        name = f"{cell[0]:11} {cell[1]:8} {cell[2]}"
        done = [line for line in lines if not line["failure"]]
        text = f"{name:38}{_exits(lines):22}"
        if done:
            found = by_quantity([line_of(line) for line in done])
            kinds = [[s for q, s in found.items() if q.startswith(kind)] for kind in ("S2V", "S2S")]
            text += "".join(f"{_worst(of_kind):>8}" for of_kind in kinds)
            text += "".join(f"{_span(of_kind):>13}" for of_kind in kinds)
            text += "".join(f"{_nees(of_kind):>8}" for of_kind in kinds)
            text += f"{_scale(done):>8}"
            text += f"{_mean([sum(line['clouds'].values()) for line in done]):8.0f}"
            text += f"{_mean([line['points'] for line in done]):8.0f}{_seconds(done):7.1f}"
        yield text


def _worst(found: Sequence[Statistics]) -> str:
    values = np.concatenate([s.mean_over_sigma for s in found])
    judged = np.concatenate([s.determined >= JUDGED_RUNS for s in found])
    if np.isnan(values).all():
        return "-"
    mark = "!" if (judged & (values > BIAS_LIMIT)).any() else ""
    return f"{np.nanmax(values):.2f}{mark}"


def _span(found: Sequence[Statistics]) -> str:
    ratios = np.concatenate([s.ratio for s in found])
    judged = np.concatenate([s.determined >= JUDGED_RUNS for s in found])
    if np.isnan(ratios).all():
        return "-"
    mark = "!" if (judged & _beyond(ratios, RATIO_LIMITS)).any() else ""
    return f"{np.nanmin(ratios):.2f}-{np.nanmax(ratios):.2f}{mark}"


def _nees(found: Sequence[Statistics]) -> str:
    mean = _mean([s.nees for s in found])
    judged = min(s.nees_runs for s in found) >= JUDGED_RUNS
    mark = "!" if judged and not NEES_LIMITS[0] <= mean <= NEES_LIMITS[1] else ""
    return f"{mean:.1f}{mark}"


def pooled(by_cell: Mapping[Cell, Sequence[Mapping[str, Any]]]) -> Iterator[str]:
    """Errors over their sigmas, of all cells together, and of those of an object, LiDAR, drive."""
    axes = "".join(f"{axis:>8}" for axis in SHOWN)
    yield (
        "Errors over their own sigmas, pooled over cells. Of n runs, the mean is known to one over "
        f"the root of n.\n{'':30}{'runs':>5}{axes}{'NEES':>8}"
    )
    names = ("all", *dict.fromkeys(name for cell in by_cell for name in cell))
    for name in sorted(names, key=[*("all",), *OBJECTS, *LIDARS, *DRIVES].index):
        lines = [
            line
            for cell, of_cell in by_cell.items()
            for line in of_cell
            if name in ("all", *cell) and not line["failure"]
        ]
        found = by_quantity([_in_sigmas(line_of(line)) for line in lines])
        for quantity, s in found.items():
            judged = s.determined >= JUDGED_RUNS
            rows = (
                ("mean", s.mean, judged & (np.abs(s.mean) > BIAS_LIMIT)),
                ("RMS", s.rmse, judged & _beyond(s.rmse, RATIO_LIMITS)),
            )
            for label, values, marked in rows:
                cells = "".join(
                    f"{f'{value:.2f}{mark}' if math.isfinite(value) else '-':>8}"
                    for value, mark in zip(values, np.where(marked, "!", ""), strict=True)
                )
                first = label == "mean"
                title = f"{name if first else '':13}{quantity[:12] if first else '':12}{label:5}"
                end = f"{s.runs:5}{cells}{_nees([s]):>8}" if first else f"{'':5}{cells}"
                yield (title + end).rstrip()


def _in_sigmas(line: Line) -> Line:
    """A run with its errors over their sigmas, as if they were millimetres and milliradians."""
    return replace(
        line,
        quantities={
            name: replace(
                of,
                error=tuple(
                    1e-3 * e / s if s else math.nan for e, s in zip(of.error, of.sigma, strict=True)
                ),
                sigma=(1e-3,) * 6,
            )
            for name, of in line.quantities.items()
            if of.sigma is not None
        },
    )


# ------------------------------------------------------------------ recorded drives


def _print_recorded(option: str) -> bool:
    """Calibrates recorded drives and prints errors and sigmas; whether one had a defect."""
    defect = False
    for name, work in RECORDED[option]:
        try:
            result = work()
        except CalivError as e:
            print(f"\n{name}: skipped: {e}", flush=True)
            continue
        defect |= result.exit == DEFECT
        print("\n".join(recorded_table(name, result)), flush=True)
    return defect


def recorded_table(name: str, result: Result) -> Iterator[str]:
    """Errors of one drive beside the stated sigmas; axes that are not determined in neither."""
    yield f"\n{name}: exit {result.exit}, {result.failure or result.status}"
    said = dict.fromkeys((*result.contradictions, *result.undetermined))
    yield from (f"  {text}" for text in said)
    if result.failure:
        return
    used = ", ".join(f"{lidar} {number}" for lidar, number in result.clouds.items())
    yield (
        f"  clouds: {used}, of {result.points:.0f} points (median); registration_scale "
        f"{result.scale:.2f}; {result.seconds['total']:.1f} s of CPU"
    )
    line = line_of({"seed": 0, **asdict(result)})
    for quantity, s in by_quantity([line]).items():
        yield f"  {quantity:30}{HEADING}"
        yield _row("error", s.mean)
        yield _row("sigma", s.sigma)
        ratio = s.mean / s.sigma
        yield _row("error / sigma", ratio, np.abs(ratio) > RECORDED_LIMIT)
        yield f"    NEES {s.nees:.2f}"


if __name__ == "__main__":
    sys.exit(main())
