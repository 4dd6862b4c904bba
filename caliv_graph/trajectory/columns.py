"""Derivatives of the smoother's residuals by parameters of its input (`README.md`, section 13)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np

from caliv_graph.geometry.se3 import cross
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.build import Estimate, TrajectoryGraph, build_graph, from_values
from caliv_graph.trajectory.factors import position_residuals, velocity_residuals
from caliv_graph.trajectory.imu import DeadReckoning, Inertial, exp_so3, log_so3
from caliv_graph.trajectory.inputs import SmootherInput
from caliv_graph.trajectory.nodes import carry_to_nodes
from caliv_graph.trajectory.parameters import InputParameter
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.states import States, without_bias
from caliv_graph.trajectory.wheels import normal_of


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
    residuals = _Residuals(data, nodes, states, values, dropped)
    kinds = sorted(frozenset[str]().union(*(p.kinds for p in parameters)))
    whites = {kind: _Whitening.of(graph, kind, values, starts) for kind in kinds}
    column = 0
    for parameter in parameters:
        moving = [kind for kind in sorted(parameter.kinds) if whites[kind].factors]
        for k in range(parameter.size):
            # One input after the other: its dead reckoning is that of all kinds.
            after, before = (
                {kind: residuals.of(kind, moved) for kind in moving}
                for moved in (parameter.stepped(data, k, sign) for sign in (1.0, -1.0))
            )
            for kind in moving:
                white = whites[kind]
                if not len(after[kind]) == len(before[kind]) == len(white.factors):
                    raise ValueError(f"{parameter.name}: moved by a step, it has other factors")
                change = (after[kind] - before[kind]) / (2.0 * parameter.steps[k])
                out[white.rows, column] = np.einsum("mij,mj->mi", white.roots, change)
            column += 1
    return out


def columns_of(
    smoothed: SmoothedTrajectory, estimate: Estimate, parameters: Sequence[InputParameter]
) -> Array:
    """`parameter_columns` of a smoothed trajectory, at its `estimate()`."""
    return parameter_columns(
        smoothed.data,
        smoothed.nodes_ns,
        smoothed.states,
        estimate.graph,
        estimate.values,
        smoothed.gnss_dropped,
        parameters,
    )


@dataclass(frozen=True)
class _Whitening:
    """How the factors of one kind whiten, as `linearize` does: with the root of a robust weight.

    Attributes:
        factors: m indices into the graph.
        rows: (m, d) of their residuals.
        roots: (m, d, d), from the left.
    """

    factors: tuple[int, ...]
    rows: IntArray
    roots: Array

    @classmethod
    def of(
        cls, graph: TrajectoryGraph, kind: str, values: gtsam.Values, starts: IntArray
    ) -> _Whitening:
        """Of a kind whose factors have residuals of the same size; `starts` of all residuals."""
        factors = tuple(i for i, of in enumerate(graph.kinds) if of == kind)
        rows = [np.arange(starts[i], starts[i + 1]) for i in factors]
        roots = [whitening(graph.factors.at(i), values) for i in factors]
        return cls(factors, np.array(rows), np.array(roots))


def whitening(factor: Any, values: gtsam.Values) -> Array:
    """(d, d) root of the information of a residual, times that of its robust weight."""
    noise = factor.noiseModel()
    robust = isinstance(noise, gtsam.noiseModel.Robust)
    gaussian: Any = noise.noise() if robust else noise
    root = np.asarray(gaussian.R())
    if robust:
        root = root * math.sqrt(noise.weight(root @ factor.unwhitenedError(values)))
    return root


class _Residuals:
    """Unwhitened residuals of the factors of an input that has been moved; kernels do not matter.

    Those of positions and velocities are computed for all factors at once.
    """

    def __init__(
        self,
        data: SmootherInput,
        nodes: IntArray,
        states: States,
        values: gtsam.Values,
        dropped: IntArray,
    ) -> None:
        """Of an input that has not been moved, and states as in `parameter_columns`."""
        self._data, self._nodes, self._states = data, nodes, states
        self._values, self._dropped = values, dropped
        self._moved: tuple[Inertial, DeadReckoning] | None = None

    def of(self, kind: str, moved: SmootherInput) -> Array:
        """(m, d) residuals of the factors of a kind, in order, of a moved input."""
        if kind == "gnss":
            return self._of_positions(moved)
        if kind == "velocity":
            return self._of_velocities(moved)
        if kind == "imu" and moved.speed_scale != self._data.speed_scale:
            # Lengths of the motion's prior are in the unit of the wheels; nothing else moves it.
            by = np.ones(15)
            by[3:12] = moved.speed_scale / self._data.speed_scale
            return self._of_imu * by
        if kind == "imu":
            return self._of_inertial(moved)
        return self._of_graph(kind, moved)

    @cached_property
    def _of_imu(self) -> Array:
        return self._of_graph("imu", self._data)

    def _of_graph(self, kind: str, moved: SmootherInput) -> Array:
        every = (moved, self._nodes, self._states, self._dropped)
        graph = build_graph(*every, "none", frozenset({kind})).factors
        factors: list[Any] = [graph.at(i) for i in range(graph.size())]
        return np.array([factor.unwhitenedError(self._values) for factor in factors])

    def _of_inertial(self, moved: SmootherInput) -> Array:
        """Of the motion between nodes, as `CombinedImuFactor` has it; biases do not move.

        Dead reckoning, all intervals at once: another integration than that of the factors, from
        which the difference of two inputs is the same.
        """
        begin, end = self._nodes[:-1], self._nodes[1:]
        dR, dv, dp = self._dead_of(moved).between(begin, end)
        at, dt = self._at, ((end - begin) * 1e-9)[:, None]
        R, v, p = at.R_map_imu[:-1], at.velocity_map, at.p_map_imu
        back = np.swapaxes(at.R_map_imu[1:], 1, 2)
        g = np.array([0.0, 0.0, -moved.gravity_m_s2])
        miss_v = v[:-1] + g * dt + np.einsum("nij,nj->ni", R, dv) - v[1:]
        miss_p = p[:-1] + v[:-1] * dt + 0.5 * g * dt**2 + np.einsum("nij,nj->ni", R, dp) - p[1:]
        out = np.zeros((len(dt), 15))
        out[:, :3] = log_so3(back @ R @ dR)
        out[:, 3:6] = np.einsum("nij,nj->ni", back, miss_p)
        out[:, 6:9] = np.einsum("nij,nj->ni", back, miss_v)
        return out

    @cached_property
    def _level(self) -> States:
        """The states, with z of the axle's frame along the normal of the mean ground.

        Without an IMU it is the fixes that tell roll and pitch, with their noise. Turned by them,
        the arm of an antenna would be told by that noise: one that is longer explains more of it.
        """
        R = self._at.R_map_imu
        normal = normal_of(self._data.slope)
        turn = cross(R[:, :, 2], np.broadcast_to(normal, (len(R), 3)))
        return replace(self._at, R_map_imu=exp_so3(turn) @ R)

    @cached_property
    def _dead(self) -> DeadReckoning:
        return without_bias(self._data.inertial, self._nodes, self._states)

    @cached_property
    def _at(self) -> States:
        """The states of the values."""
        return from_values(self._values, len(self._nodes), self._data)

    def _dead_of(self, moved: SmootherInput) -> DeadReckoning:
        """Of an input; that of the last one whose samples had moved is kept."""
        if moved.inertial is self._data.inertial:
            return self._dead
        if self._moved is None or self._moved[0] is not moved.inertial:
            dead = without_bias(moved.inertial, self._nodes, self._states)
            self._moved = moved.inertial, dead
        return self._moved[1]

    def _of_positions(self, moved: SmootherInput) -> Array:
        kinds = frozenset({"gnss"})
        carried = carry_to_nodes(moved, self._nodes, self._dead_of(moved), kinds).positions
        if carried is None:
            return np.zeros((0, 3))
        keep = ~np.isin(carried.fixes, self._dropped)
        return position_residuals(
            self._at if moved.wheels is None else self._level,
            carried.nodes[keep],
            carried.position_map[keep],
            carried.offset_imu[keep],
            carried.delay_s[keep],
            moved.gravity_m_s2,
        )

    def _of_velocities(self, moved: SmootherInput) -> Array:
        kinds = frozenset({"velocity"})
        carried = carry_to_nodes(moved, self._nodes, self._dead_of(moved), kinds).velocities
        if carried is None:
            return np.zeros((0, 3))
        r = velocity_residuals(
            self._at,
            carried.nodes,
            carried.velocity_imu,
            carried.delay_s,
            moved.gravity_m_s2,
            moved.speed_scale,
        )
        if not moved.speed_alone:
            return r
        # The axes in which they are measured turn with the mounting of the IMU, the roots do not.
        # What a speed is compared with is the velocity along the axes as they are now.
        then, now = (
            of.T_vehicle_twist.between(of.T_vehicle_imu).rotation().matrix()
            for of in (self._data, moved)
        )
        return np.asarray(r @ (then.T @ now).T)
