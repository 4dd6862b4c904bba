"""A drive without motion data: the trajectory that a LiDAR estimated, and what it says of S2V.

The LiDAR that is tracked tells its own motion, T_odom_lidar. The vehicle frame is tied to it by two
statements alone: the vehicle stands parallel to the ground, and moves along its x axis. Nothing
tells where the vehicle frame's origin is in x and y.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np

from caliv_graph.geometry.se3 import skew
from caliv_graph.products import Array, GivenPoses


@dataclass(frozen=True)
class VehicleStatement:
    """What ground and direction of travel say of T_vehicle_lidar of a tracked LiDAR.

    Attributes:
        up_lidar: (3,) unit normal of the ground, lidar frame.
        ahead_lidar: (3,) unit direction of travel on a straight, across `up_lidar`.
        distance_m: of the LiDAR from the plane of the ground.
        tilt_rad: 1 sigma of the vehicle's z axis against the ground's normal, per axis.
        course_rad: 1 sigma of its x axis against the direction of travel; infinite: the drive does
            not tell it.
        distance_sigma_m: 1 sigma of the distance.
    """

    up_lidar: Array
    ahead_lidar: Array
    distance_m: float
    tilt_rad: float
    course_rad: float
    distance_sigma_m: float

    def level(self) -> Array:
        """(3, 3) from the lidar frame to axes with z up and x ahead: R_vehicle_lidar."""
        side = np.cross(self.up_lidar, self.ahead_lidar)
        return np.stack([self.ahead_lidar, side, self.up_lidar])

    def residuals(
        self, T_vehicle_lidar: gtsam.Pose3, height_m: float | None
    ) -> tuple[Array, Array, Array]:
        """Residuals (k,), derivatives (k, 6) by a right perturbation, and 1 sigmas (k,).

        With u and a the ground's normal and the direction of travel in the vehicle frame: u_x, u_y,
        atan2(a_y, a_x), and with a height of the vehicle frame above the ground, height + u . t -
        distance.
        """
        R, t = T_vehicle_lidar.rotation().matrix(), T_vehicle_lidar.translation()
        u, a = R @ self.up_lidar, R @ self.ahead_lidar
        by_u, by_a = -R @ skew(self.up_lidar), -R @ skew(self.ahead_lidar)
        r = [u[0], u[1], np.arctan2(a[1], a[0])]
        J = np.zeros((4, 6))
        J[:2, :3] = by_u[:2]
        J[2, :3] = (a[0] * by_a[1] - a[1] * by_a[0]) / (a[0] ** 2 + a[1] ** 2)
        sigmas = [self.tilt_rad, self.tilt_rad, self.course_rad]
        if height_m is None:
            return np.array(r), J[:3], np.array(sigmas)
        J[3, :3], J[3, 3:] = t @ by_u, u @ R
        r.append(height_m + float(u @ t) - self.distance_m)
        return np.array(r), J, np.array([*sigmas, self.distance_sigma_m])

    def gaussian(self, T_vehicle_lidar: gtsam.Pose3, height_m: float | None) -> tuple[Array, Array]:
        """Information (6, 6) and gradient (6,): `d^T H d / 2 - b^T d` of a right perturbation d.

        The vehicle's height has no sigma of its own here: `distance_sigma_m` includes it.
        """
        r, J, sigmas = self.residuals(T_vehicle_lidar, height_m)
        J, r = J / sigmas[:, None], r / sigmas
        return J.T @ J, -J.T @ r


@dataclass(frozen=True)
class OdometryPoses(GivenPoses):
    """Vehicle poses by the odometry of one LiDAR.

    Attributes:
        lidar: its name.
        T_vehicle_lidar: the mounting of it by which the vehicle's poses are defined.
        statement: what is known of that mounting beside the guess.
        T_map_lidar: n poses of the LiDAR itself.
    """

    lidar: str = ""
    T_vehicle_lidar: gtsam.Pose3 = field(default_factory=gtsam.Pose3)
    statement: VehicleStatement | None = None
    T_map_lidar: tuple[gtsam.Pose3, ...] = ()
