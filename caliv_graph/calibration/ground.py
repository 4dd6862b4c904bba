"""The ground in the graph: a plane per drive, seen by the LiDARs and stood upon (SPEC 3, "Ground").

Variables (keys in `conventions`): per drive g = (slope along map x, slope along map y, height in m)
of the plane `z = height + slopes . (xy - anchor)`, the anchor being in the middle of the drive, so
that height and slopes hardly correlate; the error of the vehicle's height above it (role b); and
the tilt at which the vehicle stands on it (role c). Jacobians are analytic.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from caliv_graph.calibration.graph import CalibrationGraph
from caliv_graph.calibration.problem import HEAVE_SIGMA_M, Problem
from caliv_graph.config.model import GroundConfig
from caliv_graph.conventions import key_ground, key_height, key_parallel, key_vehicle
from caliv_graph.geometry.se3 import skew
from caliv_graph.products import Array, GroundObservation, IntArray
from caliv_graph.targets.cloud.views import view_weights

PLANE_SIGMAS = np.array([1.0, 1.0, 100.0])
"""Of a plane before anything is seen: 45 degrees, and 100 m about the drive's poses. Next to the
guesses of the extrinsics that is nothing; without it a plane that nothing sees were singular."""

SWAY_SIGMA_RAD = 1e-3
"""How far the body on its springs is off its own mean tilt at each stamp, about either axis: it
leans by 1.3 mrad in a turn at walking pace (SPEC 3)."""

TOGETHER_NS = 5_000_000
"""Scans that are nearer to a pose than this see it lifted by the same heave: a body that moves by
5 mm at 2 Hz has moved by 0.3 mm."""

APART_NS = 10_000_000
"""Scans are alike in how far they are from their pose, in steps of this."""

SPREADS = (4.0, 8.0)
"""An observation has full weight up to so many spreads of its like, and none beyond the other."""

MEDIAN_OF_NORMAL = 0.6745
"""Median of the absolute value of a standard normal variable: makes of medians a spread."""

FEWEST_ALIKE = 5
"""Of fewer observations no spread can be told; all are believed."""

FEWEST_PAIRS = 20
"""Pairs of observations that tell a spread to a sixth of it."""

TILT_RAD = (math.radians(1.0), math.radians(2.0))
"""A vehicle tilted by less than this against how it stands mostly stands on the plane, one tilted
by more than that on a ramp that rises from it: where its slope is a degree, it is millimetres high
and adds less than the heave."""


@dataclass(frozen=True)
class GroundWeights:
    """What to believe of the ground.

    Attributes:
        planes: (n,) of each observation, 0 to 1; zero if no LiDAR or pose of the problem took it.
        stands: (m,) of each pose: whether the vehicle stands on the plane there, 0 to 1.
        heave_m: (n,) 1 sigma of what the vehicle's heave was another at the scan than at the pose.
    """

    planes: Array
    stands: Array
    heave_m: Array


# ------------------------------------------------------------------ factors


def plane_normal(g: Array) -> Array:
    """(3,) upward unit normal in the map of a plane g."""
    a, b = float(g[0]), float(g[1])
    inverse = 1.0 / math.sqrt(1.0 + a * a + b * b)
    return np.array([-a * inverse, -b * inverse, inverse])


def _normal_jacobian(g: Array) -> Array:
    """(3, 3) derivative of `plane_normal` by g."""
    # Written out, as is what follows: a graph asks this of hundreds of factors some fifty times,
    # and numpy takes microseconds for every small array.
    a, b = float(g[0]), float(g[1])
    inverse = 1.0 / math.sqrt(1.0 + a * a + b * b)
    cube = inverse**3
    return np.array(
        [
            [a * a * cube - inverse, a * b * cube, 0.0],
            [a * b * cube, b * b * cube - inverse, 0.0],
            [-a * cube, -b * cube, 0.0],
        ]
    )


def _height_over(g: Array, anchor: Array, place_map: Array) -> tuple[float, Array, Array]:
    """Distance of a place from the plane along its normal, with derivatives.

    Returns:
        metres; (3,) by g; (3,) by the place.
    """
    a, b = float(g[0]), float(g[1])
    inverse = 1.0 / math.sqrt(1.0 + a * a + b * b)
    x, y = float(place_map[0] - anchor[0]), float(place_map[1] - anchor[1])
    height = inverse * (float(place_map[2] - g[2]) - a * x - b * y)
    bend = -height * inverse**2
    by_plane = np.array([bend * a - inverse * x, bend * b - inverse * y, -inverse])
    return height, by_plane, np.array([-a * inverse, -b * inverse, inverse])


def _chain(
    values: gtsam.Values, keys: Sequence[int], derivatives: bool
) -> tuple[gtsam.Pose3, list[Array]]:
    """The product of poses, and per pose what a right perturbation of it does to the product's.

    Only the poses after it matter: no number here grows with the distance from the map's origin.
    """
    after = gtsam.Pose3()
    moves: list[Array] = []
    for key in reversed(keys):
        if derivatives:
            moves.append(np.asarray(after.inverse().AdjointMap()))
        after = values.atPose3(key).compose(after)
    return after, moves[::-1]


def _measured(observation: GroundObservation, R_vehicle_lidar: Array) -> tuple[Array, Array]:
    """What an observation says, the motion compensated with another mounting.

    Returns:
        (3,) tilts along its axes and distance; (3, 3) by a right perturbation of the rotation.
    """
    said = np.array([0.0, 0.0, observation.distance_m])
    if observation.R_vehicle_lidar is None or observation.by_extrinsic is None:
        return said, np.zeros((3, 3))
    turn = gtsam.Rot3(observation.R_vehicle_lidar.T @ R_vehicle_lidar)
    w = gtsam.Rot3.Logmap(turn)
    by_turn = observation.by_extrinsic @ gtsam.Rot3.LogmapDerivative(w)
    return said + observation.by_extrinsic @ w, np.asarray(by_turn)


def ground_plane_factor(
    pose_keys: Sequence[int],
    key_plane: int,
    anchor: Array,
    observation: GroundObservation,
    weight: float = 1.0,
    heave_m: float = 0.0,
) -> gtsam.CustomFactor:
    """Role a: the plane as a LiDAR sees it.

    `r = [u . n, v . n, d] - [a, b, distance]`, n the plane's normal in the lidar frame and d the
    LiDAR's distance from it, both predicted from `X E S_a`; u and v are the observation's axes;
    a, b (zero at first) and distance are what it says, corrected for what a better mounting
    `E S_a` would have made of its motion compensation.

    Args:
        pose_keys: of X_i, E and, unless the LiDAR is the reference, S_a.
        key_plane: of the drive's plane.
        anchor: (2,) metres, where the plane's height is told.
        observation: what was measured.
        weight: on its information.
        heave_m: 1 sigma of heave between scan and pose, beside the observation's covariance.
    """
    poses = list(pose_keys)
    axes = observation.axes_lidar

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        T, moves = _chain(values, poses, jacobians is not None)
        g = values.atVector(key_plane)
        d, by_plane, n = _height_over(g, anchor, T.translation())
        R_lidar_map = T.rotation().matrix().T
        n_lidar = R_lidar_map @ n
        said, by_turn = _measured(
            observation, values.atPose3(poses[0]).rotation().between(T.rotation()).matrix()
        )
        if jacobians is not None:
            J = np.zeros((3, 6))
            J[:2, :3] = axes @ skew(n_lidar)
            J[2, 3:] = n_lidar
            jacobians[0] = J @ moves[0]
            J[:, :3] -= by_turn
            for i, move in enumerate(moves[1:], start=1):
                jacobians[i] = J @ move
            jacobians[len(moves)] = np.vstack([axes @ R_lidar_map @ _normal_jacobian(g), by_plane])
        return np.asarray(np.append(axes @ n_lidar, d) - said)

    noise = gtsam.noiseModel.Gaussian.Covariance(_cov(observation, heave_m) / weight)
    return gtsam.CustomFactor(noise, [*poses, key_plane], error)


def _cov(observation: GroundObservation, heave_m: float) -> Array:
    """(3, 3) of an observation, with the heave between scan and pose."""
    cov = observation.cov.copy()
    cov[2, 2] += heave_m**2
    return cov


def standing_factor(
    key_pose: int,
    key_plane: int,
    key_error: int,
    anchor: Array,
    vehicle_height_m: float,
    weight: float = 1.0,
) -> gtsam.CustomFactor:
    """Role b: `r = height of the vehicle frame over the plane - vehicle_height - error`.

    Its sigma is the heave of one scan; the error is common to the drive.

    Args:
        key_pose: of X_i.
        key_plane: of the drive's plane.
        key_error: of the error of the vehicle's height in the drive.
        anchor: (2,) metres, where the plane's height is told.
        vehicle_height_m: height of the vehicle frame above ground.
        weight: on its information.
    """

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        X = values.atPose3(key_pose)
        height, by_plane, n = _height_over(values.atVector(key_plane), anchor, X.translation())
        if jacobians is not None:
            J = np.zeros((1, 6))
            J[0, 3:] = n @ X.rotation().matrix()
            jacobians[0] = J
            jacobians[1] = by_plane[None]
            jacobians[2] = -np.ones((1, 1))
        return np.asarray(height - vehicle_height_m - values.atVector(key_error))

    noise = gtsam.noiseModel.Isotropic.Sigma(1, HEAVE_SIGMA_M / math.sqrt(weight))
    return gtsam.CustomFactor(noise, [key_pose, key_plane, key_error], error)


def parallel_factor(
    key_pose: int, key_plane: int, key_tilt: int, weight: float = 1.0
) -> gtsam.CustomFactor:
    """Role c: `r` = x and y of the plane's normal in the vehicle frame, less those of the drive.

    Args:
        key_pose: of X_i.
        key_plane: of the drive's plane.
        key_tilt: of the tilt common to the drive.
        weight: on its information.
    """

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        R_vehicle_map = values.atPose3(key_pose).rotation().matrix().T
        g = values.atVector(key_plane)
        n_vehicle = R_vehicle_map @ plane_normal(g)
        if jacobians is not None:
            J = np.zeros((2, 6))
            J[:, :3] = skew(n_vehicle)[:2]
            jacobians[0] = J
            jacobians[1] = R_vehicle_map[:2] @ _normal_jacobian(g)
            jacobians[2] = -np.eye(2)
        return np.asarray(n_vehicle[:2] - values.atVector(key_tilt))

    noise = gtsam.noiseModel.Isotropic.Sigma(2, SWAY_SIGMA_RAD / math.sqrt(weight))
    return gtsam.CustomFactor(noise, [key_pose, key_plane, key_tilt], error)


# ------------------------------------------------------------------ graph


def ground_anchor(problem: Problem, drive: int) -> Array:
    """(2,) where the height of a drive's plane is told: the mean of its poses, problem's map."""
    places = [
        T.translation()[:2]
        for (d, _), T in zip(problem.poses, problem.T_map_vehicle, strict=True)
        if d == drive
    ]
    return np.asarray(np.mean(places, axis=0), dtype=np.float64)


def _taken(problem: Problem, observations: Sequence[GroundObservation]) -> IntArray:
    """(n,) index of the pose that each observation was taken from; -1 if the problem has it not."""
    index = {pose: i for i, pose in enumerate(problem.poses)}
    return np.array(
        [
            index.get((o.drive, o.stamp_ns), -1) if o.lidar in problem.lidars else -1
            for o in observations
        ],
        dtype=np.int64,
    )


def _drives(observations: Sequence[GroundObservation], taken: IntArray) -> list[int]:
    """Drives in which there is an observation that counts, ascending."""
    return sorted({o.drive for o, i in zip(observations, taken, strict=True) if i >= 0})


def full_weights(problem: Problem, observations: Sequence[GroundObservation]) -> GroundWeights:
    """Every observation that there is a pose for is believed, and that the vehicle stands there."""
    taken = _taken(problem, observations)
    stands = np.zeros(len(problem.poses))
    stands[taken[taken >= 0]] = 1.0
    heave = np.array([_first_heave(problem, o) for o in observations])
    return GroundWeights((taken >= 0).astype(np.float64), stands, heave)


def _first_heave(problem: Problem, observation: GroundObservation) -> float:
    """Heave between scan and pose, metres, when nothing is known of it: that of two scans.

    Given poses know it; what IMU, GNSS and wheels make of it is lost in their noise.
    """
    if observation.drive not in problem.motion or abs(observation.apart_ns) <= TOGETHER_NS:
        return 0.0
    return math.sqrt(2.0) * HEAVE_SIGMA_M


def ground_graph(
    problem: Problem,
    observations: Sequence[GroundObservation],
    config: GroundConfig,
    weights: GroundWeights | None = None,
) -> CalibrationGraph:
    """All that the ground says; empty if it is not to be used or was not seen.

    Args:
        problem: LiDARs and poses. Observations of others are left out.
        observations: the planes.
        config: which of the roles of SPEC 3 the user wants, and their sigmas.
        weights: of `ground_weights`; None: all full.
    """
    graph = CalibrationGraph()
    if not config.use:
        return graph
    taken = _taken(problem, observations)
    weights = weights or full_weights(problem, observations)
    drives = _drives(observations, taken)
    anchors = {drive: ground_anchor(problem, drive) for drive in drives}
    for drive in drives:
        graph.append("ground_prior", _plane_prior(problem, drive))
        if config.vehicle_height is not None:
            graph.append("ground_height", _centred(key_height(drive), np.array([config.sigma])))
        if config.parallel_sigma_deg is not None:
            sigma = math.radians(config.parallel_sigma_deg)
            graph.append("ground_tilt", _centred(key_parallel(drive), np.full(2, sigma)))
    worth = weights.planes * _place_shares(problem, observations, taken)
    believed = zip(
        observations, taken.tolist(), worth.tolist(), weights.heave_m.tolist(), strict=True
    )
    for o, i, weight, heave_m in believed:
        if i >= 0 and weight > 0.0:
            keys = (key_vehicle(i), *problem.extrinsic_keys_of(o.lidar))
            plane, anchor = key_ground(o.drive), anchors[o.drive]
            factor = ground_plane_factor(keys, plane, anchor, o, weight, heave_m)
            graph.append("ground_plane", factor)
    for i, ((drive, _), weight) in enumerate(
        zip(problem.poses, weights.stands.tolist(), strict=True)
    ):
        if weight <= 0.0 or drive not in anchors:
            continue
        X, plane = key_vehicle(i), key_ground(drive)
        if config.vehicle_height is not None:
            height = config.vehicle_height
            factor = standing_factor(X, plane, key_height(drive), anchors[drive], height, weight)
            graph.append("standing", factor)
        if config.parallel_sigma_deg is not None:
            graph.append("parallel", parallel_factor(X, plane, key_parallel(drive), weight))
    return graph


def _place_shares(
    problem: Problem, observations: Sequence[GroundObservation], taken: IntArray
) -> Array:
    """(n,) what each observation counts: a standing vehicle sees the same bumps in every scan."""
    out = np.ones(len(observations))
    alike: dict[tuple[int, str], list[int]] = {}
    for n, (o, i) in enumerate(zip(observations, taken.tolist(), strict=True)):
        if i >= 0:
            alike.setdefault((o.drive, o.lidar), []).append(n)
    for own in alike.values():
        places = [problem.T_map_vehicle[taken[n]].translation() for n in own]
        out[own] = view_weights(np.array(places))
    return out


def _centred(key: int, sigmas: Array) -> gtsam.PriorFactorVector:
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    return gtsam.PriorFactorVector(key, np.zeros(len(sigmas)), noise)


def _plane_prior(problem: Problem, drive: int) -> gtsam.PriorFactorVector:
    height = np.mean(
        [
            T.translation()[2]
            for (d, _), T in zip(problem.poses, problem.T_map_vehicle, strict=True)
            if d == drive
        ]
    )
    noise = gtsam.noiseModel.Diagonal.Sigmas(PLANE_SIGMAS)
    return gtsam.PriorFactorVector(key_ground(drive), np.array([0.0, 0.0, height]), noise)


def ground_values(
    problem: Problem,
    observations: Sequence[GroundObservation],
    values: gtsam.Values,
    config: GroundConfig,
) -> gtsam.Values:
    """First values of the variables of `ground_graph`, and of no others.

    Args:
        problem: LiDARs and poses.
        observations: the planes.
        values: of poses and extrinsics, guesses will do.
        config: as for `ground_graph`.
    """
    out = gtsam.Values()
    if not config.use:
        return out
    taken = _taken(problem, observations)
    for drive in _drives(observations, taken):
        anchor = ground_anchor(problem, drive)
        slopes, feet = [], []
        for o, i in zip(observations, taken.tolist(), strict=True):
            if i >= 0 and o.drive == drive:
                T = values.atPose3(key_vehicle(i)).compose(problem.extrinsic(values, o.lidar))
                n = T.rotation().matrix() @ o.normal_lidar
                slopes.append(-n[:2] / n[2])
                feet.append(T.translation() - o.distance_m * n)
        slope = np.median(slopes, axis=0)
        # Where the vehicle is, not at the anchor: a wrong tilt would be a wrong height from afar.
        heights = [foot[2] - slope @ (foot[:2] - anchor) for foot in feet]
        out.insert(key_ground(drive), np.append(slope, np.median(heights)))
        if config.vehicle_height is not None:
            out.insert(key_height(drive), np.zeros(1))
        if config.parallel_sigma_deg is not None:
            out.insert(key_parallel(drive), np.zeros(2))
    return out


# ------------------------------------------------------------------ robustness


def _residuals(
    problem: Problem,
    observations: Sequence[GroundObservation],
    taken: IntArray,
    poses: Sequence[gtsam.Pose3],
    values: gtsam.Values,
) -> Array:
    """(n, 3) residuals of role a with the vehicle at `poses`; NaN where not taken."""
    out = np.full((len(observations), 3), np.nan)
    anchors = {drive: ground_anchor(problem, drive) for drive in _drives(observations, taken)}
    extrinsics = {name: problem.extrinsic(values, name) for name in problem.lidars}
    for row, (o, i) in enumerate(zip(observations, taken.tolist(), strict=True)):
        if i >= 0:
            T = poses[i].compose(extrinsics[o.lidar])
            g = values.atVector(key_ground(o.drive))
            d, _, n = _height_over(g, anchors[o.drive], T.translation())
            said, _ = _measured(o, extrinsics[o.lidar].rotation().matrix())
            out[row] = np.append(o.axes_lidar @ T.rotation().matrix().T @ n, d) - said
    return out


def ground_weights(
    problem: Problem, observations: Sequence[GroundObservation], values: gtsam.Values
) -> GroundWeights:
    """What to believe, by how far an observation is from its like: same drive, same LiDAR.

    Judged at the poses as given or smoothed: solved poses follow a wrong plane as far as they are
    let. What the poses' own errors do is in the spread, for all alike; so is a wrong mounting, in
    the middle or the spread. So the first rounds, when little is known, drop little.

    Args:
        problem: LiDARs and poses.
        observations: the planes.
        values: the current estimate, with the drives' planes.
    """
    taken = _taken(problem, observations)
    r = _residuals(problem, observations, taken, problem.T_map_vehicle, values)
    planes = np.zeros(len(observations))
    heave = _heave_between(problem, observations, taken, r[:, 2])
    for drive in _drives(observations, taken):
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
                cov = [np.diag(_cov(observations[n], heave[n])) for n in alike]
                planes[alike] = _believed(r[alike], np.sqrt(cov))
    stands = _standing(problem, observations, taken, planes, values)
    return GroundWeights(planes, stands, heave)


def _heave_between(
    problem: Problem, observations: Sequence[GroundObservation], taken: IntArray, height: Array
) -> Array:
    """(n,) 1 sigma of the heave between each scan and its pose, from the observations themselves.

    LiDARs that do not turn together see the vehicle at heights that differ by what its springs did
    in between, of which nobody knows how much that is. But two LiDARs at one pose, one that saw it
    then and one that saw it later, differ in their distances by just that, beside their own errors.
    Taken for nothing, it makes of S2S z of such LiDARs a quarter of a millimetre that is 1.4.

    Args:
        problem: LiDARs and poses.
        observations: the planes.
        taken: (n,) their poses, -1 for none.
        height: (n,) residuals of their distances, metres.
    """
    out = np.array([_first_heave(problem, o) for o in observations])
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
        # What the extrinsics are still off by is the same for two LiDARs at all times.
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
    """(m,) how far each pose's vehicle is believed to stand on its drive's plane."""
    stands = np.zeros(len(problem.poses))
    np.maximum.at(stands, taken[taken >= 0], planes[taken >= 0])
    of_drive = problem.drives()
    for drive in _drives(observations, taken):
        alike = np.flatnonzero((of_drive == drive) & (stands > 0.0))
        if not len(alike):
            continue
        g, anchor = values.atVector(key_ground(drive)), ground_anchor(problem, drive)
        poses = [problem.T_map_vehicle[i] for i in alike.tolist()]
        height = np.array([[_height_over(g, anchor, T.translation())[0]] for T in poses])
        stands[alike] *= _believed(height, np.full_like(height, HEAVE_SIGMA_M))
        tilt = np.array([(T.rotation().matrix().T @ plane_normal(g))[:2] for T in poses])
        off = np.linalg.norm(tilt - np.median(tilt, axis=0), axis=1)
        stands[alike] *= _falling(off, *TILT_RAD)
    return stands


def _believed(r: Array, floor: Array) -> Array:
    """(n,) weights of residuals (n, k) by how far they are from their median, in spreads."""
    if len(r) < FEWEST_ALIKE:
        return np.ones(len(r))
    off = np.abs(r - np.median(r, axis=0))
    spread = np.maximum(np.median(off, axis=0) / MEDIAN_OF_NORMAL, floor)
    return _falling((off / spread).max(axis=1), *SPREADS)


def _falling(x: Array, full: float, none: float) -> Array:
    """1 up to `full`, 0 from `none` on, straight in between."""
    return np.clip((none - x) / (none - full), 0.0, 1.0)
