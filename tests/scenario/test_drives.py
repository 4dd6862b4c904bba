"""Drives against numbers derived by hand and against independent integration."""

import math

import gtsam
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from caliv_graph.products import IntArray
from caliv_graph.scenario.drive_models import (
    ArcDrive,
    DriveModel,
    FigureEightDrive,
    SCurveDrive,
    StandstillDrive,
    StraightDrive,
)
from caliv_graph.scenario.drives import (
    Drive,
    Motion,
    make_drive,
    smoothstep,
    smoothstep_integral,
    smoothstep_rate,
)

MOVING: dict[str, DriveModel] = {
    "arc": ArcDrive(duration_s=17.0),
    "left_arc": ArcDrive(duration_s=17.0, turn="left"),
    "s_curve": SCurveDrive(duration_s=17.0),
    "figure_eight": FigureEightDrive(),
    "straight": StraightDrive(duration_s=17.0),
}


def every(drive: Drive, step_s: float) -> IntArray:
    return np.arange(0, round(drive.duration_s * 1e9), round(step_s * 1e9), dtype=np.int64)


def at(drive: Drive, *times_s: float) -> Motion:
    return drive.motion(np.array([round(t * 1e9) for t in times_s]))


def test_smoothstep_has_the_derivative_and_the_integral_that_it_says() -> None:
    u = np.linspace(-0.5, 1.5, 2001)
    np.testing.assert_allclose(np.gradient(smoothstep(u), u), smoothstep_rate(u), atol=1e-5)
    np.testing.assert_allclose(np.gradient(smoothstep_integral(u), u), smoothstep(u), atol=1e-5)
    assert smoothstep(0.5) == pytest.approx(0.5)
    assert smoothstep_integral(1.0) == pytest.approx(0.5)


def test_arc_stays_on_its_circle() -> None:
    drive = make_drive(ArcDrive(duration_s=17.0, radius_m=9.16, turn="right"))
    motion = drive.motion(every(drive, 0.01))
    centre = np.array([0.0, -9.16])
    np.testing.assert_allclose(np.linalg.norm(motion.xy_map - centre, axis=1), 9.16, atol=1e-9)


def test_arc_ends_where_its_length_takes_it() -> None:
    # 17 s less 1 s of standing and half of each 1.5 s ramp is 14.5 s of 2 m/s: 29 m.
    drive = make_drive(ArcDrive(duration_s=17.0, radius_m=9.16, turn="right"))
    angle = 29.0 / 9.16
    motion = at(drive, 17.0, 30.0)
    np.testing.assert_allclose(motion.heading_rad, -angle, atol=1e-12)
    end = [9.16 * math.sin(angle), -9.16 * (1.0 - math.cos(angle))]
    np.testing.assert_allclose(motion.xy_map, [end, end], atol=1e-9)


def test_arc_to_the_left_is_the_mirror_image() -> None:
    right = at(make_drive(MOVING["arc"]), 4.0, 11.0)
    left = at(make_drive(MOVING["left_arc"]), 4.0, 11.0)
    np.testing.assert_allclose(left.xy_map, right.xy_map * [1.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(left.heading_rad, -right.heading_rad, atol=1e-12)


def test_vehicle_stands_starts_and_stops_when_it_should() -> None:
    motion = at(make_drive(MOVING["arc"]), -3.0, 0.0, 1.0, 1.75, 2.5, 9.0, 15.5, 16.25, 17.0, 40.0)
    np.testing.assert_allclose(
        motion.speed_m_s, [0.0, 0.0, 0.0, 1.0, 2.0, 2.0, 2.0, 1.0, 0.0, 0.0], atol=1e-12
    )
    np.testing.assert_allclose(motion.xy_map[:3], 0.0, atol=1e-12)
    # The steepest point of the ramp: 15/8 of 2 m/s in 1.5 s.
    np.testing.assert_allclose(motion.acceleration_m_s2[[3, 7]], [2.5, -2.5], atol=1e-12)


def test_steering_angle_is_that_of_the_paper() -> None:
    steering = at(make_drive(MOVING["arc"]), 5.0).steering_rad
    assert math.degrees(steering[0]) == pytest.approx(-17.0, abs=0.01)


@pytest.mark.parametrize("name", MOVING)
def test_motion_is_consistent_with_its_derivatives(name: str) -> None:
    drive = make_drive(MOVING[name])
    step_s = 1e-3
    motion = drive.motion(every(drive, step_s))
    velocity = np.gradient(motion.xy_map, step_s, axis=0)
    heading = motion.heading_rad
    along = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    # No slip: the rear axle moves along the vehicle's x axis only.
    np.testing.assert_allclose(
        velocity[1:-1], (motion.speed_m_s[:, None] * along)[1:-1], rtol=0.0, atol=1e-5
    )
    yaw_rate = np.gradient(heading, step_s)
    np.testing.assert_allclose(yaw_rate[1:-1], motion.yaw_rate_rad_s[1:-1], rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(
        motion.yaw_rate_rad_s, motion.speed_m_s * motion.curvature_1_m, atol=1e-15
    )
    acceleration = np.gradient(motion.speed_m_s, step_s)
    np.testing.assert_allclose(
        acceleration[1:-1], motion.acceleration_m_s2[1:-1], rtol=0.0, atol=1e-4
    )


@pytest.mark.parametrize("name", ["s_curve", "figure_eight"])
def test_curvature_changes_smoothly_and_all_the_way(name: str) -> None:
    drive = make_drive(MOVING[name])
    motion = drive.motion(every(drive, 1e-3))
    assert motion.curvature_1_m[0] == pytest.approx(-1.0 / 9.16)
    assert motion.curvature_1_m[-1] == pytest.approx(1.0 / 9.16)
    # Steepest: 15/8 of the whole change over 3 m, and 2 mm of path from sample to sample.
    bound = 15.0 / 8.0 * (2.0 / 9.16) / 3.0 * 2e-3
    assert np.abs(np.diff(motion.curvature_1_m)).max() < 1.01 * bound


def test_s_curve_ends_on_its_first_heading() -> None:
    drive = make_drive(MOVING["s_curve"])
    motion = at(drive, 9.0, 17.0)
    assert motion.heading_rad[0] < -1.0
    assert motion.heading_rad[1] == pytest.approx(0.0, abs=1e-12)


def test_figure_eight_turns_full_circles() -> None:
    drive = make_drive(MOVING["figure_eight"])
    # Two circles, and 2 * 5/64 of the 3 m of change twice: 116.05 m at 2 m/s, 1.5 s, 1 s.
    length_m = 2.0 * (2.0 * math.pi * 9.16 + 2.0 * 5.0 / 64.0 * 3.0)
    assert drive.duration_s == pytest.approx(length_m / 2.0 + 2.5)
    middle_s = 1.0 + 0.5 * (drive.duration_s - 1.0)
    motion = at(drive, middle_s, drive.duration_s)
    np.testing.assert_allclose(motion.heading_rad, [-2.0 * math.pi, 0.0], atol=1e-8)
    # It crosses itself where it began, but for what the change of curvature adds straight ahead.
    longer_m = 2.0 * 5.0 / 64.0 * 3.0
    np.testing.assert_allclose(motion.xy_map, [[longer_m, 0.0], [2.0 * longer_m, 0.0]], atol=0.02)


@pytest.mark.parametrize("name", MOVING)
def test_position_agrees_with_an_independent_integration(name: str) -> None:
    drive = make_drive(MOVING[name])

    def rates(t: float, state: object) -> list[float]:
        motion = at(drive, t)
        v, heading = float(motion.speed_m_s[0]), float(motion.heading_rad[0])
        return [v * math.cos(heading), v * math.sin(heading)]

    times_s = [3.0, 9.7, 16.9]
    solution = solve_ivp(
        rates, (0.0, 16.9), [0.0, 0.0], t_eval=times_s, rtol=1e-9, atol=1e-9, max_step=0.2
    )
    np.testing.assert_allclose(at(drive, *times_s).xy_map, solution.y.T, rtol=0.0, atol=1e-6)


def test_standstill_does_not_move() -> None:
    drive = make_drive(StandstillDrive(duration_s=5.0, start_xy_m=(3.0, 4.0), start_yaw_deg=90.0))
    motion = drive.motion(every(drive, 0.1))
    assert drive.duration_s == 5.0
    np.testing.assert_allclose(motion.xy_map, np.tile([3.0, 4.0], (50, 1)), atol=0.0)
    np.testing.assert_allclose(motion.heading_rad, math.pi / 2.0)
    assert not motion.speed_m_s.any()


def test_straight_is_straight() -> None:
    motion = at(make_drive(StraightDrive(duration_s=17.0)), 17.0)
    np.testing.assert_allclose(motion.xy_map, [[29.0, 0.0]], atol=1e-9)


@pytest.mark.parametrize("name", MOVING)
def test_start_pose_moves_the_whole_drive(name: str) -> None:
    stamps_ns = np.array([0, 4_000_000_000, 9_100_000_000, 14_000_000_000])
    moved = MOVING[name].model_copy(update={"start_xy_m": (-7.0, 2.0), "start_yaw_deg": 133.0})
    T_map_start = gtsam.Pose3(gtsam.Rot3.Yaw(math.radians(133.0)), np.array([-7.0, 2.0, 0.0]))
    for pose, pose_moved in zip(
        make_drive(MOVING[name]).poses(stamps_ns), make_drive(moved).poses(stamps_ns), strict=True
    ):
        assert T_map_start.compose(pose).equals(pose_moved, 1e-9)


def test_stamps_come_in_any_order_and_heights_with_them() -> None:
    drive = make_drive(MOVING["s_curve"])
    stamps_ns = np.array([16_000_000_000, 2_000_000_000, 9_000_000_000])
    heights = np.array([0.3, 0.1, 0.2])
    together = drive.poses(stamps_ns, heights)
    for i in range(3):
        (alone,) = drive.poses(stamps_ns[i : i + 1], heights[i])
        assert alone.equals(together[i], 1e-12)
        assert together[i].translation()[2] == heights[i]
