"""A pytest plugin: notes every error and contradiction that the tests provoke, a JSON line each.

`pytest -p scripts._messages`, with the file's path in the environment variable `MESSAGES_FILE`.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from caliv_graph.errors import CalivError
from caliv_graph.products import Calibration

VARIABLE = "MESSAGES_FILE"

_test = ""


def _note(exit_code: int, kind: str, text: str) -> None:
    line = json.dumps({"exit": exit_code, "kind": kind, "text": text, "test": _test})
    with Path(os.environ[VARIABLE]).open("a", encoding="utf-8") as file:
        file.write(f"{line}\n")


def pytest_configure(config: pytest.Config) -> None:
    if VARIABLE not in os.environ:
        raise pytest.UsageError(f"{VARIABLE}: give the file to write to")

    begin = CalivError.__init__

    def made(self: CalivError, what: str, remedy: str = "") -> None:
        begin(self, what, remedy)
        _note(2, type(self).__name__, str(self))

    CalivError.__init__ = made  # type: ignore[method-assign]
    init = Calibration.__init__

    def calibrated(self: Calibration, *args: Any, **named: Any) -> None:
        init(self, *args, **named)
        for sentence in self.contradictions:
            _note(4, "contradiction", sentence)

    Calibration.__init__ = calibrated  # type: ignore[method-assign]


def pytest_runtest_setup(item: pytest.Item) -> None:
    global _test
    _test = item.nodeid
