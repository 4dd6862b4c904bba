"""A trajectory from the given poses of a recording."""

from __future__ import annotations

from caliv_graph.errors import TrajectoryError
from caliv_graph.products import MotionData, Trajectory


def given_trajectory(motion: MotionData) -> Trajectory:
    """The given vehicle poses of a drive, as a trajectory.

    Raises:
        TrajectoryError: it has fewer than two poses.
    """
    poses = motion.poses
    if poses is None:
        raise TrajectoryError(f"{motion.name}: has no vehicle poses")
    if len(poses.stamps_ns) < 2:
        raise TrajectoryError(
            f"{motion.name}: {len(poses.stamps_ns)} vehicle pose(s), needs at least 2"
        )
    return Trajectory(poses.stamps_ns, poses.T_map_vehicle)
