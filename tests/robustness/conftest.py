from __future__ import annotations

from pathlib import Path

import pytest

from tests.robustness.hostile_drives import simulate


@pytest.fixture(scope="session")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small drive: never to be written to."""
    return simulate(tmp_path_factory.mktemp("robustness") / "drive")


@pytest.fixture(scope="session")
def result(drive: Path) -> Path:
    """A calibration of the small drive."""
    from tests.robustness.hostile_drives import command

    out = drive.parent / "result"
    done = command("calibrate", drive / "config.yaml", "--out", out)
    assert done.code == 0, done.err
    return out
