"""The same bytes from the same drive, whatever the number of cores and threads."""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType

import pytest
import yaml

from tests.batch.tiny import tiny_drive

ROOT = Path(__file__).resolve().parents[2]


def load() -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        "check_reproducible", ROOT / "scripts" / "check_reproducible.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


CHECK = load()


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cannot choose cores")
def test_the_same_bytes_on_one_and_on_two_cores(tmp_path: Path) -> None:
    """One thread, and as many as the libraries like: with two, BLAS sums in another order."""
    if len(os.sched_getaffinity(0)) < 2:
        pytest.skip("has one core")
    config = tiny_drive(tmp_path / "drive", 1)
    # By all stages that it has, with arrays that BLAS shares out.
    document = yaml.safe_load(config.read_text())
    del document["solve"], document["ground"]
    document["registration"] = {"components": 80, "max_iterations": 30, "max_points": 100}
    config.write_text(yaml.safe_dump(document))
    options = argparse.Namespace(scenario=None, config=config, data=None, seed=1)
    one, _, _, _, two, _ = CHECK.SETTINGS
    assert (one.cores, one.threads, two.cores, two.threads) == (1, 1, 2, 2)
    found = []
    for setting in (one, two):
        place = tmp_path / setting.name
        place.mkdir()
        found.append(CHECK.run(setting, place, options).digests)

    assert found[0] == found[1]
    assert set(found[0]) == {"calibration.yaml", "target.ply"}


def test_a_difference_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(setting: object, place: Path, options: argparse.Namespace) -> object:
        return CHECK.Found({"calibration.yaml": place.name}, 1.0)

    monkeypatch.setattr(CHECK, "run", run)

    assert CHECK.main(["--data", str(tmp_path)]) == (len(os.sched_getaffinity(0)) > 0)


def test_only_the_stamp_may_differ(tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    digests = []
    for stamp, sigma in (("2026-11-21", 1), ("2026-11-22", 1), ("2026-11-21", 2)):
        path.write_text(yaml.safe_dump({"provenance": {"stamp": stamp}, "sigma": sigma}))
        digests.append(CHECK.without_stamp(path))

    assert digests[0] == digests[1] != digests[2]
