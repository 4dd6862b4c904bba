"""Errors of calibrations from raw sensors, per scenario, with new noise for every seed.

    .venv/bin/python scripts/benchmark_scenarios.py --scenarios figure_eight s_curve --seeds 3

Every run simulates the drive in memory (the bag that `caliv-graph simulate` writes holds the same),
calibrates it with the config that `simulate` writes, and compares with the truth. Errors are in
vehicle axes, mm and mrad. Errors of undetermined axes are left out, and their number is shown. NEES
is 6 on average if the covariance is right.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import parse_config
from caliv_graph.conventions import AXES
from caliv_graph.errors import CalivError
from caliv_graph.pipeline import calibrate
from caliv_graph.scenario.model import load_scenario
from caliv_graph.simulation.recording import simulate_drive
from caliv_graph.simulation.writer import config_of
from caliv_graph.uncertainty.evaluation import evaluate
from caliv_graph.uncertainty.pairs import pair_determined

FOLDER = Path(__file__).resolve().parents[1] / "configs" / "scenarios"
SCENARIOS = (
    *("figure_eight", "s_curve", "paper_arc", "ramp", "tri_lidar"),
    *("distorted", "noisy", "real_like", "overlap", "static"),
)
SHOWN = ("x", "y", "z", "roll", "pitch", "yaw")


@dataclass(frozen=True)
class Outcome:
    """One calibration against the truth.

    Attributes:
        scenario: its name.
        seed: seed of all draws.
        failure: reason for a missing result, or empty.
        status: of the calibration.
        seconds: CPU time without the simulation.
        rows: quantity ('S2V front') -> error per axis (rad and m; None: undetermined), and NEES.
        offsets_ms: per LiDAR, estimated time offset minus the true one.
    """

    scenario: str
    seed: int
    failure: str = ""
    status: str = ""
    seconds: float = 0.0
    rows: Mapping[str, tuple[Mapping[str, float | None], float]] | None = None
    offsets_ms: Mapping[str, float] | None = None


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenarios", nargs="+", default=list(SCENARIOS), metavar="NAME")
    parser.add_argument("--seeds", type=int, default=3, help="seeds 1 to N (default: 3)")
    parser.add_argument("--jobs", type=int, default=1, help="at a time (default: 1)")
    parser.add_argument("--search", action="store_true", help="give no target region: find it")
    parser.add_argument("--no-guess", action="store_true", help="give no initial guesses")
    parser.add_argument("--offsets", action="store_true", help="estimate time offsets")
    arguments = parser.parse_args()
    tasks = [
        (name, seed, arguments.search, arguments.offsets, arguments.no_guess)
        for name in arguments.scenarios
        for seed in range(1, arguments.seeds + 1)
    ]
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with ProcessPoolExecutor(arguments.jobs, get_context("spawn")) as pool:
        outcomes = list(pool.map(run, tasks))
    for name in arguments.scenarios:
        print(table(name, [o for o in outcomes if o.scenario == name]), flush=True)
    return 0


def run(task: tuple[str, int, bool, bool, bool]) -> Outcome:
    """Simulates, calibrates and compares once."""
    name, seed, search, offsets, no_guess = task
    recording = simulate_drive(load_scenario(FOLDER / f"{name}.yaml"), seed)
    raw = config_of(recording, has_bag=True)
    if search:
        raw.pop("target", None)
    if no_guess:
        for lidar in raw["lidars"].values():
            del lidar["initial"], lidar["sigma"]
    if offsets:
        raw["solve"] = {"time_offset": True}
    begun = time.process_time()
    try:
        config = parse_config(raw, f"{name}.yaml", FOLDER)
        calibration = calibrate([recording], config, SilentProgress()).calibration
    except CalivError as e:
        return Outcome(name, seed, failure=str(e))
    seconds = time.process_time() - begun
    errors = evaluate(calibration, recording.truth.T_vehicle_lidar)
    rows = {}
    for lidar, found in errors["lidars"].items():
        determined = calibration.lidars[lidar].determined
        rows[f"S2V {lidar}"] = (by_axis(found["s2v"], determined), found["s2v"]["nees"])
    for pair in errors["pairs"]:
        determined = pair_determined(calibration, pair["from"], pair["to"])
        rows[f"S2S {pair['from']} to {pair['to']}"] = (by_axis(pair, determined), pair["nees"])
    found_offsets = {
        lidar: 1e3 * (result.time_offset[0] - recording.truth.time_offset_s[lidar])
        for lidar, result in calibration.lidars.items()
        if result.time_offset is not None
    }
    return Outcome(name, seed, "", calibration.status, seconds, rows, found_offsets)


def by_axis(found: Mapping[str, Any], determined: Mapping[str, bool]) -> dict[str, float | None]:
    """Errors by axis; None for undetermined axes."""
    values = [*found["rotation_rad"], *found["translation_m"]]
    return {a: float(v) if determined[a] else None for a, v in zip(AXES, values, strict=True)}


def table(name: str, outcomes: Sequence[Outcome]) -> str:
    """Mean absolute errors and mean NEES of one scenario."""
    done = [o for o in outcomes if o.rows is not None]
    lines = [f"\n{name}: {len(done)} of {len(outcomes)} calibrated"]
    lines += [f"  seed {o.seed}: {o.failure}" for o in outcomes if o.failure]
    if not done:
        return lines[0] + "\n" + "\n".join(lines[1:])
    status = ", ".join(sorted({o.status for o in done}))
    seconds = np.mean([o.seconds for o in done])
    lines[0] += f", status {status}, {seconds:.0f} s of CPU each"
    heading = "".join(f"{a + (' mm' if a in 'xyz' else ' mrad'):>12}" for a in SHOWN)
    lines.append(f"  {'mean absolute error':28}{heading}{'NEES':>8}")
    gathered: dict[str, list[tuple[Mapping[str, float | None], float]]] = defaultdict(list)
    for outcome in done:
        for row, content in (outcome.rows or {}).items():
            gathered[row].append(content)
    for row, contents in gathered.items():
        cells = []
        for axis in SHOWN:
            determined = [abs(e[axis] or 0.0) for e, _ in contents if e[axis] is not None]
            cells.append(
                f"{1e3 * np.mean(determined):.2f}" if len(determined) == len(contents) else "-"
            )
        nees = np.mean([n for _, n in contents])
        lines.append(f"  {row:28}{''.join(f'{c:>12}' for c in cells)}{nees:8.1f}")
    for outcome in done:
        if outcome.offsets_ms:
            texts = [f"'{lidar}' {off:+.2f} ms" for lidar, off in outcome.offsets_ms.items()]
            lines.append(f"  seed {outcome.seed}: time offsets off by {', '.join(texts)}")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
