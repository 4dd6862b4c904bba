"""Errors: cause and remedy, the same in another process."""

from __future__ import annotations

import pickle

from caliv_graph.errors import CalivError, SolveError, TargetError


def test_the_message_has_cause_and_remedy() -> None:
    error = TargetError("drive: none found in 60 scans", "Drive past a chair")

    assert str(error) == "drive: none found in 60 scans. Drive past a chair"
    assert error.what == "drive: none found in 60 scans"
    assert str(CalivError("a: is a pipe")) == "a: is a pipe"


def test_an_error_of_another_process_is_the_same() -> None:
    """A remedy that the class adds is not added twice."""
    error = SolveError("the graph is singular")

    copied = pickle.loads(pickle.dumps(error))

    assert type(copied) is SolveError
    assert str(copied) == str(error)
    assert str(error).startswith("the graph is singular. Run 'caliv-graph inspect")
