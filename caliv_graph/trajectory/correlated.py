"""Errors of a sensor that are correlated over time: first-order Gauss-Markov, three map axes.

A correlated error of the fixes moves them as a shift of the pose along the map's axes does, one of
the orientations as a turn about them. So the error is three more coordinates of every state, its
derivative that of the pose in the sensor's own factors, its prior a chain (`README.md`, section 9).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
import scipy.sparse

from caliv_graph.conventions import key_bias, key_imu, key_velocity
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.chain import FACTORS_AT_A_TIME, STATE, Chain, jacobian, places

DIMENSIONS = (6, 3, 6)
"""Of the pose, the velocity and the bias of a state."""

AXES = 3
"""Coordinates of a correlated error."""

MOVES = {"gnss": slice(3, 6), "orientation": slice(0, 3)}
"""Kind of factor -> the coordinates of the pose that an error of its sensor is taken for."""

GROUPS: Mapping[str, tuple[tuple[int, ...], ...]] = {
    "gnss": ((0, 1), (2,)),
    "orientation": ((0, 1), (2,)),
}
"""Kind of factor -> the map axes along which the errors of its sensor are as large."""


@dataclass(frozen=True)
class CorrelatedError:
    """A first-order Gauss-Markov error of one sensor.

    Attributes:
        kind: of the sensor's factors, a key of `MOVES`.
        sigmas: (3,) 1 sigma along the map's axes, metres or radians.
        time_s: correlation time.
    """

    kind: str
    sigmas: tuple[float, float, float]
    time_s: float


def unit_information(nodes_ns: IntArray, time_s: float) -> tuple[Array, Array, float]:
    """A stationary first-order Gauss-Markov sequence of unit sigma at n nodes.

    Returns:
        (n,) diagonal and (n - 1,) next entries of its information, and its log-determinant.
    """
    decay = np.exp(-np.diff(nodes_ns) * 1e-9 / time_s)
    step = 1.0 / (1.0 - decay**2)
    diagonal = np.ones(len(nodes_ns))
    diagonal[1:] = step
    diagonal[:-1] += decay**2 * step
    return diagonal, -decay * step, float(np.log(step).sum())


def with_columns(
    J: scipy.sparse.csr_array,
    graph: gtsam.GaussianFactorGraph,
    kinds: Sequence[str],
    errors: Sequence[str],
    R_map_imu: Array,
    width: int,
) -> scipy.sparse.csr_array:
    """A whitened Jacobian with the columns of correlated errors.

    Args:
        J: (m, size) of the graph, with empty columns for the errors: the last ones of each state.
        graph: linear, its rows those of J.
        kinds: of its factors.
        errors: kinds of the sensors with a correlated error, in the order of their coordinates.
        R_map_imu: (n, 3, 3) rotations at which it was linearised.
        width: coordinates of a state.
    """
    nodes = {key_imu(i): i for i in range(len(R_map_imu))}
    data: list[Array] = []
    rows: list[Array] = []
    columns: list[Array] = []
    at = 0
    for number, kind in enumerate(kinds):
        factor: Any = graph.at(number)
        m = factor.rows()
        if kind in errors:
            i = next(nodes[key] for key in map(int, factor.keys()) if key in nodes)
            first = MOVES[kind].start
            block = J[at : at + m, width * i + first : width * i + first + AXES].toarray()
            place = width * (i + 1) - AXES * (len(errors) - errors.index(kind))
            data.append((block @ R_map_imu[i].T).ravel())
            rows.append(np.repeat(np.arange(at, at + m), AXES))
            columns.append(np.tile(place + np.arange(AXES), m))
        at += m
    if not data:
        return J
    where = np.concatenate(rows), np.concatenate(columns)
    more = scipy.sparse.coo_array((np.concatenate(data), where), shape=J.shape)
    return scipy.sparse.csr_array(J + more)


def linearised_in_parts(
    graph: gtsam.GaussianFactorGraph,
    kinds: Sequence[str],
    errors: Sequence[str],
    R_map_imu: Array,
    common_keys: Sequence[int],
) -> Iterator[tuple[slice, scipy.sparse.csr_array, Array]]:
    """Rows of a linear graph over n nodes, errors beside each state, some factors at a time.

    Yields which rows they are, their whitened Jacobian and residuals. All at once take 6 MB per
    minute of drive. Arguments as in `with_columns`; `common_keys` are of the variables that all
    states share.
    """
    n, width = len(R_map_imu), STATE + AXES * len(errors)
    keys = [(key_imu(i), key_velocity(i), key_bias(i)) for i in range(n)]
    place = places(keys, DIMENSIONS, common_keys, width)
    first = 0
    for begin in range(0, graph.size(), FACTORS_AT_A_TIME):
        some = gtsam.GaussianFactorGraph()
        for number in range(begin, min(begin + FACTORS_AT_A_TIME, graph.size())):
            some.push_back(graph.at(number))
        J, r = jacobian(some, place, n * width + len(common_keys))
        own = kinds[begin : begin + FACTORS_AT_A_TIME]
        rows = slice(first, first + len(r))
        yield rows, with_columns(J, some, own, errors, R_map_imu, width), r
        first = rows.stop


def linearised(
    graph: gtsam.GaussianFactorGraph,
    kinds: Sequence[str],
    errors: Sequence[str],
    R_map_imu: Array,
    common_keys: Sequence[int],
) -> tuple[scipy.sparse.csr_array, Array]:
    """All rows of `linearised_in_parts`: whitened Jacobian and residuals."""
    parts = list(linearised_in_parts(graph, kinds, errors, R_map_imu, common_keys))
    J = scipy.sparse.csr_array(scipy.sparse.vstack([J for _, J, _ in parts]))
    return J, np.concatenate([r for *_, r in parts])


def add_prior(chain: Chain, nodes_ns: IntArray, errors: Sequence[CorrelatedError]) -> None:
    """Adds the prior of correlated errors, the last coordinates of each state, in place."""
    width = chain.diagonal.shape[1]
    for number, error in enumerate(errors):
        diagonal, next_, _ = unit_information(nodes_ns, error.time_s)
        for axis, sigma in enumerate(error.sigmas):
            c = width - AXES * (len(errors) - number) + axis
            chain.diagonal[:, c, c] += diagonal / sigma**2
            chain.coupling[:, c, c] += next_ / sigma**2
