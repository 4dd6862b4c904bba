"""A simulated drive, written as different drivers write it, is read as it was taken."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from caliv_graph.cli.main import app
from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.model import TopicsConfig
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.readers.rosbag import RosbagRecording
from caliv_graph.scenario.drive_models import ArcDrive
from caliv_graph.scenario.model import BagModel, Scenario
from caliv_graph.scenario.sensor_models import LidarModel, SweepModel
from caliv_graph.scenario.world_models import ChairModel, WorldModel
from caliv_graph.simulation import simulate_drive, write_drive
from caliv_graph.simulation.writer import topic_of_lidar

SEED = 5


def turning(**sweep: object) -> LidarModel:
    return LidarModel(
        mounting=PoseConfig(xyz=(0.0, 0.0, 2.0)),
        channels=16,
        horizontal_fov_deg=(-180.0, 180.0),
        vertical_fov_deg=(-15.0, 15.0),
        horizontal_resolution_deg=1.0,
        sweep=SweepModel.model_validate(sweep),
    )


SCENARIO = Scenario(
    name="dialects",
    drive=ArcDrive(standstill_s=0.2, ramp_s=0.3, duration_s=1.0),
    lidars={
        "plain": turning(time_field="t"),
        "ouster": turning(time_field="t", stamp_at="end", times_from="start"),
        "velodyne": turning(
            time_field="time", stamp_at="end", times_from="start", packet_s=1.327104e-3
        ),
    },
    world=WorldModel(objects={"chair": ChairModel(xy_m=(9.0, -3.0))}, targets=("chair",)),
    bag=BagModel(transport_s=0.004),
    crop=None,
)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    written = write_drive(SCENARIO, tmp_path_factory.mktemp("dialects") / "out", SEED, threads=1)
    return written.folder / "drive"


def opened(bag: Path, lidar: str, **more: object) -> RosbagRecording:
    raw = {"topic": topic_of_lidar(lidar), "initial": PoseConfig(xyz=(0.0, 0.0, 0.0)), **more}
    return RosbagRecording(bag, {lidar: LidarConfig.model_validate(raw)}, TopicsConfig())


@pytest.mark.parametrize(
    ("lidar", "marks", "notes"),
    [
        ("plain", "start", []),
        ("ouster", "end", ["stamps mark the end of the sweep: clouds are recorded 4 ms after"]),
        (
            "velodyne",
            "end",
            ["starts anew with every packet, 76 times a cloud", "stamps mark the end"],
        ),
    ],
)
def test_points_have_the_times_at_which_they_were_taken(
    bag: Path, lidar: str, marks: str, notes: list[str]
) -> None:
    recording = opened(bag, lidar)
    column_s = 0.1 / 360

    scans = list(recording.scans(lidar))
    truth = list(simulate_drive(SCENARIO, SEED).scans(lidar))

    assert len(scans) == len(truth) == 10
    for scan, true in zip(scans, truth, strict=True):
        assert scan.stamp_ns == true.stamp_ns
        assert scan.point_times_s is not None
        assert true.point_times_s is not None
        true_s = true.point_times_s
        if lidar == "velodyne":  # written in the order of measurement
            true_s = np.sort(true_s)
        # The end of a sweep is its last point, a column before the next sweep begins.
        np.testing.assert_allclose(scan.point_times_s, true_s, atol=1.5 * column_s)
    assert recording.stamp_mark(lidar).marks == marks
    assert len(recording.warnings()) == len(notes)
    for line, note in zip(recording.warnings(), notes, strict=True):
        assert note in line


def test_the_config_overrules_the_data(bag: Path) -> None:
    recording = opened(bag, "ouster", stamp="start")

    scan = next(iter(recording.scans("ouster")))

    assert scan.point_times_s is not None
    assert scan.point_times_s.min() >= 0.0
    assert recording.warnings() == []


def test_inspect_shows_what_the_stamps_mark(bag: Path) -> None:
    result = CliRunner().invoke(app, ["inspect", str(bag), "--json"])

    assert result.exit_code == 0, result.output
    lidars = json.loads(result.stdout)["lidars"]
    assert {name: lidar["stamp_marks"] for name, lidar in lidars.items()} == {
        "plain": "start",
        "ouster": "end",
        "velodyne": "end",
    }
    assert {lidar["stamp_told_by"] for lidar in lidars.values()} == {"records"}
    assert lidars["ouster"]["times"]["last_s"] == 0.0
    assert lidars["ouster"]["stamp_shift_s"] == pytest.approx(-0.0997, abs=1e-4)
