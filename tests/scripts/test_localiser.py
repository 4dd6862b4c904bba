from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.geometry.se3 import right_to_vehicle_axes, vehicle_axes_difference
from caliv_graph.products import Array, Calibration, LidarResult, LidarScan
from caliv_graph.results.calibration_file import write_calibration
from caliv_graph.scenario.model import Scenario, load_scenario
from caliv_graph.simulation.rays import RayCaster
from caliv_graph.simulation.recording import SimulatedRecording, simulate_drive
from scripts import _localiser_runs, localiser_example
from scripts._localiser import Extrinsics, Localiser, Track, WallMap, make_map, register
from scripts._localiser_runs import KnockedRecording, Run, Task, cached_runs, drawn, keyframes
from tests.samples import make_calibration

SCENARIO = Path(__file__).resolve().parents[2] / "configs" / "scenarios" / "localiser.yaml"

SIGMA = np.repeat([2e-4, 3e-3], 3)
"""Of the calibrations here, rad and m."""


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario(SCENARIO)


@pytest.fixture(scope="module")
def recording(scenario: Scenario) -> SimulatedRecording:
    return simulate_drive(scenario, 77)


@pytest.fixture(scope="module")
def walls(recording: SimulatedRecording) -> WallMap:
    return make_map(recording.world)


@pytest.fixture(scope="module")
def scans(recording: SimulatedRecording) -> list[LidarScan]:
    return keyframes(recording, list(recording.lidars), first_ns(recording))[:30]


def first_ns(recording: SimulatedRecording | KnockedRecording) -> int:
    return recording.truth.start_ns + NANOSECONDS_PER_SECOND


def calibration(recording: SimulatedRecording) -> Calibration:
    """Right, but for what it says of itself."""
    truth = recording.truth.T_vehicle_lidar
    sample = make_calibration()
    result = next(iter(sample.lidars.values()))
    cov = np.diag(np.tile(SIGMA**2, len(truth)))
    lidars: dict[str, LidarResult] = {
        name: replace(result, T_vehicle_lidar=T, cov=np.diag(SIGMA**2)) for name, T in truth.items()
    }
    return replace(
        sample,
        reference="rear",
        lidars=lidars,
        cov_joint=cov,
        information_data=np.linalg.inv(cov),
        undetermined=(),
        weak=(),
    )


def track(
    recording: SimulatedRecording | KnockedRecording,
    scenario: Scenario,
    walls: WallMap,
    extrinsics: Extrinsics,
    scans: list[LidarScan],
) -> Track:
    localiser = Localiser(
        recording.motion(),
        scenario,
        recording.truth.datum,
        walls,
        extrinsics,
        first_ns(recording),
        2.0,
    )
    for scan in scans:
        localiser.step(scan)
    return localiser.track


def true_lidar(recording: SimulatedRecording, scan: LidarScan) -> gtsam.Pose3:
    truth = recording.truth
    (pose,) = truth.T_map_vehicle(np.array([scan.stamp_ns]))
    heave_m = truth.heave_m[(scan.stamp_ns - truth.start_ns) // (NANOSECONDS_PER_SECOND // 10)]
    lifted = gtsam.Pose3(pose.rotation(), pose.translation() + np.array([0.0, 0.0, heave_m]))
    return lifted.compose(truth.T_vehicle_lidar[scan.lidar])


def test_points_of_the_map_lie_on_what_stands(
    recording: SimulatedRecording, walls: WallMap
) -> None:
    chosen = np.random.default_rng(0).choice(len(walls.points_map), 300, replace=False)
    beside = 0.02 * walls.normals_map[chosen]

    # A beam that comes down on a point along its normal meets it there.
    caster = RayCaster(recording.world)
    for point, out in zip(walls.points_map[chosen], beside, strict=True):
        distance_m, _ = caster.cast((point + out)[None], -out[None] / 0.02)
        assert distance_m[0] == pytest.approx(0.02, abs=2e-4)
    assert np.linalg.norm(walls.normals_map, axis=1) == pytest.approx(1.0)


def test_registrations_are_as_good_as_they_say(
    recording: SimulatedRecording, scenario: Scenario, walls: WallMap, scans: list[LidarScan]
) -> None:
    rng = np.random.default_rng(1)
    off = np.repeat([0.005, 0.05], 3)
    nees = []
    for scan in scans:
        true = true_lidar(recording, scan)
        found = register(scan, true.retract(off * rng.uniform(-1.0, 1.0, 6)), walls, 0.01)
        assert found is not None
        d = gtsam.Pose3.Logmap(true.between(found.T_map_lidar))
        nees.append(d @ np.linalg.solve(found.cov, d) / 6.0)
        assert np.abs(d[:3]).max() < 5e-4
        assert np.abs(d[3:]).max() < 0.02

    # 180 degrees of freedom: 1 give or take 0.1.
    assert 0.6 < np.mean(nees) < 1.5


@pytest.mark.parametrize("yaw_rad", [0.009, -0.009])
def test_a_knock_does_not_lead_the_registration_astray(
    recording: SimulatedRecording, walls: WallMap, scans: list[LidarScan], yaw_rad: float
) -> None:
    turn = np.array([0.0, 0.0, yaw_rad, 0.0, 0.0, 0.0])
    found = []
    for scan in scans[::2]:
        true = true_lidar(recording, scan)
        registered = register(scan, true.retract(turn), walls, 0.01)
        if registered is not None:
            found.append(gtsam.Pose3.Logmap(true.between(registered.T_map_lidar))[2])

    assert len(found) >= 13
    assert np.abs(found).max() < 5e-4


def test_a_scan_that_the_map_does_not_hold_is_not_registered(
    recording: SimulatedRecording, walls: WallMap, scans: list[LidarScan]
) -> None:
    scan = scans[0]
    true = true_lidar(recording, scan)
    z_map = (scan.points_lidar @ true.rotation().matrix().T + true.translation())[:, 2]
    ground_alone = replace(scan, points_lidar=scan.points_lidar[z_map < 0.05])
    elsewhere = replace(scan, points_lidar=scan.points_lidar + np.array([0.0, 0.0, 30.0]))

    assert len(ground_alone.points_lidar) > 200
    assert register(ground_alone, true, walls, 0.01) is None
    assert register(elsewhere, true, walls, 0.01) is None


def test_keyframes_take_turns(recording: SimulatedRecording, scans: list[LidarScan]) -> None:
    steps = np.diff([scan.stamp_ns for scan in scans])

    assert set(steps.tolist()) == {NANOSECONDS_PER_SECOND // 2}
    assert all(a.lidar != b.lidar for a, b in itertools.pairwise(scans))
    assert {scan.lidar for scan in scans} == set(recording.lidars)


def test_with_right_constants_the_localiser_knows_how_good_it_is(
    recording: SimulatedRecording, scenario: Scenario, walls: WallMap, scans: list[LidarScan]
) -> None:
    right = track(recording, scenario, walls, recording.truth.T_vehicle_lidar, scans)
    found = _localiser_runs.measured(right, recording.truth)

    assert 0.4 < np.mean(found["nees"]) / 6.0 < 2.0
    assert max(found["position_m"]) < 0.03
    assert np.abs(found["heading_rad"]).max() < 1e-3


def test_wrong_constants_are_worse_and_not_known_to_be_while_priors_are(
    recording: SimulatedRecording, scenario: Scenario, walls: WallMap, scans: list[LidarScan]
) -> None:
    said = calibration(recording)
    # Two sigmas of yaw and of x, the same way for both: nothing between the LiDARs tells.
    error = 2.0 * np.array([0.0, 0.0, SIGMA[2], SIGMA[3], 0.0, 0.0])
    wrong = {
        name: T.retract(right_to_vehicle_axes(T).T @ error)
        for name, T in recording.truth.T_vehicle_lidar.items()
    }
    lidars = {n: replace(r, T_vehicle_lidar=wrong[n]) for n, r in said.lidars.items()}

    constants, priors = (
        _localiser_runs.measured(
            track(recording, scenario, walls, extrinsics, scans), recording.truth
        )
        for extrinsics in (wrong, replace(said, lidars=lidars))
    )

    # Both priors are off by two sigmas the same way: of independent ones, their mean by 2.8.
    assert np.mean(constants["nees_heading"]) > 20.0
    assert np.mean(priors["nees_heading"]) < 10.0
    assert not priors["alarms"]


def test_a_knocked_mount_is_named_and_how_far(
    recording: SimulatedRecording, scenario: Scenario, walls: WallMap
) -> None:
    turn = np.radians([0.3, 0.0, -0.4])
    knocked = KnockedRecording(scenario, 77, "rear", turn, 8.2)
    scans = keyframes(knocked, list(scenario.lidars), first_ns(knocked))[:26]

    found = track(knocked, scenario, walls, calibration(recording), scans)

    assert found.alarms
    first, last = found.alarms[0], found.alarms[-1]
    assert {alarm.lidar for alarm in found.alarms} == {"rear"}
    assert all(alarm.alone for alarm in found.alarms)
    assert 0.0 < (first.stamp_ns - knocked.knock_ns) * 1e-9 <= 3.0
    assert np.all(np.abs(last.movement[:3] - turn) < 4.0 * last.sigma[:3])
    # The localiser does without that LiDAR, and stays where it is.
    errors = _localiser_runs.measured(found, knocked.truth)
    assert max(errors["position_m"]) < 0.05
    assert np.abs(errors["heading_rad"]).max() < 2e-3


def test_a_knock_changes_the_scans_after_it_and_nothing_else(
    recording: SimulatedRecording, scenario: Scenario
) -> None:
    turn = np.array([0.0, 0.0, np.radians(0.5)])
    knocked = KnockedRecording(scenario, 77, "front", turn, 8.2)
    stamps = list(recording.scan_stamps_ns("front"))[80:85]

    pairs = list(
        zip(
            recording.scans("front", set(stamps)),
            knocked.scans("front", set(stamps)),
            strict=True,
        )
    )

    for plain, moved in pairs:
        same = plain.points_lidar.shape == moved.points_lidar.shape and np.array_equal(
            plain.points_lidar, moved.points_lidar
        )
        assert same == (plain.stamp_ns < knocked.knock_ns)
        assert plain.stamp_ns == moved.stamp_ns
    assert {plain.stamp_ns < knocked.knock_ns for plain, _ in pairs} == {True, False}
    mount = knocked.after.truth.T_vehicle_lidar["front"]
    difference = vehicle_axes_difference(mount, recording.truth.T_vehicle_lidar["front"])
    assert difference == pytest.approx(np.concatenate([turn, np.zeros(3)]), abs=1e-9)
    assert list(knocked.scans("rear", set(stamps)))[-1].points_lidar == pytest.approx(
        list(recording.scans("rear", set(stamps)))[-1].points_lidar
    )


def test_drawn_calibrations_err_as_they_say(recording: SimulatedRecording) -> None:
    said = calibration(recording)
    truth = recording.truth.T_vehicle_lidar
    nees = []
    for seed in range(300):
        one = drawn(said, truth, seed)
        errors = np.concatenate(
            [
                gtsam.Pose3.Logmap(truth[n].between(result.T_vehicle_lidar))
                for n, result in one.lidars.items()
            ]
        )
        nees.append(errors @ np.linalg.solve(said.cov_joint, errors))

    # 12 degrees of freedom; 300 draws leave the mean uncertain by 0.28.
    assert np.mean(nees) == pytest.approx(12.0, abs=1.2)


# ------------------------------------------------------------------ the command


def make_run(scale: float = 1.0, alarms: tuple[Run, ...] = (), **more: object) -> Run:
    return {
        "time_s": [10.0, 20.0, 45.0],
        "position_m": [scale * v for v in (0.01, 0.02, 0.02)],
        "heading_rad": [scale * v for v in (0.001, -0.001, 0.001)],
        "nees": [6.0, 6.0, 12.0 * scale],
        "nees_position": [3.0, 3.0, 3.0],
        "nees_heading": [1.0, 1.0, 1.0],
        "nees_registration": [6.0, 6.0],
        "innovations": [3.0, 9.0],
        "left_out": 0,
        "alarms": list(alarms),
        **more,
    }


def make_alarm(lidar: str, time_s: float, turn: Array, alone: bool = True) -> Run:
    return {
        "lidar": lidar,
        "time_s": time_s,
        "movement": [*turn, 0.0, 0.0, 0.0],
        "sigma": [1e-3] * 6,
        "scans": 2,
        "chi2": 99.0,
        "alone": alone,
    }


def make_seed(found: tuple[Run, ...]) -> dict[str, Run]:
    turn = [0.003, 0.0, 0.0]
    return {
        "initial": make_run(100.0),
        "calibrated": make_run(),
        "priors": make_run(),
        "knocked": make_run(alarms=found, knocked="rear", turn=turn, knock_s=12.0),
    }


def test_tables_say_what_the_runs_are(scenario: Scenario) -> None:
    seeds = {
        1: make_seed((make_alarm("rear", 13.5, np.array([0.003, 0.001, 0.0])),)),
        2: make_seed(()),
        3: make_seed((make_alarm("front", 11.0, np.zeros(3)),)),
    }

    accuracy = localiser_example.accuracy_table(seeds, scenario)
    monitor = localiser_example.monitor_table(seeds, 0.5)

    # The root of (1 + 4 + 4) / 3 is 1.73.
    (line,) = (row for row in accuracy.splitlines() if "calibrated, constants" in row)
    assert line.split()[2:8] == ["17.3", "mm", "20.0", "mm", "1.00", "mrad"]
    assert "1.33 +- 0.00" in accuracy
    assert "0 of 3 drives alarmed" in monitor
    assert "found in 1 of 3 drives, after 1.5 s in the median and 1.5 s at most" in monitor
    assert "and it alone, in 1; alarmed before in 1; the turn known to 1.00 mrad" in monitor


@pytest.fixture
def calibration_file(recording: SimulatedRecording, tmp_path: Path) -> Path:
    path = tmp_path / "calibration.yaml"
    write_calibration(calibration(recording), path)
    return path


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Seeds that were run, for which made-up runs stand in."""
    seeds: list[int] = []

    def runs(_: Task, seed: int) -> dict[str, Run]:
        seeds.append(seed)
        return make_seed(())

    monkeypatch.setattr(_localiser_runs, "runs", runs)
    return seeds


def test_a_seed_is_run_once(
    scenario: Scenario, calibration_file: Path, made: list[int], tmp_path: Path
) -> None:
    task = Task(scenario, calibration_file, 0.5, draw=True)

    first = cached_runs(task, 3, tmp_path)
    again = cached_runs(task, 3, tmp_path)
    cached_runs(replace(task, knock_deg=0.1), 3, tmp_path)

    assert first == again
    assert made == [3, 3]


def test_the_command_runs_what_is_missing_and_prints_both_tables(
    calibration_file: Path,
    made: list[int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(localiser_example, "OUT", tmp_path / "out")
    command = ["--calibration", str(calibration_file), "--first-seed", "5", "--seeds"]

    localiser_example.main([*command, "1"])
    capsys.readouterr()
    assert localiser_example.main([*command, "2"]) == 0

    printed = capsys.readouterr().out
    assert made == [5, 6]
    assert "seed 6: initial 1732.1 mm" in printed
    assert "2 drives of 'localiser'" in printed
    assert "knocked by 0.5 degrees: found in 0 of 2" in printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seeds", "0"], "--seeds must be 1 or more"),
        (["--knock", "-1"], "--knock"),
        (["--from-sensors", "--calibration", "x.yaml"], "give one of them"),
        (["--calibration", "nowhere.yaml"], "nowhere.yaml: "),
    ],
)
def test_bad_arguments_are_one_line(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        localiser_example.main(arguments)

    assert stopped.value.code == 2
    assert message in capsys.readouterr().err
