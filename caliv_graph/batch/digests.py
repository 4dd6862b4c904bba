"""What a job is made from, as digests: the bytes of its drives and prior, its config, the version.

A result that is there already stands for a job if all of these are the same.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import caliv_graph
from caliv_graph.config.load import dump_config
from caliv_graph.config.model import Config

JOB_SCHEMA = "caliv-graph/batch-job/1"

_SETTLED_NS = 3_000_000_000
"""A file that was changed this short a time ago may change again within one tick of the file
system's clock (2 s on FAT, 1 s on some others) and look the same: its digest is not kept."""


@dataclass(frozen=True)
class FileState:
    """What a file system says of a file; the same as long as nobody writes to it.

    The time of the last change of the file's own entry is part of it: tools that set the time of
    the content back (cp -p, rsync -t, tar) cannot set that one.

    Attributes:
        size: bytes.
        mtime_ns: last change of the content, nanoseconds.
        ctime_ns: last change of content or entry, nanoseconds.
        inode: number of the file in its file system.
    """

    size: int
    mtime_ns: int
    ctime_ns: int
    inode: int

    @classmethod
    def of(cls, path: Path) -> FileState:
        """The state of a file now.

        Raises:
            OSError: it cannot be asked for.
        """
        stat = path.stat()
        return cls(stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino)


@dataclass
class DigestCache:
    """Digests of files that were read, so that nobody reads gigabytes twice.

    Attributes:
        entries: per absolute path the file's state when it was read, and SHA-256 of its content.
    """

    entries: dict[str, tuple[FileState, str]] = field(default_factory=dict)

    def known(self, path: Path) -> str | None:
        """The digest of a file, if it is the one that was read.

        Raises:
            OSError: the file is not there.
        """
        entry = self.entries.get(str(path))
        return entry[1] if entry is not None and entry[0] == FileState.of(path) else None

    def digest(self, path: Path) -> str:
        """The digest of a file, read if need be.

        Raises:
            OSError: it cannot be read.
        """
        known = self.known(path)
        if known is not None:
            return known
        before = FileState.of(path)
        asked_ns = time.time_ns()
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        settled = asked_ns - max(before.mtime_ns, before.ctime_ns) > _SETTLED_NS
        if settled and FileState.of(path) == before:
            self.entries[str(path)] = (before, digest)
        return digest

    def dump(self) -> str:
        """As text that `parse` reads."""
        files = {
            path: [state.size, state.mtime_ns, state.ctime_ns, state.inode, digest]
            for path, (state, digest) in self.entries.items()
        }
        # A disk that lost a part of it must not make an old digest stand for new content.
        return json.dumps({"sha256": _sha256(files), "files": files})

    @classmethod
    def parse(cls, text: str) -> DigestCache:
        """What `dump` wrote; empty if it is anything else."""
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
    """The files that a job is made from, with a name for each that does not depend on where.

    Attributes:
        drives: per drive, its files.
        prior: the earlier calibration.
    """

    drives: tuple[Mapping[str, Path], ...]
    prior: Path | None

    @property
    def files(self) -> tuple[Path, ...]:
        """All of them."""
        prior = () if self.prior is None else (self.prior,)
        return (*(path for drive in self.drives for path in drive.values()), *prior)

    def states(self) -> dict[Path, FileState]:
        """The state of each now.

        Raises:
            OSError: one is not there.
        """
        return {path: FileState.of(path) for path in self.files}

    def known(self, cache: DigestCache) -> bool:
        """Whether all of them were read already.

        Raises:
            OSError: one is not there.
        """
        return all(cache.known(path) is not None for path in self.files)


def job_inputs(
    config: Config, data: Sequence[Path], prior: Path | None, out: Path | None = None
) -> Inputs | None:
    """The files that a job reads.

    Args:
        config: the effective config.
        data: drives instead of the config's; empty: the config's.
        prior: the earlier calibration.
        out: where results go; nothing below it is input.

    Returns:
        None if a drive is not there, or not what its reader could read.

    Raises:
        OSError: a folder cannot be looked at.
    """
    out = None if out is None else out.resolve()
    drives = []
    for path in data or ([config.data.path] if config.data.path else []):
        find = _bag_files if config.data.format == "rosbag" else _caliv_files
        files = dict(find(path, config, out))
        if not files:
            return None
        drives.append(files)
    return Inputs(tuple(drives), prior) if drives else None


def job_digest(config: Config, inputs: Inputs, cache: DigestCache) -> str:
    """Digest of a job; the same exactly if its result is to be the same.

    Args:
        config: the effective config.
        inputs: the files; what was not read yet is read.
        cache: what was; gets what was not.

    Returns:
        64 hexadecimal digits.

    Raises:
        OSError: a file cannot be read.
    """
    # Where the drive lies is no part of what was asked.
    asked = config.model_copy(update={"data": config.data.model_copy(update={"path": None})})
    return _sha256(
        {
            "schema": JOB_SCHEMA,
            "caliv_graph": caliv_graph.__version__,
            "config": dump_config(asked),
            "drives": [
                {name: cache.digest(path) for name, path in drive.items()}
                for drive in inputs.drives
            ],
            "prior": None if inputs.prior is None else cache.digest(inputs.prior),
        }
    )


def _bag_files(path: Path, config: Config, out: Path | None) -> Iterator[tuple[str, Path]]:
    """All files of a bag: of a folder all that are not hidden."""
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


def _sha256(document: Any) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()
