"""Parameters of the smoother's input: what the user typed or a sensor scales, as coordinates.

A parameter moves the input, so that its derivatives need no formula: those of every factor's
residual are central differences (`README.md`, section 13). It enters the linearised graph as common
coordinates, beside the yaw bias.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array
from caliv_graph.trajectory.chain import UNDETERMINED
from caliv_graph.trajectory.inputs import GNSS_CLOCK, IMU_CLOCK, TWIST_CLOCK, SmootherInput
from caliv_graph.trajectory.wheels import swing_rates

XYZ = ("x", "y", "z")


@dataclass(frozen=True)
class InputParameter:
    """Something constant over a drive that the input of the smoother depends on.

    Attributes:
        name: of the config's key, or what it is called in messages: `gnss.lever_arm`.
        axes: names of its p coordinates.
        unit: of the coordinates: m, rad, s, or empty.
        steps: (p,) steps of the central differences, in that unit.
        kinds: of the factors whose residuals it moves (`build.KINDS`).
        moved: the input with the parameter moved by (p,), from its present value.
    """

    name: str
    axes: tuple[str, ...]
    unit: str
    steps: Array
    kinds: frozenset[str]
    moved: Callable[[SmootherInput, Array], SmootherInput] = field(repr=False)

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.axes)

    def stepped(self, data: SmootherInput, coordinate: int, sign: float) -> SmootherInput:
        """The input, one coordinate moved by its step times `sign`."""
        d = np.zeros(self.size)
        d[coordinate] = sign * self.steps[coordinate]
        return self.moved(data, d)

    def imu_moves(self, data: SmootherInput) -> Array:
        """(6, p) derivative of T_vehicle_imu, a right perturbation; zero for most parameters."""
        out = np.zeros((6, self.size))
        for k in range(self.size):
            ahead, behind = (self.stepped(data, k, sign).T_vehicle_imu for sign in (1.0, -1.0))
            out[:, k] = gtsam.Pose3.Logmap(behind.between(ahead)) / (2.0 * self.steps[k])
        return out


@dataclass(frozen=True)
class UncertainParameter:
    """A parameter in the chain of a trajectory.

    Attributes:
        parameter: what it is.
        sigmas: (p,) of its prior; None: without one it is held where nobody asks for it.
        offset: (p,) its present value less the prior's mean.
        beside_lidars: (p,) the same as `sigmas` in the graph of a calibration, where LiDARs tell
            more of it; None: `sigmas`.
    """

    parameter: InputParameter
    sigmas: Array | None = None
    offset: Array | None = None
    beside_lidars: Array | None = None

    @property
    def graph_sigmas(self) -> Array | None:
        """(p,) of its prior in the graph of a calibration."""
        return self.sigmas if self.beside_lidars is None else self.beside_lidars


def sigmas_in(parameters: Sequence[UncertainParameter], cov: Array, name: str) -> Array | None:
    """(p,) 1 sigma of a parameter by its name; None: `cov`, of all, is without it."""
    variances, first = np.diagonal(cov), 0
    for p in parameters:
        if p.parameter.name == name and first + p.parameter.size <= len(variances):
            return np.asarray(np.sqrt(variances[first : first + p.parameter.size]))
        first += p.parameter.size
    return None


def _arm_moved(data: SmootherInput, d: Array) -> SmootherInput:
    return replace(data, lever_arm=data.lever_arm + d)


def _imu_turned(data: SmootherInput, d: Array) -> SmootherInput:
    T = data.T_vehicle_imu
    R = gtsam.Rot3.Expmap(d).compose(T.rotation())
    return replace(data, T_vehicle_imu=gtsam.Pose3(R, T.translation()))


def _imu_shifted(data: SmootherInput, d: Array) -> SmootherInput:
    T = data.T_vehicle_imu
    return replace(data, T_vehicle_imu=gtsam.Pose3(T.rotation(), T.translation() + d))


LEVER_ARM = InputParameter(
    "gnss.lever_arm", XYZ, "m", np.full(3, 0.01), frozenset({"gnss", "baseline"}), _arm_moved
)
"""The GNSS antenna in the vehicle frame. The residuals are linear in it."""


def _slope_moved(data: SmootherInput, d: Array) -> SmootherInput:
    return replace(data, slope=data.slope + d)


def _slip_moved(data: SmootherInput, d: Array) -> SmootherInput:
    return replace(data, axle_slip=data.axle_slip + float(d[0]))


def _course_moved(data: SmootherInput, d: Array) -> SmootherInput:
    assert data.motion.twist is not None
    change = swing_rates(data.motion.twist, data.inertial.stamps_ns)
    gyro = data.inertial.gyro.copy()
    gyro[:, 2] += float(d[0]) * change
    return replace(data, inertial=replace(data.inertial, gyro=gyro))


def _lean_moved(data: SmootherInput, d: Array) -> SmootherInput:
    return replace(data, lean=data.lean + d)


def _scale_moved(data: SmootherInput, d: Array) -> SmootherInput:
    scale = data.speed_scale + float(d[0])
    noise = data.noise
    if data.wheels is not None:
        by = data.speed_scale / scale
        density, walk = noise.force_density * by**2, noise.force_walk * by
        noise = replace(noise, force_density=density, force_walk=walk)
    return replace(data, speed_scale=scale, noise=noise)


def _speed_point_moved(data: SmootherInput, d: Array) -> SmootherInput:
    return replace(data, speed_point=data.speed_point + d)


def _heading_moved(data: SmootherInput, d: Array) -> SmootherInput:
    return replace(data, heading_yaw=data.heading_yaw + float(d[0]))


def _second_arm_moved(data: SmootherInput, d: Array) -> SmootherInput:
    return replace(data, second_arm=data.second_arm + d)


IMU_ROTATION = InputParameter(
    "imu.T_vehicle_imu",
    ("roll", "pitch", "yaw"),
    "rad",
    np.full(3, 1e-3),
    frozenset({"gnss", "velocity", "heading", "baseline"}),
    _imu_turned,
)
"""Rotation of T_vehicle_imu about the vehicle's axes, the IMU's origin fixed: Exp(d) R. Of a step
of 1 mrad the central difference neglects a part of 2e-7."""

IMU_PLACE = InputParameter(
    "imu.T_vehicle_imu.xyz",
    XYZ,
    "m",
    np.full(3, 0.01),
    frozenset({"gnss", "velocity"}),
    _imu_shifted,
)
"""The IMU's origin in the vehicle frame. Accelerations tell it in curves and on bumps: to a few
millimetres, where the noise is small, and with it every place on the vehicle. Residuals are linear
in it."""

WHEELS_ROTATION = replace(IMU_ROTATION, name="wheels.T_vehicle_wheels")
"""The same of the axle's frame, which stands in for that of an IMU."""

SLOPE = InputParameter(
    "wheels.slope", ("x", "y"), "rad", np.full(2, 1e-3), frozenset({"level"}), _slope_moved
)
"""Of the mean ground of a drive, along the map's axes."""

AXLE_SLIP = InputParameter(
    "wheels.slip", ("value",), "s^2/m", np.full(1, 1e-3), frozenset({"velocity"}), _slip_moved
)
"""Side slip of an axle per lateral acceleration, to the outside of a curve: how soft its tyres are.
At a constant speed it is as if the axle were `slip v^2` further in the direction of travel."""

COURSE_RATE = InputParameter(
    "wheels.course", ("value",), "s^2/m", np.full(1, 1e-3), frozenset({"imu"}), _course_moved
)
"""What the yaw rate of wheels lacks of that of the body, per change of the lateral acceleration:
nothing where wheels or a sensor measure it, `wheels.slip` where it is made from a steering angle,
which gives the rate of the course."""

LEAN = InputParameter(
    "wheels.lean",
    ("pitch", "roll"),
    "rad s^2/m",
    np.full(2, 1e-3),
    frozenset({"level"}),
    _lean_moved,
)
"""How the body leans on its springs, per acceleration ahead and to the left."""

SPEED_SCALE = InputParameter(
    "twist.scale", ("value",), "", np.full(1, 1e-3), frozenset({"velocity"}), _scale_moved
)
"""Measured over true velocities, less one. It scales the estimated velocities, not the measured
ones: these are noise times noise."""

WHEEL_SCALE = replace(SPEED_SCALE, kinds=frozenset({"velocity", "imu"}))
"""The same without an IMU. The prior of the motion is then one of what the wheels measure: walks of
the acceleration are in their unit. In metres it would prefer a vehicle that moves less, and with it
a larger scale (`README.md`, section 15)."""

SPEED_POINT = InputParameter(
    "twist.point", ("y", "z"), "m", np.full(2, 0.01), frozenset({"velocity"}), _speed_point_moved
)
"""Where in the vehicle frame wheels measure the speed, beside an IMU (`README.md`, section 15)."""


def _gnss_late(data: SmootherInput, d: Array) -> SmootherInput:
    return replace(data, late_ns=_later(data, GNSS_CLOCK, d))


def _twist_late(data: SmootherInput, d: Array) -> SmootherInput:
    return replace(data, late_ns=_later(data, TWIST_CLOCK, d))


def _imu_late(data: SmootherInput, d: Array) -> SmootherInput:
    late = _later(data, IMU_CLOCK, d)
    # The ends of gaps are nodes, which stay where they are.
    by_ns = late[IMU_CLOCK] - data.late_ns.get(IMU_CLOCK, 0)
    inertial = replace(data.inertial, stamps_ns=data.inertial.stamps_ns - by_ns)
    return replace(data, inertial=inertial, late_ns=late)


DIVERGED_S = 10.0
"""A clock that seems to be this late was estimated from what no motion explains: the linearisation
has no validity there."""


def _later(data: SmootherInput, clock: str, d: Array) -> dict[str, int]:
    late_s = data.late_ns.get(clock, 0) / NANOSECONDS_PER_SECOND + float(d[0])
    if not abs(late_s) < DIVERGED_S:
        raise TrajectoryError(f"{UNDETERMINED}. Stamps of the {clock} seem {late_s:.3g} s late")
    return {**data.late_ns, clock: round(late_s * NANOSECONDS_PER_SECOND)}


GNSS_TIME_OFFSET = InputParameter(
    "gnss.time_offset",
    ("value",),
    "s",
    np.full(1, 1e-3),
    frozenset({"gnss", "heading", "baseline"}),
    _gnss_late,
)
"""Stamps of the fixes less the true times, in the clock of the LiDARs (`README.md`, section 13)."""

IMU_TIME_OFFSET = InputParameter(
    "imu.time_offset",
    ("value",),
    "s",
    np.full(1, 1e-3),
    frozenset({"imu", "gnss", "orientation", "velocity", "heading", "baseline"}),
    _imu_late,
)
"""The same of the IMU, its orientations with it. Nodes and their poses stay in the clock of the
LiDARs."""

WHEELS_TIME_OFFSET = replace(
    IMU_TIME_OFFSET, name="twist.time_offset", kinds=IMU_TIME_OFFSET.kinds | {"level"}
)
"""The same of wheels without an IMU, whose odometry stands in for it."""

SPEEDS_DELAY = InputParameter(
    "twist.delay", ("value",), "s", np.full(1, 1e-3), frozenset({"velocity"}), _twist_late
)
"""The same of velocities beside an IMU, which tells it: a parameter of the drive alone.
A vehicle's bus stamps them tens of milliseconds after the wheels were read."""

HEADING_YAW = InputParameter(
    "heading.yaw_deg", ("value",), "rad", np.full(1, 1e-3), frozenset({"heading"}), _heading_moved
)
"""Direction of the baseline of two antennas in the vehicle frame."""

SECOND_ARM = InputParameter(
    "heading.lever_arm", XYZ, "m", np.full(3, 0.01), frozenset({"baseline"}), _second_arm_moved
)
"""The second antenna in the vehicle frame. The residuals are linear in it."""


def _response_moved(data: SmootherInput, d: Array) -> SmootherInput:
    up = np.asarray(data.T_vehicle_imu.rotation().unrotate(np.array([0.0, 0.0, 1.0])))
    gyro = data.inertial.gyro - np.outer(data.inertial.gyro @ up, d)
    return replace(data, inertial=replace(data.inertial, gyro=gyro))


GYROSCOPE = InputParameter(
    "imu.gyroscope",
    XYZ,
    "",
    np.full(3, 1e-3),
    frozenset({"imu", "gnss", "velocity"}),
    _response_moved,
)
"""What the gyroscope reads too much along its axes, per turn of the vehicle about its vertical: by
its scale, and by axes that are not those of the accelerometer. A vehicle turns about nothing else
for long."""


def speed_scale(data: SmootherInput) -> InputParameter:
    """The scale of the velocities of an input."""
    return SPEED_SCALE if data.wheels is None else WHEEL_SCALE


def mount_rotation(data: SmootherInput) -> InputParameter:
    """The rotation of `T_vehicle_imu` under the name that it has in the config."""
    return IMU_ROTATION if data.wheels is None else WHEELS_ROTATION


def inertial_time_offset(data: SmootherInput) -> InputParameter:
    """The clock of the IMU, or of the wheels that stand in for it."""
    return IMU_TIME_OFFSET if data.wheels is None else WHEELS_TIME_OFFSET
