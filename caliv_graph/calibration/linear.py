"""The linearised graph: one dense quadratic, with the clouds' joint quadratic added to it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np
import scipy.linalg
import scipy.sparse

from caliv_graph.calibration.factors import predict_cloud
from caliv_graph.calibration.graph import CalibrationGraph
from caliv_graph.calibration.problem import Problem
from caliv_graph.conventions import key_target
from caliv_graph.errors import SolveError
from caliv_graph.products import Array, IntArray

GAUGE = 1e-12
"""Relative ridge under which a dense system is solved: unobservable
directions (the clouds' poses when all weights vanish) stay where they are. It also holds what moves
the whole map, as the height of the antenna does: at 1e-9, with clouds known to 0.2 mm, by 0.4 m."""

GAUGE_PRIOR = 1.0
"""Gauge prior on a target frame, information per radian^2 and metre^2. The place and orientation of
the shape are eliminated: a common motion of all clouds of a target is a gauge freedom."""


@dataclass(frozen=True)
class CloudLinearisation:
    """Derivatives of the predicted pose of every cloud with respect to its variables.

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
        Z, moves = predict_cloud(chain, values, problem.cloud_motion(j))
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

    @cached_property
    def starts(self) -> dict[int, int]:
        """First coordinate of each variable."""
        return dict(zip(self.keys, np.cumsum([0, *self.sizes]).tolist(), strict=False))

    def offset(self, key: int) -> int:
        """First coordinate of a variable."""
        return self.starts[key]

    def coordinates(self, keys: Iterable[int]) -> IntArray:
        """Where the coordinates of some variables are, in their order."""
        size = dict(zip(self.keys, self.sizes, strict=True))
        return np.concatenate([self.starts[key] + np.arange(size[key]) for key in keys])

    def covariance_of(self, key: int, cov_extrinsics: Array) -> Array:
        """Marginal covariance of a variable that is no extrinsic.

        `cov_extrinsics` is the covariance of the extrinsics, tangents in the order of `keys`.
        """
        split = len(self.b) - 6 * self.extrinsics
        start = self.offset(key)
        which = slice(start, start + self.sizes[self.keys.index(key)])
        own = scipy.linalg.cho_solve(self._rest_factor(), np.eye(split)[:, which])
        follows = own.T @ self.H[:split, split:]
        return np.asarray(own[which] + follows @ cov_extrinsics @ follows.T)

    def schur(self) -> tuple[Array, Array, Array, Array]:
        """Eliminates everything but the extrinsics.

        Returns D (6n, 6n) and c (6n,) of the reduced quadratic; and G, g with which the eliminated
        variables follow: `d_rest = g - G d_extrinsics`.

        Raises:
            SolveError: the rest is singular.
        """
        split = len(self.b) - 6 * self.extrinsics
        known = np.column_stack([self.H[:split, split:], self.b[:split]])
        both = scipy.linalg.cho_solve(self._rest_factor(), known, check_finite=False)
        G, g = both[:, :-1], both[:, -1]
        D = self.H[split:, split:] - self.H[split:, :split] @ G
        c = self.b[split:] - self.H[split:, :split] @ g
        return 0.5 * (D + D.T), c, G, g

    def _rest_factor(self) -> tuple[Array, bool]:
        """Cholesky factor of everything but the extrinsics; SolveError if it is singular."""
        split = len(self.b) - 6 * self.extrinsics
        rest = self.H[:split, :split].copy()
        diagonal = np.arange(split)
        rest[diagonal, diagonal] *= 1.0 + GAUGE
        try:
            return scipy.linalg.cho_factor(rest, lower=True, check_finite=False)
        except scipy.linalg.LinAlgError:
            raise SolveError(
                "the graph without extrinsics is singular: a pose or a target has no measurement"
            ) from None


def dense_system(problem: Problem, graph: CalibrationGraph, values: gtsam.Values) -> DenseSystem:
    """Linearises `graph` at `values` and eliminates the Gauss-Markov pose errors.

    These form chains, which GTSAM eliminates sparsely, and are linear: their values do not matter.
    Variables of the problem without a factor get zero rows; other variables of the graph are kept.
    """
    extrinsics = problem.extrinsic_keys()
    drifts = set(problem.pose_error_keys())
    linear = graph.others.linearize(values)
    own = set(graph.others.keyVector())
    touched = own.union(*(gaussian.keys for gaussian in graph.gaussians))
    known = (*problem.pose_keys(), *problem.target_keys())
    others = sorted(touched - drifts - {*known, *extrinsics})
    keys = (*known, *others, *extrinsics)
    zero = values.zeroVectors()
    sizes = tuple(6 if key in known or key in extrinsics else zero.at(key).size for key in keys)
    chains = [key for key in problem.pose_error_keys() if key in own]
    if chains:
        try:
            _, linear = linear.eliminatePartialMultifrontal(chains)
        except RuntimeError as e:
            raise SolveError(f"the given poses: {str(e).splitlines()[0]}") from None
    size = sum(sizes)
    H, b = np.zeros((size, size)), np.zeros(size)
    out = DenseSystem(keys, sizes, H, b, len(extrinsics))
    order = [key for key in keys if key in own and key not in drifts]
    if order:
        ordering = gtsam.Ordering()
        for key in order:
            ordering.push_back(key)
        H_part, b_part = linear.hessian(ordering)
        where = out.coordinates(order)
        H[np.ix_(where, where)] = H_part
        b[where] = np.asarray(b_part).ravel()
    for gaussian in graph.gaussians:
        where = out.coordinates(gaussian.keys)
        H_part, b_part = gaussian.at(values)
        H[np.ix_(where, where)] += H_part
        b[where] += b_part
    return out


def add_shape(
    system: DenseSystem, lines: CloudLinearisation, H_clouds: Array, gradient: Array
) -> DenseSystem:
    """Adds a quadratic on the poses of all clouds, `d^T H d / 2 + g^T d` (left perturbations).

    `lines` says how the poses move with the variables, `H_clouds` is (6 J, 6 J), `gradient` (6 J,).
    A common motion of a target's clouds is a gauge freedom of it: GAUGE_PRIOR holds the frame.
    """
    J = cloud_rows(system, lines)
    return _with_rows(system, J, J.T @ H_clouds, gradient)


def _with_rows(
    system: DenseSystem, J: scipy.sparse.csr_array, seen: Array, gradient: Array
) -> DenseSystem:
    """Adds the clouds' quadratic; J (6 J, M) their rows, `seen` = `J^T H`."""
    H = system.H + (J.T @ seen.T)
    add_gauge_prior(H, system.starts)
    return replace(system, H=H, b=system.b - J.T @ gradient)


def cloud_rows(system: DenseSystem, lines: CloudLinearisation) -> scipy.sparse.csr_array:
    """(6 J, M) derivatives of the poses of all clouds with respect to the variables of a system.

    Left perturbations of the predicted T_target_lidar by right perturbations of the variables.
    """
    nothing = np.zeros(0, dtype=np.int64)
    rows, columns, entries = [nothing], [nothing], [np.zeros(0)]
    for j, (keys, jacobians) in enumerate(zip(lines.keys, lines.jacobians, strict=True)):
        for key, jacobian in zip(keys, jacobians, strict=True):
            row, column = np.indices(jacobian.shape)
            rows.append((6 * j + row).ravel())
            columns.append((system.offset(key) + column).ravel())
            entries.append(jacobian.ravel())
    # Every cloud depends on four or five variables of hundreds.
    return scipy.sparse.csr_array(
        (np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))),
        shape=(6 * len(lines.keys), len(system.b)),
    )


def adjusted_residuals(
    system: DenseSystem, lines: CloudLinearisation, H_clouds: Array, residuals: Array
) -> tuple[Array, Array]:
    """Residuals of the clouds adjusted for the estimation of all variables, and their covariance.

    `W` is the information on an error in the measured poses; it is zero along what poses, targets
    and extrinsics can absorb (`caliv_graph/calibration/README.md`, "Data snooping").

    Args:
        system: the rest of the graph, which determines all variables together with the clouds.
        lines: how the clouds' poses move with the variables.
        H_clouds: (6 J, 6 J) joint information of the measured poses.
        residuals: (J, 6) `Log(predicted measured^-1)`.

    Returns:
        (6 J, 6 J) W and (6 J,) v, the gradient at the solution.

    Raises:
        SolveError: a variable is unobservable.
    """
    gradient = H_clouds @ residuals.ravel()
    J = cloud_rows(system, lines)
    seen = J.T @ H_clouds
    full = _with_rows(system, J, seen, gradient)
    try:
        factor = scipy.linalg.cho_factor(full.H, lower=True)
    except scipy.linalg.LinAlgError:
        raise SolveError(
            "the graph of the registered clouds is singular: a pose or a target has no measurement"
        ) from None
    W = H_clouds - seen.T @ scipy.linalg.cho_solve(factor, seen)
    return W, gradient + seen.T @ scipy.linalg.cho_solve(factor, full.b)


def add_gauge_prior(H: Array, starts: Mapping[int, int]) -> None:
    """Adds GAUGE_PRIOR to the frames of the targets in H (M, M), in place; `starts` by variable."""
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
