"""Work done ahead: the same results in the same order, few at a time, and nothing left running."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from caliv_graph.readers.ahead import AHEAD, worked_ahead


@pytest.fixture(params=[1, 2, 8])
def cores(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    count: int = request.param
    monkeypatch.setattr("caliv_graph.readers.ahead.cores", lambda: count)
    return count


def test_results_come_in_the_order_of_the_items(cores: int) -> None:
    assert list(worked_ahead(lambda n: n * n, range(50))) == [n * n for n in range(50)]
    assert list(worked_ahead(lambda n: n, [])) == []


def test_items_are_taken_as_they_are_wanted_and_by_the_caller(cores: int) -> None:
    taken: list[int] = []
    takers = set()

    def items() -> Iterator[int]:
        for n in range(100):
            taken.append(n)
            takers.add(threading.get_ident())
            yield n

    results = worked_ahead(lambda n: n, items())
    for done in range(1, 20):
        next(results)
        assert len(taken) <= done + AHEAD
    assert takers == {threading.get_ident()}


def test_an_error_comes_when_the_turn_of_its_item_does(cores: int) -> None:
    results = worked_ahead(lambda n: 1 // (n - 3), range(10))

    assert [next(results) for _ in range(3)] == [-1, -1, -1]
    with pytest.raises(ZeroDivisionError):
        next(results)


def test_an_error_of_the_items_is_the_callers(cores: int) -> None:
    def items() -> Iterator[int]:
        yield 1
        raise OSError("cut off")

    with pytest.raises(OSError, match="cut off"):
        list(worked_ahead(lambda n: n, items()))


def test_no_thread_outlives_the_one_who_asked(cores: int) -> None:
    before = threading.active_count()
    results = worked_ahead(lambda n: n, range(100))
    next(results)
    results.close()  # type: ignore[attr-defined]

    assert threading.active_count() == before
