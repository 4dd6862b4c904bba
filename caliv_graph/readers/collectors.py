"""What collectors of motion data share: rows of numbers, kept small, and counts of losses.

A collector per topic takes messages in any order and makes the product at the end: sorted by stamp,
each stamp once, without invalid measurements, which it counts.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, ClassVar, Protocol

import numpy as np
import numpy.typing as npt

from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.readers.even_stamps import even_stamps, said_of

NORM_TOLERANCE = 1e-2
"""Of a quaternion: single precision is off by less."""

MOST_RAD_S = 200.0
MOST_ALTITUDE_M = 1e5
MOST_M = 1e8
"""Beyond the range of any sensor on a vehicle, and the width of any map: such values are invalid,
and their squares may overflow."""

Reason = tuple[str, Callable[[Array], Any]]
"""Why rows are left out, and a test (n, k) -> (n,) that is true for the rows that are kept."""


class Collector(Protocol):
    """Takes the messages of one topic."""

    def add(self, stamp_ns: int, message: Any) -> None:
        """Takes one message; `stamp_ns` is its header's stamp, or else the time of recording."""

    def notes(self) -> list[str]:
        """What was left out or looks wrong, after `finish`: sentences without a subject."""


class Rows:
    """Rows of numbers with stamps, a few bytes each however long the drive."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._stamps = array("q")
        self._values = array("d")

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp_ns: int, values: Iterable[float]) -> None:
        """Takes one row, of `width` numbers."""
        self._stamps.append(stamp_ns)
        self._values.extend(values)

    def ordered(self) -> tuple[IntArray, Array, IntArray]:
        """Stamps (n,) strictly increasing, of equal ones the first; their rows; their indices."""
        recorded, values = self._views()
        stamps, first = np.unique(recorded, return_index=True)
        return stamps, values[first], first

    def arrivals(self) -> tuple[IntArray, IntArray]:
        """Stamps (n,) in the order of arrival, and their indices.

        Of messages that were sent again with the same stamp and values, the first.
        """
        recorded, values = self._views()
        order = np.argsort(recorded, kind="stable")
        equal = np.flatnonzero(np.diff(recorded[order]) == 0)
        bits = values.view(np.int64)  # NaN equals itself
        again = (bits[order[equal]] == bits[order[equal + 1]]).all(axis=1)
        kept = np.ones(len(recorded), dtype=bool)
        kept[order[equal[again] + 1]] = False
        index = np.flatnonzero(kept)
        return recorded[index], index

    def at(self, index: IntArray) -> Array:
        """The rows (n, width) of these indices, a copy."""
        return self._views()[1][index]

    def _views(self) -> tuple[IntArray, Array]:
        """All stamps and rows as they were added; views, for a moment."""
        values = np.frombuffer(self._values, dtype=np.float64).reshape(-1, self._width)
        return np.frombuffer(self._stamps, dtype=np.int64), values


class Stated:
    """Rows of numbers that mostly repeat the row before, as covariances do: kept once."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._values = array("d")
        self._which = array("i")
        self._last = b""

    def add(self, *parts: npt.NDArray[np.float64]) -> None:
        """Takes one row, in parts of `width` numbers altogether."""
        row = b"".join(np.asarray(part, np.float64).tobytes() for part in parts)
        if row != self._last or not self._which:
            self._values.frombytes(row)
            self._last = row
        self._which.append(len(self._values) // self._width - 1)

    def distinct(self) -> tuple[Array, IntArray]:
        """The rows that were kept (d, width), and the index of the kept row of each added one."""
        values = np.array(self._values, dtype=np.float64).reshape(-1, self._width)
        return values, np.array(self._which, dtype=np.int64)


class Losses:
    """Counts the messages of a topic that are left out."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._others: list[str] = []

    def keep(self, kept: Any, why: str) -> BoolArray:
        """Counts the rows that are not kept; returns `kept`."""
        self._counts[why] += int(np.count_nonzero(~kept))
        return np.asarray(kept)

    def say(self, sentence: str) -> None:
        """Adds a sentence of its own."""
        self._others.append(sentence)

    def notes(self, total: int) -> list[str]:
        """What was left out of `total` messages, and the sentences."""
        lost = [f"{count} {why}" for why, count in self._counts.items() if count]
        return [f"of {total} messages not used: {', '.join(lost)}"] * bool(lost) + self._others


class RowCollector:
    """Keeps a row of numbers of each message."""

    _WIDTH: ClassVar[int]

    _EVEN: ClassVar[bool] = False
    """Whether the sensor samples evenly, so that stamps of the arrival can be mended."""

    def __init__(self) -> None:
        self._rows = Rows(self._WIDTH)
        self._losses = Losses()

    def _usable(self, *reasons: Reason) -> tuple[IntArray, Array, IntArray]:
        """Stamps and rows without those to leave out, and which of the added rows they are."""
        self._losses = Losses()
        stamps, rows, added = self._ordered()
        for why, test in reasons:
            kept = self._losses.keep(test(rows), why)
            stamps, rows, added = stamps[kept], rows[kept], added[kept]
        return stamps, rows, added

    def _ordered(self) -> tuple[IntArray, Array, IntArray]:
        """As `Rows.ordered`, with the stamps of an even clock where they are those of arrivals."""
        if self._EVEN:
            arrived_ns, added = self._rows.arrivals()
            even = even_stamps(arrived_ns)
            if even is not None:
                added = added[np.argsort(arrived_ns, kind="stable")]
                self._losses.say(said_of(even))
                return even.stamps_ns, self._rows.at(added), added
        return self._rows.ordered()

    def notes(self) -> list[str]:
        """What was left out, one line each."""
        return self._losses.notes(len(self._rows))


def covariances(flat: Array) -> Array:
    """(n, k, k) of (n, k * k), symmetric; NaN where a message states none.

    In ROS all zeros mean unknown; some drivers write a negative value or a single zero.
    """
    size = round(flat.shape[1] ** 0.5)
    cov = flat.reshape(-1, size, size)
    cov = (cov + cov.transpose(0, 2, 1)) / 2.0
    known = np.isfinite(cov).all(axis=(1, 2)) & (np.einsum("nii->ni", cov) > 0.0).all(axis=1)
    cov[~known] = np.nan
    return np.asarray(cov)


def or_none(cov: Array) -> Array | None:
    """Covariances; None if all are NaN."""
    return None if np.isnan(cov).all() else cov


def below(vectors: Array, most: float) -> BoolArray:
    """(n,) of (n, k): whether all values are within plus and minus a limit."""
    return np.asarray((np.abs(vectors) <= most).all(axis=1))
