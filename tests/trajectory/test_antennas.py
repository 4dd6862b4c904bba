"""Heading by two antennas, against drives that are known exactly."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pymap3d
import pytest

from caliv_graph.config.model import Config
from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, GnssFixes, HeadingSamples, MotionData
from caliv_graph.trajectory.inputs import check_input
from caliv_graph.trajectory.physics import motion_physics
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.wording.physics import motion_findings
from tests.trajectory.motions import (
    ORIGIN,
    Course,
    Sensors,
    arc_drive,
    config_for,
    errors,
    record,
    rows_of,
    seconds,
    stamps,
)

ARC = Course(arc_drive())
LEFT_DEG, OFF_RAD, NOISE_RAD = 90.0, 0.02, 0.004
SECOND = (-1.0, 0.3, 0.0)


def without_orientation(seed: int) -> MotionData:
    motion = record(ARC, Sensors(), seed)
    assert motion.imu is not None
    return replace(motion, imu=replace(motion.imu, orientation_xyzw=None), twist=None)


def with_angles(seed: int, ned: bool = False) -> MotionData:
    """Headings of a baseline to the left, which is 20 mrad off."""
    at = stamps(ARC.duration_s, 10.0, 0.03)
    R = ARC.at(seconds(at)).R_map_vehicle
    direction = math.radians(LEFT_DEG) + OFF_RAD
    u = R @ np.array([math.cos(direction), math.sin(direction), 0.0])
    rng = np.random.default_rng([seed, 3])
    yaw = np.arctan2(u[:, 1], u[:, 0]) + NOISE_RAD * rng.standard_normal(len(at))
    yaw = 0.5 * math.pi - yaw if ned else yaw
    var = np.full(len(at), NOISE_RAD**2)
    return replace(without_orientation(seed), heading=HeadingSamples(at, yaw, var))


def with_second_antenna(seed: int) -> MotionData:
    at = stamps(ARC.duration_s, 10.0)
    truth = ARC.at(seconds(at))
    place = truth.p_map_vehicle + truth.R_map_vehicle @ np.add(SECOND, [0.0, 0.01, 0.0])
    noise = np.random.default_rng([seed, 4]).standard_normal((len(at), 3))
    east, north, up = (place + noise * [0.0167, 0.0167, 0.02]).T
    latitude, longitude, altitude = pymap3d.enu2geodetic(east, north, up, *ORIGIN)
    fixes = GnssFixes(at, np.asarray(latitude), np.asarray(longitude), np.asarray(altitude))
    return replace(without_orientation(seed), heading=fixes)


def settings(**heading: object) -> Config:
    return config_for(Sensors(), heading={"yaw_deg": LEFT_DEG, "sigma_deg": 2.0, **heading})


def whitened(motion: MotionData, found: SmoothedTrajectory) -> tuple[Array, Array]:
    R, t = stack(found.trajectory.T_map_vehicle)
    turn, shift = errors(ARC, motion, found.trajectory.stamps_ns, R, t)
    e = np.hstack([turn, np.einsum("nji,nj->ni", R, shift)])
    assert found.trajectory.cov is not None
    return np.einsum("ni,nij,nj->n", e, np.linalg.inv(found.trajectory.cov), e), turn


@cache
def smoothed(kind: str) -> tuple[MotionData, SmoothedTrajectory]:
    wanted = stamps(ARC.duration_s, 5.0)
    if kind == "none":
        motion = without_orientation(1)
        return motion, smooth_trajectory(motion, settings(), wanted)
    if kind == "fixes":
        motion = with_second_antenna(1)
        return motion, smooth_trajectory(motion, settings(lever_arm=list(SECOND)), wanted)
    motion = with_angles(1, ned=kind == "ned")
    return motion, smooth_trajectory(motion, settings(axes=kind), wanted)


@pytest.mark.parametrize("kind", ["enu", "ned", "fixes"])
def test_a_heading_makes_yaw_more_certain(kind: str) -> None:
    motion, found = smoothed(kind)
    nees, turn = whitened(motion, found)
    cov, alone = found.trajectory.cov, smoothed("none")[1].trajectory.cov
    assert cov is not None
    assert alone is not None
    assert np.median(cov[:, 2, 2]) < 0.8 * np.median(alone[:, 2, 2])
    assert np.sqrt((turn[:, 2] ** 2).mean()) < 4.0 * np.sqrt(np.median(cov[:, 2, 2]))
    assert nees.mean() < 14.0


def test_the_direction_of_the_baseline_is_found() -> None:
    _, found = smoothed("enu")
    sigmas = found.sigmas_of("heading.yaw_deg")
    assert sigmas is not None
    assert sigmas[0] < math.radians(1.0)
    assert abs(found.data.heading_yaw - math.radians(LEFT_DEG) - OFF_RAD) < 4.0 * sigmas[0]


def test_a_heading_alone_tells_the_yaw_of_the_map() -> None:
    motion = replace(record(ARC, Sensors(), 2), gnss=None)
    angles = with_angles(2).heading
    assert isinstance(angles, HeadingSamples)
    assert motion.imu is not None
    still = replace(motion.imu, orientation_xyzw=None)
    quarter = replace(angles, yaw_rad=angles.yaw_rad + 0.5 * math.pi - OFF_RAD)
    motion = replace(motion, imu=still, heading=quarter)
    found = smooth_trajectory(motion, settings(), stamps(ARC.duration_s, 5.0))
    yaw = float(found.trajectory.T_map_vehicle[0].rotation().yaw())
    cov = found.trajectory.cov
    assert cov is not None
    assert abs(yaw - 0.5 * math.pi) < 4.0 * math.sqrt(cov[0, 2, 2])
    assert cov[0, 2, 2] == pytest.approx(math.radians(2.0) ** 2, rel=0.2)


@pytest.mark.parametrize(
    ("heading", "ned", "said"),
    [
        ({}, False, None),
        ({"axes": "ned"}, True, None),
        ({}, True, "set heading.axes: ned"),
        ({"yaw_deg": 0.0}, False, "Set heading.yaw_deg to about 91"),
        ({"yaw_deg": 0.0}, True, "set heading.axes: ned, and heading.yaw_deg to about 91"),
    ],
)
def test_a_heading_off_the_course_is_told(
    heading: dict[str, object], ned: bool, said: str | None
) -> None:
    config = settings(**heading)
    found = motion_physics(with_angles(1, ned), config)
    assert found is not None
    sentences = [f.sentence for f in motion_findings(found, config) if "heading" in f.input]
    assert len(sentences) == (said is not None)
    assert said is None or said in sentences[0]


def test_a_second_antenna_needs_its_place() -> None:
    with pytest.raises(TrajectoryError, match=r"set heading\.lever_arm and gnss\.lever_arm"):
        smooth_trajectory(with_second_antenna(1), settings(), stamps(ARC.duration_s, 5.0))
    motion = replace(record(ARC, Sensors(), 1), heading=with_second_antenna(1).heading, gnss=None)
    with pytest.raises(TrajectoryError, match=r"topics\.gnss none of the first"):
        smooth_trajectory(motion, settings(), stamps(ARC.duration_s, 5.0))


def test_a_baseline_has_the_noise_that_the_fixes_state() -> None:
    """What rough fixes of two antennas have in common is not in their difference."""
    motion = with_second_antenna(1)
    assert motion.gnss is not None
    rough = seconds(motion.gnss.stamps_ns) > 8.0
    cov = np.where(rough, 0.15, 0.02)[:, None, None] ** 2 * np.eye(3)
    motion = replace(motion, gnss=replace(motion.gnss, cov_enu=cov))

    data, _ = check_input(motion, settings(lever_arm=list(SECOND)))

    assert data.positions is not None
    assert data.positions.shared.max() > 50.0
    assert data.baselines is not None
    state = np.sqrt(data.baselines.cov_map[-1, 0, 0])
    assert state == pytest.approx(math.hypot(0.15, 0.0167), rel=0.05)


def test_fixes_are_rough_beside_those_within_the_span_of_the_imu() -> None:
    motion = without_orientation(1)
    assert motion.gnss is not None
    assert motion.imu is not None
    cov = np.where(seconds(motion.gnss.stamps_ns) > 8.0, 0.15, 0.02)[:, None, None] ** 2
    late = rows_of(motion.imu, seconds(motion.imu.stamps_ns) > 9.0)
    motion = replace(motion, imu=late, gnss=replace(motion.gnss, cov_enu=cov * np.eye(3)))

    data, _ = check_input(motion, settings())

    assert data.positions is not None
    assert (data.positions.shared == 1.0).all()
    np.testing.assert_allclose(data.positions.cov_map[:, 0, 0], 0.15**2)
