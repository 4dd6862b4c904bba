"""Where results cannot go, and results that are interrupted: whole, or not there at all."""

from __future__ import annotations

import hashlib
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from caliv_graph.results.calibration_file import read_calibration, write_calibration
from caliv_graph.results.names import RESULT_FILES
from tests.cli import commands
from tests.cli.commands import ROOT, program_with
from tests.fusion.drives import arc_information
from tests.fusion.drives import drive as fused_drive
from tests.robustness.hostile_drives import SCENARIO, Outcome, command

NAMES = ("front", "rear")

SUCCEEDS = """
def calibrate(recordings, config, progress, prior):
    return run_of(make_calibration())
"""


@pytest.fixture
def results(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Calibrations from a right and from a left arc."""
    folder = tmp_path_factory.mktemp("results")
    paths = folder / "right.yaml", folder / "left.yaml"
    write_calibration(fused_drive(arc_information(NAMES), source="a"), paths[0])
    write_calibration(fused_drive(arc_information(NAMES, 2, left=True), source="b"), paths[1])
    return paths


def start(
    *arguments: object, before: Callable[[], None] | None = None, pipeline: str = ""
) -> subprocess.Popen[str]:
    """Starts the program in a process of its own, maybe with a pipeline that is made up."""
    program = ["-c", program_with(pipeline)] if pipeline else ["-m", "caliv_graph"]
    return subprocess.Popen(
        [sys.executable, *program, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        # Python 3.11 itself leaves a cut-off cache of bytecode behind where a file cannot grow.
        env={
            "PATH": "/usr/bin:/bin",
            "PYTHONPATH": str(ROOT),
            "OMP_NUM_THREADS": "1",
            "PYTHONDONTWRITEBYTECODE": "1",
        },
        preexec_fn=before,
    )


def digest(folder: Path) -> str:
    """Of all files below a folder, names included."""
    found = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        found.update(str(path.relative_to(folder)).encode())
        if path.is_file():
            found.update(path.read_bytes())
    return found.hexdigest()


def is_whole(result: Path) -> bool:
    there = {path.name for path in result.iterdir()}
    return there == {name for name in RESULT_FILES if "[" not in name}


def interrupted(
    number: int, lines: int, wait_s: float, *arguments: object
) -> tuple[Outcome, list[str]]:
    """Runs a command and sends it a signal, so many lines and so much time after its start."""
    process = start(*arguments)
    assert process.stdout is not None
    said = [process.stdout.readline() for _ in range(lines)]
    time.sleep(wait_s)
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    return Outcome(process.returncode, out, err), said


# ------------------------------------------------------------------ signals


# Lines of progress of `calibrate`: two per stage. The last is the table, when all is written.
@pytest.mark.parametrize(
    ("number", "lines", "wait_s"),
    [
        (signal.SIGINT, 0, 0.3),  # modules are imported
        (signal.SIGTERM, 1, 0.0),  # the trajectory
        (signal.SIGINT, 3, 0.1),  # clouds
        (signal.SIGTERM, 14, 0.2),  # the graph
    ],
)
def test_a_calibration_that_is_interrupted(
    number: int, lines: int, wait_s: float, drive: Path, tmp_path: Path
) -> None:
    before = digest(drive)
    out = tmp_path / "results" / "result"
    out.parent.mkdir()

    done, _ = interrupted(number, lines, wait_s, "calibrate", drive / "config.yaml", "--out", out)

    check_interrupted(done, number, out)
    assert digest(drive) == before


def check_interrupted(done: Outcome, number: int, out: Path) -> None:
    """Whole or not there; nothing beside it, unless it was killed without a word."""
    assert "Traceback" not in done.err
    if out.exists():
        assert is_whole(out)
    beside = [path.name for path in out.parent.iterdir() if path != out]
    if number == signal.SIGKILL:
        assert done.code == -signal.SIGKILL
        assert all(name.startswith(f".{out.name}.") for name in beside)
        return
    assert beside == []
    # It may have been done just before.
    assert done.code == 130 or out.exists()
    if done.code == 130:
        assert done.err == "error: interrupted\n"


@pytest.mark.parametrize("wait_s", [0.05, 0.15])
def test_an_interrupt_while_the_program_starts(wait_s: float, tmp_path: Path) -> None:
    """Before Python runs a line of ours, it has its own answer; never a result, though."""
    out = tmp_path / "result"

    done, _ = interrupted(signal.SIGTERM, 0, wait_s, "calibrate", tmp_path / "c", "--out", out)

    assert done.code in (130, -signal.SIGTERM)
    assert "Traceback" not in done.err
    assert not out.exists()


def test_what_a_kill_leaves_is_not_in_the_way(results: tuple[Path, Path], tmp_path: Path) -> None:
    """The next run has its own place to write to, and its result holds nothing of the other."""
    out = tmp_path / "calibration.json"
    left = tmp_path / f".{out.name}.0123456789ab"
    left.write_text("half a res")

    done = command("export", results[0], "--to", "json", "--out", out)

    assert done.code == 0
    assert left.read_text() == "half a res"
    assert sorted(path.name for path in tmp_path.iterdir()) == [left.name, out.name]


def test_a_simulation_that_is_interrupted(tmp_path: Path) -> None:
    scenario = tmp_path / "scenario.yaml"
    # Ten times as long as the small drive: it is not done when the signal comes.
    long = {**SCENARIO, "drive": {**SCENARIO["drive"], "duration_s": 140.0}}
    scenario.write_text(yaml.safe_dump(long))
    out = tmp_path / "drives" / "drive"
    out.parent.mkdir()

    done, said = interrupted(
        signal.SIGTERM, 1, 0.4, "simulate", scenario, "--out", out, "--format", "both"
    )

    assert said == ["simulating: started\n"]
    assert (done.code, done.err) == (130, "error: interrupted\n")
    assert list(out.parent.iterdir()) == []


_AT_THE_LAST_STEP = """
import pathlib, signal
last_step = pathlib.Path.{step}
def interrupted_before(path, target):
    signal.raise_signal({number})
    return last_step(path, target)
pathlib.Path.{step} = interrupted_before
"""


@pytest.mark.parametrize(
    ("name", "number"),
    [("calibrate", signal.SIGKILL), ("merge", signal.SIGINT), ("export", signal.SIGTERM)],
)
def test_what_is_interrupted_before_its_last_step_is_not_there(
    name: str, number: int, results: tuple[Path, Path], tmp_path: Path
) -> None:
    """All is written, and has only not yet the name of the result."""
    commands.write_drive(tmp_path / "drive")
    config = commands.write_config(tmp_path / "config.yaml")
    out = tmp_path / "results" / "out"
    arguments: dict[str, list[object]] = {
        "calibrate": [config],
        "merge": [*results],
        "export": [results[0], "--to", "autoware"],
    }
    before = digest(tmp_path)
    # A folder gets its name by `rename`, a file by `replace`.
    step = "rename" if name == "calibrate" else "replace"
    pipeline = SUCCEEDS + _AT_THE_LAST_STEP.format(step=step, number=int(number))

    process = start(name, *arguments[name], "--out", out, pipeline=pipeline)
    _, err = process.communicate(timeout=60)

    if number == signal.SIGKILL:
        assert process.returncode == -signal.SIGKILL
        (left,) = out.parent.iterdir()
        assert left.name.startswith(f".{out.name}.")
        assert (left / "new" / "calibration.yaml").is_file()
    else:
        assert (process.returncode, err) == (130, "error: interrupted\n")
        assert digest(tmp_path) == before


_WHERE_IT_IS_SWALLOWED = """
import ctypes, signal, time
@ctypes.CFUNCTYPE(None)
def from_c():
    signal.raise_signal({number})
def calibrate(recordings, config, progress, prior):
    from_c()
    time.sleep(20.0)
    return run_of(make_calibration())
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_that_nothing_can_take_comes_once_more(
    number: signal.Signals, tmp_path: Path
) -> None:
    """Python prints "Exception ignored in" for one in a callback from C, and goes on."""
    commands.write_drive(tmp_path / "drive")
    config = commands.write_config(tmp_path / "config.yaml")
    out = tmp_path / "out"
    pipeline = _WHERE_IT_IS_SWALLOWED.format(number=int(number))

    process = start("calibrate", config, "--out", out, pipeline=pipeline)
    _, err = process.communicate(timeout=60)

    assert (process.returncode, err) == (130, "error: interrupted\n")
    assert not out.exists()


# ------------------------------------------------------------------ no place


def small_disk(most_bytes: int) -> Callable[[], None]:
    """No file may be larger: as on a disk that fills up while it is written."""

    def limit() -> None:
        # The signal of the limit would end the program before it could say a word.
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))

    return limit


@pytest.mark.parametrize("most_bytes", [0, 5000])
def test_a_disk_that_fills_up_while_a_result_is_written(
    most_bytes: int, results: tuple[Path, Path], tmp_path: Path
) -> None:
    """It has 10 kB."""
    out = tmp_path / "results" / "merged.npz"
    arguments = ["export", results[0], "--to", "npz", "--out", out]

    process = start(*arguments, before=small_disk(most_bytes))
    _, err = process.communicate(timeout=60)

    assert process.returncode == 2
    assert err.startswith(f"error: {out}: cannot be written: File too large")
    assert len(err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_fills_up_while_a_calibration_is_written(tmp_path: Path) -> None:
    """Some of its files would fit, one has 10 kB."""
    drive = commands.write_drive(tmp_path / "drive")
    config = commands.write_config(tmp_path / "config.yaml")
    out = tmp_path / "results" / "result"

    disk = small_disk(5000)
    process = start("calibrate", config, "--out", out, before=disk, pipeline=SUCCEEDS)
    _, err = process.communicate(timeout=60)

    assert process.returncode == 2
    assert err.startswith(f"error: {out}/calibration.yaml: cannot be written: File too large")
    assert len(err.splitlines()) == 1
    assert sorted(tmp_path.iterdir()) == sorted([config, drive])


def test_a_disk_that_fills_up_while_a_drive_is_simulated(tmp_path: Path) -> None:
    scenario = tmp_path / "scenario.yaml"
    scenario.write_text(yaml.safe_dump(dict(SCENARIO)))
    out = tmp_path / "drive"

    process = start("simulate", scenario, "--out", out, before=small_disk(100_000))
    _, err = process.communicate(timeout=60)

    assert process.returncode == 2, err
    assert err.startswith(f"error: {out}: cannot be written: File too large")
    assert len(err.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["scenario.yaml"]


PLACES: dict[str, Callable[[Path], Path]] = {
    "a file": lambda folder: folder / "file",
    "below a file": lambda folder: folder / "file" / "result",
    "a device": lambda folder: Path("/dev/full"),
    "no name": lambda folder: folder / ("x" * 300),
    "a broken link": lambda folder: folder / "loop",
    "the kernel's": lambda folder: Path("/proc/result"),
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("name", ["calibrate", "simulate", "merge", "export"])
def test_a_place_that_takes_no_result(
    name: str, place: str, drive: Path, results: tuple[Path, Path], tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "loop").symlink_to("loop")
    scenario = tmp_path / "scenario.yaml"
    scenario.write_text(yaml.safe_dump(dict(SCENARIO)))
    arguments: dict[str, list[object]] = {
        "calibrate": [drive / "config.yaml"],
        "simulate": [scenario],
        "merge": [*results],
        "export": [results[0], "--to", "json"],
    }
    before = digest(tmp_path)
    out = PLACES[place](tmp_path)

    done = command(name, *arguments[name], "--out", out)

    assert done.code == 2, done.err
    assert done.err.startswith(f"error: {out}: ")
    assert len(done.err.splitlines()) == 1
    assert digest(tmp_path) == before


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission(results: tuple[Path, Path], tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    out = tmp_path / "out.json"

    done = command("export", results[0], "--to", "json", "--out", out)

    assert (done.code, "no permission" in done.err) == (2, True)


def test_a_parent_that_is_missing_is_made(results: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "a" / "b" / "out.yaml"

    done = command("merge", *results, "--out", out)

    assert done.code == 0, done.err
    assert tuple(read_calibration(out).lidars) == NAMES


def test_a_parent_that_was_made_goes_with_what_fails(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b" / "out.yaml"

    done = command("merge", tmp_path / "gone.yaml", "--out", out)

    assert done.code == 2
    assert list(tmp_path.iterdir()) == []
