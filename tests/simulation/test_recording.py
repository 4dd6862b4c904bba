"""A simulated drive in memory: true poses, extrinsics and times put its points on the world."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caliv_graph.config.mounting import PoseConfig
from caliv_graph.products import Array, LidarScan, Recording
from caliv_graph.scenario.drive_models import ArcDrive, FigureEightDrive, SCurveDrive
from caliv_graph.scenario.model import CropModel, SuspensionModel
from caliv_graph.scenario.sensor_models import EdgeModel, LidarModel, SweepModel
from caliv_graph.scenario.world_models import (
    BodyBoxModel,
    BoxModel,
    ChairModel,
    GroundModel,
    RampModel,
    WalkerModel,
    WorldModel,
)
from caliv_graph.simulation import Scenario, SimulatedRecording, load_scenario, simulate_drive
from caliv_graph.simulation.rays import RayCaster
from caliv_graph.simulation.recording import HEAVE_PERIOD_NS
from tests.scan_rates import scanned_every

SCENARIOS = Path(__file__).parents[2] / "configs" / "scenarios"

RAMP = RampModel(xy_m=(6.5, -4.0), yaw_deg=-45.0, height_m=0.4, flank_m=4.0, top_m=1.0, width_m=4.0)

WORLD = WorldModel(
    ground=GroundModel(height_m=-0.3),
    objects={
        "chair": ChairModel(xy_m=(11.0, -2.0), yaw_deg=160.0),
        "wall": BoxModel(xy_m=(18.0, 0.0), size_m=(0.2, 20.0, 3.0)),
    },
    targets=("chair",),
)

FRONT = LidarModel(
    mounting=PoseConfig(xyz=(2.0, 0.2, 2.0), rpy_deg=(1.0, 10.0, -3.0)),
    channels=48,
    horizontal_resolution_deg=0.6,
    range_sigma_m=0.0,
)
SIDE = FRONT.model_copy(
    update={"mounting": PoseConfig(xyz=(0.5, 0.8, 1.8), rpy_deg=(0.0, 12.0, 60.0)), "rate_hz": 5.0}
)


def scenario_of(**sections: Any) -> Scenario:
    base: dict[str, Any] = {
        "name": "test",
        "drive": ArcDrive(duration_s=8.0),
        "lidars": {"front": FRONT, "side": SIDE},
        "world": WORLD,
        "suspension": SuspensionModel(height_sigma_m=0.02, heave_sigma_m=0.01),
    }
    return Scenario(**{**base, **sections})


def points_map_of(recording: SimulatedRecording, scan: LidarScan, *, timed: bool = True) -> Array:
    """Points in the map from nothing but the truth and the times that the scan tells."""
    truth = recording.truth
    after_s = np.zeros(len(scan.points_lidar))
    if timed and scan.point_times_s is not None:
        after_s = scan.point_times_s
    true_s = after_s - truth.time_offset_s[scan.lidar]
    states = truth.states(scan.stamp_ns + np.rint(true_s * 1e9).astype(np.int64))
    points_vehicle = truth.T_vehicle_lidar[scan.lidar].transformFrom(scan.points_lidar.T).T
    lifted = truth.heave_m[(scan.stamp_ns - truth.start_ns) // HEAVE_PERIOD_NS]
    turned = np.einsum("nij,nj->ni", states.R_map_vehicle, points_vehicle)
    points: Array = turned + states.position_map + np.array([0.0, 0.0, lifted])
    return points


def ground_z(recording: SimulatedRecording, points_map: Array) -> Array:
    """Height of the ground below points, from the function that the vehicle follows."""
    z: Array = np.full(len(points_map), recording.scenario.world.ground.height_m)
    terrain = recording.truth.drive.terrain
    return z if terrain is None else z + terrain.heights(points_map[:, :2])[0]


def sweep_of(model: LidarModel, **changes: Any) -> LidarModel:
    return model.model_copy(update={"sweep": SweepModel(**changes)})


CASES: dict[str, dict[str, Any]] = {
    "instant": {},
    "late": {"lidars": {"front": FRONT.model_copy(update={"time_offset_s": 0.02})}},
    "sweep": {
        "lidars": {
            "front": sweep_of(FRONT),
            "side": sweep_of(SIDE, direction="counter_clockwise", duration_s=0.15),
        }
    },
    "sweep, late, stamped at its end": {
        "lidars": {
            "front": sweep_of(
                FRONT.model_copy(update={"time_offset_s": -0.03}),
                stamp_at="end",
                time_field="timestamp",
            )
        }
    },
    "ramp": {"world": WORLD.model_copy(update={"ground": GroundModel(ramps=(RAMP,))})},
    "ramp, sweep": {
        "world": WORLD.model_copy(update={"ground": GroundModel(ramps=(RAMP,))}),
        "lidars": {"front": sweep_of(FRONT)},
        "drive": SCurveDrive(duration_s=8.0, transition_m=2.0),
    },
}


@pytest.mark.parametrize("case", CASES)
def test_truth_puts_points_on_the_world(case: str) -> None:
    recording = simulate_drive(scenario_of(**CASES[case]), 2)
    caster = RayCaster(recording.world)
    chair = recording.world.names.index("chair")
    seen = 0
    for name in recording.lidars:
        some = frozenset(recording.scan_stamps_ns(name)[::3])  # standing, turning and stopping
        for taken in recording.scans_with_truth(name, some):
            points_map = points_map_of(recording, taken.scan)
            off = caster.distance(points_map)
            on_ground = taken.objects == 0
            # A mesh of squares of 0.1 m, half a millimetre from what it stands for.
            off[on_ground] = points_map[on_ground, 2] - ground_z(recording, points_map[on_ground])
            assert np.abs(off).max() < 5e-4
            seen += int((taken.objects == chair).sum())
    assert seen > 500


def test_without_their_times_points_of_a_sweep_are_off() -> None:
    recording = simulate_drive(scenario_of(lidars={"front": sweep_of(FRONT)}), 2)
    caster = RayCaster(recording.world)
    stamp_ns = recording.scan_stamps_ns("front")[45]
    (scan,) = recording.scans("front", {stamp_ns})
    off = caster.distance(points_map_of(recording, scan, timed=False))
    assert off.max() > 0.03


def test_vehicle_is_on_the_ramp_while_it_looks() -> None:
    recording = simulate_drive(scenario_of(**CASES["ramp"]), 2)
    R = recording.truth.states(np.array(recording.scan_stamps_ns("front"))).R_map_vehicle
    assert np.degrees(np.arcsin(np.abs(R[:, 2, 0]))).max() > 5.0


def test_it_is_a_recording() -> None:
    recording: Recording = simulate_drive(scenario_of(), 0)
    assert recording.lidars == ("front", "side")
    assert recording.name == "simulated test, seed 0"
    assert list(recording.warnings()) == []
    begin_ns = 1_750_000_000 * 10**9
    # 8 s at 10 Hz and at 5 Hz, both ends included.
    front, side = (recording.scan_stamps_ns(name) for name in recording.lidars)
    assert list(front) == [begin_ns + k * 100_000_000 for k in range(81)]
    assert list(side) == [begin_ns + k * 200_000_000 for k in range(41)]
    scans = list(recording.scans("side"))
    assert [scan.stamp_ns for scan in scans] == list(side)
    assert all(scan.lidar == "side" and scan.point_times_s is None for scan in scans)
    assert "7.400" in scans[37].source


@pytest.mark.parametrize("case", ["instant", "sweep"])
def test_wanted_scans_are_what_they_are_among_all(case: str) -> None:
    sections = {**CASES[case]}
    lidars = sections.get("lidars", {"front": FRONT, "side": SIDE})
    sections["lidars"] = {
        name: model.model_copy(update={"range_sigma_m": 0.02, "edges": EdgeModel()})
        for name, model in lidars.items()
    }
    recording = simulate_drive(scenario_of(**sections), 0)
    everything = {scan.stamp_ns: scan for scan in recording.scans("front")}
    wanted = list(everything)[20:60:13]
    some = list(recording.scans("front", wanted))
    assert [scan.stamp_ns for scan in some] == wanted
    for scan in some:
        np.testing.assert_array_equal(scan.points_lidar, everything[scan.stamp_ns].points_lidar)
        if case == "sweep":
            assert scan.point_times_s is not None
            np.testing.assert_array_equal(
                scan.point_times_s, everything[scan.stamp_ns].point_times_s
            )


def test_scans_do_not_depend_on_which_were_asked_for_before() -> None:
    noisy = FRONT.model_copy(update={"range_sigma_m": 0.02, "edges": EdgeModel()})
    scenario = scenario_of(lidars={"front": noisy, "side": noisy})
    whole = simulate_drive(scenario, 0)
    everything = {scan.stamp_ns: scan.points_lidar for scan in whole.scans("front")}
    stamps = list(everything)
    recording = simulate_drive(scenario, 0)
    for wanted in ([5], [9, 11], [3, 4, 10], [6, 12, 80], [0, 80]):
        for lidar, alike in (("front", True), ("side", False)):
            scans = list(recording.scans(lidar, [stamps[n] for n in wanted]))
            assert [scan.stamp_ns for scan in scans] == [stamps[n] for n in wanted]
            for scan in scans:
                same = np.array_equal(scan.points_lidar, everything[scan.stamp_ns])
                assert same == alike


def test_sweeps_lie_within_the_drive_and_tell_their_times() -> None:
    recording = simulate_drive(scenario_of(**CASES["sweep"]), 0)
    truth = recording.truth
    for name, sweep_s, most in (("front", 0.1, 80), ("side", 0.15, 40)):
        stamps = recording.scan_stamps_ns(name)
        assert len(stamps) == most
        assert max(recording.complete_stamps_ns(name)) <= truth.end_ns
        (scan,) = recording.scans(name, {stamps[-1]})
        assert scan.point_times_s is not None
        assert scan.point_times_s.min() >= 0.0
        assert 0.9 * sweep_s < scan.point_times_s.max() < sweep_s
        assert recording.complete_ns(scan) == stamps[-1] + round(sweep_s * 1e9)
    at_end = simulate_drive(scenario_of(**CASES["sweep, late, stamped at its end"]), 0)
    stamps = at_end.scan_stamps_ns("front")
    assert stamps[0] == truth.start_ns + 100_000_000
    assert list(at_end.complete_stamps_ns("front")) == list(stamps)
    (scan,) = at_end.scans("front", {stamps[3]})
    assert scan.point_times_s is not None
    assert scan.point_times_s.max() < 0.0
    assert scan.point_times_s.min() >= -0.1


def test_phase_shifts_the_clouds() -> None:
    phased = FRONT.model_copy(update={"phase_s": 0.03})
    recording = simulate_drive(scenario_of(lidars={"front": phased}), 0)
    after = np.array(recording.scan_stamps_ns("front")) - recording.truth.start_ns
    assert after[:2].tolist() == [30_000_000, 130_000_000]
    assert len(after) == 80


def test_heave_lifts_clouds_and_nothing_else() -> None:
    lively = SuspensionModel(height_sigma_m=0.0, heave_sigma_m=0.05)
    calm = SuspensionModel(height_sigma_m=0.0, heave_sigma_m=0.0)
    one, other = (simulate_drive(scenario_of(suspension=s), 0) for s in (lively, calm))
    assert one.truth.heave_m.std() == pytest.approx(0.05, rel=0.3)
    assert not other.truth.heave_m.any()
    stamps = np.array(one.scan_stamps_ns("front"))
    for a, b in zip(
        one.truth.T_map_vehicle(stamps), other.truth.T_map_vehicle(stamps), strict=True
    ):
        assert a.equals(b, 1e-12)
    a_imu, b_imu = one.motion().imu, other.motion().imu
    assert a_imu is not None
    assert b_imu is not None
    np.testing.assert_array_equal(a_imu.specific_force, b_imu.specific_force)
    # The ground comes nearer and goes: 2 m below the LiDAR, by as much as the heave.
    down = LidarModel(
        mounting=PoseConfig(xyz=(0.0, 0.0, 2.0)),
        vertical_fov_deg=(-90.0, -80.0),
        channels=2,
        horizontal_fov_deg=(-1.0, 1.0),
        horizontal_resolution_deg=2.0,
        range_sigma_m=0.0,
    )
    looking_down = simulate_drive(scenario_of(lidars={"down": down}, suspension=lively), 0)
    heights = [-scan.points_lidar[0, 2] - 2.0 for scan in looking_down.scans("down")]
    np.testing.assert_allclose(heights, looking_down.truth.heave_m, atol=1e-6)


def test_walker_s_points_lie_where_he_is_when_they_are_taken() -> None:
    walker = WalkerModel(from_xy_m=(7.0, -4.0), to_xy_m=(9.0, 3.0), speed_m_s=1.5)
    recording = simulate_drive(
        scenario_of(
            lidars={"front": sweep_of(FRONT)},
            world=WORLD.model_copy(update={"walkers": {"who": walker}}),
        ),
        0,
    )
    index = recording.world.names.index("who")
    body = recording.world.walkers["who"]
    places = []
    for taken in recording.scans_with_truth("front"):
        own = taken.objects == index
        if own.sum() < 20:
            continue
        points_map = points_map_of(recording, taken.scan)[own]
        assert taken.scan.point_times_s is not None
        times_s = (taken.scan.stamp_ns - recording.truth.start_ns) * 1e-9
        R, t = body.poses(times_s + taken.scan.point_times_s[own])
        points_own = np.einsum("nji,nj->ni", R, points_map - t)
        low, high = body.mesh.vertices.min(axis=0), body.mesh.vertices.max(axis=0)
        assert (points_own > low - 1e-3).all()
        assert (points_own < high + 1e-3).all()
        places.append(points_map.mean(axis=0))
    assert len(places) > 10
    assert np.ptp(np.array(places)[:, 1]) > 2.0


def test_returns_from_the_vehicle_stay_where_they_are() -> None:
    body = (BodyBoxModel(centre_m=(2.0, 0.0, 1.4), size_m=(3.0, 1.8, 0.8)),)
    near = {"front": FRONT.model_copy(update={"min_range_m": 0.2})}
    recording = simulate_drive(scenario_of(lidars=near, vehicle_body=body), 0)
    index = recording.world.names.index("vehicle")
    own = [
        taken.scan.points_lidar[taken.objects == index]
        for taken in recording.scans_with_truth("front")
    ]
    assert len(own[0]) > 50
    assert all(np.array_equal(points, own[0]) for points in own[1:])
    # The IMU and the truth do not know of it.
    points_vehicle = FRONT.mounting.pose().transformFrom(own[0].T).T
    np.testing.assert_allclose(points_vehicle[:, 2], 1.8, atol=1e-5)


def test_guesses_and_other_draws_depend_on_the_seed_alone() -> None:
    one, again, other = (simulate_drive(scenario_of(), seed) for seed in (4, 4, 5))
    assert one.guesses == again.guesses
    assert one.guesses != other.guesses
    assert one.truth.level_z_map == again.truth.level_z_map != other.truth.level_z_map
    for a, b in zip(one.scans("front"), again.scans("front"), strict=True):
        np.testing.assert_array_equal(a.points_lidar, b.points_lidar)


def test_number_of_threads_changes_nothing() -> None:
    scenario = scenario_of(lidars={"front": sweep_of(FRONT)}, crop=CropModel())
    one, two = (simulate_drive(scenario, 4, threads=threads) for threads in (1, 2))
    for a, b in zip(one.scans("front"), two.scans("front"), strict=True):
        np.testing.assert_array_equal(a.points_lidar, b.points_lidar)


@pytest.mark.parametrize(
    ("name", "both"),
    [
        ("s_curve", {"front": 60, "rear": 30}),
        ("tri_lidar", {"front": 40, "left": 40, "right": 40}),
        ("overlap", {"roof": 60, "left": 40, "right": 40}),
        ("static", {"front": 100, "left": 100}),
        ("no_target", {"front": 0, "rear": 0}),
    ],
)
def test_shipped_scenarios_show_the_target_to_every_lidar(name: str, both: dict[str, int]) -> None:
    """Scans that see the target with at least 50 points; every tenth of a long drive."""
    scenario = load_scenario(SCENARIOS / f"{name}.yaml")
    every = 10 if isinstance(scenario.drive, FigureEightDrive) else 4
    recording = simulate_drive(scanned_every(scenario, every), 0)
    is_target = np.isin(recording.world.names, recording.world.targets)
    for lidar, least in both.items():
        counts = [
            int(is_target[taken.objects[taken.objects >= 0]].sum())
            for taken in recording.scans_with_truth(lidar)
        ]
        seen = every * sum(count >= 50 for count in counts)
        assert seen >= least
        if least == 0:
            assert seen == 0


def test_ramp_is_driven_over_while_the_target_is_seen() -> None:
    recording = simulate_drive(scanned_every(load_scenario(SCENARIOS / "ramp.yaml"), 10), 0)
    chair = recording.world.names.index("chair")
    for name in recording.lidars:
        stamps = [
            taken.scan.stamp_ns
            for taken in recording.scans_with_truth(name)
            if (taken.objects == chair).sum() >= 50
        ]
        R = recording.truth.states(np.array(stamps)).R_map_vehicle
        pitch_deg = np.degrees(np.arcsin(-R[:, 2, 0]))
        assert np.ptp(pitch_deg) > 4.0, name


def test_walker_of_noisy_passes_the_chair_and_hides_some_of_it() -> None:
    scenario = load_scenario(SCENARIOS / "noisy.yaml")
    world = simulate_drive(scenario, 0).world
    walker = world.walkers["passer_by"]
    _, t = walker.poses(np.arange(0.0, 20.0, 0.05))
    centre, _ = world.bounding_sphere("chair")
    nearest_m = np.linalg.norm(t[:, :2] - centre[:2], axis=1).min()
    # Neither through it nor out of its region.
    assert 0.9 < nearest_m < 1.1
    assert scenario.lidars["front"].time_offset_s == 0.02
