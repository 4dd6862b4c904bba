"""Derivatives of the smoother's residuals by parameters of its input (`README.md`, section 13)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np

from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.build import TrajectoryGraph, build_graph
from caliv_graph.trajectory.inputs import SmootherInput
from caliv_graph.trajectory.parameters import InputParameter
from caliv_graph.trajectory.smoothed import States


def parameter_columns(
    data: SmootherInput,
    nodes: IntArray,
    states: States,
    graph: TrajectoryGraph,
    values: gtsam.Values,
    dropped: IntArray,
    parameters: Sequence[InputParameter],
) -> Array:
    """(rows, p) derivatives of all whitened residuals, in order of the factors.

    Args:
        data: the input that `graph` was built of.
        nodes: (n,) stamps.
        states: the estimate; its biases carry the measurements.
        graph: its factors have the noise models that whiten.
        values: where the residuals are evaluated.
        dropped: (k,) indices of the fixes that the graph is without.
        parameters: whose coordinates follow each other.

    Raises:
        ValueError: a parameter changes how many factors there are.
    """
    sizes = [graph.factors.at(i).dim() for i in range(graph.factors.size())]
    starts = np.cumsum([0, *sizes])
    out = np.zeros((int(starts[-1]), sum(p.size for p in parameters)))
    column = 0
    for parameter in parameters:
        touched = [i for i, kind in enumerate(graph.kinds) if kind in parameter.kinds]
        for k in range(parameter.size):
            ahead, behind = (
                _errors(parameter.stepped(data, k, sign), nodes, states, values, dropped, parameter)
                for sign in (1.0, -1.0)
            )
            if not len(ahead) == len(behind) == len(touched):
                raise ValueError(f"{parameter.name}: moved by a step, it has other factors")
            for i, after, before in zip(touched, ahead, behind, strict=True):
                change = (after - before) / (2.0 * parameter.steps[k])
                factor = graph.factors.at(i)
                out[starts[i] : starts[i + 1], column] = whitened(factor, values, change)
            column += 1
    return out


def _errors(
    data: SmootherInput,
    nodes: IntArray,
    states: States,
    values: gtsam.Values,
    dropped: IntArray,
    parameter: InputParameter,
) -> list[Array]:
    """Unwhitened residuals of the factors that a parameter touches; kernels do not matter."""
    graph = build_graph(data, nodes, states, dropped, "none", parameter.kinds).factors
    factors: list[Any] = [graph.at(i) for i in range(graph.size())]
    return [factor.unwhitenedError(values) for factor in factors]


def whitened(factor: Any, values: gtsam.Values, change: Array) -> Array:
    """A change of the residual, whitened as `linearize` does: with the root of a robust weight."""
    noise = factor.noiseModel()
    residual = noise.unweightedWhiten(factor.unwhitenedError(values))
    return np.asarray(noise.unweightedWhiten(change) * math.sqrt(noise.weight(residual)))
