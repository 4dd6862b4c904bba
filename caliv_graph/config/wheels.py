"""Wheel odometry: where the vehicle runs straight and level, and how well it does."""

from __future__ import annotations

import math

from pydantic import Field

from caliv_graph.config.mounting import PoseConfig
from caliv_graph.config.sections import NonNegative, Positive, PositiveTriple, Section

SPEED_SCALE_SIGMA = 0.02
"""Tyres lose 1 to 2 % of their radius with pressure, load and wear."""


DELAY_SIGMA_S, DELAY_SIGMA_BESIDE_IMU_S = 0.01, 0.05
"""A vehicle's bus stamps speeds tens of milliseconds after the wheels were read. Without an IMU
nothing but LiDARs and fixes tells how late: who drives so is asked for clocks that agree."""


class WheelsConfig(Section):
    """The wheels of a vehicle, as a source of its motion; with an IMU scale and delay count."""

    T_vehicle_wheels: PoseConfig = Field(
        PoseConfig(xyz=(0.0, 0.0, 0.0)),
        description="middle of the axle that does not steer; x where the vehicle goes on a "
        "straight, z normal to the road under it",
    )
    rotation_sigma_deg: Positive | PositiveTriple = Field(
        (0.3, 0.3, 0.1),
        description="degrees, sigma of its rotation about the vehicle's axes: load on the springs, "
        "tyres that run askew",
    )
    slip_sigma_deg: Positive = Field(
        0.3, description="degrees, direction of travel of the axle against its x, 1 sigma"
    )
    tilt_sigma_deg: Positive = Field(
        0.3,
        description="degrees, roll and pitch of the axle's frame against the mean ground, 1 sigma: "
        "bumps, and the body on its springs",
    )
    correlation_s: Positive = Field(1.0, description="seconds, correlation time of slip and tilt")
    slope_sigma_deg: Positive = Field(
        2.0, description="degrees, slope of the mean ground of a drive, 1 sigma per map axis"
    )
    speed_scale_sigma: NonNegative | None = Field(
        None,
        description="1 sigma of the scale of the speeds, measured over true, less one; absent: "
        "0.02, exact beside an IMU where lateral velocities are measured, too; 0: exact",
    )
    time_offset_sigma_s: NonNegative | None = Field(
        None,
        description="seconds, sigma of the stamps of the speeds less the true times; absent: 0.05 "
        "beside an IMU (exact where lateral velocities are measured, too), 0.01 without one; "
        "0: exact",
    )

    def rotation_sigmas_rad(self) -> tuple[float, float, float]:
        """Sigmas of the rotation of T_vehicle_wheels about the vehicle's axes, radians."""
        deg = self.rotation_sigma_deg
        x, y, z = deg if isinstance(deg, tuple) else (deg,) * 3
        return math.radians(x), math.radians(y), math.radians(z)

    def delay_sigma_s(self, of_wheels: bool, beside_imu: bool) -> float:
        """Sigma of the stamps of the speeds less the true times, seconds; 0: they are exact.

        As is their scale, where lateral velocities are measured, too: by one device, with an IMU.
        """
        if self.time_offset_sigma_s is not None:
            return self.time_offset_sigma_s
        if beside_imu:
            return DELAY_SIGMA_BESIDE_IMU_S if of_wheels else 0.0
        return DELAY_SIGMA_S

    def scale_sigma(self, of_wheels: bool) -> float | None:
        """Sigma of the scale of the speeds; None: it is exact."""
        if self.speed_scale_sigma is None:
            return SPEED_SCALE_SIGMA if of_wheels else None
        return self.speed_scale_sigma or None
