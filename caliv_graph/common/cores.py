"""How many cores the program uses, and how it distributes work over them.

No result depends on the number: parallel work writes to separate places.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")

THREADS = 2
"""At most, for work on clouds and points: numpy holds the interpreter's lock between its
operations, so more threads mostly wait."""

_one_core = False


def cores() -> int:
    """The number of cores that this process may use."""
    if _one_core:
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def on_one_core() -> Iterator[None]:
    """Inside, the program uses one thread: other processes use the other cores."""
    global _one_core
    before = _one_core
    _one_core = True
    try:
        yield
    finally:
        _one_core = before


def parts(count: int, number: int) -> list[slice]:
    """Cuts a row of `count` items into `number` parts of about the same size."""
    ends = [count * i // number for i in range(number + 1)]
    return [slice(first, last) for first, last in itertools.pairwise(ends) if first < last]


def share_out(work: Callable[[Item], object], items: Iterable[Item]) -> None:
    """Does `work` on all items, several at a time, and raises whatever it raises.

    `work` should release the interpreter's lock for most of its time.
    """
    items = list(items)
    threads = min(THREADS, cores(), len(items))
    if threads < 2:
        for item in items:
            work(item)
        return
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(work, items):
            pass
