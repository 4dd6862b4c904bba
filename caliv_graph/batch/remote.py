"""Drives and results behind URLs, such as s3://bucket/drive, by fsspec.

What is there is listed, fetched as a whole and put as a whole. Keys and endpoints are those of the
environment and of fsspec's own configuration files.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path, PurePosixPath
from typing import Any

from caliv_graph.errors import BatchError, CalivError, OutputError, RecordingError

MARKS = (
    *("ETag", "etag", "md5Hash", "content_md5", "md5", "checksum", "crc32c", "generation"),
    *("version_id", "VersionId", "LastModified", "last_modified", "mtime", "updated", "created"),
    "ino",
)
"""What file systems say of a file that changes when the file is written."""


def is_url(text: str) -> bool:
    """Whether a drive or a folder is a URL, and not a path."""
    return "://" in text


@dataclass(frozen=True)
class ListedFile:
    """A file behind a URL.

    Attributes:
        size: bytes.
        mark: changes when the file is written; None: its file system says nothing but the size.
    """

    size: int
    mark: str | None


@dataclass(frozen=True)
class Fetched:
    """A local copy of what is behind a URL.

    Attributes:
        listed: its files by name, the same before and after they were copied.
        copy: the folder, or the single file.
    """

    listed: Mapping[str, ListedFile]
    copy: Path


class RemoteFolder:
    """A folder, or a single file, behind a URL.

    Names are relative to it; those of hidden files, which begin with a dot, are left out of lists.
    """

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")

    @cached_property
    def _opened(self) -> tuple[Any, str]:
        """The file system of fsspec, and the path in it.

        Raises:
            BatchError: fsspec or the package of this protocol is missing.
        """
        try:
            fsspec = import_module("fsspec")
        except ImportError:
            raise BatchError(
                f"{self.url}: a URL needs fsspec: pip install 'caliv-graph[batch]'"
            ) from None
        try:
            system, path = fsspec.url_to_fs(self.url)
        except ImportError as e:
            raise BatchError(
                f"{self.url}: {e}, with pip where the batch and its workers run"
            ) from None
        except ValueError as e:
            raise BatchError(
                f"{self.url}: {e}. Give a URL that fsspec knows, such as s3://bucket/folder, or a "
                "path"
            ) from None
        return system, path.rstrip("/")

    @property
    def name(self) -> str:
        """Its last part."""
        return PurePosixPath(self.url.split("://", 1)[1]).name

    def files(self) -> dict[str, ListedFile]:
        """All files below that are not hidden, by name; a single file is itself, without a name.

        Empty if there is nothing.

        Raises:
            RecordingError: it cannot be listed.
        """
        with self._errors(RecordingError, "read"):
            system, path = self._opened
            system.invalidate_cache()
            if system.isfile(path):
                return {"": _listed(system.info(path))}
            found = system.find(path, detail=True) if system.exists(path) else {}
            out = {}
            for full, info in sorted(found.items()):
                name = full.removeprefix(path).lstrip("/")
                if info.get("type") == "file" and not any(p[0] == "." for p in name.split("/")):
                    out[name] = _listed(info)
            return out

    def read(self, name: str) -> bytes | None:
        """The content of a file; None if it is not there.

        Raises:
            RecordingError: it cannot be read.
        """
        with self._errors(RecordingError, "read"):
            system, path = self._opened
            try:
                return bytes(system.cat_file(f"{path}/{name}"))
            except FileNotFoundError:
                return None

    def fetch(self, folder: Path) -> Fetched:
        """Copies all files into a local folder, below the name that it has here.

        Raises:
            RecordingError: there is nothing, a file cannot be read, or changes meanwhile.
            OSError: the copy cannot be written.
        """
        listed = self.files()
        if not listed:
            raise RecordingError(
                f"{self.url}: nothing is there. Give the URL of a bag, or of the folder of a drive"
            )
        system, path = self._opened
        copy = folder / (self.name or "drive")
        for name, of in listed.items():
            local = copy / name
            local.parent.mkdir(parents=True, exist_ok=True)
            with self._errors(RecordingError, "read"):
                system.get_file(f"{path}/{name}".rstrip("/"), str(local))
            size = local.stat().st_size
            if size != of.size:
                raise self._changed(f" ({name or self.name}: {size} bytes, not {of.size})")
        if self.files() != listed:
            raise self._changed()
        return Fetched(listed, copy)

    def put(self, files: Sequence[Path], below: str = "") -> None:
        """Copies local files to it, or to a folder below, in this order.

        Raises:
            OutputError: a file cannot be written.
        """
        with self._errors(OutputError, "written", ". Give another --out"):
            system, path = self._opened
            parent = f"{path}/{below}" if below else path
            system.makedirs(parent, exist_ok=True)
            for file in files:
                system.put_file(str(file), f"{parent}/{file.name}")

    def remove(self, names: Sequence[str]) -> None:
        """Removes those of these files that are there.

        Raises:
            OutputError: a file cannot be removed.
        """
        with self._errors(OutputError, "written", ". Give another --out"):
            system, path = self._opened
            for name in names:
                try:
                    system.rm_file(f"{path}/{name}")
                except FileNotFoundError:
                    continue

    def _changed(self, how: str = "") -> RecordingError:
        return RecordingError(
            f"{self.url}: changed while it was read{how}. Run the batch again when the recording "
            "is complete"
        )

    @contextmanager
    def _errors(self, kind: type[CalivError], done: str, remedy: str = "") -> Iterator[None]:
        # Each file system has exceptions of its own, of which few are an OSError.
        try:
            yield
        except CalivError:
            raise
        except Exception as e:
            said = " ".join(f"{type(e).__name__}: {e}".split())
            raise kind(f"{self.url}: cannot be {done}: {said}{remedy}") from None


def _listed(info: Mapping[str, Any]) -> ListedFile:
    said = [f"{key}={info[key]}" for key in MARKS if info.get(key) is not None]
    mark = hashlib.sha256("\n".join(said).encode()).hexdigest() if said else None
    return ListedFile(int(info.get("size") or 0), mark)
