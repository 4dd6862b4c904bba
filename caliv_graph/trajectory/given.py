"""A trajectory from the given poses of a recording, with the covariances of their messages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caliv_graph.common.statistics import MAD
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.interpolation import PoseCurve
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, IntArray, MotionData, Trajectory
from caliv_graph.trajectory.imu import log_so3
from caliv_graph.trajectory.noise import stated

RARE_S, ROUGH_M = 0.2, 2e-3
"""Poses farther apart in time, between which the path is known no better, are told: to a scan that
is an error as large as those of good poses."""

FEWEST_POSES = 8
"""Poses from which that can be said."""

HALVING = 10.0
"""Error of the curve midway between poses, over its root mean square between poses half as far
apart: 8 to 20 on drives with curves of 9 m (chords: 5)."""


MOSTLY_SLOW = 2.0
"""Stated white errors over the scatter of the poses, from which what is stated is no white error.
The scatter has the jerk of the vehicle in it: it is a bound."""

EVEN_STEPS = 0.2
"""By how much of a step the next ones may differ where scatter is told."""

FEWEST_STEPS = 50
"""Of poses that come evenly."""


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


def scatter_of_poses(trajectory: Trajectory) -> tuple[float, float] | None:
    """White error that given poses have at most: 1 sigma per axis, rotation (rad), position (m).

    By third differences, in which the white errors of four poses have 20 times their variance and a
    steady acceleration none (`README.md`, section 11). None: too few poses come evenly.
    """
    steps = np.diff(trajectory.stamps_ns).astype(np.float64)
    if len(steps) < FEWEST_STEPS:
        return None
    three = np.stack([steps[:-2], steps[1:-1], steps[2:]])
    even = np.ptp(three, axis=0) < EVEN_STEPS * np.median(steps)
    even &= three[0] < 2.0 * np.median(steps)
    if np.count_nonzero(even) < FEWEST_STEPS:
        return None
    R, t = stack(trajectory.T_map_vehicle)
    turns = log_so3(np.swapaxes(R[:-1], 1, 2) @ R[1:])
    found = []
    for third in (np.diff(turns, n=2, axis=0)[even], np.diff(t, n=3, axis=0)[even]):
        spread = MAD * np.median(np.abs(third - np.median(third, axis=0)), axis=0)
        found.append(float(np.sqrt(np.mean(spread**2) / 20.0)))
    return found[0], found[1]


@dataclass(frozen=True)
class SlowStated:
    """What the messages of poses state, where that is mostly a slow error; 1 sigma per axis.

    Attributes:
        stated: of rotation (rad) and of position (m), the median over poses and axes: an axis that
            is not observed often has a variance of 1e6.
        scatter: what they scatter by at most (`scatter_of_poses`).
    """

    stated: tuple[float, float]
    scatter: tuple[float, float]

    @property
    def slow(self) -> tuple[float | None, float | None]:
        """Of rotation and position what is stated of slow errors; None: it may be white as well."""
        turn, place = (
            of if of > MOSTLY_SLOW * most else None
            for of, most in zip(self.stated, self.scatter, strict=True)
        )
        return turn, place


def slow_errors_stated(trajectory: Trajectory) -> SlowStated | None:
    """What poses state and what they scatter by at most, if the first is no white error.

    A localiser states how far it may be off. That error is mostly slow: taken as white it leaves
    nothing for the slow one, and a hundred poses would know the vehicle ten times as well. None:
    nothing is stated, or poses scatter as much.
    """
    if trajectory.cov is None:
        return None
    known, scatter = trajectory.cov[stated(trajectory.cov)], scatter_of_poses(trajectory)
    if not len(known) or scatter is None:
        return None
    variances = np.median(np.diagonal(known, axis1=1, axis2=2), axis=0)
    said = float(np.sqrt(np.median(variances[:3]))), float(np.sqrt(np.median(variances[3:])))
    found = SlowStated(said, scatter)
    return None if found.slow == (None, None) else found


def rare_poses(trajectory: Trajectory, stamps_ns: IntArray) -> tuple[float, float] | None:
    """Usual seconds between given poses, and 1 sigma (m) of the path there, if that is rough.

    Every second pose is left out, and the curve through the others compared with it. None if poses
    are frequent (`RARE_S`), the path smooth (`ROUGH_M`), or all scans, at `stamps_ns` (m,), are at
    poses.
    """
    own = trajectory.stamps_ns
    step_s = float(np.median(np.diff(own))) / NANOSECONDS_PER_SECOND
    between = stamps_ns[(stamps_ns > own[0]) & (stamps_ns < own[-1])]
    if step_s <= RARE_S or len(own) < FEWEST_POSES or np.isin(between, own).all():
        return None
    seconds = (own - own[0]) / NANOSECONDS_PER_SECOND
    R, t = stack(trajectory.T_map_vehicle)
    left_out = np.arange(1, len(own) - 1, 2)
    kept = np.setdiff1d(np.arange(len(own)), left_out)
    _, found = PoseCurve(seconds[kept], R[kept], t[kept]).at(seconds[left_out])
    sigma_m = float(np.sqrt(np.mean(np.sum((found - t[left_out]) ** 2, axis=1)))) / HALVING
    return (step_s, sigma_m) if sigma_m > ROUGH_M else None


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
