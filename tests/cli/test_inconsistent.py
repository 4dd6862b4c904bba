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


SUSPECT = """
from caliv_graph.products import Suspect

def calibrate(recordings, config, progress, prior):
    arm = tuple(config.gnss.lever_arm)
    wrong = arm == (0.0, 0.0, 0.0)
    first = Suspect(
        "gnss.lever_arm", (1.2, 0.3, 0.8), (0.02, 0.02, 0.1), (1.2, 0.3, 0.8), ("m",) * 3, 0.96,
        41.0 if wrong else 0.2, 41.0 if wrong else 0.2,
    )
    said = ("most likely: gnss.lever_arm",) if wrong else ()
    return run_of(
        make_calibration(
            status="inconsistent" if wrong else "ok", contradictions=said, suspects=(first,)
        )
    )
"""


def test_the_first_suspect_is_tried_beside_the_first_run(tmp_path: Path) -> None:
    write_drive(tmp_path / "drive")
    config, out = write_config(tmp_path / "config.yaml"), tmp_path / "out"
    done = called("calibrate", config, "--out", out, "--try-suspects", pipeline=SUSPECT)
    assert done.returncode == 4, done.stderr  # that of the run that was asked for
    assert "Tried: gnss.lever_arm: [1.2, 0.3, 0.8]" in done.stdout
    assert read_calibration(out / "calibration.yaml").status == "inconsistent"
    assert read_calibration(out / "suspect" / "calibration.yaml").status == "ok"
    effective = yaml.safe_load((out / "suspect" / "config.yaml").read_text())
    assert effective["gnss"]["lever_arm"] == [1.2, 0.3, 0.8]
    # Both results are replaced together.
    again = called("calibrate", config, "--out", out, "--force", pipeline=SUSPECT)
    assert again.returncode == 4, again.stderr
    assert not (out / "suspect").exists()
