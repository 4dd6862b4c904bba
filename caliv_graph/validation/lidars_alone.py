"""A drive without motion data: the alignment along the odometry of one of its LiDARs.

The odometry of a LiDAR tells nothing of where that LiDAR is on the vehicle. Guesses and calibration
are moved, all LiDARs together, to where the odometry has it: what is left to validate is S2S.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from caliv_graph.common.progress import Progress
from caliv_graph.config.guesses import with_guess
from caliv_graph.config.model import Config
from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.covariance import about_one_jacobian
from caliv_graph.geometry.se3 import unstack
from caliv_graph.odometry.run import with_odometry
from caliv_graph.products import (
    Array,
    Calibration,
    IntArray,
    LidarResult,
    MotionData,
    Recording,
    Trajectory,
)
from caliv_graph.structure.elimination import covariance_of
from caliv_graph.structure.solve import Solved
from caliv_graph.trajectory.odometry import OdometryPoses
from caliv_graph.trajectory.select import GivenTrajectory, VehicleTrajectory
from caliv_graph.validation.clouds import choose_scans
from caliv_graph.validation.held_out import HeldOutOutcome


@dataclass(frozen=True)
class Way:
    """The vehicle's poses at the scans that are measured.

    Attributes:
        trajectory: of the vehicle.
        chosen: LiDAR -> stamps of the scans to read, within it.
        covariance: times (S,) of scans -> (6 S, 6 S) joint covariance of the poses there, right
            perturbations.
    """

    trajectory: VehicleTrajectory
    chosen: Mapping[str, IntArray]
    covariance: Callable[[IntArray], Array]


@dataclass(frozen=True)
class LidarsAlone:
    """A drive without motion data, about the LiDAR that is tracked.

    Attributes:
        lidar: its name.
        motion: poses by its odometry.
        config: LiDARs to validate, with their guesses about it; no target.
        calibration: the same LiDARs about it, with the covariance of their places to it.
    """

    lidar: str
    motion: MotionData
    config: Config
    calibration: Calibration


def about_tracked(
    recording: Recording,
    names: Sequence[str],
    calibration: Calibration,
    config: Config,
    motions: Mapping[int, MotionData],
    progress: Progress,
) -> LidarsAlone:
    """The odometry that `calibrate` makes, and everything about the LiDAR that it tracks.

    Args:
        recording: the drive.
        names: LiDARs to validate, all with a guess.
        calibration: has them.
        config: has them.
        motions: motion data of the drive, 0 its index; none tell the motion.
        progress: reports the stage.

    Raises:
        ConfigError: the config asks for what cannot be had without motion data.
        TrajectoryError: no LiDAR can be tracked.
        RecordingError: a cloud could not be read.
    """
    lidars = {name: config.lidars[name] for name in names}
    reference = config.reference if config.reference in lidars else names[0]
    config = config.model_copy(update={"lidars": lidars, "reference": reference})
    told, _, _ = with_odometry([recording], config, motions, progress)
    poses = told[0].poses
    assert isinstance(poses, OdometryPoses)
    tracked, T = poses.lidar, poses.T_vehicle_lidar
    # Clouds of a target have no pose that is known without them: `calibrate` uses none either.
    moved = config.model_copy(update={"target": False})
    to_guess = T.compose(config.lidars[tracked].guess().inverse())
    for name in names:
        moved = with_guess(moved, name, to_guess.compose(config.lidars[name].guess()))
    return LidarsAlone(tracked, told[0], moved, _about(calibration, tracked, T, names))


def _about(
    calibration: Calibration, tracked: str, T_vehicle_tracked: gtsam.Pose3, names: Sequence[str]
) -> Calibration:
    """Some LiDARs of a calibration, one of them held at a pose, the others to it as they were."""
    every = list(calibration.lidars)
    results = [calibration.lidars[name] for name in names]
    rows = [6 * every.index(name) + axis for name in names for axis in range(6)]
    J = about_one_jacobian([r.T_vehicle_lidar for r in results], names.index(tracked))
    cov = J @ calibration.cov_joint[np.ix_(rows, rows)] @ J.T
    own = calibration.lidars[tracked]
    away = T_vehicle_tracked.compose(own.T_vehicle_lidar.inverse())
    lidars = {
        name: replace(
            result,
            T_vehicle_lidar=away.compose(result.T_vehicle_lidar),
            cov=cov[6 * i : 6 * i + 6, 6 * i : 6 * i + 6],
            time_offset=_offset_to(result, own),
        )
        for i, (name, result) in enumerate(zip(names, results, strict=True))
    }
    return replace(calibration, lidars=lidars, cov_joint=0.5 * (cov + cov.T))


def _offset_to(result: LidarResult, tracked: LidarResult) -> tuple[float, float] | None:
    """The time offset of a LiDAR against the tracked one, whose clock the poses have."""
    if result is tracked or (result.time_offset is None and tracked.time_offset is None):
        return None
    own, other = result.time_offset or (0.0, 0.0), tracked.time_offset or (0.0, 0.0)
    return own[0] - other[0], float(np.hypot(own[1], other[1]))


def way_of(
    drive: str, names: Sequence[str], odometry: VehicleTrajectory, outcome: HeldOutOutcome
) -> Way:
    """The poses that the structure has that is not held out, at its scans.

    The odometry itself drifts by what no covariance tells.

    Args:
        drive: its name, for the message.
        names: the LiDARs.
        odometry: the trajectory that the solve began with.
        outcome: the solve of that structure.

    Raises:
        TrajectoryError: there is no such solve.
    """
    used = outcome.used
    if used is None:
        raise TrajectoryError(
            f"{drive}: without motion data only structure validates. {' '.join(outcome.sentences)} "
            "Give --data a longer drive past walls of two directions, or one with motion data"
        )
    trajectory, stamps = _solved_way(odometry, used), used.problem.patches.stamps_ns
    scan_lidar = used.problem.patches.scan_lidar
    index = {name: i for i, name in enumerate(used.problem.patches.lidars)}
    chosen = {
        name: choose_scans(np.unique(stamps[scan_lidar == index[name]]).tolist(), trajectory)
        for name in names
    }
    return Way(trajectory, chosen, lambda taken_ns: _pose_covariance(used, taken_ns))


def _solved_way(odometry: VehicleTrajectory, used: Solved) -> GivenTrajectory:
    """The odometry, moved at the scans to the poses of the solve and evenly in between."""
    own = used.problem.prior.stamps_ns
    before = unstack(*odometry.poses_at(own))
    after = unstack(used.state.R_map_vehicle, used.state.t_map_vehicle)
    away = np.array([gtsam.Pose3.Logmap(a.between(b)) for a, b in zip(before, after, strict=True)])
    stamps = np.union1d(odometry.trajectory.stamps_ns, own)
    s, own_s = 1e-9 * (stamps - own[0]), 1e-9 * (own - own[0])
    steps = np.stack([np.interp(s, own_s, axis) for axis in away.T], axis=1)
    poses = zip(unstack(*odometry.poses_at(stamps)), steps, strict=True)
    moved = tuple(T.compose(gtsam.Pose3.Expmap(d)) for T, d in poses)
    return GivenTrajectory(Trajectory(stamps, moved))


def _pose_covariance(used: Solved, taken_ns: IntArray) -> Array:
    """(6 S, 6 S) of the poses of the solve nearest to some times (S,), right perturbations."""
    own = used.problem.prior.stamps_ns
    after = np.clip(np.searchsorted(own, taken_ns), 1, len(own) - 1)
    at = after - (taken_ns - own[after - 1] < own[after] - taken_ns)
    poses, inverse = np.unique(at, return_inverse=True)
    cov = covariance_of(used.factor, (6 * poses[:, None] + np.arange(6)).ravel())
    rows = (6 * inverse.ravel()[:, None] + np.arange(6)).ravel()
    return np.asarray(0.5 * (cov + cov.T)[np.ix_(rows, rows)])
