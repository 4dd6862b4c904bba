"""Where the processor time of a calibration goes, by stage and by function of the package.

A timer of processor time interrupts the run, and what runs then is counted: unlike a tracing
profiler, this makes small functions no slower than large ones.
"""

from __future__ import annotations

import signal
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import caliv_graph
from caliv_graph.common.cores import on_one_core
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.model import Config
from caliv_graph.pipeline import calibrate
from caliv_graph.products import Recording

PERIOD_S = 0.004
"""Processor time from one sample to the next: a run of 10 s has up to 2,500 samples."""

SHOWN = 30
"""Functions in the text, of each list."""

PACKAGE = f"{Path(caliv_graph.__file__).parent}/"


@dataclass
class Samples:
    """Processor time by function, `room/file.py:name`, in seconds.

    A sample counts with the time since the one before: the timer is answered between two
    instructions of Python, so that a long call of compiled code has one sample.

    Attributes:
        until_s: processor time of the last sample.
        own: in the function itself, and in what it calls outside the package.
        total: in the function, and in all that it calls.
    """

    until_s: float = field(default_factory=time.process_time)
    own: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    total: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))

    def take(self, frame: FrameType | None) -> None:
        """Adds the time since the last sample, by the frames from the innermost."""
        now_s = time.process_time()
        spent_s, self.until_s = now_s - self.until_s, now_s
        names = []
        while frame is not None:
            code = frame.f_code
            if code.co_filename.startswith(PACKAGE):
                names.append(f"{code.co_filename.removeprefix(PACKAGE)}:{code.co_qualname}")
            frame = frame.f_back
        for name in names[:1]:
            self.own[name] += spent_s
        for name in set(names):
            self.total[name] += spent_s


@contextmanager
def sampled() -> Iterator[Samples]:
    """Samples what runs inside, in the main thread."""
    samples = Samples()
    before: Any = signal.signal(signal.SIGPROF, lambda _, frame: samples.take(frame))
    signal.setitimer(signal.ITIMER_PROF, PERIOD_S, PERIOD_S)
    try:
        yield samples
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


@dataclass(frozen=True)
class Profile:
    """Processor time of a calibration in memory, on one core; no report, no files.

    Attributes:
        name: of the drive.
        cpu_s: in all.
        stages: name and seconds of each, in order.
        own: seconds by function, the most first (`Samples.own`).
        total: the same (`Samples.total`).
    """

    name: str
    cpu_s: float
    stages: Sequence[tuple[str, float]]
    own: Mapping[str, float]
    total: Mapping[str, float]


def profiled(name: str, recording: Recording, config: Config) -> Profile:
    """Calibrates once.

    Raises:
        CalivError: there is no result.
    """
    progress = SilentProgress()
    begun = time.process_time()
    with on_one_core(), sampled() as samples:
        calibrate([recording], config, progress)
    cpu_s = time.process_time() - begun
    stages = [(s.name, s.cpu_seconds or 0.0) for s in progress.stages if s.depth == 0]
    stages.append(("between the stages, tests", cpu_s - sum(seconds for _, seconds in stages)))
    own, total = (
        dict(sorted(spent_s.items(), key=lambda of: -of[1]))
        for spent_s in (samples.own, samples.total)
    )
    return Profile(name, cpu_s, stages, own, total)


def profile_text(profile: Profile) -> str:
    """Stages, and the functions with the most time."""
    rows = [f"{profile.name}: {profile.cpu_s:.2f} s of CPU on one core", "  by stage"]
    rows += [_row(profile, *stage) for stage in profile.stages]
    for what, functions in (
        ("in the function itself", profile.own),
        ("with what it calls", profile.total),
    ):
        rows.append(f"  by function, {what}")
        rows += [_row(profile, *found) for found in list(functions.items())[:SHOWN]]
    return "\n".join(rows)


def _row(profile: Profile, name: str, seconds: float) -> str:
    return f"    {seconds:7.2f} s {100.0 * seconds / profile.cpu_s:5.1f} %  {name}"
