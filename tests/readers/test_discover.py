from __future__ import annotations

from pathlib import Path

import pytest

from caliv_graph.errors import RecordingError
from caliv_graph.readers.bag import Bag
from caliv_graph.readers.discover import (
    choose_lidar_topics,
    choose_motion_topics,
    is_recorded_bag,
    lidar_names,
    open_all,
)
from tests.readers.bags import (
    SECOND,
    START,
    Message,
    cloud,
    fix,
    header,
    imu,
    livox,
    odometry,
    tf,
    twist,
    write_bag,
)

POINT = [[1, 2, 3]]


def bag_of(tmp_path: Path, *messages: tuple[str, Message]) -> Bag:
    return Bag(write_bag(tmp_path / "bag", [(topic, START, m) for topic, m in messages]))


@pytest.mark.parametrize(
    ("topics", "names"),
    [
        (["/lidar/front/points", "/lidar/rear/points"], ["front", "rear"]),
        (["/velodyne_points"], ["velodyne"]),
        (["/points_raw"], ["lidar"]),
        (
            ["/sensing/lidar/top/pointcloud_raw", "/sensing/lidar/left/pointcloud_raw"],
            ["top", "left"],
        ),
        (["/ouster/points", "/livox/lidar"], ["ouster", "livox"]),
        (["/vehicle/hesai/front/points", "/vehicle/hesai/rear/points"], ["front", "rear"]),
        (["/os1/points", "/os1/points_raw"], ["os1", "os1_2"]),
        (["/front_lidar/points", "/rear_lidar/points"], ["front", "rear"]),
        (["/livox/lidar_3WEDH7", "/livox/lidar_3WEDJ1"], ["3WEDH7", "3WEDJ1"]),
        (["/a/points", "/a/b/points"], ["a", "b"]),
    ],
)
def test_names_of_lidars(topics: list[str], names: list[str]) -> None:
    assert lidar_names(topics) == dict(zip(names, topics, strict=True))


def test_clouds_that_are_no_lidars_own(tmp_path: Path) -> None:
    bag = bag_of(
        tmp_path,
        ("/lidar/front/points", cloud(START, POINT, frame_id="/front")),
        ("/lidar/front/points_v2", cloud(START, POINT, frame_id="front")),
        ("/lidar/rear", livox(START, POINT, [0], frame_id="rear")),
        ("/lidar/concatenated/points", cloud(START, POINT, frame_id="base_link")),
        ("/camera/depth/points", cloud(START, POINT, frame_id="camera")),
    )

    topics = choose_lidar_topics(bag)

    assert topics.chosen == {"front": "/lidar/front/points", "rear": "/lidar/rear"}
    assert topics.frame_ids == {"front": "front", "rear": "rear"}
    assert topics.others["/lidar/front/points_v2"] == "of the same frame as /lidar/front/points"
    assert set(topics.others) == {
        "/lidar/front/points_v2",
        "/lidar/concatenated/points",
        "/camera/depth/points",
    }


def test_lidars_that_were_given_the_same_frame(tmp_path: Path) -> None:
    bag = bag_of(
        tmp_path,
        ("/livox/lidar_a", livox(START, POINT, [0], frame_id="livox_frame")),
        ("/livox/lidar_b", livox(START, POINT, [0], frame_id="livox_frame")),
    )

    assert choose_lidar_topics(bag).chosen == {"a": "/livox/lidar_a", "b": "/livox/lidar_b"}


def test_clouds_with_odd_names_are_better_than_none(tmp_path: Path) -> None:
    bag = bag_of(tmp_path, ("/filtered_points", cloud(START, POINT)))
    assert choose_lidar_topics(bag).chosen == {"filtered": "/filtered_points"}


def test_a_bag_without_clouds(tmp_path: Path) -> None:
    bag = bag_of(tmp_path, ("/imu", imu(START)))
    with pytest.raises(
        RecordingError, match=r"has no clouds .* It has: /imu \(sensor_msgs/msg/Imu"
    ):
        choose_lidar_topics(bag)


def test_raw_sensors_are_preferred_to_poses(tmp_path: Path) -> None:
    bag = bag_of(
        tmp_path,
        ("/livox/imu", imu(START)),
        ("/imu/data_raw", imu(START)),
        ("/imu/data", imu(START)),
        ("/fix", fix(START)),
        ("/cmd_vel", twist(START, (1, 0, 0))),
        ("/vehicle/twist", twist(START, (1, 0, 0))),
        ("/odom", odometry(START, (0, 0, 0))),
    )

    topics = choose_motion_topics(bag)

    assert topics.chosen == {"imu": "/imu/data", "gnss": "/fix", "twist": "/vehicle/twist"}
    assert topics.others["imu"] == ("/imu/data_raw", "/livox/imu")
    assert topics.others["pose"] == ("/odom",)
    assert topics.others["twist"] == ("/odom",)


def test_without_an_imu_gnss_and_wheels_are_preferred_to_poses_that_drift(tmp_path: Path) -> None:
    drifting = odometry(START, (0, 0, 0)) | {"header": header(START, "odom")}
    wheels = [("/fix", fix(START)), ("/gnss/velocity", twist(START, (1, 0, 0)))]
    bag = bag_of(tmp_path / "wheels", *wheels, ("/odom", drifting))
    topics = choose_motion_topics(bag)
    assert topics.chosen == {"gnss": "/fix", "twist": "/odom"}
    assert topics.others["pose"] == ("/odom",)

    located = odometry(START, (0, 0, 0)) | {"header": header(START, "map")}
    bag = bag_of(tmp_path / "located", *wheels, ("/odom", drifting), ("/state", located))
    assert choose_motion_topics(bag).chosen == {"pose": "/state"}


def test_headings_are_known_by_type_and_name(tmp_path: Path) -> None:
    turn = {"_type": "geometry_msgs/msg/QuaternionStamped", "header": header(START, "gnss")}
    sensors = [("/imu", imu(START)), ("/fix", fix(START))]
    bag = bag_of(tmp_path / "a", *sensors, ("/heading", turn), ("/attitude", turn))
    assert choose_motion_topics(bag).chosen == {
        "imu": "/imu",
        "gnss": "/fix",
        "heading": "/heading",
    }

    bag = bag_of(tmp_path / "b", *sensors, ("/a/navheading", imu(START)))
    topics = choose_motion_topics(bag)
    assert topics.chosen == {"imu": "/imu", "gnss": "/fix", "heading": "/a/navheading"}
    assert topics.others["imu"] == ()


def test_poses_where_imu_or_gnss_is_missing(tmp_path: Path) -> None:
    link = ("odom", "base_link", (0, 0, 0), (0, 0, 0, 1))
    other = ("base_link", "wheel", (0, 0, 0), (0, 0, 0, 1))
    bag = bag_of(
        tmp_path,
        ("/imu", imu(START)),
        ("/tf", tf(other)),
        ("/tf", tf(link)),
        ("/tf_static", tf(link)),
    )

    topics = choose_motion_topics(bag)

    assert topics.chosen == {"pose": "/tf"}
    assert topics.others["imu"] == ("/imu",)


def test_transforms_that_do_not_move_the_vehicle_are_no_poses(tmp_path: Path) -> None:
    bag = bag_of(tmp_path, ("/tf", tf(("base_link", "wheel", (0, 0, 0), (0, 0, 0, 1)))))
    assert choose_motion_topics(bag).chosen == {}


def test_all_of_a_bag(tmp_path: Path) -> None:
    messages = [
        (topic, START + k * SECOND, message)
        for k in range(3)
        for topic, message in (
            ("/lidar/front/points", cloud(START + k * SECOND, [[0.1, 0, 0], [900, 0, 0]])),
            ("/imu", imu(START + k * SECOND)),
            ("/other/imu", imu(START + k * SECOND)),
        )
    ]
    path = write_bag(tmp_path / "bag", messages)

    recording = open_all(path)

    assert is_recorded_bag(path)
    assert recording.lidars == ("front",)
    # All ranges: of the vehicle's own body, too.
    assert [len(scan.points_lidar) for scan in recording.scans("front")] == [2, 2, 2]
    assert recording.motion().imu is not None


def test_what_is_neither(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("lidars: {}")
    (tmp_path / "notes.txt").write_text("rain")
    (tmp_path / "empty").mkdir()
    bag = write_bag(tmp_path / "day/drive", [("/p", START, cloud(START, [[1, 2, 3]]))])

    for name, said in {
        "nowhere": r"nowhere: no such file or folder\. Give a bag",
        "nowhere.bag": r"nowhere\.bag: no such file or folder\. Give a bag",
        "config.yaml": "a YAML file, not a drive. Give the drive itself, which data.path",
        "notes.txt": "is not a bag",
        "empty": "holds neither a bag",
        "day": f"holds drives. Give {bag}",
    }.items():
        for read in (is_recorded_bag, open_all):
            with pytest.raises(RecordingError, match=said):
                read(tmp_path / name)
