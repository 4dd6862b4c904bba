"""Headings by two antennas: `QuaternionStamped`, or an `Imu` of which only the yaw is one.

The angle is taken as it stands in the message; the config says from where it counts.
"""

from __future__ import annotations

import numpy as np

from caliv_graph.products import Array, HeadingSamples
from caliv_graph.readers.collectors import NORM_TOLERANCE, RowCollector

QUATERNION = "geometry_msgs/msg/QuaternionStamped"
IMU = "sensor_msgs/msg/Imu"


class HeadingCollector(RowCollector):
    """The yaw of a quaternion and, of an `Imu`, its variance."""

    _WIDTH = 6

    def add(self, stamp_ns: int, message: object) -> None:
        """Takes one message."""
        q = getattr(message, "quaternion", None)
        first = variance = 0.0
        if q is None:
            q = message.orientation  # type: ignore[attr-defined]
            cov = message.orientation_covariance  # type: ignore[attr-defined]
            first, variance = float(cov[0]), float(cov[8])
        self._rows.add(stamp_ns, (q.x, q.y, q.z, q.w, first, variance))

    def finish(self) -> HeadingSamples | None:
        """The headings; None if there are none."""
        stamps, rows, _ = self._usable(
            ("without an orientation (covariance -1)", lambda r: r[:, 4] != -1.0),
            (
                "whose orientation is not a unit quaternion",
                lambda r: np.abs(np.linalg.norm(r[:, :4], axis=1) - 1.0) <= NORM_TOLERANCE,
            ),
        )
        if not len(stamps):
            return None
        if len(stamps) > 1 and (rows[:, :4] == rows[0, :4]).all():
            self._losses.say("the heading is the same in all messages, and is not used")
            return None
        x, y, z, w = rows[:, :4].T
        yaw = np.arctan2(2.0 * (w * z + x * y), w**2 + x**2 - y**2 - z**2)
        stated: Array = np.where(rows[:, 5] > 0.0, rows[:, 5], np.nan)
        return HeadingSamples(stamps, yaw, None if np.isnan(stated).all() else stated)
