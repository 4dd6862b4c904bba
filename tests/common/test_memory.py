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


def test_arrays_are_made_of_memory_that_was_freed() -> None:
    done = subprocess.run(
        [sys.executable, "-c", FAULTS], capture_output=True, text=True, check=True
    )
    if not done.stdout:
        pytest.skip("the system's library is not glibc")
    usual, kept = map(int, done.stdout.split())
    assert kept < 0.05 * usual
