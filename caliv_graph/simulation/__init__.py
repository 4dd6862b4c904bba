"""Simulated drives past a target, with known truth.

`scenario` describes a drive, `worlds` makes the meshes and casts rays at them, `drives` moves the
vehicle, `lidar` takes the scans, `noise` draws everything else, `writer` writes it down.
"""

from caliv_graph.simulation.scenario import Scenario, load_scenario
from caliv_graph.simulation.simulate import SimulatedDrive, SimulatedScans, simulate_caliv

__all__ = ["Scenario", "SimulatedDrive", "SimulatedScans", "load_scenario", "simulate_caliv"]
