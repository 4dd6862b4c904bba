"""Exit codes and streams, as a shell sees them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import types
from pathlib import Path

import pytest

from caliv_graph import __version__
from caliv_graph.__main__ import main
from caliv_graph.cli import main as command_line
from caliv_graph.cli import streams
from tests.cli.commands import ROOT, called, run, start, write_config, write_drive

HEAVY = {
    *("gtsam", "open3d", "numpy", "scipy", "yaml", "rosbags", "plotly", "jinja2"),
    *("pandas", "matplotlib", "dask", "caliv_graph.config.model"),
}
"""What no help needs: each takes a twentieth of a second and more. (So does pydantic, but typer has
a use for it.)"""

LATE = {
    *("open3d", "plotly", "jinja2", "rosbags", "pandas", "matplotlib"),
    *("scipy.stats", "scipy.ndimage", "scipy.interpolate"),
}
"""What a calibration from a folder needs late, for its report, or not at all."""

SUCCEEDS = """
def calibrate(recordings, config, progress, prior):
    with progress.stage("solving", 2) as advance:
        advance(2)
    return run_of(make_calibration())
"""

FAILS = """
def calibrate(recordings, config, progress, prior):
    import warnings
    from caliv_graph.errors import TargetError
    warnings.warn("of a library")
    with progress.stage("solving", 2) as advance:
        raise TargetError("target: no cloud enters the region;\\n  it came as near as 3.2 m")
"""

BREAKS = """
def calibrate(recordings, config, progress, prior):
    raise ZeroDivisionError("nobody thought of this")
"""

WAITS = """
def calibrate(recordings, config, progress, prior):
    import time
    with progress.stage("solving", 2) as advance:
        time.sleep(60)
"""

LOSES_THE_INTERRUPT = """
def calibrate(recordings, config, progress, prior):
    import time
    with progress.stage("solving", 2) as advance:
        try:
            time.sleep(60)
        except KeyboardInterrupt:
            raise RuntimeError("what native code makes of it")
"""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    write_drive(tmp_path / "drive")
    return write_config(tmp_path / "config.yaml")


def test_help_names_only_what_there_is() -> None:
    result = run("--help")

    assert result.returncode == 0
    assert result.stderr == ""
    for command in (
        "init",
        "inspect",
        "simulate",
        "observability",
        "plan",
        "calibrate",
        "evaluate",
    ):
        assert f"│ {command} " in result.stdout
    assert "│ teleport" not in result.stdout


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import contextlib, io, sys\n"
        "from caliv_graph.cli.main import app, run\n"
        "commands = [c.name or c.callback.__name__ for c in app.registered_commands]\n"
        "for arguments in ([], *([command] for command in commands)):\n"
        "    with contextlib.redirect_stdout(io.StringIO()):\n"
        "        code = run([*arguments, '--help'])\n"
        f"    heavy = {HEAVY!r} & sys.modules.keys()\n"
        "    if code or heavy:\n"
        "        sys.exit(f'{arguments}: exit code {code}, imported {heavy}')\n"
        "sys.exit(0 if len(commands) > 10 else f'only {commands}')\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )

    assert (result.returncode, result.stderr) == (0, "")


def test_calibrating_a_folder_imports_only_what_it_uses() -> None:
    code = (
        "import sys\n"
        "import caliv_graph.pipeline, caliv_graph.readers, caliv_graph.results.calibration_file\n"
        "import caliv_graph.report.log, caliv_graph.report.tables\n"
        f"heavy = {LATE!r} & sys.modules.keys()\n"
        "sys.exit(f'imported: {heavy}' if heavy else 0)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )

    assert (result.returncode, result.stderr) == (0, "")


@pytest.mark.parametrize("command", ["init", "inspect", "simulate", "calibrate", "evaluate"])
def test_every_command_explains_itself_with_an_example(command: str) -> None:
    result = called(command, "--help")

    assert result.returncode == 0
    assert f"Example: caliv-graph {command} " in result.stdout
    if command != "init":
        assert "--json" in result.stdout
    if command in ("init", "calibrate"):
        assert "--out" in result.stdout
        assert "--force" in result.stdout


def test_version() -> None:
    result = run("--version")

    assert (result.returncode, result.stdout, result.stderr) == (
        0,
        f"caliv-graph {__version__}\n",
        "",
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "error: Missing command. See 'caliv-graph --help'\n"),
        (["calibrat"], "error: No such command 'calibrat'"),
        (["--verbose"], "error: No such option: --verbose"),
        (["calibrate"], "error: Missing argument 'CONFIG.yaml'"),
        (["calibrate", "a.yaml"], "error: Missing option '--out'"),
        (["calibrate", "a.yaml", "--out"], "error: Option '--out' requires an argument"),
        (["evaluate", "a", "b", "c"], "error: Got unexpected extra argument"),
        (["evaluate", "nowhere.yaml", "b"], "error: nowhere.yaml: no such file. Check the path\n"),
        (["inspect", "nowhere"], "error: nowhere: no such file or folder. Give a bag (.bag, "),
        (["inspect", "drive.mcap"], "error: drive.mcap: no such file or folder"),
        (["init", "nowhere", "--out", "c.yaml"], "error: nowhere: no such file or folder. Give a "),
        (
            ["calibrate", "nowhere.yaml", "--out", "o"],
            "error: nowhere.yaml: no such file. Write it for a drive by 'caliv-graph init",
        ),
    ],
)
def test_bad_usage_is_one_line(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    result = called(*arguments)

    assert result.returncode == 2
    assert result.stdout == ""
    assert result.stderr.startswith(message)
    assert result.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_bad_input_is_one_line_and_no_output(config: Path, form: list[str]) -> None:
    out = config.parent / "a/out"
    # The warning about 'ground' must not join the error.
    write_config(config, ground={"use": True})

    result = called("calibrate", config, "--out", out, *form, pipeline=FAILS)

    assert result.returncode == 2
    assert result.stderr == (
        "error: target: no cloud enters the region; it came as near as 3.2 m\n"
    )
    assert result.stdout == ("" if form else "solving: started\n")
    assert not out.parent.exists()


def test_a_defect_of_the_program(config: Path) -> None:
    result = called("calibrate", config, "--out", config.parent / "out", pipeline=BREAKS)

    assert result.returncode == 1
    lines = result.stderr.splitlines()
    assert lines[0] == "Traceback (most recent call last):"
    assert "ZeroDivisionError: nobody thought of this" in lines
    assert lines[-1].startswith(f"error: this is a defect of caliv-graph {__version__}: please")
    assert not (config.parent / "out").exists()


@pytest.mark.parametrize(
    ("pipeline", "number"), [(WAITS, signal.SIGTERM), (LOSES_THE_INTERRUPT, signal.SIGINT)]
)
def test_an_interrupt_leaves_nothing(config: Path, number: int, pipeline: str) -> None:
    before = sorted(config.parent.iterdir())
    process = start("calibrate", config, "--out", config.parent / "out", pipeline=pipeline)
    assert process.stdout is not None
    assert process.stdout.readline() == "solving: started\n"

    process.send_signal(number)
    _, err = process.communicate(timeout=30)

    assert process.returncode == 130
    assert err == "error: interrupted\n"
    assert sorted(config.parent.iterdir()) == before


def test_an_interrupt_counts_where_the_shell_had_it_ignored(config: Path) -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        process = start("calibrate", config, "--out", config.parent / "out", pipeline=WAITS)
    finally:
        signal.signal(signal.SIGINT, before)
    assert process.stdout is not None
    process.stdout.readline()

    process.send_signal(signal.SIGINT)
    process.communicate(timeout=30)

    assert process.returncode == 130


def test_json_is_one_document_and_nothing_else(config: Path) -> None:
    result = run("calibrate", config, "--out", config.parent / "out", "--json", pipeline=SUCCEEDS)

    assert result.returncode == 0
    assert result.stderr == ""
    assert json.loads(result.stdout)["status"] == "partial"


def test_progress_is_lines_where_stdout_is_no_terminal(config: Path) -> None:
    result = called("calibrate", config, "--out", config.parent / "out", pipeline=SUCCEEDS)

    lines = result.stdout.splitlines()
    assert lines[0] == "solving: started"
    assert lines[1].startswith("solving: 2/2 in ")
    assert lines[-1] == f"Written to {config.parent / 'out'}"
    assert "\x1b" not in result.stdout


@pytest.mark.parametrize("arguments", [["inspect"], ["--help"]], ids=" ".join)
def test_a_closed_pipe_is_one_line(arguments: list[str], config: Path) -> None:
    """The help is printed by typer."""
    drive = [config.parent / "drive"] if "inspect" in arguments else []
    process = start(*arguments, *drive)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()

    err = process.stderr.read()

    assert process.wait(timeout=30) == 2
    assert err == "error: standard output: cannot be written: Broken pipe\n"


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
@pytest.mark.parametrize(
    ("arguments", "unbuffered"),
    [(["inspect"], False), (["--help"], False), (["--help"], True)],
    ids=["inspect", "help", "help-unbuffered"],
)
def test_a_full_disk_behind_stdout_is_one_line(
    arguments: list[str], unbuffered: bool, config: Path
) -> None:
    """Without a buffer and without rich, typer looks by a write what kind of stream it has."""
    drive = [config.parent / "drive"] if "inspect" in arguments else []
    plain = {"PYTHONUNBUFFERED": "1", "TYPER_USE_RICH": "0"} if unbuffered else {}
    with open("/dev/full", "w") as full:
        result = subprocess.run(
            [sys.executable, "-m", "caliv_graph", *arguments, *drive],
            env={**os.environ, **plain},
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            check=False,
        )

    assert result.returncode == 2
    assert result.stderr == "error: standard output: cannot be written: No space left on device\n"


def test_without_standard_output_help_says_nothing_and_results_are_an_error(
    config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As `>&-` leaves it; Python has None for it then."""
    monkeypatch.setattr(sys, "stdout", None)

    assert command_line.run(["--help"]) == 0
    assert capsys.readouterr().err == ""
    for arguments in (["--version"], ["inspect", str(config.parent / "drive")]):
        assert command_line.run(arguments) == 2
        told = capsys.readouterr().err
        assert told == "error: standard output: cannot be written: it is closed\n"


def test_a_message_shows_what_a_terminal_would_obey(capsys: pytest.CaptureFixture[str]) -> None:
    streams.error("/tmp/x\x1b[31m: a\r\nb\x07\u202e\ufeff é \ud800\x85c")

    assert capsys.readouterr().err == (
        "error: /tmp/x\\x1b[31m: a b\\x07\\u202e\\ufeff é \\ud800 c\n"
    )


def test_the_end_of_a_file_is_no_interrupt(config: Path) -> None:
    """Typer takes an EOFError for the end of what a person types."""
    pipeline = "def calibrate(*_): raise EOFError('marshal data too short')"

    result = called("calibrate", config, "--out", config.parent / "out", pipeline=pipeline)

    assert result.returncode == 1
    assert "this is a defect of caliv-graph" in result.stderr
    assert "EOFError: marshal data too short" in result.stderr


def test_a_message_is_short_whatever_it_quotes(capsys: pytest.CaptureFixture[str]) -> None:
    streams.error(f"/tmp/x: 'lidars.{'9' * 100_000}' is missing. Add it")

    said = capsys.readouterr().err
    assert len(said) < 1500
    assert said.startswith("error: /tmp/x: 'lidars.999")
    assert said.endswith("999' is missing. Add it\n")


@pytest.mark.parametrize(("given", "used"), [(None, "1"), ("3", "3")])
def test_linear_algebra_has_one_thread_unless_the_user_says_otherwise(
    given: str | None, used: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before the program is imported, and numpy with it: later it would not count."""
    seen = []
    # So that both are put back at the end.
    monkeypatch.setenv("OMP_NUM_THREADS", "")
    monkeypatch.delenv("OMP_NUM_THREADS")
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    if given is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", given)
    started = types.ModuleType("caliv_graph.cli.main")
    started.__dict__["main"] = lambda: seen.append(os.environ["OMP_NUM_THREADS"])
    monkeypatch.setitem(sys.modules, "caliv_graph.cli.main", started)

    main()

    assert seen == [used]
