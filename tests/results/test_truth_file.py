from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from caliv_graph.errors import ConfigError
from caliv_graph.results.calibration_file import write_calibration
from caliv_graph.results.truth_file import read_truth
from tests.samples import make_calibration


def test_truth_in_the_form_of_the_specification(tmp_path: Path) -> None:
    path = tmp_path / "truth.yaml"
    path.write_text(
        "lidars:\n"
        "  front: {T_vehicle_lidar: {translation: [2, 0, 1.5], quaternion_xyzw: [0, 0, 1, 0]},"
        " time_offset: 0.01}\n"
    )

    truth = read_truth(path)

    assert list(truth) == ["front"]
    # Turned by 180 degrees about z, a point ahead of the LiDAR is behind it.
    assert truth["front"].transformFrom(np.array([1.0, 0.0, 0.0])) == pytest.approx([1.0, 0, 1.5])


def test_a_calibration_serves_as_truth(tmp_path: Path) -> None:
    write_calibration(make_calibration(), tmp_path / "calibration.yaml")

    truth = read_truth(tmp_path / "calibration.yaml")

    for name, result in make_calibration().lidars.items():
        assert truth[name].equals(result.T_vehicle_lidar, 1e-11)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", ": holds no truth: expected the key 'lidars'"),
        ("lidars: {}", ": 'lidars': must have 1 or more items, has 0"),
        ("lidars: {front: {}}", ": 'lidars.front.T_vehicle_lidar' is missing"),
        (
            "lidars: {front: {T_vehicle_lidar: {translation: [0, 0, 0], "
            "quaternion_xyzw: [0.1, 0, 0, 1]}}}",
            ": 'lidars.front.T_vehicle_lidar.quaternion_xyzw': must have norm 1 within 0.001, has "
            "1.00499",
        ),
        ("lidars: [", ": not valid YAML in line "),
    ],
)
def test_a_truth_that_is_none(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "truth.yaml"
    path.write_text(text)

    with pytest.raises(ConfigError) as caught:
        read_truth(path)

    assert str(caught.value).startswith(f"{path}{message}")


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        read_truth(tmp_path / "nowhere.yaml")
