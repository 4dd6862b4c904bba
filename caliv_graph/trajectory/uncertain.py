"""Estimating parameters of the input: lever arm, rotation of the IMU, scales, clocks.

Gauss-Newton over all states and the parameters at once, the parameters as one more variable of the
linear graph (`README.md`, section 13). After a step the input is moved and the graph built anew.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import gtsam
import numpy as np

from caliv_graph.conventions import key_parameters
from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.build import Estimate, from_values
from caliv_graph.trajectory.chain import UNDETERMINED, inverse_of
from caliv_graph.trajectory.columns import parameter_columns
from caliv_graph.trajectory.inputs import TWIST_CLOCK, SmootherInput
from caliv_graph.trajectory.marginals import node_ordering
from caliv_graph.trajectory.parameters import (
    AXLE_SLIP,
    COURSE_RATE,
    GNSS_TIME_OFFSET,
    GYROSCOPE,
    HEADING_YAW,
    IMU_PLACE,
    IMU_ROTATION,
    LEAN,
    LEVER_ARM,
    SECOND_ARM,
    SLOPE,
    SPEED_POINT,
    SPEED_SCALE,
    SPEEDS_DELAY,
    WHEELS_ROTATION,
    UncertainParameter,
    inertial_time_offset,
    mount_rotation,
    sigmas_in,
    speed_scale,
)
from caliv_graph.trajectory.solve import ERROR_TOLERANCE, solve

MAX_STEPS = 15
"""Of the parameters. Sound figures take one or two; a lever arm that is unknown about five, under
the weights of Huber's kernel."""

STEP_SIGMAS, ROUGH_STEP_SIGMAS = 0.01, 0.1
"""Step of a parameter, in sigmas of what is then known of it, at which it has converged; while
outliers are still in the graph."""

LINED_UP, LARGEST_RATIO = 0.98, 0.8
"""Cosine of two steps of the parameters, in their joint sigmas, from which the second goes on along
the first; and its largest length over the first at which it is extrapolated."""

SPEED_POINT_SIGMAS = (0.1, 0.5)
"""1 sigma of it, metres, beside the vehicle's x axis. The body pitches about a point half a metre
above the axle on which the wheels roll; wheels of one side, or of other radii, measure a part of
the turn."""

AXLE_SLIP_SIGMA = 0.005
"""1 sigma of the side slip of an axle, radians per m/s^2: tyres of a passenger car let its rear
axle slip by 2 to 4 degrees per g."""

LEAN_SIGMAS = (0.005, 0.008)
"""1 sigma of how the body leans by acceleration, radians per m/s^2: cars pitch by 2 to 4 degrees
per g, and roll by 3 to 7."""

SYNCHRONISED_S = 1e-4
"""1 sigma of a synchronised clock: PPS and PTP are below, NTP on a local network is about there.
Motion data alone hardly tell clocks: free, they move the trajectory along itself by a centimetre
and turn it by a milliradian. A calibration, whose LiDARs tell more, frees them
(`calibration/clock_prior.py`)."""

LATE_SIGMAS = 4.0
"""Of what the motion data alone say of that clock, from which it is late: one sound drive in 16,000
is that far off."""

ALIKE_SIGMAS, ALIKE_S = 3.0, 0.002
"""Fixes and speeds are late by the same if both are within these sigmas of each other, and beyond
them from none; the least sigma of their difference, seconds."""

MOST_LATE_SIGMAS = 5.0
"""Largest lateness of the fixes, in sigmas of their clock, at which that is freed."""

WIDE_SIGMAS = {
    LEVER_ARM.name: 0.05,
    IMU_ROTATION.name: np.radians(1.0),
    WHEELS_ROTATION.name: np.radians(1.0),
    SPEED_SCALE.name: 0.01,
    SPEEDS_DELAY.name: 0.02,
}
"""From these prior sigmas on (m, rad, part) an error would make sound fixes look like outliers:
three times the noise of a good fix, what 1 degree is at 3 m, 2 cm/s at 2 m/s and at 1 m/s^2. The
parameter is then estimated before fixes and speeds are rejected."""


@dataclass(frozen=True)
class Settled:
    """An estimate of states and parameters.

    Attributes:
        data: the input with its parameters as estimated.
        estimate: of the states, with that input.
        parameters: with the offsets from their priors' means.
        columns: (rows, p) derivatives of the estimate's whitened residuals by the parameters; None:
            there are none.
        cov: (p, p) of the parameters, priors included.
        step: (p,) the last step, too small to be taken.
    """

    data: SmootherInput
    estimate: Estimate
    parameters: tuple[UncertainParameter, ...] = ()
    columns: Array | None = None
    cov: Array = field(default_factory=lambda: np.zeros((0, 0)))
    step: Array = field(default_factory=lambda: np.zeros(0))


def uncertain_parameters(data: SmootherInput) -> tuple[UncertainParameter, ...]:
    """The parameters of the input that have a sigma, at their priors' means."""
    out = []
    arm = data.config.gnss.arm_sigma()
    if arm is not None and data.positions is not None:
        out.append(UncertainParameter(LEVER_ARM, np.full(3, arm), np.zeros(3)))
    if data.rotation_sigmas is not None:
        out.append(UncertainParameter(mount_rotation(data), data.rotation_sigmas, np.zeros(3)))
    place = data.config.imu.place_sigma()
    if place is not None and data.wheels is None and _has_place(data):
        out.append(UncertainParameter(IMU_PLACE, np.full(3, place), np.zeros(3)))
    response = data.gyroscope_scale_sigma
    if response is not None:
        out.append(UncertainParameter(GYROSCOPE, np.full(3, response), np.zeros(3)))
    out += _clocks(data)
    wheels = data.config.wheels
    if data.wheels is not None:
        slope = np.full(2, np.radians(wheels.slope_sigma_deg))
        out.append(UncertainParameter(SLOPE, slope, np.zeros(2)))
        out.append(UncertainParameter(LEAN, np.array(LEAN_SIGMAS), np.zeros(2)))
        if data.wheels.planar:
            out.append(UncertainParameter(AXLE_SLIP, np.full(1, AXLE_SLIP_SIGMA), np.zeros(1)))
            if data.wheels.yaw_rate:
                sigma = np.full(1, AXLE_SLIP_SIGMA)
                out.append(UncertainParameter(COURSE_RATE, sigma, np.zeros(1)))
    scale = data.speed_scale_sigma
    if scale is not None and data.motion.twist is not None:
        out.append(UncertainParameter(speed_scale(data), np.full(1, scale), np.zeros(1)))
    if data.speed_alone:
        out.append(UncertainParameter(SPEED_POINT, np.array(SPEED_POINT_SIGMAS), np.zeros(2)))
    if delay_s := data.speeds_delay_sigma_s:
        out.append(UncertainParameter(SPEEDS_DELAY, np.full(1, delay_s), np.zeros(1)))
    heading = data.config.heading
    if data.headings is not None:
        sigma = np.full(1, np.radians(heading.sigma_deg))
        out.append(UncertainParameter(HEADING_YAW, sigma, np.zeros(1)))
    if data.baselines is not None:
        arms = np.full(3, heading.lever_arm_sigma)
        out.append(UncertainParameter(SECOND_ARM, arms, np.zeros(3)))
    return tuple(out)


def _has_place(data: SmootherInput) -> bool:
    """Whether another sensor is where an IMU is not."""
    return data.positions is not None or data.motion.twist is not None


def _clocks(data: SmootherInput) -> list[UncertainParameter]:
    """The time offsets that have a sigma; of the IMU none where those of LiDARs are free."""
    config, sigmas = data.config, []
    if not config.solve.time_offset:
        sigma_s = config.imu.time_offset_sigma_s
        if data.wheels is not None:
            sigma_s = config.wheels.delay_sigma_s(of_wheels=True, beside_imu=False)
        sigmas.append((inertial_time_offset(data), sigma_s))
    late = data.found_late_s
    if data.positions is not None and late is None:
        sigmas.append((GNSS_TIME_OFFSET, config.gnss.time_offset_sigma_s))
    out = [
        UncertainParameter(
            parameter, np.full(1, min(sigma_s, SYNCHRONISED_S)), np.zeros(1), np.full(1, sigma_s)
        )
        for parameter, sigma_s in sigmas
        if sigma_s
    ]
    if data.positions is not None and late is not None:  # free from the start, about that
        sigma = np.full(1, np.hypot(late[1], config.gnss.time_offset_sigma_s))
        out.append(UncertainParameter(GNSS_TIME_OFFSET, sigma, np.zeros(1)))
    return out


def are_wide(parameters: Sequence[UncertainParameter]) -> bool:
    """Whether a parameter has to be estimated before outliers are looked for."""
    return any(
        p.sigmas is not None and p.sigmas.max() > WIDE_SIGMAS.get(p.parameter.name, np.inf)
        for p in parameters
    )


def settle(
    data: SmootherInput,
    nodes: IntArray,
    estimate: Estimate,
    dropped: IntArray,
    kernel: str,
    parameters: Sequence[UncertainParameter],
    tolerance: float = ERROR_TOLERANCE,
) -> Settled:
    """Moves states and parameters until their joint step is small.

    Args:
        data: the input.
        nodes: (n,) stamps.
        estimate: of the states with this input.
        dropped: (k,) indices of fixes that are left out.
        kernel: robust kernel of the others.
        parameters: at least one, each with sigmas and an offset.
        tolerance: of the solves between the steps.

    Raises:
        TrajectoryError: the graph is singular.
    """
    parameters = tuple(parameters)
    sigmas = np.concatenate([np.asarray(p.sigmas) for p in parameters])
    before: Array | None = None
    for number in range(MAX_STEPS + 1):
        columns = parameter_columns(
            data,
            nodes,
            estimate.states,
            estimate.graph,
            estimate.values,
            dropped,
            [p.parameter for p in parameters],
        )
        linear = _with_variable(estimate.graph.factors.linearize(estimate.values), columns)
        offset = np.concatenate([np.asarray(p.offset) for p in parameters])
        tree = _eliminated(linear, len(nodes), data.yaw_bias, -offset, sigmas)
        try:
            solution = tree.optimize()
            root = tree.marginalFactor(key_parameters(), gtsam.EliminateQR)
        except RuntimeError:  # GTSAM's report of a singular system
            raise TrajectoryError(UNDETERMINED) from None
        step = np.asarray(solution.at(key_parameters()))
        information = np.asarray(root.information())
        cov = inverse_of(information)
        enough = STEP_SIGMAS if tolerance == ERROR_TOLERANCE else ROUGH_STEP_SIGMAS
        if (np.abs(step) < enough * np.sqrt(np.diag(cov))).all() or number == MAX_STEPS:
            break
        ahead = 1.0 if before is None else steps_ahead(before, step, information)
        before = step = ahead * step
        solution = solution.scale(ahead)
        data, parameters = moved(data, parameters, step)
        # The states move with the parameters: an antenna that is a metre off leaves its fixes with
        # small robust weights.
        states = from_values(estimate.values.retract(solution), len(nodes), data)
        del estimate, linear, tree, solution, root  # megabytes per minute of drive
        estimate = solve(data, nodes, states, dropped, kernel, tolerance)
    return Settled(data, estimate, parameters, columns, cov, step)


def steps_ahead(before: Array, step: Array, information: Array) -> float:
    """How many times a step (p,) is to be taken after the one `before`; 1 unless both line up.

    Measurements that are averaged at a node have a covariance that goes with the parameters, which
    their derivatives are without: steps along one direction then shrink by the same factor from one
    to the next (0.4 on a street), and all that follow together are a multiple of this one (Aitken).
    `information` (p, p) is of the parameters.
    """
    along, size2 = float(before @ information @ step), float(before @ information @ before)
    ratio = along / size2
    lined_up = along > LINED_UP * np.sqrt(size2 * float(step @ information @ step))
    return 1.0 / (1.0 - ratio) if lined_up and ratio < LARGEST_RATIO else 1.0


def with_late_clock(settled: Settled) -> tuple[UncertainParameter, ...] | None:
    """The parameters, the clock of the fixes free where the motion data say that it is late.

    None: they do not. A trajectory under a clock that is off by 50 ms is bent by as much as LiDARs
    see of it.
    """
    found = _late_fixes(settled)
    if found is None:
        return None
    i, late_s, sigma_s = found
    p = settled.parameters[i]
    assert p.beside_lidars is not None
    # So late is no clock that is merely not synchronised: an antenna a metre from where it was
    # typed to be swings in curves like one. The ranking of suspects tells which it is.
    if abs(late_s) <= LATE_SIGMAS * sigma_s or abs(late_s) > MOST_LATE_SIGMAS * p.beside_lidars[0]:
        return None
    out = list(settled.parameters)
    out[i] = replace(p, sigmas=p.beside_lidars)
    return tuple(out)


def with_exact_speeds(
    settled: Settled,
) -> tuple[SmootherInput, tuple[UncertainParameter, ...]] | None:
    """Input and parameters, the speeds in time where they and the fixes seem late by the same.

    None: they do not. It is the IMU that is late then, whatever its prior says: moved to its
    clock, both would put the vehicle as far along its path.
    """
    found, sigmas = (
        _late_fixes(settled),
        sigmas_in(settled.parameters, settled.cov, SPEEDS_DELAY.name),
    )
    if found is None or sigmas is None:
        return None
    _, fixes_s, sigma_s = found
    speeds_s = settled.data.late_s(TWIST_CLOCK)
    sigma_s = max(math.hypot(sigma_s, float(sigmas[0])), ALIKE_S)
    apart, both = abs(fixes_s - speeds_s), min(abs(fixes_s), abs(speeds_s))
    if not apart < ALIKE_SIGMAS * sigma_s < both:
        return None
    late_ns = {clock: ns for clock, ns in settled.data.late_ns.items() if clock != TWIST_CLOCK}
    data = replace(settled.data, late_ns=late_ns, about_late_ns=0)
    exact = UncertainParameter(SPEEDS_DELAY, np.full(1, SYNCHRONISED_S), np.zeros(1))
    out = [exact if p.parameter is SPEEDS_DELAY else p for p in settled.parameters]
    return data, tuple(out)


def _late_fixes(settled: Settled) -> tuple[int, float, float] | None:
    """Which parameter a held clock of the fixes is, how late the data alone say it is, 1 sigma."""
    at = 0
    for i, p in enumerate(settled.parameters):
        if p.parameter is GNSS_TIME_OFFSET:
            if p.beside_lidars is None:  # it is free
                return None
            assert p.sigmas is not None
            assert p.offset is not None
            variance = settled.cov[at, at]
            told = 1.0 / variance - p.sigmas[0] ** -2.0
            if told <= 0.0:
                return None
            # The offset is what the data alone say, times their part of all information.
            late_s = (p.offset[0] + settled.step[at]) / variance / told
            return i, float(late_s), float(told**-0.5)
        at += p.parameter.size
    return None


def moved(
    data: SmootherInput, parameters: Sequence[UncertainParameter], step: Array
) -> tuple[SmootherInput, tuple[UncertainParameter, ...]]:
    """The input and the offsets after a step of all parameters."""
    out, start = [], 0
    for p in parameters:
        d = step[start : start + p.parameter.size]
        start += p.parameter.size
        data = p.parameter.moved(data, d)
        out.append(replace(p, offset=np.asarray(p.offset) + d))
    return data, tuple(out)


def _with_variable(linear: gtsam.GaussianFactorGraph, columns: Array) -> gtsam.GaussianFactorGraph:
    """A linear graph in which the parameters are a variable, of the dimension of `columns`."""
    out, start = gtsam.GaussianFactorGraph(), 0
    for number in range(linear.size()):
        factor: Any = linear.at(number)
        own = columns[start : start + factor.rows()]
        start += factor.rows()
        if not own.any():
            out.push_back(factor)
            continue
        A, keys, first = factor.getA(), list(factor.keys()), 0
        blocks = []
        for key in keys:
            size = _DIMS[chr(gtsam.symbolChr(key))]
            blocks.append(A[:, first : first + size])
            first += size
        out.push_back(_linear_factor([*keys, key_parameters()], [*blocks, own], factor.getb()))
    return out


def _linear_factor(keys: Sequence[int], blocks: Sequence[Array], b: Array) -> Any:
    """`|sum A_k d_k - b|^2` of any number of keys: the constructor takes three from Python."""
    unit = gtsam.noiseModel.Unit.Create(len(b))
    if len(keys) <= MOST_KEYS:
        terms = [part for pair in zip(keys, blocks, strict=True) for part in pair]
        make: Any = gtsam.JacobianFactor
        return make(*terms, b, unit)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        if jacobians is not None:
            for k, block in enumerate(blocks):
                jacobians[k] = block
        return -b

    zero = gtsam.Values()
    for key, block in zip(keys, blocks, strict=True):
        zero.insert(key, np.zeros(block.shape[1]))
    return gtsam.CustomFactor(unit, list(keys), error).linearize(zero)


MOST_KEYS = 3
"""Of a `gtsam.JacobianFactor` that is made from Python."""


_DIMS = {"i": 6, "v": 3, "b": 6, "y": 1}
"""Coordinates of the variables of a trajectory, by letter."""


def _eliminated(
    linear: gtsam.GaussianFactorGraph, n: int, yaw_bias: bool, mean: Array, sigmas: Array
) -> gtsam.GaussianBayesTree:
    """The Bayes tree of a graph with a prior on the parameters, which are its root."""
    graph = linear.clone()
    unit = gtsam.noiseModel.Unit.Create(len(sigmas))
    graph.add(gtsam.JacobianFactor(key_parameters(), np.diag(1.0 / sigmas), mean / sigmas, unit))
    ordering = node_ordering(n, yaw_bias)
    ordering.push_back(key_parameters())
    try:
        return graph.eliminateMultifrontal(ordering, gtsam.EliminateQR)
    except RuntimeError:  # GTSAM's report of a singular system
        raise TrajectoryError(UNDETERMINED) from None
