"""Errors of the angular velocity within sweeps: white noise of the gyroscope (`README.md`, 6b).

Points taken tau after the stamp are moved there by the gyroscope, whose angle walks at random, or
by rates that nothing measures: all strips that a scan sees are turned by as much, in proportion to
their times. LiDARs that sweep together turn alike.
"""

from __future__ import annotations

import numpy as np

from caliv_graph.products import Array, IntArray
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.trajectory.rates import turn_variances
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory

LEAST_S = 1e-3
"""Shortest sweep: one that is shorter turns nothing."""


def turn_sigmas(
    patches: DrivePatches, pose_of_scan: IntArray, trajectory: VehicleTrajectory
) -> Array:
    """(P, 3) rad/s, vehicle axes, for the P poses with a scan; empty where nothing sweeps."""
    if not patches.swept_scans.any() or not isinstance(trajectory, SmoothedTrajectory):
        return np.zeros((0, 3))
    poses, number = np.unique(pose_of_scan, return_inverse=True)
    longest = np.full(len(poses), LEAST_S)
    np.maximum.at(longest, number.ravel()[patches.scan], np.abs(patches.time_s))
    # The angle has the variance q tau; a constant error w of the rate makes it w^2 tau^2. Over 0 to
    # T their means are the same at w^2 = 3 q / (2 T).
    walk, constant = turn_variances(trajectory)
    return np.asarray(np.sqrt(1.5 * walk / longest[:, None] + constant))
