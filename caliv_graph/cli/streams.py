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

_STDOUT = "standard output"

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
    if sys.stdout is None:
        raise OutputError(f"{_STDOUT}: cannot be written: it is closed")
    out = sys.stdout if isinstance(sys.stdout, _Guarded) else _Guarded(sys.stdout)
    out.write(f"{text}\n")
    out.flush()


@contextmanager
def guarded_stdout() -> Iterator[None]:
    """Inside, what libraries write fails as `say` does: typer prints the help itself.

    Raises:
        OutputError: stdout could not be written, even if a library has caught that.
    """
    before = sys.stdout
    if before is None:
        yield
        return
    guarded = _Guarded(before)
    sys.stdout = cast(TextIO, guarded)
    try:
        yield
    finally:
        sys.stdout = before
    guarded.check()


class _Guarded:
    """A stream that raises an `OutputError` where it cannot be written, and then at every write.

    All else is the stream's.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._failed: OutputError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def check(self) -> None:
        """Raises the error of an earlier write."""
        if self._failed is not None:
            raise self._failed

    def write(self, text: str) -> int:
        with self._checked():
            return self._stream.write(text)

    def flush(self) -> None:
        with self._checked():
            self._stream.flush()

    @contextmanager
    def _checked(self) -> Iterator[None]:
        self.check()
        try:
            yield
        except OSError as e:
            # Otherwise Python would try to write the rest of the buffer at exit and fail again.
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self._stream.fileno())
            os.close(null)
            self._failed = OutputError(f"{_STDOUT}: cannot be written: {e.strerror}")
            raise self._failed from None


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
    elif _on_terminal() and not (console := _console()).is_dumb_terminal:
        with BarProgress(console) as progress:
            yield progress
    else:
        yield PlainProgress(say)


def _on_terminal() -> bool:
    """Whether stdout is a terminal; None stands for one that is closed (`>&-`)."""
    return sys.stdout is not None and sys.stdout.isatty()


def _console() -> Console:
    from rich.console import Console  # takes 0.1 s, which --help saves

    return Console(width=None if _on_terminal() else _PLAIN_WIDTH)
