"""One smoothed trajectory with covariance from IMU, GNSS, velocity and orientation, in GTSAM.

The pose of the IMU is the variable, not that of the vehicle (`README.md`, section 1). The map is
ENU, gravity along -z, its origin the first GNSS fix. Without GNSS the start of the vehicle is the
origin, and without an orientation source its heading is the x axis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import gtsam
import numpy as np

from caliv_graph.config.model import Config
from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array, IntArray, MotionData, Trajectory
from caliv_graph.trajectory.build import Estimate
from caliv_graph.trajectory.correlated import MOVES, CorrelatedError
from caliv_graph.trajectory.correlated_step import (
    WithErrors,
    covariances_with_parameters,
    step_with_errors,
)
from caliv_graph.trajectory.initial import first_states
from caliv_graph.trajectory.initial_wheels import first_wheel_states
from caliv_graph.trajectory.inputs import TWIST_CLOCK, SmootherInput, noise_sources, scaled
from caliv_graph.trajectory.late_fixes import smoother_input
from caliv_graph.trajectory.measurements import nearest_node
from caliv_graph.trajectory.mounting import needs_guess, with_guessed_rotation
from caliv_graph.trajectory.nodes import place_nodes
from caliv_graph.trajectory.noise import configured_errors
from caliv_graph.trajectory.outliers import Robust, dropped_warnings, lost_fixes
from caliv_graph.trajectory.parameters import (
    GYROSCOPE,
    SPEEDS_DELAY,
    UncertainParameter,
    sigmas_in,
)
from caliv_graph.trajectory.slipping import slip_warnings, solve_without_slips, without_slips
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.solve import (
    ROUGH_TOLERANCE,
    chain_of,
    covariances_of,
    solve,
    solve_from_the_start,
)
from caliv_graph.trajectory.states import States, poses_of_vehicle
from caliv_graph.trajectory.uncertain import (
    Settled,
    are_wide,
    moved,
    settle,
    uncertain_parameters,
    with_exact_speeds,
    with_late_clock,
)
from caliv_graph.trajectory.variances import estimated_scales

BIAS_SIGMAS = 5.0
"""Of its prior: a larger bias is reported. A sound sensor exceeds it in one of 600,000 drives."""


LATE_S = 0.02
"""A larger delay of the velocities is reported: less is usual of messages of a vehicle's bus."""


def smooth_trajectory(
    motion: MotionData,
    config: Config,
    stamps_ns: Sequence[int] | IntArray,
    correlated: Sequence[CorrelatedError] = (),
    scales: Mapping[str, float] | None = None,
    earlier: SmoothedTrajectory | None = None,
) -> SmoothedTrajectory:
    """Smooths one drive: IMU, and GNSS, velocities or both; orientations within the IMU's messages.

    Without an IMU: velocities of the wheels, and GNSS or a yaw rate (`wheels.py`).

    Poses are wanted at `stamps_ns` (of LiDAR scans), in any order; those outside the span of the
    IMU are in `lost_ns` of the result. `correlated` are errors of sensors that the config does not
    give. `scales` on the stated sigmas are those of an earlier smoothing of the drive
    (`SmootherInput.scales`); None: estimated. `earlier` is an earlier smoothing of the drive, where
    the search begins; None: at the measurements.

    Raises:
        TrajectoryError: what was recorded does not determine the motion; says what is missing.
    """
    data, warnings = smoother_input(motion, config)
    data = scaled(data, scales or {})
    wanted, lost, lines = _within_span(data, stamps_ns)
    nodes = place_nodes(data.inertial, wanted)
    data, states, parameters = _begun_at(earlier, data, nodes) or _begun(data, nodes)
    errors = errors_in(data, [*configured_errors(config), *correlated])
    robust, estimate = solve_without_slips(data, nodes, states)
    warnings += [*lines, *robust.warnings]
    found = estimate.states
    wrong = (
        estimated_scales(robust.data, nodes, found, robust.dropped, errors)
        if scales is None
        else {}
    )
    if wrong:
        data = scaled(robust.data, wrong)
        del estimate  # its graph
        robust, estimate = solve_without_slips(data, nodes, found)
        warnings += robust.warnings
    positions = robust.data.positions
    # Handed over: a second graph beside it would be as large.
    begun = [estimate]
    del estimate
    try:
        robust, settled = _settled(robust, nodes, begun, parameters)
        linear = settled.estimate.graph.factors.linearize(settled.estimate.values)
        cov_imu, yaw_sigma = covariances_of(linear, settled.data, settled.estimate.states)
    except TrajectoryError:
        # What is left of the data determines nothing; that the fixes are lost says why.
        gone = lost_fixes(robust.data, robust.dropped)
        if gone is None:
            raise
        raise TrajectoryError(gone.sentence(data.name, data.wheels is None)) from None
    last = _last_step(settled, linear, cov_imu, nodes, robust.dropped, errors)
    data, estimate = last.settled.data, last.settled.estimate
    # Only those at wanted stamps are asked for: the memory of the others grows with the drive.
    kept = np.unique(nearest_node(nodes, wanted)) if len(wanted) else None
    chain = last.chain if kept is None else last.chain.only(kept)
    warnings += [*dropped_warnings(robust), *slip_warnings(data)]
    warnings += _bias_warnings(data, estimate.states)
    warnings += _gyroscope_warnings(data, last.settled.parameters)
    warnings += _delay_warnings(data, last.settled)
    return SmoothedTrajectory(
        trajectory=_at_wanted(data, wanted, nodes, estimate.states, last.cov),
        lost_ns=tuple(lost.tolist()),
        warnings=tuple(warnings),
        noise_sources=noise_sources(data),
        nodes_ns=nodes,
        pose_sigmas=np.sqrt(np.median(np.diagonal(last.cov, axis1=1, axis2=2), axis=0)),
        states=estimate.states,
        T_vehicle_imu=data.T_vehicle_imu,
        gravity_m_s2=data.gravity_m_s2,
        yaw_bias=None if yaw_sigma is None else (estimate.states.yaw_bias_rad, yaw_sigma),
        gnss_rejected=robust.dropped if positions is None else positions.stamps_ns[robust.dropped],
        origin_deg_m=None if positions is None else positions.origin_deg_m,
        built_with=estimate.built_with,
        chain=chain,
        inertial=data.inertial,
        data=data,
        gnss_dropped=robust.dropped,
        factor_kinds=tuple(estimate.graph.kinds),
        parameters=last.settled.parameters,
        parameter_cov=last.settled.cov,
        correlated=tuple(errors),
        errors=last.errors,
        chain_nodes=kept,
    )


def _begun(
    data: SmootherInput, nodes: IntArray
) -> tuple[SmootherInput, States, tuple[UncertainParameter, ...]]:
    """Input, states and uncertain parameters with all fixes, outliers among them."""
    if data.wheels is None and needs_guess(data):
        data = with_guessed_rotation(data, nodes, partial(_solved_roughly, nodes))
    states = solve_from_the_start(data, nodes, _first_states(data, nodes))
    parameters = uncertain_parameters(data)
    if are_wide(parameters):
        return _roughly_settled(data, nodes, states, parameters)
    return data, states, parameters


def _begun_at(
    earlier: SmoothedTrajectory | None, data: SmootherInput, nodes: IntArray
) -> tuple[SmootherInput, States, tuple[UncertainParameter, ...]] | None:
    """`_begun` where an earlier smoothing has ended; None: there is none with these parameters."""
    if earlier is None or (data.wheels is None and needs_guess(data)):
        return None  # a guess goes with the nodes
    fresh, found = uncertain_parameters(data), earlier.parameters
    if [p.parameter.name for p in fresh] != [p.parameter.name for p in found]:
        return None
    offsets = [np.asarray(p.offset) for p in found]
    if offsets:
        data, _ = moved(data, fresh, np.concatenate(offsets))
    about_ns, slipped = earlier.data.about_late_ns, earlier.data.slipped
    data = replace(data, about_late_ns=about_ns, slipped=slipped)
    return data, earlier.states_at(nodes), found


def _settled(
    robust: Robust,
    nodes: IntArray,
    begun: list[Estimate],
    parameters: tuple[UncertainParameter, ...],
) -> tuple[Robust, Settled]:
    """States and parameters, from the estimate in `begun`, which is taken out."""
    data, kernel = robust.data, robust.data.config.robust.kernel
    if not parameters:
        return robust, Settled(data, begun.pop())
    settled = settle(data, nodes, begun.pop(), robust.dropped, kernel, parameters)
    if exact := with_exact_speeds(settled):
        data, parameters = exact
        robust, estimate = solve_without_slips(data, nodes, settled.estimate.states)
        settled = settle(robust.data, nodes, estimate, robust.dropped, kernel, parameters)
    if late := with_late_clock(settled):
        settled = settle(settled.data, nodes, settled.estimate, robust.dropped, kernel, late)
        # Fixes that the wrong time had put beside the path.
        robust, estimate = solve_without_slips(settled.data, nodes, settled.estimate.states)
        late = settled.parameters
        settled = settle(robust.data, nodes, estimate, robust.dropped, kernel, late)
    return robust, settled


def _first_states(data: SmootherInput, nodes: IntArray) -> States:
    return first_states(data, nodes) if data.wheels is None else first_wheel_states(data, nodes)


def _last_step(
    settled: Settled,
    linear: gtsam.GaussianFactorGraph,
    cov_imu: Array,
    nodes: IntArray,
    dropped: IntArray,
    errors: Sequence[CorrelatedError],
) -> WithErrors:
    """The estimate with its covariance and chain, after a step with correlated errors if any.

    `linear` is the settled graph, `cov_imu` (n, 6, 6) its covariances where parameters are known.
    """
    if errors:
        return step_with_errors(settled, linear, nodes, dropped, errors)
    data = settled.data
    chain = chain_of(linear, len(nodes), data.yaw_bias, settled.columns)
    if settled.parameters:
        cov = covariances_with_parameters(settled, chain)
    else:
        Ad = np.asarray(data.T_vehicle_imu.AdjointMap())
        cov = Ad @ cov_imu @ Ad.T
    return WithErrors(settled, np.zeros((len(nodes), 0)), cov, chain)


def errors_in(
    data: SmootherInput, errors: Sequence[CorrelatedError]
) -> tuple[CorrelatedError, ...]:
    """The errors of sensors that the drive has, the first of each sensor."""
    has = {"gnss": data.positions is not None, "orientation": data.orientation}
    first = {error.kind: error for error in reversed(errors) if has[error.kind]}
    return tuple(first[kind] for kind in MOVES if kind in first)


def _within_span(
    data: SmootherInput, stamps_ns: Sequence[int] | IntArray
) -> tuple[IntArray, IntArray, list[str]]:
    """Wanted stamps within the IMU's span, those outside, and a warning about the latter."""
    inertial = data.inertial
    wanted = np.unique(np.asarray(stamps_ns, dtype=np.int64))
    inside = (wanted >= inertial.begin_ns) & (wanted <= inertial.end_ns)
    lost = wanted[~inside]
    if not len(lost):
        return wanted, lost, []
    if not inside.any():
        sensor = "IMU" if data.wheels is None else "velocities"
        raise TrajectoryError(
            f"{data.name}: all {len(wanted)} scans are outside the trajectory's span: {sensor} "
            f"from {inertial.begin_ns * 1e-9:.3f} s to {inertial.end_ns * 1e-9:.3f} s, scans from "
            f"{wanted[0] * 1e-9:.3f} s to {wanted[-1] * 1e-9:.3f} s. Check their clocks "
            "with 'caliv-graph inspect'"
        )
    line = (
        f"{data.name}: {len(lost)} of {len(wanted)} scans are outside the trajectory's span, lost"
    )
    return wanted[inside], lost, [line]


def _at_wanted(
    data: SmootherInput, wanted: IntArray, nodes: IntArray, states: States, cov: Array
) -> Trajectory:
    """The vehicle's poses at the wanted stamps; `cov` (n, 6, 6) are those at the nodes."""
    i = nearest_node(nodes, wanted)
    return Trajectory(
        stamps_ns=wanted,
        T_map_vehicle=poses_of_vehicle(states, i, data.T_vehicle_imu),
        cov=np.asarray(cov[i]),
    )


def _solved_roughly(nodes: IntArray, data: SmootherInput) -> States:
    """The states of an input, outliers among its fixes."""
    states = solve_from_the_start(data, nodes, _first_states(data, nodes))
    none = np.zeros(0, dtype=np.int64)
    return solve(data, nodes, states, none, "huber", ROUGH_TOLERANCE).states


def _roughly_settled(
    data: SmootherInput,
    nodes: IntArray,
    states: States,
    parameters: tuple[UncertainParameter, ...],
) -> tuple[SmootherInput, States, tuple[UncertainParameter, ...]]:
    """Input, states and parameters with all fixes, outliers among them."""
    none = np.zeros(0, dtype=np.int64)
    # Its graph is not kept beside those of the solves that follow.
    begun = [solve(data, nodes, states, none, "huber", ROUGH_TOLERANCE)]
    settled = settle(data, nodes, begun.pop(), none, "huber", parameters, ROUGH_TOLERANCE)
    settled = without_slips(settled, nodes)
    return settled.data, settled.estimate.states, settled.parameters


def _gyroscope_warnings(data: SmootherInput, parameters: Sequence[UncertainParameter]) -> list[str]:
    """A line if scale and axes of the gyroscope are off by more than their prior explains."""
    sigma = data.gyroscope_scale_sigma
    if sigma is None:
        return []
    (offset,) = (np.asarray(p.offset) for p in parameters if p.parameter is GYROSCOPE)
    most = float(np.abs(offset).max())
    if most <= BIAS_SIGMAS * sigma:
        return []
    return [
        f"{data.name}: the gyroscope reads {100.0 * most:.2g} percent of the vehicle's turn "
        "too much or too little, by its scale or its axes, and "
        f"imu.gyroscope_scale_sigma is {100.0 * sigma:.2g} percent: check its unit and range, or "
        "state a larger sigma"
    ]


def _delay_warnings(data: SmootherInput, settled: Settled) -> list[str]:
    """A line if the velocities are stamped late, or early."""
    sigmas = sigmas_in(settled.parameters, settled.cov, SPEEDS_DELAY.name)
    late_s = data.late_s(TWIST_CLOCK)
    if sigmas is None or abs(late_s) <= max(LATE_S, BIAS_SIGMAS * float(sigmas[0])):
        return []
    # To some milliseconds: its sigma is without what bumps and springs add to speeds.
    return [
        f"{data.name}: the velocities are stamped about {1e3 * abs(late_s):.0f} ms "
        f"{'late' if late_s > 0.0 else 'early'} in the clock of the IMU, which is made up for"
    ]


def _bias_warnings(data: SmootherInput, states: States) -> list[str]:
    """A line for each sensor whose bias its prior does not explain."""
    if data.wheels is not None:
        return []  # the states are those of the vehicle's motion
    noise = data.noise
    sensors = (
        ("accelerometer", states.force_bias, noise.force_bias, "accelerometer_bias_m_s2", "m/s^2"),
        ("gyroscope", states.gyro_bias, noise.gyro_bias, "gyroscope_bias_rad_s", "rad/s"),
    )
    out = []
    for sensor, bias, sigma, key, unit in sensors:
        typical = np.abs(np.median(bias, axis=0))
        if (typical > BIAS_SIGMAS * sigma).any():
            out.append(
                f"{data.name}: the {sensor}'s bias comes out as {typical.max():.3g} {unit}, "
                f"noise.{key} is {sigma.max():.3g}: a wrong unit, or axes that are not "
                "those of the orientation"
            )
    return out
