from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from caliv_graph.cli.main import app
from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config
from caliv_graph.errors import RecordingError
from caliv_graph.pipeline import Look
from caliv_graph.products import Recording, TargetCloud, TargetObservation
from caliv_graph.targets.cloud.choice import Choose
from caliv_graph.targets.search import FoundTarget
from caliv_graph.trajectory.select import VehicleTrajectory
from tests.cli.commands import write_config, write_drive
from tests.readers.bags import (
    SECOND,
    START,
    cloud,
    fix,
    imu,
    odometry,
    packed_cloud,
    write_bag,
)


def inspect(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["inspect", *map(str, arguments)])


def test_a_folder_without_a_config(tmp_path: Path) -> None:
    drive = write_drive(tmp_path / "drive", sensors=11, frames=5)
    (drive / "input/sensor_1/2.pcd").unlink()

    result = inspect(drive, "--json")

    assert result.exit_code == 0
    document = json.loads(result.stdout)
    # By number: sensor_10 comes after sensor_9.
    assert list(document["lidars"]) == [f"sensor_{number}" for number in range(1, 12)]
    first = document["lidars"]["sensor_1"]
    assert (first["clouds"], first["frames"], first["gaps"]) == (4, [0, 4], [[1, 3]])
    assert first["points"] == {"min": 4, "median": 4, "max": 4}
    assert first["rate_hz"] == pytest.approx(10.0)
    assert document["drive"]["path_length_m"] == pytest.approx(4.0)
    assert document["drive"]["heading_change_deg"] == pytest.approx(0.0)
    assert document["targets"] is None
    assert "poses without a cloud are skipped: 1 of sensor_1" in result.stderr


def test_the_folder_itself_or_the_one_around_it(tmp_path: Path) -> None:
    drive = write_drive(tmp_path / "drive")

    outer, inner = (json.loads(inspect(path, "--json").stdout) for path in (drive, drive / "input"))

    assert outer["lidars"] == inner["lidars"]


def test_guesses_that_nobody_filled_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The zeros of a draft are no guesses: the mountings are looked for."""
    looked: list[Config] = []

    def look(recording: Recording, config: Config, progress: Progress) -> Look:
        looked.append(config)
        return Look(None, (), ())

    monkeypatch.setattr("caliv_graph.pipeline.look", look)
    zeros = {"initial": {"xyz": [0, 0, 0], "rpy_deg": [0, 0, 0]}}
    lidars = {name: {"topic": f"sensor_{n}", **zeros} for n, name in ((1, "left"), (2, "right"))}
    config = write_config(tmp_path / "config.yaml", lidars=lidars)

    result = inspect(write_drive(tmp_path / "drive"), "--config", config, "--json")

    assert result.exit_code == 0
    assert json.loads(result.stdout)["targets"] is None
    assert result.stderr.startswith(
        f"warning: {config}: lidars.left.initial and lidars.right.initial are all zeros"
    )
    assert "errors of 0.1 m and 3 degrees are fine" in result.stderr
    assert [lidar.initial for lidar in looked[0].lidars.values()] == [None, None]


def test_a_table(tmp_path: Path) -> None:
    result = inspect(write_drive(tmp_path / "drive"))

    assert result.exit_code == 0
    assert "reading the clouds: 6/6 in " in result.stdout
    row = next(line for line in result.stdout.splitlines() if line.startswith("sensor_2"))
    assert row.split() == ["sensor_2", "3", "0", "to", "2", "1", "10", "4", "/", "4", "/", "4"]


def test_with_a_config_who_sees_the_target_when(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def extract(
        recordings: Sequence[Recording],
        trajectories: Sequence[VehicleTrajectory],
        config: Config,
        progress: Progress,
        choose: Choose,
        searched: Sequence[FoundTarget],
    ) -> tuple[TargetObservation, ...]:
        assert len(trajectories[0].trajectory.T_map_vehicle) == 3
        cloud = TargetCloud("front", 0, 100_000_000, np.full((60, 3), 4.0), "1.pcd")
        return (TargetObservation(0, "target", np.zeros(3), (cloud,), ("2 scans were cut",)),)

    monkeypatch.setattr("caliv_graph.pipeline.preparation.find_target", lambda *_: [])
    monkeypatch.setattr("caliv_graph.pipeline.preparation.extract_targets", extract)
    drive = write_drive(tmp_path / "drive")
    config = write_config(tmp_path / "config.yaml")

    result = inspect(drive, "--config", config, "--json")

    assert result.exit_code == 0
    document = json.loads(result.stdout)
    assert list(document["lidars"]) == ["front", "rear"]
    (target,) = document["targets"]
    assert target["lidars"]["front"]["frames"] == [[1, 1]]
    assert target["lidars"]["rear"]["scans"] == 0
    assert result.stderr == "warning: 2 scans were cut\n"


def bag_messages(count: int = 20) -> list[tuple[str, int, dict[str, object]]]:
    out = []
    for k in range(count):
        stamp = START + k * SECOND // 10
        points = [[4.0, 0, 0]] * (k + 2)
        out.append(("/odom", stamp, odometry(stamp, (k, 0, 0))))
        if k not in (5, 6):
            times_ns = [80_000 * i for i in range(k + 2)]
            out.append(("/lidar/front/points", stamp + 9, cloud(stamp, points, times_ns)))
        out.append(("/imu", stamp, imu(stamp, (0, 0, 1))))
        out.append(("/fix", stamp, fix(stamp, status=-1 if k < 4 else 0)))
        out.append(("/chatter", stamp, {"_type": "std_msgs/msg/String", "data": "hello"}))
    return out


@pytest.mark.parametrize("kind", ["mcap", "ros1"])
def test_a_bag_without_a_config(tmp_path: Path, kind: str) -> None:
    bag = write_bag(tmp_path / "drive", bag_messages(), kind)

    result = inspect(bag, "--json")

    assert result.exit_code == 0
    document = json.loads(result.stdout)
    assert document["duration_s"] == pytest.approx(1.9, abs=1e-6)
    topics = document["topics"]
    assert list(topics) == ["/chatter", "/fix", "/imu", "/lidar/front/points", "/odom"]
    assert (topics["/chatter"]["messages"], topics["/chatter"]["read"]) == (20, False)
    assert topics["/chatter"]["rate_hz"] == pytest.approx(10.0)
    points = topics["/lidar/front/points"]
    assert (points["messages"], points["gaps"], points["frame_id"]) == (18, 1, "lidar")
    assert points["longest_gaps_s"] == [[pytest.approx(0.4), pytest.approx(0.7)]]
    assert points["header_minus_record_s"] == pytest.approx([-9e-9] * 3)
    front = document["lidars"]["front"]
    assert (front["topic"], front["clouds"], front["sampled"]) == ("/lidar/front/points", 18, 18)
    assert front["points"] == {"min": 2, "median": 12, "max": 21}
    assert front["times"] == {
        "field": "t",
        "type": "uint32",
        "unit": "ns after the stamp",
        "first_s": 0.0,
        "last_s": pytest.approx(1.6e-3),
    }
    assert "units of g" in document["imus"]["/imu"]["problems"][0]
    assert document["gnss_fixes"] == {"/fix": 16}
    assert document["targets"] is None


def test_a_table_of_a_bag(tmp_path: Path) -> None:
    messages = [m for m in bag_messages() if m[0] not in ("/imu", "/fix")]
    result = inspect(write_bag(tmp_path / "drive", messages))

    assert result.exit_code == 0
    assert result.stderr == ""
    lines = [line.split() for line in result.stdout.splitlines()]
    cells = next(cells for cells in lines if cells[:1] == ["/lidar/front/points"])
    assert cells[1:4] == ["18", "10", "1"]
    assert "0.3 s" in result.stdout
    cells = next(cells for cells in lines if cells[:1] == ["front"])
    assert cells[1:8] == ["lidar", "18", "2", "/", "12", "/", "21"]
    assert "Drive: 20 poses, 19.0 m in 1.9 s, " in result.stdout


def test_a_long_bag_is_sampled(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "drive", bag_messages(100))

    front = json.loads(inspect(bag, "--json").stdout)["lidars"]["front"]

    assert (front["clouds"], front["sampled"]) == (98, 20)
    # The first and the last are among them.
    assert (front["points"]["min"], front["points"]["max"]) == (2, 101)


def test_a_bag_with_a_config_tells_times_of_sightings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def extract(recordings: Sequence[Recording], *_: object) -> tuple[TargetObservation, ...]:
        stamps = recordings[0].scan_stamps_ns("front")
        clouds = tuple(
            TargetCloud("front", 0, stamps[k], np.full((60, 3), 4.0), "a cloud")
            for k in (0, 1, 2, 9, 10)
        )
        return (TargetObservation(0, "target", np.zeros(3), clouds),)

    monkeypatch.setattr("caliv_graph.pipeline.preparation.find_target", lambda *_: [])
    monkeypatch.setattr("caliv_graph.pipeline.preparation.extract_targets", extract)
    bag = write_bag(tmp_path / "drive", bag_messages())
    lidars = {"front": {"topic": "/lidar/front/points", "initial": {"xyz": [0, 0, 0]}}}
    config = write_config(
        tmp_path / "config.yaml",
        data={"format": "rosbag"},
        topics={"pose": "/odom"},
        lidars=lidars,
    )

    document = json.loads(inspect(bag, "--config", config, "--json").stdout)

    (target,) = document["targets"]
    # The eighth cloud is that of 0.9 s, after a gap of two.
    first, second = target["lidars"]["front"]["times_s"]
    assert (first, second) == (pytest.approx([0.0, 0.2]), pytest.approx([1.1, 1.2]))
    table = inspect(bag, "--config", config).stdout
    assert "0.0 to 0.2, 1.1 to 1.2" in table


def test_sightings_are_told_though_a_calibration_uses_some_of_the_clouds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def extract(recordings: Sequence[Recording], *_: object) -> tuple[TargetObservation, ...]:
        stamps = recordings[0].scan_stamps_ns("front")
        clouds = tuple(
            TargetCloud("front", 0, stamps[k], np.full((60, 3), 4.0), "a cloud") for k in (8, 24)
        )
        # A long drive: every other scan was looked at.
        seen_ns = {"front": tuple(stamps[k] for k in (8, 10, 12, 14, 22, 24, 26))}
        return (TargetObservation(0, "target", np.zeros(3), clouds, seen_ns=seen_ns),)

    monkeypatch.setattr("caliv_graph.pipeline.preparation.find_target", lambda *_: [])
    monkeypatch.setattr("caliv_graph.pipeline.preparation.extract_targets", extract)
    bag = write_bag(tmp_path / "drive", bag_messages(30))
    lidars = {"front": {"topic": "/lidar/front/points", "initial": {"xyz": [0, 0, 0]}}}
    config = write_config(
        tmp_path / "config.yaml",
        data={"format": "rosbag"},
        topics={"pose": "/odom"},
        lidars=lidars,
    )

    (target,) = json.loads(inspect(bag, "--config", config, "--json").stdout)["targets"]

    front = target["lidars"]["front"]
    assert front["scans"] == 7
    # Two clouds are missing from the bag before these.
    assert [round(t, 1) for run in front["times_s"] for t in run] == [1.0, 1.6, 2.4, 2.8]


def test_a_bag_that_is_cut_off_is_named(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    path.touch()

    result = inspect(path)

    assert isinstance(result.exception, RecordingError)
    assert str(result.exception).startswith(f"{path}: the bag is cut off, damaged")


def test_clouds_that_cannot_be_read_do_not_hide_the_rest(tmp_path: Path) -> None:
    drive = write_drive(tmp_path / "drive", frames=5)
    for frame in (1, 2):
        (drive / f"input/sensor_1/{frame}.pcd").write_text("VERSION .7")

    result = inspect(drive, "--json")

    assert result.exit_code == 0
    lidars = json.loads(result.stdout)["lidars"]
    assert [lidar["points"]["median"] for lidar in lidars.values()] == [4, 4]
    assert "1.pcd: the header has no complete DATA line" in result.stderr
    assert "In all 2 clouds of lidar 'sensor_1' cannot be read" in result.stderr


def radar(stamp: int) -> dict[str, object]:
    """A cloud in polar coordinates."""
    return packed_cloud(stamp, {"range": (np.ones(5), "f4"), "azimuth": (np.ones(5), "f4")})


def test_a_topic_of_other_clouds_does_not_hide_the_rest(tmp_path: Path) -> None:
    stamps = [START + k * SECOND // 10 for k in range(20)]
    messages = [*bag_messages(), *(("/radar/points", stamp, radar(stamp)) for stamp in stamps)]
    page = tmp_path / "page.html"

    result = inspect(write_bag(tmp_path / "drive", messages), "--json", "--html", page)

    assert result.exit_code == 0
    document = json.loads(result.stdout)
    assert document["lidars"]["front"]["points"]["max"] == 21
    assert document["lidars"]["radar"]["points"] is None
    assert "x, y, z as float32 or float64 are needed" in result.stderr
    assert page.exists()


def scene_of_page(page: Path) -> dict[str, Any]:
    text = page.read_text(encoding="utf-8")
    (data,) = re.findall(r'<script type="application/json" id="data-scene">(.*?)</script>', text)
    document: dict[str, Any] = json.loads(data)
    return document


@pytest.mark.parametrize("kind", ["folder", "bag"])
def test_a_page_without_a_config(tmp_path: Path, kind: str) -> None:
    """The names and mountings are those of the config that `init` would draft."""
    if kind == "folder":
        drive = write_drive(tmp_path / "drive", frames=5)
    else:
        messages = [m for m in bag_messages() if m[0] not in ("/imu", "/fix")]
        drive = write_bag(tmp_path / "drive", messages)
    page = tmp_path / "pages/drive.html"

    result = inspect(drive, "--html", page)

    assert result.exit_code == 0
    assert f"Written to {page}" in " ".join(result.stdout.split())
    assert result.stderr == ""
    scene = scene_of_page(page)
    names = ["sensor_1", "sensor_2"] if kind == "folder" else ["front"]
    assert [lidar["name"] for lidar in scene["lidars"]] == names
    assert all(lidar["origin"] == "mounting unknown" for lidar in scene["lidars"])
    # 1 m per frame.
    assert scene["path"][-1][0] - scene["path"][0][0] == pytest.approx(
        4.0 if kind == "folder" else 19.0
    )
    for lidar in scene["lidars"]:
        assert sum(count for count, _ in lidar["along"]["pieces"]) > 0


def test_a_page_is_not_replaced_unless_it_is_to_be(tmp_path: Path) -> None:
    drive = write_drive(tmp_path / "drive")
    page = tmp_path / "page.html"
    page.write_text("mine")

    refused, done = inspect(drive, "--html", page), inspect(drive, "--html", page, "--force")

    assert "exists already. Give --force" in str(refused.exception)
    assert refused.stdout == ""
    assert done.exit_code == 0
    assert page.read_text().startswith("<!DOCTYPE html>")


def test_a_page_with_mountings_that_nobody_filled_in(tmp_path: Path) -> None:
    lidars = {name: {"topic": f"sensor_{n}"} for n, name in ((1, "left"), (2, "right"))}
    config = write_config(tmp_path / "config.yaml", lidars=lidars)
    page = tmp_path / "page.html"

    result = inspect(write_drive(tmp_path / "drive", frames=5), "--config", config, "--html", page)

    assert result.exit_code == 0
    assert "lidars.left.initial is not given" in result.stderr
    for lidar in scene_of_page(page)["lidars"]:
        assert (lidar["known"], lidar["xyz"]) == (False, [0.0, 0.0, 0.0])
