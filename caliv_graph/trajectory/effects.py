"""What an error of a sensor that is correlated over time does to the smoothed poses.

The smoother is a linear estimator near its solution: its poses move with the error by a fixed gain.
So the covariance of the poses under any such error is known without smoothing again (a consider
covariance; Schmidt 1966), and its level can be estimated from what the LiDARs see.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from caliv_graph.conventions import key_yaw_bias
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.chain import POSE, STATE, Chain, beside
from caliv_graph.trajectory.chain_solution import inverse_in_blocks, solved_in_blocks
from caliv_graph.trajectory.columns import columns_of
from caliv_graph.trajectory.correlated import AXES, linearised_in_parts
from caliv_graph.trajectory.parameters import UncertainParameter
from caliv_graph.trajectory.smoothed import JointInformation, SmoothedTrajectory
from caliv_graph.trajectory.suspects import suspect_parameters

STEP_NS = 500_000_000
"""The error is taken to be constant over this: a quarter of the shortest correlation time that is
looked for, and five times fewer numbers than with a step at every node."""


@dataclass(frozen=True)
class ErrorEffects:
    """Gain of the smoothed poses on one sensor's error.

    Attributes:
        kind: of the sensor's factors.
        stamps_ns: (n,) middles of the steps over which the error is taken to be constant.
        gain: (6 m, 3, n) right perturbations of m vehicle poses, rotation then translation, by the
            error in each step, along each axis of the map.
    """

    kind: str
    stamps_ns: IntArray
    gain: Array


def error_effects(
    trajectory: SmoothedTrajectory, stamps_ns: Sequence[int], kinds: Sequence[str]
) -> tuple[ErrorEffects, ...]:
    """The effects of each kind of error on the poses at wanted stamps (m,), increasing.

    `trajectory` is without errors that are correlated over time.

    Raises:
        KeyError: a stamp has no node.
    """
    if not kinds:
        return ()
    i = trajectory.node_indices(stamps_ns)
    n, width = len(trajectory.nodes_ns), STATE + AXES * len(kinds)
    common = [] if trajectory.yaw_bias is None else [key_yaw_bias()]
    estimate, R = trajectory.estimate(), trajectory.states.R_map_imu
    linear = estimate.graph.factors.linearize(estimate.values)
    of_factors = estimate.graph.kinds
    del estimate
    both = Chain.zero(n, width, len(common))
    for _, J, _ in linearised_in_parts(linear, of_factors, kinds, R, common):
        both.add(J)
    del linear
    wanted = (STATE * i[:, None] + np.arange(POSE)).ravel()
    first, middle = error_steps(trajectory.nodes_ns)
    gains = np.empty((len(kinds), len(wanted), AXES, len(first)))
    # Some poses at a time: for all nodes of a long drive the columns would take gigabytes.
    for block, inverse in inverse_in_blocks(both.leading(STATE), wanted):
        by_state = inverse[: n * STATE].reshape(n, STATE, -1)
        for number in range(len(kinds)):
            of_error = slice(STATE + AXES * number, STATE + AXES * (number + 1))
            # An error of a sensor acts at its own node: the coupling of neighbours has none.
            gain = np.einsum("nwp,nwa->pan", by_state, both.diagonal[:, :STATE, of_error])
            gain += np.einsum("kp,nak->pan", inverse[n * STATE :], both.border[:, of_error])
            gains[number, block] = np.add.reduceat(gain, first, 2)
    Ad = np.asarray(trajectory.T_vehicle_imu.AdjointMap())
    turned = Ad @ gains.reshape(len(kinds), len(i), POSE, -1)
    pairs = zip(kinds, turned.reshape(gains.shape), strict=True)
    return tuple(ErrorEffects(kind, middle, gain) for kind, gain in pairs)


def poses_and_gain(
    smoothed: SmoothedTrajectory,
    stamps_ns: Sequence[int] | IntArray,
    kinds: Sequence[str],
    until_ns: int | None = None,
) -> tuple[JointInformation, Array]:
    """The Gaussian of m vehicle poses, and their gain (6 m, 3 k s) on errors of k kinds in s steps.

    The steps are those that begin at nodes up to `until_ns`; None: all of the drive.

    The poses that the data mean are at minus the gain per unit of an error. Columns are by kind,
    then by axis of the map, then by step, as in `ErrorLikelihood`. Inputs that could be wrong are
    eliminated, as there: a lever arm that was typed wrong is no error of the fixes. `smoothed` is
    without errors that are correlated over time.

    Raises:
        KeyError: a stamp has no node.
    """
    parameters = _with_free_suspects(smoothed)
    i, of = smoothed.node_indices(stamps_ns), [p.parameter for p in parameters]
    n, width = len(smoothed.nodes_ns), STATE + AXES * len(kinds)
    common = [] if smoothed.yaw_bias is None else [key_yaw_bias()]
    estimate, R = smoothed.estimate(), smoothed.states.R_map_imu
    linear = estimate.graph.factors.linearize(estimate.values)
    columns, of_factors = columns_of(smoothed, estimate, of), estimate.graph.kinds
    del estimate
    with_right = Chain.zero(n, width, len(common) + columns.shape[1] + 1)
    for rows, J, r in linearised_in_parts(linear, of_factors, kinds, R, common):
        with_right.add(beside(J, np.column_stack([columns[rows], -r])))
    del linear
    chain = with_right.leading(STATE)
    with_suspects = replace(smoothed, chain=chain, chain_nodes=None, parameters=parameters)
    joint = with_suspects.joint(stamps_ns)
    own = np.arange(len(common) + columns.shape[1])
    both = replace(
        with_right,
        border=with_right.border[:, :, own],
        corner=with_right.corner[np.ix_(own, own)],
    )
    free = own[len(common) :]
    both.corner[free, free] += np.concatenate(
        [np.zeros(0), *(np.square(1.0 / np.asarray(p.sigmas)) for p in parameters)]
    )
    first, _ = error_steps(smoothed.nodes_ns)
    steps = int(np.count_nonzero(smoothed.nodes_ns[first] <= (until_ns or smoothed.nodes_ns[-1])))
    # Nodes after all that is asked for are eliminated once, not solved for in every column.
    n = max(int(first[steps]) if steps < len(first) else n, int(i[-1]) + 1)
    states, first = both.leading(STATE).head(n), first[first < n]
    errors = ErrorsByStep(both.part(slice(0, n)), first, steps)
    # A parameter that moves T_vehicle_imu moves the vehicle, the IMU being where it is.
    moves = np.hstack([np.zeros((POSE, 0)), *(p.imu_moves(smoothed.data) for p in of)])
    Ad = np.asarray(smoothed.T_vehicle_imu.AdjointMap())
    gain = np.empty((len(i), POSE, errors.count))
    for block, solution in solved_in_blocks(states, errors.columns, errors.count):
        of_imu = solution[: n * STATE].reshape(n, STATE, -1)[i, :POSE]
        gain[:, :, block] = Ad @ (of_imu - moves @ solution[n * STATE + len(common) :])
    return joint, gain.reshape(POSE * len(i), -1)


def _with_free_suspects(smoothed: SmoothedTrajectory) -> tuple[UncertainParameter, ...]:
    """Parameters under priors: the suspects under those that hold nothing, about their values."""
    free = [UncertainParameter(s.parameter, s.scale) for s in suspect_parameters(smoothed)]
    names = {p.parameter.name for p in free}
    known = (p for p in smoothed.parameters if p.parameter.name not in names)
    return (*free, *(p for p in known if p.sigmas is not None))


class ErrorsByStep:
    """The information between states with common coordinates and errors by step.

    (n STATE + k, e s) of e coordinates of errors in the first s steps, by coordinate, then by step.
    An error of a sensor acts at its own node: the coupling of neighbours has none.
    """

    def __init__(self, both: Chain, first: IntArray, steps: int) -> None:
        """Of a chain that has e coordinates of errors after those of each state.

        Args:
            both: the chain.
            first: first nodes of all steps of the drive.
            steps: of them, the first ones that are wanted.
        """
        n, width = both.diagonal.shape[:2]
        k, e = len(both.corner), width - STATE
        self.count = e * steps
        self._mixed = both.diagonal[:, STATE:, :STATE]
        step = np.searchsorted(first, np.arange(n), "right") - 1
        self._column = np.where(step < steps, step, -self.count)[:, None] + steps * np.arange(e)
        border = np.add.reduceat(both.border[:, STATE:], first, 0)[:steps]
        self.border: Array = border.transpose(2, 1, 0).reshape(k, self.count)

    def columns(self, block: slice) -> Array:
        """(n STATE + k, b) a slice of the columns."""
        nodes, axes = np.nonzero((self._column >= block.start) & (self._column < block.stop))
        n = len(self._column)
        out = np.zeros((n * STATE + len(self.border), block.stop - block.start))
        by_state = out[: n * STATE].reshape(n, STATE, -1)
        by_state[nodes, :, self._column[nodes, axes] - block.start] = self._mixed[nodes, axes]
        out[n * STATE :] = self.border[:, block]
        return out


def error_steps(nodes_ns: IntArray) -> tuple[IntArray, IntArray]:
    """First nodes (m,) of the steps over which an error is taken to be constant, and middles (m,).

    `nodes_ns` (n,) are stamps; the middles too.
    """
    step = (nodes_ns - nodes_ns[0]) // STEP_NS
    first = np.flatnonzero(np.diff(step, prepend=-1))
    return first, nodes_ns[0] + step[first] * STEP_NS + STEP_NS // 2


def smoothed_in_time(rows: Array, stamps_ns: IntArray, time_s: float) -> Array:
    """(r, n) rows times the correlation matrix of a first-order Gauss-Markov error at n stamps.

    The matrix is `exp(-|t_i - t_j| / time_s)`: a recursion forwards and one backwards.
    """
    decay = np.exp(-np.diff(stamps_ns) * 1e-9 / time_s)
    forward, backward = rows.T.copy(), rows.T.copy()
    for i, d in enumerate(decay.tolist(), start=1):
        forward[i] += d * forward[i - 1]
    for i in range(len(decay) - 1, -1, -1):
        backward[i] += decay[i] * backward[i + 1]
    return np.asarray((forward + backward).T - rows)
