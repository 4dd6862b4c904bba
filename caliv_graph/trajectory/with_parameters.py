"""More parameters of the input in the chain of a trajectory (`README.md`, section 13)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from caliv_graph.trajectory.columns import columns_of
from caliv_graph.trajectory.correlated_step import chain_with_errors
from caliv_graph.trajectory.parameters import InputParameter, UncertainParameter
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.solve import chain_of
from caliv_graph.trajectory.uncertain import Settled


def with_parameters(
    smoothed: SmoothedTrajectory, parameters: Sequence[InputParameter]
) -> SmoothedTrajectory:
    """The trajectory with more parameters in its chain, without a prior: none is estimated.

    `joint` of the result can be asked for their information and gradient. Those that the chain has
    already stay as they are. The chain of the result has all nodes.
    """
    known = {p.parameter.name for p in smoothed.parameters}
    more = tuple(UncertainParameter(p) for p in parameters if p.name not in known)
    if not more and smoothed.chain_nodes is None:
        return smoothed
    return linearised(replace(smoothed, parameters=(*smoothed.parameters, *more)))


def linearised(smoothed: SmoothedTrajectory) -> SmoothedTrajectory:
    """The trajectory with the chain of its motion data at its states, of all nodes."""
    every, estimate = smoothed.parameters, smoothed.estimate()
    columns = columns_of(smoothed, estimate, [p.parameter for p in every])
    linear = estimate.graph.factors.linearize(estimate.values)
    if smoothed.correlated:
        settled = Settled(smoothed.data, estimate, every, columns)
        chain = chain_with_errors(
            settled, linear, smoothed.nodes_ns, smoothed.correlated, smoothed.errors
        )
    else:
        chain = chain_of(linear, len(smoothed.nodes_ns), smoothed.data.yaw_bias, columns)
    return replace(smoothed, chain=chain, chain_nodes=None)
