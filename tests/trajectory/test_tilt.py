"""Roll and pitch of the vehicle's axes over a drive: a slope of the ground is not taken for it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from caliv_graph.config.model import Config
from caliv_graph.products import Array, Trajectory
from caliv_graph.trajectory.select import GivenTrajectory
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.tilt import vehicle_tilt
from caliv_graph.wording.physics import tilt_finding
from scripts.show_hills import beside_a_hill
from tests.trajectory.motions import Course, Sensors, config_for, eight_drive, record
from tests.trajectory.test_wheels import beside_imu, settings

CONFIG = config_for(Sensors())
SPEED_M_S, RADIUS_M = 2.0, 9.0


def drive(slope: float, turning: bool, rpy: tuple[float, float]) -> GivenTrajectory:
    """60 s over a plane that rises by `slope` towards +x; the axes turned by (roll, pitch)."""
    t = np.arange(0.0, 60.0, 0.1)
    yaw = SPEED_M_S / RADIUS_M * t if turning else 0.0 * t
    x = RADIUS_M * np.sin(yaw) if turning else SPEED_M_S * t
    y = RADIUS_M * (1.0 - np.cos(yaw)) if turning else 0.0 * t
    # A turn about y by -atan(slope) lifts +x: the ground's normal leans back.
    R_map_ground = gtsam.Rot3.Ry(-math.atan(slope))
    tilt = gtsam.Rot3.RzRyRx(*rpy, 0.0)
    poses = tuple(
        gtsam.Pose3(R_map_ground.compose(gtsam.Rot3.Rz(psi)).compose(tilt), p)
        for psi, p in zip(yaw, np.stack([x, y, slope * x], 1), strict=True)
    )
    return GivenTrajectory(Trajectory(np.round(1e9 * t).astype(np.int64), poses))


@pytest.mark.parametrize("slope", [0.0, 0.05, -0.1])
@pytest.mark.parametrize("rpy", [(0.0, 0.0), (0.035, -0.02)], ids=["level", "tilted"])
def test_on_a_slope_a_circle_tells_the_tilt(slope: float, rpy: tuple[float, float]) -> None:
    found = vehicle_tilt(drive(slope, True, rpy), "drive", CONFIG)

    assert found.roll_pitch_rad == pytest.approx(np.array(rpy), abs=0.003)
    assert (found.sigma_rad < 0.01).all()
    assert (tilt_finding(found, CONFIG) is not None) == (rpy != (0.0, 0.0))


def test_straight_uphill_pitch_is_known_and_roll_is_not() -> None:
    found = vehicle_tilt(drive(0.08, False, (0.03, 0.0)), "drive", CONFIG)

    # The climb of the path is the slope ahead; nothing tells the slope to the side.
    assert found.roll_pitch_rad[1] == pytest.approx(0.0, abs=0.003)
    assert found.sigma_rad[1] < 0.01 < 0.03 < found.sigma_rad[0]
    assert tilt_finding(found, CONFIG) is None


@pytest.mark.parametrize(
    "hill", [(5.0, 20.0, 2.0, 60.0), (10.0, 20.0, 1.0, 60.0), (15.0, 15.0, 2.0, 25.0)]
)
def test_a_hill_beside_the_path_is_no_tilt(hill: tuple[float, float, float, float]) -> None:
    # A plane that leans explains it by a vehicle that rolls by 4 to 10 degrees, at 10 to 21 sigma.
    found = vehicle_tilt(beside_a_hill(*hill), "drive", CONFIG)

    assert (np.abs(found.roll_pitch_rad) < 3.0 * found.sigma_rad).all()
    assert found.sigma_rad[0] < math.radians(7.0)
    assert tilt_finding(found, CONFIG) is None


@pytest.mark.parametrize(("roll_deg", "noise_m"), [(0.0, 0.05), (0.0, 0.2), (2.0, 0.05)])
def test_noise_of_given_heights_is_no_rough_ground(roll_deg: float, noise_m: float) -> None:
    # 50 mm are 50 mrad of climb over the metre and a half between two heights.
    level = drive(0.0, True, (math.radians(roll_deg), 0.0)).trajectory
    noise = np.random.default_rng(3).normal(0.0, noise_m, len(level.T_map_vehicle))
    poses = tuple(
        gtsam.Pose3(T.rotation(), np.add(T.translation(), [0.0, 0.0, off]))
        for T, off in zip(level.T_map_vehicle, noise, strict=True)
    )

    found = vehicle_tilt(GivenTrajectory(Trajectory(level.stamps_ns, poses)), "drive", CONFIG)

    assert np.degrees(found.roll_pitch_rad[0]) == pytest.approx(roll_deg, abs=0.3)
    assert np.degrees(found.sigma_rad[0]) < 0.6
    assert (tilt_finding(found, CONFIG) is not None) == (roll_deg > 0.0)


def test_where_nothing_tells_the_slope_it_is_that_of_roads() -> None:
    still = drive(0.0, False, (math.radians(8.0), 0.0)).trajectory
    poses = (still.T_map_vehicle[0],) * len(still.stamps_ns)

    found = vehicle_tilt(GivenTrajectory(Trajectory(still.stamps_ns, poses)), "drive", CONFIG)

    assert np.degrees(found.roll_pitch_rad[0]) == pytest.approx(8.0, abs=0.01)
    assert 2.0 < np.degrees(found.sigma_rad[0]) < 3.0


def test_in_reverse_the_climb_counts_backwards() -> None:
    forward = drive(0.08, False, (0.0, 0.02)).trajectory
    back = Trajectory(forward.stamps_ns, tuple(reversed(forward.T_map_vehicle)))

    found = vehicle_tilt(GivenTrajectory(back), "drive", CONFIG)

    assert found.roll_pitch_rad[1] == pytest.approx(0.02, abs=0.003)


@pytest.mark.parametrize(
    ("rpy_deg", "lies"),
    [((-90.0, 0.0), True), ((180.0, 0.0), True), ((0.0, 60.0), True), ((0.0, -15.0), False)],
)
def test_a_large_angle_is_no_sine(rpy_deg: tuple[float, float], lies: bool) -> None:
    """Poses of a camera, y down, were said to roll by one radian."""
    roll, pitch = np.radians(rpy_deg).tolist()
    found = vehicle_tilt(drive(0.0, True, (roll, pitch)), "drive", CONFIG)

    off = np.remainder(found.roll_pitch_rad - [roll, pitch] + math.pi, 2.0 * math.pi) - math.pi
    assert off == pytest.approx(np.zeros(2), abs=0.02)
    assert found.lies == lies


def leaning(*rpy_deg: float, parallel_sigma_deg: float | None = None) -> Config:
    """The config of a user who takes the IMU for turned by these angles."""
    mounted: dict[str, object] = {"T_vehicle_imu": {"xyz": [0, 0, 0], "rpy_deg": [*rpy_deg, 0.0]}}
    ground: dict[str, object] = {"parallel_sigma_deg": parallel_sigma_deg}
    return config_for(Sensors(), imu=mounted, ground=ground)


@pytest.mark.parametrize(
    ("rpy_deg", "seed"), [((2.0, 0.0), 0), ((0.0, -2.0), 1)], ids=["roll", "pitch"]
)
def test_two_degrees_of_the_imu_are_said_with_their_sigma(
    rpy_deg: tuple[float, float], seed: int
) -> None:
    motion, config = record(Course(eight_drive(31.0)), Sensors(), seed), leaning(*rpy_deg)
    smoothed = smooth_trajectory(motion, config, [])
    found = vehicle_tilt(smoothed, motion.name, config)

    off = np.degrees(found.roll_pitch_rad) + rpy_deg
    assert (np.abs(off) < 3.0 * np.degrees(found.sigma_rad)).all()
    finding = tilt_finding(found, config)
    assert finding is not None
    assert (finding.input, finding.severity) == ("imu.T_vehicle_imu", "contradiction")
    assert finding.value == pytest.approx((0.0, 0.0, 0.0), abs=0.3)
    # Who says that the vehicle leans is believed.
    config = leaning(*rpy_deg, parallel_sigma_deg=2.0)
    assert tilt_finding(vehicle_tilt(smoothed, motion.name, config), config) is None


def test_heights_that_nobody_measured_are_no_climb(monkeypatch: pytest.MonkeyPatch) -> None:
    # A path that climbs by 8 degrees while the vehicle is level, as heights of an IMU alone do.
    as_it_is = SmoothedTrajectory.poses_at

    def climbing(self: SmoothedTrajectory, stamps_ns: Any) -> tuple[Array, Array]:
        R, t = as_it_is(self, stamps_ns)
        return R, t + 0.28 * 1e-9 * (np.asarray(stamps_ns) - self.nodes_ns[0])[:, None] * [0, 0, 1]

    motion, config = beside_imu(1), settings()
    found = {}
    for fixes in (True, False):
        of = motion if fixes else replace(motion, gnss=None)
        smoothed = smooth_trajectory(of, config, [])
        with monkeypatch.context() as patch:
            patch.setattr(SmoothedTrajectory, "poses_at", climbing)
            found[fixes] = vehicle_tilt(smoothed, of.name, config)

    pitch_deg = {fixes: math.degrees(of.roll_pitch_rad[1]) for fixes, of in found.items()}
    assert abs(pitch_deg[True]) > 3.0
    assert abs(pitch_deg[False]) < 0.2
    assert math.degrees(found[False].sigma_rad[1]) > 1.0


@pytest.mark.parametrize("end_ns", [21_350_000_000, 36_390_000_000, 21_350_000_077])
def test_stamps_since_1970_stay_within_the_drive(end_ns: int) -> None:
    # A float has steps of 256 ns there; the last of these stamps used to lie beyond the end.
    begin = 1_750_000_000_000_000_000
    stamps = begin + np.array([0, end_ns // 2, end_ns])
    poses = tuple(gtsam.Pose3(gtsam.Rot3(), np.array([x, 0.0, 0.0])) for x in (0.0, 10.0, 20.0))

    found = vehicle_tilt(GivenTrajectory(Trajectory(stamps, poses)), "drive", CONFIG)

    assert found.roll_pitch_rad == pytest.approx(np.zeros(2), abs=1e-6)
