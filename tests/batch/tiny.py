"""Drives that are simulated, and calibrated for real, in about a second each."""

from __future__ import annotations

from pathlib import Path

import yaml

from caliv_graph.simulation import simulate_caliv
from tests.drives_with_chair import paper_scenario


def tiny_drive(folder: Path, seed: int) -> Path:
    """A CaLiV folder with a few coarse clouds, and its config.

    Returns:
        The config; what it asks for is little enough to be reached.
    """
    scenario = paper_scenario(rate_hz=1.0, position_sigma_m=0.005, rotation_sigma_rad=0.001)
    coarse = {
        name: lidar.model_copy(update={"channels": 76, "horizontal_resolution_deg": 0.36})
        for name, lidar in scenario.lidars.items()
    }
    simulate_caliv(scenario.model_copy(update={"lidars": coarse}), folder, seed, threads=1)
    path = folder / "config.yaml"
    document = yaml.safe_load(path.read_text())
    document |= {
        "extraction": {"min_points": 20, "min_scans": 4},
        "ground": {"use": False},
        "registration": {"components": 100, "max_iterations": 24, "max_points": 150},
        "require": [],
        "solve": {"mode": "staged"},
    }
    path.write_text(yaml.safe_dump(document))
    return path
