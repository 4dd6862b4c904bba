"""From `sensor_msgs/Imu` to samples (`products.ImuSamples`), and whether their units are right."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from caliv_graph.products import Array, ImuSamples, IntArray
from caliv_graph.readers.collectors import (
    MOST_RAD_S,
    NORM_TOLERANCE,
    RowCollector,
    Stated,
    below,
    covariances,
    or_none,
)

_GRAVITY_M_S2 = 9.81

_GRAVITY_TOLERANCE = 0.15
"""Part of gravity by which the median specific force may differ: driving causes less, a unit other
than m/s^2 more."""

_FAST_RAD_S = 6.0
"""Degrees per second exceed it; no road vehicle turns as fast for a twentieth of a drive."""

_MOST_M_S2 = 2000.0
"""Beyond the range of any IMU of a vehicle."""


@dataclass(frozen=True)
class ImuCheck:
    """Whether the units of an IMU are those of its message type.

    Attributes:
        specific_force_m_s2: median of its norm, as if in m/s^2.
        angular_rate_rad_s: 95th percentile of its norm, as if in rad/s.
        gravity_problem: a problem of the specific force; empty: none.
        rate_problem: a problem of the angular rate; empty: none.
        up_imu: unit vector along the mean specific force, imu frame: upwards.
    """

    specific_force_m_s2: float
    angular_rate_rad_s: float
    gravity_problem: str
    rate_problem: str
    up_imu: tuple[float, float, float]


class ImuCollector(RowCollector):
    """`sensor_msgs/Imu`."""

    _WIDTH = 10
    _EVEN = True

    def __init__(self) -> None:
        super().__init__()
        self._stated = Stated(27)

    def add(self, stamp_ns: int, message: Any) -> None:
        """Takes one message."""
        w, f, q = message.angular_velocity, message.linear_acceleration, message.orientation
        self._rows.add(stamp_ns, (w.x, w.y, w.z, f.x, f.y, f.z, q.x, q.y, q.z, q.w))
        self._stated.add(
            message.orientation_covariance,
            message.angular_velocity_covariance,
            message.linear_acceleration_covariance,
        )

    def finish(self) -> ImuSamples | None:
        """The samples; None if there are none."""
        stamps, rows, added = self._usable(
            ("with NaN or infinity", lambda r: np.isfinite(r[:, :6]).all(axis=1)),
            (
                f"beyond {MOST_RAD_S:g} rad/s or {_MOST_M_S2:g} m/s^2",
                lambda r: below(r[:, :3], MOST_RAD_S) & below(r[:, 3:6], _MOST_M_S2),
            ),
        )
        if not len(stamps):
            return None
        stated, which = self._stated.distinct()
        which = which[added]
        orientation, cov = self._orientation(rows[:, 6:10].copy(), stated[:, :9], which)
        return ImuSamples(
            stamps_ns=stamps,
            # Copies: a view would keep the whole rows alive.
            angular_velocity=rows[:, :3].copy(),
            specific_force=rows[:, 3:6].copy(),
            orientation_xyzw=orientation,
            orientation_cov=cov,
            angular_velocity_cov=_common(covariances(stated[:, 9:18]), which),
            specific_force_cov=_common(covariances(stated[:, 18:27]), which),
        )

    def _orientation(
        self, q: Array, stated: Array, which: IntArray
    ) -> tuple[Array | None, Array | None]:
        """Unit quaternions (n, 4) and their covariances, from the kinds (d, 9) of the latter."""
        has_any = (stated[:, 0] != -1.0)[which]
        norms = np.linalg.norm(q, axis=1)
        is_rotation = np.abs(norms - 1.0) <= NORM_TOLERANCE  # False for NaN
        broken = int(np.count_nonzero(has_any & ~is_rotation))
        if broken:
            self._losses.say(
                f"the orientation of {broken} of {len(q)} messages is not a unit quaternion, and "
                "is not used"
            )
        good = has_any & is_rotation
        if not good.any():
            return None, None
        first = q[good][0]
        if np.count_nonzero(good) > 1 and abs(first[3]) == 1.0 and (q[good] == first).all():
            # A driver without a filter leaves the identity in the message.
            self._losses.say("the orientation is the identity in all messages, and is not used")
            return None, None
        q[good] /= norms[good, None]
        q[~good] = np.nan
        kinds = covariances(stated)
        if good.all() and (which == which[0]).all():
            # One for all: a view that takes no memory.
            return q, or_none(np.broadcast_to(kinds[which[0]], (len(q), 3, 3)))
        cov = kinds[which]
        cov[~good] = np.nan
        return q, or_none(cov)


def check_imu(samples: ImuSamples) -> ImuCheck:
    """Checks that the units are m/s^2 and rad/s, and that the specific force contains gravity."""
    force = float(np.median(np.linalg.norm(samples.specific_force, axis=1)))
    rate = float(np.percentile(np.linalg.norm(samples.angular_velocity, axis=1), 95))
    gravity_problem = ""
    if abs(force / _GRAVITY_M_S2 - 1.0) > _GRAVITY_TOLERANCE:
        gravity_problem = (
            f"the median specific force is {force:.3g} m/s^2, expected about {_GRAVITY_M_S2:g}: "
        )
        if abs(force - 1.0) <= _GRAVITY_TOLERANCE:
            gravity_problem += f"it looks like units of g. Multiply it by {_GRAVITY_M_S2:g}"
        elif force < 0.5 * _GRAVITY_M_S2:
            gravity_problem += "gravity seems to be removed from it. Record the raw data"
        else:
            gravity_problem += "its unit is not m/s^2. Convert it"
    rate_problem = ""
    if rate > _FAST_RAD_S:
        rate_problem = (
            f"a twentieth of the angular rates exceeds {rate:.3g} rad/s, too fast for a vehicle: "
            "it looks like degrees per second"
        )
    mean = samples.specific_force.mean(axis=0)
    x, y, z = (mean / max(float(np.linalg.norm(mean)), 1e-9)).tolist()
    return ImuCheck(force, rate, gravity_problem, rate_problem, (x, y, z))


def _common(kinds: Array, which: IntArray) -> Array | None:
    """One covariance for all samples: the median of each element of the `which` (n,) of `kinds`."""
    cov = kinds[which[:1]] if (which == which[0]).all() else kinds[which]
    known = cov[np.isfinite(cov).all(axis=(1, 2))]
    return np.asarray(np.median(known, axis=0)) if len(known) else None
