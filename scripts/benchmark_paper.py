"""The paper's own estimator, reimplemented, and ours: same clouds, same guesses, same machine.

Needs the environment that scripts/demo makes: .venv/bin/python scripts/benchmark_paper.py

Simulates each scenario with seeds 1 to N (`--runs`), keeps its clouds in memory, and calibrates
them from the initial guess of the simulated drive (`--starts truth`: from the true extrinsics, the
best case of the paper's estimator). `--released` does the same on the drive that the CaLiV authors
published, from drawn guesses. Errors are in vehicle axes, mean absolute over the runs, as the paper
defines them. Each run is a line of `out/paper/NAME.jsonl`; existing lines are not run again.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: one core for both
REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the estimator beside this script from any folder

import gtsam
import numpy as np

from caliv_graph import __version__
from caliv_graph._open3d import import_open3d
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import load_config, parse_config
from caliv_graph.config.model import Config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.conventions import AXES
from caliv_graph.errors import CalivError
from caliv_graph.geometry.se3 import rpy
from caliv_graph.pipeline import calibrate
from caliv_graph.products import LidarScan, MotionData, Recording
from caliv_graph.readers import open_recording
from caliv_graph.scenario.model import CropModel, load_scenario
from caliv_graph.simulation.recording import simulate_drive
from caliv_graph.simulation.writer import config_of
from caliv_graph.uncertainty.pairs import pair_determined, sensor_pairs
from scripts import benchmark_released as released
from scripts._command import exit_code_of, positive
from scripts._paper import PERCENTILE, paper_from_recording
from scripts._paper_registration import COMPONENTS, ITERATIONS

SCENARIOS = ("paper_arc", "figure_eight")
RELEASED = "released"
PAPER, OURS = "paper", "ours"
STARTS = ("guess", "truth")
SHOWN = ("x", "y", "z", "roll", "pitch", "yaw")

TIMES: Mapping[str, str] = {
    "total": "end to end",
    "registration": "registration, refinement",
    "optimisation": "optimisation alone",
    "cpu": "end to end, of CPU",
}
"""Optimisation is Powell's method, or our graph solves. The rest of the loop that refines shape and
graph together counts as registration."""

CROP = CropModel(margin_m=0.5, elsewhere_stride=8)
"""Crop of a scenario without one, as in figure_eight.yaml: all beams near the target and few
elsewhere, so that clouds fit into memory."""


@dataclass(frozen=True)
class Outcome:
    """One calibration.

    Attributes:
        drive: scenario, or RELEASED.
        run: seed of the drive, or number of the guess.
        start: extrinsics for the pre-alignment: guess or truth.
        estimator: PAPER or OURS.
        failure: reason for a missing result, or empty.
        errors: quantity ('S2V front', 'S2S front to rear') -> axis -> rad or m; None for an axis
            that the estimator fixes or names as undetermined.
        seconds: TIMES; reading takes time only if there are files.
    """

    drive: str
    run: int
    start: str
    estimator: str
    failure: str
    errors: Mapping[str, Mapping[str, float | None]]
    seconds: Mapping[str, float]


class KeptRecording:
    """A recording with its clouds in memory, so that casting rays is not timed."""

    def __init__(self, recording: Recording) -> None:
        self.name = recording.name
        self.lidars = recording.lidars
        self._motion = recording.motion()
        self._scans = {name: list(recording.scans(name)) for name in recording.lidars}

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        return [scan.stamp_ns for scan in self._scans[lidar]]

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        return (s for s in self._scans[lidar] if wanted is None or s.stamp_ns in wanted)

    def motion(self) -> MotionData:
        return self._motion

    def warnings(self) -> Sequence[str]:
        return ()


@dataclass(frozen=True)
class Job:
    """A drive to calibrate.

    Attributes:
        drive: scenario, or RELEASED.
        run: seed of the drive, or number of the guess.
        open: returns the recording, the config with the guesses, and the true extrinsics.
    """

    drive: str
    run: int
    open: Callable[[], tuple[Recording, Config, Mapping[str, PoseConfig]]]


def main() -> int:
    arguments = parse_arguments()
    return exit_code_of(lambda: show(arguments), "interrupted; what is finished is kept")


def show(arguments: argparse.Namespace) -> int:
    outcomes = benchmark(arguments)
    if arguments.json:
        say(json.dumps([vars(o) for o in outcomes], indent=2))
    else:
        for drive in dict.fromkeys(o.drive for o in outcomes):
            for start in arguments.starts:
                some = [o for o in outcomes if (o.drive, o.start) == (drive, start)]
                say(f"\n{table(drive, start, some)}")
    return 0


def parse_arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Errors and times of the paper's estimator, written anew, beside ours.",
        epilog="Exit codes: 0 done; 2 a drive is not there; 130 interrupted.",
    )
    parser.add_argument("--scenarios", nargs="*", default=list(SCENARIOS), metavar="NAME")
    parser.add_argument(
        "--runs", type=positive, default=1, help="seeds 1 to N, guesses 1 to N (default 1)"
    )
    parser.add_argument(
        "--starts", nargs="+", choices=STARTS, default=["guess"], help="pre-alignment by"
    )
    parser.add_argument(
        "--released",
        nargs="?",
        type=Path,
        const=REPOSITORY / "../shared/data/caliv_released",
        metavar="DATA",
        help="also the authors' drive (default: ../shared/data/caliv_released beside the "
        "repository)",
    )
    parser.add_argument(
        "--out", type=Path, default=REPOSITORY / "out/paper", help="folder of the finished runs"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON document: m, rad, s")
    return parser.parse_args(given)


def benchmark(arguments: argparse.Namespace) -> list[Outcome]:
    """Runs the missing ones."""
    jobs = [
        Job(name, run, simulated(name, run))
        for name in arguments.scenarios
        for run in range(1, arguments.runs + 1)
    ]
    if arguments.released is not None:
        data = arguments.released.resolve()
        released.authors_config(data)  # raises now if the drive is missing
        jobs += [Job(RELEASED, run, published(data, run)) for run in range(1, arguments.runs + 1)]
    arguments.out.mkdir(parents=True, exist_ok=True)
    outcomes = []
    for job in jobs:
        log = arguments.out / f"{job.drive}.jsonl"
        outcomes += run_job(job, arguments.starts, log, silent if arguments.json else say)
    return outcomes


def simulated(
    name: str, seed: int
) -> Callable[[], tuple[Recording, Config, dict[str, PoseConfig]]]:
    def opened() -> tuple[Recording, Config, dict[str, PoseConfig]]:
        scenario = load_scenario(REPOSITORY / f"configs/scenarios/{name}.yaml")
        if scenario.crop is None:
            scenario = scenario.model_copy(update={"crop": CROP})
        recording = simulate_drive(scenario, seed)
        config = parse_config(config_of(recording, has_bag=True), f"{name}.yaml", REPOSITORY)
        truth = {lidar: model.mounting for lidar, model in scenario.lidars.items()}
        return KeptRecording(recording), config, truth

    return opened


def published(
    data: Path, guess: int
) -> Callable[[], tuple[Recording, Config, dict[str, PoseConfig]]]:
    def opened() -> tuple[Recording, Config, dict[str, PoseConfig]]:
        true_config = released.authors_config(data)
        config = released.guessed(load_config(released.CONFIG), true_config, data, 1, guess)
        truth = {lidar: of.given for lidar, of in true_config.lidars.items()}
        return open_recording(config), config, truth

    return opened


def run_job(
    job: Job, starts: Sequence[str], log: Path, tell: Callable[[str], None]
) -> list[Outcome]:
    """The outcomes of a drive; those in the log are not computed again."""
    done = read_log(log)
    wanted = [(job.drive, job.run, s, e) for s in starts for e in (PAPER, OURS)]
    if any(key not in done for key in wanted):
        import_open3d()  # takes a second that is part of neither estimator
        recording, config, truth = job.open()
        for key in wanted:
            if key not in done:
                _, _, start, estimator = key
                tell(f"{job.drive}, run {job.run}, from the {start}: {estimator}")
                started = config if start == "guess" else with_guesses(config, truth)
                done[key] = run_once(job, start, estimator, recording, started, truth)
                append(log, done[key])
    return [done[key] for key in wanted]


def with_guesses(config: Config, guesses: Mapping[str, PoseConfig]) -> Config:
    lidars = {
        name: lidar.model_copy(update={"initial": guesses[name]})
        for name, lidar in config.lidars.items()
    }
    return config.model_copy(update={"lidars": lidars})


def run_once(
    job: Job,
    start: str,
    estimator: str,
    recording: Recording,
    config: Config,
    truth: Mapping[str, PoseConfig],
) -> Outcome:
    true_poses = {name: mounting.pose() for name, mounting in truth.items()}
    run = run_paper if estimator == PAPER else run_ours
    begun, cpu = time.perf_counter(), time.process_time()
    try:
        errors, stages = run(recording, config, true_poses, job.run)
    except CalivError as e:  # a failure is a result too
        return Outcome(job.drive, job.run, start, estimator, str(e), {}, {})
    seconds = {
        "total": time.perf_counter() - begun,
        "cpu": time.process_time() - cpu,
        "registration": stages["registration"],
        "optimisation": stages["optimisation"],
    }
    return Outcome(job.drive, job.run, start, estimator, "", errors, seconds)


Errors = dict[str, dict[str, float | None]]


def run_paper(
    recording: Recording, config: Config, truth: Mapping[str, gtsam.Pose3], seed: int
) -> tuple[Errors, Mapping[str, float]]:
    result = paper_from_recording(recording, config, seed)
    found = mounting_errors(result.T_vehicle_lidar, truth, config.reference)
    # S2V translations are those of the guess, moved by S2S, and no estimates.
    held = dict.fromkeys("xyz")
    errors = {row: {**e, **held} if row.startswith("S2V") else e for row, e in found.items()}
    return errors, result.seconds


def run_ours(
    recording: Recording, config: Config, truth: Mapping[str, gtsam.Pose3], seed: int
) -> tuple[Errors, Mapping[str, float]]:
    run = calibrate([recording], config, SilentProgress())
    calibration, seconds = run.calibration, run.solution.stage_times_s
    seen = {n: r.T_vehicle_lidar for n, r in calibration.lidars.items() if r.saw_target}
    errors = mounting_errors(seen, truth, calibration.reference)
    for name in seen:
        determined = calibration.lidars[name].determined
        errors[f"S2V {name}"] = only(errors[f"S2V {name}"], determined)
    for source, to in sensor_pairs(seen, calibration.reference):
        row = f"S2S {source} to {to}"
        errors[row] = only(errors[row], pair_determined(calibration, source, to))
    return errors, {
        "registration": seconds["registration"] + seconds.get("refinement", 0.0),
        "optimisation": seconds["graph"],
    }


def only(
    errors: Mapping[str, float | None], determined: Mapping[str, bool]
) -> dict[str, float | None]:
    return {axis: error if determined[axis] else None for axis, error in errors.items()}


def mounting_errors(
    estimates: Mapping[str, gtsam.Pose3], truth: Mapping[str, gtsam.Pose3], reference: str
) -> Errors:
    """Errors as the paper's Evaluation section defines them, vehicle axes, rad and m.

    Returns:
        'S2V a' and 'S2S a to b' -> per axis of `conventions.AXES`.
    """
    out = {f"S2V {name}": difference(T, truth[name]) for name, T in estimates.items()}
    for source, to in sensor_pairs(estimates, reference):
        expected = estimates[to].compose(truth[to].between(truth[source]))
        out[f"S2S {source} to {to}"] = difference(estimates[source], expected)
    return out


def difference(T: gtsam.Pose3, expected: gtsam.Pose3) -> dict[str, float | None]:
    turn = rpy(T.rotation().matrix() @ expected.rotation().matrix().T)
    shift = T.translation() - expected.translation()
    values = [*turn.tolist(), *shift.tolist()]
    return {axis: float(value) for axis, value in zip(AXES, values, strict=True)}


Key = tuple[str, int, str, str]


def settings() -> dict[str, Any]:
    """Settings of a line of the log; lines with other settings do not count."""
    return {
        "version": __version__,
        "components": COMPONENTS,
        "iterations": ITERATIONS,
        "percentile": PERCENTILE,
    }


def read_log(path: Path) -> dict[Key, Outcome]:
    """Finished runs, without the incomplete line of a killed run."""
    out: dict[Key, Outcome] = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else ():
        try:
            document = json.loads(line)
            made_with = document.pop("settings")
            outcome = Outcome(**document)
        except (ValueError, TypeError, KeyError, AttributeError):
            continue
        if made_with == settings():
            out[outcome.drive, outcome.run, outcome.start, outcome.estimator] = outcome
    return out


def append(path: Path, outcome: Outcome) -> None:
    """Adds a line, on its own line even after an incomplete one."""
    torn = path.is_file() and path.stat().st_size and not path.read_bytes().endswith(b"\n")
    line = json.dumps({"settings": settings(), **vars(outcome)})
    with path.open("a", encoding="utf-8") as file:
        file.write(f"{chr(10) if torn else ''}{line}\n")
        file.flush()
        os.fsync(file.fileno())


def table(drive: str, start: str, outcomes: Sequence[Outcome]) -> str:
    """Mean absolute errors of both, times of both, and their ratios."""
    of = {e: [o for o in outcomes if o.estimator == e and not o.failure] for e in (PAPER, OURS)}
    n = {estimator: len(some) for estimator, some in of.items()}
    lines = [
        f"{drive}, from the {start}: {n[PAPER]} runs of the paper's estimator, {n[OURS]} of ours "
        "(-: held or not determined)"
    ]
    lines += [f"  run {o.run}, {o.estimator} failed: {o.failure}" for o in outcomes if o.failure]
    if not all(n.values()):
        return "\n".join(lines)
    rows = of[PAPER][0].errors
    width = max(max(map(len, rows)), len("registration, refinement")) + 2
    headings = "".join(f"{axis:>9}" for axis in SHOWN)
    lines.append(f"  {'mean absolute, mm, mrad':{width}}{'':5}{headings}")
    for row in rows:
        paper, ours = (mean_absolute(row, of[e]) for e in (PAPER, OURS))
        ratios = [ratio(paper[axis], ours[axis]) for axis in SHOWN]
        for label, name, texts in (
            (row, "paper", [shown(paper[axis]) for axis in SHOWN]),
            ("", "ours", [shown(ours[axis]) for axis in SHOWN]),
            ("", "ratio", ratios),
        ):
            lines.append(f"  {label:{width}}{name:5}{''.join(f'{text:>9}' for text in texts)}")
    lines.append(f"  {'time, s, median':{width}}{'':5}{'paper':>9}{'ours':>9}{'ratio':>9}")
    for name, label in TIMES.items():
        a, b = (float(np.median([o.seconds[name] for o in of[e]])) for e in (PAPER, OURS))
        lines.append(f"  {label:{width}}{'':5}{a:9.2f}{b:9.2f}{ratio(a, b, 2):>9}")
    if drive == RELEASED:
        lines.append(f"  {AUTHORS_PROGRAM}")
    return "\n".join(lines)


AUTHORS_PROGRAM = (
    "The authors' own program: 15 s to preprocess 462 clouds, 38 minutes for the 158 that see the "
    "target, 2 cores"
)

LARGEST_RATIO = 1000.0
"""Largest ratio that is shown; a larger one is chance in a few runs."""


def mean_absolute(row: str, outcomes: Sequence[Outcome]) -> dict[str, float | None]:
    """Per axis; None if one of the runs has no estimate."""
    out: dict[str, float | None] = {}
    for axis in SHOWN:
        values = [o.errors.get(row, {}).get(axis) for o in outcomes]
        known = [abs(value) for value in values if value is not None]
        out[axis] = float(np.mean(known)) if len(known) == len(values) else None
    return out


def shown(value: float | None) -> str:
    return "-" if value is None else f"{1e3 * value:.2f}"


def ratio(paper: float | None, ours: float | None, digits: int = 1) -> str:
    if paper is None or ours is None:
        return "-"
    if paper >= LARGEST_RATIO * ours:
        return f">{LARGEST_RATIO:.0f}"
    return f"{paper / ours:.{digits}f}"


def say(text: str) -> None:
    print(text, flush=True)


def silent(text: str) -> None:
    """With --json stdout is one document."""


if __name__ == "__main__":
    sys.exit(main())
