from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner, Result

from caliv_graph.cli.main import app
from caliv_graph.config.load import load_config
from caliv_graph.errors import ConfigError, OutputError, RecordingError
from caliv_graph.readers import open_recording
from caliv_graph.workflows.caliv_config import are_radians
from tests.cli.commands import write_drive
from tests.readers.bags import START, cloud, fix, header, imu, livox, odometry, tf, write_bag

ORIGINAL = """\
number_of_sensors: 2
transform_sensor_1:
  - [0.0, 10.0, 0.0, 2.259, 0.0, 1.938] # roll pitch yaw x y z
transform_sensor_2: [1.0, 10.0, 180.0, -0.4, 0.003, 2.1]
min_bound:
  - [10.0, -14.0, -5.0]
max_bound:
  - [20.0, -4.0, 5.0]
"""


def init(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["init", *map(str, arguments)])


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    return write_drive(tmp_path / "drive")


def test_guesses_of_a_caliv_config_beside_the_data(drive: Path, tmp_path: Path) -> None:
    (drive / "original_config.yaml").write_text(ORIGINAL)
    out = tmp_path / "configs/config.yaml"

    result = init(drive, "--out", out)

    warning = f"warning: {out}: fill in before you calibrate: ground.vehicle_height\n"
    assert (result.exit_code, result.stderr) == (0, warning)
    assert f"taken from {drive / 'original_config.yaml'}\n" in result.stdout
    config = load_config(out)
    assert list(config.lidars) == ["sensor_1", "sensor_2"]
    assert config.lidars["sensor_1"].given.xyz == (2.259, 0.0, 1.938)
    assert config.lidars["sensor_1"].given.rpy_deg == (0.0, 10.0, 0.0)
    assert config.lidars["sensor_2"].given.xyz == (-0.4, 0.003, 2.1)
    assert config.lidars["sensor_2"].given.rpy_deg == (1.0, 10.0, 180.0)
    assert config.target
    assert config.target[0].min == (10.0, -14.0, -5.0)
    assert config.target[0].max == (20.0, -4.0, 5.0)
    assert out.read_text().count("TODO") == 1
    # The path in it leads from the config to the data.
    assert open_recording(config).lidars == ("sensor_1", "sensor_2")


def test_what_is_not_known_is_left_to_a_person(drive: Path, tmp_path: Path) -> None:
    out = tmp_path / "config.yaml"

    result = init(drive / "input", "--out", out)

    assert result.exit_code == 0
    assert result.stderr == (
        f"warning: {out}: fill in before you calibrate: ground.vehicle_height\n"
    )
    text = out.read_text()
    assert text.count("TODO") == 1
    assert "The target is searched for" in text
    config = load_config(out)
    assert config.target is None
    assert config.lidars["sensor_1"].initial is None


GMMCALIB = """\
transform_sensor_1:
  - [-0.3461248, 0.0165291, -0.0162606, 2.31205, 0.581505, 1.610277] #[roll, pitch, yaw, x, y z]
transform_sensor_2:
  - [0.3551248, 0.0165291, 3.1415927, 2.311906, -0.664888, 1.612698]
"""


def test_angles_in_radians_in_the_folder_of_configs(drive: Path, tmp_path: Path) -> None:
    """As GMMCalib has them; CaLiV's keys are the same, its angles degrees."""
    (drive / "config").mkdir()
    (drive / "config/config.yaml").write_text(GMMCALIB)
    out = tmp_path / "config.yaml"

    result = init(drive, "--out", out)

    assert "Initial guesses taken from" in result.stdout  # it has no region of a target
    assert "config.yaml, whose angles are radians by their size" in result.stdout
    first, second = (load_config(out).lidars[f"sensor_{n}"].given for n in (1, 2))
    # 0.3461248 * 180 / pi and so on.
    assert first.rpy_deg == pytest.approx((-19.831491, 0.947048, -0.931664), abs=1e-5)
    assert first.xyz == (2.31205, 0.581505, 1.610277)
    assert second.rpy_deg == pytest.approx((20.347153, 0.947048, 180.0), abs=1e-5)
    assert "angles in radians there by their size: check them" in out.read_text()


@pytest.mark.parametrize(
    ("angles", "radians"),
    [
        ([(0.0, 10.0, 0.0), (0.0, 10.0, 180.0)], False),
        ([(0.0, 0.1745, 0.0), (0.0, 0.1745, 3.1416)], True),
        ([(-0.346, 0.0165, -0.0163), (0.355, 0.0165, 0.0061)], True),
        # Radians of pitch end at 1.57.
        ([(0.0, 2.0, 0.0), (0.0, 1.5, 0.0)], False),
        ([(0.0, 0.0, 0.0), (0.0, 0.0, 0.0)], False),
    ],
)
def test_the_unit_of_angles_by_their_size(angles: list[Any], radians: bool) -> None:
    assert are_radians(angles) is radians


def test_every_key_is_commented(drive: Path, tmp_path: Path) -> None:
    (drive / "original_config.yaml").write_text(ORIGINAL)
    init(drive, "--out", tmp_path / "config.yaml")

    bare = [
        line
        for line in (tmp_path / "config.yaml").read_text().splitlines()
        if line and "#" not in line
    ]

    # The names of sections and LiDARs, and the path, say what they are.
    names = [line.strip().rstrip(":") for line in bare]
    assert names == ["data", "path: drive", "sensor_1", "sensor_2", "solve", "robust"]


@pytest.mark.parametrize("name", ["a drive, #1: [x]", "1e3", "täst", "'quoted'"])
def test_odd_names_of_folders(tmp_path: Path, name: str) -> None:
    drive = write_drive(tmp_path / name)

    init(drive, "--out", tmp_path / "config.yaml")

    assert open_recording(load_config(tmp_path / "config.yaml")).lidars == ("sensor_1", "sensor_2")


def test_a_config_is_replaced_only_with_force(drive: Path, tmp_path: Path) -> None:
    out = tmp_path / "config.yaml"
    out.write_text("mine")

    refused = init(drive, "--out", out)

    assert isinstance(refused.exception, OutputError)
    assert out.read_text() == "mine"
    assert init(drive, "--out", out, "--force").exit_code == 0
    assert load_config(out).lidars


def test_the_config_that_guesses_were_read_from_is_not_replaced(drive: Path) -> None:
    original = drive / "config.yaml"
    original.write_text(ORIGINAL)

    refused = init(drive, "--out", original, "--force")

    assert isinstance(refused.exception, OutputError)
    assert "it is what this command reads" in str(refused.exception)
    assert original.read_text() == ORIGINAL


def test_other_yaml_beside_the_data_is_not_touched_by_it(drive: Path, tmp_path: Path) -> None:
    (drive / "a.yaml").write_text("no: [yaml")
    (drive / "b.yaml").write_text("- a list")
    (drive / "c.yaml").write_text(ORIGINAL)

    result = init(drive, "--out", tmp_path / "config.yaml")

    assert result.exit_code == 0
    assert "c.yaml" in result.stdout


def test_a_damaged_caliv_config_is_named(drive: Path, tmp_path: Path) -> None:
    (drive / "config.yaml").write_text("transform_sensor_1: [[0.0, 10.0, .nan, 1, 2, 3]]")

    result = init(drive, "--out", tmp_path / "out.yaml")

    assert isinstance(result.exception, ConfigError)
    assert "'transform_sensor_1.2': must be a finite number (got 'nan')" in str(result.exception)
    assert not (tmp_path / "out.yaml").exists()


NONE = (0.0, 0.0, 0.0, 1.0)
PITCHED = (0.0, math.sin(math.radians(5)), 0.0, math.cos(math.radians(5)))
STATIC = tf(
    ("base_link", "mast", (1.0, 0, 2.0), NONE),
    ("mast", "/lidar_front", (1.0, 0.25, 0), PITCHED),
    ("base_link", "imu_link", (0.5, 0, 0.25), NONE),
    ("lidar_rear", "base_footprint", (3.0, 0, -2.0), (0, 0, 1, 0)),
    ("base_footprint", "base_link", (0, 0, 0.5), NONE),
)


def write_sensors(path: Path, static: Any = STATIC, kind: str = "mcap") -> Path:
    messages = [
        ("/lidar/front/points", START, cloud(START, [[1, 2, 3]], frame_id="lidar_front")),
        ("/lidar/front/points_cropped", START, cloud(START, [[1, 2, 3]], frame_id="base_link")),
        ("/lidar/rear/points", START, livox(START, [[1, 2, 3]], [0], frame_id="lidar_rear")),
        ("/imu/data", START, imu(START)),
        ("/livox/imu", START, imu(START)),
        ("/fix", START, fix(START)),
        ("/odom", START, odometry(START, (0, 0, 0))),
    ]
    if static is not None:
        messages.insert(0, ("/tf_static", START, static))
    return write_bag(path, messages, kind)


@pytest.mark.parametrize("kind", ["mcap-zstd", "sqlite3", "ros1"])
def test_a_config_of_a_bag(tmp_path: Path, kind: str) -> None:
    bag = write_sensors(tmp_path / "drive", kind=kind)
    out = tmp_path / "configs/config.yaml"

    result = init(bag, "--out", out)

    assert result.exit_code == 0
    assert "Initial guesses of front, rear taken from /tf_static" in result.stdout
    assert result.stderr == f"warning: {out}: fill in before you calibrate: gnss.lever_arm\n"
    config = load_config(out)
    assert config.data.format == "rosbag"
    assert {name: lidar.topic for name, lidar in config.lidars.items()} == {
        "front": "/lidar/front/points",
        "rear": "/lidar/rear/points",
    }
    front, rear = config.lidars["front"].given, config.lidars["rear"].given
    assert (front.xyz, front.rpy_deg) == ((2.0, 0.25, 2.0), (0.0, 10.0, 0.0))
    # From base_link up to base_footprint and to the LiDAR's own frame, which is its parent.
    assert (rear.xyz, rear.rpy_deg) == ((3.0, 0.0, 1.5), (0.0, 0.0, 180.0))
    topics = config.topics
    assert (topics.imu, topics.gnss, topics.twist) == ("/imu/data", "/fix", "/odom")
    assert topics.pose is None
    assert config.imu.T_vehicle_imu.xyz == (0.5, 0.0, 0.25)
    # base_footprint is the point of the ground below the vehicle (REP-120).
    assert (config.ground.vehicle_height, config.ground.sigma) == (0.5, 0.005)
    text = out.read_text()
    assert text.count("TODO") == 1
    assert "  # imu: /livox/imu" in text
    assert "# not taken: /lidar/front/points_cropped" in text
    # The path in it leads from the config to the data, and every topic will do.
    recording = open_recording(config)
    assert recording.lidars == ("front", "rear")
    assert recording.motion().imu is not None


def test_every_key_of_a_config_of_a_bag_is_commented(tmp_path: Path) -> None:
    init(write_sensors(tmp_path / "drive"), "--out", tmp_path / "config.yaml")

    lines = (tmp_path / "config.yaml").read_text().splitlines()

    names = [line.strip().rstrip(":") for line in lines if line and "#" not in line]
    assert names == ["data", "path: drive", "imu", "front", "rear", "solve", "robust"]


def test_a_vehicle_with_wheels_and_two_antennas_instead_of_an_imu(tmp_path: Path) -> None:
    drifting = odometry(START, (0, 0, 0)) | {"header": header(START, "odom")}
    turn = {"_type": "geometry_msgs/msg/QuaternionStamped", "header": header(START, "gnss")}
    messages = [
        ("/points", START, cloud(START, [[1, 2, 3]], frame_id="lidar")),
        ("/fix", START, fix(START)),
        ("/odom", START, drifting),
        ("/heading", START, turn),
    ]
    out = tmp_path / "config.yaml"
    result = init(write_bag(tmp_path / "drive", messages), "--out", out)

    assert "fill in before you calibrate: gnss.lever_arm, heading.yaw_deg" in result.stderr
    config = load_config(out)
    topics = {key: topic for key, topic in config.topics.model_dump().items() if topic}
    assert topics == {"gnss": "/fix", "twist": "/odom", "heading": "/heading"}
    assert config.wheels.speed_scale_sigma == 0.02
    lines = out.read_text().splitlines()
    bare = [line.strip().rstrip(":") for line in lines if line and "#" not in line]
    assert bare == ["data", "path: drive", "lidar", "solve", "robust"]
    # Every topic of it can be read.
    assert open_recording(config).motion().gnss is not None


def test_extrinsics_from_a_urdf(tmp_path: Path) -> None:
    urdf = tmp_path / "car.urdf"
    urdf.write_text(
        """<robot name="car">
        <joint name="a" type="fixed"><parent link="chassis"/><child link="mast"/>
          <origin xyz="1 0 2" rpy="0 0 0"/></joint>
        <joint name="b" type="fixed"><parent link="mast"/><child link="lidar_front"/>
          <origin xyz="0.5 0 0" rpy="0 0 1.5707963267948966"/></joint>
        <joint name="c" type="revolute"><parent link="chassis"/><child link="lidar_rear"/></joint>
        </robot>"""
    )
    bag = write_sensors(tmp_path / "drive", static=None)
    out = tmp_path / "config.yaml"

    result = init(bag, "--urdf", urdf, "--out", out)

    assert result.exit_code == 0
    assert "Initial guesses of front taken from car.urdf" in result.stdout
    assert "calibrate: imu.T_vehicle_imu, gnss.lever_arm, ground" in result.stderr
    front = load_config(out).lidars["front"].given
    assert (front.xyz, front.rpy_deg) == ((1.5, 0.0, 2.0), (0.0, 0.0, 90.0))
    assert "car.urdf does not lead from chassis to lidar_rear" in out.read_text()


def test_a_urdf_has_the_last_word(tmp_path: Path) -> None:
    urdf = tmp_path / "car.urdf"
    urdf.write_text(
        """<robot name="car"><joint name="a" type="fixed"><parent link="mast"/>
        <child link="lidar_front"/><origin xyz="0 0 0.1"/></joint></robot>"""
    )

    init(write_sensors(tmp_path / "drive"), "--urdf", urdf, "--out", tmp_path / "config.yaml")

    config = load_config(tmp_path / "config.yaml")
    assert config.lidars["front"].given.xyz == (1.0, 0.0, 2.1)
    assert config.lidars["rear"].given.xyz == (3.0, 0.0, 1.5)


def test_a_bag_without_extrinsics(tmp_path: Path) -> None:
    out = tmp_path / "config.yaml"

    result = init(write_sensors(tmp_path / "drive", static=None), "--out", out)

    assert result.exit_code == 0
    assert "taken" not in result.stdout
    assert "calibrate: imu.T_vehicle_imu, gnss" in result.stderr
    assert load_config(out).lidars["front"].initial is None
    assert "the bag, which has no /tf_static, has no frame base_link" in out.read_text()
    # Zeros would say that the IMU's axes are the vehicle's; what is not known is estimated.
    assert load_config(out).imu.T_vehicle_imu.rpy_deg is None
    assert load_config(out).gnss.lever_arm is None
    assert load_config(out).ground.vehicle_height is None


def test_an_imu_in_the_frame_of_the_vehicle_is_there_already(tmp_path: Path) -> None:
    messages = [
        ("/points", START, cloud(START, [[1, 2, 3]], frame_id="os_sensor")),
        ("/imu/data", START, imu(START, frame_id="base_link")),
        ("/fix", START, fix(START) | {"header": header(START, "/base_link")}),
    ]
    out = tmp_path / "config.yaml"

    result = init(write_bag(tmp_path / "drive", messages), "--out", out)

    assert "calibrate: ground.vehicle_height\n" in result.stderr
    config = load_config(out)
    assert config.imu.T_vehicle_imu.rpy_deg == (0.0, 0.0, 0.0)
    assert config.gnss.lever_arm == (0.0, 0.0, 0.0)
    assert "its frame base_link is that of the vehicle" in out.read_text()


def test_frames_are_matched_by_their_names_as_export_does(tmp_path: Path) -> None:
    """Clouds in `front` and `rear`, of which the tree knows `lidar_front_link` and two rears."""
    links = tf(
        ("base_link", "lidar_front_link", (2.0, 0.0, 1.8), PITCHED),
        ("base_link", "rear_left_link", (-1.0, 0.5, 1.8), NONE),
        ("base_link", "rear_right_link", (-1.0, -0.5, 1.8), NONE),
        ("base_footprint", "base_link", (0, 0, 0.31), NONE),
    )
    messages = [
        ("/tf_static", START, links),
        ("/front/points", START, cloud(START, [[1, 2, 3]], frame_id="front")),
        ("/rear/points", START, cloud(START, [[1, 2, 3]], frame_id="rear")),
        ("/odom", START, odometry(START, (0, 0, 0))),
    ]
    out = tmp_path / "config.yaml"

    result = init(write_bag(tmp_path / "drive", messages), "--out", out)

    assert "Initial guesses of front taken from /tf_static" in result.stdout
    assert load_config(out).lidars["rear"].initial is None
    assert not result.stderr
    front = load_config(out).lidars["front"].given
    assert (front.xyz, front.rpy_deg) == ((2.0, 0.0, 1.8), (0.0, 10.0, 0.0))
    assert "base_link to lidar_front_link (by its name that of front)" in out.read_text()
    assert load_config(out).ground.vehicle_height == 0.31


@pytest.mark.parametrize(
    ("link", "height"),
    [
        (("base_footprint", "base_link", (0, 0, 0.4), NONE), 0.4),
        (("base_link", "base_footprint", (0.1, 0, -0.4), NONE), 0.4),
        (("base_link", "base_footprint", (0, 0, -0.4), PITCHED), None),
        (("base_link", "ground", (0, 0, -0.35), NONE), 0.35),
        (("base_footprint", "base_link", (0, 0, 40.0), NONE), None),
        (("base_footprint", "mast", (0, 0, 1.0), NONE), 0.0),
        (("base_link", "mast", (0, 0, 1.0), NONE), None),
    ],
)
def test_the_height_of_the_vehicle_frame_from_frames_on_the_ground(
    tmp_path: Path, link: Any, height: float | None
) -> None:
    messages = [
        ("/tf_static", START, tf(link)),
        ("/points", START, cloud(START, [[1, 2, 3]], frame_id="base_link")),
    ]
    out = tmp_path / "config.yaml"

    init(write_bag(tmp_path / "drive", messages), "--out", out)

    assert load_config(out).ground.vehicle_height == height


def test_extrinsics_repeated_on_tf(tmp_path: Path) -> None:
    moving = [
        ("/tf", START + k, tf(("odom", "base_link", (k, 0, 0), NONE), *links))
        for k, links in enumerate([[("base_link", "lidar", (1, 0, 2), NONE)]] * 5)
    ]
    points = ("/points", START, cloud(START, [[1, 2, 3]], frame_id="lidar"))

    init(write_bag(tmp_path / "drive", [points, *moving]), "--out", tmp_path / "config.yaml")

    config = load_config(tmp_path / "config.yaml")
    assert config.lidars["lidar"].given.xyz == (1.0, 0.0, 2.0)
    assert config.topics.pose == "/tf"


def test_a_bag_without_anything_that_tells_the_motion(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "drive", [("/points", START, cloud(START, [[1, 2, 3]]))])

    result = init(bag, "--out", tmp_path / "config.yaml")

    assert "fill in before you calibrate: ground.vehicle_height" in result.stderr
    assert "the LiDARs tell their motion" in (tmp_path / "config.yaml").read_text()
    assert not load_config(tmp_path / "config.yaml").names_motion()


@pytest.mark.parametrize("frame", ["a: b # c", "new\nline", "tab\there", "\x07", "'", "täst"])
def test_odd_names_in_a_bag(tmp_path: Path, frame: str) -> None:
    messages = [
        ("/1e3/points", START, cloud(START, [[1, 2, 3]], frame_id=frame)),
        ("/no/points", START, cloud(START, [[1, 2, 3]], frame_id="base_link")),
    ]

    init(write_bag(tmp_path / "drive", messages), "--out", tmp_path / "config.yaml")

    config = load_config(tmp_path / "config.yaml")
    assert list(config.lidars) == ["1e3", "no"]
    assert "\t" not in (tmp_path / "config.yaml").read_text()
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["reference"] == "1e3"


def test_a_urdf_places_nothing_in_a_caliv_folder(drive: Path, tmp_path: Path) -> None:
    result = init(drive, "--urdf", tmp_path / "car.urdf", "--out", tmp_path / "config.yaml")

    assert isinstance(result.exception, ConfigError)
    assert "is not a bag" in str(result.exception)


def test_a_bag_without_clouds_is_no_drive(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "drive", [("/imu", START, imu(START))])

    result = init(bag, "--out", tmp_path / "config.yaml")

    assert isinstance(result.exception, RecordingError)
    assert not (tmp_path / "config.yaml").exists()
