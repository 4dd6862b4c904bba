"""Simulated LiDARs against geometry worked out by hand, and their noise against its sigma."""

import math

import gtsam
import numpy as np
import pytest

from caliv_graph.config.mounting import PoseConfig
from caliv_graph.products import Array
from caliv_graph.scenario.model import CropModel
from caliv_graph.scenario.sensor_models import EdgeModel, LidarModel, SweepModel
from caliv_graph.scenario.world import World, make_world
from caliv_graph.scenario.world_models import BodyBoxModel, BoxModel, ChairModel, WorldModel
from caliv_graph.simulation.lidar import (
    LidarReturns,
    SimulatedLidar,
    beam_directions,
    beams_through_sphere,
    column_times,
)
from caliv_graph.simulation.rays import NO_OBJECT, RayCaster

FRONT = LidarModel(mounting=PoseConfig(xyz=(2.0, 0.0, 2.0), rpy_deg=(0.0, 10.0, 0.0)))
CHAIR_WORLD = make_world(
    WorldModel(objects={"chair": ChairModel(xy_m=(9.0, -1.0), yaw_deg=150.0)}, targets=("chair",))
)
T_MAP_VEHICLE = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.01, -0.02, 0.3), np.array([0.5, -2.0, 0.03]))


def scan(
    model: LidarModel,
    *,
    world: World = CHAIR_WORLD,
    crop: CropModel | None = None,
    T_map_vehicle: gtsam.Pose3 = T_MAP_VEHICLE,
    seed: int = 0,
) -> LidarReturns:
    rng = np.random.default_rng(seed)
    return SimulatedLidar(model, world, RayCaster(world), crop, rng).scan(T_map_vehicle)


def quiet(model: LidarModel) -> LidarModel:
    return model.model_copy(update={"range_sigma_m": 0.0})


def angles_deg(points: Array) -> tuple[Array, Array]:
    azimuth = np.degrees(np.arctan2(points[..., 1], points[..., 0]))
    elevation = np.degrees(np.arctan2(points[..., 2], np.hypot(points[..., 0], points[..., 1])))
    return azimuth, elevation


def test_mounting_is_roll_pitch_yaw_of_urdf() -> None:
    # Nose down by 10 degrees: what lies ahead of the LiDAR lies below it.
    T_vehicle_lidar = PoseConfig(xyz=(2.0, 0.0, 2.0), rpy_deg=(0.0, 10.0, 0.0)).pose()
    down, ahead = math.sin(math.radians(10.0)), math.cos(math.radians(10.0))
    ahead_vehicle = T_vehicle_lidar.transformFrom(np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(ahead_vehicle, [2.0 + ahead, 0.0, 2.0 - down])
    T_vehicle_rear = PoseConfig(xyz=(-0.4, 0.0, 2.0), rpy_deg=(0.0, 10.0, 180.0)).pose()
    behind_vehicle = T_vehicle_rear.transformFrom(np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(behind_vehicle, [-0.4 - ahead, 0.0, 2.0 - down], atol=1e-12)


def test_beams_are_those_of_the_paper() -> None:
    directions = beam_directions(FRONT)
    assert directions.shape == (152, 658, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0)
    azimuth, elevation = angles_deg(directions)
    np.testing.assert_allclose(np.diff(azimuth, axis=1), 120.0 / 658.0)
    np.testing.assert_allclose(np.diff(elevation, axis=0), 25.0 / 151.0)
    np.testing.assert_allclose(elevation[[0, -1]], [[-12.5] * 658, [12.5] * 658])
    np.testing.assert_allclose(azimuth[:, 0], -azimuth[:, -1])


def test_full_turn_has_no_column_twice() -> None:
    model = FRONT.model_copy(
        update={"horizontal_fov_deg": (-180.0, 180.0), "horizontal_resolution_deg": 1.0}
    )
    azimuth, _ = angles_deg(beam_directions(model)[0])
    turn = np.diff(np.append(azimuth, azimuth[0] + 360.0))
    np.testing.assert_allclose(turn, 1.0)


def test_beam_straight_down_measures_the_height_of_the_mount() -> None:
    model = quiet(FRONT).model_copy(
        update={
            "mounting": PoseConfig(xyz=(2.0, 0.0, 2.25)),
            "vertical_fov_deg": (-90.0, -45.0),
            "channels": 2,
            "horizontal_fov_deg": (-1.0, 1.0),
            "horizontal_resolution_deg": 2.0,
        }
    )
    T_map_vehicle = gtsam.Pose3(gtsam.Rot3.Yaw(1.0), np.array([-20.0, 5.0, 0.0]))
    points = scan(model, T_map_vehicle=T_map_vehicle).points_lidar
    np.testing.assert_allclose(points, [[0.0, 0.0, -2.25], [2.25, 0.0, -2.25]], atol=1e-6)


def test_quiet_returns_lie_on_the_mesh_that_they_name() -> None:
    returns = scan(quiet(FRONT))
    points_map = (
        T_MAP_VEHICLE.compose(FRONT.mounting.pose()).transformFrom(returns.points_lidar.T).T
    )
    on_chair = returns.objects == CHAIR_WORLD.names.index("chair")
    assert on_chair.sum() > 500
    assert RayCaster(CHAIR_WORLD).distance(points_map).max() < 1e-4
    assert np.abs(points_map[~on_chair, 2]).max() < 1e-4
    low, high = CHAIR_WORLD.bounds("chair")
    assert (points_map[on_chair] > low - 1e-4).all()
    assert (points_map[on_chair] < high + 1e-4).all()


def test_noise_is_along_the_beam_and_has_its_sigma() -> None:
    sigma_m = 0.02
    noisy = scan(FRONT.model_copy(update={"range_sigma_m": sigma_m})).points_lidar
    clean = scan(quiet(FRONT)).points_lidar
    assert noisy.shape == clean.shape
    beams = clean / np.linalg.norm(clean, axis=1, keepdims=True)
    along = np.einsum("ij,ij->i", noisy - clean, beams)
    across = noisy - clean - along[:, None] * beams
    assert np.abs(across).max() < 1e-9
    n = len(along)
    # Within 4 standard errors.
    assert abs(along.mean()) < 4.0 * sigma_m / math.sqrt(n)
    assert abs(along.std() / sigma_m - 1.0) < 4.0 / math.sqrt(2.0 * n)
    assert abs(np.corrcoef(along[:-1], along[1:])[0, 1]) < 4.0 / math.sqrt(n)


def test_successive_scans_have_noise_of_their_own() -> None:
    rng = np.random.default_rng(0)
    lidar = SimulatedLidar(FRONT, CHAIR_WORLD, RayCaster(CHAIR_WORLD), None, rng)
    one, two = (lidar.scan(T_MAP_VEHICLE).points_lidar for _ in range(2))
    assert np.abs(one - two).max() > 0.01


def test_only_returns_within_the_ranges_are_reported() -> None:
    everything = np.linalg.norm(scan(FRONT).points_lidar, axis=1)
    limited = FRONT.model_copy(update={"min_range_m": 8.0, "max_range_m": 20.0})
    ranges_m = np.linalg.norm(scan(limited).points_lidar, axis=1)
    assert everything.min() < 8.0
    assert everything.max() > 100.0
    np.testing.assert_array_equal(ranges_m, everything[(everything >= 8.0) & (everything <= 20.0)])


def test_beams_through_a_sphere() -> None:
    directions = beam_directions(FRONT).reshape(-1, 3)
    centre, radius_m = np.array([7.0, 2.0, -0.5]), 1.2
    along = np.linspace(0.0, 12.0, 600)
    passes = beams_through_sphere(directions, centre, radius_m)
    assert 0 < passes.sum() < len(passes)
    chosen = np.random.default_rng(1).choice(len(directions), 400, replace=False)
    for beam, verdict in zip(directions[chosen], passes[chosen], strict=True):
        nearest = np.linalg.norm(along[:, None] * beam - centre, axis=1).min()
        assert verdict == (nearest <= radius_m) or abs(nearest - radius_m) < 1e-3
    assert not beams_through_sphere(directions, -centre, radius_m).any()
    assert beams_through_sphere(directions, np.array([0.0, 0.5, 0.5]), radius_m).all()


@pytest.mark.parametrize("stride", [0, 4])
def test_crop_keeps_the_target_and_changes_no_return(stride: int) -> None:
    full = scan(FRONT)
    cropped = scan(FRONT, crop=CropModel(margin_m=0.5, elsewhere_stride=stride))
    rows = {tuple(row): int(hit) for row, hit in zip(full.points_lidar, full.objects, strict=True)}
    for row, hit in zip(cropped.points_lidar, cropped.objects, strict=True):
        assert rows[tuple(row)] == hit
    chair = CHAIR_WORLD.names.index("chair")
    assert (cropped.objects == chair).sum() == (full.objects == chair).sum()
    fraction = len(cropped.points_lidar) / len(full.points_lidar)
    assert fraction < 0.25
    # Beyond the target and its surroundings nothing, or one in 16.
    bearing = angles_deg(cropped.points_lidar)[0]
    elsewhere = (bearing > 0.0).sum() / (angles_deg(full.points_lidar)[0] > 0.0).sum()
    assert elsewhere == pytest.approx(1.0 / 16.0 if stride else 0.0, rel=0.1)


def test_lidars_may_differ() -> None:
    coarse = FRONT.model_copy(
        update={
            "channels": 16,
            "vertical_fov_deg": (-15.0, 15.0),
            "horizontal_fov_deg": (-180.0, 180.0),
            "horizontal_resolution_deg": 0.4,
        }
    )
    elevation = angles_deg(scan(quiet(coarse)).points_lidar)[1]
    assert np.unique(np.round(elevation, 3)).tolist() == pytest.approx(
        [-15.0 + 2.0 * i for i in range(len(np.unique(np.round(elevation, 3))))]
    )
    fine = angles_deg(scan(quiet(FRONT)).points_lidar)
    assert np.unique(np.round(fine[1], 3)).size > 60
    assert fine[0].min() > -60.0


def test_chair_has_as_many_points_as_the_authors_clouds_have() -> None:
    # Theirs: 210 at 15.7 m, 1260 at 6.0 m. One point covers range^2 x 9.2e-6 rad^2.
    for range_m, expected in ((15.7, 210), (6.0, 1260)):
        world = make_world(
            WorldModel(
                objects={"chair": ChairModel(xy_m=(2.0 + range_m, 0.0), yaw_deg=130.0)},
                targets=("chair",),
            )
        )
        returns = scan(FRONT, world=world, T_map_vehicle=gtsam.Pose3())
        count = int((returns.objects == world.names.index("chair")).sum())
        assert 0.75 * expected < count < 1.33 * expected


def test_channels_may_be_uneven() -> None:
    model = FRONT.model_copy(update={"elevations_deg": (-20.0, -3.0, -2.0, 0.5)})
    _, elevation = angles_deg(beam_directions(model))
    assert elevation.shape == (4, 658)
    np.testing.assert_allclose(elevation[:, 17], [-20.0, -3.0, -2.0, 0.5])


def swept(**changes: object) -> LidarModel:
    return FRONT.model_copy(update={"sweep": SweepModel(**changes)})  # type: ignore[arg-type]


def test_columns_follow_one_another_through_the_sweep() -> None:
    assert column_times(FRONT, 5).tolist() == [0.0]
    times = {
        (way, at): column_times(
            swept(direction=way, stamp_at=at, time_field="time", duration_s=0.05), 5
        ).tolist()
        for way in ("clockwise", "counter_clockwise")
        for at in ("start", "end")
    }
    # The first column is the rightmost; seen from above, clockwise begins on the left.
    rising = [0.0, 0.01, 0.02, 0.03, 0.04]
    assert times["counter_clockwise", "start"] == pytest.approx(rising)
    assert times["clockwise", "start"] == pytest.approx(rising[::-1])
    assert times["counter_clockwise", "end"] == pytest.approx([t - 0.05 for t in rising])
    assert times["clockwise", "end"] == pytest.approx([t - 0.05 for t in rising[::-1]])
    # Without a duration it takes the whole period.
    assert column_times(swept(), 5).max() == pytest.approx(0.08)


def moving_poses(columns: int) -> tuple[Array, Array]:
    """The vehicle turns by 0.2 rad and drives 1 m from the first to the last column."""
    part = np.linspace(0.0, 1.0, columns)
    poses = [
        gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.02 * p, 0.2 * p), np.array([p, 0.1 * p, 0.0]))
        for p in part
    ]
    return (
        np.array([pose.rotation().matrix() for pose in poses]),
        np.array([pose.translation() for pose in poses]),
    )


def sweeping(
    model: LidarModel, crop: CropModel | None = None, seed: int = 0
) -> tuple[SimulatedLidar, LidarReturns]:
    rng = np.random.default_rng(seed)
    lidar = SimulatedLidar(model, CHAIR_WORLD, RayCaster(CHAIR_WORLD), crop, rng)
    R, t = moving_poses(658)
    return lidar, lidar.sweep(R, t, lidar.column_times_s)


def test_each_column_of_a_sweep_is_taken_from_its_own_pose() -> None:
    lidar, returns = sweeping(quiet(swept()))
    R, t = moving_poses(658)
    T_vehicle_lidar = FRONT.mounting.pose()
    points_vehicle = T_vehicle_lidar.transformFrom(returns.points_lidar.T).T
    column = lidar.columns_of(returns)
    points_map = np.einsum("nij,nj->ni", R[column], points_vehicle) + t[column]
    on_chair = returns.objects == CHAIR_WORLD.names.index("chair")
    assert on_chair.sum() > 500
    caster = RayCaster(CHAIR_WORLD)
    assert caster.distance(points_map).max() < 1e-4
    # Taken for an instant, they do not fit.
    still = points_vehicle @ R[0].T + t[0]
    assert np.median(caster.distance(still[on_chair])) > 0.05


def test_crop_of_a_sweep_keeps_the_target_and_changes_no_return() -> None:
    _, full = sweeping(swept())
    _, part = sweeping(swept(), CropModel(margin_m=0.0, elsewhere_stride=0))
    chair = CHAIR_WORLD.names.index("chair")
    kept = dict(zip(part.beams.tolist(), part.points_lidar.tolist(), strict=True))
    whole = dict(zip(full.beams.tolist(), full.points_lidar.tolist(), strict=True))
    assert set(full.beams[full.objects == chair].tolist()) <= set(kept)
    assert len(kept) < 0.2 * len(whole)
    assert all(whole[beam] == point for beam, point in kept.items())


def test_skipped_cloud_leaves_the_next_as_it_is() -> None:
    for model in (FRONT, FRONT.model_copy(update={"edges": EdgeModel()})):
        one, other = (
            SimulatedLidar(
                model, CHAIR_WORLD, RayCaster(CHAIR_WORLD), None, np.random.default_rng(3)
            )
            for _ in range(2)
        )
        one.scan(T_MAP_VEHICLE)
        other.skip()
        np.testing.assert_array_equal(
            one.scan(T_MAP_VEHICLE).points_lidar, other.scan(T_MAP_VEHICLE).points_lidar
        )


BOX_WORLD = make_world(
    WorldModel(
        objects={
            "near": BoxModel(xy_m=(9.0, 0.0), size_m=(0.2, 2.0, 3.0)),
            "wall": BoxModel(xy_m=(10.0, 0.0), size_m=(0.2, 40.0, 9.0)),
        },
        targets=("near",),
    )
)


def edged(**changes: float) -> LidarReturns:
    model = quiet(FRONT).model_copy(update={"edges": EdgeModel(**changes)})
    return scan(model, world=BOX_WORLD, T_map_vehicle=gtsam.Pose3())


def test_mixed_returns_lie_between_the_two_surfaces_and_at_edges_only() -> None:
    clean = scan(quiet(FRONT), world=BOX_WORLD, T_map_vehicle=gtsam.Pose3())
    mixed = edged(mixed_probability=1.0, lost_probability=0.0, divergence_mrad=10.0)
    between = mixed.objects == NO_OBJECT
    # The box's two upright edges, 100 channels each, and where ground and walls meet.
    assert 50 < between.sum() < 3000
    # A beam that grazes the ground is long, but meets no edge but where the box stands.
    on_ground = clean.objects == 0
    assert (between & on_ground).sum() < 0.01 * on_ground.sum()
    np.testing.assert_array_equal(mixed.beams, clean.beams)
    np.testing.assert_allclose(
        mixed.points_lidar[~between], clean.points_lidar[~between], atol=1e-9
    )
    T_vehicle_lidar = FRONT.mounting.pose()
    points = T_vehicle_lidar.transformFrom(mixed.points_lidar[between].T).T
    # Beside the box, above the ground: between its front at 8.9 m and the wall's at 9.9 m.
    beside = (
        (np.abs(np.abs(points[:, 1]) - 1.0) < 0.06) & (points[:, 2] > 0.2) & (points[:, 2] < 2.9)
    )
    assert beside.sum() > 30
    x = points[beside, 0]
    assert x.min() > 8.89
    assert x.max() < 9.91
    assert ((x > 9.2) & (x < 9.6)).sum() > 5


def test_edges_are_lost_as_often_as_stated() -> None:
    all_mixed = edged(mixed_probability=1.0, lost_probability=0.0, mixing_m=1e3)
    half_lost = edged(mixed_probability=1.0, lost_probability=0.5, mixing_m=1e3)
    edge = int((all_mixed.objects == NO_OBJECT).sum())
    lost = len(all_mixed.points_lidar) - len(half_lost.points_lidar)
    assert lost == pytest.approx(0.5 * edge, rel=0.15)
    some = edged(mixed_probability=0.4, lost_probability=0.5, mixing_m=1e3)
    assert (some.objects == NO_OBJECT).sum() == pytest.approx(0.2 * edge, rel=0.25)
    thinned = edged(mixed_probability=0.0, lost_probability=0.0, dropout_probability=0.1)
    assert len(thinned.points_lidar) / len(all_mixed.points_lidar) == pytest.approx(0.9, abs=0.01)


def test_edge_effects_leave_the_range_noise_alone() -> None:
    plain = scan(FRONT, world=BOX_WORLD)
    edges = EdgeModel(mixed_probability=0.0, lost_probability=0.0)
    same = scan(FRONT.model_copy(update={"edges": edges}), world=BOX_WORLD)
    np.testing.assert_array_equal(plain.points_lidar, same.points_lidar)


def test_body_of_the_vehicle_is_seen_the_same_from_everywhere() -> None:
    # The roof, 1.9 m up, from 2 m at 10 degrees nose down: the lowest beam comes down by 22.5.
    body = (BodyBoxModel(centre_m=(2.0, 0.0, 1.5), size_m=(3.0, 1.8, 0.8)),)
    world = make_world(WorldModel(), body)
    model = quiet(FRONT).model_copy(update={"min_range_m": 0.1})
    returns = [
        scan(model, world=world, T_map_vehicle=pose) for pose in (gtsam.Pose3(), T_MAP_VEHICLE)
    ]
    roofs = [r.points_lidar[r.objects == world.names.index("vehicle")] for r in returns]
    assert len(roofs[0]) > 1000
    np.testing.assert_array_equal(roofs[0], roofs[1])
    points_vehicle = FRONT.mounting.pose().transformFrom(roofs[0].T).T
    np.testing.assert_allclose(points_vehicle[:, 2], 1.9, atol=1e-5)
    assert np.abs(points_vehicle[:, 1]).max() <= 0.9 + 1e-5
