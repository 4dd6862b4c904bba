"""Drives: the pose of the vehicle at any time, analytic in time and in path length.

The model is a single track with a steered front axle (Ackermann) and the frame on the ground at the
rear axle. The speed is a function of time and the curvature one of path length, so the path does
not depend on the speed. Position is an integral by quadrature, exact to a micrometre; all
derivatives are analytic.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol, assert_never

import gtsam
import numpy as np
import numpy.typing as npt

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import ConfigError
from caliv_graph.products import Array, IntArray
from caliv_graph.scenario.drive_models import (
    ArcDrive,
    DriveModel,
    FigureEightDrive,
    SCurveDrive,
    StandstillDrive,
    StraightDrive,
)

if TYPE_CHECKING:
    from caliv_graph.scenario.sensor_models import LidarModel
    from caliv_graph.scenario.terrain import Terrain

PANEL_M = 0.25
"""Length of one quadrature panel. With 8 nodes the rule is exact to rounding at driving radii."""

GAUSS_NODES, GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(8)


def smoothstep(u: npt.ArrayLike) -> Array:
    """0 below 0, 1 above 1, between them 10 u^3 - 15 u^4 + 6 u^5: two continuous derivatives."""
    v = np.clip(np.asarray(u, dtype=np.float64), 0.0, 1.0)
    return v**3 * (10.0 + v * (6.0 * v - 15.0))


def smoothstep_rate(u: npt.ArrayLike) -> Array:
    """The derivative of `smoothstep`."""
    v = np.clip(np.asarray(u, dtype=np.float64), 0.0, 1.0)
    return 30.0 * (v * (1.0 - v)) ** 2


def smoothstep_integral(u: npt.ArrayLike) -> Array:
    """The integral of `smoothstep` from 0."""
    w = np.asarray(u, dtype=np.float64)
    v = np.clip(w, 0.0, 1.0)
    return v**4 * (2.5 + v * (v - 3.0)) + np.maximum(w - 1.0, 0.0)


@dataclass(frozen=True)
class SpeedProfile:
    """Speed over time: standing, a smooth start, constant speed, a smooth stop.

    Attributes:
        speed_m_s: the constant speed; 0 is a vehicle that never moves.
        standstill_s: time before it starts.
        ramp_s: duration of the start, and of the stop.
        duration_s: time at which it stands again.
    """

    speed_m_s: float
    standstill_s: float
    ramp_s: float
    duration_s: float

    def _progress(self, time_s: Array) -> tuple[Array, Array]:
        stop_s = self.duration_s - self.ramp_s
        return (time_s - self.standstill_s) / self.ramp_s, (time_s - stop_s) / self.ramp_s

    def distance_m(self, time_s: Array) -> Array:
        """Path length since the start, any shape."""
        start, stop = self._progress(time_s)
        ramps = smoothstep_integral(start) - smoothstep_integral(stop)
        return self.speed_m_s * self.ramp_s * ramps

    def speed(self, time_s: Array) -> Array:
        """Speed in m/s, any shape."""
        start, stop = self._progress(time_s)
        return self.speed_m_s * (smoothstep(start) - smoothstep(stop))

    def acceleration(self, time_s: Array) -> Array:
        """Acceleration along the path in m/s^2, any shape."""
        start, stop = self._progress(time_s)
        rate = smoothstep_rate(start) - smoothstep_rate(stop)
        return self.speed_m_s / self.ramp_s * rate


@dataclass(frozen=True)
class CurvatureProfile:
    """Curvature over path length: constant pieces with smooth transitions.

    Attributes:
        initial_1_m: curvature at the start in 1/m, positive to the left.
        changes: per change the path length at its middle (m), the length of the transition (m) and
            the change of curvature (1/m).
    """

    initial_1_m: float
    changes: tuple[tuple[float, float, float], ...] = ()

    def curvature(self, distance_m: Array) -> Array:
        """Curvature in 1/m, any shape."""
        value = np.full_like(distance_m, self.initial_1_m)
        for middle, length, change in self.changes:
            value += change * smoothstep((distance_m - middle) / length + 0.5)
        return value

    def heading(self, distance_m: Array) -> Array:
        """The integral of the curvature: heading gained since the start in radians, any shape."""
        value = self.initial_1_m * distance_m
        for middle, length, change in self.changes:
            value += change * length * smoothstep_integral((distance_m - middle) / length + 0.5)
        return value


@dataclass(frozen=True)
class Motion:
    """The vehicle's state at n times.

    Attributes:
        stamps_ns: (n,) since the start of the drive.
        xy_map: (n, 2) position of the rear axle in metres.
        heading_rad: (n,) from map +x, not wrapped.
        speed_m_s: (n,) along the vehicle's x axis.
        acceleration_m_s2: (n,) rate of the speed.
        curvature_1_m: (n,) of the path of the rear axle, positive to the left.
        steering_rad: (n,) angle of the front wheels, positive to the left.
    """

    stamps_ns: IntArray
    xy_map: Array
    heading_rad: Array
    speed_m_s: Array
    acceleration_m_s2: Array
    curvature_1_m: Array
    steering_rad: Array

    @property
    def yaw_rate_rad_s(self) -> Array:
        """(n,) heading's rate: speed times curvature."""
        return self.speed_m_s * self.curvature_1_m


@dataclass(frozen=True)
class VehicleStates:
    """Pose of the vehicle frame at n times, and its exact derivatives.

    Attributes:
        stamps_ns: (n,) since the start of the drive.
        position_map: (n, 3) metres.
        R_map_vehicle: (n, 3, 3).
        velocity_map: (n, 3) m/s.
        acceleration_map: (n, 3) m/s^2, without gravity.
        angular_velocity: (n, 3) rad/s of the vehicle in the map, vehicle axes.
    """

    stamps_ns: IntArray
    position_map: Array
    R_map_vehicle: Array
    velocity_map: Array
    acceleration_map: Array
    angular_velocity: Array


class Route(Protocol):
    """What a prediction needs to know of a drive, planned or recorded."""

    @property
    def duration_s(self) -> float:
        """Time of its end, since its start."""

    @property
    def terrain(self) -> Terrain | None:
        """The ground; None: flat, or as the states show it."""

    def states(self, stamps_ns: IntArray, z_map: npt.ArrayLike = 0.0) -> VehicleStates:
        """See `Drive.states`."""


@dataclass(frozen=True)
class Drive:
    """A drive over ground, flat or with ramps.

    Path, speed and curvature are those of the horizontal projection. On a ramp the vehicle frame
    lies in the tangent plane of the ground at its origin, with its x axis along the path. Its
    speed along the slope is `speed` / cos(slope).

    Attributes:
        speed: speed over time.
        curvature: curvature over path length.
        wheelbase_m: distance of the axles.
        start_xy_m: start in the map.
        start_yaw_rad: heading at the start.
        terrain: the ground; None: flat.
    """

    speed: SpeedProfile
    curvature: CurvatureProfile
    wheelbase_m: float
    start_xy_m: tuple[float, float] = (0.0, 0.0)
    start_yaw_rad: float = 0.0
    terrain: Terrain | None = None

    @property
    def duration_s(self) -> float:
        """Time at which the vehicle stands again."""
        return self.speed.duration_s

    def _displacement(self, begin_m: Array, end_m: Array) -> Array:
        """(n, 2) integral of the direction of travel between path lengths (n,) and (n,)."""
        half = 0.5 * (end_m - begin_m)
        nodes_m = (0.5 * (end_m + begin_m))[:, None] + half[:, None] * GAUSS_NODES
        heading = self.start_yaw_rad + self.curvature.heading(nodes_m)
        direction = np.stack([np.cos(heading), np.sin(heading)])
        displacement: Array = (half * (direction @ GAUSS_WEIGHTS)).T
        return displacement

    @cached_property
    def _panel_starts_xy(self) -> Array:
        """(p, 2) position at the start of each quadrature panel."""
        length_m = float(self.speed.distance_m(np.array(self.duration_s)))
        begin_m = PANEL_M * np.arange(math.floor(length_m / PANEL_M), dtype=np.float64)
        steps = self._displacement(begin_m, begin_m + PANEL_M)
        start: Array = np.array(self.start_xy_m, dtype=np.float64)
        return start + np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])

    def motion(self, stamps_ns: IntArray) -> Motion:
        """The state at (n,) stamps in any order, in nanoseconds since the start of the drive.

        Before the start and after the end the vehicle stands.
        """
        time_s = np.asarray(stamps_ns, dtype=np.int64) / NANOSECONDS_PER_SECOND
        distance_m = self.speed.distance_m(time_s)
        starts = self._panel_starts_xy
        panel = np.clip((distance_m / PANEL_M).astype(np.int64), 0, len(starts) - 1)
        panel_m: Array = PANEL_M * panel.astype(np.float64)
        curvature = self.curvature.curvature(distance_m)
        return Motion(
            stamps_ns=np.asarray(stamps_ns, dtype=np.int64),
            xy_map=starts[panel] + self._displacement(panel_m, distance_m),
            heading_rad=self.start_yaw_rad + self.curvature.heading(distance_m),
            speed_m_s=self.speed.speed(time_s),
            acceleration_m_s2=self.speed.acceleration(time_s),
            curvature_1_m=curvature,
            steering_rad=np.arctan(self.wheelbase_m * curvature),
        )

    def states(self, stamps_ns: IntArray, z_map: npt.ArrayLike = 0.0) -> VehicleStates:
        """Pose and derivatives at (n,) stamps in any order, in nanoseconds since the drive's start.

        `z_map` is the height of the vehicle frame in the map where the ground is level, in metres,
        a number or (n,). The height of ramps is added. The derivatives assume it constant.
        """
        motion = self.motion(stamps_ns)
        n = len(motion.stamps_ns)
        heights, gradient, hessian = (
            (np.zeros(n), np.zeros((n, 2)), np.zeros((n, 2, 2)))
            if self.terrain is None
            else self.terrain.heights(motion.xy_map)
        )
        cos, sin = np.cos(motion.heading_rad), np.sin(motion.heading_rad)
        along = np.column_stack([cos, sin])
        along_rate = motion.yaw_rate_rad_s[:, None] * np.column_stack([-sin, cos])
        speed = motion.speed_m_s[:, None]
        gradient_rate = np.einsum("nij,nj->ni", hessian, speed * along)
        slope = _dot(gradient, along)
        slope_rate = _dot(gradient_rate, along) + _dot(gradient, along_rate)

        # The path's tangent lies in the ground, so it is perpendicular to the ground's normal.
        ones, zeros = np.ones((n, 1)), np.zeros((n, 1))
        x, x_rate = _unit(np.hstack([along, slope]), np.hstack([along_rate, slope_rate]))
        z, z_rate = _unit(np.hstack([-gradient, ones]), np.hstack([-gradient_rate, zeros]))
        y = np.cross(z, x)
        y_rate = np.cross(z_rate, x) + np.cross(z, x_rate)
        acceleration = motion.acceleration_m_s2[:, None]
        level = np.broadcast_to(np.asarray(z_map, dtype=np.float64), (n,))
        return VehicleStates(
            stamps_ns=motion.stamps_ns,
            position_map=np.column_stack([motion.xy_map, level + heights]),
            R_map_vehicle=np.stack([x, y, z], axis=-1),
            velocity_map=speed * np.hstack([along, slope]),
            acceleration_map=acceleration * np.hstack([along, slope])
            + speed * np.hstack([along_rate, slope_rate]),
            angular_velocity=np.hstack([_dot(z, y_rate), _dot(x, z_rate), _dot(y, x_rate)]),
        )

    def poses(self, stamps_ns: IntArray, z_map: npt.ArrayLike = 0.0) -> tuple[gtsam.Pose3, ...]:
        """T_map_vehicle at (n,) stamps; see `states`."""
        states = self.states(stamps_ns, z_map)
        return tuple(
            gtsam.Pose3(gtsam.Rot3(R), t)
            for R, t in zip(states.R_map_vehicle, states.position_map, strict=True)
        )


def _dot(a: Array, b: Array) -> Array:
    """(n, 1) scalar products of (n, k) vectors."""
    product: Array = np.einsum("ni,ni->n", a, b)[:, None]
    return product


def _unit(vectors: Array, rates: Array) -> tuple[Array, Array]:
    """(n, 3) vectors normalised to length 1, and the rates of the unit vectors."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    unit = vectors / length
    return unit, (rates - unit * _dot(unit, rates)) / length


def _figure_eight(model: FigureEightDrive) -> tuple[SpeedProfile, float]:
    """Speed profile and path length of the change with which each loop turns by 360 degrees."""
    # The first half of the transition turns less than the arc. The loop is longer to make up.
    longer_m = 2.0 * float(smoothstep_integral(0.5)) * model.transition_m
    middle_m = 2.0 * math.pi * model.radius_m + longer_m
    rolling_s = 2.0 * middle_m / model.speed_m_s + model.ramp_s
    duration_s = model.standstill_s + rolling_s
    return (
        SpeedProfile(model.speed_m_s, model.standstill_s, model.ramp_s, duration_s),
        middle_m,
    )


def make_drive(model: DriveModel, terrain: Terrain | None = None) -> Drive:
    """The drive that a scenario describes, on this ground; None: flat."""
    start_yaw_rad = math.radians(model.start_yaw_deg)
    if isinstance(model, StandstillDrive):
        speed = SpeedProfile(0.0, 0.0, 1.0, model.duration_s)
        return Drive(speed, CurvatureProfile(0.0), 1.0, model.start_xy_m, start_yaw_rad, terrain)
    if isinstance(model, FigureEightDrive):
        speed, middle_m = _figure_eight(model)
    else:
        speed = SpeedProfile(model.speed_m_s, model.standstill_s, model.ramp_s, model.duration_s)
        middle_m = 0.5 * float(speed.distance_m(np.array(model.duration_s)))
    if isinstance(model, StraightDrive):
        curvature = CurvatureProfile(0.0)
    else:
        first = (1.0 if model.turn == "left" else -1.0) / model.radius_m
        if isinstance(model, ArcDrive):
            curvature = CurvatureProfile(first)
        elif isinstance(model, SCurveDrive | FigureEightDrive):
            change = (middle_m, model.transition_m, -2.0 * first)
            curvature = CurvatureProfile(first, (change,))
        else:
            assert_never(model)
    return Drive(speed, curvature, model.wheelbase_m, model.start_xy_m, start_yaw_rad, terrain)


def sample_stamps(
    what: str, rate_hz: float, phase_s: float, duration_s: float, last_s: float = 0.0
) -> IntArray:
    """(n,) increasing stamps of periodic samples, at least one, ns since the drive's start.

    The first is at `phase_s`, and the last at least `last_s` before the end of the drive. `what` is
    the sensor's place in the scenario, for messages.

    Raises:
        ConfigError: the drive ends before the first one.
    """
    count = math.floor((duration_s - last_s - phase_s) * rate_hz + 1e-6) + 1
    if count < 1:
        raise ConfigError(
            f"{what}: the drive of {duration_s:.3g} s ends before the first sample, which starts "
            f"at {phase_s:g} s and takes {last_s:g} s. Lower phase_s, or make the drive longer"
        )
    seconds = phase_s + np.arange(count, dtype=np.float64) / rate_hz
    return np.rint(seconds * NANOSECONDS_PER_SECOND).astype(np.int64)


def cloud_stamps(lidar: str, model: LidarModel, duration_s: float) -> IntArray:
    """(n,) stamps of the clouds of a LiDAR, in nanoseconds since the start of the drive.

    Every sweep ends before the drive does.

    Raises:
        ConfigError: the drive ends before the first cloud.
    """
    after_s = model.sweep_s if model.stamps_at_start else 0.0
    return sample_stamps(f"lidars.{lidar}", model.rate_hz, model.phase_s, duration_s, after_s)
