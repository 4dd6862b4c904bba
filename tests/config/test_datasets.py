"""Configs for published datasets, each against a tiny recording of that layout."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from caliv_graph.cli.main import app
from caliv_graph.config.load import load_config
from caliv_graph.readers import open_recording
from tests.readers.bags import (
    SECOND,
    START,
    Message,
    cloud,
    fix,
    header,
    imu,
    livox,
    write_bag,
    xyz,
    xyzw,
)
from tests.readers.test_navigation import inspvax
from tests.readers.test_velodyne_packets import HDL32E, scan

DATASETS = Path(__file__).resolve().parents[2] / "configs" / "datasets"
CLOUDS = 4
TIMES = np.linspace(0.0, 99e6, 30)

Timed = tuple[str, int, Message]


def stamp(k: int) -> int:
    return START + k * SECOND // 10


def points(k: int) -> np.ndarray[Any, Any]:
    return np.random.default_rng(k).uniform(2.0, 9.0, (30, 3))


def ouster(topic: str, at_end: bool = False) -> list[Timed]:
    delay = 3_000_000 if at_end else 103_000_000
    return [
        (topic, stamp(k) + delay, cloud(stamp(k), points(k), TIMES, ("t", "u4")))
        for k in range(CLOUDS)
    ]


def velodyne(topic: str) -> list[Timed]:
    times = TIMES * 1e-9 - 0.099
    return [
        (topic, stamp(k) + 3_000_000, cloud(stamp(k), points(k), times, ("time", "f4")))
        for k in range(CLOUDS)
    ]


def pose(k: int, position: Iterable[float], quaternion: Iterable[float]) -> Message:
    return {
        "_type": "geometry_msgs/msg/PoseStamped",
        "header": header(stamp(k), "map"),
        "pose": {"position": xyz(position), "orientation": xyzw(quaternion)},
    }


def motion(topic: str, message: Callable[[int], Message]) -> list[Timed]:
    return [(topic, stamp(k) + 1, message(stamp(k))) for k in range(CLOUDS)]


def bag(folder: Path, name: str, *topics: list[Timed]) -> Path:
    timed = sorted((item for topic in topics for item in topic), key=lambda item: item[1])
    return write_bag(folder / name, timed, "ros1")


def mcd(folder: Path) -> Path:
    rows = [f"{k},{stamp(k) / 1e9:.9f},{k},0,0,1,0,0,0" for k in range(CLOUDS)]
    (folder / "pose_inW.csv").write_text("num,t,x,y,z,qx,qy,qz,qw\n" + "\n".join(rows))
    mid70 = [
        (
            "/livox/lidar",
            stamp(k) + 103_000_000,
            livox(stamp(k), points(k), TIMES.astype(int).tolist(), package="livox_ros_driver"),
        )
        for k in range(CLOUDS)
    ]
    return bag(folder, "ntu_day_01", ouster("/os_cloud_node/points", at_end=True), mid70)


def ntu_viral(folder: Path) -> Path:
    prism = [
        ("/leica/pose/relative", stamp(k) + 1, pose(k, (k, 2.0 * k, 0.0), (0, 0, 0, 1)))
        for k in range(CLOUDS)
    ]
    return bag(
        folder,
        "eee_01",
        ouster("/os1_cloud_node1/points", at_end=True),
        ouster("/os1_cloud_node2/points", at_end=True),
        motion("/imu/imu", imu),
        prism,
    )


def urbannav(folder: Path) -> Path:
    span = [
        ("/novatel_data/inspvax", START + k * SECOND + 1, inspvax("novatel_msgs", k, azimuth=90.0))
        for k in range(2)
    ]
    lidars = ("/velodyne_points", "/left/lslidar_point_cloud", "/right/velodyne_points")
    return bag(folder, "UrbanNav-HK_TST-20210517_sensors", *map(velodyne, lidars), span)


def ford_av(folder: Path) -> Path:
    lidars = []
    for colour in ("red", "green", "blue", "yellow"):
        for k in range(CLOUDS):
            message, _ = scan(HDL32E, 2, begin_ns=stamp(k))
            lidars.append((f"/lidar_{colour}_scan", stamp(k) + 2_000_000, message))
    # To the north, 30 degrees of heading, at a height of 2 m, in axes of north, east, down.
    q = (0.0, 0.0, np.sin(np.pi / 12), np.cos(np.pi / 12))
    poses = [
        ("/pose_ground_truth", stamp(k) + 1, pose(k, (k, 0.0, -2.0), q)) for k in range(CLOUDS)
    ]
    return bag(folder, "Sample-Data", lidars, poses)


def helipr(folder: Path) -> Path:
    root = folder / "DCC04"
    config = load_config(DATASETS / "helipr.yaml")
    for lidar in config.lidars.values():
        (root / lidar.topic).mkdir(parents=True)
        assert lidar.bin_fields is not None
        pairs = [field.split(" ") for field in lidar.bin_fields]
        for k in range(CLOUDS):
            table = np.zeros(30, np.dtype([(name, "<" + kind) for name, kind in pairs]))
            for axis, name in enumerate("xyz"):
                table[name] = points(k)[:, axis]
            table.tofile(root / lidar.topic / f"{stamp(k)}.bin")
    (root / "LiDAR_GT").mkdir()
    rows = [f"{stamp(k)} {k} 0 0 0 0 0 1" for k in range(CLOUDS)]
    (root / "LiDAR_GT" / "Ouster_gt.txt").write_text("\n".join(rows))
    return root


def szenergy_leaf(folder: Path) -> Path:
    return bag(
        folder,
        "leaf-2021-04-23-campus",
        ouster("/left_os1/os1_cloud_node/points"),
        ouster("/right_os1/os1_cloud_node/points"),
        velodyne("/velodyne_left/velodyne_points"),
        velodyne("/velodyne_right/velodyne_points"),
        motion("/gps/duro/imu", imu),
        motion("/gps/duro/fix", fix),
    )


LAYOUTS = {
    layout.__name__: layout for layout in (mcd, ntu_viral, urbannav, ford_av, helipr, szenergy_leaf)
}
TIMED = {"ouster": -0.099, "horizontal": -0.099, "vertical": -0.099, "left_os1": 0.0}


def test_every_config_has_a_layout() -> None:
    # Argoverse 2 has its test beside its converter.
    assert {path.stem for path in DATASETS.glob("*.yaml")} == {*LAYOUTS, "argoverse2"}


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_recording_of_the_layout(tmp_path: Path, name: str) -> None:
    text = (DATASETS / f"{name}.yaml").read_text()
    (tmp_path / "config.yaml").write_text(text)
    path = LAYOUTS[name](tmp_path)
    config = load_config(tmp_path / "config.yaml")

    assert config.data.path == path
    recording = open_recording(config)
    for lidar in recording.lidars:
        scans = list(recording.scans(lidar))
        assert len(scans) == CLOUDS
        assert all(len(scan.points_lidar) for scan in scans)
        times_s = scans[0].point_times_s
        if lidar in TIMED and name != "helipr":
            assert times_s is not None
            assert times_s.min() == pytest.approx(TIMED[lidar], abs=1e-6)
    found = recording.motion()
    if name in ("ntu_viral", "szenergy_leaf"):
        assert found.imu is not None
        assert found.gnss is not None
    else:
        assert found.poses is not None
    # Nothing had to be assumed of the stamps, except where no time of recording tells.
    assumed = [line for line in recording.warnings() if "assumed" in line]
    assert assumed == []


@pytest.mark.parametrize("name", LAYOUTS)
def test_inspect_of_the_layout(tmp_path: Path, name: str) -> None:
    path = LAYOUTS[name](tmp_path)

    # Fields of points in .bin files are known from the config only.
    config = ["--config", str(tmp_path / "config.yaml")] if name == "helipr" else []
    (tmp_path / "config.yaml").write_text((DATASETS / f"{name}.yaml").read_text())
    result = CliRunner().invoke(app, ["inspect", str(path), "--json", *config])

    assert result.exit_code == 0, result.output


def test_axes_of_poses_become_those_of_a_vehicle(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text((DATASETS / "ford_av.yaml").read_text())
    ford_av(tmp_path)

    poses = open_recording(load_config(tmp_path / "config.yaml")).motion().poses

    assert poses is not None
    last = poses.T_map_vehicle[-1]
    np.testing.assert_allclose(last.translation(), [3.0, 0.0, 2.0], atol=1e-12)
    # Clockwise seen from above: negative about z up.
    np.testing.assert_allclose(np.degrees(last.rotation().rpy()), [0, 0, -30], atol=1e-9)
