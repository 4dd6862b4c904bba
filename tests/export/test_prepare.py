from __future__ import annotations

from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from caliv_graph.config.load import dump_config, load_config
from caliv_graph.errors import ConfigError, ExportError
from caliv_graph.export.consumers.autoware import export as export_autoware
from caliv_graph.export.consumers.tf import export as export_tf
from caliv_graph.export.prepare import Options, prepare
from caliv_graph.results.calibration_file import write_calibration
from tests.cli.commands import write_config
from tests.export.requests import (
    T_HOUSING_LIDAR,
    T_VEHICLE_IMU,
    T_VEHICLE_KIT,
    T_VEHICLE_LIDAR,
    calibration_of,
    quaternion_xyzw,
)

OUT = Path("out.sh")


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    path = tmp_path / "calibration.yaml"
    write_calibration(calibration_of(), path)
    return path


def write_bag(
    folder: Path, cloud_frames: dict[str, str], links: dict[tuple[str, str], gtsam.Pose3]
) -> Path:
    """A bag with one empty cloud per topic and /tf_static."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    t = store.types
    stamp = t["builtin_interfaces/msg/Time"](sec=5, nanosec=0)

    def header(frame: str) -> Any:
        return t["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)

    transforms = []
    for (parent, child), T in links.items():
        x, y, z = T.translation()
        qx, qy, qz, qw = quaternion_xyzw(T)
        pose = t["geometry_msgs/msg/Transform"](
            translation=t["geometry_msgs/msg/Vector3"](x=x, y=y, z=z),
            rotation=t["geometry_msgs/msg/Quaternion"](x=qx, y=qy, z=qz, w=qw),
        )
        stamped = t["geometry_msgs/msg/TransformStamped"]
        transforms.append(stamped(header=header(parent), child_frame_id=child, transform=pose))
    messages: list[tuple[str, str, object]] = [
        ("/tf_static", "tf2_msgs/msg/TFMessage", t["tf2_msgs/msg/TFMessage"](transforms=transforms))
    ]
    for topic, frame in cloud_frames.items():
        cloud = t["sensor_msgs/msg/PointCloud2"](
            header=header(frame),
            height=1,
            width=0,
            fields=[],
            is_bigendian=False,
            point_step=12,
            row_step=0,
            data=np.zeros(0, np.uint8),
            is_dense=True,
        )
        messages.append((topic, "sensor_msgs/msg/PointCloud2", cloud))
    with Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, kind, message in messages:
            connection = writer.add_connection(topic, kind, typestore=store)
            writer.write(connection, 5_000_000_000, store.serialize_cdr(message, kind))
    return folder


def test_frames_housings_and_the_kit_from_a_recording(calibration: Path, tmp_path: Path) -> None:
    write_config(tmp_path / "config.yaml")  # its topics are sensor_1 and sensor_2
    bag = write_bag(
        tmp_path / "bag",
        {"sensor_1": "velodyne_front", "sensor_2": "velodyne_rear"},
        {
            ("base_link", "sensor_kit_base_link"): T_VEHICLE_KIT,
            ("sensor_kit_base_link", "velodyne_front_base_link"): gtsam.Pose3(),
            ("velodyne_front_base_link", "velodyne_front"): T_HOUSING_LIDAR,
        },
    )
    old = tmp_path / "sensor_kit_calibration.yaml"
    zeros = "{x: 0, y: 0, z: 0, roll: 0, pitch: 0, yaw: 0}"
    old.write_text(f"sensor_kit_base_link: {{velodyne_front_base_link: {zeros}}}\n")

    asked = prepare(
        calibration, Options("autoware", tmp_path / "new.yaml", base=old, bag=bag, lidars=["front"])
    )
    made = export_autoware(asked)

    T = T_VEHICLE_KIT.compose(made.transforms[0].T_parent_child).compose(T_HOUSING_LIDAR)
    assert T.equals(T_VEHICLE_LIDAR["front"], 1e-9)
    assert made.warnings == ()
    # The other LiDAR is in another file: that the recording knows its frame does not change this.
    both = export_autoware(
        prepare(calibration, Options("autoware", tmp_path / "new.yaml", base=old, bag=bag))
    )
    assert "has no frame of LiDAR 'rear', which is not written" in both.warnings[0]
    # To tf2, the frame of the cloud is what matters, and a housing only if it was asked for.
    lines = export_tf(prepare(calibration, Options("tf", OUT, bag=bag)))
    assert [t.child for t in lines.transforms] == ["velodyne_front", "velodyne_rear"]
    assert lines.transforms[0].T_parent_child.equals(T_VEHICLE_LIDAR["front"], 1e-9)
    assert prepare(calibration, Options("tf", OUT, bag=bag)).recorded_ns == 5_000_000_000


def test_the_imu_is_where_the_config_or_the_option_says(calibration: Path, tmp_path: Path) -> None:
    assert prepare(calibration, Options("glim", OUT)).imu is None

    extrinsic = {"xyz": [0.412, -0.153, 0.608], "rpy_deg": [3.3, 5.1, -31.7]}
    write_config(tmp_path / "config.yaml", imu={"T_vehicle_imu": extrinsic})
    imu = prepare(calibration, Options("glim", OUT)).imu
    assert imu is not None
    assert imu.stated
    assert imu.T_vehicle_imu.equals(T_VEHICLE_IMU, 1e-12)

    imu = prepare(calibration, Options("glim", OUT, imu="1,2,3,0,0,0.5")).imu
    assert imu is not None
    assert imu.T_vehicle_imu.equals(gtsam.Pose3(gtsam.Rot3.Yaw(0.5), np.array([1, 2, 3.0])), 1e-12)

    other = write_config(tmp_path / "other.yaml", topics={"pose": "/pose"})
    imu = prepare(calibration, Options("glim", OUT, config=other)).imu
    assert imu is not None
    assert not imu.stated
    other = write_config(tmp_path / "other.yaml", topics={"imu": "/imu"})
    imu = prepare(calibration, Options("glim", OUT, config=other)).imu
    assert imu is not None
    assert imu.stated


def test_an_imu_of_unknown_rotation_is_not_exported_as_aligned(
    calibration: Path, tmp_path: Path
) -> None:
    unknown = {"T_vehicle_imu": {"xyz": [0, 0, 0], "rpy_deg": None}}
    asked = load_config(write_config(tmp_path / "asked.yaml", imu=unknown))
    (calibration.parent / "config.yaml").write_text(dump_config(asked))

    with pytest.raises(ConfigError, match="rpy_deg is null: the rotation of the IMU is unknown"):
        prepare(calibration, Options("fast-lio", OUT))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            Options("npz", OUT, base=Path("x")),
            "--base: is not for --to npz, but for .*autoware,",
        ),
        (Options("urdf", OUT, letter="l"), "--letter: is not for --to urdf, but for gtsam"),
        (
            Options("urdf", OUT, lidars=["top"]),
            "--lidar: .* has no LiDAR 'top'. Give one of front, rear",
        ),
        (
            Options("tf", OUT, frames=["top=x"]),
            "--frame: .* has no LiDAR 'top'. Give one of front, rear",
        ),
        (Options("urdf", OUT, housings=["front=1"]), "--housing front: '1', expected x,y,z,roll"),
        (Options("urdf", OUT, parents=["a"]), "--parent: 'a', expected NAME=VALUE"),
        (Options("urdf", OUT, base=Path("none.urdf")), "none.urdf: no such file. Give --base an"),
    ],
)
def test_what_cannot_be_asked_for(calibration: Path, options: Options, message: str) -> None:
    with pytest.raises(ExportError, match=message) as caught:
        prepare(calibration, options)

    assert "\n" not in str(caught.value)


def test_a_base_that_is_no_text(calibration: Path, tmp_path: Path) -> None:
    old = tmp_path / "old.urdf"
    old.write_bytes(b"<robot name='\xff'/>")

    with pytest.raises(ExportError, match=r"old\.urdf: is not text in UTF-8"):
        prepare(calibration, Options("urdf", OUT, base=old))


def test_a_recording_that_says_nothing(calibration: Path, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", {}, {})

    with pytest.raises(ExportError, match="has neither /tf_static nor one of the LiDARs' topics"):
        prepare(calibration, Options("tf", OUT, bag=bag))
