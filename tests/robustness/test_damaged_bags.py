"""Bags that are cut off, or have bits flipped, from the command line to the result."""

from __future__ import annotations

import random
import shutil
from pathlib import Path

import pytest

from tests.robustness.hostile_drives import check_sound, command, write_config


def damaged(drive: Path, folder: Path) -> Path:
    """The bag's file alone, in a folder of its own."""
    return Path(shutil.copy(drive / "drive" / "drive.mcap", folder / "drive.mcap"))


def flip(path: Path, seed: int, count: int) -> None:
    rng = random.Random(seed)
    data = bytearray(path.read_bytes())
    for _ in range(count):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    path.write_bytes(data)


@pytest.mark.parametrize("seed", range(6))
def test_looking_at_a_bag_with_flipped_bits(seed: int, drive: Path, tmp_path: Path) -> None:
    path = damaged(drive, tmp_path)
    flip(path, seed, 1 if seed % 2 else 100)

    done = command("inspect", path)

    assert done.code in (0, 2), done.err
    assert "Traceback" not in done.err
    if done.code == 2:
        assert len(done.err.splitlines()) == 1


@pytest.mark.parametrize("part", [0.0, 1e-5, 0.2, 0.7, 0.999, 0.99999])
def test_a_bag_that_is_cut_off(part: float, drive: Path, tmp_path: Path) -> None:
    path = damaged(drive, tmp_path)
    with path.open("r+b") as file:
        file.truncate(int(part * path.stat().st_size))
    config = write_config(drive, tmp_path / "config.yaml", data__path=str(path))

    done = command("calibrate", config, "--out", tmp_path / "out")

    assert done.code == 2
    assert str(path) in done.err
    check_sound(done, tmp_path / "out", drive / "truth.yaml")


@pytest.mark.parametrize(("seed", "count"), [(2, 1000)])
def test_calibrating_from_a_bag_with_flipped_bits(
    seed: int, count: int, drive: Path, tmp_path: Path
) -> None:
    path = damaged(drive, tmp_path)
    flip(path, seed, count)
    config = write_config(drive, tmp_path / "config.yaml", data__path=str(path))

    done = command("calibrate", config, "--out", tmp_path / "out")

    check_sound(done, tmp_path / "out", drive / "truth.yaml")
