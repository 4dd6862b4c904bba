"""The walls of a recorded drive, solved for the prediction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from caliv_graph.calibration.noise import first_pose_noise
from caliv_graph.calibration.pose_priors import pose_priors
from caliv_graph.calibration.sensor_noise import usual_noise
from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config
from caliv_graph.errors import SolveError
from caliv_graph.geometry.se3 import unstack
from caliv_graph.planning.recorded_walls import RecordedWalls
from caliv_graph.products import Recording
from caliv_graph.structure.noise import range_sigmas
from caliv_graph.structure.own_body import without_own_body
from caliv_graph.structure.read import level, read_patches
from caliv_graph.structure.solve import solve_structure
from caliv_graph.structure.term import aligned_start, problem_of, usable
from caliv_graph.trajectory.select import VehicleTrajectory, sharing_poses, smooth_trajectories


@dataclass(frozen=True)
class SolvedWalls:
    """What the walls of a recorded drive tell of it.

    Attributes:
        walls: for the prediction.
        T_vehicle_lidar: the mountings at which their pieces join, in the frame of the recording.
    """

    walls: RecordedWalls
    T_vehicle_lidar: Mapping[str, gtsam.Pose3]


def uses_walls(config: Config) -> bool:
    """Whether `calibrate` uses structure; the paper's procedure does without."""
    return config.structure.use and config.solve.mode != "staged"


def solved_walls(
    recording: Recording,
    rough: VehicleTrajectory,
    config: Config,
    begin_ns: int,
    height_m: float,
    progress: Progress,
) -> SolvedWalls | None:
    """The walls and the ground of a drive; None if it passes no walls, or none are to be used.

    Args:
        recording: the drive.
        rough: its trajectory.
        config: with a guess of every LiDAR.
        begin_ns: stamp that is the start of the drive.
        height_m: of the vehicle frame above ground.
        progress: reports the stages.

    Raises:
        RecordingError: a cloud could not be read.
        TrajectoryError: the motion data are unusable.
    """
    if not uses_walls(config):
        return None
    motions = {0: recording.motion()}
    recording = sharing_poses(recording, motions[0], config)
    (patches,) = read_patches([recording], [rough], config, progress, keep_level=True)
    patches, _ = without_own_body(patches, rough, config)
    if not len(patches.scan):
        return None
    with progress.stage("joining the walls", None):
        stamps = np.unique(patches.stamps_ns)
        (trajectory,) = smooth_trajectories([recording], config, [stamps], motions, [rough])
        heave_m = usual_noise(config.noise).heave_m
        noise = first_pose_noise(config.noise)
        priors = pose_priors([trajectory], {0: stamps}, heave_m, noise, config)
        guesses = {name: lidar.guess() for name, lidar in config.lidars.items()}
        start = aligned_start([patches], [trajectory], guesses, config)
        patches = usable(patches, trajectory, start, config)
        try:
            problem = problem_of(patches, priors[0], trajectory, config, heave_m, {})
            found = solve_structure(problem, start)
        except SolveError:
            return None
        if found is None:
            return None
        T = dict(zip(patches.lidars, found.state.T_vehicle_lidar, strict=True))
        own = level(patches, trajectory, T)
        on_wall = (found.strips.of_patch >= 0) & ~own
        if not on_wall.any():
            return None
        walls = RecordedWalls.of(
            patches,
            own,
            trajectory,
            (stamps, unstack(found.state.R_map_vehicle, found.state.t_map_vehicle)),
            (found.levels(), range_sigmas(patches, config.noise.lidar_range_m)),
            begin_ns,
            height_m,
        )
    return SolvedWalls(walls, T)
