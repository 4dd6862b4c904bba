"""Digests of the inputs of a job: the bytes of its drives and prior, its config, the version.

An existing result is reused for a job if its digest is the same.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from errno import ENOENT
from pathlib import Path
from typing import Any

import caliv_graph
from caliv_graph.batch.remote import Fetched, ListedFile, RemoteFolder
from caliv_graph.config.load import dump_config
from caliv_graph.config.model import Config

JOB_SCHEMA = "caliv-graph/batch-job/1"

_SETTLED_NS = 3_000_000_000
"""The digest of a file that was changed more recently than this is not kept: the file could change
again within one tick of the file system's clock (2 s on FAT, 1 s on some others) unnoticed."""


@dataclass(frozen=True)
class FileState:
    """Size, times (nanoseconds) and inode of a file, which change when the file is written.

    They include the time of the last change of the entry (ctime), which tools that restore the time
    of the content (cp -p, rsync -t, tar) cannot set.
    """

    size: int
    mtime_ns: int
    ctime_ns: int
    inode: int

    @classmethod
    def of(cls, path: Path) -> FileState:
        """The current state of a file.

        Raises:
            OSError: the file cannot be accessed.
        """
        stat = path.stat()
        return cls(stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino)

    @classmethod
    def listed(cls, file: ListedFile) -> FileState:
        """That of a file behind a URL: its mark stands for times and inode."""
        mark = -1 if file.mark is None else int(file.mark[:15], 16)
        return cls(file.size, 0, 0, mark)


@dataclass(frozen=True)
class RemoteFile:
    """An input file behind a URL.

    Attributes:
        url: of the file.
        listed: what its file system says of it.
        copy: its local copy; None: not fetched.
    """

    url: str
    listed: ListedFile
    copy: Path | None = None

    def __str__(self) -> str:
        return self.url


InputFile = Path | RemoteFile
"""A file that a result depends on."""


def state_of(file: InputFile) -> FileState:
    """The state of a file: of one on a disk now, of one behind a URL when it was listed.

    Raises:
        OSError: the file cannot be accessed.
    """
    return FileState.of(file) if isinstance(file, Path) else FileState.listed(file.listed)


@dataclass
class DigestCache:
    """Digests of files that were read, so that no file is read twice.

    Attributes:
        entries: per absolute path or URL the state of the file when it was read, and the SHA-256 of
            its content.
    """

    entries: dict[str, tuple[FileState, str]] = field(default_factory=dict)

    def known(self, file: InputFile) -> str | None:
        """The digest of a file, or None if it was not read or has changed.

        Raises:
            OSError: the file does not exist.
        """
        entry = self.entries.get(str(file))
        return entry[1] if entry is not None and entry[0] == state_of(file) else None

    def digest(self, file: InputFile) -> str:
        """The digest of a file; reads the file, or its local copy, if necessary.

        Raises:
            OSError: the file cannot be read.
        """
        known = self.known(file)
        if known is not None:
            return known
        if isinstance(file, RemoteFile):
            if file.copy is None:
                raise FileNotFoundError(ENOENT, "was not fetched", file.url)
            digest = _content(file.copy)
            if file.listed.mark is not None:
                self.entries[file.url] = (state_of(file), digest)
            return digest
        return self._read(file)

    def _read(self, path: Path) -> str:
        before = FileState.of(path)
        asked_ns = time.time_ns()
        digest = _content(path)
        settled = asked_ns - max(before.mtime_ns, before.ctime_ns) > _SETTLED_NS
        if settled and FileState.of(path) == before:
            self.entries[str(path)] = (before, digest)
        return digest

    def dump(self) -> str:
        """Text for `parse`."""
        files = {
            path: [state.size, state.mtime_ns, state.ctime_ns, state.inode, digest]
            for path, (state, digest) in self.entries.items()
        }
        # The checksum detects a file that was damaged on the disk.
        return json.dumps({"sha256": _sha256(files), "files": files})

    @classmethod
    def parse(cls, text: str) -> DigestCache:
        """The cache of a text of `dump`; empty if the text is damaged."""
        try:
            document = json.loads(text)
            files = document["files"]
            if document["sha256"] != _sha256(files):
                return cls()
            return cls({p: (FileState(*entry[:4]), entry[4]) for p, entry in files.items()})
        except (ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError):
            return cls()


@dataclass(frozen=True)
class Inputs:
    """The input files of a job, with names that do not depend on their folder.

    Attributes:
        drives: per drive, its files by name.
        prior: the earlier calibration.
    """

    drives: tuple[Mapping[str, InputFile], ...]
    prior: Path | None

    @property
    def files(self) -> tuple[InputFile, ...]:
        """All input files."""
        prior = () if self.prior is None else (self.prior,)
        return (*(path for drive in self.drives for path in drive.values()), *prior)

    def states(self) -> dict[InputFile, FileState]:
        """The current state of each file.

        Raises:
            OSError: a file does not exist.
        """
        return {file: state_of(file) for file in self.files}

    def known(self, cache: DigestCache) -> bool:
        """Whether the digests of all files are known.

        Raises:
            OSError: a file does not exist.
        """
        return all(cache.known(file) is not None for file in self.files)


def job_inputs(
    config: Config,
    data: Sequence[Path | str],
    prior: Path | None,
    out: Path | None = None,
    fetched: Mapping[str, Fetched] | None = None,
) -> Inputs | None:
    """The input files of a job; without `data`, its drive is `data.path` of the config.

    Of a URL, all files below, as they were when it was `fetched`, or else are now. Files in `out`,
    the folder of the results, are no inputs.

    Returns:
        None if a drive does not exist or has no files of its format.

    Raises:
        OSError: a folder cannot be listed.
        CalivError: a URL cannot be listed.
    """
    out = None if out is None else out.resolve()
    drives: list[dict[str, InputFile]] = []
    for drive in data or ([config.data.path] if config.data.path else []):
        if isinstance(drive, str):
            files = _remote_files(drive, (fetched or {}).get(drive))
        else:
            # Folders of clouds, too: of those, all files below.
            find = _caliv_files if config.data.format == "caliv" else _bag_files
            files = dict(find(drive, config, out))
        if not files:
            return None
        if config.data.poses is not None:
            files["data.poses"] = config.data.poses
        drives.append(files)
    return Inputs(tuple(drives), prior) if drives else None


def job_digest(config: Config, inputs: Inputs, cache: DigestCache) -> str:
    """Digest of the inputs of a job, 64 hexadecimal digits: equal digests mean equal results.

    Files without a known digest are read, and their digests are added to the cache.

    Raises:
        OSError: a file cannot be read.
    """
    # The path of the drive and of its poses does not change the result.
    nowhere = config.data.model_copy(update={"path": None, "poses": None})
    pathless = config.model_copy(update={"data": nowhere})
    return _sha256(
        {
            "schema": JOB_SCHEMA,
            "caliv_graph": caliv_graph.__version__,
            "config": dump_config(pathless),
            "drives": [
                {name: cache.digest(file) for name, file in drive.items()}
                for drive in inputs.drives
            ],
            "prior": None if inputs.prior is None else cache.digest(inputs.prior),
        }
    )


def _bag_files(path: Path, config: Config, out: Path | None) -> Iterator[tuple[str, Path]]:
    """All files of a bag; of a folder, all files that are not hidden."""
    if path.is_file():
        yield path.suffix, path
        return
    for folder, folders, files in os.walk(path):
        here = Path(folder)
        folders[:] = sorted(
            f for f in folders if f[0] != "." and (out is None or (here / f).resolve() != out)
        )
        for file in sorted(files):
            if file[0] != "." and (here / file).is_file():
                yield str((here / file).relative_to(path)), here / file


def _caliv_files(path: Path, config: Config, out: Path | None) -> Iterator[tuple[str, Path]]:
    """The poses of a CaLiV folder and the clouds of the config's LiDARs."""
    from caliv_graph.readers.caliv_folder import POSES_FILE

    root = next((f for f in (path / "input", path) if (f / POSES_FILE).is_file()), None)
    if root is None:
        return
    yield POSES_FILE, root / POSES_FILE
    for topic in sorted({lidar.topic for lidar in config.lidars.values()}):
        folder = root / topic
        if folder.parent == root and folder.is_dir():
            for cloud in sorted(folder.iterdir()):
                if cloud.suffix == ".pcd" and cloud.name[0] != "." and cloud.is_file():
                    yield f"{topic}/{cloud.name}", cloud


def _remote_files(url: str, fetched: Fetched | None) -> dict[str, InputFile]:
    """The files of a drive behind a URL, by the names of a local one."""
    remote = RemoteFolder(url)
    listed = remote.files() if fetched is None else fetched.listed
    # Of a single file only its kind is part of the name, as of a bag on a disk.
    return {
        name or Path(remote.name).suffix: RemoteFile(
            f"{remote.url}/{name}".rstrip("/"), of, None if fetched is None else fetched.copy / name
        )
        for name, of in listed.items()
    }


def _content(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sha256(document: Any) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()
