"""Inputs of the smoother that could be wrong, and by how much a sound one may be off.

Each is a parameter of the input (`parameters.py`): what freeing it would explain follows from the
chain of the estimate, without another solve. `uncertainty.suspects` ranks them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtri

from caliv_graph.config.wheels import SPEED_SCALE_SIGMA
from caliv_graph.products import Array, ImuSamples
from caliv_graph.trajectory.imu import interpolate, log_so3
from caliv_graph.trajectory.inputs import SmootherInput
from caliv_graph.trajectory.parameters import (
    GNSS_TIME_OFFSET,
    HEADING_YAW,
    LEVER_ARM,
    SECOND_ARM,
    InputParameter,
    inertial_time_offset,
    mount_rotation,
    speed_scale,
)
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.with_parameters import with_parameters

ARM_M = 0.01
"""Allowance, 1 sigma, of a lever arm without a sigma: the error of an RTK receiver that does not
average out over a drive is about as large."""

ARM_KNOWN_M = 0.3
"""Largest sigma at which a direction of a lever arm counts as determined, where the config gives no
wider one. On level ground the height of an antenna shows in the tilts alone, of which the
linearised graph claims more than there is: at sigmas of 0.5 m it wandered by metres."""

ROTATION_RAD = math.radians(0.1)
"""The same of the IMU's rotation: a mount on a surface that was made for it."""

CLOCK_S = 5e-3
"""The same of the stamps of a sensor, where the config says that they are exact: half the sample
period of an IMU at 100 Hz; at 2 m/s it is the centimetre of `ARM_M`."""

SENSOR_SCALE = 0.01
"""The same of the scales of gyroscope and accelerometer: data sheets of MEMS sensors state 0.1 to
1 %."""

MIN_TURN_RAD = 0.1
"""Smallest turn of a drive that tells a gyroscope's scale. The estimated turns of a vehicle that
stands are noise, by which the scale came out at 1.9 with a sigma of 0.2."""

HEADING_RAD = math.radians(0.2)
"""The same of the heading of an orientation source, as `heading.FLOOR_RAD`."""


@dataclass(frozen=True)
class SuspectParameter:
    """A parameter that could be wrong.

    Attributes:
        parameter: how it moves the input.
        allowance: (p,) 1 sigma of what a sound one may be off by.
        scale: (p,) largest sigma at which a direction counts as determined.
        offset: (p,) the estimate's value less the user's.
    """

    parameter: InputParameter
    allowance: Array
    scale: Array
    offset: Array


def suspect_parameters(smoothed: SmoothedTrajectory) -> tuple[SuspectParameter, ...]:
    """The inputs of a smoothed trajectory that could be wrong: those that it has."""
    data, out = smoothed.data, []
    if data.positions is not None:
        out.append(_known(smoothed, LEVER_ARM, ARM_M, ARM_KNOWN_M))
        out.append(_known(smoothed, GNSS_TIME_OFFSET, CLOCK_S, 1.0))
    if not data.config.solve.time_offset:  # else it is the clock that all others are against
        out.append(_known(smoothed, inertial_time_offset(data), CLOCK_S, 1.0))
    if data.positions is not None or data.motion.twist is not None:
        out.append(_known(smoothed, mount_rotation(data), ROTATION_RAD, 0.5))
    if data.motion.twist is not None:
        out.append(_known(smoothed, speed_scale(data), SPEED_SCALE_SIGMA, 1.0))
    if data.headings is not None:
        out.append(_known(smoothed, HEADING_YAW, HEADING_RAD, 0.5))
    if data.baselines is not None:
        out.append(_known(smoothed, SECOND_ARM, ARM_M, ARM_KNOWN_M))
    if data.orientation and not data.yaw_bias:
        out.append(_plain(_HEADING, HEADING_RAD, 1.0))
    if data.wheels is not None:
        return tuple(out)
    gyroscope, accelerometer = _inertial_scales(smoothed)
    if _turned_rad(smoothed) > MIN_TURN_RAD:
        out.append(_plain(gyroscope, SENSOR_SCALE, 1.0))
    return (*out, _plain(accelerometer, SENSOR_SCALE, 1.0))


def _turned_rad(smoothed: SmoothedTrajectory) -> float:
    """Largest angle from the first attitude."""
    R = smoothed.states.R_map_imu
    return float(np.linalg.norm(log_so3(R[0].T @ R), axis=1).max(initial=0.0))


def with_suspects(
    smoothed: SmoothedTrajectory,
) -> tuple[SmoothedTrajectory, tuple[SuspectParameter, ...]]:
    """The trajectory with its suspects in the chain, for `joint`; and these."""
    suspects = suspect_parameters(smoothed)
    return with_parameters(smoothed, [s.parameter for s in suspects]), suspects


def misfit(smoothed: SmoothedTrajectory) -> float:
    """Variance of the residuals over what the noise of the sensors states; 1 or more.

    The largest of GNSS, velocities and orientations, each by the median of its squared residuals:
    outliers do not matter, and a single wrong input is small in most of them.
    """
    squares: dict[str, list[float]] = {kind: [] for kind in ("gnss", "velocity", "orientation")}
    estimate = smoothed.estimate(squares.keys())
    for number, kind in enumerate(estimate.graph.kinds):
        factor: Any = estimate.graph.factors.at(number)
        residual = factor.unwhitenedError(estimate.values)
        white = factor.noiseModel().unweightedWhiten(residual)
        squares[kind].append(float(white @ white))
    usual = float(chdtri(3, 0.5))
    return max([1.0, *(float(np.median(some)) / usual for some in squares.values() if some)])


def _known(
    smoothed: SmoothedTrajectory, parameter: InputParameter, allowance: float, scale: float
) -> SuspectParameter:
    """A parameter that the smoother may have estimated under a prior: its sigma is the allowance.

    One that the user asked to be estimated has no right value: it is no suspect beyond its prior.
    """
    for p in smoothed.parameters:
        sigmas = p.graph_sigmas
        if p.parameter.name == parameter.name and sigmas is not None:
            offset = np.zeros(parameter.size) if p.offset is None else p.offset
            wide = np.maximum(scale, 3.0 * sigmas)
            return SuspectParameter(parameter, sigmas, wide, offset)
    return _plain(parameter, allowance, scale)


def _plain(parameter: InputParameter, allowance: float, scale: float) -> SuspectParameter:
    size = parameter.size
    return SuspectParameter(
        parameter, np.full(size, allowance), np.full(size, scale), np.zeros(size)
    )


def _inertial_scales(smoothed: SmoothedTrajectory) -> tuple[InputParameter, InputParameter]:
    """Measured over true angular velocities and specific forces, less one; estimates are scaled.

    Both are those between the estimated nodes.
    """
    states, nodes = smoothed.states, smoothed.nodes_ns
    seconds = (np.diff(nodes) * 1e-9)[:, None]
    R, back = states.R_map_imu, np.swapaxes(states.R_map_imu[:-1], 1, 2)
    gyro = log_so3(back @ R[1:]) / seconds
    gravity = np.array([0.0, 0.0, -smoothed.gravity_m_s2])
    force = np.einsum("nij,nj->ni", back, np.diff(states.velocity_map, axis=0) / seconds - gravity)
    middles = nodes[:-1] + np.diff(nodes) // 2
    stamps = smoothed.inertial.stamps_ns

    rates, forces = interpolate(stamps, middles, gyro), interpolate(stamps, middles, force)

    def turned(data: SmootherInput, d: Array) -> SmootherInput:
        changed = replace(data.inertial, gyro=data.inertial.gyro - d[0] * rates)
        return replace(data, inertial=changed)

    def pushed(data: SmootherInput, d: Array) -> SmootherInput:
        changed = replace(data.inertial, force=data.inertial.force - d[0] * forces)
        return replace(data, inertial=changed)

    return (
        _scalar("imu.gyroscope.scale", "", "imu", turned),
        _scalar("imu.accelerometer.scale", "", "imu", pushed),
    )


def _heading_turned(data: SmootherInput, d: Array) -> SmootherInput:
    imu = data.motion.imu
    assert imu is not None
    assert imu.orientation_xyzw is not None
    turned: ImuSamples = replace(imu, orientation_xyzw=_turned_about_z(imu.orientation_xyzw, -d[0]))
    return replace(data, motion=replace(data.motion, imu=turned))


def _turned_about_z(xyzw: Array, angle_rad: float) -> Array:
    """(n, 4) quaternions of `Rz(angle) R`."""
    x, y, z, w = xyzw.T
    c, s = math.cos(0.5 * angle_rad), math.sin(0.5 * angle_rad)
    return np.stack([c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z], axis=1)


def _scalar(
    name: str, unit: str, kind: str, moved: Callable[[SmootherInput, Array], SmootherInput]
) -> InputParameter:
    return InputParameter(name, ("value",), unit, np.full(1, 1e-3), frozenset({kind}), moved)


_HEADING = _scalar("imu.yaw_bias", "rad", "orientation", _heading_turned)
