"""The folder of a batch behind a URL.

A local copy holds what a resume needs: the digests, and of each job job.json and calibration.yaml.
Results are put as they are finished. job.json comes last and names the sizes of all others, so that
a result counts only if it is whole. Nothing locks a URL against a second batch.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from caliv_graph.batch.folder import (
    CACHE_FILE,
    JOB_FILE,
    JOB_FILES,
    SUMMARY_FILE,
    SUMMARY_FILES,
    BatchFolder,
    JobRecord,
)
from caliv_graph.batch.remote import ListedFile, RemoteFolder
from caliv_graph.errors import OutputError
from caliv_graph.results.names import CALIBRATION_FILE


class RemoteBatchFolder(BatchFolder):
    """A `BatchFolder` whose content is behind a URL; `path` is the local copy.

    The copy is below the folder for temporary files (TMPDIR), which the workers of a cluster must
    share.
    """

    def __init__(self, url: str) -> None:
        self._remote = RemoteFolder(url)
        self._scratch = Path(tempfile.mkdtemp(prefix="caliv-graph-batch-"))
        super().__init__(self._scratch / "batch")
        self._given = self.path
        self._listed: dict[str, ListedFile] = {}
        self._new = False

    def __enter__(self) -> Self:
        """Fetches what a resume needs.

        Raises:
            OutputError: the URL is not that of a batch, or cannot be used.
            RecordingError: it cannot be listed.
        """
        try:
            self._listed = self._remote.files()
            self._new = not self._listed
            self.path.mkdir(parents=True)
            if not self._new and not self._fetched("", SUMMARY_FILE):
                raise OutputError(
                    f"{self._remote.url}: exists already, and is not the folder of a batch (no "
                    f"{SUMMARY_FILE}). Give another --out"
                )
            self._fetched("", CACHE_FILE)
            return super().__enter__()
        except BaseException:
            shutil.rmtree(self._scratch, ignore_errors=True)
            raise

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            if error is not None and self._new and not self._has_results():
                self._remote.remove((*SUMMARY_FILES, CACHE_FILE))
        finally:
            super().__exit__(kind, error, traceback)
            shutil.rmtree(self._scratch, ignore_errors=True)

    def record(self, job: str) -> JobRecord | None:
        """job.json of a job; None if there is no complete result of a batch."""
        for name in (CALIBRATION_FILE, JOB_FILE):
            if not (self.path / job / name).is_file() and f"{job}/{name}" in self._listed:
                self._fetched(job, name)
        return super().record(job)

    def check_place(self, job: str, force: bool) -> None:
        """Checks before the calibration that the result of a job can be put.

        Raises:
            OutputError: there is other content.
        """
        names = [n.removeprefix(f"{job}/") for n in self._listed if n.startswith(f"{job}/")]
        foreign = sorted(set(names) - set(JOB_FILES))
        if foreign or (names and not force and JOB_FILE not in names):
            what = f"holds '{foreign[0]}'" if foreign else f"holds no {JOB_FILE}"
            raise OutputError(
                f"{self._remote.url}/{job}: exists already, and {what}: it is not a result of a "
                "batch. Move it elsewhere, or give another --out"
            )

    def put(self, job: str, staged: Path, **of_record: Any) -> JobRecord:
        """Puts the files in `staged` and their job.json; see `BatchFolder.put`.

        Raises:
            OutputError: a file cannot be written.
        """
        record = super().put(job, staged, **of_record)
        folder = self.path / job
        # Until the new job.json is there, no result is.
        self._remote.remove([f"{job}/{JOB_FILE}"])
        files = [folder / name for name in record.files]
        self._remote.put([*files, folder / JOB_FILE], job)
        for file in files:
            self._listed[f"{job}/{file.name}"] = ListedFile(record.files[file.name], None)
            if file.name != CALIBRATION_FILE:
                file.unlink()
        return record

    def write(self, files: Mapping[str, str]) -> None:
        """Replaces files of the summary, here and behind the URL.

        Raises:
            OutputError: a file cannot be written.
        """
        super().write(files)
        self._remote.put([self.path / name for name in files])

    def keep_cache(self) -> None:
        """Writes the digests for the next run.

        Raises:
            OutputError: the file cannot be written.
        """
        super().keep_cache()
        self._remote.put([self.path / CACHE_FILE])

    def _sizes(self, job: str, names: Iterable[str]) -> dict[str, int]:
        return {n: of.size for n in names if (of := self._listed.get(f"{job}/{n}")) is not None}

    def _fetched(self, below: str, name: str) -> bool:
        """Copies a file here; False if there is none."""
        content = self._remote.read(f"{below}/{name}" if below else name)
        if content is None:
            return False
        (self.path / below).mkdir(exist_ok=True)
        (self.path / below / name).write_bytes(content)
        return True
