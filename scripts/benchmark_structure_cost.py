"""What walls and ground add to the time and memory of a calibration.

Needs the environment that scripts/demo makes: .venv/bin/python scripts/benchmark_structure_cost.py

Writes bags of figure-eights past a chair in a walled yard, 10 Hz, 30,000 points per cloud
(`--points`): two LiDARs for one minute, then other numbers of LiDARs (`--lidars`) and longer drives
(`--laps`, minutes). `caliv-graph calibrate` runs in its own process on each bag, once with
`structure: {use: false}` and once with it. The table has what the second costs more. Each bag is
deleted before the next one is written.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the scripts beside this one from any folder

from caliv_graph.common.progress import PlainProgress, Progress, SilentProgress
from scripts import _child, benchmark_bag
from scripts._command import exit_code_of, positive

MOST_SECONDS = 15.0
MOST_MEMORY_MB = 300.0
"""Limits for two LiDARs and one minute: wall time on 2 cores and peak memory, both in addition."""


@dataclass(frozen=True)
class Cost:
    """A bag, calibrated without and with structure.

    Attributes:
        lidars: how many.
        minutes: duration of the drive.
        without: resources of the run without structure.
        with_: resources of the run with it.
    """

    lidars: int
    minutes: int
    without: _child.Usage
    with_: _child.Usage

    @property
    def wall_s(self) -> float:
        """Wall time that structure adds."""
        return self.with_.wall_s - self.without.wall_s

    @property
    def cpu_s(self) -> float:
        """Processor time that structure adds."""
        return self.with_.cpu_s - self.without.cpu_s

    @property
    def memory_mb(self) -> float:
        """Peak memory that structure adds."""
        return self.with_.peak_mb - self.without.peak_mb


def main() -> int:
    arguments = parse_arguments()
    return exit_code_of(lambda: benchmark(arguments))


def parse_arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Calibrates with and without walls and ground; prints what these cost.",
        epilog="Exit codes: 0 two LiDARs and one minute are within the limits; 3 they are not; "
        "2 could not be tried.",
    )
    number = parser.add_argument
    number("--lidars", nargs="*", type=positive, default=[1, 4], help="default: 1 4")
    number("--laps", nargs="*", type=positive, default=[2, 4], help="minutes (default: 2 4)")
    number("--points", type=positive, default=30_000, help="per cloud (default: 30000)")
    number("--seed", type=positive, default=1, help="default: 1")
    number("--cores", type=positive, default=2, help="for the calibration (default: 2)")
    number("--folder", type=Path, help="where to make the bags (default: the system's temporary)")
    number("--json", action="store_true", help="print one JSON document")
    return parser.parse_args(given)


def benchmark(arguments: argparse.Namespace) -> int:
    progress = SilentProgress() if arguments.json else PlainProgress(say)
    cases = [(2, 1), *((n, 1) for n in arguments.lidars), *((2, n) for n in arguments.laps)]
    costs = [measure(*case, arguments, progress) for case in dict.fromkeys(cases)]
    say(json.dumps(document(costs), indent=2) if arguments.json else text(costs))
    return 0 if kept(costs[0]) else 3


def measure(lidars: int, minutes: int, arguments: argparse.Namespace, progress: Progress) -> Cost:
    """Writes a bag, calibrates from it without and with structure, deletes it."""
    asked = argparse.Namespace(
        minutes=float(minutes), lidars=lidars, points=arguments.points, search=False, zstd=False
    )
    recording = benchmark_bag.LapsRecording(
        benchmark_bag.scenario_of(asked), arguments.seed, arguments.cores
    )
    with tempfile.TemporaryDirectory(prefix="caliv_cost_", dir=arguments.folder) as name:
        folder = Path(name)
        benchmark_bag.check_disk(recording, arguments.points, folder)
        benchmark_bag.write_laps(recording, folder, progress)
        found = []
        for use in (False, True):
            config = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))
            path = folder / f"config_{use}.yaml"
            text_ = yaml.safe_dump({**config, "structure": {"use": use}})
            path.write_text(text_, encoding="utf-8")
            said = "with" if use else "without"
            with progress.stage(f"{lidars} LiDARs, {minutes} min, {said} structure"):
                found.append(_child.calibrate(path, folder / "result", arguments.cores))
    return Cost(lidars, minutes, *found)


def kept(cost: Cost) -> bool:
    """Whether what structure adds is within the limits."""
    return cost.wall_s <= MOST_SECONDS and cost.memory_mb <= MOST_MEMORY_MB


def text(costs: Sequence[Cost]) -> str:
    """The table, and whether the first row is within the limits."""
    lines = [
        "",
        f"{'':16}{'without: wall':>14}{'CPU':>9}{'peak':>9}"
        f"{'structure adds':>17}{'CPU':>9}{'memory':>10}",
    ]
    lines += [
        f"{c.lidars} LiDARs, {c.minutes:2d} min{c.without.wall_s:12.1f} s{c.without.cpu_s:7.1f} s"
        f"{c.without.peak_mb:6.0f} MB{c.wall_s:15.1f} s{c.cpu_s:7.1f} s{c.memory_mb:7.0f} MB"
        for c in costs
    ]
    lines.append(
        f"The first row may add {MOST_SECONDS:g} s and {MOST_MEMORY_MB:g} MB: "
        f"{'kept' if kept(costs[0]) else 'MISSED'}"
    )
    return "\n".join(lines)


def document(costs: Sequence[Cost]) -> dict[str, object]:
    """The result as plain values."""
    return {
        "runs": [
            {
                "lidars": c.lidars,
                "minutes": c.minutes,
                "exit_codes": [c.without.code, c.with_.code],
                "without": {
                    "wall_s": c.without.wall_s,
                    "cpu_s": c.without.cpu_s,
                    "peak_mb": c.without.peak_mb,
                },
                "added": {"wall_s": c.wall_s, "cpu_s": c.cpu_s, "memory_mb": c.memory_mb},
            }
            for c in costs
        ],
        "kept": kept(costs[0]),
    }


def say(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())
