"""The estimate with errors of sensors that are correlated over time (`README.md`, section 9).

One linear step from the estimate without them. An error of decimetres turns the vehicle by
milliradians: what is neglected is below a micrometre.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from caliv_graph.conventions import key_yaw_bias
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.build import Estimate, build_graph, from_values
from caliv_graph.trajectory.chain import POSE, STATE, Chain, beside
from caliv_graph.trajectory.chain_solution import ChainSolution, solved
from caliv_graph.trajectory.columns import parameter_columns
from caliv_graph.trajectory.correlated import AXES, CorrelatedError, add_prior, linearised_in_parts
from caliv_graph.trajectory.solve import step_of, without_right_side
from caliv_graph.trajectory.uncertain import Settled, moved


@dataclass(frozen=True)
class WithErrors:
    """An estimate with correlated errors.

    Attributes:
        settled: states and parameters.
        errors: (n, 3 e) of the sensors at the nodes, map axes, metres or radians.
        cov: (n, 6, 6) covariances of the vehicle's poses at the nodes, parameters included.
        chain: the information, as `chain_with_errors` has it.
    """

    settled: Settled
    errors: Array
    cov: Array
    chain: Chain


def step_with_errors(
    settled: Settled,
    linear: gtsam.GaussianFactorGraph,
    nodes: IntArray,
    dropped: IntArray,
    errors: Sequence[CorrelatedError],
) -> WithErrors:
    """The estimate moved by one step of states, parameters and correlated errors together.

    Args:
        settled: without the errors.
        linear: its graph, linearised.
        nodes: (n,) stamps.
        dropped: (k,) indices of fixes that are left out.
        errors: at least one.

    Raises:
        TrajectoryError: the graph is singular.
    """
    data, estimate, n = settled.data, settled.estimate, len(nodes)
    none = np.zeros((n, AXES * len(errors)))
    start = chain_with_errors(settled, linear, nodes, errors, none)
    first = 1 if data.yaw_bias else 0
    found = _solved_with_priors(settled, start)
    width = STATE + AXES * len(errors)
    by_node, common = found.step[: n * width].reshape(n, width), found.step[n * width :]
    parameters = settled.parameters
    if parameters:
        data, parameters = moved(data, parameters, common[first:])
    values = estimate.values.retract(step_of(by_node, common, bool(first)))
    states = from_values(values, n, data)
    graph = build_graph(data, nodes, states, dropped, data.config.robust.kernel)
    columns = None
    if parameters:
        of = [p.parameter for p in parameters]
        columns = parameter_columns(data, nodes, states, graph, values, dropped, of)
    after = Settled(
        data,
        Estimate(states, graph, values, states),
        parameters,
        columns,
        found.cov_corner[first:, first:],
    )
    linear = graph.factors.linearize(values)
    estimated = by_node[:, STATE:]
    return WithErrors(
        settled=after,
        errors=estimated,
        cov=_of_vehicle(after, found.cov[:, :POSE, :POSE], found.cov_border[:, :POSE, first:]),
        chain=chain_with_errors(after, linear, nodes, errors, estimated),
    )


def covariances_with_parameters(settled: Settled, chain: Chain) -> Array:
    """(n, 6, 6) covariances of the vehicle's poses, without correlated errors.

    `chain` is that of the settled graph and its columns (`solve.chain_of`).

    Raises:
        TrajectoryError: the graph is singular.
    """
    first = 1 if settled.data.yaw_bias else 0
    found = _solved_with_priors(settled, chain)
    return _of_vehicle(settled, found.cov[:, :POSE, :POSE], found.cov_border[:, :POSE, first:])


def _solved_with_priors(settled: Settled, start: Chain) -> ChainSolution:
    """The solution of a chain with a right-hand side, the priors of the parameters included."""
    chain, gradient = without_right_side(start)
    if settled.parameters:
        first = 1 if settled.data.yaw_bias else 0
        at = np.arange(first, len(chain.corner))
        weight = np.concatenate([np.asarray(p.sigmas) for p in settled.parameters]) ** -2
        chain.corner[at, at] += weight
        offset = np.concatenate([np.asarray(p.offset) for p in settled.parameters])
        gradient[len(gradient) - len(at) :] += weight * offset
    return solved(chain, gradient)


def _of_vehicle(settled: Settled, cov_imu: Array, cross: Array) -> Array:
    """(n, 6, 6) covariances of the vehicle's poses.

    `cov_imu` (n, 6, 6) is that of the IMU's poses, `cross` (n, 6, p) theirs with the parameters. X
    = I T_vehicle_imu^-1: the vehicle also moves where a parameter is that transform.
    """
    data = settled.data
    total = cov_imu
    if settled.parameters:
        moves = np.hstack([p.parameter.imu_moves(data) for p in settled.parameters])
        mixed = cross @ moves.T
        total = total - mixed - np.swapaxes(mixed, 1, 2) + moves @ settled.cov @ moves.T
    Ad = np.asarray(data.T_vehicle_imu.AdjointMap())
    return np.asarray(Ad @ total @ Ad.T)


def chain_with_errors(
    settled: Settled,
    linear: gtsam.GaussianFactorGraph,
    nodes: IntArray,
    errors: Sequence[CorrelatedError],
    estimated: Array,
) -> Chain:
    """The information about an estimate, the errors as the last coordinates of every state.

    Common coordinates are those of `solve.chain_of`: the yaw bias if there is one, the parameters,
    and the right-hand side, the priors of the errors included.

    Args:
        settled: the estimate and the columns of its parameters.
        linear: its graph, linearised.
        nodes: (n,) stamps.
        errors: at least one.
        estimated: (n, 3 e) their estimates.
    """
    estimate, n = settled.estimate, len(nodes)
    common = [key_yaw_bias()] if settled.data.yaw_bias else []
    names = [error.kind for error in errors]
    R = estimate.states.R_map_imu
    width = STATE + AXES * len(errors)
    of_errors = np.zeros((n, width))
    of_errors[:, STATE:] = estimated
    columns = settled.columns
    extra = 0 if columns is None else columns.shape[1]
    chain = Chain.zero(n, width, len(common) + extra + 1)
    for rows, J, r in linearised_in_parts(linear, estimate.graph.kinds, names, R, common):
        residuals = r + J[:, : n * width] @ of_errors.ravel()
        own = np.zeros((len(r), 0)) if columns is None else columns[rows]
        chain.add(beside(J, np.column_stack([own, -residuals])))
    prior = Chain.zero(n, width, 0)
    add_prior(prior, nodes, errors)
    pull = np.einsum("nij,nj->ni", prior.diagonal, of_errors)
    pull[:-1] += np.einsum("nij,nj->ni", prior.coupling, of_errors[1:])
    pull[1:] += np.einsum("nji,nj->ni", prior.coupling, of_errors[:-1])
    chain.border[:, :, -1] -= pull
    return replace(
        chain,
        diagonal=chain.diagonal + prior.diagonal,
        coupling=chain.coupling + prior.coupling,
    )
