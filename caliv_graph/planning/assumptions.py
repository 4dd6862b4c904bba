"""Assumptions of a prediction about how the drive will be recorded and calibrated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from caliv_graph.calibration.problem import HEAVE_SIGMA_M
from caliv_graph.config.model import ExtractionConfig
from caliv_graph.config.range_errors import UNSTATED, RangeErrors
from caliv_graph.products import Guess
from caliv_graph.targets.ground.planes import DISTANCE_FLOOR_M, NORMAL_FLOOR_RAD

Source = Literal["sensors", "poses"]
"""Source of the vehicle's poses: IMU, GNSS and velocity, or given poses."""

Ground = Literal["none", "plane", "height"]
"""Use of the ground: none; a plane of unknown height; one at a known height under the wheels."""


@dataclass(frozen=True)
class Assumptions:
    """How a planned drive will be recorded and calibrated.

    Attributes:
        ground: use of the ground.
        ground_height_sigma_m: sigma of the vehicle's height above ground; None: the scenario's.
        heave_sigma_m: sigma of the heave of the vehicle and its LiDARs at each stamp.
        ground_tilt_sigma_rad: sigma of the plane's normal in one scan, of asphalt. A simulated
            ground is flatter.
        ground_distance_sigma_m: sigma of the LiDAR's distance from the plane in one scan.
        source: source of the poses; None: raw sensors if the scenario has them.
        time_offset: whether a time offset of each LiDAR is estimated.
        extraction: how many points and scans are used.
        ground_everywhere: whether the ground is measured at every scan. `calibrate` measures it
            only at scans that see a target.
        ranges: errors of the ranges that no average removes.
        guesses: LiDAR -> its initial guess, of which the extrinsic plays no part; those that are
            not named have the sigmas of the scenario.
        structure: whether walls count, and the ground cell by cell.
        stride: for a quick prediction, only every n-th cloud is used, with n-fold weight; of each
            LiDAR two stay. Ground without walls is then told by the planes of scans, not cell by
            cell.
    """

    ground: Ground = "height"
    ground_height_sigma_m: float | None = None
    heave_sigma_m: float = HEAVE_SIGMA_M
    ground_tilt_sigma_rad: float = NORMAL_FLOOR_RAD
    ground_distance_sigma_m: float = DISTANCE_FLOOR_M
    source: Source | None = None
    time_offset: bool = False
    extraction: ExtractionConfig = field(default_factory=ExtractionConfig)
    ground_everywhere: bool = False
    ranges: RangeErrors = UNSTATED
    guesses: Mapping[str, Guess] = field(default_factory=dict)
    structure: bool = True
    stride: int = 1
