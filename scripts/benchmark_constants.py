"""What halving and doubling the constants that decide results changes, on simulated drives.

Needs the environment that scripts/demo makes:

    .venv/bin/python scripts/benchmark_constants.py
    .venv/bin/python scripts/benchmark_constants.py --only mixture.BESIDE --seeds 5
    .venv/bin/python scripts/benchmark_constants.py --summary

Each drive is simulated and calibrated with every constant as it is, then with one constant at a
time at half and at twice its value; a fraction takes the two values that the table of constants
(scripts/_constants_table.py) states. Seed n draws the same drive each time, so that the difference
is due to the constant alone. A run is a line in out/constants/runs.jsonl, written as it is done: a
second start does what is missing. Runs of another version of the program, another scenario or
another config do not count. The tables go to stdout as Markdown, and with all numbers to
out/constants/constants.json.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import hashlib
import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: one process per core
REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # for the modules beside this script, run from anywhere

import gtsam
import numpy as np

import caliv_graph
from caliv_graph.config.load import dump_config
from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.products import Array
from caliv_graph.scenario.model import InitialGuessModel, dump_scenario
from caliv_graph.simulation import simulate_drive
from scripts._command import add_beams, exit_code_of, positive
from scripts._constants_drives import DRIVES, config_of_drive, performed, scenario_of
from scripts._constants_table import CONFIG, CONSTANTS, Constant
from scripts._patched import PACKAGE, patched

OUT = REPOSITORY / "out" / "constants"

NOT_RUN = ("caliv_graph.planning", "caliv_graph.validation")
"""Packages that a calibration does not use; what they took of a constant at import stays."""


@dataclass(frozen=True)
class Task:
    """One run.

    Attributes:
        constant: its name; empty: all are as they are.
        which: "less" or "more".
        drive: one of `DRIVES`.
        seed: of all that is drawn.
    """

    constant: str
    which: str
    drive: str
    seed: int


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", metavar="NAME", help="constants, such as noise.GROSS")
    parser.add_argument("--seeds", type=positive, help="1 to N on every drive (default: 1 to 3)")
    parser.add_argument("--jobs", type=positive, default=1, help="processes (default: 1)")
    parser.add_argument("--summary", action="store_true", help="only print what is there")
    parser.add_argument("--out", type=Path, default=OUT, help="folder (default: out/constants)")
    add_beams(parser)
    asked = parser.parse_args(arguments)
    unknown = set(asked.only or ()) - {constant.name for constant in CONSTANTS}
    if unknown:
        parser.error(f"no constant {', '.join(sorted(unknown))}; there are {_names()}")
    chosen = [c for c in CONSTANTS if not asked.only or c.name in asked.only]
    defects = []
    if not asked.summary:
        asked.out.mkdir(parents=True, exist_ok=True)
        check(chosen)
        defects = run_missing(tasks_of(chosen, asked.seeds), asked.out, asked.beams, asked.jobs)
    print(summary(chosen, asked.out, asked.seeds), flush=True)
    for text in defects:
        print(text, file=sys.stderr)
    return 1 if defects else 0


def _names() -> str:
    return ", ".join(constant.name for constant in CONSTANTS)


def changed(constant: Constant, which: str) -> Any:
    """The value of a constant in a run.

    Args:
        constant: which one.
        which: "less", "more", or "" for its own.
    """
    value = constant.value()
    return {"": lambda v: v, "less": constant.less, "more": constant.more}[which](value)


def check(constants: Sequence[Constant]) -> None:
    """Tries every change once, so that nothing is found out after an hour.

    Raises:
        UnreachableError: a constant is gone, or cannot be changed.
    """
    for constant in constants:
        for which in ("less", "more"):
            value = changed(constant, which)
            if repr(value) == repr(constant.value()):
                raise ValueError(f"{constant.name} does not change")
            if constant.module != CONFIG:
                with patched(constant.module, constant.attribute, value, NOT_RUN):
                    pass


# ------------------------------------------------------------------ runs


def tasks_of(constants: Sequence[Constant], seeds: int | None) -> list[Task]:
    """All runs, those of one drive and seed one after the other, the unchanged first."""
    wanted: dict[tuple[str, int], list[Task]] = {}
    for constant in constants:
        for drive, few in constant.drives:
            for seed in range(1, (seeds or few) + 1):
                own = wanted.setdefault((drive, seed), [Task("", "", drive, seed)])
                own += [Task(constant.name, which, drive, seed) for which in ("less", "more")]
    order = sorted(wanted, key=lambda key: (list(DRIVES).index(key[0]), key[1]))
    return [task for key in order for task in wanted[key]]


def perform(task: Task, beams: Path) -> dict[str, Any]:
    """Simulates and calibrates once; the line to write."""
    line = {**dataclasses.asdict(task), "digest": digest(task), "code": code_digest()}
    given: tuple[str, int, Path] = (task.drive, task.seed, beams)
    if not task.constant:
        return {**line, **performed(*given, {}, early=False)}
    constant = _constant(task.constant)
    value = changed(constant, task.which)
    if constant.module == CONFIG:
        section, key = constant.attribute.split(".")
        return {**line, **performed(*given, {section: {key: value}})}
    with patched(constant.module, constant.attribute, value, NOT_RUN):
        return {**line, **performed(*given, {}, early=constant.early)}


def _constant(name: str) -> Constant:
    return next(constant for constant in CONSTANTS if constant.name == name)


def run_missing(tasks: Sequence[Task], out: Path, beams: Path, jobs: int) -> list[str]:
    """Does the tasks that the file has not, each written down as it is done.

    Args:
        tasks: what there shall be.
        out: folder of the results.
        beams: folder of the beams that matter.
        jobs: processes; each takes one drive and seed at a time.

    Returns:
        A sentence for each task that ended in a defect of the program; they are not written.
    """
    kept = read(out)
    missing = [task for task in tasks if task not in kept]
    groups: dict[tuple[str, int], list[Task]] = {}
    for task in missing:
        groups.setdefault((task.drive, task.seed), []).append(task)
    defects, done = [], 0
    for task, line in _performed(list(groups.values()), beams, jobs):
        done += 1
        where = f"{task.drive} seed {task.seed}, {task.constant or 'as it is'} {task.which}".strip()
        if isinstance(line, str):
            defects.append(f"{where}: {line}")
            print(f"{done}/{len(missing)} {where}: defect", flush=True)
            continue
        with (out / "runs.jsonl").open("a", encoding="utf-8") as file:
            file.write(f"{json.dumps(line)}\n")
        said = line["failure"] or f"{line['seconds']:.1f} s"
        print(f"{done}/{len(missing)} {where}: {said}", flush=True)
    return defects


def _performed(
    groups: Sequence[Sequence[Task]], beams: Path, jobs: int
) -> Iterator[tuple[Task, dict[str, Any] | str]]:
    """Tasks and their lines, or what went wrong, as they are done."""
    if jobs == 1:
        for tasks in groups:
            for task in tasks:
                yield from _all_of([task], beams)
        return
    # Spawned: threads of open3d do not survive a fork.
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        futures = [pool.submit(_all_of, tasks, beams) for tasks in groups]
        for future in as_completed(futures):
            yield from future.result()


def _all_of(tasks: Sequence[Task], beams: Path) -> list[tuple[Task, dict[str, Any] | str]]:
    out: list[tuple[Task, dict[str, Any] | str]] = []
    for task in tasks:
        try:
            out.append((task, perform(task, beams)))
        except Exception as e:
            out.append((task, f"{type(e).__name__}: {e}"))
    return out


# ------------------------------------------------------------------ files


@functools.cache
def _drive_text(drive: str) -> str:
    """What the runs of a drive depend on."""
    model = scenario_of(drive)
    exact = model.model_copy(
        update={"initial_guess": InitialGuessModel(translation_m=0.0, rotation_deg=0.0)}
    )
    config = config_of_drive(drive, simulate_drive(exact, 0))
    made = DRIVES[drive]
    return "\n".join(
        [caliv_graph.__version__, made.text, dump_scenario(model), dump_config(config)]
    )


@functools.cache
def digest(task: Task) -> str:
    """What a result depends on besides its seed: drive, config, and the constant's values."""
    own = ""
    if task.constant:
        constant = _constant(task.constant)
        own = f"{constant.value()!r} {changed(constant, task.which)!r}"
    return hashlib.sha256(f"{_drive_text(task.drive)}\n{own}".encode()).hexdigest()[:16]


@functools.cache
def code_digest() -> str:
    """Of the package's text: runs before and after a change can be told apart."""
    out = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        out.update(path.read_bytes())
    return out.hexdigest()[:8]


def read(out: Path) -> dict[Task, dict[str, Any]]:
    """The runs that are done and belong to what is asked now; half a line is none."""
    path, kept = out / "runs.jsonl", {}
    names = {constant.name for constant in CONSTANTS}
    for text in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            continue
        task = Task(*(line[field.name] for field in dataclasses.fields(Task)))
        known = task.drive in DRIVES and (not task.constant or task.constant in names)
        if known and line["digest"] == digest(task):
            kept[task] = line
    return kept


# ------------------------------------------------------------------ tables


@dataclass(frozen=True)
class Effect:
    """What the runs of one drive say of one value of a constant, mean or largest over the seeds.

    Translations are in mm, rotations in mrad; largest over LiDARs or pairs, axes and seeds, axes
    that are not determined left out.

    Attributes:
        runs: seeds.
        failures: of them without a result.
        s2s: (translation, rotation) by which S2S differs from that with the constant's own value.
        s2s_sigmas: the same over the sigmas that the run with its own value states.
        s2v: as `s2s`, of S2V.
        s2v_sigmas: as `s2s_sigmas`.
        sigma: sigmas of S2S over those with its own value, geometric mean.
        error_s2s: (translation, rotation) root mean square error against the truth.
        error_s2v: the same.
        nees_s2s: mean; 6 is right.
        nees_s2v: the same.
        down: clouds of less than half their weight, mean.
        said: statuses, how many runs of each.
        same: whether every pose is the same to the last bit.
    """

    runs: int
    failures: int
    s2s: tuple[float, float]
    s2s_sigmas: tuple[float, float]
    s2v: tuple[float, float]
    s2v_sigmas: tuple[float, float]
    sigma: float
    error_s2s: tuple[float, float]
    error_s2v: tuple[float, float]
    nees_s2s: float
    nees_s2v: float
    down: float
    said: Mapping[str, int]
    same: bool


def effect(own: Sequence[Mapping[str, Any]], other: Sequence[Mapping[str, Any]]) -> Effect:
    """Compares runs with a constant changed with those without, seed by seed.

    Args:
        own: lines of the runs with every constant as it is, in order of their seeds.
        other: lines of those with one changed, in the same order.
    """
    both = [(a, b) for a, b in zip(own, other, strict=True) if not (a["failure"] or b["failure"])]
    kinds: dict[str, list[tuple[Array, Array, Array, Array, float | None]]] = {}
    for a, b in both:
        for name, stated in a["quantities"].items():
            found = b["quantities"][name]
            moved = _moved(name, a["poses"], b["poses"])
            usable = np.array(stated["determined"]) & np.array(found["determined"])
            values = [np.where(usable, v, np.nan) for v in (moved, found["error"])]
            sigmas = [np.where(usable, v, np.nan) for v in (stated["sigma"], found["sigma"])]
            kinds.setdefault(name[:3], []).append((*values, *sigmas, found["nees"]))
    columns: dict[str, Any] = {}
    for kind in ("S2S", "S2V"):
        rows = kinds.get(kind, [])
        moved, error, before, after = (
            np.array([row[i] for row in rows]).reshape(-1, 6) for i in range(4)
        )
        low = kind.lower()
        columns[low] = _largest(1e3 * moved)
        columns[f"{low}_sigmas"] = _largest(moved / before)
        columns[f"error_{low}"] = tuple(
            _mean(1e6 * error[:, part] ** 2) ** 0.5 for part in (slice(3, 6), slice(0, 3))
        )
        columns[f"nees_{low}"] = _mean(np.array([row[4] for row in rows if row[4] is not None]))
        if kind == "S2S":
            columns["sigma"] = float(np.exp(_mean(np.log(after / before))))
    said: dict[str, int] = {}
    for line in other:
        key = line.get("status", "failed")
        said[key] = said.get(key, 0) + 1
    return Effect(
        runs=len(other),
        failures=sum(bool(line["failure"]) for line in other),
        down=_mean(np.array([b["down"] for _, b in both])),
        said=said,
        same=all(a["poses"] == b["poses"] for a, b in both),
        **columns,
    )


def _moved(name: str, own: Mapping[str, Any], other: Mapping[str, Any]) -> Array:
    """(6,) difference of 'S2V a' or 'S2S a to b', vehicle axes, as `evaluate` has errors."""
    old = {k: gtsam.Pose3(np.reshape(v, (4, 4))) for k, v in own.items()}
    new = {k: gtsam.Pose3(np.reshape(v, (4, 4))) for k, v in other.items()}
    kind, lidars = name[:3], name[4:].split(" to ")
    if kind == "S2V":
        return vehicle_axes_difference(new[lidars[0]], old[lidars[0]])
    a, b = lidars
    return vehicle_axes_difference(new[a], new[b].compose(old[b].between(old[a])))


def _largest(values: Array) -> tuple[float, float]:
    """Of translations and of rotations; NaN if there are none."""
    return tuple(  # type: ignore[return-value]
        float(np.nanmax(np.abs(part))) if np.isfinite(part).any() else float("nan")
        for part in (values[:, 3:], values[:, :3])
    )


def _mean(values: Array) -> float:
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else float("nan")


def summary(constants: Sequence[Constant], out: Path, seeds: int | None = None) -> str:
    """Tables of what is there, in Markdown; the numbers go to constants.json."""
    lines = read(out)
    parts = [
        "| constant | in | value | unit | what it is | source or reason |",
        "|---|---|---|---|---|---|",
    ]
    parts += [
        f"| `{c.name}` | {c.file} | {_shown(_part(c, c.value()))} | {c.unit or '-'} | {c.text} "
        f"| {c.reason} |"
        for c in constants
    ]
    numbers: list[dict[str, Any]] = []
    for drive in DRIVES:
        rows = _rows(drive, constants, lines, seeds)
        if rows:
            parts += ["", f"**{drive}**: {DRIVES[drive].text}.", "", *HEADER]
            parts += [text for text, _ in rows]
            numbers += [of_row for _, of_row in rows]
    codes = sorted({line["code"] for line in lines.values()})
    if out.exists():
        whole = {"code": codes, "rows": numbers}
        (out / "constants.json").write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")
    if len(codes) > 1:
        parts += ["", f"From {len(codes)} versions of the code."]
    return "\n".join(parts) if numbers else "no runs yet"


HEADER = (
    "| constant | value | seeds | S2S moves mm (sigma) | mrad (sigma) | S2V moves mm (sigma) "
    "| mrad (sigma) | S2S sigmas | S2S error mm, mrad | S2V error mm, mrad | NEES S2S, S2V "
    "| clouds down | status |",
    "|" + "---|" * 13,
)


def _rows(
    drive: str,
    constants: Sequence[Constant],
    lines: Mapping[Task, Mapping[str, Any]],
    seeds: int | None,
) -> list[tuple[str, dict[str, Any]]]:
    """Rows of the table of one drive, and their numbers."""
    rows, numbers = [], set()
    for constant in constants:
        few = dict(constant.drives).get(drive, 0)
        for which in ("less", "more"):
            tasks = [
                Task(constant.name, which, drive, seed)
                for seed in range(1, (seeds or few) + 1 if few else 0)
            ]
            done = [t for t in tasks if t in lines and Task("", "", drive, t.seed) in lines]
            if done:
                own = [lines[Task("", "", drive, task.seed)] for task in done]
                value = _shown(_part(constant, changed(constant, which)))
                found = effect(own, [lines[task] for task in done])
                rows.append(_row(f"`{constant.name}`", value, found, drive))
                numbers.add(tuple(task.seed for task in done))
    base = []
    for seeds_of in sorted(numbers, key=len):
        own = [lines[Task("", "", drive, seed)] for seed in seeds_of]
        base.append(_row("as they are", "", effect(own, own), drive))
    return base + rows


def _part(constant: Constant, value: Any) -> Any:
    """The part of the value that the row is about."""
    return value[int(constant.part.strip("[]"))] if constant.part else value


def _shown(value: Any) -> str:
    if dataclasses.is_dataclass(value):
        return ", ".join(f"{v:.3g}" for v in dataclasses.astuple(value)[:-1])  # type: ignore[arg-type]
    if isinstance(value, np.ndarray):
        return ", ".join(f"{v:.3g}" for v in dict.fromkeys(value.tolist()))
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _row(name: str, value: str, found: Effect, drive: str) -> tuple[str, dict[str, Any]]:
    def moved(size: tuple[float, float], sigmas: tuple[float, float], i: int) -> str:
        if found.same and value:
            return "0"
        return "-" if np.isnan(size[i]) or not value else f"{size[i]:.3g} ({sigmas[i]:.2g})"

    def pair(values: tuple[float, float], form: str) -> str:
        return ", ".join("-" if np.isnan(v) else format(v, form) for v in values)

    n = found.runs
    said = ", ".join(f"{status} {count}/{n}" for status, count in sorted(found.said.items()))
    cells = [
        name,
        value or "-",
        str(n),
        moved(found.s2s, found.s2s_sigmas, 0),
        moved(found.s2s, found.s2s_sigmas, 1),
        moved(found.s2v, found.s2v_sigmas, 0),
        moved(found.s2v, found.s2v_sigmas, 1),
        f"{found.sigma:.2f}" if value else "-",
        pair(found.error_s2s, ".2f"),
        pair(found.error_s2v, ".2f"),
        pair((found.nees_s2s, found.nees_s2v), ".1f"),
        f"{found.down:.0f}",
        said,
    ]
    numbers = {"constant": name.strip("`"), "value": value, "drive": drive}
    return "| " + " | ".join(cells) + " |", {**numbers, **dataclasses.asdict(found)}


if __name__ == "__main__":
    sys.exit(exit_code_of(main))
