"""The command line: commands, exit codes, interrupts.

Modules that need gtsam, open3d or pydantic are imported inside the commands, so that `--help`
answers at once.
"""

from __future__ import annotations

import os
import signal
import sys
import traceback
import warnings
from collections.abc import Sequence
from functools import cache
from types import FrameType
from typing import Annotated, Any, Self

import typer

from caliv_graph import __version__
from caliv_graph.cli import streams
from caliv_graph.cli.batch import batch
from caliv_graph.cli.calibrate import calibrate
from caliv_graph.cli.compare import compare
from caliv_graph.cli.evaluate import evaluate
from caliv_graph.cli.export import export
from caliv_graph.cli.init import init
from caliv_graph.cli.inspect import inspect
from caliv_graph.cli.merge import merge
from caliv_graph.cli.observability import observability
from caliv_graph.cli.plan import plan
from caliv_graph.cli.simulate import simulate
from caliv_graph.cli.validate import validate
from caliv_graph.common.exits import DEFECT, DONE, INTERRUPTED, USAGE
from caliv_graph.common.memory import keep_freed_memory
from caliv_graph.errors import CalivError

_PROGRAM = "caliv-graph"

_UsageError: Any = typer.BadParameter.__mro__[1]
"""Base class of typer's errors about the command line, which has no public name."""

app = typer.Typer(
    name=_PROGRAM,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help="Calibrates LiDARs to each other and to the vehicle from drives past a target or walls, "
    "with covariance, and names the directions that a drive does not determine.",
    epilog="Exit codes: 0 done; 2 bad usage or input; 3 finished, but something required was not "
    "reached, or a LiDAR saw nothing; 4 finished, but the data contradict each other, the initial "
    "guess or an earlier calibration; 130 interrupted; 1 a defect of the program.",
)


def _paragraphs(docstring: str) -> str:
    """A docstring without the line breaks inside its paragraphs, for typer to wrap."""
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in docstring.split("\n\n"))


for _command in (
    *(init, simulate, inspect, observability, plan),
    *(calibrate, evaluate, validate, compare, merge, export, batch),
):
    app.command(help=_paragraphs(_command.__doc__ or ""))(_command)


def _print_version(asked: bool) -> None:
    if asked:
        streams.say(f"{_PROGRAM} {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    pass


class _Interrupts:
    """Turns SIGINT and SIGTERM into KeyboardInterrupt, which native code may replace or swallow.

    Python swallows it where nothing can take it, in a destructor or a callback from C, and tells
    `sys.unraisablehook`. The signal is then sent once more, a moment later.
    """

    _ONCE_MORE_S = 0.02

    def __init__(self) -> None:
        self.came = 0
        """Number of the last signal; 0: none came."""

    def __enter__(self) -> Self:
        # SIGINT too: a shell without job control starts programs with '&' that ignore it.
        numbers = (signal.SIGINT, signal.SIGTERM)
        self._before = {number: signal.signal(number, self._on_signal) for number in numbers}
        self._before[signal.SIGALRM] = signal.signal(signal.SIGALRM, self._send_once_more)
        self._hook_before = sys.unraisablehook
        sys.unraisablehook = self._on_unraisable
        return self

    def __exit__(self, *_: object) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        sys.unraisablehook = self._hook_before
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.came = number
        raise KeyboardInterrupt

    def _on_unraisable(self, what: sys.UnraisableHookArgs) -> None:
        if self.came and issubclass(what.exc_type, KeyboardInterrupt):
            signal.setitimer(signal.ITIMER_REAL, self._ONCE_MORE_S)
        else:
            self._hook_before(what)

    def _send_once_more(self, number: int, frame: FrameType | None) -> None:
        # Not raised here: whoever ignores the signal at the moment has a reason.
        signal.raise_signal(self.came)


@cache
def built() -> Any:
    """All commands, as typer builds them from their signatures: that takes 15 ms."""
    return typer.main.get_command(app)


def run(arguments: Sequence[str]) -> int:
    """Runs a command line, turns all exceptions into messages, and returns the exit code."""
    with _Interrupts() as interrupts, warnings.catch_warnings():
        if not sys.warnoptions:
            # Python warnings are for developers; a user cannot act upon them.
            warnings.simplefilter("ignore")
        try:
            with streams.guarded_stdout():
                code = built().main(list(arguments), prog_name=_PROGRAM, standalone_mode=False)
        except BaseException as e:
            code = INTERRUPTED if interrupts.came else _explain(e)
        if code == INTERRUPTED:
            streams.error("interrupted")
        return code if isinstance(code, int) else DONE


def _explain(problem: BaseException) -> int:
    """Prints the error and returns the exit code."""
    if isinstance(problem, typer.Abort) and isinstance(problem.__context__, EOFError):
        # Typer raises Abort for an EOFError, as if the user had ended an interactive input.
        problem = problem.__context__
    if isinstance(problem, KeyboardInterrupt | typer.Abort):
        return INTERRUPTED
    if isinstance(problem, CalivError):
        streams.error(str(problem))
        return USAGE
    if isinstance(problem, _UsageError):
        command = problem.ctx.command_path if problem.ctx else _PROGRAM
        streams.error(f"{problem.format_message().rstrip('.')}. See '{command} --help'")
        return USAGE
    if not isinstance(problem, Exception):
        raise problem
    traceback.print_exception(problem)
    streams.error(
        f"this is a defect of {_PROGRAM} {__version__}: please report it with the lines above and "
        "the command"
    )
    return DEFECT


def main() -> None:
    """Entry point of `caliv-graph`."""
    keep_freed_memory()
    code = run(sys.argv[1:])
    # All output is written. Python removes its handlers before it ends, and a signal would then
    # turn a success into a death by signal.
    signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    if code == INTERRUPTED:
        # After an interrupt in native code, Python would end by the signal.
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:  # closed
                stream.flush()
        os._exit(code)
    sys.exit(code)
