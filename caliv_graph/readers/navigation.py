"""Messages of GNSS/INS receivers in their own types, as positions or poses.

| type | key | |
|---|---|---|
| `novatel_msgs/INSPVAX`, `novatel_oem7_msgs/INSPVAX`, `novatel_gps_msgs/Inspvax` | `pose` | attitude and position of the INS |
| `ublox_msgs/NavPVT` | `gnss` | antenna |
| `septentrio_gnss_driver/PVTGeodetic` | `gnss` | antenna |
| `geometry_msgs/PoseStamped`, `PointStamped` | `gnss` | prism of a total station; its orientation is not used |

Conventions: azimuth is clockwise from north, heights of NovAtel are above the geoid (`undulation` over the
ellipsoid), and its body frame is x right, y forward, z up.
"""  # noqa: E501 (a table)

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping
from typing import Any

import gtsam
import numpy as np
import pymap3d

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import Array, GivenPoses, GnssFixes
from caliv_graph.readers.collectors import (
    MOST_M,
    Collector,
    RowCollector,
    below,
)
from caliv_graph.readers.motion import (
    INSPVAX_TYPES,
    NAVPVT,
    NAVSATFIX,
    ON_EARTH,
    POSITION_TYPES,
    PVT_GEODETIC,
    GnssCollector,
)

_GOOD = {3, 6, 7, "INS_SOLUTION_GOOD", "INS_SOLUTION_FREE", "INS_ALIGNMENT_COMPLETE"}
"""States of the INS in which its attitude is valid."""

_GPS_EPOCH_NS = 315_964_800 * NANOSECONDS_PER_SECOND
"""1980-01-06 since 1970."""

GPS_UTC_S = 18
"""GPS minus UTC since 2017."""

_TRANSPORT_NS = NANOSECONDS_PER_SECOND // 2
_AHEAD_NS = NANOSECONDS_PER_SECOND // 20
"""A receiver's time is taken if the message was recorded up to so much after it, or so little
before it (clocks set by each other): the computer's clock is then that of the receiver."""

_UNKNOWN_CM = 65535
_UNKNOWN_M = -2e10
"""What a Septentrio sends in place of an unknown value."""

_FIXED, _UNCOVERED, _DIAGONAL = 0, 0, 2
"""Status of a fix, and types of a covariance, as in NavSatFix."""

_MIDDLE_LATITUDE_DEG = 45.0
"""Where local positions are placed on the earth: gravity there is within 0.3 % of any."""


def own_stamp_ns(message: Any, record_ns: int) -> int:
    """The receiver's time of a message without a header, if it fits the time of recording; else 0.

    The receiver says when it measured; the recording comes later by the transport. If the clock of
    the computer is not set by the receiver's, only the recording is in the clock of the LiDARs.
    """
    if hasattr(message, "i_tow"):
        own_ns = _utc_ns(message)
    else:
        weeks_ns = message.header.week * 604_800 * NANOSECONDS_PER_SECOND
        own_ns = _GPS_EPOCH_NS + weeks_ns + message.header.gpssec * 1_000_000
        own_ns -= GPS_UTC_S * NANOSECONDS_PER_SECOND
    return own_ns if -_AHEAD_NS <= record_ns - own_ns <= _TRANSPORT_NS else 0


def _utc_ns(message: Any) -> int:
    if message.valid & 3 != 3:  # date and time of day
        return 0
    try:
        day = datetime.datetime(
            int(message.year),
            int(message.month),
            int(message.day),
            int(message.hour),
            int(message.min),
            tzinfo=datetime.UTC,
        )
    except ValueError:
        return 0
    seconds = int(day.timestamp()) + int(message.sec)
    return seconds * NANOSECONDS_PER_SECOND + int(message.nano)


class InspvaxCollector(RowCollector):
    """INSPVAX: the vehicle in ENU axes with the origin at the first position.

    The INS is taken to report in the axes of the vehicle (its body frame turned by RBV, or mounted
    that way) at the origin of the vehicle frame (SETINSTRANSLATION USER).
    """

    _WIDTH = 13

    def add(self, stamp_ns: int, message: Any) -> None:
        """Takes one message."""
        m = message
        status = getattr(m.ins_status, "status", m.ins_status)
        end = "std" if hasattr(m, "latitude_std") else "stdev"
        up = "altitude" if hasattr(m, "altitude") else "height"
        names = ("longitude", "latitude", up, "roll", "pitch", "azimuth")
        sigmas: list[float] = [getattr(m, f"{name}_{end}") for name in names]
        height = getattr(m, up) + m.undulation
        angles = (m.roll, m.pitch, m.azimuth)
        self._rows.add(
            stamp_ns,
            (m.latitude, m.longitude, height, *angles, *sigmas, float(status in _GOOD)),
        )

    def finish(self) -> GivenPoses | None:
        """The poses; None if there are none."""
        stamps, rows, _ = self._usable(
            ("without a solution of the INS", lambda r: r[:, 12] > 0),
            ("with NaN or infinity", lambda r: np.isfinite(r[:, :6]).all(axis=1)),
            *ON_EARTH,
        )
        if not len(stamps):
            return None
        (latitude, longitude, height), first = rows[:, :3].T, rows[0, :3]
        t = np.stack(pymap3d.geodetic2enu(latitude, longitude, height, *first), axis=1)
        R_ecef_map = axes_enu(first[0], first[1])
        R_map_vehicle = np.stack(
            [
                R_ecef_map.T @ axes_enu(lat, lon) @ rotation_of_inspvax(*angles)
                for (lat, lon), angles in zip(rows[:, :2], rows[:, 3:6], strict=True)
            ]
        )
        poses = tuple(gtsam.Pose3(gtsam.Rot3(R), p) for R, p in zip(R_map_vehicle, t, strict=True))
        return GivenPoses(stamps, poses, _inspvax_cov(R_map_vehicle, rows[:, 6:12]))


def rotation_of_inspvax(roll_deg: float, pitch_deg: float, azimuth_deg: float) -> Array:
    """R_enu_vehicle (3, 3) from the angles of an INSPVAX.

    Of the body (x right, y forward, z up): R_enu_body = Rz(-azimuth) Rx(pitch) Ry(roll). In axes
    x forward, y left, z up that is Rz(90 - azimuth) Ry(-pitch) Rx(roll): nose up is positive there.
    """
    R: Array = gtsam.Rot3.RzRyRx(
        math.radians(roll_deg), math.radians(-pitch_deg), math.radians(90.0 - azimuth_deg)
    ).matrix()
    return R


def axes_enu(latitude_deg: float, longitude_deg: float) -> Array:
    """East, north and up at a place, (3, 3) columns in earth-centred axes."""
    lat, lon = math.radians(latitude_deg), math.radians(longitude_deg)
    east = [-math.sin(lon), math.cos(lon), 0.0]
    north = [-math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat)]
    up = [math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)]
    return np.array([east, north, up]).T


def _inspvax_cov(R_map_vehicle: Array, sigmas: Array) -> Array | None:
    """(n, 6, 6) right perturbations from sigmas (n, 6) east, north, up (m), roll, pitch, azimuth.

    Angles in degrees. On a road, roll and pitch are small, and their axes are the vehicle's.
    """
    cov = np.full((len(sigmas), 6, 6), np.nan)
    known = np.isfinite(sigmas).all(axis=1) & (sigmas > 0.0).all(axis=1)
    cov[known] = 0.0
    enu = np.zeros((len(sigmas), 3, 3))
    for axis in range(3):
        enu[:, axis, axis] = sigmas[:, axis] ** 2
        cov[known, axis, axis] = np.radians(sigmas[known, 3 + axis]) ** 2
    R = R_map_vehicle
    cov[known, 3:, 3:] = (R.transpose(0, 2, 1) @ enu @ R)[known]
    return cov if known.any() else None


class NavPvtCollector(GnssCollector):
    """`ublox_msgs/NavPVT`: 1e-7 degrees and millimetres above the ellipsoid.

    The horizontal accuracy is the root of the sum of both variances.
    """

    def add(self, stamp_ns: int, message: Any) -> None:
        """Takes one message."""
        m = message
        fixed = m.fix_type in (3, 4) and m.flags & 1  # 3-D, or with dead reckoning
        horizontal, vertical = m.h_acc * 1e-3 / math.sqrt(2.0), m.v_acc * 1e-3
        place = (m.lat * 1e-7, m.lon * 1e-7, m.height * 1e-3)
        self._rows.add(stamp_ns, _fix_row(place, bool(fixed), horizontal, vertical))


class PvtGeodeticCollector(GnssCollector):
    """`septentrio_gnss_driver/PVTGeodetic`: radians and metres above the ellipsoid.

    The horizontal accuracy is twice the root mean square of the distance (2DRMS), the vertical one
    two sigma; in centimetres. Field names begin with capitals in the driver's older versions.
    """

    def add(self, stamp_ns: int, message: Any) -> None:
        """Takes one message."""
        values: dict[str, Any] = {
            name: getattr(message, name, getattr(message, name.lower().replace("acc", "_acc"), 0))
            for name in (
                "Mode",
                "Error",
                "Latitude",
                "Longitude",
                "Height",
                "HAccuracy",
                "VAccuracy",
            )
        }
        place = (
            math.degrees(values["Latitude"]),
            math.degrees(values["Longitude"]),
            values["Height"],
        )
        fixed = values["Mode"] & 15 and not values["Error"] and values["Height"] > _UNKNOWN_M
        horizontal, vertical = (
            math.nan if v == _UNKNOWN_CM else 0.01 * v
            for v in (values["HAccuracy"], values["VAccuracy"])
        )
        row = _fix_row(place, bool(fixed), horizontal / (2.0 * math.sqrt(2.0)), vertical / 2.0)
        self._rows.add(stamp_ns, row)


class LocalPositionCollector(GnssCollector):
    """Positions in axes of their own, z up, as of a total station that follows a prism.

    They pass as fixes around 45 degrees north: fixes are turned back into metres from the first.
    """

    _WIDTH = 3

    def add(self, stamp_ns: int, message: Any) -> None:
        """Takes one message."""
        p = message.pose.position if hasattr(message, "pose") else message.point
        self._rows.add(stamp_ns, (p.x, p.y, p.z))

    def finish(self) -> GnssFixes | None:
        """The positions as fixes; None if there are none."""
        stamps, rows, _ = self._usable(
            ("with NaN or infinity", lambda r: np.isfinite(r).all(axis=1)),
            (f"beyond {MOST_M:g} m from the origin", lambda r: below(r, MOST_M)),
        )
        if not len(stamps):
            return None
        self._losses.say(
            "positions in their own axes, taken for east, north, up at 45 degrees of latitude: if "
            "the IMU has an orientation, set imu.yaw_bias: true and imu.yaw_bias_sigma_deg; set "
            "imu.gravity_m_s2 to that of the place"
        )
        local = rows - rows[0]
        east, north, up = local.T
        latitude, longitude, altitude = pymap3d.enu2geodetic(
            east, north, up, _MIDDLE_LATITUDE_DEG, 0.0, 0.0
        )
        return GnssFixes(
            stamps, np.asarray(latitude), np.asarray(longitude), np.asarray(altitude), None
        )


def _fix_row(
    place: tuple[float, float, float], fixed: bool, horizontal_m: float, vertical_m: float
) -> tuple[float, ...]:
    """A row of `GnssCollector`: sigmas east and north alike; NaN or 0: unknown."""
    known = horizontal_m > 0.0 and vertical_m > 0.0
    cov = np.zeros(9)
    if known:
        cov[[0, 4, 8]] = horizontal_m**2, horizontal_m**2, vertical_m**2
    status = _FIXED if fixed else -1
    return (*place, status, _DIAGONAL if known else _UNCOVERED, *cov.tolist())


COLLECTORS: Mapping[tuple[str, str], type[Collector]] = {
    **{("pose", name): InspvaxCollector for name in INSPVAX_TYPES},
    ("gnss", NAVPVT): NavPvtCollector,
    ("gnss", PVT_GEODETIC): PvtGeodeticCollector,
    **{("gnss", name): LocalPositionCollector for name in POSITION_TYPES},
    ("heading", NAVSATFIX): GnssCollector,
    ("heading", NAVPVT): NavPvtCollector,
    ("heading", PVT_GEODETIC): PvtGeodeticCollector,
}
"""Collectors of these types, by key of `topics` and type."""
