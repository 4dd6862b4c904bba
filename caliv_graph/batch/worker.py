"""One job, in the process of a Dask worker.

A worker may die, lose its connection or be stopped at any time. It writes below the work folder of
the run. When that folder is gone, the batch has ended and the worker stops.
"""

from __future__ import annotations

import ctypes
import functools
import json
import os
import shutil
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
from caliv_graph.batch.remote import Fetched, RemoteFolder
from caliv_graph.common.exits import DEFECT, USAGE
from caliv_graph.common.progress import SilentProgress, StageRecord, count_text
from caliv_graph.config.model import Config
from caliv_graph.errors import CalivError

MOST_ATTEMPTS = 2
"""Attempts per job: the first worker may have died for a reason outside the job."""

_LOOK_S = 1.0
"""Seconds between two checks that the batch still runs."""

_NO_MEMORY = "the memory is not sufficient. Give the batch fewer --workers"

_ONE_AT_A_TIME = threading.Lock()
"""A worker may have several threads, but runs one pipeline at a time."""


@dataclass(frozen=True)
class Task:
    """The description of a job for a worker. All paths are absolute.

    Attributes:
        config_file: path of the config, for messages.
        data: drives, paths and URLs (text); empty: `data.path` of the config.
        prior: an earlier calibration.
        recorded: digest of the existing result; None: there is none, or it is made again.
        cache: known digests of the input files (`DigestCache.dump`).
    """

    name: str
    config: Config
    config_file: Path
    data: tuple[Path | str, ...]
    prior: Path | None
    recorded: str | None
    cache: str
    out: Path
    work: Path
    version: str


@dataclass(frozen=True)
class Outcome:
    """The outcome of a job.

    Attributes:
        kind: `calibrated`; `unchanged`: the existing result is valid; `failed`; `died`: all
            attempts ended with the death of the worker.
        exit: exit code of `calibrate` for this job; None if a worker died.
        message: reason of the failure, one line.
        staged: folder of the result.
        cache: digests of the input files.
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
    """The batch has ended or was killed."""


class _WatchedProgress(SilentProgress):
    """Writes the current stage to a file, and stops the job when the batch has ended."""

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
    """The file in which a worker writes its current stage."""
    return work / f"{job}.stage"


def attempts(work: Path, job: str) -> list[tuple[str, int]]:
    """Host and process of the attempts at a job in this run, in order."""
    out: list[tuple[str, int]] = []
    for number in range(1, MOST_ATTEMPTS + 1):
        try:
            found = json.loads(_attempt_file(work, job, number).read_text("utf-8"))
            out.append((found["host"], found["pid"]))
        except (OSError, ValueError, TypeError, KeyError):
            break
    return out


def run_task(task: Task) -> Outcome:
    """Runs a job unless it is done or has used all attempts. Errors become outcomes.

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
    """Lets the C library keep freed memory for the next array.

    Dask sets M_TRIM_THRESHOLD, which disables glibc's dynamic thresholds: a quarter of the run time
    was then spent on zeroing pages.
    """
    with suppress(OSError, AttributeError):
        for option, value in _MALLOPT.items():
            ctypes.CDLL(None).mallopt(option, value)


def _run(task: Task, attempt: int, start: float) -> Outcome:
    scratch = task.work / f"{task.name}.data-{attempt}"
    try:
        return _calibrated(task, attempt, start, scratch)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _fetched(task: Task, scratch: Path, progress: SilentProgress) -> dict[str, Fetched]:
    """Copies the drives behind URLs to the folder `scratch`; by URL.

    Raises:
        CalivError: one cannot be read.
    """
    urls = [drive for drive in task.data if isinstance(drive, str)]
    out: dict[str, Fetched] = {}
    for number, url in enumerate(dict.fromkeys(urls)):
        with progress.stage("fetching"):
            out[url] = RemoteFolder(url).fetch(scratch / str(number))
    return out


def _calibrated(task: Task, attempt: int, start: float, scratch: Path) -> Outcome:
    # Imported here: the process of the batch itself does not need the estimator.
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
    # The readers first: their messages about a drive or a prior are the most specific.
    check_guesses(task.config, task.config_file)
    prior = None if task.prior is None else read_calibration(task.prior)
    progress = _WatchedProgress(task)
    cache = DigestCache.parse(task.cache)
    fetched = _fetched(task, scratch, progress)
    drives = [fetched[d].copy if isinstance(d, str) else d for d in task.data]
    recordings = open_recordings(task.config, drives)
    inputs = job_inputs(task.config, task.data, task.prior, task.out, fetched)
    if inputs is None:
        raise RecordingError(f"{recordings[0].name}: has no readable files")
    before = inputs.states()
    with progress.stage("reading"):
        digest = job_digest(task.config, inputs, cache)
    if digest == task.recorded:
        return Outcome("unchanged", digest=digest, cache=cache.dump())
    with threadpool_limits(limits=1), on_one_core(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        job = run_job(recordings, task.config, progress, prior)
        if task.data and isinstance(task.data[0], str):
            job = job.without_path()  # the copy goes
        with progress.stage("writing"):
            staged = task.work / f"{task.name}.result-{attempt}"
            staged.mkdir()
            job.write(staged)
    changed = [path for path, state in inputs.states().items() if before[path] != state]
    if changed:
        raise RecordingError(
            f"{changed[0]}: changed during the calibration. Run the batch again when the recording "
            "is complete"
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
    """Records the process of an attempt before the job starts."""
    attempt = {"host": socket.gethostname(), "pid": os.getpid()}
    try:
        _attempt_file(task.work, task.name, number).write_text(json.dumps(attempt), "utf-8")
    except FileNotFoundError:
        raise NotWantedError from None


def probe(token: str, version: str) -> str:
    """The reason why a worker cannot run the jobs of a batch of this version; empty: none.

    `token` is a file in the folder of the batch, which every worker must be able to read.
    """
    if version != caliv_graph.__version__:
        return f"has caliv-graph {caliv_graph.__version__}, not {version}: install the same version"
    if not os.access(token, os.R_OK):
        return f"cannot read {token}: put data and --out on a disk that all workers share"
    return ""


def dask_setup(worker: Any) -> None:
    """Prepares a worker of the local cluster (Dask calls this for a preload module).

    Output of native code goes to stderr, so that it does not mix with the output of the batch.
    """
    os.dup2(2, 1)
