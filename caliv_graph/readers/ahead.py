"""Decoding the next clouds on another core while the caller works on the last one."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from caliv_graph.common.cores import cores

Item = TypeVar("Item")
Result = TypeVar("Result")

AHEAD = 2
"""Results that wait or are being made, at most: memory stays bounded."""


def worked_ahead(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """`map(work, items)`, the next `AHEAD` items being worked on in a thread meanwhile.

    Results come in the order of the items, whatever the number of cores. Items are taken in the
    caller's thread, because readers of files may not leave the thread that opened them. `work`
    should release the interpreter's lock; what it raises comes when the turn of its item comes.
    """
    if cores() < 2:
        yield from map(work, items)
        return
    waiting: deque[Future[Result]] = deque()
    pool = ThreadPoolExecutor(1, "ahead")
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) > AHEAD:
                # No name for the result: a name would keep it in memory while the next one is made.
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        # After an early stop, wait for the running item and drop those that have not started.
        pool.shutdown(cancel_futures=True)
