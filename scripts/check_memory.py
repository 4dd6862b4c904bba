"""Whether the memory of a calibration depends on the length of the drive.

Needs the environment that scripts/demo makes: .venv/bin/python scripts/check_memory.py

Writes bags of 1, 4 and 16 minutes (`--laps`), 0.24 GB each minute: figure-eights past a chair, one
a minute, two LiDARs (`--lidars`) at 10 Hz with 12,000 points per cloud (`--points`). The clouds of
the first lap are repeated with later stamps; IMU, GNSS and velocity are never repeated.
`caliv-graph calibrate` runs in its own process on each, and its peak memory (ru_maxrss) is printed.
Each bag is deleted before the next one is written.

Only the smoother may grow: the samples of the IMU and a pose every 0.1 s. `--limit` is the limit of
this growth in MB per minute of drive. Clouds kept in memory would need 0.24 GB per minute.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the scripts beside this one from any folder

from caliv_graph.common.progress import PlainProgress, Progress, SilentProgress
from caliv_graph.errors import CalivError
from scripts import _child, benchmark_bag

LAPS = (1, 4, 16)

LIMIT_MB_PER_MINUTE = 1.0


@dataclass(frozen=True)
class Length:
    """A bag of one length, and the calibration from it.

    Attributes:
        minutes: duration of the drive.
        bag_mb: size of the bag.
        usage: resources of the calibration.
    """

    minutes: int
    bag_mb: float
    usage: _child.Usage


def main() -> int:
    arguments = parse_arguments()
    progress = SilentProgress() if arguments.json else PlainProgress(say)
    try:
        lengths = [measure(n, arguments, progress) for n in sorted(set(arguments.laps))]
    except (CalivError, OSError) as e:
        print(f"error: {e}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("error: interrupted", file=sys.stderr)
        return 130
    kept = growth(lengths) <= arguments.limit
    if arguments.json:
        say(json.dumps(document(lengths, arguments.limit), indent=2))
    else:
        say(text(lengths, arguments.limit))
    return 0 if kept else 3


def parse_arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Calibrates from bags of growing length, and prints the peak memory of each.",
        epilog="Exit codes: 0 memory grows by no more than the limit; 3 by more; 2 could not be "
        "tried.",
    )
    number = parser.add_argument
    number("--laps", nargs="+", type=_positive, default=list(LAPS), help="default: 1 4 16")
    number("--lidars", type=_positive, default=2, help="default: 2")
    number("--points", type=_positive, default=12_000, help="per cloud (default: 12000)")
    number("--seed", type=_positive, default=1, help="default: 1")
    number("--cores", type=_positive, default=2, help="for the calibration (default: 2)")
    number(
        "--limit",
        type=float,
        default=LIMIT_MB_PER_MINUTE,
        help=f"MB per minute (default: {LIMIT_MB_PER_MINUTE:g})",
    )
    number("--folder", type=Path, help="where to make the bags (default: the system's temporary)")
    parser.add_argument(
        "--search", action="store_true", help="a config that does not say where the target is"
    )
    parser.add_argument("--zstd", action="store_true", help="compress the bags' chunks")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    return parser.parse_args(given)


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return value


def measure(minutes: int, arguments: argparse.Namespace, progress: Progress) -> Length:
    """Writes a bag, calibrates from it, deletes it."""
    of_bag = argparse.Namespace(**vars(arguments), minutes=float(minutes))
    scenario = benchmark_bag.scenario_of(of_bag)
    recording = benchmark_bag.LapsRecording(scenario, arguments.seed, arguments.cores)
    with tempfile.TemporaryDirectory(prefix="caliv_memory_", dir=arguments.folder) as name:
        folder = Path(name)
        benchmark_bag.check_disk(recording, arguments.points, folder)
        bag_mb = benchmark_bag.write_laps(recording, folder, progress)
        with progress.stage(f"calibrating from {minutes} min, {bag_mb:.0f} MB"):
            usage = _child.calibrate(folder / "config.yaml", folder / "result", arguments.cores)
    return Length(minutes, bag_mb, usage)


def growth(lengths: Sequence[Length]) -> float:
    """MB per minute of drive, between the shortest and the longest; 0 if there is only one."""
    first, last = lengths[0], lengths[-1]
    if last.minutes == first.minutes:
        return 0.0
    return (last.usage.peak_mb - first.usage.peak_mb) / (last.minutes - first.minutes)


def text(lengths: Sequence[Length], limit: float) -> str:
    """The result for a person."""
    lines = ["", f"{'drive':>8}{'bag':>11}{'peak':>11}{'CPU':>9}{'wall':>9}"]
    lines += [
        f"{n.minutes:4d} min{n.bag_mb:8.0f} MB{n.usage.peak_mb:8.0f} MB"
        f"{n.usage.cpu_s:7.1f} s{n.usage.wall_s:7.1f} s"
        for n in lengths
    ]
    verdict = "kept" if growth(lengths) <= limit else "MISSED"
    lines.append(
        f"Growth: {growth(lengths):.2f} MB per minute of drive (at most {limit:g}: {verdict})"
    )
    return "\n".join(lines)


def document(lengths: Sequence[Length], limit: float) -> dict[str, Any]:
    """The result as plain values."""
    return {
        "lengths": [
            {
                "minutes": n.minutes,
                "bag_mb": n.bag_mb,
                "peak_mb": n.usage.peak_mb,
                "cpu_s": n.usage.cpu_s,
                "wall_s": n.usage.wall_s,
                "stages_s": {name: wall for name, (wall, _) in n.usage.stages.items()},
            }
            for n in lengths
        ],
        "growth_mb_per_minute": growth(lengths),
        "limit_mb_per_minute": limit,
        "kept": growth(lengths) <= limit,
    }


def say(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())
