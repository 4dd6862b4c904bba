"""Small, valid inputs of every reader, made on the fly: what fuzz.py starts from."""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import gtsam
import lzf  # type: ignore[import-not-found]
import numpy as np
import yaml
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from caliv_graph.config.load import dump_config, parse_config
from caliv_graph.conventions import AXES, NANOSECONDS_PER_SECOND
from caliv_graph.products import Calibration, DataTerm, Direction, Guess, LidarResult
from caliv_graph.results.calibration_file import write_calibration
from caliv_graph.scenario.model import dump_scenario, parse_scenario

REPOSITORY = Path(__file__).resolve().parents[1]

START_NS = 1_700_000_000 * NANOSECONDS_PER_SECOND

TYPES = {
    "/points": "sensor_msgs/msg/PointCloud2",
    "/imu": "sensor_msgs/msg/Imu",
    "/fix": "sensor_msgs/msg/NavSatFix",
    "/odom": "nav_msgs/msg/Odometry",
    "/twist": "geometry_msgs/msg/TwistStamped",
    "/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/tf": "tf2_msgs/msg/TFMessage",
}
"""Topics of the small bags and their types."""

CONFIG: Mapping[str, Any] = {
    "data": {"format": "rosbag", "path": "drive"},
    "topics": {"imu": "/imu", "gnss": "/fix", "twist": "/twist"},
    "lidars": {
        "front": {
            "topic": "/points",
            "initial": {"xyz": [2, 0, 2], "rpy_deg": [0, 10, 0]},
            "sigma": {"xyz": 0.058, "rpy_deg": [1.73, 1.73, 2]},
        },
        "rear": {"topic": "/rear", "initial": {"xyz": [-0.4, 0, 2]}, "fixed": True},
    },
    "reference": "rear",
    "target": [{"min": [10, -14, -1], "max": [20, -4, 3], "frame": "start"}],
    "ground": {"use": True, "vehicle_height": 0.0},
    "noise": {"gnss_horizontal_m": 0.02},
    "robust": {"kernel": "tls"},
    "require": ["s2s", "s2v_rotation"],
    "limits": {"s2v_yaw_deg": 0.1},
}

SCENARIO: Mapping[str, Any] = {
    "name": "small",
    "drive": {"kind": "arc", "duration_s": 17.0, "radius_m": 9.16, "turn": "right"},
    "lidars": {
        "front": {"mounting": {"xyz": [2, 0, 2], "rpy_deg": [0, 10, 0]}, "rate_hz": 5.0},
        "rear": {
            "mounting": {"xyz": [-0.4, 0, 2], "rpy_deg": [0, 10, 180]},
            "sweep": {"time_field": "t"},
        },
    },
    "reference": "rear",
    "world": {
        "objects": {"chair": {"shape": "chair", "xy_m": [15.16, -9.16], "yaw_deg": 90.0}},
        "targets": ["chair"],
    },
    "gnss": {"outages": [{"start_s": 3.0, "duration_s": 2.0}]},
}

URDF = """<?xml version="1.0"?>
<robot name="v">
  <link name="base_link"/><link name="roof"/><link name="lidar"/>
  <joint name="a" type="fixed"><parent link="base_link"/><child link="roof"/>
    <origin xyz="0.4 0 1.9" rpy="0 0.1 0"/></joint>
  <joint name="b" type="fixed"><parent link="roof"/><child link="lidar"/></joint>
  <joint name="w" type="continuous"><parent link="base_link"/><child link="wheel"/></joint>
</robot>
"""

BASES: Mapping[str, str] = {
    "urdf": URDF.replace("lidar", "front").replace("roof", "rear"),
    "autoware": "base_link:\n  front:\n    {x: 1.0, y: 0.0, z: 2.0, roll: 0.0, pitch: 0.1, "
    "yaw: 0.0}\n  rear: {x: 0.0, y: 0.0, z: 2.0, roll: 0.0, pitch: 0.0, yaw: 3.14}  # rear\n",
    "glim": '{"sensors": {"T_lidar_imu": [0.0, 0, 0, 0, 0, 0, 1], /* imu */ "x": 1}}\n',
    "lio-sam": "lio_sam:\n  extrinsicTrans: [0.0, 0.0, 0.0]\n  extrinsicRot: [1, 0, 0,\n"
    "    0, 1, 0, 0, 0, 1]\n  extrinsicRPY: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n",
    "fast-lio": "mapping:\n  extrinsic_T: [0.0, 0.0, 0.0]\n  extrinsic_R: [1,0,0, 0,1,0, 0,0,1]\n",
    "mola": "sensors:\n  - topic: ${T|'/points'}\n    type: CObservationPointCloud\n"
    '    fixed_sensor_pose: "0 0 0 0 0 0"\n',
}
"""Per consumer of `export` an existing file that is to be changed."""


def small_calibration(*names: str) -> Calibration:
    """All that a file can hold: an undetermined direction, guesses, and of one LiDAR earlier data.

    Args:
        names: front, rear or both.
    """
    rng = np.random.default_rng(1)
    size = 6 * len(names)
    scale = np.tile([2e-4] * 3 + [1e-3] * 3, len(names))
    roots = rng.normal(size=(size, 2 * size)) * scale[:, None]
    cov = np.asarray(roots @ roots.T)
    poses = {
        "front": gtsam.Pose3(gtsam.Rot3.RzRyRx(0.01, 0.17, 0.02), np.array([2.0, 0.1, 2.0])),
        "rear": gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.17, 3.1), np.array([-0.4, 0.0, 2.0])),
    }
    poses = {name: poses[name] for name in names}
    sigmas = np.array([0.03] * 3 + [0.06] * 3)
    lidars = {
        name: LidarResult(
            T_vehicle_lidar=T,
            cov=cov[6 * i : 6 * i + 6, 6 * i : 6 * i + 6],
            determined={axis: axis != "x" for axis in AXES},
            scans_used=60,
            saw_target=True,
            time_offset=(0.01, 0.001) if i else None,
            guess=Guess(T, sigmas, fixed=False),
        )
        for i, (name, T) in enumerate(poses.items())
    }
    vector = {name: np.eye(6)[3] for name in names}
    information = np.asarray(np.linalg.inv(cov))
    term = DataTerm(("0f3a",), poses, information, np.zeros(size))
    return Calibration(
        status="partial",
        reference=names[-1],
        lidars=lidars,
        cov_joint=cov,
        information_data=information,
        undetermined=(Direction(vector, np.inf, 0.06, "x of all LiDARs", together=True),),
        weak=(),
        unmet=("front to rear: x",),
        provenance={"caliv_graph": "0.1.0", "recordings": ["drive"]},
        gradient_data=np.zeros(size),
        earlier=(term,) if len(names) == 1 else (),
    )


def calibration_text(*names: str) -> str:
    """A calibration.yaml of LiDARs `front`, `rear` or both."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "calibration.yaml"
        write_calibration(small_calibration(*names), path)
        return path.read_text(encoding="utf-8")


def truth_text() -> str:
    """A truth.yaml."""
    pose = {"translation": [2.0, 0.0, 2.0], "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0]}
    lidars = {name: {"T_vehicle_lidar": pose, "time_offset": 0.0} for name in ("front", "rear")}
    return str(yaml.safe_dump({"lidars": lidars}))


def manifest_text() -> str:
    """A batch's manifest with all its keys: the example that the repository has."""
    return (REPOSITORY / "configs" / "batch.yaml").read_text(encoding="utf-8")


def config_text() -> str:
    """A config with all its keys."""
    return dump_config(parse_config(CONFIG, "config", Path("/")))


def scenario_text() -> str:
    """A scenario with all its keys."""
    return dump_scenario(parse_scenario(SCENARIO, "scenario"))


def poses_text() -> str:
    """An ego_poses.yaml of two frames."""
    half = float(np.sqrt(0.5))
    poses = [["0.pcd", [0.0, 0, 0, 0, 0, 0, 1]], ["1.pcd", [1.5, -2e-3, 0, 0, 0, half, half]]]
    return str(yaml.safe_dump({"sensor_1": poses, "sensor_2": poses}))


def pcd_files() -> list[bytes]:
    """Clouds in all three encodings, with and without further fields."""
    points = np.array([[3, 0, 0], [4, 0.5, 0], [np.nan] * 3, [6, 1, 1]], "<f4")
    wide = np.zeros(4, [("i", "<u2"), ("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("n", "<f4", 2)])
    for column, axis in enumerate("xyz"):
        wide[axis] = points[:, column]
    plain = "# .PCD v.7\nVERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    more = "FIELDS i x y z n\nSIZE 2 8 8 8 4\nTYPE U F F F F\nCOUNT 1 1 1 1 2\n"
    shape = "WIDTH 4\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 4\nDATA "
    rows = "\n".join(" ".join(str(value) for value in row) for row in points)
    body = points.T.tobytes() * 4
    packed = lzf.compress(body)
    sizes = struct.pack("<II", len(packed), len(body))
    longer = shape.replace("4\n", "16\n")
    return [
        f"{plain}{shape}ascii\n{rows}\n".encode(),
        f"{plain}{shape}binary\n".encode() + points.tobytes(),
        f"{more}WIDTH 2\nHEIGHT 2\nPOINTS 4\nDATA binary\n".encode() + wide.tobytes(),
        f"{plain}{longer}binary_compressed\n".encode() + sizes + packed,
    ]


def messages(store: Typestore) -> dict[str, list[tuple[int, Any]]]:
    """Per topic of `TYPES` stamps and messages that a drive could have."""
    make = _Messages(store)
    stamps = [START_NS + k * 100_000_000 for k in range(3)]
    makers = {
        "/points": make.cloud,
        "/imu": make.imu,
        "/fix": make.fix,
        "/odom": make.odometry,
        "/twist": make.twist,
        "/pose": make.pose,
        "/tf": make.transforms,
    }
    return {topic: [(stamp, maker(stamp)) for stamp in stamps] for topic, maker in makers.items()}


class _Messages:
    """Makes messages of a store's types; what is not told is zero."""

    def __init__(self, store: Typestore) -> None:
        self.store = store

    def make(self, name: str, /, **fields: Any) -> Any:
        values = {}
        for field, (node, detail) in self.store.fielddefs[name][1]:
            values[field] = fields[field] if field in fields else self._zero(int(node), detail)
        return self.store.types[name](**values)

    def _zero(self, node: int, detail: Any) -> Any:
        if node == 1:
            return "" if detail[0] == "string" else 0
        if node == 2:
            return self.make(detail)
        (_, inner), size = detail
        return np.zeros(size if node == 3 else 0, inner[0])

    def header(self, stamp_ns: int, frame: str) -> Any:
        seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS_PER_SECOND)
        stamp = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def vector(self, *xyz: float) -> Any:
        x, y, z = map(float, xyz)
        return self.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def point(self, *xyz: float) -> Any:
        x, y, z = map(float, xyz)
        return self.make("geometry_msgs/msg/Point", x=x, y=y, z=z)

    def quaternion(self, *xyzw: float) -> Any:
        x, y, z, w = map(float, xyzw)
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def cloud(self, stamp_ns: int, big_endian: bool = False, height: int = 1) -> Any:
        layout = np.dtype([(axis, "<f4") for axis in "xyz"] + [("t", "<u4")])
        if big_endian:
            layout = layout.newbyteorder(">")
        points = np.zeros(4, layout)
        points["x"], points["y"], points["t"] = [3, 4, 5, np.nan], 1.0, [0, 1000, 2000, 3000]
        fields = [
            self.make("sensor_msgs/msg/PointField", name=n, offset=4 * i, datatype=t, count=1)
            for i, (n, t) in enumerate((("x", 7), ("y", 7), ("z", 7), ("t", 6)))
        ]
        return self.make(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(stamp_ns, "lidar"),
            height=height,
            width=4 // height,
            fields=fields,
            is_bigendian=big_endian,
            point_step=16,
            row_step=64 // height,
            data=np.frombuffer(points.tobytes(), np.uint8),
        )

    def imu(self, stamp_ns: int) -> Any:
        return self.make(
            "sensor_msgs/msg/Imu",
            header=self.header(stamp_ns, "imu"),
            orientation=self.quaternion(0, 0, 0.6, 0.8),
            orientation_covariance=np.eye(3).ravel() * 1e-4,
            linear_acceleration=self.vector(0, 0.1, 9.81),
            angular_velocity=self.vector(0, 0, 0.1),
        )

    def fix(self, stamp_ns: int) -> Any:
        return self.make(
            "sensor_msgs/msg/NavSatFix",
            header=self.header(stamp_ns, "gnss"),
            latitude=48.0,
            longitude=11.0,
            altitude=500.0,
            position_covariance=np.eye(3).ravel() * 1e-4,
            position_covariance_type=2,
        )

    def odometry(self, stamp_ns: int) -> Any:
        pose = self.make(
            "geometry_msgs/msg/Pose",
            position=self.point(1, 2, 0),
            orientation=self.quaternion(0, 0, 0.6, 0.8),
        )
        cov = np.eye(6).ravel() * 1e-4
        twist = self.make("geometry_msgs/msg/Twist", linear=self.vector(2, 0, 0))
        return self.make(
            "nav_msgs/msg/Odometry",
            header=self.header(stamp_ns, "map"),
            child_frame_id="base_link",
            pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=cov),
            twist=self.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=cov),
        )

    def twist(self, stamp_ns: int) -> Any:
        twist = self.make("geometry_msgs/msg/Twist", linear=self.vector(2, 0, 0))
        header = self.header(stamp_ns, "base_link")
        return self.make("geometry_msgs/msg/TwistStamped", header=header, twist=twist)

    def pose(self, stamp_ns: int) -> Any:
        header = self.header(stamp_ns, "map")
        pose = self.odometry(stamp_ns).pose
        return self.make("geometry_msgs/msg/PoseWithCovarianceStamped", header=header, pose=pose)

    def transforms(self, stamp_ns: int) -> Any:
        links = [
            self.make(
                "geometry_msgs/msg/TransformStamped",
                header=self.header(stamp_ns, parent),
                child_frame_id=child,
                transform=self.make(
                    "geometry_msgs/msg/Transform",
                    translation=self.vector(1, 2, 0),
                    rotation=self.quaternion(0, 0, 0.6, 0.8),
                ),
            )
            for parent, child in (("map", "odom"), ("odom", "base_link"))
        ]
        return self.make("tf2_msgs/msg/TFMessage", transforms=links)


def clouds(store: Typestore) -> list[bytes]:
    """Serialised clouds of both byte orders, of one and of two rows."""
    make = _Messages(store)
    made = [make.cloud(START_NS), make.cloud(START_NS, big_endian=True), make.cloud(0, height=2)]
    kind = TYPES["/points"]
    orders = (True, True, False)
    return [
        bytes(store.serialize_cdr(cloud, kind, little_endian=order))
        for cloud, order in zip(made, orders, strict=True)
    ]


def livox() -> list[bytes]:
    """Serialised Livox clouds of two points, as in ROS 2 and as in ROS 1."""
    head = struct.pack("<II", 1_700_000_000, 0) + struct.pack("<I", 4) + b"lid\0"
    ros1 = struct.pack("<I", 7) + head + struct.pack("<QIB3xI", START_NS, 2, 1, 2)
    ros2 = b"\0\1\0\0" + head + struct.pack("<QIB3xI", START_NS, 2, 1, 2)
    point = struct.pack("<IfffBBB", 1000, 3.0, 1.0, 0.0, 9, 16, 1)
    return [b"\0" + ros2 + point + b"\0" + point, b"\1" + ros1 + point + point]


def bag(folder: Path, kind: str, topics: Iterable[str]) -> Path:
    """Writes a bag of a few messages.

    Args:
        folder: must exist.
        kind: mcap, zstd (MCAP with packed chunks), db3 or bag.
        topics: some of `TYPES`.

    Returns:
        The file that holds the messages.
    """
    store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
    names = {topic: TYPES[topic] for topic in topics}
    writer: Any
    if kind == "bag":
        writer = Writer1(folder / "drive.bag")
    else:
        plugin = StoragePlugin.SQLITE3 if kind == "db3" else StoragePlugin.MCAP
        writer = Writer2(folder / "drive", version=9, storage_plugin=plugin)
        if kind == "zstd":
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    made = messages(store) if kind != "bag" else _ros1_messages(store, names)
    with writer:
        serialise = store.serialize_ros1 if kind == "bag" else store.serialize_cdr
        for topic, name in names.items():
            connection = writer.add_connection(topic, name, typestore=store)
            for stamp, message in made[topic]:
                writer.write(connection, stamp, serialise(message, name))
    if kind == "bag":
        return folder / "drive.bag"
    return next(f for f in (folder / "drive").iterdir() if f.suffix in (".mcap", ".db3"))


def _ros1_messages(store: Typestore, names: Iterable[str]) -> dict[str, list[tuple[int, Any]]]:
    make = _Messages(store)
    makers = {"/points": make.cloud, "/imu": make.imu, "/fix": make.fix, "/twist": make.twist}
    stamps = [START_NS + k * 100_000_000 for k in range(3)]
    return {topic: [(stamp, makers[topic](stamp)) for stamp in stamps] for topic in names}
