"""How many cores the program uses, and how it distributes work over them.

No result depends on the number: parallel work writes to separate places.
"""

from __future__ import annotations

import functools
import itertools
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import TypeVar, cast

Item = TypeVar("Item")
Result = TypeVar("Result")

THREADS = 2
"""At most, for work on clouds and points: numpy holds the interpreter's lock between its
operations, so more threads mostly wait."""

TOGETHER = 6
"""Items that are held while they are worked on together: memory stays bounded."""

_one_core = False

_sharing = threading.local()
"""`on` in a thread that does a part of what is shared out."""

_NONE = object()


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

    This thread takes part. `work` should release the interpreter's lock for most of its time; what
    it shares out itself, it does alone: the cores are given out already.
    """
    items = list(items)
    if min(THREADS, cores(), len(items)) < 2 or getattr(_sharing, "on", False):
        for item in items:
            work(item)
        return
    left, lock = iter(items), threading.Lock()

    def take() -> None:
        nonlocal left
        _sharing.on = True
        try:
            while True:
                with lock:
                    item = next(left, _NONE)
                if item is _NONE:
                    return
                work(cast("Item", item))
        except BaseException:
            with lock:
                left = iter(())  # nobody goes on
            raise
        finally:
            _sharing.on = False

    others = [_helpers().submit(take) for _ in range(THREADS - 1)]
    try:
        take()
    finally:
        wait(others)
    for other in others:
        other.result()


def shared_map(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """`list(map(work, items))`, shared out as `share_out` does; the first items begin first."""
    found: dict[int, Result] = {}

    def one(i: int) -> None:
        found[i] = work(items[i])

    share_out(one, range(len(items)))
    return [found[i] for i in range(len(items))]


def worked_together(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """`map(work, items)`, `TOGETHER` items being shared out at a time.

    Results come in the order of the items. These are taken in the caller's thread, because readers
    of files may not leave the thread that opened them.
    """
    if cores() < 2:
        yield from map(work, items)
        return
    left = iter(items)
    while some := list(itertools.islice(left, TOGETHER)):
        yield from shared_map(work, some)


@functools.cache
def _helpers() -> ThreadPoolExecutor:
    """The other threads, kept: to start one costs as much as a small piece of work."""
    return ThreadPoolExecutor(THREADS - 1, "share_out")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_helpers.cache_clear)  # a fork has none of the threads
