"""Trajectories from poses that came with the recording."""

from __future__ import annotations

from collections.abc import Sequence

from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Recording, Trajectory


def given_trajectories(recordings: Sequence[Recording]) -> tuple[Trajectory, ...]:
    """The given vehicle poses of each drive, as a trajectory.

    Raises:
        TrajectoryError: a recording has fewer than two poses.
        RecordingError: its poses could not be read.
    """
    out = []
    for recording in recordings:
        poses = recording.motion().poses
        if poses is None:
            raise TrajectoryError(f"{recording.name}: has no vehicle poses")
        if len(poses.stamps_ns) < 2:
            raise TrajectoryError(
                f"{recording.name}: {len(poses.stamps_ns)} vehicle pose(s), needs at least 2"
            )
        out.append(Trajectory(poses.stamps_ns, poses.T_map_vehicle))
    return tuple(out)
