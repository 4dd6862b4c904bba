"""What a recorded drive is predicted to tell, beside the truth of its scenario and a survey."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.guesses import TRUSTED_SIGMAS, configured_guess, with_found_guess
from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config, TopicsConfig
from caliv_graph.errors import ConfigError, TrajectoryError
from caliv_graph.planning.predict import Prediction, predict, predict_drives
from caliv_graph.planning.suggest import is_met, shortfall, suggest
from caliv_graph.products import MotionData
from caliv_graph.scenario.drive_models import ArcDrive
from caliv_graph.simulation.writer import config_of
from caliv_graph.workflows.next_drive import RecordedDrive, next_drive, recorded_drive
from tests.drives_with_chair import without_structure
from tests.kept import KeptDrive
from tests.workflows.test_survey import TURN, from_the_recording, recorded, scenario_of


@functools.cache
def arc() -> tuple[KeptDrive, Config, RecordedDrive]:
    recording = recorded("arc")
    config = without_structure(parse_config(config_of(recording, has_bag=True), "arc", Path()))
    return recording, config, recorded_drive(recording, config, SilentProgress())


def alone(drive: RecordedDrive) -> Prediction:
    planned = next_drive([drive], [], drive.assumptions)
    assert planned.prediction is not None
    return planned.prediction


def test_the_vehicle_is_that_of_the_scenario() -> None:
    true, (_, config, drive) = scenario_of("arc"), arc()
    found = drive.scenario

    for name, lidar in true.lidars.items():
        model = found.lidars[name]
        # The edge of a cropped cloud is as far off as the columns that were left are apart.
        assert model.horizontal_fov_deg == pytest.approx(lidar.horizontal_fov_deg, abs=2.5)
        assert model.vertical_fov_deg[0] == pytest.approx(lidar.vertical_fov_deg[0], abs=0.01)
        # Nose down by 10 degrees over open ground, channels above 10 never return.
        assert 8.0 < model.vertical_fov_deg[1] < 10.1
        spacing = np.diff(model.vertical_fov_deg)[0] / (model.channels - 1)
        assert spacing == pytest.approx(25.0 / 151.0, rel=0.01)
        assert model.horizontal_resolution_deg == pytest.approx(0.18237, rel=0.01)
        assert model.rate_hz == pytest.approx(lidar.rate_hz, rel=1e-3)
        assert model.mounting.xyz == pytest.approx(config.lidars[name].given.xyz, abs=1e-4)
    assert found.world.objects["target"].shape == "chair"
    chair = true.world.objects["chair"]
    assert found.world.objects["target"].xy_m == pytest.approx(chair.xy_m, abs=0.3)
    assert found.imu.gyroscope_sigma_rad_s == pytest.approx(true.imu.gyroscope_sigma_rad_s)
    assert found.gnss.horizontal_sigma_m == pytest.approx(0.0167, rel=0.05)
    assert found.velocity.sigma_m_s == pytest.approx(true.velocity.sigma_m_s)
    assert found.drive.radius_m == pytest.approx(9.16, rel=0.05)  # type: ignore[union-attr]


def test_as_recorded_is_what_the_scenario_and_a_survey_predict() -> None:
    _, _, drive = arc()

    found = alone(drive)

    planned = predict(scenario_of("arc"), assumptions=replace(drive.assumptions, structure=False))
    surveyed = from_the_recording()[0].covariance
    for name, sigma in found.sigma_s2v.items():
        assert sigma / planned.sigma_s2v[name] == pytest.approx(np.ones(6), abs=0.1)
        assert (np.abs(np.log(sigma / surveyed.sigma_s2v[name])) < np.log(1.5)).all()
    pair = ("front", "rear")
    assert found.sigma_s2s[pair] / planned.sigma_s2s[pair] == pytest.approx(np.ones(6), abs=0.1)
    # Roll, pitch and z of the pair are as good as the ground is flat.
    flat = found.sigma_s2s[pair][2:5] / surveyed.sigma_s2s[pair][2:5]
    assert (np.abs(np.log(flat)) < np.log(1.5)).all()
    (turn,) = found.undetermined
    assert turn.text.startswith(TURN)


def test_without_initial_guesses_a_plan_promises_what_a_calibration_gives() -> None:
    _, config, drive = arc()
    start = {name: config.lidars[name].guess() for name in config.lidars}
    for name, T in start.items():
        config = with_found_guess(config, name, T)
    guesses = {name: configured_guess(config, name) for name in config.lidars}
    drive = replace(drive, assumptions=replace(drive.assumptions, guesses=guesses))

    found = alone(drive)

    for name, sigma in found.sigma_s2v.items():
        assert 5.0 < sigma[3] < 8.0
        assert not found.covariance.calibration.lidars[name].determined["y"]
    # Both LiDARs turn together: they are known against each other as before.
    pair = ("front", "rear")
    assert found.sigma_s2s[pair] == pytest.approx(alone(arc()[2]).sigma_s2s[pair], rel=0.15)
    assert not is_met(shortfall(found, {"s2v_x_m": 0.5}), {"s2v_x_m": 0.5})


def test_a_trusted_mounting_determines_what_the_others_turn_with() -> None:
    """`fixed: true` of the front LiDAR: what is left is what the target tells of the pair."""
    recording, config, given = arc()
    front = config.lidars["front"].model_copy(update={"fixed": True})
    config = config.model_copy(update={"lidars": {**config.lidars, "front": front}})
    drive = recorded_drive(recording, config, SilentProgress())

    found = alone(drive)

    assert found.undetermined == ()
    assert found.sigma_s2v["front"] == pytest.approx(TRUSTED_SIGMAS, rel=0.01)
    pair = found.sigma_s2s["front", "rear"]
    assert (found.sigma_s2v["rear"][[2, 3, 4]] < 1.5 * pair[[2, 3, 4]]).all()
    results = found.covariance.calibration.lidars
    assert all(all(result.determined.values()) for result in results.values())
    # The scenario of a suggestion has the sigmas of the LiDAR that is not trusted.
    assert drive.scenario.initial_guess == given.scenario.initial_guess


def test_what_is_suggested_determines_the_rest_together_with_the_drive() -> None:
    _, _, drive = arc()
    recorded = next_drive([drive], [], drive.assumptions).recorded

    suggestion = suggest(drive.vehicle, {}, drive.assumptions, recorded)
    assert suggestion is not None
    both = next_drive([drive], [suggestion.scenario], drive.assumptions).prediction

    # Two arcs to different sides change the curvature, and neither does alone.
    assert isinstance(suggestion.scenario.drive, ArcDrive)
    assert suggestion.scenario.drive.turn == "left"
    assert len(predict(suggestion.scenario, assumptions=drive.assumptions).undetermined) == 1
    assert both is not None
    assert both.undetermined == ()
    assert both.names[1] == "suggestion"
    assert both.names[0].endswith(" as recorded")
    for name, sigma in both.sigma_s2v.items():
        assert sigma == pytest.approx(suggestion.prediction.sigma_s2v[name], rel=1e-6)
    # Without the recorded drive more space is needed.
    alone_too = suggest(drive.vehicle, {}, drive.assumptions)
    assert alone_too is not None
    assert math.prod(alone_too.space_m) > math.prod(suggestion.space_m)


def test_a_scenario_beside_a_recorded_drive_has_its_vehicle() -> None:
    _, _, drive = arc()
    other = scenario_of("S-curve")
    renamed = other.model_copy(update={"lidars": {"x": other.lidars["front"]}, "reference": "x"})

    both = next_drive([drive], [renamed], drive.assumptions).prediction

    assert both is not None
    assert set(both.sigma_s2v) == {"front", "rear"}


def test_a_frame_above_ground_changes_nothing() -> None:
    """The vehicle frame may be anywhere: one that is higher has everything lower in it."""
    _, _, drive = arc()
    up_m = 0.7
    lidars = {
        name: m.model_copy(
            update={
                "mounting": m.mounting.model_copy(
                    update={"xyz": (*m.mounting.xyz[:2], m.mounting.xyz[2] - up_m)}
                )
            }
        )
        for name, m in drive.scenario.lidars.items()
    }
    assert lidars != drive.scenario.lidars
    lower = replace(drive.route, height_m=-up_m)  # type: ignore[type-var]
    imu = drive.scenario.imu
    mounting = imu.mounting.model_copy(update={"xyz": (0.0, 0.0, -up_m)})
    gnss = drive.scenario.gnss.model_copy(update={"lever_arm": (0.0, 0.0, -up_m)})
    changes = {
        "lidars": lidars,
        "imu": imu.model_copy(update={"mounting": mounting}),
        "gnss": gnss,
    }
    assumptions = replace(drive.assumptions, ground="none")

    one = predict_drives([(drive.scenario, drive.route)], assumptions)
    other = predict_drives([(drive.scenario.model_copy(update=changes), lower)], assumptions)

    for name, sigma in one.sigma_s2v.items():
        assert other.sigma_s2v[name] == pytest.approx(sigma, rel=0.02)


def test_without_a_target_a_drive_past_a_chair_is_suggested() -> None:
    recording, config, _ = arc()
    blind = config.model_copy(
        update={"target": False, "structure": config.structure.model_copy(update={"use": True})}
    )

    drive = recorded_drive(recording, blind, SilentProgress())
    planned = next_drive([drive], [], drive.assumptions)

    assert planned.prediction is None
    assert any("no target is known in the recorded drive" in note for note in planned.notes)
    # By ground planes: walls of the new drive are unknown, and cells take longer.
    by_planes = replace(planned.assumptions, structure=False)
    suggestion = suggest(planned.vehicle, {}, by_planes)
    assert suggestion is not None
    assert suggestion.met


class WithoutImu(KeptDrive):
    """As a vehicle with GNSS and odometry records it."""

    def motion(self) -> MotionData:
        return replace(super().motion(), imu=None)


def test_what_has_no_model_is_refused_with_what_to_do() -> None:
    recording, config, _ = arc()
    nothing = config.model_copy(update={"topics": TopicsConfig()})
    with pytest.raises(ConfigError, match=r"nothing that measures the vehicle's motion.*scenario"):
        recorded_drive(recording, nothing, SilentProgress())

    wheels = WithoutImu(scenario_of("arc"), 1)
    wheels._kept = recording._kept
    topics = TopicsConfig(gnss="/gnss/fix", twist="/vehicle/twist")
    no_imu = config.model_copy(update={"topics": topics, "target": False})
    no_imu = no_imu.model_copy(
        update={"structure": config.structure.model_copy(update={"use": True})}
    )
    with pytest.raises(TrajectoryError, match=r"wheels without an IMU.*observability"):
        recorded_drive(wheels, no_imu, SilentProgress())
