"""A batch from its jobs to its summary: what is done is skipped, the rest goes to the workers."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import caliv_graph
from caliv_graph.batch import cluster
from caliv_graph.batch.digests import DigestCache, job_digest, job_inputs
from caliv_graph.batch.folder import BatchFolder, JobRecord
from caliv_graph.batch.manifest import Job, effective_config
from caliv_graph.batch.page import render_index
from caliv_graph.batch.summary import Row, Summary, summary_csv, summary_json
from caliv_graph.batch.worker import (
    MOST_ATTEMPTS,
    Outcome,
    Task,
    attempts,
    run_task,
    stage_file,
)
from caliv_graph.common.exits import DEFECT, USAGE
from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config
from caliv_graph.errors import BatchError, CalivError
from caliv_graph.results.calibration_file import read_calibration
from caliv_graph.results.names import CALIBRATION_FILE

_POLL_S = 0.2

_COUNT_S = 5.0
"""Seconds between two questions how many workers there are."""

_PATIENCE_S = 300.0
"""Seconds without any worker, or without the scheduler, after which the batch ends."""

_MOST_SUBMISSIONS = 6
"""Of one job: it may have been lost with a worker that another one took down, or a scheduler that
was started again."""

_WRITING_SHARE = 0.05
"""Part of the time that may go into rewriting the summary while jobs run."""


@dataclass
class _Flight:
    """A job that a worker has."""

    future: Any
    submissions: int


def run_batch(
    jobs: Sequence[Job],
    out: Path,
    progress: Progress,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    force: bool = False,
    manifest: str = "",
) -> Summary:
    """Does all jobs of a batch that are not done yet.

    Args:
        jobs: of the manifest.
        out: the folder of the batch. An earlier batch there is resumed: whatever was made from the
            same input, config and version is left as it is.
        progress: told of every job.
        scheduler: address of a Dask scheduler; None: workers on this machine.
        workers: how many of these; None: as many as there are processors, and jobs.
        force: do all jobs again, and replace results of `calibrate` in their folders.
        manifest: the file, for the summary.

    Returns:
        What became of all of them. It is written beside the results, and while they run.

    Raises:
        OutputError: `out` is not a batch's, or cannot be written.
        BatchError: Dask is missing, or its scheduler or workers are of no use.
    """
    with BatchFolder(out) as folder:
        batch = _Batch(jobs, folder, force, manifest)
        batch.prepare(progress)
        if batch.todo:
            try:
                with _workers(scheduler, workers, batch) as found:
                    if scheduler is not None:
                        token = folder.work / "token"
                        token.write_text("seen\n", encoding="utf-8")
                        cluster.check_workers(found, token, caliv_graph.__version__)
                    batch.work(found, progress)
            finally:
                batch.write()
        return batch.summary()


def _workers(
    scheduler: str | None, count: int | None, batch: _Batch
) -> AbstractContextManager[cluster.Workers]:
    if scheduler is not None:
        return cluster.connect(scheduler, count)
    count = cluster.default_workers() if count is None else count
    return cluster.start(min(count, len(batch.todo)), batch.folder.work / "dask")


class _Batch:
    """The state of a batch.

    Attributes:
        folder: of it, held.
        rows: what became of each job, in the manifest's order.
        todo: what is left for workers.
    """

    def __init__(
        self, jobs: Sequence[Job], folder: BatchFolder, force: bool, manifest: str
    ) -> None:
        self.folder = folder
        self.rows = {job.name: Row(job.name, job.vehicle) for job in jobs}
        self.todo: dict[str, Task] = {}
        self._jobs = jobs
        self._files: dict[str, set[str]] = {}
        self._force = force
        self._manifest = manifest
        self._last_write = -1e9
        self._write_s = 0.0
        self._unwritten = True

    def summary(self) -> Summary:
        return Summary(tuple(self.rows.values()), self._manifest, _now())

    def write(self) -> None:
        """Writes summary and digests as they are now."""
        start = time.monotonic()
        summary = self.summary()
        self.folder.keep_cache()
        # The page last: who sees it finds the rest there.
        self.folder.write(
            {
                "summary.json": summary_json(summary),
                "summary.csv": summary_csv(summary),
                "index.html": render_index(summary),
            }
        )
        self._last_write = time.monotonic()
        self._write_s = self._last_write - start
        self._unwritten = False

    def prepare(self, progress: Progress) -> None:
        """Finds what is done, what cannot be done, and what is left."""
        with progress.stage("looking at what is there", len(self._jobs)) as advance:
            for job in self._jobs:
                try:
                    config = effective_config(job)
                except CalivError as e:
                    self._fail(job.name, USAGE, str(e))
                else:
                    self._prepare(job, config)
                advance()
        self.write()

    def _prepare(self, job: Job, config: Config) -> None:
        self.folder.check_place(job.name, self._force)
        record = None if self._force else self.folder.record(job.name)
        try:
            inputs = job_inputs(config, job.data, job.prior, self.folder.path)
            if inputs is not None:
                if inputs.known(self.folder.cache) and record is not None:
                    digest = job_digest(config, inputs, self.folder.cache)
                    if digest == record.digest and self._take(job.name, record, reused=True):
                        return
                self._files[job.name] = {str(path) for path in inputs.files}
        except OSError:
            pass  # what is not there, the job itself will say
        self.todo[job.name] = Task(
            name=job.name,
            config=config,
            config_file=job.config,
            data=job.data,
            prior=job.prior,
            recorded=None if record is None else record.digest,
            cache="",
            out=self.folder.path,
            work=self.folder.work,
            version=caliv_graph.__version__,
        )

    def work(self, workers: cluster.Workers, progress: Progress) -> None:
        """Has the workers do what is left."""
        queue = deque((name, 0) for name in self.todo)
        flying: dict[str, _Flight] = {}
        count, counted_s, alive_s = workers.count(), time.monotonic(), time.monotonic()
        with progress.stage("calibrating", len(self._jobs)) as advance:
            finished = len(self._jobs) - len(self.todo)
            if finished:
                advance(finished, f"{finished} were done or cannot be")
            while queue or flying:
                now = time.monotonic()
                if workers.connected and now - counted_s > _COUNT_S:
                    count, counted_s = _asked(workers.count), now
                if workers.connected and count:
                    alive_s = now
                if workers.lost or now - alive_s > _PATIENCE_S:
                    self._give_up([*flying, *(name for name, _ in queue)], workers)
                    return
                while workers.connected and queue and len(flying) < count:
                    name, submissions = queue.popleft()
                    key = f"{name}-{self.folder.work.name}-{submissions}"
                    try:
                        task = self._task(name)
                        future = workers.client.submit(run_task, task, key=key, pure=False)
                    except OSError:  # the scheduler went away a moment ago
                        queue.append((name, submissions))
                        break
                    flying[name] = _Flight(future, submissions + 1)
                time.sleep(_POLL_S)
                for name in [name for name, flight in flying.items() if flight.future.done()]:
                    flight = flying.pop(name)
                    if self._land(name, flight, workers):
                        advance(1, self._note(flying))
                        self._write_now_and_then()
                    else:
                        queue.append((name, flight.submissions))
                advance(0, self._note(flying))

    def _task(self, name: str) -> Task:
        """A job with what is known by now of its files: others may have read them."""
        entries = self.folder.cache.entries
        known = self._files.get(name, set()) & entries.keys()
        cache = DigestCache({path: entries[path] for path in known})
        return replace(self.todo[name], cache=cache.dump())

    def _land(self, name: str, flight: _Flight, workers: cluster.Workers) -> bool:
        """Takes what became of a job; False if it has to be done again."""
        future = flight.future
        if future.status == "finished":
            outcome: Outcome = future.result()
        else:
            error = future.exception() if future.status == "error" else None
            died = type(error).__name__ == "KilledWorker"
            if error is not None and not died:
                outcome = Outcome("failed", DEFECT, f"its worker could not run it: {error!r}")
            elif len(attempts(self.folder.work, name)) >= MOST_ATTEMPTS:
                outcome = Outcome("died")
            elif flight.submissions < _MOST_SUBMISSIONS:
                return False
            else:
                outcome = Outcome(
                    "failed", None, f"was lost {_MOST_SUBMISSIONS} times with a worker or scheduler"
                )
        future.release()
        self.folder.cache.entries.update(DigestCache.parse(outcome.cache).entries)
        if outcome.kind == "died":
            self._fail(name, None, self._death(name, workers))
        elif outcome.kind == "unchanged":
            record = self.folder.record(name)
            if record is None or not self._take(name, record, reused=True):
                self._fail(name, None, "its result has changed meanwhile. Run the batch again")
        elif outcome.kind == "calibrated" and outcome.staged is not None:
            self._put(name, outcome, outcome.staged)
        else:
            self._fail(name, outcome.exit, outcome.message, outcome.trace)
        return True

    def _put(self, name: str, outcome: Outcome, staged: Path) -> None:
        try:
            record = self.folder.put(
                name,
                staged,
                digest=outcome.digest,
                exit_code=DEFECT if outcome.exit is None else outcome.exit,
                seconds=outcome.seconds,
                warnings=outcome.warnings,
                written=_now(),
            )
        except CalivError as e:
            self._fail(name, USAGE, str(e))
        else:
            self._take(name, record, reused=False)

    def _take(self, name: str, record: JobRecord, reused: bool) -> bool:
        """Takes a result into the summary, if it can be read."""
        try:
            calibration = read_calibration(self.folder.path / name / CALIBRATION_FILE)
        except CalivError as e:
            if not reused:
                self._fail(name, DEFECT, f"its result cannot be read: {e}")
            return False
        self._set(
            replace(
                self.rows[name],
                state="done",
                exit=record.exit,
                seconds=record.seconds,
                digest=record.digest,
                warnings=record.warnings,
                calibration=calibration,
                reused=reused,
            )
        )
        return True

    def _fail(
        self, name: str, exit_code: int | None, message: str, trace: tuple[str, ...] = ()
    ) -> None:
        if (self.folder.path / name / CALIBRATION_FILE).is_file():
            message += " (its folder still holds an older result)"
        text = " ".join(message.split())
        self._set(
            replace(self.rows[name], state="failed", exit=exit_code, message=text, trace=trace)
        )

    def _set(self, row: Row) -> None:
        self.rows[row.job] = row
        self._unwritten = True

    def _death(self, name: str, workers: cluster.Workers) -> str:
        parts = []
        for attempt in attempts(self.folder.work, name):
            how = workers.deaths.get(attempt.pid, "ended without a word")
            parts.append(f"process {attempt.pid} on {attempt.host} {how}")
        return (
            f"its worker died {len(parts)} times: {'; '.join(parts)}. Signal 9 is mostly the "
            "system that runs out of memory: give the batch fewer --workers"
        )

    def _give_up(self, names: Sequence[str], workers: cluster.Workers) -> None:
        what = "there was no worker" if workers.connected else "the scheduler was lost"
        if len(names) == len(self.todo):
            raise BatchError(
                f"batch: {what}, and no job was done. Start it, and run the batch again"
            )
        for name in names:
            self._fail(name, None, f"{what}. Run the batch again")

    def _note(self, flying: dict[str, _Flight]) -> str:
        """What is going on, as a person wants to know it."""
        parts = []
        for name in flying:
            try:
                stage = stage_file(self.folder.work, name).read_text(encoding="utf-8")
            except OSError:
                stage = "starting"
            parts.append(f"{name}: {stage}")
        return "; ".join(parts[:4]) + (f"; {len(parts) - 4} more" if len(parts) > 4 else "")

    def _write_now_and_then(self) -> None:
        """Writes the summary, unless that would take too much of the time."""
        if time.monotonic() - self._last_write >= self._write_s / _WRITING_SHARE:
            self.write()


def _asked(count: Callable[[], int]) -> int:
    """How many workers there are; none, if nobody answers."""
    try:
        return count()
    except Exception:
        return 0


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
