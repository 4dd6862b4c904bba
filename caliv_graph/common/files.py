"""Output files and folders: complete or absent, and never in the place of foreign files."""

from __future__ import annotations

import fnmatch
import os
import secrets
import shutil
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import Any

from caliv_graph.errors import ConfigError, OutputError

WRITTEN = (".yaml", ".yml", ".html", ".htm", ".json", ".urdf", ".xml", ".xacro", ".py", ".sh")
"""Files of commands, which people keep beside their recordings."""

OF_A_BAG = ("metadata.yaml", "ego_pose.json")
"""Those that recordings have themselves."""


def atomic_write(path: Path, content: str | bytes, force: bool = False) -> None:
    """Writes a file in one step: a reader sees the old file or the new one.

    Args:
        path: the file; folders that it needs are made.
        content: of the file; text is written as UTF-8.
        force: replace an older one.

    Raises:
        OutputError: it exists and `force` is not set, or it cannot be written.
    """
    check_output_file(path, force)
    target = _resolved(path)
    with _errors_named(path), _new_parents(target):
        scratch = _beside(target)
        try:
            with scratch.open("xb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
                _flush_to_disk(file)
            scratch.replace(target)
        finally:
            with _uninterrupted():
                scratch.unlink(missing_ok=True)


def check_output_file(path: Path, force: bool = False, inputs: Sequence[Path | None] = ()) -> None:
    """Checks before long work what `atomic_write` checks after it, and that no input is lost.

    `inputs` are files and folders that the command reads; None stands for one that is not given.

    Raises:
        OutputError: the file exists and `force` is not set, it is an input or a file in one, or it
            cannot be written.
    """
    with _errors_named(path):
        target = _resolved(path)
        if target.is_dir():
            raise OutputError(f"{path}: is a folder. Give the name of a file")
        if target.exists() and not force:
            raise OutputError(f"{path}: exists already. Give --force to replace it")
        for given, own in _all_resolved(inputs) if target.exists() else ():
            if target == own:
                read = "what this command reads"
            elif target.is_relative_to(own) and _may_be_recorded(target):
                read = f"part of {given}, which this command reads"
            else:
                continue
            raise OutputError(f"{path}: is not replaced, for it is {read}. Give another name")
        _check_parent_writable(path, target)


@contextmanager
def output_folder(path: Path, content: Sequence[str], force: bool = False) -> Iterator[Path]:
    """A folder that appears with all its content, or not at all.

    Args:
        path: the folder. An empty one that exists is filled.
        content: patterns (`fnmatch`, of each part of a path) of the files of a result of this kind,
            the main file first. With `force` only a result is replaced: a folder with the main file
            and without any other file, in a subfolder too.
        force: replace an older result.

    Yields:
        An empty folder beside `path` to write to. It takes the place of `path` at the end. After
        an error it is removed, and the older result stays.

    Raises:
        OutputError: `path` exists and is not to be replaced, or something cannot be written.
    """
    check_output_folder(path, content, force)
    target = _resolved(path)
    with _errors_named(path), _new_parents(target):
        scratch = _beside(target)
        fresh, old = scratch / "new", scratch / "old"
        try:
            fresh.mkdir(parents=True)
            yield fresh
            for entry in fresh.rglob("*"):
                if entry.is_file():
                    with entry.open("rb") as opened:
                        _flush_to_disk(opened)
            with _uninterrupted():
                _swap(fresh, target, old)
        except OutputError as e:
            # A file in it is named where it will be: nobody finds it in the scratch folder.
            raise OutputError(e.what.replace(str(fresh), str(path)), e.remedy) from None
        finally:
            with _uninterrupted():
                shutil.rmtree(scratch, ignore_errors=True)


def check_output_folder(
    path: Path, content: Sequence[str], force: bool = False, inputs: Sequence[Path | None] = ()
) -> None:
    """Checks before long work what `output_folder` checks after it, and that no input is lost.

    `inputs` are files that the command reads; None stands for one that is not given.

    Raises:
        OutputError: `path` exists and is not to be replaced, holds an input, or cannot be written.
    """
    with _errors_named(path):
        target = _resolved(path)
        _check_parent_writable(path, target)
        if not target.exists():
            return
        if not target.is_dir():
            raise OutputError(f"{path}: is a file. Give --out the name of a folder")
        if os.path.ismount(target) or Path.cwd().is_relative_to(target):
            kind = "a mount point" if os.path.ismount(target) else "the current folder"
            raise OutputError(
                f"{path}: is {kind}, which cannot be replaced in one step. Give --out a folder "
                f"in it, such as {path / 'result'}"
            )
        names = sorted(entry.name for entry in target.iterdir())
        if not names:
            return
        if not force:
            raise OutputError(
                f"{path}: exists already. Give --force to replace it, or another --out"
            )
        for given, own in _all_resolved(inputs):
            if own.is_relative_to(target):
                raise OutputError(
                    f"{path}: is not replaced, for it holds {given}, which this command reads. "
                    "Give another --out"
                )
        if not fnmatch.filter(names, content[0]):
            raise OutputError(
                f"{path}: is not replaced: it holds no {content[0]} and is not a result of this "
                "program. Give another --out"
            )
        foreign = sorted(
            str(entry.relative_to(target))
            for entry in target.rglob("*")
            if not _belongs(entry, target, content)
        )
        if foreign:
            raise OutputError(
                f"{path}: is not replaced, for it also holds '{foreign[0]}', which is not part of "
                "a result and would be lost. Move it elsewhere, or give another --out"
            )


def _all_resolved(inputs: Sequence[Path | None]) -> list[tuple[Path, Path]]:
    """Each input that is given, and where it is."""
    return [(given, _resolved(given)) for given in inputs if given is not None]


def _may_be_recorded(path: Path) -> bool:
    """Whether a file in the folder of a recording may be part of it: no older output beside it."""
    return path.suffix not in WRITTEN or path.name in OF_A_BAG


def _belongs(entry: Path, folder: Path, content: Sequence[str]) -> bool:
    """Whether `content` names a file of `folder`, or a folder on the way to one."""
    parts = entry.relative_to(folder).parts
    for pattern in content:
        wanted = PurePath(pattern).parts
        if entry.is_dir() and not entry.is_symlink():
            wanted = wanted[:-1][: len(parts)]
        if len(wanted) == len(parts) and all(map(fnmatch.fnmatch, parts, wanted)):
            return True
    return False


def _resolved(path: Path) -> Path:
    try:
        return path.resolve()
    except RuntimeError:  # of links that lead to each other
        raise OutputError(
            f"{path}: cannot be written: links in a circle. Give another --out"
        ) from None


def _swap(fresh: Path, target: Path, old: Path) -> None:
    """Moves `fresh` to `target`, and `target` to `old` unless it is empty."""
    # A folder can be renamed onto an empty one, but not onto one with content.
    occupied = target.is_dir() and any(target.iterdir())
    if occupied:
        target.rename(old)
    try:
        fresh.rename(target)
    except OSError:
        if occupied:
            old.rename(target)
        raise


def _beside(target: Path) -> Path:
    """A new name in the same folder, hence on the same disk: only there is a rename one step."""
    return target.with_name(f".{target.name[:200]}.{secrets.token_hex(6)}")


def _check_parent_writable(path: Path, target: Path) -> None:
    parent = next(folder for folder in target.parents if os.path.lexists(folder))
    if not parent.is_dir():
        raise OutputError(
            f"{path}: cannot be written: {parent} is not a folder. Give another --out"
        )
    if not os.access(parent, os.W_OK | os.X_OK):
        raise OutputError(
            f"{path}: cannot be written: no permission to write in {parent}. Give another --out"
        )
    # Some file systems are read-only although the permissions allow writing.
    probe = _beside(parent / target.name)
    probe.mkdir()
    with _uninterrupted():
        probe.rmdir()


@contextmanager
def _new_parents(target: Path) -> Iterator[None]:
    """Makes the folders that `target` needs, and removes them again after an error."""
    made = []
    for folder in reversed(target.parents):
        if not folder.exists():
            folder.mkdir()
            made.append(folder)
    try:
        yield
    except BaseException:
        with _uninterrupted():
            for folder in reversed(made):
                # Another program may have written there meanwhile.
                if not any(folder.iterdir()):
                    folder.rmdir()
        raise


@contextmanager
def _errors_named(path: Path) -> Iterator[None]:
    """Turns an error of the system (a full or read-only disk, no permission) into one line."""
    try:
        yield
    except OSError as e:
        where = f" ({e.filename})" if e.filename and str(e.filename) != str(path) else ""
        raise OutputError(
            f"{path}: cannot be written: {e.strerror or e}{where}. Nothing was changed; give "
            "another --out"
        ) from None


def _flush_to_disk(file: Any) -> None:
    """Some file systems notice only here that they are full."""
    file.flush()
    os.fsync(file.fileno())


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Ignores interrupts during a swap or a clean-up: the work is done, or already fails."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, signal.SIG_IGN) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            # None: the handler was not set from Python, and cannot be restored from Python.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def each_once(paths: Sequence[Path], where: str, what: str) -> None:
    """Checks that no path is given twice, under whatever names.

    `where`, an option and a space or nothing, begins the message; `what` is such as "a drive".

    Raises:
        ConfigError: one is.
    """
    seen: set[Path] = set()
    for path in paths:
        if path.resolve() in seen:
            raise ConfigError(f"{where}{path}: given twice, and {what} counts once. Give it once")
        seen.add(path.resolve())
