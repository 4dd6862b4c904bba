"""What drives past walls alone determine, as `observability` and `calibrate` say it."""

from __future__ import annotations

import io
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config, GroundConfig, StructureConfig
from caliv_graph.pipeline import calibrate, prepare, structure_evidence
from caliv_graph.report.predicted import survey_document, survey_table
from caliv_graph.scenario.drive_models import StraightDrive
from caliv_graph.scenario.model import Scenario
from caliv_graph.scenario.sensor_models import LidarModel
from caliv_graph.scenario.world_models import WallModel, WorldModel
from caliv_graph.simulation.writer import config_of
from caliv_graph.uncertainty.pairs import pair_determined
from caliv_graph.workflows.next_drive import next_drive, recorded_drive
from caliv_graph.workflows.survey import Survey, survey_observations
from tests.drives_with_chair import paper_lidar, paper_scenario
from tests.kept import KeptDrive

STRAIGHT = StraightDrive(duration_s=9.0)


def wall(x_m: float, y_m: float, yaw_deg: float, length_m: float, seed: int) -> WallModel:
    return WallModel(xy_m=(x_m, y_m), yaw_deg=yaw_deg, length_m=length_m, seed=seed)


PARALLEL = {"left": wall(6, 7, 0, 18.0, 1), "right": wall(6, -7, 0, 18.0, 2)}
OBLIQUE = {"left": wall(8, 8, 25, 8.0, 1), "right": wall(8, -8, 30, 8.0, 2)}


def coarse(x_m: float, yaw_deg: float) -> LidarModel:
    return paper_lidar(x_m, yaw_deg, rate_hz=1.6).model_copy(
        update={"channels": 40, "horizontal_resolution_deg": 0.75}
    )


AHEAD = {"front": coarse(2.0, 0.0), "rear": coarse(-0.4, 180.0)}
ASIDE = {"front": coarse(2.0, 65.0), "rear": coarse(-0.4, -65.0)}


def scenario_of(objects: dict[str, WallModel], lidars: dict[str, LidarModel]) -> Scenario:
    return paper_scenario(STRAIGHT).model_copy(
        update={
            "lidars": lidars,
            "crop": None,
            "world": WorldModel(objects=dict(objects)),
        }
    )


CASES = {
    "parallel": (PARALLEL, AHEAD),
    "not shared": (OBLIQUE, ASIDE),
}


@cache
def driven(name: str) -> tuple[KeptDrive, Config]:
    recording = KeptDrive(scenario_of(*CASES[name]), 1)
    config = parse_config(config_of(recording, has_bag=True), name, Path())
    return recording, config.model_copy(update={"target": False, "ground": GroundConfig(use=True)})


@cache
def surveyed(name: str) -> Survey:
    recording, config = driven(name)
    found = prepare([recording], config, {0: recording.motion()}, SilentProgress())
    return survey_observations(
        found.observations,
        found.trajectories,
        found.grounds,
        found.config,
        SilentProgress(),
        structure_evidence(found),
    )


def test_parallel_walls_leave_open_what_lies_along_them() -> None:
    """Straight ahead between two fronts, in the result of `calibrate`."""
    recording, config = driven("parallel")

    run = calibrate([recording], config, SilentProgress())

    lost = {d.text: d.remedy for d in run.calibration.undetermined}
    assert {"x of lidar 'front'", "x of lidar 'rear'"} < set(lost)
    assert "walls that are not parallel" in lost["x of lidar 'front'"]
    assert "target" not in " ".join(lost.values())
    determined = pair_determined(run.calibration, "front", "rear")
    assert [axis for axis, known in determined.items() if not known] == ["x"]
    assert run.calibration.status == "partial"
    assert any("front" in line for line in run.calibration.unmet)


def test_walls_that_are_not_shared_are_named() -> None:
    found = surveyed("not shared")

    lost = {d.text: d.remedy for d in found.covariance.undetermined}
    assert found.shared_walls == {("front", "rear"): 0}
    assert min(found.wall_sightings.values()) > 50
    for name in ("front", "rear"):
        assert "each seen by all of these LiDARs" in lost[f"y of lidar '{name}'"]
        assert "each seen by all of these LiDARs" in lost[f"x of lidar '{name}'"]
    assert found.unmet
    words = Console(width=200, file=io.StringIO())
    words.print(survey_table(found))
    text = words.file.getvalue()  # type: ignore[attr-defined]
    assert "see no piece of a wall that the other sees" in text
    assert "Scans that see the target" not in text
    assert survey_document(found)["shared_walls"] == [{"lidars": ["front", "rear"], "strips": 0}]


def test_a_plan_of_the_recorded_drive_counts_its_walls() -> None:
    recording, config = driven("not shared")
    observed = surveyed("not shared")

    drive = recorded_drive(recording, config, SilentProgress())
    planned = next_drive([drive], [], drive.assumptions)

    found = planned.prediction
    assert found is not None
    (walls,) = found.walls
    assert walls is not None
    assert walls.strips == {("front", "rear"): 0}
    assert walls.scans.keys() == {("walls of the drive", name) for name in ASIDE}
    lost = {d.text for d in observed.covariance.undetermined}
    assert {d.text for d in found.undetermined} == lost
    for lidar, sigma in found.sigma_s2v.items():
        ratio = sigma / observed.covariance.sigma_s2v[lidar]
        assert (np.abs(np.log(ratio)) < np.log(1.35)).all()
    assert any("it is predicted by walls and ground" in note for note in planned.notes)
    # At the mountings of this drive its walls join, whatever those of another drive are.
    assert drive.mounted_as({}) == drive.scenario.lidars
    for lidar, model in drive.scenario.lidars.items():
        assert model.mounting.xyz != pytest.approx(config.lidars[lidar].given.xyz, abs=1e-3)


def test_walls_that_are_not_to_be_used_predict_nothing() -> None:
    recording, config = driven("parallel")
    without = config.model_copy(update={"structure": StructureConfig(use=False)})

    drive = recorded_drive(recording, without, SilentProgress())
    planned = next_drive([drive], [], drive.assumptions)

    assert planned.prediction is None
    assert any("walls are not used: there are no sigmas" in note for note in planned.notes)
