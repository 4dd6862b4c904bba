"""A recorded drive as a route: the smoothed trajectory where a planned drive has formulas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import Array, IntArray
from caliv_graph.scenario.drives import VehicleStates
from caliv_graph.scenario.terrain import Terrain
from caliv_graph.trajectory.imu import log_so3
from caliv_graph.trajectory.select import TWIST_WINDOW_NS, VehicleTrajectory

PATH_NS = NANOSECONDS_PER_SECOND // 5
"""Distance of the places at which the path's curvature is looked at."""

MOVING_M_S = 0.3
"""Speed from which a path has a curvature."""

TIGHTEST_PART = 0.9
"""Part of the moving time that is less curved than the curvature taken as the vehicle's own: the
ends of a smoothed path are noisy."""


@dataclass(frozen=True)
class RecordedRoute:
    """The vehicle on a recorded drive, its frame moved down to the ground as in a scenario.

    Velocities are averaged over 0.1 s: a prediction asks for directions, not for bumps.

    Attributes:
        trajectory: of the vehicle frame.
        begin_ns: stamp that is the start of the drive.
        end_ns: stamp of its end.
        height_m: of the vehicle frame above ground.
    """

    trajectory: VehicleTrajectory
    begin_ns: int
    end_ns: int
    height_m: float

    @property
    def duration_s(self) -> float:
        """Time of its end, since its start."""
        return (self.end_ns - self.begin_ns) / NANOSECONDS_PER_SECOND

    @property
    def terrain(self) -> Terrain | None:
        """None: slopes are in the poses."""
        return None

    def states(self, stamps_ns: IntArray, z_map: npt.ArrayLike = 0.0) -> VehicleStates:
        """Pose and derivatives at (n,) stamps in nanoseconds since the start; `z_map` is unused.

        Outside the span of the trajectory the state at its end is taken.
        """
        begin, end = self.trajectory.span_ns
        half = min(TWIST_WINDOW_NS, (end - begin) // 4)
        at = np.clip(self.begin_ns + np.asarray(stamps_ns, np.int64), begin + half, end - half)
        (R0, p0), (R1, p1), (R2, p2) = (self._poses(at + step) for step in (-half, 0, half))
        seconds = half / NANOSECONDS_PER_SECOND
        return VehicleStates(
            stamps_ns=np.asarray(stamps_ns, np.int64),
            position_map=p1,
            R_map_vehicle=R1,
            velocity_map=(p2 - p0) / (2.0 * seconds),
            acceleration_map=(p2 - 2.0 * p1 + p0) / seconds**2,
            angular_velocity=log_so3(np.swapaxes(R0, 1, 2) @ R2) / (2.0 * seconds),
        )

    def _poses(self, stamps_ns: IntArray) -> tuple[Array, Array]:
        R, position = self.trajectory.poses_at(stamps_ns)
        return R, position - self.height_m * R[:, :, 2]

    def habits(self) -> tuple[float, float]:
        """Median speed in m/s while moving (0: it never moves), and the tightest curvature, 1/m."""
        end = self.end_ns - self.begin_ns
        states = self.states(np.arange(0, end + 1, PATH_NS, dtype=np.int64))
        speed = np.linalg.norm(states.velocity_map[:, :2], axis=1)
        moving = speed > MOVING_M_S
        if not moving.any():
            return 0.0, 0.0
        curvature = np.abs(states.angular_velocity[moving, 2]) / speed[moving]
        return float(np.median(speed[moving])), float(np.quantile(curvature, TIGHTEST_PART))
