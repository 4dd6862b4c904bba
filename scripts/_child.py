"""Runs the command line in its own process, and measures its time, CPU and memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from caliv_graph.errors import CalivError

REPOSITORY = Path(__file__).resolve().parents[1]

# A process inherits the peak memory of its parent. This parent is small.
_LAUNCHER = """
import json, os, resource, subprocess, sys
cores, report = int(sys.argv[1]), sys.argv[2]
if cores and hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
code = subprocess.run(sys.argv[3:], stdout=subprocess.DEVNULL).returncode
used = resource.getrusage(resource.RUSAGE_CHILDREN)
unit = 1024 if sys.platform == "linux" else 1024**2
with open(report, "w") as file:
    json.dump({
        "code": code, "process_cpu_s": used.ru_utime + used.ru_stime,
        "peak_mb": used.ru_maxrss / unit,
    }, file)
"""

# Start-up is the interpreter and the imports. It does not depend on the drive.
_RUN = """
import json, sys, time
from caliv_graph.cli.main import run
from caliv_graph.common.memory import keep_freed_memory
import caliv_graph.pipeline, caliv_graph.readers.rosbag, caliv_graph.results.calibration_file
keep_freed_memory()
wall, cpu = time.perf_counter(), time.process_time()
code = run(sys.argv[2:])
document = {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu,
            "start_up_cpu_s": cpu}
with open(sys.argv[1], "w") as file:
    json.dump(document, file)
sys.exit(code)
"""


@dataclass(frozen=True)
class Usage:
    """Resources of one run.

    Attributes:
        code: its exit code.
        wall_s: from the end of the imports to the end, results written.
        cpu_s: processor time of the same, all threads.
        start_up_cpu_s: processor time of the interpreter and the imports.
        peak_mb: largest resident memory of the process, imports included; MiB.
        stages: per stage of log.jsonl: wall time and processor time, seconds.
    """

    code: int
    wall_s: float
    cpu_s: float
    start_up_cpu_s: float
    peak_mb: float
    stages: Mapping[str, tuple[float, float]]

    def stage_s(self, *names: str) -> float:
        """Wall time of some stages together; stages that did not run count 0."""
        return sum(self.stages[name][0] for name in names if name in self.stages)


def calibrate(config: Path, result: Path, cores: int, data: Sequence[Path] = ()) -> Usage:
    """Runs `caliv-graph calibrate`.

    Args:
        config: config file.
        result: folder to write to; replaced.
        cores: number of cores that it may use.
        data: drives that replace the drive of the config.

    Raises:
        CalivError: it wrote no result.
    """
    arguments = ["calibrate", str(config.resolve()), "--out", str(result.resolve()), "--force"]
    for path in data:
        arguments += ["--data", str(path.resolve())]
    code, usage = run(arguments, cores)
    if code not in (0, 3, 4):
        raise CalivError(f"caliv-graph {' '.join(arguments)}: exit code {code}")
    return Usage(code=code, stages=read_stages(result / "log.jsonl"), **usage)


def middle(usages: Sequence[Usage]) -> Usage:
    """The run whose processor time is the median (the lower of two)."""
    return sorted(usages, key=lambda usage: usage.cpu_s)[(len(usages) - 1) // 2]


def help_s(arguments: Sequence[str], runs: int) -> float:
    """Shortest wall time of a process that only prints its help, over several runs, seconds.

    The shortest, because other processes can only slow it down.
    """
    command = [sys.executable, "-m", "caliv_graph", *arguments, "--help"]
    times = []
    for _ in range(runs):
        begun = time.perf_counter()
        subprocess.run(command, cwd=REPOSITORY, check=True, stdout=subprocess.DEVNULL)
        times.append(time.perf_counter() - begun)
    return min(times)


def run(arguments: Sequence[str], cores: int) -> tuple[int, dict[str, float]]:
    """Runs `caliv-graph` with these arguments; its exit code, and times and memory.

    Raises:
        CalivError: exit code 2, with its message; or it did not end.
    """
    with tempfile.TemporaryDirectory() as name:
        inner, outer = Path(name) / "inner.json", Path(name) / "outer.json"
        command = [sys.executable, "-c", _RUN, str(inner), *arguments]
        launch = [sys.executable, "-I", "-S", "-c", _LAUNCHER, str(cores), str(outer), *command]
        # Like a user's environment; the scripts set this variable for themselves.
        environment = {k: v for k, v in os.environ.items() if k != "OMP_NUM_THREADS"}
        done = subprocess.run(
            launch,
            cwd=REPOSITORY,
            env=environment,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
        if not (inner.is_file() and outer.is_file()):
            raise CalivError(f"caliv-graph {arguments[0]}: killed; {_last(done.stderr)}")
        usage = json.loads(inner.read_text(encoding="utf-8"))
        outside = json.loads(outer.read_text(encoding="utf-8"))
    if outside["code"] == 2:
        raise CalivError(f"caliv-graph {arguments[0]}: {_last(done.stderr)}")
    usage["peak_mb"] = outside["peak_mb"]
    return int(outside["code"]), usage


def read_stages(log: Path) -> dict[str, tuple[float, float]]:
    """Wall and processor seconds of each stage of a log.jsonl; NaN if the log has none."""
    stages: dict[str, tuple[float, float]] = {}
    for line in map(json.loads, log.read_text(encoding="utf-8").splitlines()):
        if "stage" in line and line["depth"] == 0 and line["seconds"] is not None:
            before = stages.get(line["stage"], (0.0, 0.0))
            cpu_s = line.get("cpu_seconds")
            more = (line["seconds"], float("nan") if cpu_s is None else cpu_s)
            stages[line["stage"]] = (before[0] + more[0], before[1] + more[1])
    return stages


def _last(stderr: str) -> str:
    lines = stderr.strip().splitlines()
    return lines[-1] if lines else "it said nothing"
