"""Messages and bags of the other simulator's drives, which imports nothing from caliv_graph."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from scripts._foreign_lidar import Sweep, TimeField
from scripts._foreign_vehicle import Fixes, Imu, ImuSamples, PoseSamples, WheelSamples, geodetic
from scripts._foreign_world import Array

BEGIN_S = 1_767_000_000.0
"""Time of the drive's zero."""

FIELD_TYPES = {"<f4": 7, "<u4": 6, "<f8": 8, "<u2": 4}
"""Numbers of the types in a PointField."""

TIME_TYPES: dict[TimeField, str] = {
    "t": "<u4",
    "time": "<f4",
    "timestamp": "<f8",
    "offset_time": "<u4",
}
"""Ouster (ns), Velodyne (s), Hesai (s, absolute) and Livox (ns) name the time of a point so."""

INS_SIGMA_RAD = (3.5e-4, 3.5e-4, 1.7e-3)


class Bag:
    """A bag (MCAP) that is written."""

    def __init__(self, folder: Path) -> None:
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        self._writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        self._links: dict[str, Connection] = {}

    def __enter__(self) -> Bag:
        self._writer.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._writer.close()

    def imu(self, topic: str, imu: Imu, samples: ImuSamples) -> None:
        """Writes the messages of an IMU."""
        force_cov = np.diag([imu.accel_density**2 * imu.rate_hz] * 3).ravel()
        rate_cov = np.diag([imu.gyro_density**2 * imu.rate_hz] * 3).ravel()
        none = np.array([-1.0, *[0.0] * 8])
        turn_cov = np.diag(np.square(INS_SIGMA_RAD)).ravel() if imu.orientation else none
        for k, t_s in enumerate(samples.t_s):
            xyzw = samples.xyzw[k] if imu.orientation else (0.0, 0.0, 0.0, 1.0)
            message = self._make(
                "sensor_msgs/msg/Imu",
                header=self._header(t_s, "imu"),
                orientation=self._make("geometry_msgs/msg/Quaternion", *xyzw),
                orientation_covariance=turn_cov,
                angular_velocity=self._vector(*samples.rate_rad_s[k]),
                angular_velocity_covariance=rate_cov,
                linear_acceleration=self._vector(*samples.force_m_s2[k]),
                linear_acceleration_covariance=force_cov,
            )
            self._write(topic, t_s + 0.002, message)

    def fixes(self, topic: str, fixes: Fixes, place: tuple[float, float, float]) -> None:
        """Writes the messages of a receiver; place: latitude and longitude (deg), altitude (m)."""
        status = self._make("sensor_msgs/msg/NavSatStatus", status=2, service=1)
        where = geodetic(fixes.position_m, *place)
        for k, t_s in enumerate(fixes.t_s):
            message = self._make(
                "sensor_msgs/msg/NavSatFix",
                header=self._header(t_s, "gnss"),
                status=status,
                latitude=where[k, 0],
                longitude=where[k, 1],
                altitude=where[k, 2],
                position_covariance=np.diag(fixes.sigma_m[k] ** 2).ravel(),
                position_covariance_type=2,
            )
            self._write(topic, fixes.arrival_s[k], message)

    def wheels(self, topic: str, samples: WheelSamples, yaw_rate: bool) -> None:
        """Writes the messages of the wheels."""
        for k, t_s in enumerate(samples.t_s):
            turning = samples.yaw_rate_rad_s[k] if yaw_rate else 0.0
            twist = self._make(
                "geometry_msgs/msg/Twist",
                linear=self._vector(samples.speed_m_s[k], 0.0, 0.0),
                angular=self._vector(0.0, 0.0, turning),
            )
            header = self._header(t_s, "base_link")
            message = self._make("geometry_msgs/msg/TwistStamped", header=header, twist=twist)
            self._write(topic, t_s + 0.005, message)

    def odometry(self, topic: str, samples: PoseSamples, base_m: Array) -> None:
        """Writes poses of base_link, `base_m` in the axle frame, without covariances."""
        unknown = np.zeros(36)
        still = self._vector(0.0, 0.0, 0.0)
        twist = self._make(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=self._make("geometry_msgs/msg/Twist", linear=still, angular=still),
            covariance=unknown,
        )
        position = samples.position_m + Rotation.from_quat(samples.xyzw).apply(base_m)
        for k, t_s in enumerate(samples.t_s):
            pose = self._make(
                "geometry_msgs/msg/Pose",
                position=self._make("geometry_msgs/msg/Point", *position[k]),
                orientation=self._make("geometry_msgs/msg/Quaternion", *samples.xyzw[k]),
            )
            message = self._make(
                "nav_msgs/msg/Odometry",
                header=self._header(t_s, "odom"),
                child_frame_id="base_link",
                pose=self._make(
                    "geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=unknown
                ),
                twist=twist,
            )
            self._write(topic, t_s + 0.02, message)

    def cloud(self, topic: str, frame: str, sweep: Sweep, kind: TimeField, end_s: float) -> None:
        """Writes a sweep that ends at `end_s`."""
        layout = dict.fromkeys(("x", "y", "z", "intensity"), "<f4")
        layout |= {kind: TIME_TYPES[kind], "ring": "<u2"}
        dtype = np.dtype(list(layout.items()))
        data = np.zeros(len(sweep.points), dtype)
        data["x"], data["y"], data["z"] = sweep.points.T
        data["intensity"], data["ring"] = sweep.intensity, sweep.channel
        if kind == "timestamp":
            data[kind] = BEGIN_S + sweep.start_s + sweep.time_s
        else:
            data[kind] = sweep.time_s * (1.0 if kind == "time" else 1e9)
        assert dtype.fields is not None
        fields = [
            self._make(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=offset,
                datatype=FIELD_TYPES[of.str],
                count=1,
            )
            for name, (of, offset, *_) in dtype.fields.items()
        ]
        message = self._make(
            "sensor_msgs/msg/PointCloud2",
            header=self._header(sweep.start_s, frame),
            height=1,
            width=len(data),
            fields=fields,
            is_bigendian=False,
            point_step=dtype.itemsize,
            row_step=dtype.itemsize * len(data),
            data=np.frombuffer(data.tobytes(), np.uint8),
            is_dense=True,
        )
        self._write(topic, end_s + 0.008, message)

    def _write(self, topic: str, arrival_s: float, message: Any) -> None:
        kind = message.__msgtype__
        if topic not in self._links:
            self._links[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        content = self._store.serialize_cdr(message, kind)
        self._writer.write(self._links[topic], round((BEGIN_S + arrival_s) * 1e9), content)

    def _header(self, t_s: float, frame: str) -> Any:
        seconds, nanoseconds = divmod(round((BEGIN_S + t_s) * 1e9), 10**9)
        stamp = self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def _vector(self, x: float, y: float, z: float) -> Any:
        return self._make("geometry_msgs/msg/Vector3", x, y, z)

    def _make(self, kind: str, *values: float, **fields: Any) -> Any:
        """A message; the types are made at run time and have no annotations."""
        return self._store.types[kind](*values, **fields)
