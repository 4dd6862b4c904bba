"""The remedy says what would make scans count, by the counts themselves."""

from __future__ import annotations

from collections import Counter

import pytest

from caliv_graph.config.model import ExtractionConfig
from caliv_graph.targets.cloud.tally import EMPTY, MOVED, OUTSIDE, Tally

EXTRACTION = ExtractionConfig(min_points=30, min_scans=8)


def test_fewer_points_are_proposed_only_where_they_would_suffice() -> None:
    sparse = [25, 24, 21, 20, 20, 12]
    tally = Tally(scans=20, kept=4, rejected=Counter({OUTSIDE: 10}), sparse=sparse)
    assert tally.remedy(EXTRACTION, is_given=True) == (
        "Set extraction.min_points to 20 (now 30): 5 more scans show an object with as many points"
    )
    none = Tally(scans=20, kept=1, rejected=Counter({OUTSIDE: 13}), sparse=sparse)
    assert "min_points" not in none.remedy(EXTRACTION, is_given=True)
    # The smallest value that the config accepts is 6.
    few = Tally(scans=20, kept=7, rejected=Counter({OUTSIDE: 13}), sparse=[5, 4])
    assert "min_points" not in few.remedy(EXTRACTION, is_given=True)


@pytest.mark.parametrize(
    ("why", "is_given", "words"),
    [
        (OUTSIDE, True, "or leave target out"),
        (OUTSIDE, False, "Check its initial guess"),
        (MOVED, True, "Check its initial guess, its stamps"),
        (EMPTY, True, "min_range and max_range"),
        ("under 30 points", True, "nearer"),
    ],
)
def test_otherwise_the_most_common_reason_decides(why: str, is_given: bool, words: str) -> None:
    tally = Tally(scans=9, rejected=Counter({why: 7, OUTSIDE: 1} if why != OUTSIDE else {why: 8}))
    remedy = tally.remedy(EXTRACTION, is_given)
    assert words in remedy
    assert ("target.min/max" in remedy) == (why == OUTSIDE and is_given)
