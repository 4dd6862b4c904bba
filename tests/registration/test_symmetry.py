"""Shapes of known symmetry, ray-cast with noise from known places, and what is found of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest

from caliv_graph.geometry.se3 import stack, unstack
from caliv_graph.products import Array, Registration
from caliv_graph.registration.register import FINE_SIGMA_M, JointRegistration
from caliv_graph.registration.self_comparison import Shape, View, ViewIndex, views_of
from caliv_graph.registration.symmetry import (
    ORDERS,
    Symmetry,
    alarming,
    alarming_orders,
    marginalise_symmetry,
    refit,
    symmetries,
)
from caliv_graph.scenario.model import CropModel
from caliv_graph.scenario.sensor_models import LidarModel
from caliv_graph.scenario.world import make_world
from caliv_graph.scenario.world_models import (
    BoxModel,
    ChairModel,
    CylinderModel,
    ObjectModel,
    TableModel,
    WorldModel,
)
from caliv_graph.simulation.lidar import SimulatedLidar
from caliv_graph.simulation.rays import RayCaster
from tests.registration.scenes import STRAIGHT, config_of, looking_at_target, observe

NAMED: dict[str, ObjectModel] = {
    "chair": ChairModel(xy_m=(0.0, 0.0), yaw_deg=30.0),
    "cylinder": CylinderModel(xy_m=(0.0, 0.0), radius_m=0.35, height_m=1.2),
    "cube": BoxModel(xy_m=(0.0, 0.0), yaw_deg=20.0, size_m=(0.7, 0.7, 1.0)),
    "box": BoxModel(xy_m=(0.0, 0.0), yaw_deg=20.0, size_m=(0.9, 0.6, 1.0)),
    # 60 mm: a fifth of what separates its faces from those of a cube is 3 sigma of one beam.
    "nearly a cube": BoxModel(xy_m=(0.0, 0.0), yaw_deg=20.0, size_m=(0.73, 0.67, 1.0)),
    "table": TableModel(xy_m=(0.0, 0.0), yaw_deg=-40.0),
}

ALL_AROUND = tuple(np.linspace(0.0, 324.0, 10).tolist())
A_QUARTER = tuple(np.linspace(0.0, 90.0, 10).tolist())
OPPOSITE = (*np.linspace(5.0, 35.0, 5).tolist(), *np.linspace(185.0, 215.0, 5).tolist())

SIGMA_M = 0.01


@cache
def seen(name: str, azimuths_deg: Sequence[float], seed: int = 0) -> Registration:
    """The shape as it is reconstructed from poses that are off by a milliradian and 2 mm."""
    world = make_world(WorldModel(objects={"it": NAMED[name]}, targets=("it",)))
    rng = np.random.default_rng(seed)
    model = LidarModel(mounting=STRAIGHT, range_sigma_m=SIGMA_M)
    crop = CropModel(margin_m=0.0, elsewhere_stride=0)
    lidar = SimulatedLidar(model, world, RayCaster(world), crop, rng)
    T_map_target = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 0.6]))
    clouds, poses = [], []
    for azimuth in azimuths_deg:
        T = looking_at_target(azimuth, 8.0)
        returns = lidar.scan(T_map_target.compose(T))
        clouds.append(returns.points_lidar[returns.objects == world.names.index("it")])
        error = rng.normal(size=6) * np.repeat([1e-3, 2e-3], 3)
        poses.append(gtsam.Pose3.Expmap(error).compose(T))
    state = JointRegistration(observe(clouds), config_of(components=600, max_points=400))
    R, t = stack(poses)
    state.refine_normals(R, t)
    state.seed(R, t, FINE_SIGMA_M)
    while not state.finest:
        quadratic = state.expect(R, t)
        state.maximise(R, t)
    return state.result(R, t, quadratic.blocks, quadratic.joint(), 1, True, (0.0, 0.0))


def found(registration: Registration) -> tuple[Symmetry, ...]:
    return symmetries(registration.mixture, views_of(registration), SIGMA_M, ORDERS)


@cache
def upright(name: str, azimuths_deg: Sequence[float]) -> Symmetry | None:
    return next((s for s in found(seen(name, azimuths_deg)) if s.upright), None)


@pytest.mark.parametrize("azimuths", [ALL_AROUND, A_QUARTER, OPPOSITE])
def test_a_chair_is_the_same_after_no_turn(azimuths: tuple[float, ...]) -> None:
    assert found(seen("chair", azimuths)) == ()


@pytest.mark.parametrize(
    ("name", "expected"),
    [("cylinder", 0.0), ("cube", 90.0), ("box", 180.0), ("nearly a cube", 180.0), ("table", 180.0)],
)
def test_the_smallest_turn_of_a_shape_seen_from_all_sides(name: str, expected: float) -> None:
    symmetry = upright(name, ALL_AROUND)
    assert symmetry is not None
    assert math.degrees(symmetry.angle_rad) == pytest.approx(expected)
    # The table's top is seen at 9 degrees, too flat to be compared: of the rest, nearly all.
    registration = seen(name, ALL_AROUND)
    shape = Shape(registration.mixture, views_of(registration), SIGMA_M)
    comparable = shape.compare(np.eye(3), np.zeros(3)).compared
    assert comparable > (0.7 if name == "table" else 0.95)
    assert symmetry.compared > 0.9 * comparable
    # The axis goes through the middle of the shape, which stands at the target's origin.
    assert np.abs(symmetry.centre_target[:2]).max() < 5e-3


def test_a_cube_of_which_two_lidars_see_opposite_corners_is_the_same_after_half_a_turn() -> None:
    # Each sees two faces, and none of the other's.
    symmetry = upright("cube", OPPOSITE)
    assert symmetry is not None
    assert symmetry.angle_rad in (math.pi / 2.0, math.pi)


def test_a_drum_seen_from_one_side_is_known_by_what_was_seen() -> None:
    symmetry = upright("cylinder", A_QUARTER)
    assert symmetry is not None
    assert symmetry.continuous
    # What is at the edges of the view turns to where nobody looked.
    assert len(symmetry.unseen) > 0
    assert symmetry.compared < 1.0
    again = refit(symmetry, seen("cylinder", A_QUARTER).mixture)
    # The middle of the drum, a third of a metre behind what is seen of it.
    assert np.abs(again.centre_target[:2]).max() < 5e-3
    assert again.axis_target[2] > math.cos(10e-3)


def test_one_side_of_a_box_shows_no_symmetry_about_the_vertical() -> None:
    # Turned, the face that was seen is where nobody looked, whichever way.
    assert upright("box", tuple(np.linspace(18.0, 22.0, 10).tolist())) is None


def test_another_frame_changes_nothing() -> None:
    registration = seen("table", ALL_AROUND)
    T = gtsam.Pose3(gtsam.Rot3.Yaw(0.7), np.array([0.4, -0.3, 0.2]))
    R = T.rotation().matrix()
    mixture = registration.mixture
    moved = replace(
        registration,
        T_target_lidar=tuple(T.compose(pose) for pose in registration.T_target_lidar),
        mixture=replace(
            mixture,
            means_target=mixture.means_target @ R.T + T.translation(),
            normals_target=mixture.normals_target @ R.T,
        ),
    )
    before = upright("table", ALL_AROUND)
    after = next((s for s in found(moved) if s.upright), None)
    assert before is not None
    assert after is not None
    assert before.angle_rad == after.angle_rad
    expected = T.transformFrom(before.centre_target)
    np.testing.assert_allclose(after.centre_target[:2], expected[:2], atol=2e-3)


@pytest.mark.parametrize("whole", [True, False])
def test_one_view_against_expected_surfaces(whole: bool) -> None:
    # A square of 1 m, 5 m ahead, in steps of 25 mm, seen head on.
    y, z = np.meshgrid(np.arange(-0.5, 0.501, 0.025), np.arange(-0.5, 0.501, 0.025))
    square = np.column_stack([np.full(y.size, 5.0), y.ravel(), z.ravel()])
    view = ViewIndex.of(View(np.zeros(3), square, whole))
    asked = np.array(
        [
            [5.0, 0.1, 0.1],  # on it
            [5.02, 0.1, 0.1],  # 20 mm behind it: it is 20 mm in front
            [4.7, 0.1, 0.1],  # in front of it: the beam went on
            [5.3, 0.1, 0.1],  # behind it: hidden
            [5.0, 0.7, 0.1],  # beside it: nothing came back from there
            [5.0, 2.0, 0.1],  # far beside it: perhaps nobody looked
            [5.0, 0.1, 0.8],  # above it: the field of view may end there
        ]
    )
    towards = np.tile([-1.0, 0.0, 0.0], (len(asked), 1))
    off, counts, pierced = view.look(asked, towards)
    nan = math.nan
    np.testing.assert_allclose(off, [0.0, 0.02, nan, nan, nan, nan, nan], atol=1e-9)
    assert counts.tolist() == [4, 4, 0, 0, 0, 0, 0]
    assert pierced.tolist() == [False, False, True, False, whole, False, False]
    # A surface that looks away could not have been seen.
    off, _, pierced = view.look(asked, -towards)
    assert np.isnan(off).all()
    assert not pierced.any()


def test_a_shape_without_views_has_no_symmetry() -> None:
    assert symmetries(seen("cube", ALL_AROUND).mixture, (), SIGMA_M, ORDERS) == ()


# ------------------------------------------------------------------ what it means


def quadratic_of(name: str) -> tuple[Array, Array]:
    H = seen(name, A_QUARTER).information_joint
    # Gradients towards other poses, in the range of H: a common motion has none.
    return H, H @ np.random.default_rng(1).normal(size=len(H))


def test_rotations_about_the_axis_are_marginalised_and_nothing_else() -> None:
    symmetry = upright("cylinder", A_QUARTER)
    assert symmetry is not None
    H, g = quadratic_of("cylinder")
    marginalised, gradient = marginalise_symmetry(H, g, symmetry)
    count = len(H) // 6
    turns = np.kron(np.eye(count), symmetry.generator()[:, None])
    scale = np.abs(H).max()
    assert np.abs(marginalised @ turns).max() < 1e-7 * scale
    assert np.abs(turns.T @ gradient).max() < 1e-6 * np.abs(g).max()
    # A Schur complement: information is lost along the rotations, one direction per cloud.
    values = np.linalg.eigvalsh(H - marginalised)
    assert values.min() > -1e-9 * scale
    assert (values > 1e-9 * scale).sum() <= count
    # The marginal cost of a step is its cost with the best rotations added.
    step = np.random.default_rng(2).normal(size=len(H))
    best = np.linalg.lstsq(turns.T @ H @ turns, -turns.T @ (H @ step), rcond=None)[0]
    regained = step + turns @ best
    assert step @ marginalised @ step == pytest.approx(regained @ H @ regained, rel=1e-6)


def test_the_generator_moves_points_about_the_axis() -> None:
    symmetry = Symmetry(
        axis_target=np.array([0.0, 0.0, 1.0]),
        centre_target=np.array([0.3, -0.2, 0.5]),
        angle_rad=0.0,
        fitted_rad=1.0,
        compared=1.0,
        contradicted=0.0,
        unseen=np.zeros(0, dtype=np.int64),
    )
    quarter = gtsam.Pose3.Expmap(0.5 * math.pi * symmetry.generator())
    np.testing.assert_allclose(quarter.transformFrom(np.array([1.3, -0.2, 0.9])), [0.3, 0.8, 0.9])


def test_a_drum_alone_claims_its_yaw_and_the_symmetry_takes_it_back() -> None:
    # The reason for `marginalise_symmetry`: flat components on a round surface resist a turn a
    # little, each as much as its part of the surface bends.
    registration = seen("cylinder", A_QUARTER)
    symmetry = upright("cylinder", A_QUARTER)
    assert symmetry is not None
    symmetry = refit(symmetry, registration.mixture)
    turn = symmetry.generator()
    claimed = [float(turn @ block @ turn) ** -0.5 for block in registration.information]
    # Of a hundred such clouds that would be some milliradians.
    assert np.median(claimed) < 50e-3
    left = [
        float(turn @ marginalise_symmetry(b, np.zeros(6), symmetry)[0] @ turn)
        for b in registration.information
    ]
    assert max(left) < 1.0
    # A true turn of one cloud about the axis: by half a radian it is still the same drum.
    R, t = stack(list(registration.T_target_lidar))
    (back,) = unstack(R[:1], t[:1])
    points = registration.observation.clouds[0].points_lidar
    turned = gtsam.Pose3.Expmap(0.2 * turn).compose(back).transformFrom(points.T).T
    off = turned - symmetry.centre_target
    radius = np.hypot(off[:, 0], off[:, 1])
    side = np.abs(off[:, 2]) < 0.5
    assert np.sqrt(np.mean((radius[side] - 0.35) ** 2)) < 2.0 * SIGMA_M


def test_a_symmetry_is_alarming_if_guesses_may_be_off_by_half_its_turn() -> None:
    drum, cube = upright("cylinder", A_QUARTER), upright("cube", ALL_AROUND)
    assert drum is not None
    assert cube is not None
    sigma = math.radians(1.73)
    # 5 degrees off a cube is no danger, 20 degrees (1 sigma) is.
    assert alarming(drum, sigma)
    assert not alarming(cube, sigma)
    assert alarming(cube, math.radians(20.0))


@pytest.mark.parametrize(
    ("sigma_deg", "orders"),
    [(3.0, ()), (7.6, (2, 4, 8)), (10.1, (2, 3, 4, 6, 8)), (12.1, ORDERS), (60.0, ORDERS)],
)
def test_orders_that_guesses_may_confuse_are_tested_with_their_parts(
    sigma_deg: float, orders: tuple[int, ...]
) -> None:
    """Three sigmas reach half of an eighth of a turn at 7.5 degrees, of a fifth at 12."""
    assert alarming_orders(math.radians(sigma_deg)) == orders
