"""The noise of the sensors, estimated from how they contradict each other.

Restricted maximum likelihood on the linearised graph: minus twice its logarithm is chi-square at
the optimum, the log-determinant of the information, and that of the noise. What the trajectory
takes up of the noise is in the second term, so that no residual counts as precision which the
trajectory absorbs (`README.md`, section 9).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any

import gtsam
import numpy as np
import scipy.sparse
from scipy.optimize import OptimizeResult, minimize

from caliv_graph.conventions import key_yaw_bias
from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.trajectory.build import build_graph, to_values
from caliv_graph.trajectory.chain import STATE, Chain, beside
from caliv_graph.trajectory.chain_solution import ChainSolution, solved
from caliv_graph.trajectory.columns import parameter_columns
from caliv_graph.trajectory.correlated import (
    AXES,
    CorrelatedError,
    add_prior,
    linearised,
)
from caliv_graph.trajectory.imu import bridged_s
from caliv_graph.trajectory.inputs import SmootherInput
from caliv_graph.trajectory.parameters import (
    AXLE_SLIP,
    COURSE_RATE,
    GNSS_TIME_OFFSET,
    GYROSCOPE,
    HEADING_YAW,
    LEAN,
    LEVER_ARM,
    SECOND_ARM,
    SPEED_POINT,
    SPEEDS_DELAY,
    mount_rotation,
    speed_scale,
)
from caliv_graph.trajectory.sample_noise import levels_of_samples
from caliv_graph.trajectory.states import States, first_nodes
from caliv_graph.trajectory.wheels import is_planar

COMPONENTS: Mapping[str, tuple[str, tuple[int, ...]]] = {
    "gnss_horizontal": ("gnss", (0, 1)),
    "gnss_vertical": ("gnss", (2,)),
    # GTSAM's root is upper triangular: the rotation given position and velocity, whose rows have a
    # part of the rotation's error. The two levels mix where a stated one is wrong (section 9).
    "gyroscope": ("imu", (0, 1, 2)),
    "accelerometer": ("imu", (3, 4, 5, 6, 7, 8)),
    "orientation": ("orientation", (0, 1, 2)),
    "velocity": ("velocity", (0, 1, 2)),
    "heading": ("heading", (0,)),
    "baseline": ("baseline", (0, 1, 2)),
    # Without an IMU: what odometry measures, and how its acceleration and its yaw rate change.
    "yaw_rate": ("imu", (2,)),
    "speed": ("velocity", (0,)),
    "braking": ("imu", (3, 4, 5, 6, 7, 8, 9, 10, 11)),
    "steering": ("imu", (2, 14)),
}
"""Name of a noise level -> kind of its factors, and rows of their residual."""

LOG_SPREAD = math.log(3.0)
"""1 sigma of the log-normal prior of a scale about 1: a factor of three. The hundreds of
measurements of a drive outweigh it."""

SCALE_BOUNDS = (0.05, 20.0)
"""Of a scale on stated sigmas."""


LARGEST_RIGHT = 1.1
"""Estimated scales up to this, and down to its inverse, leave the stated sigmas as they are. A
drive of a minute tells the noise of a gyroscope to 8 percent, and that of fixes to 2."""

EVIDENCE = 9.0
"""Increase of -2 log L, by holding a scale at 1, from which the stated sigma counts as wrong: 3
sigma. Beside a slow error of the fixes, the noise of an accelerometer is hardly known."""

FIT_TOLERANCE = 0.01
"""Derivative of -2 log L by a scale's logarithm, in units of how well that is told, at which a fit
ends: a hundredth of its standard deviation."""

UNKNOWN_SIGMA = 3.0
"""Prior of a lever arm (m) and of the IMU's rotation (rad) that are free: larger than any error."""

NODES = 600
"""First nodes of the drive that are used: a minute, which tells the noise to some percent."""


def free_components(data: SmootherInput) -> list[str]:
    """Names of the noise levels that the config does not give."""
    noise = data.config.noise
    configured = {
        "gnss_horizontal": noise.gnss_horizontal_m,
        "gnss_vertical": noise.gnss_vertical_m,
        "gyroscope": noise.gyroscope_density_rad_s_sqrthz,
        "accelerometer": noise.accelerometer_density_m_s2_sqrthz,
        "orientation": noise.orientation_deg,
        "velocity": noise.velocity_m_s,
        "heading": noise.heading_deg,
        "baseline": noise.gnss_horizontal_m,
    }
    if data.wheels is not None:
        for name in ("gyroscope", "accelerometer"):
            del configured[name]
        if data.wheels.yaw_rate:
            configured["yaw_rate"] = noise.yaw_rate_rad_s
        else:
            configured["steering"] = None
        configured["braking"] = None
    if data.motion.twist is not None and is_planar(data.motion.twist):
        del configured["velocity"]
        configured["speed"] = noise.velocity_m_s
    return [name for name, value in configured.items() if value is None]


def estimated_scales(
    data: SmootherInput,
    nodes: IntArray,
    states: States,
    dropped: IntArray,
    errors: Sequence[CorrelatedError],
) -> dict[str, float]:
    """Scales on the stated sigmas that the data contradict; empty: none.

    `states` is the estimate at the nodes, `dropped` the fixes that are left out, `errors` those
    that are correlated over time.
    """
    if data.config.robust.kernel == "none":
        return {}  # everything is believed, jumps of the fixes too
    nodes = nodes[:NODES]
    part = first_nodes(states, len(nodes))
    graph = build_graph(data, nodes, part, dropped, "none")
    values = to_values(part, data)
    # Free, whatever sigma they have: a lever arm that was typed wrong is no noise.
    rotation = mount_rotation(data)
    typed = [rotation] if data.positions is None else [LEVER_ARM, rotation, GNSS_TIME_OFFSET]
    if data.motion.twist is not None and data.speed_scale_sigma:
        typed.append(speed_scale(data))
    typed += [GYROSCOPE] if data.gyroscope_scale_sigma is not None else []
    typed += [SPEED_POINT] if data.speed_alone else []
    typed += [SPEEDS_DELAY] if data.speeds_delay_sigma_s else []
    if data.wheels is not None:
        typed += [LEAN, AXLE_SLIP] if data.wheels.planar else [LEAN]
        typed += [COURSE_RATE] if data.wheels.planar and data.wheels.yaw_rate else []
    typed += [HEADING_YAW] if data.headings is not None else []
    typed += [SECOND_ARM] if data.baselines is not None else []
    columns = parameter_columns(data, nodes, part, graph, values, dropped, typed)
    bridged = iter(bridged_s(data.inertial, nodes) > 0.0)
    # What happens in a gap is no noise of the IMU, and the errors of rough fixes are not white.
    kinds = ["gap" if kind == "imu" and next(bridged) else kind for kind in graph.kinds]
    if data.positions is not None:
        rough = iter((data.positions.shared[graph.fixes] > 1.0).tolist())
        kinds = ["rough fix" if kind == "gnss" and next(rough) else kind for kind in kinds]
    likelihood = NoiseLikelihood(
        graph.factors.linearize(values),
        kinds,
        [key_yaw_bias()] if data.yaw_bias else [],
        nodes,
        part.R_map_imu,
        errors,
        free_components(data),
        columns,
    )
    shown = {}
    if data.wheels is None:
        shown = levels_of_samples(data.inertial, data.noise, int(nodes[-1]))
    return contradicted(likelihood, shown)


@dataclass
class _Part:
    """Information, gradient and squared residuals of one noise level at scale 1."""

    chain: Chain
    gradient: Array
    square: float
    rows: int


class NoiseLikelihood:
    """The restricted likelihood of noise levels of a linearised trajectory."""

    def __init__(
        self,
        graph: gtsam.GaussianFactorGraph,
        kinds: Sequence[str],
        common_keys: Sequence[int],
        nodes_ns: IntArray,
        R_map_imu: Array,
        errors: Sequence[CorrelatedError],
        free: Sequence[str],
        columns: Array | None = None,
    ) -> None:
        """Sorts the rows of a graph by noise level.

        Args:
            graph: whitened by the stated noise, without robust weights, over n nodes.
            kinds: of its factors.
            common_keys: of the variables that all nodes share.
            nodes_ns: (n,) stamps.
            R_map_imu: (n, 3, 3) at which it was linearised.
            errors: correlated over time.
            free: names of `COMPONENTS` that are estimated.
            columns: (rows, p) derivatives of the residuals by parameters that are free, in units of
                which `UNKNOWN_SIGMA` is a prior without weight.
        """
        self.nodes_ns, self.errors = nodes_ns, tuple(errors)
        J, r = linearised(graph, kinds, [e.kind for e in errors], R_map_imu, common_keys)
        self.parameters = 0 if columns is None else columns.shape[1]
        if columns is not None:
            J = beside(J, columns)
        self.width = STATE + AXES * len(errors)
        self.k = len(common_keys) + self.parameters
        label = np.full(len(r), -1)
        at = 0
        for number, kind in enumerate(kinds):
            factor: Any = graph.at(number)
            m = factor.rows()
            for c, name in enumerate(free):
                of_kind, rows = COMPONENTS[name]
                if of_kind == kind:
                    label[at + np.array(rows)] = c
            at += m
        self.names = [name for c, name in enumerate(free) if (label == c).any()]
        index = [c for c, name in enumerate(free) if name in self.names]
        self.fixed = self._part(J, r, label < 0)
        self.parts = [self._part(J, r, label == c) for c in index]

    def _part(self, J: scipy.sparse.csr_array, r: Array, mine: BoolArray) -> _Part:
        rows = np.flatnonzero(mine)
        chain = Chain.zero(len(self.nodes_ns), self.width, self.k)
        chain.add(J[rows])
        return _Part(chain, J[rows].T @ r[rows], float(r[rows] @ r[rows]), len(rows))

    def at(self, scales: Array) -> tuple[float, Array]:
        """-2 log L at scales (m,) of `names`, and its derivatives by their logarithms."""
        return self._evaluated(scales, *self._solved(scales))

    def _solved(self, scales: Array) -> tuple[_Part, ChainSolution]:
        """The weighted sum of all levels, and its solution."""
        total = _sum([self.fixed, *self.parts], [1.0, *scales**-2.0])
        add_prior(total.chain, self.nodes_ns, self.errors)
        at = np.arange(self.k - self.parameters, self.k)
        total.chain.corner[at, at] += UNKNOWN_SIGMA**-2.0
        return total, solved(total.chain, total.gradient)

    def _evaluated(self, scales: Array, total: _Part, found: ChainSolution) -> tuple[float, Array]:
        """`at` a solution."""
        weights = scales**-2.0
        cost = total.square + float(total.gradient @ found.step) + found.log_determinant
        slope = np.zeros(len(scales))
        moments = _second_moments(found)
        for c, (part, weight) in enumerate(zip(self.parts, weights, strict=True)):
            cost += 2.0 * part.rows * math.log(scales[c])
            slope[c] = 2.0 * part.rows - 2.0 * weight * _expected(part, found.step, moments)
        return cost, slope

    @cached_property
    def as_stated(self) -> tuple[float, Array]:
        """`at` the stated noise, where every fit begins."""
        return self._evaluated(np.ones(len(self.names)), *self._solved_as_stated)

    @cached_property
    def curvatures(self) -> Array:
        """(m,) second derivatives of `at` by the logarithms, about, at the stated noise.

        Two for each row, less what the trajectory takes up of them: of 1446 rows of an
        accelerometer 14 are left, of 723 of velocities 717.
        """
        found = self._solved_as_stated[1]
        cov = Chain(found.cov, found.cov_next, found.cov_border, found.cov_corner)
        none = np.zeros_like(found.step)
        taken_up = [_expected(part, none, cov) - part.square for part in self.parts]
        return 2.0 * (np.array([part.rows for part in self.parts]) - taken_up)

    @cached_property
    def _solved_as_stated(self) -> tuple[_Part, ChainSolution]:
        return self._solved(np.ones(len(self.names)))


def _sum(parts: Sequence[_Part], weights: Sequence[float]) -> _Part:
    """The weighted sum of some parts."""

    def total(of: str) -> Array:
        return np.asarray(
            sum(w * getattr(p.chain, of) for p, w in zip(parts, weights, strict=True))
        )

    return _Part(
        Chain(total("diagonal"), total("coupling"), total("border"), total("corner")),
        np.asarray(sum(w * p.gradient for p, w in zip(parts, weights, strict=True))),
        sum(w * p.square for p, w in zip(parts, weights, strict=True)),
        0,
    )


def _second_moments(found: ChainSolution) -> Chain:
    """Expected products of the coordinates, the trajectory's uncertainty included."""
    n, w = found.cov.shape[:2]
    x, common = found.step[: n * w].reshape(n, w), found.step[n * w :]
    return Chain(
        found.cov + x[:, :, None] * x[:, None],
        found.cov_next + x[:-1, :, None] * x[1:, None],
        found.cov_border + x[:, :, None] * common,
        found.cov_corner + np.outer(common, common),
    )


def _expected(part: _Part, step: Array, moments: Chain) -> float:
    """Expected squared residual of the rows of a part."""
    chain = part.chain
    total = part.square + 2.0 * part.gradient @ step
    total += np.vdot(chain.diagonal, moments.diagonal)
    total += 2.0 * np.vdot(chain.coupling, moments.coupling)
    total += 2.0 * np.vdot(chain.border, moments.border)
    total += np.vdot(chain.corner, moments.corner)
    return float(total)


TOO_FAR = 1e6
"""-2 log likelihood, beyond that of the stated noise, where it cannot be worked out."""


def contradicted(likelihood: NoiseLikelihood, shown: Mapping[str, float]) -> dict[str, float]:
    """The scales that the data set against the stated sigmas; all others are 1.

    `shown` are the levels that samples themselves show, on the stated ones. Where they are louder,
    what is stated has no word against the residuals, that mostly say little of a gyroscope: their
    scale counts without `EVIDENCE`, up to what the samples show.
    """
    names = set(likelihood.names)
    scales, best = fit(likelihood, names)
    away = {name for name, s in scales.items() if max(s, 1.0 / s) > LARGEST_RIGHT}
    enough = best + EVIDENCE
    # Each begins where the fit of all has ended: mostly it is below `enough` there already.
    kept = {
        name
        for name in away
        if fit(likelihood, names - {name}, enough, scales)[1] - best > EVIDENCE
    }
    if kept == names:
        return scales
    louder = {
        name: shown[name]
        for name in away - kept
        if scales[name] > LARGEST_RIGHT and shown.get(name, 0.0) > LARGEST_RIGHT
    }
    kept |= louder.keys()
    return fit(likelihood, kept, start=scales, most=louder)[0] if kept else {}


def fit(
    likelihood: NoiseLikelihood,
    free: Set[str],
    enough: float = -math.inf,
    start: Mapping[str, float] | None = None,
    most: Mapping[str, float] = MappingProxyType({}),
) -> tuple[dict[str, float], float]:
    """Scales of the `free` noise levels at the maximum of likelihood times prior.

    The others are 1. Returns them, and -2 log of likelihood times prior. The fit ends early where
    this falls below `enough`: every step descends, so that it would end below as well. It begins at
    the scales `start`; None: at the stated noise. Scales in `most` do not exceed it.
    """
    at = [i for i, name in enumerate(likelihood.names) if name in free]
    names = [likelihood.names[i] for i in at]
    logarithms = np.zeros(len(likelihood.names))
    begin = likelihood.as_stated[0]

    # In units of how well each is told: the search takes 7 steps instead of 20.
    unit = np.sqrt(np.maximum(likelihood.curvatures[at], 0.0) + 2.0 / LOG_SPREAD**2)

    def cost(scaled: Array) -> tuple[float, Array]:
        x = scaled / unit
        logarithms[at] = x
        try:
            value, slope = likelihood.at(np.exp(logarithms)) if x.any() else likelihood.as_stated
        except TrajectoryError:
            if not x.any():
                raise
            # Levels so far apart that numbers do not tell the states: the search turns back.
            return TOO_FAR * (1.0 + float(x @ x)), 2.0 * TOO_FAR * x / unit
        # Less the value at the start: the optimiser's tolerance is relative.
        return (
            value - begin + float(x @ x) / LOG_SPREAD**2,
            (slope[at] + 2.0 * x / LOG_SPREAD**2) / unit,
        )

    if not at:
        return {}, begin
    if begin <= enough:
        return dict.fromkeys(free, 1.0), begin
    low, high = SCALE_BOUNDS
    highest = [min(high, most.get(name, high)) for name in names]
    begun = [
        1.0 if start is None else min(start[name], h)
        for name, h in zip(names, highest, strict=True)
    ]
    first = unit * np.log(begun)
    if start is not None and (value := cost(first)[0] + begin) <= enough:
        return dict(zip(names, begun, strict=True)), value

    def check(intermediate_result: OptimizeResult) -> None:
        if intermediate_result.fun + begin <= enough:
            raise StopIteration

    bounds = np.log([[low, h] for h in highest]) * unit[:, None]
    found = minimize(
        cost,
        first,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds.tolist(),
        callback=check,
        options={"ftol": 1e-8, "gtol": FIT_TOLERANCE, "maxiter": 30},
    )
    scales = np.exp(np.asarray(found.x) / unit).tolist()
    return dict(zip(names, scales, strict=True)), float(found.fun) + begin
