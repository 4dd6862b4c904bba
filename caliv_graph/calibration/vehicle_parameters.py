"""Lever arm, rotation of the IMU and clocks in the calibration graph: one of each for all drives.

The motion data of a drive are a Gaussian on its poses and on them (`README.md`, section 17).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import gtsam
import numpy as np
from scipy.linalg import block_diag

from caliv_graph.calibration.heave import with_heave
from caliv_graph.config.guesses import DEFAULT_GUESS_SIGMAS
from caliv_graph.config.model import Config
from caliv_graph.conventions import (
    key_imu_place,
    key_imu_rotation,
    key_lever_arm,
    key_sensor_offset,
    key_wheels_rotation,
)
from caliv_graph.geometry.chart import PoseChart
from caliv_graph.products import Array, IntArray, VehicleParameter
from caliv_graph.trajectory.chain import POSE
from caliv_graph.trajectory.factors import tangent_size
from caliv_graph.trajectory.inputs import GNSS_CLOCK, IMU_CLOCK
from caliv_graph.trajectory.parameters import (
    GNSS_TIME_OFFSET,
    HEADING_YAW,
    IMU_PLACE,
    IMU_ROTATION,
    IMU_TIME_OFFSET,
    LEVER_ARM,
    SPEED_SCALE,
    WHEELS_ROTATION,
    WHEELS_TIME_OFFSET,
    mount_rotation,
)
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.smoothed import JointInformation, SmoothedTrajectory
from caliv_graph.uncertainty.observability import UNDETERMINED_RATIO

ParameterValue = Array | gtsam.Rot3

POSE_TIME_OFFSET = "poses.time_offset"
"""Name of the time offset of given poses: their stamps less the true times."""

KEYS = {
    LEVER_ARM.name: key_lever_arm(),
    IMU_PLACE.name: key_imu_place(),
    IMU_ROTATION.name: key_imu_rotation(),
    WHEELS_ROTATION.name: key_wheels_rotation(),
    GNSS_TIME_OFFSET.name: key_sensor_offset(0),
    IMU_TIME_OFFSET.name: key_sensor_offset(1),
    WHEELS_TIME_OFFSET.name: key_sensor_offset(2),
    POSE_TIME_OFFSET: key_sensor_offset(3),
}
"""Parameter of the input -> its key: (3,) metres in the vehicle frame, R_vehicle_imu,
R_vehicle_wheels, and (1,) seconds."""

NAMES = {
    LEVER_ARM.name: "lever_arm",
    IMU_PLACE.name: "imu_place",
    IMU_ROTATION.name: "imu_rotation",
    WHEELS_ROTATION.name: "wheels_rotation",
    GNSS_TIME_OFFSET.name: "gnss_time_offset",
    IMU_TIME_OFFSET.name: "imu_time_offset",
    WHEELS_TIME_OFFSET.name: "twist_time_offset",
    POSE_TIME_OFFSET: "pose_time_offset",
}
"""What they are called in a result."""

CLOCKS = {
    GNSS_TIME_OFFSET.name: GNSS_CLOCK,
    IMU_TIME_OFFSET.name: IMU_CLOCK,
    WHEELS_TIME_OFFSET.name: IMU_CLOCK,
}
"""Parameters that are the time offset of a sensor -> its clock in `SmootherInput.late_s`."""

USUAL_LATE_S = 0.02
"""1 sigma of the stamps of a sensor whose messages are stamped when they arrive."""

USUAL_SIGMAS = {
    LEVER_ARM.name: DEFAULT_GUESS_SIGMAS[3:],
    IMU_PLACE.name: DEFAULT_GUESS_SIGMAS[3:],
    IMU_ROTATION.name: DEFAULT_GUESS_SIGMAS[:3],
    WHEELS_ROTATION.name: DEFAULT_GUESS_SIGMAS[:3],
    **dict.fromkeys([*CLOCKS, POSE_TIME_OFFSET], np.full(1, USUAL_LATE_S)),
}
"""A parameter that nobody measured is judged by the usual guess of a mount, as extrinsics are."""


HELD_M = 1e-3
"""1 sigma of a coordinate that is held: it lifts the map, and a map that is metres away makes tilts
look like shifts of the poses."""


@dataclass(frozen=True)
class MotionTerm:
    """What the motion data of a drive say of its m poses and of parameters of the vehicle.

    Minus the log-likelihood is `d^T information d / 2 - gradient^T d`: coordinates of the poses in
    `chart`, then right perturbations of the parameters about `values`.

    Attributes:
        information: (6 m + p, 6 m + p), heave included, priors of the parameters not; p the
            coordinates of all parameters.
        gradient: (6 m + p,).
        constant: at least twice what the quadratic falls below zero.
        values: of the parameters where it was linearised, by name, in order.
        chart: of the poses.
    """

    information: Array
    gradient: Array
    constant: float
    values: Mapping[str, ParameterValue]
    chart: PoseChart


@dataclass(frozen=True)
class ParameterPrior:
    """The prior of a parameter of the vehicle: its mean, and (p, p) of its perturbation.

    `sigmas` (p,) are those of the lever arm's x, y, z, of the rotation about the vehicle's axes, or
    of a time. `held` are coordinates of the lever arm that nothing tells and that change nothing
    else: `cov` has `HELD_M` of them; empty: none.
    """

    mean: ParameterValue
    cov: Array
    sigmas: Array
    held: tuple[bool, ...] = ()


def motion_term(
    trajectory: SmoothedTrajectory, stamps_ns: Sequence[int], heave_m: float
) -> MotionTerm | None:
    """The term of one drive's wanted poses.

    None if none of its parameters is uncertain, and their mean is the trajectory.
    """
    if not (_uncertain(trajectory) or trajectory.elsewhere):
        return None
    joint, values = motion_gaussian(trajectory, stamps_ns, heave_m)
    chart = chart_of(trajectory)
    return MotionTerm(joint.information, joint.gradient, _constant(joint), values, chart)


def chart_of(trajectory: SmoothedTrajectory) -> PoseChart:
    """Coordinates of the vehicle's poses in which a turn of the IMU on it is a straight line."""
    return PoseChart(np.asarray(trajectory.T_vehicle_imu.translation()))


def motion_gaussian(
    trajectory: SmoothedTrajectory, stamps_ns: Sequence[int] | IntArray, heave_m: float
) -> tuple[JointInformation, dict[str, ParameterValue]]:
    """The joint Gaussian of one drive's wanted poses, heave included, and uncertain parameters.

    A rotation of the IMU is a right perturbation in it. Also the parameters' values, by name.
    """
    names = [name for name in KEYS if name in _uncertain(trajectory)]
    joint = _in_tangents(trajectory, trajectory.joint(stamps_ns, names))
    if _height_unknown(trajectory):
        joint = _without_height(joint)
    information, gradient = with_heave(
        joint.information, joint.gradient, len(joint.T_map_vehicle), heave_m
    )
    joint = replace(joint, information=information, gradient=gradient)
    return joint, {name: _value(trajectory, name) for name in names}


def parameter_priors(trajectories: Sequence[SmoothedTrajectory]) -> dict[str, ParameterPrior]:
    """The prior of each uncertain parameter of smoothed drives, counted once; the first drive's.

    They differ between drives only where the rotation of the IMU was guessed from the data.
    """
    out: dict[str, ParameterPrior] = {}
    for trajectory in trajectories:
        for name, (sigmas, offset) in _uncertain(trajectory).items():
            value, cov = _value(trajectory, name), np.diag(sigmas**2)
            mean: ParameterValue
            if isinstance(value, gtsam.Rot3):
                mean = gtsam.Rot3.Expmap(-offset).compose(value)
                cov = mean.matrix().T @ cov @ mean.matrix()
            else:
                mean = value - offset
            out.setdefault(name, ParameterPrior(mean, cov, sigmas))
    with_arm = [t for t in trajectories if LEVER_ARM.name in _uncertain(t)]
    if with_arm and all(map(_height_unknown, with_arm)):
        arm = out[LEVER_ARM.name]
        cov = arm.cov.copy()
        cov[2, 2] = HELD_M**2
        out[LEVER_ARM.name] = replace(arm, cov=cov, held=(False, False, True))
    return {name: out[name] for name in KEYS if name in out}


def pose_clock_prior(config: Config) -> ParameterPrior | None:
    """The prior of the time offset of given poses; None: it is zero.

    So it is where LiDARs have offsets of their own.
    """
    sigma = np.full(1, config.noise.pose_time_offset_s)
    if config.solve.time_offset or not sigma.any():
        return None
    return ParameterPrior(np.zeros(1), np.diag(sigma**2), sigma)


def rates_of_errors(R_map_vehicle: Array, twists: Array) -> Array:
    """(n, 6) of twists (n, 6), vehicle axes: what a second of lateness is as an error of poses."""
    out = twists.copy()
    out[:, 3:] = np.einsum("nij,nj->ni", R_map_vehicle, twists[:, 3:])
    return out


class _Marginals(Protocol):
    """The solved problem, as `reduced.Reduced` has it."""

    def covariance_of(self, key: int, cov: Array) -> Array:
        """Marginal covariance of a variable, `cov` that of the extrinsics."""


def estimated_parameters(
    priors: Mapping[str, ParameterPrior], values: gtsam.Values, solved: _Marginals, cov: Array
) -> dict[str, VehicleParameter]:
    """Value, sigma and verdict of each parameter; `cov` is that of the extrinsics."""
    out = {}
    for name, prior in priors.items():
        own = solved.covariance_of(KEYS[name], cov)
        if isinstance(prior.mean, gtsam.Rot3):
            R = values.atRot3(KEYS[name])
            value, own, known = R.rpy(), R.matrix() @ own @ R.matrix().T, prior.sigmas**-2.0
        else:
            value, known = values.atVector(KEYS[name]), 1.0 / np.diag(prior.cov)
        variance = np.diag(own)
        # What the drive knows is what the result knows beyond the prior that it was solved under.
        by_drive = np.maximum(1.0 / variance - known, 0.0)
        limit = UNDETERMINED_RATIO * np.minimum(prior.sigmas, USUAL_SIGMAS[name])
        determined = by_drive > limit**-2.0
        if prior.held:
            determined &= ~np.array(prior.held)
        # Of what nobody knows the linearised graph knows too much: the noise of the poses' tilt
        # looks like one that would tell the height of the antenna (`README.md`, section 17).
        unknown = ~determined & (prior.sigmas > USUAL_SIGMAS[name]) & (name == LEVER_ARM.name)
        sigma = np.where(unknown, prior.sigmas, np.sqrt(variance))
        out[name] = VehicleParameter(np.asarray(value), sigma, tuple(determined.tolist()))
    return out


def sigmas_from_stated(
    vehicle: Mapping[str, VehicleParameter], trajectories: Sequence[VehicleTrajectory]
) -> dict[str, float]:
    """How far places and rotations that the user measured come out from there, in his sigmas.

    The largest of the three coordinates, by the name of the input. Under a right model data that do
    not determine them leave them where they are.
    """
    smoothed = [t for t in trajectories if isinstance(t, SmoothedTrajectory)]
    out = {}
    for name, prior in parameter_priors(smoothed).items():
        if name in CLOCKS or NAMES[name] not in vehicle:
            continue
        value, mean = vehicle[NAMES[name]].value, prior.mean
        if isinstance(mean, gtsam.Rot3):
            R = gtsam.Rot3.RzRyRx(*np.asarray(value).tolist())
            away = gtsam.Rot3.Logmap(R.compose(mean.inverse()))
        else:
            away = value - mean
        out[name] = float(np.max(np.abs(away) / prior.sigmas))
    return out


def drive_parameters(trajectories: Sequence[VehicleTrajectory]) -> dict[str, VehicleParameter]:
    """Scale of the speeds and yaw of a baseline, of the drives on which they were estimated.

    Every drive has its own, by its motion data alone.
    """
    found: dict[str, list[tuple[float, float, bool]]] = {}
    for trajectory in trajectories:
        if not isinstance(trajectory, SmoothedTrajectory):
            continue
        for p in trajectory.parameters:
            name = PER_DRIVE.get(p.parameter.name)
            sigmas = trajectory.sigmas_of(p.parameter.name)
            if name is None or p.sigmas is None or sigmas is None:
                continue
            data = trajectory.data
            value = data.speed_scale if name == "speed_scale" else data.heading_yaw
            sigma, prior = float(sigmas[0]), float(p.sigmas[0])
            told = max(sigma**-2 - prior**-2, 0.0) > (UNDETERMINED_RATIO * prior) ** -2
            found.setdefault(name, []).append((value, sigma, told))
    out = {}
    for name, rows in found.items():
        values, spread, determined = zip(*rows, strict=True)
        out[name] = VehicleParameter(np.array(values), np.array(spread), determined)
    return out


PER_DRIVE = {SPEED_SCALE.name: "speed_scale", HEADING_YAW.name: "heading_yaw"}
"""Parameters that every drive has of its own -> what they are called in a result."""


def _uncertain(trajectory: SmoothedTrajectory) -> dict[str, tuple[Array, Array]]:
    """Sigmas of the prior, and the offset from its mean, of each parameter that has one."""
    return {
        p.parameter.name: (sigmas, np.zeros(p.parameter.size) if p.offset is None else p.offset)
        for p in trajectory.parameters
        if (sigmas := p.graph_sigmas) is not None and p.parameter.name in KEYS
    }


def _value(trajectory: SmoothedTrajectory, name: str) -> ParameterValue:
    if name == LEVER_ARM.name:
        return np.asarray(trajectory.data.lever_arm)
    if name == IMU_PLACE.name:
        return np.asarray(trajectory.data.T_vehicle_imu.translation())
    if name in CLOCKS:
        return np.array([trajectory.data.late_s(CLOCKS[name])])
    return trajectory.data.T_vehicle_imu.rotation()


def _in_tangents(trajectory: SmoothedTrajectory, joint: JointInformation) -> JointInformation:
    """The same, a rotation of the IMU as a right perturbation instead of one in vehicle axes."""
    rotation = mount_rotation(trajectory.data).name
    if rotation not in joint.parameters:
        return joint
    m = len(joint.T_map_vehicle)
    R_vehicle_imu = trajectory.data.T_vehicle_imu.rotation().matrix()
    sizes = {name: tangent_size(_value(trajectory, name)) for name in joint.parameters}
    blocks = [R_vehicle_imu if n == rotation else np.eye(k) for n, k in sizes.items()]
    turn = np.asarray(block_diag(*blocks))
    information, gradient = joint.information.copy(), joint.gradient.copy()
    information[:, POSE * m :] = information[:, POSE * m :] @ turn
    information[POSE * m :] = turn.T @ information[POSE * m :]
    gradient[POSE * m :] = turn.T @ gradient[POSE * m :]
    return JointInformation(information, gradient, joint.T_map_vehicle, joint.parameters)


def _height_unknown(trajectory: SmoothedTrajectory) -> bool:
    """Whether the motion data leave the height of the antenna to its prior."""
    known = trajectory.sigmas_of(LEVER_ARM.name)
    prior = _uncertain(trajectory).get(LEVER_ARM.name)
    return (
        known is not None
        and prior is not None
        and bool(prior[0][2] > USUAL_SIGMAS[LEVER_ARM.name][2])
        and bool(known[2] > UNDETERMINED_RATIO * prior[0][2])
    )


def _without_height(joint: JointInformation) -> JointInformation:
    """The same; the height of the antenna lifts the whole map, and nothing tells it.

    On level ground it shows in the tilts alone, linearised where their noise is: times an error of
    metres it looks like errors of the fixes. Poses that LiDARs know to a millimetre would then say
    where the antenna is, 20 m away.
    """
    m = len(joint.T_map_vehicle)
    assert joint.parameters[0] == LEVER_ARM.name  # as in `KEYS`
    z = POSE * m + 2
    # The fixes stay: a vehicle whose antenna is higher is lower.
    follow = np.eye(len(joint.gradient))
    follow[z, z] = 0.0
    for i, T in enumerate(joint.T_map_vehicle):
        follow[POSE * i + 3 : POSE * i + 6, z] = T.rotation().matrix()[2]
    return replace(
        joint,
        information=follow.T @ joint.information @ follow,
        gradient=follow.T @ joint.gradient,
    )


def _constant(joint: JointInformation) -> float:
    """At least twice what the quadratic falls below zero."""
    size = POSE * len(joint.T_map_vehicle)
    B, a = joint.information[:size, size:], joint.gradient[:size]
    known = np.linalg.solve(joint.information[:size, :size], np.column_stack([B, a]))
    own = joint.information[size:, size:] - B.T @ known[:, :-1]  # the parameters' marginal
    pull = joint.gradient[size:] - B.T @ known[:, -1]
    inverse = np.linalg.pinv(0.5 * (own + own.T), 1e-12, hermitian=True)
    return float(a @ known[:, -1] + pull @ inverse @ pull)
