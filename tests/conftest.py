"""Tests that several processes share: their order, and one core for each process."""

from __future__ import annotations

import os

# Before numpy is imported, as the command line does (`caliv_graph.__main__`): several processes
# share the cores, and threads of its library would wait for each other at ten times the cost.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import gc
from contextlib import ExitStack
from pathlib import Path

import pytest

from caliv_graph.common.cores import cores, on_one_core
from caliv_graph.common.memory import keep_freed_memory

ROOT = Path(__file__).resolve().parents[1]

LONGEST = (
    "tests/test_pipeline.py",
    "tests/cli/test_batch.py",
    "tests/robustness/test_spoiled_drives.py",
    "tests/cli/test_plan.py",
    "tests/test_structure.py",
    "tests/targets/search/test_find.py",
    "tests/trajectory/test_wheels.py",
    "tests/calibration/test_score_tests.py",
    "tests/workflows/test_survey.py",
    "tests/trajectory/test_smooth.py",
    "tests/planning/test_suggest.py",
    "tests/calibration/test_several_drives.py",
    "tests/test_prior.py",
    "tests/robustness/test_outputs.py",
    "tests/calibration/test_noise.py",
    "tests/test_raw_sensors.py",
    "tests/trajectory/test_uncertain.py",
    "tests/registration/test_register.py",
    "tests/planning/test_structure.py",
    "tests/mounting/test_doubts.py",
    "tests/test_memory.py",
    "tests/report/test_html.py",
    "tests/test_moved_target.py",
    "tests/targets/cloud/test_constellation.py",
    "tests/validation/test_lidars_alone.py",
    "tests/trajectory/test_heading.py",
    "tests/test_late_clocks.py",
    "tests/simulation/test_recording.py",
    "tests/scripts/test_fuzz.py",
    "tests/workflows/test_survey_walls.py",
    "tests/structure/test_slow_errors.py",
    "tests/calibration/test_staged.py",
    "tests/calibration/test_motion_suspects.py",
    "tests/scripts/test_thinned.py",
)
"""Files that take more than 8 s beside others, the longest first: what begins last should be
short, or one process works alone at the end."""


MOST_PROCESSES = 4


def pytest_xdist_auto_num_workers() -> int:
    """One process more than cores: some tests wait for other processes, for a clock or the disk."""
    return min(cores() + 1, MOST_PROCESSES)


def pytest_configure(config: pytest.Config) -> None:
    """As the command line does it, in a process of pytest-xdist with one thread.

    Two threads would wait for the cores of the other processes.
    """
    keep_freed_memory()
    if hasattr(config, "workerinput"):
        stack = ExitStack()
        stack.enter_context(on_one_core())
        config.add_cleanup(stack.close)


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
