"""Speed-up of a batch on two workers, what a fleet costs, and whether a killed batch ends the same.

Needs the environment that scripts/demo makes: .venv/bin/python scripts/benchmark_batch.py

Simulates 16 drives (`--drives`) of the demo's arc with different seeds, once: they stay in
out/batch_drives. With `--bags` they are bags of a minute instead (`benchmark_bag.py`: two LiDARs at
10 Hz with 12,000 points per cloud, 0.23 GB, walls and ground in use), in out/batch_bags. Then
`caliv-graph batch` runs on them with 1 and with 2 workers (`--workers`), alternately, `--rounds`
times each. The shortest time of each counts, because other programs can only make it longer.

From the latter follows what `--fleet` drives of this kind take: the calibrations, and what
start-up, scheduler and waiting add to each. `--price` is that of an hour of one processor.

With `--kills N` a batch is killed (SIGKILL to all its processes) at a random moment and started
again, N times. After each kill every finished result must be unchanged. In the end all results must
equal those of a batch that was never killed, byte for byte, except times and durations: job.json
(times and sizes), log.jsonl (seconds) and the table of times in report.html.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # imports the module beside this one from any folder

from caliv_graph.common.files import output_folder
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import load_config
from caliv_graph.errors import CalivError
from caliv_graph.simulation import load_scenario, simulate_caliv
from scripts import benchmark_bag
from scripts._command import between

SCENARIO = ROOT / "configs/scenarios/demo_arc.yaml"
DRIVES, BAGS = ROOT / "out/batch_drives", ROOT / "out/batch_bags"
BAG = argparse.Namespace(minutes=1.0, lidars=2, points=12_000, zstd=False, search=False)

PRICE_USD = 0.0425
"""Of one processor for an hour: c5 of AWS on demand in Virginia, 0.34 USD for eight."""

LEAST_RATIO = 1.85
"""Smallest speed-up of two workers."""

_TIMES_IN_REPORT = re.compile(rb"<h3>Time</h3>.*?</table>", re.DOTALL)


@dataclass(frozen=True)
class Run:
    """One batch.

    Attributes:
        workers: number of workers.
        wall_s: from start to end.
        cpu_s: processor time of all its processes.
        load: load average of the machine in the minute before.
        calibrating_s: wall time of its calibrations, one after the other.
    """

    workers: int
    wall_s: float
    cpu_s: float
    load: float
    calibrating_s: float


@dataclass(frozen=True)
class Plan:
    """A fleet on paper, from a batch of some drives.

    Attributes:
        drives: of the fleet.
        drive_s: wall time of a calibration beside those of the other workers.
        added_s: what start-up, scheduler and waiting add to a drive, of one worker's time.
        worker_hours: of the fleet.
        usd: price of these.
    """

    drives: int
    drive_s: float
    added_s: float
    worker_hours: float
    usd: float


@dataclass(frozen=True)
class Kills:
    """Kills, and their effect on the results.

    Attributes:
        kills: number of kills.
        finished: number of finished results at each kill.
        touched: finished results that a later run has repeated, lost or changed.
        different: files that differ from those of the batch that was never killed.
    """

    kills: int
    finished: tuple[int, ...]
    touched: tuple[str, ...]
    different: tuple[str, ...]


def main() -> int:
    arguments = parse_arguments()
    try:
        return benchmark(arguments)
    except (CalivError, OSError) as e:
        print(f"error: {e}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("error: interrupted", file=sys.stderr)
        return 130


def parse_arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Runs batches with one and with more workers, and kills some.",
        epilog="Exit codes: 0 fast enough and never different; 3 not; 2 it could not be tried.",
    )
    number = parser.add_argument
    number("--drives", type=between(int, 1, 1000), default=16, help="default: 16")
    number("--workers", type=between(int, 2, 64), default=2, help="against one (default: 2)")
    number(
        "--rounds", type=between(int, 0, 100), default=2, help="of each (default: 2); 0: no times"
    )
    number("--kills", type=between(int, 0, 1000), default=0, help="default: 0")
    number("--seed", type=between(int, 0, 2**31), default=1, help="of the moments of the kills")
    number("--folder", type=Path, help="for results (default: a temporary one, removed)")
    number("--fleet", type=between(int, 1, 10**7), default=1000, help="drives (default: 1000)")
    number(
        "--price",
        type=between(float, 0.0, 1e3),
        default=PRICE_USD,
        help=f"USD per hour of one processor (default: {PRICE_USD:g})",
    )
    parser.add_argument("--bags", action="store_true", help="drives are bags of a minute")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    return parser.parse_args(given)


def benchmark(arguments: argparse.Namespace) -> int:
    def tell(text: str) -> None:
        if not arguments.json:
            print(text, flush=True)

    drives = (make_bags if arguments.bags else make_drives)(arguments.drives, tell)
    with tempfile.TemporaryDirectory(prefix="caliv_batch_", dir=arguments.folder) as name:
        folder = Path(name)
        manifest = write_manifest(folder / "fleet.yaml", drives)
        runs = []
        for _ in range(arguments.rounds):
            for workers in (1, arguments.workers):
                runs.append(time_batch(manifest, folder / f"out_{workers}", workers))
                tell(_text(runs[-1]))
        kills = None
        if arguments.kills:
            whole = folder / f"out_{arguments.workers}"
            if not runs:
                time_batch(manifest, whole, arguments.workers)
            kills = kill_often(manifest, whole, folder / "killed", arguments, tell)
    ratio = ratio_of(runs, "wall_s", arguments.workers) if runs else None
    plan = plan_of(runs, len(drives), arguments) if runs else None
    good = (ratio is None or ratio >= LEAST_RATIO) and (
        kills is None or not (kills.touched or kills.different)
    )
    if arguments.json:
        document: dict[str, Any] = {
            "drives": len(drives),
            "runs": [asdict(run) for run in runs],
            "ratio": ratio,
            "plan": None if plan is None else asdict(plan),
            "kills": None if kills is None else asdict(kills),
            "good": good,
        }
        print(json.dumps(document, indent=2))
    else:
        if ratio is not None:
            cpu = ratio_of(runs, "cpu_s", arguments.workers)
            print(
                f"{len(drives)} drives: {arguments.workers} workers are {ratio:.2f} times as fast "
                f"as one (wanted: {LEAST_RATIO:g}), for {1.0 / cpu:.2f} times the processor time"
            )
        if plan is not None:
            print(
                f"Of a worker's time a drive takes {plan.drive_s:.1f} s, and start-up, scheduler "
                f"and waiting {plan.added_s:.1f} s. {plan.drives} such drives: "
                f"{plan.worker_hours:.1f} hours of one worker, {plan.usd:.2f} USD at "
                f"{arguments.price:g} USD per hour"
            )
        if kills is not None:
            print(
                f"Killed {kills.kills} times, with {', '.join(map(str, kills.finished))} results "
                f"finished: {len(kills.touched)} of these touched later, {len(kills.different)} "
                "files different in the end"
            )
            for what in (*kills.touched, *kills.different):
                print(f"  {what}")
    return 0 if good else 3


def make_drives(count: int, tell: Callable[[str], None]) -> list[Path]:
    """Configs of the drives; those that are missing are simulated."""
    scenario = load_scenario(SCENARIO)

    def simulate(fresh: Path, seed: int) -> None:
        simulate_caliv(scenario, fresh / "drive", seed, threads=1)
        for file in (fresh / "drive").iterdir():
            file.rename(fresh / file.name)
        (fresh / "drive").rmdir()

    return _made(DRIVES, count, simulate, tell)


def make_bags(count: int, tell: Callable[[str], None]) -> list[Path]:
    """Configs of drives that are bags; those that are missing are simulated."""
    scenario = benchmark_bag.scenario_of(BAG)

    def simulate(fresh: Path, seed: int) -> None:
        recording = benchmark_bag.LapsRecording(scenario, seed, 1)
        benchmark_bag.write_laps(recording, fresh, SilentProgress())

    return _made(BAGS, count, simulate, tell)


def _made(
    folder: Path, count: int, simulate: Callable[[Path, int], None], tell: Callable[[str], None]
) -> list[Path]:
    configs = []
    for seed in range(1, count + 1):
        drive = folder / f"drive_{seed:03d}"
        if not (drive / "config.yaml").is_file():
            tell(f"simulating drive {seed} of {count}")
            # A partly simulated drive must not stay.
            with output_folder(drive, ("config.yaml",)) as fresh:
                simulate(fresh, seed)
        load_config(drive / "config.yaml")
        configs.append(drive / "config.yaml")
    return configs


def write_manifest(path: Path, configs: Sequence[Path]) -> Path:
    jobs = [
        {"name": config.parent.name, "vehicle": "van", "config": str(config)} for config in configs
    ]
    path.write_text(yaml.safe_dump({"jobs": jobs}), encoding="utf-8")
    return path


def command(manifest: Path, out: Path, workers: int) -> list[str]:
    return [
        *(sys.executable, "-m", "caliv_graph", "batch", str(manifest)),
        *("--out", str(out), "--workers", str(workers), "--json"),
    ]


def time_batch(manifest: Path, out: Path, workers: int) -> Run:
    """Runs a batch in an empty folder."""
    shutil.rmtree(out, ignore_errors=True)
    load = os.getloadavg()[0]
    used, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    done = subprocess.run(
        command(manifest, out, workers), cwd=ROOT, capture_output=True, text=True, check=False
    )
    wall_s = time.monotonic() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise CalivError(f"batch ended with {done.returncode}: {done.stderr.strip()[:500]}")
    cpu_s = after.ru_utime + after.ru_stime - used.ru_utime - used.ru_stime
    calibrating_s = sum(json.loads(text)["seconds"] for text in results(out).values())
    return Run(workers, wall_s, cpu_s, load, calibrating_s)


def plan_of(runs: Sequence[Run], drives: int, arguments: argparse.Namespace) -> Plan:
    """A fleet of such drives, from the quickest run with several workers."""
    best = min((run for run in runs if run.workers > 1), key=lambda run: run.wall_s)
    worker_s, drive_s = best.workers * best.wall_s / drives, best.calibrating_s / drives
    hours = arguments.fleet * worker_s / 3600.0
    return Plan(arguments.fleet, drive_s, worker_s - drive_s, hours, hours * arguments.price)


def ratio_of(runs: Sequence[Run], what: str, workers: int) -> float:
    """Best of one worker over best of several."""
    best = {n: min(getattr(run, what) for run in runs if run.workers == n) for n in (1, workers)}
    return float(best[1] / best[workers])


def kill_often(
    manifest: Path,
    whole: Path,
    out: Path,
    arguments: argparse.Namespace,
    tell: Callable[[str], None],
) -> Kills:
    """Kills a batch several times, lets it end, and compares the results.

    A batch that ends before the requested number of kills starts again from nothing.
    """
    rng = random.Random(arguments.seed)
    before: dict[str, str] = {}
    counts: list[int] = []
    touched: list[str] = []
    different: set[str] = set()
    # The moments are spread over about the duration of one job, from its start.
    longest_s = max(json.loads(text)["seconds"] for text in results(whole).values())
    while len(counts) < arguments.kills:
        process = subprocess.Popen(
            command(manifest, out, arguments.workers),
            cwd=ROOT,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            process.wait(timeout=rng.uniform(0.0, 10.0 + 1.5 * longest_s))
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            counts.append(len(results(out)))
            tell(f"kill {len(counts)} of {arguments.kills}: {counts[-1]} results are finished")
        after = results(out)
        touched += [f"{job}: not as it was" for job in before if after.get(job) != before[job]]
        before = after
        if process.returncode != -signal.SIGKILL:
            different |= compare(whole, out)
            shutil.rmtree(out)
            before = {}
    subprocess.run(
        command(manifest, out, arguments.workers),
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        check=True,
    )
    after = results(out)
    touched += [f"{job}: not as it was" for job in before if after.get(job) != before[job]]
    different |= compare(whole, out)
    return Kills(len(counts), tuple(counts), tuple(touched), tuple(sorted(different)))


def results(out: Path) -> dict[str, str]:
    """Record of each finished job, which has the time at which it was made."""
    found = {}
    for file in sorted(out.glob("*/job.json")):
        record = file.read_text(encoding="utf-8")
        sizes = {name: (file.parent / name).stat().st_size for name in json.loads(record)["files"]}
        if sizes != json.loads(record)["files"]:
            raise CalivError(f"{file.parent}: is there, but not whole")
        found[file.parent.name] = record
    return found


def compare(whole: Path, out: Path) -> set[str]:
    """Files that differ in more than times and durations."""
    names = {
        str(file.relative_to(folder)) for folder in (whole, out) for file in folder.glob("[!.]*/*")
    }
    different = set()
    for name in sorted(names):
        files = (whole / name, out / name)
        if not all(file.is_file() for file in files):
            different.add(f"{name}: is only in one of them")
        elif len({_timeless(file) for file in files}) > 1:
            different.add(f"{name}: differs")
    return different


def _timeless(file: Path) -> bytes:
    content = file.read_bytes()
    if file.name == "report.html":
        return _TIMES_IN_REPORT.sub(b"", content)
    if file.name == "log.jsonl":
        lines = [json.loads(line) for line in content.splitlines()]
        for line in lines:
            line.pop("seconds", None)
            line.pop("cpu_seconds", None)
        return json.dumps(lines).encode()
    if file.name == "job.json":
        record = json.loads(content)
        for key in ("written", "seconds", "files"):
            record.pop(key)
        return json.dumps(record).encode()
    return content


def _text(run: Run) -> str:
    return (
        f"{run.workers} worker{'s' if run.workers > 1 else ''}: {run.wall_s:.1f} s, "
        f"{run.cpu_s:.1f} s of processor time (load before: {run.load:.1f})"
    )


if __name__ == "__main__":
    sys.exit(main())
