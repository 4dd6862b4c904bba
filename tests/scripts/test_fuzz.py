"""A short run of the fuzzer on every reader, and that it would tell."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

pytest.importorskip("atheris", reason="has no package for this platform")

ROOT = Path(__file__).resolve().parents[2]
RUNS = 400
SCRIPT = ROOT / "scripts" / "fuzz.py"


def load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("fuzz_script", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


FUZZ = load()


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    out = tmp_path_factory.mktemp("fuzz")
    done = subprocess.run(
        [sys.executable, SCRIPT, "--runs", str(RUNS), "--seed", "3", "--json", "--out", out],
        stdout=subprocess.PIPE,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode in (0, 1)
    found: dict[str, Any] = json.loads(done.stdout)["targets"]
    return found


@pytest.mark.parametrize("target", list(FUZZ.MODULES))
def test_no_input_breaks_a_reader(target: str, results: dict[str, Any]) -> None:
    result = results[target]

    assert result["crashes"] == {}
    assert result["crash"] == 0
    assert result["inputs"] == RUNS
    # It gets past the first check, and does find what is to be refused.
    assert result["accepted"] >= 10
    assert result["refused"] >= RUNS // 3


def test_what_it_calls_a_crash(tmp_path: Path) -> None:
    class Refusal(Exception):
        pass

    def attempt(data: bytes) -> None:
        if data == b"no":
            raise Refusal("no, for a reason")
        if data == b"escape":
            raise Refusal("\x1b[31m")
        if data == b"silent":
            raise Refusal("")
        if data == b"defect":
            raise KeyError(data)
        assert data != b"promise"

    judge = FUZZ.Judge(attempt, (Refusal,), str, tmp_path)
    for data in (b"yes", b"no", b"escape", b"silent", b"defect", b"defect", b"promise"):
        judge(data)

    assert judge.counts == {"accepted": 1, "refused": 1, "crash": 5}
    # One file per place, and each holds what broke it.
    kept = {Path(file).read_bytes() for file in judge.crashes.values()}
    assert kept == {b"escape", b"silent", b"defect", b"promise"}


def test_the_death_of_a_reader_is_a_crash(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    program = tmp_path / "dies.py"
    program.write_text("import os; os.abort()")
    monkeypatch.setattr(FUZZ, "__file__", str(program))

    code = FUZZ.main(["--target", "pcd", "--runs", "10", "--out", str(tmp_path)])

    assert code == 1
    assert "the process ended with" in capsys.readouterr().out
