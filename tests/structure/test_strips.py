"""Strips: what is taken for one piece of surface."""

import numpy as np

from caliv_graph.structure.strips import MIN_SCANS, find_strips

EIGHT = np.arange(8, dtype=np.int64)


def patch(centre: np.ndarray, normal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Moments of 40 points on 0.5 m of a plane."""
    p = rng.uniform(-0.25, 0.25, (40, 3))
    p -= np.outer(p @ normal, normal)
    h = np.column_stack([p + centre, np.ones(40)])
    return np.asarray(h.T @ h)


def patches(
    centres: np.ndarray, normals: np.ndarray, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    both = zip(centres, normals, strict=True)
    return np.array([patch(c, n, rng) for c, n in both]), np.asarray(normals)


def test_two_faces_of_a_thin_wall_are_two_strips() -> None:
    along = np.linspace(0.3, 1.7, 8)
    front = np.column_stack([np.full(8, 1.0), along, np.full(8, 1.0)])
    back = front + np.array([0.1, 0.0, 0.0])
    normals = np.array([[-1.0, 0.0, 0.0]] * 8 + [[1.0, 0.0, 0.0]] * 8)
    strips = find_strips(*patches(np.vstack([front, back]), normals), np.tile(EIGHT, 2), 0.3)
    assert strips.count == 2
    assert set(strips.of_patch[:8]) & set(strips.of_patch[8:]) == set()


def test_a_corner_is_two_strips_and_two_surfaces() -> None:
    along = np.linspace(0.3, 1.7, 8)
    one = np.column_stack([np.full(8, 0.2), along, np.full(8, 1.0)])
    other = np.column_stack([along, np.full(8, 0.2), np.full(8, 1.0)])
    normals = np.array([[1.0, 0.0, 0.0]] * 8 + [[0.0, 1.0, 0.0]] * 8)
    strips = find_strips(*patches(np.vstack([one, other]), normals), np.tile(EIGHT, 2), 0.1)
    assert strips.count == 2
    assert len(set(strips.surface)) == 2


def test_a_long_wall_is_one_surface_of_several_strips() -> None:
    along = np.repeat(np.arange(0.5, 9.5, 1.0), 8)
    centres = np.column_stack([np.full(72, 1.0), along, np.full(72, 1.0)])
    normals = np.tile([1.0, 0.0, 0.0], (72, 1))
    strips = find_strips(*patches(centres, normals), np.tile(EIGHT, 9), 0.1)
    assert strips.count == 5  # 9 m in cells of 2 m
    assert len(set(strips.surface)) == 1


def test_a_surface_on_the_boundary_of_cells_is_one_strip() -> None:
    """Two would have patches whose errors have the same sign."""
    along = np.linspace(0.3, 1.7, 8)
    around = np.where(EIGHT % 2, 0.001, -0.001)
    ground = np.column_stack([np.linspace(0.75, 1.35, 8), np.full(8, 1.0), around])
    wall = np.column_stack([4.0 + around, along, np.full(8, 1.0)])
    for centres, normal in ((ground, [0.0, 0.0, 1.0]), (wall, [-1.0, 0.0, 0.0])):
        strips = find_strips(*patches(centres, np.tile(normal, (8, 1))), EIGHT, 0.1)
        assert strips.count == 1
        assert (strips.of_patch == 0).all()


def test_fronts_behind_each_other_are_strips_of_their_own() -> None:
    along = np.linspace(0.3, 1.7, 8)
    wall = np.column_stack([np.zeros(8), along, np.full(8, 1.0)])
    centres = np.vstack([wall + np.array([x, 0.0, 0.0]) for x in (1.0, 3.0, 3.5, 9.0)])
    strips = find_strips(
        *patches(centres, np.tile([1.0, 0.0, 0.0], (32, 1))), np.tile(EIGHT, 4), 0.06
    )
    assert sorted(strips.centres_map[:, 0].round(2).tolist()) == [1.0, 3.0, 3.5, 9.0]


def test_what_few_scans_see_is_no_strip() -> None:
    centres = np.column_stack([np.full(8, 1.0), np.linspace(0.3, 1.7, 8), np.full(8, 1.0)])
    normals = np.tile([1.0, 0.0, 0.0], (8, 1))
    few = np.minimum(EIGHT, MIN_SCANS - 2)
    assert find_strips(*patches(centres, normals), few, 0.1).count == 0
    assert find_strips(*patches(centres, normals), EIGHT, 0.1).count == 1


def test_ground_is_a_surface_for_each_tile() -> None:
    x, y = (g.ravel() for g in np.meshgrid(0.35 + 2.1 * np.arange(6), 0.35 + 2.1 * np.arange(3)))
    centres = np.repeat(np.column_stack([x, y, np.full(len(x), 0.5)]), 8, axis=0)
    normals = np.tile([0.0, 0.0, 1.0], (len(centres), 1))
    strips = find_strips(*patches(centres, normals), np.tile(EIGHT, len(x)), 0.1)
    assert strips.count == 18
    assert len(set(strips.surface)) == 2  # 12 m by 6 m
    tile = np.floor(strips.centres_map[:, 0] / 6.0)
    assert all(len(set(strips.surface[tile == k])) == 1 for k in (0, 1))


def test_nothing_gives_nothing() -> None:
    none = find_strips(np.zeros((0, 4, 4)), np.zeros((0, 3)), np.zeros(0, np.int64), 0.1)
    assert none.count == 0
