from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caliv_graph.errors import RecordingError
from caliv_graph.products import Array
from caliv_graph.readers.bag import Bag
from caliv_graph.readers.discover import choose_lidar_topics
from caliv_graph.readers.velodyne_packets import MODELS, decode_velodyne
from tests.readers.bags import START, Message, as_object, cloud, header, write_bag
from tests.readers.test_rosbag import opened

RATE_DEG_S = 3600.0
WALL_M = 10.0
HOUR_NS = 3600 * 10**9

VLP16, VLP32C, HDL32E = 0x22, 0x28, 0x21


def shot_us(number: int, block: int, shot: int) -> float:
    """Microseconds after the packet's first shot, by the table of the manual of each LiDAR."""
    if number == VLP16:  # 24 sequences of 16 shots
        return 55.296 * (2 * block + shot // 16) + 2.304 * (shot % 16)
    if number == VLP32C:  # 12 sequences of 16 pairs
        return 55.296 * block + 2.304 * (shot // 2)
    return 46.08 * block + 1.152 * shot


def scan(
    number: int,
    packets: int,
    dual: bool = False,
    late_ns: int = 0,
    stamp_of: int = -1,
    begin_ns: int = START,
) -> tuple[Message, Array]:
    """A VelodyneScan that turns at 10 Hz in front of a wall at x = 10 m, and the true times (N,).

    Each packet is stamped `late_ns` after its first shot; the scan with that of one packet.
    """
    model, out, times_s = MODELS[number], [], []
    step = 2 if dual else 1
    duration_us = 12 // step * shot_us(number, 1, 0)
    for p in range(packets):
        first_us = p * duration_us
        body = b""
        for b in range(12):
            block_us = first_us + shot_us(number, b // step, 0)
            body += struct.pack("<HH", 0xEEFF, round(RATE_DEG_S * block_us * 1e-4) % 36000)
            for k in range(32):
                us = first_us + shot_us(number, b // step, k)
                laser = k % model.lasers
                azimuth = np.radians(RATE_DEG_S * us * 1e-6 + model.azimuth_deg[laser])
                elevation = np.radians(model.elevation_deg[laser])
                # The earlier of two returns: a leaf at half the way.
                half = 2.0 if dual and b % 2 else 1.0
                hit = WALL_M / (np.cos(elevation) * np.cos(azimuth)) / half
                visible = 0.0 < hit < 60.0
                body += struct.pack("<HB", round(hit / model.range_m) if visible else 0, 9)
                if visible and half == 1.0:
                    times_s.append(us * 1e-6)
        at_ns = begin_ns + round(first_us * 1000)
        tail = struct.pack(
            "<IBB", at_ns // 1000 % (HOUR_NS // 1000), 0x39 if dual else 0x37, number
        )
        stamp = header(at_ns + late_ns)["stamp"]
        out.append({"stamp": stamp, "data": np.frombuffer(body + tail, np.uint8)})
    stamp = out[stamp_of]["stamp"]
    message: Message = {
        "_type": "velodyne_msgs/msg/VelodyneScan",
        "header": {"stamp": stamp, "frame_id": "velodyne"},
        "packets": out,
    }
    return message, np.array(times_s)


def stamp_ns(message: Message) -> int:
    stamp = message["header"]["stamp"]
    return int(stamp["sec"]) * 10**9 + int(stamp["nanosec"])


@pytest.mark.parametrize("dual", [False, True])
@pytest.mark.parametrize("number", [VLP16, VLP32C, HDL32E])
def test_a_wall_is_flat_and_each_point_has_its_time(number: int, dual: bool) -> None:
    message, times_s = scan(number, 6, dual)
    at_ns = stamp_ns(message)

    found = decode_velodyne(as_object(message), at_ns, 1.0, 100.0)

    # Ranges are rounded to 2 or 4 mm, azimuths to 0.01 degrees.
    np.testing.assert_allclose(found.points_lidar[:, 0], WALL_M, atol=5e-3)
    assert found.times_s is not None
    # The stamp is that of the last packet; the packets' clock counts whole microseconds.
    np.testing.assert_allclose(found.times_s + (at_ns - START) * 1e-9, times_s, atol=1.1e-6)
    assert found.times_s.max() > 0.0 > found.times_s.min()


def test_the_first_shots_of_a_vlp16_by_hand() -> None:
    message, _ = scan(VLP16, 1)

    points = decode_velodyne(as_object(message), stamp_ns(message), 1.0, 100.0).points_lidar

    # -15 degrees at azimuth 0: 10 / cos 15 = 10.353 m; the laser sits 11.2 mm above the origin.
    np.testing.assert_allclose(points[0], [10.0, 0.0, -2.6795 + 0.0112], atol=1.5e-3)
    # 1 degree, 2.304 us later: 0.0083 degrees clockwise, to the right.
    np.testing.assert_allclose(points[1], [10.0, -0.00145, 0.1746 - 0.0007], atol=1.5e-3)
    # The last shot of the packet: 23 sequences and 15 shots later, 4.70 degrees to the right.
    np.testing.assert_allclose(points[-1, 1], -10.0 * np.tan(np.radians(4.7029)), atol=3e-3)


@pytest.mark.parametrize(
    ("stamp_of", "late_ns", "begin_ns"),
    [
        (0, 0, START),  # stamped with its first packet, by the LiDAR's own clock
        (-1, 0, START),
        (0, 1_327_104, START + 777_777),  # received when the packet was complete
        (
            -1,
            0,
            1_700_002_799_999_000_000 // HOUR_NS * HOUR_NS + HOUR_NS - 2_000_000,
        ),  # an hour ends
    ],
)
def test_the_packets_clock_is_anchored_at_the_stamp(
    stamp_of: int, late_ns: int, begin_ns: int
) -> None:
    message, times_s = scan(VLP16, 4, stamp_of=stamp_of, late_ns=late_ns, begin_ns=begin_ns)
    at_ns = stamp_ns(message)

    if late_ns:  # a clock of the hour that is not the computer's
        for packet in message["packets"]:
            tail = bytes(packet["data"][1200:1204])
            own = (struct.unpack("<I", tail)[0] + 123_456_789) % (HOUR_NS // 1000)
            body = bytes(packet["data"])
            packet["data"] = np.frombuffer(
                body[:1200] + struct.pack("<I", own) + body[1204:], np.uint8
            )

    found = decode_velodyne(as_object(message), at_ns, 1.0, 100.0)

    assert found.times_s is not None
    np.testing.assert_allclose(found.times_s + (at_ns - begin_ns) * 1e-9, times_s, atol=2.1e-6)


@pytest.mark.parametrize("kind", ["mcap", "sqlite3", "ros1"])
def test_a_bag_of_packets(tmp_path: Path, kind: str) -> None:
    messages = []
    for k in range(5):
        message, _ = scan(VLP16, 3, begin_ns=START + k * 100_000_000)
        messages.append(("/velodyne_packets", START + (k + 1) * 100_000_000, message))
    bag = write_bag(tmp_path / "drive", messages, kind)

    assert choose_lidar_topics(Bag(bag)).chosen == {"velodyne": "/velodyne_packets"}
    recording = opened(bag, top="/velodyne_packets")

    scans = list(recording.scans("top"))
    assert len(scans) == 5
    assert all(scan.point_times_s is not None for scan in scans)
    np.testing.assert_allclose(scans[3].points_lidar[:, 0], WALL_M, atol=3e-3)
    # The packets' own times need no assumption about the stamp.
    assert recording.warnings() == []
    assert recording.stamp_mark("top").told_by == "times"


def test_packets_beside_their_cloud_are_not_a_second_lidar(tmp_path: Path) -> None:
    message, _ = scan(VLP16, 1)
    points = cloud(START, np.ones((3, 3)), frame_id="velodyne")
    messages = [("/velodyne_packets", START, message), ("/velodyne_points", START + 1, points)]

    topics = choose_lidar_topics(Bag(write_bag(tmp_path / "drive", messages)))

    assert list(topics.chosen.values()) == ["/velodyne_points"]
    assert topics.others["/velodyne_packets"] == "packets of a cloud that is there"


def changed(byte: int, value: int, packet: int = 0) -> Message:
    message, _ = scan(VLP16, 2)
    data = message["packets"][packet]["data"].copy()
    data[byte] = value
    message["packets"][packet]["data"] = data
    return message


@pytest.mark.parametrize(
    ("message", "text"),
    [
        (changed(1205, 0xA1), "model 0xa1; known are VLP-16"),
        (changed(1, 0xDD), "HDL-64E need the calibration of that very LiDAR"),
    ],
)
def test_what_cannot_be_decoded_names_the_node(tmp_path: Path, message: Any, text: str) -> None:
    bag = write_bag(tmp_path / "drive", [("/velodyne_packets", START, message)])

    with pytest.raises(RecordingError, match=text) as error:
        list(opened(bag, top="/velodyne_packets").scans("top"))
    assert "velodyne_pointcloud" in str(error.value)


def test_a_damaged_packet_is_left_out(tmp_path: Path) -> None:
    good, _ = scan(VLP16, 2, begin_ns=START + 100_000_000)
    messages = [
        ("/velodyne_packets", START, changed(0, 0, packet=1)),
        ("/velodyne_packets", START + 1, good),
    ]
    recording = opened(write_bag(tmp_path / "drive", messages), top="/velodyne_packets")

    assert len(list(recording.scans("top"))) == 1
    assert any("without the flag of a Velodyne" in line for line in recording.warnings())


@pytest.mark.parametrize(
    ("type_name", "node"),
    [
        ("hesai_lidar/msg/PandarScan", "hesai_ros_driver_node"),
        ("pandar_msgs/msg/PandarScan", "hesai_ros_wrapper_node"),
        ("nebula_hesai_msgs/msg/HesaiScan", "hesai_ros_wrapper_node"),
        ("hesai_ros_driver/msg/UdpFrame", "hesai_ros_driver_node"),
        ("robosense_msgs/msg/RobosenseScan", "rslidar_sdk_node"),
        ("rslidar_msg/msg/RslidarPacket", "rslidar_sdk_node"),
        ("ouster_sensor_msgs/msg/PacketMsg", "os_cloud"),
    ],
)
def test_packets_of_others_are_refused_with_the_node_that_decodes_them(
    tmp_path: Path, type_name: str, node: str
) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("std_msgs/Header header\nuint8[] data\n", type_name))
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=1, nanosec=0)
    head = types["std_msgs/msg/Header"](stamp=stamp, frame_id="a")
    message = types[type_name](header=head, data=np.zeros(4, np.uint8))
    with Writer(tmp_path / "drive", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/packets", type_name, typestore=store)
        writer.write(connection, START, store.serialize_cdr(message, type_name))

    with pytest.raises(RecordingError, match=node):
        opened(tmp_path / "drive", top="/packets")
    with pytest.raises(RecordingError, match=node):
        choose_lidar_topics(Bag(tmp_path / "drive"))
