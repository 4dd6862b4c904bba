"""Given poses of a simulated drive, with errors that are drawn."""

from __future__ import annotations

import numpy as np

from caliv_graph.products import Array, GivenPoses, IntArray
from caliv_graph.simulation.recording import SimulatedRecording

PERIOD_NS = 20_000_000
"""Between given poses: 50 Hz."""


def stamps_of(drive: SimulatedRecording, period_ns: int = PERIOD_NS) -> IntArray:
    """(n,) stamps of the given poses."""
    return np.arange(drive.truth.start_ns, drive.truth.end_ns, period_ns)


def given_poses(
    drive: SimulatedRecording, errors: Array, late_ns: int = 0, period_ns: int = PERIOD_NS
) -> GivenPoses:
    """True poses with errors (n, 6), right perturbations, and stamps that are late."""
    stamps = stamps_of(drive, period_ns)
    truth = drive.truth.T_map_vehicle(stamps)
    poses = [T.retract(e) for T, e in zip(truth, errors, strict=True)]
    return GivenPoses(stamps + late_ns, tuple(poses))
