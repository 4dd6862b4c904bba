"""Tests that several processes share: their order, and one core for each process."""

from __future__ import annotations

import os

# Before numpy is imported, as the command line does (`caliv_graph.__main__`): several processes
# share the cores, and threads of its library would wait for each other at ten times the cost.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Containers often set this. Without bytecode every process rewrites the asserts of all files.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import gc
import importlib
import sys
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from caliv_graph.cli import main
from caliv_graph.common.cores import cores, on_one_core
from caliv_graph.common.memory import keep_freed_memory

FOLDER = Path(__file__).resolve().parent

ROOT = FOLDER.parent

TESTS = "test_*.py"

LONGEST = (
    "tests/test_pipeline.py",
    "tests/cli/test_batch.py",
    "tests/report/test_html.py",
    "tests/robustness/test_spoiled_drives.py",
    "tests/calibration/test_score_tests.py",
    "tests/test_structure.py",
    "tests/registration/test_register.py",
    "tests/trajectory/test_uncertain.py",
    "tests/cli/test_plan.py",
    "tests/workflows/test_survey.py",
    "tests/trajectory/test_wheels.py",
    "tests/trajectory/test_smooth.py",
    "tests/targets/search/test_find.py",
    "tests/test_moved_target.py",
    "tests/targets/cloud/test_constellation.py",
    "tests/robustness/test_outputs.py",
    "tests/test_raw_sensors.py",
    "tests/planning/test_structure.py",
    "tests/test_memory.py",
    "tests/test_prior.py",
    "tests/structure/test_solve.py",
    "tests/scripts/test_paper.py",
    "tests/test_late_clocks.py",
    "tests/scripts/test_fuzz.py",
    "tests/calibration/test_several_drives.py",
    "tests/validation/test_validate.py",
    "tests/workflows/test_survey_walls.py",
    "tests/trajectory/test_heading.py",
    "tests/calibration/test_staged.py",
    "tests/workflows/test_next_drive.py",
    "tests/calibration/test_drift.py",
    "tests/scripts/test_demo.py",
    "tests/scripts/test_thinned.py",
    "tests/validation/test_lidars_alone.py",
    "tests/simulation/test_simulate.py",
    "tests/simulation/test_recording.py",
    "tests/calibration/test_motion_suspects.py",
    "tests/cli/test_main.py",
    "tests/structure/test_rates.py",
    "tests/registration/test_symmetry.py",
    "tests/scripts/test_check_reproducible.py",
)
"""Files that take more than 7.5 s of processor time, their children's included, the longest first:
what begins last should be short, or one process works alone at the end."""


MOST_PROCESSES = 4

TUNABLES, LARGE_PAGES = "GLIBC_TUNABLES", "glibc.malloc.hugetlb=1"
"""By which malloc asks for large pages: 3 percent of the time of a calibration. It is read when a
process starts."""


def pytest_xdist_auto_num_workers() -> int:
    """One process more than cores: some tests wait for other processes, for a clock or the disk."""
    return min(cores() + 1, MOST_PROCESSES)


def pytest_xdist_setupnodes() -> None:
    """Before the processes of pytest-xdist start."""
    os.environ.setdefault(TUNABLES, LARGE_PAGES)


def pytest_configure(config: pytest.Config) -> None:
    """As the command line does it, in a process of pytest-xdist with one thread.

    Two threads would wait for the cores of the other processes.
    """
    keep_freed_memory()
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False  # in the order of `LONGEST`
    if hasattr(config, "workerinput"):
        # What a test starts, to measure its memory perhaps, does without.
        if os.environ.get(TUNABLES) == LARGE_PAGES:
            del os.environ[TUNABLES]
        stack = ExitStack()
        stack.enter_context(on_one_core())
        config.add_cleanup(stack.close)


def pytest_sessionstart(session: pytest.Session) -> None:
    """In a fresh clone every process would rewrite the asserts of all files, 9 s each.

    Each begins with other files, and leaves what it made to the next.
    """
    sys.dont_write_bytecode = False
    worker = getattr(session.config, "workerinput", None)
    if worker is None:
        return
    asked = [Path(argument.partition("::")[0]).resolve() for argument in session.config.args]
    files = [file for file in sorted(FOLDER.rglob(TESTS)) if {file, *file.parents} & {*asked}]
    first = int(worker["workerid"][2:]) * len(files) // worker["workercount"]
    for file in files[first:] + files[:first]:
        # What cannot be imported is told by the collection.
        with suppress(Exception, pytest.skip.Exception):
            importlib.import_module(".".join(file.relative_to(ROOT).with_suffix("").parts))


@pytest.fixture
def all_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of threads: as many as the process may use, in a process of pytest-xdist too."""
    monkeypatch.setattr("caliv_graph.common.cores._one_core", False)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if hasattr(config, "workerinput"):  # a process of pytest-xdist
        places = {ROOT / name: place for place, name in enumerate(LONGEST)}
        items.sort(key=lambda item: places.get(item.path, len(places)))


def pytest_collection_finish(session: pytest.Session) -> None:
    keep_from_garbage_collections()
    # What takes 15 and 40 ms in each test that calls a command or calibrates: typer builds the
    # commands from their signatures, and a calibration counts what is frozen.
    patch = pytest.MonkeyPatch()
    session.config.add_cleanup(patch.undo)
    patch.setattr("typer.testing._get_command", lambda _: main.built())
    patch.setattr("caliv_graph.common.memory.anything_is_frozen", lambda: True)


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    if nextitem is None or nextitem.path != item.path:
        keep_from_garbage_collections()


def keep_from_garbage_collections() -> None:
    """What is there now is there to the end: modules, tests, and drives that files keep.

    Structure asks for several full collections in each calibration. Beside the tests of all files
    they took half of the time of its tests.
    """
    gc.collect()
    gc.freeze()
