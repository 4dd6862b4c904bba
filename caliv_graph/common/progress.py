"""Progress of long work, and the duration of each stage.

A stage is a context manager that yields `advance(n, note)`:

    with progress.stage("registration", total=len(clouds)) as advance:
        for cloud in clouds:
            ...
            advance()
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self

if TYPE_CHECKING:
    from rich.console import Console

SIGN_OF_LIFE_S = 10.0
"""Seconds between two lines of a running stage, where there is no bar."""


class Advance(Protocol):
    """Reports steps that are done."""

    def __call__(self, n: int = 1, note: str = "") -> None:
        """Adds `n` steps; the note is shown beside the count until the next note."""


class Progress(Protocol):
    """Takes the reports of long work."""

    def stage(self, name: str, total: int | None = None) -> AbstractContextManager[Advance]:
        """A stage of the work, named in a word or two; `total` steps, None if unknown."""


@dataclass
class StageRecord:
    """One stage.

    Attributes:
        name: of the stage.
        total: steps expected; None if unknown.
        depth: 0, or one more than the depth of the enclosing stage.
        done: steps done.
        note: the last note.
        seconds: of wall time; None while it runs, or after an exception.
        cpu_seconds: of processor time, all threads of the process together; None likewise.
    """

    name: str
    total: int | None
    depth: int
    done: int = 0
    note: str = ""
    seconds: float | None = None
    cpu_seconds: float | None = None


class SilentProgress:
    """Keeps the records and shows nothing.

    Attributes:
        stages: in the order in which they started.
    """

    def __init__(self) -> None:
        self.stages: list[StageRecord] = []
        self._depth = 0

    @contextmanager
    def stage(self, name: str, total: int | None = None) -> Iterator[Advance]:
        """A stage of the work (see `Progress`)."""
        record = StageRecord(name, total, self._depth)
        self.stages.append(record)

        def advance(n: int = 1, note: str = "") -> None:
            record.done += n
            record.note = note or record.note
            self._show(record)

        start, cpu = time.monotonic(), time.process_time()
        self._depth += 1
        self._show_start(record)
        try:
            yield advance
        finally:
            self._depth -= 1
        record.seconds = time.monotonic() - start
        record.cpu_seconds = time.process_time() - cpu
        self._show_end(record)

    def _show_start(self, record: StageRecord) -> None:
        """A stage has started."""

    def _show(self, record: StageRecord) -> None:
        """A stage goes on."""

    def _show_end(self, record: StageRecord) -> None:
        """A stage has ended well."""


class PlainProgress(SilentProgress):
    """Writes a line at the start and the end of a stage, and every `SIGN_OF_LIFE_S` between."""

    def __init__(self, write: Callable[[str], object]) -> None:
        """Takes what writes a line, without its end."""
        super().__init__()
        self._write = write
        self._last_line = 0.0

    def _line(self, record: StageRecord, text: str) -> None:
        self._last_line = time.monotonic()
        note = f" ({record.note})" if record.note else ""
        self._write(f"{'  ' * record.depth}{record.name}: {text}{note}")

    def _show_start(self, record: StageRecord) -> None:
        self._line(record, "started")

    def _show(self, record: StageRecord) -> None:
        if time.monotonic() - self._last_line >= SIGN_OF_LIFE_S:
            self._line(record, count_text(record) or "still running")

    def _show_end(self, record: StageRecord) -> None:
        count = count_text(record)
        self._line(record, f"{f'{count} ' if count else ''}in {record.seconds:.1f} s")


class BarProgress(SilentProgress):
    """Shows a bar per stage on a terminal. A context manager: inside, no one else writes there."""

    def __init__(self, console: Console) -> None:
        """Shows the bars on this terminal."""
        # Here, because importing rich takes a tenth of a second.
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            SpinnerColumn,
            TextColumn,
            TimeElapsedColumn,
        )
        from rich.progress import Progress as RichProgress

        super().__init__()
        self._bars = RichProgress(
            SpinnerColumn(finished_text=" "),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[note]}", markup=False),
            console=console,
        )
        self._tasks: dict[int, Any] = {}

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bars.stop()

    def _show_start(self, record: StageRecord) -> None:
        description = f"{'  ' * record.depth}{record.name}"
        self._tasks[id(record)] = self._bars.add_task(description, total=record.total, note="")

    def _show(self, record: StageRecord) -> None:
        self._bars.update(self._tasks[id(record)], completed=record.done, note=record.note)

    def _show_end(self, record: StageRecord) -> None:
        # A bar that ends short of its total would go on spinning.
        total = max(record.done, 1)
        self._bars.update(self._tasks[id(record)], total=total, completed=total, note=record.note)


def count_text(record: StageRecord) -> str:
    """Steps done, and the total if known: '12/136', '12', or '' if no step was counted."""
    if record.total is not None:
        return f"{record.done}/{record.total}"
    return str(record.done) if record.done else ""
