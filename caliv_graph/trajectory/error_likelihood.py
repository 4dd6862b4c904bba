"""What motion data say of errors of sensors that are correlated over time (`README.md`, section 9).

All else is eliminated once. The likelihood of errors of any size and time then takes a matrix of
the size of the errors, and no other smoothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import scipy.linalg

from caliv_graph.conventions import key_yaw_bias
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.build import build_graph, to_values
from caliv_graph.trajectory.chain import STATE, Chain, beside
from caliv_graph.trajectory.chain_solution import solved_in_blocks
from caliv_graph.trajectory.columns import parameter_columns
from caliv_graph.trajectory.correlated import AXES, CorrelatedError, linearised
from caliv_graph.trajectory.effects import STEP_NS, ErrorsByStep, error_steps
from caliv_graph.trajectory.inputs import SmootherInput
from caliv_graph.trajectory.measurements import rotated, rotations_of, usable_orientations
from caliv_graph.trajectory.noise import orientation_covariances
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.states import first_nodes
from caliv_graph.trajectory.suspects import suspect_parameters
from caliv_graph.trajectory.variances import NODES

STEPS = 120
"""Steps of errors that are used: a minute. Memory grows with their square: on long drives, whose
nodes lie apart, `NODES` nodes would be five minutes and 0.3 GB more."""


@dataclass(frozen=True)
class ErrorLikelihood:
    """The motion data of a drive as a Gaussian on the errors of its sensors.

    Minus its logarithm is `b^T information b / 2 - gradient^T b`, b the errors in m steps: by kind,
    then by axis of the map, then by step.

    Attributes:
        kinds: of the sensors' factors.
        stamps_ns: (m,) of the steps over which an error is taken to be constant.
        information: (3 k m, 3 k m) of k kinds.
        gradient: (3 k m,).
    """

    kinds: tuple[str, ...]
    stamps_ns: IntArray
    information: Array
    gradient: Array

    def given(self, errors: Sequence[CorrelatedError]) -> ErrorLikelihood:
        """What is left to say of further errors where some are there, of known size."""
        mine = [error for error in errors if error.kind in self.kinds]
        if not mine:
            return self
        halves = [self._half(error) for error in mine]
        L = scipy.linalg.block_diag(*(half for _, half in halves))
        at = np.concatenate([columns for columns, _ in halves])
        across = self.information[:, at] @ L
        taken = np.linalg.solve(np.eye(len(at)) + L.T @ across[at], across.T)
        return replace(
            self,
            information=self.information - across @ taken,
            gradient=self.gradient - taken.T @ (L.T @ self.gradient[at]),
        )

    def told(self, information: Array, gradient: Array) -> ErrorLikelihood:
        """With what else is known of the errors, on their first steps as here or on more.

        `information` (3 k s, 3 k s) and `gradient` (3 k s,) are as those of the class, in s steps.
        Errors beyond the steps of here are taken for none.
        """
        k = AXES * len(self.kinds)
        m, s = len(self.stamps_ns), len(gradient) // k
        own = (s * np.arange(k)[:, None] + np.arange(m)).ravel()
        return replace(
            self,
            information=self.information + information[np.ix_(own, own)],
            gradient=self.gradient + gradient[own],
        )

    def gains(self, error: CorrelatedError, sizes: Array) -> Array:
        """(s,) log-likelihood of an error with its sigmas times sizes (s,), less that of none."""
        if error.kind not in self.kinds:
            return np.zeros(len(sizes))
        at, L = self._half(error)
        values, axes = np.linalg.eigh(L.T @ self.information[np.ix_(at, at)] @ L)
        pull = (axes.T @ (L.T @ self.gradient[at])) ** 2
        variance = np.square(sizes)[:, None]
        wider = 1.0 + variance * np.maximum(values, 0.0)
        return np.asarray(0.5 * (variance * pull / wider - np.log(wider)).sum(axis=1))

    def _half(self, error: CorrelatedError) -> tuple[IntArray, Array]:
        """Coordinates of an error, and a square root of its covariance."""
        apart = np.abs(self.stamps_ns[:, None] - self.stamps_ns) * 1e-9
        half = np.linalg.cholesky(np.exp(-apart / error.time_s))
        m = AXES * len(self.stamps_ns)
        first = m * self.kinds.index(error.kind)
        spread: Array = scipy.linalg.block_diag(*(sigma * half for sigma in error.sigmas))
        return np.arange(first, first + m, dtype=np.int64), spread


def error_likelihood(smoothed: SmoothedTrajectory, kinds: Sequence[str]) -> ErrorLikelihood:
    """What the first minute of a drive says of errors of its sensors.

    `smoothed` is without errors that are correlated over time. Inputs that could be wrong are
    eliminated too: a lever arm that was typed wrong is no error of the fixes.

    Raises:
        TrajectoryError: the motion data leave the trajectory undetermined.
    """
    data, nodes = smoothed.data, _first_minute(smoothed)
    states = first_nodes(smoothed.states, len(nodes))
    graph = build_graph(data, nodes, states, smoothed.gnss_dropped, "none")
    values = to_values(states, data)
    suspects = suspect_parameters(smoothed)
    of = [s.parameter for s in suspects]
    columns = parameter_columns(data, nodes, states, graph, values, smoothed.gnss_dropped, of)
    priors = np.concatenate([s.scale for s in suspects]) ** -2.0
    return eliminated(
        graph.factors.linearize(values),
        graph.kinds,
        [key_yaw_bias()] if data.yaw_bias else [],
        nodes,
        states.R_map_imu,
        kinds,
        columns,
        priors,
    )


def likelihood_end_ns(smoothed: SmoothedTrajectory) -> int:
    """Last stamp of which `error_likelihood` uses the data."""
    return int(_first_minute(smoothed)[-1])


def _first_minute(smoothed: SmoothedTrajectory) -> IntArray:
    nodes = smoothed.nodes_ns[:NODES]
    return np.asarray(nodes[nodes < nodes[0] + STEPS * STEP_NS])


def eliminated(
    graph: gtsam.GaussianFactorGraph,
    factor_kinds: Sequence[str],
    common_keys: Sequence[int],
    nodes_ns: IntArray,
    R_map_imu: Array,
    kinds: Sequence[str],
    columns: Array,
    priors: Array,
) -> ErrorLikelihood:
    """The Gaussian on errors that is left of a linear graph without them.

    Args:
        graph: whitened, over n nodes.
        factor_kinds: of its factors.
        common_keys: of the variables that all nodes share.
        nodes_ns: (n,) stamps.
        R_map_imu: (n, 3, 3) at which it was linearised.
        kinds: of the sensors whose errors are asked for.
        columns: (rows, p) derivatives of the residuals by parameters that are free.
        priors: (p,) their information.

    Raises:
        TrajectoryError: the graph is singular.
    """
    n, e = len(nodes_ns), AXES * len(kinds)
    width, k = STATE + e, len(common_keys) + len(priors)
    J, r = linearised(graph, factor_kinds, kinds, R_map_imu, common_keys)
    J = beside(J, columns)
    both, slope = Chain.zero(n, width, k), J.T @ r
    both.add(J)
    of_state, of_error = slice(0, STATE), slice(STATE, width)
    at = np.arange(len(common_keys), k)
    both.corner[at, at] += priors
    by_node = slope[: n * width].reshape(n, width)
    first, middles = error_steps(nodes_ns)
    m = len(first)
    errors = ErrorsByStep(both, first, m)
    mixed = both.diagonal[:, of_error, of_state]
    last = np.append(by_node[:, of_state], slope[n * width :])

    def right(block: slice) -> Array:
        of_errors = errors.columns(slice(block.start, min(block.stop, e * m)))
        return np.column_stack([of_errors, last]) if block.stop > e * m else of_errors

    taken = np.empty((e * m, e * m + 1))
    for block, solution in solved_in_blocks(both.leading(STATE), right, e * m + 1):
        # A dense product would take ten times as long: a step touches the states of few nodes.
        by_state = solution[: n * STATE].reshape(n, STATE, -1)
        near = np.add.reduceat(mixed @ by_state, first, 0)
        taken[:, block] = np.swapaxes(near, 0, 1).reshape(e * m, -1)
        taken[:, block] += errors.border.T @ solution[n * STATE :]
    own = np.zeros((e, m, e, m))
    blocks = np.add.reduceat(both.diagonal[:, of_error, of_error], first, 0)
    own[:, np.arange(m), :, np.arange(m)] = blocks
    information = own.reshape(e * m, e * m) - taken[:, :-1]
    pull = np.add.reduceat(by_node[:, of_error], first, 0).T.ravel() - taken[:, -1]
    return ErrorLikelihood(
        tuple(kinds), middles, np.asarray(0.5 * (information + information.T)), -pull
    )


def white_sigmas(data: SmootherInput, kind: str) -> Array:
    """(3,) median 1 sigma of one fix (m) or orientation (rad), as it is in use, map axes."""
    if kind == "gnss":
        assert data.positions is not None
        # Rough fixes have errors in common anyway.
        cov, scale = data.positions.cov_map[data.positions.shared == 1.0], 1.0
    else:
        imu = data.motion.imu
        assert imu is not None
        assert imu.orientation_xyzw is not None
        usable = usable_orientations(imu)
        R = rotations_of(imu.orientation_xyzw[usable])
        of_imu = orientation_covariances(imu, data.config)[0][usable]
        cov = rotated(R, of_imu)
        scale = data.scales.get("orientation", 1.0)
    return np.asarray(scale * np.sqrt(np.median(np.diagonal(cov, axis1=1, axis2=2), axis=0)))
