"""Where sensors sit on the vehicle: poses as people measure them, the IMU and the GNSS antenna."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pydantic import Field, model_validator

from caliv_graph.config.sections import NonNegative, Place, Positive, Section, Triple
from caliv_graph.errors import ConfigError

if TYPE_CHECKING:
    import gtsam

_ARM_SIGMA_M = 0.01
"""Of a lever arm from a tape measure or a drawing."""

_UNKNOWN_ARM_SIGMA_M = 2.0
"""Of a lever arm that nobody measured: antennas are within some metres of the vehicle's origin."""

_LEAST_UNKNOWN_ARM_SIGMA_M = 0.1
"""A smaller sigma of an unknown lever arm is left over from a known one."""

_IMU_SIGMA_M = 0.01
"""Of the place of an IMU, by a tape measure."""

_ROTATION_SIGMA_DEG = 0.1
"""Of an IMU's mount on a surface that was made for it."""


class PoseConfig(Section):
    """A pose as people measure it: `T_parent_child`."""

    xyz: Place = Field(description="metres, in the parent frame")
    rpy_deg: Triple = Field(
        (0.0, 0.0, 0.0), description="roll, pitch, yaw in degrees: R = Rz(yaw) Ry(pitch) Rx(roll)"
    )

    def pose(self) -> gtsam.Pose3:
        """`T_parent_child`."""
        import gtsam  # here: `--help` and `init` need no gtsam, which takes 0.4 s to import
        import numpy as np

        roll, pitch, yaw = (math.radians(a) for a in self.rpy_deg)
        return gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, yaw), np.array(self.xyz))


class ImuPoseConfig(PoseConfig):
    """`T_vehicle_imu`; its rotation may be unknown."""

    # pydantic keeps the field, mypy wants the same type as that of a pose.
    rpy_deg: Triple | None = Field(  # type: ignore[assignment]
        (0.0, 0.0, 0.0),
        description="roll, pitch, yaw in degrees; null: estimated from gravity and the drive",
    )

    def pose(self) -> gtsam.Pose3:
        """`T_vehicle_imu`.

        Raises:
            ConfigError: its rotation is unknown.
        """
        if self.rpy_deg is None:
            raise ConfigError(
                "imu.T_vehicle_imu.rpy_deg is null: the rotation of the IMU is unknown here. Enter "
                "vehicle.imu_rotation.value_deg of a calibration.yaml"
            )
        return super().pose()

    @property
    def exact(self) -> bool:
        """Whether the vehicle frame is that of the IMU."""
        return not any(self.xyz) and self.rpy_deg is not None and not any(self.rpy_deg)


class ImuConfig(Section):
    """The IMU on the vehicle."""

    T_vehicle_imu: ImuPoseConfig = ImuPoseConfig(xyz=(0.0, 0.0, 0.0))
    xyz_sigma: Positive | None = Field(
        None,
        description="metres, sigma of the place of T_vehicle_imu along each vehicle axis; absent: "
        "0.01, and none where its xyz is zero",
    )
    rotation_sigma_deg: Positive | None = Field(
        None,
        description="degrees, sigma of the rotation of T_vehicle_imu about each vehicle axis; "
        "absent: 0.1, and none where T_vehicle_imu is absent or the identity",
    )
    gyroscope_scale_sigma: NonNegative = Field(
        1e-3,
        description="radians per radian, sigma of the error of its gyroscope's scale, and of the "
        "directions of its axes; 0: exact",
    )
    time_offset_sigma_s: NonNegative = Field(
        0.005,
        description="seconds, sigma of its stamps less the true times, in the clock of the LiDARs; "
        "0: exact",
    )
    gravity_m_s2: Positive | None = Field(
        None, description="m/s^2, local gravity; absent: by latitude and altitude"
    )
    yaw_bias: bool = Field(
        False, description="estimate a constant yaw error of the IMU's orientation"
    )
    yaw_bias_sigma_deg: Positive = Field(
        5.0, description="degrees, how large that yaw error may be, 1 sigma"
    )

    @model_validator(mode="after")
    def _has_a_rotation_for_its_sigma(self) -> ImuConfig:
        if self.T_vehicle_imu.rpy_deg is None and self.rotation_sigma_deg is not None:
            raise ValueError(
                "T_vehicle_imu.rpy_deg is null (unknown), yet rotation_sigma_deg says that it is "
                f"known to {self.rotation_sigma_deg:g} degrees: remove rotation_sigma_deg, or "
                "enter rpy_deg"
            )
        return self

    def place_sigma(self) -> float | None:
        """Sigma of the IMU's place per axis, metres; None: it is exact."""
        if self.xyz_sigma is not None:
            return self.xyz_sigma
        return _IMU_SIGMA_M if any(self.T_vehicle_imu.xyz) else None

    def rotation_sigma_rad(self) -> float | None:
        """Sigma of a rotation that was measured, radians; None: it is exact, or unknown."""
        if self.T_vehicle_imu.rpy_deg is None:
            return None
        if self.rotation_sigma_deg is None and self.T_vehicle_imu.exact:
            return None
        return math.radians(self.rotation_sigma_deg or _ROTATION_SIGMA_DEG)


class GnssConfig(Section):
    """The GNSS antenna on the vehicle."""

    lever_arm: Place | None = Field(
        (0.0, 0.0, 0.0),
        description="metres, antenna in the vehicle frame; null: unknown, estimated",
    )
    lever_arm_sigma: Positive | None = Field(
        None,
        description="metres, sigma of the lever arm per axis; absent: 0.01, 2 where it is unknown, "
        "and none where it is exactly zero",
    )
    time_offset_sigma_s: NonNegative = Field(
        0.02,
        description="seconds, sigma of the stamps of the fixes less the true times, in the clock "
        "of the LiDARs; 0: exact",
    )

    @model_validator(mode="after")
    def _has_an_arm_for_its_sigma(self) -> GnssConfig:
        sigma = self.lever_arm_sigma
        if self.lever_arm is None and sigma is not None and sigma < _LEAST_UNKNOWN_ARM_SIGMA_M:
            raise ValueError(
                "lever_arm is null (unknown), yet lever_arm_sigma says that the antenna is within "
                f"{sigma:g} m of the vehicle's origin: remove lever_arm_sigma (then 2 m), or enter "
                "lever_arm"
            )
        return self

    def arm_sigma(self) -> float | None:
        """Sigma of the lever arm per axis, metres; None: it is exact."""
        if self.lever_arm_sigma is not None:
            return self.lever_arm_sigma
        if self.lever_arm is None:
            return _UNKNOWN_ARM_SIGMA_M
        return _ARM_SIGMA_M if any(self.lever_arm) else None
