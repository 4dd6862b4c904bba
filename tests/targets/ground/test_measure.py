"""The ground over a drive: motion compensation, choice of scans, and what is reported."""

from __future__ import annotations

import math
from collections.abc import Container, Iterator
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.rates import with_rates_of
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.load import load_config, parse_config
from caliv_graph.config.model import Config, GroundConfig
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.config.range_errors import growth
from caliv_graph.errors import TrajectoryError
from caliv_graph.products import (
    Array,
    GroundObservation,
    LidarScan,
    MotionData,
    TargetCloud,
    TargetObservation,
    Trajectory,
)
from caliv_graph.readers.caliv_folder import CalivFolder
from caliv_graph.targets.ground.measure import (
    GroundMeter,
    by_rates,
    measure_grounds,
    nearest_scans,
)
from caliv_graph.targets.ground.planes import DISTANCE_FLOOR_M, NORMAL_FLOOR_RAD
from caliv_graph.trajectory.deskew import deskewed
from caliv_graph.trajectory.given import given_trajectory
from caliv_graph.trajectory.select import GivenTrajectory
from tests.samples import pose
from tests.targets.ground.scans import (
    HEIGHT_M,
    beams,
    level,
    plateau,
    scan_of,
    terrain,
)

ROOT = Path(__file__).parents[3]
RELEASED = ROOT.parent / "shared" / "data" / "caliv_released"

CONFIG = parse_config(
    {
        "lidars": {
            "front": {"topic": "a", "initial": {"xyz": [1.0, 0.0, 2.0], "rpy_deg": [1.0, 8.0, 0]}}
        }
    },
    "made up",
    Path(),
)

SECOND_NS = 1_000_000_000


def pitching(rate_rad_s: float) -> GivenTrajectory:
    """A vehicle that stands and pitches evenly about its frame's origin."""
    stamps = np.arange(0, SECOND_NS + 1, 10_000_000)
    poses = tuple(
        gtsam.Pose3(gtsam.Rot3.Pitch(rate_rad_s * (t - SECOND_NS // 2) / SECOND_NS), np.zeros(3))
        for t in stamps
    )
    return GivenTrajectory(Trajectory(stamps.astype(np.int64), poses))


def test_meter_compensates_the_motion() -> None:
    # A sweep of 0.1 s, during which the vehicle noses down by 20 mrad; the LiDAR at its origin.
    rate = 0.2
    trajectory = pitching(rate)
    columns, channels = 120, 26
    times_s = np.repeat(np.arange(columns) / columns * 0.1, channels)
    points = []
    for direction, time_s in zip(beams(columns, channels), times_s, strict=True):
        R = gtsam.Rot3.Pitch(math.radians(8.0) + rate * time_s).matrix()
        down = float((R @ direction)[2])
        points.append(direction * (HEIGHT_M / -down if down < -1e-3 else np.nan))
    cloud = np.array(points)
    seen = np.isfinite(cloud[:, 0])
    scan = LidarScan("front", SECOND_NS // 2, cloud[seen], "sweep", times_s[seen])
    mounted = {"front": {"topic": "a", "initial": {"xyz": [0, 0, 0], "rpy_deg": [0, 8.0, 0]}}}
    config = parse_config({"lidars": mounted}, "made up", Path())

    observation = GroundMeter(config, trajectory, 3).measure(scan)
    assert observation is not None
    eight = math.radians(8.0)
    expected = [-math.sin(eight), 0.0, math.cos(eight)]
    assert observation.normal_lidar == pytest.approx(expected, abs=1e-5)
    assert observation.distance_m == pytest.approx(HEIGHT_M, abs=1e-4)
    assert (observation.lidar, observation.drive, observation.stamp_ns) == (
        "front",
        3,
        SECOND_NS // 2,
    )
    assert np.sqrt(np.diag(observation.cov)) == pytest.approx(
        [NORMAL_FLOOR_RAD, NORMAL_FLOOR_RAD, DISTANCE_FLOOR_M], rel=0.05
    )
    # Without the times it would be off by milliradians.
    naive = GroundMeter(config, trajectory, 3).measure(replace(scan, point_times_s=None))
    assert naive is None or np.abs(naive.normal_lidar - expected).max() > 2e-3


def test_meter_tells_what_another_mounting_would_have_made_of_it() -> None:
    # 2 m/s ahead while turning by 0.3 rad/s: with a pitch that is 2 degrees off, the ground seems
    # to rise by 7 mm from the first column of the sweep to the last.
    stamps = np.arange(0, SECOND_NS + 1, 10_000_000)
    moving = tuple(
        gtsam.Pose3.Expmap((t / SECOND_NS - 0.5) * np.array([0.0, 0.0, 0.3, 2.0, 0.0, 0.0]))
        for t in stamps
    )
    trajectory = GivenTrajectory(Trajectory(stamps.astype(np.int64), moving))
    true = pose((1.0, 0.2, HEIGHT_M), (1.0, 8.0, -2.0))
    guess = pose((1.05, 0.15, 1.9), (2.5, 6.0, 1.0))
    columns, channels = 120, 26
    times_s = np.repeat(np.arange(columns) / columns * 0.1, channels)
    directions = beams(columns, channels)
    # The vehicle stays level: all columns see the ground as if it stood.
    down = -(directions @ true.rotation().matrix().T)[:, 2]
    seen = down > 0.02
    points = directions[seen] * (HEIGHT_M / down[seen])[:, None]
    scan = LidarScan("front", SECOND_NS // 2, points, "sweep", times_s[seen])
    lidar = {"topic": "a", "initial": {"xyz": [1.05, 0.15, 1.9], "rpy_deg": [2.5, 6.0, 1.0]}}
    config = parse_config({"lidars": {"front": lidar}}, "made up", Path())

    found = GroundMeter(config, trajectory, 0).measure(scan)
    assert found is not None
    assert found.R_vehicle_lidar == pytest.approx(guess.rotation().matrix(), abs=1e-12)
    assert found.by_extrinsic is not None
    normal = true.rotation().matrix()[2]
    off = np.append(found.axes_lidar @ (found.normal_lidar - normal), found.distance_m - HEIGHT_M)
    w = gtsam.Rot3.Logmap(guess.rotation().between(true.rotation()))
    corrected = off + found.by_extrinsic @ w
    assert np.abs(off[:2]).max() > 4e-4
    assert abs(off[2]) > 4e-4
    assert np.abs(corrected[:2]).max() < 4e-5
    assert abs(corrected[2]) < 2e-4
    # The ground is level: that it seems bent is of the guess.
    assert found.beyond_by_extrinsic is not None
    straight = found.beyond + found.beyond_by_extrinsic @ w
    assert abs(found.beyond[0]) > 3e-4
    assert np.abs(straight).max() < 4e-5
    # Clouds of one instant have nothing to be corrected.
    at_once = GroundMeter(config, trajectory, 0).measure(replace(scan, point_times_s=None))
    assert at_once is not None
    assert at_once.by_extrinsic is None
    assert at_once.beyond_by_extrinsic is None


def turning(twist: Array) -> GivenTrajectory:
    """A second at constant velocities (6,), at the origin in the middle of it."""
    stamps = np.arange(0, SECOND_NS + 1, 10_000_000)
    moving = tuple(gtsam.Pose3.Expmap((t / SECOND_NS - 0.5) * twist) for t in stamps)
    return GivenTrajectory(Trajectory(stamps.astype(np.int64), moving))


def test_meter_tells_what_other_rates_would_have_made_of_it() -> None:
    twist = np.array([0.0, 0.02, 0.3, 2.0, 0.0, 0.1])
    directions = beams(120, 26)
    times_s = np.repeat(np.arange(120) / 120 * 0.1 - 0.1, 26)
    T = CONFIG.lidars["front"].guess()
    down = -(directions @ T.rotation().matrix().T)[:, 2]
    seen = down > 0.02
    points = directions[seen] * (HEIGHT_M / down[seen])[:, None]
    scan = LidarScan("front", SECOND_NS // 2, points, "sweep", times_s[seen])

    def measured(rates: Array) -> GroundObservation:
        found = GroundMeter(CONFIG, turning(rates), 0).measure(scan)
        assert found is not None
        return found

    usual = measured(twist)
    assert usual.by_rates is not None
    assert scan.point_times_s is not None
    (still,) = deskewed(scan, [T], turning(twist))
    moves = by_rates(still, scan.point_times_s, T)
    for k, d in enumerate(1e-3 * np.eye(6)):
        found = measured(twist + d)
        tilts = usual.axes_lidar @ (found.normal_lidar - usual.normal_lidar)
        change = 1e3 * np.append(tilts, found.distance_m - usual.distance_m)
        assert change == pytest.approx(usual.by_rates[:, k], rel=0.1, abs=0.02)
        # The same from the observation alone, where a drive was smoothed again.
        (again,) = with_rates_of([usual], [turning(twist)], [turning(twist + d)])
        assert again.normal_lidar == pytest.approx(found.normal_lidar, abs=5e-6)
        assert again.distance_m == pytest.approx(found.distance_m, abs=1e-5)
        (moved,) = deskewed(scan, [T], turning(twist + d))
        left = np.linalg.norm(1e3 * (moved - still) - moves[k], axis=1)
        arm = np.linalg.norm(points, axis=1) + 3.0 if k < 3 else 1.0
        # Half of the turn during the sweep, 0.03 rad, is neglected.
        assert (left <= 0.02 * np.abs(scan.point_times_s) * arm + 1e-9).all()
    assert np.abs(usual.by_rates).max() > 0.05
    at_once = GroundMeter(CONFIG, turning(twist), 0).measure(replace(scan, point_times_s=None))
    assert at_once is not None
    assert at_once.by_rates is None


@pytest.mark.parametrize("speed_m_s", [0.0, 10.0])
def test_meter_tells_what_range_biases_change(speed_m_s: float) -> None:
    """Also where the LiDAR is a metre farther at the end of its sweep."""
    columns, channels = 120, 26
    directions = beams(columns, channels)
    stamps = np.arange(0, SECOND_NS + 1, 10_000_000)
    ahead = [gtsam.Pose3(gtsam.Rot3(), [speed_m_s * t / SECOND_NS, 0, 0]) for t in stamps.tolist()]
    trajectory = GivenTrajectory(Trajectory(stamps.astype(np.int64), tuple(ahead)))
    times_s = np.repeat(np.arange(columns) / columns * 0.1, channels)
    T = pose((1.0, 0.0, HEIGHT_M), (1.0, 8.0, 0.0))
    down = -(directions @ T.rotation().matrix().T)[:, 2]
    seen = down > 0.02
    ranges, across = HEIGHT_M / down[seen], down[seen]
    meter = GroundMeter(CONFIG, trajectory, 0)

    def measured(lengths: Array) -> GroundObservation:
        points = directions[seen] * lengths[:, None]
        scan = LidarScan("front", SECOND_NS // 2, points, "scan", times_s[seen])
        found = meter.measure(scan)
        assert found is not None
        return found

    true = measured(ranges)
    assert true.by_range_bias is not None
    size_m = 2e-3
    for column, wrong in enumerate((np.ones(len(ranges)), *growth(across).T)):
        found = measured(ranges + size_m * wrong)
        tilts = true.axes_lidar @ found.normal_lidar
        change = np.append(tilts, found.distance_m - true.distance_m) / size_m
        assert change == pytest.approx(true.by_range_bias[:, column], rel=0.01, abs=2e-4)
    # Too long ranges sink the ground below the LiDAR by a part of their bias.
    assert 0.1 < true.by_range_bias[2, 0] < 1.0


def test_meter_says_why_there_is_no_ground() -> None:
    meter = GroundMeter(CONFIG, pitching(0.0), 1)
    empty = LidarScan("front", 5, np.zeros((0, 3)), "empty")
    assert meter.measure(empty) is None
    assert meter.measure(replace(scan_of(level), stamp_ns=6)) is not None
    assert meter.warnings() == ()
    assert meter.measure(empty) is None
    assert meter.warnings() == (
        "ground: lidar 'front' has it in 1 of 3 scans of drive 2: "
        "2 under 60 points near the ground",
    )


def test_the_roof_below_a_lidar_is_no_ground() -> None:
    stated = Config(lidars=CONFIG.lidars, ground=GroundConfig(vehicle_height=0.0))
    meter = GroundMeter(stated, pitching(0.0), 0)
    roof = scan_of(level, plateau(0.3, 4.0, 3.0, HEIGHT_M - 0.2), directions=beams(400, 80))

    # Beams that clear its edges meet the ground, 2 m below and more than 20 m away.
    assert meter.measure(roof) is None
    assert meter.warnings()[0].endswith("1 beams pass through the plane, to what is lower")
    # Nothing says that it is not a quay: no height is stated.
    assert GroundMeter(CONFIG, pitching(0.0), 0).measure(roof) is not None


def test_a_road_on_a_bank_is_ground() -> None:
    """Sixteen metres wide and a metre above the field, at the stated height."""
    lower = LidarConfig(topic="a", initial=PoseConfig(xyz=(1.0, 0.0, 1.0), rpy_deg=(1.0, 8.0, 0)))
    config = Config(lidars={"front": lower}, ground=GroundConfig(vehicle_height=0.0))
    road = scan_of(level, plateau(-30.0, 30.0, 8.0, 1.0), directions=beams(400, 80))

    found = GroundMeter(config, pitching(0.0), 0).measure(road)

    assert found is not None
    assert found.distance_m == pytest.approx(HEIGHT_M - 1.0, abs=1e-3)


def test_ground_with_a_shaft_is_ground() -> None:
    def shaft(directions: Array) -> Array:
        """Half a metre square, 6 m ahead, a metre deep."""
        foot = level(directions)[:, None] * directions
        inside = (np.abs(foot[:, 0] - 6.0) < 0.25) & (np.abs(foot[:, 1]) < 0.25)
        return np.where(inside, 1.5 * level(directions), level(directions))

    found = GroundMeter(CONFIG, pitching(0.0), 0).measure(scan_of(shaft))
    assert found is not None
    assert found.distance_m == pytest.approx(HEIGHT_M, abs=1e-3)


def test_meter_says_how_often_the_ground_is_bent() -> None:
    lidar = {"topic": "a", "initial": {"xyz": [0, 0, 2], "rpy_deg": [0, 10.0, 0]}}
    lidars = {name: lidar | {"topic": name} for name in ("front", "rear")}
    meter = GroundMeter(parse_config({"lidars": lidars}, "made up", Path()), pitching(0.0), 0)
    flat = scan_of(level)
    bent = scan_of(terrain(lambda x: x**2 / 200.0), sigma_m=0.01)
    for n in range(10):
        assert meter.measure(replace(flat, lidar="rear", stamp_ns=n)) is not None
        measured = meter.measure(replace(bent if n < 6 else flat, stamp_ns=n))
        assert (measured is None) == (n < 6)
    # Scans that show no ground say nothing of its shape.
    assert meter.measure(LidarScan("front", 11, np.zeros((0, 3)), "empty")) is None
    assert meter.bent() == pytest.approx(0.6)


def test_meter_refuses_stamps_outside_the_trajectory() -> None:
    meter = GroundMeter(CONFIG, pitching(0.0), 0)
    with pytest.raises(TrajectoryError, match="outside the given poses"):
        meter.measure(replace(scan_of(level), stamp_ns=2 * SECOND_NS))


def test_ground_as_of_another_stamp() -> None:
    # The vehicle noses down by 0.2 rad/s; the scan is taken 50 ms before the pose it speaks for.
    mounted = {"front": {"topic": "a", "initial": {"xyz": [0, 0, 0], "rpy_deg": [0, 10.0, 0]}}}
    config = parse_config({"lidars": mounted}, "made up", Path())
    meter = GroundMeter(config, pitching(0.2), 0)
    scan = replace(scan_of(level), stamp_ns=SECOND_NS // 2)
    at_ns = SECOND_NS // 2 + 50_000_000
    found = meter.measure(scan, at_ns)
    assert found is not None
    assert found.stamp_ns == at_ns
    tilt = math.radians(10.0) + 0.2 * 0.05
    assert found.normal_lidar == pytest.approx([-math.sin(tilt), 0.0, math.cos(tilt)], abs=1e-6)
    assert found.distance_m == pytest.approx(HEIGHT_M, abs=1e-6)


def test_nearest_scans() -> None:
    ms = 1_000_000
    scans = [0, 100 * ms, 200 * ms, 500 * ms]
    # To the nearest, unless another pose is nearer to it, or it is more than 60 ms away.
    poses = [20 * ms, 40 * ms, 149 * ms, 200 * ms, 439 * ms, 561 * ms]
    assert nearest_scans(poses, scans) == {0: 20 * ms, 100 * ms: 149 * ms, 200 * ms: 200 * ms}
    assert nearest_scans([440 * ms], scans) == {500 * ms: 440 * ms}
    assert nearest_scans([], scans) == {}
    assert nearest_scans(poses, []) == {}


class TwoLidars:
    """A recording in memory: `front` at 0.2, 0.4, ... s, `rear` 30 ms later."""

    name = "made up"
    lidars = ("front", "rear")

    def __init__(self) -> None:
        self.read: list[tuple[str, int]] = []

    def scan_stamps_ns(self, lidar: str) -> list[int]:
        return [200_000_000 * i + 30_000_000 * (lidar == "rear") for i in range(1, 5)]

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        for stamp_ns in self.scan_stamps_ns(lidar):
            if wanted is None or stamp_ns in wanted:
                self.read.append((lidar, stamp_ns))
                yield replace(scan_of(level), lidar=lidar, stamp_ns=stamp_ns)

    def motion(self) -> MotionData:
        return MotionData("made up")

    def warnings(self) -> tuple[str, ...]:
        return ()


def test_all_lidars_see_the_ground_when_one_sees_the_target() -> None:
    lidar = {"topic": "a", "initial": {"xyz": [0, 0, 2], "rpy_deg": [0, 10.0, 0]}}
    lidars = {name: lidar | {"topic": name} for name in ("front", "rear", "blind")}
    config = parse_config({"lidars": lidars}, "made up", Path())
    # The front LiDAR sees the target twice, the rear one once.
    seen = [("front", 400_000_000), ("front", 600_000_000), ("rear", 830_000_000)]
    clouds = tuple(TargetCloud(name, 0, t, np.zeros((1, 3)), "cloud") for name, t in seen)
    targets = [TargetObservation(0, "target", np.zeros(3), clouds)]
    recording, progress = TwoLidars(), SilentProgress()
    found, warnings = measure_grounds([recording], [pitching(0.0)], targets, config, progress)
    assert [(o.lidar, o.stamp_ns // 1_000_000) for o in found] == [
        ("front", 400),
        ("front", 600),
        ("front", 830),
        ("rear", 400),
        ("rear", 600),
        ("rear", 830),
    ]
    assert len(recording.read) == 6
    assert warnings == ()
    assert all(o.distance_m == pytest.approx(HEIGHT_M, abs=1e-6) for o in found)
    off = config.model_copy(update={"ground": config.ground.model_copy(update={"use": False})})
    assert measure_grounds([recording], [pitching(0.0)], targets, off, progress) == ((), ())
    assert len(recording.read) == 6


@pytest.mark.skipif(not RELEASED.is_dir(), reason="the authors' drive is not there")
def test_authors_drive_agrees_with_their_extrinsics() -> None:
    config: Config = load_config(ROOT / "configs" / "caliv_released.yaml")
    recording = CalivFolder(RELEASED, config.lidars)
    trajectory = GivenTrajectory(given_trajectory(recording.motion()))
    meter = GroundMeter(config, trajectory, 0)
    published = {
        "sensor_1": pose((2.259, 0.0, 1.938), (0.0, 10.0, 0.0)),
        "sensor_2": pose((-0.3987347, 0.002735673, 2.098425312), (0.0, 10.0, 180.0)),
    }
    for name, T in published.items():
        stamps = set(recording.scan_stamps_ns(name)[::3])
        found: list[GroundObservation] = []
        for scan in recording.scans(name, stamps):
            observation = meter.measure(scan)
            assert observation is not None
            found.append(observation)
        normals = np.array([T.rotation().matrix() @ o.normal_lidar for o in found])
        heights = [o.distance_m - n @ T.translation() for o, n in zip(found, normals, strict=True)]
        # Their vehicle frame is on the ground; it leans out of the turn by a little over 1 mrad.
        assert np.mean(heights) == pytest.approx(0.0, abs=1e-3)
        assert normals.mean(axis=0)[:2] == pytest.approx([0.0, -1.2e-3], abs=5e-4)
    assert meter.warnings() == ()
