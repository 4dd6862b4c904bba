"""From messages to the vehicle's motion (`products.MotionData`).

A collector per topic takes messages in any order and makes the product at the end: sorted by stamp,
each stamp once, without invalid measurements, which it counts.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import gtsam
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

from caliv_graph.products import (
    Array,
    BoolArray,
    GivenPoses,
    GnssFixes,
    ImuSamples,
    IntArray,
    TwistSamples,
)
from caliv_graph.readers.frames import (
    TF_TYPES,
    VEHICLE_FRAMES,
    FrameTransform,
    FrameTree,
    message_transforms,
)

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

NORM_TOLERANCE = 1e-2
"""Of a quaternion: single precision is off by less."""

GRAVITY_M_S2 = 9.81

_GRAVITY_TOLERANCE = 0.15
"""Part of gravity by which the median specific force may differ: driving causes less, a unit other
than m/s^2 more."""

_FAST_RAD_S = 6.0
"""Degrees per second exceed it; no road vehicle turns as fast for a twentieth of a drive."""

_UNKNOWN_RATE_VAR = 100.0
"""(rad/s)^2: no vehicle turns at 10 rad/s. By a larger variance drivers say that it is unknown."""

_MOST_RAD_S = 200.0
_MOST_M_S2 = 2000.0
_MOST_M_S = 1000.0
MOST_ALTITUDE_M = 1e5
MOST_M = 1e8
"""Beyond the range of any sensor on a vehicle, and the width of any map: such values are invalid,
and their squares may overflow."""

_SIDEWAYS_M = 1.0
"""Of a vehicle that always looks along x: poses that move farther along y hold no orientation."""

_FIXED_AXES = ("map", "odom", "world", "earth", "enu", "utm")
"""Frames whose axes do not turn with the vehicle: a velocity stated in them is not in its axes."""


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


_Reason = tuple[str, Callable[[Array], Any]]
"""Why rows are left out, and a test (n, k) -> (n,) that is true for the rows that are kept."""


class Collector(Protocol):
    """Takes the messages of one topic."""

    def add(self, stamp_ns: int, message: Any) -> None:
        """Takes one message; `stamp_ns` is its header's stamp, or else the time of recording."""

    def notes(self) -> list[str]:
        """What was left out or looks wrong, after `finish`: sentences without a subject."""


class _Rows:
    """Rows of numbers with stamps, a few bytes each however long the drive."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._stamps = array("q")
        self._values = array("d")

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp_ns: int, values: Iterable[float]) -> None:
        self._stamps.append(stamp_ns)
        self._values.extend(values)

    def ordered(self) -> tuple[IntArray, Array, IntArray]:
        """Stamps (n,) strictly increasing, of equal ones the first; their rows; their indices."""
        # Views for a moment: the results are copies.
        stamps = np.frombuffer(self._stamps, dtype=np.int64)
        values = np.frombuffer(self._values, dtype=np.float64).reshape(-1, self._width)
        stamps, first = np.unique(stamps, return_index=True)
        return stamps, values[first], first


class _Stated:
    """Rows of numbers that mostly repeat the row before, as covariances do: kept once."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._values = array("d")
        self._which = array("i")
        self._last = b""

    def add(self, *parts: npt.NDArray[np.float64]) -> None:
        row = b"".join(np.asarray(part, np.float64).tobytes() for part in parts)
        if row != self._last or not self._which:
            self._values.frombytes(row)
            self._last = row
        self._which.append(len(self._values) // self._width - 1)

    def distinct(self) -> tuple[Array, IntArray]:
        """The rows that were kept (d, width), and the index of the kept row of each added one."""
        values = np.array(self._values, dtype=np.float64).reshape(-1, self._width)
        return values, np.array(self._which, dtype=np.int64)


class _Losses:
    """Counts the messages of a topic that are left out."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._others: list[str] = []

    def keep(self, kept: Any, why: str) -> BoolArray:
        """Counts the rows that are not kept; returns `kept`."""
        self._counts[why] += int(np.count_nonzero(~kept))
        return np.asarray(kept)

    def say(self, sentence: str) -> None:
        self._others.append(sentence)

    def notes(self, total: int) -> list[str]:
        lost = [f"{count} {why}" for why, count in self._counts.items() if count]
        return [f"of {total} messages not used: {', '.join(lost)}"] * bool(lost) + self._others


ON_EARTH: tuple[_Reason, ...] = (
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


class RowCollector:
    """Keeps a row of numbers of each message."""

    _WIDTH: ClassVar[int]

    def __init__(self) -> None:
        self._rows = _Rows(self._WIDTH)
        self._losses = _Losses()

    def _usable(self, *reasons: _Reason) -> tuple[IntArray, Array, IntArray]:
        """Stamps and rows without those to leave out, and which of the added rows they are."""
        self._losses = _Losses()
        stamps, rows, added = self._rows.ordered()
        for why, test in reasons:
            kept = self._losses.keep(test(rows), why)
            stamps, rows, added = stamps[kept], rows[kept], added[kept]
        return stamps, rows, added

    def notes(self) -> list[str]:
        """What was left out, one line each."""
        return self._losses.notes(len(self._rows))


class ImuCollector(RowCollector):
    """`sensor_msgs/Imu`."""

    _WIDTH = 10

    def __init__(self) -> None:
        super().__init__()
        self._stated = _Stated(27)

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
                f"beyond {_MOST_RAD_S:g} rad/s or {_MOST_M_S2:g} m/s^2",
                lambda r: below(r[:, :3], _MOST_RAD_S) & below(r[:, 3:6], _MOST_M_S2),
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
            angular_velocity_cov=_common(_covariances(stated[:, 9:18]), which),
            specific_force_cov=_common(_covariances(stated[:, 18:27]), which),
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
        kinds = _covariances(stated)
        if good.all() and (which == which[0]).all():
            # One for all: a view that takes no memory.
            return q, _or_none(np.broadcast_to(kinds[which[0]], (len(q), 3, 3)))
        cov = kinds[which]
        cov[~good] = np.nan
        return q, _or_none(cov)


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
        cov = _covariances(rows[:, 5:14])
        cov[rows[:, 4] == 0] = np.nan  # COVARIANCE_TYPE_UNKNOWN
        return GnssFixes(stamps, rows[:, 0], rows[:, 1], rows[:, 2], _or_none(cov))

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
        cov = _or_none(_covariances(rows[:, 3:12]))
        return TwistSamples(stamps, rows[:, :3], cov, *_yaw_rates(rows[:, 12], rows[:, 13]))


def _yaw_rates(rate: Array, variance: Array) -> tuple[Array | None, Array | None]:
    """Yaw rates (n,) and their variances, NaN where unknown; None where no message knows any.

    A driver without one leaves zeros, and may say so by a variance.
    """
    known = np.isfinite(rate) & (np.abs(rate) <= _MOST_RAD_S) & ~(variance > _UNKNOWN_RATE_VAR)
    if not (known & (rate != 0.0)).any():
        return None, None
    stated = known & (variance > 0.0)
    return (
        np.where(known, rate, np.nan),
        np.where(stated, variance, np.nan) if stated.any() else None,
    )


class PoseCollector(RowCollector):
    """`Odometry`, `PoseStamped` or `PoseWithCovarianceStamped`: the vehicle in the map.

    The header's frame is taken for the map, the child frame of an odometry for the vehicle.
    """

    _WIDTH = 43

    def add(self, stamp_ns: int, message: Any) -> None:
        """Takes one message."""
        pose = message.pose
        cov = np.zeros(36)
        if hasattr(pose, "covariance"):
            cov, pose = pose.covariance, pose.pose
        t, q = pose.position, pose.orientation
        self._rows.add(stamp_ns, (t.x, t.y, t.z, q.x, q.y, q.z, q.w, *cov.tolist()))

    def finish(self) -> GivenPoses | None:
        """The poses; None if there are none."""
        stamps, rows, _ = self._usable(
            ("with NaN or infinity", lambda r: np.isfinite(r[:, :7]).all(1)),
            (f"beyond {MOST_M:g} m from the origin", lambda r: below(r[:, :3], MOST_M)),
            (
                "whose orientation is not a unit quaternion",
                lambda r: np.abs(np.linalg.norm(r[:, 3:7], axis=1) - 1.0) <= NORM_TOLERANCE,
            ),
        )
        if not len(stamps):
            return None
        if (rows[:, 3:6] == 0.0).all() and np.ptp(rows[:, 1]) > _SIDEWAYS_M:
            self._losses.say(
                "the orientation is the identity in all messages, but the position moves sideways: "
                "if these are positions, as of a total station, set topics.gnss to the topic "
                "instead and gnss.lever_arm to the place of the prism"
            )
        poses = poses_of(rows[:, :3], rows[:, 3:7])
        cov = _or_none(_covariances(rows[:, 7:]))
        if cov is not None:
            cov = right_perturbations(Rotation.from_quat(rows[:, 3:7]).as_matrix(), cov)
        return GivenPoses(stamps, poses, cov)


class TfCollector:
    """`/tf` and `/tf_static`: the vehicle in the frame at the root of its chain.

    With map -> odom -> base_link this is base_link in map, at the stamps of the link of the chain
    that comes most often; the others are interpolated between their stamps.
    """

    def __init__(self) -> None:
        self._moving: dict[tuple[str, str], _Rows] = {}
        self._static: dict[str, FrameTransform] = {}
        self._losses = _Losses()
        self._messages = 0

    def add(self, stamp_ns: int, message: Any) -> None:
        """Takes one message of `/tf`."""
        self._messages += 1
        for own_stamp_ns, link in message_transforms(message):
            rows = self._moving.setdefault((link.parent, link.child), _Rows(7))
            q: Any = link.T_parent_child.rotation().toQuaternion()
            rows.add(
                own_stamp_ns or stamp_ns,
                (*link.T_parent_child.translation(), q.x(), q.y(), q.z(), q.w()),
            )

    def add_static(self, message: Any) -> None:
        """Takes one message of `/tf_static`."""
        for _, link in message_transforms(message):
            self._static[link.child] = link

    def finish(self) -> GivenPoses | None:
        """The poses; None if no vehicle frame moves in another."""
        self._losses = _Losses()
        rows = {child: value for (_, child), value in self._moving.items()}
        still = [link for link in self._static.values() if link.child not in rows]
        moving = [FrameTransform(*names, gtsam.Pose3()) for names in self._moving]
        tree = FrameTree([*still, *moving])
        for vehicle in VEHICLE_FRAMES:
            chain = tree.links_to(vehicle)
            if any(link.child in rows for link in chain):
                break
        else:
            self._losses.say(
                f"none of the frames {', '.join(VEHICLE_FRAMES)} moves in another; frames: "
                f"{', '.join(tree.frames[:12])}"
            )
            return None
        self._losses.say(
            "poses are those of the chain "
            + " -> ".join([chain[0].parent, *(link.child for link in chain)])
        )
        sampled = {c: rows[c].ordered()[:2] for c in (link.child for link in chain) if c in rows}
        stamps = max((stamps for stamps, _ in sampled.values()), key=len)
        # A frame that was sent once, as a latched map -> odom is, holds throughout.
        several = [s for s, _ in sampled.values() if len(s) > 1]
        if several:
            inside = (stamps >= max(s[0] for s in several)) & (
                stamps <= min(s[-1] for s in several)
            )
            stamps = stamps[inside]
        if not len(stamps):
            self._losses.say("its links have no time in common")
            return None
        R, t = Rotation.identity(len(stamps)), np.zeros((len(stamps), 3))
        for link in chain:
            if link.child in sampled:
                R_link, t_link = _interpolated(*sampled[link.child], stamps)
            else:
                # Copies: scipy refuses the views of GTSAM's memory, which are read-only.
                R_link = Rotation.from_matrix(np.array(link.T_parent_child.rotation().matrix()))
                t_link = np.array(link.T_parent_child.translation())
            R, t = R * R_link, t + R.apply(t_link)
        return GivenPoses(stamps, poses_of(t, R.as_quat()))

    def notes(self) -> list[str]:
        """What was left out, and the frames that were used."""
        return self._losses.notes(self._messages)


def check_imu(samples: ImuSamples) -> ImuCheck:
    """Checks that the units are m/s^2 and rad/s, and that the specific force contains gravity."""
    force = float(np.median(np.linalg.norm(samples.specific_force, axis=1)))
    rate = float(np.percentile(np.linalg.norm(samples.angular_velocity, axis=1), 95))
    gravity_problem = ""
    if abs(force / GRAVITY_M_S2 - 1.0) > _GRAVITY_TOLERANCE:
        gravity_problem = (
            f"the median specific force is {force:.3g} m/s^2, expected about {GRAVITY_M_S2:g}: "
        )
        if abs(force - 1.0) <= _GRAVITY_TOLERANCE:
            gravity_problem += f"it looks like units of g. Multiply it by {GRAVITY_M_S2:g}"
        elif force < 0.5 * GRAVITY_M_S2:
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


def right_perturbations(R_map_vehicle: Array, cov_ros: Array) -> Array:
    """Covariances (n, 6, 6) of poses from ROS's convention into ours, rad and m.

    ROS: x, y, z, then rotation about the fixed axes, all in the parent's axes. Ours: right
    perturbation, rotation then translation. `cov_ros = B cov B^T`, `B = [[0, R], [R, 0]]`.
    """
    B = np.zeros((len(R_map_vehicle), 6, 6))
    B[:, :3, 3:] = R_map_vehicle
    B[:, 3:, :3] = R_map_vehicle
    return np.asarray(B.transpose(0, 2, 1) @ cov_ros @ B)


def _covariances(flat: Array) -> Array:
    """(n, k, k) of (n, k * k), symmetric; NaN where a message states none.

    In ROS all zeros mean unknown; some drivers write a negative value or a single zero.
    """
    size = round(flat.shape[1] ** 0.5)
    cov = flat.reshape(-1, size, size)
    cov = (cov + cov.transpose(0, 2, 1)) / 2.0
    known = np.isfinite(cov).all(axis=(1, 2)) & (np.einsum("nii->ni", cov) > 0.0).all(axis=1)
    cov[~known] = np.nan
    return np.asarray(cov)


def _or_none(cov: Array) -> Array | None:
    return None if np.isnan(cov).all() else cov


def _common(kinds: Array, which: IntArray) -> Array | None:
    """One covariance for all samples: the median of each element of the `which` (n,) of `kinds`."""
    cov = kinds[which[:1]] if (which == which[0]).all() else kinds[which]
    known = cov[np.isfinite(cov).all(axis=(1, 2))]
    return np.asarray(np.median(known, axis=0)) if len(known) else None


def below(vectors: Array, most: float) -> BoolArray:
    """(n,) of (n, k): whether all values are within plus and minus a limit."""
    return np.asarray((np.abs(vectors) <= most).all(axis=1))


def poses_of(t: Array, q_xyzw: Array) -> tuple[gtsam.Pose3, ...]:
    """Poses from places (n, 3), metres, and quaternions (n, 4) of about unit norm."""
    q = q_xyzw / np.linalg.norm(q_xyzw, axis=1, keepdims=True)
    return tuple(
        gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), ti)
        for ti, (x, y, z, w) in zip(t, q, strict=True)
    )


def _interpolated(stamps: IntArray, rows: Array, at_ns: IntArray) -> tuple[Rotation, Array]:
    """Rotation and translation (n, 3) of a link at other stamps, none outside its own."""
    if len(stamps) == 1:
        return Rotation.from_quat(rows[0, 3:]), rows[0, :3]
    # Seconds from the first: a float cannot resolve nanoseconds in numbers this large.
    own_s, at_s = (stamps - stamps[0]) * 1e-9, (at_ns - stamps[0]) * 1e-9
    t = np.stack([np.interp(at_s, own_s, rows[:, axis]) for axis in range(3)], axis=1)
    return Slerp(own_s, Rotation.from_quat(rows[:, 3:]))(at_s), t
