"""Simulated drives past a target, with known truth.

`scenario` describes a drive, `terrain` and `worlds` make the ground and the meshes and cast rays at
them, `drives` moves the vehicle, `lidar` takes the scans, `motion` says what IMU, GNSS and odometry
measure, `noise` draws the rest. `recording` has it all in memory, `bag` and `writer` write it down.
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
