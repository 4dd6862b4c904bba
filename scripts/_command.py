"""Common parts of the scripts' command lines: exit codes, numbers, options."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from caliv_graph.errors import CalivError

Number = TypeVar("Number", int, float)

COMMAND = Path(sys.executable).with_name("caliv-graph")

# A process inherits the peak memory of its parent. This parent is small.
LAUNCHER = """
import json, os, resource, subprocess, sys, time
cores = int(sys.argv[1])
if cores and hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
start = time.monotonic()
code = subprocess.run(sys.argv[2:], stdout=subprocess.DEVNULL).returncode
seconds = time.monotonic() - start
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps({
    "code": code, "wall_s": seconds, "cpu_s": used.ru_utime + used.ru_stime,
    "peak_mb": used.ru_maxrss / 1024,
}))
"""


@dataclass(frozen=True)
class Usage:
    """Resources of one calibration.

    Attributes:
        code: its exit code.
        wall_s: from start to end.
        cpu_s: of processor time.
        peak_mb: largest resident memory.
        stages_s: seconds per stage, from its log.
    """

    code: int
    wall_s: float
    cpu_s: float
    peak_mb: float
    stages_s: Mapping[str, float]


def run_command(*arguments: object) -> str:
    """Runs `caliv-graph` in its own process; returns what it prints.

    Raises:
        CalivError: it ended with an exit code other than 0.
    """
    done = subprocess.run([COMMAND, *map(str, arguments)], capture_output=True, text=True)
    if done.returncode != 0:
        raise _failed(str(arguments[0]), done.returncode, done.stderr)
    return done.stdout


def calibrate_measured(
    config: Path, result: Path, cores: int = 0, options: Sequence[str] = ()
) -> Usage:
    """Runs `caliv-graph calibrate` in its own process.

    Args:
        config: config to calibrate with.
        result: folder for the result; an older one is replaced.
        cores: number of cores that it may use; 0: all.
        options: further options of the command.

    Raises:
        CalivError: it left no result.
    """
    command = map(str, (COMMAND, "calibrate", config, "--out", result, "--force", *options))
    launch = [sys.executable, "-I", "-S", "-c", LAUNCHER, str(cores), *command]
    launched = subprocess.run(launch, check=True, capture_output=True, text=True)
    usage = json.loads(launched.stdout)
    if usage["code"] not in (0, 3, 4):
        raise _failed("calibrate", usage["code"], launched.stderr)
    stages: dict[str, float] = {}
    for line in map(json.loads, (result / "log.jsonl").read_text(encoding="utf-8").splitlines()):
        if "stage" in line and line["depth"] == 0:
            stages[line["stage"]] = stages.get(line["stage"], 0.0) + line["seconds"]
    return Usage(stages_s=stages, **usage)


def _failed(command: str, code: int, stderr: str) -> CalivError:
    why = "; ".join(stderr.strip().splitlines()[-2:])
    return CalivError(f"caliv-graph {command}, exit code {code}: {why}")


def exit_code_of(work: Callable[[], int], interrupted: str = "interrupted") -> int:
    """Runs the work. An error of its input becomes one line on stderr and exit code 2.

    Args:
        work: function that returns the exit code.
        interrupted: message on an interrupt, whose exit code is 130.
    """
    try:
        return work()
    except (CalivError, OSError) as e:
        print(f"error: {e}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"error: {interrupted}", file=sys.stderr)
        return 130


def add_beams(parser: argparse.ArgumentParser) -> None:
    """The option --beams, of the scripts that simulate thinned clouds."""
    parser.add_argument(
        "--beams",
        type=Path,
        default=Path(__file__).resolve().parents[1] / "out" / "tables" / "beams",
        help="folder of the beams that matter, found once per scenario",
    )


def positive(text: str) -> int:
    """A number of the command line that is at least 1."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return value


def between(kind: Callable[[str], Number], least: Number, most: Number) -> Callable[[str], Number]:
    """Reads a number of the command line, int or float, within a closed range."""

    def read(text: str) -> Number:
        value = kind(text)
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"must be {least} to {most}")
        return value

    read.__name__ = "integer" if kind is int else "number"  # the name in argparse's message
    return read
