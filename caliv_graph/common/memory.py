"""How the process takes memory from the system."""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Iterator
from contextlib import contextmanager

# Parameters of glibc's mallopt (malloc.h).
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3

LARGEST_KEPT = 8 * 2**20
"""Bytes of the largest array that is kept. Larger ones take longer to fill than to clear, and what
they leave behind in pieces is not used again: with 32 MiB a solve of structure had a peak that was
100 MB higher, and took no less time."""

LARGEST_KEPT_WHILE_REGISTERING = 32 * 2**20
"""The same while clouds are registered, where sums over clouds and surfels are as large as this;
glibc allows no more. With three LiDARs it saves 4 to 8 percent of a calibration, same peak."""

MOST_KEPT = 512 * 2**20
"""Free bytes at the end of the heap that are kept: the working set of the largest calibrations."""


class _Keeping:
    """Whether this process keeps freed memory: asked for once, never taken back."""

    is_set = False


def give_back_freed_memory() -> None:
    """Gives memory that is freed back to the system, in front of a stage that takes much.

    What many small objects leave behind is in pieces that no large array fits into. Python keeps
    some thousand small objects of each kind for later; spread over what a long drive took, they
    keep all of it. A full collection lets go of them.
    """
    gc.collect()
    give_back_freed_arrays()


def give_back_freed_arrays() -> None:
    """The same without what small objects left behind: within a stage, for a tenth of the time."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (AttributeError, OSError, TypeError):
        return  # not glibc


def anything_is_frozen() -> bool:
    """Whether a caller has frozen objects; these are counted one by one."""
    return gc.get_freeze_count() > 0


@contextmanager
def collecting_what_is_new() -> Iterator[None]:
    """Inside, garbage collections pass over the objects that are there already.

    A full collection visits every object of the modules, 0.1 s of processor time. A calibration
    asks for several (`give_back_freed_memory`). Where a caller has frozen objects, they stay so.
    """
    if anything_is_frozen():
        yield
        return
    gc.collect()  # garbage that is frozen would stay, run after run
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def keep_freed_memory() -> bool:
    """Keeps memory that is freed for the next array; whether the system's library can do so.

    For processes that calibrate: numpy frees arrays of megabytes and asks for them again thousands
    of times. By default glibc gives them back to the system, which clears every page anew: 6 to 7
    percent of the processor time of a calibration. Peak memory stays the same.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False  # not glibc: what other libraries do is their own affair
    kept = [mallopt(_MMAP_THRESHOLD, LARGEST_KEPT), mallopt(_TRIM_THRESHOLD, MOST_KEPT)]
    _Keeping.is_set = all(kept)
    return _Keeping.is_set


@contextmanager
def keeping_larger_arrays() -> Iterator[None]:
    """Inside, freed arrays of up to `LARGEST_KEPT_WHILE_REGISTERING` bytes are kept, too.

    Only in a process that keeps freed memory (`keep_freed_memory`).
    """
    if not _Keeping.is_set:
        yield
        return
    mallopt = ctypes.CDLL(None).mallopt
    mallopt(_MMAP_THRESHOLD, LARGEST_KEPT_WHILE_REGISTERING)
    try:
        yield
    finally:
        mallopt(_MMAP_THRESHOLD, LARGEST_KEPT)
