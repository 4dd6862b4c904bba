"""Memory that is freed is used again."""

from __future__ import annotations

import subprocess
import sys

import pytest

FAULTS = """
import resource
import numpy as np
from caliv_graph.common.memory import keep_freed_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        some = [np.ones(10**6) for _ in range(6)]  # 48 MB, freed together
        del some
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

usual = faults()
if keep_freed_memory():
    faults()
    print(usual, faults())
"""


def usual_and_kept(program: str) -> tuple[int, int]:
    """Page faults that a program prints, without and with memory that is kept."""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    if not done.stdout:
        pytest.skip("the system's library is not glibc")
    usual, kept = map(int, done.stdout.split())
    return usual, kept


def test_arrays_are_made_of_memory_that_was_freed() -> None:
    usual, kept = usual_and_kept(FAULTS)
    assert kept < 0.05 * usual


LARGER = """
import resource
import numpy as np
from caliv_graph.common.memory import keep_freed_memory, keeping_larger_arrays

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        some = np.ones(2 * 10**6)  # 16 MB
        del some
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

with keeping_larger_arrays():  # of a process that did not ask for it: nothing happens
    pass
if keep_freed_memory():
    usual = faults()
    with keeping_larger_arrays():
        faults()
        print(usual, faults())
"""


def test_larger_arrays_are_kept_for_a_while() -> None:
    usual, kept = usual_and_kept(LARGER)
    assert kept < 0.05 * usual


PASSED_OVER = """
import gc
import weakref
from caliv_graph.common.memory import collecting_what_is_new

class Ring:
    def __init__(self):
        self.own = self

def ring():
    return weakref.ref(Ring())

gc.disable()
dead, kept = ring(), Ring()
old = weakref.ref(kept)
with collecting_what_is_new():
    new = ring()
    del kept
    gc.collect()
    print(dead() is None, old() is None, new() is None)
gc.collect()
print(old() is None, gc.get_freeze_count())
"""


def test_collections_pass_over_what_is_there_until_the_end() -> None:
    done = subprocess.run(
        [sys.executable, "-c", PASSED_OVER], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["True", "False", "True", "True", "0"]


FROZEN = """
import gc
from caliv_graph.common.memory import collecting_what_is_new

gc.freeze()
with collecting_what_is_new():
    pass
print(gc.get_freeze_count() > 0)
"""


def test_what_a_caller_has_frozen_stays_so() -> None:
    """In a process of its own: in this one `tests/conftest.py` answers whether anything is."""
    done = subprocess.run(
        [sys.executable, "-c", FROZEN], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["True"]
