"""Triangle meshes, made in code, of what a scenario can place.

Every solid is closed and has thickness. A backrest with a single skin would let two LiDARs on its
two sides agree on a surface that a real chair does not have.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import assert_never

import gtsam
import numpy as np

from caliv_graph.products import Array, IntArray
from caliv_graph.scenario.terrain import Terrain
from caliv_graph.scenario.world_models import (
    BoxModel,
    ChairModel,
    CylinderModel,
    ObjectModel,
    PoleModel,
    TableModel,
)

DRUM_SIDES = 360
"""Sides of a cylinder's mesh. With 24 sides its yaw would be observable to some milliradians."""

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Mesh:
    """Triangles.

    Attributes:
        vertices: (n, 3) metres, frame by context.
        triangles: (m, 3) indices of vertices, counter-clockwise seen from outside.
    """

    vertices: Array
    triangles: IntArray

    def moved(self, T_a_b: gtsam.Pose3) -> Mesh:
        """The mesh with its vertices transformed from frame b into frame a."""
        vertices = self.vertices @ T_a_b.rotation().matrix().T + T_a_b.translation()
        return Mesh(vertices, self.triangles)

    def signed_volume(self) -> float:
        """Volume in cubic metres of a closed mesh; positive if its faces point outwards."""
        a, b, c = (self.vertices[self.triangles[:, i]] for i in range(3))
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one. Solids may overlap: a ray from outside hits the outer skin first."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return Mesh(
        np.vstack([mesh.vertices for mesh in meshes]),
        np.vstack([mesh.triangles + o for mesh, o in zip(meshes, offsets[:-1], strict=True)]),
    )


def _quads(a: IntArray, b: IntArray, c: IntArray, d: IntArray) -> IntArray:
    """Two triangles for each quadrilateral a b c d."""
    a, b, c, d = (x.reshape(-1) for x in (a, b, c, d))
    return np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def _grid_quads(index: IntArray) -> IntArray:
    return _quads(index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])


def solid_between(one: Array, other: Array) -> Mesh:
    """The closed solid between two grids (r, c, 3) of points and the rim between their borders."""
    rows, columns = one.shape[:2]
    n = rows * columns
    index = np.arange(n).reshape(rows, columns)
    border = np.concatenate(
        [index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0], index[0, :1]]
    )
    triangles = np.vstack(
        [
            _grid_quads(index)[:, ::-1],
            _grid_quads(index + n),
            _quads(border[1:], border[:-1], border[:-1] + n, border[1:] + n),
        ]
    )
    mesh = Mesh(np.vstack([one.reshape(-1, 3), other.reshape(-1, 3)]), triangles)
    # The orientation of the faces depends on the side of `one` on which `other` lies.
    return mesh if mesh.signed_volume() > 0.0 else Mesh(mesh.vertices, triangles[:, ::-1])


def _rectangle(centre: Point, size: tuple[float, float], axes: tuple[int, int]) -> Array:
    """(2, 2, 3) corners of a rectangle that spans two of the axes x, y, z (0, 1, 2)."""
    corners = np.tile(np.array(centre, dtype=np.float64), (2, 2, 1))
    corners[:, :, axes[0]] += np.array([[-0.5], [0.5]]) * size[0]
    corners[:, :, axes[1]] += np.array([-0.5, 0.5]) * size[1]
    return corners


def bar(
    begin: Point,
    end: Point,
    begin_size: tuple[float, float],
    end_size: tuple[float, float],
    axes: tuple[int, int] = (0, 1),
) -> Mesh:
    """A tapered bar between two rectangles in parallel planes.

    Args:
        begin: centre of one end in metres.
        end: centre of the other end.
        begin_size: sides of the rectangle at `begin` along the two axes.
        end_size: sides at `end`.
        axes: the two axes of x, y, z (0, 1, 2) that the rectangles span.
    """
    return solid_between(_rectangle(begin, begin_size, axes), _rectangle(end, end_size, axes))


def box(size_m: Point) -> Mesh:
    """A box of this size; the origin is in the middle of its bottom face."""
    x, y, z = size_m
    return bar((0.0, 0.0, 0.0), (0.0, 0.0, z), (x, y), (x, y))


def _seat() -> Mesh:
    """Wider in front, dished by 12 mm, 25 mm thick, its top at 0.53 m."""
    u, v = np.meshgrid(np.linspace(-1.0, 1.0, 9), np.linspace(-1.0, 1.0, 9), indexing="ij")
    half_width = 0.30 + 0.03 * u
    dish = 0.012 * (1.0 - u**2) * (1.0 - v**2)
    # The front edge rolls off.
    roll = 0.03 * np.maximum(u - 0.6, 0.0) ** 2 / 0.16
    top = np.stack([0.015 + 0.295 * u, half_width * v, 0.53 - dish - roll], axis=-1)
    return solid_between(top, top - np.array([0.0, 0.0, 0.025]))


def _backrest() -> Mesh:
    """An arch 0.60 m wide, curved around the sitter, leaning back by 8 degrees, 25 mm thick."""
    v, w = np.meshgrid(np.linspace(-1.0, 1.0, 25), np.linspace(0.0, 1.0, 13), indexing="ij")
    top = 0.80 + 0.45 * np.sqrt(1.0 - 0.97 * v**2)
    z = 0.62 + (top - 0.62) * w
    lean = math.tan(math.radians(8.0)) * (z - 0.53)
    front = np.stack([-0.275 + 0.06 * v**2 - lean, 0.30 * v, z], axis=-1)
    return solid_between(front, front - np.array([0.025, 0.0, 0.0]))


def _side(side: float) -> list[Mesh]:
    """Legs, upright and armrest; `side` is +1 on the left, -1 on the right."""

    def at(x: float, y: float, z: float) -> Point:
        return (x, side * y, z)

    return [
        # Front leg, from the ground past the seat up to the armrest.
        bar(at(0.345, 0.335, 0.0), at(0.245, 0.325, 0.70), (0.055, 0.045), (0.08, 0.035)),
        # Rear leg, and the upright that carries the backrest.
        bar(at(-0.345, 0.315, 0.0), at(-0.245, 0.295, 0.52), (0.055, 0.045), (0.08, 0.035)),
        bar(at(-0.25, 0.295, 0.5), at(-0.265, 0.285, 0.84), (0.065, 0.03), (0.035, 0.025)),
        # Armrest, rising towards the back.
        bar(at(0.285, 0.325, 0.695), at(-0.265, 0.3, 0.765), (0.06, 0.025), (0.05, 0.025), (1, 2)),
    ]


def chair() -> Mesh:
    """A plastic armchair like the CaLiV authors': 0.71 m wide, 0.77 m deep, 1.25 m high.

    Front is +x, the origin is on the ground below the middle of the seat. It has mirror symmetry
    between left and right and no rotational symmetry.
    """
    return join([_seat(), _backrest(), *_side(1.0), *_side(-1.0)])


def cylinder(
    begin: Point, end: Point, begin_radius_m: float, end_radius_m: float, sides: int = 24
) -> Mesh:
    """An upright round solid between two levels, tapered if the radii differ."""
    angle = np.linspace(0.0, 2.0 * math.pi, sides, endpoint=False)
    rim = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    low = np.array(begin) + begin_radius_m * rim
    high = np.array(end) + end_radius_m * rim
    n = len(angle)
    i = np.arange(n)
    j = (i + 1) % n
    low_centre, high_centre = np.full(n, 2 * n), np.full(n, 2 * n + 1)
    triangles = np.vstack(
        [
            _quads(i, j, j + n, i + n),
            np.column_stack([j, i, low_centre]),
            np.column_stack([i + n, j + n, high_centre]),
        ]
    )
    return Mesh(np.vstack([low, high, [begin], [end]]), triangles)


def table(size_m: Point, top_m: float, leg_m: float) -> Mesh:
    """A table: a top and four square legs at its corners; the origin is on the ground below it."""
    x, y, z = size_m
    top = bar((0.0, 0.0, z - top_m), (0.0, 0.0, z), (x, y), (x, y))
    half_x, half_y = 0.5 * (x - leg_m), 0.5 * (y - leg_m)
    legs = [
        bar((a, b, 0.0), (a, b, z - 0.5 * top_m), (leg_m, leg_m), (leg_m, leg_m))
        for a in (-half_x, half_x)
        for b in (-half_y, half_y)
    ]
    return join([top, *legs])


def person() -> Mesh:
    """A person in mid-step, 1.75 m tall, facing +x, origin on the ground between the feet."""
    return join(
        [
            cylinder((0.22, 0.1, 0.0), (0.0, 0.09, 0.86), 0.06, 0.085),
            cylinder((-0.22, -0.1, 0.0), (0.0, -0.09, 0.86), 0.06, 0.085),
            bar((0.0, 0.0, 0.84), (0.0, 0.0, 1.46), (0.22, 0.34), (0.24, 0.42)),
            bar((-0.2, 0.26, 0.8), (0.0, 0.23, 1.42), (0.09, 0.08), (0.11, 0.09)),
            bar((0.2, -0.26, 0.8), (0.0, -0.23, 1.42), (0.09, 0.08), (0.11, 0.09)),
            cylinder((0.0, 0.0, 1.45), (0.01, 0.0, 1.75), 0.09, 0.08),
        ]
    )


def ground(half_size_m: float, terrain: Terrain | None = None) -> Mesh:
    """Ground around the origin, a square at z = 0 with ramps on it, facing up.

    It is the only mesh without thickness.
    """
    if terrain is None:
        side_m = 2.0 * half_size_m
        square = _rectangle((0.0, 0.0, 0.0), (side_m, side_m), (0, 1))
        return Mesh(square.reshape(-1, 3), _grid_quads(np.arange(4).reshape(2, 2)))
    x, y = np.meshgrid(*terrain.grid_lines(half_size_m), indexing="ij")
    xy = np.column_stack([x.ravel(), y.ravel()])
    vertices = np.column_stack([xy, terrain.heights(xy)[0]])
    return Mesh(vertices, _grid_quads(np.arange(len(xy)).reshape(x.shape)))


def object_mesh(model: ObjectModel) -> Mesh:
    """The mesh of an object, in its own frame: origin on the ground, front along +x."""
    if isinstance(model, ChairModel):
        return chair()
    if isinstance(model, BoxModel):
        return box(model.size_m)
    if isinstance(model, PoleModel | CylinderModel):
        top = (0.0, 0.0, model.height_m)
        sides = 24 if isinstance(model, PoleModel) else DRUM_SIDES
        return cylinder((0.0, 0.0, 0.0), top, model.radius_m, model.radius_m, sides)
    if isinstance(model, TableModel):
        return table(model.size_m, model.top_m, model.leg_m)
    assert_never(model)
