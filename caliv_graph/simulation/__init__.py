"""Simulated drives past a target, with known truth. README.md has the models.

`rays` casts rays into the world of a scenario, `lidar` takes the scans, `motion` computes the
measurements of IMU, GNSS and odometry, and `noise` draws all other errors. `recording` holds a
drive in memory; `bag`, `caliv_folder` and `writer` write it.
"""

from caliv_graph.scenario.model import Scenario, load_scenario
from caliv_graph.simulation.recording import SimulatedRecording, SimulatedTruth, simulate_drive
from caliv_graph.simulation.simulate import (
    SimulatedDrive,
    SimulatedScans,
    simulate_caliv,
    write_drive,
)

__all__ = [
    "Scenario",
    "SimulatedDrive",
    "SimulatedRecording",
    "SimulatedScans",
    "SimulatedTruth",
    "load_scenario",
    "simulate_caliv",
    "simulate_drive",
    "write_drive",
]
