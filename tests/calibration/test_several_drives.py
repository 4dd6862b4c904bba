"""Several drives, several targets: what they share, and what each has of its own."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from functools import cache
from pathlib import Path

import gtsam
import numpy as np
import pytest

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.pipeline import calibrate
from caliv_graph.products import LidarScan, Recording
from caliv_graph.readers.forwarding import ForwardingRecording
from caliv_graph.results.run import CalibrationRun
from caliv_graph.scenario.drive_models import ArcDrive
from caliv_graph.scenario.model import CropModel, Scenario
from caliv_graph.scenario.sensor_models import GnssModel, ImuModel, LidarModel
from caliv_graph.scenario.world_models import ChairModel, GroundModel, ObjectModel, WorldModel
from caliv_graph.simulation.recording import SimulatedRecording
from caliv_graph.simulation.writer import config_of
from caliv_graph.uncertainty.evaluation import evaluate
from tests.drives_with_chair import without_structure
from tests.kept import KeptDrive

MM, MRAD = 1e-3, 1e-3

RIGHT = ArcDrive(duration_s=10.0, speed_m_s=3.0)
LEFT = ArcDrive(duration_s=10.0, speed_m_s=3.0, turn="left")

CHAIR = {"chair": ChairModel(xy_m=(15.16, -9.16), yaw_deg=90.0)}
CHAIR_LEFT = {"chair": ChairModel(xy_m=(15.16, 9.16), yaw_deg=-120.0)}
TWO_CHAIRS = {
    **CHAIR,
    "other": ChairModel(xy_m=(11.6, 0.6), yaw_deg=40.0),
}


def lidar(x_m: float, yaw_deg: float, y_m: float = 0.0) -> LidarModel:
    return LidarModel(
        mounting=PoseConfig(xyz=(x_m, y_m, 2.0), rpy_deg=(0.0, 10.0, yaw_deg)),
        rate_hz=2.5,
        channels=90,
        horizontal_resolution_deg=0.3,
    )


LIDARS = {"front": lidar(2.0, 0.0), "rear": lidar(-0.4, 180.0)}
THREE = {**LIDARS, "side": lidar(1.0, 60.0, 0.8)}


def scenario(
    drive: ArcDrive,
    objects: dict[str, ObjectModel],
    lidars: dict[str, LidarModel] = LIDARS,
    ground_m: float = 0.0,
    datum_deg: float = 48.0,
) -> Scenario:
    """A drive with raw sensors; each has a map origin and a ground of its own."""
    return Scenario(
        name="drive",
        drive=drive,
        lidars=lidars,
        world=WorldModel(
            ground=GroundModel(height_m=ground_m),
            objects=objects,
            targets=tuple(objects),
            region_margin_m=1.5,
        ),
        gnss=GnssModel(latitude_deg=datum_deg),
        imu=ImuModel(rate_hz=50.0),
        crop=CropModel(margin_m=0.5, elsewhere_stride=10),
    )


@cache
def right() -> SimulatedRecording:
    return KeptDrive(scenario(RIGHT, {**CHAIR}, THREE), 13)


@cache
def left() -> SimulatedRecording:
    """In another country, on higher ground, past a chair of its own."""
    return KeptDrive(scenario(LEFT, {**CHAIR_LEFT}, ground_m=3.0, datum_deg=51.0), 12)


def config(*recordings: SimulatedRecording, use: tuple[str, ...] = ()) -> Config:
    """Guesses of the first drive, regions of all, few scans and components."""
    raw = config_of(recordings[0], has_bag=True)
    # Of each drive its regions: what is in no region of a drive is nobody's target there.
    raw["target"] = [r for one in recordings for r in config_of(one, has_bag=True)["target"]]
    raw |= {"registration": {"components": 100, "max_points": 100}}
    raw["extraction"] = {"max_scans": 12}
    raw["require"] = []
    # The simulated errors of the fixes and of the orientation are white: nothing to look for.
    raw["noise"] = raw.get("noise", {}) | {
        "gnss_correlated_horizontal_m": 0.0,
        "orientation_correlated_deg": 0.0,
    }
    if use:
        raw["lidars"] = {name: raw["lidars"][name] for name in use}
    return without_structure(parse_config(raw, "config.yaml", Path("/nowhere")))


class WithoutSide(ForwardingRecording):
    """A drive in which one LiDAR of the config recorded nothing."""

    @property
    def lidars(self) -> tuple[str, ...]:
        return tuple(THREE)

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        return [] if lidar == "side" else super().scan_stamps_ns(lidar)

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        return iter(()) if lidar == "side" else super().scans(lidar, wanted)


@cache
def together() -> CalibrationRun:
    """The left arc without the LiDAR that looks to the side."""
    drives: list[Recording] = [right(), WithoutSide(left())]
    return calibrate(drives, config(right(), left()), SilentProgress())


def test_a_right_and_a_left_arc_tell_everything() -> None:
    run = together()
    assert run.calibration.undetermined == ()
    assert run.calibration.status == "ok"
    errors = evaluate(run.calibration, right().truth.T_vehicle_lidar)
    for name, result in run.calibration.lidars.items():
        assert all(result.determined.values())
        error = errors["lidars"][name]["s2v"]
        # 99.9 percent of a chi-square of 6 degrees of freedom.
        assert error["nees"] < 22.5
        if name != "side":  # it passes a chair once, for a few seconds
            # A 9.16 m lever: 40 mm of x would be 4 mrad of yaw, as either arc alone is off by.
            assert abs(error["rotation_rad"][2]) < 2.0 * MRAD
            assert np.abs(error["translation_m"][:2]).max() < 15 * MM


def test_drives_share_the_extrinsics_and_nothing_else() -> None:
    run = together()
    solution = run.solution
    # A placement in each drive that sees a target, in the map of that drive.
    assert [{c.drive for c in o.clouds} for o in run.observations if o.clouds] == [{0}, {1}]
    heights = [T.inverse().translation()[2] for T in solution.T_target_map]
    origins = [r.motion().gnss for r in (right(), left())]
    assert all(origin is not None for origin in origins)
    # Each map begins at its own first fix: the chair's middle stands 0.6 m over either ground.
    assert heights == pytest.approx([0.6, 0.6], abs=0.15)
    # One plane, one height error, and one chain of poses per drive; nothing joins two drives.
    graph, keys = solution.graph, {0: set[int](), 1: set[int]()}
    index = {pose: i for i, pose in enumerate(sorted(solution.T_map_vehicle))}
    for (drive, _), i in index.items():
        keys[drive].add(gtsam.symbol("x", i))
    for drive in (0, 1):
        keys[drive] |= {gtsam.symbol(letter, drive) for letter in "cgh"}
    assert keys[0] | keys[1] <= set(solution.values.keys())
    for i in range(graph.size()):
        touched = set(graph.at(i).keys())
        assert not (touched & keys[0] and touched & keys[1])


def test_a_lidar_that_is_missing_in_a_drive_is_told_and_solved_from_the_others() -> None:
    run = together()
    assert any("'side' has no scans in this drive" in line for line in run.calibration.warnings)
    assert {c.drive for o in run.observations for c in o.clouds if c.lidar == "side"} == {0}
    # Tied to the others by the first drive, and through them to the vehicle by both: its errors
    # are with those of the others above.
    assert all(run.calibration.lidars["side"].determined.values())


def test_two_targets_in_a_drive() -> None:
    recording = KeptDrive(scenario(RIGHT, {**TWO_CHAIRS}), 14)
    both = config(recording)
    assert both.target
    assert len(both.target) == 2
    run = calibrate([recording], both, SilentProgress())
    assert [o.name for o in run.observations] == ["target 1", "target 2"]
    assert all({c.lidar for c in o.clouds} == {"front", "rear"} for o in run.observations)
    places = [T.inverse().translation() for T in run.solution.T_target_map]
    # 10.4 m apart, each with a pose of its own.
    first, other = (np.array(chair.xy_m) for chair in TWO_CHAIRS.values())
    apart = float(np.linalg.norm((places[0] - places[1])[:2]))
    assert apart == pytest.approx(float(np.linalg.norm(first - other)), abs=0.15)
    (errors,) = evaluate(run.calibration, recording.truth.T_vehicle_lidar)["pairs"]
    assert np.abs(errors["rotation_rad"]).max() < 2.0 * MRAD
    # On an arc a second target moves no turn centre: the same is undetermined.
    (direction,) = run.calibration.undetermined
    assert direction.together
    assert "turn centre" in direction.text
