"""Calibrations of drives that are drawn at random, against the truth.

    .venv/bin/python scripts/benchmark_random.py --first 100 --last 139
    .venv/bin/python scripts/benchmark_random.py --first 400 --last 419 --options
    .venv/bin/python scripts/benchmark_random.py --summary

A drive is drawn from its seed: path, vehicle, one to three LiDARs, targets, walls, people, noise
(`_random_drives.py`). It is simulated in memory and calibrated with the config that `simulate`
writes, one in four without initial guesses. With --options, keys of the config are drawn as well:
mode, kernel, what is estimated. A run is a line in out/random/runs.jsonl, written when
it ends; a second start runs the missing ones. Runs of another version of the program do not count
unless --any-version is given. Errors are in vehicle axes, of the axes that the drive determines.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy

import numpy as np
from scipy.stats import chi2

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the modules beside this script from any folder

from caliv_graph.common.exits import DEFECT, DONE, INCONSISTENT, UNMET, USAGE
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import parse_config
from caliv_graph.errors import CalivError
from caliv_graph.pipeline import calibrate
from caliv_graph.results.run import CalibrationRun
from caliv_graph.scenario.model import dump_scenario
from caliv_graph.simulation.recording import SimulatedRecording, simulate_drive
from caliv_graph.simulation.writer import config_of
from scripts._guesses import drop_guesses
from scripts._judged import nees_text, outcome_of, sigmas_off, worst
from scripts._random_drives import RandomDrive, random_drive, with_options
from scripts._runs import add_line, code_digest, json_lines, performed

OUT = REPOSITORY / "out" / "random"

WRONG_SIGMAS = 4.0
"""An error beyond is called wrong: 40 normal errors of a drive do so once in 400 drives."""

RIGHT_SIGMAS = 3.0
"""An alarm is called false if no error is beyond."""

COMMON = 0.99
"""Probability that a sound NEES is within its limit."""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--first", type=int, default=100, help="seed (default: 100)")
    parser.add_argument("--last", type=int, default=119, help="seed (default: 119)")
    guesses = parser.add_mutually_exclusive_group()
    guesses.add_argument("--guess", action="store_true", help="always give initial guesses")
    guesses.add_argument("--no-guess", action="store_true", help="never give initial guesses")
    parser.add_argument("--options", action="store_true", help="draw keys of the config, too")
    parser.add_argument("--jobs", type=int, default=1, help="at a time (default: 1)")
    parser.add_argument("--show", action="store_true", help="only print the drives as scenarios")
    parser.add_argument("--summary", action="store_true", help="only print what is there")
    parser.add_argument("--any-version", action="store_true", help="count runs of older text too")
    parser.add_argument("--out", type=Path, default=OUT, help="folder (default: out/random)")
    asked = parser.parse_args(arguments)
    forced = True if asked.guess else False if asked.no_guess else None
    seeds = range(asked.first, asked.last + 1)
    if asked.show:
        for seed in seeds:
            drive = drawn(seed, forced, asked.options)
            print(f"# {drive.text}\n{dump_scenario(drive.scenario)}")
        return 0
    path = asked.out / "runs.jsonl"
    if not asked.summary:
        asked.out.mkdir(parents=True, exist_ok=True)
        done = {key_of(line) for line in lines_of(path, asked.any_version)}
        tasks = [task for seed in seeds if (task := (seed, forced, asked.options)) not in done]
        for _, line in performed(perform, tasks, asked.jobs):
            if isinstance(line, Exception):
                raise line
            add_line(path, line)
            print(text_of(line), flush=True)
    kind = (forced, asked.options)
    counted = [r for r in lines_of(path, asked.any_version) if key_of(r)[1:] == kind]
    print(summary([r for r in counted if asked.summary or r["seed"] in seeds]))
    return 0


Task = tuple[int, bool | None, bool]
"""Seed; whether there are initial guesses, None: as drawn; whether keys of the config are drawn."""


def drawn(seed: int, forced: bool | None, options: bool) -> RandomDrive:
    """The drive of a task."""
    drive = random_drive(seed)
    if forced is not None:
        drive = replace(drive, guess=forced)
    return with_options(drive) if options else drive


def perform(task: Task) -> dict[str, Any]:
    """Draws, simulates, calibrates and compares once; returns the line to write."""
    seed, forced, options = task
    drive = drawn(*task)
    recording = simulate_drive(drive.scenario, seed)
    line: dict[str, Any] = {"seed": seed, "forced": forced, "options": options}
    line["code"] = code_digest()
    line |= {"text": drive.text, "said": [], "warnings": [], "undetermined": [], "errors": {}}
    begun = time.process_time()
    try:
        run = calibrated(recording, drive)
    except CalivError as e:
        line |= {"exit": USAGE, "said": [f"{type(e).__name__}: {e}"]}
    except Exception:  # a defect on one drive must not end the others
        line |= {"exit": DEFECT, "said": [traceback.format_exc()]}
    else:
        line |= outcome_of(run.calibration, recording.truth.T_vehicle_lidar)
        line["warnings"] = list(run.calibration.warnings)
    return {**line, "cpu_s": time.process_time() - begun}


def calibrated(recording: SimulatedRecording, drive: RandomDrive) -> CalibrationRun:
    """Calibrates with the config that `simulate` writes, and the options of the drive.

    Raises:
        CalivError: there is no result.
    """
    raw = config_of(recording, has_bag=True)
    if not drive.guess:
        drop_guesses(raw)
    for section, keys in drive.options.items():
        raw[section] = {**raw.get(section, {}), **keys}
    return calibrate([recording], parse_config(raw, drive.text, REPOSITORY), SilentProgress())


# ------------------------------------------------------------------ lines


def lines_of(path: Path, any_version: bool) -> list[dict[str, Any]]:
    """The runs of a file that count, by seed; of a seed the last one."""
    lines = (x for x in json_lines(path) if any_version or x["code"] == code_digest())
    last = {key_of(line): line for line in lines}
    return sorted(last.values(), key=lambda line: int(line["seed"]))


def key_of(line: Mapping[str, Any]) -> Task:
    """The task of a line; older lines have no options."""
    return int(line["seed"]), line["forced"], bool(line.get("options", False))


def worst_sigmas(line: Mapping[str, Any]) -> float:
    """Largest error of a run over its sigma; 0 if nothing is determined."""
    return worst(line["errors"])


def is_wrong(line: Mapping[str, Any]) -> bool:
    """Whether the run is sure of something wrong and reports no contradiction."""
    return line["exit"] in (DONE, UNMET) and worst_sigmas(line) > WRONG_SIGMAS


def is_false_alarm(line: Mapping[str, Any]) -> bool:
    """Whether the run calls inputs contradictory, and all that it determines is right."""
    return bool(line["exit"] == INCONSISTENT) and worst_sigmas(line) < RIGHT_SIGMAS


def text_of(line: Mapping[str, Any]) -> str:
    """A run: what was driven, exit code, errors, messages."""
    mark = "  WRONG" if is_wrong(line) else "  FALSE ALARM" if is_false_alarm(line) else ""
    out = [f"{line['seed']}: {line['text']}: exit {line['exit']}, {line['cpu_s']:.0f} s{mark}"]
    for name, of in line["errors"].items():
        shown = ["-" if e is None else f"{1e3 * e:.2f}" for e in of["error"]]
        off = iter(sigmas_off(of))
        sigmas = " ".join("-" if e is None else f"{next(off):.1f}" for e in of["error"])
        out.append(
            f"  {name}: {' '.join(shown[:3])} mrad, {' '.join(shown[3:])} mm; "
            f"sigmas {sigmas}{nees_text(of)}"
        )
    out += [f"  not determined: {text}" for text in line["undetermined"]]
    out += [f"  {text}" for text in line["said"]]
    return "\n".join(out)


def summary(lines: Sequence[Mapping[str, Any]]) -> str:
    """Exit codes, consistency, and what to look at."""
    codes = Counter(line["exit"] for line in lines)
    out = [f"{len(lines)} drives; exit " + ", ".join(f"{c}: {n}" for c, n in sorted(codes.items()))]
    for kind in ("S2V", "S2S"):
        out += _consistency(kind, lines)
    for title, chosen in (
        (f"exit 0 or 3 and an error over {WRONG_SIGMAS:g} sigma", filter(is_wrong, lines)),
        (f"exit 4 and no error over {RIGHT_SIGMAS:g} sigma", filter(is_false_alarm, lines)),
    ):
        found = [f"{line['seed']} ({worst_sigmas(line):.1f})" for line in chosen]
        out.append(f"{title}: {len(found)}" + (f": {', '.join(found)}" if found else ""))
    for line in lines:
        if line["exit"] in (DEFECT, USAGE, UNMET):
            last = line["said"][0].strip().splitlines()[-1]
            out.append(f"exit {line['exit']}, seed {line['seed']}: {last}")
    return "\n".join(out)


def _consistency(kind: str, lines: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """The NEES of all S2V or S2S of the runs with exit code 0, per determined axis times 6."""
    judged = [
        (float(of["nees"]), int(of["axes"]))
        for line in lines
        if line["exit"] == DONE
        for name, of in line["errors"].items()
        if name.startswith(kind) and of["nees"] is not None
    ]
    if not judged:
        return
    nees, axes = (np.array(column) for column in zip(*judged, strict=True))
    six = 6.0 * nees / axes
    share = float(np.mean(nees <= chi2.ppf(COMMON, axes)))
    yield (
        f"{kind} of exit 0, {len(nees)}: NEES for six axes: median {np.median(six):.1f} "
        f"(ideal 5.3), 90 % below {np.quantile(six, 0.9):.1f} (ideal 10.6), "
        f"{share:.0%} within the {COMMON:.0%} limit"
    )


if __name__ == "__main__":
    sys.exit(main())
