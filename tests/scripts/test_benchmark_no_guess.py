"""Verdicts on calibrations with and without initial guesses, on runs by hand."""

from __future__ import annotations

from typing import Any

import pytest

from scripts import benchmark_no_guess as benchmark


def a_line(seed: int, sigmas: float, *, axes: int = 6, exits: tuple[int, int] = (0, 0)) -> Any:
    """S2S in x differs by some sigmas of 2 mm."""
    error: list[float | None] = [0.0, 0.0, 0.0, 2e-3 * sigmas, 0.0, 0.0]
    error[axes:] = [None] * (6 - axes)
    of = {"error": error, "sigma": [2e-3] * 6, "nees": 1.0, "axes": axes}
    run: dict[str, Any] = {"said": [], "undetermined": [], "errors": {"S2V front": of}}
    return {
        "scenario": "paper_arc",
        "seed": seed,
        "code": "a",
        "with": {**run, "exit": exits[0], "cpu_s": 10.0},
        "without": {**run, "exit": exits[1], "cpu_s": 11.0, "undetermined": ["a shift"]},
        "apart": {"S2S rear to front": of},
    }


@pytest.mark.parametrize(
    ("line", "same"),
    [
        (a_line(1, 0.9), True),
        (a_line(1, -1.1), False),
        (a_line(1, 0.1, axes=5), False),
        (a_line(1, 0.1, exits=(0, 3)), False),
        (a_line(1, 0.1, exits=(4, 4)), False),
    ],
)
def test_two_results_are_the_same_if_s2s_is_known_and_differs_by_less_than_its_sigma(
    line: Any, same: bool
) -> None:
    assert benchmark.is_same(line) == same
    assert benchmark.text_of(line).endswith("DIFFERS") != same


def test_the_summary_counts_what_is_the_same_and_what_failed() -> None:
    failed = a_line(3, 0.0)
    del failed["apart"]
    failed["without"] = {"exit": 2, "said": ["TargetError: none"], "undetermined": [], "cpu_s": 1.0}

    text = benchmark.summary([a_line(1, 0.5), a_line(2, 2.0), failed])

    assert "paper_arc: the same in 1 of 3" in text
    assert "apart by at most 4.00 mm, 0.000 mrad, 2.00 sigma" in text
    assert "undetermined in 2" in text
    assert "1.10 at most (limit 1.5)" in text
    assert "TargetError: none" in benchmark.text_of(failed)
