"""Writing a simulated drive as a ROS 2 bag, one message at a time."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import gtsam
import numpy as np
import numpy.typing as npt
from rosbags import interfaces as ros
from rosbags.interfaces import Connection
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.geometry.se3 import quaternion_xyzw
from caliv_graph.products import Array, LidarScan
from caliv_graph.scenario.model import Scenario
from caliv_graph.scenario.sensor_models import LidarModel
from caliv_graph.simulation.recording import SimulatedRecording
from caliv_graph.simulation.writer import TOPIC_GNSS, TOPIC_IMU, TOPIC_TWIST, topic_of_lidar

TOPIC_TF_STATIC = "/tf_static"

FRAME_VEHICLE = "base_link"
FRAME_IMU = "imu_link"
FRAME_GNSS = "gnss_link"

BAG_VERSION: Literal[8] = 8
"""The newest version of rosbag2's metadata that the reader of ROS 2 Humble accepts."""

TIME_FIELDS: dict[str, tuple[str, int, int, int]] = {
    "t": ("<u4", 12, 6, 16),
    "time": ("<f4", 12, 7, 16),
    "timestamp": ("<f8", 16, 8, 24),
    "time_stamp": ("<u4", 12, 6, 16),
}
"""Per time field: its type, its offset, its type's number in a PointField, and bytes per point."""

_NEVER = ros.QosTime(sec=9_223_372_036, nsec=854_775_807)
"""No deadline, as rosbag2 writes it."""

UNKNOWN_VARIANCE = 1e9
"""Variance of the vehicle's angular velocity, which the twist messages do not contain."""


def frame_of_lidar(name: str) -> str:
    """Frame of a LiDAR's clouds."""
    return f"lidar_{name}"


def cloud_layout(model: LidarModel) -> tuple[np.dtype[Any], list[tuple[str, int, int]]]:
    """The type of a point in a PointCloud2, and name, offset and type number per field."""
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7)]
    formats, size = ["<f4", "<f4", "<f4"], 12
    if model.sweep is not None:
        time_format, offset, number, size = TIME_FIELDS[model.sweep.time_field]
        fields.append((model.sweep.time_field, offset, number))
        formats.append(time_format)
    layout = np.dtype(
        {
            "names": [name for name, _, _ in fields],
            "formats": formats,
            "offsets": [offset for _, offset, _ in fields],
            "itemsize": size,
        }
    )
    return layout, fields


def cloud_bytes(scan: LidarScan, model: LidarModel) -> npt.NDArray[np.uint8]:
    """The data of a PointCloud2, one point after the other."""
    layout, _ = cloud_layout(model)
    cloud = np.zeros(len(scan.points_lidar), dtype=layout)
    for axis, name in enumerate("xyz"):
        cloud[name] = scan.points_lidar[:, axis]
    if model.sweep is not None and scan.point_times_s is not None:
        field = model.sweep.time_field
        if field == "timestamp":
            after_ns = np.rint(scan.point_times_s * NANOSECONDS_PER_SECOND).astype(np.int64)
            cloud[field] = (scan.stamp_ns + after_ns) / NANOSECONDS_PER_SECOND
        else:
            times_s = _written_times(scan.point_times_s, model)
            cloud[field] = times_s if field == "time" else np.rint(times_s * NANOSECONDS_PER_SECOND)
        if model.sweep.packet_s is not None:
            cloud = cloud[np.argsort(scan.point_times_s, kind="stable")]
    return cloud.view(np.uint8).reshape(-1)


def _written_times(times_s: Array, model: LidarModel) -> Array:
    """Times (n,) after the stamp as the driver counts them."""
    sweep = model.sweep
    assert sweep is not None
    from_start_s = times_s if model.stamps_at_start else times_s + model.sweep_s
    if sweep.packet_s is not None:
        return np.asarray(np.mod(np.round(from_start_s, 9), sweep.packet_s))
    return from_start_s if sweep.times_from == "start" else times_s


class BagWriter:
    """Writes the messages of a recording in the order in which a recorder receives them.

    The folder must not exist. Raises ConfigError if the name of a LiDAR cannot be part of a topic.
    """

    def __init__(self, folder: Path, recording: SimulatedRecording) -> None:
        self._recording = recording
        self._scenario: Scenario = recording.scenario
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        topics = {name: topic_of_lidar(name) for name in recording.lidars}
        self._writer = Writer(folder, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP)
        if self._scenario.bag.compression == "zstd":
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._writer.open()
        self._clouds = {
            name: self._connection(topic, "sensor_msgs/msg/PointCloud2")
            for name, topic in topics.items()
        }
        motion = recording.motion()
        streams = [self._tf_static()]
        if motion.imu is not None:
            streams.append(self._imu())
        if motion.gnss is not None:
            streams.append(self._gnss())
        if motion.twist is not None:
            streams.append(self._twist())
        self._others = heapq.merge(*streams, key=lambda item: item[0])
        self._next = next(self._others, None)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self._write_others(None)
            self._writer.close()
        else:
            self._writer.abort()

    def write(self, scan: LidarScan) -> None:
        """Writes a cloud that is complete no earlier than those before, and what came before it."""
        model = self._scenario.lidars[scan.lidar]
        transport_ns = round(self._scenario.bag.transport_s * NANOSECONDS_PER_SECOND)
        record_ns = self._recording.complete_ns(scan) + transport_ns
        self._write_others(record_ns)
        types = self._store.types
        layout, fields = cloud_layout(model)
        data = cloud_bytes(scan, model)
        self._write(
            self._clouds[scan.lidar],
            record_ns,
            types["sensor_msgs/msg/PointCloud2"](
                header=self._header(scan.stamp_ns, frame_of_lidar(scan.lidar)),
                height=1,
                width=len(scan.points_lidar),
                fields=[
                    types["sensor_msgs/msg/PointField"](
                        name=name, offset=offset, datatype=number, count=1
                    )
                    for name, offset, number in fields
                ],
                is_bigendian=False,
                point_step=layout.itemsize,
                row_step=len(data),
                data=data,
                is_dense=True,
            ),
        )

    def _write_others(self, until_ns: int | None) -> None:
        """Writes all messages except clouds up to a time; None: to the end."""
        while self._next is not None and (until_ns is None or self._next[0] <= until_ns):
            record_ns, connection, message = self._next
            self._write(connection, record_ns, message)
            self._next = next(self._others, None)

    def _write(self, connection: Connection, record_ns: int, message: Any) -> None:
        data = self._store.serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, record_ns, data)

    def _connection(self, topic: str, message_type: str, latched: bool = False) -> Connection:
        qos = ros.Qos(
            history=ros.QosHistory.KEEP_LAST,
            depth=1 if latched else 10,
            reliability=ros.QosReliability.RELIABLE,
            durability=ros.QosDurability.TRANSIENT_LOCAL if latched else ros.QosDurability.VOLATILE,
            deadline=_NEVER,
            lifespan=_NEVER,
            liveliness=ros.QosLiveliness.AUTOMATIC,
            liveliness_lease_duration=_NEVER,
            avoid_ros_namespace_conventions=False,
        )
        return self._writer.add_connection(
            topic, message_type, typestore=self._store, offered_qos_profiles=[qos]
        )

    def _header(self, stamp_ns: int, frame: str) -> Any:
        types = self._store.types
        seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS_PER_SECOND)
        stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)

    def _vector(self, values: Array) -> Any:
        x, y, z = (float(value) for value in values)
        return self._store.types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)

    def _quaternion(self, xyzw: Iterable[float]) -> Any:
        x, y, z, w = (float(value) for value in xyzw)
        return self._store.types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)

    def _tf_static(self) -> Iterator[tuple[int, Connection, Any]]:
        """The extrinsics that the vehicle publishes: LiDARs at their initial guesses."""
        connection = self._connection(TOPIC_TF_STATIC, "tf2_msgs/msg/TFMessage", latched=True)
        scenario, types = self._scenario, self._store.types
        stamp_ns = self._recording.truth.start_ns
        extrinsics = {
            frame_of_lidar(name): guess.pose() for name, guess in self._recording.guesses.items()
        }
        if scenario.imu.enabled:
            extrinsics[FRAME_IMU] = scenario.imu.mounting.pose()
        if scenario.gnss.enabled:
            antenna = np.array(scenario.gnss.lever_arm)
            extrinsics[FRAME_GNSS] = gtsam.Pose3(gtsam.Rot3(), antenna)
        transforms = []
        for frame, pose in extrinsics.items():
            transforms.append(
                types["geometry_msgs/msg/TransformStamped"](
                    header=self._header(stamp_ns, FRAME_VEHICLE),
                    child_frame_id=frame,
                    transform=types["geometry_msgs/msg/Transform"](
                        translation=self._vector(pose.translation()),
                        rotation=self._quaternion(quaternion_xyzw(pose.rotation())),
                    ),
                )
            )
        yield stamp_ns, connection, types["tf2_msgs/msg/TFMessage"](transforms=transforms)

    def _imu(self) -> Iterator[tuple[int, Connection, Any]]:
        connection = self._connection(TOPIC_IMU, "sensor_msgs/msg/Imu")
        imu = self._recording.motion().imu
        assert imu is not None
        message = self._store.types["sensor_msgs/msg/Imu"]
        rate_cov = _flat(imu.angular_velocity_cov)
        force_cov = _flat(imu.specific_force_cov)
        for k, stamp_ns in enumerate(imu.stamps_ns.tolist()):
            if imu.orientation_xyzw is None:
                # REP 145: no estimate of the orientation.
                xyzw, cov = np.array([0.0, 0.0, 0.0, 1.0]), np.array([-1.0] + [0.0] * 8)
            else:
                xyzw = imu.orientation_xyzw[k]
                cov = _flat(None if imu.orientation_cov is None else imu.orientation_cov[k])
            yield (
                stamp_ns,
                connection,
                message(
                    header=self._header(stamp_ns, FRAME_IMU),
                    orientation=self._quaternion(xyzw),
                    orientation_covariance=cov,
                    angular_velocity=self._vector(imu.angular_velocity[k]),
                    angular_velocity_covariance=rate_cov,
                    linear_acceleration=self._vector(imu.specific_force[k]),
                    linear_acceleration_covariance=force_cov,
                ),
            )

    def _gnss(self) -> Iterator[tuple[int, Connection, Any]]:
        connection = self._connection(TOPIC_GNSS, "sensor_msgs/msg/NavSatFix")
        simulated = self._recording.gnss
        assert simulated is not None
        fixes, types = simulated.fixes, self._store.types
        place = np.column_stack([fixes.latitude_deg, fixes.longitude_deg, fixes.altitude_m])
        lost = dict.fromkeys(simulated.lost_ns.tolist())
        index = {stamp: k for k, stamp in enumerate(fixes.stamps_ns.tolist())}
        for stamp_ns in sorted((*index, *lost)):
            k = index.get(stamp_ns)
            cov = None if k is None or fixes.cov_enu is None else fixes.cov_enu[k]
            latitude, longitude, altitude = (
                (math.nan,) * 3 if k is None else (float(v) for v in place[k])
            )
            yield (
                stamp_ns,
                connection,
                types["sensor_msgs/msg/NavSatFix"](
                    header=self._header(stamp_ns, FRAME_GNSS),
                    # A GBAS fix by GPS, or no fix.
                    status=types["sensor_msgs/msg/NavSatStatus"](
                        status=-1 if k is None else 2, service=1
                    ),
                    latitude=latitude,
                    longitude=longitude,
                    altitude=altitude,
                    position_covariance=_flat(cov),
                    position_covariance_type=0 if cov is None else 2,
                ),
            )

    def _twist(self) -> Iterator[tuple[int, Connection, Any]]:
        connection = self._connection(TOPIC_TWIST, "geometry_msgs/msg/TwistWithCovarianceStamped")
        twist = self._recording.motion().twist
        assert twist is not None
        types = self._store.types
        for k, stamp_ns in enumerate(twist.stamps_ns.tolist()):
            cov = np.zeros((6, 6))
            if twist.velocity_cov is not None:
                cov[:3, :3] = twist.velocity_cov[k]
                cov[3:, 3:] = UNKNOWN_VARIANCE * np.eye(3)
            yield (
                stamp_ns,
                connection,
                types["geometry_msgs/msg/TwistWithCovarianceStamped"](
                    header=self._header(stamp_ns, FRAME_VEHICLE),
                    twist=types["geometry_msgs/msg/TwistWithCovariance"](
                        twist=types["geometry_msgs/msg/Twist"](
                            linear=self._vector(twist.velocity[k]),
                            angular=self._vector(np.zeros(3)),
                        ),
                        covariance=cov.reshape(-1),
                    ),
                ),
            )


def _flat(cov: Array | None) -> Array:
    """(9,) a covariance row by row; zeros mean unknown."""
    return np.zeros(9) if cov is None else np.ascontiguousarray(cov, dtype=np.float64).reshape(9)
