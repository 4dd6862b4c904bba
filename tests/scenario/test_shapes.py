"""Meshes and rays against geometry worked out by hand."""

import math
from collections import Counter

import gtsam
import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from caliv_graph.scenario.shapes import (
    _backrest,
    _seat,
    _side,
    chair,
    ground,
    object_mesh,
    person,
)
from caliv_graph.scenario.solids import Mesh, bar, box, cylinder, join, tube
from caliv_graph.scenario.terrain import Terrain
from caliv_graph.scenario.world import GROUND, World, make_world
from caliv_graph.scenario.world_models import (
    BicycleModel,
    BinModel,
    BodyBoxModel,
    BoxesModel,
    BoxModel,
    ChairModel,
    ConesModel,
    GroundModel,
    ObjectModel,
    PoleModel,
    RampModel,
    StrollerModel,
    ThinChairModel,
    WalkerModel,
    WorldModel,
)
from caliv_graph.simulation.rays import NO_OBJECT, RayCaster

SOLIDS: dict[str, Mesh] = {
    "box": box((1.0, 2.0, 3.0)),
    "bar": bar((0.0, 0.0, 1.0), (0.5, 0.1, 0.0), (0.1, 0.2), (0.2, 0.1)),
    "lying bar": bar((1.0, 0.0, 1.0), (0.0, 0.1, 1.0), (0.1, 0.2), (0.2, 0.1), (1, 2)),
    "cylinder": cylinder((0.0, 0.0, 0.0), (0.1, 0.0, 2.0), 0.2, 0.1),
    "seat": _seat(),
    "backrest": _backrest(),
    "upright ring": tube(
        np.array([[math.cos(a), 0.0, math.sin(a)] for a in np.arange(0.0, 6.2, 0.2)]),
        0.1,
        closed=True,
    ),
    "bent tube": tube(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.5, 1.0]]), 0.1),
    **{f"side {i}": part for i, part in enumerate([*_side(1.0), *_side(-1.0)])},
}

STREET: dict[str, tuple[ObjectModel, tuple[float, float, float]]] = {
    "thin_chair": (ThinChairModel(xy_m=(0.0, 0.0)), (0.60, 0.60, 0.95)),
    "boxes": (BoxesModel(xy_m=(0.0, 0.0)), (0.65, 1.07, 0.65)),
    "cones": (ConesModel(xy_m=(0.0, 0.0)), (0.78, 1.13, 0.75)),
    "bicycle": (BicycleModel(xy_m=(0.0, 0.0)), (1.70, 0.60, 1.03)),
    "stroller": (StrollerModel(xy_m=(0.0, 0.0)), (0.96, 0.58, 1.05)),
    "bin": (BinModel(xy_m=(0.0, 0.0)), (0.74, 0.58, 1.07)),
}
"""Targets by the name of their shape, with their size along x, y, z in metres."""


def surface(mesh: Mesh, count: int, seed: int = 0) -> np.ndarray:
    """(count, 3) points, evenly spread over the triangles."""
    rng = np.random.default_rng(seed)
    a, b, c = (mesh.vertices[mesh.triangles[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    which = rng.choice(len(area), count, p=area / area.sum())
    u, v = np.sort(rng.uniform(size=(2, count)), axis=0)[:, :, None]
    points: np.ndarray = u * a[which] + (v - u) * b[which] + (1.0 - v) * c[which]
    return points


def cast_one(
    world: World, origin: tuple[float, float, float], direction: tuple[float, float, float]
) -> tuple[float, str | None]:
    d = np.array([direction]) / np.linalg.norm(direction)
    distance, objects = RayCaster(world).cast(np.array(origin), d)
    name = None if objects[0] == NO_OBJECT else world.names[objects[0]]
    return float(distance[0]), name


def chair_world(x: float = 0.0, y: float = 0.0, yaw_deg: float = 0.0, z: float = 0.0) -> World:
    return make_world(
        WorldModel(
            ground=GroundModel(height_m=z, half_size_m=50.0),
            objects={"chair": ChairModel(xy_m=(x, y), yaw_deg=yaw_deg)},
            targets=("chair",),
        )
    )


@pytest.mark.parametrize("name", SOLIDS)
def test_solids_are_closed_and_look_outwards(name: str) -> None:
    mesh = SOLIDS[name]
    edges = Counter((int(t[i]), int(t[(i + 1) % 3])) for t in mesh.triangles for i in range(3))
    # Closed and consistently turned: each directed edge once, and once the other way.
    assert set(edges.values()) == {1}
    assert all((b, a) in edges for a, b in edges)
    assert mesh.signed_volume() > 0.0


@pytest.mark.parametrize("name", STREET)
def test_every_part_of_a_target_is_closed_and_looks_outwards(name: str) -> None:
    model, _ = STREET[name]
    mesh = object_mesh(model)
    assert model.shape == name
    edges = Counter((int(t[i]), int(t[(i + 1) % 3])) for t in mesh.triangles for i in range(3))
    assert set(edges.values()) == {1}
    assert all((b, a) in edges for a, b in edges)
    rows, columns = np.array(list(edges)).T
    n = len(mesh.vertices)
    links = coo_array((np.ones(len(rows)), (rows, columns)), shape=(n, n))
    count, part = connected_components(links, directed=False)
    assert count > 2
    for i in range(count):
        solid = Mesh(mesh.vertices, mesh.triangles[part[mesh.triangles[:, 0]] == i])
        assert solid.signed_volume() > 0.0


@pytest.mark.parametrize("name", STREET)
def test_target_has_its_size_and_stands_on_the_ground_about_its_origin(name: str) -> None:
    model, size_m = STREET[name]
    vertices = object_mesh(model).vertices
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    np.testing.assert_allclose(high - low, size_m, atol=0.015)
    assert low[2] == pytest.approx(0.0, abs=1e-9)
    assert np.abs(low + high)[:2].max() < 0.12


@pytest.mark.parametrize("name", STREET)
def test_target_turned_about_its_middle_does_not_match_itself(name: str) -> None:
    mesh = object_mesh(STREET[name][0])
    one, other = surface(mesh, 20_000), surface(mesh, 2_000, seed=1)
    middle = one.mean(axis=0) * [1.0, 1.0, 0.0]
    tree = cKDTree(one - middle)
    itself = float(np.median(tree.query(other - middle)[0]))
    for degrees in range(30, 331, 10):
        R = gtsam.Rot3.Yaw(math.radians(degrees)).matrix()
        distance = tree.query((other - middle) @ R.T)[0]
        assert np.mean(distance) > 0.015, degrees
        assert np.percentile(distance, 95) > 8.0 * itself, degrees


def test_tubes_have_their_thickness_and_length() -> None:
    straight = tube(np.array([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]]), 0.1, 64)
    assert straight.signed_volume() == pytest.approx(math.pi * 0.1**2 * 2.0, rel=0.005)
    angle = np.linspace(0.0, 2.0 * math.pi, 90, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(90)])
    ring = tube(circle, 0.1, 64, closed=True)
    # Pappus: the section's area times the way of its middle.
    assert ring.signed_volume() == pytest.approx(math.pi * 0.1**2 * 2.0 * math.pi, rel=0.005)


def test_slats_of_the_thin_chair_have_gaps() -> None:
    world = make_world(
        WorldModel(objects={"chair": ThinChairModel(xy_m=(0.0, 0.0))}, targets=("chair",))
    )
    # Across the back at 0.7 m, every 5 mm: four slats of 5 cm, and two posts of 4 cm.
    y = np.arange(-0.4, 0.4, 0.005) + 0.0025
    origins = np.column_stack([np.full(len(y), -2.0), y, np.full(len(y), 0.7)])
    ahead = np.tile([1.0, 0.0, 0.0], (len(y), 1))
    caster = RayCaster(world)
    distance, _ = caster.cast(origins, ahead)
    on_back = distance < 1.8
    assert on_back.sum() * 0.005 == pytest.approx(4 * 0.05 + 2 * 0.04, abs=0.011)
    assert np.count_nonzero(np.diff(on_back.astype(int)) == 1) == 6


@pytest.mark.parametrize(("x", "y", "z"), [(-0.4, 0.0, 0.74), (0.0, 0.0, 0.95)])
def test_hood_of_the_stroller_is_cloth_seen_from_both_sides(x: float, y: float, z: float) -> None:
    world = make_world(
        WorldModel(objects={"pram": StrollerModel(xy_m=(0.0, 0.0))}, targets=("pram",))
    )
    centre = np.array([-0.11, 0.0, 0.71])
    way = np.array([x, y, z]) - centre
    way /= np.linalg.norm(way)
    begin, end = centre + 0.2 * way, centre + 0.5 * way
    out, _ = cast_one(world, tuple(begin.tolist()), tuple(way.tolist()))
    back, _ = cast_one(world, tuple(end.tolist()), tuple((-way).tolist()))
    assert 0.3 - out - back == pytest.approx(0.015, abs=0.001)


def test_box_has_its_size_and_stands_on_its_origin() -> None:
    mesh = box((1.0, 2.0, 3.0))
    assert mesh.signed_volume() == pytest.approx(6.0)
    np.testing.assert_allclose(mesh.vertices.min(axis=0), [-0.5, -1.0, 0.0])
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [0.5, 1.0, 3.0])


def test_joined_meshes_keep_their_triangles() -> None:
    one, two = box((1.0, 1.0, 1.0)), box((2.0, 1.0, 1.0))
    assert join([one, two]).signed_volume() == pytest.approx(3.0)


def test_moved_mesh_is_mapped_by_the_pose() -> None:
    T_map_box = gtsam.Pose3(gtsam.Rot3.Yaw(math.pi / 2.0), np.array([10.0, 20.0, 30.0]))
    mesh = box((1.0, 2.0, 3.0)).moved(T_map_box)
    np.testing.assert_allclose(mesh.vertices.min(axis=0), [9.0, 19.5, 30.0])
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [11.0, 20.5, 33.0])


def test_ground_looks_up() -> None:
    mesh = ground(GroundModel(half_size_m=25.0))
    a, b, c = (mesh.vertices[mesh.triangles[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    assert (normals[:, 2] > 0.0).all()
    assert 0.5 * normals[:, 2].sum() == pytest.approx(2500.0)


def test_chair_has_the_size_of_a_chair() -> None:
    mesh = chair()
    size = mesh.vertices.max(axis=0) - mesh.vertices.min(axis=0)
    np.testing.assert_allclose(size, [0.77, 0.72, 1.25], atol=0.01)
    assert mesh.vertices[:, 2].min() == 0.0


def test_chair_mirrors_left_to_right_but_not_front_to_back() -> None:
    world = chair_world()
    vertices = world.meshes["chair"].vertices
    caster = RayCaster(world)
    assert caster.distance(vertices * [1.0, -1.0, 1.0]).max() < 1e-5
    turned = caster.distance(vertices * [-1.0, -1.0, 1.0])
    assert turned.max() > 0.3
    assert np.median(turned) > 0.05


def test_seat_is_25_mm_thick() -> None:
    world = chair_world()
    down, _ = cast_one(world, (0.015, 0.0, 1.0), (0.0, 0.0, -1.0))
    up, _ = cast_one(world, (0.015, 0.0, 0.1), (0.0, 0.0, 1.0))
    # Top at 0.53 m less 12 mm of dish.
    assert 1.0 - down == pytest.approx(0.518, abs=1e-5)
    assert (1.0 - down) - (0.1 + up) == pytest.approx(0.025, abs=1e-5)


def test_backrest_is_25_mm_thick_and_seen_from_both_sides() -> None:
    world = chair_world()
    front, _ = cast_one(world, (2.0, 0.0, 1.0), (-1.0, 0.0, 0.0))
    back, _ = cast_one(world, (-2.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    assert (2.0 - front) - (back - 2.0) == pytest.approx(0.025, abs=1e-5)
    # It leans back by 8 degrees: 0.14 m per metre.
    higher, _ = cast_one(world, (2.0, 0.0, 1.1), (-1.0, 0.0, 0.0))
    assert higher - front == pytest.approx(0.1 * math.tan(math.radians(8.0)), abs=1e-5)


@pytest.mark.parametrize("z", [0.0, -1.7])
def test_ray_straight_down_hits_the_ground_at_its_height(z: float) -> None:
    world = chair_world(z=z)
    distance, name = cast_one(world, (5.0, 3.0, z + 2.0), (0.0, 0.0, -1.0))
    assert distance == pytest.approx(2.0, abs=1e-6)
    assert name == GROUND
    distance, _ = cast_one(world, (5.0, 3.0, z + 2.0), (1.0, 0.0, -1.0))
    assert distance == pytest.approx(2.0 * math.sqrt(2.0), abs=1e-5)


def test_ray_into_the_sky_hits_nothing() -> None:
    assert cast_one(chair_world(), (5.0, 3.0, 2.0), (0.0, 0.3, 1.0)) == (math.inf, None)


def test_objects_stand_where_they_are_put() -> None:
    world = make_world(
        WorldModel(
            ground=GroundModel(height_m=0.5),
            objects={
                "wall": BoxModel(xy_m=(10.0, 0.0), yaw_deg=90.0, size_m=(8.0, 0.2, 3.0)),
                "chair": ChairModel(xy_m=(-5.0, 1.0)),
            },
            targets=("chair",),
        )
    )
    assert world.names == (GROUND, "wall", "chair")
    distance, name = cast_one(world, (0.0, 3.9, 3.4), (1.0, 0.0, 0.0))
    assert distance == pytest.approx(9.9, abs=1e-5)
    assert name == "wall"
    assert cast_one(world, (0.0, 4.1, 3.4), (1.0, 0.0, 0.0)) == (math.inf, None)
    low, high = world.bounds("chair")
    assert low[2] == 0.5
    assert high[2] == pytest.approx(1.75)
    centre, radius_m = world.bounding_sphere("chair")
    distances = np.linalg.norm(world.meshes["chair"].vertices - centre, axis=1)
    assert radius_m == pytest.approx(distances.max())
    assert radius_m < 0.9


def test_precision_holds_far_from_the_origin_of_the_map() -> None:
    # As in a UTM grid, where float32 resolves 30 mm.
    near, far = chair_world(), chair_world(x=500_000.0, y=5_000_000.0)
    d = np.array([[-1.0, 0.05, -0.2], [-1.0, -0.02, -0.25], [-1.0, 0.0, -0.18]])
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    origin = np.array([5.0, 0.0, 2.0])
    distance_near, objects_near = RayCaster(near).cast(origin, d)
    shift = np.array([500_000.0, 5_000_000.0, 0.0])
    distance_far, objects_far = RayCaster(far).cast(origin + shift, d)
    chair_hits = objects_near == near.names.index("chair")
    assert chair_hits.any()
    np.testing.assert_array_equal(objects_far[chair_hits], objects_near[chair_hits])
    np.testing.assert_allclose(distance_far[chair_hits], distance_near[chair_hits], atol=1e-5)


def test_far_ground_is_flat_to_a_tenth_of_a_millimetre() -> None:
    world = chair_world()
    ranges_m = np.linspace(5.0, 45.0, 200)
    d = np.stack([ranges_m, np.zeros(200), np.full(200, -2.0)], axis=1)
    lengths = np.linalg.norm(d, axis=1)
    distance, _ = RayCaster(world).cast(np.array([0.0, 7.0, 2.0]), d / lengths[:, None])
    heights = 2.0 - distance * 2.0 / lengths
    assert np.abs(heights).max() < 1e-5


@pytest.mark.parametrize("threads", [2, 0])
def test_number_of_threads_changes_nothing(threads: int) -> None:
    world = chair_world()
    rng = np.random.default_rng(3)
    d = rng.normal(size=(20_000, 3)) * [1.0, 1.0, 0.3] - [0.0, 0.0, 0.1]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    one = RayCaster(world, 1).cast(np.array([2.0, 0.0, 1.0]), d)
    many = RayCaster(world, threads).cast(np.array([2.0, 0.0, 1.0]), d)
    np.testing.assert_array_equal(one[0], many[0])
    np.testing.assert_array_equal(one[1], many[1])


def test_pole_is_round_and_upright() -> None:
    world = make_world(
        WorldModel(objects={"pole": PoleModel(xy_m=(5.0, 1.0), radius_m=0.2, height_m=3.0)})
    )
    for z, name in ((0.5, "pole"), (2.9, "pole"), (3.1, None)):
        distance, hit = cast_one(world, (0.0, 1.0, z), (1.0, 0.0, 0.0))
        assert hit == name
        if name:
            assert distance == pytest.approx(4.8, abs=0.002)
    assert cast_one(world, (0.0, 1.21, 1.0), (1.0, 0.0, 0.0))[1] is None


def test_person_has_the_size_of_one() -> None:
    mesh = person()
    size = mesh.vertices.max(axis=0) - mesh.vertices.min(axis=0)
    np.testing.assert_allclose(size, [0.56, 0.6, 1.75], atol=0.05)
    assert mesh.vertices[:, 2].min() == 0.0
    # About 70 litres.
    assert 0.05 < mesh.signed_volume() < 0.1


RAMP = RampModel(xy_m=(6.0, -2.0), yaw_deg=30.0, height_m=0.6, flank_m=5.0, top_m=1.0, width_m=2.0)


def test_mesh_of_the_ground_is_the_function() -> None:
    world = make_world(WorldModel(ground=GroundModel(height_m=0.3, ramps=(RAMP,))))
    terrain = Terrain((RAMP,))
    rng = np.random.default_rng(0)
    near = rng.uniform(-8.0, 8.0, (300, 2)) + np.array([6.0, -2.0])
    xy = np.vstack([near, rng.uniform(-90.0, 90.0, (50, 2))])
    origins = np.column_stack([xy, np.full(len(xy), 5.0)])
    down = np.array([[0.0, 0.0, -1.0]])
    caster = RayCaster(world)
    heights = np.array([5.0 - caster.cast(origin, down)[0][0] for origin in origins])
    expected = 0.3 + terrain.heights(xy)[0]
    assert expected.max() > 0.85
    # It bends by 7.5 x 0.6 / 5^2 per metre at most: half a millimetre over a square of 0.1 m.
    np.testing.assert_allclose(heights, expected, atol=5e-4)


def test_ground_with_a_ramp_ends_where_it_should_and_is_not_huge() -> None:
    mesh = ground(GroundModel(half_size_m=100.0), Terrain((RAMP,)))
    np.testing.assert_allclose(mesh.vertices[:, :2].min(axis=0), [-100.0, -100.0])
    np.testing.assert_allclose(mesh.vertices[:, :2].max(axis=0), [100.0, 100.0])
    assert len(mesh.vertices) < 50_000
    a, b, c = (mesh.vertices[mesh.triangles[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    assert (normals[:, 2] > 0.0).all()
    assert 0.5 * normals[:, 2].sum() == pytest.approx(40_000.0)


def test_objects_stand_on_a_ramp() -> None:
    model = WorldModel(
        ground=GroundModel(ramps=(RAMP,)),
        objects={
            "chair": ChairModel(xy_m=(6.0, -2.0)),
            "box": BoxModel(xy_m=(30.0, 0.0), size_m=(1, 1, 1)),
        },
        targets=("chair",),
    )
    world = make_world(model)
    assert world.bounds("chair")[0][2] == pytest.approx(0.6)
    assert world.bounds("box")[0][2] == 0.0


def test_walker_goes_to_and_fro_facing_ahead() -> None:
    walker = WalkerModel(from_xy_m=(5.0, 0.0), to_xy_m=(5.0, 4.0), speed_m_s=2.0)
    world = make_world(WorldModel(walkers={"who": walker}))
    R, t = world.walkers["who"].poses(np.array([0.0, 1.0, 2.5, 3.0, 4.5]))
    np.testing.assert_allclose(
        t[:, :2], [[5.0, 0.0], [5.0, 2.0], [5.0, 3.0], [5.0, 2.0], [5.0, 1.0]], atol=1e-12
    )
    np.testing.assert_allclose(R[:, :2, 0], [[0, 1], [0, 1], [0, -1], [0, -1], [0, 1]], atol=1e-12)
    assert world.names == (GROUND, "who")
    caster = RayCaster(world)
    ahead = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    at_once = np.array([[0.0, 2.0, 1.0], [0.0, 0.0, 1.0]])
    distance, objects = caster.cast(at_once, ahead, np.array([1.0, 1.0]))
    assert distance[0] == pytest.approx(5.0 - 0.2, abs=0.1)
    assert objects.tolist() == [1, NO_OBJECT]
    # Each ray at its own time: now it is at the other place.
    _, objects = caster.cast(at_once, ahead, np.array([2.0, 4.0]))
    assert objects.tolist() == [NO_OBJECT, 1]
    # One time for all.
    assert caster.cast(at_once[0], ahead, 1.0)[1].tolist() == [1, 1]


def test_walker_hides_what_is_behind_and_not_what_is_before() -> None:
    walker = WalkerModel(from_xy_m=(5.0, -1.0), to_xy_m=(5.0, 1.0), speed_m_s=1.0)
    boxes: dict[str, ObjectModel] = {"far": BoxModel(xy_m=(9.0, 0.0), size_m=(1.0, 1.0, 2.0))}
    world = make_world(WorldModel(objects=boxes, walkers={"who": walker}))
    caster = RayCaster(world)
    ahead = np.array([[1.0, 0.0, 0.0]])
    assert caster.cast(np.array([0.0, 0.0, 1.0]), ahead, 1.0)[1].tolist() == [2]
    assert caster.cast(np.array([0.0, 0.0, 1.0]), ahead, 0.0)[1].tolist() == [1]
    assert caster.cast(np.array([10.0, 0.0, 1.0]), -ahead, 1.0)[1].tolist() == [1]


def test_body_of_the_vehicle_is_in_its_own_frame() -> None:
    body = (BodyBoxModel(centre_m=(1.0, 0.0, 1.5), size_m=(2.0, 1.0, 0.5)),)
    world = make_world(WorldModel(), body)
    assert world.names == (GROUND, "vehicle")
    down = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    distance, index = RayCaster(world).cast_at_vehicle(np.array([0.5, 0.2, 3.0]), down)
    assert world.names[index] == "vehicle"
    np.testing.assert_allclose(distance, [3.0 - 1.75, np.inf], atol=1e-6)
    # It stands nowhere in the map.
    below_m, name = cast_one(world, (0.5, 0.2, 3.0), (0.0, 0.0, -1.0))
    assert name == GROUND
    assert below_m == pytest.approx(3.0)
    bare, _ = RayCaster(make_world(WorldModel())).cast_at_vehicle(np.zeros(3), down)
    assert np.isinf(bare).all()
