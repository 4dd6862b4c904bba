"""Output on stdout and stderr: results, progress, warnings, errors."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TextIO, cast

from caliv_graph.common.progress import BarProgress, PlainProgress, SilentProgress
from caliv_graph.errors import OutputError

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

_PLAIN_WIDTH = 120
"""Columns of a table in a file or a pipe, which have no width of their own."""

_MOST_CHARACTERS = 1500
"""Characters of a message. A damaged file may contain names of megabytes."""


def one_line(text: str) -> str:
    """A message as one printable line, whatever names it quotes.

    Control characters, such as colour escapes, are shown as escape sequences.
    """
    line = " ".join(text.split())
    if len(line) > _MOST_CHARACTERS:
        # The problem is at the start and the remedy at the end; the middle is quoted input.
        line = f"{line[: _MOST_CHARACTERS // 2]} ... {line[-_MOST_CHARACTERS // 4 :]}"
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


def error(message: str) -> None:
    """Prints an error to stderr."""
    sys.stderr.write(f"error: {one_line(message)}\n")


def warn(messages: Iterable[str]) -> None:
    """Prints warnings to stderr, each once. Only after success: a failure prints one line."""
    for message in dict.fromkeys(messages):
        sys.stderr.write(f"warning: {one_line(message)}\n")


def say(text: str) -> None:
    """Prints a line to stdout and flushes, so that a pipe shows the progress.

    Raises:
        OutputError: stdout cannot be written: a closed pipe, a full disk.
    """
    with _told(sys.stdout):
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()


@contextmanager
def guarded_stdout() -> Iterator[None]:
    """Inside, what libraries print fails as `say` does: typer's help and rich's bars."""
    before = sys.stdout
    sys.stdout = cast(TextIO, _Guarded(before))
    try:
        yield
    finally:
        sys.stdout = before


class _Guarded:
    """A stream whose errors are told; all else is the stream's."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with _told(self._stream):
            return self._stream.write(text)

    def flush(self) -> None:
        with _told(self._stream):
            self._stream.flush()


@contextmanager
def _told(stream: TextIO) -> Iterator[None]:
    """An error of the stream's inside is an `OutputError`."""
    try:
        yield
    except OSError as e:
        # Otherwise Python would try to write the rest of the buffer at exit and fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        raise OutputError(f"standard output: cannot be written: {e.strerror}") from None


def show(table: RenderableType) -> None:
    """Prints a table to stdout.

    Raises:
        OutputError: stdout cannot be written.
    """
    console = _console()
    # Rich itself would end the program on a closed pipe.
    with console.capture() as captured:
        console.print(table, highlight=False)
    say(captured.get().rstrip("\n"))


def show_json(document: Any) -> None:
    """Prints a JSON document to stdout.

    Raises:
        OutputError: stdout cannot be written.
    """
    say(json.dumps(document, indent=2, allow_nan=False))


@contextmanager
def progress_on_stdout(as_json: bool) -> Iterator[SilentProgress]:
    """Shows progress: bars on a terminal, lines elsewhere, nothing with `--json`."""
    if as_json:
        yield SilentProgress()
    elif sys.stdout.isatty() and not (console := _console()).is_dumb_terminal:
        with BarProgress(console) as progress:
            yield progress
    else:
        yield PlainProgress(say)


def _console() -> Console:
    from rich.console import Console  # takes 0.1 s, which --help saves

    return Console(width=None if sys.stdout.isatty() else _PLAIN_WIDTH)
