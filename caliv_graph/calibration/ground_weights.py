"""Weights of the ground observations, and the heave between scans, estimated from them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import gtsam
import numpy as np

from caliv_graph.calibration.ground import (
    TOGETHER_NS,
    GroundWeights,
    first_heave,
    ground_centre,
    ground_centres,
    seen_drives,
    taken_poses,
)
from caliv_graph.calibration.ground_factors import (
    compensated,
    height_over,
    plane_normal,
    with_heave,
)
from caliv_graph.calibration.problem import Problem
from caliv_graph.conventions import key_ground
from caliv_graph.products import Array, GroundObservation, IntArray
from caliv_graph.targets.ground.planes import MEDIAN_OF_NORMAL

APART_NS = 10_000_000
"""Scans are grouped by their time from their pose, in steps of this."""

SPREADS = (4.0, 8.0)
"""Spreads of its group up to which an observation has full weight, and beyond which it has none."""

FEWEST_ALIKE = 5
"""Fewer observations give no spread; all keep full weight."""

FEWEST_PAIRS = 20
"""Pairs of observations that give a spread with a standard error of a sixth."""

TILT_RAD = (math.radians(1.0), math.radians(2.0))
"""Tilt against the median of the drive below which the vehicle stands on the plane, and above which
it stands on a ramp. Where a ramp has a slope of a degree, it is millimetres high, less than the
heave."""


def _residuals(
    problem: Problem,
    observations: Sequence[GroundObservation],
    taken: IntArray,
    poses: Sequence[gtsam.Pose3],
    values: gtsam.Values,
) -> Array:
    """(n, 3) residuals of role a with the vehicle at `poses`; NaN where not taken."""
    out = np.full((len(observations), 3), np.nan)
    centres = ground_centres(problem, seen_drives(observations, taken))
    extrinsics = problem.extrinsics(values)
    for row, (o, i) in enumerate(zip(observations, taken.tolist(), strict=True)):
        if i >= 0:
            T = poses[i].compose(extrinsics[o.lidar])
            g = values.atVector(key_ground(o.drive))
            d, _, n = height_over(g, centres[o.drive], T.translation())
            said = compensated(o, extrinsics[o.lidar].rotation().matrix())
            out[row] = np.append(o.axes_lidar @ T.rotation().matrix().T @ n, d) - said
    return out


def ground_weights(
    problem: Problem, observations: Sequence[GroundObservation], values: gtsam.Values
) -> GroundWeights:
    """Weights by how far an observation is from its group: same drive, same LiDAR.

    Residuals are taken at the poses as given or smoothed: solved poses follow a wrong plane. Pose
    errors widen the spread of all alike, so that the first rounds, with little known, drop little.
    """
    taken = taken_poses(problem, observations)
    r = _residuals(problem, observations, taken, problem.T_map_vehicle, values)
    planes = np.zeros(len(observations))
    heave = _heave_between(problem, observations, taken, r[:, 2])
    for drive in seen_drives(observations, taken):
        for name in problem.lidars:
            alike = np.array(
                [
                    n
                    for n, o in enumerate(observations)
                    if taken[n] >= 0 and o.drive == drive and o.lidar == name
                ],
                dtype=np.int64,
            )
            if len(alike):
                cov = [np.diag(with_heave(observations[n], heave[n])) for n in alike]
                planes[alike] = _group_weights(r[alike], np.sqrt(cov))
    stands = _standing(problem, observations, taken, planes, values)
    return GroundWeights(planes, stands, heave)


def _heave_between(
    problem: Problem, observations: Sequence[GroundObservation], taken: IntArray, height: Array
) -> Array:
    """(n,) 1 sigma of the heave between each scan and its pose, from `height` (n,) residuals in m.

    Two LiDARs at one pose, one scanning later, differ by it. Without it their S2S z claims 0.25 mm
    where it is 1.4 mm.
    """
    out = np.array([first_heave(problem, o) for o in observations])
    at_once: dict[int, list[int]] = {}
    for n, i in enumerate(taken.tolist()):
        if i >= 0 and abs(observations[n].apart_ns) <= TOGETHER_NS:
            at_once.setdefault(i, []).append(n)
    later = np.flatnonzero((taken >= 0) & (out > 0.0)).tolist()
    lags = {n: round(abs(observations[n].apart_ns) / APART_NS) for n in later}
    for drive, lag in sorted({(observations[n].drive, lags[n]) for n in later}):
        alike = [n for n in later if (observations[n].drive, lags[n]) == (drive, lag)]
        pairs = [(n, m) for n in alike for m in at_once.get(int(taken[n]), [])]
        if len(pairs) < FEWEST_PAIRS:
            continue
        apart = np.array([height[n] - height[m] for n, m in pairs])
        own = np.array([observations[n].cov[2, 2] + observations[m].cov[2, 2] for n, m in pairs])
        # The errors of the extrinsics are the same for two LiDARs at all times.
        who = [(observations[n].lidar, observations[m].lidar) for n, m in pairs]
        for both in sorted(set(who)):
            of_both = np.array([w == both for w in who])
            apart[of_both] -= np.median(apart[of_both])
        spread = float(np.median(np.abs(apart))) / MEDIAN_OF_NORMAL
        out[alike] = math.sqrt(max(spread**2 - float(np.mean(own)), 0.0))
    return out


def _standing(
    problem: Problem,
    observations: Sequence[GroundObservation],
    taken: IntArray,
    planes: Array,
    values: gtsam.Values,
) -> Array:
    """(m,) weights of the vehicle standing on its drive's plane at each pose."""
    stands = np.zeros(len(problem.poses))
    np.maximum.at(stands, taken[taken >= 0], planes[taken >= 0])
    of_drive = problem.drives()
    usual_m = math.hypot(problem.heave_m, problem.floors[2])
    for drive in seen_drives(observations, taken):
        alike = np.flatnonzero((of_drive == drive) & (stands > 0.0))
        if not len(alike):
            continue
        g, centre = values.atVector(key_ground(drive)), ground_centre(problem, drive)
        poses = [problem.T_map_vehicle[i] for i in alike.tolist()]
        height = np.array([[height_over(g, centre, T.translation())[0]] for T in poses])
        stands[alike] *= _group_weights(height, np.full_like(height, usual_m))
        tilt = np.array([(T.rotation().matrix().T @ plane_normal(g))[:2] for T in poses])
        off = np.linalg.norm(tilt - np.median(tilt, axis=0), axis=1)
        stands[alike] *= _falling(off, *TILT_RAD)
    return stands


def _group_weights(r: Array, floor: Array) -> Array:
    """(n,) weights of residuals (n, k) by how far they are from their median, in spreads."""
    if len(r) < FEWEST_ALIKE:
        return np.ones(len(r))
    off = np.abs(r - np.median(r, axis=0))
    spread = np.maximum(np.median(off, axis=0) / MEDIAN_OF_NORMAL, floor)
    return _falling((off / spread).max(axis=1), *SPREADS)


def _falling(x: Array, full: float, none: float) -> Array:
    """1 up to `full`, 0 from `none` on, linear in between."""
    return np.clip((none - x) / (none - full), 0.0, 1.0)
