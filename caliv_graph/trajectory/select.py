"""The trajectory of each drive: smoothed from raw sensors, or the given poses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import gtsam
import numpy as np

from caliv_graph.config.model import Config
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.interpolation import PoseCurve
from caliv_graph.geometry.se3 import stack, unstack
from caliv_graph.products import Array, IntArray, MotionData, Recording, Trajectory
from caliv_graph.readers.common_stamps import COMMON_NS, MERGE_NS, with_common_stamps
from caliv_graph.trajectory.given import (
    error_covariances,
    given_trajectory,
    rare_poses,
    slow_errors_stated,
)
from caliv_graph.trajectory.noise import stated
from caliv_graph.trajectory.odometry import OdometryPoses
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory, within_span
from caliv_graph.trajectory.solve import without_heading

TWIST_WINDOW_NS = 50_000_000
"""Half the time over which the vehicle's velocity is averaged: that of a sweep at 10 Hz."""

GIVEN_WINDOW_NS = 250_000_000
"""The same of given poses, whose noise is in it. A late clock moves poses along the velocity. Noise
in that does not go with the slow errors of the poses, which take up most of what the clock does:
over 0.1 s it made 10 ms look like 9, and told 17 ms at 6 sigma where the clocks of a slow robot
were right."""


class VehicleTrajectory(Protocol):
    """The interface of every trajectory, smoothed or given."""

    @property
    def trajectory(self) -> Trajectory:
        """Poses at the wanted stamps (smoothed), or at the stamps of the given poses."""

    @property
    def lost_ns(self) -> tuple[int, ...]:
        """Wanted stamps outside the span."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """For the user, a line each."""

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last stamp at which there is a pose."""

    def poses_at(self, stamps_ns: Sequence[int] | IntArray) -> tuple[Array, Array]:
        """R_map_vehicle (m, 3, 3) and t_map_vehicle (m, 3) at any times within the span."""


@dataclass(frozen=True)
class GivenTrajectory:
    """Given poses, and a smooth curve between them (`geometry.interpolation`).

    Attributes:
        trajectory: the poses at their own stamps, and the covariances that their messages state.
        lost_ns: wanted stamps outside their span.
        warnings: a line each.
        odometry: the poses, if the odometry of a LiDAR gave them: then they are no evidence of
            where a LiDAR is on the vehicle. None: they came with the recording.
        slow_stated: 1 sigma per axis of the slow errors of rotation (rad) and position (m) that
            their messages state in the place of white ones (`given.SlowStated`); None: neither.
    """

    trajectory: Trajectory
    lost_ns: tuple[int, ...] = ()
    warnings: tuple[str, ...] = ()
    odometry: OdometryPoses | None = None
    slow_stated: tuple[float | None, float | None] = (None, None)

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last stamp at which there is a pose."""
        return int(self.trajectory.stamps_ns[0]), int(self.trajectory.stamps_ns[-1])

    @cached_property
    def _curve(self) -> PoseCurve:
        begin, _ = self.span_ns
        seconds: Array = np.asarray(self.trajectory.stamps_ns - begin, np.float64) * 1e-9
        return PoseCurve(seconds, *stack(self.trajectory.T_map_vehicle))

    def poses_at(self, stamps_ns: Sequence[int] | IntArray) -> tuple[Array, Array]:
        """R_map_vehicle (m, 3, 3) and t_map_vehicle (m, 3), metres, at any times within the span.

        Raises:
            TrajectoryError: a stamp is outside the span.
        """
        stamps = within_span(stamps_ns, self.span_ns, "the given poses")
        return self._curve.at(np.asarray((stamps - self.span_ns[0]) * 1e-9, np.float64))

    def error_covariances(self, stamps_ns: Sequence[int] | IntArray) -> Array | None:
        """`given.error_covariances` at stamps (m,) in any order.

        Raises:
            TrajectoryError: a stamp is outside the span.
        """
        stamps = within_span(stamps_ns, self.span_ns, "the given poses")
        return error_covariances(self.trajectory, stamps)


def wanted_stamps(recording: Recording) -> IntArray:
    """(m,) stamps of the clouds of all LiDARs, ascending."""
    stamps = [np.asarray(recording.scan_stamps_ns(name), np.int64) for name in recording.lidars]
    return np.unique(np.concatenate([*stamps, np.zeros(0, dtype=np.int64)]))


def smooth_trajectories(
    recordings: Sequence[Recording],
    config: Config,
    wanted: Sequence[Sequence[int] | IntArray] | None = None,
    motions: Mapping[int, MotionData] | None = None,
    earlier: Sequence[VehicleTrajectory] | None = None,
    *,
    by_walls: bool = False,
) -> tuple[SmoothedTrajectory | GivenTrajectory, ...]:
    """The trajectory of each drive: given poses (`takes_given_poses`), or smoothed raw sensors.

    `wanted` are per drive the stamps at which poses are wanted; None: those of all clouds.
    `motions` are motion data by the recording's index, if they have been read already. `earlier`
    are trajectories of the same drives by an earlier smoothing: the search begins there, with their
    noise levels, which are told best where nodes are even. Later nodes crowd where scans see a
    target. `by_walls`: a wide heading is not refused, for walls are to tell it
    (`calibration.drift`).

    Raises:
        TrajectoryError: the data of a drive do not determine its motion.
        RecordingError: it could not be read.
    """
    out: list[SmoothedTrajectory | GivenTrajectory] = []
    for index, recording in enumerate(recordings):
        motion = motions[index] if motions is not None else recording.motion()
        stamps = wanted_stamps(recording) if wanted is None else np.unique(wanted[index])
        if takes_given_poses(motion, config):
            out.append(_given(motion, stamps))
        else:
            begin = None if earlier is None else earlier[index]
            if isinstance(begin, SmoothedTrajectory):
                known = begin.data.scales
                smoothed = smooth_trajectory(motion, config, stamps, (), known, begin)
            else:
                smoothed = smooth_trajectory(motion, config, stamps)
            if smoothed.heading_is_wide and not by_walls:
                raise without_heading(smoothed.data, smoothed.heading_sigma_rad)
            out.append(smoothed)
    return tuple(out)


def takes_given_poses(motion: MotionData, config: Config) -> bool:
    """Whether the trajectory of a drive is its given poses.

    It is where the config names them, whatever else it names (`names_poses`), or where there is no
    IMU beside them.
    """
    return config.names_poses() or (motion.poses is not None and motion.imu is None)


def sharing_poses(recording: Recording, motion: MotionData, config: Config) -> Recording:
    """The recording with one stamp for clouds that share a pose (`with_common_stamps`).

    Those are within `COMMON_NS` of each other where the trajectory is smoothed. By given poses each
    cloud has its own, but for stamps that are the same.
    """
    given = takes_given_poses(motion, config)
    return with_common_stamps(recording, MERGE_NS if given else COMMON_NS)


def are_given(trajectories: Sequence[VehicleTrajectory]) -> bool:
    """Whether the trajectories of all drives are given poses."""
    return all(isinstance(trajectory, GivenTrajectory) for trajectory in trajectories)


def is_of_wheels(trajectory: VehicleTrajectory) -> bool:
    """Whether wheels stand in for an IMU: roll and pitch are those of level ground."""
    return isinstance(trajectory, SmoothedTrajectory) and trajectory.data.wheels is not None


def _given(motion: MotionData, stamps: IntArray) -> GivenTrajectory:
    trajectory = given_trajectory(motion)
    begin, end = GivenTrajectory(trajectory).span_ns
    lost = stamps[(stamps < begin) | (stamps > end)]
    if len(lost) and len(lost) == len(stamps):
        raise TrajectoryError(
            f"{motion.name}: all {len(stamps)} scans are outside the given poses' span, "
            f"{begin * 1e-9:.3f} s to {end * 1e-9:.3f} s. Check their clocks with "
            "'caliv-graph inspect'"
        )
    warnings = []
    if len(lost):
        warnings.append(
            f"{motion.name}: {len(lost)} of {len(stamps)} scans are outside the given poses' span, "
            "lost"
        )
    count = len(trajectory.stamps_ns)
    unknown = 0 if trajectory.cov is None else int((~stated(trajectory.cov)).sum())
    if 0 < unknown < count:
        warnings.append(
            f"{motion.name}: {unknown} of {count} vehicle poses state no covariance: their white "
            "error is estimated"
        )
    slow = slow_errors_stated(trajectory)
    if slow is not None:
        (turn, place), (turn_most, place_most) = slow.stated, slow.scatter
        warnings.append(
            f"{motion.name}: the vehicle's poses state errors of {math.degrees(turn):.2g} degrees "
            f"and {1e3 * place:.2g} mm, and from one to the next they scatter by at most "
            f"{math.degrees(turn_most):.2g} degrees and {1e3 * place_most:.2g} mm: what they state "
            "is mostly a slow error. White and slow errors of the poses are estimated, the slow "
            "ones about what is stated"
        )
        trajectory = replace(trajectory, cov=None)
    rare = rare_poses(trajectory, stamps)
    if rare is not None:
        step_s, sigma_m = rare
        warnings.append(
            f"{motion.name}: the vehicle's poses come every {step_s:.2g} s: at the scans between "
            f"them its path is known to about {1e3 * sigma_m:.0f} mm. Give poses more often"
        )
    odometry = motion.poses if isinstance(motion.poses, OdometryPoses) else None
    slow_stated = (None, None) if slow is None else slow.slow
    return GivenTrajectory(trajectory, tuple(lost.tolist()), tuple(warnings), odometry, slow_stated)


def accelerations_at(trajectory: VehicleTrajectory, stamps_ns: Sequence[int]) -> Array:
    """(m, 6) change of the velocity of `twists_at` per second at some stamps."""
    before, after, seconds = _windows(trajectory, stamps_ns)
    change = twists_at(trajectory, after.tolist()) - twists_at(trajectory, before.tolist())
    return np.asarray(change / seconds[:, None])


def twists_at(trajectory: VehicleTrajectory, stamps_ns: Sequence[int]) -> Array:
    """(m, 6) velocity of the vehicle at some stamps, a right perturbation per second."""
    before, after, _ = _windows(trajectory, stamps_ns)
    return mean_twists(trajectory, before, after)


def mean_twists(trajectory: VehicleTrajectory, begin_ns: IntArray, end_ns: IntArray) -> Array:
    """(m, 6) mean velocity of the vehicle between stamps, a right perturbation per second."""
    # Together: a call takes most of its time whatever it is asked for.
    poses = unstack(*trajectory.poses_at(np.concatenate([begin_ns, end_ns])))
    seconds = _seconds(begin_ns, end_ns)
    steps = zip(poses[: len(seconds)], poses[len(seconds) :], seconds, strict=True)
    return np.array([gtsam.Pose3.Logmap(a.between(b)) / s for a, b, s in steps])


def _seconds(begin_ns: IntArray, end_ns: IntArray) -> Array:
    """(m,) from one stamp to another, a nanosecond at least."""
    return np.asarray(np.maximum(end_ns - begin_ns, 1) / NANOSECONDS_PER_SECOND)


def _windows(
    trajectory: VehicleTrajectory, stamps_ns: Sequence[int]
) -> tuple[IntArray, IntArray, Array]:
    """(m,) begin and end of the time around each stamp that is averaged over, and its seconds."""
    half_ns = GIVEN_WINDOW_NS if isinstance(trajectory, GivenTrajectory) else TWIST_WINDOW_NS
    begin, end = trajectory.span_ns
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    before = np.maximum(stamps - half_ns, begin)
    after = np.minimum(stamps + half_ns, end)
    return before, after, _seconds(before, after)
