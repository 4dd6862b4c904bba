from __future__ import annotations

import gc
import math
import warnings
import weakref
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
import yaml

from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config
from caliv_graph.errors import ConfigError, RecordingError
from caliv_graph.products import Array, GivenPoses, LidarScan, Recording
from caliv_graph.readers import open_recording
from caliv_graph.readers.ahead import AHEAD
from caliv_graph.readers.caliv_folder import CalivFolder
from caliv_graph.readers.pcd import read_pcd

AUTHORS_DRIVE = Path(__file__).resolve().parents[2].parent / "shared/data/caliv_released"

IDENTITY = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]


def write_cloud(path: Path, points: Sequence[Sequence[float]] = ((3.0, 4.0, 0.0),)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(
        f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {len(points)}\nDATA binary\n".encode()
        + np.array(points, dtype="<f4").tobytes()
    )


def write_drive(
    folder: Path,
    poses: Mapping[str, Any],
    clouds: Mapping[str, Sequence[int]] | None = None,
) -> Path:
    """A CaLiV folder; without `clouds`, every pose has one."""
    if clouds is None:
        clouds = {
            sensor: [int(file.removesuffix(".pcd")) for file, _ in entries]
            for sensor, entries in poses.items()
        }
    (folder / "input").mkdir(parents=True)
    (folder / "input/ego_poses.yaml").write_text(yaml.safe_dump(dict(poses)))
    for sensor, frames in clouds.items():
        (folder / "input" / sensor).mkdir()
        for frame in frames:
            write_cloud(folder / "input" / sensor / f"{frame}.pcd")
    return folder


def config_of(lidars: Mapping[str, str], **changed: Any) -> Config:
    raw = {
        "data": {"format": "caliv", "path": "drive"},
        "lidars": {
            name: {"topic": topic, "initial": {"xyz": [0, 0, 2]}, **changed}
            for name, topic in lidars.items()
        },
    }
    return parse_config(raw, "config.yaml", Path("/nowhere"))


def open_drive(path: Path, lidars: Mapping[str, str] | None = None, **changed: Any) -> Recording:
    config = config_of({"front": "sensor_1"} if lidars is None else lidars, **changed)
    return open_recording(config, path)


def poses_of(recording: Recording) -> GivenPoses:
    poses = recording.motion().poses
    assert poses is not None
    return poses


def read_all(recording: Recording) -> list[LidarScan]:
    return [scan for lidar in recording.lidars for scan in recording.scans(lidar)]


def error_of(path: Path, lidars: Mapping[str, str] | None = None) -> str:
    """What opening the drive and reading all of it says, in one line."""
    with pytest.raises(RecordingError) as caught:
        read_all(open_drive(path, lidars))
    message = str(caught.value)
    assert "\n" not in message
    return message


def entry(frame: int, pose: Sequence[float] = IDENTITY) -> list[Any]:
    return [f"{frame}.pcd", list(pose)]


def test_frames_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    """10 comes after 9, in clouds, stamps and poses, however the file lists them."""
    listed = [entry(k, [float(k), 0, 0, 0, 0, 0, 1]) for k in (10, 9, 100, 2)]
    recording = open_drive(write_drive(tmp_path, {"sensor_1": listed}))
    stamps = [200_000_000, 900_000_000, 1_000_000_000, 10_000_000_000]  # 0.1 s a frame
    assert list(recording.scan_stamps_ns("front")) == stamps
    assert [scan.stamp_ns for scan in recording.scans("front")] == stamps
    poses = poses_of(recording)
    assert poses.stamps_ns.dtype == np.int64
    assert poses.stamps_ns.tolist() == stamps
    assert [pose.x() for pose in poses.T_map_vehicle] == [2.0, 9.0, 10.0, 100.0]
    assert recording.warnings() == ()


def test_pose_is_xyz_and_quaternion_xyzw(tmp_path: Path) -> None:
    """Yaw by 90 degrees at (1, 2, 3): what is ahead of the vehicle lies along the map's y."""
    half = math.sqrt(0.5)
    drive = write_drive(tmp_path, {"sensor_1": [entry(0, [1, 2, 3, 0, 0, half, half])]})
    (T_map_vehicle,) = poses_of(open_drive(drive)).T_map_vehicle
    np.testing.assert_allclose(T_map_vehicle.transformFrom([5.0, 0.0, 0.0]), [1.0, 7.0, 3.0])


def test_scan_holds_what_the_file_holds(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, {"sensor_7": [entry(3)]})
    recording = open_drive(drive, {"roof": "sensor_7"})
    (scan,) = recording.scans("roof")
    assert scan.lidar == "roof"
    assert scan.source == str(drive / "input/sensor_7/3.pcd")
    assert scan.points_lidar.dtype == np.float64
    np.testing.assert_array_equal(scan.points_lidar, [[3.0, 4.0, 0.0]])
    assert recording.name == str(drive)


def test_the_input_folder_itself_will_do(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, {"sensor_1": [entry(3)]})
    assert list(open_drive(drive / "input").scan_stamps_ns("front")) == [300_000_000]


def test_ranges_and_non_returns_are_left_out(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, {"sensor_1": [entry(1)]})
    kept = [[0.0, 0.0, -2.0], [3.0, 4.0, 0.0]]
    dropped = [
        [0.0, 0.0, 0.0],
        [0.0, 1.99, 0.0],  # below min_range
        [3.0, 4.0, 0.1],  # above max_range
        [math.nan, 3.0, 3.0],
        [3.0, math.inf, 0.0],
        [-math.inf, math.inf, math.nan],
    ]
    write_cloud(drive / "input/sensor_1/1.pcd", [*dropped[:3], *kept, *dropped[3:]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (scan,) = open_drive(drive, min_range=2.0, max_range=5.0).scans("front")
    np.testing.assert_array_equal(scan.points_lidar, kept)
    (scan,) = open_drive(drive, min_range=0.0, max_range=5.0).scans("front")
    assert len(scan.points_lidar) == 3  # (0, 0, 0) is no return, however near is near enough


def test_ranges_are_each_lidars_own(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, {"sensor_1": [entry(1)], "sensor_2": [entry(1)]})
    lidars = config_of({"near": "sensor_1", "far": "sensor_2"}).lidars
    lidars = {**lidars, "far": lidars["far"].model_copy(update={"min_range": 6.0})}
    recording = CalivFolder(drive, lidars)
    assert [len(scan.points_lidar) for scan in recording.scans("near")] == [1]
    assert [len(scan.points_lidar) for scan in recording.scans("far")] == [0]


def test_scan_that_sees_nothing_is_a_scan(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, {"sensor_1": [entry(1)]})
    (scan,) = open_drive(drive, max_range=2.0).scans("front")
    assert scan.points_lidar.shape == (0, 3)


def test_sensors_that_the_config_does_not_name_are_not_looked_at(tmp_path: Path) -> None:
    poses = {"sensor_1": [entry(1)], "sensor_2": "nonsense", "sensor_3": [entry(2)]}
    drive = write_drive(tmp_path, poses, {"sensor_1": [1], "sensor_2": [5]})
    recording = open_drive(drive)
    assert recording.lidars == ("front",)
    assert poses_of(recording).stamps_ns.tolist() == [100_000_000]
    assert recording.warnings() == ()


def test_poses_are_those_of_any_lidar(tmp_path: Path) -> None:
    poses = {
        name: [entry(k) for k in frames]
        for name, frames in (("sensor_1", (1, 3)), ("sensor_2", (2, 3)), ("sensor_3", (7,)))
    }
    lidars = {"c": "sensor_3", "a": "sensor_1", "b": "sensor_2"}
    recording = open_drive(write_drive(tmp_path, poses), lidars)
    assert recording.lidars == ("c", "a", "b")
    assert (poses_of(recording).stamps_ns // 100_000_000).tolist() == [1, 2, 3, 7]
    assert len(poses_of(recording).T_map_vehicle) == 4


def test_poses_without_a_cloud_are_skipped_and_counted(tmp_path: Path) -> None:
    poses = {"sensor_1": [entry(k) for k in range(5)], "sensor_2": [entry(k) for k in range(5)]}
    drive = write_drive(tmp_path, poses, {"sensor_1": [1, 3], "sensor_2": [0, 1, 2, 3]})
    recording = open_drive(drive, {"front": "sensor_1", "rear": "sensor_2"})
    (warning,) = recording.warnings()
    assert "3 of sensor_1, 1 of sensor_2" in warning
    assert str(drive / "input/ego_poses.yaml") in warning
    assert (poses_of(recording).stamps_ns // 100_000_000).tolist() == [0, 1, 2, 3]
    assert len(list(recording.scans("front"))) == 2


@pytest.mark.parametrize("cores", [1, 2])
def test_only_a_few_clouds_are_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cores: int
) -> None:
    drive = write_drive(tmp_path, {"sensor_1": [entry(k) for k in range(20)]})
    handed: list[weakref.ref[Array]] = []
    read: list[Path] = []

    def read_watched(path: Path) -> Array:
        read.append(path)
        return read_pcd(path)

    monkeypatch.setattr("caliv_graph.readers.ahead.cores", lambda: cores)
    monkeypatch.setattr("caliv_graph.readers.caliv_folder.read_pcd", read_watched)
    scans = open_drive(drive).scans("front")
    assert read == []  # nothing is read before it is asked for
    for _ in range(20):
        handed.append(weakref.ref(next(scans).points_lidar))
        gc.collect()
        assert handed[-1]() is None  # nobody but the caller holds on to it
        assert len(read) <= len(handed) + (AHEAD if cores > 1 else 0)
    assert next(scans, None) is None
    assert len(read) == 20  # nothing is read twice


def test_foreign_files_beside_the_clouds(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, {"sensor_1": [entry(1)]})
    for name in ("notes.txt", "._1.pcd", "1.pcd.part"):
        (drive / "input/sensor_1" / name).write_bytes(b"")
    assert len(list(open_drive(drive).scans("front"))) == 1


def test_zero_padded_names_are_the_same_frames(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, {"sensor_1": [["0012.pcd", IDENTITY]]}, {"sensor_1": []})
    write_cloud(drive / "input/sensor_1/0012.pcd")
    (scan,) = open_drive(drive).scans("front")
    assert scan.stamp_ns == 1_200_000_000
    write_cloud(drive / "input/sensor_1/12.pcd")
    message = error_of(drive)
    assert "12.pcd: frame 12 is 0012.pcd as well" in message


def test_numbers_as_yaml_cpp_writes_them(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, {"sensor_1": [entry(1)]})
    (drive / "input/ego_poses.yaml").write_text("sensor_1: [[1.pcd, [-2e-05, 3, 1.5, 0, 0, 0, 1]]]")
    (pose,) = poses_of(open_drive(drive)).T_map_vehicle
    np.testing.assert_array_equal(pose.translation(), [-2e-05, 3.0, 1.5])


def test_rounded_quaternion_is_normalised(tmp_path: Path) -> None:
    """0.707 instead of the root of a half: norm 0.99985, still a turn by 90 degrees."""
    drive = write_drive(tmp_path, {"sensor_1": [entry(1, [0, 0, 0, 0, 0, 0.707, 0.707])]})
    (pose,) = poses_of(open_drive(drive)).T_map_vehicle
    np.testing.assert_allclose(pose.rotation().matrix() @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_quaternion_that_is_none(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, {"sensor_1": [entry(4), entry(5, [0, 0, 0, 0, 0, 0.6, 0.6])]})
    message = error_of(drive)
    assert "ego_poses.yaml: sensor_1, entry 2 (5.pcd)" in message
    assert "norm 0.848528" in message  # 0.6 times the root of 2
    zero = write_drive(tmp_path / "zero", {"sensor_1": [entry(4, [0.0] * 7)]})
    assert "norm 0, expected 1" in error_of(zero)


def test_poses_of_one_frame_must_agree(tmp_path: Path) -> None:
    lidars = {"front": "sensor_1", "rear": "sensor_2"}

    def drive(name: str, pose: Sequence[float]) -> Path:
        poses = {"sensor_1": [entry(6)], "sensor_2": [entry(6, pose)]}
        return write_drive(tmp_path / name, poses)

    message = error_of(drive("moved", [0.02, 0, 0, 0, 0, 0, 1]), lidars)
    assert "ego_poses.yaml: sensor_2, frame 6" in message
    assert "20 mm and 0 mrad" in message
    angle = 0.003
    turned = [0, 0, 0, 0, 0, math.sin(angle / 2), math.cos(angle / 2)]
    assert "0 mm and 3 mrad" in error_of(drive("turned", turned), lidars)
    # Rounding to six decimals, and the same rotation's other quaternion, are no contradiction.
    same = [1e-6, -1e-6, 1e-6, 1e-6, -1e-6, 1e-6, -1.0]
    recording = open_drive(drive("same", same), lidars)
    assert poses_of(recording).T_map_vehicle[0].equals(gtsam.Pose3(), 1e-12)


def test_cloud_without_a_pose(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, {"sensor_1": [entry(1)]}, {"sensor_1": [1, 30, 4]})
    message = error_of(drive)
    assert message.startswith(f"{drive / 'input/sensor_1/4.pcd'}: has no pose (and 1 more)")
    assert f"Add 4.pcd to sensor_1 in {drive / 'input/ego_poses.yaml'}" in message


def test_cloud_that_is_no_frame(tmp_path: Path) -> None:
    drive = write_drive(tmp_path, {"sensor_1": [entry(1)]})
    write_cloud(drive / "input/sensor_1/map.pcd")
    assert "map.pcd: the name is not a frame number" in error_of(drive)


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ([entry(1), ["2.pcd"]], ["entry 2", "['2.pcd'], expected [file, [x, y, z"]),
        ([{"file": "1.pcd"}], ["entry 1", ", expected [file, [x, y, z"]),
        ([[1, IDENTITY]], ["entry 1", "1 is not the name of a cloud"]),
        ([["../../etc/1.pcd", IDENTITY]], ["entry 1", "'../../etc/1.pcd' is not the name"]),
        ([["/etc/1.pcd", IDENTITY]], ["'/etc/1.pcd' is not the name"]),
        ([["1.pcd\n", IDENTITY]], ["'1.pcd\\n' is not the name"]),
        ([["\u0663.pcd", IDENTITY]], ["is not the name"]),  # a digit, but none of ours
        ([["1700000000000000000.pcd", IDENTITY]], ["frame number"]),
        ([["1.pcd", IDENTITY[:6]]], ["entry 1 (1.pcd)", "7 numbers of a pose"]),
        ([["1.pcd", None]], ["entry 1 (1.pcd)", "None", "7 numbers of a pose"]),
        ([["1.pcd", [*IDENTITY[:6], True]]], ["7 numbers of a pose"]),
        ([["1.pcd", ["north", *IDENTITY[1:]]]], ["'north'", "7 numbers of a pose"]),
        ([["1.pcd", [[0.0], *IDENTITY[1:]]]], ["7 numbers of a pose"]),
        ([["1.pcd", [math.nan, *IDENTITY[1:]]]], ["entry 1 (1.pcd)", "not finite"]),
        ([["1.pcd", [*IDENTITY[:3], math.inf, 0, 0, 1]]], ["not finite"]),
        ([entry(1), entry(2), entry(1)], ["entry 3", "frame 1 is given twice"]),
        ([], ["holds no poses"]),
        ({"1.pcd": IDENTITY}, ["holds no poses", "[file, [x, y, z, qx, qy, qz, qw]]"]),
        (None, ["holds no poses"]),
    ],
)
def test_wrong_entries_name_the_sensor_and_the_entry(
    tmp_path: Path, entries: Any, said: list[str]
) -> None:
    drive = write_drive(tmp_path, {"sensor_1": entries}, {"sensor_1": [1]})
    message = error_of(drive)
    assert message.startswith(f"{drive / 'input/ego_poses.yaml'}: sensor_1")
    for part in said:
        assert part in message


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "holds no poses"),
        ("just text", "holds no poses"),
        ("- 1.pcd", "holds no poses"),
        ("sensor_1:\n- [1.pcd, [0, 0}]", "not valid YAML in line 2"),
        ("sensor_1: !!python/object/apply:os.system [ls]", "not valid YAML"),
    ],
)
def test_poses_file_that_is_none(tmp_path: Path, text: str, said: str) -> None:
    drive = write_drive(tmp_path, {"sensor_1": [entry(1)]})
    (drive / "input/ego_poses.yaml").write_text(text)
    message = error_of(drive)
    assert message.startswith(str(drive / "input/ego_poses.yaml"))
    assert said in message


def test_entry_that_unfolds_to_gigabytes(tmp_path: Path) -> None:
    """YAML's aliases: ten times ten times ... of the same list, which nobody may spell out."""
    drive = write_drive(tmp_path, {"sensor_1": [entry(1)]})
    bomb = "a0: &a0 [x, x]\n" + "".join(
        f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 20)
    )
    (drive / "input/ego_poses.yaml").write_text(f"{bomb}sensor_1: [*a19]\n")
    message = error_of(drive)
    assert "not valid YAML in line" in message
    assert "aliases expand to" in message


def break_nothing_there(drive: Path) -> Path:
    return drive / "elsewhere"


def break_file_instead(drive: Path) -> Path:
    (drive / "drive.bag").write_bytes(b"#ROSBAG V2.0\n")
    return drive / "drive.bag"


def break_poses_missing(drive: Path) -> Path:
    (drive / "input/ego_poses.yaml").unlink()
    return drive


def break_sensor_folder_missing(drive: Path) -> Path:
    (drive / "input/sensor_1/1.pcd").unlink()
    (drive / "input/sensor_1").rmdir()
    return drive


def break_clouds_missing(drive: Path) -> Path:
    (drive / "input/sensor_1/1.pcd").unlink()
    return drive


def break_cloud_is_a_folder(drive: Path) -> Path:
    (drive / "input/sensor_1/1.pcd").unlink()
    (drive / "input/sensor_1/1.pcd").mkdir()
    return drive


def break_cloud_cut_off(drive: Path) -> Path:
    cloud = drive / "input/sensor_1/1.pcd"
    cloud.write_bytes(cloud.read_bytes()[:-5])
    return drive


def break_cloud_empty(drive: Path) -> Path:
    write_cloud(drive / "input/sensor_1/1.pcd", [])
    return drive


def break_name_too_long(drive: Path) -> Path:
    return drive / ("x" * 300)


@pytest.mark.parametrize(
    ("do_break", "said"),
    [
        (break_nothing_there, ["elsewhere: no such folder", "data.path", "input/ego_poses.yaml"]),
        (break_file_instead, ["drive.bag: is a file", "data.format: rosbag"]),
        (break_poses_missing, ["holds neither input/ego_poses.yaml nor ego_poses.yaml"]),
        (
            break_sensor_folder_missing,
            ["no folder 'sensor_1' (LiDAR 'front')", "lidars.front.topic", "there is: sensor_2"],
        ),
        (break_clouds_missing, ["sensor_1: holds no clouds", "LiDAR 'front'"]),
        (break_cloud_is_a_folder, ["1.pcd: cannot be read: Is a directory"]),
        (break_cloud_cut_off, ["1.pcd: is cut off", "7 bytes", "bytes expected"]),
        (break_cloud_empty, ["1.pcd: holds no points"]),
        (break_name_too_long, ["cannot be read: File name too long"]),
    ],
)
def test_what_is_missing_or_damaged(
    tmp_path: Path, do_break: Callable[[Path], Path], said: list[str]
) -> None:
    poses = {"sensor_1": [entry(1)], "sensor_2": [entry(1)]}
    message = error_of(do_break(write_drive(tmp_path, poses)))
    assert str(tmp_path) in message
    for part in said:
        assert part in message


@pytest.mark.parametrize("topic", ["sensor_3", "../input/sensor_1", "."])
def test_lidar_that_the_data_lack(tmp_path: Path, topic: str) -> None:
    drive = write_drive(tmp_path, {"sensor_1": [entry(1)], "sensor_2": [entry(1)]})
    message = error_of(drive, {"front": "sensor_1", "roof": topic})
    assert f"no poses of sensor '{topic}' (LiDAR 'roof')" in message
    assert "lidars.roof.topic to a sensor there is: sensor_1, sensor_2" in message


def test_sensor_whose_name_leads_elsewhere(tmp_path: Path) -> None:
    """Also where the poses file names it: clouds are read from the recording, nowhere else."""
    outside = write_drive(tmp_path / "outside", {"sensor_1": [entry(1)]})
    topic = "../../outside/input/sensor_1"
    drive = write_drive(tmp_path / "drive", {topic: [entry(1)]}, {"sensor_1": [1]})
    assert (drive / "input" / topic / "1.pcd").samefile(outside / "input/sensor_1/1.pcd")
    assert f"no folder '{topic}'" in error_of(drive, {"front": topic})


def test_open_recording_takes_the_path_of_the_config(tmp_path: Path) -> None:
    drive = write_drive(tmp_path / "drive", {"sensor_1": [entry(1)]})
    raw = {
        "data": {"format": "caliv", "path": "drive"},
        "lidars": {"front": {"topic": "sensor_1", "initial": {"xyz": [0, 0, 0]}}},
    }
    assert open_recording(parse_config(raw, "config.yaml", tmp_path)).name == str(drive)
    with pytest.raises(RecordingError, match="other: no such folder"):
        open_recording(parse_config(raw, "config.yaml", tmp_path), tmp_path / "other")


def test_open_recording_without_a_path_or_with_a_bag_that_is_not_there() -> None:
    lidars = {"front": {"topic": "sensor_1", "initial": {"xyz": [0, 0, 0]}}}
    caliv = parse_config({"data": {"format": "caliv"}, "lidars": lidars}, "c.yaml", Path())
    with pytest.raises(ConfigError, match=r"data\.path"):
        open_recording(caliv)
    bag = parse_config({"data": {"format": "rosbag"}, "lidars": lidars}, "c.yaml", Path())
    with pytest.raises(RecordingError, match=r"drive\.mcap: no such file or folder"):
        open_recording(bag, Path("drive.mcap"))


@pytest.mark.skipif(
    not AUTHORS_DRIVE.is_dir(), reason=f"the authors' drive is not at {AUTHORS_DRIVE}"
)
def test_the_drive_of_the_authors() -> None:
    recording = open_drive(AUTHORS_DRIVE, {"front": "sensor_1", "rear": "sensor_2"})
    assert recording.warnings() == ()
    poses = poses_of(recording)
    assert len(poses.T_map_vehicle) == 115  # 58 and 78 frames, 21 of them common
    assert (np.diff(poses.stamps_ns) > 0).all()
    # The frame period is the drive's: with it the vehicle goes at the pace of a parking lot.
    positions = np.array([pose.translation() for pose in poses.T_map_vehicle])
    speeds = np.linalg.norm(np.diff(positions, axis=0), axis=1) / np.diff(poses.stamps_ns) * 1e9
    assert 1.8 < np.median(speeds) < 2.0
    for lidar, scans in (("front", 58), ("rear", 78)):
        stamps = []
        for scan in recording.scans(lidar):
            assert len(scan.points_lidar) > 50_000
            ranges = np.linalg.norm(scan.points_lidar, axis=1)
            assert 1.0 <= ranges.min() < ranges.max() <= 200.0
            stamps.append(scan.stamp_ns)
        assert stamps == list(recording.scan_stamps_ns(lidar))
        assert len(stamps) == scans
