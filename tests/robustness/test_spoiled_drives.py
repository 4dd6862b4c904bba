"""Recordings that came wrong: one line and exit 2, a warning exit code, or a right result.

What runs to the end takes seconds. Of those, a few stand for all, unless CALIV_ROBUSTNESS=all.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.robustness.hostile_drives import (
    FRONT,
    GNSS,
    IMU,
    REAR,
    check_sound,
    command,
    rewritten,
    write_config,
)
from tests.robustness.spoiled import SPOILED

ALL = os.environ.get("CALIV_ROBUSTNESS") == "all"

# What comes of it, where only one thing should.
EXPECTED = {
    "clouds in mm": (2, "no LiDAR sees the target"),
    "force in g": (2, "looks like units of g"),
    "gravity removed": (2, "gravity seems to be removed"),
    "gravity the other way": (2, "disagree by 180 degrees on where up is"),
    "IMU with z down": (2, "on where up is"),
    "orientation w first": (2, "on where up is"),
    "latitude in radians": (2, "Check that latitude and longitude are in degrees"),
    "latitude and longitude swapped": (2, "latitude and longitude are"),
    "clouds left-handed": (2, ""),
    "clouds upside down": (2, ""),
    "stamps backwards": (2, ""),
    "one stamp for all clouds": (2, ""),
    "an hour between LiDARs and the rest": (2, ""),
    "one LiDAR under two names": (2, "hold the same clouds: they are one LiDAR"),
    "one LiDAR in two frames": (2, "2.062 m and 180.00 degrees apart"),
    "only NaN": (2, "no LiDAR sees the target"),
    "only NaN in the IMU": (2, "no IMU"),
    "clouds without a point": (2, "no LiDAR sees the target"),
    "clouds of one point": (2, "no LiDAR sees the target"),
    "one point many times": (2, "no LiDAR sees the target"),
    "one LiDAR in feet": (3, "never saw the target"),
    "rate in degrees": (2, "degrees per second"),
    "rate the other way": (2, "the opposite sign"),
    "velocity in km/h": (2, "km/h"),
    "velocity backwards": (4, "so that it is -1"),
    "LiDARs half a second late": (4, "contradict each other"),
    "all clouds the same": (4, "contradict each other"),
    "orientation of zeros": (0, "no unit quaternion"),
    "every message twice": (0, "have the stamp of another"),
    "NaN points": (0, ""),
    "huge values in the IMU": (0, "beyond 200 rad/s"),
}

ALONE = {"structure": {"use": False}}
"""The target alone, where structure is not the subject: a third of the time."""

BY_TARGET = {"huge values in the IMU"}
"""Right in the end, by the target alone."""

ALIKE = {"only NaN", "clouds of one point"}
"""End as "clouds without a point" do, after as long a search; readers have tests of each."""

LONG = {name for name in SPOILED if EXPECTED.get(name, (0,))[0] != 2} - BY_TARGET


@pytest.mark.parametrize("name", [name for name in SPOILED if ALL or name not in LONG | ALIKE])
def test_a_spoiled_recording(name: str, drive: Path, tmp_path: Path) -> None:
    bag = rewritten(drive, tmp_path / "bag", SPOILED[name])
    sections = ALONE if name in BY_TARGET and not ALL else {}
    path = tmp_path / "config.yaml"
    config = write_config(drive, path, data__path=str(bag), **sections)

    done = command("calibrate", config, "--out", tmp_path / "out")

    check_sound(done, tmp_path / "out", drive / "truth.yaml")
    code, said = EXPECTED.get(name, (done.code, ""))
    assert (done.code, said in done.err) == (code, True), done.err


@pytest.mark.parametrize(
    ("sections", "said"),
    [
        ({"imu": {"T_vehicle_imu": {"xyz": [0, 0, 0], "rpy_deg": [90, 0, 0]}}}, "gravity is along"),
        ({"lidars__front__initial__xyz": [1e300, 0.0, 0.0]}, "xyz.0': must be within +-1e+12"),
        ({"lidars__front__initial__xyz": [2000.0, 0.0, 2000.0]}, "in metres, not millimetres"),
        ({"gnss": {"lever_arm": [0.0, 0.0, 1500.0]}}, "in metres, not millimetres"),
        ({"noise": {"lidar_range_m": 1e-300}}, "must be at least 1e-12"),
        ({"lidars__front__sigma__xyz": 1e-9}, "To trust the guess, set 'fixed: true'"),
        ({"target": [{"min": [9.8e3, -14.6e3, -5e3], "max": [20.5e3, -3.8e3, 6.3e3]}]}, "region"),
        ({"lidars__front__topic": "/lidar/frnt/points"}, "Did you mean '/lidar/front/points'"),
        ({"lidars__front__topic": IMU}, "is of type sensor_msgs/msg/Imu"),
        ({"topics__imu": GNSS}, "is of type sensor_msgs/msg/NavSatFix"),
        ({"topics__imu": FRONT}, "is of type sensor_msgs/msg/PointCloud2"),
        ({"topics__imu": "../../x\n\x1b[31m"}, "has no topic '../../x \\x1b[31m'"),
        ({"topics": {"pose": IMU}}, "is of type sensor_msgs/msg/Imu"),
        ({"reference": "nobody"}, "reference 'nobody' is not a LiDAR"),
        ({"data__format": "caliv"}, "drive"),
        ({"data__path": "/dev/null"}, "is a pipe or a device"),
        ({"data__path": "a\x00b"}, "no such file"),
        ({"lidars__rear__topic": FRONT}, "belongs to LiDARs 'front' and 'rear'"),
        ({"lidars__front__min_range": 300.0, "lidars__rear__min_range": 300.0}, "no LiDAR sees"),
    ],
    ids=str,
)
def test_a_config_that_does_not_fit(
    sections: dict[str, object], said: str, drive: Path, tmp_path: Path
) -> None:
    config = write_config(drive, tmp_path / "config.yaml", **sections)

    done = command("calibrate", config, "--out", tmp_path / "out")

    assert done.code == 2, done.err
    assert said in done.err
    check_sound(done, tmp_path / "out", drive / "truth.yaml")


def test_topics_of_two_lidars_swapped(drive: Path, tmp_path: Path) -> None:
    sections = {"lidars__front__topic": REAR, "lidars__rear__topic": FRONT}
    config = write_config(drive, tmp_path / "config.yaml", **sections)

    done = command("calibrate", config, "--out", tmp_path / "out")

    assert done.code == 2
    assert "the topics of lidars 'front' and 'rear' are swapped" in done.err
    check_sound(done, tmp_path / "out", drive / "truth.yaml")


def test_a_guess_with_its_yaw_half_a_turn_off(drive: Path, tmp_path: Path) -> None:
    initial = {"xyz": [-0.4, 0.0, 2.0], "rpy_deg": [0.0, 10.0, 0.0]}
    path = tmp_path / "config.yaml"
    config = write_config(drive, path, lidars__rear__initial=initial, **ALONE)

    done = command("calibrate", config, "--out", tmp_path / "out")

    assert done.code == 4, done.err
    assert "the initial guess of lidar 'rear' is turned by 180 degrees of yaw" in done.err
    assert "Widen" not in done.err
    check_sound(done, tmp_path / "out", drive / "truth.yaml")


@pytest.mark.skipif(not ALL, reason="takes seconds each: CALIV_ROBUSTNESS=all")
@pytest.mark.parametrize(
    "sections",
    [
        {"ground__vehicle_height": 1.0},
        {"ground__vehicle_height": 1000.0},
        {"imu": {"T_vehicle_imu": {"xyz": [0, 0, 0], "rpy_deg": [0, 0, 90]}}},
        {"imu": {"T_vehicle_imu": {"xyz": [0, 0, 0], "rpy_deg": [180, 0, 0]}}},
        {"gnss": {"lever_arm": [0, 0, 50.0]}},
        {"gnss": {"lever_arm": [50.0, 0, 0]}},
        {"noise": {"lidar_range_m": 1e-12}},
        {"noise": {"gnss_horizontal_m": 1e12, "gnss_vertical_m": 1e-12}},
        {"lidars__front__sigma": {"xyz": 1e12, "rpy_deg": 1e12}},
        {"lidars__front__sigma": {"xyz": 1e-6, "rpy_deg": 1e-6}},
        {"lidars__front__initial__rpy_deg": [0.0, -10.0, 0.0]},
        {"lidars__front__initial__rpy_deg": [0.0, 0.17, 3.14]},
        {"lidars__front__initial__xyz": [-2.0, 0.0, -2.0]},
    ],
    ids=str,
)
def test_a_config_with_a_wrong_unit_or_sign(
    sections: dict[str, object], drive: Path, tmp_path: Path
) -> None:
    config = write_config(drive, tmp_path / "config.yaml", **sections)

    done = command("calibrate", config, "--out", tmp_path / "out")

    check_sound(done, tmp_path / "out", drive / "truth.yaml")


@pytest.mark.parametrize(
    ("sections", "said"),
    [
        ({"imu": {"T_vehicle_imu": {"xyz": [0, 0, 0], "rpy_deg": [90, 0, 0]}}}, "gravity is along"),
        ({"target": [{"min": [90, 90, 0], "max": [95, 95, 3]}]}, "no LiDAR sees the target"),
        ({"lidars__front__topic": "/lidar/frnt/points"}, "Did you mean '/lidar/front/points'"),
    ],
    ids=["IMU on its side", "no target", "no topic"],
)
def test_inspect_shows_its_tables_whatever_the_config_says(
    sections: dict[str, object], said: str, drive: Path, tmp_path: Path
) -> None:
    config = write_config(drive, tmp_path / "config.yaml", **sections)

    done = command("inspect", drive / "drive", "--config", config)

    assert done.code == 0
    assert said in done.err
    assert "/lidar/front/points" in done.out
    assert ("as expected" in done.out) == ("imu" not in sections)


def test_a_target_that_a_wrong_yaw_hides_is_blamed_on_the_yaw(drive: Path, tmp_path: Path) -> None:
    turned = {"T_vehicle_imu": {"xyz": [0, 0, 0], "rpy_deg": [0, 0, 90]}}
    config = write_config(drive, tmp_path / "config.yaml", imu=turned)

    done = command("calibrate", config, "--out", tmp_path / "out")

    assert done.code == 2
    assert "Most likely because of imu.T_vehicle_imu: " in done.err
    assert "degrees of yaw against the accelerations of the path" in done.err
    assert "Move or widen" not in done.err
