"""Calibrations without initial guesses beside those of the same drives with them.

    .venv/bin/python scripts/benchmark_no_guess.py
    .venv/bin/python scripts/benchmark_no_guess.py --scenarios paper_arc --seeds 2 --summary

By the installed command: `simulate` writes a bag and its config, `calibrate` runs with that config,
and with the same without `initial` and `sigma` of every LiDAR. Printed per drive: exit codes, how
far S2S of the two are apart (mm, mrad, sigmas of the one without), the largest error against the
truth in sigmas, which S2V is determined, processor time over that with guesses. A drive is a line
in out/no_guess/runs.jsonl; a second start runs the missing ones.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gtsam
import yaml

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the modules beside this script from any folder

from caliv_graph.common.exits import DONE, UNMET, USAGE
from caliv_graph.errors import CalivError
from caliv_graph.products import Calibration
from caliv_graph.results.calibration_file import read_calibration
from caliv_graph.results.truth_file import read_truth
from scripts._command import calibrate_measured, run_command
from scripts._guesses import drop_guesses
from scripts._judged import judged, outcome_of, worst
from scripts._runs import add_line, code_digest, json_lines, performed

OUT = REPOSITORY / "out" / "no_guess"
FOLDER = REPOSITORY / "configs" / "scenarios"

SEEDS = {"figure_eight": 10, "tri_lidar": 10, "paper_arc": 20}
"""Scenario -> seeds 1 to this: figure-eights of two and three LiDARs, an arc, on which S2V is
in part not determined."""

LARGEST_TIME = 1.5
"""Times the processor time with guesses that a run without may take."""

SAME_SIGMAS = 1.0
"""Two results are the same if S2S differs by less: as much as chance makes of either."""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenarios", nargs="+", default=list(SEEDS), metavar="NAME")
    parser.add_argument("--seeds", type=int, help="seeds 1 to N (default: 10, 10, and 20)")
    parser.add_argument("--jobs", type=int, default=1, help="at a time (default: 1)")
    parser.add_argument("--summary", action="store_true", help="only print what is there")
    parser.add_argument("--any-version", action="store_true", help="count runs of older text too")
    parser.add_argument("--out", type=Path, default=OUT, help="folder (default: out/no_guess)")
    asked = parser.parse_args(arguments)
    tasks = [
        (name, seed)
        for name in asked.scenarios
        for seed in range(1, (asked.seeds or SEEDS.get(name, 10)) + 1)
    ]
    path = asked.out / "runs.jsonl"
    if not asked.summary:
        asked.out.mkdir(parents=True, exist_ok=True)
        done = {(line["scenario"], line["seed"]) for line in lines_of(path, asked.any_version)}
        missing = [task for task in tasks if task not in done]
        for _, line in performed(perform, missing, asked.jobs):
            if isinstance(line, Exception):
                raise line
            add_line(path, line)
            print(text_of(line), flush=True)
    counted = lines_of(path, asked.any_version)
    print(summary([line for line in counted if (line["scenario"], line["seed"]) in tasks]))
    return 0


def perform(task: tuple[str, int]) -> dict[str, Any]:
    """Simulates one drive and calibrates it with and without guesses; returns the line to write.

    Raises:
        CalivError: the drive could not be simulated.
    """
    scenario, seed = task
    line: dict[str, Any] = {"scenario": scenario, "seed": seed, "code": code_digest()}
    found: dict[str, Calibration] = {}
    with TemporaryDirectory(prefix="no_guess_") as name:
        folder = Path(name)
        run_command(
            *("simulate", FOLDER / f"{scenario}.yaml", "--out", folder / "drive", "--seed", seed)
        )
        truth = read_truth(folder / "drive" / "truth.yaml")
        for way in ("with", "without"):
            config, result = folder / "drive" / f"{way}.yaml", folder / way
            raw = yaml.safe_load((folder / "drive" / "config.yaml").read_text(encoding="utf-8"))
            if way == "without":
                drop_guesses(raw)
            config.write_text(yaml.safe_dump(raw), encoding="utf-8")
            line[way] = {"exit": USAGE, "said": [], "undetermined": [], "cpu_s": math.nan}
            try:
                usage = calibrate_measured(config, result)
            except CalivError as e:
                line[way]["said"] = [str(e)]
                continue
            found[way] = calibration = read_calibration(result / "calibration.yaml")
            line[way] |= outcome_of(calibration, truth) | {"exit": usage.code, "cpu_s": usage.cpu_s}
    if len(found) == 2:
        other = {name: lidar.T_vehicle_lidar for name, lidar in found["with"].lidars.items()}
        line["apart"] = apart(found["without"], other)
    return line


def apart(
    calibration: Calibration, T_vehicle_lidar: Mapping[str, gtsam.Pose3]
) -> dict[str, dict[str, Any]]:
    """S2S of a calibration less that of other extrinsics, as `judged` gives it."""
    found = judged(calibration, T_vehicle_lidar)
    return {name: of for name, of in found.items() if name.startswith("S2S")}


def lines_of(path: Path, any_version: bool) -> list[dict[str, Any]]:
    """The runs of a file that count; of a drive the last one."""
    lines = (x for x in json_lines(path) if any_version or x["code"] == code_digest())
    last = {(line["scenario"], line["seed"]): line for line in lines}
    return [last[key] for key in sorted(last)]


def is_same(line: Mapping[str, Any]) -> bool:
    """Whether both runs ended well and S2S is determined, and the same, in both."""
    return (
        all(line[name]["exit"] in (DONE, UNMET) for name in ("with", "without"))
        and line["with"]["exit"] == line["without"]["exit"]
        and all(of["axes"] == 6 for of in line["apart"].values())
        and worst(line["apart"]) < SAME_SIGMAS
    )


def largest(line: Mapping[str, Any], own: slice) -> float:
    """Largest difference of S2S in some of the six axes, thousandths."""
    found = (e for of in line["apart"].values() for e in of["error"][own] if e is not None)
    return max((abs(1e3 * e) for e in found), default=0.0)


def time_ratio(line: Mapping[str, Any]) -> float:
    """Processor time without guesses over that with."""
    return float(line["without"]["cpu_s"] / line["with"]["cpu_s"])


def text_of(line: Mapping[str, Any]) -> str:
    """A drive: what its two runs say."""
    start = f"{line['scenario']} {line['seed']}: exit {line['with']['exit']}"
    if "apart" not in line:
        return f"{start}, without guesses {line['without']}"
    determined = {
        name: [e is not None for e in of["error"]]
        for name, of in line["without"]["errors"].items()
        if name.startswith("S2V")
    }
    axes = "; ".join(f"{name} determines {sum(axes)} of 6" for name, axes in determined.items())
    return (
        f"{start}, {line['without']['exit']}; S2S apart by {largest(line, slice(3, 6)):.2f} mm, "
        f"{largest(line, slice(0, 3)):.3f} mrad, {worst(line['apart']):.2f} sigma; errors at most "
        f"{worst(line['without']['errors']):.1f} sigma (with guesses "
        f"{worst(line['with']['errors']):.1f}); {axes}; time {time_ratio(line):.2f}"
        + ("" if is_same(line) else "  DIFFERS")
    )


def summary(lines: Sequence[Mapping[str, Any]]) -> str:
    """A row per scenario."""
    out = []
    for scenario in dict.fromkeys(line["scenario"] for line in lines):
        own = [line for line in lines if line["scenario"] == scenario]
        both = [line for line in own if "apart" in line]
        text = (
            f"{scenario}: the same in {sum('apart' in x and is_same(x) for x in own)} of {len(own)}"
        )
        if both:
            ratio = sorted(map(time_ratio, both))
            named = sum(bool(line["without"]["undetermined"]) for line in both)
            text += (
                f"; S2S apart by at most {max(largest(x, slice(3, 6)) for x in both):.2f} mm, "
                f"{max(largest(x, slice(0, 3)) for x in both):.3f} mrad, "
                f"{max(worst(x['apart']) for x in both):.2f} sigma; something named undetermined "
                f"in {named}; time {ratio[len(ratio) // 2]:.2f} in the median, {ratio[-1]:.2f} at "
                f"most (limit {LARGEST_TIME:g})"
            )
        out.append(text)
    return "\n".join(out)


if __name__ == "__main__":
    sys.exit(main())
