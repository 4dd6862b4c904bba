"""A finished run: the result, and the inputs that the report shows."""

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
    """The inputs of a run that the report shows, beside the result and the solved graph.

    Attributes:
        drives: the name of each drive.
        trajectories: one per drive, smoothed without any LiDAR data.
        grounds: the ground in the scans; empty if the ground was not used.
        scene: per drive a few thinned clouds as recorded, with the times of their points if the
            LiDAR records them.
    """

    drives: tuple[str, ...]
    trajectories: tuple[VehicleTrajectory, ...]
    grounds: tuple[GroundObservation, ...] = ()
    scene: Mapping[int, tuple[LidarScan, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class CalibrationRun:
    """The result of a run, and its inputs; `record` has those that only the report shows."""

    calibration: Calibration
    solution: Solution
    observations: tuple[TargetObservation, ...]
    record: RunRecord | None = None
