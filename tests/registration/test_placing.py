"""Where the motion puts the middles of the clouds of a wide target."""

from __future__ import annotations

import math

import gtsam
import numpy as np

from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array
from caliv_graph.registration.centring import middles_of
from caliv_graph.registration.clouds import stack_clouds
from caliv_graph.registration.placing import placed_by_motion
from caliv_graph.registration.register import JointRegistration, register_jointly
from tests.registration.scenes import chair_scene, config_of, errors, looking_at_target, observe

HALF = np.array([0.9, 0.2, 0.6])
"""Half a wide box: its faces have their middles 0.2 and 0.9 m before its own."""

GUESS_SIGMAS = np.array([[math.radians(3.0), 0.06]])


def seen_from(T_target_lidar: gtsam.Pose3, rng: np.random.Generator) -> Array:
    """(300, 3) points of the faces of the box that a LiDAR sees, in its frame."""
    p = rng.uniform(-1.0, 1.0, (6000, 3)) * HALF
    face = rng.choice(2, len(p), p=[0.8, 0.2])
    side = np.sign(T_target_lidar.translation()[1 - face])
    p[np.arange(len(p)), 1 - face] = side * HALF[1 - face]
    place = T_target_lidar.translation()
    # Hardly anything comes back from a face at a grazing angle.
    visible = np.abs(place[1 - face]) > np.maximum(HALF[1 - face], 0.3 * np.hypot(*place[:2]))
    points = p[visible][:300]
    return np.asarray(T_target_lidar.transformTo(points.T).T)


def all_around() -> list[gtsam.Pose3]:
    azimuths = np.linspace(0.0, 360.0, 24, endpoint=False)
    return [looking_at_target(azimuth + 5.0, 8.0) for azimuth in azimuths]


def placed(T_map_lidar: list[gtsam.Pose3], clouds: list[Array]) -> Array:
    """(J, 3) of `placed_by_motion`."""
    stacked = stack_clouds(observe(clouds), 500, 0.003)
    R, t = stack(T_map_lidar)
    middles = middles_of(stacked, R, t)
    return placed_by_motion(middles, R, t, np.zeros(len(t), dtype=np.int64), GUESS_SIGMAS)


def test_middles_of_faces_stay_where_the_motion_has_them() -> None:
    """In spite of a guess that puts the target 0.4 m aside and 0.1 m too near."""
    rng = np.random.default_rng(1)
    true = all_around()
    clouds = [seen_from(T, rng) for T in true]
    wrong = gtsam.Pose3(gtsam.Rot3.Ypr(0.05, 0.01, -0.01), np.array([0.1, 0.0, 0.05]))

    found = placed([T.compose(wrong) for T in true], clouds)

    middles = np.array(
        [
            np.percentile(T.transformFrom(c.T).T, [2, 98], axis=0).mean(axis=0)
            for T, c in zip(true, clouds, strict=True)
        ]
    )
    assert np.ptp(middles, axis=0)[0] > 1.5  # the ends of the box are seen alone
    left = found - middles
    assert np.linalg.norm(left - left.mean(axis=0), axis=1).max() < 0.12


def test_middles_are_together_where_the_motion_errs_by_more() -> None:
    """Every pose is wrong by itself: half a metre at the target."""
    rng = np.random.default_rng(2)
    true = all_around()
    clouds = [seen_from(T, rng) for T in true]
    wrong = [
        T.compose(gtsam.Pose3(gtsam.Rot3.Yaw(rng.normal(0.0, 0.06)), rng.normal(0.0, 0.1, 3)))
        for T in true
    ]

    found = placed(wrong, clouds)

    np.testing.assert_array_equal(found, 0.0)


def test_a_wide_box_seen_from_all_around_keeps_its_faces_apart() -> None:
    """With their middles together, front and back were registered on each other."""
    rng = np.random.default_rng(3)
    true = all_around()
    clouds = [seen_from(T, rng) + rng.normal(0.0, 0.003, (300, 3)) for T in true]
    wrong = gtsam.Pose3(gtsam.Rot3.Ypr(0.04, 0.0, 0.0), np.array([0.05, 0.05, 0.0]))
    state = JointRegistration(observe(clouds), config_of(lidar_range_m=0.003))

    found = register_jointly(state, [T.compose(wrong) for T in true], 100)

    off = errors(found.T_target_lidar, true)
    assert np.linalg.norm(off[:, 3:], axis=1).max() < 0.05
    assert np.linalg.norm(off[:, :3], axis=1).max() < 0.05


def test_clouds_whose_poses_are_a_metre_off_begin_with_the_others() -> None:
    """Five of 24, as after a jump of the fixes: they are drawn in from the middle alone."""
    scene = chair_scene(np.linspace(0.0, 345.0, 24).tolist(), [8.0] * 24, 0.01, 1)
    jump = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 1.0, 0.0]))
    off = {3, 4, 10, 16, 17}
    begun = [jump.compose(T) if j in off else T for j, T in enumerate(scene.T_target_lidar)]
    state = JointRegistration(scene.observation, config_of(), rough=True)

    found = register_jointly(state, begun, 100)

    left = errors(found.T_target_lidar, scene.T_target_lidar)
    assert np.linalg.norm(left[:, 3:], axis=1).max() < 0.03
