from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caliv_graph.config.model import Config, TopicsConfig
from caliv_graph.products import GivenPoses, GnssFixes, MotionData
from caliv_graph.readers.bag import Bag
from caliv_graph.readers.discover import choose_motion_topics
from caliv_graph.readers.navigation import rotation_of_inspvax
from caliv_graph.readers.rosbag import RosbagRecording
from caliv_graph.trajectory.gnss import positions_in_map
from tests.readers.bags import SECOND, START, Message, header, write_bag, xyz

DEG = np.pi / 180
WEEK = 604_800
GPS_EPOCH = 315_964_800
LATE = 30_000_000


def record(path: Path, messages: list[Message], kind: str = "mcap", **topics: str) -> MotionData:
    """The motion data of messages at 1 Hz on the topic /nav, recorded 30 ms late."""
    topic = "/nav"
    timed = [(topic, START + k * SECOND + LATE, m) for k, m in enumerate(messages)]
    bag = write_bag(path / "drive", timed, kind)
    return RosbagRecording(bag, {}, TopicsConfig(**(topics or {"pose": topic}))).motion()


def inspvax(kind: str, k: int, status: int = 3, **values: float) -> Message:
    """INSPVAX number k in the fields of the driver `kind`."""
    height, std = ("height", "stdev") if kind == "novatel_oem7_msgs" else ("altitude", "std")
    sigmas = {"latitude": 0.02, "longitude": 0.01, height: 0.03}
    sigmas |= {"roll": 0.1, "pitch": 0.2, "azimuth": 0.5}
    out: Message = {"_type": f"{kind}/msg/INSPVAX", "latitude": 48.0, "longitude": 11.0}
    out |= {height: 500.0, "undulation": 45.0, **{f"{n}_{std}": v for n, v in sigmas.items()}}
    out |= values
    if kind == "novatel_oem7_msgs":
        return out | {"header": header(START + k * SECOND), "ins_status": {"status": status}}
    seconds = START // SECOND + k + 18 - GPS_EPOCH  # GPS is 18 s ahead of UTC
    time = {"week": seconds // WEEK, "gpssec": seconds % WEEK * 1000}
    return out | {"header": time, "ins_status": status}


@pytest.mark.parametrize(
    ("roll", "pitch", "azimuth", "forward", "left"),
    [
        (0.0, 0.0, 0.0, (0, 1, 0), (-1, 0, 0)),  # north
        (0.0, 0.0, 90.0, (1, 0, 0), (0, 1, 0)),  # east
        (0.0, 0.0, 270.0, (-1, 0, 0), (0, -1, 0)),  # west
        (0.0, 30.0, 0.0, (0, np.sqrt(0.75), 0.5), (-1, 0, 0)),  # north, nose up
        (30.0, 0.0, 0.0, (0, 1, 0), (-np.sqrt(0.75), 0, 0.5)),  # north, left side up
    ],
)
def test_angles_of_an_inspvax(
    roll: float, pitch: float, azimuth: float, forward: Any, left: Any
) -> None:
    R = rotation_of_inspvax(roll, pitch, azimuth)

    np.testing.assert_allclose(R[:, 0], forward, atol=1e-12)
    np.testing.assert_allclose(R[:, 1], left, atol=1e-12)
    # The body of NovAtel: x right, y forward, z up; Rz(-azimuth) Rx(pitch) Ry(roll).
    R_enu_body = Rotation.from_euler("ZXY", [-azimuth, pitch, roll], degrees=True).as_matrix()
    axes = np.column_stack([R_enu_body[:, 1], -R_enu_body[:, 0], R_enu_body[:, 2]])
    np.testing.assert_allclose(R, axes, atol=1e-12)


@pytest.mark.parametrize("kind", ["novatel_msgs", "novatel_oem7_msgs"])
@pytest.mark.parametrize("bag", ["mcap", "sqlite3", "ros1"])
def test_poses_of_an_inspvax(tmp_path: Path, kind: str, bag: str) -> None:
    # 1e-3 degrees of latitude are 111.2 m at 48 degrees north; M = 6,371,100 m at this latitude.
    messages = [
        inspvax(kind, 0, azimuth=90.0),
        inspvax(kind, 1, status=1),  # aligning
        inspvax(kind, 2, latitude=48.001, azimuth=90.0),
    ]

    poses = record(tmp_path, messages, bag).poses

    assert poses is not None
    assert poses.stamps_ns.tolist() == [START, START + 2 * SECOND]
    first, last = poses.T_map_vehicle
    np.testing.assert_allclose(first.translation(), 0.0, atol=1e-9)
    np.testing.assert_allclose(last.translation(), [0, 111.2, 0], atol=0.05)
    np.testing.assert_allclose(first.rotation().matrix(), np.eye(3), atol=1e-12)
    assert poses.cov is not None
    # The vehicle looks east: east is its x, north its y.
    expected = np.array([0.1 * DEG, 0.2 * DEG, 0.5 * DEG, 0.01, 0.02, 0.03]) ** 2
    np.testing.assert_allclose(poses.cov[0], np.diag(expected), rtol=1e-6, atol=1e-12)


def test_north_turns_along_a_parallel(tmp_path: Path) -> None:
    """The map's axes are those of the first place: 0.1 degrees of longitude turn them."""
    messages = [
        inspvax("novatel_oem7_msgs", 0, azimuth=0.0),
        inspvax("novatel_oem7_msgs", 1, azimuth=0.0, longitude=11.1),
    ]

    poses = record(tmp_path, messages).poses

    assert poses is not None
    yaw = poses.T_map_vehicle[0].rotation().between(poses.T_map_vehicle[1].rotation()).yaw()
    # East of the origin, north leans to the left: sin(latitude) x 0.1 degrees.
    assert yaw == pytest.approx(np.sin(48 * DEG) * 0.1 * DEG, rel=1e-3)


def utc(k: int) -> dict[str, int]:
    t = datetime.datetime.fromtimestamp(START // SECOND + k, tz=datetime.UTC)
    names = ("year", "month", "day", "hour", "minute", "second")
    year, month, day, hour, minute, second = (getattr(t, name) for name in names)
    return {
        **{"year": year, "month": month, "day": day, "hour": hour, "min": minute, "sec": second},
        **{"nano": -5_000_000, "valid": 7},
    }


def navpvt(k: int, **values: int) -> Message:
    out: Message = {"_type": "ublox_msgs/msg/NavPVT", "lat": 480_000_000, "lon": 110_000_000}
    out |= {"height": 545_000, "h_msl": 500_000, "h_acc": 14, "v_acc": 20, "fix_type": 3}
    return out | {"flags": 1, **utc(k), **values}


def septentrio(k: int, **values: float) -> Message:
    out: Message = {"_type": "septentrio_gnss_driver/msg/PVTGeodetic", "mode": 4}
    out |= {"latitude": 48.0 * DEG, "longitude": 11.0 * DEG, "height": 545.0, "undulation": 45.0}
    return out | {"header": header(START + k * SECOND), "h_accuracy": 4, "v_accuracy": 6, **values}


@pytest.mark.parametrize("bag", ["mcap", "sqlite3", "ros1"])
def test_fixes_of_a_ublox(tmp_path: Path, bag: str) -> None:
    messages = [navpvt(0), navpvt(1, fix_type=2), navpvt(2, flags=0), navpvt(3, lon=110_000_001)]

    fixes = record(tmp_path, messages, bag, gnss="/nav").gnss

    assert fixes is not None
    # `nano` may be negative: 5 ms before the full second.
    assert fixes.stamps_ns.tolist() == [START - 5_000_000, START + 3 * SECOND - 5_000_000]
    np.testing.assert_allclose(fixes.latitude_deg, 48.0)
    np.testing.assert_allclose(fixes.longitude_deg, [11.0, 11.0000001], rtol=0, atol=1e-12)
    np.testing.assert_allclose(fixes.altitude_m, 545.0)
    assert fixes.cov_enu is not None
    # 14 mm are the root of the sum of two equal variances.
    np.testing.assert_allclose(fixes.cov_enu[0], np.diag([98e-6, 98e-6, 400e-6]), rtol=1e-9)


def test_a_receiver_without_the_computers_clock_is_stamped_by_the_recording(tmp_path: Path) -> None:
    fixes = record(tmp_path, [navpvt(7), navpvt(8)], gnss="/nav").gnss

    assert fixes is not None
    assert fixes.stamps_ns.tolist() == [START + LATE, START + SECOND + LATE]


@pytest.mark.parametrize("bag", ["mcap", "sqlite3"])
def test_fixes_of_a_septentrio(tmp_path: Path, bag: str) -> None:
    messages = [
        septentrio(0),
        septentrio(1, mode=0),
        septentrio(2, latitude=-2e10, longitude=-2e10, height=-2e10),
        septentrio(3, h_accuracy=65535),
    ]

    fixes = record(tmp_path, messages, bag, gnss="/nav").gnss

    assert fixes is not None
    assert fixes.stamps_ns.tolist() == [START, START + 3 * SECOND]
    np.testing.assert_allclose(fixes.latitude_deg, 48.0)
    np.testing.assert_allclose(fixes.altitude_m, 545.0)
    assert fixes.cov_enu is not None
    # 2DRMS of 4 cm: 2 sqrt(2) sigma per axis; two sigma of 6 cm.
    np.testing.assert_allclose(fixes.cov_enu[0], np.diag([2e-4, 2e-4, 9e-4]), rtol=1e-9)
    assert np.isnan(fixes.cov_enu[1]).all()


def pose_stamped(k: int, position: tuple[float, float, float]) -> Message:
    return {
        "_type": "geometry_msgs/msg/PoseStamped",
        "header": header(START + k * SECOND, "world"),
        "pose": {"position": xyz(position), "orientation": {"w": 1.0}},
    }


def test_positions_of_a_total_station(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    places = np.array([300.0, -200.0, 5.0]) + np.cumsum(rng.uniform(-2, 3, (40, 3)), axis=0)
    messages = [pose_stamped(k, tuple(p)) for k, p in enumerate(places.tolist())]
    messages.append(pose_stamped(40, (1e300, 0.0, 0.0)))  # no place

    fixes = record(tmp_path, messages, gnss="/nav").gnss

    assert fixes is not None
    lidars = {"a": {"topic": "/a", "initial": {"xyz": [0, 0, 0]}}}
    config = Config.model_validate({"lidars": lidars})
    found, _ = positions_in_map(fixes, config, "drive")
    np.testing.assert_allclose(found.position_map, places - places[0], atol=1e-6)


def test_a_total_station_taken_for_poses_is_told(tmp_path: Path) -> None:
    messages = [pose_stamped(k, (float(k), float(k), 0.0)) for k in range(5)]
    timed = [("/nav", START + k * SECOND, m) for k, m in enumerate(messages)]
    bag = write_bag(tmp_path / "drive", timed)

    recording = RosbagRecording(bag, {}, TopicsConfig(pose="/nav"))

    assert isinstance(recording.motion().poses, GivenPoses)
    assert any("set topics.gnss to the topic instead" in line for line in recording.warnings())
    # Poses are not taken for fixes unless the config says so.
    assert choose_motion_topics(Bag(bag)).chosen == {"pose": "/nav"}


def test_init_finds_the_receivers(tmp_path: Path) -> None:
    timed = [("/ublox/navpvt", START, navpvt(0)), ("/oem7", START, inspvax("novatel_msgs", 0))]
    bag = write_bag(tmp_path / "drive", timed)

    motion = choose_motion_topics(Bag(bag))

    assert motion.chosen == {"pose": "/oem7"}
    assert motion.others["gnss"] == ("/ublox/navpvt",)
    assert isinstance(
        RosbagRecording(bag, {}, TopicsConfig(gnss="/ublox/navpvt")).motion().gnss, GnssFixes
    )
