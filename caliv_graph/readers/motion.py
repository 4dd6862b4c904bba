"""Which messages tell the vehicle's motion (`products.MotionData`); GNSS fixes and velocities.

The IMU's are in `imu.py`, poses in `poses.py`, directions of two antennas in `heading.py`, types of
receivers in `navigation.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from caliv_graph.products import Array, GnssFixes, TwistSamples
from caliv_graph.readers.collectors import (
    MOST_ALTITUDE_M,
    MOST_RAD_S,
    Reason,
    RowCollector,
    below,
    covariances,
    or_none,
)
from caliv_graph.readers.frames import TF_TYPES

INSPVAX_TYPES = (
    "novatel_oem7_msgs/msg/INSPVAX",
    "novatel_msgs/msg/INSPVAX",
    "novatel_gps_msgs/msg/Inspvax",
)
NAVPVT = "ublox_msgs/msg/NavPVT"
PVT_GEODETIC = "septentrio_gnss_driver/msg/PVTGeodetic"
POSITION_TYPES = ("geometry_msgs/msg/PointStamped", "geometry_msgs/msg/PoseStamped")

_IMU = "sensor_msgs/msg/Imu"
NAVSATFIX = "sensor_msgs/msg/NavSatFix"
_ODOMETRY = "nav_msgs/msg/Odometry"
_TWIST = "geometry_msgs/msg/TwistStamped"
_TWIST_WITH_COVARIANCE = "geometry_msgs/msg/TwistWithCovarianceStamped"
_POSE = "geometry_msgs/msg/PoseStamped"
_POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"

MOTION_TYPES: Mapping[str, tuple[str, ...]] = {
    "imu": (_IMU,),
    "gnss": (NAVSATFIX, NAVPVT, PVT_GEODETIC),
    "twist": (_TWIST_WITH_COVARIANCE, _TWIST, _ODOMETRY),
    "heading": ("geometry_msgs/msg/QuaternionStamped",),
    "pose": (_ODOMETRY, _POSE_WITH_COVARIANCE, _POSE, *TF_TYPES, *INSPVAX_TYPES),
}
"""Types that fit each key of `topics`, the most informative first."""

ON_REQUEST: Mapping[str, tuple[str, ...]] = {
    "gnss": POSITION_TYPES,
    "heading": (_IMU, NAVSATFIX, NAVPVT, PVT_GEODETIC),
}
"""Types that fit a key as well, if the config says so: mostly they are something else."""

_UNKNOWN_RATE_VAR = 100.0
"""(rad/s)^2: no vehicle turns at 10 rad/s. By a larger variance drivers say that it is unknown."""

_MOST_M_S = 1000.0

_FIXED_AXES = ("map", "odom", "world", "earth", "enu", "utm")
"""Frames whose axes do not turn with the vehicle: a velocity stated in them is not in its axes."""

ON_EARTH: tuple[Reason, ...] = (
    (
        "at latitude and longitude 0 or out of their range",
        lambda r: (np.abs(r[:, 0]) <= 90) & (np.abs(r[:, 1]) <= 360) & r[:, :2].any(1),
    ),
    (
        f"beyond {MOST_ALTITUDE_M:g} m of altitude",
        lambda r: below(r[:, 2:3], MOST_ALTITUDE_M),
    ),
)
"""What rows that begin with latitude, longitude (degrees) and altitude (m) are left out for."""


class GnssCollector(RowCollector):
    """`sensor_msgs/NavSatFix`."""

    _WIDTH = 14

    def add(self, stamp_ns: int, message: Any) -> None:
        """Takes one message."""
        self._rows.add(
            stamp_ns,
            (
                *(message.latitude, message.longitude, message.altitude),
                *(message.status.status, message.position_covariance_type),
                *message.position_covariance.tolist(),
            ),
        )

    def finish(self) -> GnssFixes | None:
        """The fixes; None if there are none."""
        stamps, rows, _ = self._usable(
            ("without a fix (status < 0)", lambda r: r[:, 3] >= 0),
            ("without latitude, longitude or altitude", lambda r: np.isfinite(r[:, :3]).all(1)),
            *ON_EARTH,
        )
        if not len(stamps):
            return None
        cov = covariances(rows[:, 5:14])
        cov[rows[:, 4] == 0] = np.nan  # COVARIANCE_TYPE_UNKNOWN
        # Copies: a view would keep the whole rows alive.
        latitude, longitude, altitude = (column.copy() for column in rows[:, :3].T)
        return GnssFixes(stamps, latitude, longitude, altitude, or_none(cov))

    @property
    def fixes(self) -> int:
        """Messages with a fix."""
        found = self.finish()
        return 0 if found is None else len(found.stamps_ns)


class TwistCollector(RowCollector):
    """`TwistStamped`, `TwistWithCovarianceStamped`, or the twist of an `Odometry`.

    The twist of an odometry is in its child frame, which is taken for the vehicle's, as is the
    frame of the others.
    """

    _WIDTH = 14
    _LINEAR: ClassVar[list[int]] = [0, 1, 2, 6, 7, 8, 12, 13, 14]
    _YAW_RATE = 35

    def __init__(self) -> None:
        super().__init__()
        self._frames: set[str] = set()

    def add(self, stamp_ns: int, message: Any) -> None:
        """Takes one message."""
        twist = message.twist
        cov, yaw_rate_var = np.zeros(9), 0.0
        if hasattr(twist, "covariance"):
            yaw_rate_var = float(twist.covariance[self._YAW_RATE])
            cov, twist = twist.covariance[self._LINEAR], twist.twist
        self._frames.add(getattr(message, "child_frame_id", message.header.frame_id))
        v = twist.linear
        self._rows.add(stamp_ns, (v.x, v.y, v.z, *cov.tolist(), twist.angular.z, yaw_rate_var))

    def finish(self) -> TwistSamples | None:
        """The velocities; None if there are none."""
        stamps, rows, _ = self._usable(
            ("with NaN or infinity", lambda r: np.isfinite(r[:, :3]).all(axis=1)),
            (f"beyond {_MOST_M_S:g} m/s", lambda r: below(r[:, :3], _MOST_M_S)),
        )
        for frame in sorted(self._frames):
            if frame.strip("/").lower() in _FIXED_AXES:
                self._losses.say(
                    f"its velocity is stated in the frame '{frame}', but is taken to be in the "
                    "vehicle's axes: check it"
                )
        if not len(stamps):
            return None
        cov = or_none(covariances(rows[:, 3:12]))
        velocity = rows[:, :3].copy()  # a view would keep the whole rows alive
        return TwistSamples(stamps, velocity, cov, *_yaw_rates(rows[:, 12], rows[:, 13]))


def _yaw_rates(rate: Array, variance: Array) -> tuple[Array | None, Array | None]:
    """Yaw rates (n,) and their variances, NaN where unknown; None where no message knows any.

    A driver without one leaves zeros, and may say so by a variance.
    """
    known = np.isfinite(rate) & (np.abs(rate) <= MOST_RAD_S) & ~(variance > _UNKNOWN_RATE_VAR)
    if not (known & (rate != 0.0)).any():
        return None, None
    stated = known & (variance > 0.0)
    return (
        np.where(known, rate, np.nan),
        np.where(stated, variance, np.nan) if stated.any() else None,
    )
