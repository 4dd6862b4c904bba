from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caliv_graph.config.load import load_config
from caliv_graph.products import Array
from caliv_graph.readers import open_recording
from scripts.convert_argoverse2 import (
    LIDARS,
    Poses,
    Table,
    lidar_of_lasers,
    read_extrinsics,
    read_poses,
    separated,
    tum,
)

START = 1_600_000_000_000_000_000
CONFIG = Path(__file__).resolve().parents[2] / "configs" / "datasets" / "argoverse2.yaml"
UP = (Rotation.from_euler("xyz", [1.0, -2.0, 3.0], degrees=True), np.array([1.35, 0.0, 1.64]))
DOWN = (Rotation.from_euler("xyz", [179.0, 1.0, 5.0], degrees=True), np.array([1.33, 0.1, 1.5]))
EXTRINSICS = {"up_lidar": UP, "down_lidar": DOWN}


def driven() -> Poses:
    """A turn at 10 m/s and 30 degrees per second, far from the city's origin."""
    s = np.arange(30) * 0.01
    R = Rotation.from_euler("z", 30.0 * s[:, None], degrees=True)
    position = np.column_stack([5000.0 + 10.0 * s, -3000.0 + 4.0 * s, np.full(30, 7.0)])
    stamps = START + np.arange(30) * 10_000_000
    q = R.as_quat()
    names = ("qx", "qy", "qz", "qw")
    table: dict[str, Any] = {"timestamp_ns": stamps[::-1]}
    table |= {name: q[::-1, i] for i, name in enumerate(names)}
    table |= {name: position[::-1, i] for i, name in enumerate(("tx_m", "ty_m", "tz_m"))}
    return read_poses(table)


def sweep(poses: Poses, stamp_ns: int, swapped: bool) -> tuple[Table, Array]:
    """A sweep as published, and the points in the frames of their LiDARs."""
    rng = np.random.default_rng(3)
    count = 2000
    laser = rng.integers(0, 64, count)
    elevation = np.radians(np.linspace(-25.0, 15.0, 32))[laser % 32]
    azimuth, reach = rng.uniform(-np.pi, np.pi, count), rng.uniform(5.0, 60.0, count)
    lidar = reach[:, None] * np.column_stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    offsets = rng.integers(0, 100_000_000, count)
    is_up = (laser < 32) != swapped
    vehicle = np.where(is_up[:, None], UP[0].apply(lidar) + UP[1], DOWN[0].apply(lidar) + DOWN[1])
    R, t = poses.at(stamp_ns + offsets)
    R0, t0 = poses.at(np.array([stamp_ns]))
    published = R0.inv().apply(R.apply(vehicle) + t - t0)
    columns = {axis: published[:, i].astype(np.float32) for i, axis in enumerate("xyz")}
    columns |= {"intensity": np.full(count, 7, np.uint8), "laser_number": laser.astype(np.uint8)}
    return {**columns, "offset_ns": offsets.astype(np.int32)}, lidar


@pytest.mark.parametrize("swapped", [False, True])
def test_points_go_back_to_their_lidar_and_their_time(swapped: bool) -> None:
    poses = driven()
    table, lidar = sweep(poses, START + 100_000_000, swapped)

    lasers = lidar_of_lasers(table, START + 100_000_000, poses, EXTRINSICS)
    clouds = separated(table, START + 100_000_000, poses, EXTRINSICS, lasers)

    assert list(clouds) == list(LIDARS)
    for name, cloud in clouds.items():
        own = (table["laser_number"] < 32) == ((name == "up_lidar") != swapped)
        found = np.column_stack([cloud[axis] for axis in "xyz"])
        np.testing.assert_allclose(found, lidar[own], atol=2e-5)  # float32 of 60 m
        np.testing.assert_array_equal(cloud["t"], table["offset_ns"][own])


def test_extrinsics_by_the_name_of_the_sensor() -> None:
    q = np.array([UP[0].as_quat(), DOWN[0].as_quat()])
    t = np.array([UP[1], DOWN[1]])
    table = {"sensor_name": np.array(["down_lidar", "up_lidar"])}
    table |= {name: q[::-1, i] for i, name in enumerate(("qx", "qy", "qz", "qw"))}
    table |= {name: t[::-1, i] for i, name in enumerate(("tx_m", "ty_m", "tz_m"))}

    found = read_extrinsics(table)

    np.testing.assert_allclose(found["down_lidar"][1], DOWN[1])
    np.testing.assert_allclose((found["up_lidar"][0] * UP[0].inv()).magnitude(), 0.0, atol=1e-12)


def test_the_config_opens_what_was_converted(tmp_path: Path) -> None:
    poses = driven()
    out = tmp_path / "argoverse2"
    for k in range(2):
        stamp_ns = START + k * 100_000_000
        table, _ = sweep(poses, stamp_ns, swapped=False)
        lasers = {"up_lidar": range(32), "down_lidar": range(32, 64)}
        for name, cloud in separated(table, stamp_ns, poses, EXTRINSICS, lasers).items():
            (out / name).mkdir(parents=True, exist_ok=True)
            cloud.tofile(out / name / f"{stamp_ns}.bin")
    (out / "poses.txt").write_text(tum(poses))
    (tmp_path / "config.yaml").write_text(CONFIG.read_text())

    recording = open_recording(load_config(tmp_path / "config.yaml"))

    scan = next(recording.scans("up_lidar"))
    assert scan.point_times_s is not None
    assert 0.0 <= scan.point_times_s.min() < scan.point_times_s.max() < 0.1
    found = recording.motion().poses
    assert found is not None
    np.testing.assert_allclose(found.T_map_vehicle[0].translation(), 0.0, atol=1e-6)
    np.testing.assert_allclose(found.T_map_vehicle[-1].translation(), [2.9, 1.16, 0], atol=1e-6)
    assert recording.warnings() == []
