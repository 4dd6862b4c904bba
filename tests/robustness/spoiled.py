"""Ways in which recordings come wrong: units, signs, axes, frames, stamps, values."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from tests.robustness.hostile_drives import (
    FRONT,
    GNSS,
    IMU,
    LIDARS,
    REAR,
    TWIST,
    Change,
    on,
    points_of,
    set_points,
)

EVERYTHING = (*LIDARS, IMU, GNSS, TWIST)


def _vector(name: str, convert: Callable[[Any], Iterable[float]]) -> Callable[[Any], None]:
    """Changes a vector of a message, by its dotted name."""

    def edit(message: Any) -> None:
        for part in name.split("."):
            message = getattr(message, part)
        values = np.array([message.x, message.y, message.z])
        message.x, message.y, message.z = (float(value) for value in convert(values))

    return edit


def _quaternion(convert: Callable[[Any], Iterable[float]]) -> Callable[[Any], None]:
    def edit(message: Any) -> None:
        q = message.orientation
        q.x, q.y, q.z, q.w = (float(v) for v in convert(np.array([q.x, q.y, q.z, q.w])))

    return edit


def _both(*edits: Callable[[Any], None]) -> Callable[[Any], None]:
    def edit(message: Any) -> None:
        for one in edits:
            one(message)

    return edit


def _covariance(name: str, variance: float, other: float = 0.0) -> Callable[[Any], None]:
    """Sets a covariance: its diagonal, and what stands beside it."""

    def edit(message: Any) -> None:
        *above, last = name.split(".")
        for part in above:
            message = getattr(message, part)
        size = round(len(getattr(message, last)) ** 0.5)
        matrix = np.full((size, size), other) + np.eye(size) * (variance - other)
        setattr(message, last, matrix.ravel())

    return edit


def _cloud(convert: Callable[[Any], Any]) -> Callable[[Any], None]:
    """Changes the points of a cloud, (N, 3)."""

    def edit(message: Any) -> None:
        points = points_of(message)
        points[:] = convert(points.copy())

    return edit


def _place(**values: Callable[[Any], float]) -> Callable[[Any], None]:
    def edit(message: Any) -> None:
        new = {name: value(message) for name, value in values.items()}
        for name, value in new.items():
            setattr(message, name, value)

    return edit


def _stamps(convert: Callable[[int, int], int], *topics: str) -> Change:
    """Changes header stamps: ns since the drive's start and number of the message to ns."""
    counts = dict.fromkeys(EVERYTHING, 0)
    start_ns = [0]

    def change(topic: str, record_ns: int, message: Any) -> Iterable[tuple[int, Any]]:
        if topic in (topics or EVERYTHING):
            stamp = message.header.stamp
            stamp_ns = stamp.sec * NANOSECONDS_PER_SECOND + stamp.nanosec
            start_ns[0] = start_ns[0] or stamp_ns
            new_ns = start_ns[0] + convert(stamp_ns - start_ns[0], counts[topic])
            stamp.sec, stamp.nanosec = divmod(new_ns, NANOSECONDS_PER_SECOND)
            counts[topic] += 1
        return [(record_ns, message)]

    return change


def _every(n: int, edit: Callable[[Any], None]) -> Callable[[Any], None]:
    numbers = itertools.count()

    def sometimes(message: Any) -> None:
        if next(numbers) % n == 0:
            edit(message)

    return sometimes


def _some(values: Any, bad: float) -> Any:
    values[::3] = bad
    values[1::7, 2] = bad
    return values


_FIRST: dict[str, Any] = {}


def _always_the_first(topic: str, record_ns: int, message: Any) -> Iterable[tuple[int, Any]]:
    """All clouds of a LiDAR have the points of its tenth."""
    if topic in LIDARS:
        key = topic
        if key not in _FIRST and len(points_of(message)) > 1000:
            _FIRST[key] = points_of(message).copy()
        if key in _FIRST:
            set_points(message, _FIRST[key])
    return [(record_ns, message)]


def _one_lidar_twice(convert: Callable[[Any], Any]) -> Change:
    """The rear LiDAR has the front one's clouds, in another frame perhaps."""
    last: list[Any] = []

    def change(topic: str, record_ns: int, message: Any) -> Iterable[tuple[int, Any]]:
        if topic == FRONT:
            last[:] = [points_of(message).copy()]
        if topic == REAR and last:
            set_points(message, convert(last[0]))
        return [(record_ns, message)]

    return change


def _twice(topic: str, record_ns: int, message: Any) -> Iterable[tuple[int, Any]]:
    return [(record_ns, message), (record_ns + 1000, message)]


HOUR_NS = 3600 * NANOSECONDS_PER_SECOND

SPOILED: Mapping[str, Change] = {
    # units
    "clouds in mm": on(*LIDARS)(_cloud(lambda p: 1000.0 * p)),
    "clouds in feet": on(*LIDARS)(_cloud(lambda p: p / 0.3048)),
    "one LiDAR in feet": on(REAR)(_cloud(lambda p: p / 0.3048)),
    "force in g": on(IMU)(_vector("linear_acceleration", lambda f: f / 9.80665)),
    "rate in degrees": on(IMU)(_vector("angular_velocity", np.degrees)),
    "velocity in km/h": on(TWIST)(_vector("twist.twist.linear", lambda v: 3.6 * v)),
    "latitude in radians": on(GNSS)(
        _place(
            latitude=lambda m: np.radians(m.latitude), longitude=lambda m: np.radians(m.longitude)
        )
    ),
    "altitude in feet": on(GNSS)(_place(altitude=lambda m: m.altitude / 0.3048)),
    "stamps in ms": _stamps(lambda t, n: 1000 * t),
    "stamps of the LiDARs in ms": _stamps(lambda t, n: 1000 * t, *LIDARS),
    "stamps of the LiDARs in us": _stamps(lambda t, n: t // 1000, *LIDARS),
    # signs and axes
    "gravity the other way": on(IMU)(_vector("linear_acceleration", lambda f: -f)),
    "gravity removed": on(IMU)(_vector("linear_acceleration", lambda f: f - [0, 0, 9.80665])),
    "IMU with z down": on(IMU)(
        _both(
            _vector("linear_acceleration", lambda f: f * [1, -1, -1]),
            _vector("angular_velocity", lambda w: w * [1, -1, -1]),
        )
    ),
    "IMU with x and y swapped": on(IMU)(
        _both(
            _vector("linear_acceleration", lambda f: f[[1, 0, 2]]),
            _vector("angular_velocity", lambda w: w[[1, 0, 2]]),
        )
    ),
    "rate the other way": on(IMU)(_vector("angular_velocity", lambda w: -w)),
    "velocity sideways": on(TWIST)(_vector("twist.twist.linear", lambda v: v[[1, 0, 2]])),
    "velocity backwards": on(TWIST)(_vector("twist.twist.linear", lambda v: -v)),
    "latitude and longitude swapped": on(GNSS)(
        _place(latitude=lambda m: m.longitude, longitude=lambda m: m.latitude)
    ),
    "clouds left-handed": on(*LIDARS)(_cloud(lambda p: p * [1, -1, 1])),
    "one LiDAR left-handed": on(REAR)(_cloud(lambda p: p * [1, -1, 1])),
    "clouds with x and y swapped": on(*LIDARS)(_cloud(lambda p: p[:, [1, 0, 2]])),
    "clouds upside down": on(*LIDARS)(_cloud(lambda p: p * [1, -1, -1])),
    "orientation w first": on(IMU)(_quaternion(lambda q: q[[3, 0, 1, 2]])),
    "orientation inverted": on(IMU)(_quaternion(lambda q: q * [-1, -1, -1, 1])),
    "orientation from north": on(IMU)(
        _quaternion(
            lambda q: np.array([q[0] + q[1], q[1] - q[0], q[2] - q[3], q[3] + q[2]]) / 2**0.5
        )
    ),
    "orientation not of norm one": on(IMU)(_quaternion(lambda q: 1.5 * q)),
    "orientation of zeros": on(IMU)(_quaternion(lambda q: 0 * q)),
    # stamps
    "every message twice": _twice,
    "one stamp for all clouds": _stamps(lambda t, n: 0, *LIDARS),
    "stamps backwards": _stamps(lambda t, n: 14 * NANOSECONDS_PER_SECOND - t),
    "stamps of the LiDARs backwards": _stamps(
        lambda t, n: 14 * NANOSECONDS_PER_SECOND - t, *LIDARS
    ),
    "a jump of an hour": _stamps(lambda t, n: t + HOUR_NS * (t > 7 * NANOSECONDS_PER_SECOND)),
    "a jump back": _stamps(
        lambda t, n: t - 5 * NANOSECONDS_PER_SECOND * (t > 7 * NANOSECONDS_PER_SECOND)
    ),
    "LiDARs half a second late": _stamps(lambda t, n: t + NANOSECONDS_PER_SECOND // 2, *LIDARS),
    "an hour between LiDARs and the rest": _stamps(lambda t, n: t + HOUR_NS, *LIDARS),
    "stamps of zero": _stamps(lambda t, n: -1_750_000_000 * NANOSECONDS_PER_SECOND, *LIDARS),
    # values
    "NaN points": on(*LIDARS)(_cloud(lambda p: _some(p, np.nan))),
    "infinite points": on(*LIDARS)(_cloud(lambda p: _some(p, np.inf))),
    "only NaN": on(*LIDARS)(_cloud(lambda p: p * np.nan)),
    "NaN in the IMU": on(IMU)(_every(5, _vector("linear_acceleration", lambda f: f * np.nan))),
    "only NaN in the IMU": on(IMU)(_vector("angular_velocity", lambda f: f * np.nan)),
    "infinity in the IMU": on(IMU)(_every(9, _vector("angular_velocity", lambda f: f + np.inf))),
    "huge values in the IMU": on(IMU)(_every(9, _vector("angular_velocity", lambda f: f + 1e300))),
    "huge values in the velocity": on(TWIST)(
        _every(9, _vector("twist.twist.linear", lambda v: v * 1e300))
    ),
    "a huge altitude": on(GNSS)(_every(9, _place(altitude=lambda m: 1e300))),
    "a huge covariance": on(GNSS)(_covariance("position_covariance", 1e300)),
    "a tiny covariance": on(GNSS)(_covariance("position_covariance", 1e-300)),
    "an indefinite covariance": on(GNSS)(_covariance("position_covariance", 1e-4, 5e-4)),
    "a tiny covariance of the orientation": on(IMU)(_covariance("orientation_covariance", 1e-300)),
    "a huge covariance of the velocity": on(TWIST)(_covariance("twist.covariance", 1e300)),
    "a tiny covariance of the force": on(IMU)(
        _covariance("linear_acceleration_covariance", 1e-300)
    ),
    "NaN in the position": on(GNSS)(_every(3, _place(latitude=lambda m: np.nan))),
    "no fix": on(GNSS)(lambda message: setattr(message.status, "status", -1)),
    "an IMU that stands still": on(IMU)(
        _both(
            _vector("linear_acceleration", lambda f: [0, 0, 9.80665]),
            _vector("angular_velocity", lambda w: 0 * w),
        )
    ),
    "clouds without a point": on(*LIDARS)(lambda message: set_points(message, np.empty((0, 3)))),
    "clouds of one point": on(*LIDARS)(lambda message: set_points(message, points_of(message)[:1])),
    "every other cloud empty": on(*LIDARS)(
        _every(4, lambda message: set_points(message, np.empty((0, 3))))
    ),
    "all clouds the same": _always_the_first,
    "one LiDAR under two names": _one_lidar_twice(lambda p: p),
    "one LiDAR in two frames": _one_lidar_twice(lambda p: p * [-1, -1, 1] + [2, 0, 0.5]),
    "one point many times": on(*LIDARS)(
        lambda message: set_points(message, np.full((500, 3), [10.0, 1.0, -1.0]))
    ),
}
