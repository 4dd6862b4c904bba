"""A thinned drive shows of the target, and of the ground, what whole clouds show."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.errors import ConfigError
from caliv_graph.products import Array, LidarScan, Recording, TargetCloud, TargetObservation
from caliv_graph.scenario.drive_models import ArcDrive
from caliv_graph.scenario.model import InitialGuessModel, SuspensionModel
from caliv_graph.scenario.sensor_models import EdgeModel, LidarModel, SweepModel
from caliv_graph.scenario.world_models import (
    BodyBoxModel,
    BoxModel,
    ChairModel,
    WalkerModel,
    WorldModel,
)
from caliv_graph.simulation import Scenario, SimulatedRecording, simulate_drive
from caliv_graph.simulation.writer import config_of
from caliv_graph.targets import extract_targets
from caliv_graph.targets.ground.measure import measure_grounds
from caliv_graph.trajectory.select import VehicleTrajectory, smooth_trajectories
from scripts._thinned import (
    BeamSelection,
    GroundWaves,
    ThinnedRecording,
    cached_selection,
    scenario_digest,
    select_beams,
)
from tests.kept import KeptDrive
from tests.targets.ground.scans import plane_in

FRONT = LidarModel(
    mounting=PoseConfig(xyz=(2.0, 0.2, 2.0), rpy_deg=(1.0, 10.0, -3.0)),
    channels=60,
    horizontal_resolution_deg=0.4,
    rate_hz=5.0,
)
REAR = FRONT.model_copy(
    update={"mounting": PoseConfig(xyz=(-0.4, 0.0, 2.0), rpy_deg=(0.0, 10.0, 180.0))}
)
SWEPT = FRONT.model_copy(
    update={
        "horizontal_fov_deg": (-180.0, 180.0),
        "channels": 32,
        "horizontal_resolution_deg": 1.0,
        "sweep": SweepModel(),
        "edges": EdgeModel(dropout_probability=0.02),
    }
)
WORLD = WorldModel(
    objects={
        "chair": ChairModel(xy_m=(9.0, -3.0), yaw_deg=160.0),
        "box": BoxModel(xy_m=(11.5, -6.0), size_m=(0.4, 0.4, 0.9)),
        "wall": BoxModel(xy_m=(30.0, 0.0), size_m=(0.2, 20.0, 3.0)),
    },
    walkers={"passer_by": WalkerModel(from_xy_m=(7.0, -7.0), to_xy_m=(9.5, 2.0))},
    targets=("chair",),
)


def scenario_of(**sections: Any) -> Scenario:
    base: dict[str, Any] = {
        "name": "test",
        "drive": ArcDrive(duration_s=10.0),
        "lidars": {"front": FRONT, "rear": REAR},
        "world": WORLD,
    }
    return Scenario(**{**base, **sections})


def silent(scenario: Scenario) -> Scenario:
    """Without the noise of ranges, height and heave; guesses stay off."""
    lidars = {
        name: model.model_copy(update={"range_sigma_m": 0.0})
        for name, model in scenario.lidars.items()
    }
    still = SuspensionModel(height_sigma_m=0.0, heave_sigma_m=0.0)
    return scenario.model_copy(update={"lidars": lidars, "suspension": still})


@cache
def selected() -> BeamSelection:
    return select_beams(scenario_of())


@cache
def whole_and_quiet() -> KeptDrive:
    """The drive without noise, all its beams cast once."""
    return KeptDrive(silent(scenario_of()), 3)


def config_for(recording: SimulatedRecording) -> Config:
    return parse_config(config_of(recording, has_bag=True), "test", Path())


@cache
def smoothed() -> Sequence[VehicleTrajectory]:
    """Of both kinds of recording: they have the same motion, as a test below finds."""
    whole = whole_and_quiet()
    return smooth_trajectories([whole], config_for(whole), [[]])


def points_of(cloud: LidarScan | TargetCloud) -> set[tuple[float, ...]]:
    return set(map(tuple, cloud.points_lidar.tolist()))


def observed(recording: SimulatedRecording) -> TargetObservation:
    recordings: list[Recording] = [recording]
    config, trajectories = config_for(recording), smoothed()
    # The box in the region is a placement of its own.
    box, chair = extract_targets(recordings, trajectories, config, SilentProgress())
    assert box.centre_map[0] > 11.0 > chair.centre_map[0]
    return chair


def test_without_noise_the_target_has_the_same_points() -> None:
    thin = ThinnedRecording(whole_and_quiet().scenario, selected(), 3)

    whole, thinned = observed(whole_and_quiet()), observed(thin)

    assert len(whole.clouds) > 20
    assert [(c.lidar, c.stamp_ns) for c in thinned.clouds] == [
        (c.lidar, c.stamp_ns) for c in whole.clouds
    ]
    # The ground near the target is sampled more thinly: a point at its rim may go either way.
    counts = np.array(
        [
            [len(a.points_lidar), len(b.points_lidar)]
            for a, b in zip(whole.clouds, thinned.clouds, strict=True)
        ]
    )
    assert np.abs(counts[:, 0] - counts[:, 1]).max() <= 0.03 * counts.max()
    for a, b in zip(whole.clouds, thinned.clouds, strict=True):
        common = points_of(a) & points_of(b)
        assert len(common) >= 0.95 * len(a.points_lidar)


def test_the_beams_that_are_kept_return_what_whole_clouds_do() -> None:
    """And those that are left out meet nothing in the target's region but ground."""
    whole = whole_and_quiet()
    scenario = whole.scenario
    thin = ThinnedRecording(scenario, selected(), 3)
    low, high = whole.world.bounds("chair")
    margin_m = scenario.world.region_margin_m
    walker = whole.world.names.index("passer_by")
    walked = 0
    for name in scenario.lidars:
        wanted = frozenset(thin.scan_stamps_ns(name))
        T_vehicle_lidar = whole.truth.T_vehicle_lidar[name]
        for a, b in zip(
            whole.scans_with_truth(name, wanted), thin.scans_with_truth(name), strict=True
        ):
            assert a.scan.stamp_ns == b.scan.stamp_ns
            points = points_of(b.scan)
            assert points <= points_of(a.scan)
            (T_map_vehicle,) = whole.truth.T_map_vehicle(np.array([a.scan.stamp_ns]))
            at_map = T_map_vehicle.compose(T_vehicle_lidar).transformFrom(a.scan.points_lidar.T).T
            inside = ((at_map > low - margin_m) & (at_map < high + margin_m)).all(axis=1)
            things = a.scan.points_lidar[inside & (a.objects != 0)]
            assert points >= set(map(tuple, things.tolist()))
            walked += int((inside & (a.objects == walker)).sum())
    assert walked > 100


def test_with_noise_it_is_the_same_kind_of_cloud() -> None:
    """Every target return is there, off along its beam by the LiDAR's noise and nothing else."""
    scenario = scenario_of(suspension=SuspensionModel(height_sigma_m=0.01, heave_sigma_m=0.01))
    thin = ThinnedRecording(scenario, selected(), 4)
    quiet = silent(scenario).model_copy(update={"suspension": scenario.suspension})
    still = ThinnedRecording(quiet, selected(), 4)
    whole = simulate_drive(quiet, 4)
    off, lost = [], 0
    for name in scenario.lidars:
        wanted = frozenset(thin.scan_stamps_ns(name))
        for noisy, exact, all_of_it in zip(
            thin.scans_with_truth(name),
            still.scans_with_truth(name),
            whole.scans_with_truth(name, wanted),
            strict=True,
        ):
            # Height and heave are drawn alike, whatever beams there are: no edge goes astray where
            # there is enough of the target to be of use.
            on_target = int((all_of_it.objects == 1).sum())
            if on_target >= 30:
                lost += on_target - int((exact.objects == 1).sum())
            if len(noisy.scan.points_lidar) == len(exact.scan.points_lidar):
                off.append(
                    np.linalg.norm(noisy.scan.points_lidar, axis=1)
                    - np.linalg.norm(exact.scan.points_lidar, axis=1)
                )
    assert lost == 0
    errors = np.concatenate(off)
    assert len(errors) > 20_000
    assert abs(errors.mean()) < 4.0 * 0.01 / np.sqrt(len(errors))
    assert errors.std() == pytest.approx(0.01, rel=0.02)


def test_the_ground_is_told_as_well_as_its_floors() -> None:
    """The normal to 0.5 mrad, the distance to 2 mm; the noise adds almost nothing."""
    scenario = scenario_of()
    recording = ThinnedRecording(scenario, selected(), 5)
    found = []
    for name in scenario.lidars:
        for scan in list(recording.scans(name))[::6]:
            up = level_up(recording, scan)
            plane = plane_in(scan, up, 0.01)
            assert plane is not None
            off = plane.axes_lidar @ (plane.normal_lidar - up)
            found.append([*np.sqrt(np.diag(plane.cov)), *off])
    noise = np.array(found)
    assert len(noise) >= 8
    assert np.sqrt((noise[:, :2] ** 2).mean()) < 0.1e-3
    assert np.sqrt((noise[:, 2] ** 2).mean()) < 0.5e-3
    assert np.sqrt((noise[:, 3:] ** 2).mean()) < 0.1e-3


def test_every_pose_has_the_ground_of_every_lidar() -> None:
    recording = ThinnedRecording(scenario_of(), selected(), 6)
    config = config_for(recording)
    trajectories = smooth_trajectories([recording], config, [[]])
    targets = extract_targets([recording], trajectories, config, SilentProgress())
    stamps = {cloud.stamp_ns for target in targets for cloud in target.clouds}

    grounds, warnings = measure_grounds(
        [recording], trajectories, targets, config, SilentProgress()
    )

    assert len(grounds) == 2 * len(stamps)
    assert warnings == ()


def test_a_cloud_is_the_same_whenever_it_is_asked_for() -> None:
    scenario = scenario_of()
    recording = ThinnedRecording(scenario, selected(), 7)
    every = {scan.stamp_ns: scan.points_lidar for scan in recording.scans("front")}
    last = max(every)
    (alone,) = ThinnedRecording(scenario, selected(), 7).scans("front", {last})
    np.testing.assert_array_equal(alone.points_lidar, every[last])
    assert list(every) == list(recording.scan_stamps_ns("front"))
    (fresh,) = ThinnedRecording(scenario, selected(), 8).scans("front", {last})
    assert not np.array_equal(fresh.points_lidar[:50], alone.points_lidar[:50])


def test_motion_and_guesses_are_those_of_the_whole_drive() -> None:
    scenario = scenario_of()
    thin, whole = ThinnedRecording(scenario, selected(), 9), simulate_drive(scenario, 9)
    a, b = thin.motion(), whole.motion()
    assert a.imu is not None
    assert b.imu is not None
    np.testing.assert_array_equal(a.imu.specific_force, b.imu.specific_force)
    assert thin.guesses == whole.guesses
    np.testing.assert_array_equal(thin.truth.heave_m, whole.truth.heave_m)


def test_sweeps_edges_and_the_vehicle_itself() -> None:
    """Each point tells its own time, and an edge effect changes what it may."""
    scenario = scenario_of(
        lidars={"top": SWEPT},
        vehicle_body=(BodyBoxModel(centre_m=(1.0, 0.0, 0.8), size_m=(4.0, 1.6, 1.0)),),
        drive=ArcDrive(duration_s=6.0),
    )
    selection = select_beams(scenario)
    thin, whole = ThinnedRecording(scenario, selection, 2), simulate_drive(scenario, 2)
    wanted = frozenset(thin.scan_stamps_ns("top"))
    counts = np.zeros(2)
    for scan in thin.scans("top"):
        assert scan.point_times_s is not None
        # Clockwise from the back, 360 columns in the fifth of a second between two clouds.
        azimuth = np.arctan2(scan.points_lidar[:, 1], scan.points_lidar[:, 0])
        turned = (np.pi - azimuth) / (2.0 * np.pi)
        np.testing.assert_allclose(scan.point_times_s, 0.2 * turned, atol=0.2 / 360)
    for i, recording in enumerate((whole, thin)):
        for taken in recording.scans_with_truth("top", wanted):
            counts[i] += (taken.objects == 1).sum()
    # A tenth of the beams at the chair's edges fail or melt, in both by chance.
    assert counts[1] == pytest.approx(counts[0], rel=0.1)


def test_a_selection_is_found_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = scenario_of(drive=ArcDrive(duration_s=5.0))
    first = cached_selection(scenario, tmp_path)

    def again(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr("scripts._thinned.select_beams", again)
    second = cached_selection(scenario, tmp_path)

    assert first.digest == second.digest
    for name in scenario.lidars:
        np.testing.assert_array_equal(first.frames[name], second.frames[name])
        assert list(first.near[name]) == list(second.near[name])
        for frame in first.frames[name].tolist():
            np.testing.assert_array_equal(first.beams(name, frame), second.beams(name, frame))
    assert [path.suffix for path in tmp_path.iterdir()] == [".npz"]


def test_noise_is_no_part_of_a_selection_but_what_moves_a_beam_is() -> None:
    scenario = scenario_of()
    assert scenario_digest(scenario) == scenario_digest(silent(scenario))
    farther = scenario_of(drive=ArcDrive(duration_s=11.0))
    assert scenario_digest(farther) != scenario_digest(scenario)
    surer = scenario_of(initial_guess=InitialGuessModel(rotation_deg=1.0))
    assert scenario_digest(surer) != scenario_digest(scenario)


def test_another_scenario_or_none_at_all_is_refused() -> None:
    other = scenario_of(drive=ArcDrive(duration_s=11.0))
    with pytest.raises(ConfigError, match="scenario 'test': the selection of beams is another"):
        ThinnedRecording(other, selected(), 1)
    searched = scenario_of(config_target="search")
    with pytest.raises(ConfigError, match="no target whose region"):
        select_beams(searched)


def test_waves_of_the_ground_are_of_the_world_and_lift_all_that_stands_on_it() -> None:
    """The vehicle, the target and the ground under every LiDAR, where they are; other drives,
    other waves."""
    scenario = silent(scenario_of())
    waves = GroundWaves(sigma_m=0.02)
    level = ThinnedRecording(scenario, selected(), 1)
    waved = ThinnedRecording(scenario, selected(), 1, waves=waves)
    terrain = waved.truth.drive.terrain
    assert terrain is not None
    for name in scenario.lidars:
        for scan in list(waved.scans_with_truth(name))[::20]:
            states = waved.truth.states(np.array([scan.scan.stamp_ns]))
            T = waved.truth.T_vehicle_lidar[name]
            vehicle = scan.scan.points_lidar[scan.objects == 0] @ T.rotation().matrix().T
            vehicle += T.translation()
            points = vehicle @ states.R_map_vehicle[0].T + states.position_map[0]
            height, _, _ = terrain.heights(points[:, :2])
            # The mesh is off by a twentieth of a wave's height.
            assert len(points) > 50
            np.testing.assert_allclose(points[:, 2], height, atol=3e-3)
            assert np.ptp(height) > 0.02
    other = ThinnedRecording(scenario, selected(), 2, waves=waves).truth.drive.terrain
    assert other is not None
    assert other.height_at((1.0, 2.0)) != terrain.height_at((1.0, 2.0))
    stamps = level.truth.start_ns + np.arange(0, 10**10, 10**9)
    along = waved.truth.states(stamps).position_map - level.truth.states(stamps).position_map
    np.testing.assert_allclose(along[:, :2], 0.0, atol=1e-12)
    expected, _, _ = terrain.heights(level.truth.states(stamps).position_map[:, :2])
    np.testing.assert_allclose(along[:, 2], expected, atol=1e-12)


def level_up(recording: SimulatedRecording, scan: LidarScan) -> Array:
    states = recording.truth.states(np.array([scan.stamp_ns]))
    rotation = recording.truth.T_vehicle_lidar[scan.lidar].rotation().matrix()
    up: Array = (states.R_map_vehicle[0] @ rotation)[2]
    return up
