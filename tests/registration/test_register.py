"""Joint registration of clouds with known poses: a chair, and a plate whose two skins are seen."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from caliv_graph.config.model import Config
from caliv_graph.errors import RegistrationError
from caliv_graph.geometry.se3 import unstack
from caliv_graph.products import Array, IntArray, Mixture, Registration, Side
from caliv_graph.registration.centring import depth_of
from caliv_graph.registration.clouds import CloudStack, stack_clouds
from caliv_graph.registration.heights import HeightNoise
from caliv_graph.registration.mixture import LEAST_EXTENT_M, expect, maximise_shape, seed_mixture
from caliv_graph.registration.moments import Responsibilities, cell_moments
from caliv_graph.registration.quadratic import ShapeQuadratic, shape_quadratic
from caliv_graph.registration.register import (
    MAX_STEP,
    NEIGHBOURS_HELD,
    TILES_SETTLE,
    JointRegistration,
    annealing_steps,
    free_step,
    left_step,
    register_jointly,
)
from caliv_graph.registration.surfels import Surfels
from caliv_graph.uncertainty.consistency import is_scattered
from tests.registration.scenes import (
    Scene,
    centre_clouds,
    chair_scene,
    config_of,
    errors,
    guesses,
    looking_at_target,
    matrices,
    observe,
    plates,
    rms,
    seen_from,
)


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """As `estimate` does: threads of linear algebra on small matrices wait for each other."""
    with threadpool_limits(limits=1):
        yield


SIGMA_M = 0.003
"""Range noise of most scenes: that of a good LiDAR."""

CONFIG = config_of(lidar_range_m=SIGMA_M)


@cache
def chair(sigma_m: float = SIGMA_M) -> Scene:
    """12 places on a quarter circle around the chair, 6, 8 and 10 m away in turn."""
    return chair_scene(np.linspace(20.0, 110.0, 12).tolist(), [6.0, 8.0, 10.0] * 4, sigma_m, 1)


def clouds_of(scene: Scene) -> list[Array]:
    return [cloud.points_lidar for cloud in scene.observation.clouds]


def registered(
    clouds: Sequence[Array], guess: Sequence[gtsam.Pose3], config: Config = CONFIG
) -> Registration:
    return register_jointly(JointRegistration(observe(clouds), config), guess, 100)


@cache
def chair_registration(seed: int = 1) -> Registration:
    scene = chair()
    return registered(clouds_of(scene), guesses(scene.T_target_lidar, seed))


# ------------------------------------------------------------------ known transforms


def test_poses_are_found_up_to_a_common_motion() -> None:
    scene = chair()
    guess = guesses(scene.T_target_lidar, 1)
    wrong = rms(errors(guess, scene.T_target_lidar))
    assert wrong[0] > 0.02
    assert wrong[1] > 0.2

    registration = chair_registration()

    e = errors(registration.T_target_lidar, scene.T_target_lidar)
    assert rms(e)[0] < 2e-3
    assert rms(e)[1] < 1.5e-3
    assert np.abs(e[:, :3]).max() < 6e-3
    assert np.abs(e[:, 3:]).max() < 4e-3
    assert registration.converged
    assert registration.iterations < 50
    assert registration.last_step[0] < 3e-4
    assert registration.last_step[1] < 2e-4
    assert registration.inlier_ratio.shape == (12,)
    assert registration.inlier_ratio.min() > 0.9


def test_frame_stays_where_the_guesses_put_it() -> None:
    # Origin at the target's middle, axes those of the guesses: 3 degrees, averaged over 12.
    scene, registration = chair(), chair_registration()
    first, true = registration.T_target_lidar, scene.T_target_lidar
    common = np.mean(
        [gtsam.Pose3.Logmap(a.compose(b.inverse())) for a, b in zip(first, true, strict=True)],
        axis=0,
    )
    assert np.linalg.norm(common[:3]) < math.radians(2.0)
    assert np.linalg.norm(common[3:]) < 0.1
    # Of a chair of 0.7 x 0.8 x 1.25 m, a face of the back and the armrests are never seen.
    low, high = np.percentile(registration.mixture.means_target, [1, 99], axis=0)
    assert np.abs(0.5 * (low + high)).max() < 0.1
    assert high - low == pytest.approx([0.75, 0.7, 1.2], abs=0.12)


def test_a_bush_shows_no_surface_and_a_chair_does() -> None:
    rng = np.random.default_rng(4)
    poses = chair().T_target_lidar
    leaves = [seen_from(T, rng.uniform(-0.7, 0.7, (70, 3)), SIGMA_M, rng) for T in poses]
    of_bush, of_chair = registered(leaves, poses).surface, chair_registration().surface
    assert of_bush is not None
    assert of_chair is not None
    assert is_scattered(of_bush)
    assert not is_scattered(of_chair)
    assert of_chair.scatter_m["front"] == pytest.approx(SIGMA_M, rel=0.3)
    assert of_chair.told_m == {"front": SIGMA_M}


def test_another_guess_finds_the_same() -> None:
    first, second = chair_registration(1), chair_registration(2)
    difference = rms(errors(first.T_target_lidar, second.T_target_lidar))
    # A third of what either is off by.
    assert difference[0] < 1e-3
    assert difference[1] < 5e-4


def test_order_of_the_clouds_does_not_matter() -> None:
    scene = chair()
    clouds, guess = clouds_of(scene), guesses(scene.T_target_lidar, 1)
    order = np.random.default_rng(5).permutation(12).tolist()

    shuffled = registered([clouds[j] for j in order], [guess[j] for j in order])

    straight = chair_registration()
    assert shuffled.iterations == straight.iterations
    for j, T in zip(order, shuffled.T_target_lidar, strict=True):
        assert T.equals(straight.T_target_lidar[j], 1e-6)
    np.testing.assert_allclose(shuffled.information, straight.information[order], rtol=1e-4)
    np.testing.assert_allclose(shuffled.inlier_ratio, straight.inlier_ratio[order], rtol=1e-6)


def test_a_turned_world_gives_a_turned_registration() -> None:
    # A quarter turn about the vertical, which keeps boxes boxes; and the map begins elsewhere.
    scene = chair()
    G = gtsam.Pose3(gtsam.Rot3.Yaw(math.pi / 2), np.array([200.0, -100.0, 30.0]))
    guess = [G.compose(T) for T in guesses(scene.T_target_lidar, 1)]

    turned = registered(clouds_of(scene), guess)

    R = gtsam.Pose3(G.rotation(), np.zeros(3))
    for T, straight in zip(turned.T_target_lidar, chair_registration().T_target_lidar, strict=True):
        assert T.equals(R.compose(straight), 1e-5)


def test_the_paper_s_noise() -> None:
    # 10 mm along the beam. The thin parts of the chair are then no surfaces any more, and clouds
    # are drawn away from their LiDAR: it is this, not the noise, that the errors consist of.
    scene = chair(0.01)
    registration = registered(
        clouds_of(scene), guesses(scene.T_target_lidar, 1), config_of(lidar_range_m=0.01)
    )
    e = errors(registration.T_target_lidar, scene.T_target_lidar)
    assert registration.converged
    assert rms(e)[0] < 6e-3
    assert rms(e)[1] < 7e-3


def test_clouds_of_very_different_size() -> None:
    # 90 points from every other place, up to 1500 from the ones between.
    scene = chair()
    rng = np.random.default_rng(6)
    clouds = [
        p if j % 2 else p[np.sort(rng.permutation(len(p))[:90])]
        for j, p in enumerate(clouds_of(scene))
    ]
    assert max(len(p) for p in clouds) > 1200

    registration = registered(clouds, guesses(scene.T_target_lidar, 1))

    e = errors(registration.T_target_lidar, scene.T_target_lidar)
    assert rms(e[1::2])[0] < 2e-3
    assert rms(e[1::2])[1] < 2e-3
    assert rms(e[::2])[0] < 6e-3
    assert rms(e[::2])[1] < 5e-3
    # And they do not claim what they have not got.
    claimed = np.trace(registration.information[:, 3:, 3:], axis1=1, axis2=2)
    assert claimed[::2].max() < 0.5 * claimed[1::2].min()


def test_a_fifth_of_outliers() -> None:
    scene = chair()
    rng = np.random.default_rng(7)
    clouds = []
    for T, points in zip(scene.T_target_lidar, clouds_of(scene), strict=True):
        stray = rng.uniform([-0.6, -0.6, -0.7], [0.6, 0.6, 0.8], (len(points) // 4, 3))
        clouds.append(np.vstack([points, T.transformTo(stray.T).T]))

    registration = registered(clouds, guesses(scene.T_target_lidar, 1))

    e = errors(registration.T_target_lidar, scene.T_target_lidar)
    assert rms(e)[0] < 3e-3
    assert rms(e)[1] < 2e-3
    # Not all strays are far from a chair: but many are seen to be none of it.
    assert 0.8 < registration.inlier_ratio.mean() < 0.95


def test_half_of_the_target_is_hidden_from_some() -> None:
    # Every third cloud lacks what is on the LiDAR's left of the chair's middle.
    scene = chair()
    clouds = clouds_of(scene)
    for j in range(0, 12, 3):
        y = clouds[j][:, 1]
        clouds[j] = clouds[j][y < 0.5 * (y.min() + y.max())]

    registration = registered(clouds, guesses(scene.T_target_lidar, 1, shift_m=0.1))

    e = errors(registration.T_target_lidar, scene.T_target_lidar)
    assert rms(e)[0] < 4e-3
    assert rms(e)[1] < 3e-3


def test_the_lower_third_of_the_target_is_hidden_from_some() -> None:
    scene = chair()
    clouds = clouds_of(scene)
    for j in range(0, 12, 3):
        z = scene.T_target_lidar[j].transformFrom(clouds[j].T)[2]
        clouds[j] = clouds[j][z > -0.2]

    registration = registered(clouds, guesses(scene.T_target_lidar, 1, shift_m=0.1))

    e = errors(registration.T_target_lidar, scene.T_target_lidar)
    assert rms(e)[0] < 4e-3
    assert rms(e)[1] < 3e-3


# ------------------------------------------------------------------ two skins


def front_against_back(e: Array) -> Array:
    return np.asarray(np.abs(e[::2].mean(axis=0) - e[1::2].mean(axis=0)))


@pytest.mark.parametrize(("sigma_m", "tolerance"), [(0.003, 1.5e-3), (0.01, 4e-3)])
def test_the_skins_of_a_plate_are_kept_apart(sigma_m: float, tolerance: float) -> None:
    scene = plates(300, sigma_m, 1)
    config = config_of(components=200, lidar_range_m=sigma_m)
    guess = guesses(scene.T_target_lidar, 1, 1.0, 0.3)
    e = errors(registered(clouds_of(scene), guess, config).T_target_lidar, scene.T_target_lidar)
    apart = front_against_back(e)
    # Of a plate of 25 mm.
    assert apart[:3].max() < tolerance
    assert apart[3:].max() < tolerance


def test_without_normals_the_skins_are_pulled_together() -> None:
    # What the test above is worth: the same, with every normal and every beam as of the front.
    scene = plates(300, 0.003, 1)
    state = JointRegistration(scene.observation, config_of(components=200, lidar_range_m=0.003))
    R, _ = matrices(scene.T_target_lidar)
    ahead = np.swapaxes(R, 1, 2)[state.clouds.cloud][:, :, 0]
    state.clouds = replace(state.clouds, normals=ahead, beams=-ahead, flatness=np.ones(len(ahead)))
    guess = guesses(scene.T_target_lidar, 1, 1.0, 0.3)
    registration = register_jointly(state, guess, 100)
    e = errors(registration.T_target_lidar, scene.T_target_lidar)
    assert front_against_back(e)[3] > 0.01


def test_the_skins_of_a_plate_are_kept_apart_at_close_range() -> None:
    # 2500 points on a square metre, as the paper's LiDAR has at 6 m, and its noise.
    scene = plates(1500, 0.01, 1)
    config = config_of(components=300, lidar_range_m=0.01, max_points=3000)
    guess = guesses(scene.T_target_lidar, 1, 1.0, 0.3)
    e = errors(registered(clouds_of(scene), guess, config).T_target_lidar, scene.T_target_lidar)
    assert front_against_back(e)[3:].max() < 5e-3


# ------------------------------------------------------------------ information


def quadratic_at(
    clouds: CloudStack,
    R: Array,
    t: Array,
    mixture: Mixture,
    noise: HeightNoise,
    weights: Array,
) -> tuple[ShapeQuadratic, tuple[Array, Array, Array]]:
    """E-step with a known shape: the quadratic on the poses, and the sums for the M-step.

    A tenth of outliers along the 1.5 m of a beam that a chair takes.
    """
    who = expect(clouds, R, t, mixture, noise, 0.07, weights)
    cells = cell_moments(clouds, who, len(mixture.weights))
    quadratic = shape_quadratic(clouds, R, t, mixture, cells, who)
    return quadratic, (cells, who.counts, quadratic.turns)


@cache
def against_a_known_shape(sigma_m: float) -> tuple[Array, Array]:
    """Errors (S, J, 6) of clouds registered to a chair that is known, and their information.

    The shape is that of 24 clouds at their true poses; the clouds are others, S draws of their
    noise, J places. Each is on its own: only its block is used.
    """
    config = config_of(lidar_range_m=sigma_m)
    dense = chair_scene(np.linspace(-60, 60, 24).tolist(), [5.0, 7.0, 9.0] * 8, sigma_m, 1)
    teacher = JointRegistration(dense.observation, config)
    R, t = matrices(dense.T_target_lidar)
    teacher.seed(R, t, 0.02)
    # Annealing takes 16 rounds; then the noise is estimated.
    for _ in range(20):
        teacher.expect(R, t)
        teacher.maximise(R, t)
    assert teacher.finest
    e, information = [], []
    for seed in range(8):
        scene = chair_scene(np.linspace(-45, 45, 6).tolist(), [8.0, 10.0] * 3, sigma_m, 50 + seed)
        clouds = stack_clouds(scene.observation, config.registration.max_points, sigma_m)
        R, t = matrices(scene.T_target_lidar)
        for _ in range(10):
            quadratic, _ = quadratic_at(clouds, R, t, teacher.mixture, teacher.noise, np.ones(6))
            g = quadratic.gradient_given_shape
            d = -np.linalg.solve(quadratic.blocks, g[..., None])[..., 0]
            R, t = left_step(R, t, np.asarray(d, dtype=np.float64))
        e.append(
            [
                gtsam.Pose3.Logmap(est.compose(true.inverse()))
                for est, true in zip(unstack(R, t), scene.T_target_lidar, strict=True)
            ]
        )
        information.append(
            quadratic_at(clouds, R, t, teacher.mixture, teacher.noise, np.ones(6))[0].blocks
        )
    return np.array(e), np.array(information)


def chi2_per_dof(e: Array, information: Array) -> float:
    return float(np.einsum("sja,sjab,sjb->sj", e, information, e).mean() / 6.0)


@pytest.mark.parametrize("sigma_m", [0.003, 0.01])
def test_information_is_that_of_the_noise(sigma_m: float) -> None:
    # From draw to draw: the errors about their mean over the 8 draws. 0.9 at both.
    e, information = against_a_known_shape(sigma_m)
    spread = (e - e.mean(axis=0)) * math.sqrt(8.0 / 7.0)
    assert 0.5 < chi2_per_dof(spread, information) < 2.0


def test_information_is_that_of_the_error() -> None:
    e, information = against_a_known_shape(0.003)
    assert chi2_per_dof(e, information) < 2.0


def test_information_is_that_of_the_error_at_the_noise_of_the_paper() -> None:
    e, information = against_a_known_shape(0.01)
    assert chi2_per_dof(e, information) < 2.0


def test_information_falls_with_the_noise_and_the_points() -> None:
    quiet = against_a_known_shape(0.003)[1][0]
    loud = against_a_known_shape(0.01)[1][0]
    for information in (quiet, loud):
        np.testing.assert_allclose(
            information, np.swapaxes(information, 1, 2), rtol=1e-9, atol=1e-3
        )
        assert np.linalg.eigvalsh(information).min() > 0.0
        # Odd places are farther away.
        trace = np.trace(information[:, 3:, 3:], axis1=1, axis2=2)
        assert trace[1::2].max() < trace[::2].min()
    ratio = np.trace(quiet[:, 3:, 3:], axis1=1, axis2=2) / np.trace(
        loud[:, 3:, 3:], axis1=1, axis2=2
    )
    # (10 mm / 3 mm)^2 = 11 if the noise were all.
    assert 2.0 < ratio.mean() < 12.0


def test_joint_information_is_less_than_each_cloud_s_own() -> None:
    registration = chair_registration()
    H = registration.information_joint
    assert H.shape == (72, 72)
    for j in range(12):
        own = H[6 * j : 6 * j + 6, 6 * j : 6 * j + 6]
        less = np.linalg.eigvalsh(registration.information[j] - own)
        assert less.min() > -1e-6 * less.max()
    shift = np.tile(np.eye(6)[:, 3:], (12, 1))
    claimed = np.trace(registration.information[:, 3:, 3:].sum(axis=0))
    assert np.trace(shift.T @ H @ shift) < 1e-3 * claimed


def test_a_surfel_with_hardly_a_point_leaves_the_frame_free() -> None:
    """Clouds that all turn together have no gradient: 0.003 of it took the frame 0.15 m away."""
    scene = chair()
    state = JointRegistration(scene.observation, CONFIG)
    R, t = matrices(scene.T_target_lidar)
    state.seed(R, t, 0.02)
    for _ in range(3):
        state.expect(R, t)
        state.maximise(R, t)
    surfels = state.mixture
    tilted = surfels.normals_target + np.array([0.2, 0.1, 0.0])
    tilted /= np.linalg.norm(tilted, axis=1)[:, None]
    away = 0.15 * surfels.normals_target
    away[::2] = 0.0
    mixture = replace(surfels, means_target=surfels.means_target + away, normals_target=tilted)

    quadratic, _ = quadratic_at(state.clouds, R, t, mixture, state.noise, np.ones(12))

    assert np.abs(quadratic.gradient.sum(axis=0)).max() < 1e-6
    together = np.tile(np.eye(6), (12, 1))
    assert np.abs(quadratic.joint() @ together).max() < 1e-6


# ------------------------------------------------------------------ the steps


def test_centring_puts_the_middle_of_every_extent_at_the_origin() -> None:
    # Twice as many points on one side of a box do not move its middle.
    rng = np.random.default_rng(8)
    box = rng.uniform([4.0, -1.0, 0.0], [5.0, 1.0, 1.0], (400, 3))
    lopsided = np.vstack([box, rng.uniform([4.0, -1.0, 0.0], [4.5, 1.0, 1.0], (800, 3))])
    state = JointRegistration(observe([box, lopsided]), CONFIG)
    state.clouds = replace(
        state.clouds,
        points=np.vstack([box, lopsided]),
        cloud=np.repeat([0, 1], [400, 1200]),
        starts=np.array([0, 400]),
    )
    R, t = matrices([gtsam.Pose3(), looking_at_target(90.0, 7.0)])
    centred = centre_clouds(state.clouds, R, t)
    assert centred[0] == pytest.approx([-4.5, 0.0, -0.5], abs=0.03)
    # In the axes of its view, which is a fraction of a degree beside an axis of the map.
    points = lopsided @ R[1].T + centred[1]
    low, high = np.percentile(points, [2, 98], axis=0)
    assert 0.5 * (low + high) == pytest.approx(np.zeros(3), abs=2e-3)


def test_centring_does_not_depend_on_the_axes_of_the_map() -> None:
    rng = np.random.default_rng(8)
    clouds = [rng.uniform([4.0, -1.0, 0.0], [5.0, 1.0, 1.0], (200, 3)) for _ in range(3)]
    state = JointRegistration(observe(clouds), CONFIG)
    cut = [frozenset[Side](), frozenset[Side]({"left"}), frozenset[Side]({"top"})]
    R, t = matrices([looking_at_target(azimuth, 7.0) for azimuth in (10.0, 80.0, 200.0)])
    turn = gtsam.Rot3.Yaw(0.7).matrix()
    moved = centre_clouds(state.clouds, turn @ R, t @ turn.T + np.array([30.0, -70.0, 2.0]), cut)
    there = centre_clouds(state.clouds, R, t, cut)
    np.testing.assert_allclose(moved, there @ turn.T, atol=1e-9)
    depths = [
        depth_of(state.clouds.moved(T, x)) for T, x in ((R, there), (turn @ R, there @ turn.T))
    ]
    assert depths[0] == pytest.approx(depths[1])


@pytest.mark.parametrize(
    ("roll_deg", "side"), [(0.0, "top"), (90.0, "left"), (180.0, "bottom"), (270.0, "right")]
)
def test_a_cut_side_is_that_of_the_lidar_however_it_is_mounted(roll_deg: float, side: Side) -> None:
    """What is above the target is at the left of a LiDAR that lies on its side."""
    rng = np.random.default_rng(8)
    whole = rng.uniform([4.0, -1.0, -0.5], [5.0, 1.0, 0.5], (400, 3))
    part = whole[whole[:, 2] < 0.0]  # without its upper half
    rolled = gtsam.Rot3.Roll(np.radians(roll_deg)).matrix()
    state = JointRegistration(observe([whole, part @ rolled]), CONFIG)
    state.clouds = replace(
        state.clouds,
        points=np.vstack([whole, part @ rolled]),
        cloud=np.repeat([0, 1], [len(whole), len(part)]),
        starts=np.array([0, len(whole)]),
        beams=np.tile([1.0, 0.0, 0.0], (len(whole) + len(part), 1)),
    )
    R, t = np.array([np.eye(3), rolled]), np.zeros((2, 3))
    centred = centre_clouds(state.clouds, R, t, [frozenset[Side](), frozenset[Side]({side})])
    # The lower halves of both are at the same place.
    assert centred[1] == pytest.approx(centred[0], abs=0.05)
    cut_below = centre_clouds(state.clouds, R, t)
    assert cut_below[1, 2] - centred[1, 2] == pytest.approx(0.24, abs=0.02)  # of the middle 96 %


def test_a_left_step_is_a_motion_of_the_target_frame() -> None:
    rng = np.random.default_rng(9)
    poses = [looking_at_target(a, 8.0) for a in (10.0, 100.0)]
    d = 0.3 * rng.normal(size=(2, 6))
    R, t = left_step(*matrices(poses), d)
    for j, T in enumerate(poses):
        expected = gtsam.Pose3.Expmap(d[j]).compose(T)
        np.testing.assert_allclose(R[j], expected.rotation().matrix(), atol=1e-12)
        np.testing.assert_allclose(t[j], expected.translation(), atol=1e-12)


def quadratic_of(minima: Array, information: Array) -> ShapeQuadratic:
    """Clouds that are each drawn to a minimum, and nothing that couples them."""
    gradient = -np.einsum("jab,jb->ja", information, minima)
    return ShapeQuadratic(
        blocks=information,
        gradient=gradient,
        gradient_given_shape=gradient,
        across=np.zeros((1, 6 * len(minima))),
        moments=np.zeros((len(minima), 1, 11)),
        coupling=np.zeros((1, 11, 3, 6)),
        prior_turns=np.zeros((len(minima), len(minima))),
        orientation_information=np.eye(3)[None],
        turns=np.zeros((1, 3)),
        normal_information=np.ones(1),
    )


def test_a_free_step_goes_to_the_minimum_less_the_common_motion() -> None:
    rng = np.random.default_rng(10)
    minima = 0.01 * rng.normal(size=(4, 6))
    root = rng.normal(size=(4, 6, 12))
    step = free_step(quadratic_of(minima, root @ np.swapaxes(root, 1, 2)))
    # Levenberg-Marquardt takes a thousandth of it, and UNSEEN a hundredth of that.
    assert step == pytest.approx((minima - minima.mean(axis=0)) / 1.001, abs=1e-6)


def test_a_free_step_is_never_long() -> None:
    minima = np.zeros((3, 6))
    minima[0, 4] = 30.0
    step = free_step(quadratic_of(minima, np.tile(np.eye(6), (3, 1, 1))))
    assert np.abs(step).max() == pytest.approx(MAX_STEP)
    assert step[0, 4] > 0.0
    assert step[1, 4] == pytest.approx(-0.5 * step[0, 4])
    assert not free_step(quadratic_of(np.zeros((3, 6)), np.tile(np.eye(6), (3, 1, 1)))).any()


def test_surfels_become_finer_step_by_step() -> None:
    # From 50 mm by 0.75 a step, down to 0.3 of the range noise of 10 mm: 50, 37.5, 28.1, 21.1, ...
    scene = chair(0.01)
    state = JointRegistration(scene.observation, config_of(lidar_range_m=0.01))
    R, t = matrices(scene.T_target_lidar)
    state.seed(R, t, 0.05)
    narrowest = []
    while not state.finest:
        state.expect(R, t)
        state.maximise(R, t)
        narrowest.append(math.sqrt(float(state.mixture.var_tangent.min())))
    # 0.05 x 0.75^10 = 2.8 mm is the first below 3 mm.
    assert len(narrowest) == 10
    assert narrowest[:3] == pytest.approx([0.0375, 0.028125, 0.02109375])
    # A few rounds later the narrowest are half of the thinnest part; none is narrower.
    for _ in range(5):
        state.expect(R, t)
        state.maximise(R, t)
    assert LEAST_EXTENT_M <= math.sqrt(float(state.mixture.var_tangent.min())) < 0.010


def test_the_noise_of_the_heights_is_estimated_at_the_end_of_annealing() -> None:
    # Configured are 5 mm, in the clouds there are 3: a prior of 50 among thousands of points.
    state = JointRegistration(observe(clouds_of(chair())), config_of(lidar_range_m=0.005))
    R, t = matrices(chair().T_target_lidar)
    state.seed(R, t, 0.05)
    configured = state.noise
    while not state.finest:
        assert state.noise is configured
        state.expect(R, t)
        state.maximise(R, t)
    for _ in range(6):
        state.expect(R, t)
        state.maximise(R, t)
    assert math.sqrt(state.noise.range_m2[0]) == pytest.approx(SIGMA_M, rel=0.25)


def test_tiles_and_noise_stay_once_beams_have_told_them_for_a_while() -> None:
    state = JointRegistration(observe(clouds_of(chair())), config_of(lidar_range_m=0.005))
    R, t = matrices(chair().T_target_lidar)
    state.by_beams, state.held_along = True, 0.0

    def iterated() -> tuple[Mixture, Mixture]:
        before = state.mixture
        state.expect(R, t)
        state.maximise(R, t)
        return before, state.mixture

    def slid_m(before: Mixture, after: Mixture) -> float:
        moved = np.cross(after.means_target - before.means_target, after.normals_target)
        return float(np.linalg.norm(moved, axis=1).max())

    for _ in range(2):  # a new mixture begins as free as the first
        state.seed(R, t, 0.02)
        while not state.finest:
            iterated()
        for _ in range(TILES_SETTLE - 1):  # the last of annealing was by beams, too
            assert slid_m(*iterated()) > 1e-4
        noise, widths = state.noise, state.mixture.var_tangent
        heights = []
        for _ in range(2):
            before, after = iterated()
            assert slid_m(before, after) < 1e-12
            heights.append(np.abs(after.means_target - before.means_target).max())
        assert state.noise is noise
        assert state.mixture.var_tangent is widths
        assert min(heights) > 1e-6


def test_surfels_near_the_beams_are_searched_for_at_times(monkeypatch: pytest.MonkeyPatch) -> None:
    state = JointRegistration(observe(clouds_of(chair())), config_of(lidar_range_m=0.005))
    R, t = matrices(chair().T_target_lidar)
    state.by_beams, state.held_along = True, 0.0
    state.seed(R, t, 0.02)
    while not state.finest:
        state.expect(R, t)
        state.maximise(R, t)
    begun, searched = list[int](), set[int]()
    search = Surfels.nearest_to_beams

    def watched(surfels: Surfels, points: Array, beams: Array, cloud: IntArray) -> IntArray:
        searched.add(begun[-1])
        return search(surfels, points, beams, cloud)

    monkeypatch.setattr(Surfels, "nearest_to_beams", watched)
    for number in range(2 * (NEIGHBOURS_HELD + 1)):
        begun.append(number)
        who = state.responsibilities(R, t)
        state.quadratic(R, t, who)
        state.maximise(R, t)
    # The last E-step that annealing took was by beams, too.
    assert searched == {NEIGHBOURS_HELD, 2 * NEIGHBOURS_HELD + 1}

    def looking_at(near: IntArray | None) -> Responsibilities:
        weights = np.ones(state.clouds.count)
        noise, shape = state.noise, state.mixture
        return expect(state.clouds, R, t, shape, noise, 0.07, weights, by_beams=True, near=near)

    held, anew = looking_at(who.component), looking_at(None)
    assert np.abs(held.slides_m - anew.slides_m).mean() < 1e-5
    assert held.inlier_ratio == pytest.approx(anew.inlier_ratio, abs=1e-3)
    # Some of the clouds, in another order, look at what was found for theirs.
    which = np.array([3, 1])
    alone = state.only(which).responsibilities(R[which], t[which])
    assert (alone.component == who.component[state.clouds.points_of(which)]).all()


# ------------------------------------------------------------------ errors and weights


def test_one_cloud_is_too_few() -> None:
    with pytest.raises(RegistrationError, match=r"target: 1 cloud\(s\) to register, needs 2"):
        JointRegistration(observe(clouds_of(chair())[:1]), CONFIG)


def test_steps_in_the_wrong_order_are_said_to_be() -> None:
    state = JointRegistration(observe(clouds_of(chair())[:2]), CONFIG)
    R, t = matrices(chair().T_target_lidar[:2])
    with pytest.raises(RegistrationError, match="not seeded yet"):
        state.expect(R, t)
    state.seed(R, t, 0.05)
    with pytest.raises(RegistrationError, match="E-step missing"):
        state.maximise(R, t)
    assert state.inlier_ratio.tolist() == [1.0, 1.0]
    assert not state.finest


def test_a_cloud_that_is_dropped_does_not_shape_the_target() -> None:
    # Cloud 3 is something else altogether, somewhere else; its weight is next to nothing.
    scene = chair()
    clouds = clouds_of(scene)
    rng = np.random.default_rng(11)
    other = scene.T_target_lidar[3].transformTo(rng.uniform(-0.4, 0.4, (900, 3)).T).T
    R, t = matrices(scene.T_target_lidar)
    shapes = []
    weights = np.where(np.arange(12) == 3, 1e-6, 1.0)
    most = CONFIG.registration.max_points
    start = seed_mixture(stack_clouds(observe(clouds), most, SIGMA_M), R, t, 300, 0.02)
    for points in (clouds[3], other):
        stacked = stack_clouds(observe([*clouds[:3], points, *clouds[4:]]), most, SIGMA_M)
        mixture = start
        for floor_m in (0.017, 0.01445, 0.0123):
            noise = HeightNoise.configured(1, SIGMA_M, floor_m)
            quadratic, sums = quadratic_at(stacked, R, t, mixture, noise, weights)
            mixture = maximise_shape(stacked, R, t, mixture, floor_m, *sums)
        shapes.append((quadratic, mixture))
    (first, first_mixture), (second, second_mixture) = shapes
    keep = np.arange(12) != 3
    np.testing.assert_allclose(second.blocks[keep], first.blocks[keep], rtol=1e-2, atol=1.0)
    strong = first_mixture.weights > 1e-4
    difference = np.abs(second_mixture.means_target - first_mixture.means_target)[strong]
    assert difference.max() < 1e-4
    assert np.trace(first.blocks[3]) < 1e-4 * np.trace(first.blocks[4])


@pytest.mark.usefixtures("all_cores")
def test_cores_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    # 13 clouds: not a multiple of what is summed up together.
    scene = chair_scene(np.linspace(20.0, 110.0, 13).tolist(), [8.0] * 13, SIGMA_M, 1)
    start = guesses(scene.T_target_lidar, 1)
    results = []
    for usable in ({0}, {0, 1}):
        monkeypatch.setattr("os.sched_getaffinity", lambda _, usable=usable: usable)
        state = JointRegistration(scene.observation, CONFIG, rough=True)
        first = register_jointly(state, start, 6)
        state.refine_normals(*matrices(first.T_target_lidar))
        again = register_jointly(state, first.T_target_lidar, 3, coarse=False)
        results.append(
            [
                state.clouds.normals,
                *matrices(again.T_target_lidar),
                again.information_joint,
                again.mixture.means_target,
                again.mixture.normals_target,
            ]
        )
    for alone, shared in zip(*results, strict=True):
        assert np.array_equal(alone, shared)


def test_annealing_ends_after_the_steps_that_it_is_given() -> None:
    # 0.75^9 x 20 mm = 1.50 mm > 0.3 x 4 mm; 0.75^10 x 20 mm = 1.13 mm.
    assert annealing_steps(0.02, 0.004) == 10
    assert annealing_steps(0.02, 0.1) == 0
    state = JointRegistration(observe(clouds_of(chair())), config_of(lidar_range_m=0.004))
    R, t = matrices(chair().T_target_lidar)
    state.seed(R, t, 0.02)
    for _ in range(10):
        assert not state.finest
        state.expect(R, t)
        state.maximise(R, t)
    assert state.finest


def test_clouds_whose_steps_stay_below_their_own_sigmas_are_registered() -> None:
    """However small a step in metres is asked for: noise sets what it can be."""
    scene = chair()
    state = JointRegistration(observe(clouds_of(scene)), CONFIG)
    state.tolerance = (0.0, 0.0)
    found = register_jointly(state, guesses(scene.T_target_lidar, 1), 100)
    assert found.converged
    assert found.iterations < 60


def test_sparse_clouds_whose_steps_no_longer_fall_are_registered() -> None:
    """Of 20 points the steps stay at half a sigma, since the nearest surfels change."""
    rng = np.random.default_rng(1)
    sparse = [cloud[rng.permutation(len(cloud))[:20]] for cloud in clouds_of(chair())]
    start = guesses(chair().T_target_lidar, 1)

    found = register_jointly(JointRegistration(observe(sparse), CONFIG), start, 100)

    assert found.converged
    assert found.iterations < 60
    # A registration that still closes in is not at its end, however long it takes.
    far = register_jointly(JointRegistration(observe(sparse), CONFIG), start, 8)
    assert not far.converged


def test_turns_about_normals_are_eliminated_apart_with_the_same_result() -> None:
    scene = chair()
    state = JointRegistration(observe(clouds_of(scene)), CONFIG)
    state.held_along = 0.0
    R, t = matrices(scene.T_target_lidar)
    state.seed(R, t, SIGMA_M)
    quadratic = state.expect(R, t)
    whole = replace(quadratic, normals=None).joint()
    np.testing.assert_allclose(quadratic.joint(), whole, atol=1e-12 * np.abs(whole).max())
