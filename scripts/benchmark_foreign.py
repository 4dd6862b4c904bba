"""Calibrations of drives that another simulator than the project's wrote, against the truth.

    .venv/bin/python scripts/benchmark_foreign.py --scenarios eight robot --seeds 1
    .venv/bin/python scripts/benchmark_foreign.py --scenarios slalom --off edges,channel_angle
    .venv/bin/python scripts/benchmark_foreign.py --scenarios random --first 1 --seeds 20

The simulator (`_foreign_*.py`) imports nothing from caliv_graph. It writes a bag, a config as a
user would, with errors of lever arms and guesses, and the truth; the bag is calibrated as
`caliv-graph calibrate` does. Errors are in vehicle axes, of the axes that the drive determines,
with their sigmas. The scenario `random` draws course, vehicle, LiDARs, place and sensors from the
seed (`_foreign_random.py`); it is not among those that run by default. Bags stay in the folder
(about half a GB for two LiDARs) only with --keep.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the modules beside this script from any folder

from caliv_graph._open3d import import_open3d
from caliv_graph.batch.job import open_recordings, run_job
from caliv_graph.common.exits import USAGE
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import load_config
from caliv_graph.errors import CalivError
from caliv_graph.results.truth_file import read_truth
from scripts._command import exit_code_of, positive
from scripts._foreign_draws import EFFECTS, Draws
from scripts._foreign_drives import SCENARIOS, simulate
from scripts._foreign_random import in_words, random_scenario
from scripts._judged import outcome_of, rows_of

OUT = REPOSITORY / "out" / "foreign"

RANDOM = "random"
"""The scenario that is drawn from the seed."""


def main(arguments: Sequence[str] | None = None) -> int:
    effects = "\n".join(f"  {name:20}{text}" for name, text in EFFECTS.items())
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").splitlines()[0],
        epilog=f"effects:\n{effects}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--scenarios",
        nargs="+",
        choices=[*SCENARIOS, RANDOM],
        default=list(SCENARIOS),
        metavar="NAME",
    )
    parser.add_argument("--seeds", type=positive, default=1, help="how many (default: 1)")
    parser.add_argument("--first", type=positive, default=1, help="the first seed (default: 1)")
    parser.add_argument("--off", type=effects_of, default=frozenset(), metavar="EFFECT,...")
    parser.add_argument(
        "--deskewed",
        action="store_true",
        help="points are moved to the stamp, and keep their times",
    )
    parser.add_argument("--keep", action="store_true", help="keep the bags")
    parser.add_argument("--out", type=Path, default=OUT, help="folder (default: out/foreign)")
    asked = parser.parse_args(arguments)
    import_open3d()  # with its shared libraries, for the simulator as well
    for name in asked.scenarios:
        for seed in range(asked.first, asked.first + asked.seeds):
            draws = Draws(name, seed, asked.off)
            folder = asked.out / f"{name}_{seed}"
            print(text_of(draws, folder, asked.keep, asked.deskewed), flush=True)
    return 0


def effects_of(text: str) -> frozenset[str]:
    """Effects that are named with commas between them."""
    names = frozenset(text.split(","))
    unknown = sorted(names - EFFECTS.keys())
    if unknown:
        raise argparse.ArgumentTypeError(f"no such effect: {', '.join(unknown)}; see --help")
    return names


def text_of(draws: Draws, folder: Path, keep: bool, deskewed: bool = False) -> str:
    """Simulates, calibrates and compares once; what to print."""
    if folder.exists():
        shutil.rmtree(folder)
    drawn = draws.scenario == RANDOM
    scenario = random_scenario(draws.seed) if drawn else SCENARIOS[draws.scenario]
    if deskewed:
        lidars = {name: replace(of, deskewed=True) for name, of in scenario.lidars.items()}
        scenario = replace(scenario, lidars=lidars)
    simulate(scenario, draws, folder)
    title = f"{draws.scenario}, seed {draws.seed}"
    if drawn:
        title += f" ({in_words(scenario)})"
    if deskewed:
        title += ", deskewed"
    if draws.off:
        title += f", without {', '.join(sorted(draws.off))}"
    begun = time.monotonic()
    try:
        config = load_config(folder / "config.yaml")
        job = run_job(open_recordings(config, ()), config, SilentProgress())
    except CalivError as e:
        return f"{title}: exit {USAGE}: {e}"
    wall_s = time.monotonic() - begun
    outcome = outcome_of(job.calibration, read_truth(folder / "truth.yaml"))
    if not keep:
        shutil.rmtree(folder / "drive")
    return "\n".join([f"{title}: exit {outcome['exit']}, {wall_s:.0f} s", *rows_of(outcome)])


if __name__ == "__main__":
    sys.exit(exit_code_of(main))
