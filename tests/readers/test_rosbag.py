from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.load import parse_config
from caliv_graph.config.model import PoseAxes, TopicsConfig
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.errors import ConfigError, RecordingError
from caliv_graph.products import GivenPoses
from caliv_graph.readers import open_recording
from caliv_graph.readers.pointcloud2 import DecodedCloud
from caliv_graph.readers.rosbag import RosbagRecording
from tests.readers.bags import (
    KINDS,
    SECOND,
    START,
    Message,
    cloud,
    fix,
    imu,
    livox,
    odometry,
    packed_cloud,
    tf,
    twist,
    write_bag,
)

FRONT, REAR = "/lidar/front/points", "/livox/lidar"

Recorded = tuple[str, int, Message]


def lidar(topic: str, low: float = 0.0, high: float = 100.0) -> LidarConfig:
    return LidarConfig(
        topic=topic, initial=PoseConfig(xyz=(0.0, 0.0, 0.0)), min_range=low, max_range=high
    )


def points_of(number: int, count: int = 40) -> np.ndarray[Any, Any]:
    return np.random.default_rng(number).uniform(2.0, 9.0, (count, 3)).astype(np.float32)


def stamp_of(number: int) -> int:
    return START + number * SECOND // 10


def drive(count: int = 20) -> list[Recorded]:
    out: list[Recorded] = []
    for k in range(count):
        stamp = stamp_of(k)
        out.append(("/imu/data", stamp + 1, imu(stamp)))
        out.append(("/vehicle/twist", stamp + 2, twist(stamp, (2, 0, 0))))
        out.append(("/gnss/fix", stamp + 3, fix(stamp, latitude=48 + k * 1e-5)))
        out.append((FRONT, stamp + 4, cloud(stamp, points_of(k), np.arange(40) * 1_000_000)))
        times_ns = [200_000 * i for i in range(9)]
        out.append((REAR, stamp + 5, livox(stamp + 50, points_of(-k % 97, 9), times_ns)))
    return out


def opened(
    path: Path, topics: TopicsConfig | None = None, also: Sequence[str] = (), **lidars: str
) -> RosbagRecording:
    names = lidars or {"front": FRONT}
    configs = {name: lidar(topic) for name, topic in names.items()}
    return RosbagRecording(path, configs, topics or TopicsConfig(), also)


def stamps(scans: Any) -> list[int]:
    return [(scan.stamp_ns - START) * 10 // SECOND for scan in scans]


@pytest.mark.parametrize("kind", KINDS)
def test_a_drive_in_every_kind_of_bag(tmp_path: Path, kind: str) -> None:
    path = write_bag(tmp_path / "drive", drive(), kind)
    config = parse_config(
        {
            "data": {"path": str(path)},
            "topics": {"imu": "/imu/data", "gnss": "/gnss/fix", "twist": "/vehicle/twist"},
            "lidars": {
                "rear": {"topic": REAR, "initial": {"xyz": [0, 0, 0]}},
                "front": {"topic": FRONT, "initial": {"xyz": [0, 0, 0]}, "stamp": "start"},
            },
        },
        "config.yaml",
        tmp_path,
    )

    recording = open_recording(config)

    assert recording.name == str(path)
    assert recording.lidars == ("rear", "front")
    assert recording.scan_stamps_ns("front") == [stamp_of(k) for k in range(20)]
    assert recording.scan_stamps_ns("rear") == [stamp_of(k) + 50 for k in range(20)]
    scans = list(recording.scans("front"))
    assert [scan.stamp_ns for scan in scans] == recording.scan_stamps_ns("front")
    np.testing.assert_array_equal(scans[7].points_lidar, points_of(7))
    times_s = scans[7].point_times_s
    assert times_s is not None
    np.testing.assert_allclose(times_s, np.arange(40) * 1e-3)
    assert scans[7].source == f"{path}: {FRONT} at 1700000000.700000000 s"
    assert all(len(scan.points_lidar) == 9 for scan in recording.scans("rear"))
    motion = recording.motion()
    assert motion.name == str(path)
    assert motion.imu is not None
    assert motion.gnss is not None
    assert motion.twist is not None
    assert motion.poses is None
    assert motion.imu.stamps_ns.tolist() == [stamp_of(k) for k in range(20)]
    assert motion.gnss.latitude_deg[3] == 48 + 3e-5
    assert motion.twist.velocity[0].tolist() == [2, 0, 0]
    assert recording.warnings() == []


def test_a_file_of_poses_is_in_the_clock_of_the_stamps_not_of_the_recorder(tmp_path: Path) -> None:
    # A simulated drive: the stamps count from 0, the record times from 1970.
    begin = 10 * SECOND
    messages = [
        (FRONT, stamp_of(k), cloud(begin + k * SECOND // 10, points_of(k))) for k in range(20)
    ]
    bag = write_bag(tmp_path / "drive", messages)

    def read(first_s: float) -> GivenPoses | None:
        path = tmp_path / "poses.tum"
        path.write_text("".join(f"{first_s + 0.1 * k:.1f} {k} 0 0 0 0 0 1\n" for k in range(20)))
        lidars = {"front": lidar(FRONT)}
        return RosbagRecording(bag, lidars, TopicsConfig(), poses=path).motion().poses

    poses = read(10.0)
    assert poses is not None
    assert poses.stamps_ns[0] == begin
    with pytest.raises(RecordingError, match=r"of 1700000000\.000 .*drive of 10\.000 to 11\.900 s"):
        read(START / SECOND)


@pytest.mark.parametrize("package", ["livox_ros_driver", "livox_ros_driver2"])
@pytest.mark.parametrize("kind", ["mcap", "ros1"])
def test_livox_of_both_drivers(tmp_path: Path, package: str, kind: str) -> None:
    message = livox(START, points_of(1, 5), [0, 10, 20, 30, 40], package=package)
    recording = opened(write_bag(tmp_path / "drive", [(REAR, START, message)], kind), rear=REAR)

    (scan,) = recording.scans("rear")

    np.testing.assert_array_equal(scan.points_lidar, points_of(1, 5))
    assert scan.point_times_s is not None
    np.testing.assert_allclose(scan.point_times_s, np.arange(5) * 1e-8)


def test_only_what_is_wanted_is_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = opened(write_bag(tmp_path / "drive", drive(60)))
    decoded: list[int] = []
    plain = RosbagRecording._decoded

    def counted(
        self: RosbagRecording, found: tuple[str, int, bytes]
    ) -> tuple[int, DecodedCloud | str]:
        decoded.append(found[1])
        return plain(self, found)

    monkeypatch.setattr(RosbagRecording, "_decoded", counted)
    assert len(recording.scan_stamps_ns("front")) == 60
    assert decoded == []
    wanted = {stamp_of(k) for k in (3, 4, 30, 59)} | {12345}

    assert stamps(recording.scans("front", wanted)) == [3, 4, 30, 59]
    assert len(decoded) == 4
    assert stamps(recording.scans("front", set())) == []


def test_parts_of_the_bag_without_wanted_clouds_are_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = opened(write_bag(tmp_path / "drive", drive(60)))
    windows: list[tuple[int | None, int | None]] = []
    plain = recording._bag.messages

    def recorded(topics: Any, start: int | None = None, stop: int | None = None) -> Any:
        windows.append((start, stop))
        return plain(topics, start, stop)

    monkeypatch.setattr(recording._bag, "messages", recorded)
    wanted = {stamp_of(k) for k in (3, 4, 7, 30)}
    recording.scan_stamps_ns("front")
    recording.motion()

    assert stamps(recording.scans("front", wanted)) == [3, 4, 7, 30]
    # One pass for all stamps and the motion; then one window for near clouds, one for the other.
    first = (None, None)
    assert windows == [
        first,
        (stamp_of(3) + 4, stamp_of(7) + 5),
        (stamp_of(30) + 4, stamp_of(30) + 5),
    ]


@pytest.mark.parametrize("kind", ["mcap", "ros1"])
def test_messages_out_of_order_are_sorted(tmp_path: Path, kind: str) -> None:
    numbers = [0, 1, 3, 2, 4, 8, 7, 6, 5, 9]
    messages = [
        (FRONT, stamp_of(i), cloud(stamp_of(k), points_of(k))) for i, k in enumerate(numbers)
    ]
    recording = opened(write_bag(tmp_path / "drive", messages, kind))

    scans = list(recording.scans("front"))

    assert stamps(scans) == list(range(10))
    for k, scan in enumerate(scans):
        np.testing.assert_array_equal(scan.points_lidar, points_of(k))
    assert stamps(recording.scans("front", {stamp_of(k) for k in (2, 3, 5)})) == [2, 3, 5]
    (line,) = recording.warnings()
    assert "4 of 10 messages of /lidar/front/points are stamped before" in line


def test_of_two_clouds_with_one_stamp_the_first_is_taken(tmp_path: Path) -> None:
    messages = [(FRONT, stamp_of(k), cloud(stamp_of(min(k, 3)), points_of(k))) for k in range(5)]
    recording = opened(write_bag(tmp_path / "drive", messages))

    scans = list(recording.scans("front"))

    assert stamps(scans) == [0, 1, 2, 3]
    np.testing.assert_array_equal(scans[3].points_lidar, points_of(3))
    assert "1 of 5 messages of /lidar/front/points have the stamp of another" in str(
        recording.warnings()
    )


def test_clouds_without_a_stamp_have_the_time_of_their_recording(tmp_path: Path) -> None:
    messages = [(FRONT, stamp_of(k), cloud(0, points_of(k))) for k in range(3)]
    recording = opened(write_bag(tmp_path / "drive", messages))

    assert recording.scan_stamps_ns("front") == [stamp_of(k) for k in range(3)]
    assert stamps(recording.scans("front")) == [0, 1, 2]
    assert "3 of 3 messages of /lidar/front/points have no header stamp" in str(
        recording.warnings()
    )


def test_ranges_of_the_config(tmp_path: Path) -> None:
    points = [[0.9, 0, 0], [1.1, 0, 0], [0, 0, 4.9], [0, 0, 5.1], [np.nan, 0, 0], [0, 0, 0]]
    path = write_bag(tmp_path / "drive", [(FRONT, START, cloud(START, points, range(6)))])
    recording = RosbagRecording(path, {"front": lidar(FRONT, 1.0, 5.0)}, TopicsConfig())

    (scan,) = recording.scans("front")

    np.testing.assert_allclose(scan.points_lidar, [[1.1, 0, 0], [0, 0, 4.9]], rtol=1e-6)
    assert scan.point_times_s is not None
    np.testing.assert_allclose(scan.point_times_s, [1e-9, 2e-9])


def test_a_cloud_without_returns_is_a_scan(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "drive", [(FRONT, START, cloud(START, np.zeros((5, 3))))])

    (scan,) = opened(path).scans("front")

    assert scan.points_lidar.shape == (0, 3)


def test_times_of_points_are_reported(tmp_path: Path) -> None:
    good = [
        (FRONT, stamp_of(k), cloud(stamp_of(k), points_of(k, 3), [-0.1, -0.05, k * 0.01], TIME))
        for k in range(3)
    ]
    bad = [
        (FRONT, stamp_of(k), cloud(stamp_of(k), points_of(k, 3), [0.0, 5e3, 1e5], TIME))
        for k in (3, 4)
    ]
    recording = opened(write_bag(tmp_path / "drive", good + bad))

    scans = list(recording.scans("front")) + list(recording.scans("front"))

    assert [scan.point_times_s is None for scan in scans[:5]] == [False] * 3 + [True] * 2
    seen = recording.times_seen("front")
    assert seen.field is not None
    assert (seen.field.name, seen.field.type) == ("time", "float32")
    assert (seen.first_s, seen.last_s) == pytest.approx((-0.1, 0.02))
    # Read twice, but each cloud counts once.
    assert (seen.clouds, seen.problems) == (3, 2)
    (line,) = recording.warnings()
    assert "LiDAR 'front': the times of the points of 2 clouds are not used" in line
    assert "spans 0 to 1e+05 s" in line


TIME = ("time", "f4")


def test_times_that_are_never_filled_in(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "drive", [(FRONT, START, cloud(START, points_of(1, 3), [0, 0, 0]))])
    recording = opened(path)

    list(recording.scans("front"))

    assert "field 't' is 0 for all points" in str(recording.warnings())


def test_a_damaged_cloud_is_left_out_and_told(tmp_path: Path) -> None:
    messages: list[Recorded] = [
        (FRONT, stamp_of(k), cloud(stamp_of(k), points_of(k))) for k in range(4)
    ]
    messages[2][2]["data"] = np.zeros(7, np.uint8)
    recording = opened(write_bag(tmp_path / "drive", messages))

    assert stamps(recording.scans("front")) == [0, 1, 3]
    (line,) = recording.warnings()
    assert "1 clouds of LiDAR 'front' are damaged and not used" in line
    assert "has 7 bytes of data, expected 480" in line


@pytest.mark.parametrize("kind", ["mcap", "sqlite3", "ros1"])
def test_clouds_and_warnings_do_not_depend_on_the_number_of_cores(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages = drive()
    broken = [message for topic, _, message in messages if topic == FRONT][7]
    broken["data"] = np.zeros(7, np.uint8)
    path = write_bag(tmp_path / "drive", messages, kind)
    found = []
    for cores in (1, 2):
        monkeypatch.setattr("caliv_graph.readers.ahead.cores", partial(int, cores))
        whole, half = opened(path), opened(path)
        scans = list(whole.scans("front"))
        # Who stops before the damaged cloud has not seen it, whatever was decoded ahead.
        early = [scan for scan, _ in zip(half.scans("front"), range(6), strict=False)]
        found.append((scans, whole.warnings(), half.warnings(), len(early)))

    (scans, told, told_early, _), (scans_2, told_2, told_early_2, _) = found
    assert [s.stamp_ns for s in scans] == [s.stamp_ns for s in scans_2]
    for one, other in zip(scans, scans_2, strict=True):
        np.testing.assert_array_equal(one.points_lidar, other.points_lidar)
        assert one.point_times_s is not None
        assert other.point_times_s is not None
        np.testing.assert_array_equal(one.point_times_s, other.point_times_s)
    assert told == told_2
    assert any("damaged" in line for line in told)
    assert told_early == told_early_2
    assert not any("damaged" in line for line in told_early)


def test_clouds_without_coordinates(tmp_path: Path) -> None:
    columns: dict[str, tuple[Any, str]] = {"range": (np.ones(3), "f4")}
    path = write_bag(tmp_path / "drive", [(FRONT, START, packed_cloud(START, columns))])

    with pytest.raises(
        RecordingError, match=r"fields are range float32\. Set lidars\.front\.topic"
    ):
        list(opened(path).scans("front"))


@pytest.mark.parametrize(
    ("topics", "lidars", "message"),
    [
        ({}, {"front": "/lidar/frnt/points"}, r"no topic '/lidar/frnt/points' \(lidars\.front\.to"),
        ({}, {"front": "/lidar/frnt/points"}, r"Did you mean '/lidar/front/points'\? Topics that"),
        ({}, {"front": "/nothing"}, r"Topics that fit: /lidar/front/points, /livox/lidar$"),
        (
            {},
            {"front": "/imu/data"},
            r"'/imu/data' \(lidars\.front\.topic\) is of type sensor_msgs",
        ),
        ({"imu": "/gnss/fix"}, {}, r"for IMU it takes sensor_msgs/msg/Imu\. Topics .* /imu/data$"),
        ({"gnss": "/fix"}, {}, r"no topic '/fix' \(topics\.gnss\).* Topics that fit: /gnss/fix$"),
        ({"twist": FRONT}, {}, r"for velocity it takes .* Topics that fit: /vehicle/twist$"),
        (
            {"pose": "/imu/data"},
            {},
            r"No topic of the bag fits: record one, or leave topics.pose out$",
        ),
    ],
)
def test_missing_topics_and_wrong_types(
    tmp_path: Path, topics: dict[str, str], lidars: dict[str, str], message: str
) -> None:
    path = write_bag(tmp_path / "drive", drive(2))

    with pytest.raises(RecordingError, match=message) as caught:
        opened(path, TopicsConfig(**topics), **lidars)

    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_the_leading_slash_may_be_left_out(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "drive", drive(3))

    recording = opened(path, TopicsConfig(imu="imu/data"), front="lidar/front/points")

    assert len(list(recording.scans("front"))) == 3
    assert recording.motion().imu is not None


def test_a_topic_without_clouds(tmp_path: Path) -> None:
    empty = [(FRONT, "sensor_msgs/msg/PointCloud2")]
    path = write_bag(tmp_path / "drive", [("/imu", START, imu(START))], topics=empty)

    with pytest.raises(RecordingError, match=r"\(LiDAR 'front'\) has no clouds\. Record it"):
        opened(path)


def test_a_topic_of_motion_without_anything_useful(tmp_path: Path) -> None:
    messages = [*drive(2), ("/fix", START, fix(START, status=-1))]
    recording = opened(write_bag(tmp_path / "drive", messages), TopicsConfig(gnss="/fix"))

    assert recording.motion().gnss is None
    assert [line.partition("'/fix': ")[2] for line in recording.warnings()] == [
        "of 1 messages not used: 1 without a fix (status < 0)",
        "holds nothing that can be used",
    ]


def test_an_imu_in_units_of_g_is_refused(tmp_path: Path) -> None:
    messages = drive(2)
    messages += [("/g", stamp_of(k), imu(stamp_of(k), (0, 0, 1))) for k in range(5)]
    path = write_bag(tmp_path / "drive", messages)
    recording = opened(path, TopicsConfig(imu="/g"))

    with pytest.raises(RecordingError, match=r"topics\.imu '/g': .* units of g\. Multiply it by"):
        recording.motion()

    with pytest.raises(RecordingError):
        recording.motion()
    assert len(recording.warnings()) == len(set(recording.warnings()))
    assert recording.imu_checks()["/g"].specific_force_m_s2 == pytest.approx(1.0)
    assert len(recording.scan_stamps_ns("front")) == 2


def test_gaps_of_the_imu_are_told(tmp_path: Path) -> None:
    messages = [
        ("/imu", START + k * SECOND // 100, imu(START + k * SECOND // 100))
        for k in range(200)
        if not 50 <= k < 75 and k != 20
    ]
    path = write_bag(tmp_path / "drive", [*drive(1), *messages])
    recording = opened(path, TopicsConfig(imu="/imu"))

    recording.motion()

    (line,) = recording.warnings()
    assert line.endswith("'/imu': 1 gaps longer than 0.1 s, the longest 0.26 s")


@pytest.mark.parametrize(
    ("child", "mount", "axes", "said"),
    [
        ("camera_link", ((1.6, 0.1, 0.9), (0, 0, 0, 1)), "flu", "'camera_link' is at xyz [1.60,"),
        ("camera_link", ((0.0, 0.0, 0.0), (0, 0, 0, 1)), "flu", ""),
        ("base_frd", ((0.0, 0.0, 0.0), (1, 0, 0, 0)), "flu", "rpy_deg [180.0, 0.0, 0.0] in"),
        ("base_frd", ((0.0, 0.0, 0.0), (1, 0, 0, 0)), "frd", ""),
        ("base_footprint", ((0.0, 0.0, -0.4), (0, 0, 0, 1)), "flu", ""),
        ("imu_link", None, "flu", ""),
    ],
)
def test_poses_of_another_frame_are_named(
    child: str, mount: Any, axes: PoseAxes, said: str, tmp_path: Path
) -> None:
    """As /tf_static has it; where it has nothing to say, the poses are taken for the vehicle's."""
    links = [("base_link", "lidar", (0.0, 0.0, 2.0), (0, 0, 0, 1))]
    links += [("base_link", child, *mount)] if mount else []
    messages = [
        ("/odom", stamp_of(k), odometry(stamp_of(k), (k, 0, 0), child=child)) for k in range(5)
    ]
    static = ("/tf_static", stamp_of(0), tf(*links))
    path = write_bag(tmp_path / "drive", [*drive(5), *messages, static])
    lidars = {"front": lidar(FRONT)}
    recording = RosbagRecording(path, lidars, TopicsConfig(pose="/odom"), pose_axes=axes)

    motion = recording.motion()

    assert motion.poses is not None
    assert (motion.poses.frame is not None) == (child != "base_footprint")
    lines = [line for line in recording.warnings() if "of the frame" in line]
    assert len(lines) == bool(said)
    assert said in "".join(lines)
    if child == "camera_link" and said:
        assert "times T_camera_link_base_link from the right, xyz [-1.60, -0.10, -0.90]" in lines[0]


def test_an_odometry_may_tell_pose_and_velocity(tmp_path: Path) -> None:
    messages = [
        ("/odom", stamp_of(k), odometry(stamp_of(k), (k, 0, 0), velocity=(2, 0, 0)))
        for k in range(5)
    ]
    path = write_bag(tmp_path / "drive", [*drive(5), *messages])

    motion = opened(path, TopicsConfig(twist="/odom", pose="/odom")).motion()

    assert motion.poses is not None
    assert motion.twist is not None
    assert [T.x() for T in motion.poses.T_map_vehicle] == [0, 1, 2, 3, 4]
    assert motion.twist.velocity[:, 0].tolist() == [2] * 5


@pytest.mark.parametrize("kind", ["mcap", "ros1"])
def test_poses_from_tf(tmp_path: Path, kind: str) -> None:
    static = tf(("footprint", "base_link", (0, 0, 1), (0, 0, 0, 1)))
    messages: list[Recorded] = [("/tf_static", START - 5, static), *drive(5)]
    messages += [
        (
            "/tf",
            stamp_of(k),
            tf(("map", "footprint", (k, 0, 0), (0, 0, 0, 1)), stamp_ns=stamp_of(k)),
        )
        for k in range(5)
    ]
    recording = opened(write_bag(tmp_path / "drive", messages, kind), TopicsConfig(pose="/tf"))

    poses = recording.motion().poses

    assert poses is not None
    assert poses.stamps_ns.tolist() == [stamp_of(k) for k in range(5)]
    assert [T.translation().tolist() for T in poses.T_map_vehicle] == [[k, 0, 1] for k in range(5)]
    (line,) = recording.warnings()
    assert line.endswith("poses are those of the chain map -> footprint -> base_link")


def test_topics_looked_at_beside_those_of_the_config(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "drive", drive(5))

    recording = opened(path, also=["/imu/data", "/gnss/fix"])

    assert set(recording.clocks()) == {FRONT, "/imu/data", "/gnss/fix"}
    assert recording.frame_ids()["/imu/data"] == "imu_link"
    assert list(recording.imu_checks()) == ["/imu/data"]
    assert recording.gnss_fixes() == {"/gnss/fix": 5}
    assert recording.motion().imu is None


def test_a_bag_that_breaks_off_is_one_line(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "drive", drive(5))
    (file,) = path.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-100])

    with pytest.raises(RecordingError, match=r"drive\.mcap: the bag is cut off.* 'mcap recover'"):
        opened(path)


def test_poses_in_a_file_beside_the_bag(tmp_path: Path) -> None:
    write_bag(tmp_path / "drive", drive(4))
    rows = [f"{stamp_of(k) / 1e9:.9f} {k} 0 0 0 0 0 1" for k in range(4)]
    (tmp_path / "poses.tum").write_text("\n".join(rows))
    raw: dict[str, Any] = {
        "data": {"path": "drive", "poses": "poses.tum"},
        "topics": {"imu": "/imu/data"},
        "lidars": {"front": {"topic": FRONT, "initial": {"xyz": [0, 0, 0]}}},
    }

    motion = open_recording(parse_config(raw, "config.yaml", tmp_path)).motion()

    assert motion.imu is not None
    assert motion.poses is not None
    assert [pose.x() for pose in motion.poses.T_map_vehicle] == [0, 1, 2, 3]
    raw["topics"] = {"pose": "/odom"}
    with pytest.raises(ConfigError, match=r"give data\.poses or topics\.pose, not both"):
        parse_config(raw, "config.yaml", tmp_path)
