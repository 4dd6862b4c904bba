from __future__ import annotations

import io
import re
import time

import pytest
from rich.console import Console

from caliv_graph.common.progress import BarProgress, PlainProgress, SilentProgress


def without_seconds(lines: list[str]) -> list[str]:
    return [re.sub(r"\d+\.\d s", "T s", line) for line in lines]


def test_stages_are_recorded_in_the_order_of_their_start() -> None:
    progress = SilentProgress()

    with progress.stage("outer", 2) as advance:
        advance(note="half")
        with progress.stage("inner"):
            pass
        advance()

    outer, inner = progress.stages
    assert (outer.name, outer.depth, outer.done, outer.total, outer.note) == (
        "outer",
        0,
        2,
        2,
        "half",
    )
    assert (inner.name, inner.depth, inner.done, inner.total) == ("inner", 1, 0, None)
    assert outer.seconds is not None
    assert inner.seconds is not None
    assert outer.seconds >= inner.seconds >= 0.0


def test_a_stage_that_fails_has_not_ended() -> None:
    lines: list[str] = []
    progress = PlainProgress(lines.append)

    with pytest.raises(ValueError, match="no"), progress.stage("work"):
        raise ValueError("no")
    with progress.stage("next"):
        pass

    assert progress.stages[0].seconds is None
    assert without_seconds(lines) == ["work: started", "next: started", "next: in T s"]


def test_plain_lines_are_no_flood() -> None:
    lines: list[str] = []
    progress = PlainProgress(lines.append)

    with progress.stage("clouds", 1000) as advance:
        for _ in range(1000):
            advance(note="all well")

    assert without_seconds(lines) == ["clouds: started", "clouds: 1000/1000 in T s (all well)"]


def test_long_stages_give_signs_of_life(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    lines: list[str] = []
    progress = PlainProgress(lines.append)

    with progress.stage("EM", 40) as advance:
        for _ in range(30):
            now += 1.0
            advance()

    assert lines == ["EM: started", "EM: 10/40", "EM: 20/40", "EM: 30/40", "EM: 30/40 in 30.0 s"]


def test_bars_on_a_terminal() -> None:
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=100)

    with (
        BarProgress(console) as progress,
        progress.stage("[clouds]", 3) as advance,
    ):
        advance(3, "of sensor_1")

    assert "[clouds]" in out.getvalue()
    assert "3/3" in out.getvalue()
    assert "of sensor_1" in out.getvalue()
    assert [stage.name for stage in progress.stages] == ["[clouds]"]
