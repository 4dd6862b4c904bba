"""One job, in the process of a Dask worker.

A worker may die, be cut off or be told to stop at any moment. What it writes is below the work
folder of the run; that this is gone means that nobody waits for the result any more.
"""

from __future__ import annotations

import ctypes
import functools
import json
import os
import socket
import threading
import time
import traceback
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import caliv_graph
from caliv_graph.common.exits import DEFECT, USAGE
from caliv_graph.common.progress import SilentProgress, StageRecord, count_text
from caliv_graph.config.model import Config
from caliv_graph.errors import CalivError

MOST_ATTEMPTS = 2
"""How often a job may take a worker down with it: once may have been somebody else's fault."""

_LOOK_S = 1.0
"""Seconds between two looks at whether the result is still wanted."""

_NO_MEMORY = "there was not enough memory. Give the batch fewer --workers"

_ONE_AT_A_TIME = threading.Lock()
"""A worker may have several threads; the pipeline has one."""


@dataclass(frozen=True)
class Task:
    """What a worker needs to know of a job. All paths are absolute.

    Attributes:
        name: of the job.
        config: the effective config.
        config_file: where it is from, for messages.
        data: drives instead of the config's; empty: the config's.
        prior: an earlier calibration.
        recorded: digest of the result that is there already; None: there is none, or it is to be
            made again.
        cache: digests of its files that are known (`DigestCache.dump`).
        out: folder of the batch.
        work: folder of this run.
        version: of the program that runs the batch.
    """

    name: str
    config: Config
    config_file: Path
    data: tuple[Path, ...]
    prior: Path | None
    recorded: str | None
    cache: str
    out: Path
    work: Path
    version: str


@dataclass(frozen=True)
class Attempt:
    """Which process took up a job."""

    host: str
    pid: int


@dataclass(frozen=True)
class Outcome:
    """What became of a job.

    Attributes:
        kind: `calibrated`; `unchanged`: the result that is there is the right one; `failed`;
            `died`: its workers did, as often as they may.
        exit: exit code that `calibrate` would have ended with; None if a worker died.
        message: why it failed, one line.
        trace: lines of the traceback of a defect.
        digest: of the job.
        staged: folder of the result.
        warnings: what a person should know, a line each.
        seconds: how long it took.
        cache: digests of its files.
    """

    kind: Literal["calibrated", "unchanged", "failed", "died"]
    exit: int | None = None
    message: str = ""
    trace: tuple[str, ...] = ()
    digest: str = ""
    staged: Path | None = None
    warnings: tuple[str, ...] = ()
    seconds: float = 0.0
    cache: str = ""


class NotWantedError(Exception):
    """The batch has ended, or was killed."""


class _WatchedProgress(SilentProgress):
    """Tells the batch the stage, and stops the job if there is no batch any more."""

    def __init__(self, task: Task) -> None:
        super().__init__()
        self._task = task
        self._last_look = 0.0

    def _show_start(self, record: StageRecord) -> None:
        self._look(record)

    def _show(self, record: StageRecord) -> None:
        if time.monotonic() - self._last_look >= _LOOK_S:
            self._look(record)

    def _look(self, record: StageRecord) -> None:
        self._last_look = time.monotonic()
        text = f"{record.name} {count_text(record)}".rstrip()
        try:
            stage_file(self._task.work, self._task.name).write_text(text, encoding="utf-8")
        except FileNotFoundError:
            raise NotWantedError from None


def stage_file(work: Path, job: str) -> Path:
    """Where a worker says what it is doing."""
    return work / f"{job}.stage"


def attempts(work: Path, job: str) -> list[Attempt]:
    """Who took up a job in this run, in order."""
    out = []
    for number in range(1, MOST_ATTEMPTS + 1):
        try:
            out.append(Attempt(**json.loads(_attempt_file(work, job, number).read_text("utf-8"))))
        except (OSError, ValueError, TypeError):
            break
    return out


def run_task(task: Task) -> Outcome:
    """Does a job, unless it is done or has killed its workers. Whatever goes wrong is an outcome.

    Raises:
        NotWantedError: the batch has ended.
    """
    with _ONE_AT_A_TIME:
        before = len(attempts(task.work, task.name))
        if before >= MOST_ATTEMPTS:
            return Outcome("died")
        _mark_attempt(task, before + 1)
        start = time.monotonic()
        try:
            return _run(task, before + 1, start)
        except NotWantedError:
            raise
        except CalivError as e:
            outcome = Outcome("failed", USAGE, str(e))
        except OSError as e:
            where = e.filename or task.name
            outcome = Outcome("failed", USAGE, f"{where}: {e.strerror or e}")
        except MemoryError:
            outcome = Outcome("failed", DEFECT, _NO_MEMORY)
        except Exception as e:
            outcome = Outcome(
                "failed",
                DEFECT,
                f"a defect of caliv-graph {caliv_graph.__version__}: {type(e).__name__}: {e}",
                tuple("".join(traceback.format_exception(e)).splitlines()),
            )
        if not task.work.is_dir():
            raise NotWantedError
        return outcome


_MALLOPT = {-1: 512 << 20, -3: 32 << 20}
"""M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of glibc, bytes."""


@functools.cache
def _keep_freed_memory() -> None:
    """Lets the C library keep what was freed for the next array.

    Dask has its workers give back all that is freed at once, and with that switches off what makes
    the library learn: a quarter of the time went into zeroing pages.
    """
    with suppress(OSError, AttributeError):
        for option, value in _MALLOPT.items():
            ctypes.CDLL(None).mallopt(option, value)


def _run(task: Task, attempt: int, start: float) -> Outcome:
    # Here, for the batch itself has no use for the estimator.
    from threadpoolctl import threadpool_limits

    from caliv_graph.batch.digests import DigestCache, job_digest, job_inputs
    from caliv_graph.batch.job import check_guesses, open_recordings, run_job
    from caliv_graph.common.cores import on_one_core
    from caliv_graph.common.exits import exit_code
    from caliv_graph.errors import RecordingError
    from caliv_graph.results.calibration_file import read_calibration

    if task.version != caliv_graph.__version__:
        raise CalivError(
            f"the worker on {socket.gethostname()} has caliv-graph {caliv_graph.__version__}, the "
            f"batch {task.version}. Install the same version on all workers"
        )
    _keep_freed_memory()
    # The readers know best what is wrong with a drive or a prior.
    check_guesses(task.config, task.config_file)
    prior = None if task.prior is None else read_calibration(task.prior)
    recordings = open_recordings(task.config, task.data)
    inputs = job_inputs(task.config, task.data, task.prior, task.out)
    if inputs is None:
        raise RecordingError(f"{recordings[0].name}: holds no files that could be read")
    progress = _WatchedProgress(task)
    cache = DigestCache.parse(task.cache)
    before = inputs.states()
    with progress.stage("reading"):
        digest = job_digest(task.config, inputs, cache)
    if digest == task.recorded:
        return Outcome("unchanged", digest=digest, cache=cache.dump())
    with threadpool_limits(limits=1), on_one_core(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        job = run_job(recordings, task.config, progress, prior)
        with progress.stage("writing"):
            staged = task.work / f"{task.name}.result-{attempt}"
            staged.mkdir()
            job.write(staged)
    changed = [path for path, state in inputs.states().items() if before[path] != state]
    if changed:
        raise RecordingError(
            f"{changed[0]}: was written to while it was calibrated from. Run the batch again when "
            "the recording is whole"
        )
    return Outcome(
        "calibrated",
        exit=exit_code(job.calibration),
        digest=digest,
        staged=staged,
        warnings=job.warnings,
        seconds=time.monotonic() - start,
        cache=cache.dump(),
    )


def _attempt_file(work: Path, job: str, number: int) -> Path:
    return work / f"{job}.attempt-{number}"


def _mark_attempt(task: Task, number: int) -> None:
    """Says who takes up the job, before it can do any harm."""
    attempt = {"host": socket.gethostname(), "pid": os.getpid()}
    try:
        _attempt_file(task.work, task.name, number).write_text(json.dumps(attempt), "utf-8")
    except FileNotFoundError:
        raise NotWantedError from None


def probe(token: str, version: str) -> str:
    """Whether a worker can do the jobs of a batch.

    Args:
        token: a file in the batch's folder, which all workers have to see.
        version: of the program that runs the batch.

    Returns:
        What is wrong; empty: nothing.
    """
    if version != caliv_graph.__version__:
        return f"has caliv-graph {caliv_graph.__version__}, not {version}: install the same version"
    if not os.access(token, os.R_OK):
        return f"does not see {token}: put data and --out on a disk that all workers share"
    return ""


def dask_setup(worker: Any) -> None:
    """Prepares a worker of our own cluster (Dask calls this where the module is a preload).

    What native code prints is no part of the batch's own output.
    """
    os.dup2(2, 1)
