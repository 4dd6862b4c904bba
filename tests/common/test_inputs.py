"""What stands where a file should be: folders, pipes, devices, far too large ones."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from caliv_graph.common.inputs import read_input
from caliv_graph.config.load import load_config
from caliv_graph.errors import CalivError
from caliv_graph.export.edit import read_base
from caliv_graph.readers.bag import Bag
from caliv_graph.readers.frames import read_urdf
from caliv_graph.readers.pcd import read_pcd
from caliv_graph.results.calibration_file import read_calibration
from caliv_graph.results.truth_file import read_truth
from caliv_graph.scenario.model import load_scenario

READERS: dict[str, Callable[[Path], object]] = {
    "config.yaml": load_config,
    "scenario.yaml": load_scenario,
    "calibration.yaml": read_calibration,
    "truth.yaml": read_truth,
    "0.pcd": read_pcd,
    "vehicle.urdf": read_urdf,
    "old.yaml": read_base,
    "drive.mcap": Bag,
    "drive.bag": Bag,
}


@pytest.fixture(params=READERS)
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return tmp_path / str(request.param)


def refusal(path: Path) -> str:
    with pytest.raises(CalivError) as caught:
        READERS[path.name](path)
    return str(caught.value)


def test_a_pipe_is_not_waited_for(place: Path) -> None:
    """Nobody writes to it: to open it would never come back."""
    os.mkfifo(place)

    assert "is a pipe or a device" in refusal(place)


def test_a_device_is_not_read(place: Path) -> None:
    place.symlink_to("/dev/zero")

    assert "is a pipe or a device" in refusal(place)


def test_a_folder_and_nothing(place: Path) -> None:
    assert str(place) in refusal(place)
    place.mkdir()
    assert str(place) in refusal(place)


def test_a_recording_that_is_given_for_a_config_is_not_read_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    with path.open("wb") as file:
        file.truncate(20 * 1024**3)  # a file of holes takes no room

    assert "has 21475 MB, expected at most 200 MB" in refusal(path)


def test_a_file_is_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"12345")

    assert read_input(path, 5) == b"12345"
    with pytest.raises(OSError, match="expected at most"):
        read_input(path, 4)
