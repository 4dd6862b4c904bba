"""Many runs in one or several processes, and files that hold a line for each."""

from __future__ import annotations

import functools
import hashlib
import json
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context, parent_process
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, TypeVar

from caliv_graph.common.memory import keep_freed_memory

Task = TypeVar("Task")
Result = TypeVar("Result")

REPOSITORY = Path(__file__).resolve().parents[1]


def performed(
    work: Callable[[Task], Result], tasks: Sequence[Task], jobs: int
) -> Iterator[tuple[Task, Result | Exception]]:
    """Tasks and their results, in the order in which they end.

    Args:
        work: function of a task; with several processes it must be a module's.
        tasks: what is to be done.
        jobs: number of processes; 1: this one.
    """
    if jobs == 1:
        keep_freed_memory()
        for task in tasks:
            try:
                yield task, work(task)
            except Exception as e:
                yield task, e
        return
    # Spawned, because threads of open3d do not survive a fork.
    with ProcessPoolExecutor(jobs, get_context("spawn"), _prepare_worker) as pool:
        futures = {pool.submit(work, task): task for task in tasks}
        try:
            for future in as_completed(futures):
                error = future.exception()
                if isinstance(error, Exception):
                    yield futures[future], error
                else:
                    yield futures[future], future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _prepare_worker() -> None:
    """Settings of a process of the pool, which ends with the one that began it.

    A pool's processes wait for work for ever where their parent was killed.
    """
    keep_freed_memory()
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(process: BaseProcess) -> None:
    process.join()
    os._exit(1)  # work in other threads goes on otherwise


@functools.cache
def code_digest() -> str:
    """Digest of the program's text, to distinguish runs before and after a change."""
    files = [*(REPOSITORY / "caliv_graph").rglob("*.py"), *(REPOSITORY / "scripts").glob("_*.py")]
    out = hashlib.sha256()
    for path in sorted(files):
        out.update(path.read_bytes())
    return out.hexdigest()[:8]


def json_lines(path: Path) -> list[dict[str, Any]]:
    """The lines of a file, without incomplete ones; none if there is no file."""
    lines = []
    for text in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            lines.append(json.loads(text))
        except json.JSONDecodeError:
            continue
    return lines


def add_line(path: Path, line: Mapping[str, Any]) -> None:
    """Adds a line to a file. It begins below half a line that an interrupted run may have left."""
    with path.open("a+b") as file:
        if file.seek(0, os.SEEK_END):
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":
                file.write(b"\n")
        file.write(f"{json.dumps(line)}\n".encode())
