"""Wanted clouds of a bag, still serialised, in the order of their stamps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.readers.bag import Bag, DamagedMessageError

_JOIN_NS = NANOSECONDS_PER_SECOND // 2
"""Wanted clouds recorded within this time of each other are read in one go: reading on costs less
than starting again."""


def wanted_clouds(
    bag: Bag, topic: str, records_ns: Mapping[int, int]
) -> Iterator[tuple[int, bytes]]:
    """Stamps and clouds of a topic; `records_ns` is the record time by stamp, in their order.

    Clouds recorded out of order are kept until their turn. Parts of the bag without a wanted cloud
    are not read. A cloud whose header does not decode is left out.

    Raises:
        RecordingError: the bag is damaged.
    """
    queue = _Queue(records_ns)
    for start_ns, stop_ns in _windows(records_ns.values()):
        for _, record_ns, raw in bag.messages([topic], start_ns, stop_ns):
            try:
                stamp_ns = bag.header(raw).stamp_ns or record_ns
            except DamagedMessageError:
                continue  # counted by the first pass
            yield from queue.take(stamp_ns, record_ns, raw)


class _Queue:
    """The wanted clouds, and those of them that were read before their turn."""

    def __init__(self, records_ns: Mapping[int, int]) -> None:
        """Takes the record time by stamp, in the order of the stamps."""
        self._records_ns = records_ns
        self._order = iter(records_ns)
        self._next = next(self._order, None)
        self._early: dict[int, bytes] = {}

    def take(self, stamp_ns: int, record_ns: int, raw: bytes) -> Iterator[tuple[int, bytes]]:
        """Takes a message; yields the stamps and clouds whose turn has come."""
        # Of two messages with one stamp, only one is in the index.
        if self._records_ns.get(stamp_ns) != record_ns:
            return
        self._early[stamp_ns] = raw
        while self._next is not None and self._next in self._early:
            turn, self._next = self._next, next(self._order, None)
            yield turn, self._early.pop(turn)


def _windows(records_ns: Iterable[int]) -> list[tuple[int, int]]:
    """Spans of record time, start and stop, around all of these times and little else."""
    times = np.unique(np.fromiter(records_ns, np.int64))
    if not len(times):
        return []
    breaks = np.flatnonzero(np.diff(times) > _JOIN_NS)
    starts, stops = times[np.r_[0, breaks + 1]], times[np.r_[breaks, len(times) - 1]]
    return [(int(a), int(b) + 1) for a, b in zip(starts, stops, strict=True)]
