"""Bags, read back by another reader than the package that wrote them: PyPI's mcap."""

import struct
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from caliv_graph.config.load import load_config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.errors import ConfigError
from caliv_graph.products import Array
from caliv_graph.scenario.drive_models import ArcDrive
from caliv_graph.scenario.model import BagModel, CropModel
from caliv_graph.scenario.sensor_models import (
    GnssModel,
    ImuModel,
    LidarModel,
    OrientationModel,
    OutageModel,
    SweepModel,
    VelocityModel,
)
from caliv_graph.scenario.world_models import ChairModel, WorldModel
from caliv_graph.simulation import Scenario, SimulatedRecording, simulate_drive, write_drive

BEGIN_NS = 1_750_000_000 * 10**9

FRONT = LidarModel(
    mounting=PoseConfig(xyz=(2.0, 0.0, 2.0), rpy_deg=(0.0, 10.0, 0.0)),
    channels=16,
    horizontal_resolution_deg=2.0,
)


def with_sweep(time_field: str, stamp_at: str = "start", **changes: Any) -> LidarModel:
    sweep = SweepModel.model_validate({"time_field": time_field, "stamp_at": stamp_at})
    return FRONT.model_copy(update={"sweep": sweep, **changes})


LIDARS = {
    "plain": FRONT,
    "ouster": with_sweep("t", phase_s=0.013),
    "velodyne": with_sweep("time", rate_hz=5.0, time_offset_s=0.02),
    "hesai": with_sweep("timestamp", "end"),
    "autoware": with_sweep("time_stamp"),
}

SCENARIO = Scenario(
    name="bagged",
    drive=ArcDrive(duration_s=5.0),
    lidars=LIDARS,
    world=WorldModel(objects={"chair": ChairModel(xy_m=(9.0, -3.0))}, targets=("chair",)),
    gnss=GnssModel(lever_arm=(0.5, -0.2, 1.7), outages=(OutageModel(start_s=2.0, duration_s=0.5),)),
    imu=ImuModel(mounting=PoseConfig(xyz=(0.3, 0.1, 0.5), rpy_deg=(0.0, 0.0, 90.0))),
)

SEED = 3

FORMATS = {2: "B", 6: "I", 7: "f", 8: "d"}


def changed(**sections: Any) -> Scenario:
    sections = {"lidars": {"plain": FRONT}, **sections}
    reference = next(iter(sections["lidars"]))
    return SCENARIO.model_copy(update={"reference": reference, **sections})


def messages(folder: Path) -> dict[str, list[tuple[int, Any]]]:
    """Record time and message, per topic, in the order of the file."""
    (path,) = (folder / "drive").glob("*.mcap")
    found = defaultdict(list)
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
            found[channel.topic].append((message.log_time, decoded))
    return dict(found)


def stamp_of(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def decoded_cloud(message: Any) -> dict[str, Array]:
    """Field by field and point by point, as the definition of PointCloud2 says."""
    assert message.height == 1
    assert message.row_step == message.width * message.point_step == len(message.data)
    assert not message.is_bigendian
    columns: dict[str, Array] = {}
    for field in message.fields:
        values = [
            struct.unpack_from("<" + FORMATS[field.datatype], message.data, start + field.offset)[0]
            for start in range(0, len(message.data), message.point_step)
        ]
        columns[field.name] = np.array(values)
    return columns


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(SCENARIO, tmp_path_factory.mktemp("bag") / "out", SEED, threads=1).folder


@pytest.fixture(scope="module")
def bag(folder: Path) -> dict[str, list[tuple[int, Any]]]:
    return messages(folder)


@pytest.fixture(scope="module")
def recording() -> SimulatedRecording:
    return simulate_drive(SCENARIO, SEED)


def test_folder_holds_a_bag_and_what_lies_beside_it(folder: Path) -> None:
    assert sorted(path.name for path in folder.iterdir()) == [
        "config.yaml",
        "drive",
        "scenario.yaml",
        "trajectory.tum",
        "truth.yaml",
    ]
    assert sorted(path.name for path in (folder / "drive").iterdir()) == [
        "drive.mcap",
        "metadata.yaml",
    ]


def test_topics_types_and_counts(bag: dict[str, list[tuple[int, Any]]], folder: Path) -> None:
    assert {topic: len(found) for topic, found in bag.items()} == {
        "/tf_static": 1,
        "/imu/data": 501,
        "/gnss/fix": 51,
        "/vehicle/twist": 51,
        "/lidar/plain/points": 51,
        "/lidar/ouster/points": 49,
        "/lidar/velodyne/points": 25,
        "/lidar/hesai/points": 50,
        "/lidar/autoware/points": 50,
    }
    metadata = yaml.safe_load((folder / "drive/metadata.yaml").read_text())
    info = metadata["rosbag2_bagfile_information"]
    types = {
        topic["topic_metadata"]["name"]: topic["topic_metadata"]["type"]
        for topic in info["topics_with_message_count"]
    }
    assert types["/imu/data"] == "sensor_msgs/msg/Imu"
    assert types["/gnss/fix"] == "sensor_msgs/msg/NavSatFix"
    assert types["/vehicle/twist"] == "geometry_msgs/msg/TwistWithCovarianceStamped"
    assert types["/lidar/plain/points"] == "sensor_msgs/msg/PointCloud2"
    assert info["message_count"] == sum(map(len, bag.values()))


def test_messages_come_in_the_order_of_their_times(folder: Path) -> None:
    (path,) = (folder / "drive").glob("*.mcap")
    with path.open("rb") as file:
        times = [
            message.log_time
            for _, _, message in make_reader(file).iter_messages(log_time_order=False)
        ]
    assert times[0] == BEGIN_NS
    assert times == sorted(times)


def test_motion_is_that_of_the_recording(
    bag: dict[str, list[tuple[int, Any]]], recording: SimulatedRecording
) -> None:
    motion = recording.motion()
    assert motion.imu is not None
    assert motion.imu.orientation_xyzw is not None
    assert motion.twist is not None
    assert [stamp_of(m) for _, m in bag["/imu/data"]] == motion.imu.stamps_ns.tolist()
    for k, (log_ns, m) in enumerate(bag["/imu/data"]):
        assert log_ns == stamp_of(m)
        assert m.header.frame_id == "imu_link"
        a, w, q = m.linear_acceleration, m.angular_velocity, m.orientation
        assert [a.x, a.y, a.z] == motion.imu.specific_force[k].tolist()
        assert [w.x, w.y, w.z] == motion.imu.angular_velocity[k].tolist()
        assert [q.x, q.y, q.z, q.w] == motion.imu.orientation_xyzw[k].tolist()
    _, first = bag["/imu/data"][0]
    np.testing.assert_allclose(first.angular_velocity_covariance, (0.005**2 * np.eye(3)).ravel())
    np.testing.assert_allclose(first.linear_acceleration_covariance, (0.05**2 * np.eye(3)).ravel())
    np.testing.assert_allclose(first.orientation_covariance, (0.005**2 * np.eye(3)).ravel())
    for k, (_, m) in enumerate(bag["/vehicle/twist"]):
        v = m.twist.twist.linear
        assert [v.x, v.y, v.z] == motion.twist.velocity[k].tolist()
        cov = np.array(m.twist.covariance).reshape(6, 6)
        np.testing.assert_allclose(cov[:3, :3], 0.01 * np.eye(3))
        assert cov[5, 5] > 1e6


def test_fixes_are_those_of_the_recording_and_losses_say_so(
    bag: dict[str, list[tuple[int, Any]]], recording: SimulatedRecording
) -> None:
    fixes = recording.motion().gnss
    assert fixes is not None
    fixed = [m for _, m in bag["/gnss/fix"] if m.status.status >= 0]
    lost = [m for _, m in bag["/gnss/fix"] if m.status.status < 0]
    assert [(stamp_of(m) - BEGIN_NS) // 10**8 for m in lost] == [20, 21, 22, 23, 24]
    assert all(np.isnan([m.latitude, m.longitude, m.altitude]).all() for m in lost)
    assert [stamp_of(m) for m in fixed] == fixes.stamps_ns.tolist()
    assert [m.latitude for m in fixed] == fixes.latitude_deg.tolist()
    assert [m.longitude for m in fixed] == fixes.longitude_deg.tolist()
    assert [m.altitude for m in fixed] == fixes.altitude_m.tolist()
    np.testing.assert_allclose(
        fixed[0].position_covariance, np.diag([0.0167**2, 0.0167**2, 0.02**2]).ravel()
    )
    assert fixed[0].position_covariance_type == 2


@pytest.mark.parametrize("name", LIDARS)
def test_clouds_are_those_of_the_recording(
    bag: dict[str, list[tuple[int, Any]]], recording: SimulatedRecording, name: str
) -> None:
    found = bag[f"/lidar/{name}/points"]
    scans = list(recording.scans(name))
    assert [stamp_of(m) for _, m in found] == [scan.stamp_ns for scan in scans]
    for k in (0, 11, len(scans) - 1):
        (log_ns, message), scan = found[k], scans[k]
        assert message.header.frame_id == f"lidar_{name}"
        assert log_ns == recording.complete_ns(scan)
        cloud = decoded_cloud(message)
        points = np.column_stack([cloud[axis] for axis in "xyz"])
        np.testing.assert_array_equal(points, scan.points_lidar.astype(np.float32))
        if name == "plain":
            assert set(cloud) == {"x", "y", "z"}
            continue
        after_s = scan.point_times_s
        assert after_s is not None
        if name == "ouster":
            np.testing.assert_array_equal(cloud["t"], np.rint(after_s * 1e9))
        elif name == "velodyne":
            np.testing.assert_allclose(cloud["time"], after_s, atol=1e-8)
        elif name == "hesai":
            # A double of 1.75e9 s knows a quarter of a microsecond.
            absolute = cloud["timestamp"] - BEGIN_NS * 1e-9
            expected = (scan.stamp_ns - BEGIN_NS) * 1e-9 + after_s
            np.testing.assert_allclose(absolute, expected, atol=3e-7)
            assert after_s.max() < 0.0
        else:
            np.testing.assert_array_equal(cloud["time_stamp"], np.rint(after_s * 1e9))


def test_tree_of_frames_has_the_initial_guesses(
    bag: dict[str, list[tuple[int, Any]]], folder: Path
) -> None:
    ((_, message),) = bag["/tf_static"]
    config = load_config(folder / "config.yaml")
    expected = {f"lidar_{name}": lidar.given for name, lidar in config.lidars.items()}
    expected["imu_link"] = SCENARIO.imu.mounting
    expected["gnss_link"] = PoseConfig(xyz=SCENARIO.gnss.lever_arm)
    assert {t.child_frame_id for t in message.transforms} == set(expected)
    for sent in message.transforms:
        assert sent.header.frame_id == "base_link"
        t, q = sent.transform.translation, sent.transform.rotation
        pose = expected[sent.child_frame_id].pose()
        np.testing.assert_allclose([t.x, t.y, t.z], pose.translation(), atol=1e-9)
        w: Any = pose.rotation().toQuaternion()
        np.testing.assert_allclose([q.x, q.y, q.z, q.w], [w.x(), w.y(), w.z(), w.w()], atol=1e-9)
    assert config.lidars["plain"].initial != FRONT.mounting


def test_same_seed_gives_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    again = write_drive(SCENARIO, tmp_path / "again", SEED, threads=2).folder
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            assert (again / path.relative_to(folder)).read_bytes() == path.read_bytes(), path


def test_compressed_bag_says_the_same_in_less(tmp_path: Path) -> None:
    # Clouds of noise do not compress; times, headers and fields do.
    lidars = {"ouster": LIDARS["ouster"]}
    sizes, contents = [], []
    for compression in ("none", "zstd"):
        bag = BagModel.model_validate({"compression": compression})
        out = write_drive(changed(lidars=lidars, bag=bag), tmp_path / compression, SEED).folder
        sizes.append((out / "drive/drive.mcap").stat().st_size)
        contents.append(messages(out))
    assert sizes[1] < 0.8 * sizes[0]
    for topic, found in contents[0].items():
        for (one_ns, one), (other_ns, other) in zip(found, contents[1][topic], strict=True):
            assert one_ns == other_ns
            if "points" in topic:
                assert bytes(one.data) == bytes(other.data)
            else:
                assert str(one) == str(other)


def test_unknown_covariances_are_zeros_and_the_config_knows(tmp_path: Path) -> None:
    scenario = changed(bag=BagModel(covariances="unknown"))
    out = write_drive(scenario, tmp_path / "out", SEED).folder
    bag = messages(out)
    imu, twist = bag["/imu/data"][7][1], bag["/vehicle/twist"][7][1]
    fix = bag["/gnss/fix"][7][1]
    for values in (
        imu.orientation_covariance,
        imu.angular_velocity_covariance,
        imu.linear_acceleration_covariance,
        twist.twist.covariance,
        fix.position_covariance,
    ):
        assert not np.any(values)
    assert fix.position_covariance_type == 0
    noise = load_config(out / "config.yaml").noise
    # A sample's sigma at 100 Hz, as a density.
    assert noise.accelerometer_density_m_s2_sqrthz == pytest.approx(0.005)
    assert noise.gyroscope_density_rad_s_sqrthz == pytest.approx(0.0005)
    assert noise.gnss_horizontal_m == pytest.approx(0.0167)
    assert noise.gnss_vertical_m == pytest.approx(0.02)
    assert noise.velocity_m_s == pytest.approx(0.1)
    assert noise.orientation_deg == pytest.approx(np.degrees(0.005))


def test_sensors_that_are_not_there_have_no_topic(tmp_path: Path) -> None:
    scenario = changed(
        gnss=GnssModel(enabled=False),
        velocity=VelocityModel(enabled=False),
        imu=ImuModel(orientation=OrientationModel(enabled=False)),
    )
    out = write_drive(scenario, tmp_path / "out", SEED).folder
    bag = messages(out)
    assert set(bag) == {"/tf_static", "/imu/data", "/lidar/plain/points"}
    # REP 145.
    assert bag["/imu/data"][0][1].orientation_covariance[0] == -1.0
    topics = load_config(out / "config.yaml").topics
    assert (topics.imu, topics.gnss, topics.twist) == ("/imu/data", None, None)


def test_cloud_without_a_return_is_an_empty_message(tmp_path: Path) -> None:
    blind = {"plain": FRONT.model_copy(update={"max_range_m": 1.5})}
    drive = write_drive(changed(lidars=blind), tmp_path / "out", SEED)
    assert drive.scans["plain"].points == (0,) * 51
    found = messages(drive.folder)["/lidar/plain/points"]
    assert len(found) == 51
    assert all(m.width == 0 and len(m.data) == 0 for _, m in found)


def test_config_is_ready_to_run_on_the_bag(folder: Path) -> None:
    config = load_config(folder / "config.yaml")
    assert config.data.format == "rosbag"
    assert config.data.path == folder / "drive"
    assert config.topics.model_dump() == {
        "imu": "/imu/data",
        "gnss": "/gnss/fix",
        "twist": "/vehicle/twist",
        "heading": None,
        "pose": None,
    }
    assert config.imu.T_vehicle_imu.model_dump() == SCENARIO.imu.mounting.model_dump()
    assert config.gnss.lever_arm == (0.5, -0.2, 1.7)
    assert config.lidars["ouster"].topic == "/lidar/ouster/points"
    # All but the LiDARs' noise is in the messages.
    assert config.noise.model_dump(exclude_unset=True) == {"lidar_range_m": 0.01}
    # The map of a bag begins at the antenna's first fix: (0.5, -0.2, 1.7) here.
    assert config.target
    (region,) = config.target
    assert region.min == pytest.approx((8.1 - 5.0, -3.16 - 5.0, -6.7), abs=0.03)
    assert region.max == pytest.approx((8.87 + 5.0, -2.44 + 5.0, 4.55), abs=0.03)


def test_target_is_left_out_where_it_is_to_be_searched_for(tmp_path: Path) -> None:
    out = write_drive(changed(config_target="search"), tmp_path / "search", SEED).folder
    assert "target" not in yaml.safe_load((out / "config.yaml").read_text())
    assert load_config(out / "config.yaml").target is None


def test_none_is_searched_for_where_the_world_has_none(tmp_path: Path) -> None:
    out = write_drive(changed(world=WorldModel()), tmp_path / "none", SEED).folder
    assert load_config(out / "config.yaml").target is False


def test_bias_walk_is_in_the_config_since_no_message_tells_it(tmp_path: Path) -> None:
    imu = ImuModel(
        accelerometer_bias_walk_m_s3_sqrthz=0.002, gyroscope_bias_walk_rad_s2_sqrthz=0.0001
    )
    noise = load_config(
        write_drive(changed(imu=imu), tmp_path / "out", 0).folder / "config.yaml"
    ).noise
    assert noise.accelerometer_bias_walk_m_s3_sqrthz == 0.002
    assert noise.gyroscope_bias_walk_rad_s2_sqrthz == 0.0001


def test_trajectory_has_the_truth_at_the_stamps_of_the_bag(
    folder: Path, recording: SimulatedRecording
) -> None:
    lines = (folder / "trajectory.tum").read_text().splitlines()
    assert lines[0].startswith("# map: ENU, origin at latitude 48.262700000")
    rows = {}
    for line in lines[1:]:
        stamp, *values = line.split()
        seconds, nanoseconds = stamp.split(".")
        rows[int(seconds) * 10**9 + int(nanoseconds)] = [float(v) for v in values]
    assert list(rows) == sorted(rows)
    for name in recording.lidars:
        assert set(recording.scan_stamps_ns(name)) <= set(rows)
    stamp_ns = recording.scan_stamps_ns("ouster")[30]
    (pose,) = recording.truth.T_map_vehicle(np.array([stamp_ns]))
    np.testing.assert_allclose(rows[stamp_ns][:3], pose.translation(), atol=1e-11)


def test_lidar_whose_name_is_no_topic_is_an_error_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"lidars\.front left: .* Rename the LiDAR"):
        write_drive(changed(lidars={"front left": FRONT}), tmp_path / "out", 0)
    assert not list(tmp_path.iterdir())


def test_crop_makes_a_bag_small(tmp_path: Path) -> None:
    full = write_drive(changed(), tmp_path / "full", SEED)
    crop = CropModel(margin_m=0.2, elsewhere_stride=4)
    small = write_drive(changed(crop=crop), tmp_path / "small", SEED)
    assert small.scans["plain"].target_points == full.scans["plain"].target_points
    assert sum(small.scans["plain"].points) < 0.3 * sum(full.scans["plain"].points)
