"""truth.yaml: the true extrinsics of a simulated drive, or those of another program."""

from __future__ import annotations

from pathlib import Path

import gtsam

from caliv_graph.config.load import read_yaml, validated
from caliv_graph.results.model import TruthModel


def read_truth(path: Path) -> dict[str, gtsam.Pose3]:
    """Reads true `T_vehicle_lidar` per LiDAR from truth.yaml.

    A calibration.yaml serves as well: another calibration, taken for the truth.

    Raises:
        ConfigError: it is missing, or a field is not what it should be.
    """
    expected = "truth: expected the key 'lidars'"
    truth = validated(TruthModel, read_yaml(path), str(path), expected)
    return {name: lidar.T_vehicle_lidar.pose() for name, lidar in truth.lidars.items()}
