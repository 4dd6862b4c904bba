from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from caliv_graph.batch.job import open_recordings
from caliv_graph.cli.main import app
from caliv_graph.config.load import load_config, parse_config
from caliv_graph.errors import ConfigError, RecordingError
from caliv_graph.products import Recording
from caliv_graph.readers import open_recording
from caliv_graph.readers.discover import open_all

BEGIN = 1_700_000_000_000_000_000
PERIOD = 100_000_000


def points_of(number: int, count: int = 30) -> np.ndarray[Any, Any]:
    return np.random.default_rng(number).uniform(2.0, 9.0, (count, 3)).astype(np.float32)


def write_tum(path: Path, count: int = 6) -> None:
    rows = [f"{(BEGIN + k * PERIOD) / 1e9:.9f} {k} 0 0 0 0 0 1" for k in range(count)]
    path.write_text("\n".join(rows))


def kitti(root: Path, floats: int = 4, count: int = 6) -> Path:
    """sequences/00 as of KITTI odometry: numbered clouds, times, poses of the camera."""
    folder = root / "velodyne"
    folder.mkdir(parents=True)
    for k in range(count):
        rows = np.hstack([points_of(k), np.zeros((30, floats - 3), np.float32)])
        rows.astype("<f4").tofile(folder / f"{k:06d}.bin")
    (root / "times.txt").write_text("\n".join(f"{0.1 * k:.6e}" for k in range(count)))
    lines = [f"1 0 0 0 0 1 0 0 0 0 1 {k}" for k in range(count)]
    (root / "poses.txt").write_text("\n".join(lines))
    return root


def nuscenes(root: Path, lidars: tuple[str, ...] = ("LIDAR_TOP",)) -> Path:
    for name in lidars:
        folder = root / "samples" / name
        folder.mkdir(parents=True)
        for k in range(6):
            rows = np.hstack([points_of(k), np.ones((30, 2), np.float32)]).astype("<f4")
            stamp_us = (BEGIN + k * PERIOD) // 1000
            rows.tofile(folder / f"n015-2023-11-14-22-13-20+0800__{name}__{stamp_us}.pcd.bin")
    entries = ", ".join(
        f'{{"token": "{k}", "timestamp": {(BEGIN + k * PERIOD) // 1000}, '
        f'"rotation": [1.0, 0.0, 0.0, 0.0], "translation": [{k}.0, 0.0, 0.0]}}'
        for k in range(6)
    )
    (root / "ego_pose.json").write_text(f"[{entries}]")
    return root


def write_cloud(path: Path, table: np.ndarray[Any, Any], body: str = "binary") -> None:
    """A cloud as `.bin`, or as `.pcd` with an ascii or binary body."""
    if path.suffix == ".bin":
        table.tofile(path)
        return
    kinds = [table.dtype[i] for i in range(len(table.dtype))]
    letters = {"f": "F", "i": "I", "u": "U"}
    header = (
        f"FIELDS {' '.join(table.dtype.names or ())}\n"
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}\n"
        f"TYPE {' '.join(letters[kind.kind] for kind in kinds)}\n"
        f"WIDTH {len(table)}\nHEIGHT 1\nPOINTS {len(table)}\nDATA {body}\n"
    )
    rows = "".join(" ".join(map(str, row)) + "\n" for row in table.tolist())
    path.write_bytes(header.encode() + (rows.encode() if body == "ascii" else table.tobytes()))


def opened(root: Path, topic: str, poses: str | None = None, **lidar: Any) -> Recording:
    raw: dict[str, Any] = {
        "data": {"format": "clouds", "path": str(root)},
        "lidars": {"top": {"topic": topic, "initial": {"xyz": [0, 0, 0]}, **lidar}},
    }
    if poses:
        raw["data"]["poses"] = poses
    return open_recording(parse_config(raw, "config.yaml", root))


def test_a_sequence_of_kitti(tmp_path: Path) -> None:
    recording = opened(kitti(tmp_path / "00"), "velodyne")

    assert recording.scan_stamps_ns("top") == [k * PERIOD for k in range(6)]
    scans = list(recording.scans("top", {2 * PERIOD, 5 * PERIOD}))
    assert [scan.stamp_ns for scan in scans] == [2 * PERIOD, 5 * PERIOD]
    np.testing.assert_array_equal(scans[0].points_lidar, points_of(2))
    assert scans[0].point_times_s is None
    poses = recording.motion().poses
    assert poses is not None
    assert poses.stamps_ns.tolist() == [k * PERIOD for k in range(6)]
    # The camera moves along its z axis: forward.
    np.testing.assert_allclose(poses.T_map_vehicle[5].translation(), [5, 0, 0], atol=1e-12)
    np.testing.assert_allclose(poses.T_map_vehicle[5].rotation().matrix(), np.eye(3), atol=1e-12)


@pytest.mark.parametrize("name", ["{}.bin", "cloud_{}.bin", "run2_{}_left.bin"])
def test_numbers_that_are_not_equally_long_count_as_numbers(tmp_path: Path, name: str) -> None:
    root = kitti(tmp_path / "00", count=12)
    for k in range(12):
        (root / f"velodyne/{k:06d}.bin").rename(root / "velodyne" / name.format(k))

    scans = list(opened(root, "velodyne").scans("top"))

    assert [scan.stamp_ns for scan in scans] == [k * PERIOD for k in range(12)]
    for k, scan in enumerate(scans):
        np.testing.assert_array_equal(scan.points_lidar, points_of(k))


def test_the_dates_of_kitti_raw(tmp_path: Path) -> None:
    root = kitti(tmp_path / "velodyne_points")
    (root / "times.txt").unlink()
    lines = [f"2011-09-26 13:02:25.{k:01d}67794688" for k in range(6)]
    (root / "timestamps.txt").write_text("\n".join(lines))

    stamps = opened(root, "velodyne").scan_stamps_ns("top")

    # 2011-09-26 13:02:25 UTC is 1317042145 s.
    assert stamps[0] == 1_317_042_145_067_794_688
    assert stamps[5] - stamps[0] == 5 * PERIOD


def test_clouds_and_poses_of_nuscenes(tmp_path: Path) -> None:
    recording = opened(nuscenes(tmp_path), "samples/LIDAR_TOP")

    assert recording.scan_stamps_ns("top") == [BEGIN + k * PERIOD for k in range(6)]
    (scan,) = recording.scans("top", {BEGIN + 3 * PERIOD})
    np.testing.assert_array_equal(scan.points_lidar, points_of(3))
    poses = recording.motion().poses
    assert poses is not None
    assert [pose.x() for pose in poses.T_map_vehicle] == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    ("name", "kind", "unit_ns", "absolute"),
    [
        ("timestamp", "u8", 1, True),
        ("timestamp", "i8", 1_000, True),
        ("time_stamp", "u8", 1_000_000, True),
        ("t", "i8", 1, False),
        ("t", "u8", 1, True),
        ("timestamp", "u8", 1, False),
    ],
)
@pytest.mark.parametrize("suffix", ["bin", "pcd"])
def test_times_that_are_64_bit_integers(
    tmp_path: Path, suffix: str, name: str, kind: str, unit_ns: int, absolute: bool
) -> None:
    table = np.zeros(30, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), (name, "<" + kind)])
    (tmp_path / "top").mkdir()
    for k in range(3):
        for axis, column in zip("xyz", points_of(k).T, strict=True):
            table[axis] = column
        stamp = BEGIN + k * PERIOD
        table[name] = ((stamp if absolute else 0) + np.arange(30) * 3_000_000) // unit_ns
        write_cloud(tmp_path / "top" / f"{stamp}.{suffix}", table)
    fields = ["x f4", "y f4", "z f4", f"{name} {kind}"] if suffix == "bin" else None

    scans = list(opened(tmp_path, "top", bin_fields=fields).scans("top"))

    for k, scan in enumerate(scans):
        np.testing.assert_array_equal(scan.points_lidar, points_of(k))
        assert scan.point_times_s is not None
        np.testing.assert_allclose(scan.point_times_s, np.arange(30) * 3e-3, rtol=0, atol=1e-12)


@pytest.mark.parametrize("body", ["binary", "ascii"])
@pytest.mark.parametrize(
    ("name", "kind", "first", "scale"),
    [("timestamp", "f8", BEGIN / 1e9, 1.0), ("t", "u4", 0.0, 1e9), ("time", "f4", 0.0, 1.0)],
)
def test_pcd_clouds_have_the_times_of_their_fields(
    tmp_path: Path, body: str, name: str, kind: str, first: float, scale: float
) -> None:
    table = np.zeros(30, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), (name, "<" + kind)])
    table["x"], table["y"], table["z"] = points_of(0).T
    table["x"][0] = np.nan  # no return
    table[name] = first + np.arange(30) * 3e-3 * scale
    (tmp_path / "top").mkdir()
    for k in range(2):
        if first:
            table[name] += k * PERIOD / 1e9
        write_cloud(tmp_path / "top" / f"{BEGIN + k * PERIOD}.pcd", table, body)

    recording = opened(tmp_path, "top")
    scans = list(recording.scans("top"))

    for scan in scans:
        np.testing.assert_array_equal(scan.points_lidar, points_of(0)[1:])
        assert scan.point_times_s is not None
        np.testing.assert_allclose(scan.point_times_s, np.arange(1, 30) * 3e-3, atol=1e-6)
    # The sweep ends where its beams hit nothing, too; at which end it is stamped is not known.
    assumed = any("assumed to mark the start" in line for line in recording.warnings())
    assert assumed is (first == 0.0)
    (ended,) = opened(tmp_path, "top", stamp="end").scans("top", {BEGIN})
    assert ended.point_times_s is not None
    assert ended.point_times_s.max() == pytest.approx(0.0, abs=1e-6)


def test_times_of_pcd_clouds_that_cannot_be_are_told(tmp_path: Path) -> None:
    table = np.ones(30, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("timestamp", "<f8")])
    table["x"], table["timestamp"] = 2.0, 1e6
    (tmp_path / "top").mkdir()
    write_cloud(tmp_path / "top" / f"{BEGIN}.pcd", table)

    recording = opened(tmp_path, "top")

    assert next(recording.scans("top")).point_times_s is None
    assert any(
        "the times of the points of 1 clouds are not used" in w for w in recording.warnings()
    )


def test_clouds_without_times_beside_others_that_have_them_are_told(tmp_path: Path) -> None:
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")]
    for name, fields in {"top": kinds, "rear": kinds[:3]}.items():
        (tmp_path / name).mkdir()
        for k in range(3):
            table = np.zeros(30, fields)
            table["x"], table["y"], table["z"] = points_of(k).T
            if name == "top":
                table["t"] = np.arange(30) * 3_000_000
            write_cloud(tmp_path / name / f"{BEGIN + k * PERIOD}.pcd", table)
    write_tum(tmp_path / "poses.tum")
    guess = {"initial": {"xyz": [0, 0, 0]}}
    raw = {
        "data": {"format": "clouds", "path": str(tmp_path)},
        "lidars": {name: {"topic": name, **guess} for name in ("top", "rear")},
    }
    recording = open_recording(parse_config(raw, "config.yaml", tmp_path))

    list(recording.scans("top"))
    told = "points of 'rear' have no times, those of 'top' have"
    assert not any(told in line for line in recording.warnings())  # no cloud of it was read
    list(recording.scans("rear"))
    assert any(told in line for line in recording.warnings())


def test_fields_of_the_config_and_a_stamp_at_the_end(tmp_path: Path) -> None:
    """As HeLiPR stores an Ouster: 26 bytes per point, times from the start of the sweep."""
    kinds = {"x": "f4", "y": "f4", "z": "f4", "intensity": "f4", "t": "u4", "reflectivity": "u2"}
    kinds |= {"ring": "u2", "ambient": "u2"}
    (tmp_path / "LiDAR" / "Ouster").mkdir(parents=True)
    for k in range(3):
        table = np.zeros(30, np.dtype([(name, "<" + kind) for name, kind in kinds.items()]))
        for axis, name in enumerate("xyz"):
            table[name] = points_of(k)[:, axis]
        table["t"] = np.arange(30) * 3_000_000
        table.tofile(tmp_path / "LiDAR" / "Ouster" / f"{BEGIN + k * PERIOD}.bin")
    write_tum(tmp_path / "gt.txt")
    fields = [f"{name} {kind}" for name, kind in kinds.items()]
    options: dict[str, Any] = {"bin_fields": fields, "poses": "gt.txt"}

    scan = next(opened(tmp_path, "LiDAR/Ouster", stamp="end", **options).scans("top"))
    plain = opened(tmp_path, "LiDAR/Ouster", **options)
    first = next(plain.scans("top"))

    np.testing.assert_array_equal(scan.points_lidar, points_of(0))
    assert scan.point_times_s is not None
    assert first.point_times_s is not None
    np.testing.assert_allclose(scan.point_times_s, np.arange(30) * 3e-3 - 0.087, atol=1e-12)
    np.testing.assert_allclose(first.point_times_s, np.arange(30) * 3e-3)
    assert any("assumed to mark the start" in line for line in plain.warnings())
    # 30 points of 26 bytes might be 39 points of 20: what they would hold tells otherwise.
    with pytest.raises(RecordingError, match=r"m away\. Set bin_fields of the LiDAR"):
        list(opened(tmp_path, "LiDAR/Ouster").scans("top"))
    with pytest.raises(RecordingError, match="780 bytes are no whole number of points of 22 bytes"):
        list(opened(tmp_path, "LiDAR/Ouster", bin_fields=fields[:-2]).scans("top"))
    with (tmp_path / "LiDAR" / "Ouster" / f"{BEGIN}.bin").open("ab") as file:
        file.write(b"x")
    with pytest.raises(RecordingError, match="fit neither 4 nor 5 floats per point"):
        opened(tmp_path, "LiDAR/Ouster")


def test_what_is_wrong_is_named(tmp_path: Path) -> None:
    root = kitti(tmp_path / "00")
    with pytest.raises(RecordingError, match=r"Set lidars\.top\.topic to .*: velodyne"):
        opened(root, "ouster")
    with pytest.raises(RecordingError, match=r"no such file\. Set data\.poses"):
        opened(root, "velodyne", poses="nope.txt").motion()
    write_tum(root / "late.txt")
    with pytest.raises(RecordingError, match="in the clock of the clouds"):
        opened(root, "velodyne", poses="late.txt").motion()
    (root / "times.txt").write_text("0\n1\n")
    with pytest.raises(RecordingError, match=r"has 2 times, .* has 6 clouds"):
        opened(root, "velodyne")
    (root / "times.txt").unlink()
    with pytest.raises(RecordingError, match=r"hold no time\. Add times\.txt"):
        opened(root, "velodyne")


def test_inspect_and_init_know_such_folders(tmp_path: Path) -> None:
    root = nuscenes(tmp_path / "v1", ("LIDAR_FRONT", "LIDAR_REAR"))
    config = tmp_path / "config.yaml"

    shown = CliRunner().invoke(app, ["inspect", str(root)], env={"COLUMNS": "200"})
    drafted = CliRunner().invoke(app, ["init", str(root), "--out", str(config)])

    assert shown.exit_code == 0, shown.output
    assert "LIDAR_FRONT" in shown.output
    assert "30 / 30 / 30" in shown.output
    assert "Drive: 6 poses, 5.0 m" in shown.output
    assert drafted.exit_code == 0, drafted.output
    loaded = load_config(config)
    assert loaded.data.format == "clouds"
    assert loaded.data.poses == root / "ego_pose.json"
    assert [lidar.topic for lidar in loaded.lidars.values()] == [
        "samples/LIDAR_FRONT",
        "samples/LIDAR_REAR",
    ]
    recording = open_recording(loaded)
    assert len(list(recording.scans(recording.lidars[0]))) == 6
    assert open_all(root).lidars == recording.lidars


@pytest.mark.parametrize("more", [{"poses": "poses.tum"}, {"pose_axes": "frd"}])
def test_a_caliv_folder_has_poses_of_its_own(tmp_path: Path, more: dict[str, str]) -> None:
    lidars = {"top": {"topic": "sensor_1", "initial": {"xyz": [0, 0, 0]}}}
    raw = {"data": {"format": "caliv", "path": "drive", **more}, "lidars": lidars}

    with pytest.raises(ConfigError, match="a CaLiV folder has its own"):
        parse_config(raw, "config.yaml", tmp_path)


@pytest.mark.parametrize(
    ("parts", "expected_ns"),
    [
        # Whole nanoseconds without leading zeros: 0.06 s, 0.16 s, ...; the longest has 9 digits.
        (["60000000", "160000000", "260000000"], [60_000_000, 160_000_000, 260_000_000]),
        (["60123", "160123", "5001"], [5_001_000, 60_123_000, 160_123_000]),  # microseconds
        (["05", "125", "2"], [50_000_000, 125_000_000, 200_000_000]),  # decimals, as a zero tells
        (["050", "150", "250"], [50_000_000, 150_000_000, 250_000_000]),
    ],
)
def test_parts_of_a_second_in_names(
    tmp_path: Path, parts: list[str], expected_ns: list[int]
) -> None:
    (tmp_path / "top").mkdir()
    for part in parts:
        np.ones((30, 4), np.float32).tofile(tmp_path / "top" / f"1700000000_{part}.bin")

    stamps = opened(tmp_path, "top").scan_stamps_ns("top")

    assert [s - 1_700_000_000 * 10**9 for s in stamps] == expected_ns


def test_two_drives_of_one_time_and_one_file_of_poses(tmp_path: Path) -> None:
    for name in ("one", "other"):
        kitti(tmp_path / name)
    config = parse_config(
        {
            "data": {"format": "clouds", "poses": str(tmp_path / "one" / "poses.txt")},
            "lidars": {"top": {"topic": "velodyne", "initial": {"xyz": [0, 0, 0]}}},
        },
        "config.yaml",
        tmp_path,
    )

    with pytest.raises(RecordingError, match=r"'.*one' and '.*other' are of the same time"):
        open_recordings(config, [tmp_path / "one", tmp_path / "other"])
    assert len(open_recordings(config, [tmp_path / "one"])) == 1


def test_fields_of_bin_files_with_a_bag(tmp_path: Path) -> None:
    fields = ["x f4", "y f4", "z f4"]

    with pytest.raises(ConfigError, match=r"lidars.top.bin_fields.*data.format"):
        parse_config({"lidars": {"top": {"topic": "a", "bin_fields": fields}}}, "c.yaml", tmp_path)
