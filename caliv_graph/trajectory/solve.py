"""Solving the smoother's graph, and the covariance of what comes out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np

from caliv_graph.conventions import key_bias, key_imu, key_velocity, key_yaw_bias
from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.build import Estimate, build_graph, from_values, to_values
from caliv_graph.trajectory.chain import STATE, Chain
from caliv_graph.trajectory.chain_solution import solved_columns
from caliv_graph.trajectory.initial import extended_states
from caliv_graph.trajectory.inputs import SmootherInput
from caliv_graph.trajectory.marginals import Marginals, node_ordering
from caliv_graph.trajectory.measurements import rotated
from caliv_graph.trajectory.states import States

MAX_PASSES = 4
"""Preintegration and carrying are repeated with the new biases at most this often. Two passes do
on every drive simulated here; the later ones are for biases far from zero."""

GYRO_BIAS_CHANGE_RAD_S = 2e-4
FORCE_BIAS_CHANGE_M_S2 = 5e-3
"""Biases may differ by this from those that the measurements were integrated with. Preintegrated
factors correct for the difference to first order; measurements carried by 0.05 s are off by at most
0.01 mrad and 0.006 mm."""

MAX_STEPS = 60
"""Of Levenberg-Marquardt; about four do from an initial guess with orientation."""

ERROR_TOLERANCE = 1e-7
"""Relative decrease of the error at which the solver stops: the remaining step is below a hundredth
of a sigma in every variable."""

ROUGH_TOLERANCE = 1e-3
"""The same while outliers are still in the graph: the Huber weights of gross outliers settle in
many small steps, which no later stage uses."""

MIN_DAMPING, MAX_DAMPING = 1e-2, 1e8
"""Of Levenberg-Marquardt: 1 sigma of the damping is 10 m and 1 rad at the smallest, and 0.1 mm and
0.01 mrad at the largest, where the solver stops."""

# 1 sigma of the damping where it is 1; that of positions and velocities is 1 m and 1 m/s.
STEP_RAD = 0.1
STEP_FORCE_BIAS_M_S2 = 0.1
STEP_GYRO_BIAS_RAD_S = 0.01

# Medians of sigma over the drive beyond which the trajectory counts as undetermined: ten times what
# any sensor set in use leaves, and too much for the target to be found in the map. Walls can tell
# the heading (`about_poses.py`), where an error of the gyroscope's bias turns it along the drive.
MAX_TILT_SIGMA_RAD = 0.1
MAX_YAW_SIGMA_RAD = 1.0
MAX_POSITION_SIGMA_M = 10.0

LONE_YAW_SIGMA_RAD = 0.2
"""The same of the heading where no walls tell it."""


def solve_from_the_start(data: SmootherInput, nodes: IntArray, states: States) -> States:
    """Extends an estimate of the first nodes to all nodes, doubling its length after every solve.

    The initial guess without an orientation source holds for a short time only.
    """
    none = np.zeros(0, dtype=np.int64)
    while len(states.p_map_imu) < len(nodes):
        done = len(states.p_map_imu)
        states = solve(data, nodes[:done], states, none, "huber", ROUGH_TOLERANCE).states
        until = nodes[0] + 2 * (nodes[done - 1] - nodes[0])
        more = min(max(int(np.searchsorted(nodes, until)), done + 1), len(nodes))
        states = extended_states(data, nodes[:more], states)
    return states


def solve(
    data: SmootherInput,
    nodes: IntArray,
    states: States,
    dropped: IntArray,
    kernel: str,
    tolerance: float = ERROR_TOLERANCE,
    held: Sequence[gtsam.NonlinearFactor] = (),
) -> Estimate:
    """Builds and solves the graph until its biases are those it was built with.

    The GNSS fixes of indices `dropped` (k,) are left out; `kernel` is the robust kernel of the
    others. `tolerance` is the relative decrease of the error at which a solve stops. `held` are
    further factors, which the graph of the result is without.
    """
    for _ in range(MAX_PASSES):
        graph = build_graph(data, nodes, states, dropped, kernel)
        # Its factors are shared: those of Python cannot be cloned.
        factors = gtsam.NonlinearFactorGraph()
        factors.push_back(graph.factors)
        for factor in held:
            factors.push_back(factor)
        values = optimise(factors, to_values(states, data), len(nodes), tolerance)
        found = from_values(values, len(nodes), data)
        gyro_change = np.abs(found.gyro_bias - states.gyro_bias).max()
        force_change = np.abs(found.force_bias - states.force_bias).max()
        built_with, states = states, found
        if gyro_change < GYRO_BIAS_CHANGE_RAD_S and force_change < FORCE_BIAS_CHANGE_M_S2:
            break
    return Estimate(states, graph, values, built_with)


def optimise(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, n: int, tolerance: float
) -> gtsam.Values:
    """Gauss-Newton over n nodes, with Levenberg-Marquardt damping where a step does not descend.

    It stops at a relative decrease of the error below `tolerance`. GTSAM's optimisers end in the
    same place and take 6 to 14 times as long (`README.md`, section 5).
    """
    ordering = node_ordering(n, values.exists(key_yaw_bias()))
    error = graph.error(values)
    damping = 0.0
    for _ in range(MAX_STEPS):
        linear = graph.linearize(values)
        moved, error_moved = values, math.inf
        while not error_moved <= error and damping < MAX_DAMPING:
            moved = _step(linear, values, ordering, n, damping)
            error_moved = graph.error(moved)
            if error_moved <= error:
                damping = damping / 10.0 if damping > MIN_DAMPING else 0.0
            elif error_moved - error < tolerance * (1.0 + error):
                return values  # the increase is rounding: the minimum is reached
            else:
                damping = max(10.0 * damping, MIN_DAMPING)
        if not error_moved <= error:
            return values
        gained = error - error_moved
        values, error = moved, error_moved
        if gained <= tolerance * (1.0 + error) and damping == 0.0:
            break
    return values


def _step(
    linear: gtsam.GaussianFactorGraph,
    values: gtsam.Values,
    ordering: gtsam.Ordering,
    n: int,
    damping: float,
) -> gtsam.Values:
    """The values after one damped step; unchanged if the damped system is singular."""
    if damping == 0.0:
        stepped = _solved(linear, values, ordering, n)
        if stepped is not None:
            return stepped
        damping = MIN_DAMPING
    damped = linear.clone()
    root = math.sqrt(damping)
    pose = np.diag([root / STEP_RAD] * 3 + [root] * 3)
    bias = np.diag([root / STEP_FORCE_BIAS_M_S2] * 3 + [root / STEP_GYRO_BIAS_RAD_S] * 3)
    unit3, unit6 = gtsam.noiseModel.Unit.Create(3), gtsam.noiseModel.Unit.Create(6)
    for i in range(n):
        damped.add(gtsam.JacobianFactor(key_imu(i), pose, np.zeros(6), unit6))
        damped.add(gtsam.JacobianFactor(key_velocity(i), root * np.eye(3), np.zeros(3), unit3))
        damped.add(gtsam.JacobianFactor(key_bias(i), bias, np.zeros(6), unit6))
    stepped = _solved(damped, values, ordering, n)
    return values if stepped is None else stepped


def _solved(
    linear: gtsam.GaussianFactorGraph, values: gtsam.Values, ordering: gtsam.Ordering, n: int
) -> gtsam.Values | None:
    """The values after an undamped step; None if the system is singular.

    GTSAM's Cholesky does not scale its variables: where fixes of a metre stand beside an IMU of
    micrometres per node, it calls a sound system singular. The chain is scaled.
    """
    try:
        return values.retract(linear.optimize(ordering))
    except RuntimeError:  # GTSAM's report of a singular system
        pass
    yaw_bias = values.exists(key_yaw_bias())
    chain, gradient = without_right_side(chain_of(linear, n, yaw_bias))
    try:
        step = solved_columns(chain, -gradient[:, None])[:, 0]
    except TrajectoryError:
        return None
    by_node, common = step[: n * STATE].reshape(n, STATE), step[n * STATE :]
    return values.retract(step_of(by_node, common, yaw_bias))


def step_of(by_node: Array, common: Array, yaw_bias: bool) -> gtsam.VectorValues:
    """A step of the graph from (n, `STATE` or more) pose, velocity and bias, and the yaw bias."""
    step = gtsam.VectorValues()
    for i, d in enumerate(by_node):
        step.insert(key_imu(i), d[:6])
        step.insert(key_velocity(i), d[6:9])
        step.insert(key_bias(i), d[9:STATE])
    if yaw_bias:
        step.insert(key_yaw_bias(), common[:1])
    return step


def without_right_side(chain: Chain) -> tuple[Chain, Array]:
    """A chain of `chain_of` without its last common coordinate, and the gradient that is there."""
    gradient = -np.concatenate([chain.border[:, :, -1].ravel(), chain.corner[:-1, -1]])
    border, corner = chain.border[:, :, :-1], chain.corner[:-1, :-1].copy()
    return Chain(chain.diagonal, chain.coupling, border, corner), gradient


def chain_of(
    linear: gtsam.GaussianFactorGraph, n: int, yaw_bias: bool, columns: Array | None = None
) -> Chain:
    """The information of a linearised graph over n nodes, as a chain of states.

    The common coordinates are the yaw bias if there is one, those of `columns` (rows, p), the
    derivatives of the graph's rows, and at last the graph's right-hand side: its products with the
    others are the gradient of the log-likelihood.
    """
    factors: list[Any] = [linear.at(i) for i in range(linear.size())]
    right = np.concatenate([factor.getb() for factor in factors])[:, None]
    return Chain.from_graph(
        linear,
        [(key_imu(i), key_velocity(i), key_bias(i)) for i in range(n)],
        (6, 3, 6),
        [key_yaw_bias()] if yaw_bias else [],
        right if columns is None else np.hstack([columns, right]),
    )


def covariances_of(
    linear: gtsam.GaussianFactorGraph, data: SmootherInput, states: States
) -> tuple[Array, float | None]:
    """Marginal covariances of the IMU's poses; sigma of the yaw bias, radians, if it is estimated.

    Of a graph linearised at `states`: (n, 6, 6) right perturbations, rotation then translation, rad
    and m.

    Raises:
        TrajectoryError: the poses are undetermined, or far less certain than is of use.
    """
    wanting, advice = f"{data.name}: the motion data do not determine ", _missing_sensors(data)
    try:
        marginals = Marginals(linear, node_ordering(len(states.p_map_imu), data.yaw_bias))
        cov = marginals.covariances([key_imu(i) for i in range(len(states.p_map_imu))])
        yaw_cov = marginals.covariances([key_yaw_bias()]) if data.yaw_bias else None
    except TrajectoryError:
        raise TrajectoryError(f"{wanting}the trajectory: record {advice}") from None
    R = states.R_map_imu
    cov_map = rotated(R, cov[:, :3, :3])
    sigma = np.median(np.sqrt(np.diagonal(cov_map, axis1=1, axis2=2)), axis=0)
    if sigma[2] > MAX_YAW_SIGMA_RAD:
        raise without_heading(data, sigma[2])
    if max(sigma[:2]) > MAX_TILT_SIGMA_RAD:
        raise TrajectoryError(
            f"{wanting}roll and pitch: sigma {math.degrees(max(sigma[:2])):.1f} degrees. Record "
            f"{advice}"
        )
    position = float(np.sqrt(np.median(np.trace(cov[:, 3:, 3:], axis1=1, axis2=2))))
    if position > MAX_POSITION_SIGMA_M:
        raise TrajectoryError(f"{wanting}position: its sigma is {position:.1f} m. Record {advice}")
    return cov, None if yaw_cov is None else math.sqrt(float(yaw_cov[0, 0, 0]))


def _missing_sensors(data: SmootherInput) -> str:
    """What a recording would have to have beside what it has."""
    if data.wheels is not None:
        return "GNSS along the whole drive, the heading of two antennas, or an IMU"
    has_speeds = data.motion.twist is not None
    if data.orientation:
        return "GNSS along the whole drive" if has_speeds else "GNSS or velocities all along"
    if has_speeds:
        return "orientation in the IMU's messages, or GNSS and a drive with curves"
    return "orientation in the IMU's messages, GNSS, or velocities, or a drive with curves"


def without_heading(
    data: SmootherInput, sigma_rad: float, *, walls: bool = False
) -> TrajectoryError:
    """The error of a drive whose heading is too uncertain; `walls` in view do not tell it."""
    not_by_walls, near, stand = "", "", ""
    if walls:
        not_by_walls = ", and the walls in view of the LiDARs tell it no better"
        near = ", or drive where walls are in view all along"
    if data.motion.twist is not None and not data.orientation and data.positions is None:
        stand = (
            ". Speeds of zero tell the gyroscope's bias: stand still for two seconds before and "
            "after the drive"
        )
    return TrajectoryError(
        f"{data.name}: the motion data do not determine heading: its sigma is "
        f"{math.degrees(sigma_rad):.1f} degrees{not_by_walls}. Record {_missing_sensors(data)}"
        f"{near}{stand}"
    )
