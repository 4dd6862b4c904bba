"""A trajectory from the given poses of a recording, with the covariances of their messages."""

from __future__ import annotations

import numpy as np

from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, IntArray, MotionData, Trajectory
from caliv_graph.trajectory.noise import stated


def given_trajectory(motion: MotionData) -> Trajectory:
    """The given vehicle poses of a drive, as a trajectory; `cov` as the messages state it.

    Raises:
        TrajectoryError: it has fewer than two poses.
    """
    poses = motion.poses
    if poses is None:
        raise TrajectoryError(f"{motion.name}: has no vehicle poses. Set topics.pose or data.poses")
    if len(poses.stamps_ns) < 2:
        raise TrajectoryError(
            f"{motion.name}: {len(poses.stamps_ns)} vehicle pose(s), needs at least 2. "
            "Choose another topics.pose or data.poses"
        )
    return Trajectory(poses.stamps_ns, poses.T_map_vehicle, poses.cov)


def error_covariances(trajectory: Trajectory, stamps_ns: IntArray) -> Array | None:
    """Covariances of the errors of given poses as their messages state them, at stamps (m,).

    Between two poses they are interpolated linearly (`README.md`, section 11).

    Returns:
        (m, 6, 6) of the rotation in vehicle axes (rad), then the position in map axes (m); NaN
        where unknown. None: no message states one.
    """
    if trajectory.cov is None:
        return None
    known = stated(trajectory.cov)
    if not known.any():
        return None
    R, _ = stack(trajectory.T_map_vehicle)
    A = np.tile(np.eye(6), (len(R), 1, 1))
    A[:, 3:, 3:] = R
    cov = np.full_like(trajectory.cov, np.nan)
    cov[known] = (A @ trajectory.cov @ np.swapaxes(A, 1, 2))[known]
    after = np.clip(np.searchsorted(trajectory.stamps_ns, stamps_ns), 1, len(R) - 1)
    before = after - 1
    begin, end = trajectory.stamps_ns[before], trajectory.stamps_ns[after]
    s = ((stamps_ns - begin) / (end - begin))[:, None, None]
    # At a pose itself its neighbour does not matter, be it unknown.
    return np.where(
        s == 0.0,
        cov[before],
        np.where(s == 1.0, cov[after], (1.0 - s) * cov[before] + s * cov[after]),
    )
