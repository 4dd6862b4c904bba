"""Drives whose heading drifts: linearised where walls put the vehicle (`README.md`, section 18).

Without fixes or orientations the bias of the gyroscope turns the heading by tenths of a radian
within a minute. Velocities turn with it, and a Gaussian on poses does not know.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from caliv_graph.calibration.structure_evidence import (
    NOTHING_TOLD,
    StructureEvidence,
    ToldErrors,
)
from caliv_graph.config.model import Config
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.about_poses import about_poses
from caliv_graph.trajectory.imu import log_so3
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.solve import LONE_YAW_SIGMA_RAD, without_heading

DRIFT_SIGMA_RAD = 0.02
"""1 sigma of the heading, relative to the start, from which motion data are linearised where walls
put the vehicle: by then lengths err by 2e-4 of themselves, a velocity of 2 m/s by 0.4 mm/s."""

LEFT_RAD = 0.005
"""Turn of a pose from where the motion data were linearised at which they stay."""

ROUNDS = 8
"""Times at most that they are linearised anew: one makes 1 mrad of a heading 0.1 rad off; with few
walls it takes three or four."""


def about_walls(
    trajectories: Sequence[VehicleTrajectory],
    structure: StructureEvidence,
    start: Mapping[str, gtsam.Pose3],
    held: Mapping[str, gtsam.Pose3],
    config: Config,
) -> tuple[tuple[VehicleTrajectory, ...], ToldErrors]:
    """Trajectories whose heading drifts, linearised anew; the others stay as they are.

    Args:
        trajectories: one per drive, with nodes at the stamps of the patches.
        structure: what the LiDARs see beside target and ground.
        start: rough T_vehicle_lidar of every LiDAR.
        held: those of LiDARs that a target has placed.
        config: guesses and noise.

    Returns:
        The trajectories; and where the strips lie on each other, of errors nothing.

    Raises:
        SolveError: structure could not be solved.
        TrajectoryError: a heading is uncertain, and no structure tells it, or never the same.
    """
    now, told = list(trajectories), NOTHING_TOLD
    left = {drive for drive, trajectory in enumerate(now) if _drifts(trajectory)}
    untold = set(range(len(now)))
    for _ in range(ROUNDS):
        found, stamps_ns = structure.poses(now, left, start, held, config)
        if found.T_vehicle_lidar is None:
            break
        told, start, left = found, found.T_vehicle_lidar, set()
        untold -= stamps_ns.keys()
        for drive, stamps in stamps_ns.items():
            trajectory, (T, sigmas) = now[drive], found.of_drives[drive]
            assert isinstance(trajectory, SmoothedTrajectory)
            if np.median(sigmas) > LONE_YAW_SIGMA_RAD:  # ground, say, tells no heading
                untold.add(drive)
            elif _turned_rad(trajectory, stamps, T[:, :3, :3]) > LEFT_RAD:
                now[drive] = about_poses(trajectory, stamps, T[:, :3, :3], T[:, :3, 3])
                left.add(drive)
    for drive in sorted(untold | left):
        trajectory = now[drive]
        if isinstance(trajectory, SmoothedTrajectory) and trajectory.heading_is_wide:
            sigma_rad = trajectory.heading_sigma_rad
            raise without_heading(trajectory.data, sigma_rad, walls=_drifts(trajectory))
    return tuple(now), replace(told, of_drives={})


def _drifts(trajectory: VehicleTrajectory) -> bool:
    """Whether motion data, without fixes or orientations, leave the heading of a drive wide."""
    return (
        isinstance(trajectory, SmoothedTrajectory)
        and not (trajectory.correlated or trajectory.open_kinds)
        and trajectory.heading_sigma_rad > DRIFT_SIGMA_RAD
    )


def _turned_rad(trajectory: SmoothedTrajectory, stamps_ns: IntArray, R_map_vehicle: Array) -> float:
    """Largest turn of the vehicle from the poses of a trajectory to others (m, 3, 3)."""
    before, _ = trajectory.poses_at(stamps_ns)
    turns = log_so3(np.swapaxes(before, 1, 2) @ R_map_vehicle)
    return float(np.linalg.norm(turns, axis=1).max())
