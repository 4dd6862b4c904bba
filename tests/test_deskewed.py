"""A drive past walls whose clouds were deskewed before they were recorded, times and all."""

from __future__ import annotations

from functools import cache

import gtsam
import numpy as np

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.model import Config, GroundConfig
from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.pipeline import calibrate
from caliv_graph.results.run import CalibrationRun
from tests.drives_with_chair import Memory
from tests.samples import pose
from tests.structure.worlds import Spinner, deskewed_before, driven, guessed, near_yard, recorded
from tests.trajectory.motions import eight_drive

TRUTH = {
    "front": pose((2.0, 0.3, 1.8), (2.0, 3.0, 20.0)),
    "rear": pose((-1.0, -0.2, 1.6), (-1.0, 2.0, 175.0)),
}
OFF = gtsam.Pose3(gtsam.Rot3.Expmap(np.radians([1.0, -1.0, 2.0])), np.array([0.05, -0.05, 0.02]))


def config() -> Config:
    return Config(
        lidars=guessed({name: T * OFF for name, T in TRUTH.items()}),
        ground=GroundConfig(vehicle_height=0.0),
        target=False,
    )


@cache
def deskewed_drive() -> Memory:
    """Of 360 degrees in 0.1 s, every second; the rear LiDAR has no end in sight."""
    way = driven(eight_drive())
    begin, end = way.span_ns
    stamps = np.arange(begin + 100_000_000, end - 100_000_000, 1_000_000_000, dtype=np.int64)
    around = np.linspace(-180.0, 180.0, 600, endpoint=False)
    lidars = {
        "front": Spinner(TRUTH["front"], np.arange(-16.0, 10.0), around, sweep_s=0.1),
        "rear": Spinner(TRUTH["rear"], np.arange(-16.0, 10.0), around[200:400], sweep_s=0.03),
    }
    drive = recorded(near_yard(), way, lidars, dict.fromkeys(lidars, stamps))
    return deskewed_before(drive, way, TRUTH)


@cache
def found() -> CalibrationRun:
    return calibrate([deskewed_drive()], config(), SilentProgress())


def test_their_times_are_not_used_and_the_warning_says_so() -> None:
    result = found().calibration

    assert result.status == "ok"
    (said,) = (line for line in result.warnings if "deskewed" in line)
    assert "lidar 'front' (" in said
    assert "and 'rear', which does not tell, were deskewed before they were recorded" in said
    for name, lidar in result.lidars.items():
        error = vehicle_axes_difference(lidar.T_vehicle_lidar, TRUTH[name])
        assert np.abs(error[:3]).max() < 1e-3, name
        assert np.abs(error[3:]).max() < 3e-3, name
    record = found().record
    assert record is not None
    assert all(scan.point_times_s is None for scan in record.scene[0])
