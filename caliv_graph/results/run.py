"""What a calibration was made from, as far as a report shows it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from caliv_graph.products import (
    Calibration,
    GroundObservation,
    LidarScan,
    Solution,
    TargetObservation,
)
from caliv_graph.trajectory.select import VehicleTrajectory


@dataclass(frozen=True)
class RunRecord:
    """Beside the result and the solved graph.

    Attributes:
        drives: what to call each drive.
        trajectories: one per drive, as they were before any LiDAR had a say.
        grounds: the ground in the scans; empty where it was not used.
        scene: per drive a few thinned clouds, as they were recorded: with the times of their
            points, if the LiDAR tells them.
    """

    drives: tuple[str, ...]
    trajectories: tuple[VehicleTrajectory, ...]
    grounds: tuple[GroundObservation, ...] = ()
    scene: Mapping[int, tuple[LidarScan, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class CalibrationRun:
    """What a run leaves: the result, and what it was made from.

    Attributes:
        calibration: the result to write.
        solution: the solved graph.
        observations: the target's clouds.
        warnings: what a person should know, a line each.
        evidence: what the report shows beside these; None: nothing was kept.
    """

    calibration: Calibration
    solution: Solution
    observations: tuple[TargetObservation, ...]
    warnings: tuple[str, ...]
    evidence: RunRecord | None = None
