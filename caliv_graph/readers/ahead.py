"""Decoding the next clouds on another core while the last one is being looked at."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from caliv_graph.common.cores import cores

Item = TypeVar("Item")
Result = TypeVar("Result")

AHEAD = 2
"""Results that wait to be taken, at most, or are being made: memory stays bounded."""


def worked_ahead(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """`map(work, items)`, the next `AHEAD` items being worked on in a thread meanwhile.

    Results come in the order of the items and are the same whatever the number of cores, as long as
    `work` depends on nothing but its item. Items are taken in the caller's thread, for readers of
    files may not leave the thread that opened them. On a single core nothing is done ahead.

    Args:
        work: what to do with an item; spends its time where the interpreter's lock is released.
        items: any number of them.

    Raises:
        Whatever `work` raises, when the turn of its item comes.
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
                # No name for the result here: it would keep it alive while the next one is made.
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        # Who stops half-way does not wait for what nobody wants any more, but for what runs.
        pool.shutdown(cancel_futures=True)
