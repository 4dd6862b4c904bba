"""Coverage-guided fuzzing of every reader, with atheris (libFuzzer).

Needs the environment that scripts/demo makes: .venv/bin/python scripts/fuzz.py

A reader may accept an input, if what it makes of it holds what is promised of it (finite, the right
shapes, ascending stamps), or refuse it by an error of the project that is one line. All else is a
crash: another exception, a broken promise, more than 10 s, more than 4 GB, the end of the process.
Inputs that crash are kept in out/fuzz/TARGET/ (`--out`), one per place in the code; `--replay FILE`
tries one again and shows the traceback. The exit code is 1 if there were crashes.

    .venv/bin/python scripts/fuzz.py --target pcd config --runs 100000 --seed 1
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import importlib
import io
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: the matrices are small

HERE = Path(__file__).resolve().parent

_BAG_MODULES = ("caliv_graph.readers", "rosbags")

MODULES: Mapping[str, Sequence[str]] = {
    "config": ("caliv_graph.config",),
    "manifest": ("caliv_graph.batch.manifest", "caliv_graph.config"),
    "scenario": ("caliv_graph.config", "caliv_graph.scenario.model"),
    "calibration": ("caliv_graph.config", "caliv_graph.results"),
    "truth": ("caliv_graph.config", "caliv_graph.results"),
    "poses": ("caliv_graph.config", "caliv_graph.readers.caliv_folder"),
    "pcd": ("caliv_graph.readers.pcd",),
    "pointcloud2": ("caliv_graph.readers",),
    "livox": ("caliv_graph.readers",),
    "motion": ("caliv_graph.readers",),
    "urdf": ("caliv_graph.readers.frames",),
    "base": ("caliv_graph.export",),
    "mcap": _BAG_MODULES,
    "sqlite3": _BAG_MODULES,
    "ros1": _BAG_MODULES,
    "metadata": _BAG_MODULES,
}
"""Per target the modules whose branches guide the search."""

MOST_SECONDS = 10
"""For one input. A reader takes milliseconds."""

MOST_MEMORY_MB = 4096

MOST_CHARACTERS = 2000
"""Of a message, paths included."""

OUTCOMES = ("accepted", "refused", "crash")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--target", nargs="+", choices=MODULES, default=list(MODULES), metavar="NAME"
    )
    parser.add_argument("--runs", type=int, default=2000, help="inputs per target")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1, help="targets at the same time")
    parser.add_argument("--out", type=Path, default=HERE.parent / "out" / "fuzz")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    parser.add_argument("--replay", type=Path, help="try one input on the (one) target")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.replay:
        return replay(options.target[0], options.replay)
    if options.child:
        return fuzz_each(options)
    results: dict[str, Any] = {}
    groups = [options.target[i :: options.jobs] for i in range(min(options.jobs, len(MODULES)))]
    with ThreadPoolExecutor(len(groups)) as pool:
        jobs = [pool.submit(run, group, options, results) for group in groups if group]
        for job in jobs:
            job.result()
    results = {name: results[name] for name in options.target}
    if options.json:
        print(json.dumps({"seed": options.seed, "targets": results}, indent=2))
    return int(any(result["crash"] for result in results.values()))


def run(names: Sequence[str], options: argparse.Namespace, results: dict[str, Any]) -> None:
    """Fuzzes some targets, one after the other, in a process of its own."""
    command = [sys.executable, __file__, "--child", "--target", *names]
    command += ["--runs", options.runs, "--seed", options.seed, "--out", options.out]
    with subprocess.Popen(
        [str(part) for part in command],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONHASHSEED": "0"},
    ) as process:
        assert process.stdout is not None
        for said in process.stdout:
            name, result = json.loads(said)
            _tell(name, result, options, results)
    for name in names:
        if name not in results:
            place = {f"the process ended with {process.returncode}": "before it began"}
            lost = dict.fromkeys(OUTCOMES, 0) | {"crash": 1, "crashes": place}
            _tell(name, lost | {"inputs": 0, "seconds": 0.0}, options, results)


def _tell(
    name: str, result: dict[str, Any], options: argparse.Namespace, results: dict[str, Any]
) -> None:
    results[name] = result
    if not options.json:
        print(line(name, result), flush=True)


def line(name: str, result: Mapping[str, Any]) -> str:
    counts = ", ".join(f"{result[outcome]} {outcome}" for outcome in OUTCOMES)
    kept = "".join(f"\n  {place}: {file}" for place, file in result["crashes"].items())
    return f"{name:<12} {result['inputs']:>7} inputs: {counts} in {result['seconds']:.0f} s{kept}"


def fuzz_each(options: argparse.Namespace) -> int:
    """Forks for each target, for libFuzzer ends the process; prints what came of each."""
    import atheris

    sys.path.insert(0, str(HERE.parent))
    modules = {module for name in options.target for module in MODULES[name]}
    # It names each module on stderr, which is for what goes wrong.
    quiet = contextlib.redirect_stderr(io.StringIO())
    with quiet, atheris.instrument_imports(include=sorted(modules)):
        targets = importlib.import_module("scripts._fuzz_targets")
    # In memory, where there is such a place: opening files would be most of the time.
    memory = Path("/dev/shm")
    for name in options.target:
        start = time.monotonic()
        log = options.out / f"{name}.log"
        (options.out / name).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
            pid = os.fork()
            if not pid:
                stderr = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
                os.dup2(stderr, 1)
                os.dup2(stderr, 2)
                fuzz(targets, name, options, Path(folder))
                os._exit(1)
            code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
            result: dict[str, Any] = dict.fromkeys(OUTCOMES, 0) | {"crashes": {}}
            counts = Path(folder) / "counts.json"
            if counts.is_file():
                result = json.loads(counts.read_text(encoding="utf-8"))
        if code:
            result["crash"] += 1
            result["crashes"][f"the process ended with {code}"] = str(log)
        else:
            log.unlink()
        result["inputs"] = sum(result[outcome] for outcome in OUTCOMES)
        result["seconds"] = time.monotonic() - start
        print(json.dumps([name, result]), flush=True)
    return 0


def replay(name: str, file: Path) -> int:
    sys.path.insert(0, str(HERE.parent))
    target = importlib.import_module("scripts._fuzz_targets").TARGETS[name]
    with tempfile.TemporaryDirectory() as folder:
        attempt = target.make(Path(folder))
        try:
            attempt(file.read_bytes())
        except target.refusals as e:
            print(f"refused: {e}")
        else:
            print("accepted")
    return 0


def fuzz(targets: Any, name: str, options: argparse.Namespace, work: Path) -> None:
    """Fuzzes one target, and does not come back."""
    import atheris

    target = targets.TARGETS[name]
    corpus, scratch, made = work / "corpus", work / "scratch", work / "seeds"
    for folder in (corpus, scratch, made):
        folder.mkdir()
    valid = target.seeds(made)
    for number, data in enumerate(valid):
        (corpus / f"{number:03d}").write_bytes(data)
    out = options.out / name
    judge = Judge(target.make(scratch), target.refusals, targets.one_line, out)

    def one_input(data: bytes) -> None:
        judge(data)
        total = sum(judge.counts.values())
        if total % 500 == 0 or total == options.runs:
            found = json.dumps(judge.counts | {"crashes": judge.crashes})
            (work / "counts.json").write_text(found, encoding="utf-8")
        if total == options.runs:
            os._exit(0)

    def change(data: bytes, most_bytes: int, number: int) -> bytes:
        changed: bytes = targets.change_yaml(data, most_bytes, number, atheris.Mutate, valid)
        return changed

    settings: dict[str, Any] = {"custom_mutator": change} if target.kind == "yaml" else {}
    atheris.Setup(
        [
            sys.argv[0],
            f"-seed={options.seed}",
            f"-max_len={target.most_bytes}",
            "-len_control=0",
            "-mutate_depth=2",
            f"-rss_limit_mb={MOST_MEMORY_MB}",
            f"-artifact_prefix={out}{os.sep}",
            str(corpus),
        ],
        one_input,
        **settings,
    )
    atheris.Fuzz()


class _TooLong(BaseException):
    """Of no kind that a reader may catch."""


def _too_long(*_: object) -> None:
    raise _TooLong


class Judge:
    """Tries inputs, counts the outcomes, and keeps an input per place where it crashes."""

    def __init__(
        self,
        attempt: Callable[[bytes], None],
        refusals: tuple[type[Exception], ...],
        one_line: Callable[[str], str],
        folder: Path,
    ) -> None:
        self._attempt = attempt
        self._refusals = refusals
        self._one_line = one_line
        self._folder = folder
        self.counts = dict.fromkeys(OUTCOMES, 0)
        self.crashes: dict[str, str] = {}

    def __call__(self, data: bytes) -> None:
        # libFuzzer's own alarm ends the process without a word.
        signal.signal(signal.SIGALRM, _too_long)
        signal.setitimer(signal.ITIMER_REAL, MOST_SECONDS)
        try:
            self._attempt(data)
        except self._refusals as e:
            shown = self._one_line(str(e))
            if shown.isprintable() and 0 < len(shown) <= MOST_CHARACTERS:
                self.counts["refused"] += 1
            else:
                self._crash(data, f"message of {len(shown)} characters: {shown[:80]!r}")
        except Exception as e:
            frames = traceback.extract_tb(e.__traceback__)
            ours = [f for f in frames if "caliv_graph" in f.filename] or frames
            last = ours[-1]
            place = f"{type(e).__name__} in {Path(last.filename).name}:{last.lineno} {last.name}"
            self._crash(data, place)
        except _TooLong:
            self._crash(data, f"takes more than {MOST_SECONDS} s")
        else:
            self.counts["accepted"] += 1
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)

    def _crash(self, data: bytes, place: str) -> None:
        self.counts["crash"] += 1
        if place not in self.crashes and len(self.crashes) < 50:
            file = self._folder / hashlib.sha256(data).hexdigest()[:16]
            file.write_bytes(data)
            self.crashes[place] = str(file)


if __name__ == "__main__":
    sys.exit(main())
