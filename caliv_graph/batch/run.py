"""A batch from its jobs to its summary: finished jobs are skipped, the others go to workers."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import caliv_graph
from caliv_graph.batch import cluster
from caliv_graph.batch.digests import DigestCache, job_digest, job_inputs
from caliv_graph.batch.folder import BatchFolder, JobRecord
from caliv_graph.batch.manifest import Job, effective_config
from caliv_graph.batch.page import render_index
from caliv_graph.batch.remote import is_url
from caliv_graph.batch.remote_folder import RemoteBatchFolder
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
"""Seconds between two requests for the number of workers."""

_PATIENCE_S = 300.0
"""Seconds without any worker, or without the scheduler, after which the batch ends."""

_MOST_SUBMISSIONS = 6
"""Submissions per job: another job may have killed its worker, or the scheduler was restarted."""

_WRITING_SHARE = 0.05
"""Largest fraction of the time for rewriting the summary while jobs run."""


def run_batch(
    jobs: Sequence[Job],
    out: str,
    progress: Progress,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    force: bool = False,
    manifest: str = "",
) -> Summary:
    """Runs all jobs of a batch that are not done yet, and writes its summary while they run.

    An earlier batch in `out` is resumed: results from the same inputs, config and version are kept.

    Args:
        jobs: of the manifest.
        out: the folder of the batch, a path or a URL. An earlier batch there is resumed: results
            from the same inputs, config and version are kept.
        progress: shows the jobs.
        scheduler: address of a Dask scheduler; None: workers on this machine.
        workers: number of workers; None: the number of processors, or of jobs if smaller.
        force: run all jobs again, and replace results of `calibrate` in their folders.
        manifest: path of the manifest, for the summary.

    Raises:
        OutputError: `out` is not the folder of a batch, or cannot be written.
        BatchError: Dask is not installed, or its scheduler or workers cannot be used.
    """
    with RemoteBatchFolder(out) if is_url(out) else BatchFolder(Path(out)) as folder:
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
    """The state of a batch: its locked folder, a row per job of the manifest, and what is to do."""

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
        """Writes the current summary and digests."""
        start = time.monotonic()
        summary = self.summary()
        self.folder.keep_cache()
        # The page last, since it links to the other files.
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
        """Sorts the jobs into done, failed and to do."""
        with progress.stage("checking for finished jobs", len(self._jobs)) as advance:
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
        except (OSError, CalivError):
            pass  # the job itself reports a missing file or URL
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
        """Runs the remaining jobs on the workers."""
        queue = deque((name, 0) for name in self.todo)
        flying: dict[str, tuple[Any, int]] = {}  # the future, and the number of submissions
        count, counted_s, alive_s = workers.count(), time.monotonic(), time.monotonic()
        with progress.stage("calibrating", len(self._jobs)) as advance:
            finished = len(self._jobs) - len(self.todo)
            if finished:
                advance(finished, f"{finished} were done or failed before")
            while queue or flying:
                now = time.monotonic()
                if workers.connected and now - counted_s > (_COUNT_S if count else _POLL_S):
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
                    except OSError:  # the connection was lost a moment ago
                        queue.append((name, submissions))
                        break
                    flying[name] = (future, submissions + 1)
                time.sleep(_POLL_S)
                for name in [name for name, (future, _) in flying.items() if future.done()]:
                    future, submissions = flying.pop(name)
                    if self._land(name, future, submissions, workers):
                        advance(1, self._note(flying))
                        self._write_now_and_then()
                    else:
                        queue.append((name, submissions))
                advance(0, self._note(flying))

    def _task(self, name: str) -> Task:
        """A job with all digests of its files that are known by now."""
        entries = self.folder.cache.entries
        known = self._files.get(name, set()) & entries.keys()
        cache = DigestCache({path: entries[path] for path in known})
        return replace(self.todo[name], cache=cache.dump())

    def _land(self, name: str, future: Any, submissions: int, workers: cluster.Workers) -> bool:
        """Records the outcome of a job; False if the job must be submitted again."""
        if future.status == "finished":
            outcome: Outcome = future.result()
        else:
            error = future.exception() if future.status == "error" else None
            died = type(error).__name__ == "KilledWorker"
            if error is not None and not died:
                outcome = Outcome("failed", DEFECT, f"its worker could not run it: {error!r}")
            elif len(attempts(self.folder.work, name)) >= MOST_ATTEMPTS:
                outcome = Outcome("died")
            elif submissions < _MOST_SUBMISSIONS:
                return False
            else:
                outcome = Outcome(
                    "failed",
                    None,
                    f"was lost {_MOST_SUBMISSIONS} times with its worker or the scheduler",
                )
        future.release()
        self.folder.cache.entries.update(DigestCache.parse(outcome.cache).entries)
        if outcome.kind == "died":
            self._fail(name, None, self._death(name, workers))
        elif outcome.kind == "unchanged":
            record = self.folder.record(name)
            if record is None or not self._take(name, record, reused=True):
                self._fail(name, None, "its result changed during the batch. Run the batch again")
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
        """Adds a result to the summary; False if the result cannot be read."""
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
            message += " (its folder still contains an older result)"
        text = " ".join(message.split())
        self._set(
            replace(self.rows[name], state="failed", exit=exit_code, message=text, trace=trace)
        )

    def _set(self, row: Row) -> None:
        self.rows[row.job] = row
        self._unwritten = True

    def _death(self, name: str, workers: cluster.Workers) -> str:
        parts = []
        for host, pid in attempts(self.folder.work, name):
            how = workers.deaths.get(pid, "ended without a message")
            parts.append(f"process {pid} on {host} {how}")
        return (
            f"its worker died {len(parts)} times: {'; '.join(parts)}. Signal 9 usually means that "
            "the system is out of memory: give the batch fewer --workers"
        )

    def _give_up(self, names: Sequence[str], workers: cluster.Workers) -> None:
        what = "no worker is left" if workers.connected else "the scheduler is lost"
        if len(names) == len(self.todo):
            raise BatchError(
                f"batch: {what}, and no job was done. Start it, and run the batch again"
            )
        for name in names:
            self._fail(name, None, f"{what}. Run the batch again")

    def _note(self, flying: Iterable[str]) -> str:
        """The jobs that run now, with their stages."""
        parts = []
        for name in flying:
            try:
                stage = stage_file(self.folder.work, name).read_text(encoding="utf-8")
            except OSError:
                stage = "starting"
            parts.append(f"{name}: {stage}")
        return "; ".join(parts[:4]) + (f"; {len(parts) - 4} more" if len(parts) > 4 else "")

    def _write_now_and_then(self) -> None:
        """Writes the summary, unless writing takes too large a part of the time."""
        if time.monotonic() - self._last_write >= self._write_s / _WRITING_SHARE:
            self.write()


def _asked(count: Callable[[], int]) -> int:
    """The number of workers; 0 if the scheduler does not answer."""
    try:
        return count()
    except Exception:
        return 0


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
