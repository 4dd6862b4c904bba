"""What goes to stdout and stderr, and in which form."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from caliv_graph.common.progress import BarProgress, PlainProgress, SilentProgress
from caliv_graph.errors import OutputError

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

_PLAIN_WIDTH = 120
"""Columns of a table that goes to a file or a pipe, where nobody says how many there are."""

_MOST_CHARACTERS = 1500
"""Of a message. A damaged file may have names of megabytes."""


def one_line(text: str) -> str:
    """A message as the one line that it has to be, whatever names are quoted in it.

    What a terminal would obey, such as the escapes of colours, is shown instead.
    """
    line = " ".join(text.split())
    if len(line) > _MOST_CHARACTERS:
        # What is wrong stands in front, what to do at the end; between them is what was quoted.
        line = f"{line[: _MOST_CHARACTERS // 2]} ... {line[-_MOST_CHARACTERS // 4 :]}"
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


def error(message: str) -> None:
    """Prints an error to stderr."""
    sys.stderr.write(f"error: {one_line(message)}\n")


def warn(messages: Iterable[str]) -> None:
    """Prints warnings to stderr, each once. Only for what has succeeded: a failure is one line."""
    for message in dict.fromkeys(messages):
        sys.stderr.write(f"warning: {one_line(message)}\n")


def say(text: str) -> None:
    """Prints to stdout at once, so that a pipe shows where long work stands.

    Raises:
        OutputError: stdout takes no more: a closed pipe, a full disk.
    """
    try:
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()
    except OSError as e:
        # What is still in the buffer would fail again, unasked, while Python shuts down.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise OutputError(f"standard output: cannot be written: {e.strerror}") from None


def show(table: RenderableType) -> None:
    """Prints a table to stdout.

    Raises:
        OutputError: stdout takes no more.
    """
    console = _console()
    # Rich would answer a closed pipe by ending the program.
    with console.capture() as captured:
        console.print(table, highlight=False)
    say(captured.get().rstrip("\n"))


def show_json(document: Any) -> None:
    """Prints a JSON document to stdout.

    Raises:
        OutputError: stdout takes no more.
    """
    say(json.dumps(document, indent=2, allow_nan=False))


@contextmanager
def progress_on_stdout(as_json: bool) -> Iterator[SilentProgress]:
    """Shows progress: bars on a terminal, lines elsewhere, nothing if stdout is for JSON."""
    if as_json:
        yield SilentProgress()
    elif sys.stdout.isatty() and not (console := _console()).is_dumb_terminal:
        with BarProgress(console) as progress:
            yield progress
    else:
        yield PlainProgress(say)


def _console() -> Console:
    from rich.console import Console  # a tenth of a second that --help does without

    return Console(width=None if sys.stdout.isatty() else _PLAIN_WIDTH)
