"""The folder of a batch: one result per job, the summary, and the state for a resume.

The folder of a job also has job.json with the digest of its inputs. Both appear together, by one
rename, so that no result exists without its digest. Workers write below `.work/`; only the process
that holds `.lock` moves results to their folders.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import secrets
import shutil
import socket
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from caliv_graph.batch.digests import JOB_SCHEMA, DigestCache
from caliv_graph.common.files import atomic_write, check_output_folder, output_folder
from caliv_graph.errors import OutputError
from caliv_graph.results.names import CALIBRATION_FILE, RESULT_FILES

SUMMARY_SCHEMA = "caliv-graph/batch/1"
SUMMARY_FILE = "summary.json"
SUMMARY_FILES = (SUMMARY_FILE, "summary.csv", "index.html")

JOB_FILE = "job.json"
JOB_FILES = (*RESULT_FILES, JOB_FILE)

CACHE_FILE, _LOCK, _WORK = ".digests.json", ".lock", ".work"

_LEFT_OVER = re.compile(r"\.(.+)\.[0-9a-f]{12}")
"""Names of the temporary folders of `common.files`."""


@dataclass(frozen=True)
class JobRecord:
    """The content of job.json about the result in the same folder.

    Attributes:
        digest: of the inputs (`digests.job_digest`).
        exit: exit code of `calibrate` for this job.
        seconds: duration of the calibration.
        warnings: one line each.
        written: time of writing, UTC, ISO 8601.
        files: size in bytes of every file of the result.
        calibration_sha256: of calibration.yaml.
    """

    digest: str
    exit: int
    seconds: float
    warnings: tuple[str, ...]
    written: str
    files: Mapping[str, int]
    calibration_sha256: str


class BatchFolder:
    """The folder of a batch; a context manager that creates it and locks it against other batches.

    Attributes:
        path: the folder, absolute.
        work: folder for the workers of this run, removed with the end of the context.
        cache: digests of the files read.
    """

    def __init__(self, path: Path) -> None:
        self._given = path
        self.path = path.absolute()
        self.work = self.path / _WORK / secrets.token_hex(6)
        self.cache = DigestCache()
        self._made: list[Path] = []
        self._lock: int | None = None

    def __enter__(self) -> Self:
        """Creates and locks the folder.

        Raises:
            OutputError: the folder is not one of a batch, is locked, or cannot be written.
        """
        try:
            self._check_ours()
            for folder in (*reversed(self.path.parents), self.path):
                if not folder.exists():
                    folder.mkdir()
                    self._made.append(folder)
            self._take_lock()
            self._sweep()
            self.work.mkdir(parents=True)
            if (self.path / CACHE_FILE).is_file():
                text = (self.path / CACHE_FILE).read_text(encoding="utf-8", errors="replace")
                self.cache = DigestCache.parse(text)
        except OSError as e:
            self._leave(nothing_done=True)
            raise OutputError(
                f"{self._given}: cannot be written: {e.strerror or e}. Give another --out"
            ) from None
        except BaseException:
            self._leave(nothing_done=True)
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._leave(nothing_done=error is not None)

    def record(self, job: str) -> JobRecord | None:
        """job.json of a job; None if the folder has no complete result of a batch."""
        folder = self.path / job
        try:
            document = json.loads((folder / JOB_FILE).read_text(encoding="utf-8"))
            if document.pop("schema") != JOB_SCHEMA:
                return None
            document["warnings"] = tuple(document["warnings"])
            record = JobRecord(**document)
            if self._sizes(job, record.files) != record.files:
                return None
            if _sha256(folder / CALIBRATION_FILE) != record.calibration_sha256:
                return None
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            return None
        return record

    def _sizes(self, job: str, names: Iterable[str]) -> dict[str, int]:
        """Bytes of files of a job.

        Raises:
            OSError: one is missing.
        """
        return {name: (self.path / job / name).stat().st_size for name in names}

    def check_place(self, job: str, force: bool) -> None:
        """Checks before the calibration that the result of a job can be written.

        An older result of a batch is replaced, since its digest differs.

        Raises:
            OutputError: the folder has other content.
        """
        ours = force or (self.path / job / JOB_FILE).is_file()
        check_output_folder(self._given / job, JOB_FILES, force=ours)

    def put(
        self,
        job: str,
        staged: Path,
        *,
        digest: str,
        exit_code: int,
        seconds: float,
        warnings: tuple[str, ...],
        written: str,
    ) -> JobRecord:
        """Moves the files in `staged` to the folder of their job in one step; see `JobRecord`.

        Raises:
            OutputError: the folder cannot be written.
        """
        with output_folder(self._given / job, JOB_FILES, force=True) as folder:
            sizes = {}
            for file in sorted(staged.iterdir()):
                file.rename(folder / file.name)
                sizes[file.name] = (folder / file.name).stat().st_size
            record = JobRecord(
                digest=digest,
                exit=exit_code,
                seconds=round(seconds, 3),
                warnings=warnings,
                written=written,
                files=sizes,
                calibration_sha256=_sha256(folder / CALIBRATION_FILE),
            )
            document = {"schema": JOB_SCHEMA, **asdict(record)}
            (folder / JOB_FILE).write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
        return record

    def write(self, files: Mapping[str, str]) -> None:
        """Replaces files of the summary, each in one step.

        Raises:
            OutputError: a file cannot be written.
        """
        for name, text in files.items():
            atomic_write(self._given / name, text, force=True)

    def keep_cache(self) -> None:
        """Writes the digests for the next run.

        Raises:
            OutputError: the file cannot be written.
        """
        atomic_write(self._given / CACHE_FILE, self.cache.dump(), force=True)

    def _check_ours(self) -> None:
        if not self.path.exists():
            return
        if not self.path.is_dir():
            raise OutputError(f"{self._given}: is a file. Give --out the name of a folder")
        names = {entry.name for entry in self.path.iterdir()}
        if names <= {CACHE_FILE, _LOCK, _WORK}:
            return
        if not _is_summary(self.path / SUMMARY_FILE):
            raise OutputError(
                f"{self._given}: exists already, and is not the folder of a batch (no "
                f"{SUMMARY_FILE}). Give another --out"
            )

    def _take_lock(self) -> None:
        self._lock = os.open(self.path / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(self._lock, 200).decode(errors="replace").strip()
            os.close(self._lock)
            self._lock = None
            raise OutputError(
                f"{self._given}: another batch uses this folder ({holder or 'unknown process'}). "
                "Wait until it ends, or give another --out"
            ) from None
        os.ftruncate(self._lock, 0)
        os.write(self._lock, f"process {os.getpid()} on {socket.gethostname()}\n".encode())

    def _sweep(self) -> None:
        """Removes temporary files of a killed batch, whose workers stop when they are gone."""
        shutil.rmtree(self.path / _WORK, ignore_errors=True)
        for entry in self.path.iterdir():
            if not _LEFT_OVER.fullmatch(entry.name):
                continue
            if entry.is_file():
                entry.unlink()
            elif {child.name for child in entry.iterdir()} <= {"new", "old"}:
                shutil.rmtree(entry, ignore_errors=True)

    def _leave(self, nothing_done: bool) -> None:
        """Unlocks the folder; removes it if this run created it and wrote no result."""
        if self._lock is None:
            made = self._made
        else:
            shutil.rmtree(self.path / _WORK, ignore_errors=True)
            made = self._made if nothing_done and not self._has_results() else []
            if self.path in made:
                for name in (*SUMMARY_FILES, CACHE_FILE, _LOCK):
                    (self.path / name).unlink(missing_ok=True)
            os.close(self._lock)
            self._lock = None
        for folder in reversed(made):
            if not any(folder.iterdir()):
                folder.rmdir()

    def _has_results(self) -> bool:
        return any((entry / JOB_FILE).is_file() for entry in self.path.iterdir())


def _is_summary(path: Path) -> bool:
    try:
        document: Any = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(document, dict) and document.get("schema") == SUMMARY_SCHEMA


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
