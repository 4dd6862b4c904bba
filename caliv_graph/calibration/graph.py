"""The factor graph: assembling, solving, and reading its information on the extrinsics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import gtsam
import numpy as np
import scipy.linalg
import scipy.sparse

from caliv_graph.calibration.factors import (
    extrinsic_prior,
    gauss_markov_factor,
    given_pose_factor,
    predict_cloud,
    target_pose_factor,
)
from caliv_graph.calibration.problem import Problem
from caliv_graph.conventions import key_extrinsic, key_pose_error, key_target, key_vehicle
from caliv_graph.errors import SolveError
from caliv_graph.products import Array, PoseNoise
from caliv_graph.trajectory.factors import marginal_factor

OFFSET_SIGMA_S = 0.05
"""How far off the clock of a LiDAR may be, 1 sigma: half a turn of one that turns at 10 Hz."""

GAUGE = 1e-9
"""Relative ridge under which a dense system is solved: directions that nothing says anything
about (the clouds' poses when all weights vanish) stay where they are."""

GAUGE_PRIOR = 1.0
"""Information per radian^2 and metre^2 that holds the frame of a target where it is. The shape's
own place and orientation are eliminated: what moves all clouds of a target alike is no quantity."""


FactorKind = Literal[
    "motion",
    "given_pose",
    "pose_error_start",
    "pose_error_step",
    "time_offset",
    "extrinsic_prior",
    "cloud",
    "ground_prior",
    "ground_height",
    "ground_tilt",
    "ground_plane",
    "standing",
    "parallel",
]


class CalibrationGraph(gtsam.NonlinearFactorGraph):
    """A factor graph that knows of which kind each of its factors is.

    Attributes:
        kinds: of every factor, in order.
    """

    def __init__(self) -> None:
        super().__init__()
        self.kinds: list[FactorKind] = []

    def append(self, kind: FactorKind, factor: gtsam.NonlinearFactor) -> None:
        """Adds a factor."""
        self.add(factor)
        self.kinds.append(kind)


def pose_error_sigmas(noise: PoseNoise) -> Array:
    """(6,) stationary sigmas of the slow error."""
    return np.array([noise.drift_rotation_rad] * 3 + [noise.drift_position_m] * 3)


def motion_graph(problem: Problem) -> CalibrationGraph:
    """What motion data say of the vehicle's poses: a joint Gaussian for each drive that has them.

    Hundreds of poses with all their correlations take a while to hand over: build it once.
    """
    graph = CalibrationGraph()
    drives = problem.drives()
    for drive, information in problem.motion.items():
        of_drive = np.flatnonzero(drives == drive).tolist()
        graph.append(
            "motion",
            marginal_factor(
                [key_vehicle(i) for i in of_drive],
                information,
                tuple(problem.T_map_vehicle[i] for i in of_drive),
            ),
        )
    return graph


def pose_graph(
    problem: Problem, noise: PoseNoise, motion: CalibrationGraph | None = None
) -> CalibrationGraph:
    """What is known of the vehicle's poses without any LiDAR.

    Given poses have white and slow errors; those of a smoothed trajectory a joint Gaussian.

    Args:
        problem: the poses.
        noise: error model of the given ones.
        motion: `motion_graph(problem)` if it is there already.
    """
    graph = merged(motion_graph(problem) if motion is None else motion)
    times, drives, given = problem.times_s(), problem.drives(), problem.given()
    stationary = pose_error_sigmas(noise)
    for i in np.flatnonzero(given).tolist():
        T = problem.T_map_vehicle[i]
        graph.append(
            "given_pose",
            given_pose_factor(
                key_vehicle(i),
                key_pose_error(i),
                T,
                noise.white_rotation_rad,
                noise.white_position_m,
            ),
        )
        if i == 0 or drives[i] != drives[i - 1]:
            start = gtsam.noiseModel.Diagonal.Sigmas(stationary)
            graph.append(
                "pose_error_start",
                gtsam.PriorFactorVector(key_pose_error(i), np.zeros(6), start),
            )
        else:
            decay = float(np.exp(-(times[i] - times[i - 1]) / noise.drift_time_s))
            step = stationary * np.sqrt(1.0 - decay**2)
            graph.append(
                "pose_error_step",
                gauss_markov_factor(key_pose_error(i - 1), key_pose_error(i), decay, step),
            )
    return graph


def prior_graph(problem: Problem, lidars: Sequence[str]) -> CalibrationGraph:
    """The initial guesses of the named LiDARs."""
    graph = CalibrationGraph()
    for name in lidars:
        graph.append(
            "extrinsic_prior",
            extrinsic_prior(
                problem.extrinsic_keys_of(name), problem.guesses[name], problem.prior_sigmas[name]
            ),
        )
    return graph


def offset_graph(problem: Problem) -> CalibrationGraph:
    """How far off a LiDAR's clock may be, for those whose offset is free."""
    graph = CalibrationGraph()
    for key in problem.offset_keys():
        sigma = gtsam.noiseModel.Isotropic.Sigma(1, OFFSET_SIGMA_S)
        graph.append("time_offset", gtsam.PriorFactorVector(key, np.zeros(1), sigma))
    return graph


def cloud_graph(
    problem: Problem, measured: Sequence[gtsam.Pose3], information: Array
) -> CalibrationGraph:
    """One pose factor per registered cloud; `information` (J, 6, 6) has the weights in it."""
    graph = CalibrationGraph()
    for j, Z in enumerate(measured):
        graph.append(
            "cloud",
            target_pose_factor(problem.cloud_keys(j), Z, information[j], problem.cloud_twist(j)),
        )
    return graph


def initial_values(problem: Problem, measured: Sequence[gtsam.Pose3]) -> gtsam.Values:
    """The guesses, the given poses, and the target frames that fit the median cloud."""
    values = gtsam.Values()
    for i, T in enumerate(problem.T_map_vehicle):
        values.insert(key_vehicle(i), T)
    for key in problem.pose_error_keys():
        values.insert(key, np.zeros(6))
    for key in problem.offset_keys():
        values.insert(key, np.zeros(1))
    E = problem.guesses[problem.reference]
    values.insert(key_extrinsic(), E)
    for name in problem.lidars:
        for key in problem.extrinsic_keys_of(name)[1:]:
            values.insert(key, E.between(problem.guesses[name]))
    for m in range(problem.placements):
        candidates = []
        for j in np.flatnonzero(problem.cloud_placement == m).tolist():
            X = problem.T_map_vehicle[problem.cloud_pose[j]]
            guess = problem.guesses[problem.lidars[problem.cloud_lidar[j]]]
            candidates.append(measured[j].compose(X.compose(guess).inverse()))
        values.insert(key_target(m), _median_pose(candidates))
    return values


def with_given_poses(problem: Problem, values: gtsam.Values) -> gtsam.Values:
    """The same extrinsics and targets, with the poses as they were given."""
    out = gtsam.Values(values)
    for i, T in enumerate(problem.T_map_vehicle):
        out.update(key_vehicle(i), T)
    for key in problem.pose_error_keys():
        out.update(key, np.zeros(6))
    return out


def _median_pose(poses: Sequence[gtsam.Pose3]) -> gtsam.Pose3:
    """The pose of the list that has the smallest sum of distances to the others.

    Distances are taken where the poses put the origin of their inverse: at the target.
    """
    if not poses:
        return gtsam.Pose3()
    centres = np.array([p.inverse().translation() for p in poses])
    total = np.linalg.norm(centres[:, None] - centres[None], axis=2).sum(axis=1)
    return poses[int(total.argmin())]


def merged(*graphs: CalibrationGraph) -> CalibrationGraph:
    """All factors of several graphs in one."""
    out = CalibrationGraph()
    for graph in graphs:
        out.push_back(graph)
        out.kinds += graph.kinds
    return out


def optimise(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, iterations: int
) -> gtsam.Values:
    """Levenberg-Marquardt from `values`.

    Raises:
        SolveError: the graph is singular or its error is not finite.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(iterations)
    parameters.setRelativeErrorTol(1e-6)
    parameters.setLinearSolverType("MULTIFRONTAL_CHOLESKY")
    try:
        optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
        result = optimiser.optimizeSafely()
    except RuntimeError as e:
        raise SolveError(f"the graph could not be solved: {str(e).splitlines()[0]}") from None
    if not np.isfinite(optimiser.error()):
        raise SolveError("the graph could not be solved: its error is not a number")
    return result


@dataclass(frozen=True)
class CloudLinearisation:
    """How the predicted pose of every cloud moves with the variables it depends on.

    Attributes:
        predicted: T_target_lidar of each cloud.
        keys: per cloud, in order of the product.
        jacobians: per cloud and key, (6, size): left perturbation of the prediction by a right
            perturbation of the variable.
    """

    predicted: tuple[gtsam.Pose3, ...]
    keys: tuple[tuple[int, ...], ...]
    jacobians: tuple[tuple[Array, ...], ...]


def linearise_clouds(problem: Problem, values: gtsam.Values) -> CloudLinearisation:
    """Predictions and their Jacobians at `values`."""
    predicted, keys, jacobians = [], [], []
    for j in range(problem.clouds):
        chain = problem.cloud_keys(j)
        Z, moves = predict_cloud(chain, values, problem.cloud_twist(j))
        predicted.append(Z)
        keys.append(chain)
        jacobians.append(tuple(moves))
    return CloudLinearisation(tuple(predicted), tuple(keys), tuple(jacobians))


@dataclass(frozen=True)
class DenseSystem:
    """A linearised graph as one quadratic, `d^T H d / 2 - b^T d`, the extrinsics last.

    Attributes:
        keys: poses, targets, others (ground, time offsets), and the extrinsics at the end.
        sizes: coordinates of each: six, but for the others.
        H: (M, M), M the sum of `sizes`.
        b: (M,).
        extrinsics: how many of `keys` are extrinsics.
    """

    keys: tuple[int, ...]
    sizes: tuple[int, ...]
    H: Array
    b: Array
    extrinsics: int

    def offset(self, key: int) -> int:
        """First coordinate of a variable."""
        return sum(self.sizes[: self.keys.index(key)])

    def covariance_of(self, key: int, cov_extrinsics: Array) -> Array:
        """Marginal covariance of a variable that is no extrinsic.

        Args:
            key: of the variable.
            cov_extrinsics: covariance of the extrinsics, tangents in the order of `keys`.
        """
        split = len(self.b) - 6 * self.extrinsics
        start = self.offset(key)
        which = slice(start, start + self.sizes[self.keys.index(key)])
        rest = self.H[:split, :split].copy()
        diagonal = np.arange(split)
        rest[diagonal, diagonal] *= 1.0 + GAUGE
        unit = np.eye(split)[:, which]
        own = scipy.linalg.cho_solve(scipy.linalg.cho_factor(rest, lower=True), unit)
        follows = own.T @ self.H[:split, split:]
        return np.asarray(own[which] + follows @ cov_extrinsics @ follows.T)

    def schur(self) -> tuple[Array, Array, Array, Array]:
        """Eliminates everything but the extrinsics.

        Returns:
            D (6n, 6n) and c (6n,) of the reduced quadratic; and G, g with which the eliminated
            variables follow: `d_rest = g - G d_extrinsics`.

        Raises:
            SolveError: the rest is singular.
        """
        split = len(self.b) - 6 * self.extrinsics
        rest = self.H[:split, :split].copy()
        diagonal = np.arange(split)
        rest[diagonal, diagonal] *= 1.0 + GAUGE
        try:
            factor = scipy.linalg.cho_factor(rest, lower=True, check_finite=False)
        except scipy.linalg.LinAlgError:
            raise SolveError(
                "the graph without extrinsics is singular: a pose or a target is tied to nothing"
            ) from None
        both = scipy.linalg.cho_solve(
            factor, np.column_stack([self.H[:split, split:], self.b[:split]]), check_finite=False
        )
        G, g = both[:, :-1], both[:, -1]
        D = self.H[split:, split:] - self.H[split:, :split] @ G
        c = self.b[split:] - self.H[split:, :split] @ g
        return 0.5 * (D + D.T), c, G, g


def dense_system(
    problem: Problem, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values
) -> DenseSystem:
    """Linearises `graph` at `values`, with the slow errors of the poses eliminated.

    They form chains, which GTSAM eliminates sparsely, and are linear: their values do not matter.
    Variables of the problem that the graph does not touch get zero rows; others that it does touch
    are taken along.
    """
    extrinsics = problem.extrinsic_keys()
    drifts = set(problem.pose_error_keys())
    linear = graph.linearize(values)
    touched = set(graph.keyVector())
    known = (*problem.pose_keys(), *problem.target_keys())
    others = sorted(touched - drifts - {*known, *extrinsics})
    keys = (*known, *others, *extrinsics)
    zero = values.zeroVectors()
    sizes = tuple(6 if key in known or key in extrinsics else zero.at(key).size for key in keys)
    chains = [key for key in problem.pose_error_keys() if key in touched]
    if chains:
        try:
            _, linear = linear.eliminatePartialMultifrontal(chains)
        except RuntimeError as e:
            raise SolveError(f"the given poses: {str(e).splitlines()[0]}") from None
    size = sum(sizes)
    H, b = np.zeros((size, size)), np.zeros(size)
    order = [key for key in keys if key in touched and key not in drifts]
    if order:
        ordering = gtsam.Ordering()
        for key in order:
            ordering.push_back(key)
        H_part, b_part = linear.hessian(ordering)
        present = set(order)
        starts = np.cumsum([0, *sizes])
        where = np.concatenate(
            [
                np.arange(start, start + n)
                for key, start, n in zip(keys, starts, sizes, strict=False)
                if key in present
            ]
        )
        H[np.ix_(where, where)] = H_part
        b[where] = np.asarray(b_part).ravel()
    return DenseSystem(keys, sizes, H, b, len(extrinsics))


def add_shape(
    system: DenseSystem, lines: CloudLinearisation, H_clouds: Array, gradient: Array
) -> DenseSystem:
    """Adds a quadratic on the poses of all clouds, `d^T H d / 2 + g^T d` (left perturbations).

    A common motion of a target's clouds is free in it: GAUGE_PRIOR holds their target frame.

    Args:
        system: the rest of the graph.
        lines: how the clouds' poses move with the variables.
        H_clouds: (6 J, 6 J).
        gradient: (6 J,).
    """
    J = cloud_rows(system, lines)
    return _with_rows(system, J, J.T @ H_clouds, gradient)


def _with_rows(
    system: DenseSystem, J: scipy.sparse.csr_array, seen: Array, gradient: Array
) -> DenseSystem:
    """Adds what clouds of rows J say, `seen` being `J^T H`."""
    H = system.H + (J.T @ seen.T)
    add_gauge_prior(H, _starts(system))
    return replace(system, H=H, b=system.b - J.T @ gradient)


def cloud_rows(system: DenseSystem, lines: CloudLinearisation) -> scipy.sparse.csr_array:
    """(6 J, M) derivatives of the poses of all clouds with respect to the variables of a system.

    Left perturbations of the predicted T_target_lidar by right perturbations of the variables.
    """
    starts = _starts(system)
    rows, columns, entries = [], [], []
    for j, (keys, jacobians) in enumerate(zip(lines.keys, lines.jacobians, strict=True)):
        for key, jacobian in zip(keys, jacobians, strict=True):
            row, column = np.indices(jacobian.shape)
            rows.append((6 * j + row).ravel())
            columns.append((starts[key] + column).ravel())
            entries.append(jacobian.ravel())
    # Every cloud depends on four or five variables of hundreds.
    return scipy.sparse.csr_array(
        (np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))),
        shape=(6 * len(lines.keys), len(system.b)),
    )


def adjusted_residuals(
    system: DenseSystem, lines: CloudLinearisation, H_clouds: Array, residuals: Array
) -> tuple[Array, Array]:
    """What measured poses of clouds are off, once all variables have made up for what they can.

    With H the clouds' information, r their residuals and A the information of all variables: the
    gradient `v = H (r + J d)` at the solution d, and its covariance `W = H - H J A^-1 J^T H`. W is
    the information on an error in the measured poses; of what poses, targets and extrinsics would
    take up, it says nothing.

    Args:
        system: the rest of the graph, which determines all variables together with the clouds.
        lines: how the clouds' poses move with the variables.
        H_clouds: (6 J, 6 J) joint information of the measured poses.
        residuals: (J, 6) `Log(predicted measured^-1)`.

    Returns:
        (6 J, 6 J) W and (6 J,) v.

    Raises:
        SolveError: some variable is not determined.
    """
    gradient = H_clouds @ residuals.ravel()
    J = cloud_rows(system, lines)
    seen = J.T @ H_clouds
    full = _with_rows(system, J, seen, gradient)
    try:
        factor = scipy.linalg.cho_factor(full.H, lower=True)
    except scipy.linalg.LinAlgError:
        raise SolveError(
            "the graph of the registered clouds is singular: a pose or a target is tied to nothing"
        ) from None
    W = H_clouds - seen.T @ scipy.linalg.cho_solve(factor, seen)
    return W, gradient + seen.T @ scipy.linalg.cho_solve(factor, full.b)


def _starts(system: DenseSystem) -> dict[int, int]:
    """First coordinate of each variable."""
    return dict(zip(system.keys, np.cumsum([0, *system.sizes]).tolist(), strict=False))


def add_gauge_prior(H: Array, starts: Mapping[int, int]) -> None:
    """Adds GAUGE_PRIOR to the frames of the targets.

    Args:
        H: (M, M) information, changed in place.
        starts: first coordinate of each variable.
    """
    letter = gtsam.symbolChr(key_target(0))
    for key, start in starts.items():
        if gtsam.symbolChr(key) == letter:
            frame = start + np.arange(6)
            H[frame, frame] += GAUGE_PRIOR


def retract(values: gtsam.Values, keys: Sequence[int], d: Array) -> gtsam.Values:
    """Moves the variables `keys` by their tangents, one after the other in d."""
    zero, delta, start = values.zeroVectors(), gtsam.VectorValues(), 0
    for key in keys:
        size = zero.at(key).size
        delta.insert(key, d[start : start + size])
        start += size
    return values.retract(delta)
