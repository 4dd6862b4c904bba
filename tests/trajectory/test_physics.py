"""Raw sensors against each other and the config: each mistake is named, a sound drive is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from caliv_graph.errors import TrajectoryError
from caliv_graph.physics import raise_fatal, raw_findings
from caliv_graph.products import Array, Finding, MotionData
from caliv_graph.trajectory.axes import SIGMAS, is_alone
from caliv_graph.trajectory.physics import motion_physics
from tests.trajectory.motions import (
    Course,
    Sensors,
    arc_drive,
    config_for,
    eight_drive,
    mounted_askew,
    record,
)

EIGHT, ARC = Course(eight_drive(31.0)), Course(arc_drive())
SEEDS = range(3)


@cache
def recorded(course: Course, seed: int, askew: bool = False) -> MotionData:
    return record(course, mounted_askew() if askew else Sensors(), seed)


def imu(motion: MotionData, **changes: Callable[[Array], Array]) -> MotionData:
    """Motion data with other readings of the IMU."""
    assert motion.imu is not None
    new: dict[str, Any] = {n: change(getattr(motion.imu, n)) for n, change in changes.items()}
    return replace(motion, imu=replace(motion.imu, **new))


def mounted(*rpy_deg: float) -> dict[str, object]:
    return {"T_vehicle_imu": {"xyz": [0, 0, 0], "rpy_deg": list(rpy_deg)}}


def found_in(motion: MotionData, **sections: dict[str, object]) -> tuple[Finding, ...]:
    return raw_findings({0: motion}, config_for(Sensors(), **sections))


@pytest.mark.parametrize("course", [EIGHT, ARC, Course(eight_drive(31.0), rough=1.0)], ids=str)
@pytest.mark.parametrize("without", ["", "orientation", "twist", "gnss"])
def test_a_sound_drive_has_no_finding(course: Course, without: str) -> None:
    for seed in SEEDS:
        motion = recorded(course, seed, askew=True)
        if without == "orientation":
            assert motion.imu is not None
            motion = replace(motion, imu=replace(motion.imu, orientation_xyzw=None))
        elif without:
            motion = (
                replace(motion, twist=None) if without == "twist" else replace(motion, gnss=None)
            )
        assert raw_findings({0: motion}, config_for(mounted_askew())) == ()


@pytest.mark.parametrize("course", [EIGHT, ARC], ids=["eight", "arc"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_imu_on_its_side_is_named_with_the_rotation_that_fits(
    course: Course, sign: float
) -> None:
    # Its y axis is up (down): y_imu = +-z_vehicle, z_imu = -+y_vehicle.
    R_imu_vehicle = np.array([[1.0, 0, 0], [0, 0, sign], [0, -sign, 0]])
    for seed in SEEDS:
        motion = imu(
            recorded(course, seed),
            specific_force=lambda f: f @ R_imu_vehicle.T,
            angular_velocity=lambda w: w @ R_imu_vehicle.T,
            orientation_xyzw=lambda q: np.full_like(q, np.nan),
        )
        (found,) = found_in(motion)

        assert (found.input, found.severity) == ("imu.T_vehicle_imu", "fatal")
        axis = "+y" if sign > 0 else "-y"
        assert f"gravity is along {axis} of the IMU, " in found.sentence
        assert np.allclose(found.value, [sign * 90.0, 0.0, 0.0], atol=20.0)
        assert np.allclose(found.value[:2], [sign * 90.0, 0.0], atol=3.0)
        with pytest.raises(TrajectoryError, match="gravity is along"):
            raise_fatal((found,))
        assert found_in(motion, imu=mounted(sign * 90.0, 0.0, 0.0)) == ()


@pytest.mark.parametrize(
    ("change", "key", "severity", "said"),
    [
        ({"angular_velocity": np.degrees}, "topics.imu", "fatal", "degrees per second"),
        ({"angular_velocity": np.negative}, "topics.imu", "fatal", "opposite sign"),
        (
            {"angular_velocity": lambda w: 1.5 * w},
            "topics.imu",
            "contradiction",
            "the gyroscope turns 1.5",
        ),
        (
            {"orientation_xyzw": lambda q: q * [-1, -1, -1, 1]},
            "topics.imu",
            "contradiction",
            "the orientation of the same messages",
        ),
        (
            {
                "specific_force": lambda f: f[:, [1, 0, 2]],
                "angular_velocity": lambda w: w[:, [1, 0, 2]],
            },
            "topics.imu",
            "contradiction",
            "left-handed",
        ),
    ],
    ids=["degrees", "sign", "scale", "inverse orientation", "left-handed"],
)
def test_a_wrong_imu_is_named(
    change: dict[str, Callable[[Array], Array]], key: str, severity: str, said: str
) -> None:
    for seed in SEEDS:
        (found,) = found_in(imu(recorded(EIGHT, seed), **change))
        assert (found.input, found.severity) == (key, severity)
        assert said in found.sentence


@pytest.mark.parametrize("course", [EIGHT, ARC], ids=["eight", "arc"])
def test_a_force_of_the_opposite_sign_is_no_imu_that_hangs(course: Course) -> None:
    """Gravity is down in both; about it a gyroscope that hangs turns as the course does."""
    without = {"orientation_xyzw": lambda q: np.full_like(q, np.nan)}
    over = np.diag([1.0, -1.0, -1.0])
    for seed in SEEDS:
        motion = recorded(course, seed)
        (found,) = found_in(imu(motion, specific_force=np.negative, **without))
        assert (found.input, found.severity) == ("topics.imu", "fatal")
        assert "the sign of the acceleration is reversed" in found.sentence
        assert "multiply linear_acceleration by -1" in found.sentence
        assert "would fit" not in found.sentence
        turned = {name: lambda v: v @ over for name in ("specific_force", "angular_velocity")}
        (hangs,) = found_in(imu(motion, **turned, **without))
        assert hangs.input == "imu.T_vehicle_imu"
        assert "0, yaw) would fit" in hangs.sentence
        assert "sign" not in hangs.sentence


def test_swapped_latitude_and_longitude_are_named() -> None:
    """A mirrored path: nothing else that it contradicts is said."""
    for seed in SEEDS:
        motion = recorded(EIGHT, seed)
        gnss = motion.gnss
        assert gnss is not None
        swapped = replace(gnss, latitude_deg=gnss.longitude_deg, longitude_deg=gnss.latitude_deg)
        (found,) = found_in(replace(motion, gnss=swapped))
        assert (found.input, found.severity) == ("topics.gnss", "fatal")
        assert "latitude and longitude are swapped" in found.sentence


def test_the_unit_of_the_velocities_is_named() -> None:
    motion = recorded(EIGHT, 0)
    assert motion.twist is not None
    fast = replace(motion, twist=replace(motion.twist, velocity=3.6 * motion.twist.velocity))
    (found,) = found_in(fast)
    assert (found.input, found.severity) == ("topics.twist", "fatal")
    assert "km/h" in found.sentence


@pytest.mark.parametrize("course", [EIGHT, ARC], ids=["eight", "arc"])
def test_a_quarter_turn_of_yaw_is_named_and_corrected(course: Course) -> None:
    for seed in SEEDS:
        found = found_in(recorded(course, seed), imu=mounted(0.0, 0.0, 90.0))
        turned = [f for f in found if f.input == "imu.T_vehicle_imu"]
        assert len(turned) == 1
        assert abs(turned[0].value[2]) < max(5.0 * turned[0].sigma, 5.0)


@pytest.mark.parametrize(
    ("yaw_deg", "topics", "severity", "unless"),
    [
        (40.0, {}, "contradiction", ""),
        (90.0, {}, "fatal", ""),
        (90.0, {"heading": "/heading"}, "contradiction", ""),
        (180.0, {}, "contradiction", "unless the vehicle reverses all the way"),
        (180.0, {"twist": "/twist"}, "fatal", "unless the velocities in topics.twist"),
    ],
)
def test_without_orientations_axes_that_are_turned_leave_nothing_to_smooth(
    yaw_deg: float, topics: dict[str, object], severity: str, unless: str
) -> None:
    """The smoother took minutes for a path that fixes and accelerations do not share."""
    motion = recorded(EIGHT, 0)
    assert motion.imu is not None
    blind = replace(motion, imu=replace(motion.imu, orientation_xyzw=None))
    topics = {"imu": "/imu", "gnss": "/gnss", **topics}
    for of, expected in ((motion, "contradiction"), (blind, severity)):
        found = found_in(of, imu=mounted(0.0, 0.0, yaw_deg), topics=topics)
        (turned,) = (f for f in found if f.input == "imu.T_vehicle_imu")
        assert (turned.severity, unless in turned.sentence) == (expected, True)


def late(motion: MotionData, late_s: float) -> MotionData:
    assert motion.gnss is not None
    stamps = motion.gnss.stamps_ns + round(1e9 * late_s)
    return replace(motion, gnss=replace(motion.gnss, stamps_ns=stamps))


@pytest.mark.parametrize("late_s", [0.3, -0.2, 2.0, -1.0])
def test_a_late_gnss_clock_is_named_in_its_own_seconds(late_s: float) -> None:
    for seed in SEEDS:
        # Nothing else is: gyroscope, speeds and axes are compared at the true times.
        (found,) = found_in(late(recorded(EIGHT, seed), late_s))
        assert (found.input, found.severity) == ("topics.gnss", "contradiction")
        assert found.value[0] == pytest.approx(late_s, abs=5.0 * found.sigma)
        assert "or set gnss.time_offset_sigma_s to as much" in found.sentence


def test_a_late_gnss_clock_that_the_config_allows_for_is_no_finding() -> None:
    # As the sentence says.
    motion = late(recorded(EIGHT, 0), 0.5)
    assert found_in(motion, gnss={"time_offset_sigma_s": 0.5}) == ()
    assert found_in(motion, gnss={"time_offset_sigma_s": 0.05}) != ()


def test_a_clock_that_two_offsets_fit_is_not_told() -> None:
    one = np.array([90.0, 40.0, 12.0, 60.0, 80.0])
    assert is_alone(one)
    assert is_alone(np.array([*one, 12.0 + SIGMAS**2, 70.0]))
    assert not is_alone(np.array([*one, 11.0 + SIGMAS**2, 70.0]))
    assert not is_alone(np.array([30.0, *one]))  # the best may lie beyond the end


def test_a_wrong_lever_arm_is_no_clock() -> None:
    # A metre ahead of the origin, an antenna swings in curves as if its stamps were 0.5 s early.
    motion = recorded(EIGHT, 0, askew=True)
    config = config_for(replace(mounted_askew(), lever_arm=(0.0, 0.0, 0.0)))
    assert not [f for f in raw_findings({0: motion}, config) if f.input == "topics.gnss"]


def test_ratios_and_delays_are_within_their_sigmas() -> None:
    for seed in range(5):
        found = motion_physics(recorded(EIGHT, seed), config_for(Sensors()))
        assert found is not None
        assert found.speed is not None
        for ratio in (*found.gyroscope, found.speed):
            assert abs(ratio.value - 1.0) < 4.0 * ratio.sigma
            assert ratio.sigma < 0.06
        assert found.axes is not None
        assert found.axes.delay_s is not None
        delay_s, sigma_s = found.axes.delay_s
        assert abs(delay_s) < 4.0 * sigma_s < 0.2
