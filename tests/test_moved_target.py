"""A chair that is carried about while the vehicle stands: what this determines, and what not."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config, TargetRegion
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.errors import TargetError
from caliv_graph.pipeline import calibrate
from caliv_graph.products import Array
from caliv_graph.results.run import CalibrationRun
from caliv_graph.scenario.drive_models import StandstillDrive
from caliv_graph.scenario.model import CropModel, Scenario, load_scenario
from caliv_graph.scenario.sensor_models import ImuModel, LidarModel
from caliv_graph.scenario.world_models import ChairModel, MoveModel, WorldModel
from caliv_graph.simulation.recording import SimulatedRecording, simulate_drive
from caliv_graph.simulation.writer import config_of
from caliv_graph.targets import extract_targets
from caliv_graph.trajectory.select import smooth_trajectories
from caliv_graph.uncertainty.evaluation import evaluate
from tests.drives_with_chair import without_structure
from tests.kept import KeptDrive

SCENARIO = Path(__file__).resolve().parents[1] / "configs" / "scenarios" / "moved_target.yaml"
MM, MRAD = 1e-3, 1e-3

IN_BOTH_VIEWS = ((8.0, 3.5, 200.0), (6.5, 5.5, 260.0))
FRONT_ALONE = (9.0, -4.0, 140.0)
LEFT_ALONE = (0.0, 9.0, -60.0)


@dataclass(frozen=True)
class Standing:
    """A vehicle that stands, and the config that calibrates it quickly."""

    recording: SimulatedRecording
    config: Config

    def calibrated(self) -> CalibrationRun:
        return calibrate([self.recording], self.config, SilentProgress())


def lidar(x_m: float, y_m: float, yaw_deg: float, phase_s: float) -> LidarModel:
    return LidarModel(
        mounting=PoseConfig(xyz=(x_m, y_m, 2.0), rpy_deg=(0.0, 10.0, yaw_deg)),
        rate_hz=2.0,
        phase_s=phase_s,
        channels=90,
        horizontal_resolution_deg=0.27,
    )


def standing(*places: tuple[float, float, float], phase_s: float = 0.0, seed: int = 3) -> Standing:
    """The chair stands for 5 s at each of these places (x, y, yaw), with 2.5 s on the way."""
    moves = tuple(
        MoveModel(begin_s=7.5 * i + 5.0, end_s=7.5 * i + 7.5, xy_m=(x, y), yaw_deg=yaw)
        for i, (x, y, yaw) in enumerate(places[1:])
    )
    x, y, yaw = places[0]
    chair = ChairModel(xy_m=(x, y), yaw_deg=yaw, moves=moves)
    scenario = Scenario(
        name="moved",
        drive=StandstillDrive(duration_s=7.5 * len(places) - 2.5),
        lidars={"front": lidar(2.0, 0.0, 0.0, 0.0), "left": lidar(1.0, 0.8, 70.0, phase_s)},
        world=WorldModel(objects={"chair": chair}, targets=("chair",), region_margin_m=1.0),
        crop=CropModel(margin_m=0.3, elsewhere_stride=10),
        imu=ImuModel(rate_hz=50.0),
    )
    recording = KeptDrive(scenario, seed)
    raw = config_of(recording, has_bag=True)
    raw |= {"registration": {"components": 100, "max_points": 100}}
    # The simulated ranges have no bias; one of some millimetres, which real ones may have, would
    # leave the yaw of LiDARs that stand still to 2 mrad.
    raw |= {"noise": {**raw.get("noise", {}), "lidar_range_bias_m": 0.001}}
    config = parse_config(raw, "config.yaml", Path("/nowhere"))
    return Standing(recording, without_structure(config))


@cache
def shared() -> tuple[Standing, CalibrationRun]:
    drive = standing(*IN_BOTH_VIEWS, FRONT_ALONE, phase_s=0.1)
    return drive, drive.calibrated()


@cache
def unshared() -> CalibrationRun:
    return standing(FRONT_ALONE, LEFT_ALONE).calibrated()


def true_places(drive: Standing) -> Array:
    """(m, 2) the chair's places in the map."""
    chair = drive.recording.scenario.world.objects["chair"]
    return np.array([chair.xy_m, *(move.xy_m for move in chair.moves)])


def test_every_place_is_a_placement_of_its_own() -> None:
    drive, run = shared()
    seen_by = [sorted({c.lidar for c in o.clouds}) for o in run.observations]
    assert seen_by == [["front", "left"], ["front", "left"], ["front"]]
    assert [o.placement for o in run.observations] == [0, 1, 2]
    assert [o.name.split(" (")[0] for o in run.observations] == [
        f"target at place {i} of 3" for i in (1, 2, 3)
    ]
    # Not a point of the way, nor of who carried it: through the truth, every cloud is where the
    # chair stood at that time, and no larger than it.
    for observation, place in zip(run.observations, true_places(drive), strict=True):
        for cloud in observation.clouds:
            (T_map_vehicle,) = drive.recording.truth.T_map_vehicle(np.array([cloud.stamp_ns]))
            T = T_map_vehicle.compose(drive.recording.truth.T_vehicle_lidar[cloud.lidar])
            points = T.transformFrom(cloud.points_lidar.T).T
            assert np.linalg.norm(points[:, :2] - place, axis=1).max() < 0.7


def test_lidars_that_share_views_are_determined_against_each_other() -> None:
    drive, run = shared()
    assert all(direction.together for direction in run.calibration.undetermined)
    (pair,) = evaluate(run.calibration, drive.recording.truth.T_vehicle_lidar)["pairs"]
    assert np.abs(pair["rotation_rad"]).max() < 1.5 * MRAD
    assert np.abs(pair["translation_m"]).max() < 8 * MM


def test_nothing_is_known_to_the_vehicle_but_the_height() -> None:
    # Five of six, the ground determines the height.
    _, run = shared()
    assert run.calibration.status == "partial"
    assert len(run.calibration.undetermined) == 5
    for lidar_result in run.calibration.lidars.values():
        lost = [axis for axis, told in lidar_result.determined.items() if not told]
        assert lost == ["roll", "pitch", "yaw", "x", "y"]


def test_views_that_are_not_shared_leave_lidars_undetermined_against_each_other() -> None:
    run = unshared()
    assert [{c.lidar for c in o.clouds} for o in run.observations] == [{"front"}, {"left"}]
    # Of each other x, y and yaw: the ground that both see ties roll, pitch and height. And of the
    # vehicle the five of above.
    assert len(run.calibration.undetermined) == 8
    assert sum(not d.together for d in run.calibration.undetermined) >= 3
    for lidar_result in run.calibration.lidars.values():
        assert not any(lidar_result.determined[axis] for axis in ("x", "y", "yaw"))


def test_a_person_is_told() -> None:
    _, run = shared()
    (line,) = (w for w in run.calibration.warnings if "moved" in w)
    assert line == (
        "target: it was moved while the vehicle stood: 3 places, each solved for by itself: "
        "2 seen by 'front' and 'left', 1 seen by 'front' alone"
    )
    (line,) = (w for w in unshared().calibration.warnings if "moved" in w)
    assert "2 places" in line
    assert "No placement is shared, so S2S is unobservable: put it where two LiDARs see it" in line


def test_a_vehicle_that_stands_where_no_target_is_is_told_to_drive() -> None:
    drive = standing(IN_BOTH_VIEWS[0])
    region = TargetRegion(min=(60.0, 60.0, -1.0), max=(62.0, 62.0, 2.0))
    config = drive.config.model_copy(update={"target": (region,)})
    with pytest.raises(
        TargetError, match=r"The vehicle stands: it moves 0\.0\d m .* in 5\.0 s"
    ) as e:
        calibrate([drive.recording], config, SilentProgress())
    # A target that was carried may be outside of the region, too.
    assert "target" in e.value.remedy.partition("several places")[2]


def test_a_chair_that_nobody_moves_is_one_placement() -> None:
    drive = standing(IN_BOTH_VIEWS[0])
    trajectories = smooth_trajectories([drive.recording], drive.config, [[]])
    observations = extract_targets([drive.recording], trajectories, drive.config, SilentProgress())
    assert [o.name for o in observations] == ["target"]
    assert observations[0].warnings == ()


@pytest.mark.parametrize("name", ["front", "left"])
def test_the_scenario_shows_the_chair_at_four_places(name: str) -> None:
    scenario = load_scenario(SCENARIO)
    recording = simulate_drive(scenario, 1)  # four clouds are all that is wanted of it
    chair = scenario.world.objects["chair"]
    assert len(chair.moves) == 3
    wanted = {
        recording.truth.start_ns + round(1e9 * s): shows
        for s, shows in ((3.0, True), (13.0, True), (23.0, True), (35.0, name == "front"))
    }
    target = recording.world.names.index("chair")
    for taken in recording.scans_with_truth(name, wanted):
        shown = int((taken.objects == target).sum()) > 200
        assert shown == wanted[taken.scan.stamp_ns]
