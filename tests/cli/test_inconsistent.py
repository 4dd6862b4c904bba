"""`calibrate` on data that contradict each other: exit 4, and a sentence that says what does."""

from __future__ import annotations

import json
from pathlib import Path

import yaml

from caliv_graph.results.calibration_file import read_calibration
from tests.cli.commands import called, write_config, write_drive

SENTENCE = "lidar 'front': its stamps and the motion of the vehicle contradict each other"

INCONSISTENT = f"""
def calibrate(recordings, config, progress, prior):
    return run_of(
        make_calibration(
            status="inconsistent", contradictions=({SENTENCE!r},), unmet=("asked for, not had",)
        )
    )
"""


def test_a_contradiction_is_exit_4_even_if_something_was_not_reached(tmp_path: Path) -> None:
    write_drive(tmp_path / "drive")
    config = write_config(tmp_path / "config.yaml")
    done = called("calibrate", config, "--out", tmp_path / "out", pipeline=INCONSISTENT)
    assert done.returncode == 4, done.stderr
    assert SENTENCE in done.stderr
    assert "Contradictions:" in done.stdout
    written = yaml.safe_load((tmp_path / "out" / "calibration.yaml").read_text())
    assert written["status"] == "inconsistent"
    assert written["contradictions"] == [SENTENCE]
    assert read_calibration(tmp_path / "out" / "calibration.yaml").contradictions == (SENTENCE,)
    assert SENTENCE in (tmp_path / "out" / "log.jsonl").read_text()


def test_json_has_the_contradictions(tmp_path: Path) -> None:
    write_drive(tmp_path / "drive")
    config = write_config(tmp_path / "config.yaml")
    out = tmp_path / "out"
    done = called("calibrate", config, "--out", out, "--json", pipeline=INCONSISTENT)
    assert done.returncode == 4
    document = json.loads(done.stdout)
    assert document["contradictions"] == [SENTENCE]
    assert SENTENCE in document["warnings"]
