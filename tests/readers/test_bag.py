from __future__ import annotations

import shutil
import sqlite3
import struct
from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from caliv_graph.errors import RecordingError
from caliv_graph.readers.bag import Bag, DamagedMessageError, is_bag
from tests.readers.bags import KINDS, SECOND, START, cloud, header, imu, serialise, write_bag

IMU = "sensor_msgs/msg/Imu"


def messages(count: int = 40) -> list[tuple[str, int, dict[str, object]]]:
    out = []
    for k in range(count):
        stamp = START + k * SECOND // 10
        out.append(("/imu", stamp + 1000, imu(stamp)))
        out.append(("/points", stamp + 2000, cloud(stamp, [[k, 1, 2]] * 100)))
    return out


def file_of(bag: Path) -> Path:
    if bag.is_file():
        return bag
    return next(entry for entry in bag.iterdir() if entry.suffix in (".mcap", ".db3"))


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_bag(tmp_path: Path, kind: str) -> None:
    path = write_bag(tmp_path / "drive", messages(), kind)

    bag = Bag(path)

    assert is_bag(path)
    assert bag.name == str(path)
    assert [(t.name, t.type, t.messages) for t in bag.topics.values()] == [
        ("/imu", IMU, 40),
        ("/points", "sensor_msgs/msg/PointCloud2", 40),
    ]
    # The span includes the last message, or ends just before it is over.
    assert bag.span_ns[0] == START + 1000
    assert 0 <= bag.span_ns[1] - (START + 39 * SECOND // 10 + 2000) <= 1
    found = list(bag.messages(["/imu"]))
    assert [record for _, record, _ in found] == [
        START + k * SECOND // 10 + 1000 for k in range(40)
    ]
    stamps = [bag.header(raw).stamp_ns for _, _, raw in found]
    assert stamps == [START + k * SECOND // 10 for k in range(40)]
    assert bag.header(found[0][2]).frame_id == "imu_link"
    assert bag.decode("/imu", found[0][2]).linear_acceleration.z == 9.81


@pytest.mark.parametrize("kind", KINDS)
def test_a_window_of_time(tmp_path: Path, kind: str) -> None:
    bag = Bag(write_bag(tmp_path / "drive", messages(), kind))
    start = START + SECOND + 1000

    found = list(bag.messages(["/imu", "/points"], start, start + SECOND // 10 + 1))

    assert [(topic, record - start) for topic, record, _ in found] == [
        ("/imu", 0),
        ("/points", 1000),
        ("/imu", SECOND // 10),
    ]
    assert list(bag.messages(["/imu"], START + 100 * SECOND, START + 200 * SECOND)) == []
    assert list(bag.messages([])) == []


@pytest.mark.parametrize("kind", KINDS)
def test_two_passes_at_the_same_time(tmp_path: Path, kind: str) -> None:
    bag = Bag(write_bag(tmp_path / "drive", messages(), kind))

    both = zip(bag.messages(["/imu"]), bag.messages(["/points"]), strict=True)

    assert all(b[1] - a[1] == 1000 for a, b in both)


def test_a_pass_that_is_broken_off_leaves_the_bag_usable(tmp_path: Path) -> None:
    bag = Bag(write_bag(tmp_path / "drive", messages(), "mcap-zstd"))

    for _ in bag.messages(["/imu"]):
        break

    assert len(list(bag.messages(["/imu"]))) == 40


def test_a_bare_file_and_a_folder_without_its_description(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "drive", messages(), "mcap")

    assert Bag(file_of(path)).topics["/imu"].messages == 40
    (path / "metadata.yaml").unlink()
    assert is_bag(path)
    assert Bag(path).topics["/imu"].messages == 40


def test_the_parts_of_a_split_bag_are_read_in_the_order_of_time(tmp_path: Path) -> None:
    every = messages()
    folder = tmp_path / "split"
    folder.mkdir()
    write_bag(folder / "b", every[:40], "ros1")
    write_bag(folder / "a", every[40:], "ros1")

    bag = Bag(folder)

    assert bag.topics["/imu"].messages == 40
    records = [record for _, record, _ in bag.messages(["/imu"])]
    assert records == sorted(records)
    assert len(records) == 40


def test_quality_of_service_in_the_description_does_not_hide_messages(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "drive", messages(), "mcap")
    text = (path / "metadata.yaml").read_text()
    qos = (
        "offered_qos_profiles: [{history: keep_last, depth: 5, reliability: reliable, durability: "
        "volatile, deadline: {sec: 0, nsec: 0}, lifespan: {sec: 0, nsec: 0}, "
        "liveliness: automatic, "
        "liveliness_lease_duration: {sec: 0, nsec: 0}, avoid_ros_namespace_conventions: false}]"
    )
    assert "offered_qos_profiles: []" in text
    (path / "metadata.yaml").write_text(text.replace("offered_qos_profiles: []", qos))

    assert len(list(Bag(path).messages(["/imu"]))) == 40


@pytest.mark.parametrize("kind", ["mcap", "mcap-zstd", "sqlite3", "ros1"])
@pytest.mark.parametrize("part", [0.0, 0.001, 0.3, 0.9])
def test_a_bag_that_is_cut_off(tmp_path: Path, kind: str, part: float) -> None:
    path = write_bag(tmp_path / "drive", messages(), kind)
    file = file_of(path)
    data = file.read_bytes()
    file.write_bytes(data[: int(part * len(data))])

    with pytest.raises(RecordingError) as caught:
        list(Bag(path).messages(["/points"]))

    assert str(caught.value).startswith(f"{file}: the bag is cut off, damaged or of an unsupported")
    assert "\n" not in str(caught.value)
    assert "ecord" in str(caught.value)  # or recover


@pytest.mark.parametrize("suffix", [".mcap", ".bag", ".db3"])
@pytest.mark.parametrize("content", [b"data:\n  path: drive\n", b"\xff\x00\x01", b"x"])
def test_a_file_of_another_kind_is_not_called_damaged(
    tmp_path: Path, suffix: str, content: bytes
) -> None:
    file = tmp_path / f"drive{suffix}"
    file.write_bytes(content)
    with pytest.raises(RecordingError) as caught:
        Bag(file)
    assert f"{file}: is not a" in str(caught.value)
    assert "it begins with b" in str(caught.value)
    assert "recover" not in str(caught.value)


def test_damage_in_the_middle_is_told_when_it_is_come_upon(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "drive", messages(), "mcap-zstd")
    file = file_of(path)
    data = bytearray(file.read_bytes())
    data[len(data) // 4 : len(data) // 2] = bytes(len(data) // 2 - len(data) // 4)
    file.write_bytes(data)

    bag = Bag(path)

    with pytest.raises(RecordingError, match=r"drive\.mcap: the bag is cut off, damaged"):
        list(bag.messages(["/points"]))


def test_what_is_no_bag(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"nowhere: no such file or folder"):
        Bag(tmp_path / "nowhere")
    (tmp_path / "text.txt").touch()
    with pytest.raises(RecordingError, match=r"text\.txt: is not a bag by its name"):
        Bag(tmp_path / "text.txt")
    (tmp_path / "drive.mcap.zst").touch()
    with pytest.raises(RecordingError, match="Unpack it first"):
        Bag(tmp_path / "drive.mcap.zst")
    (tmp_path / "caliv/input").mkdir(parents=True)
    with pytest.raises(RecordingError, match=r"holds no bag .* set data\.format: caliv"):
        Bag(tmp_path / "caliv")
    assert not is_bag(tmp_path / "caliv")


def test_bags_of_two_kinds_in_one_folder(tmp_path: Path) -> None:
    (tmp_path / "a.bag").touch()
    (tmp_path / "b.mcap").touch()

    with pytest.raises(RecordingError, match=r"several kinds \(a\.bag, b\.mcap\)"):
        Bag(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [", "is not the description of a ROS 2 bag"),
        ("[]", "is not the description of a ROS 2 bag"),
        (
            "rosbag2_bagfile_information: {relative_file_paths: [gone.mcap]}",
            "names the file 'gone.mcap', which is not there",
        ),
    ],
)
def test_a_damaged_description(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "metadata.yaml").write_text(text)

    with pytest.raises(RecordingError, match=message):
        Bag(tmp_path)


def test_a_topic_of_two_types(tmp_path: Path) -> None:
    folder = tmp_path / "both"
    folder.mkdir()
    for name, message in (("a", imu(START)), ("b", cloud(START, [[1, 2, 3]]))):
        part = write_bag(tmp_path / name, [("/x", START, message)], "mcap")
        shutil.move(file_of(part), folder / f"{name}.mcap")

    with pytest.raises(RecordingError, match="'/x' holds messages of two types"):
        Bag(folder)


def test_headers_of_either_endianness_and_of_damaged_messages(tmp_path: Path) -> None:
    bag = Bag(write_bag(tmp_path / "drive", messages(1)))
    raw = serialise(imu(START + 5, frame_id="a frame"), little_endian=False)

    assert bag.header(raw).stamp_ns == START + 5
    assert bag.header(raw).frame_id == "a frame"
    for size in (0, 1, 3, 4, 15, 17):
        with pytest.raises(DamagedMessageError):
            bag.header(raw[:size])
    with pytest.raises(DamagedMessageError):
        bag.decode("/imu", raw[:60])


@pytest.mark.parametrize("whole", [False, True])
def test_types_that_the_bag_defines_in_idl(tmp_path: Path, whole: bool) -> None:
    idl = "module ours { module msg { struct Value { double x; unsigned short y; }; }; };"
    text = f"{'=' * 80}\nIDL: ours/msg/Value\n{idl}" if whole else idl
    with Writer(tmp_path / "drive", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        # Without the rule the writer takes it for the other language; the file says which it is.
        topic = writer.add_connection("/v", "ours/msg/Value", msgdef=text, rihs01="0")
        writer.write(topic, START, b"\0\1\0\0" + struct.pack("<dH", 2.5, 7))
    if not whole:
        file = file_of(tmp_path / "drive")
        file.write_bytes(file.read_bytes().replace(b"ros2msg", b"ros2idl"))

    bag = Bag(tmp_path / "drive")

    ((_, _, raw),) = bag.messages(["/v"])
    value = bag.decode("/v", raw)
    assert (value.x, value.y) == (2.5, 7)


def test_types_without_a_definition_in_the_bag(tmp_path: Path) -> None:
    ours = {"_type": "livox_ros_driver2/msg/CustomMsg", "header": header(START)}
    path = write_bag(tmp_path / "drive", [*messages(1), ("/livox", START, ours)], "sqlite3")
    with sqlite3.connect(file_of(path)) as database:
        database.execute("DELETE FROM message_definitions")
    database.close()

    bag = Bag(path)

    # Standard types are known without.
    (raw,) = (raw for _, _, raw in bag.messages(["/imu"]))
    assert bag.decode("/imu", raw).linear_acceleration.z == 9.81
    with pytest.raises(RecordingError, match="holds no definition of the type livox_ros_driver2"):
        bag.decode("/livox", serialise(ours))


def test_a_standard_type_with_a_damaged_definition(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "drive", messages(1), "ros1")
    data = path.read_bytes()
    assert data.count(b"uint32 point_step") >= 1
    path.write_bytes(data.replace(b"uint32 point_step", b"uint32 point_stop"))

    bag = Bag(path)

    (raw,) = (raw for _, _, raw in bag.messages(["/points"]))
    assert bag.decode("/points", raw).point_step == 12


@pytest.mark.parametrize("kind", ["mcap", "ros1"])
def test_a_damaged_definition_of_another_topic(tmp_path: Path, kind: str) -> None:
    """`rosbags.highlevel.AnyReader` refuses the whole bag."""
    file = file_of(write_bag(tmp_path / "drive", messages(2), kind))
    data = file.read_bytes()
    assert data.count(b"uint32 point_step") >= 1
    file.write_bytes(data.replace(b"uint32 point_step", b"uint32 point{step"))

    bag = Bag(file)

    for topic, _, raw in bag.messages(["/imu", "/points"]):
        assert bag.decode(topic, raw).header.frame_id


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("UPDATE topics SET name = x'00'", "a topic is b'"),
        ("UPDATE topics SET type = x'ff00'", "of type b'"),
        ("UPDATE messages SET timestamp = 'noon'", "'str'"),
        ("UPDATE messages SET timestamp = 9223372036854775807", "recorded at 9223372036854775807"),
        ("UPDATE messages SET timestamp = -1", "was recorded at -1"),
        ("UPDATE messages SET timestamp = 1.5", "was recorded at 1.5"),
        ("UPDATE messages SET data = 'text'", "a message of /imu is not bytes"),
    ],
)
def test_values_that_no_bag_can_have(tmp_path: Path, change: str, said: str) -> None:
    """SQLite keeps a value of any type in a column of any other."""
    path = file_of(write_bag(tmp_path / "drive", messages(4), "sqlite3"))
    with sqlite3.connect(path) as database:
        database.execute(change)
    database.close()

    with pytest.raises(RecordingError, match="damaged") as caught:
        list(Bag(path).messages(["/imu"]))

    assert said in str(caught.value)


def test_two_topics_of_one_number(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "drive", messages(4), "ros1")
    data = path.read_bytes()
    first, other = (b"conn=" + struct.pack("<I", number) for number in (0, 1))
    assert first in data
    assert other in data
    path.write_bytes(data.replace(other, first))

    said = ""
    for topic in ("/imu", "/points"):
        try:
            assert {name for name, _, _ in Bag(path).messages([topic])} <= {topic}
        except RecordingError as e:
            said += str(e)
    assert "has the number of another topic" in said


@pytest.mark.parametrize("kind", ["mcap", "mcap-file", "mcap-message", "sqlite3"])
def test_the_folder_of_a_ros_2_bag_may_be_called_as_a_ros_1_bag(kind: str, tmp_path: Path) -> None:
    named = write_bag(tmp_path / "drive", messages(), kind).rename(tmp_path / "drive.bag")
    bag = Bag(named)
    assert not bag.is_ros1
    assert len(list(bag.messages(bag.topics))) == len(list(messages()))
