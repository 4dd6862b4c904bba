"""Work that is shared out, and work that is not."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator

import pytest

from caliv_graph.common.cores import (
    TOGETHER,
    cores,
    on_one_core,
    parts,
    share_out,
    worked_together,
)

pytestmark = pytest.mark.usefixtures("all_cores")


def test_on_one_core_all_is_done_here_and_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1, 2})
    assert cores() == 3
    done: list[tuple[int, int]] = []
    with on_one_core():
        assert cores() == 1
        share_out(lambda i: done.append((i, threading.get_ident())), range(20))
    assert done == [(i, threading.get_ident()) for i in range(20)]
    assert cores() == 3


def test_work_is_shared_out_and_all_of_it_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1})
    both = threading.Barrier(2, timeout=20.0)
    done = [0] * 2

    def work(i: int) -> None:
        both.wait()  # two at a time, or never
        done[i] = i + 1

    share_out(work, range(2))
    assert done == [1, 2]


def test_what_goes_wrong_in_a_part_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    for usable in ({0}, {0, 1}):
        monkeypatch.setattr("os.sched_getaffinity", lambda _, usable=usable: usable)
        with pytest.raises(ZeroDivisionError):
            share_out(lambda i: i // 0, range(3))


def test_work_done_together_comes_in_order_and_holds_few_items(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    here, taken, done = threading.get_ident(), 0, 0

    def items() -> Iterator[int]:
        nonlocal taken
        for i in range(3 * TOGETHER + 1):
            assert threading.get_ident() == here  # readers of files stay in their thread
            taken += 1
            yield i

    for usable in ({0}, {0, 1}):
        monkeypatch.setattr("os.sched_getaffinity", lambda _, usable=usable: usable)
        taken = done = 0
        for i, square in enumerate(worked_together(lambda i: i * i, items())):
            assert square == i * i
            assert taken - done <= TOGETHER
            done += 1
        assert done == taken == 3 * TOGETHER + 1


def test_work_that_shares_out_work_does_it_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1})
    both = threading.Barrier(2, timeout=20.0)
    inside: list[set[int]] = [set(), set()]

    def outer(i: int) -> None:
        both.wait()
        share_out(lambda _: inside[i].add(threading.get_ident()), range(50))

    for _ in range(3):  # the helper is the same one, and has not stayed in its part
        share_out(outer, range(2))
        assert [len(threads) for threads in inside] == [1, 1]
        assert inside[0] != inside[1]
        inside[0].clear()
        inside[1].clear()


def test_a_fork_has_a_helper_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1})
    share_out(lambda _: None, range(2))
    child = os.fork()
    if child == 0:
        done: list[int] = []
        share_out(done.append, range(8))
        os._exit(0 if sorted(done) == list(range(8)) else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_after_an_error_nobody_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1})
    begun: list[int] = []
    both = threading.Barrier(2, timeout=20.0)

    def work(i: int) -> None:
        begun.append(i)
        if i < 2:
            both.wait()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        share_out(work, range(1000))
    assert sorted(begun) == [0, 1]


def test_one_core_is_given_back_after_an_error() -> None:
    before = cores()
    with pytest.raises(ValueError, match="stop"), on_one_core():
        raise ValueError("stop")
    assert cores() == before


@pytest.mark.parametrize(("count", "number"), [(0, 3), (2, 5), (10, 3), (9, 3), (7, 1)])
def test_parts_are_all_of_it_in_order_and_about_equal(count: int, number: int) -> None:
    cut = parts(count, number)
    assert [i for part in cut for i in range(count)[part]] == list(range(count))
    sizes = [part.stop - part.start for part in cut]
    assert all(size > 0 for size in sizes)
    assert not sizes or max(sizes) - min(sizes) <= 1
